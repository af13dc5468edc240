"""The best picture of each landmark: where it was seen surely, belongs to it surely, and is large."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.io.files import atomic_path

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


def best_views(observations: Sequence[Mapping[str, Any]], associations: Sequence[Mapping[str, Any]]) -> dict[str, Crop]:
    """For each landmark the detection with the largest weight x objectness x side of its box.

    Args:
        observations: rows of `observations.jsonl`.
        associations: rows of `associations.jsonl`, in the same order.
    """
    best: dict[str, Crop] = {}
    for seen, found in zip(observations, associations, strict=True):
        if "box" not in seen:
            continue
        box = np.array(seen["box"], dtype=np.float64)
        side = float(np.sqrt(np.prod(np.maximum(box[2:] - box[:2], 0.0))))
        for name, weight in found["landmarks"].items():
            value = float(weight) * float(seen.get("objectness", 1.0)) * side
            if value > 0 and (name not in best or value > best[name].value):
                best[name] = Crop(int(seen["frame"]), box, value)
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


def write_crops(out: Path, views: Mapping[str, Crop], read: Callable[[int], UInt8[np.ndarray, "h w 3"]]) -> None:
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
