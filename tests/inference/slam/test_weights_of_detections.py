"""Every detection counts once, however many landmarks it may be of, to the end of a run."""

from dataclasses import replace

import numpy as np

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve
from nolbo_ppl.inference.slam.map_refinement import fit_odometry
from nolbo_ppl.inference.slam.slam_state import SlamState


def test_weights_of_a_detection_sum_to_one_at_most() -> None:
    """Objects of one kind, close together: many detections have several candidates; odometry scales are found on the map."""
    rng = np.random.default_rng(0)
    drive = simulate_sequence(
        simulate_circuit(rng, laps=1, radius=12.0, frames_per_lap=40),
        rng,
        world=WorldConfig(objects=40, categories=1, latent_dim=0, minimum_spacing=0.6),
        detector=DetectorConfig(rotation_scale=None, position_scale=0.4, clutter_rate=0.5),
        odometry_rotation_scale=0.02,
    )
    state = solve(SlamProblem(drive.odometry, drive.observations), SlamConfig(hypotheses=1)).state
    loose = replace(state.noise, rotation_step=5 * state.noise.rotation_step, translation_step=5 * state.noise.translation_step)
    fitted = fit_odometry(replace(state, noise=loose))
    check(state, len(drive.observations))
    check(fitted, len(drive.observations))
    assert np.median(fitted.noise.rotation_step) < 0.7 * np.median(loose.rotation_step), "nothing was fitted"


def check(state: SlamState, detections: int) -> None:
    total = np.bincount(state.rows, state.weight, minlength=detections)
    assert len(state.rows) > len(np.unique(state.rows)), "no detection has several candidates: the test would see nothing"
    assert total.max() <= 1 + 1e-6
