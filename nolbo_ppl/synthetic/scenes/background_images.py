"""Pictures behind the objects: photographs of a folder, or pictures drawn at random."""

from __future__ import annotations

from collections import OrderedDict
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from nolbo_ppl._moved import renamed
from nolbo_ppl.io.images import images_of, open_image
from nolbo_ppl.synthetic.renderer import textures
from nolbo_ppl.synthetic.renderer.materials import hsv

LINEAR = (np.arange(256, dtype=np.float32) / 255) ** np.float32(2.2)
"""Linear light of eight-bit display values (gamma 2.2)."""
CACHE_SIZE = 512
"""Decoded photographs held in memory."""


def list_background_images(folder: str | PathLike[str]) -> list[Path]:
    """Pictures of a folder and its sub-folders, sorted by path. Raises `InputError` when there is none."""
    return sorted(images_of(folder, recursive=True))


class BackgroundImages:
    """Crops of the photographs of a folder; decoded ones are kept, at most twice as large as the scenes."""

    def __init__(self, folder: str | PathLike[str], size: int) -> None:
        self.paths = list_background_images(folder)
        self.size = size
        self._kept: OrderedDict[int, UInt8[np.ndarray, "h w 3"]] = OrderedDict()

    def __getstate__(self) -> dict:
        return {**self.__dict__, "_kept": OrderedDict()}

    def _decoded(self, number: int) -> UInt8[np.ndarray, "h w 3"]:
        if number not in self._kept:
            picture = Image.fromarray(open_image(self.paths[number], shorter_side=2 * self.size))
            factor = min(1.0, 2 * self.size / min(picture.size))
            if factor < 1:
                shape = (max(1, round(picture.width * factor)), max(1, round(picture.height * factor)))
                picture = picture.resize(shape, Image.Resampling.BILINEAR, reducing_gap=2.0)
            self._kept[number] = np.asarray(picture)
            if len(self._kept) > CACHE_SIZE:
                self._kept.popitem(last=False)
        return self._kept[number]

    def crop(self, rng: np.random.Generator, height: int, width: int) -> Float[np.ndarray, "{height} {width} 3"]:
        """A random crop of a random photograph, mirrored or not, in linear light."""
        picture = self._decoded(int(rng.integers(len(self.paths))))
        side = int(min(picture.shape[:2]) * rng.uniform(0.45, 1.0))
        top = int(rng.integers(picture.shape[0] - side + 1))
        left = int(rng.integers(picture.shape[1] - side + 1))
        square = Image.fromarray(picture[top : top + side, left : left + side])
        crop = np.asarray(square.resize((width, height), Image.Resampling.BILINEAR, reducing_gap=2.0))
        if rng.random() < 0.5:
            crop = crop[:, ::-1]
        return LINEAR[crop]


def drawn_background(rng: np.random.Generator, height: int, width: int) -> Float[np.ndarray, "{height} {width} 3"]:
    """A picture of nothing: coloured noise with rectangles and ellipses of other noise, in linear light."""
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    u, v = columns / width, rows / height

    def layer(shape: tuple[int, ...], points: np.ndarray) -> np.ndarray:
        frequency = np.exp(rng.uniform(np.log(1.5), np.log(16)))
        stretch = np.exp(rng.normal(0, 0.4, 2))
        mix = textures.fractal_noise(points * frequency * stretch, int(rng.integers(2**31)), 3)[:, None]
        mix = np.clip(0.5 + (mix - 0.5) * rng.uniform(0.5, 2.5), 0, 1)
        hue, spread = rng.random(), rng.uniform(0, 0.25)
        first = np.array(hsv(hue, rng.uniform(0, 0.6), rng.uniform(0.1, 0.9)))
        second = np.array(hsv((hue + spread) % 1, rng.uniform(0, 0.6), rng.uniform(0.1, 0.9)))
        return (first * (1 - mix) + second * mix).reshape(*shape, 3)

    grid = np.stack((u, v), axis=-1)
    picture = layer((height, width), grid.reshape(-1, 2)).astype(np.float32)
    for _ in range(int(rng.integers(0, 9))):
        centre, half, angle = rng.uniform(0, 1, 2), np.exp(rng.uniform(-3.2, -0.9, 2)), rng.uniform(-np.pi, np.pi)
        x = (u - centre[0]) * np.cos(angle) + (v - centre[1]) * np.sin(angle)
        y = (v - centre[1]) * np.cos(angle) - (u - centre[0]) * np.sin(angle)
        x, y = np.abs(x) / half[0], np.abs(y) / half[1]
        inside = (x * x + y * y < 1) if rng.random() < 0.5 else (np.maximum(x, y) < 1)
        if inside.any():
            picture[inside] = layer((int(inside.sum()),), grid[inside])
    return picture


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
