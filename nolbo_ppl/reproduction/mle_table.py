"""Classification by maximum likelihood over the prior means of the 3D VAE's latent, as a table."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nolbo_ppl.data.voxel_archive import VoxelArchive, read_voxel_archive, stratified_split
from nolbo_ppl.errors import input_error
from nolbo_ppl.metrics.intervals import IntervalEstimate, estimate, resample_weights, wilson_interval
from nolbo_ppl.metrics.statistics import weighted_mean
from nolbo_ppl.reproduction.budgets import ReproduceConfig
from nolbo_ppl.reproduction.result_table import ResultTable, over_seeds
from nolbo_ppl.reproduction.shape_classification import ShapeScores, ShapeVaeConfig, fit_shape_vae, score_shapes
from nolbo_ppl.synthetic.assets.shape_library import ShapeLibrary

HELD_OUT = 0.2
"""Share of the shapes of every class that is held out."""
GENERATED = 40
"""Generated shapes of each category, where there is no archive."""
ARCHIVES = ("train.npz", "modelnet10/train.npz")
"""Where an archive of shapes lies in a folder of data."""


def shapes_of(config: ReproduceConfig) -> VoxelArchive:
    """The archive in the folder of data, or generated shapes.

    Raises:
        InputError: a folder without an archive.
    """
    if config.folder is not None:
        for name in ARCHIVES:
            if (config.folder / name).is_file():
                return read_voxel_archive(config.folder / name)
        raise input_error("no archive of shapes", expected=f"one of {ARCHIVES}", file=config.folder)
    from nolbo_ppl.categories import CATEGORIES
    from nolbo_ppl.geometry.voxels import unpack_voxels

    pool = ShapeLibrary(CATEGORIES, seed=0)
    count = 4 if config.budget == "smoke" else GENERATED
    packed = [pool.item(name, k).voxels for name in CATEGORIES for k in range(count)]
    return VoxelArchive(unpack_voxels(np.array(packed), 32), np.repeat(np.arange(len(CATEGORIES)), count), tuple(CATEGORIES))


def scores_of_seed(config: ReproduceConfig, archive: VoxelArchive, seed: int, checkpoint: Path) -> ShapeScores:
    """Train on one split and score what was held out of it."""
    train, test = stratified_split(archive.category, HELD_OUT, seed)
    model = fit_shape_vae(
        archive.select(train), ShapeVaeConfig(steps=config.sizes.shape_vae_steps, seed=seed), checkpoint, device=config.device
    )
    return score_shapes(model, archive.select(test))


def mle_table(config: ReproduceConfig) -> ResultTable:
    """Accuracy and voxel IoU on held-out shapes; intervals over seeds (splits and networks), of one seed over its shapes."""
    archive = shapes_of(config)
    folder = config.out / "shapes" / config.budget
    folder.mkdir(parents=True, exist_ok=True)
    found = [scores_of_seed(config, archive, seed, folder / f"{seed}.safetensors") for seed in range(config.seeds)]
    table = ResultTable(
        "Classification by maximum likelihood over the prior means of the 3D VAE's latent",
        ("value",),
        f"{len(archive)} shapes of {len(archive.names)} classes, {HELD_OUT:.0%} of each class held out; 3D encoder and decoder "
        f"started from the shipped shape networks, {config.sizes.shape_vae_steps} steps. Data: {config.data}, "
        f"{config.seeds} seeds; accuracies of single classes are those of the last seed.",
    )
    rows = {
        "accuracy": [(one.predicted == one.category).astype(np.float64) for one in found],
        "voxel IoU": [one.iou for one in found],
        "voxel IoU of the class's mean": [one.category_iou for one in found],
    }
    for name, values in rows.items():
        table.add(name, [_interval(values, proportion=name == "accuracy")])
    (last,) = found[-1:]
    for label, name in enumerate(archive.names):
        own = last.category == label
        right = float((last.predicted[own] == label).sum())
        low, high = wilson_interval(right, int(own.sum()))
        table.add(f"accuracy, {name}", [IntervalEstimate(right / own.sum(), low, high, int(own.sum()))])
    return table


def _interval(values: list[np.ndarray], proportion: bool) -> IntervalEstimate:
    """Over seeds; of one seed Wilson's interval, or the bootstrap over shapes."""
    if len(values) > 1:
        return over_seeds([float(value.mean()) for value in values])
    (value,) = values
    if proportion:
        low, high = wilson_interval(float(value.sum()), len(value))
        return IntervalEstimate(float(value.mean()), low, high, len(value))
    return estimate(lambda w: weighted_mean(value, w), resample_weights(len(value), 500, np.random.default_rng(0)), len(value))
