"""Simulated object SLAM on any true trajectory: a world of objects along the way, noisy detections, drifting odometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl._moved import renamed
from nolbo_ppl.geometry.pose import R_WORLD_UPRIGHT, chain, inverse, make_pose, relative, se3_exp, so3_exp, transform
from nolbo_ppl.structures.detections import Detections


@dataclass(frozen=True)
class WorldConfig:
    """A world of static objects scattered along a drive."""

    objects: int = 400
    """Number of objects."""
    categories: int = 20
    """Number of categories."""
    latent_dim: int = 16
    """Dimension of the shape latent; 0: none."""
    category_scale: float = 3.0
    """Standard deviation of each coordinate of a category's mean latent."""
    instance_scale: float = 1.0
    """Standard deviation of an object's latent about its category's mean; 0 makes all of a category identical."""
    lateral: tuple[float, float] = (4.0, 12.0)
    """Least and largest distance from the path, m."""
    minimum_spacing: float = 2.0
    """No two objects are closer than this, m."""


@dataclass(frozen=True)
class DetectorConfig:
    """What a detector sees of a world."""

    minimum_range: float = 2.0
    """m."""
    maximum_range: float = 25.0
    """m."""
    field_of_view: float = np.pi / 2
    """Full horizontal angle, rad."""
    miss_rate: float = 0.15
    """Probability that a visible object is not detected."""
    clutter_rate: float = 0.2
    """Mean number of false detections a frame."""
    position_scale: float = 0.1
    """Standard deviation of each coordinate at range 0, m."""
    position_ratio: float = 0.03
    """Its growth with range, m per m."""
    rotation_scale: float | None = 0.05
    """Standard deviation of each angle, rad; None: no orientation."""
    flip_rate: float = 0.02
    """Probability that an orientation is turned by 180 degrees about the vertical axis."""
    latent_scale: float = 0.7
    """Standard deviation of each latent coordinate."""
    objectness: tuple[float, float] = (0.9, 0.3)
    """Mean reported objectness of true and of false detections."""
    confused_objects: float = 0.0
    """Share of the objects that the detector takes for one other category, each for one of its own."""
    confusion_rate: float = 0.7
    """Probability of that mistake in a view of such an object: looks of one network at one object are not independent."""


@dataclass(frozen=True)
class SimulatedWorld:
    """Static objects in the frame of the trajectory."""

    position: Float[np.ndarray, "m 3"]
    """World positions, m."""
    rotation: Float[np.ndarray, "m 3 3"]
    """R_world_object; upright, z up."""
    category: Int[np.ndarray, " m"]
    """Category index."""
    latent: Float[np.ndarray, "m d"]
    """Shape latent."""
    category_latent: Float[np.ndarray, "c d"]
    """Mean latent of each category."""


@dataclass(frozen=True)
class SimulatedSequence:
    """A simulated drive with its truth."""

    truth: Float[np.ndarray, "n 4 4"]
    """True T_world_camera."""
    odometry: Float[np.ndarray, "n 4 4"]
    """Drifting T_world_camera."""
    observations: Detections
    """Detections."""
    object_of: Int[np.ndarray, " k"]
    """True object of each detection, -1 for clutter."""
    world: SimulatedWorld | None = None
    """The objects, where they are known."""


def simulate_world(truth: Float[np.ndarray, "n 4 4"], config: WorldConfig, rng: np.random.Generator) -> SimulatedWorld:
    """Scatter objects to both sides of a path, upright with any heading, at the height of the camera less 1 m."""
    positions: list[np.ndarray] = []
    tries = 0
    step = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(step)])
    while len(positions) < config.objects and tries < 200 * config.objects:
        tries += 1
        pose = truth[np.searchsorted(along, rng.uniform(0, along[-1])) % len(truth)]
        side = rng.choice([-1.0, 1.0]) * rng.uniform(*config.lateral)
        point = transform(pose, np.array([side, 1.0 + 0.3 * rng.standard_normal(), 0.0]))
        if np.linalg.norm(truth[:, :3, 3] - point, axis=1).min() < config.lateral[0] * 0.7:
            continue
        if positions and np.linalg.norm(np.array(positions) - point, axis=1).min() < config.minimum_spacing:
            continue
        positions.append(point)
    m = len(positions)
    category = rng.integers(config.categories, size=m)
    means = config.category_scale * rng.standard_normal((config.categories, config.latent_dim))
    yaw = rng.uniform(-np.pi, np.pi, m)
    rotation = R_WORLD_UPRIGHT @ so3_exp(yaw[:, None] * np.array([0.0, 0.0, 1.0]))
    latent = means[category] + config.instance_scale * rng.standard_normal((m, config.latent_dim))
    return SimulatedWorld(np.array(positions).reshape(m, 3), rotation, category, latent, means)


