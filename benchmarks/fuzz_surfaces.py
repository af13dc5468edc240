"""Kinds of files for `fuzz.py`: the project's own, each with a good example and what reads it."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Surface:
    """A kind of file: its name, a good example, and what reads it."""

    name: str
    good: bytes
    read: Callable[[Path], Any]
    beside: tuple[tuple[str, bytes], ...] = ()
    """Files that lie beside it."""
    missing: bool = False
    """Whether NaN stands for what a file may leave out."""


def own_surfaces() -> list[Surface]:
    """Files that this project writes or reads as its own."""
    from PIL import Image

    from nolbo_ppl.data.dataset_folder import SceneFolder
    from nolbo_ppl.inference.posterior.model_folder import read_model_config
    from nolbo_ppl.io.camera_files import read_camera
    from nolbo_ppl.io.images import open_image
    from nolbo_ppl.io.npz import read_voxels, save_npz
    from nolbo_ppl.io.observations import read_observations
    from nolbo_ppl.io.tensors import load_tensors, save_tensors
    from nolbo_ppl.io.text import read_lengths, read_times
    from nolbo_ppl.io.trajectories import read_covariance, read_trajectory
    from nolbo_ppl.models.model_config import nano
    from nolbo_ppl.synthetic.worlds.sequence_reader import read_objects

    def encoded(image: np.ndarray, kind: str) -> bytes:
        buffer = io.BytesIO()
        Image.fromarray(image).save(buffer, kind)
        return buffer.getvalue()

    def written(write: Callable[[Path], None]) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder) / "file")
            return next(Path(folder).iterdir()).read_bytes()

    def lines(rows: list[dict[str, Any]]) -> bytes:
        return "".join(json.dumps(row) + "\n" for row in rows).encode()

    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    png = encoded(picture, "PNG")
    eye = [1.0, 0.0, 0.0, 0.5, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0]
    kitti = "".join(" ".join(map(str, [*eye[:11], k])) + "\n" for k in range(6)).encode()
    tum = b"# time x y z qx qy qz qw\n" + "".join(f"{k}.25 {k} 0 0 0 0 0 1\n" for k in range(6)).encode()
    mode = {"weight": 0.5, "rotation": [0, 0, 0, 1], "std": 0.1}
    detection = {"frame": 1, "position": [0.5, 0.1, 4.0], "position_std": 0.1, "rotation": [0, 0, 0, 1], "rotation_std": 0.1}
    detection |= {"rotation_modes": [mode, mode], "latent": [0.1, -0.2], "latent_std": 0.5, "objectness": 0.9}
    detection |= {"category": "chair", "size": [0.5, 0.5, 1.0], "symmetry": 1}
    thing = {"box": [4, 4, 30, 30], "category": "chair", "rotation": [0, 0, 0, 1], "position": [0.1, 0.0, 3.0], "size": 1.0}
    scene = {"image": "images/a.png", "intrinsics": [50, 50, 32, 24], "objects": [thing, {**thing, "visibility": 0.5}]}
    camera = {"fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48}
    known = {"id": "a", "category": "car", "instance": "car-1", "symmetry": 1, "T_world_object": np.eye(4).tolist()}
    known |= {"diagonal": 4.0, "dimensions": [1.0, 2.0, 3.0], "moving": False}
    voxels = {"car-1": rng.integers(0, 256, 4096, dtype=np.uint8), "car-2": np.zeros(4096, np.uint8)}
    tensors = {"a": np.ones((3, 4), np.float32), "b": np.arange(5.0)}

    def store_tensors(path: Path) -> None:
        import torch

        save_tensors(path, {name: torch.from_numpy(value) for name, value in tensors.items()}, {"step": 1})

    return [
        Surface(
            "observations.jsonl",
            lines([detection, {**detection, "frame": 2, "id": "b"}]),
            lambda p: read_observations(p, 6),
            missing=True,
        ),
        Surface("kitti.txt", kitti, read_trajectory),
        Surface("tum.txt", tum, read_trajectory),
        Surface("covariance.npz", written(lambda p: save_npz(p, {"covariance": np.tile(np.eye(6), (5, 1, 1))})), read_covariance),
        Surface("intrinsics.json", json.dumps(camera).encode(), read_camera),
        Surface("intrinsics.txt", b"50 50 32 24\n", read_camera),
        Surface("times.txt", b"0.0\n0.1\n0.2\n", read_times),
        Surface("wheel.txt", b"0.5\n0.1\n0.2\n", read_lengths),
        Surface("scenes.jsonl", lines([scene, scene]), lambda p: SceneFolder(p).batch([0]), (("images/a.png", png),)),
        Surface("voxels.npz", written(lambda p: save_npz(p, voxels)), read_voxels),
        Surface("objects.json", json.dumps([known]).encode(), read_objects),
        Surface("a.png", png, open_image),
        Surface("a.jpg", encoded(picture, "JPEG"), open_image),
        Surface("a.tiff", encoded(picture[..., 0].astype(np.uint16) * 200, "TIFF"), open_image),
        Surface("a.ppm", encoded(picture, "PPM"), open_image),
        Surface("a.webp", encoded(picture, "WEBP"), open_image),
        Surface(
            "config.json",
            json.dumps({"model": nano().to_json(), "calibration": {"shape_scale": 1.0}}).encode(),
            read_model_config,
        ),
        Surface("model.safetensors", written(store_tensors), lambda p: load_tensors(p)[1]),
        *run_surfaces(),
    ]


def run_surfaces() -> list[Surface]:
    """Files of a run, read by the report."""
    from nolbo_ppl.report import read_run

    landmark = {"name": "L0", "position": [1.0, 0.0, 3.0], "position_covariance": np.eye(3).tolist(), "existence": 0.9}
    landmark |= {"detections": 3.0, "first_frame": 0, "last_frame": 3, "rotation": [0, 0, 0, 1], "category": "chair"}
    landmark |= {"class_posterior": {"chair": 0.9, "sofa": 0.1}, "size": [1.0, 1.0, 1.0]}
    way = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(4)).encode()
    rows = "".join(
        json.dumps({"id": f"d{k}", "landmarks": {"L0": 0.9}, "new": 0.05, "background": 0.05}) + "\n" for k in range(3)
    )
    frames = "".join(json.dumps({"frame": k, "image": f"{k}.png", "index": k, "time": 0.1 * k}) + "\n" for k in range(4))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, T_world_camera=np.tile(np.eye(4, dtype=np.float32), (2, 4, 1, 1)), landmarks_0=np.zeros((1, 3)))
    files = {
        "trajectory.txt": way,
        "landmarks.json": json.dumps([landmark]).encode(),
        "associations.jsonl": rows.encode(),
        "frames.jsonl": frames.encode(),
        "iterations.npz": buffer.getvalue(),
        "summary.json": json.dumps({"warnings": ["x"], "iterations": [{"change": 1.0}], "before": {"ate": 1.0}}).encode(),
    }

    def read(path: Path) -> Any:
        run = read_run(path.parent)
        return run.estimate, run.iterations, run.landmarks, run.associations

    beside = {name: tuple((other, content) for other, content in files.items() if other != name) for name in files}
    return [Surface(name, files[name], read, beside[name], missing=True) for name in files]
