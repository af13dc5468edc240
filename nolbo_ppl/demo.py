"""`nolbo demo`: a short SVI run from scratch with its bound by term, then posteriors of unseen scenes.

The run trains the smallest networks (`nano`) on two thousand generated scenes, enough to watch every term of the bound
rise. The queries use the shipped model on scenes and shapes that no training has seen.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from tqdm import tqdm

from nolbo_ppl.data.scene import Rendered
from nolbo_ppl.data.scene_config import preset
from nolbo_ppl.data.source import SceneSource
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.inference.elbo import BOUND_TERMS
from nolbo_ppl.inference.observations import Observations
from nolbo_ppl.inference.queries import ObservationModel
from nolbo_ppl.inference.weights import load
from nolbo_ppl.io import read_jsonl, write_json
from nolbo_ppl.metrics.calibration import chi_square_mass
from nolbo_ppl.metrics.detection import match_image
from nolbo_ppl.metrics.viewpoint import rotation_error
from nolbo_ppl.metrics.voxel import voxel_iou
from nolbo_ppl.train import TrainConfig, TrainSummary
from nolbo_ppl.train import run as train

UNSEEN = 77_001
"""Seed of the scenes that are observed: neither they nor their shapes occur in training or evaluation."""


@dataclass(frozen=True)
class DemoConfig:
    """What the demonstration does."""

    out: Path = Path("demo")
    """Folder for the short run, the picture, the table and a cache of scenes."""
    model: str = "tiny"
    """Model of the queries: weights in the package, or a folder."""
    shape_steps: int = 200
    """Steps of the short run's shape autoencoder."""
    scene_steps: int = 600
    """Steps of the short run on scenes."""
    count: int = 2048
    """Scenes of the short run."""
    scenes: int = 24
    """Unseen scenes to observe; the one with the most objects is drawn."""
    threshold: float = 0.3
    """Least objectness of a detection."""
    seed: int = 0
    """Seed of the short run."""
    workers: int = 2
    """Processes that render scenes."""

    def __post_init__(self) -> None:
        for name in ("shape_steps", "scene_steps", "count", "scenes", "workers"):
            if getattr(self, name) < 1:
                raise input_error(name, got=getattr(self, name), expected="at least 1")


@dataclass(frozen=True)
class Found:
    """One true object and what was said of it; the answers are NaN where it was missed."""

    scene: int
    category: str
    visibility: float
    side: float
    """Longer side of its box, px."""
    distance: float
    """m."""
    objectness: float = math.nan
    said: str = "missed"
    """Category of maximum likelihood."""
    probability: float = math.nan
    """Posterior probability of that category."""
    rotation_error: float = math.nan
    """rad, the least over the object's symmetry."""
    said_distance: float = math.nan
    distance_scale: float = math.nan
    position_mass: float = math.nan
    """Mass of the posterior's region that reaches out to the true position: below 0.9 it is inside the 90 % region."""
    voxel_iou: float = math.nan

    @property
    def counts(self) -> bool:
        """At least 12 px and half visible, as in `nolbo evaluate`."""
        return self.side >= 12 and self.visibility >= 0.5


@dataclass
class DemoSummary:
    """What came out."""

    training: TrainSummary
    objects: list[Found]
    figures: dict[str, float] = field(default_factory=dict)
    """Recall, precision, category accuracy, median rotation error (degrees), median distance error, coverage, IoU."""
    picture: Path = Path("posterior.png")
    text: str = ""
    """The printed tables."""


