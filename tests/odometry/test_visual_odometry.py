"""Odometry of rendered images: drift, determinism, lost frames, sizes; features and their matches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, relative, se3_log
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error, path_length
from nolbo_ppl.odometry import (
    GroundHeight,
    KnownLengths,
    Odometry,
    OdometryConfig,
    StepFlag,
    VisualOdometry,
    estimate_odometry,
    init,
    lengths_of,
    step,
)
from nolbo_ppl.odometry.keypoints import Features, detect, grey, match, spread, track

from .conftest import CAMERA_HEIGHT, HEIGHT, INTRINSICS, WIDTH, Room


class Frames:
    """Images in memory."""

    def __init__(self, images: list[np.ndarray]) -> None:
        self.images = images

    def __len__(self) -> int:
        return len(self.images)

    def frame(self, k: int, /) -> np.ndarray:
        return self.images[k]


@pytest.fixture(scope="module")
def frames(room: Room) -> Frames:
    return Frames([room.frame(k) for k in range(len(room))])


@pytest.fixture(scope="module")
def odometry(room: Room, frames: Frames) -> Odometry:
    return estimate_odometry(frames, INTRINSICS, KnownLengths(lengths_of(room.T_world_camera)))


def test_drift_of_known_lengths(room: Room, odometry: Odometry) -> None:
    truth = room.T_world_camera
    assert len(odometry) == len(truth) and not odometry.flags.any()
    error = absolute_trajectory_error(odometry.T_world_camera, truth, "se3").rmse
    assert error < 0.03 * path_length(truth)
    np.testing.assert_allclose(lengths_of(odometry.T_world_camera), lengths_of(truth), rtol=1e-9)
    np.testing.assert_array_equal(odometry.T_world_camera[0], np.eye(4))
    assert (np.linalg.eigvalsh(odometry.covariance) > 0).all()
    assert odometry.inliers.min() > 50 and (odometry.inliers <= odometry.matches).all()


@pytest.mark.parametrize("settings", [{"patch": 11}, {"detector": "sift"}])
def test_registered_patches_and_sift_are_several_times_better(
    settings: dict, room: Room, frames: Frames, odometry: Odometry
) -> None:
    truth = room.T_world_camera[:12]
    lengths = KnownLengths(lengths_of(truth))
    better = estimate_odometry(Frames(frames.images[:12]), INTRINSICS, lengths, OdometryConfig(**settings))

    def error(T: np.ndarray) -> float:
        gap = se3_log(inverse(relative(T[:-1], T[1:])) @ relative(truth[:-1], truth[1:]))
        return float(np.sqrt((gap[:, :3] ** 2).mean()))

    assert error(better.T_world_camera) < 0.5 * error(odometry.T_world_camera[:12])


def test_the_ground_gives_the_scale(room: Room, frames: Frames) -> None:
    found = estimate_odometry(frames, INTRINSICS, GroundHeight(CAMERA_HEIGHT), OdometryConfig(patch=11))
    ratio = lengths_of(found.T_world_camera) / lengths_of(room.T_world_camera)
    assert np.median(ratio) == pytest.approx(1, abs=0.08) and np.mean(found.flags == 0) > 0.5
    assert path_length(found.T_world_camera) == pytest.approx(path_length(room.T_world_camera), rel=0.08)


def test_the_same_images_give_the_same_odometry(room: Room, frames: Frames, odometry: Odometry) -> None:
    again = estimate_odometry(Frames(frames.images[:8]), INTRINSICS, KnownLengths(lengths_of(room.T_world_camera[:8])))
    np.testing.assert_array_equal(again.T_world_camera, odometry.T_world_camera[:8])
    np.testing.assert_array_equal(again.covariance, odometry.covariance[:7])


def test_steps_by_hand_are_those_of_the_sequence(room: Room, frames: Frames, odometry: Odometry) -> None:
    setup = VisualOdometry(INTRINSICS, KnownLengths(lengths_of(room.T_world_camera)))
    state = init(setup, frames.frame(0))
    for k in range(1, 4):
        before = state
        state, taken = step(setup, state, frames.frame(k))
        assert before.frame == k - 1 and state.frame == k
        np.testing.assert_array_equal(taken.covariance, odometry.covariance[k - 1])
    np.testing.assert_allclose(state.T_world_camera, odometry.T_world_camera[3], atol=1e-12)


def test_a_dark_frame_is_bridged(room: Room, frames: Frames) -> None:
    images = list(frames.images[:8])
    images[4] = np.zeros_like(images[4])
    truth = room.T_world_camera[:8]
    found = estimate_odometry(Frames(images), INTRINSICS, KnownLengths(lengths_of(truth)))
    assert found.flags.tolist() == [0, 0, 0, StepFlag.FEW_MATCHES, StepFlag.FEW_MATCHES, 0, 0]
    assert np.isfinite(found.T_world_camera).all()
    assert found.covariance[3, 0, 0] > 100 * found.covariance[2, 0, 0]


def test_one_frame_is_a_trajectory(frames: Frames) -> None:
    found = estimate_odometry(Frames(frames.images[:1]), INTRINSICS, GroundHeight(1.5))
    assert found.T_world_camera.shape == (1, 4, 4) and found.covariance.shape == (0, 6, 6)


def test_what_does_not_fit_is_refused(frames: Frames) -> None:
    with pytest.raises(InputError, match="lengths of steps do not match the frames: got 3 lengths"):
        estimate_odometry(frames, INTRINSICS, KnownLengths(np.ones(3)))
    with pytest.raises(InputError, match="no frame"):
        estimate_odometry(Frames([]), INTRINSICS, GroundHeight(1.5))
    with pytest.raises(InputError, match=r"frame 1 has another size: got 100 x 50 px"):
        estimate_odometry(Frames([frames.frame(0), np.zeros((50, 100, 3), np.uint8)]), INTRINSICS, GroundHeight(1.5))
    with pytest.raises(InputError, match=r"not an image: got float64"):
        estimate_odometry(Frames([np.zeros((50, 100, 3))]), INTRINSICS, GroundHeight(1.5))
    setup = VisualOdometry(INTRINSICS, KnownLengths(np.ones(1)))
    state, _ = step(setup, init(setup, frames.frame(0)), frames.frame(1))
    with pytest.raises(InputError, match="more frames than lengths"):
        step(setup, state, frames.frame(2))


def test_corners_are_spread_over_the_image(frames: Frames) -> None:
    features = detect(grey(frames.frame(0)), OdometryConfig(features=200))
    assert len(features) == 200 and features.descriptors.shape == (200, 32)
    cells = set(map(tuple, (features.pixels // 64).astype(int)))
    assert len(cells) >= 15  # of 18
    assert (features.pixels > 0).all() and (features.pixels < [WIDTH, HEIGHT]).all()


def test_spreading_takes_the_strongest_of_each_cell_first() -> None:
    pixels = np.array([[1.0, 1], [2, 2], [3, 3], [40, 1], [41, 2]])
    strength = np.array([1.0, 3, 2, 0.1, 0.2])
    assert spread(pixels, strength, 32, 2).tolist() == [1, 4]
    assert spread(pixels, strength, 32, 3).tolist() == [1, 2, 4]
    assert spread(pixels, strength, 32, 9).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("detector", ["orb", "sift"])
def test_a_plain_image_has_no_corner(detector: str) -> None:
    config = replace(OdometryConfig(), detector=detector)  # type: ignore[arg-type]
    found = detect(np.full((HEIGHT, WIDTH), 90, np.uint8), config)
    assert len(found) == 0 and len(match(found, found, 0.8, 100)) == 0


def test_matches_of_a_shifted_image_are_the_shift(frames: Frames) -> None:
    picture = grey(frames.frame(0))
    first = detect(picture, OdometryConfig())
    second = detect(np.roll(picture, 5, axis=1), OdometryConfig())
    rows = match(first, second, 0.85, 100.0)
    shift = second.pixels[rows[:, 1]] - first.pixels[rows[:, 0]]
    error = np.abs(shift - [5, 0]).max(axis=1)
    # Corners of the coarser levels of the pyramid are off by up to a pixel of theirs.
    assert len(rows) > 0.5 * len(first) and np.mean(error < 0.01) > 0.4 and np.mean(error < 2.0) > 0.95
    assert len(match(first, second, 0.85, 4.0)) < 0.1 * len(rows)
    assert len(set(rows[:, 1])) == len(rows)


def test_matching_is_the_mutual_best_of_the_distances() -> None:
    rng = np.random.default_rng(0)
    bits = [rng.integers(0, 256, (40, 32), dtype=np.uint8) for _ in range(2)]
    bits[1][:20] = bits[0][:20] ^ (rng.random((20, 32)) < 0.1).astype(np.uint8)
    first, second = (Features(np.zeros((40, 2)), b) for b in bits)
    distance = np.unpackbits(bits[0][:, None] ^ bits[1][None], axis=2).sum(axis=2)
    expected = []
    for i in range(40):
        order = np.argsort(distance[i], kind="stable")
        if distance[i, order[0]] <= 0.8 * distance[i, order[1]] and np.argmin(distance[:, order[0]]) == i:
            expected.append([i, order[0]])
    assert len(expected) >= 20
    assert match(first, second, 0.8, 1.0).tolist() == expected


def test_patches_find_a_shift_below_a_pixel(frames: Frames) -> None:
    import cv2

    picture = grey(frames.frame(0))
    move = np.array([[1.0, 0.0, 3.4], [0.0, 1.0, -1.3]])
    moved = cv2.warpAffine(picture, move, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    first = detect(picture, OdometryConfig(features=150)).pixels
    first = first[((first > 30) & (first < [WIDTH - 30, HEIGHT - 30])).all(axis=1)]
    start = np.round(first + [3.4, -1.3])
    found, good = track(picture, moved, first, start, 11, 3.0)
    assert good.mean() > 0.9
    assert np.median(np.abs(found[good] - first[good] - [3.4, -1.3])) < 0.05
