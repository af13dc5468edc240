"""The pinhole camera: x right, y down, z forward; intrinsics [fx, fy, cx, cy] in pixels.

Image coordinates are continuous: the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

GUESSED_FIELD_OF_VIEW = math.radians(60.0)
"""Horizontal view, rad, of a camera of which nobody states anything."""


def guessed_pinhole(width: float, height: float) -> Float[np.ndarray, " 4"]:
    """Intrinsics [fx, fy, cx, cy], px, that are assumed for an image whose camera nobody states.

    >>> guessed_pinhole(200, 100).round(1).tolist()
    [173.2, 173.2, 100.0, 50.0]
    """
    focal = width / (2 * math.tan(GUESSED_FIELD_OF_VIEW / 2))
    return np.array([focal, focal, width / 2, height / 2])


def project(points: Float[Tensor, "*#batch 3"], intrinsics: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch 2"]:
    """Pixels of points in the camera frame (m). Points must lie before the camera (z > 0)."""
    focal, centre = intrinsics[..., :2], intrinsics[..., 2:]
    return focal * points[..., :2] / points[..., 2:] + centre


def pixel_ray(pixels: Float[Tensor, "*#batch 2"], intrinsics: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Unit direction, in the camera frame, of the ray through each pixel."""
    slope = (pixels - intrinsics[..., 2:]) / intrinsics[..., :2]
    ray = torch.cat((slope, torch.ones_like(slope[..., :1])), dim=-1)
    unit: torch.Tensor = ray / torch.linalg.vector_norm(ray, dim=-1, keepdim=True)
    return unit
