"""Log evidence of maps and their weights, and the graph with true associations, against independent computations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from nolbo_ppl.geometry.pose import inverse, se3_exp, transform
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve_with_associations
from nolbo_ppl.inference.slam.data_association import Associations
from nolbo_ppl.inference.slam.frame_model import initial_frame_model
from nolbo_ppl.inference.slam.hypotheses import MapHypothesis, ambiguity, mixture_covariances
from nolbo_ppl.inference.slam.map_evidence import map_log_evidence, trajectory_distance
from nolbo_ppl.inference.slam.slam_state import SlamState
from nolbo_ppl.structures.detections import Detections

EXACT = SlamConfig(odometry_rotation_scale=1e-7, odometry_translation_scale=1e-7, birth_intensity=0.01, clutter_intensity=0.02)


def standing(points: np.ndarray, owner: np.ndarray, scale: float = 0.3) -> SlamState:
    """One detection a frame of a camera that does not move."""
    n = len(points)
    table = Detections.from_arrays(np.arange(n), points, position_scale=scale, objectness=np.full(n, 0.7))
    return solve_with_associations(SlamProblem(np.tile(np.eye(4), (n, 1, 1)), table), owner, EXACT)


def test_evidence_of_still_camera_is_the_normal_integral() -> None:
    """Against the joint normal of all detections of a landmark whose place has a (very wide) normal prior."""
    rng = np.random.default_rng(0)
    points = np.array([2.0, 0.0, 5.0]) + 0.3 * rng.standard_normal((6, 3))
    wide = 1e3
    clutter = np.log(EXACT.clutter_intensity or 1)

    def exact(groups: list[list[int]]) -> float:
        value = 0.0
        for rows in groups:
            n = len(rows)
            covariance = 0.09 * np.eye(n) + wide**2 * np.ones((n, n))
            # The prior's own density at its middle is taken off: the rate stands in its place.
            for axis in range(3):
                value += multivariate_normal.logpdf(points[rows, axis] - points[rows, axis].mean(), np.zeros(n), covariance)
                value += 0.5 * np.log(2 * np.pi * wide**2)
            value += np.log(EXACT.birth_intensity or 1) - n * clutter
        return value

    one = standing(points, np.zeros(6, int))
    two = standing(points, np.array([0, 0, 0, 1, 1, 1]))
    three = standing(points, np.array([0, 0, 1, 1, 2, 2]))
    base = map_log_evidence(one)
    for state, groups in ((two, [[0, 1, 2], [3, 4, 5]]), (three, [[0, 1], [2, 3], [4, 5]])):
        # Detections may also be background (a mixture): far more probable as objects here, by 1e-3 at most.
        assert map_log_evidence(state) - base == pytest.approx(exact(groups) - exact([list(range(6))]), abs=0.35)
    assert base > map_log_evidence(two)


def test_two_objects_are_two_landmarks() -> None:
    rng = np.random.default_rng(1)
    place = np.array([[2.0, 0.0, 5.0], [4.5, 0.0, 5.0]])[np.array([0, 0, 0, 1, 1, 1])]
    points = place + 0.3 * rng.standard_normal((6, 3))
    assert map_log_evidence(standing(points, np.array([0, 0, 0, 1, 1, 1]))) > map_log_evidence(standing(points, np.zeros(6, int)))


def test_mixture_covariance_and_words() -> None:
    rng = np.random.default_rng(2)
    state = standing(np.array([2.0, 0.0, 5.0]) + 0.1 * rng.standard_normal((4, 3)), np.zeros(4, int))
    moved = state.estimate.T_world_camera.copy()
    away = np.array([0.0, 0.1, 0.0, 0.3, 0.0, -0.2])
    moved[3] = moved[3] @ se3_exp(away)
    other = replace(state, estimate=replace(state.estimate, T_world_camera=moved))
    nothing = np.zeros(0, int)
    model = initial_frame_model(state.measurements, EXACT, 4)
    empty = Associations(nothing, nothing, np.zeros(0), np.zeros(4), np.ones(4), np.zeros(4), True, np.ones(1), model)
    maps = (MapHypothesis(0.7, 0.0, state, empty), MapHypothesis(0.3, -0.85, other, empty))
    found = mixture_covariances(maps, state.estimate.T_world_camera, np.array([2, 3]))
    own = [h.pose_covariances(np.array([2, 3])) for h in maps]
    np.testing.assert_allclose(found[0], 0.7 * own[0][0] + 0.3 * own[1][0], atol=1e-12)
    np.testing.assert_allclose(found[1], 0.7 * own[0][1] + 0.3 * own[1][1] + 0.3 * np.outer(away, away), atol=1e-9)
    text = ambiguity(maps)
    assert text is not None and "frame 3" in text and "0.30" in text
    assert ambiguity(maps[:1]) is None
    assert trajectory_distance(moved, state.estimate.T_world_camera) == pytest.approx(np.sqrt(0.13 / 4), rel=0.02)


def test_true_associations_are_least_squares() -> None:
    """The whole graph against scipy on rotation vectors and translations, residuals written out."""
    rng = np.random.default_rng(3)
    n, m = 5, 3
    objects = np.array([[1.0, 0.5, 6.0], [-2.0, 0.0, 7.0], [3.0, -0.5, 9.0]])
    truth = [np.eye(4)]
    odometry = [np.eye(4)]
    for _ in range(n - 1):
        step = se3_exp(np.array([0.0, 0.1, 0.02, 0.1, 0.0, 0.6]))
        truth.append(truth[-1] @ step)
        odometry.append(odometry[-1] @ step @ se3_exp(np.r_[0.02 * rng.standard_normal(3), 0.05 * rng.standard_normal(3)]))
    frame, owner = np.repeat(np.arange(n), m), np.tile(np.arange(m), n)
    points = np.array([transform(inverse(truth[t]), objects[j]) for t, j in zip(frame, owner)])
    points += 0.05 * rng.standard_normal(points.shape)
    config = SlamConfig(odometry_rotation_scale=0.02, odometry_translation_scale=0.05)
    problem = SlamProblem(np.array(odometry), Detections.from_arrays(frame, points, position_scale=0.05))
    found = solve_with_associations(problem, owner, config).estimate

    def residuals(x: np.ndarray) -> np.ndarray:
        T = [np.eye(4)]
        for i in range(n - 1):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(x[6 * i : 6 * i + 3]).as_matrix(), x[6 * i + 3 : 6 * i + 6]
            T.append(pose)
        landmarks = x[6 * (n - 1) :].reshape(m, 3)
        out = []
        for i in range(n - 1):
            measured = np.linalg.inv(odometry[i]) @ odometry[i + 1]
            difference = np.linalg.inv(measured) @ np.linalg.inv(T[i]) @ T[i + 1]
            turn = Rotation.from_matrix(difference[:3, :3]).as_rotvec()
            # Translation of the logarithm, by the series of the inverse left Jacobian to second order.
            K = np.cross(np.eye(3), -turn)
            move = (np.eye(3) - 0.5 * K + K @ K / 12) @ difference[:3, 3]
            out += [turn / 0.02, move / 0.05]
        for t, j, p in zip(frame, owner, points):
            out.append((np.linalg.inv(T[t])[:3] @ np.r_[landmarks[j], 1] - p) / 0.05)
        return np.concatenate(out)

    start = np.concatenate(
        [np.r_[Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]] for T in odometry[1:]] + [objects.ravel()]
    )
    best = least_squares(residuals, start, xtol=1e-14, ftol=1e-14).x
    np.testing.assert_allclose(found.T_world_camera[1:, :3, 3], best[: 6 * (n - 1)].reshape(-1, 6)[:, 3:], atol=2e-4)
    np.testing.assert_allclose(found.T_world_landmark[:, :3, 3], best[6 * (n - 1) :].reshape(m, 3), atol=2e-4)


def test_runs_begin_differently_where_nothing_is_stated() -> None:
    from nolbo_ppl.inference.slam.hypotheses import raised_odometry, start_of_run

    state = standing(np.ones((4, 3)) + 0.1 * np.arange(12).reshape(4, 3), np.zeros(4, int))
    assert start_of_run(state, 0) is state
    stated, free = start_of_run(state, 1), start_of_run(replace(state, config=SlamConfig()), 1)
    np.testing.assert_array_equal(stated.noise.rotation_step, state.noise.rotation_step)
    np.testing.assert_allclose(free.noise.rotation_step, 3 * state.noise.rotation_step)
    assert stated.config.seed != state.config.seed and stated.config.annealing[0] > state.config.annealing[0]
    # A run is repeated where the end raised what was stated, not otherwise.
    wider = replace(state, noise=replace(state.noise, rotation_step=10 * state.noise.rotation_step, warnings=("said",)))
    again = raised_odometry(state, wider)
    assert again is not None and again.noise.warnings == ("said",)
    np.testing.assert_allclose(again.noise.rotation_step, 10 * state.noise.rotation_step)
    np.testing.assert_array_equal(again.noise.translation_step, state.noise.translation_step)
    assert raised_odometry(state, state) is None


@pytest.mark.slow
def test_map_does_not_depend_on_the_seed() -> None:
    """Identical objects without orientations: two seeds end at one trajectory, or the answer says that it is ambiguous."""
    from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
    from nolbo_ppl.inference.slam import solve

    rng = np.random.default_rng(123)
    truth = simulate_circuit(rng, laps=2, radius=20.0, frames_per_lap=40)
    world = simulate_sequence(
        truth,
        rng,
        world=WorldConfig(objects=20, categories=1, latent_dim=0),
        detector=DetectorConfig(rotation_scale=None),
        odometry_rotation_scale=0.01,
    )
    problem = SlamProblem(world.odometry, world.observations)
    runs = [solve(problem, SlamConfig(odometry_rotation_scale=0.01, odometry_translation_ratio=0.01, seed=s)) for s in (0, 7)]
    assert all(sum(h.weight for h in run.hypotheses) == pytest.approx(1.0, abs=1e-3) for run in runs)
    apart = trajectory_distance(runs[0].T_world_camera, runs[1].T_world_camera)
    assert apart < 0.1 or all(ambiguity(run.hypotheses) for run in runs)
