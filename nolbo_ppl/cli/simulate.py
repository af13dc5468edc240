"""`nolbo simulate`: a simulated world of objects, a drive through it, drifting odometry and a detector's mistakes.

Writes what `nolbo slam` reads, with the truth beside it: odometry.txt, observations.jsonl, truth.txt, objects.json (true object
of each detection, true pose of each object) and source.json. Everything is a function of the options and the seed.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from nolbo_ppl.data.converters.converted import Converted, write_converted
from nolbo_ppl.data.simulate import (
    DetectorConfig,
    SimulatedSequence,
    WorldConfig,
    simulate_detections,
    simulate_odometry,
    simulate_world,
)
from nolbo_ppl.data.simulated_paths import circle, figure_of_eight, room, straight
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.io.files import read_json_object
from nolbo_ppl.io.output_folder import output_folder
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory
from nolbo_ppl.structures.detections import Detections

RESULT = ("odometry.txt", "truth.txt", "observations.jsonl", "objects.json", "source.json")
"""Files of a simulated drive."""


@dataclass(frozen=True)
class OdometryNoise:
    """White noise and bias of the odometry's steps."""

    rotation_scale: float = 0.004
    """Standard deviation of each angle of a step, rad."""
    translation_scale: float = 0.0
    """Standard deviation of each coordinate of a step, m."""
    translation_ratio: float = 0.01
    """The same in m per m of the step; both add in quadrature."""
    length_factor: float = 1.0
    """Factor on the length of every step: the scale error of a monocular camera, a worn wheel."""
    scale_drift: float = 0.0
    """Standard deviation of the change of that factor's log from one step to the next: monocular odometry whose scale drifts."""
    planar: bool = False
    """Turn about the vertical and move in the horizontal plane only."""


@dataclass(frozen=True)
class SimulateConfig:
    """A world, a path through it, what the odometry and the detector say of it."""

    out: Path
    """Folder for odometry.txt, observations.jsonl, truth.txt, objects.json, source.json."""
    path: Literal["circle", "straight", "eight", "room"] = "circle"
    """Shape of the path; `--trajectory` takes one from a file instead."""
    trajectory: Path | None = None
    """True poses (KITTI or TUM), in place of `path`."""
    frames: int = 400
    """Frames of the path."""
    laps: int = 2
    """Laps of a circle or an eight."""
    radius: float = 40.0
    """Radius of a circle, half the length of an eight, reach of a room, m."""
    length: float = 400.0
    """Length of a straight path, m."""
    identical: bool = False
    """All objects of a category have one and the same shape latent: look-alikes."""
    state_scales: bool = True
    """Whether the observations state their standard deviations; else `slam` has to estimate them."""
    world: WorldConfig = field(default_factory=lambda: WorldConfig(objects=100))
    """The objects."""
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    """What the detector sees, misses, invents and confuses."""
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    """Noise of the odometry."""
    seed: int = 0
    """Seed of everything that is drawn."""


def check(config: SimulateConfig) -> None:
    """Raise `InputError` where an option is out of its range."""
    shares = {
        "--detector.miss-rate": config.detector.miss_rate,
        "--detector.flip-rate": config.detector.flip_rate,
        "--detector.confused-objects": config.detector.confused_objects,
        "--detector.confusion-rate": config.detector.confusion_rate,
    }
    for name, value in shares.items():
        if not 0.0 <= value <= 1.0:
            raise input_error(name, got=value, expected="a probability from 0 to 1")
    positive = {
        "--radius": config.radius,
        "--length": config.length,
        "--detector.maximum-range": config.detector.maximum_range,
        "--odometry.length-factor": config.odometry.length_factor,
    }
    for name, value in positive.items():
        if not (math.isfinite(value) and value > 0):
            raise input_error(name, got=value, expected="a finite number above 0")
    scales = {
        "--detector.clutter-rate": config.detector.clutter_rate,
        "--detector.position-scale": config.detector.position_scale,
        "--detector.position-ratio": config.detector.position_ratio,
        "--detector.latent-scale": config.detector.latent_scale,
        "--odometry.rotation-scale": config.odometry.rotation_scale,
        "--odometry.translation-scale": config.odometry.translation_scale,
        "--odometry.translation-ratio": config.odometry.translation_ratio,
        "--odometry.scale-drift": config.odometry.scale_drift,
    }
    for name, value in scales.items():
        if not (math.isfinite(value) and value >= 0):
            raise input_error(name, got=value, expected="a finite number, 0 or more")
    counts = {"--frames": (config.frames, 2), "--laps": (config.laps, 1), "--world.categories": (config.world.categories, 1)}
    for name, (count, least) in counts.items():
        if count < least:
            raise input_error(name, got=count, expected=f"at least {least}")
    if config.world.objects < 0 or config.world.latent_dim < 0 or config.seed < 0:
        raise input_error("objects, dimension of the latent or seed", got="a negative number", expected="0 or more")
    if not all(0.0 < mean < 1.0 for mean in config.detector.objectness):
        raise input_error("--detector.objectness", got=config.detector.objectness, expected="two means between 0 and 1")


