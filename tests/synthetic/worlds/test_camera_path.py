"""Loops, tracks and camera poses against geometry worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.synthetic.worlds.camera_path import Wobble, camera_poses, drive_track, random_loop, rounded_polygon

SQUARE = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 20.0], [0.0, 20.0]])
STILL = Wobble(0, 0, 0, 0, 0, 30.0)


@pytest.mark.parametrize("corners", [SQUARE, SQUARE[::-1]])
def test_rounded_rectangle(corners: np.ndarray) -> None:
    loop = rounded_polygon(corners, 5.0)
    assert loop.length == pytest.approx(2 * (30 + 20) - 8 * 5 + 2 * np.pi * 5, rel=1e-4)
    assert loop.inner == (1 if corners is SQUARE else -1)
    closed = np.concatenate((loop.points, loop.points[:1]))
    steps = np.diff(closed, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), loop.length / len(loop.points), rtol=2e-3)
    direction = np.arctan2(steps[:, 1], steps[:, 0])
    apart = np.angle(np.exp(1j * (direction - loop.headings)))
    assert np.abs(apart).max() < 0.02
    # Every point lies on a side or on one of the four arcs.
    x, y = loop.points.T
    dx, dy = np.maximum(np.abs(x - 15) - 10, 0), np.maximum(np.abs(y - 10) - 5, 0)
    np.testing.assert_allclose(np.hypot(dx, dy), 5.0, atol=1e-3)


def test_places_along_a_loop() -> None:
    loop = rounded_polygon(SQUARE, 5.0)
    start, heading = loop.at(0.0)
    np.testing.assert_allclose(start, [15, 0], atol=1e-9)
    np.testing.assert_allclose(loop.at(0.0, 2.0)[0], [15, 2], atol=1e-9)  # left of travel along +x
    again, turned = loop.at(loop.length)
    np.testing.assert_allclose(again, start, atol=1e-9)
    assert turned - heading == pytest.approx(2 * np.pi)
    assert loop.at(-3.0)[0] == pytest.approx([12.0, 0.0], abs=1e-6)
    assert loop.distance(np.array([15.0, 4.0])) == pytest.approx(4.0, abs=1e-3)
    inset = loop.inset(6.0)
    assert len(inset) > 10
    assert (np.abs(inset - [15, 10]) < [9.01, 4.01]).all()
    assert len(loop.inset(10.5)) == 0


def test_random_loops_have_their_length_and_both_directions() -> None:
    loops = [random_loop(90.0, 9.0, np.random.default_rng(k), (1.15, 1.7), 0.12) for k in range(12)]
    assert {loop.inner for loop in loops} == {1, -1}
    for loop in loops:
        assert loop.length == pytest.approx(90.0, rel=1e-3)
        # Convex: the heading turns one way only, a whole turn in all.
        assert (loop.inner * np.diff(loop.headings) > -1e-9).all()
        (x, y), (after_x, after_y) = loop.points.T, np.roll(loop.points, -1, axis=0).T
        area = 0.5 * np.sum(x * after_y - y * after_x)
        assert np.sign(area) == loop.inner


def test_track_back_in_the_opposite_lane() -> None:
    loop = rounded_polygon(SQUARE, 5.0)
    track = drive_track(loop, 0.05, 0.04, 3.6)
    assert np.linalg.norm(np.diff(track.points, axis=0), axis=1).max() < 0.15
    assert np.abs(np.diff(track.headings)).max() < 0.06
    assert track.headings[-1] - track.headings[0] == pytest.approx(np.pi)  # a half turn to the left
    np.testing.assert_allclose(track.points[0], [15, 0], atol=1e-6)
    np.testing.assert_allclose(track.points[-1], [15 + 0.01 * loop.length, 3.6], atol=1e-6)
    moved = np.diff(track.points, axis=0)
    along = np.stack((np.cos(track.headings), np.sin(track.headings)), axis=1)[:-1]
    assert (np.einsum("nd,nd->n", moved, along) > 0).all()


def test_camera_poses() -> None:
    loop = rounded_polygon(SQUARE, 5.0)
    track = drive_track(loop, 0.5, 0.0, 0.0)
    poses = camera_poses(track, 60, 1.0, 1.7, 10.0, STILL, np.random.default_rng(0), most_turn=5.0)
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(t[:, 2], 1.7)
    np.testing.assert_allclose(t[[0, -1], :2], [[15, 0], [15, 20]], atol=0.06)
    # Looks along +x and 10 degrees down; right is -y, down is -z.
    down = np.radians(10)
    np.testing.assert_allclose(R[0, :, 2], [np.cos(down), 0, -np.sin(down)], atol=1e-9)
    np.testing.assert_allclose(R[0, :, 0], [0, -1, 0], atol=1e-9)
    forward = np.unwrap(np.arctan2(R[:, 1, 2], R[:, 0, 2]))
    turns, steps = np.degrees(np.abs(np.diff(forward))), np.linalg.norm(np.diff(t, axis=0), axis=1)
    effort = np.maximum(steps, turns / 5.0)
    assert effort.max() / effort.min() < 1.15  # evenly spread: as far as it is straight, by angle where it bends
    assert steps.max() > 1.2 * steps.min()


def test_wobble_has_its_scale() -> None:
    loop = rounded_polygon(10 * SQUARE, 5.0)
    track = drive_track(loop, 1.0, 0.0, 0.0)
    wobble = Wobble(0.2, 0.01, 1.0, 0.5, 0.4, 30.0)
    rough = camera_poses(track, 2000, 1.0, 1.5, 8.0, wobble, np.random.default_rng(1), most_turn=180.0)
    smooth = camera_poses(track, 2000, 1.0, 1.5, 8.0, STILL, np.random.default_rng(1), most_turn=180.0)
    sideways = np.linalg.norm((rough - smooth)[:, :2, 3], axis=1)
    assert np.sqrt((sideways**2).mean()) == pytest.approx(0.2, rel=0.05)
    assert rough[:, 2, 3].std() == pytest.approx(0.01, rel=0.05)
    relative = smooth[:, :3, :3].transpose(0, 2, 1) @ rough[:, :3, :3]
    angle = np.degrees(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert np.sqrt((angle**2).mean()) == pytest.approx(np.sqrt(1 + 0.5**2 + 0.4**2), rel=0.1)
