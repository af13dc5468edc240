"""Keyframes that hang on others: chains against products of their links, and links of files that make no sense."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import inverse, se3_exp
from nolbo_ppl.inference.slam.incremental.hanging_poses import HangingPoses


def test_chains_are_products_of_their_links() -> None:
    """Keyframes leave in random order, each onto one that is still there; the world poses stay what they were."""
    rng, frames = np.random.default_rng(0), 600
    world = se3_exp(rng.normal(size=(frames, 6)))
    poses, there = HangingPoses(), set(range(frames))
    for frame in rng.permutation(frames)[: frames - 5].tolist():
        there.discard(frame)
        onto = int(rng.choice(sorted(there)))
        poses.hang(frame, onto, inverse(world[onto]) @ world[frame])
    assert len(poses) == frames - 5 and set(range(frames)) - set(poses.numbers().tolist()) == there
    np.testing.assert_allclose(poses.places(frames, lambda i: world[i]), world, atol=1e-9)
    for frame in (0, 17, 599):
        root, T = poses.root(frame)
        assert root in there and (frame in poses) == (frame not in there)
        np.testing.assert_allclose(world[root] @ T, world[frame], atol=1e-9)
    # What a keyframe of the graph moves by, all that hangs on it moves by.
    moved = se3_exp(np.array([0, 0.1, 0, 1.0, 0, 0])) @ world
    np.testing.assert_allclose(poses.places(frames, lambda i: moved[i]), moved, atol=1e-9)
    assert -1 not in poses and frames + 1000 not in poses
    again = HangingPoses.of_links(poses.numbers(), poses.onto[poses.numbers()], poses.T[poses.numbers()], frames)
    np.testing.assert_array_equal(again.places(frames, lambda i: world[i]), poses.places(frames, lambda i: world[i]))


def test_a_keyframe_costs_what_it_says() -> None:
    poses = HangingPoses()
    for frame in range(10_000):
        poses.hang(frame, 10_000, np.eye(4))
    assert (poses.onto.nbytes + poses.T.nbytes) / 10_000 < 1.25 * 136 + 4


@pytest.mark.parametrize(
    ("frames", "onto", "message"),
    [
        ([0, 1], [1, 0], "circle"),
        ([2], [2], "circle"),
        ([0, 1, 2], [1, 2, 1], "circle"),
        ([0], [9], "none of 4"),
        ([-1], [1], "none of 4"),
    ],
)
def test_links_without_an_end_are_refused(frames: list[int], onto: list[int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HangingPoses.of_links(np.array(frames), np.array(onto), np.tile(np.eye(4), (len(frames), 1, 1)), 4)
