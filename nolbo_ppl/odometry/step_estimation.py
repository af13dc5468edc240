"""One step of the visual odometry from matched corners: measured where they tell it, guessed with a covariance where not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.odometry.depth_motion import depth_motion
from nolbo_ppl.odometry.epipolar import TwoView, depths, rays, tangent, two_view
from nolbo_ppl.odometry.few_matches import CloserLook, closer_look, needs_a_closer_look
from nolbo_ppl.odometry.ground_scale import LengthBelief, fit_ground, next_length
from nolbo_ppl.odometry.odometry_config import GroundHeight, KnownLengths, MeasuredDepth, StepFlag
from nolbo_ppl.odometry.odometry_state import OdometryState, Step, StepMemory, VisualOdometry
from nolbo_ppl.odometry.planar_scene import (
    PLANAR_SHARE,
    PlaneMotion,
    PlanePast,
    pasts_of,
    plane_inliers,
    plane_motions,
    twin_covariance,
)
from nolbo_ppl.odometry.pure_rotation import parallax_share, rotation_only

ROTATION_FLOOR, TRANSLATION_FLOOR = 1e-5, 1e-4
"""Least standard deviations of a step, rad and m: a covariance is never singular."""
FIRST_LENGTH = 0.1
"""Scale of the translation of a step that cannot be measured when no step before it was, m."""
HIDDEN_PARALLAX = 2.0
"""Parallax that a step taken for a rotation may hold, in standard deviations of its residuals."""
FAR_HEIGHTS = 10.0
"""What a camera over the ground looks at before anything was measured lies within so many of its heights."""
WEAK_DIRECTION, WEAK_ROTATION = 0.35, 0.05
"""Standard deviations, rad, along the worst axis, from which a measured step is called weak."""
FORWARD = np.array([0.0, 0.0, 1.0])


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


def hidden_translation(
    setup: VisualOdometry, state: OdometryState, noise: float, second: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, " 3"] | None:
    """Scales of a translation along the camera's axes that `noise` px of the corners may hide, m; None where nobody knows.

    It takes the depth that the camera last measured: a standing camera stands, whatever it did a step ago. Aside, a translation
    t shifts a point at depth Z by f t / Z; ahead, only by its slope's share of that.
    """
    depth = state.depth
    if depth is None and isinstance(setup.scale, GroundHeight):
        depth = FAR_HEIGHTS * setup.scale.height
    if depth is None:
        return None
    aside = HIDDEN_PARALLAX * noise / setup.focal * depth
    slope = float(np.median(np.linalg.norm(second[:, :2], axis=1)))
    return np.array([aside, aside, aside / min(max(slope, 0.05), 1.0)])


def turning_step(
    setup: VisualOdometry,
    state: OdometryState,
    R: Float[np.ndarray, "3 3"],
    covariance: Float[np.ndarray, "3 3"],
    noise: float,
    second: Float[np.ndarray, "m 3"],
    flags: StepFlag,
) -> Step:
    """A step whose rotation alone is measured, `noise` px being the scale of its residuals, `second` the later rays.

    Translation along the image that all points share looks like rotation: where the camera may have moved, about as much
    of it as the residuals hide is added. Where no length is given, the camera has moved no further than they hide.
    """
    translation, scale = guessed_translation(setup, state, moving=False)
    at_rest = isinstance(setup.scale, KnownLengths) and setup.scale.lengths[state.frame] <= setup.scale.floor
    hidden = 0.0 if at_rest else HIDDEN_PARALLAX * noise / setup.focal
    scales = np.full(3, scale)
    if not isinstance(setup.scale, KnownLengths):
        held = hidden_translation(setup, state, max(noise, setup.config.still_shift), second)
        scales = scales if held is None else np.minimum(scales, held)
    full = np.zeros((6, 6))
    full[:3, :3], full[3:, 3:] = covariance * setup.config.inflation**2 + hidden**2 * np.eye(3), np.diag(scales**2)
    return Step(make_pose(R, translation), floored(full), len(second), len(second), flags)


def scaled_step(
    setup: VisualOdometry,
    state: OdometryState,
    view: TwoView,
    first: np.ndarray,
    second: np.ndarray,
    planar: Sequence[PlaneMotion] = (),
    look: CloserLook | None = None,
) -> tuple[Step, StepMemory]:
    """A step whose rotation and direction are measured, given its length; also what the next step is told."""
    flags, belief = StepFlag.OK, state.length
    if isinstance(setup.scale, GroundHeight):
        ground = fit_ground(view, first, second, setup.intrinsics, setup.scale.pitch)
        belief, used = next_length(state.length, ground, setup.scale)
        flags = StepFlag.OK if used else StepFlag.NO_SCALE
        length, length_scale = (FIRST_LENGTH, FIRST_LENGTH) if belief is None else (belief.length, belief.scale)
    elif isinstance(setup.scale, KnownLengths):
        length = float(setup.scale.lengths[state.frame])
        length_scale = setup.scale.scale(length)
    else:  # depth images that tell nothing of this step
        flags = StepFlag.NO_SCALE
        length = FIRST_LENGTH if belief is None else belief.length
        length_scale = max(setup.config.lost_translation_ratio * length, FIRST_LENGTH if belief is None else 0.0)
    covariance = step_covariance(view.covariance * setup.config.inflation**2, view.R, view.direction, length, length_scale)
    pose = make_pose(view.R, length * view.direction)
    doubted = twin_covariance(planar, length) if planar else None
    if doubted is not None:
        covariance, flags = covariance + doubted, flags | StepFlag.TWIN
    if look is not None:
        covariance = look.covariance(covariance, length)
    if is_weak(covariance, pose):
        flags |= StepFlag.WEAK
    rho = float(np.median(depths(view.R, view.direction, first, second)[view.inliers, 1]))
    depth = length / rho if rho > 0 and not flags & (StepFlag.NO_SCALE | StepFlag.WEAK) else None
    normal = planar[0].normal if planar else None
    memory = StepMemory(belief, pasts_of(planar) if planar else (PlanePast(direction=view.direction),), depth)
    return Step(pose, covariance, len(first), int(view.inliers.sum()), flags, normal), memory


def is_weak(covariance: Float[np.ndarray, "6 6"], T_earlier_later: Float[np.ndarray, "4 4"]) -> bool:
    """Whether a motion is hardly measured: its rotation or its direction has a standard deviation about that of a guess."""
    translation = T_earlier_later[:3, :3].T @ T_earlier_later[:3, 3]
    length = float(np.linalg.norm(translation))
    turned = bool(np.linalg.eigvalsh(covariance[:3, :3])[-1] > WEAK_ROTATION**2)
    if turned or length < TRANSLATION_FLOOR:
        return turned
    across = tangent(translation / length)
    aside = np.linalg.eigvalsh(across.T @ covariance[3:, 3:] @ across)[-1]
    return bool(aside > (WEAK_DIRECTION * length) ** 2)


def plane_of(
    setup: VisualOdometry, state: OdometryState, view: TwoView, first: np.ndarray, second: np.ndarray
) -> list[PlaneMotion]:
    """The motions a scene of one plane allows, the likelier first; empty where the scene is more than a plane."""
    plane = plane_inliers(first, second, setup.config, view.scale)
    if plane is None or np.mean(plane[1][view.inliers]) < PLANAR_SHARE:
        return []
    past = state.planes or (PlanePast(direction=state.direction),)
    return plane_motions(plane[0], first, second, setup.intrinsics, setup.config, view, past)


def depth_step(
    setup: VisualOdometry,
    state: OdometryState,
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    depth_first: Float[np.ndarray, " m"],
    depth_second: Float[np.ndarray, " m"],
) -> tuple[Step, StepMemory] | None:
    """A step measured in metres by corners with depth; None where too few of them have one."""
    assert isinstance(setup.scale, MeasuredDepth)
    view = depth_motion(first, second, depth_first, depth_second, setup.intrinsics, setup.scale, setup.config)
    if view is None:
        return None
    covariance = floored(view.covariance * setup.config.inflation**2)
    rotation, shift = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]), np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    length = float(np.linalg.norm(view.T_earlier_later[:3, 3]))
    usual = FIRST_LENGTH if state.length is None else max(state.length.length, FIRST_LENGTH)
    weak = rotation > WEAK_ROTATION or shift > setup.config.lost_translation_ratio * usual
    still = float(np.median(np.linalg.norm(first - second, axis=1))) < setup.config.still_shift
    flags = (StepFlag.WEAK if weak else StepFlag.OK) | (StepFlag.STILL if still else StepFlag.OK)
    memory = StepMemory(LengthBelief(max(length, 1e-3), 1.0), (), float(np.median(depth_first[view.inliers])))
    return Step(view.T_earlier_later, covariance, len(first), int(view.inliers.sum()), flags), memory


def motion(
    setup: VisualOdometry,
    state: OdometryState,
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    depth: tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]] | None = None,
) -> tuple[Step, StepMemory]:
    """The step that matched corners (px, earlier and later) show, and what the next step is told.

    `depth` holds the depths of both corners of every match, m, NaN unknown, where the scale is that of depth images.
    """
    config = setup.config
    if isinstance(setup.scale, KnownLengths) and state.frame >= len(setup.scale.lengths):
        raise input_error(
            "more frames than lengths of steps",
            got=f"frame {state.frame + 1}",
            expected=f"{len(setup.scale.lengths)} lengths for {len(setup.scale.lengths) + 1} frames",
        )
    lost = StepMemory(state.length)
    if len(first) < config.least_inliers:
        return repeated_step(setup, state, len(first)), lost
    if depth is not None and isinstance(setup.scale, MeasuredDepth):
        measured = depth_step(setup, state, first, second, *depth)
        if measured is not None:
            return measured
    ray_first, ray_second = rays(first, setup.intrinsics), rays(second, setup.intrinsics)
    still = float(np.median(np.linalg.norm(first - second, axis=1))) < config.still_shift
    R, covariance, scale = rotation_only(ray_first, ray_second, setup.intrinsics, config.threshold)
    guess = None if state.direction is None else (R, state.direction)
    view = None if still else two_view(first, second, setup.intrinsics, config, guess)
    kept = np.ones(len(first), dtype=bool) if view is None else view.inliers
    if view is not None:
        R, covariance, scale = rotation_only(ray_first[kept], ray_second[kept], setup.intrinsics, config.threshold)
    noise = scale if view is None else view.scale
    turning = still or parallax_share(R, ray_first[kept], ray_second[kept], setup.intrinsics, noise) < config.parallax_share
    if turning:
        flag = StepFlag.STILL if still else StepFlag.ROTATION
        step = turning_step(setup, state, R, covariance, scale, ray_second, flag)
        return step, StepMemory(state.length, tuple(past.turned(R) for past in state.planes))
    if view is None:
        return repeated_step(setup, state, len(first)), lost
    if needs_a_closer_look(view):
        look = closer_look(view, ray_first, ray_second, setup.intrinsics, config, state.direction)
        return scaled_step(setup, state, look.view, ray_first, ray_second, look=look)
    planar = plane_of(setup, state, view, first, second)
    return scaled_step(setup, state, planar[0].view if planar else view, ray_first, ray_second, planar)
