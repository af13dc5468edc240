"""Motion from matched points: errors and covariances against simulated truth, degenerate motions, wrong matches."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, rotation_angle, se3_exp, se3_log, transform
from nolbo_ppl.odometry import (
    GroundHeight,
    KnownLengths,
    OdometryConfig,
    OdometryState,
    Step,
    StepFlag,
    VisualOdometry,
    motion,
)
from nolbo_ppl.odometry.epipolar import (
    cross,
    depths,
    mirrored,
    rays,
    sampson,
    tangent,
    two_view,
)
from nolbo_ppl.odometry.ground_scale import Ground, LengthBelief, fit_ground, ground_axes, next_length
from nolbo_ppl.odometry.keypoints import Features
from nolbo_ppl.odometry.pure_rotation import rotation_only

from .conftest import CAMERA_HEIGHT, HEIGHT, INTRINSICS, WIDTH

EMPTY = Features(np.zeros((0, 2)), np.zeros((0, 32), dtype=np.uint8))


def points(rng: np.random.Generator, n: int, ground: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the earlier view and the points there; most of those below the horizon lie on the ground."""
    pixels = rng.uniform([0, 0], [WIDTH, HEIGHT], (n, 2))
    ray = rays(pixels, INTRINSICS)
    depth = rng.uniform(4, 25, n)
    down = ray[:, 1] > 0.06
    floor = CAMERA_HEIGHT / np.maximum(ray[:, 1], 1e-3)
    on_ground = down & (rng.random(n) < 0.7) & ground
    depth = np.where(on_ground, floor, np.where(down, np.minimum(depth, floor), depth))
    return pixels, ray * depth[:, None]


