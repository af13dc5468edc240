"""Pictures of each landmark: the best one (where it was seen surely, belongs to it surely, and is large) and all its views."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.io.files import atomic_path, write_json
from nolbo_ppl.io.landmark_views import VIEWS
from nolbo_ppl.structures.association_table import AssociationTable
from nolbo_ppl.structures.detections import Detections

MARGIN = 0.15
"""What is shown around the box, as a share of its sides."""
LONGEST = 192
"""Longer side of a crop, px; smaller ones are enlarged to it up to four times."""
MOST_VIEWS, MOST_PICTURES = 24, 2000
"""Views of one landmark, and of all, that are cut out: a report holds them all."""
HARDLY = 0.05
"""A detection that belongs to a landmark with less probability is no view of it."""
VIEW_LONGEST = 128
"""Longer side of a view, px."""


@dataclass(frozen=True)
class Crop:
    """Where a landmark is seen."""

    frame: int
    """Keyframe."""
    box: Float[np.ndarray, " 4"]
    """[x0, y0, x1, y1], px."""
    value: float
    """Weight times objectness times the box's side."""
    weight: float = 1.0
    """Probability that the detection is of the landmark."""
    objectness: float = 1.0
    """Probability that it is an object."""


def best_views(detections: Detections, found: AssociationTable, names: Sequence[str]) -> dict[str, Crop]:
    """For each landmark the detection with the largest weight x objectness x side of its box.

    Args:
        detections: what SLAM was given.
        found: the weights, in the order of the detections.
        names: names of the landmarks.
    """
    return {name: max(views, key=lambda view: view.value) for name, views in all_views(detections, found, names).items()}


def all_views(detections: Detections, found: AssociationTable, names: Sequence[str]) -> dict[str, list[Crop]]:
    """Every detection of each landmark that has a box, in order of the frames; those a landmark hardly owns are left out.

    Args:
        detections: what SLAM was given.
        found: the weights, in the order of the detections.
        names: names of the landmarks.
    """
    views: dict[str, list[Crop]] = {}
    side = np.sqrt(np.prod(np.maximum(detections.box[:, 2:] - detections.box[:, :2], 0.0), axis=1))
    values = found.weight * detections.objectness[found.row] * side[found.row]
    for k, j, value, weight in zip(found.row.tolist(), found.landmark.tolist(), values.tolist(), found.weight.tolist()):
        if value > 0 and weight >= HARDLY:  # NaN where there is no box
            owned = (weight, float(detections.objectness[k]))
            views.setdefault(names[j], []).append(Crop(int(detections.frame[k]), detections.box[k], value, *owned))
    return {name: sorted(seen, key=lambda view: view.frame) for name, seen in views.items()}


def spread_views(views: Sequence[Crop], most: int) -> list[Crop]:
    """At most so many views: the best of each of as many stretches of equal numbers, in order."""
    if len(views) <= most:
        return list(views)
    edges = np.linspace(0, len(views), most + 1).round().astype(int)
    return [max(views[a:b], key=lambda view: view.value) for a, b in pairwise(edges.tolist())]


def cut(image: UInt8[np.ndarray, "h w 3"], box: Float[np.ndarray, " 4"], longest: int = LONGEST) -> UInt8[np.ndarray, "a b 3"]:
    """The box with a margin, at a size to look at."""
    from PIL import Image

    extent = MARGIN * (box[2:] - box[:2])
    size = np.array(image.shape[1::-1])
    low = np.clip(np.floor(box[:2] - extent), 0, size - 1).astype(int)
    high = np.maximum(np.clip(np.ceil(box[2:] + extent), 1, size).astype(int), low + 1)
    part = Image.fromarray(image[low[1] : high[1], low[0] : high[0]])
    factor = min(longest / max(part.size), 4.0)
    new = [max(1, round(side * factor)) for side in part.size]
    return np.asarray(part.resize((new[0], new[1]), Image.Resampling.LANCZOS))


def write_thumbnails(out: Path, views: Mapping[str, Sequence[Crop]], read: Callable[[int], UInt8[np.ndarray, "h w 3"]]) -> None:
    """Write `NAME.png` of each landmark's best view, its views into `views`, and `views.json`; each image is read once.

    Args:
        out: folder, made even when there is nothing to write.
        views: views of each landmark, in order of the frames.
        read: image of a keyframe.
    """
    from PIL import Image

    (out / VIEWS).mkdir(parents=True, exist_ok=True)
    most = max(3, min(MOST_VIEWS, MOST_PICTURES // max(len(views), 1)))
    best = {name: max(seen, key=lambda view: view.value) for name, seen in views.items()}
    chosen = {name: spread_views(seen, most) for name, seen in views.items()}
    listed: dict[str, Any] = {name: {"count": len(seen), "views": []} for name, seen in views.items()}
    wanted: dict[int, list[tuple[int, str]]] = {}
    for k, (name, seen) in enumerate(chosen.items()):
        for frame in {view.frame for view in seen} | {best[name].frame}:
            wanted.setdefault(frame, []).append((k, name))
    for frame in sorted(wanted):
        image = read(frame)
        for k, name in wanted[frame]:
            if best[name].frame == frame:
                with atomic_path(out / f"{name}.png") as temporary:
                    Image.fromarray(cut(image, best[name].box)).save(temporary)
            for number, view in enumerate(view for view in chosen[name] if view.frame == frame):
                file = f"{k}-{frame}-{number}.jpg"
                with atomic_path(out / VIEWS / file) as temporary:
                    Image.fromarray(cut(image, view.box, VIEW_LONGEST)).save(temporary, quality=82)
                row = {"frame": frame, "file": file, "weight": round(view.weight, 4), "objectness": round(view.objectness, 4)}
                listed[name]["views"].append(row)
    write_json(out / f"{VIEWS}.json", listed)
