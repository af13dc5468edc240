"""A camera circles one object: it lies at one place of the image all the time, which is no evidence of false detections."""

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import chain, inverse, make_pose, relative, se3_exp, transform
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve, solve_incremental
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error
from nolbo_ppl.structures.detections import Detections


def circled(seed: int, frames: int = 90) -> tuple[SlamProblem, np.ndarray]:
    """Two rounds at 4 m of one object; steps with 0.01 rad and 0.02 m of noise, detections with 0.05 m."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 4 * np.pi, frames, endpoint=False)
    centre = 4 * np.stack([np.cos(angle), np.zeros(frames), np.sin(angle)], axis=1)
    ahead, down = -centre / 4, np.tile([0.0, 1.0, 0.0], (frames, 1))
    truth = make_pose(np.stack([np.cross(down, ahead), down, ahead], axis=-1), centre)
    scale = np.repeat([0.01, 0.02], 3)
    odometry = chain(truth[0], relative(truth[:-1], truth[1:]) @ se3_exp(scale * rng.standard_normal((frames - 1, 6))))
    position = transform(inverse(truth), np.zeros((frames, 3))) + 0.05 * rng.standard_normal((frames, 3))
    return SlamProblem(odometry, Detections.from_arrays(np.arange(frames), position)), truth


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    "stated", [{}, {"odometry_rotation_scale": 0.01, "odometry_translation_scale": 0.02}], ids=["guessed", "stated"]
)
def test_one_object_is_one_landmark_and_corrects_the_odometry(seed: int, stated: dict[str, float]) -> None:
    problem, truth = circled(seed)
    before = absolute_trajectory_error(problem.odometry, truth).rmse
    for result in (solve(problem, SlamConfig(**stated)), solve_incremental(problem, SlamConfig(**stated))):
        assert len(result.landmarks) == 1
        assert result.landmarks[0].detections > 0.6 * len(problem.observations)
        assert result.landmarks[0].existence > 0.99
        assert absolute_trajectory_error(result.T_world_camera, truth).rmse < 0.8 * before
