"""Model folders: `model.safetensors` and `config.json`, shipped in the package or a user's own."""

from __future__ import annotations

from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.io.tensors import load_strictly, load_tensors, save_tensors
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.posterior_calibration import Calibration


def load(name_or_path: str | PathLike[str] = "tiny") -> ObservationModel:
    """Load a model: the name of weights in the package (`tiny`), or a folder with `model.safetensors` and `config.json`.

    Raises:
        InputError: neither is there, or the files are damaged or do not fit each other.
    """
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
    values = read_json(folder / "config.json")
    if not isinstance(values, dict) or "model" not in values:
        raise input_error("not a model configuration", expected='{"model": {...}, ...}', file=folder / "config.json")
    model = Nolbo.from_seed(ModelConfig.from_json(values["model"]), seed=0)
    tensors, _ = load_tensors(folder / "model.safetensors")
    load_strictly(model, tensors, folder / "model.safetensors")
    return ObservationModel(model, Calibration.from_json(values.get("calibration", {})))


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
    save_tensors(folder / "model.safetensors", tensors, {"format": 1})
    write_json(folder / "config.json", {"model": model.config.to_json(), "calibration": calibration.to_json(), **meta})
