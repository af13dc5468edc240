"""The best picture of each landmark: where it was seen surely, belongs to it surely, and is large."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.structures.association_table import AssociationTable
from nolbo_ppl.structures.detections import Detections

MARGIN = 0.15
"""What is shown around the box, as a share of its sides."""
LONGEST = 192
"""Longer side of a crop, px; smaller ones are enlarged to it up to four times."""


@dataclass(frozen=True)
class Crop:
    """Where a landmark is seen best."""

    frame: int
    """Keyframe."""
    box: Float[np.ndarray, " 4"]
    """[x0, y0, x1, y1], px."""
    value: float
    """Weight times objectness times the box's side."""


def best_views(detections: Detections, found: AssociationTable, names: Sequence[str]) -> dict[str, Crop]:
    """For each landmark the detection with the largest weight x objectness x side of its box.

    Args:
        detections: what SLAM was given.
        found: the weights, in the order of the detections.
        names: names of the landmarks.
    """
    best: dict[str, Crop] = {}
    side = np.sqrt(np.prod(np.maximum(detections.box[:, 2:] - detections.box[:, :2], 0.0), axis=1))
    values = found.weight * detections.objectness[found.row] * side[found.row]
    for k, j, value in zip(found.row.tolist(), found.landmark.tolist(), values.tolist()):
        if value > 0 and (names[j] not in best or value > best[names[j]].value):  # NaN where there is no box
            best[names[j]] = Crop(int(detections.frame[k]), detections.box[k], value)
    return best


def cut(image: UInt8[np.ndarray, "h w 3"], box: Float[np.ndarray, " 4"]) -> UInt8[np.ndarray, "a b 3"]:
    """The box with a margin, at a size to look at."""
    from PIL import Image

    extent = MARGIN * (box[2:] - box[:2])
    size = np.array(image.shape[1::-1])
    low = np.clip(np.floor(box[:2] - extent), 0, size - 1).astype(int)
    high = np.maximum(np.clip(np.ceil(box[2:] + extent), 1, size).astype(int), low + 1)
    part = Image.fromarray(image[low[1] : high[1], low[0] : high[0]])
    factor = min(LONGEST / max(part.size), 4.0)
    new = [max(1, round(side * factor)) for side in part.size]
    return np.asarray(part.resize((new[0], new[1]), Image.Resampling.LANCZOS))


def write_thumbnails(out: Path, views: Mapping[str, Crop], read: Callable[[int], UInt8[np.ndarray, "h w 3"]]) -> None:
    """Write `NAME.png` of every view into `out`; each image is read once.

    Args:
        out: folder, made even when there is nothing to write.
        views: best view of each landmark.
        read: image of a keyframe.
    """
    from PIL import Image

    out.mkdir(parents=True, exist_ok=True)
    for frame in sorted({view.frame for view in views.values()}):
        image = read(frame)
        for name, view in views.items():
            if view.frame == frame:
                with atomic_path(out / f"{name}.png") as temporary:
                    Image.fromarray(cut(image, view.box)).save(temporary)
