"""One absurd value is set aside by name; settings are checked; an answer is never worse in silence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve
from nolbo_ppl.inference.slam.initialise import init
from nolbo_ppl.inference.slam.noise.absurd_values import MOST_MODES, without_absurd_values
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error
from nolbo_ppl.structures.detections import Detections


def detections(n: int = 60, latent: np.ndarray | None = None, **more: Any) -> SlamProblem:
    rng = np.random.default_rng(0)
    z = rng.standard_normal((n, 3)) if latent is None else latent
    table = Detections.from_arrays(np.arange(n), rng.uniform(2, 8, (n, 3)), latent=z, latent_scale=0.5, **more)
    return SlamProblem(np.tile(np.eye(4), (n, 1, 1)), table)


@pytest.mark.parametrize("value", [1e300, -1e12])
def test_one_absurd_latent_is_set_aside_by_name(value: float) -> None:
    problem = detections()
    latent = problem.observations.latent.copy()
    latent[7, 1] = value
    names = [f"car-{k}" for k in range(60)]
    cleaned, warnings = without_absurd_values(detections(latent=latent, id=names))
    assert not cleaned.observations.has_latent[7] and cleaned.observations.has_latent.sum() == 59
    assert len(warnings) == 1 and "car-7 " in warnings[0]
    state = init(detections(latent=latent, id=names), SlamConfig())
    assert np.isfinite(state.prior.population.variance).all() and state.prior.population.variance.max() < 10
    assert any("car-7 " in w for w in state.noise.warnings)


def test_wide_populations_are_no_absurdity() -> None:
    problem = detections(latent=np.random.default_rng(1).standard_cauchy((60, 3)))
    assert without_absurd_values(problem) == (problem, ())


def test_modes_are_bounded() -> None:
    n, count = 5, 40
    weight = np.random.default_rng(2).dirichlet(np.ones(count), n)
    R = np.tile(np.eye(3), (n, count, 1, 1))
    table = Detections.from_arrays(
        np.arange(n), np.ones((n, 3)), mode_weight=weight, mode_rotation=R, mode_std=np.full((n, count), 0.1)
    )
    cleaned, warnings = without_absurd_values(SlamProblem(np.tile(np.eye(4), (n, 1, 1)), table))
    kept = cleaned.observations.mode_weight
    assert kept.shape == (n, MOST_MODES) and "40 modes" in warnings[0]
    best = np.sort(weight, axis=1)[:, -MOST_MODES:]
    np.testing.assert_allclose(np.sort(kept, axis=1), best / best.sum(axis=1, keepdims=True))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("position_scale", -1.0),
        ("flip_probability", 2.0),
        ("objectness_limits", (0.0, 1.0)),
        ("objectness_limits", (0.9, 0.1)),
        ("track_gap", -1),
        ("samples", 0),
        ("samples", -5),
        ("seed", -1),
        ("annealing", (4.0, float("nan"))),
        ("annealing", ()),
        ("birth_intensity", float("inf")),
        ("em_iterations", 2.5),
        ("hypotheses", 0),
        ("odometry_rotation_scale", True),
    ],
)
def test_settings_are_checked(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=name):
        SlamConfig(**{name: value})


def test_good_odometry_is_not_bent_by_poor_detections() -> None:
    """0.2 mrad and 0.1 % a step under a detector of 1 m and 20 % of the range, no scale of the odometry stated."""
    rng = np.random.default_rng(11)
    truth = simulate_circuit(rng, laps=1, radius=20.0, frames_per_lap=60)
    world = simulate_sequence(
        truth,
        rng,
        world=WorldConfig(objects=30, categories=6, latent_dim=4),
        detector=DetectorConfig(position_scale=1.0, position_ratio=0.2),
        odometry_rotation_scale=0.0002,
        odometry_translation_ratio=0.001,
    )
    result = solve(SlamProblem(world.odometry, world.observations), SlamConfig(hypotheses=1))
    before, after = (absolute_trajectory_error(T, truth).rmse for T in (world.odometry, result.T_world_camera))
    assert after < 1.05 * before + 1e-3
    assert any("is a guess" in w and "half of it" in w for w in result.state.noise.warnings)


def test_no_landmark_is_said() -> None:
    problem = detections(6)
    far = replace(problem, observations=replace(problem.observations, position=10.0 * np.arange(18).reshape(6, 3) + 1.0))
    result = solve(far, SlamConfig(hypotheses=1))
    assert not result.landmarks and any("no landmark is left" in w for w in result.state.noise.warnings)
