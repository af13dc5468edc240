"""Steps from corners with depth: metres, covariances that hold the errors, depths at edges, rooms drawn with their depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, relative, se3_exp, se3_log, transform
from nolbo_ppl.odometry import MeasuredDepth, OdometryConfig, StepFlag, estimate_odometry
from nolbo_ppl.odometry.depth_motion import DepthMatches, depth_at, depth_motion, residuals
from nolbo_ppl.odometry.epipolar import rays

from .conftest import CAMERA_HEIGHT, HEIGHT, INTRINSICS, WIDTH, Room, make_room, weaving

CAMERA = np.array([525.0, 525.0, 320.0, 240.0])
NOISE = MeasuredDepth()


def seen_twice(
    rng: np.random.Generator,
    T: np.ndarray,
    count: int,
    wrong: int = 0,
    unknown: float = 0.2,
    pixel: float = 0.4,
    worse: float = 1.0,
    within: tuple[float, float] = (0.8, 5.0),
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Corners of both views and their depths, with noise; depths `worse` times as noisy as stated, some unknown, some wrong."""
    first = rng.uniform([10, 10], [630, 470], (count, 2))
    depth = rng.uniform(*within, count)
    later = transform(inverse(T), rays(first, CAMERA) * depth[:, None])
    second = later[:, :2] / later[:, 2:] * CAMERA[:2] + CAMERA[2:] + rng.normal(0, pixel, (count, 2))
    first = first + rng.normal(0, pixel, first.shape)
    depth_first = depth + worse * NOISE.scale(depth) * rng.standard_normal(count)
    depth_second = later[:, 2] + worse * NOISE.scale(later[:, 2]) * rng.standard_normal(count)
    depth_second[rng.random(count) < unknown] = np.nan
    depth_first[rng.random(count) < unknown] = np.nan
    second[:wrong] = rng.uniform([0, 0], [640, 480], (wrong, 2))
    return first, second, depth_first, depth_second


def surprise(T: np.ndarray, covariance: np.ndarray, true: np.ndarray) -> float:
    error = se3_log(inverse(T) @ true)
    return float(error @ np.linalg.solve(covariance, error))


def random_step(rng: np.random.Generator) -> np.ndarray:
    return se3_exp(np.concatenate([0.05 * rng.standard_normal(3), 0.06 * rng.standard_normal(3)]))


def test_the_jacobian_of_the_residuals_is_their_derivative() -> None:
    rng = np.random.default_rng(0)
    T = random_step(rng)
    matches = DepthMatches(*seen_twice(rng, T, 12, unknown=0.0))
    # The whitening depends on the motion as well; as in any Gauss-Newton its derivative is left out, so it is held here.
    _, jacobian, _ = residuals(T, matches, CAMERA, NOISE)
    step = 1e-6
    numeric = np.stack(
        [
            (residuals(T @ se3_exp(d), matches, CAMERA, NOISE)[0] - residuals(T @ se3_exp(-d), matches, CAMERA, NOISE)[0])
            / (2 * step)
            for d in step * np.eye(6)
        ],
        axis=2,
    )
    # Exact at the truth, up to residuals (of order one) times the change of the whitening (small).
    assert np.abs(numeric - jacobian).max() < 0.03 * np.abs(jacobian).max()


@pytest.mark.parametrize("case", ["plain", "wrong matches", "few", "depth worse than stated", "far", "still"])
def test_covariance_holds_the_errors(case: str) -> None:
    """The mean of 60 squared Mahalanobis distances of six degrees of freedom, within five of its standard errors."""
    options: dict[str, dict] = {
        "plain": {"count": 200},
        "wrong matches": {"count": 240, "wrong": 60},
        "few": {"count": 45},
        "depth worse than stated": {"count": 200, "worse": 2.5},
        "far": {"count": 150, "within": (4.0, 9.0)},
        "still": {"count": 200},
    }
    squares, shifts = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        T = np.eye(4) if case == "still" else random_step(rng)
        found = depth_motion(*seen_twice(rng, T, **options[case]), CAMERA, NOISE, OdometryConfig())
        assert found is not None
        squares.append(surprise(found.T_earlier_later, found.covariance, T))
        shifts.append(np.linalg.norm((inverse(found.T_earlier_later) @ T)[:3, 3]))
    slack = 1.5 if case == "few" else 1.25  # Student's weights and scales of the same residuals cost something
    assert 6 - 5 * np.sqrt(12 / 60) < np.mean(squares) < slack * (6 + 5 * np.sqrt(12 / 60))
    assert np.median(shifts) < (0.03 if case == "far" else 0.008)


def test_too_few_depths_measure_nothing() -> None:
    rng = np.random.default_rng(0)
    first, second, depth_first, depth_second = seen_twice(rng, np.eye(4), 100, unknown=0.0)
    depth_first[15:] = np.nan
    assert depth_motion(first, second, depth_first, depth_second, CAMERA, NOISE, OdometryConfig()) is None
    assert depth_motion(first, second[::-1], depth_first * np.nan, depth_second, CAMERA, NOISE, OdometryConfig()) is None


