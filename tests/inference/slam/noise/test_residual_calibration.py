"""Scales nobody stated against worlds whose errors are known: independent from frame to frame, or alike within a pass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.geometry.pose import inverse, transform
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve
from nolbo_ppl.inference.slam.noise.residual_calibration import (
    MIN_PASSES,
    UNSTATED_FACTOR,
    between_passes,
    calibrate,
    rows_of_several_passes,
)
from nolbo_ppl.inference.slam.slam_state import SlamState

FRAMES_PER_LAP = 40


def solved(bias: float) -> SlamState:
    """Two laps past 30 objects, no scale of a detection stated; `bias`: scale of each object's own error in a lap, m."""
    rng = np.random.default_rng(11)
    truth = simulate_circuit(rng, laps=2, radius=15.0, frames_per_lap=FRAMES_PER_LAP)
    drive = simulate_sequence(
        truth,
        rng,
        world=WorldConfig(objects=30, categories=10, latent_dim=4),
        detector=DetectorConfig(clutter_rate=0.1, position_scale=0.1, position_ratio=0.0),
        odometry_rotation_scale=0.002,
        odometry_translation_ratio=0.005,
    )
    table = drive.observations
    unknown = np.full(len(table), np.nan)
    of_pass = bias * rng.standard_normal((31, 2, 3))[drive.object_of, table.frame // FRAMES_PER_LAP]
    table = replace(
        table,
        position=table.position + of_pass,
        position_covariance=unknown[:, None, None] * np.eye(3),
        rotation_scale=unknown,
        latent_scale=unknown[:, None] * np.ones(4),
    )
    config = SlamConfig(odometry_rotation_scale=0.002, odometry_translation_ratio=0.005, hypotheses=1)
    return solve(SlamProblem(drive.odometry, table), config).state


@pytest.fixture(scope="module")
def independent() -> SlamState:
    return solved(0.0)


def test_independent_errors_cost_nothing_however_often_they_are_judged(independent: SlamState) -> None:
    """The prior of 4 and 16 gives way where passes of one object agree, and a factor in use is not counted again."""
    assert independent.noise.position_factor < 1.5
    assert independent.noise.rotation_factor < 2.5
    again = calibrate(calibrate(independent))
    assert again.noise.position_factor == pytest.approx(independent.noise.position_factor, rel=0.15)
    for factor in (1.0, 4.0):
        noise = replace(independent.noise, position_factor=factor, range_factor=factor, rotation_factor=factor)
        report = calibrate(replace(independent, noise=noise)).noise.report
        assert report["position_correlation_factor"] == pytest.approx(1.0, abs=0.35)
        assert report["rotation_correlation_factor"] == pytest.approx(1.0, abs=0.45)


def test_what_differs_between_passes_widens_positions(independent: SlamState) -> None:
    """Errors of s = 0.1 m a view and b = 0.15 m a pass: sums over n views are `1 + n b^2 / s^2` times as wide.

    Single residuals show half of b^2, since two passes share a landmark; the rest of the sums is the factor.
    """
    state = solved(0.15)
    views = len(state.rows) / (2 * len(state.static))
    expected = (1 + 2.25 * views) / (1 + 2.25 / 2)
    assert state.noise.position_factor > 2.5 * independent.noise.position_factor
    assert 0.4 * expected < state.noise.position_factor < 1.6 * expected
    assert state.noise.rotation_factor < 2.5  # orientations had none


def test_depth_and_directions_have_scales_of_their_own() -> None:
    """A camera's detections: 0.05 m across the ray, 0.25 m along it, nothing stated."""
    rng = np.random.default_rng(5)
    truth = simulate_circuit(rng, laps=1, radius=15.0, frames_per_lap=60)
    drive = simulate_sequence(
        truth,
        rng,
        world=WorldConfig(objects=30, categories=10, latent_dim=0),
        detector=DetectorConfig(clutter_rate=0.0, rotation_scale=None),
        odometry_rotation_scale=0.005,
        odometry_translation_ratio=0.01,
    )
    table = drive.observations
    assert drive.world is not None
    exact = transform(inverse(truth[table.frame]), drive.world.position[drive.object_of])
    ray = exact / np.linalg.norm(exact, axis=1, keepdims=True)
    noise = rng.standard_normal((len(table), 4))
    position = exact + 0.05 * noise[:, :3] + 0.25 * noise[:, 3:] * ray
    table = replace(table, position=position, position_covariance=np.full((len(table), 3, 3), np.nan))
    state = solve(SlamProblem(drive.odometry, table), SlamConfig(hypotheses=1)).state
    # Factors in use are taken off by direction: the answer does not depend on them.
    for across, along in ((1.0, 1.0), (2.0, 8.0)):
        noise = replace(state.noise, position_factor=across, range_factor=along)
        again = calibrate(replace(state, noise=noise)).noise.position_covariance
        check_ray_scales(again, position)
    check_ray_scales(state.noise.position_covariance, position)


def check_ray_scales(covariance: np.ndarray, position: np.ndarray) -> None:
    seen = position / np.linalg.norm(position, axis=1, keepdims=True)
    along = np.einsum("ni,nij,nj->n", seen, covariance, seen)
    across = (np.trace(covariance, axis1=1, axis2=2) - along) / 2
    assert np.sqrt(np.median(along)) == pytest.approx(np.hypot(0.25, 0.05), rel=0.3)
    assert np.sqrt(np.median(across)) == pytest.approx(0.05, rel=0.3)


def test_rows_of_several_passes(independent: SlamState) -> None:
    rows = np.arange(len(independent.rows))
    several = rows_of_several_passes(independent, rows)
    for j in range(0, len(independent.static), 5):
        mine = (independent.landmark == j) & (independent.weight > 0.5)
        tracks = {int(t) for t in independent.tracklets.of_observation[independent.rows[mine]] if t >= 0}
        assert set(several[independent.landmark == j].tolist()) <= {len(tracks) >= 2}


def test_passes_outweigh_the_prior_as_they_grow_in_number() -> None:
    """The mean of two Gaussians in the log, by numerical integration of their product."""
    grid = np.linspace(-6, 8, 20001)
    for passes, measured in ((8, 2.0), (40, 1.3), (12, 9.0)):
        density = np.exp(-0.5 * 1.5 * passes * (grid - np.log(measured)) ** 2 - 0.5 * 1.2 * (grid - np.log(UNSTATED_FACTOR)) ** 2)
        mean = np.trapezoid(grid * density, grid) / np.trapezoid(density, grid)
        assert between_passes(UNSTATED_FACTOR, measured, passes) == pytest.approx(np.exp(mean), rel=1e-6)
    assert between_passes(UNSTATED_FACTOR, 9.0, MIN_PASSES - 1) == pytest.approx(UNSTATED_FACTOR)
