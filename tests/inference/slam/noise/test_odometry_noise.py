"""The odometry's scales in the answer: a word where the map leaves the odometry altogether."""

from __future__ import annotations

import numpy as np
import pytest

import nolbo_ppl
from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.geometry.pose import inverse, make_pose


def solved(error: float, stated: float | None = None) -> nolbo_ppl.SlamResult:
    """A small drive whose odometry errs by so many metres a step beside its own error."""
    rng = np.random.default_rng(3)
    drive = simulate_sequence(simulate_circuit(rng, frames_per_lap=150), rng, world=WorldConfig(objects=40))
    step = inverse(drive.odometry[:-1]) @ drive.odometry[1:]
    shift = rng.normal(0.0, 1.0, (len(step), 3)) * error
    step = step @ make_pose(np.tile(np.eye(3), (len(step), 1, 1)), shift)
    odometry = [drive.odometry[0]]
    for one in step:
        odometry.append(odometry[-1] @ one)
    config = nolbo_ppl.SlamConfig(hypotheses=1, odometry_translation_scale=stated)
    return nolbo_ppl.solve(nolbo_ppl.SlamProblem(np.array(odometry), drive.observations), config)


@pytest.mark.parametrize("stated", [None, 0.02])
def test_odometry_that_is_lost_is_told_of(stated: float | None) -> None:
    """Whether its scale is guessed or a stated one is raised: the warning names the scale that the map was made with."""
    good, lost = solved(0.0), solved(2.5, stated)
    assert not [text for text in good.state.noise.warnings if "contradict the odometry" in text]
    (told,) = [text for text in lost.state.noise.warnings if "contradict the odometry" in text]
    scale = float(np.median(lost.state.noise.translation_step))
    assert f"err by {scale:.3g} m" in told
    assert 1.5 < scale < 4.0
