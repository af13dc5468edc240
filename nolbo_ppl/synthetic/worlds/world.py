"""A world to drive through: what stands where, the light, and the camera's poses; all from a configuration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.geometry.pose import inverse, make_pose
from nolbo_ppl.synthetic.assets.shape_library import ShapeLibrary
from nolbo_ppl.synthetic.renderer.camera_view import Environment, Light, Mesh, Surface
from nolbo_ppl.synthetic.renderer.materials import Material, hsv
from nolbo_ppl.synthetic.scenes.environment import sample_light
from nolbo_ppl.synthetic.scenes.scene_config import SceneConfig
from nolbo_ppl.synthetic.worlds.camera_path import Loop, Wobble, camera_poses, drive_track, random_loop
from nolbo_ppl.synthetic.worlds.indoor import build_indoor
from nolbo_ppl.synthetic.worlds.placing import Appearance, Catalogue, Placer, WorldObject
from nolbo_ppl.synthetic.worlds.street import build_street
from nolbo_ppl.synthetic.worlds.street_ground import LANE
from nolbo_ppl.synthetic.worlds.world_config import SequenceConfig
from nolbo_ppl.synthetic.worlds.world_mesh import turned

POOL_SEED = 50_000
"""Shapes of world s come from the pool with seed `POOL_SEED + s`: training uses small seeds, so they are unseen."""
RATE = 10.0
"""Frames a second, as written to `times.txt`."""


@dataclass(frozen=True)
class World:
    """Everything a frame depends on. The ground frame has z up; the world frame is that of the first camera."""

    config: SequenceConfig
    loop: Loop
    T_ground_camera: Float[np.ndarray, "frames 4 4"]
    objects: tuple[WorldObject, ...]
    static: Mesh
    """All that is no object, in the ground frame."""
    static_materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    """Directions in the ground frame."""
    ambient_sky: Float[np.ndarray, " 3"]
    ambient_ground: Float[np.ndarray, " 3"]
    backdrop: Environment
    exposure: float

    @property
    def intrinsics(self) -> Float[np.ndarray, " 4"]:
        """[fx, fy, cx, cy] px."""
        width, height = self.config.size
        focal = self.config.focal * width
        return np.array([focal, focal, width / 2, height / 2])

    @cached_property
    def T_world_ground(self) -> Float[np.ndarray, "4 4"]:
        """Takes the ground frame (z up) into the frame of the first camera."""
        return inverse(self.T_ground_camera[0])

    @cached_property
    def T_world_camera(self) -> Float[np.ndarray, "frames 4 4"]:
        """True poses; the first is the identity."""
        poses = self.T_world_ground @ self.T_ground_camera
        poses[0] = np.eye(4)
        return poses

    @property
    def times(self) -> Float[np.ndarray, " frames"]:
        """Seconds."""
        return np.arange(self.config.frames) / RATE

    def T_ground_object(self, thing: WorldObject, frame: int) -> Float[np.ndarray, "4 4"]:
        """Pose of an object in the ground frame as a camera frame sees it."""
        if thing.moving is None:
            return thing.T_ground_object
        start, speed, lateral = thing.moving
        return _riding(self.loop, start + speed * frame, lateral, thing.look)


def _riding(loop: Loop, s: float, lateral: float, look: Appearance) -> Float[np.ndarray, "4 4"]:
    """Pose in the ground frame of an object that drives against the camera's direction."""
    point, heading = loop.at(s, lateral)
    z = 0.5 * float(look.item.shape.dimensions[2])
    return make_pose(turned(float(heading) + np.pi + np.pi / 2), np.array([*point, z]))


