"""The pinhole camera: x right, y down, z forward; intrinsics [fx, fy, cx, cy] in pixels.

Image coordinates are continuous: the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


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