def simulate_odometry(
    truth: Float[np.ndarray, "n 4 4"],
    rng: np.random.Generator,
    *,
    rotation_scale: float,
    translation_scale: float = 0.0,
    translation_ratio: float = 0.0,
    planar: bool = False,
    length_scale: float = 1.0,
    scale_drift: float = 0.0,
) -> Float[np.ndarray, "n 4 4"]:
    """Chain the true steps with white noise on each: rad an axis, m an axis, and m an axis per m of the step.

    Args:
        planar: turn about the camera's vertical axis only, move in its horizontal plane only.
        length_scale: factor on every step, the scale error of a monocular camera.
        scale_drift: standard deviation of the change of that factor's log from one step to the next.
    """
    steps = relative(truth[:-1], truth[1:]).copy()
    length = np.linalg.norm(steps[:, :3, 3], axis=1, keepdims=True)
    n = len(steps)
    scale = np.sqrt(translation_scale**2 + (translation_ratio * length) ** 2)
    noise = np.concatenate([rotation_scale * rng.standard_normal((n, 3)), scale * rng.standard_normal((n, 3))], axis=1)
    if planar:
        noise[:, [0, 2, 4]] = 0.0
    steps[:, :3, 3] *= length_scale
    noise = se3_exp(noise)
    if scale_drift:  # draws nothing without, so that odometry without stays what it was
        wander = np.exp(np.cumsum(scale_drift * rng.standard_normal(n)))
        steps[:, :3, 3] *= wander[:, None]
        noise[:, :3, 3] *= length_scale * wander[:, None]
    return chain(truth[0], steps @ noise)


def simulate_detections(
    truth: Float[np.ndarray, "n 4 4"], world: SimulatedWorld, config: DetectorConfig, rng: np.random.Generator
) -> tuple[Detections, Int[np.ndarray, " k"]]:
    """Detections of every frame in order, and the true object of each (-1 clutter).

    Noise of a position is isotropic with scale `position_scale + position_ratio * range`. Latents of clutter are drawn
    about the categories' means, its orientation at random.
    """
    frames, points, sources = [], [], []
    tangent = np.tan(config.field_of_view / 2)
    for t, pose in enumerate(truth):
        local = transform(inverse(pose), world.position) if len(world.position) else np.zeros((0, 3))
        distance = np.linalg.norm(local, axis=1)
        seen = (distance > config.minimum_range) & (distance < config.maximum_range) & (local[:, 2] > 0)
        seen &= np.abs(local[:, 0]) < tangent * local[:, 2]
        seen &= rng.random(len(local)) >= config.miss_rate
        rows = np.flatnonzero(seen)
        clutter = int(rng.poisson(config.clutter_rate))
        depth = rng.uniform(config.minimum_range, config.maximum_range, clutter)
        angle = rng.uniform(-0.5, 0.5, clutter) * config.field_of_view
        false = np.stack([depth * np.sin(angle), 1.0 + 0.3 * rng.standard_normal(clutter), depth * np.cos(angle)], axis=1)
        frames.append(np.full(len(rows) + clutter, t))
        points.append(np.concatenate([local[rows], false]))
        sources.append(np.concatenate([rows, np.full(clutter, -1)]))
    frame, point, source = np.concatenate(frames), np.concatenate(points), np.concatenate(sources).astype(np.int64)
    n, true = len(frame), source >= 0
    scale = config.position_scale + config.position_ratio * np.linalg.norm(point, axis=1)
    position = point + true[:, None] * scale[:, None] * rng.standard_normal((n, 3))
    rotation = None
    if config.rotation_scale is not None:
        R_world_camera = truth[frame, :3, :3]
        heading = so3_exp(rng.uniform(-np.pi, np.pi, (n, 1)) * np.array([0.0, 0.0, 1.0]))
        R_world_object = np.where(true[:, None, None], world.rotation[source], R_WORLD_UPRIGHT @ heading)
        flipped = so3_exp(np.where(rng.random(n) < config.flip_rate, np.pi, 0.0)[:, None] * np.array([0.0, 0.0, 1.0]))
        noise = so3_exp(config.rotation_scale * rng.standard_normal((n, 3)))
        rotation = np.swapaxes(R_world_camera, 1, 2) @ R_world_object @ flipped @ noise
    latent = None
    category: list[str | None] = [None] * n
    if world.latent.shape[1]:
        kind = np.where(true, world.category[source], rng.integers(len(world.category_latent), size=n))
        spread = np.std(world.latent - world.category_latent[world.category], axis=0)
        any_latent = world.category_latent[kind] + spread * rng.standard_normal((n, world.latent.shape[1]))
        latent = np.where(true[:, None], world.latent[source], any_latent)
        latent = latent + config.latent_scale * rng.standard_normal(latent.shape)
        category = [f"c{k}" for k in confused(kind, source, world, config, rng)]
    mean = np.where(true, config.objectness[0], config.objectness[1])
    objectness = rng.beta(10 * mean, 10 * (1 - mean)) if n else np.zeros(0)
    table = Detections.from_arrays(
        frame,
        position,
        position_scale=scale,
        rotation=rotation,
        rotation_scale=config.rotation_scale,
        latent=latent,
        latent_scale=config.latent_scale if latent is not None else None,
        objectness=objectness,
        category=category,
        id=[f"{t:06d}-{k:06d}" for k, t in enumerate(frame)],
    )
    return table, source


