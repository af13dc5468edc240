"""The compared networks, trained alike: one detector to start from, whose encoder stays as it is, the same scenes and steps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.errors import input_error
from nolbo_ppl.evaluation.labelled_scenes import FolderScenes
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.posterior.single_object_predictor import SingleObjectModel
from nolbo_ppl.models.baselines.method import METHODS
from nolbo_ppl.reproduction.budgets import NETWORKS, ReproduceConfig
from nolbo_ppl.synthetic.dataset_writer import SCENES, write_scenes
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.training.train_config import TrainConfig
from nolbo_ppl.training.trainer import run

TRAIN_SEED, HELD_OUT_SEED = 301, 9301
"""Seeds of the generated scenes: neither scenes nor shapes of one are among those of the other."""
INITIAL = "tiny"
"""Shipped weights from which all start, but for latent and prior."""


def own_scenes(config: ReproduceConfig) -> Path | None:
    """The folder of data where it holds labelled scenes: only then networks learn from it (paths and shapes are other data)."""
    return config.folder if config.folder is not None and (config.folder / SCENES).is_file() else None


def check_scenes(config: ReproduceConfig) -> None:
    """Raise `InputError` where a folder of data holds no labelled scenes to measure on."""
    if config.folder is not None and own_scenes(config) is None:
        raise input_error("no labelled scenes", expected=f"a file {SCENES}, as `nolbo convert` writes it", file=config.folder)


def scene_folder(config: ReproduceConfig, held_out: bool) -> Path:
    """Scenes to learn from or held-out ones; a folder of data is both (its last tenth is held out)."""
    own = own_scenes(config)
    if own is not None:
        return own
    sizes = config.sizes
    name, seed, count = ("held_out", HELD_OUT_SEED, sizes.held_out) if held_out else ("train", TRAIN_SEED, sizes.scenes)
    folder = config.out / "scenes" / config.budget / name
    source = SceneGenerator(preset("standard" if config.budget != "smoke" else "easy", sizes.render_size), seed)
    write_scenes(folder, source, count, config.workers)
    return folder


def training_of(config: ReproduceConfig, name: str, seed: int) -> TrainConfig:
    """How a network is trained."""
    network, sizes = NETWORKS[name], config.sizes
    return TrainConfig(
        out=config.out / "networks" / config.budget / f"{name}-{seed}",
        preset="tiny",
        method=network.method,
        latent_dim=network.latent_dim,
        initial=INITIAL,
        initial_part="detection",
        freeze_encoder=True,
        scenes=(scene_folder(config, held_out=False),),
        validation=None if own_scenes(config) is not None else scene_folder(config, held_out=True),
        image_size=sizes.image_size,
        seed=seed,
        shape_steps=sizes.shape_steps,
        single_steps=0,
        scene_steps=sizes.scene_steps,
        batch=sizes.batch,
        shape_batch=min(32, 2 * sizes.batch),
        shape_decode=8,
        evaluate_every=10**6,
        evaluate_scenes=64,
        checkpoint_every=20,
        device=config.device,
        threads=config.threads,
        workers=config.workers,
    )


def trained(config: ReproduceConfig, name: str, seed: int) -> ObservationModel:
    """A network, trained if it is not yet; NOLBO on single objects is shown the boxes of the scene network of the same seed.

    Raises:
        InputError: weights that are to be taken are those of another method.
    """
    if name in config.weights:
        model = load(config.weights[name], config.device)
        if model.config.method != NETWORKS[name].method:
            got = f"weights of method {model.config.method}"
            raise input_error(f"weights of {name}", got=got, expected=f"those of method {NETWORKS[name].method}")
        return model
    training = training_of(config, name, seed)
    if not (training.out / "model" / "config.json").is_file():
        run(training)
    model = load(training.out / "model", config.device)
    if METHODS[NETWORKS[name].method].one_object:
        return SingleObjectModel(model.model, model.calibration, trained(config, "multi16", seed))
    return model


def held_out_scenes(config: ReproduceConfig, categories: Sequence[str], symmetry: Sequence[int]) -> FolderScenes:
    """The scenes to measure on: the held-out folder, or the last tenth of a folder of data."""
    folder = SceneFolder(scene_folder(config, held_out=True), categories, size=config.sizes.image_size, symmetry=symmetry)
    first = 0 if own_scenes(config) is None else len(folder) - max(1, len(folder) // 10)
    return FolderScenes(folder, config.sizes.held_out, first)
