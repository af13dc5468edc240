"""The plain EM: its bound never falls, equals brute force, and its log density is GTSAM's."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import gtsam
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal, norm

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.geometry.pose import make_pose, relative, se3_exp, se3_log, so3_exp
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, em_init, em_solve
from nolbo_ppl.inference.slam.reference_em import ReferenceEmState, e_step
from nolbo_ppl.io.observations import Detections

CONFIG = SlamConfig(odometry_rotation_scale=0.004, odometry_translation_ratio=0.01)


def small(seed: int, latent_dim: int = 4, rotation: float | None = 0.05) -> ReferenceEmState:
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=1, frames_per_lap=40)
    drive = simulate_sequence(
        truth,
        rng,
        world=WorldConfig(objects=10, categories=2, latent_dim=latent_dim),
        odometry_rotation_scale=0.004,
        detector=DetectorConfig(flip_rate=0.2, rotation_scale=rotation, clutter_rate=0.3),
    )
    assert drive.world is not None
    start = drive.world.position + rng.standard_normal(drive.world.position.shape)
    return em_init(SlamProblem(drive.odometry, drive.observations), CONFIG, make_pose(drive.world.rotation, start))


@pytest.mark.parametrize(("seed", "latent_dim", "rotation"), [(0, 4, 0.05), (1, 0, 0.05), (2, 0, None), (3, 3, None)])
def test_the_bound_never_falls(seed: int, latent_dim: int, rotation: float | None) -> None:
    _, infos = em_solve(small(seed, latent_dim, rotation), iterations=8, tolerance=-np.inf)
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
    start = em_init(problem, CONFIG, state.estimate.T_world_landmark, noise=state.noise)
    _, infos = em_solve(start, iterations=8, tolerance=-np.inf)
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


def sphere_mass(scale: float) -> float:
    """Integral of exp(-tilt^2 / 2 scale^2) over the unit sphere."""
    return quad(lambda t: 2 * np.pi * np.sin(t) * np.exp(-0.5 * (t / scale) ** 2), 0, np.pi)[0]


def group_mass(scale: float) -> float:
    """Integral of exp(-angle^2 / 2 scale^2) over SO(3), whose volume is 8 pi^2 here."""
    return quad(lambda t: 8 * np.pi * (1 - np.cos(t)) * np.exp(-0.5 * (t / scale) ** 2), 0, np.pi)[0]


def test_evidence_and_weights_equal_enumeration() -> None:
    """One frame with an oriented, a free, a 2-fold and two plain detections, two latents missing: the whole generative
    model written out, every hypothesis a density of position, rotation and latent; nothing of the library is used."""
    uniform, outlier, flip = 1 / (8 * np.pi**2), 0.05, 0.03
    pose = Rotation.from_rotvec([0.2, -0.5, 0.1])
    T = make_pose(pose.as_matrix(), np.array([1.0, -2.0, 0.5]))
    true = Rotation.from_rotvec([[0.1, 0.2, 0.3], [0.0, 1.0, 0.0], [2.0, 0.3, 0.0]])
    landmarks = make_pose(true.as_matrix(), T[:3, 3] + pose.apply([[0.2, 0.0, 5.0], [0.9, 0.1, 6.1], [-0.3, 0.4, 5.6]]))
    position = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 6.0], [0.5, 0.2, 5.5], [0.3, 0.1, 5.4], [-0.2, 0.3, 5.7]])
    noise = Rotation.from_rotvec([[0.05, 0.0, 0.2], [0.1, -0.1, 2.0], [0.0, 0.1, 3.1]])
    rotation = np.full((5, 3, 3), np.nan)
    rotation[:3] = (pose.inv() * true[[0, 1, 1]] * noise).as_matrix()
    symmetry, rotation_scale, q = [1, 0, 2, 1, 1], [0.1, 0.2, 1.5, np.nan, np.nan], [0.9, 0.6, 0.3, 0.8, 0.5]
    latent, spread = np.array([[0.3], [np.nan], [1.5], [-0.5], [np.nan]]), 0.4
    table = Detections.from_arrays(
        np.zeros(5, int),
        position,
        position_scale=0.5,
        rotation=rotation,
        rotation_scale=rotation_scale,
        symmetry=symmetry,
        latent=latent,
        latent_scale=spread,
        objectness=q,
    )
    config = replace(CONFIG, birth_intensity=0.02, clutter_intensity=0.05, objectness_prior=0.7, correct_scales=False)
    mapped = np.array([[0.5], [1.0], [-1.0]])
    state = em_init(SlamProblem(T[None], table), config, landmarks, mapped)
    _, weights, evidence = e_step(state)
    finite = latent[np.isfinite(latent)]
    population = norm(finite.mean(), np.sqrt(max(finite.var() - spread**2, 1e-12) + spread**2))

    def rotation_density(k: int, j: int) -> float:
        if k > 2:
            return uniform  # none is observed: any will do, as for every other hypothesis
        predicted = pose.inv() * true[j]
        observed, s = Rotation.from_matrix(rotation[k]), rotation_scale[k]
        if symmetry[k] == 0:
            tilt = np.arccos(np.clip(observed.apply([0, 0, 1]) @ predicted.apply([0, 0, 1]), -1, 1))
            informed = np.exp(-0.5 * (tilt / s) ** 2) / sphere_mass(s) / (2 * np.pi)
        else:
            shares = {1: [(0.0, 1 - flip), (np.pi, flip)], 2: [(0.0, 0.5), (np.pi, 0.5)]}[symmetry[k]]
            angles = [((observed * Rotation.from_rotvec([0, 0, a])).inv() * predicted).magnitude() for a, _ in shares]
            informed = sum(p * np.exp(-0.5 * (t / s) ** 2) / group_mass(s) for t, (_, p) in zip(angles, shares))
        return (1 - outlier) * informed + outlier * uniform

    def density(k: int, j: int) -> float:
        local = pose.inv().apply(landmarks[j, :3, 3] - T[:3, 3])
        value = multivariate_normal(local, 0.25 * np.eye(3)).pdf(position[k]) * rotation_density(k, j)
        return value * (norm(mapped[j, 0], spread).pdf(latent[k, 0]) if np.isfinite(latent[k, 0]) else 1.0)

    def anywhere(k: int) -> float:
        return uniform * (population.pdf(latent[k, 0]) if np.isfinite(latent[k, 0]) else 1.0)

    total, nothing, marginal = 0.0, 1.0, np.zeros((5, 3))
    for k in range(5):
        nothing *= anywhere(k)
    for choice in product([-1, 0, 1, 2], repeat=5):
        used = [j for j in choice if j >= 0]
        if len(used) != len(set(used)):
            continue
        p = 1.0
        for k, j in enumerate(choice):
            score_true, score_false = q[k] / 0.7, (1 - q[k]) / 0.3
            p *= score_true * density(k, j) if j >= 0 else (score_true * 0.02 + score_false * 0.05) * anywhere(k)
        total += p
        for k, j in enumerate(choice):
            if j >= 0:
                marginal[k, j] += p
    np.testing.assert_allclose(weights, marginal / total, atol=1e-5)
    assert evidence == pytest.approx(np.log(total / nothing), abs=1e-4)


@pytest.mark.parametrize(("scale", "weight"), [(0.05, 0.9995), (3.0, 0.9995), (None, 0.9995)])
def test_an_orientation_that_says_nothing_costs_nothing(scale: float | None, weight: float) -> None:
    """One detection exactly on a landmark: the position alone gives odds of 2e3, with or without an orientation."""
    rotation = None if scale is None else np.eye(3)[None]
    table = Detections.from_arrays(
        [0], [[0.0, 0.0, 5.0]], position_scale=0.3, rotation=rotation, rotation_scale=scale, objectness=[0.9]
    )
    config = replace(CONFIG, birth_intensity=1e-3, clutter_intensity=1e-3, objectness_prior=0.5)
    state = em_init(SlamProblem(np.eye(4)[None], table), config, make_pose(np.eye(3), np.array([[0, 0, 5.0]])))
    assert e_step(state)[1][0, 0] > 0.99 * weight


@pytest.mark.parametrize("symmetry", [0, 2])
def test_the_bound_never_falls_with_symmetry(symmetry: int) -> None:
    state = small(5)
    table = replace(state.problem.observations, symmetry=np.full(len(state.measurements), symmetry))
    table.rotation[::3] = np.nan  # some without an orientation, under landmarks that have one
    start = em_init(SlamProblem(state.problem.odometry, table), CONFIG, state.estimate.T_world_landmark)
    _, infos = em_solve(start, iterations=5, tolerance=-np.inf)
    bounds = np.array([info.bound for info in infos])
    assert bounds[-1] > bounds[0] + 0.5
    assert np.diff(bounds).min() > -1e-6 * np.abs(bounds).max()


def test_latent_update_is_the_weighted_mean() -> None:
    odometry = np.tile(np.eye(4), (3, 1, 1))
    latent, scale = np.array([[1.0], [2.0], [4.0]]), np.array([[0.5], [1.0], [2.0]])
    table = Detections.from_arrays([0, 1, 2], np.tile([0, 0, 5.0], (3, 1)), position_scale=0.1, latent=latent, latent_scale=scale)
    state = em_init(SlamProblem(odometry, table), CONFIG, make_pose(np.eye(3), np.array([[0, 0, 5.0]])))
    _, weights, _ = e_step(state)
    after, _ = em_solve(state, iterations=1)
    w = weights[:, 0] / scale[:, 0] ** 2
    assert after.latent[0, 0] == pytest.approx((w @ latent[:, 0]) / w.sum())