def test_depth_at_corners_is_that_of_the_plane_and_none_at_edges() -> None:
    v, u = np.mgrid[0:40, 0:60] + 0.5
    inverse_depth = 0.3 + 0.002 * u + 0.004 * v
    depth = 1 / inverse_depth
    rng = np.random.default_rng(0)
    pixels = rng.uniform([2, 2], [58, 38], (50, 2))
    np.testing.assert_allclose(depth_at(depth, pixels), 1 / (0.3 + pixels @ [0.002, 0.004]), rtol=1e-6)
    half = depth[::2, ::2] * 0 + 1 / (0.3 + 0.002 * (u[::2, ::2] + 0.5) + 0.004 * (v[::2, ::2] + 0.5))
    np.testing.assert_allclose(depth_at(half, pixels, 0.5), 1 / (0.3 + pixels @ [0.002, 0.004]), rtol=1e-6)
    depth[:, 30:] = 9.0
    on_edge = depth_at(depth, np.array([[30.2, 20.0], [10.0, 20.0], [50.0, 20.0]]))
    assert np.isnan(on_edge[0]) and np.isfinite(on_edge[1:]).all()
    depth[18:23, 8:13] = 0.0
    assert np.isnan(depth_at(depth, np.array([[10.0, 20.0], [-3.0, 4.0], [70.0, 4.0]]))).all()


@dataclass
class RoomWithDepth:
    """A room's images and depth images, with the noise and the holes of a sensor."""

    room: Room

    def __len__(self) -> int:
        return len(self.room)

    def frame(self, k: int, /) -> np.ndarray:
        return self.room.frame(k)

    def depth(self, k: int) -> np.ndarray:
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
        T = self.room.T_world_camera[k]
        ray = (
            np.stack([(u - INTRINSICS[2]) / INTRINSICS[0], (v - INTRINSICS[3]) / INTRINSICS[1], np.ones_like(u)], -1)
            @ T[:3, :3].T
        )
        ways = []
        for axis, at in ((0, 6.0), (0, -6.0), (1, CAMERA_HEIGHT), (1, -4.0), (2, 20.0), (2, -20.0)):
            with np.errstate(divide="ignore", invalid="ignore"):
                way = (at - T[axis, 3]) / ray[..., axis]
            ways.append(np.where(way > 0, way, np.inf))
        depth = np.min(ways, axis=0)
        rng = np.random.default_rng([7, k])
        depth = depth + NOISE.scale(depth) * rng.standard_normal(depth.shape)
        return np.where((depth < 12.0) & (rng.random(depth.shape) > 0.05), depth, 0.0)


@pytest.fixture(scope="module")
def walk() -> RoomWithDepth:
    moving = weaving(7, 0.25, 0.03)
    return RoomWithDepth(make_room(np.concatenate([moving[:5], moving[4:5], moving[4:]])))  # it stands for two steps


def test_images_with_depth_give_metres_and_a_stop_is_one(walk: RoomWithDepth) -> None:
    found = estimate_odometry(walk, INTRINSICS, NOISE, depth=walk.depth)
    true = walk.room.T_world_camera
    steps, true_steps = relative(found.T_world_camera[:-1], found.T_world_camera[1:]), relative(true[:-1], true[1:])
    squares = [surprise(*pair) for pair in zip(steps, found.covariance, true_steps)]
    assert max(squares) < 25
    assert np.linalg.norm((inverse(steps) @ true_steps)[:, :3, 3], axis=1).max() < 0.03
    rests = [k for k in range(len(steps)) if np.linalg.norm(true_steps[k, :3, 3]) < 1e-9]
    assert len(rests) == 2
    for k in rests:
        assert np.linalg.norm(steps[k, :3, 3]) < 0.01 and np.sqrt(np.diag(found.covariance[k])[3:]).max() < 0.02
        assert not found.flags[k] & ~np.uint8(StepFlag.STILL)


def test_a_dark_depth_image_is_bridged_and_said(walk: RoomWithDepth) -> None:
    part = RoomWithDepth(Room(walk.room.T_world_camera[:4], walk.room.textures))
    found = estimate_odometry(part, INTRINSICS, NOISE, depth=lambda k: None if k == 1 else part.depth(k))
    assert found.flags[0] == StepFlag.OK and found.flags[1] & StepFlag.NO_SCALE
    true = relative(part.room.T_world_camera[1], part.room.T_world_camera[2])
    assert surprise(relative(found.T_world_camera[1], found.T_world_camera[2]), found.covariance[1], true) < 25


def test_depth_that_does_not_fit_is_refused(walk: RoomWithDepth) -> None:
    with pytest.raises(InputError, match="depth images and their noise"):
        estimate_odometry(walk, INTRINSICS, NOISE)
    with pytest.raises(InputError, match="another shape than its frame"):
        estimate_odometry(walk, INTRINSICS, NOISE, depth=lambda k: np.ones((10, 50)))
    with pytest.raises(InputError, match="noise of depths"):
        MeasuredDepth(floor=0.0)
