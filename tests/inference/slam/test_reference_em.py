"""The plain EM: its bound never falls, equals brute force, and its log density is GTSAM's."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import gtsam
import numpy as np
import pytest

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_drive
from nolbo_ppl.geometry.pose import make_pose, relative, se3_exp, se3_log, so3_exp
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, plain_init, plain_solve
from nolbo_ppl.inference.slam.reference_em import PlainState, e_step, mode_log_likelihood
from nolbo_ppl.io.observations import make_table

CONFIG = SlamConfig(odometry_rotation_scale=0.004, odometry_translation_ratio=0.01)


def small(seed: int, latent_dim: int = 4, rotation: float | None = 0.05) -> PlainState:
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=1, frames_per_lap=40)
    drive = simulate_drive(
        truth,
        rng,
        world=WorldConfig(objects=10, categories=2, latent_dim=latent_dim),
        odometry_rotation_scale=0.004,
        detector=DetectorConfig(flip_rate=0.2, rotation_scale=rotation, clutter_rate=0.3),
    )
    assert drive.world is not None
    start = drive.world.position + rng.standard_normal(drive.world.position.shape)
    return plain_init(SlamProblem(drive.odometry, drive.observations), CONFIG, make_pose(drive.world.rotation, start))


@pytest.mark.parametrize(("seed", "latent_dim", "rotation"), [(0, 4, 0.05), (1, 0, 0.05), (2, 0, None), (3, 3, None)])
def test_the_bound_never_falls(seed: int, latent_dim: int, rotation: float | None) -> None:
    _, infos = plain_solve(small(seed, latent_dim, rotation), iterations=8, tolerance=-np.inf)
    bounds = np.array([info.bound for info in infos])
    assert len(bounds) == 8
    assert bounds[-1] > bounds[0] + 0.5
    assert np.diff(bounds).min() > -1e-6 * np.abs(bounds).max()


def test_the_bound_never_falls_with_stated_modes() -> None:
    state = small(4)
    table = state.problem.observations
    rng = np.random.default_rng(0)
    wrong = table.rotation @ so3_exp(np.pi / 2 * np.array([0, 0, 1.0]))
    first = rng.random(len(table)) < 0.7
    modes = np.where(first[:, None, None, None], np.stack([table.rotation, wrong], 1), np.stack([wrong, table.rotation], 1))
    table = replace(
        table,
        rotation=modes[:, 0],
        mode_weight=np.tile([0.6, 0.4], (len(table), 1)),
        mode_rotation=modes,
        mode_std=np.full((len(table), 2), 0.05),
    )
    problem = SlamProblem(state.problem.odometry, table)
    start = plain_init(problem, CONFIG, state.estimate.T_world_landmark, noise=state.noise)
    _, infos = plain_solve(start, iterations=8, tolerance=-np.inf)
    bounds = np.array([info.bound for info in infos])
    assert bounds[-1] > bounds[0] + 0.5
    assert np.diff(bounds).min() > -1e-6 * np.abs(bounds).max()


def test_error_is_that_of_gtsam() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        T, L, measured = (se3_exp(rng.standard_normal(6)) for _ in range(3))
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3(T))
        values.insert(1, gtsam.Pose3(L))
        factor = gtsam.BetweenFactorPose3(0, 1, gtsam.Pose3(measured), gtsam.noiseModel.Unit.Create(6))
        ours = se3_log(relative(measured, relative(T, L)))
        np.testing.assert_allclose(factor.unwhitenedError(values), ours, atol=1e-9)


def test_evidence_and_weights_equal_enumeration() -> None:
    """One frame, three detections, two landmarks: the sum over all associations written out."""
    odometry = np.tile(np.eye(4), (2, 1, 1))
    table = make_table(
        [0, 0, 0], np.array([[0, 0, 5.0], [1, 0, 6.0], [0.5, 0, 5.5]]), position_scale=0.5, objectness=[0.9, 0.6, 0.3]
    )
    landmarks = make_pose(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.2, 0, 5.0], [0.9, 0.1, 6.1]]))
    state = plain_init(SlamProblem(odometry, table), CONFIG, landmarks)
    _, weights, evidence = e_step(state)
    log_a = mode_log_likelihood(state) + np.log(table.objectness)[:, None]
    log_null = np.log(table.objectness * state.noise.new_rate + (1 - table.objectness) * state.noise.clutter_rate)
    total, marginal = 0.0, np.zeros((3, 2))
    for choice in product([-1, 0, 1], repeat=3):
        used = [j for j in choice if j >= 0]
        if len(used) != len(set(used)):
            continue
        p = np.exp(sum(log_null[k] if j < 0 else log_a[k, j] for k, j in enumerate(choice)))
        total += p
        for k, j in enumerate(choice):
            if j >= 0:
                marginal[k, j] += p
    assert evidence == pytest.approx(np.log(total), abs=1e-9)
    np.testing.assert_allclose(weights, marginal / total, atol=1e-9)


def test_latent_update_is_the_weighted_mean() -> None:
    odometry = np.tile(np.eye(4), (3, 1, 1))
    latent, scale = np.array([[1.0], [2.0], [4.0]]), np.array([[0.5], [1.0], [2.0]])
    table = make_table([0, 1, 2], np.tile([0, 0, 5.0], (3, 1)), position_scale=0.1, latent=latent, latent_scale=scale)
    state = plain_init(SlamProblem(odometry, table), CONFIG, make_pose(np.eye(3), np.array([[0, 0, 5.0]])))
    _, weights, _ = e_step(state)
    after, _ = plain_solve(state, iterations=1)
    w = weights[:, 0] / scale[:, 0] ** 2
    assert after.latent[0, 0] == pytest.approx((w @ latent[:, 0]) / w.sum())
