"""The noise of a run comes back as it was."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, estimate_noise
from nolbo_ppl.pipeline.noise_file import TEXTS, read_noise, write_noise
from tests.simulated_sequence import SimulatedDrive


@pytest.mark.parametrize("stated", [True, False])
def test_noise_comes_back(drive: SimulatedDrive, tmp_path: Path, stated: bool) -> None:
    covariance = np.tile(np.diag([1e-5] * 3 + [1e-3] * 3), (len(drive.truth) - 1, 1, 1)) if stated else None
    noise = estimate_noise(SlamProblem(drive.truth, drive.model.table, covariance), SlamConfig())
    write_noise(tmp_path / "noise.npz", noise)
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
