"""A world along any path, such as that of a recorded drive: a road, trees beside it, and objects to be seen.

Loops of streets (`street`) are convex and driven round; a path may cross itself and come back as it likes, and what stands beside
it must keep clear of every part of it. The path is laid on level ground.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import input_error
from nolbo_ppl.synthetic.assets.shape_library import ShapeLibrary
from nolbo_ppl.synthetic.worlds import scenery
from nolbo_ppl.synthetic.worlds.camera_path import Loop, Track, camera_pose
from nolbo_ppl.synthetic.worlds.placing import Catalogue, Placer
from nolbo_ppl.synthetic.worlds.street_ground import ASPHALT, GRASS
from nolbo_ppl.synthetic.worlds.world import POOL_SEED, World, world_light
from nolbo_ppl.synthetic.worlds.world_config import SequenceConfig
from nolbo_ppl.synthetic.worlds.world_mesh import Frame, StaticBuilder

DENSE = 0.5
"""Distance between the points that objects keep clear of, m."""
ROAD = 3.4
"""Half of the road's width, m."""
CLEARANCE = 2.6
"""Least distance of an object from the camera's way, m."""
MARGIN = 30.0
"""Way beyond the last frame beside which objects stand, m."""
FAR = 300.0
"""Ground beyond the way, m."""
TREES = 14.0
"""Metres of the way for each tree or hedge."""
SMOOTHING = 2.0
"""Length over which the heading of a path is smoothed, m."""
SHARES = {
    "car": 0.4,
    "bicycle": 0.12,
    "motorbike": 0.12,
    "chair": 0.08,
    "sofa": 0.08,
    "bus": 0.06,
    "boat": 0.06,
    "diningtable": 0.08,
}
"""How often each category stands beside the road."""


def level_track(T_world_camera: Float[np.ndarray, "n 4 4"], spacing: float = DENSE) -> Track:
    """The way of a camera (x right, y down, z ahead) on level ground, evenly sampled, x ahead and y to the left of its start.

    Raises:
        InputError: the camera moves less than ten metres.
    """
    xy = T_world_camera[:, [2, 0], 3] * [1.0, -1.0]
    step = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1)))
    if step[-1] < 10.0:
        raise input_error("length of a path", got=f"{step[-1]:.1f} m", expected="at least 10 m")
    moved = np.append(True, np.diff(step) > 1e-6)
    s = np.linspace(0.0, step[-1], max(2, int(step[-1] / spacing)))
    points = np.stack([np.interp(s, step[moved], xy[moved, axis]) for axis in (0, 1)], axis=1)
    half = max(1, int(SMOOTHING / spacing / 2))
    index = np.arange(len(points))
    ahead = points[np.minimum(index + half, len(points) - 1)] - points[np.maximum(index - half, 0)]
    return Track(points, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])))


def make_path_world(
    T_world_camera: Float[np.ndarray, "n 4 4"],
    step: float,
    size: tuple[int, int],
    seed: int,
    frames: int | None = None,
    spacing: float = 6.0,
) -> World:
    """Build a world along a path: the same arguments give the same world.

    Args:
        T_world_camera: poses of the path; only their positions count, and of these what is level.
        step: distance between frames, m.
        size: width and height of the images, px.
        seed: which objects, which light.
        frames: frames at most; the way is cut off there.
        spacing: metres of the way for each object.

    Raises:
        InputError: the path is too short.
    """
    whole = level_track(T_world_camera)
    along = np.arange(len(whole.points)) * (_length(whole) / (len(whole.points) - 1))
    count = int(along[-1] / step) + 1
    count = count if frames is None else min(count, frames)
    config = SequenceConfig(world="street", seed=seed, frames=count, laps=1.0, step=step, size=size, supersample=1, tilt=4.0)
    reach = (count - 1) * step
    used = along <= reach + MARGIN  # what stands a little further is seen too
    track = Track(whole.points[used], whole.headings[used])
    place_rng, look_rng, light_rng = (np.random.default_rng([seed, 9300 + k]) for k in range(3))
    catalogue = Catalogue(ShapeLibrary(CATEGORIES, seed=POOL_SEED + seed), config.look_alikes, seed, look_rng)
    placer = Placer(catalogue, track, CLEARANCE, int(reach / spacing))
    _stand(placer, track, place_rng)
    static, materials = _surroundings(placer, track, place_rng).built()
    s = np.arange(count) * step
    way = [np.interp(s, along, value) for value in (*whole.points.T, whole.headings)]
    tilt = np.radians(config.tilt)
    poses = np.stack([camera_pose(x, y, config.camera_height, heading, tilt, 0.0) for x, y, heading in zip(*way)])
    loop = Loop(track.points, track.headings, _length(track))
    return World(config, loop, poses, tuple(placer.objects), static, materials, *world_light(config, light_rng))


def _length(track: Track) -> float:
    return float(np.linalg.norm(np.diff(track.points, axis=0), axis=1).sum())


def _beside(track: Track, at: int, lateral: float) -> tuple[Float[np.ndarray, " 2"], float]:
    """A place to the left (positive) or right of a point of the way, and the heading there."""
    heading = float(track.headings[at])
    return track.points[at] + lateral * np.array([-np.sin(heading), np.cos(heading)]), heading


def _stand(placer: Placer, track: Track, rng: np.random.Generator) -> None:
    """Stand objects beside the way, anywhere along it, along the road or across."""
    names, shares = list(SHARES), np.array(list(SHARES.values()))
    for _ in range(8 * placer.wanted):
        if placer.full:
            return
        category = str(rng.choice(names, p=shares / shares.sum()))
        large = category in ("bus", "boat")
        lateral = rng.choice([-1.0, 1.0]) * (rng.uniform(7.0, 11.0) if large else rng.uniform(4.2, 8.0))
        place, heading = _beside(track, int(rng.integers(len(track.points))), lateral)
        turn = rng.choice([0.0, np.pi]) + rng.normal(0, 0.1) if large or category == "car" else rng.uniform(-np.pi, np.pi)
        placer.place(category, place, heading + turn, longest=13.5 if large else 6.0)


def _surroundings(placer: Placer, track: Track, rng: np.random.Generator) -> StaticBuilder:
    """Ground, road, and a tree or a hedge every so often where there is room."""
    builder = StaticBuilder()
    low, high = track.points.min(0) - FAR, track.points.max(0) + FAR
    corners = [(x, y, -0.03) for x, y in ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))]
    builder.polygon(np.array(corners), GRASS)
    kept = track.points[::3], track.headings[::3]
    normal = np.stack((-np.sin(kept[1]), np.cos(kept[1])), axis=1)
    left, right = (np.column_stack((kept[0] + side * ROAD * normal, np.zeros(len(normal)))) for side in (1, -1))
    builder.ribbon(left, right, ASPHALT)
    for at in range(0, len(track.points), int(TREES / DENSE)):
        place, heading = _beside(track, at, rng.choice([-1.0, 1.0]) * rng.uniform(9.0, 16.0))
        footprint = placer.block(place, heading, (1.0, 1.0), (-1, 8))
        if placer.free(footprint):
            placer.taken.append(footprint)
            if rng.random() < 0.75:
                scenery.tree(builder, place, rng.uniform(4.5, 8.0), rng)
            else:
                scenery.hedge(builder, Frame(place, heading), 1.8, 1.4, rng)
    return builder