def views(rng: np.random.Generator, T: np.ndarray, n: int, noise: float, wrong: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Noisy matches seen by both cameras; the first `wrong` are no matches at all."""
    first, X = points(rng, n)
    Y = transform(inverse(T), X)
    second = Y[:, :2] / Y[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]
    seen = (Y[:, 2] > 0.5) & (second > 0).all(axis=1) & (second < [WIDTH, HEIGHT]).all(axis=1)
    first, second = first[seen], second[seen]
    first = first + rng.normal(0, noise, first.shape)
    second = second + rng.normal(0, noise, second.shape)
    second[:wrong] = rng.uniform([0, 0], [WIDTH, HEIGHT], (wrong, 2))
    return first, second


def random_step(rng: np.random.Generator, length: float = 0.8) -> np.ndarray:
    T = se3_exp(np.array([0.003, 0.03, 0.002, 0.05, 0.02, 1.0]) * rng.normal([0, 0, 0, 0, 0, 1], [1, 1, 1, 1, 1, 0]))
    T[:3, 3] *= length / np.linalg.norm(T[:3, 3])
    return T


def measured(first: np.ndarray, second: np.ndarray, scale: KnownLengths | GroundHeight, **state: object) -> Step:
    setup = VisualOdometry(INTRINSICS, scale, OdometryConfig(inflation=1.0))
    start = OdometryState(0, np.eye(4), np.zeros((HEIGHT, WIDTH), np.uint8), EMPTY, **state)  # type: ignore[arg-type]
    return motion(setup, start, first, second)[0]


def test_the_jacobian_of_sampson_residuals_is_their_derivative() -> None:
    rng = np.random.default_rng(0)
    T = random_step(rng)
    first, second = (rays(p, INTRINSICS) for p in views(rng, T, 50, 3.0))
    R, u = T[:3, :3], T[:3, 3] / np.linalg.norm(T[:3, 3])
    residual, jacobian = sampson(R, u, first, second, INTRINSICS)
    assert np.abs(residual).max() > 3
    for axis in range(5):
        delta = np.zeros(5)
        delta[axis] = 1e-6

        def moved(sign: float, delta: np.ndarray = delta) -> np.ndarray:
            turned = R @ se3_exp(np.concatenate([sign * delta[:3], np.zeros(3)]))[:3, :3]
            direction = u + sign * tangent(u) @ delta[3:]
            return sampson(turned, direction / np.linalg.norm(direction), first, second, INTRINSICS)[0]

        np.testing.assert_allclose((moved(1) - moved(-1)) / 2e-6, jacobian[:, axis], rtol=1e-4, atol=1e-3)


def test_sampson_residuals_have_the_scale_of_the_corners() -> None:
    rng = np.random.default_rng(1)
    T = random_step(rng)
    first, second = (rays(p, INTRINSICS) for p in views(rng, T, 20_000, 0.3))
    residual, _ = sampson(T[:3, :3], T[:3, 3] / np.linalg.norm(T[:3, 3]), first, second, INTRINSICS)
    assert residual.std() == pytest.approx(0.3, abs=5 * 0.3 / np.sqrt(2 * len(residual)))


def test_depths_are_those_of_the_points() -> None:
    rng = np.random.default_rng(2)
    T = random_step(rng)
    pixels, X = points(rng, 40)
    Y = transform(inverse(T), X)
    rho = depths(T[:3, :3], T[:3, 3], rays(pixels, INTRINSICS), Y / Y[:, 2:])
    np.testing.assert_allclose(1 / rho, np.column_stack([X[:, 2], Y[:, 2]]), rtol=1e-8)
    away = depths(T[:3, :3], -T[:3, 3], rays(pixels, INTRINSICS), Y / Y[:, 2:])
    assert (away < 0).all()


def test_cross_products_are_those_of_numpy() -> None:
    a, b = np.random.default_rng(3).standard_normal((2, 7, 3))
    np.testing.assert_array_equal(cross(a, b), np.cross(a, b))


def test_covariance_of_the_opposite_direction_is_the_same_in_space() -> None:
    rng = np.random.default_rng(4)
    u = rng.standard_normal(3)
    u /= np.linalg.norm(u)
    root = rng.standard_normal((5, 5))
    covariance = root @ root.T
    turned = mirrored(covariance, -u)
    # -(u + B d) = -u + B' d' makes d' = -B'^T B d: the covariance in space is the same.
    space = lambda c, v: tangent(v) @ c[3:, 3:] @ tangent(v).T  # noqa: E731
    np.testing.assert_allclose(space(turned, -u), space(covariance, u), atol=1e-12)
    np.testing.assert_array_equal(turned[:3, :3], covariance[:3, :3])


@pytest.mark.parametrize("wrong", [0, 80])
def test_motion_is_found_among_wrong_matches(wrong: int) -> None:
    rng = np.random.default_rng(5)
    for _ in range(10):
        T = random_step(rng)
        first, second = views(rng, T, 400, 0.2, wrong)
        found = two_view(first, second, INTRINSICS, OdometryConfig())
        assert found is not None
        assert rotation_angle(found.R.T @ T[:3, :3]) < 0.003
        assert found.direction @ T[:3, 3] > np.cos(0.03) * np.linalg.norm(T[:3, 3])
        assert found.inliers[wrong:].mean() > 0.95
        if wrong:
            assert found.inliers[:wrong].mean() < 0.2
        assert found.scale == pytest.approx(0.2, rel=0.25)


def test_covariance_is_that_of_the_errors() -> None:
    """Normalised squared errors of a step with a noisy wheel have mean 6: chi-squared with six degrees of freedom."""
    runs, ratio = 120, 0.02
    squares = []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        T = random_step(rng)
        first, second = views(rng, T, 400, 0.1)
        wheel = 0.8 * (1 + ratio * rng.standard_normal())
        step = measured(first, second, KnownLengths(np.array([wheel]), ratio=ratio))
        assert step.flags == StepFlag.OK
        error = se3_log(inverse(step.T_earlier_later) @ T)
        squares.append(error @ np.linalg.solve(step.covariance, error))
    assert abs(np.mean(squares) - 6) < 5 * np.sqrt(12 / runs)
    assert np.median(squares) == pytest.approx(5.35, abs=5 * 1.2533 * np.sqrt(12 / runs))


def test_a_turn_on_the_spot_is_flagged_and_measured() -> None:
    squares = []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        T = se3_exp(np.array([0.0, 0.08, 0.01, 0, 0, 0]))
        first, second = views(rng, T, 300, 0.3, wrong=20)
        step = measured(first, second, KnownLengths(np.array([0.0])))
        assert step.flags == StepFlag.ROTATION
        error = se3_log(inverse(step.T_earlier_later) @ T)
        assert np.linalg.norm(error[:3]) < 2e-3 and np.linalg.norm(error[3:]) < 1e-9
        squares.append(error[:3] @ np.linalg.solve(step.covariance[:3, :3], error[:3]))
    # Three degrees of freedom; weighting by Student's t and wrong matches cost a little.
    assert 3 - 5 * np.sqrt(6 / 50) < np.mean(squares) < 1.5 * (3 + 5 * np.sqrt(6 / 50))


def test_far_points_hide_translation_and_the_covariance_says_so() -> None:
    squares = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        pixels = rng.uniform([0, 0], [WIDTH, HEIGHT], (300, 2))
        X = rays(pixels, INTRINSICS) * rng.uniform(60, 90, 300)[:, None]
        T = np.eye(4)
        T[0, 3] = 0.1
        Y = transform(inverse(T), X)
        second = Y[:, :2] / Y[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:] + rng.normal(0, 0.3, (300, 2))
        step = measured(pixels + rng.normal(0, 0.3, (300, 2)), second, KnownLengths(np.array([0.1])))
        assert step.flags & (StepFlag.ROTATION | StepFlag.STILL)
        error = se3_log(inverse(step.T_earlier_later) @ T)[:3]
        squares.append(error @ np.linalg.solve(step.covariance[:3, :3], error))
    # All points go 0.27 px to the left, which looks like a turn by 1.3 mrad: far outside what the residuals alone tell.
    assert np.mean(squares) < 3 + 5 * np.sqrt(6 / 40)


def test_rotation_alone_is_exact_without_noise() -> None:
    rng = np.random.default_rng(7)
    T = se3_exp(np.array([0.02, -0.1, 0.03, 0, 0, 0]))
    first, second = views(rng, T, 100, 0.0)
    R, _, _ = rotation_only(rays(first, INTRINSICS), rays(second, INTRINSICS), INTRINSICS, 1.0)
    assert rotation_angle(R.T @ T[:3, :3]) < 1e-9


def test_standing_still_is_flagged() -> None:
    rng = np.random.default_rng(8)
    first, second = views(rng, np.eye(4), 200, 0.05)
    step = measured(first, second, KnownLengths(np.array([0.0])))
    assert step.flags == StepFlag.STILL
    np.testing.assert_allclose(step.T_earlier_later, np.eye(4), atol=1e-3)
    ground = measured(first, second, GroundHeight(CAMERA_HEIGHT), length=LengthBelief(0.7, 0.03))
    assert np.linalg.norm(ground.T_earlier_later[:3, 3]) == 0 and np.sqrt(ground.covariance[3, 3]) < 0.05


def test_too_few_matches_repeat_the_step_before() -> None:
    before = se3_exp(np.array([0, 0.02, 0, 0.1, 0, 0.5]))
    direction = before[:3, 3] / np.linalg.norm(before[:3, 3])
    step = measured(np.zeros((5, 2)), np.zeros((5, 2)), KnownLengths(np.array([0.4])), step=before, direction=direction)
    assert step.flags == StepFlag.FEW_MATCHES and step.inliers == 0
    np.testing.assert_allclose(step.T_earlier_later[:3, :3], before[:3, :3], atol=1e-12)
    np.testing.assert_allclose(step.T_earlier_later[:3, 3], 0.4 * direction, atol=1e-12)
    scales = np.sqrt(np.diag(step.covariance))
    np.testing.assert_allclose(scales, [0.1] * 3 + [0.2] * 3, rtol=0.01)


def test_matches_of_nothing_repeat_the_step_before() -> None:
    rng = np.random.default_rng(9)
    first, second = rng.uniform([0, 0], [WIDTH, HEIGHT], (2, 60, 2))
    step = measured(first, second, KnownLengths(np.array([0.4])))
    assert step.flags & (StepFlag.FEW_MATCHES | StepFlag.ROTATION)
    assert np.sqrt(step.covariance[5, 5]) >= 0.19


def test_the_ground_gives_the_length() -> None:
    errors, scales = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        T = random_step(rng)
        first, second = views(rng, T, 400, 0.2)
        view = two_view(first, second, INTRINSICS, OdometryConfig())
        assert view is not None
        ground = fit_ground(view, rays(first, INTRINSICS), rays(second, INTRINSICS), INTRINSICS, 0.0)
        assert ground is not None and ground.points > 25
        errors.append(CAMERA_HEIGHT * ground.inverse_height / 0.8 - 1)
        scales.append(ground.scale / ground.inverse_height)
    assert abs(np.mean(errors)) < 0.01
    assert np.std(errors) < 2.0 * np.mean(scales)
    step = measured(first, second, GroundHeight(CAMERA_HEIGHT))
    assert step.flags == StepFlag.OK
    assert np.linalg.norm(step.T_earlier_later[:3, 3]) == pytest.approx(0.8, rel=0.03)


def test_the_ground_under_a_camera_that_looks_down() -> None:
    pitch = 0.15
    rng = np.random.default_rng(10)
    axes = ground_axes(pitch)
    ray = rays(rng.uniform([0, 0], [WIDTH, HEIGHT], (500, 2)), INTRINSICS)
    # A plane alone has two motions: what lies above the horizon decides between them.
    down = ray @ axes[:, 0]
    X = ray * np.where(down > 0.1, CAMERA_HEIGHT / np.maximum(down, 0.1), rng.uniform(5, 15, 500))[:, None]
    T = np.eye(4)
    T[:3, 3] = 0.5 * axes[:, 2]
    Y = transform(inverse(T), X)
    first, second = X / X[:, 2:], Y / Y[:, 2:]
    pixels = (p[:, :2] * INTRINSICS[:2] + INTRINSICS[2:] for p in (first, second))
    view = two_view(*pixels, INTRINSICS, OdometryConfig())
    assert view is not None
    ground = fit_ground(view, first, second, INTRINSICS, pitch)
    assert ground is not None and CAMERA_HEIGHT * ground.inverse_height == pytest.approx(0.5, rel=1e-3)


def test_without_ground_the_length_before_is_kept() -> None:
    setting = GroundHeight(1.5, acceleration=0.1)
    assert next_length(None, None, setting) == (None, False)
    kept, used = next_length(LengthBelief(0.5, 0.03), None, setting)
    assert not used and kept is not None and kept.length == 0.5 and kept.log_scale == pytest.approx(np.hypot(0.03, 0.1))
    wild, used = next_length(LengthBelief(0.5, 0.03), Ground(10.0, 0.01, 50), setting)
    assert not used and wild is not None and wild.length == 0.5
    joined, used = next_length(LengthBelief(0.5, 0.03), Ground(0.4, 0.004, 50), setting)
    assert used and joined is not None and 0.5 < joined.length < 0.6 and joined.log_scale < 0.0317


@pytest.mark.parametrize(
    ("build", "match"),
    [
        (lambda: OdometryConfig(ratio=0), "odometry setting ratio"),
        (lambda: OdometryConfig(features=0), "odometry setting features"),
        (lambda: OdometryConfig(level_factor=1.0), "level_factor"),
        (lambda: OdometryConfig(least_inliers=3), "least_inliers"),
        (lambda: KnownLengths(np.array([1.0, -1.0])), "lengths of steps"),
        (lambda: KnownLengths(np.array([1.0, np.nan])), "lengths of steps"),
        (lambda: KnownLengths(np.array([1.0]), floor=0.0), "noise of lengths"),
        (lambda: GroundHeight(0.0), "height of the camera"),
        (lambda: GroundHeight(1.5, pitch=1.0), "pitch"),
        (lambda: GroundHeight(1.5, ratio=0.0), "noise of the ground"),
        (lambda: VisualOdometry(np.array([0.0, 1, 1, 1]), GroundHeight(1.0)), "intrinsics"),
    ],
)
def test_settings_that_cannot_be(build: object, match: str) -> None:
    with pytest.raises(InputError, match=match):
        build()  # type: ignore[operator]
