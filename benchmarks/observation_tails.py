"""Tails of the positions and the largest certainty of a model, fitted on scenes that nothing else was fitted on.

    OMP_NUM_THREADS=1 python benchmarks/observation_tails.py [--model tiny] [--scenes 200] [--seeds 8801] [--write]
    OMP_NUM_THREADS=1 python benchmarks/observation_tails.py --model photo --photographs val.json --write

Half of the scenes are standard, half full. Positions are known in scenes alone; with `--photographs` the largest certainty is
that of labelled photographs, every third from the first (`nolbo evaluate --part 1 3` measures every third from the second), and
`--evidence` first fits on these how a detector's evidence is read, as the last stage of training does. With `--write` it all goes
into the model's folder.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import tyro

import nolbo_ppl
from nolbo_ppl.cli.evaluate import EvaluateConfig, Evaluation, measure, open_scenes
from nolbo_ppl.data.converters.photographs import read_photographs
from nolbo_ppl.evaluation.photograph_run import evaluate_photographs
from nolbo_ppl.evaluation.scores import MIN_OBJECTNESS, judged
from nolbo_ppl.inference.posterior.model_folder import load, save
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.models.posterior_calibration import CERTAIN
from nolbo_ppl.training.calibrate_answers import calibrate_answers
from nolbo_ppl.training.photograph_fit import PARTS, adopt_fit, find_objects, fit_found


@dataclass(frozen=True)
class Arguments:
    """What to fit and on how many scenes."""

    model: str = "tiny"
    """Model (a name or a folder)."""
    scenes: int = 200
    """Scenes of each of the two difficulties."""
    seeds: tuple[int, ...] = (8801,)
    """Their seeds; so many scenes of each."""
    photographs: Path | None = None
    """Labelled photographs (COCO-style JSON), for the largest certainty."""
    evidence: bool = False
    """Fit factor and shift of a detector's evidence on the photographs first (`nolbo_ppl.training.photograph_fit`)."""
    write: bool = False
    """Write what was fitted into the model's folder."""


def answers(model: ObservationModel, arguments: Arguments) -> list[Evaluation]:
    """The model's answers on both kinds of scenes."""
    out = []
    for seed, difficulty in product(arguments.seeds, ("standard", "full")):
        config = EvaluateConfig(
            Path("unused"),
            model=arguments.model,
            count=arguments.scenes,
            seed=seed,
            difficulty=difficulty,
            resamples=10,
        )
        out.append(measure(config, model, open_scenes(config, model.config)))
    return out


def main(arguments: Arguments) -> None:
    """Fit, and write where asked."""
    model = load(arguments.model)
    plain = dataclasses.replace(model.calibration, objectness_limit=CERTAIN)
    if arguments.evidence and arguments.photographs is not None:
        photos = read_photographs(arguments.photographs, categories=model.config.categories)[::PARTS]
        fit = fit_found(find_objects(model.model, photos), photos)
        assert fit is not None, "too few objects in these photographs"
        adopt_fit(model.model, fit)
        print(fit)
    found = answers(ObservationModel(model.model, plain), arguments)
    squared = np.concatenate([one.objects.position_squared for one in found])
    squared = squared[np.isfinite(squared)]
    detections = [one.detections.all.select(judged(one.detections.all)) for one in found]
    score, right = (np.concatenate([getattr(d, name) for d in detections]) for name in ("score", "correct"))
    if arguments.photographs is not None:
        fitted_on = ObservationModel(model.model, plain)
        pooled = evaluate_photographs(arguments.photographs, fitted_on, part=(0, PARTS), resamples=10).scores.pooled
        pooled = pooled.select(~pooled.ignored & (pooled.score >= MIN_OBJECTNESS))
        score, right = pooled.score, pooled.correct
    fitted = calibrate_answers(plain, squared, score, right)
    sure = score > 0.99
    print(
        f"{len(squared)} positions, {len(score)} detections, {sure.sum()} above 0.99, of which {right[sure].mean():.4f} are right"
    )
    print(
        f"degrees of freedom {fitted.position_dof:.3f}, spread {fitted.position_spread:.3f}, limit {fitted.objectness_limit:.5f}"
    )
    if arguments.write:
        given = Path(arguments.model)
        file = (given if given.is_dir() else Path(nolbo_ppl.__file__).parent / "weights" / given) / "config.json"
        values = read_json(file)
        if arguments.evidence:
            meta = {name: value for name, value in values.items() if name not in ("model", "calibration", "sha256")}
            save(file.parent, model.model, fitted, meta, half=not given.is_dir())  # as shipped weights are
        else:
            write_json(file, {**values, "calibration": fitted.to_json()})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
