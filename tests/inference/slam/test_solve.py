"""The whole EM on small worlds: loops close, maps are consistent, hostile input is survived."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.data.simulate import DetectorConfig, SimulatedSequence, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, transform
from nolbo_ppl.inference.slam import (
    IncrementalSlam,
    SlamConfig,
    SlamProblem,
    SlamResult,
    init,
    solve,
    solve_with_associations,
    step,
)
from nolbo_ppl.inference.slam.map_files import association_table
from nolbo_ppl.io.observations import Detections
from nolbo_ppl.metrics.association import association_pairs
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error

CONFIG = SlamConfig(odometry_rotation_scale=0.01, odometry_translation_ratio=0.01)


def drive(seed: int = 0, detector: DetectorConfig | None = None, laps: int = 2, **world: object) -> SimulatedSequence:
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=laps, frames_per_lap=90)
    objects = WorldConfig(**{"objects": 45, "categories": 8, "latent_dim": 6, **world})  # type: ignore[arg-type]
    return simulate_sequence(truth, rng, world=objects, detector=detector, odometry_rotation_scale=0.01)


def labels(result: SlamResult) -> np.ndarray:
    return association_table(result).landmark_of


def ate(T: np.ndarray, truth: np.ndarray) -> float:
    return absolute_trajectory_error(T, truth).rmse


@pytest.fixture(scope="module")
def solved() -> tuple[SimulatedSequence, SlamResult]:
    world = drive()
    return world, solve(SlamProblem(world.odometry, world.observations), CONFIG)


def test_loops_close_as_with_true_associations(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    world, result = solved
    oracle = solve_with_associations(result.state.problem, world.object_of, CONFIG)
    before, after = ate(world.odometry, world.truth), ate(result.T_world_camera, world.truth)
    assert after < 0.6 * before
    assert after < 1.3 * ate(oracle.estimate.T_world_camera, world.truth)
    score = association_pairs(world.observations.frame, world.object_of, labels(result), 45)
    assert score.precision > 0.99 and score.recall > 0.9


def test_associations_are_probabilities(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    _, result = solved
    found = result.associations
    total = found.new + found.background
    np.add.at(total, found.row, found.weight)
    np.testing.assert_allclose(total, 1.0, atol=2e-3)  # weights below 1e-4 are not listed
    assert found.exact


def test_answers_carry_uncertainty(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    world, result = solved
    covariance = result.pose_covariances(np.array([0, 10, 100]))
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert np.trace(covariance[0]) < 1e-6 < np.trace(covariance[1])
    seen = {int(o) for o in world.object_of if o >= 0}
    assert abs(len(result.landmarks) - len(seen)) <= 0.15 * len(seen)
    # Clutter is a seventh of the detections: most landmarks are objects, and are believed to be.
    assert np.mean([landmark.existence > 0.9 for landmark in result.landmarks]) > 0.9
    for landmark in result.landmarks:
        assert sum(landmark.class_posterior.values()) == pytest.approx(1.0)
        assert landmark.latent is not None and landmark.latent_variance is not None
        assert (landmark.latent_variance > 0).all()
        assert np.linalg.eigvalsh(landmark.position_covariance).min() > 0
    with pytest.raises(InputError, match="no such pose"):
        result.pose_covariances(np.array([10**6]))


def test_covariances_equal_gtsam_marginals(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    import gtsam

    from nolbo_ppl.inference.slam.graph import landmark_key, pose_key, to_values
    from nolbo_ppl.inference.slam.map_refinement import final_graph

    _, result = solved
    marginals = gtsam.Marginals(final_graph(result.state), to_values(result.state.estimate))
    for i in (1, 60, 179):
        np.testing.assert_allclose(
            result.pose_covariances(np.array([i]))[0], marginals.marginalCovariance(pose_key(i)), rtol=1e-4, atol=1e-9
        )
    np.testing.assert_allclose(
        result.landmark_covariances()[3], marginals.marginalCovariance(landmark_key(3)), rtol=1e-4, atol=1e-9
    )


def test_samples_have_the_marginal_covariance(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    _, result = solved
    poses, _ = result.linearisation.samples(4000, np.random.default_rng(0))
    exact = result.pose_covariances(np.array([90]))[0]
    sampled = poses[90] @ poses[90].T / 4000
    error = np.sqrt((np.outer(np.diag(exact), np.diag(exact)) + exact**2) / 4000)
    assert (np.abs(sampled - exact) < 5 * error).all()


def test_same_seed_same_answer() -> None:
    world = drive(seed=3, laps=1)
    problem = SlamProblem(world.odometry, world.observations)
    np.testing.assert_array_equal(solve(problem, CONFIG).T_world_camera, solve(problem, CONFIG).T_world_camera)


def test_steps_are_pure() -> None:
    world = drive(seed=4, laps=1)
    state = init(SlamProblem(world.odometry, world.observations), CONFIG)
    before = state.estimate.T_world_camera.copy()
    (_, first), (_, second) = step(state), step(state)
    assert first == second
    np.testing.assert_array_equal(state.estimate.T_world_camera, before)


def test_position_only_landmarks_close_loops() -> None:
    world = drive(seed=1, detector=DetectorConfig(rotation_scale=None, clutter_rate=0.3), latent_dim=0, categories=1)
    result = solve(SlamProblem(world.odometry, world.observations), CONFIG)
    assert ate(result.T_world_camera, world.truth) < 0.75 * ate(world.odometry, world.truth)
    score = association_pairs(world.observations.frame, world.object_of, labels(result), 45)
    assert score.precision > 0.95
    assert not any(landmark.oriented for landmark in result.landmarks)


def test_too_small_scales_are_reported() -> None:
    world = drive(seed=2)
    table = replace(
        world.observations,
        latent_scale=world.observations.latent_scale / 3,
        position_covariance=world.observations.position_covariance / 9,
    )
    state = init(SlamProblem(world.odometry, table), CONFIG)
    assert any("latent" in w for w in state.noise.warnings)
    assert any("position" in w for w in state.noise.warnings)
    assert not init(SlamProblem(world.odometry, world.observations), CONFIG).noise.warnings


def test_scales_are_estimated_where_none_are_stated() -> None:
    world = drive(seed=6, laps=1)
    unknown = np.full(len(world.observations), np.nan)
    table = replace(
        world.observations,
        position_covariance=unknown[:, None, None] * np.eye(3),
        rotation_scale=unknown,
        latent_scale=unknown[:, None] * np.ones(6),
    )
    noise = init(SlamProblem(world.odometry, table), CONFIG).noise
    assert 0.5 < np.median(noise.latent_scale) / 0.7 < 1.5
    assert 0.5 < np.median(noise.rotation_scale) / 0.05 < 2.5
    true = np.sqrt(np.trace(world.observations.position_covariance, axis1=1, axis2=2))
    found = np.sqrt(np.trace(noise.position_covariance, axis1=1, axis2=2))
    assert 0.5 < np.median(found / true) < 2.5


def test_moving_objects_do_not_bend_the_trajectory() -> None:
    world = drive(seed=5, laps=1)
    rng = np.random.default_rng(0)
    frames = np.arange(10, 80)
    # A vehicle ahead that keeps its distance: static in the camera's frame, moving in the world.
    ahead = transform(inverse(world.truth[frames]), transform(world.truth[frames], np.array([0.5, 1.0, 12.0])))
    ahead += 0.1 * rng.standard_normal(ahead.shape)
    mover = Detections.from_arrays(
        frames,
        ahead,
        position_scale=0.3,
        rotation=np.tile(np.eye(3), (len(frames), 1, 1)),
        rotation_scale=0.05,
        latent=rng.standard_normal((len(frames), 6)),
        latent_scale=0.7,
        category=["c0"] * len(frames),
        id=[f"mover-{t}" for t in frames],
    )
    both = Detections.concatenate([world.observations, mover])
    clean = solve(SlamProblem(world.odometry, world.observations), CONFIG)
    result = solve(SlamProblem(world.odometry, both), CONFIG)
    assert ate(result.T_world_camera, world.truth) < 1.2 * ate(clean.T_world_camera, world.truth) + 0.05


def empty_table() -> Detections:
    return Detections.from_arrays(np.zeros(0, int), np.zeros((0, 3)))


@pytest.mark.parametrize("case", ["no observations", "one landmark", "one frame", "one observation", "no loop", "jump"])
def test_poor_input_gives_an_answer(case: str) -> None:
    world = drive(seed=7, laps=1)
    odometry, table = world.odometry[:40], world.observations.select(world.observations.frame < 40)
    if case == "no observations":
        table = empty_table()
    elif case == "one landmark":
        table = table.select(world.object_of[: len(table)] == world.object_of[np.argmax(world.object_of[: len(table)] >= 0)])
    elif case == "one frame":
        odometry, table = odometry[:1], table.select(table.frame == 0)
    elif case == "one observation":
        table = table.select(np.arange(1))
    elif case == "jump":
        odometry = odometry.copy()
        odometry[20:, 0, 3] += 1e4
    result = solve(SlamProblem(odometry, table), CONFIG)
    assert result.T_world_camera.shape == odometry.shape and np.isfinite(result.T_world_camera).all()
    assert len(result.associations.new) == len(table)
    step_before = np.linalg.norm(np.diff(odometry[:, :3, 3], axis=0), axis=1)
    step_after = np.linalg.norm(np.diff(result.T_world_camera[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(step_after, step_before, rtol=0.1, atol=0.5)
    # One sighting founds no landmark, and there is at most one for each object that was seen.
    seen = len(np.unique(world.object_of[: len(table)])) if case in ("no loop", "jump") else 1
    least, most = (1, seen) if case in ("no loop", "jump") else (0, int(case == "one landmark"))
    assert least <= len(result.landmarks) <= most


def test_malformed_problems_raise() -> None:
    with pytest.raises(InputError, match="no trajectory"):
        SlamProblem(np.zeros((0, 4, 4)), empty_table())
    bad = np.tile(np.eye(4), (3, 1, 1))
    bad[1, 0, 0] = np.nan
    with pytest.raises(InputError, match="row 1"):
        SlamProblem(bad, empty_table())
    with pytest.raises(InputError, match="frame out of range"):
        SlamProblem(np.tile(np.eye(4), (3, 1, 1)), Detections.from_arrays([7], np.ones((1, 3))))


@pytest.mark.slow
def test_online_ends_where_batch_does(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    world, batch = solved
    slam = IncrementalSlam(CONFIG, calibration=SlamProblem(world.odometry, world.observations))
    closings = 0
    for t, pose in enumerate(world.odometry):
        closings += slam.update(pose, world.observations.select(world.observations.frame == t)).closings
    assert closings > 0
    assert ate(slam.trajectory(), world.truth) < 0.8 * ate(world.odometry, world.truth)
    end = slam.finish()
    assert abs(ate(end.T_world_camera, world.truth) - ate(batch.T_world_camera, world.truth)) < 0.2


def test_online_refuses_nonsense() -> None:
    slam = IncrementalSlam(CONFIG)
    with pytest.raises(InputError, match="no keyframe"):
        slam.finish()
    with pytest.raises(InputError, match="no pose"):
        slam.update(np.full((4, 4), np.nan), empty_table())
