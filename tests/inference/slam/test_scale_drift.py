"""Odometry whose unit of length is unknown and wanders: the scale as a state, with its covariance."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import gtsam
import numpy as np
import pytest

from nolbo_ppl.data.simulate import (
    DetectorConfig,
    SimulatedSequence,
    WorldConfig,
    simulate_circuit,
    simulate_detections,
    simulate_odometry,
    simulate_world,
)
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import relative, se3_exp
from nolbo_ppl.inference.slam import (
    IncrementalSlam,
    SlamConfig,
    SlamProblem,
    SlamResult,
    em_init,
    solve,
    solve_with_associations,
)
from nolbo_ppl.inference.slam.graph import pose_key, to_values
from nolbo_ppl.inference.slam.map_evidence import map_log_evidence
from nolbo_ppl.inference.slam.noise.fitted_residuals import fitted_residuals, whole_graph
from nolbo_ppl.inference.slam.noise.odometry_scale import rescaled, scale_profile, smooth
from nolbo_ppl.inference.slam.scale_state import scale_key, scaled_step_factor
from nolbo_ppl.inference.slam.slam_state import given_odometry
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error

CONFIG = SlamConfig(odometry_rotation_scale=0.004, odometry_translation_ratio=0.01, scale_drift=True)


def drive(seed: int = 0, walk: float = 0.01, length: float = 0.3) -> SimulatedSequence:
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, frames_per_lap=40, radius=22.0)
    world = simulate_world(truth, WorldConfig(objects=25), rng)
    odometry = simulate_odometry(truth, rng, rotation_scale=0.004, translation_ratio=0.01, length_scale=length, scale_drift=walk)
    table, source = simulate_detections(truth, world, DetectorConfig(), rng)
    return SimulatedSequence(truth, odometry, table, source, world)


def true_scale(world: SimulatedSequence) -> np.ndarray:
    step, given = (np.linalg.norm(relative(T[:-1], T[1:])[:, :3, 3], axis=1) for T in (world.truth, world.odometry))
    return step / given


@pytest.fixture(scope="module")
def solved() -> tuple[SimulatedSequence, SlamResult]:
    world = drive()
    return world, solve(SlamProblem(world.odometry, world.observations), CONFIG)


def test_step_factor_has_the_jacobians_of_finite_differences() -> None:
    rng = np.random.default_rng(0)
    step = se3_exp(np.array([0.05, -0.1, 0.02, 0.3, 0.1, 2.0]))
    factor = scaled_step_factor(pose_key(0), pose_key(1), 0, step, gtsam.noiseModel.Unit.Create(6))
    first = se3_exp(rng.standard_normal(6))
    scaled = step.copy()
    scaled[:3, 3] *= 1.3

    def error(delta: np.ndarray) -> np.ndarray:
        values = gtsam.Values()
        values.insert(pose_key(0), gtsam.Pose3(first @ se3_exp(delta[:6])))
        values.insert(pose_key(1), gtsam.Pose3(first @ scaled @ se3_exp(delta[6:12])))
        values.insert(scale_key(0), 1.3 + delta[12:])
        return np.asarray(factor.unwhitenedError(values))

    np.testing.assert_allclose(error(np.zeros(13)), 0.0, atol=1e-12)
    values = gtsam.Values()
    values.insert(pose_key(0), gtsam.Pose3(first))
    values.insert(pose_key(1), gtsam.Pose3(first @ scaled))
    values.insert(scale_key(0), np.array([1.3]))
    A, _ = factor.linearize(values).jacobian()
    numeric = np.stack([(error(1e-6 * e) - error(-1e-6 * e)) / 2e-6 for e in np.eye(13)], axis=1)
    np.testing.assert_allclose(A, numeric, atol=1e-7)


def test_smoothing_equals_the_sum_over_all_paths() -> None:
    rng = np.random.default_rng(1)
    grid, walk = np.array([-0.2, 0.0, 0.2]), 0.15
    score = rng.standard_normal((4, 3))
    kernel = np.exp(-0.5 * ((grid[:, None] - grid[None]) / walk) ** 2)
    kernel /= kernel.sum(axis=0, keepdims=True)
    total, marginal = 0.0, np.zeros((4, 3))
    for path in product(range(3), repeat=4):
        weight = np.exp(sum(score[w, k] for w, k in enumerate(path))) / 3
        for before, after in pairwise(path):
            weight *= kernel[after, before]
        total += weight
        for w, k in enumerate(path):
            marginal[w, k] += weight
    posterior, evidence = smooth(score, grid, walk)
    np.testing.assert_allclose(posterior, marginal / total, rtol=1e-12)
    np.testing.assert_allclose(evidence, np.log(total), rtol=1e-12)


def test_a_jump_of_the_scale_leaves_numbers() -> None:
    """Windows that are sure of scales far apart: the walk allows neither, and the answer is each window's own."""
    grid = np.arange(-1.0, 1.01, 0.01)
    peaks = np.array([-0.9, -0.9, 0.9, 0.9])
    posterior, evidence = smooth(-1e4 * (grid - peaks[:, None]) ** 2, grid, 0.007)
    assert np.isfinite(evidence)
    np.testing.assert_allclose(posterior @ grid, peaks, atol=0.02)


