"""The truth of a drive: read, refused where it does not fit, and whose each detection is."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.evaluation.sequence_truth import SequenceGroundTruth, match_detections, object_shown, read_ground_truth
from nolbo_ppl.structures.annotations import Annotations
from tests.simulated_sequence import SimulatedDrive


def names(drive: SimulatedDrive) -> list[str]:
    return [f"../anywhere/images/{t:06d}.png" for t in range(len(drive.truth))]


def test_truth_of_a_drive(drive: SimulatedDrive) -> None:
    truth = read_ground_truth(drive.folder, names(drive)[5:40:5])
    assert len(truth) == len(drive.model.latents) and len(truth.frames) == 7
    seen = truth.frames[2]  # the frames that were asked for, in that order
    T = drive.truth[15]
    world = np.einsum("ij,nj->ni", T[:3, :3], seen.position) + T[:3, 3]
    np.testing.assert_allclose(world, truth.T_world_object[truth.shown[2], :3, 3], atol=1e-9)
    np.testing.assert_allclose(T[:3, :3] @ seen.R_camera_object, truth.T_world_object[truth.shown[2], :3, :3], atol=1e-9)


def test_every_simulated_detection_finds_its_object(drive: SimulatedDrive) -> None:
    """Boxes follow from noisy positions: what matches is right, and with exact boxes everything matches."""
    truth, table = read_ground_truth(drive.folder, names(drive)), drive.model.table
    seen = np.concatenate(truth.shown)
    frame = np.repeat(np.arange(len(truth.frames)), [len(one) for one in truth.frames])
    exact = match_detections(frame, np.concatenate([one.box for one in truth.frames]), np.ones(len(frame)), truth)
    np.testing.assert_array_equal(exact.object, seen)
    assert exact.recall == 1.0 and exact.precision == 1.0
    from tests.simulated_sequence import boxes_of

    found = match_detections(table.frame, boxes_of(table.position), table.objectness, truth)
    matched = found.object >= 0
    assert matched.mean() > 0.8
    assert (found.object[matched] == drive.object_of[matched]).mean() > 0.98


def one_frame(box: list[list[float]], visibility: list[float]) -> SequenceGroundTruth:
    n = len(box)
    ids = tuple(str(k) for k in range(n))
    frame = Annotations.from_arrays([100, 100, 50, 50], box, id=ids, visibility=visibility)
    text = tuple("x" * n)
    return SequenceGroundTruth(
        ids, text, text, np.tile(np.eye(4), (n, 1, 1)), np.ones(n), np.ones(n, dtype=int), np.zeros(n, dtype=bool), {}, (frame,)
    )


def test_hardly_seen_objects_count_neither_way() -> None:
    truth = one_frame([[0, 0, 20, 20], [50, 0, 70, 20], [80, 0, 90, 10]], [1.0, 0.2, 1.0])  # large, hidden, small
    box = np.array([[0.0, 0, 20, 20], [50, 0, 70, 20], [80, 0, 90, 10], [120, 0, 140, 20], [1, 0, 21, 20]])
    found = match_detections(np.zeros(5, dtype=int), box, np.array([0.9, 0.8, 0.7, 0.6, 0.5]), truth)
    np.testing.assert_array_equal(found.object, [0, 1, 2, -1, -1])  # the second box of the first object is of none
    np.testing.assert_array_equal(found.counted, [True, False, False, False, False])
    assert (found.found, found.wanted) == (1, 1)
    assert found.precision == pytest.approx(1 / 3) and found.recall == 1.0


def test_two_detections_may_show_one_object() -> None:
    truth = one_frame([[0, 0, 20, 20], [10, 0, 30, 20]], [1.0, 1.0])
    box = np.array([[0.0, 0, 20, 20], [1, 0, 21, 20], [9, 0, 29, 20], [100, 0, 120, 20], [0, 0, 6, 6]])
    shown = object_shown(np.zeros(5, dtype=int), box, truth, 0.3)
    np.testing.assert_array_equal(shown, [0, 0, 1, -1, -1])
    assert object_shown(np.zeros(0, dtype=int), np.zeros((0, 4)), truth, 0.3).shape == (0,)


@pytest.mark.parametrize(
    ("file", "change", "match"),
    [
        ("objects.json", "[]", "expected one of objects.json"),
        (
            "scenes.jsonl",
            json.dumps({"image": "images/000000.png", "intrinsics": [9, 9, 9, 9], "objects": []}) + "\n",
            "lengths differ",
        ),
    ],
)
def test_bad_truth_is_refused(drive: SimulatedDrive, tmp_path: Path, file: str, change: str, match: str) -> None:
    folder = tmp_path / "drive"
    shutil.copytree(drive.folder, folder)
    (folder / file).write_text(change)
    with pytest.raises(InputError, match=match):
        read_ground_truth(folder, names(drive))


def test_images_and_shapes_must_be_those_of_the_drive(drive: SimulatedDrive, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not an image of the drive"):
        read_ground_truth(drive.folder, ["000000.png", "other.png"])
    folder = tmp_path / "drive"
    shutil.copytree(drive.folder, folder)
    np.savez(folder / "voxels.npz", something=np.zeros(4096, dtype=np.uint8))
    with pytest.raises(InputError, match="a true shape is missing"):
        read_ground_truth(folder, names(drive))
