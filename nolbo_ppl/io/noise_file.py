"""The noise a run has settled on, kept beside its result: true associations are judged under the same one."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.npz import Npz, save_npz
from nolbo_ppl.structures.noise_model import NoiseModel

TEXTS = ("report", "warnings")
"""What `slam/summary.json` tells already."""


def write_noise(path: Path, noise: NoiseModel) -> None:
    """Write the numbers of a noise model as one NPZ file (`noise.npz` of a run), atomically."""
    values = {field.name: getattr(noise, field.name) for field in fields(noise) if field.name not in TEXTS}
    save_npz(path, {name: value for name, value in values.items() if value is not None})


def read_noise(path: Path) -> NoiseModel:
    """Read it back, without its words.

    Raises:
        InputError: the file is damaged, lacks a field, or holds NaN; names it.
    """
    with Npz(path) as archive:
        arrays = {name: archive.array(name) for name in archive.names}
    values: dict[str, Any] = {name: value if value.ndim else float(value) for name, value in arrays.items()}
    try:
        return NoiseModel(**values, report={}, warnings=())
    except TypeError as error:
        raise input_error("not a noise model", got=error, file=path) from None
