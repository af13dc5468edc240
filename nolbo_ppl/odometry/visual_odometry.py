"""Frame to frame visual odometry in the form of `init` and `step`, and over a whole sequence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import chain, make_pose
from nolbo_ppl.odometry.epipolar import TwoView, rays, tangent, two_view
from nolbo_ppl.odometry.ground_scale import LengthBelief, fit_ground, next_length
from nolbo_ppl.odometry.keypoints import Features, detect, grey, match, track
from nolbo_ppl.odometry.odometry_config import GroundHeight, KnownLengths, OdometryConfig, Scale, StepFlag
from nolbo_ppl.odometry.planar_scene import PLANAR_SHARE, PlaneMotion, plane_inliers, plane_motions, twin_covariance
from nolbo_ppl.odometry.pure_rotation import parallax_share, rotation_only
from nolbo_ppl.progress import progress_bar

ROTATION_FLOOR, TRANSLATION_FLOOR = 1e-5, 1e-4
"""Least standard deviations of a step, rad and m: a covariance is never singular."""
FIRST_LENGTH = 0.1
"""Scale of the translation of a step that cannot be measured when no step before it was, m."""
LARGEST_CORRECTION = 3.0
"""A match that its patch moves further is dropped, px."""
HIDDEN_PARALLAX = 2.0
"""Parallax that a step taken for a rotation may hold, in standard deviations of its residuals."""
FORWARD = np.array([0.0, 0.0, 1.0])


class FrameSource(Protocol):
    """What frames are read from; `nolbo_ppl.data.sequences.FrameSequence` is one."""

    def __len__(self) -> int:
        """Number of frames."""

    def frame(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """One frame."""


@dataclass(frozen=True)
class VisualOdometry:
    """What does not change along the way."""

    intrinsics: Float[np.ndarray, " 4"]
    """fx, fy, cx, cy, px."""
    scale: Scale
    """Where lengths come from."""
    config: OdometryConfig = field(default_factory=OdometryConfig)
    """Settings."""

    def __post_init__(self) -> None:
        intrinsics = np.asarray(self.intrinsics, dtype=np.float64)
        if intrinsics.shape != (4,) or not np.isfinite(intrinsics).all() or (intrinsics[:2] <= 0).any():
            raise input_error("intrinsics", got=self.intrinsics, expected="[fx, fy, cx, cy] px, focal lengths above 0")
        object.__setattr__(self, "intrinsics", intrinsics)


@dataclass(frozen=True)
class OdometryState:
    """Where the odometry stands after a frame."""

    frame: int
    """Number of frames seen before this one."""
    T_world_camera: Float[np.ndarray, "4 4"]
    """Pose of this frame; the world is the first camera."""
    image: UInt8[np.ndarray, "h w"]
    """This frame in grey."""
    features: Features
    """Its corners."""
    step: Float[np.ndarray, "4 4"] | None = None
    """The step before, T_earlier_later."""
    direction: Float[np.ndarray, " 3"] | None = None
    """Direction of the last translation that was measured."""
    length: LengthBelief | None = None
    """Length of the step before, where the ground gives the scale."""
    normal: Float[np.ndarray, " 3"] | None = None
    """Normal of the plane that was all the step before saw, in this camera."""


@dataclass(frozen=True)
class Step:
    """Motion from one frame to the next."""

    T_earlier_later: Float[np.ndarray, "4 4"]
    """Pose of the later camera in the earlier one."""
    covariance: Float[np.ndarray, "6 6"]
    """Of `Log(T_earlier_later^-1 T_true)`, [rotation rad, translation m], about the later camera's axes (GTSAM Pose3)."""
    matches: int
    """Matches between the two frames."""
    inliers: int
    """Those that obey the motion."""
    flags: StepFlag
    """What it lacked."""
    normal: Float[np.ndarray, " 3"] | None = None
    """Normal of the plane in the later camera, where the scene is one."""


@dataclass(frozen=True)
class Odometry:
    """A trajectory by visual odometry."""

    T_world_camera: Float[np.ndarray, "n 4 4"]
    """Poses; the world is the first camera."""
    covariance: Float[np.ndarray, "n-1 6 6"]
    """Covariance of each step, [rotation rad, translation m] about the later camera's axes (GTSAM Pose3)."""
    matches: Int[np.ndarray, " n-1"]
    """Matches of each step."""
    inliers: Int[np.ndarray, " n-1"]
    """Inliers of each step."""
    flags: UInt8[np.ndarray, " n-1"]
    """`StepFlag` bits of each step."""

    def __len__(self) -> int:
        return len(self.T_world_camera)


