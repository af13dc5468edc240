"""What is true in a drive: objects, their shapes, and which of them a frame shows; and whose a detection is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.boxes import pairwise_iou
from nolbo_ppl.metrics.detection import match_image
from nolbo_ppl.structures.annotations import Annotations

IOU = 0.5
"""Overlap of a detection with the object it is of."""


@dataclass(frozen=True)
class SequenceGroundTruth:
    """True objects of a drive."""

    names: tuple[str, ...]
    """`id` of each object."""
    category: tuple[str, ...]
    """Its category."""
    instance: tuple[str, ...]
    """Its shape's name."""
    T_world_object: Float[np.ndarray, "m 4 4"]
    """Its pose, at the start where it moves."""
    diagonal: Float[np.ndarray, " m"]
    """Its box diagonal, m."""
    symmetry: Int[np.ndarray, " m"]
    """1 none, n n-fold, 0 free about the vertical axis."""
    moving: Bool[np.ndarray, " m"]
    """Whether it moves."""
    packed: Mapping[str, UInt8[np.ndarray, " bytes"]]
    """Packed 32^3 grid by instance."""
    frames: tuple[Annotations, ...]
    """What each keyframe shows; every object has one of `names` for its `id`."""

    @cached_property
    def shown(self) -> tuple[Int[np.ndarray, " _"], ...]:
        """Number of every object that each keyframe shows, in the order of its annotations."""
        number = {name: i for i, name in enumerate(self.names)}
        return tuple(np.array([number[name or ""] for name in frame.id], dtype=np.int64) for frame in self.frames)

    def __len__(self) -> int:
        return len(self.names)


def _with_pose(seen: Annotations, file: Path) -> Annotations:
    """A frame whose objects all have a position and a rotation."""
    if not (np.isfinite(seen.position).all() and np.isfinite(seen.R_camera_object).all()):
        name = None if seen.file is None else seen.file.name
        raise input_error("an object without position or rotation", got=name, expected="both", file=file)
    return seen


def read_ground_truth(folder: Path, images: Sequence[str]) -> SequenceGroundTruth:
    """True objects of a drive folder, frame by frame for the given images.

    Args:
        folder: the drive (`nolbo drive`).
        images: names of the keyframes' images; the last part of a path decides.

    Raises:
        InputError: a file is missing or malformed, or an image is not one of the drive's.
    """
    from nolbo_ppl.synthetic.worlds import read_sequence_folder  # delayed: it brings the renderer

    drive = read_sequence_folder(folder)
    things = drive.objects
    by_image = {seen.file.name: seen for seen in drive.frames if seen.file is not None}
    missing = [image for image in images if Path(image).name not in by_image]
    if missing:
        raise input_error("not an image of the drive", got=missing[0], expected=f"one of {len(drive)} images", file=folder)
    packed = drive.voxels()
    without = sorted({thing.instance for thing in things} - set(packed))
    if without:
        raise input_error("a true shape is missing", got=without[0], expected="a grid for every instance", file=folder)
    return SequenceGroundTruth(
        names=tuple(thing.id for thing in things),
        category=tuple(thing.category for thing in things),
        instance=tuple(thing.instance for thing in things),
        T_world_object=np.array([thing.T_world_object for thing in things]).reshape(-1, 4, 4),
        diagonal=np.array([thing.diagonal for thing in things], dtype=np.float64),
        symmetry=np.array([thing.symmetry for thing in things], dtype=np.int64),
        moving=np.array([thing.moving for thing in things], dtype=bool),
        packed=packed,
        frames=tuple(_with_pose(by_image[Path(image).name], folder) for image in images),
    )


@dataclass(frozen=True)
class MatchResult:
    """Whose each detection is."""

    object: Int[np.ndarray, " k"]
    """Number of the true object, -1 for none."""
    row: Int[np.ndarray, " k"]
    """Its row in the truth of the frame, -1 for none."""
    counted: Bool[np.ndarray, " k"]
    """Matched to an object that was to be found."""
    found: int
    """Objects (of all frames) that were to be found and were."""
    wanted: int
    """Objects (of all frames) that were to be found."""

    @property
    def precision(self) -> float:
        """Share of the detections that are of an object; those of hardly seen ones are left out."""
        judged = self.counted | (self.object < 0)
        return float(self.counted.sum() / judged.sum()) if judged.any() else float("nan")

    @property
    def recall(self) -> float:
        """Share of the objects to be found that were."""
        return self.found / self.wanted if self.wanted else float("nan")


def object_shown(
    frame: Int[np.ndarray, " k"], box: Float[np.ndarray, "k 4"], truth: SequenceGroundTruth, least_overlap: float
) -> Int[np.ndarray, " k"]:
    """Number of the object each detection overlaps most, -1 where none reaches `least_overlap` (IoU).

    Unlike `match_detections`, two detections may be of one object: whose a detection is does not depend on the others.
    """
    shown = np.full(len(frame), -1)
    for t, (seen, number) in enumerate(zip(truth.frames, truth.shown)):
        rows = np.flatnonzero(frame == t)
        if len(rows) and len(seen):
            overlap = pairwise_iou(torch.from_numpy(box[rows]), torch.from_numpy(seen.box)).numpy()
            best = overlap.argmax(1)
            shown[rows] = np.where(overlap.max(1) >= least_overlap, number[best], -1)
    return shown


def match_detections(
    frame: Int[np.ndarray, " k"],
    box: Float[np.ndarray, "k 4"],
    objectness: Float[np.ndarray, " k"],
    truth: SequenceGroundTruth,
    iou_threshold: float = IOU,
) -> MatchResult:
    """Match detections with the objects of their frames, greedily by objectness, at most one an object (as COCO does)."""
    object_of, row_of = np.full(len(frame), -1), np.full(len(frame), -1)
    counted = np.zeros(len(frame), dtype=bool)
    found = wanted = 0
    for t, (seen, number) in enumerate(zip(truth.frames, truth.shown)):
        rows, counts = np.flatnonzero(frame == t), seen.counts()
        matched = match_image(box[rows], objectness[rows], seen.box, ~counts, iou_threshold)
        hit = matched >= 0
        object_of[rows[hit]], row_of[rows[hit]] = number[matched[hit]], matched[hit]
        counted[rows[hit]] = counts[matched[hit]]
        found += int(counts[matched[hit]].sum())
        wanted += int(counts.sum())
    return MatchResult(object_of, row_of, counted, found, wanted)