def test_neighbouring_frames_tell_the_scale_in_any_unit() -> None:
    world = drive(seed=3)
    problem = SlamProblem(world.odometry, world.observations)
    profile = scale_profile(problem)
    error = profile.log_scale - np.log(true_scale(world))
    assert profile.told and 0.002 <= profile.walk <= 0.02  # 0.01 was drawn
    assert np.sqrt(np.mean(error**2)) < 0.06
    assert np.mean((error / profile.deviation) ** 2) < 4.0
    thousandth = rescaled(problem, np.full(len(problem) - 1, 1e-2))
    np.testing.assert_allclose(scale_profile(thousandth).log_scale, profile.log_scale + np.log(100), atol=0.05)


def test_loops_close_as_with_true_associations(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    world, result = solved
    problem = SlamProblem(world.odometry, world.observations)
    oracle = solve_with_associations(problem, world.object_of, CONFIG, result.state.noise)
    before, after, best = (
        absolute_trajectory_error(T, world.truth).rmse
        for T in (world.odometry, result.T_world_camera, oracle.estimate.T_world_camera)
    )
    assert after < 1.5 * best < 0.1 * before
    np.testing.assert_allclose(given_odometry(result.state), world.odometry, atol=1e-9)


def test_scale_is_stated_with_its_uncertainty(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    world, result = solved
    assert result.scale is not None and result.scale_standard_deviation is not None
    error = result.scale - true_scale(world)
    assert np.sqrt(np.mean((error / result.scale) ** 2)) < 0.05
    # The truth of a single step holds the noise of its own translation, 1 % of its length.
    spread = np.hypot(result.scale_standard_deviation, 0.01 * result.scale)
    assert 0.1 < np.mean((error / spread) ** 2) < 3.0
    deviations = result.linearisation.scale_deviations()
    marginals = gtsam.Marginals(result.graph, result.values)
    for i in (0, 17, len(deviations) - 1):
        assert deviations[i] == pytest.approx(np.sqrt(marginals.marginalCovariance(scale_key(i))[0, 0]), rel=1e-6)


def test_residuals_of_detections_are_read_behind_those_of_the_scales(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    """Squares of each factor between a pose and a landmark, by GTSAM one by one."""
    state = solved[1].state
    found = fitted_residuals(state, np.random.default_rng(0))
    graph, factors = whole_graph(state)
    values = to_values(state.estimate)
    each = [graph.at(k) for k in range(graph.size())]
    kinds = ["".join(chr(gtsam.Symbol(key).chr()) for key in factor.keys()) for factor in each]  # noqa: SIM118 - no mapping
    errors = [factor.error(values) for factor, kind in zip(each, kinds) if kind == "xl"]
    sure = factors.weight[factors.weight > 1e-3] > 0.5
    assert len(errors) == len(sure) and found.oriented.all()
    np.testing.assert_allclose(0.5 * np.sum(found.observation**2, axis=1), np.array(errors)[sure], rtol=1e-6, atol=1e-9)


def test_evidence_of_an_ever_narrower_walk_is_that_of_one_scale(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    """Walks too narrow to matter explain alike: the density of the walk is normalised (each step else gained ln 10)."""
    state = solved[1].state
    assert state.estimate.scale is not None
    even = replace(state, estimate=replace(state.estimate, scale=np.full_like(state.estimate.scale, state.estimate.scale.mean())))
    values = [map_log_evidence(replace(even, noise=replace(even.noise, scale_walk=walk))) for walk in (1e-5, 1e-6)]
    assert values[0] == pytest.approx(values[1], abs=0.5)


def test_without_drift_nothing_is_scaled() -> None:
    world = drive(seed=4, walk=0.0, length=1.0)
    result = solve(SlamProblem(world.odometry, world.observations), replace(CONFIG, scale_drift=False, em_iterations=1))
    assert result.scale is None and result.scale_standard_deviation is None


def test_who_takes_lengths_as_metres_says_so() -> None:
    world = drive(seed=5)
    with pytest.raises(InputError, match=r"online.*batch"):
        IncrementalSlam(CONFIG)
    with pytest.raises(InputError, match=r"reference EM"):
        em_init(SlamProblem(world.odometry, world.observations), CONFIG, np.eye(4)[None])
    with pytest.raises(InputError, match="scale_walk"):
        SlamConfig(scale_walk=0.0)


def test_no_detections_no_scale() -> None:
    world = drive(seed=6)
    result = solve(SlamProblem(world.odometry, world.observations.select(np.zeros(0, dtype=np.int64))), CONFIG)
    assert any("scale of the odometry is a guess" in text for text in result.state.noise.warnings)
    np.testing.assert_allclose(result.T_world_camera, world.odometry, atol=1e-6)
