"""Steps that images hardly tell: few corners, corners in one place, stops, turns. A covariance says so, and a flag."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import inverse, make_pose, se3_exp, se3_log, transform
from nolbo_ppl.odometry import GroundHeight, KnownLengths, Step, StepFlag, VisualOdometry, motion
from nolbo_ppl.odometry.epipolar import rays
from nolbo_ppl.odometry.ground_scale import LengthBelief
from nolbo_ppl.odometry.keypoints import Features
from nolbo_ppl.odometry.odometry_state import OdometryState
from nolbo_ppl.odometry.planar_scene import PlanePast
from nolbo_ppl.odometry.visual_odometry import with_earlier_lengths

from .conftest import HEIGHT, INTRINSICS, WIDTH

EMPTY = Features(np.zeros((0, 2)), np.zeros((0, 32), dtype=np.uint8))
BOUND = 25.0
"""Largest Mahalanobis^2 of six degrees of freedom of any step; by chance one in three thousand exceeds it."""


def corners(
    rng: np.random.Generator, T: np.ndarray, count: int, box: tuple[float, float, float, float], noise: float, wrong: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Matches of points in one part of the image, 4 to 25 m away; the first `wrong` are no matches at all."""
    pixels = rng.uniform(box[:2], box[2:], (count, 2))
    points = transform(inverse(T), rays(pixels, INTRINSICS) * rng.uniform(4, 25, count)[:, None])
    second = points[:, :2] / points[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]
    second, first = (p + rng.normal(0, noise, p.shape) for p in (second, pixels))
    second[:wrong] = rng.uniform([0, 0], [WIDTH, HEIGHT], (wrong, 2))
    return first, second


def surprise(step: Step, T: np.ndarray) -> float:
    error = se3_log(inverse(step.T_earlier_later) @ T)
    return float(error @ np.linalg.solve(step.covariance, error))


def measured(first: np.ndarray, second: np.ndarray, scale: KnownLengths | GroundHeight, **state: object) -> Step:
    start = OdometryState(0, np.eye(4), np.zeros((HEIGHT, WIDTH), np.uint8), EMPTY, **state)  # type: ignore[arg-type]
    return motion(VisualOdometry(INTRINSICS, scale), start, first, second)[0]


def forward(rng: np.random.Generator, length: float = 0.6) -> np.ndarray:
    T = se3_exp(np.concatenate([0.02 * rng.standard_normal(3), [0.05, 0.05, 1.0] * np.array([*rng.standard_normal(2), 1.0])]))
    T[:3, 3] *= length / np.linalg.norm(T[:3, 3])
    return T


CASES = {
    "20": (20, (0, 0, 384, 192), 0),
    "20, 6 wrong": (26, (0, 0, 384, 192), 6),
    "25, 15 wrong": (40, (0, 0, 384, 192), 15),
    "40 in a corner": (40, (250, 20, 330, 80), 0),
    "50 at the side, 10 wrong": (60, (10, 10, 100, 180), 10),
}
"""Number of corners, part of the image they lie in, how many of the matches are wrong."""


def few_corners(case: str, seed: int) -> tuple[Step, np.ndarray]:
    """A step of few corners, every second one with a past; the true motion."""
    count, box, wrong = CASES[case]
    rng = np.random.default_rng(seed)
    T = forward(rng)
    first, second = corners(rng, T, count, box, 0.4, wrong)
    past = {"direction": np.array([0.0, 0.0, 1.0]), "step": make_pose(np.eye(3), np.array([0.0, 0.0, 0.6]))}
    return measured(first, second, KnownLengths(np.array([0.6])), **(past if seed % 2 else {})), T


@pytest.mark.parametrize("case", CASES)
def test_few_corners_never_mislead(case: str) -> None:
    """The covariance at the best motion alone: Mahalanobis^2 up to 280, in a corner of the image 16 000."""
    steps = [few_corners(case, seed) for seed in range(10)]
    squares = [surprise(*pair) for pair in steps]
    assert max(squares) < BOUND
    assert np.mean(squares) < 6 + 5 * np.sqrt(12 / 10)  # standard deviations are doubled (inflation), so about 2
    spread = [np.sqrt(np.linalg.eigvalsh(step.covariance[3:, 3:])[-1]) for step, _ in steps]
    assert np.median(spread) < 0.6 * 0.6  # and it is not by saying nothing


def test_a_hardly_measured_step_is_flagged() -> None:
    flagged = [few_corners("40 in a corner", seed)[0].flags for seed in range(100, 106)]
    plain = [
        measured(
            *corners(np.random.default_rng(s), forward(np.random.default_rng(s)), 300, (0, 0, 384, 192), 0.4),
            KnownLengths(np.array([0.6])),
        ).flags
        for s in range(3)
    ]
    assert plain == [StepFlag.OK] * 3 and any(flag & StepFlag.WEAK for flag in flagged)


