"""A drive on disk without a renderer, and a model that knows it: everything but pictures and networks is as in a real run."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.geometry.pose import inverse, make_pose, matrix_to_quaternion, transform
from nolbo_ppl.geometry.rotation import egocentric_to_allocentric, matrix_to_viewpoint
from nolbo_ppl.geometry.voxels import pack_voxels, voxel_centres
from nolbo_ppl.io.observations import Detections
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors, ViewpointModes

CAMERA = np.array([100.0, 100.0, 96.0, 48.0])
SIZE = (192, 96)
DIAGONAL = 2.0
CATEGORIES = ("bus", "car", "chair")


def ellipsoids(latent: np.ndarray) -> np.ndarray:
    """Occupancy of ellipsoids whose radii follow from the latent: a decoder that is exact."""
    radius = 0.12 + 0.3 / (1 + np.exp(-latent[:, :3] / 3))
    x, y, z = np.meshgrid(*[voxel_centres(32)] * 3, indexing="ij")
    squared = sum((axis / radius[:, i, None, None, None]) ** 2 for i, axis in enumerate((x, y, z)))
    return 1 / (1 + np.exp(12 * (squared - 1)))


def boxes_of(position: np.ndarray) -> np.ndarray:
    """Image boxes of balls of that diagonal, cut to the image."""
    pixel = CAMERA[2:] + CAMERA[:2] * position[:, :2] / position[:, 2:]
    half = CAMERA[:2] * DIAGONAL / 2 / position[:, 2:]
    return np.clip(np.concatenate([pixel - half, pixel + half], axis=1), 0, [*SIZE, *SIZE])


@dataclass
class KnowingModel:
    """Answers with the simulated detections of the frame that is written into an image's first pixel."""

    table: Detections
    latents: np.ndarray
    calls: int = 0
    calibration: Calibration = field(default_factory=Calibration)

    def observe(self, images: Any, intrinsics: Any = None, **options: Any) -> list[ObjectPosteriors]:
        self.calls += 1
        assert options["decode"] is False and len(images) <= options["batch"]
        np.testing.assert_allclose(intrinsics, CAMERA)
        return [self.one(int(image[0, 0, 0]) * 256 + int(image[0, 0, 1]), options["threshold"]) for image in images]

    def one(self, frame: int, threshold: float) -> ObjectPosteriors:
        table = self.table
        rows = np.flatnonzero((table.frame == frame) & (table.objectness > threshold))
        n = len(rows)
        R = table.rotation[rows]
        allocentric = egocentric_to_allocentric(torch.from_numpy(R), torch.from_numpy(table.position[rows]))
        viewpoint = matrix_to_viewpoint(allocentric).numpy().reshape(n, 3)
        label = np.array([CATEGORIES.index(str(table.category[k])) for k in rows], dtype=np.int64)
        log = np.log(np.where(np.arange(len(CATEGORIES)) == label[:, None], 0.9, 0.05)).reshape(n, len(CATEGORIES))
        scale = table.rotation_scale[rows]
        return ObjectPosteriors(
            categories=CATEGORIES,
            objectness=table.objectness[rows],
            box=boxes_of(table.position[rows]),
            box_scale=np.ones((n, 4)),
            class_log_posterior=log,
            class_log_likelihood=log,
            instance_log_posterior=None,
            latent=table.latent[rows],
            latent_scale=table.latent_scale[rows],
            position=table.position[rows],
            position_covariance=table.position_covariance[rows],
            viewpoint_modes=ViewpointModes(
                np.tile([0.9, 0.1], (n, 1)),
                viewpoint[:, :1] + [[0.0, np.pi]],
                np.repeat(1 / scale[:, None] ** 2, 2, axis=1),
            ),
            elevation_inplane=viewpoint[:, 1:],
            elevation_inplane_scale=np.repeat(scale[:, None], 2, axis=1),
            viewpoint=viewpoint,
            R_camera_object=R,
            rotation_scale=scale,
            diagonal=np.full(n, DIAGONAL),
            diagonal_log_scale=np.full(n, 0.1),
            size=np.full((n, 3), DIAGONAL / 3**0.5),
            voxel_mean=None,
            voxel_variance=None,
        )

    def decode(self, latent: np.ndarray) -> np.ndarray:
        return ellipsoids(np.asarray(latent))

    def shape_posterior(self, packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        true = pack_voxels(ellipsoids(self.latents) > 0.5)
        index = [int(np.flatnonzero((true == one).all(axis=1))[0]) for one in packed]
        return self.latents[index], np.full((len(index), self.latents.shape[1]), 0.1)


@dataclass(frozen=True)
class SimulatedDrive:
    """The folder and who knows it."""

    folder: Path
    model: KnowingModel
    truth: np.ndarray
    object_of: np.ndarray


def frame_objects(position: np.ndarray, R: np.ndarray, seen: np.ndarray, category: np.ndarray) -> list[dict[str, Any]]:
    """Objects of one line of scenes.jsonl."""
    box = boxes_of(position[seen]) if len(seen) else np.zeros((0, 4))
    return [
        {
            "id": f"O{i}",
            "category": CATEGORIES[category[i]],
            "instance": f"shape-{i}",
            "box": box[k].tolist(),
            "rotation": matrix_to_quaternion(R[i]).tolist(),
            "position": position[i].tolist(),
            "size": DIAGONAL,
            "visibility": 1.0,
            "symmetry": 1,
        }
        for k, i in enumerate(seen)
    ]


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> SimulatedDrive:
    """Two laps of a circle among twenty objects, in the format of `nolbo drive`, with odometry that drifts."""
    folder = tmp_path_factory.mktemp("drive")
    rng = np.random.default_rng(3)
    simulated = simulate_sequence(
        simulate_circuit(rng, laps=2, frames_per_lap=60, radius=15.0),
        rng,
        world=WorldConfig(objects=20, categories=3, latent_dim=4, lateral=(3.0, 7.0)),
        detector=DetectorConfig(
            maximum_range=16.0, clutter_rate=0.1, flip_rate=0.0, latent_scale=0.6, position_scale=0.04, position_ratio=0.008
        ),
        odometry_rotation_scale=0.006,
    )
    world, truth = simulated.world, simulated.truth
    assert world is not None
    (folder / "images").mkdir()
    lines = []
    for t, pose in enumerate(truth):
        image = np.random.default_rng(t).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
        image[0, 0] = t // 256, t % 256, 0
        Image.fromarray(image).save(folder / "images" / f"{t:06d}.png")
        position = transform(inverse(pose), world.position)
        R = pose[:3, :3].T @ world.rotation
        distance = np.linalg.norm(position, axis=1)
        seen = (distance > 2) & (distance < 16) & (position[:, 2] > 0) & (np.abs(position[:, 0]) < 0.95 * position[:, 2])
        objects = frame_objects(position, R, np.flatnonzero(seen), world.category)
        lines.append({"image": f"images/{t:06d}.png", "intrinsics": CAMERA.tolist(), "objects": objects})
    (folder / "scenes.jsonl").write_text("\n".join(json.dumps(line) for line in lines) + "\n")
    things = [
        {
            "id": f"O{i}",
            "category": CATEGORIES[world.category[i]],
            "instance": f"shape-{i}",
            "symmetry": 1,
            "diagonal": DIAGONAL,
            "T_world_object": make_pose(world.rotation[i], world.position[i]).tolist(),
            "dimensions": [0.8, 0.8, 0.8],
            "moving": False,
        }
        for i in range(len(world.position))
    ]
    (folder / "objects.json").write_text(json.dumps(things))
    packed = pack_voxels(ellipsoids(world.latent) > 0.5)
    np.savez_compressed(folder / "voxels.npz", **{f"shape-{i}": row for i, row in enumerate(packed)})
    camera = {**dict(zip(("fx", "fy", "cx", "cy"), CAMERA.tolist())), "width": SIZE[0], "height": SIZE[1]}
    (folder / "intrinsics.json").write_text(json.dumps(camera))
    (folder / "times.txt").write_text("\n".join(f"{0.1 * t:.3f}" for t in range(len(truth))) + "\n")
    write_trajectory(folder / "truth.txt", Trajectory(truth))
    write_trajectory(folder / "odometry.txt", Trajectory(simulated.odometry))
    (folder / "drive.json").write_text("{}")
    table = simulated.observations
    table = replace(table, category=tuple(CATEGORIES[int(str(name)[1:])] for name in table.category))
    return SimulatedDrive(folder, KnowingModel(table, world.latent), truth, simulated.object_of)
