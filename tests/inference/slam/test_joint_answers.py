"""Joint covariances and the log evidence of settings."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from nolbo_ppl.data.simulate import DetectorConfig, SimulatedSequence, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve


def settings(scale: float) -> SlamConfig:
    return SlamConfig(odometry_rotation_scale=scale, odometry_translation_ratio=0.01, correct_scales=False, hypotheses=1)


@pytest.fixture(scope="module")
def solved() -> tuple[SimulatedSequence, SlamResult]:
    rng = np.random.default_rng(0)
    truth = simulate_circuit(rng, radius=18.0, frames_per_lap=25)
    world, detector = WorldConfig(objects=12, categories=4, latent_dim=4), DetectorConfig(clutter_rate=0.0)
    drive = simulate_sequence(truth, rng, world=world, detector=detector, odometry_rotation_scale=0.01)
    return drive, solve(SlamProblem(drive.odometry, drive.observations), settings(0.01))


def test_joint_covariance_is_that_of_gtsam(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    _, result = solved
    found = result.joint_covariance(np.array([7]), np.array([0, 3]))
    marginals = gtsam.Marginals(result.graph, result.values)
    keys = [gtsam.symbol("x", 7), gtsam.symbol("l", 0), gtsam.symbol("l", 3)]
    joint = marginals.jointMarginalCovariance(gtsam.KeyVector(keys))
    for i, a in enumerate(keys):
        for j, b in enumerate(keys):
            np.testing.assert_allclose(found[i, :, j], joint.at(a, b), rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(found[1, :, 1], result.landmark_covariances()[0], rtol=1e-6, atol=1e-12)
    assert np.abs(found[1, 3:, 2, 3:]).max() > 1e-4  # drift is shared
    for bad in ((np.array([99]), np.array([0])), (np.array([0]), np.array([-1]))):
        with pytest.raises(InputError, match="no such"):
            result.joint_covariance(*bad)


def test_evidence_prefers_the_scale_the_odometry_has(solved: tuple[SimulatedSequence, SlamResult]) -> None:
    drive, result = solved
    problem = SlamProblem(drive.odometry, drive.observations)
    for wrong in (0.001, 0.1):
        assert solve(problem, settings(wrong)).log_evidence < result.log_evidence - 3.0
    assert result.log_evidence == pytest.approx(result.hypotheses[0].log_evidence)