@pytest.mark.parametrize("scale", [GroundHeight(1.5), KnownLengths(np.array([0.0]))], ids=["ground", "wheel"])
def test_a_stop_is_one(scale: GroundHeight | KnownLengths) -> None:
    """A camera that moved by 0.6 m a step and then stands: it stands, to within centimetres, not with a guess of 0.3 m."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        first, second = corners(rng, np.eye(4), 200, (0, 0, 384, 192), 0.1)
        past = {"direction": np.array([0.0, 0.0, 1.0]), "depth": 12.0, "length": LengthBelief(0.6, 0.05)}
        step = measured(first, second, scale, **past)
        assert step.flags == StepFlag.STILL and np.linalg.norm(step.T_earlier_later[:3, 3]) == 0
        assert surprise(step, np.eye(4)) < BOUND and np.sqrt(np.diag(step.covariance)[3:]).max() < 0.1


def test_a_creeping_camera_is_within_the_covariance_of_a_stop() -> None:
    """Too slow for a shift of the images, and yet it moves: what the corners may hide is in the covariance."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        T = se3_exp(np.array([0, 0, 0, *(0.01 * rng.standard_normal(3))]))
        first, second = corners(rng, T, 200, (0, 0, 384, 192), 0.1)
        step = measured(first, second, GroundHeight(1.5), depth=12.0, length=LengthBelief(0.6, 0.05))
        assert step.flags & (StepFlag.STILL | StepFlag.ROTATION) and surprise(step, T) < BOUND


def test_turning_on_the_spot_after_driving_says_how_far_it_may_have_gone() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        T = se3_exp(np.array([0, 0.06, 0, *(0.005 * rng.standard_normal(3))]))
        first, second = corners(rng, T, 250, (60, 0, 384, 192), 0.3, wrong=20)
        step = measured(first, second, GroundHeight(1.5), depth=12.0, length=LengthBelief(0.6, 0.05))
        assert step.flags & StepFlag.ROTATION and surprise(step, T) < BOUND
        assert np.sqrt(step.covariance[3, 3]) < 0.15  # without the depth: half a step, 0.3 m


def test_frames_that_follow_undo_a_wrong_twin() -> None:
    """Of two motions before a plane the wrong one looked better once: its normal does not fit the steps after."""
    normal, other = np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.0, 0.8])
    branches = [PlanePast(other, None, 0.0), PlanePast(normal, None, 3.0)]
    straight = [PlanePast(other, None, 0.0)]
    ahead = np.array([1.0, 0.0, 0.0])
    held = [min(past.against(np.eye(3), normal, ahead) for past in pasts) for pasts in (branches, straight)]
    assert held == [3.0, 12.0]
    R = se3_exp(np.array([0, 0.3, 0, 0, 0, 0]))[:3, :3]
    turned = branches[0].turned(R)
    np.testing.assert_allclose(R @ turned.normal, other, atol=1e-12)
    assert turned.against(np.eye(3), turned.normal, ahead) == 0.0


def test_steps_before_the_first_ground_have_the_length_of_the_first_that_saw_it() -> None:
    """Guessed at 0.1 m, measured from the third step on: the two before get its length, the nearer one more surely."""
    turn = se3_exp(np.array([0, 0.1, 0, 0, 0, 0]))
    steps = []
    for k, length in enumerate((0.1, 0.1, 0.5)):
        T = turn @ make_pose(np.eye(3), np.array([0, 0, length]))
        covariance = np.diag([1e-6] * 3 + [0.01**2, 0.01**2, 0.1**2])
        steps.append(Step(T, covariance, 100, 90, StepFlag.NO_SCALE if k < 2 else StepFlag.OK))
    found = with_earlier_lengths(steps, [None, None, LengthBelief(0.5, 0.05)], GroundHeight(1.5))
    lengths = [np.linalg.norm(step.T_earlier_later[:3, 3]) for step in found]
    np.testing.assert_allclose(lengths, 0.5, rtol=1e-12)
    # Along the camera's way: log-normal random walk backwards; across: the same angle over a longer way.
    along = [np.sqrt(step.covariance[5, 5]) for step in found]
    np.testing.assert_allclose(along[1::-1], [0.5, 0.5], rtol=0.01)  # five times the guess's own: the larger one stays
    assert np.sqrt(found[0].covariance[3, 3]) == pytest.approx(0.05)
    narrow = [Step(s.T_earlier_later, np.diag([1e-6] * 6), 100, 90, s.flags) for s in steps]
    sure = with_earlier_lengths(narrow, [None, None, LengthBelief(0.5, 0.05)], GroundHeight(1.5))
    expected = [0.5 * np.sqrt(0.05**2 + n * 0.1**2) for n in (2, 1)]
    np.testing.assert_allclose([np.sqrt(step.covariance[5, 5]) for step in sure[:2]], expected, rtol=1e-6)
    assert with_earlier_lengths(steps, [None] * 3, GroundHeight(1.5)) == steps