def training_config(config: DemoConfig) -> TrainConfig:
    """The short run: networks of 0.15 M parameters on easy scenes of 64 px."""
    return TrainConfig(
        out=config.out / "svi", preset="nano", difficulty="easy", count=config.count, cache=config.out / "cache",
        seed=config.seed, shape_steps=config.shape_steps, single_steps=0, scene_steps=config.scene_steps,
        batch=32, shape_batch=16, learning_rate=4e-3, workers=config.workers, log_every=1,
        evaluate_every=max(1, config.scene_steps // 12), evaluate_scenes=128,
        checkpoint_every=max(1, config.scene_steps // 6), threads=0,
    )  # fmt: skip


def bound_table(config: TrainConfig, end: Mapping[str, float]) -> str:
    """The bound by term as it rose: of shapes over the first stage, of held-out scenes over the second."""
    history = [row for _, row in read_jsonl(config.out / "metrics.jsonl")]
    shapes = [row for row in history if row["stage"] == "shapes"]
    shapes = [shapes[0], shapes[len(shapes) // 2], shapes[-1]]
    terms = ("shape_kl", "voxels")
    lines = _columns(
        "shapes, nats a shape", [f"step {row['step']}" for row in shapes],
        {name: [row[f"terms/{name}"] for row in shapes] for name in terms}, "bound",
    )  # fmt: skip
    scenes: list[dict[str, Any]] = [row for row in history if "bound" in row]
    scenes = [*(scenes[i] for i in sorted({0, len(scenes) // 4, len(scenes) // 2}) if scenes), dict(end)]
    names = [f"step {row['step']}" for row in scenes[:-1]] + [f"step {config.scene_steps}"]
    bound = {name: [row.get(f"bound/{name}", 0.0) for row in scenes] for name in BOUND_TERMS if f"bound/{name}" in end}
    return "\n".join([*lines, "", *_columns("unseen scenes, nats a scene", names, bound, "bound")])


def _columns(title: str, names: Sequence[str], rows: Mapping[str, Sequence[float]], total: str) -> list[str]:
    lines = [f"{title:<30}" + "".join(f"{name:>14}" for name in names)]
    lines += [f"  {term:<28}" + "".join(f"{value:>14.1f}" for value in values) for term, values in rows.items()]
    sums = [sum(values[i] for values in rows.values()) for i in range(len(names))]
    return [*lines, f"  {total:<28}" + "".join(f"{value:>14.1f}" for value in sums)]


def compare(scene: int, rendered: Rendered, observed: Observations) -> tuple[list[Found], int]:
    """Every true object of a scene with the detection matched to it, and the number of detections without a truth."""
    labels = rendered.labels
    boxes = np.array([label.box for label in labels]).reshape(-1, 4)
    matched = match_image(observed.box, observed.objectness, boxes, np.zeros(len(labels), dtype=bool))
    result = []
    for i, label in enumerate(labels):
        side, distance = float(np.max(label.box[2:] - label.box[:2])), float(np.linalg.norm(label.position))
        hits = np.flatnonzero(matched == i)
        answer = _answer(observed, hits[:1], rendered, i) if len(hits) else {}
        result.append(Found(scene, label.category, label.visibility, side, distance, **answer))
    return result, int((matched < 0).sum())


def _answer(observed: Observations, hit: Int[np.ndarray, " 1"], rendered: Rendered, truth: int) -> dict[str, Any]:
    """What the posterior of one detection says of its truth."""
    label, one = rendered.labels[truth], observed[hit]
    position, covariance = one.position[0], one.position_covariance[0]
    distance = float(np.linalg.norm(position))
    ray = position / distance
    symmetry = np.array([label.symmetry])
    iou = math.nan
    if one.voxel_mean is not None and one.voxel_mean.shape[1] == 32:
        iou = float(voxel_iou(one.voxel_mean, unpack_voxels(label.item.voxels[None], 32))[0])
    return {
        "objectness": float(one.objectness[0]),
        "said": one.category[0],
        "probability": float(one.class_posterior[0, one.categories.index(one.category[0])]),
        "rotation_error": float(rotation_error(one.R_camera_object, label.R_camera_object[None], symmetry)[0]),
        "said_distance": distance,
        "distance_scale": math.sqrt(float(ray @ covariance @ ray)),
        "position_mass": float(chi_square_mass((label.position - position)[None], covariance[None])[0]),
        "voxel_iou": iou,
    }


def figures(objects: Sequence[Found], spurious: int) -> dict[str, float]:
    """Summary over the objects that count (a spurious detection is one that overlaps no object by half)."""
    counted = [one for one in objects if one.counts]
    found = [one for one in counted if one.said != "missed"]
    hits = sum(one.said != "missed" for one in objects)

    def median(values: Sequence[float]) -> float:
        return float(np.nanmedian(values)) if len(values) else math.nan

    result = {
        "objects": len(counted),
        "recall": len(found) / max(len(counted), 1),
        "precision": hits / max(hits + spurious, 1),
        "category_accuracy": float(np.mean([one.said == one.category for one in found])) if found else math.nan,
        "rotation_error_deg": math.degrees(median([one.rotation_error for one in found])),
        "distance_error": median([abs(one.said_distance / one.distance - 1) for one in found]),
        "position_in_90": float(np.mean([one.position_mass <= 0.9 for one in found])) if found else math.nan,
        "voxel_iou": median([one.voxel_iou for one in found]),
    }
    return {name: value for name, value in result.items() if math.isfinite(value)}


def object_table(objects: Sequence[Found]) -> str:
    """What was said of each object beside the truth."""
    lines = [
        f"{'truth':<13}{'seen':>5}  {'objectness':>10}  {'category said (its probability)':<32}{'rotation off':>13}"
        f"{'distance':>10}{'said, m':>18}{'voxel IoU':>11}"
    ]
    for one in objects:
        if one.said == "missed":
            lines.append(f"{one.category:<13}{one.visibility:>5.0%}  {'missed':>10}{'':<47}{one.distance:>10.2f}")
            continue
        said = f"{one.said} ({one.probability:.2f})"
        range_ = f"{one.said_distance:.2f} ± {one.distance_scale:.2f}"
        lines.append(
            f"{one.category:<13}{one.visibility:>5.0%}  {one.objectness:>10.3f}  {said:<32}"
            f"{math.degrees(one.rotation_error):>12.1f}°{one.distance:>10.2f}{range_:>18}{one.voxel_iou:>11.2f}"
        )
    return "\n".join(lines)


def observe_unseen(config: DemoConfig, model: ObservationModel) -> tuple[list[Found], int, Rendered, Observations]:
    """Observe unseen scenes: objects, spurious detections, and the fullest scene with its posterior."""
    source = SceneSource(preset("standard", model.config.image_size), seed=UNSEEN)
    rendered = [
        source.render(i) for i in tqdm(range(config.scenes), desc="rendering unseen scenes", unit="scene", disable=None)
    ]
    observed = model.observe(
        [one.image for one in rendered], [one.intrinsics for one in rendered], threshold=config.threshold
    )
    objects, spurious = [], 0
    for i, (truth, said) in enumerate(zip(rendered, observed)):
        found, alone = compare(i, truth, said)
        objects += found
        spurious += alone
    crowded = int(np.argmax([sum(one.counts for one in objects if one.scene == i) for i in range(len(rendered))]))
    # The objects of the crowded scene come first, as in the picture.
    objects.sort(key=lambda one: one.scene != crowded)
    return objects, spurious, rendered[crowded], observed[crowded]


def run(config: DemoConfig) -> DemoSummary:
    """Train for a short while, observe unseen scenes, draw one; writes `posterior.png` and `demo.json`.

    Raises:
        InputError: the model is not there, or the folder holds a run with other options.
    """
    from nolbo_ppl.viz.observations import draw_observations  # matplotlib is only needed for the picture

    model = load(config.model)  # before the minutes of training: a wrong name fails at once
    training = training_config(config)
    summary = DemoSummary(train(training), [], picture=config.out / "posterior.png")
    summary.objects, spurious, scene, observed = observe_unseen(config, model)
    summary.figures = figures(summary.objects, spurious)
    draw_observations(
        scene.image, observed, scene.intrinsics, prior_mean=model.prior_mean(), path=summary.picture,
        title=f"Posterior of an unseen scene, model {config.model}",
    )  # fmt: skip
    first = summary.objects[0].scene if summary.objects else 0
    told = f"{summary.training.steps} steps, {summary.training.seconds:.0f} s; rows in {training.out}/metrics.jsonl"
    summary.text = "\n".join([
        "1. A short SVI run from scratch: the bound by term", "",
        bound_table(training, summary.training.held_out), "",
        f"   {told}", "",
        f"2. Posterior of unseen scenes by the model {config.model}: the scene of {summary.picture}", "",
        object_table([one for one in summary.objects if one.scene == first]), "",
        f"   over {config.scenes} scenes: " + ", ".join(f"{k} {_plain(v)}" for k, v in summary.figures.items()),
    ])  # fmt: skip
    write_json(config.out / "demo.json", {"figures": summary.figures, "held_out": summary.training.held_out})
    return summary


def _plain(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.3g}"


def main(args: Sequence[str] | None = None) -> None:
    """Parse the command line, run, print the tables."""
    import tyro

    summary = run(tyro.cli(DemoConfig, args=args, prog="nolbo demo", description=__doc__))
    sys.stdout.write(summary.text + "\n")


if __name__ == "__main__":
    main()
