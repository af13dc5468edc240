"""An observation model measured on unseen scenes: what is asked for, what is found, and the content of metrics.json."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro

from nolbo_ppl._version import __version__
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.errors import input_error
from nolbo_ppl.evaluation.calibration_scores import calibration_table
from nolbo_ppl.evaluation.instance_views import InstanceViews
from nolbo_ppl.evaluation.labelled_scenes import FolderScenes, GeneratedScenes, Scenes
from nolbo_ppl.evaluation.measure import measure_detections, measure_objects
from nolbo_ppl.evaluation.photograph_run import PhotographEvaluation
from nolbo_ppl.evaluation.records import DetectionRecords, ObjectRecords, concatenate
from nolbo_ppl.evaluation.retrieval import RetrievalRecords, retrieval_table, retrieve
from nolbo_ppl.evaluation.scores import category_table, confusion, difficulty_table, judged, score_intervals
from nolbo_ppl.inference.posterior.multiscale import MultiScalePredictor
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.metrics.intervals import IntervalEstimate
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.renamed_options import renamed_options, stored_names
from nolbo_ppl.synthetic.scenes.scene_config import preset, rendered_size
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator

SEED = 9001
"""Default seed of generated scenes: neither the scenes nor the shapes of another seed are among them."""


@renamed_options(sizes="test_sizes", threshold="score_threshold")
@dataclass(frozen=True)
class EvaluateConfig:
    """Evaluate a model on scenes it has not seen and write figures, plots and examples.

    Example:
        >>> import nolbo_ppl
        >>> nolbo_ppl.EvaluateConfig("figures", model="tiny", count=200).score_threshold
        0.01
    """

    out: Path
    """Folder for metrics.json and the pictures."""
    model: str = "tiny"
    """Name of shipped weights, or a folder with model.safetensors and config.json."""
    device: str = "auto"
    """Where the networks run: `auto`, `cpu`, `cuda`, `cuda:N` or `mps`."""
    scenes: Path | None = None
    """Folder of labelled scenes (scenes.jsonl); without it scenes are generated."""
    photographs: Path | None = None
    """Labelled photographs in place of scenes: a COCO-style JSON file, or a folder with `val.json`; images lie in the folder
    `images` beside it. An image may name the categories it labels `exhaustive`ly, an annotation be `difficult` or have an
    `azimuth`, degrees."""
    part: tuple[int, int] = (0, 1)
    """Number of the first photograph and step to the next: with `1 3` the second, the fifth, ... are measured."""
    peer: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """ONNX file of a detector (YOLOX or PicoDet, COCO's categories) to measure on the same photographs; may be given several
    times (extra `onnx`)."""
    count: int = 500
    """Scenes to generate, or at most to read; of photographs, all are read unless a smaller number is given."""
    seed: int = SEED
    """Seed of the generated scenes and their shapes."""
    difficulty: Literal["easy", "standard", "full"] = "standard"
    """Generated scenes: easy, standard or full."""
    cad: Path | None = None
    """Folder of CAD shapes to generate scenes from, in place of parametric ones."""
    cad_up: str | None = None
    """The axis of the CAD files that points up; by default +y of GLB and glTF, +z of the others."""
    cad_front: str | None = None
    """The axis that their front faces; by default +z of files with y up, -y of those with z up."""
    backgrounds: Path | None = None
    """Folder of photographs behind generated scenes."""
    test_sizes: tuple[int, ...] = ()
    """Longer sides, px, images are brought to; the network's own size by default. With several, each answers for the
    objects it shows at a trained size: `256 640` for street images 1242 px wide."""
    retrieval: bool = False
    """Measure too whether the shape latent tells instances of a category apart, from other views in other light."""
    gallery: int = 100
    """Instances of each category among which one is to be found again."""
    least_side: float = 12.0
    """Objects whose box has no side of so many px do not count, nor does a detection of them."""
    least_visibility: float = 0.5
    """Objects of which less is seen do not count either."""
    score_threshold: float = 0.01
    """Least objectness of a detection."""
    resamples: int = 500
    """Bootstrap resamples of the scenes behind the intervals."""
    batch: int = 32
    """Scenes that go through the network at once."""
    pictures: bool = True
    """Draw plots and examples, and put them with every figure into index.html."""


def open_scenes(config: EvaluateConfig, model_config: ModelConfig) -> Scenes:
    """The scenes the configuration asks for: those of a folder, or generated ones.

    Raises:
        InputError: there are none, or both a folder and shapes or photographs to generate from are given.
    """
    if config.count < 1:
        raise input_error("number of scenes", got=config.count, expected="at least 1")
    categories = model_config.categories
    if config.scenes is not None:
        if config.cad is not None or config.backgrounds is not None:
            raise input_error("a folder of scenes and what to generate others from", do="drop --cad, --backgrounds")
        folder = SceneFolder(
            config.scenes,
            categories,
            size=model_config.image_size,
            symmetry=model_config.symmetry,
            voxel_side=model_config.voxel_size,
        )
        return FolderScenes(folder, config.count)
    return GeneratedScenes(open_source(config, model_config), config.count)


def open_source(config: EvaluateConfig, model_config: ModelConfig) -> SceneGenerator:
    """Where generated scenes and views of instances come from."""
    cad = None
    if config.cad is not None:
        from nolbo_ppl.synthetic.assets.cad import load_cad_folder

        cad = tuple(load_cad_folder(config.cad, model_config.categories, up=config.cad_up, front=config.cad_front))
    return SceneGenerator(
        preset(config.difficulty, rendered_size(model_config.image_size)),
        seed=config.seed,
        cad=cad,
        backgrounds=None if config.backgrounds is None else str(config.backgrounds),
    )


@dataclass(frozen=True)
class Evaluation:
    """Everything measured."""

    objects: ObjectRecords
    detections: DetectionRecords
    figures: dict[str, IntervalEstimate]
    scenes: int
    categories: tuple[str, ...]
    retrieval: RetrievalRecords | None = None
    """Instances found again, where that was asked for."""


def measure(config: EvaluateConfig, model: ObservationModel | MultiScalePredictor, scenes: Scenes) -> Evaluation:
    """Run the model over the scenes and compute every figure.

    Raises:
        InputError: no scene holds an object that counts.
    """
    objects: list[ObjectRecords] = []
    boxes, labels, counts, answers, regions = [], [], [], [], []
    for start in progress_bar(range(0, len(scenes), config.batch), "evaluating", "batch"):
        rows = range(start, min(start + config.batch, len(scenes)))
        truth = [scenes[i] for i in rows]
        images, cameras = [scene.image for scene in truth], np.array([scene.intrinsics for scene in truth])
        found = model.observe(images, cameras, threshold=config.score_threshold, decode=False, batch=config.batch)
        answers += [(one.box, one.objectness, one.class_posterior) for one in found]
        counted = [scene.counts(config.least_side, config.least_visibility) for scene in truth]
        boxes += [scene.box for scene in truth]
        labels += [scene.labels(model.config.categories) for scene in truth]
        counts += counted
        regions += [scene.ignore for scene in truth]
        used = [k for k, some in enumerate(counted) if some.any()]
        if used:
            slots = [np.flatnonzero(counted[k]) for k in used]
            at_boxes = model.observe_boxes(
                [images[k] for k in used],
                cameras[used],
                [truth[k].box[s] for k, s in zip(used, slots)],
                decode=False,
                batch=config.batch,
            )
            numbers = [rows[k] for k in used]
            tails = getattr(model, "calibration", Calibration()).position_tails
            objects.append(measure_objects([truth[k] for k in used], at_boxes, slots, numbers, model, tails))
    if not objects:
        raise input_error(
            "no object to evaluate on",
            got=f"{len(scenes)} scenes",
            expected=f"a box with a side of {config.least_side} px, {config.least_visibility:.0%} of it seen",
        )
    categories = model.config.categories
    records = concatenate(objects)
    detections = measure_detections(boxes, labels, counts, answers, len(categories), regions=regions)
    rng = np.random.default_rng(config.seed)
    estimates = score_intervals(records, detections, len(scenes), model.config.symmetry, rng, config.resamples)
    return Evaluation(records, detections, estimates, len(scenes), categories)


def measure_retrieval(
    config: EvaluateConfig, model: ObservationModel | MultiScalePredictor, views: InstanceViews
) -> RetrievalRecords:
    """Render two views of every instance, take the shape latent at the true box, and seek each among the others.

    Raises:
        InputError: no category has two instances.
    """
    instances = views.instances
    if not instances:
        raise input_error("instances to find again", got=0, expected="at least two of a category")
    means, scales = [], []
    step = max(1, config.batch // 2)
    for start in progress_bar(range(0, len(instances), step), "retrieval", "batch"):
        pairs = [views.pair(*instance) for instance in instances[start : start + step]]
        flat = [view for pair in pairs for view in pair]
        answers = model.observe_boxes(
            [view.image for view in flat],
            np.array([view.intrinsics for view in flat]),
            [view.box for view in flat],
            decode=False,
            batch=config.batch,
        )
        means.append(np.array([answer.latent[0] for answer in answers]).reshape(len(pairs), 2, -1))
        scales.append(np.array([answer.latent_scale[0] for answer in answers]).reshape(len(pairs), 2, -1))
    category = np.array([views.categories.index(name) for name, _ in instances])
    return retrieve(np.concatenate(means), np.concatenate(scales), category, model.prior_mean())


def metrics(evaluation: Evaluation, config: EvaluateConfig) -> dict[str, Any]:
    """The content of metrics.json: figures by name, their intervals and counts, tables, and what they came from."""
    estimates = evaluation.figures
    found = evaluation.retrieval
    return {
        **{name: one.value for name, one in estimates.items()},
        "intervals": {name: None if one.low is None else [one.low, one.high] for name, one in estimates.items()},
        "counts": {name: one.count for name, one in estimates.items()},
        "scenes": evaluation.scenes,
        "objects": len(evaluation.objects),
        "by_category": category_table(evaluation.objects, evaluation.detections, evaluation.categories),
        "by_difficulty": difficulty_table(evaluation.objects),
        "calibration": calibration_table(evaluation.objects, evaluation.detections.all.select(judged(evaluation.detections.all))),
        "confusion": confusion(evaluation.objects, len(evaluation.categories)).tolist(),
        "retrieval": None if found is None else retrieval_table(found, evaluation.categories),
        "categories": list(evaluation.categories),
        "configuration": _stored(config),
        "seeds": {"scenes": config.seed if config.scenes is None else None, "bootstrap": config.seed},
        "versions": {
            "nolbo_ppl": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
    }


def photograph_metrics(evaluation: PhotographEvaluation, config: EvaluateConfig, categories: Sequence[str]) -> dict[str, Any]:
    """The content of metrics.json of photographs."""
    scores = evaluation.scores
    columns = ("photographs", "objects", "ap50", "category_found")
    tables = {**scores.by_source, **scores.by_size}
    configuration = _stored(config)
    configuration |= {"scenes": str(config.photographs), "peer": [str(path) for path in config.peer]}
    models = {str(config.model): scores, **evaluation.peers}
    names = list(dict.fromkeys(name for one in models.values() for name in one.figures))
    values = {name: [one.figures[name].value if name in one.figures else None for one in models.values()] for name in names}
    return {
        **{name: one.value for name, one in scores.figures.items()},
        "intervals": {name: None if one.low is None else [one.low, one.high] for name, one in scores.figures.items()},
        "counts": {name: one.count for name, one in scores.figures.items()},
        "images_per_second": evaluation.images_per_second,
        "scenes": len(evaluation.photos),
        "objects": int(scores.pooled.truths.sum()),
        "by_category": scores.by_category,
        "by_difficulty": {name: {column: row.get(column) for column in columns} for name, row in tables.items()},
        "peers": {model: {name: values[name][k] for name in names} for k, model in enumerate(models)},
        "categories": list(categories),
        "configuration": configuration,
        "versions": {"nolbo_ppl": __version__, "python": platform.python_version(), "torch": torch.__version__},
    }


def _stored(config: EvaluateConfig) -> dict[str, Any]:
    """The options as JSON, under the names that files of every version have."""
    return stored_names(config, {k: str(v) if isinstance(v, Path) else v for k, v in asdict(config).items()})
