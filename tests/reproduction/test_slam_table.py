"""Table 2 and the E-step: drives along paths, whose a detection is, the clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nolbo_ppl
from nolbo_ppl.data.simulated_paths import figure_of_eight
from nolbo_ppl.errors import InputError
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory
from nolbo_ppl.metrics.trajectory import trajectory_errors
from nolbo_ppl.reproduction.budgets import ReproduceConfig
from nolbo_ppl.reproduction.estep_time import simulated_state, time_e_step
from nolbo_ppl.reproduction.slam_table import (
    UNKNOWN,
    Drive,
    observe_drive,
    odometry_of,
    paths,
    score_odometry,
    true_objects,
)
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors


def drive(T: np.ndarray) -> Drive:
    frame, number = np.array([0, 0, 1]), np.array([4, 7, 4])
    box = np.array([[0.0, 0, 10, 10], [20.0, 0, 40, 10], [2.0, 0, 12, 10]])
    return Drive("made", T, np.zeros((len(T), 4, 4, 3), np.uint8), np.array([5.0, 5, 2, 2]), frame, box, number)


def test_whose_a_detection_is() -> None:
    seen = Detections.from_arrays(
        [0, 0, 1, 2], np.ones((4, 3)), box=[[19.0, 0, 41, 10], [0.0, 0, 3, 10], [1.0, 0, 12, 10], [0.0, 0, 10, 10]]
    )
    assert true_objects(seen, drive(np.tile(np.eye(4), (3, 1, 1)))).tolist() == [7, UNKNOWN, 4, -1]


class SizeRecorder:
    """Sees nothing, and remembers how large it was shown the frames."""

    def __init__(self, nothing: ObjectPosteriors) -> None:
        self.nothing, self.sizes = nothing, []

    def observe(self, images: list, intrinsics: np.ndarray, size: int, **options: object) -> list[ObjectPosteriors]:
        self.sizes.append(size)
        return [self.nothing] * len(images)


@pytest.mark.parametrize(("zoom", "size"), [(1.0, 256), (1.5, 384), (2.0, 512)])
def test_frames_are_seen_as_large_as_what_was_learnt_from(zoom: float, size: int) -> None:
    made = replace(drive(np.tile(np.eye(4), (20, 1, 1))), images=np.zeros((20, 128, 256, 3), np.uint8))
    nothing = nolbo_ppl.load("tiny").observe(np.full((64, 64, 3), 128, np.uint8), decode=False)
    assert len(nothing) == 0
    recorder = SizeRecorder(nothing)
    assert len(observe_drive(recorder, made, zoom, batch=16)) == 0
    assert recorder.sizes == [size, size]


def test_the_odometry_of_a_drive() -> None:
    """Another seed is another drift, the same seed the same; its error is that of the trajectory."""
    T = figure_of_eight(120, 1, 30.0)
    made = drive(T)
    first, again, other = odometry_of(made, 0), odometry_of(made, 0), odometry_of(made, 1)
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)
    scores = score_odometry(made, first)
    assert scores.ate == trajectory_errors(first, T)["ate"] > 0.1
    assert np.isnan(scores.loop_recall)


def test_paths_of_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no paths"):
        paths(ReproduceConfig(tmp_path, data=str(tmp_path)))
    (tmp_path / "poses").mkdir()
    T = figure_of_eight(50, 1, 30.0)
    write_trajectory(tmp_path / "poses" / "06.txt", Trajectory(T))
    found = paths(ReproduceConfig(tmp_path, data=str(tmp_path)))
    assert list(found) == ["06"]
    np.testing.assert_allclose(found["06"], T, atol=1e-6)
    for T in paths(ReproduceConfig(tmp_path)).values():  # generated ones come back to where they were
        step = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)))
        distance = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1)
        assert (distance[np.abs(step[:, None] - step) > 100] < 2.0).any()


def test_the_e_step_is_timed() -> None:
    """A clock that ticks once a reading: one tick for the E-step, one for the latents, at every repetition."""
    state = simulated_state(8, 12, seed=0)
    assert state.latent.shape[1] == 8
    ticks = iter(range(1000))
    found = time_e_step(state, 3, clock=lambda: float(next(ticks)))
    assert found.whole.tolist() == [1.0] * 3 and found.latent.tolist() == [1.0] * 3
    assert 0 < found.keyframes <= 12
