"""Frame to frame visual odometry in the form of `init` and `step`, and over a whole sequence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import chain, rotation_angle
from nolbo_ppl.odometry.depth_motion import depth_at
from nolbo_ppl.odometry.ground_scale import LengthBelief
from nolbo_ppl.odometry.keypoints import detect, grey, match, track
from nolbo_ppl.odometry.odometry_config import GroundHeight, KnownLengths, MeasuredDepth, OdometryConfig, Scale, StepFlag
from nolbo_ppl.odometry.odometry_state import (
    DepthOfFrame,
    FrameSource,
    Odometry,
    OdometryState,
    Step,
    VisualOdometry,
)
from nolbo_ppl.odometry.step_estimation import motion
from nolbo_ppl.progress import progress_bar

LARGEST_CORRECTION = 3.0
"""A match that its patch moves further is dropped, px."""
DEPTH_KEPT = 0.3
"""A camera that has turned by more looks at something else than what it has measured, rad."""


def corner_depth(
    depth: Float[np.ndarray, "h w"] | None, pixels: Float[np.ndarray, "n 2"], picture: UInt8[np.ndarray, "a b"]
) -> Float[np.ndarray, " n"] | None:
    """Depth of the corners of a picture. Raises `InputError` for a depth image that does not show the same view."""
    if depth is None:
        return None
    zoom = depth.shape[1] / picture.shape[1] if depth.ndim == 2 else np.nan
    if not (depth.ndim == 2 and abs(depth.shape[0] - zoom * picture.shape[0]) <= 1):
        raise input_error(
            "depth image of another shape than its frame",
            got=f"{depth.shape[::-1]} px",
            expected=f"{picture.shape[::-1]} px, or a multiple of it",
        )
    return depth_at(depth, pixels, zoom)


def init(
    setup: VisualOdometry, image: UInt8[np.ndarray, "h w 3"], depth: Float[np.ndarray, "h w"] | None = None
) -> OdometryState:
    """State at the first frame. Raises `InputError` for anything but an RGB image, or a depth of another shape."""
    picture = grey(image)
    features = detect(picture, setup.config)
    return OdometryState(0, np.eye(4), picture, features, feature_depth=corner_depth(depth, features.pixels, picture))


def step(
    setup: VisualOdometry,
    state: OdometryState,
    image: UInt8[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"] | None = None,
) -> tuple[OdometryState, Step]:
    """Take in the next frame, with its depth image (m, 0 or NaN unknown) where there is one.

    Raises:
        InputError: an image of another size, or more frames than known lengths.
    """
    picture = grey(image)
    height, width = state.image.shape
    if picture.shape != state.image.shape:
        raise input_error(
            f"frame {state.frame + 1} has another size",
            got=f"{picture.shape[1]} x {picture.shape[0]} px",
            expected=f"{width} x {height} px",
        )
    features = detect(picture, setup.config)
    rows = match(state.features, features, setup.config.ratio, setup.config.largest_shift * float(np.hypot(height, width)))
    first, second = state.features.pixels[rows[:, 0]], features.pixels[rows[:, 1]]
    if setup.config.patch:
        second, good = track(state.image, picture, first, second, setup.config.patch, LARGEST_CORRECTION)
        first, second, rows = first[good], second[good], rows[good]
    known = corner_depth(depth, features.pixels, picture)
    both = None
    if state.feature_depth is not None:
        later = corner_depth(depth, second, picture)  # a patch that was registered has moved
        both = state.feature_depth[rows[:, 0]], np.full(len(rows), np.nan) if later is None else later
    taken, memory = motion(setup, state, first, second, both)
    measured = not taken.flags & (StepFlag.FEW_MATCHES | StepFlag.STILL | StepFlag.ROTATION)
    translation = taken.T_earlier_later[:3, 3]
    direction = state.direction
    if measured and np.linalg.norm(translation) > 0:
        direction = translation / np.linalg.norm(translation)
    turned = state.turned + float(rotation_angle(taken.T_earlier_later[:3, :3]))
    seen = state.depth if turned < DEPTH_KEPT and not taken.flags & StepFlag.FEW_MATCHES else None
    after = OdometryState(
        state.frame + 1,
        chain(state.T_world_camera, taken.T_earlier_later[None])[1],
        picture,
        features,
        step=taken.T_earlier_later,
        direction=direction,
        length=memory.length,
        planes=memory.planes,
        depth=seen if memory.depth is None else memory.depth,
        turned=turned if memory.depth is None else 0.0,
        feature_depth=known,
    )
    return after, taken


def with_earlier_lengths(steps: Sequence[Step], lengths: Sequence[LengthBelief | None], scale: GroundHeight) -> list[Step]:
    """The steps before the first ground was found, with the length of the first step that had one.

    The belief in a length runs backwards as it runs forwards: a camera keeps its speed but for `acceleration`. A guess for all
    of them would be wrong by the same factor in each, which no covariance of single steps can say: of 69 m, 23 were missing.
    """
    first = next((k for k, length in enumerate(lengths) if length is not None), None)
    result = list(steps)
    if first is None:
        return result
    known = lengths[first]
    assert known is not None
    for k in range(first - 1, -1, -1):
        known = LengthBelief(known.length, float(np.hypot(known.log_scale, scale.acceleration)))
        step = steps[k]
        length = float(np.linalg.norm(step.T_earlier_later[:3, 3]))
        if not step.flags & StepFlag.NO_SCALE or length <= 0:
            continue
        factor = known.length / length
        T = step.T_earlier_later.copy()
        T[:3, 3] *= factor
        stretch = np.diag(np.repeat([1.0, factor], 3))
        covariance = stretch @ step.covariance @ stretch
        along = np.concatenate([np.zeros(3), T[:3, :3].T @ T[:3, 3] / known.length])
        # Its own part along the way was that of the guess.
        missing = known.scale**2 - float(along @ covariance @ along)
        result[k] = replace(step, T_earlier_later=T, covariance=covariance + max(missing, 0.0) * np.outer(along, along))
    return result


def estimate_odometry(
    frames: FrameSource,
    intrinsics: Float[np.ndarray, " 4"],
    scale: Scale,
    config: OdometryConfig | None = None,
    progress: bool = False,
    depth: DepthOfFrame | None = None,
) -> Odometry:
    """Visual odometry of a sequence, one frame in memory at a time.

    Args:
        frames: the sequence, `len(frames)` and `frames.frame(k)`.
        intrinsics: fx, fy, cx, cy, px.
        scale: lengths of the steps, the camera's height over the ground, or the noise of depth images.
        config: settings.
        progress: show a bar on a terminal.
        depth: depth image of frame k, for a scale of `MeasuredDepth`.

    Raises:
        InputError: no frame, lengths that do not fit, images that differ in size, depth images without their noise or the
            other way round.

    Example:
        >>> import nolbo_ppl
        >>> from nolbo_ppl.odometry import KnownLengths
        >>> texture = np.kron(np.random.default_rng(0).integers(0, 256, (40, 60, 3)), np.ones((4, 4, 1))).astype(np.uint8)
        >>> class Sideways:  # any sequence with a length and `frame(k)`
        ...     def __len__(self): return 3
        ...     def frame(self, k): return texture[:, 4 * k : 4 * k + 200]
        >>> lengths = KnownLengths(np.array([0.1, 0.1]))
        >>> found = nolbo_ppl.estimate_odometry(Sideways(), np.array([150.0, 150.0, 100.0, 80.0]), lengths)
        >>> found.T_world_camera.shape
        (3, 4, 4)
    """
    setup = VisualOdometry(np.asarray(intrinsics), scale, config or OdometryConfig())
    if len(frames) == 0:
        raise input_error("no frame to run odometry on")
    if isinstance(scale, KnownLengths) and len(scale.lengths) != len(frames) - 1:
        raise input_error(
            "lengths of steps do not match the frames",
            got=f"{len(scale.lengths)} lengths",
            expected=f"{len(frames) - 1} for {len(frames)} frames",
        )
    if isinstance(scale, MeasuredDepth) != (depth is not None):
        raise input_error(
            "depth images and their noise", got="one of the two", expected="`depth` with a scale of `MeasuredDepth`, or neither"
        )
    state = init(setup, frames.frame(0), None if depth is None else depth(0))
    steps: list[Step] = []
    lengths: list[LengthBelief | None] = []
    for k in progress_bar(range(1, len(frames)), "odometry", "frame", shown=progress):
        state, taken = step(setup, state, frames.frame(k), None if depth is None else depth(k))
        steps.append(taken)
        lengths.append(state.length)
    if isinstance(scale, GroundHeight):
        steps = with_earlier_lengths(steps, lengths, scale)
    return Odometry(
        chain(np.eye(4), np.array([taken.T_earlier_later for taken in steps]).reshape(-1, 4, 4)),
        np.array([taken.covariance for taken in steps]).reshape(-1, 6, 6),
        np.array([taken.matches for taken in steps], dtype=np.int64),
        np.array([taken.inliers for taken in steps], dtype=np.int64),
        np.array([int(taken.flags) for taken in steps], dtype=np.uint8),
    )
