"""Orientations with several modes: densities, responsibilities and split factors against brute force."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.geometry.pose import make_pose, rotation_angle, so3_exp
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve
from nolbo_ppl.inference.slam.detection_features import fit_prior
from nolbo_ppl.inference.slam.graph import SlamEstimate, add_observation_factors, resolve_observations, to_values
from nolbo_ppl.inference.slam.map_files import association_table
from nolbo_ppl.inference.slam.measurements import resolve
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.orientation import (
    OrientationModes,
    mixture_log_density,
    observed_modes,
    resolve_modes,
    vertical_turns,
)
from nolbo_ppl.io.observations import Detections
from nolbo_ppl.metrics.association import landmark_to_object

CONFIG = SlamConfig(odometry_rotation_scale=0.01, odometry_translation_ratio=0.01)
Z = np.array([0.0, 0.0, 1.0])


def random_modes(rng: np.random.Generator, n: int, count: int) -> OrientationModes:
    weight = rng.dirichlet(np.ones(count), n)
    weight[0, 1:] = 0.0  # a row with one mode alone
    with np.errstate(divide="ignore"):
        return OrientationModes(
            np.log(weight / weight.sum(axis=1, keepdims=True)),
            so3_exp(rng.standard_normal((n, count, 3))),
            0.2 + rng.random((n, count)),
        )


def mass_on_the_group(scale: float) -> float:
    """Integral of exp(-angle^2 / 2 scale^2) over SO(3) of volume 8 pi^2: the angle's density is proportional to 1 - cos."""
    return quad(lambda angle: 8 * np.pi * np.exp(-0.5 * (angle / scale) ** 2) * (1 - np.cos(angle)), 0, np.pi)[0]


def brute_parts(predicted: np.ndarray, modes: OrientationModes, row: int, order: int) -> list[tuple[float, np.ndarray]]:
    """Every (density, rotation) of the mixture, the uniform part last; rotation vectors by scipy."""
    parts = []
    for k in range(modes.log_weight.shape[1]):
        weight, R, s = np.exp(modes.log_weight[row, k]), modes.R[row, k], modes.scale[row, k]
        flips = (
            [(g, (1 - CONFIG.flip_probability) / order) for g in range(order)]
            if order % 2
            else [(g, 1 / order) for g in range(order)]
        )
        turns = [(2 * np.pi * g / order, share) for g, share in flips]
        if order % 2:
            turns += [(2 * np.pi * g / order + np.pi, CONFIG.flip_probability / order) for g in range(order)]
        for angle, share in turns:
            candidate = R @ Rotation.from_rotvec(angle * Z).as_matrix()
            error = Rotation.from_matrix(predicted.T @ candidate).magnitude()
            density = np.exp(-0.5 * error**2 / s**2) / mass_on_the_group(s)
            parts.append(((1 - CONFIG.orientation_outlier) * weight * share * density, candidate))
    parts.append((CONFIG.orientation_outlier / (8 * np.pi**2), predicted))
    return parts


@pytest.mark.parametrize("order", [0, 1, 3])
@pytest.mark.parametrize("scale", [0.1, 0.5, 1.0, 2.0, 30.0])
def test_densities_have_mass_one_over_so3(order: int, scale: float) -> None:
    """Monte Carlo over the Haar measure; importance samples where the density is narrow."""
    rng = np.random.default_rng(1)
    n = 40000
    modes = OrientationModes(np.zeros((n, 1)), np.tile(np.eye(3), (n, 1, 1, 1)), np.full((n, 1), scale))
    R = Rotation.random(n, rng=rng).as_matrix()
    value = np.exp(mixture_log_density(R, modes, np.full(n, order), CONFIG)) * 8 * np.pi**2
    assert abs(value.mean() - 1) < 5 * value.std() / np.sqrt(n)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_density_and_responsibilities_equal_enumeration(order: int) -> None:
    rng = np.random.default_rng(order)
    n, count = 6, 3
    modes, predicted = random_modes(rng, n, count), so3_exp(rng.standard_normal((n, 3)))
    symmetry = np.full(n, order)
    density = mixture_log_density(predicted, modes, symmetry, CONFIG)
    resolved = resolve_modes(predicted, modes, symmetry, CONFIG, minimum=0.0)
    for i in range(n):
        parts = brute_parts(predicted[i], modes, i, order)
        total = sum(p for p, _ in parts)
        assert density[i] == pytest.approx(np.log(total), abs=1e-5)
        rows = np.flatnonzero(resolved.row == i)
        assert resolved.responsibility[rows].sum() == pytest.approx(1.0)
        for p, R in parts:
            if p / total < 1e-12 or len(rows) == 1:
                continue
            match = rows[np.abs(resolved.R[rows] - R).max(axis=(1, 2)) < 1e-9]
            assert resolved.responsibility[match].sum() == pytest.approx(p / total, abs=1e-5)


def test_a_free_axis_ignores_the_azimuth() -> None:
    rng = np.random.default_rng(0)
    modes = random_modes(rng, 4, 2)
    predicted = so3_exp(rng.standard_normal((4, 3)))
    free = np.zeros(4, dtype=int)
    value = mixture_log_density(predicted, modes, free, CONFIG)
    turned = OrientationModes(modes.log_weight, modes.R @ so3_exp(rng.uniform(-3, 3, (4, 2, 1)) * Z), modes.scale)
    np.testing.assert_allclose(mixture_log_density(predicted, turned, free, CONFIG), value, atol=1e-9)