def init(setup: VisualOdometry, image: UInt8[np.ndarray, "h w 3"]) -> OdometryState:
    """State at the first frame. Raises `InputError` for anything but an RGB image."""
    picture = grey(image)
    return OdometryState(0, np.eye(4), picture, detect(picture, setup.config))


def step_covariance(
    view_covariance: Float[np.ndarray, "5 5"],
    R: Float[np.ndarray, "3 3"],
    direction: Float[np.ndarray, " 3"],
    length: float,
    length_scale: float,
) -> Float[np.ndarray, "6 6"]:
    """Covariance of a step from that of rotation and direction, and its length's standard deviation, m.

    With t = s u the right perturbation is `v = R' (u ds + s B db)`; the length is taken as independent.
    """
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = np.eye(3)
    jacobian[3:, 3:5] = length * R.T @ tangent(direction)
    jacobian[3:, 5] = R.T @ direction
    source = np.zeros((6, 6))
    source[:5, :5], source[5, 5] = view_covariance, length_scale**2
    return floored(jacobian @ source @ jacobian.T)


def floored(covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """The covariance, symmetric, with the least variances added."""
    floor = np.repeat([ROTATION_FLOOR**2, TRANSLATION_FLOOR**2], 3)
    return 0.5 * (covariance + covariance.T) + np.diag(floor)


def guessed_translation(setup: VisualOdometry, state: OdometryState, moving: bool) -> tuple[np.ndarray, float]:
    """Translation of a step whose images do not tell it, and the standard deviation of each axis, m.

    A measured length is taken along the last direction. Without one the camera keeps its speed if it is `moving`, or
    rests, since the images show no parallax.
    """
    direction = FORWARD if state.direction is None else state.direction
    ratio = setup.config.lost_translation_ratio
    if isinstance(setup.scale, KnownLengths):
        length = float(setup.scale.lengths[state.frame])
        return length * direction, float(np.hypot(ratio * length, setup.scale.floor))
    usual = FIRST_LENGTH if state.length is None else state.length.length
    length = usual if moving and state.length is not None else 0.0
    return length * direction, ratio * usual


def repeated_step(setup: VisualOdometry, state: OdometryState, matches: int) -> Step:
    """The step before once more, for frames without a measurement."""
    R = np.eye(3) if state.step is None else state.step[:3, :3]
    translation, scale = guessed_translation(setup, state, moving=True)
    covariance = np.diag(np.repeat([setup.config.lost_rotation_scale**2, scale**2], 3))
    return Step(make_pose(R, translation), floored(covariance), matches, 0, StepFlag.FEW_MATCHES)


def turning_step(
    setup: VisualOdometry,
    state: OdometryState,
    R: Float[np.ndarray, "3 3"],
    covariance: Float[np.ndarray, "3 3"],
    noise: float,
    matches: int,
    flags: StepFlag,
) -> Step:
    """A step whose rotation alone is measured, `noise` px being the scale of its residuals.

    Translation along the image that all points share looks like rotation: where the camera may have moved, about as much
    of it as the residuals hide is added.
    """
    translation, scale = guessed_translation(setup, state, moving=False)
    at_rest = isinstance(setup.scale, KnownLengths) and setup.scale.lengths[state.frame] <= setup.scale.floor
    hidden = 0.0 if at_rest else HIDDEN_PARALLAX * noise / float(np.sqrt(setup.intrinsics[0] * setup.intrinsics[1]))
    full = np.zeros((6, 6))
    full[:3, :3], full[3:, 3:] = covariance * setup.config.inflation**2 + hidden**2 * np.eye(3), scale**2 * np.eye(3)
    return Step(make_pose(R, translation), floored(full), matches, matches, flags)


def scaled_step(
    setup: VisualOdometry,
    state: OdometryState,
    view: TwoView,
    first: np.ndarray,
    second: np.ndarray,
    planar: Sequence[PlaneMotion] = (),
) -> tuple[Step, LengthBelief | None]:
    """A step whose rotation and direction are measured, given its length; also what is known of the length."""
    flags, belief = StepFlag.OK, None
    if isinstance(setup.scale, GroundHeight):
        ground = fit_ground(view, first, second, setup.intrinsics, setup.scale.pitch)
        belief, used = next_length(state.length, ground, setup.scale)
        flags = StepFlag.OK if used else StepFlag.NO_SCALE
        length, length_scale = (FIRST_LENGTH, FIRST_LENGTH) if belief is None else (belief.length, belief.scale)
    else:
        length = float(setup.scale.lengths[state.frame])
        length_scale = setup.scale.scale(length)
    covariance = step_covariance(view.covariance * setup.config.inflation**2, view.R, view.direction, length, length_scale)
    pose = make_pose(view.R, length * view.direction)
    doubted = twin_covariance(planar, length) if planar else None
    if doubted is not None:
        covariance, flags = covariance + doubted, flags | StepFlag.TWIN
    normal = planar[0].normal if planar else None
    return Step(pose, covariance, len(first), int(view.inliers.sum()), flags, normal), belief


def plane_of(
    setup: VisualOdometry, state: OdometryState, view: TwoView, first: np.ndarray, second: np.ndarray
) -> list[PlaneMotion]:
    """The motions a scene of one plane allows, the likelier first; empty where the scene is more than a plane."""
    plane = plane_inliers(first, second, setup.config, view.scale)
    if plane is None or np.mean(plane[1][view.inliers]) < PLANAR_SHARE:
        return []
    return plane_motions(plane[0], first, second, setup.intrinsics, setup.config, view, state.normal, state.direction)


def motion(
    setup: VisualOdometry, state: OdometryState, first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"]
) -> tuple[Step, LengthBelief | None]:
    """The step that matched corners (px, earlier and later) show, and what is known of its length."""
    config = setup.config
    if isinstance(setup.scale, KnownLengths) and state.frame >= len(setup.scale.lengths):
        raise input_error(
            "more frames than lengths of steps",
            got=f"frame {state.frame + 1}",
            expected=f"{len(setup.scale.lengths)} lengths for {len(setup.scale.lengths) + 1} frames",
        )
    if len(first) < config.least_inliers:
        return repeated_step(setup, state, len(first)), state.length
    ray_first, ray_second = rays(first, setup.intrinsics), rays(second, setup.intrinsics)
    still = float(np.median(np.linalg.norm(first - second, axis=1))) < config.still_shift
    R, covariance, scale = rotation_only(ray_first, ray_second, setup.intrinsics, config.threshold)
    guess = None if state.direction is None else (R, state.direction)
    view = None if still else two_view(first, second, setup.intrinsics, config, guess)
    kept = np.ones(len(first), dtype=bool) if view is None else view.inliers
    if view is not None:
        R, covariance, scale = rotation_only(ray_first[kept], ray_second[kept], setup.intrinsics, config.threshold)
    if still:
        return turning_step(setup, state, R, covariance, scale, len(first), StepFlag.STILL), state.length
    noise = scale if view is None else view.scale
    share = parallax_share(R, ray_first[kept], ray_second[kept], setup.intrinsics, noise)
    if share < config.parallax_share:
        return turning_step(setup, state, R, covariance, scale, len(first), StepFlag.ROTATION), state.length
    if view is None:
        return repeated_step(setup, state, len(first)), state.length
    planar = plane_of(setup, state, view, first, second)
    return scaled_step(setup, state, planar[0].view if planar else view, ray_first, ray_second, planar)


def step(setup: VisualOdometry, state: OdometryState, image: UInt8[np.ndarray, "h w 3"]) -> tuple[OdometryState, Step]:
    """Take in the next frame.

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
        first, second = first[good], second[good]
    taken, length = motion(setup, state, first, second)
    measured = not taken.flags & (StepFlag.FEW_MATCHES | StepFlag.STILL | StepFlag.ROTATION)
    translation = taken.T_earlier_later[:3, 3]
    direction = state.direction
    if measured and np.linalg.norm(translation) > 0:
        direction = translation / np.linalg.norm(translation)
    pose = chain(state.T_world_camera, taken.T_earlier_later[None])[1]
    after = OdometryState(state.frame + 1, pose, picture, features, taken.T_earlier_later, direction, length, taken.normal)
    return after, taken


def estimate_odometry(
    frames: FrameSource,
    intrinsics: Float[np.ndarray, " 4"],
    scale: Scale,
    config: OdometryConfig | None = None,
    progress: bool = False,
) -> Odometry:
    """Visual odometry of a sequence, one frame in memory at a time.

    Args:
        frames: the sequence, `len(frames)` and `frames.frame(k)`.
        intrinsics: fx, fy, cx, cy, px.
        scale: lengths of the steps, or the camera's height over the ground.
        config: settings.
        progress: show a bar on a terminal.

    Raises:
        InputError: no frame, lengths that do not fit, images that differ in size.

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
    state = init(setup, frames.frame(0))
    steps: list[Step] = []
    for k in progress_bar(range(1, len(frames)), "odometry", "frame", shown=progress):
        state, taken = step(setup, state, frames.frame(k))
        steps.append(taken)
    return Odometry(
        chain(np.eye(4), np.array([taken.T_earlier_later for taken in steps]).reshape(-1, 4, 4)),
        np.array([taken.covariance for taken in steps]).reshape(-1, 6, 6),
        np.array([taken.matches for taken in steps], dtype=np.int64),
        np.array([taken.inliers for taken in steps], dtype=np.int64),
        np.array([int(taken.flags) for taken in steps], dtype=np.uint8),
    )
