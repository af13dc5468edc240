"""One picture as a square of the size a classifier looks at: a random part of it in training, its middle otherwise."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from PIL import Image

MIN_PART = 0.25
"""Least share of a picture's area that a random part has."""
ASPECT = 4 / 3
"""Greatest ratio of the sides of a random part."""
MARGIN = 8 / 7
"""Shorter side of a picture over the part of it that is looked at otherwise: 256 px for 224."""


def random_part(image: UInt8[np.ndarray, "h w 3"], size: int, rng: np.random.Generator) -> UInt8[np.ndarray, "{size} {size} 3"]:
    """A part of random size, place and shape, turned left to right in half of the cases (C. Szegedy et al., 2015)."""
    height, width = image.shape[:2]
    for _ in range(10):
        area = height * width * rng.uniform(MIN_PART, 1.0)
        aspect = np.exp(rng.uniform(-np.log(ASPECT), np.log(ASPECT)))
        w, h = round(np.sqrt(area * aspect)), round(np.sqrt(area / aspect))
        if 0 < w <= width and 0 < h <= height:
            left, top = rng.integers(0, width - w + 1), rng.integers(0, height - h + 1)
            break
    else:
        w = h = min(width, height)
        left, top = (width - w) // 2, (height - h) // 2
    part = _scaled(image[top : top + h, left : left + w], size)
    return part[:, ::-1] if rng.random() < 0.5 else part


def middle_part(image: UInt8[np.ndarray, "h w 3"], size: int) -> UInt8[np.ndarray, "{size} {size} 3"]:
    """The square in the middle, seven eighths of the shorter side."""
    height, width = image.shape[:2]
    side = max(1, round(min(height, width) / MARGIN))
    left, top = (width - side) // 2, (height - side) // 2
    return _scaled(image[top : top + side, left : left + side], size)


def padded_square(image: UInt8[np.ndarray, "h w 3"], size: int) -> UInt8[np.ndarray, "{size} {size} 3"]:
    """The whole picture between grey bars: an object fills it as far as its shape allows."""
    from nolbo_ppl.data.dataset_folder import letterbox

    return letterbox(image, size)[0]


def coloured(image: UInt8[np.ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Brightness, contrast and saturation changed at random."""
    values = image.astype(np.float32)
    grey = values @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    values = grey[..., None] + rng.uniform(0.5, 1.5) * (values - grey[..., None])
    values = 127.5 + rng.uniform(0.7, 1.4) * (values - 127.5) + rng.uniform(-25.0, 25.0)
    return values.clip(0, 255).astype(np.uint8)


def _scaled(image: UInt8[np.ndarray, "h w 3"], size: int) -> UInt8[np.ndarray, "{size} {size} 3"]:
    return np.asarray(Image.fromarray(np.ascontiguousarray(image)).resize((size, size), Image.Resampling.BILINEAR))
