"""The noise a run has settled on, kept beside its result: true associations are judged under the same one."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.slam import NoiseModel
from nolbo_ppl.io.files import atomic_path

TEXTS = ("report", "warnings")
"""What `slam/summary.json` tells already."""


def write_noise(path: Path, noise: NoiseModel) -> None:
    """Write the numbers of a noise model as one NPZ file, atomically."""
    values = {field.name: getattr(noise, field.name) for field in fields(noise) if field.name not in TEXTS}
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **{name: value for name, value in values.items() if value is not None})


def read_noise(path: Path) -> NoiseModel:
    """Read it back, without its words.

    Raises:
        InputError: the file lacks a field.
    """
    if not path.is_file():
        raise input_error("no such file", file=path)
    with np.load(path, allow_pickle=False) as arrays:
        values: dict[str, Any] = {name: arrays[name] if arrays[name].ndim else float(arrays[name]) for name in arrays.files}
    try:
        return NoiseModel(**values, report={}, warnings=())
    except TypeError as error:
        raise input_error("not a noise model", got=error, file=path) from None
