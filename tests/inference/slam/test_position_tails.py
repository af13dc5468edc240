"""Positions with heavy tails: the law that a model's calibration states reaches graph and densities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_t

from nolbo_ppl.data.simulate import DetectorConfig, SimulatedSequence, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, transform
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, estimate_noise, solve, solve_with_associations
from nolbo_ppl.inference.slam.gaussian import position_log_density, squared_distance

DOF = 2.5
CONFIG = SlamConfig(odometry_rotation_scale=0.005, odometry_translation_ratio=0.01, correct_scales=False, hypotheses=1)
TAILS = replace(CONFIG, position_tails=(DOF, 1.0))


def drive(seed: int) -> SimulatedSequence:
    """Positions err as Student's t with the stated covariance for its scale matrix."""
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=2, radius=18.0, frames_per_lap=25)
    detector = DetectorConfig(clutter_rate=0.0, position_scale=0.15)
    made = simulate_sequence(truth, rng, world=WorldConfig(objects=15), detector=detector, odometry_rotation_scale=0.005)
    assert made.world is not None
    table = made.observations
    exact = transform(inverse(truth[table.frame]), made.world.position[made.object_of])
    scale = np.sqrt(table.position_covariance[:, 0, 0])
    error = multivariate_t(shape=np.eye(3), df=DOF).rvs(len(table), random_state=seed)
    return replace(made, observations=replace(table, position=exact + scale[:, None] * error))


def test_density_of_the_law() -> None:
    rng = np.random.default_rng(0)
    error, S = rng.standard_normal((4, 3)), np.tile(np.diag([0.5, 1.0, 2.0]), (4, 1, 1))
    square, log_det = squared_distance(error, S)
    np.testing.assert_allclose(position_log_density(square, log_det, None), -0.5 * (square + log_det))
    expected = multivariate_t(shape=S[0], df=4.0).logpdf(error)
    np.testing.assert_allclose(position_log_density(square, log_det, 4.0), expected, rtol=1e-9)


def test_landmarks_lie_nearer_to_the_truth_with_the_true_law() -> None:
    worse = []
    for seed in range(4):
        made = drive(seed)
        assert made.world is not None
        seen = np.unique(made.object_of)
        errors = []
        for config in (CONFIG, TAILS):
            state = solve_with_associations(SlamProblem(made.odometry, made.observations), made.object_of, config)
            gap = state.estimate.T_world_landmark[:, :3, 3] - made.world.position[seen]
            errors.append(float(np.sqrt(np.mean(np.sum((gap - gap.mean(axis=0)) ** 2, axis=1)))))
        worse.append(errors[0] / errors[1])
    assert np.exp(np.mean(np.log(worse))) > 1.1


def test_the_whole_of_it_runs_with_tails() -> None:
    made = drive(7)
    problem = SlamProblem(made.odometry, made.observations)
    found = solve(problem, TAILS)
    assert found.state.noise.position_dof == DOF
    assert abs(len(found.landmarks) - len(np.unique(made.object_of))) <= 3
    half = estimate_noise(problem, replace(CONFIG, position_tails=(DOF, 0.5)))
    np.testing.assert_allclose(half.position_covariance, 0.5 * estimate_noise(problem, CONFIG).position_covariance)


@pytest.mark.parametrize("tails", [(0.5, 1.0), (3.0, 0.0), (3.0,), (np.nan, 1.0)])
def test_no_law_is_refused(tails: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="position_tails"):
        SlamConfig(position_tails=tails)  # type: ignore[arg-type]
