"""Runs that compete: odometry that detections contradict is kept where the whole map speaks for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import nolbo_ppl
from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.slam.hypotheses import start_of_run, with_odometry_kept
from nolbo_ppl.inference.slam.initialise import SlamState, init
from nolbo_ppl.inference.slam.noise.odometry_noise import LEFT_BEHIND
from nolbo_ppl.metrics.trajectory import trajectory_errors


@pytest.mark.parametrize("stated", [{}, {"odometry_translation_scale": 0.02, "odometry_rotation_scale": 0.004}])
def test_objects_of_misjudged_size_do_not_bend_the_odometry(stated: dict[str, float]) -> None:
    """Every object is seen nearer or farther than it is by a factor of its own, of which the stated covariances know nothing."""
    rng = np.random.default_rng(3)
    drive = simulate_sequence(simulate_circuit(rng, frames_per_lap=100), rng, world=WorldConfig(objects=40))
    factor = np.exp(rng.normal(0.0, 0.3, drive.object_of.max() + 2))[drive.object_of]
    seen = replace(drive.observations, position=drive.observations.position * factor[:, None])
    before = trajectory_errors(drive.odometry, drive.truth)["ate"]
    result = nolbo_ppl.solve(nolbo_ppl.SlamProblem(drive.odometry, seen), nolbo_ppl.SlamConfig(hypotheses=1, **stated))
    after = trajectory_errors(result.T_world_camera, drive.truth)["ate"]
    assert before > 1.5
    assert after < 0.4 * before  # 0.82 of it without the rival, where no scale is stated
    told = [text for text in result.state.noise.warnings if "more probable with the odometry kept" in text]
    assert len(told) == result.state.odometry_kept


def test_a_rival_keeps_what_was_said() -> None:
    rng = np.random.default_rng(0)
    drive = simulate_sequence(simulate_circuit(rng, frames_per_lap=40), rng, world=WorldConfig(objects=15))
    config = nolbo_ppl.SlamConfig(odometry_translation_scale=0.05, odometry_rotation_scale=0.01)
    start = init(nolbo_ppl.SlamProblem(drive.odometry, drive.observations), config)

    def loosened(factor: float) -> SlamState:
        return replace(start, noise=replace(start.noise, translation_step=start.noise.translation_step * factor))

    assert with_odometry_kept(start, loosened(0.99 * LEFT_BEHIND)) is None
    rival = with_odometry_kept(loosened(7.0), loosened(1.01 * LEFT_BEHIND))
    assert rival is not None and rival.odometry_kept
    np.testing.assert_allclose(rival.noise.translation_step, 0.05)
    np.testing.assert_allclose(rival.noise.rotation_step, 0.01)
    unknown = replace(rival, config=nolbo_ppl.SlamConfig())  # further runs keep it too, where nobody stated the scales
    np.testing.assert_allclose(start_of_run(unknown, 1).noise.translation_step, 0.05)
    assert (start_of_run(replace(unknown, odometry_kept=False), 1).noise.translation_step > 0.1).all()
    assert rival.noise.report["odometry_translation_scale"] == pytest.approx(0.05)
