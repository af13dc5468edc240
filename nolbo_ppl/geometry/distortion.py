"""Lens distortion: where a camera sees a point, and what its images, points and boxes are without it.

Models and order of the coefficients are OpenCV's: `radial-tangential` k1 k2 p1 p2 [k3], `rational` k1 k2 p1 p2 k3 k4 k5 k6
(with thin-prism and tilt terms: 12 or 14), `fisheye` k1 k2 k3 k4 (equidistant, Kannala and Brandt 2006).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.errors import input_error

DistortionModel = Literal["radial-tangential", "rational", "fisheye"]
COUNTS: dict[str, tuple[int, ...]] = {"radial-tangential": (4, 5), "rational": (8, 12, 14), "fisheye": (4,)}
"""Coefficients of each model."""
EDGE_POINTS = 9
"""Points along each edge of a box that are undistorted: its edges become curves."""
ITERATIONS = 20
"""Newton steps of the inversion; it stops at a millionth of a pixel."""


def _camera(intrinsics: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "3 3"]:
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def distort_points(
    points: Float[np.ndarray, "n 2"], intrinsics: Float[np.ndarray, " 4"], model: DistortionModel, coefficients: tuple[float, ...]
) -> Float[np.ndarray, "n 2"]:
    """Where the lens shows what an ideal pinhole camera of the same intrinsics would show at these pixels."""
    import cv2

    slopes = (np.asarray(points, dtype=np.float64) - intrinsics[2:]) / intrinsics[:2]
    d = np.array(coefficients)
    if model == "fisheye":
        return cv2.fisheye.distortPoints(slopes[:, None], _camera(intrinsics), d)[:, 0]
    rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), _camera(intrinsics), d)[0][:, 0]


def undistort_points(
    points: Float[np.ndarray, "n 2"], intrinsics: Float[np.ndarray, " 4"], model: DistortionModel, coefficients: tuple[float, ...]
) -> Float[np.ndarray, "n 2"]:
    """Where an ideal pinhole camera of the same intrinsics shows what the lens shows at these pixels.

    By Newton's method: OpenCV's own inversion stops after five steps of a fixed point, a pixel off at the corners of wide
    lenses.

    Raises:
        InputError: a pixel beyond what the model can undo (outside the image of a strong lens).

    Example:
        >>> camera = np.array([200.0, 200.0, 160.0, 120.0])
        >>> seen = distort_points(np.array([[20.0, 20.0]]), camera, "radial-tangential", (-0.28, 0.07, 0.0, 0.0))
        >>> undistort_points(seen, camera, "radial-tangential", (-0.28, 0.07, 0.0, 0.0)).round(3).tolist()
        [[20.0, 20.0]]
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    if not len(points):
        return points
    found, step = points.copy(), 1e-3 * intrinsics[:2]
    if model == "fisheye":  # from the equidistant lens: Newton's steps on an arc tangent only converge from near
        slopes = (points - intrinsics[2:]) / intrinsics[:2]
        angle = np.linalg.norm(slopes, axis=1, keepdims=True)
        found = intrinsics[2:] + intrinsics[:2] * slopes * np.tan(np.minimum(angle, 1.5)) / np.maximum(angle, 1e-12)
    for _ in range(ITERATIONS):
        error = distort_points(found, intrinsics, model, coefficients) - points
        if np.abs(error).max() < 1e-6:
            break
        slope = np.stack(
            [
                (
                    distort_points(found + d, intrinsics, model, coefficients)
                    - distort_points(found - d, intrinsics, model, coefficients)
                )
                / (2 * d[k])
                for k, d in enumerate(np.diag(step))
            ],
            axis=2,
        )
        change = np.einsum("nij,nj->ni", np.linalg.pinv(slope), error)
        found = found - np.clip(change, -0.5 * intrinsics[:2], 0.5 * intrinsics[:2])
    error = np.abs(distort_points(found, intrinsics, model, coefficients) - points)
    if not error.max() < 0.1:
        worst = points[int(np.argmax(np.nan_to_num(error, nan=np.inf).max(axis=1)))]
        raise input_error(
            "pixel that the distortion model cannot undo",
            got=np.round(worst, 1).tolist(),
            expected="pixels of the image, a calibration that covers it",
        )
    return found


def undistort_boxes(
    boxes: Float[np.ndarray, "n 4"], intrinsics: Float[np.ndarray, " 4"], model: DistortionModel, coefficients: tuple[float, ...]
) -> Float[np.ndarray, "n 4"]:
    """Boxes [x0, y0, x1, y1] around the undistorted edges of boxes."""
    boxes = np.asarray(boxes, dtype=np.float64).reshape(-1, 4)
    if not len(boxes):
        return boxes
    along = np.linspace(0, 1, EDGE_POINTS)
    unit = np.concatenate([np.stack([along, np.full_like(along, s)], 1)[:, order] for s in (0, 1) for order in ([0, 1], [1, 0])])
    points = boxes[:, None, :2] + unit * (boxes[:, None, 2:] - boxes[:, None, :2])
    found = undistort_points(points.reshape(-1, 2), intrinsics, model, coefficients).reshape(len(boxes), -1, 2)
    return np.concatenate([found.min(axis=1), found.max(axis=1)], axis=1)