def test_a_sure_mode_stands_alone_and_padding_says_nothing() -> None:
    R = np.stack([np.eye(3), so3_exp(1.5 * Z)])[None]
    with np.errstate(divide="ignore"):
        modes = OrientationModes(np.log([[1.0, 0.0]]), R, np.full((1, 2), 0.1))
    resolved = resolve_modes(np.eye(3)[None], modes, np.ones(1, int), CONFIG)
    assert len(resolved.row) == 1 and resolved.responsibility[0] == 1.0
    alone = OrientationModes(np.zeros((1, 1)), R[:, :1], np.full((1, 1), 0.1))
    np.testing.assert_allclose(
        mixture_log_density(np.eye(3)[None], modes, np.ones(1, int), CONFIG),
        mixture_log_density(np.eye(3)[None], alone, np.ones(1, int), CONFIG),
    )


def test_gradient_of_the_split_factor_is_that_of_the_mixture() -> None:
    """EM's identity: the M-step's quadratic, split by responsibilities, touches minus the log density of the mixture."""
    modes = np.stack([np.eye(3), so3_exp(0.5 * Z)])
    table = Detections.from_arrays(
        [0], [[0.0, 0.0, 5.0]], position_scale=1.0, mode_weight=[[0.6, 0.4]], mode_rotation=modes[None], mode_std=[[0.3, 0.3]]
    )
    problem = SlamProblem(np.eye(4)[None], table)
    noise = estimate_noise(problem, CONFIG)
    T = make_pose(so3_exp(0.2 * Z), np.array([0.0, 0.0, 5.0]))
    estimate, zero = SlamEstimate(np.eye(4)[None], T[None]), np.zeros(1, int)
    measurements = resolve(table, noise, CONFIG, fit_prior(table, CONFIG, noise))
    factors = resolve_observations(measurements, noise, CONFIG, estimate, zero, zero, np.ones(1))
    assert len(factors.weight) >= 2 and factors.weight.sum() == pytest.approx(1.0)

    def quadratic(angle: float) -> float:
        graph = gtsam.NonlinearFactorGraph()
        add_observation_factors(graph, factors)
        return graph.error(to_values(SlamEstimate(np.eye(4)[None], make_pose(so3_exp(angle * Z), T[:3, 3])[None])))

    def mixture(angle: float) -> float:
        seen = observed_modes(table, noise.rotation_scale)
        return -float(mixture_log_density(so3_exp(angle * Z)[None], seen, np.ones(1, int), CONFIG)[0])

    h = 1e-5
    slopes = [(f(0.2 + h) - f(0.2 - h)) / (2 * h) for f in (quadratic, mixture)]
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-2)


def test_scales_of_modes_follow_a_correction() -> None:
    table = Detections.from_arrays(
        [0], [[0, 0, 5.0]], mode_weight=[[0.6, 0.4]], mode_rotation=np.tile(np.eye(3), (1, 2, 1, 1)), mode_std=[[0.1, 0.2]]
    )
    np.testing.assert_allclose(observed_modes(table, np.array([0.3])).scale, [[0.3, 0.6]])


def test_stated_modes_find_orientations_the_best_mode_misses() -> None:
    """A detector whose best mode is a quarter turn off in 45 of 100 detections, and says so."""
    rng = np.random.default_rng(3)
    truth = simulate_circuit(rng, laps=1, frames_per_lap=60)
    drive = simulate_sequence(
        truth,
        rng,
        world=WorldConfig(objects=20, categories=3, latent_dim=4),
        odometry_rotation_scale=0.01,
        detector=DetectorConfig(flip_rate=0.0),
    )
    table = drive.observations
    n = len(table)
    quarter = so3_exp(np.pi / 2 * rng.choice([-1.0, 1.0], n)[:, None] * Z)
    other = table.rotation @ quarter
    wrong = rng.random(n) < 0.45
    best = np.where(wrong[:, None, None], other, table.rotation)
    second = np.where(wrong[:, None, None], table.rotation, other)
    weight = np.tile([0.55, 0.45], (n, 1))
    alone = replace(table, rotation=best)
    modes = replace(
        alone,
        mode_weight=weight,
        mode_rotation=np.stack([best, second], axis=1),
        mode_std=np.repeat(table.rotation_scale[:, None], 2, axis=1),
    )
    assert drive.world is not None
    right = []
    for observations in (alone, modes):
        result = solve(SlamProblem(drive.odometry, observations), CONFIG)
        owner, _ = landmark_to_object(drive.object_of, association_table(result).landmark_of, len(result.landmarks))
        error = [
            rotation_angle(drive.world.rotation[o].T @ result.landmarks[j].T_world_object[:3, :3])
            for j, o in enumerate(owner)
            if o >= 0
        ]
        right.append(np.mean(np.array(error) < 0.5))
    assert right[1] > 0.85 and right[1] > right[0] + 0.05, right


def test_turns_of_the_group() -> None:
    assert len(vertical_turns(1)) == 2 and len(vertical_turns(2)) == 2 and len(vertical_turns(3)) == 6
