"""What cameras do to a picture after the light has reached the lens: motion, vignetting, compression."""

from __future__ import annotations

import io

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from nolbo_ppl.io.images import open_image

LOSSLESS = 100
"""Quality at which nothing is compressed."""


def motion_blurred(colour: Float[np.ndarray, "h w 3"], path: Float[np.ndarray, " 2"]) -> Float[np.ndarray, "h w 3"]:
    """Linear light averaged along a straight path (x, y) px of the camera during the exposure; the border goes on outside.

    Example:
        >>> one = np.zeros((1, 5, 3), np.float32); one[0, 2] = 1
        >>> motion_blurred(one, np.array([2.0, 0.0]))[0, :, 0].astype(float).round(2).tolist()
        [0.0, 0.33, 0.33, 0.33, 0.0]
    """
    length = float(np.linalg.norm(path))
    if length < 0.5:
        return colour
    steps = int(np.ceil(length)) + 1
    height, width = colour.shape[:2]
    pad = int(np.ceil(np.abs(path).max() / 2)) + 1
    padded = np.pad(colour, ((pad, pad), (pad, pad), (0, 0)), mode="edge")
    total = np.zeros_like(colour)
    for share in np.linspace(-0.5, 0.5, steps):
        x, y = share * path
        x0, y0 = int(np.floor(x)), int(np.floor(y))
        fx, fy = np.float32(x - x0), np.float32(y - y0)
        for dy, wy in ((0, 1 - fy), (1, fy)):
            for dx, wx in ((0, 1 - fx), (1, fx)):
                if wx * wy > 0:
                    top, left = pad + y0 + dy, pad + x0 + dx
                    total += np.float32(wx * wy) * padded[top : top + height, left : left + width]
    return total / np.float32(steps)


def vignetted(colour: Float[np.ndarray, "h w 3"], loss: float) -> Float[np.ndarray, "h w 3"]:
    """Linear light that falls off with the square of the distance from the middle, by `loss` of it in the corners.

    Example:
        >>> out = vignetted(np.ones((3, 3, 3), np.float32), 0.5)
        >>> float(out[1, 1, 0]), round(float(out[0, 0, 0]), 3)
        (1.0, 0.778)
    """
    if loss <= 0:
        return colour
    height, width = colour.shape[:2]
    y = (np.arange(height) + 0.5 - height / 2) / (height / 2)
    x = (np.arange(width) + 0.5 - width / 2) / (width / 2)
    squared = (x[None, :] ** 2 + y[:, None] ** 2) / 2
    return colour * (1 - loss * squared).astype(colour.dtype)[..., None]


def compressed(image: UInt8[np.ndarray, "h w 3"], quality: int) -> UInt8[np.ndarray, "h w 3"]:
    """The image after JPEG of this quality, 1 to 99; as it is at `LOSSLESS`."""
    if quality >= LOSSLESS:
        return image
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=quality)
    stream.seek(0)
    return open_image(stream, label="the compressed image")
