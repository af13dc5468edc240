"""Photographs without labels, labelled by a model that says how sure it is: scenes to learn from with soft labels.

An object found has the probability that it is there (`confidence`) and that its category is right (`category_confidence`).
Training draws both anew each time an image is seen (`nolbo_ppl.training.scene_loader`): an object not drawn is background,
a category that is not drawn is missing, and the bound enumerates it. The mean over the draws is the objective of soft labels.
What the model hardly suspects is neither: a region to ignore.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.camera import guessed_pinhole
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.io.files import write_json, write_jsonl
from nolbo_ppl.io.images import open_image
from nolbo_ppl.progress import progress_bar

MIN_CONFIDENCE = 0.2
"""Least probability of an object that becomes a label."""
SUSPECTED = 0.05
"""From this probability on it is a region to ignore; what is less is background."""
MIN_SIDE = 4.0
"""Boxes with a side below, px, are left out."""


def write_pseudo_labels(
    images: Sequence[Path],
    model: ObservationModel,
    out: str | os.PathLike[str],
    min_confidence: float = MIN_CONFIDENCE,
    suspected: float = SUSPECTED,
    batch: int = 16,
) -> dict[str, int]:
    """Write images/, scenes.jsonl and source.json of what a model finds; returns counts.

    Args:
        images: the photographs.
        model: finds objects in them.
        out: folder, made when missing.
        min_confidence: least probability of a label.
        suspected: least probability of a region to ignore.
        batch: photographs that go through the network at once.

    Raises:
        InputError: no photographs, one that cannot be read, or probabilities out of order.
    """
    if not 0 < suspected <= min_confidence < 1:
        got = f"{suspected} and {min_confidence}"
        raise input_error("suspected and min_confidence", got=got, expected="0 < suspected <= min_confidence < 1")
    if not images:
        raise input_error("photographs to label", got=0, expected="at least one")
    out = Path(out)
    (out / "images").mkdir(parents=True, exist_ok=True)
    lines: list[dict[str, Any]] = []
    for first in progress_bar(range(0, len(images), batch), "pseudo-labels", "batch"):
        part = images[first : first + batch]
        pixels = [open_image(path) for path in part]
        found = model.observe(pixels, threshold=suspected, decode=False, batch=batch)
        for path, picture, one in zip(part, pixels, found):
            height, width = picture.shape[:2]
            name = f"images/{len(lines):06d}{path.suffix.lower()}"
            shutil.copyfile(path, out / name)
            box = np.clip(one.box, 0, [width, height, width, height])
            kept = (box[:, 2:] - box[:, :2] >= MIN_SIDE).all(1)
            sure, best = one.objectness >= min_confidence, one.class_log_posterior.argmax(1)
            objects = [
                {
                    "box": [round(float(v), 3) for v in box[k]],
                    "category": model.config.categories[best[k]],
                    "confidence": round(float(one.objectness[k]), 4),
                    "category_confidence": round(float(one.class_posterior[k, best[k]]), 4),
                }
                for k in np.flatnonzero(kept & sure)
            ]
            ignore = [[round(float(v), 3) for v in box[k]] for k in np.flatnonzero(kept & ~sure)]
            camera = guessed_pinhole(width, height).tolist()
            lines.append({"image": name, "intrinsics": camera, "objects": objects, "ignore": ignore})
    counts = {
        "images": len(lines),
        "objects": sum(len(line["objects"]) for line in lines),
        "ignore": sum(len(line["ignore"]) for line in lines),
    }
    write_json(out / "source.json", {"kind": "pseudo-labels", **counts})
    write_jsonl(out / "scenes.jsonl", lines)
    return counts