def confused(
    kind: Int[np.ndarray, " n"],
    source: Int[np.ndarray, " n"],
    world: SimulatedWorld,
    config: DetectorConfig,
    rng: np.random.Generator,
) -> Int[np.ndarray, " n"]:
    """Reported category of each detection: some objects are taken for one and the same other category again and again."""
    categories = len(world.category_latent)
    if config.confused_objects == 0.0 or categories < 2:
        return kind  # draws nothing, so that worlds without confusions stay what they were
    objects = len(world.category)
    other = (world.category + rng.integers(1, categories, objects)) % categories
    prone = rng.random(objects) < config.confused_objects
    mistaken = (source >= 0) & prone[source] & (rng.random(len(source)) < config.confusion_rate)
    return np.where(mistaken, other[source], kind)


def simulate_sequence(
    truth: Float[np.ndarray, "n 4 4"],
    rng: np.random.Generator,
    *,
    world: WorldConfig | None = None,
    detector: DetectorConfig | None = None,
    odometry_rotation_scale: float = 0.004,
    odometry_translation_ratio: float = 0.01,
) -> SimulatedSequence:
    """World, odometry and detections on a true trajectory, all from one generator."""
    objects = simulate_world(truth, world or WorldConfig(), rng)
    odometry = simulate_odometry(truth, rng, rotation_scale=odometry_rotation_scale, translation_ratio=odometry_translation_ratio)
    table, source = simulate_detections(truth, objects, detector or DetectorConfig(), rng)
    return SimulatedSequence(truth=truth, odometry=odometry, observations=table, object_of=source, world=objects)


def simulate_circuit(
    rng: np.random.Generator, *, laps: int = 2, radius: float = 40.0, frames_per_lap: int = 100
) -> Float[np.ndarray, "n 4 4"]:
    """A level camera driving on a slightly wavy circle, looking ahead: a small world for tests and tutorials."""
    angle = np.linspace(0.0, 2 * np.pi * laps, laps * frames_per_lap, endpoint=False)
    wave = 1.0 + 0.1 * np.sin(3 * angle + rng.uniform(0, 2 * np.pi))
    position = radius * wave[:, None] * np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    ahead = np.gradient(position, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    down = np.tile([0.0, 1.0, 0.0], (len(angle), 1))
    R = np.stack([np.cross(down, ahead), down, ahead], axis=-1)
    T = make_pose(R, position)
    return inverse(T[0]) @ T


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
