"""A small run folder: a camera drives twice around a square with eight objects outside; slam is really run."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from nolbo_ppl.cli.slam import SlamRunConfig, run
from nolbo_ppl.data.simulate import (
    R_WORLD_UPRIGHT,
    DetectorConfig,
    SimulatedSequence,
    SimulatedWorld,
    simulate_detections,
    simulate_odometry,
)
from nolbo_ppl.geometry.pose import inverse, make_pose, so3_exp
from nolbo_ppl.geometry.voxels import voxel_centres
from nolbo_ppl.inference.slam.landmark_shapes import write_voxels
from nolbo_ppl.io.files import read_json, write_json, write_jsonl
from nolbo_ppl.io.observations import write_observations
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory

FRAMES, OBJECTS, LAPS, SIDE = 40, 8, 2, 12.0
NAMES = ("car", "chair", "bus", "bicycle")


def square() -> np.ndarray:
    """A camera that drives around a square, turning over the middle of each corner; the world is its first frame."""
    along = np.arange(FRAMES) * (4 * LAPS / FRAMES) + 0.5
    side, share = np.floor(along).astype(int), along % 1.0
    corner = SIDE * np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]])
    xz = corner[side % 4] * (1 - share[:, None]) + corner[(side + 1) % 4] * share[:, None]
    turn = np.clip((share - 0.75) / 0.5, 0, 1) + np.clip((share + 0.25) / 0.5, 0, 1) - 1.0  # half a turn on either side
    heading = (side + turn) * np.pi / 2
    T = make_pose(so3_exp(heading[:, None] * np.array([0.0, 1.0, 0.0])), np.stack([xz[:, 0], np.zeros(FRAMES), xz[:, 1]], 1))
    return inverse(T[0]) @ T


@cache
def drive() -> SimulatedSequence:
    """The drive: truth, odometry, detections."""
    rng = np.random.default_rng(3)
    truth = square()
    around = np.arange(OBJECTS) * 2 * np.pi / OBJECTS + 0.3
    centre = truth[:, :3, 3].mean(axis=0)
    position = centre + (SIDE / 2 + 4.0) * np.stack([np.cos(around), np.full(OBJECTS, 0.05), np.sin(around)], axis=1)
    category = np.arange(OBJECTS) % len(NAMES)
    means = 3.0 * rng.standard_normal((len(NAMES), 4))
    rotation = R_WORLD_UPRIGHT @ so3_exp(rng.uniform(-np.pi, np.pi, (OBJECTS, 1)) * np.array([0.0, 0.0, 1.0]))
    world = SimulatedWorld(position, rotation, category, means[category] + rng.standard_normal((OBJECTS, 4)), means)
    odometry = simulate_odometry(truth, rng, rotation_scale=0.02, translation_ratio=0.03, planar=True)
    detector = DetectorConfig(field_of_view=2.2, minimum_range=1.0, maximum_range=14.0, clutter_rate=0.1, miss_rate=0.1)
    table, source = simulate_detections(truth, world, detector, rng)
    names = tuple(None if c is None else NAMES[int(c[1:])] for c in table.category)
    size = np.where(source[:, None] >= 0, np.array([1.2, 2.4, 1.0]), np.nan)
    return SimulatedSequence(truth, odometry, replace(table, category=names, size=size), source, world)


def make_slam(folder: Path) -> Path:
    """Only what `nolbo slam` takes and writes: inputs in `folder`, its output in `folder/slam`."""
    made = drive()
    write_trajectory(folder / "odometry.txt", Trajectory(made.odometry))
    write_trajectory(folder / "truth.txt", Trajectory(made.truth))
    write_observations(folder / "observations.jsonl", made.observations)
    run(SlamRunConfig(folder / "odometry.txt", folder / "observations.jsonl", folder / "slam", truth=folder / "truth.txt"))
    return folder / "slam"


def blob(extent: tuple[float, float, float], n: int = 16) -> np.ndarray:
    """Occupancy of a soft ellipsoid with a cabin on top."""
    axis = voxel_centres(n)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    body = (x / extent[0]) ** 2 + (y / extent[1]) ** 2 + ((z + 0.05) / extent[2]) ** 2
    cabin = (x / extent[0] * 1.3) ** 2 + ((y - 0.05) / extent[1] * 2) ** 2 + ((z - 0.1) / extent[2] * 1.3) ** 2
    return 1 / (1 + np.exp(9 * (np.minimum(body, cabin) - 1)))


def make_run(folder: Path) -> Path:
    """A complete run folder, as `nolbo run` leaves it."""
    make_slam(folder)
    made, rng = drive(), np.random.default_rng(0)
    landmarks = read_json(folder / "slam" / "landmarks.json")
    (folder / "images").mkdir()
    (folder / "crops").mkdir()
    for t in range(FRAMES):
        ramp = np.linspace(90, 200, 48)[:, None, None] + 40 * np.sin(t / 3 + np.linspace(0, 6, 96))[None, :, None]
        pixels = ramp * np.array([0.8, 0.9, 1.0]) + rng.normal(0, 4, (48, 96, 3))
        Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8)).save(folder / "images" / f"{t:06d}.png")
    for k, row in enumerate(landmarks):
        pixels = np.clip(np.linspace(60, 220, 64)[:, None, None] * np.array([1.0, 0.4 + 0.1 * (k % 5), 0.5]), 0, 255)
        Image.fromarray(np.tile(pixels, (1, 80, 1)).astype(np.uint8)).save(folder / "crops" / f"{row['name']}.png")
    (folder / "crops" / "views").mkdir()
    listed = {}
    for k, row in enumerate(landmarks[:-1]):  # nobody cut the views of the last one out
        for t in range(3):
            Image.new("RGB", (64, 40), (40 * t, 30 * (k % 6), 90)).save(folder / "crops" / "views" / f"{k}-{t}.jpg")
        rows = [{"frame": 2 * t, "file": f"{k}-{t}.jpg", "weight": 0.5 if t == 1 else 1.0, "objectness": 0.9} for t in range(3)]
        listed[row["name"]] = {"count": 7 if k == 0 else 3, "views": rows}
    write_json(folder / "crops" / "views.json", listed)
    shapes = {row["name"]: blob((0.2, 0.4, 0.16 + 0.02 * (k % 3))) for k, row in enumerate(landmarks[:-1])}
    write_voxels(folder / "slam" / "landmarks_voxels.npz", {name: (mean, mean * (1 - mean) / 2) for name, mean in shapes.items()})
    write_jsonl(
        folder / "frames.jsonl",
        [{"frame": t, "image": f"images/{t:06d}.png", "index": 3 * t, "time": 0.3 * t} for t in range(FRAMES)],
    )
    write_json(folder / "intrinsics.json", {"fx": 48.0, "fy": 48.0, "cx": 48.0, "cy": 24.0, "width": 96, "height": 48})
    names = [None if o < 0 else f"O{o}" for o in made.object_of]
    write_json(folder / "objects.json", {"objects": dict(zip(made.observations.id, names))})
    slam = json.loads((folder / "slam" / "summary.json").read_text(encoding="utf-8"))
    write_json(
        folder / "run.json",
        {
            "command": ["nolbo", "run", "--images", "<drive>"],
            "configuration": {"model": "tiny", "loop_gap": 10, "slam": {"samples": 64}},
            "versions": {"nolbo-ppl": "0.1.0"},
            "seconds": {"observe": 3.2, "slam": 1.1},
            "complete": ["observe", "slam"],
        },
    )
    write_json(
        folder / "summary.json",
        {
            "frames": FRAMES,
            "before": slam["before"],
            "after": slam["after"],
            "oracle": {"ate": 0.9 * slam["after"]["ate"]},
            "observation_scores": {
                "recall": 0.91,
                "position_error": {"all": {"median": 0.2, "p90": 0.5}, "0-5 m": {"median": 0.1}},
            },
            "images_per_second": 12.5,
            "warnings": [],
        },
    )
    return folder
