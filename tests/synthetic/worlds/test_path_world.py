"""Worlds along a path: the camera's way is the path, nothing stands in it, and what is seen is labelled."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.data.simulated_paths import figure_of_eight, looking_ahead
from nolbo_ppl.errors import InputError
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error
from nolbo_ppl.synthetic.worlds.path_world import CLEARANCE, level_track, make_path_world
from nolbo_ppl.synthetic.worlds.world_frame import render_frame


def hilly_path() -> np.ndarray:
    """A path that bends both ways, up and down a little."""
    s = np.linspace(0.0, 1.0, 400)
    return looking_ahead(np.stack([25 * np.sin(5 * s), 2 * np.sin(9 * s), 160 * s], axis=1))


def test_the_way_is_the_path() -> None:
    """Frame by frame at equal lengths of the way, up to a rigid motion, the path laid flat."""
    T = hilly_path()
    world = make_path_world(T, 2.5, (96, 64), seed=3, frames=60)
    flat = T.copy()
    flat[:, 1, 3] = 0.0
    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(flat[:, :3, 3], axis=0), axis=1)))
    at = np.arange(len(world.T_world_camera)) * 2.5
    truth = np.tile(np.eye(4), (len(at), 1, 1))
    truth[:, :3, 3] = np.stack([np.interp(at, s, flat[:, axis, 3]) for axis in range(3)], axis=1)
    assert absolute_trajectory_error(world.T_world_camera, truth).max < 0.2
    track = level_track(T)
    np.testing.assert_allclose(track.points[[0, -1]], T[[0, -1]][:, [2, 0], 3] * [1, -1], atol=1e-9)


def test_nothing_stands_in_the_way() -> None:
    """A figure of eight crosses itself; every object keeps clear of all of it, and stands where it is labelled."""
    T = figure_of_eight(300, 1, 60.0)
    world = make_path_world(T, 2.0, (128, 96), seed=1, frames=80, spacing=3.0)
    assert len(world.objects) > 30
    way = world.T_ground_camera[:, :2, 3]
    for thing in world.objects:
        assert np.linalg.norm(way - thing.centre[:2], axis=1).min() > CLEARANCE
    seen = {k: render_frame(world, k) for k in (0, 20, 40, 60)}
    assert sum(len(one.ids) for one in seen.values()) > 2
    for frame, one in seen.items():
        for name, label in zip(one.ids, one.rendered.labels):
            thing = world.objects[int(name.removeprefix("O"))]
            local = np.linalg.inv(world.T_ground_camera[frame]) @ np.append(thing.centre, 1.0)
            np.testing.assert_allclose(label.position, local[:3], atol=1e-6)
    again = make_path_world(T, 2.0, (128, 96), seed=1, frames=80, spacing=3.0)
    np.testing.assert_array_equal(render_frame(again, 20).rendered.image, seen[20].rendered.image)


def test_a_path_has_a_length() -> None:
    with pytest.raises(InputError, match="length of a path"):
        level_track(np.tile(np.eye(4), (5, 1, 1)))
