"""Evidence of the odometry's scales and residuals beside what the model expects, against dense linear algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve_with_associations
from nolbo_ppl.inference.slam.linearisation import linearise
from nolbo_ppl.inference.slam.noise.fitted_residuals import block_ratio, fitted_residuals, halves_of_tracks, whole_graph
from nolbo_ppl.inference.slam.noise.odometry_noise import refine_odometry
from nolbo_ppl.inference.slam.noise.scale_evidence import BIAS_RATIO, BIAS_ROTATION, scale_evidence, scale_posterior
from nolbo_ppl.inference.slam.slam_state import SlamState


def solved(seed: int = 0, frames: int = 40, rotation: float = 0.01, config: SlamConfig | None = None) -> SlamState:
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=1, radius=12.0, frames_per_lap=frames)
    world = simulate_sequence(
        truth,
        rng,
        world=WorldConfig(objects=30, categories=4, latent_dim=0),
        detector=DetectorConfig(clutter_rate=0.0, position_scale=0.02, position_ratio=0.002, rotation_scale=None),
        odometry_rotation_scale=rotation,
        odometry_translation_ratio=0.02,
    )
    config = config or SlamConfig(odometry_rotation_scale=rotation, odometry_translation_ratio=0.02)
    return solve_with_associations(SlamProblem(world.odometry, world.observations), world.object_of, config)


@pytest.fixture(scope="module")
def state() -> SlamState:
    return solved(frames=20)


def test_expected_residuals_are_one_less_the_leverage(state: SlamState) -> None:
    linearisation = linearise(whole_graph(state)[0], state.estimate)
    J = linearisation.jacobian.toarray()
    q, _ = np.linalg.qr(J)
    exact = 1 - np.sum(q**2, axis=1)
    count = 4000
    sampled = np.mean(linearisation.residual_samples(count, np.random.default_rng(0)) ** 2, axis=1)
    assert (np.abs(sampled - exact) < 5.5 * np.maximum(exact, 1e-9) * np.sqrt(2 / count) + 1e-9).all()
    # And the residual that is kept is the graph's own: its error is half its square.
    graph = whole_graph(state)[0]
    from nolbo_ppl.inference.slam.graph import to_values

    assert 0.5 * linearisation.residual @ linearisation.residual == pytest.approx(
        graph.error(to_values(state.estimate)), rel=1e-9
    )


def test_evidence_equals_dense_algebra(state: SlamState) -> None:
    """Differences of the evidence by QR of the scaled rows, with the columns of the bias written out."""
    linearisation = linearise(whole_graph(state)[0], state.estimate)
    J, r = linearisation.jacobian.toarray(), linearisation.residual
    steps = len(state.problem) - 1
    length = np.linalg.norm(np.diff(state.problem.odometry[:, :3, 3], axis=0), axis=1)
    bias = np.zeros((len(r) + 6, 6))
    for i in range(steps):
        for c in range(3):
            bias[6 + 6 * i + c, c] = -1 / state.noise.rotation_step[i]
            bias[9 + 6 * i + c, 3 + c] = -length[i] / state.noise.translation_step[i]
    for c in range(3):
        bias[len(r) + c, c] = 1 / (BIAS_ROTATION * np.median(state.noise.rotation_step))
        bias[len(r) + 3 + c, 3 + c] = 1 / BIAS_RATIO
    whole = np.hstack([np.vstack([J, np.zeros((6, J.shape[1]))]), bias])
    right = np.concatenate([r, np.zeros(6)])

    def dense(a: float, b: float) -> float:
        weight = np.ones(len(right))
        for i in range(steps):
            weight[6 + 6 * i : 9 + 6 * i], weight[9 + 6 * i : 12 + 6 * i] = 1 / a, 1 / b
        A, y = whole * weight[:, None], right * weight
        residual = y - A @ np.linalg.lstsq(A, y, rcond=None)[0]
        return float(-0.5 * residual @ residual - np.log(np.linalg.svd(A, compute_uv=False)).sum() - 3 * steps * np.log(a * b))

    evidence = scale_evidence(state)
    for a, b in ((0.25, 1.0), (4.0, 1.0), (1.0, 16.0), (0.1, 30.0)):
        found = evidence.solve(a, b)[0] - evidence.solve(1.0, 1.0)[0]
        assert found == pytest.approx(dense(a, b) - dense(1.0, 1.0), abs=1e-4)


@pytest.mark.parametrize("rotation", [0.0005, 0.03])
def test_scales_are_found_from_far(rotation: float) -> None:
    """True scales an eighth and 7.5 times the assumed ones; the posterior's mean is within its own spread and the grid's."""
    state = solved(1, 60, rotation, SlamConfig(odometry_rotation_scale=0.004, odometry_translation_ratio=0.02))
    grid = np.log(2.0) * np.arange(-6, 7)
    found = scale_posterior(scale_evidence(state), (True, False), grid=grid)
    assert abs(found.mean[0] - np.log(rotation / 0.004)) < 3 * np.hypot(found.deviation[0], 0.35)
    assert found.mean[1] == 0 and found.over_one > 3


def test_refinement_moves_scales_both_ways() -> None:
    from nolbo_ppl.inference.slam.initialise import linearise_state

    for stated, direction in ((0.002, 1), (0.05, -1)):
        state = solved(2, 60, 0.01, SlamConfig(odometry_rotation_scale=stated, odometry_translation_ratio=0.02))
        free = replace(state, config=SlamConfig(odometry_translation_ratio=0.02))
        moved = refine_odometry(free, linearise_state(free)).noise.rotation_step[0]
        assert direction * (np.log(moved) - np.log(stated)) > 0.2
        kept = refine_odometry(state, linearise_state(state)).noise
        assert kept.rotation_step[0] == stated or direction > 0  # a stated scale is never made smaller
        assert any("odometry rotation" in w for w in kept.warnings) == (direction > 0)


def test_correlated_errors_show_in_halves_of_tracks() -> None:
    rng = np.random.default_rng(0)
    track, frame = np.repeat(np.arange(200), 8), np.tile(np.arange(8), 200)
    block = halves_of_tracks(track, frame)
    assert len(np.unique(block)) == 400 and (np.bincount(block) == 4).all()
    expected = rng.standard_normal((1600, 3, 64))
    white = rng.standard_normal((1600, 3))
    ratio, count = block_ratio(white, expected, block)
    assert count == 400 and abs(ratio - 1) < 5 * np.sqrt(2 / (3 * 400))
    slow = rng.standard_normal((400, 3))[block]
    assert block_ratio(np.sqrt(0.5) * (white + slow), expected, block)[0] == pytest.approx(0.5 + 0.5 * 4, rel=0.25)


def test_residuals_of_a_right_model_have_unit_width() -> None:
    state = solved(3, 60)
    found = fitted_residuals(state, np.random.default_rng(0))
    position = found.observation[:, 3:]
    told = np.mean(found.observation_expected[:, 3:] ** 2, axis=2)
    assert abs(np.sum(position**2) / np.sum(told) - 1) < 5 * np.sqrt(2 / np.sum(told))
    assert not found.observation[:, :3].any()  # nobody observed an orientation


def test_understated_odometry_is_reported_and_raised() -> None:
    """Scales stated 20 times too small: found within a factor of two, said, and left alone where nothing is to be corrected."""
    from nolbo_ppl.inference.slam.noise.odometry_noise import raise_stated

    right = SlamConfig(odometry_rotation_scale=0.02, odometry_translation_ratio=0.02)
    state = solved(4, 60, 0.02, right)
    assert raise_stated(state, (True, True)).noise.warnings == state.noise.warnings
    wrong = SlamConfig(odometry_rotation_scale=0.001, odometry_translation_ratio=0.02)
    state = solved(4, 60, 0.02, wrong)
    raised = raise_stated(state, (True, True)).noise
    assert any("odometry rotation scale is too small" in w for w in raised.warnings)
    assert 0.5 < raised.rotation_step[0] / 0.02 < 2
    only_said = raise_stated(replace(state, config=replace(wrong, correct_scales=False)), (True, True)).noise
    assert only_said.rotation_step[0] == 0.001 and only_said.warnings == raised.warnings
