"""`nolbo evaluate`: figures of an observation model on unseen scenes, with intervals, plots and examples."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from nolbo_ppl.errors import input_error
from nolbo_ppl.evaluation.instance_views import InstanceViews
from nolbo_ppl.evaluation.labelled_scenes import Scenes
from nolbo_ppl.evaluation.model_evaluation import (
    EvaluateConfig,
    Evaluation,
    measure,
    measure_retrieval,
    metrics,
    open_scenes,
    open_source,
    photograph_metrics,
)
from nolbo_ppl.evaluation.peers import OnnxPeer
from nolbo_ppl.evaluation.photograph_run import PhotographEvaluation, PhotographScenes, evaluate_photographs
from nolbo_ppl.evaluation.retrieval import retrieval_scores
from nolbo_ppl.evaluation.scores import category_table
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.posterior.multiscale import MultiScalePredictor
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.io.files import read_json_object, write_json
from nolbo_ppl.io.output_folder import output_folder
from nolbo_ppl.renamed_options import current_arguments

PICTURES = ("precision_recall", "reliability", "confusion", "viewpoint", "size", "shape", "retrieval", "examples", "detections")
RESULT = ("metrics.json", "index.html", *(f"{name}.png" for name in PICTURES))
"""Files of an evaluation."""


def is_result(folder: Path) -> bool:
    """Whether a folder holds an evaluation that another may replace."""
    file = folder / "metrics.json"
    return file.is_file() and {"intervals", "configuration", "versions"} <= set(read_json_object(file))


def table(evaluation: Evaluation) -> str:
    """The figures with their 95 % intervals, and the main ones by category, as text."""
    lines = [f"{'figure':<32}{'value':>9}   {'95 % interval':<20}{'of':>7}"]
    for name, one in evaluation.figures.items():
        interval = "" if one.low is None or one.high is None else f"[{one.low:.3f}, {one.high:.3f}]"
        lines.append(f"{name:<32}{_number(one.value):>9}   {interval:<20}{one.count:>7}")
    columns = ("ap50", "category_accuracy", "acc_pi6", "med_err_deg", "voxel_iou", "voxel_iou_gain")
    lines += ["", f"{'category':<14}{'objects':>8}" + "".join(f"{name:>19}" for name in columns)]
    for name, row in category_table(evaluation.objects, evaluation.detections, evaluation.categories).items():
        lines.append(f"{name:<14}{row['objects']:>8}" + "".join(f"{_number(row[column]):>19}" for column in columns))
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def run(config: EvaluateConfig) -> Evaluation:
    """Measure the model and write `metrics.json` and, unless switched off, the pictures and `index.html` into `config.out`.

    Example:
        >>> import nolbo_ppl, pathlib, tempfile
        >>> config = nolbo_ppl.EvaluateConfig(
        ...     pathlib.Path(tempfile.mkdtemp()), count=4, difficulty="easy", resamples=10, pictures=False)
        >>> evaluation = nolbo_ppl.evaluate(config)
        >>> evaluation.scenes, 0 <= evaluation.figures["ap50"].value <= 1
        (4, True)
    """
    if config.photographs is not None:
        raise input_error("photographs have a run of their own", do="call run_photographs")
    if config.peer:
        raise input_error("a peer without photographs", got=config.peer, do="give --photographs too")
    with output_folder(config.out, RESULT, is_own=is_result) as folder:
        return _evaluate(config, folder)


def _evaluate(config: EvaluateConfig, folder: Path) -> Evaluation:
    loaded = load(config.model, config.device)
    model = MultiScalePredictor(loaded, config.test_sizes) if config.test_sizes else loaded
    scenes = open_scenes(config, model.config)
    evaluation = measure(config, model, scenes)
    if config.retrieval:
        views = InstanceViews(open_source(config, model.config), config.gallery, model.config.categories)
        found = measure_retrieval(config, model, views)
        rng = np.random.default_rng([config.seed, 1])
        estimates = {**evaluation.figures, **retrieval_scores(found, rng, config.resamples)}
        evaluation = replace(evaluation, figures=estimates, retrieval=found)
    values = metrics(evaluation, config)
    write_json(folder / "metrics.json", values)
    if config.pictures:
        _draw(evaluation, values, scenes, model, folder)
    return evaluation


def run_photographs(config: EvaluateConfig) -> PhotographEvaluation:
    """Measure the model and its peers on photographs; write `metrics.json` and, unless switched off, pictures and
    `index.html` into `config.out`.

    Raises:
        InputError: the photographs, or a peer's file, cannot be used, or scenes are asked for too.
    """
    if config.photographs is None or config.scenes is not None or config.cad is not None:
        raise input_error("photographs and scenes in one evaluation", do="give --photographs alone")
    with output_folder(config.out, RESULT, is_own=is_result) as folder:
        return _evaluate_photographs(config, config.photographs, folder)


def _evaluate_photographs(config: EvaluateConfig, photographs: Path, folder: Path) -> PhotographEvaluation:
    loaded = load(config.model, config.device)
    model = MultiScalePredictor(loaded, config.test_sizes) if config.test_sizes else loaded
    peers = [OnnxPeer(path, model.config.categories) for path in config.peer]
    count = None if config.count == EvaluateConfig.count else config.count
    evaluation = evaluate_photographs(
        photographs,
        model,
        peers,
        threshold=config.score_threshold,
        batch=config.batch,
        count=count,
        part=config.part,
        seed=config.seed,
        resamples=config.resamples,
    )
    values = photograph_metrics(evaluation, config, model.config.categories)
    write_json(folder / "metrics.json", values)
    if config.pictures:
        from nolbo_ppl.viz.detection_plots import write_detections
        from nolbo_ppl.viz.evaluation_page import write_page

        scenes, picture = PhotographScenes(evaluation.photos, model.config.categories), folder / "detections.png"
        write_detections(evaluation.scores.pooled, scenes, model, picture)
        write_page(values, [picture], folder / "index.html")
    return evaluation


def photograph_table(evaluation: PhotographEvaluation, model: str) -> str:
    """The figures of the model and its peers with their 95 % intervals, as text."""
    models = {model: evaluation.scores, **evaluation.peers}
    lines = [f"{'figure':<24}" + "".join(f"{name[:28]:>30}" for name in models) + f"{'of':>8}"]
    for name, one in evaluation.scores.figures.items():
        cells = []
        for scores in models.values():
            found = scores.figures.get(name)
            interval = "" if found is None or found.low is None else f" [{found.low:.3f}, {found.high:.3f}]"
            cells.append(f"{_number(None if found is None else found.value)}{interval}")
        lines.append(f"{name:<24}" + "".join(f"{cell:>30}" for cell in cells) + f"{one.count:>8}")
    lines += ["", f"{'ap50 of':<32}" + "".join(f"{name[:14]:>16}" for name in models) + f"{'objects':>9}"]
    for kind in ("by_source", "by_size", "by_category"):
        for name, row in getattr(evaluation.scores, kind).items():
            values = [getattr(scores, kind)[name]["ap50"] for scores in models.values()]
            lines.append(f"{name:<32}" + "".join(f"{_number(value):>16}" for value in values) + f"{row['objects']:>9}")
    return "\n".join([*lines, "", f"{evaluation.images_per_second:.1f} photographs a second"])


def _draw(
    evaluation: Evaluation, values: dict[str, Any], scenes: Scenes, model: ObservationModel | MultiScalePredictor, out: Path
) -> None:
    """Plots, examples, and the page that shows them with every figure."""
    from nolbo_ppl.viz.detection_plots import write_detections
    from nolbo_ppl.viz.evaluation_page import write_page
    from nolbo_ppl.viz.evaluation_plots import write_plots
    from nolbo_ppl.viz.example_plots import write_examples

    objects, found = evaluation.objects, evaluation.detections
    pictures = write_plots(objects, found, evaluation.categories, model.config.symmetry, out, evaluation.retrieval)
    write_examples(objects, scenes, model, out / "examples.png")
    pictures.append(out / "examples.png")
    if write_detections(found.all, scenes, model, out / "detections.png") is not None:
        pictures.append(out / "detections.png")
    write_page(values, pictures, out / "index.html")


def main(args: Sequence[str] | None = None) -> None:
    """Command line: parse the options, run, print the figures."""
    config = tyro.cli(
        EvaluateConfig,
        args=current_arguments(EvaluateConfig, args),
        prog="nolbo evaluate",
        description=__doc__,
    )
    if config.photographs is not None:
        text = photograph_table(run_photographs(config), config.model)
    else:
        text = table(run(config))
    sys.stdout.write(text + f"\n\nwritten to {config.out}\n")


if __name__ == "__main__":
    main()
