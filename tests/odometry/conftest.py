"""A box of textured walls seen along a path: images with known motion, drawn ray by ray."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from nolbo_ppl.geometry.pose import make_pose, so3_exp

INTRINSICS = np.array([200.0, 200.0, 192.0, 96.0])
HEIGHT, WIDTH = 192, 384
SUPER = 2
CAMERA_HEIGHT = 1.5


def texture(rng: np.random.Generator, side: int = 1024) -> np.ndarray:
    """Noise of several wavelengths, grey, with coloured tint."""
    total = np.zeros((side, side), dtype=np.float32)
    for cells, weight in ((16, 1.0), (64, 1.0), (256, 1.0), (512, 0.5)):
        noise = rng.uniform(-1, 1, (cells, cells)).astype(np.float32)
        total += weight * cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)
    total = np.clip(127 + 55 * total, 0, 255)
    return (total[..., None] * rng.uniform(0.7, 1.0, 3)).astype(np.float32)


@dataclass
class Room:
    """Six textured planes about the origin, y down; the floor is `CAMERA_HEIGHT` below it."""

    T_world_camera: np.ndarray
    textures: list[np.ndarray]
    half: tuple[float, float] = (6.0, 20.0)
    noise: float = 2.0
    seed: int = 0

    def __len__(self) -> int:
        return len(self.T_world_camera)

    def frame(self, k: int, /) -> np.ndarray:
        """The image of a pose: nearest plane along each ray, texture looked up, a little noise."""
        T = self.T_world_camera[k]
        v, u = (np.mgrid[0 : SUPER * HEIGHT, 0 : SUPER * WIDTH].astype(np.float32) + np.float32(0.5)) / SUPER
        ray = np.stack([(u - INTRINSICS[2]) / INTRINSICS[0], (v - INTRINSICS[3]) / INTRINSICS[1], np.ones_like(u)], -1)
        ray = (ray @ T[:3, :3].T).astype(np.float32)
        origin = T[:3, 3]
        planes = [(0, self.half[0]), (0, -self.half[0]), (1, CAMERA_HEIGHT), (1, -4.0), (2, self.half[1]), (2, -self.half[1])]
        nearest = np.full(u.shape, np.inf)
        image = np.zeros((*u.shape, 3), dtype=np.float32)
        for (axis, at), plane in zip(planes, self.textures):
            with np.errstate(divide="ignore", invalid="ignore"):
                way = (at - origin[axis]) / ray[..., axis]
            hit = (way > 0) & (way < nearest)
            point = origin + np.where(hit, way, 0.0)[..., None] * ray
            a, b = [i for i in range(3) if i != axis]
            scale = 24.0  # texels a metre
            x = np.mod(point[..., a] * scale, plane.shape[1] - 1).astype(np.float32)
            y = np.mod(point[..., b] * scale, plane.shape[0] - 1).astype(np.float32)
            colour = cv2.remap(plane, x, y, cv2.INTER_LINEAR)
            image[hit] = colour[hit]
            nearest = np.where(hit, way, nearest)
        image = image.reshape(HEIGHT, SUPER, WIDTH, SUPER, 3).mean(axis=(1, 3))
        rng = np.random.default_rng([self.seed, k])
        return np.clip(image + rng.normal(0, self.noise, image.shape), 0, 255).astype(np.uint8)


def make_room(T_world_camera: np.ndarray, seed: int = 0) -> Room:
    rng = np.random.default_rng(seed)
    return Room(T_world_camera, [texture(rng) for _ in range(6)], seed=seed)


def weaving(steps: int, length: float, turn: float) -> np.ndarray:
    """A level path forward that weaves left and right; the camera nods a little."""
    phase = np.arange(steps + 1) * 2 * np.pi / 16
    heading, nod = 2.5 * turn * np.sin(phase), 0.15 * turn * np.sin(2.3 * phase)
    zero = np.zeros_like(phase)
    ways = length * np.column_stack([np.sin(heading), zero, np.cos(heading)])[:-1]
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(ways, axis=0)]) + [0, 0, -15]
    yaw, pitch = (so3_exp(np.column_stack(axes)) for axes in ((zero, heading, zero), (nod, zero, zero)))
    return make_pose(yaw @ pitch, position)


@pytest.fixture(scope="session")
def room() -> Room:
    return make_room(weaving(17, 0.4, 0.03))
