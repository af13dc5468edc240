"""A road without end in bounded memory: the oldest ground goes, what it knew of the newest keyframes stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.data.simulate import SimulatedSequence, WorldConfig, simulate_sequence
from nolbo_ppl.data.simulated_paths import straight
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.slam import IncrementalSlam, SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.incremental.forgetting import FACTOR_MEMORY, graph_memory
from nolbo_ppl.inference.slam.incremental.keyframes import KeyframeConfig
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error
from nolbo_ppl.structures.detections import Detections

CONFIG = SlamConfig(odometry_rotation_scale=0.004, odometry_translation_ratio=0.01)
FRAMES, BOUND = 130, 2.0


@pytest.fixture(scope="module")
def road() -> SimulatedSequence:
    rng = np.random.default_rng(5)
    truth = straight(FRAMES, 130.0)
    return simulate_sequence(truth, rng, world=WorldConfig(objects=45, categories=5, latent_dim=4))


def system(drive: SimulatedSequence, bound: float | None) -> IncrementalSlam:
    first = drive.observations.select(drive.observations.frame < 50)
    return IncrementalSlam(CONFIG, SlamProblem(drive.odometry[:50], first), KeyframeConfig(history=False, max_memory=bound))


def feed(slam: IncrementalSlam, drive: SimulatedSequence, frames: range) -> list[float]:
    table, memory = drive.observations, []
    for t in frames:
        slam.update(drive.odometry[t], table.select(table.frame == t))
        memory.append(graph_memory(slam.graph))
    return memory


def test_memory_stays_within_its_bound_and_the_trajectory_whole(road: SimulatedSequence, tmp_path: Path) -> None:
    free, bounded = system(road, None), system(road, BOUND)
    assert max(feed(free, road, range(FRAMES))) > 1.5 * BOUND
    memory = feed(bounded, road, range(100))
    bounded.save(tmp_path / "state.npz")
    again = IncrementalSlam.load(tmp_path / "state.npz")
    memory += feed(bounded, road, range(100, FRAMES))
    feed(again, road, range(100, FRAMES))
    assert max(memory) < BOUND + 20 * FACTOR_MEMORY  # one keyframe's factors wait
    np.testing.assert_array_equal(again.trajectory(), bounded.trajectory())
    # All poses are still told, and as well as without the bound; the map holds the newest ground alone.
    assert bounded.trajectory().shape == (FRAMES, 4, 4)
    errors = [absolute_trajectory_error(slam.trajectory(), road.truth).rmse for slam in (free, bounded)]
    assert errors[1] < 1.5 * errors[0] + 0.1
    assert len(bounded.graph.of_pose) < 100 < len(free.graph.of_pose)
    kept, whole = bounded.landmarks(), free.landmarks()
    assert 3 < len(kept) < 0.8 * len(whole)
    assert all(np.linalg.eigvalsh(one.covariance)[0] > 0 for one in kept)
    assert min(one.last_frame for one in kept) > 30
    # Forgotten ground leaves the newest pose no surer than it is.
    ratio = np.trace(bounded.graph.pose_covariance(FRAMES - 1)) / np.trace(free.graph.pose_covariance(FRAMES - 1))
    assert 0.7 < ratio < 2.0


def test_a_chain_without_landmarks_forgets_exactly() -> None:
    """Odometry alone is a Markov chain: the marginal of one pose holds all that older ones say of newer ones."""
    rng = np.random.default_rng(0)
    odometry = straight(230, 200.0)
    odometry[:, :3, 3] += 0.01 * rng.standard_normal((230, 3))
    nothing = Detections.from_arrays(np.zeros(0, int), np.zeros((0, 3)))
    systems = [IncrementalSlam(CONFIG, None, KeyframeConfig(history=False, max_memory=bound)) for bound in (None, 1.0)]
    for slam in systems:
        for pose in odometry:
            slam.update(pose, nothing)
    assert len(systems[1].graph.of_pose) < 180 and len(systems[0].graph.of_pose) == 230
    for t in (100, 200, 229):
        a, b = (slam.graph.pose_covariance(t) for slam in systems)
        if t in systems[1].graph.of_pose:
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(systems[0].trajectory(), systems[1].trajectory(), atol=1e-9)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"max_memory": 0.5, "history": False}, "at least 1"),
        ({"max_memory": float("nan"), "history": False}, "finite number of MB"),
        ({"max_memory": True, "history": False}, "finite number of MB"),
        ({"max_memory": 10.0}, "set history=False"),
    ],
)
def test_bounds_that_cannot_be_kept_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        KeyframeConfig(**values)  # type: ignore[arg-type]
