"""The noise of a run comes back as it was."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.noise_file import TEXTS, read_noise, write_noise
from nolbo_ppl.structures.noise_model import NoiseModel


@pytest.mark.parametrize("stated", [True, False])
def test_noise_comes_back(tmp_path: Path, stated: bool) -> None:
    rng = np.random.default_rng(3)
    noise = NoiseModel(
        rotation_step=rng.random(4),
        translation_step=rng.random(4),
        position_covariance=rng.random((7, 3, 3)),
        rotation_scale=rng.random(7),
        latent_scale=rng.random((7, 5)),
        birth_intensity=0.1,
        clutter_intensity=1e-3,
        report={"position_lateral": 0.3},
        warnings=("too small",),
        position_factor=1.7,
        range_factor=2.5,
        rotation_factor=1.1,
        step_correlation=rng.random((4, 6, 6)) if stated else None,
    )
    write_noise(tmp_path / "noise.npz", noise)
    with np.load(tmp_path / "noise.npz") as file:  # names that folders of 0.1.0 have
        assert file["new_rate"] == 0.1 and file["clutter_rate"] == 1e-3 and "birth_intensity" not in file
    back = read_noise(tmp_path / "noise.npz")
    for field in fields(noise):
        if field.name not in TEXTS:
            before, after = getattr(noise, field.name), getattr(back, field.name)
            assert (before is None) == (after is None)
            if before is not None:
                np.testing.assert_array_equal(before, after)


def test_files_that_hold_no_noise_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_noise(tmp_path / "noise.npz")
    np.savez(tmp_path / "noise.npz", new_rate=1.0)
    with pytest.raises(InputError, match="not a noise model"):
        read_noise(tmp_path / "noise.npz")
