"""The law of positions that detections state: written, read, checked, and taken by SLAM."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.slam_problem import SlamConfig, SlamProblem
from nolbo_ppl.io.observations import read_observations, write_observations
from nolbo_ppl.structures.detections import Detections


def table(n: int = 6, tails: tuple[float, float] | None = (3.0, 0.5)) -> Detections:
    rng = np.random.default_rng(0)
    position = rng.normal(size=(n, 3)) + [0, 0, 8]
    plain = Detections.from_arrays(
        np.arange(n) % 4, position, position_covariance=np.diag([0.1, 0.2, 0.9]), id=map(str, range(n))
    )
    return plain if tails is None else dataclasses.replace(plain, position_tails=np.tile(tails, (n, 1)))


def problem(seen: Detections) -> SlamProblem:
    path = make_pose(np.tile(np.eye(3), (4, 1, 1)), np.arange(12.0).reshape(4, 3) / 10)
    return SlamProblem(path, seen)


def test_a_file_holds_them(tmp_path: Path) -> None:
    seen = Detections.concatenate([table(), dataclasses.replace(table(2, None), id=("x", "y"))])
    write_observations(tmp_path / "a.jsonl", seen)
    again = read_observations(tmp_path / "a.jsonl")
    np.testing.assert_array_equal(again.position_tails, seen.position_tails)
    assert np.isnan(again.position_tails[6:]).all()
    assert json.loads((tmp_path / "a.jsonl").read_text().splitlines()[0])["position_tails"] == [3.0, 0.5]
    assert "position_tails" not in (tmp_path / "a.jsonl").read_text().splitlines()[-1]


@pytest.mark.parametrize("value", [[3.0], [3.0, 0.0], [-1.0, 1.0], "3", [3.0, None]])
def test_what_is_no_law_is_refused(tmp_path: Path, value: object) -> None:
    (tmp_path / "a.jsonl").write_text(json.dumps({"frame": 0, "position": [0, 0, 5], "position_tails": value}))
    with pytest.raises(InputError, match=r"a\.jsonl:1: `position_tails`"):
        read_observations(tmp_path / "a.jsonl")
    with pytest.raises(InputError, match="position_tails are no law"):
        problem(dataclasses.replace(table(), position_tails=np.tile([np.nan, 1.0], (6, 1))))


def test_slam_takes_what_detections_state() -> None:
    """As if the configuration had said it, where it is asked to; what it says itself comes first; else positions are Gaussian."""
    stated = estimate_noise(problem(table()), SlamConfig(stated_tails=True))
    assert estimate_noise(problem(table()), SlamConfig()).position_dof is None
    told = estimate_noise(problem(table(tails=None)), SlamConfig(position_tails=(3.0, 0.5)))
    assert stated.position_dof == told.position_dof == 3.0
    np.testing.assert_array_equal(stated.position_covariance, told.position_covariance)
    other = estimate_noise(problem(table()), SlamConfig(position_tails=(5.0, 0.25), stated_tails=True))
    assert other.position_dof == 5.0
    np.testing.assert_allclose(2 * other.position_covariance, stated.position_covariance)
    plain = estimate_noise(problem(table(tails=None)), SlamConfig(stated_tails=True))
    assert plain.position_dof is None
    np.testing.assert_allclose(0.5 * plain.position_covariance, stated.position_covariance)


def test_detections_of_two_sources() -> None:
    """Factors are each row's own; one that states none keeps its covariance."""
    seen = table()
    tails = np.array([[2.5, 0.4], [2.5, 0.4], [2.5, 0.4], [4.0, 0.8], [np.nan, np.nan], [np.nan, np.nan]])
    mixed = estimate_noise(problem(dataclasses.replace(seen, position_tails=tails)), SlamConfig(stated_tails=True))
    plain = estimate_noise(problem(table(tails=None)), SlamConfig())
    assert mixed.position_dof == 2.5
    factor = mixed.position_covariance[:, 0, 0] / plain.position_covariance[:, 0, 0]
    np.testing.assert_allclose(factor, [0.4, 0.4, 0.4, 0.8, 1.0, 1.0])
