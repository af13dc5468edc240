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
STORED = {"birth_intensity": "new_rate", "clutter_intensity": "clutter_rate"}
"""Names in the file that are not those of the fields: the ones that files of 0.1.0 have."""


def write_noise(path: Path, noise: NoiseModel) -> None:
    """Write the numbers of a noise model as one NPZ file (`noise.npz` of a run), atomically."""
    values = {
        STORED.get(field.name, field.name): getattr(noise, field.name) for field in fields(noise) if field.name not in TEXTS
    }
    save_npz(path, {name: value for name, value in values.items() if value is not None})


def read_noise(path: Path) -> NoiseModel:
    """Read it back, without its words.

    Raises:
        InputError: the file is damaged, lacks a field, or holds NaN; names it.
    """
    with Npz(path) as archive:
        arrays = {name: archive.array(name) for name in archive.names}
    field_of = {stored: name for name, stored in STORED.items()}
    values: dict[str, Any] = {field_of.get(k, k): value if value.ndim else float(value) for k, value in arrays.items()}
    try:
        return NoiseModel(**values, report={}, warnings=())
    except TypeError as error:
        raise input_error("not a noise model", got=error, file=path) from None