def true_path(config: SimulateConfig, rng: np.random.Generator) -> Float[np.ndarray, "n 4 4"]:
    """The true poses T_world_camera."""
    if config.trajectory is not None:
        return read_trajectory(config.trajectory).T_world_camera
    if config.path == "circle":
        return circle(config.frames, config.laps, config.radius)
    if config.path == "eight":
        return figure_of_eight(config.frames, config.laps, config.radius)
    if config.path == "room":
        return room(config.frames, config.radius, rng)
    return straight(config.frames, config.length)


def simulate(config: SimulateConfig) -> SimulatedSequence:
    """The world and what is said of it, without writing anything.

    Raises:
        InputError: an option out of its range, or a trajectory that cannot be read.
    """
    check(config)
    rng = np.random.default_rng(config.seed)
    truth = true_path(config, rng)
    kind = replace(config.world, instance_scale=0.0) if config.identical else config.world
    world = simulate_world(truth, kind, rng)
    noise = config.odometry
    odometry = simulate_odometry(
        truth,
        rng,
        rotation_scale=noise.rotation_scale,
        translation_scale=noise.translation_scale,
        translation_ratio=noise.translation_ratio,
        planar=noise.planar,
        length_scale=noise.length_factor,
        scale_drift=noise.scale_drift,
    )
    table, source = simulate_detections(truth, world, config.detector, rng)
    if not config.state_scales:
        table = unstated(table)
    return SimulatedSequence(truth, odometry, table, source, world)


def unstated(table: Detections) -> Detections:
    """The detections without their standard deviations."""
    return replace(
        table,
        position_covariance=np.full_like(table.position_covariance, np.nan),
        rotation_scale=np.full_like(table.rotation_scale, np.nan),
        latent_scale=np.full_like(table.latent_scale, np.nan),
    )


def run(config: SimulateConfig) -> SimulatedSequence:
    """Simulate and write the folder.

    Raises:
        InputError: an option out of its range, a trajectory that cannot be read, or a folder that holds something else.
    """
    drive = simulate(config)
    assert drive.world is not None
    poses = make_pose(drive.world.rotation, drive.world.position)
    data = Converted(
        odometry=Trajectory(drive.odometry),
        truth=Trajectory(drive.truth),
        observations=drive.observations,
        objects=tuple(None if k < 0 else f"o{k}" for k in drive.object_of),
        trusted=np.ones(len(drive.truth), dtype=bool),
        T_world_object={f"o{k}": pose for k, pose in enumerate(poses)},
        categories={f"o{k}": f"c{c}" for k, c in enumerate(drive.world.category)} if drive.world.latent.shape[1] else {},
        latents={f"o{k}": z for k, z in enumerate(drive.world.latent) if len(z)},
        source={"simulated": {**asdict(config), "out": None, "trajectory": str(config.trajectory or "") or None}},
    )
    with output_folder(config.out, RESULT, is_own=is_simulated, inputs=(config.trajectory,)) as folder:
        write_converted(folder, data)
    return drive


def is_simulated(folder: Path) -> bool:
    """Whether a folder holds a simulated drive that another may replace."""
    file = folder / "source.json"
    return file.is_file() and "simulated" in read_json_object(file)


def main(args: Sequence[str] | None = None) -> None:
    """Parse the command line, simulate and say what was written."""
    import tyro

    config = tyro.cli(SimulateConfig, args=args, prog="nolbo simulate", description=__doc__)
    drive = run(config)
    assert drive.world is not None
    clutter = int((drive.object_of < 0).sum())
    sys.stdout.write(
        f"{config.out}: {len(drive.truth)} frames, {len(drive.world.position)} objects, "
        f"{len(drive.observations)} detections, {clutter} of them false\n"
    )


if __name__ == "__main__":
    main()
