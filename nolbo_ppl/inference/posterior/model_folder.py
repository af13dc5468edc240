"""Model folders: `model.safetensors` and `config.json`, shipped in the package or a user's own."""

from __future__ import annotations

from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any

import torch

from nolbo_ppl.devices import device_of
from nolbo_ppl.errors import InputError, input_error, located
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.posterior.single_object_predictor import SingleObjectModel
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.io.tensors import check_tensors, file_hash, load_strictly, load_tensors, save_tensors
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.posterior_calibration import Calibration

FORMAT = 1
"""Format of a model's files, kept beside the tensors: a file of a later one is refused, not misread."""

LEARNT_LATER = ("guide.shift.", "guide.sizes.")
"""Statistics that models with a detector may lack."""


def load(
    name_or_path: str | PathLike[str] = "photo", device: str | torch.device = "auto", *, half_precision: bool = False
) -> ObservationModel:
    """Load a model: the name of weights in the package (`photo`, `tiny`), or a folder with `model.safetensors` and `config.json`.

    Args:
        name_or_path: which.
        device: `auto`, `cpu`, `cuda`, `cuda:N` or `mps`; answers are the same within the tolerance of single precision.
        half_precision: run the networks' convolutions and matrix products in bfloat16.

    Raises:
        InputError: neither is there, the files are damaged or do not fit each other, or there is no such device.

    Example:
        >>> import nolbo_ppl
        >>> model = nolbo_ppl.load("tiny")
        >>> "car" in model.config.categories
        True
    """
    target = device_of(device)
    shipped = Path(str(resources.files("nolbo_ppl"))) / "weights"
    folder = Path(name_or_path)
    if not (folder / "config.json").is_file():
        folder = shipped / str(name_or_path)
    if not (folder / "config.json").is_file():
        names = sorted(path.parent.name for path in shipped.glob("*/config.json"))
        raise input_error(
            "no such model",
            got=repr(str(name_or_path)),
            expected=f"one of {names}, or a folder with config.json and model.safetensors",
        )
    weights = folder / "model.safetensors"
    config, calibration, stated = read_model_config(folder / "config.json")
    tensors, facts = load_tensors(weights)
    form = facts.get("format", 1)
    if form not in range(1, FORMAT + 1):
        expected = f"1 to {FORMAT}"
        raise input_error(
            "a model of another format", got=form, expected=expected, do="update nolbo_ppl to read it", file=weights
        )
    if stated is not None and stated != file_hash(weights):
        expected = f"SHA-256 {stated}, as config.json says"
        raise input_error("weights were changed", got=file_hash(weights), expected=expected, file=weights)
    with torch.device("meta"):  # shapes alone: a configuration of networks beyond any memory does not fit its weights
        own = Nolbo(config).state_dict()
        missing = {name for name in own if name.startswith(LEARNT_LATER) and name not in tensors}
        needed = {name: value for name, value in own.items() if name not in missing}
        check_tensors(needed, {name: t.to("meta") for name, t in tensors.items()}, weights)
    model = Nolbo.from_seed(config, seed=0)
    fresh = model.state_dict()  # models of before these were: nothing is known of shifts and sizes
    load_strictly(model, {**tensors, **{name: fresh[name] for name in missing}}, weights)
    model.set_half_precision(half_precision)
    model.to(target)
    if config.description.one_object:  # the shipped scene network says where objects are
        return SingleObjectModel(model, calibration, load("tiny", target, half_precision=half_precision))
    return ObservationModel(model, calibration)


def read_model_config(file: str | PathLike[str]) -> tuple[ModelConfig, Calibration, str | None]:
    """Networks, calibration, and the SHA-256 of the weights (None where it is not stated) of a model's `config.json`.

    Raises:
        InputError: malformed, or a value of another type or out of range; names the file and the field.
    """
    values = read_json(file)
    if not isinstance(values, dict) or "model" not in values:
        raise input_error("not a model configuration", expected='{"model": {...}, ...}', file=file)
    stated = values.get("sha256")
    if stated is not None and not isinstance(stated, str):
        raise input_error("sha256", got=stated, expected="64 hexadecimal digits", file=file)
    try:
        return ModelConfig.from_json(values["model"]), Calibration.from_json(values.get("calibration", {})), stated
    except InputError as error:
        raise located(error, file) from None


def save(folder: str | PathLike[str], model: Nolbo, calibration: Calibration, meta: dict[str, Any], half: bool = False) -> None:
    """Write a folder that `load` reads: `model.safetensors` and `config.json`.

    Args:
        folder: where.
        model: the networks.
        calibration: fitted factors.
        meta: what else the configuration file should tell, such as the training's configuration.
        half: store kernels and matrices in half precision, half the size.
    """
    folder = Path(folder)
    tensors = {
        name: value.half() if half and value.is_floating_point() and value.dim() > 1 else value
        for name, value in model.state_dict().items()
    }
    save_tensors(folder / "model.safetensors", tensors, {"format": FORMAT})
    described = {"model": model.config.to_json(), "calibration": calibration.to_json()}
    write_json(folder / "config.json", {**described, "sha256": file_hash(folder / "model.safetensors"), **meta})