def zoom_without_rims(
    intrinsics: Float[np.ndarray, " 4"], size: tuple[int, int], model: DistortionModel, coefficients: tuple[float, ...]
) -> float:
    """Least factor (at least 1) on the focal lengths with which every pixel of the undistorted image was seen.

    At a factor of 1 the lens may not have seen the corners (pincushion distortion); pixels without a picture would be
    corners and edges to whatever looks at the image.
    """
    width, height = size
    across, up = np.linspace(0.5, width - 0.5, 33), np.linspace(0.5, height - 0.5, 33)
    rim = np.concatenate(
        [np.stack([across, np.full(33, v)], 1) for v in (0.5, height - 0.5)]
        + [np.stack([np.full(33, u), up], 1) for u in (0.5, width - 0.5)]
    )

    def seen(factor: float) -> bool:
        inner = intrinsics[2:] + (rim - intrinsics[2:]) / factor
        at = distort_points(inner, intrinsics, model, coefficients)
        return bool(((at >= 0) & (at <= [width, height])).all())

    if seen(1.0):
        return 1.0
    low, high = 1.0, 2.0
    if not seen(high):
        return 1.0  # no zoom mends a calibration of other images; the rims stay black
    for _ in range(20):
        middle = (low + high) / 2
        low, high = (low, middle) if seen(middle) else (middle, high)
    return high


@lru_cache(maxsize=4)
def _maps(
    intrinsics: tuple[float, ...], target: tuple[float, ...], size: tuple[int, int], model: str, coefficients: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    import cv2

    # OpenCV has the first pixel's centre at (0, 0), a camera here at (0.5, 0.5).
    K, new = (_camera(np.array(vector) - [0, 0, 0.5, 0.5]) for vector in (intrinsics, target))
    d = np.array(coefficients)
    make = cv2.fisheye.initUndistortRectifyMap if model == "fisheye" else cv2.initUndistortRectifyMap
    return make(K, d, np.eye(3), new, size, cv2.CV_32FC1)


def undistort_image(
    image: UInt8[np.ndarray, "h w 3"],
    intrinsics: Float[np.ndarray, " 4"],
    model: DistortionModel,
    coefficients: tuple[float, ...],
    target: Float[np.ndarray, " 4"] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """The image of a pinhole camera, of the same intrinsics or of `target`, bilinearly; black where the lens saw nothing."""
    import cv2

    size = (image.shape[1], image.shape[0])
    new = intrinsics if target is None else target
    maps = _maps(tuple(intrinsics.tolist()), tuple(new.tolist()), size, model, tuple(coefficients))
    return cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR)


def undistort_depth(
    depth: Float[np.ndarray, "h w"],
    intrinsics: Float[np.ndarray, " 4"],
    model: DistortionModel,
    coefficients: tuple[float, ...],
    target: Float[np.ndarray, " 4"] | None = None,
    size: tuple[int, int] | None = None,
) -> Float[np.ndarray, "h w"]:
    """The depth image of a pinhole camera, each pixel from the nearest one of the lens; 0 where the lens saw nothing.

    Depth runs along the optical axis, so a lens moves pixels and leaves their values; a value between two sides of an edge
    would be neither's, so nothing is interpolated.

    Args:
        depth: depth image of the lens, registered to its colour image, m.
        intrinsics: fx, fy, cx, cy of the colour image, px.
        model: distortion model of the lens.
        coefficients: its coefficients.
        target: intrinsics of the pinhole camera; those of the lens by default.
        size: width and height of the colour image where the depth image has another size.

    Example:
        >>> camera = np.array([200.0, 200.0, 160.0, 120.0])
        >>> wall = undistort_depth(np.full((240, 320), 2.0), camera, "radial-tangential", (-0.1, 0.0, 0.0, 0.0))
        >>> float(wall[120, 160])
        2.0
    """
    import cv2

    own = (depth.shape[1], depth.shape[0])
    zoom = np.ones(4) if size is None else np.tile([own[0] / size[0], own[1] / size[1]], 2)
    new = intrinsics if target is None else target
    maps = _maps(tuple((intrinsics * zoom).tolist()), tuple((new * zoom).tolist()), own, model, tuple(coefficients))
    values = np.nan_to_num(np.asarray(depth, dtype=np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    return cv2.remap(values, maps[0], maps[1], cv2.INTER_NEAREST).astype(np.float64)