def make_world(config: SequenceConfig) -> World:
    """Build a world: the same configuration gives the same world on every machine.

    Raises:
        InputError: no object of those wanted has room (the loop is too short).
    """
    path_rng, light_rng, place_rng, look_rng, move_rng = (np.random.default_rng([config.seed, 9100 + k]) for k in range(5))
    street = config.world == "street"
    loop = random_loop(
        config.perimeter, 9.0 if street else 1.9, path_rng, (1.15, 1.7) if street else (1.3, 1.9), 0.12 if street else 0.0
    )
    track = drive_track(loop, config.laps, config.opposite, LANE if street else 0.0)
    wobble = Wobble(0.18, 0.012, 0.7, 0.3, 0.3, 37.0) if street else Wobble(0.06, 0.008, 1.2, 0.4, 0.4, 9.7)
    poses = camera_poses(track, config.frames, config.step, config.camera_height, config.tilt, wobble, path_rng)
    pool = ShapeLibrary(CATEGORIES, seed=POOL_SEED + config.seed)
    catalogue = Catalogue(pool, config.look_alikes, config.seed, look_rng)
    placer = Placer(catalogue, track, 1.8 if street else 0.75, max(0, config.objects - config.moving))
    build = build_street if street else build_indoor
    static, materials = build(loop, placer, config.clutter, place_rng).built()
    objects = [*placer.objects, *_moving(config, loop, catalogue, len(placer.objects), move_rng)]
    return World(
        config,
        loop,
        poses,
        tuple(objects),
        static,
        materials,
        *world_light(config, light_rng),
    )


def _moving(config: SequenceConfig, loop: Loop, catalogue: Catalogue, first: int, rng: np.random.Generator) -> list[WorldObject]:
    """Vehicles in the opposite lane, spread over the loop, all at one speed so that they never meet."""
    made = []
    lateral, speed = LANE, -config.step * rng.uniform(0.5, 0.9)
    for k in range(min(config.moving, int(loop.length / 12))):
        look = catalogue.pick(str(rng.choice(["car", "car", "motorbike", "bicycle"])), 6.0)
        start = (k + rng.uniform(0.2, 0.8)) * loop.length / config.moving
        pose = _riding(loop, start, lateral, look)
        half = 0.5 * look.item.shape.dimensions
        footprint = Placer.block(pose[:2, 3], float(np.arctan2(pose[1, 0], pose[0, 0])), (half[0], half[1]), (0, 2 * half[2]))
        made.append(WorldObject(f"O{first + k}", look, pose, footprint, (start, speed, lateral)))
    return made


def world_light(
    config: SequenceConfig, rng: np.random.Generator
) -> tuple[tuple[Light, ...], np.ndarray, np.ndarray, Environment, float]:
    """Sun and sky, or the lamps of a room: fixed in the ground frame."""
    street = config.world == "street"
    ranges = SceneConfig(sun_elevation=(42.0, 62.0) if street else (68.0, 82.0), tint=0.05, second_light_probability=0.0)
    lights, _, _ = sample_light(ranges, rng, np.eye(3))
    strength = rng.uniform(0.72, 0.9) if street else 0.35
    colour = np.array([1.0, 0.96, 0.88]) if street else np.array([1.0, 0.97, 0.92])
    sky = np.array([0.40, 0.44, 0.50]) * rng.uniform(0.9, 1.1) if street else np.array([0.52, 0.51, 0.49])
    zenith = np.array(hsv(rng.uniform(0.56, 0.61), rng.uniform(0.35, 0.6), rng.uniform(0.75, 0.95)))
    horizon = np.clip(0.35 * zenith + 0.6 * zenith.max(), 0, 1)
    if not street:
        zenith = horizon = np.array(hsv(0.1, 0.03, 0.85))
    backdrop = Environment(
        zenith,
        horizon,
        Surface(np.full((2, 3), 0.2)),
        clouds=rng.uniform(0.3, 0.8) if street else 0.0,
        seed=int(rng.integers(2**31)),
        mesh_haze=1 / 150 if street else 0.0,
    )
    only = (replace(lights[0], colour=colour * strength),)
    return only, sky, sky * (0.5 if street else 0.65), backdrop, 0.95 if street else 1.05
