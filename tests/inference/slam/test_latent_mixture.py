"""Latents of several modes in SLAM: their density, which mode an object takes, tracks and landmarks of detections that flip."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.inference.slam import IncrementalSlam
from nolbo_ppl.inference.slam.detection_features import fit_prior
from nolbo_ppl.inference.slam.initialise import init
from nolbo_ppl.inference.slam.latent_mixture import (
    LARGE_VARIANCE,
    LatentMixture,
    chosen_modes,
    nearest_difference,
)
from nolbo_ppl.inference.slam.measurements import resolve
from nolbo_ppl.inference.slam.noise.absurd_values import without_absurd_values
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.reference_em import e_step, em_init, em_step
from nolbo_ppl.inference.slam.slam_problem import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.solve import solve
from nolbo_ppl.structures.detections import Detections

CATEGORIES = ("car", "bus")
MEANS = np.array([[2.0, 0.0, 0.0, 1.0], [-2.0, 1.0, 0.0, -1.0]])
SCALE = 0.2
FRAMES = 24


def flips(seed: int = 0, wrong: float = 0.4, objects: int = 6) -> tuple[SlamProblem, np.ndarray, np.ndarray]:
    """A short drive past a row of objects, each seen in every frame; the likelier category is the wrong one at times.

    Every detection states both modes: its residual about the mean of each category. Returns the problem, the objects' true
    latents, and the object of each detection.
    """
    rng = np.random.default_rng(seed)
    label = np.arange(objects) % 2
    latent = MEANS[label] + 0.5 * rng.standard_normal((objects, 4))
    place = np.stack([4.0 * np.arange(objects) - 8, np.zeros(objects), np.full(objects, 14.0)], axis=1)
    path = np.stack([0.2 * np.arange(FRAMES), np.zeros(FRAMES), np.zeros(FRAMES)], axis=1)
    frame, of = np.divmod(np.arange(FRAMES * objects), objects)
    n = len(of)
    flipped = rng.random(n) < wrong
    seen = latent[of] + SCALE * rng.standard_normal((n, 4))
    other = seen - MEANS[label[of]] + MEANS[1 - label[of]]
    mode = np.where(flipped[:, None, None], np.stack([other, seen], axis=1), np.stack([seen, other], axis=1))
    table = Detections.from_arrays(
        frame,
        place[of] - path[frame] + 0.05 * rng.standard_normal((n, 3)),
        position_scale=0.05,
        latent=mode[:, 0],
        latent_scale=SCALE,
        category=[CATEGORIES[k] for k in np.where(flipped, 1 - label[of], label[of])],
        latent_mode_weight=np.tile([0.6, 0.4], (n, 1)),
        latent_mode=mode,
        objectness=0.99,
    )
    odometry = make_pose(np.tile(np.eye(3), (FRAMES, 1, 1)), path)
    return SlamProblem(odometry, table), latent, of


def without_modes(problem: SlamProblem) -> SlamProblem:
    table = problem.observations
    empty = {"latent_mode_weight": np.zeros((len(table), 0)), "latent_mode": np.zeros((len(table), 0, table.latent_dim))}
    return replace(problem, observations=replace(table, **empty))


def purity(assigned: np.ndarray, of: np.ndarray, objects: int) -> list[int]:
    """Tracks of each object."""
    return [len(set(assigned[(of == j) & (assigned >= 0)].tolist())) for j in range(objects)]


def test_detections_that_flip_are_one_track_and_one_landmark() -> None:
    problem, latent, of = flips()
    config = SlamConfig(correct_scales=False)
    state = init(problem, config)
    assert purity(state.tracklets.of_observation, of, len(latent)) == [1] * len(latent)
    assert (state.tracklets.of_observation >= 0).all()
    result = solve(problem, config)
    assert len(result.landmarks) == len(latent)
    for landmark in result.landmarks:
        j = int(np.argmin(np.linalg.norm(landmark.T_world_object[:3, 3] - [[4.0 * k - 8, 0, 14.0] for k in range(6)], axis=1)))
        assert landmark.latent is not None and landmark.latent_variance is not None
        error = (landmark.latent - latent[j]) / np.sqrt(landmark.latent_variance)
        assert np.abs(error).max() < 5
        assert landmark.category == CATEGORIES[j % 2]
    plain = init(without_modes(problem), config)
    broken = purity(plain.tracklets.of_observation, of, len(latent))
    assert sum(broken) > len(latent) or (plain.tracklets.of_observation < 0).any()


def test_an_object_takes_the_mode_its_detections_agree_on() -> None:
    """By enumeration of every joint choice: the largest product of weights times the density of latents about one mean."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        n = 5
        shift = np.array([[0.0, 0.0], [3.0, -2.0]])
        modes = LatentMixture(np.log(rng.dirichlet([2.0, 2.0], n)), 0.3 * rng.standard_normal((n, 1, 2)) + shift[None])
        variance = np.full((n, 2), 0.3**2)
        best, choice = -np.inf, None
        for joint in np.ndindex(*(2,) * n):
            z = modes.mean[np.arange(n), joint]
            value = modes.log_weight[np.arange(n), joint].sum() - 0.5 * np.sum((z - z.mean(axis=0)) ** 2 / variance)
            if value > best:
                best, choice = value, joint
        found = chosen_modes(modes, variance, np.zeros(n, dtype=int), np.ones(n))
        np.testing.assert_array_equal(found, choice)
    alone = chosen_modes(modes, variance, np.full(n, -1), np.ones(n))
    np.testing.assert_array_equal(alone, modes.heaviest)


def test_without_modes_every_number_is_as_before() -> None:
    """A table whose rows state one mode each is the table that states none, to the last bit."""
    problem, _, _ = flips(wrong=0.0)
    table = problem.observations
    single = replace(table, latent_mode_weight=table.latent_mode_weight * [2.0, 0.0] * 0.5)
    config = SlamConfig()
    prior, noise = fit_prior(table, config), estimate_noise(problem, config)
    assert resolve(single, noise, config, prior).latent_modes is None
    a, b = solve(replace(problem, observations=single), config), solve(without_modes(problem), config)
    np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
    assert a.log_evidence == b.log_evidence
    for one, other in zip(a.landmarks, b.landmarks, strict=True):
        np.testing.assert_array_equal(one.latent, other.latent)


def test_of_neighbours_the_nearest_modes_are_compared() -> None:
    problem, _, of = flips()
    table = problem.observations
    first = np.arange(len(table) - 6)
    second = first + 6
    assert (of[first] == of[second]).all()
    width = np.std(nearest_difference(table, first, second)) / np.sqrt(2)
    assert abs(width / SCALE - 1) < 5 / np.sqrt(8 * len(first))
    assert np.std(table.latent[second] - table.latent[first]) > 4 * SCALE


def test_absurd_latents_take_their_modes_along() -> None:
    problem, _, _ = flips()
    table = problem.observations
    latent = table.latent.copy()
    latent[5] = 1e9
    cleared, warnings = without_absurd_values(replace(problem, observations=replace(table, latent=latent)))
    assert len(warnings) == 1 and cleared.observations.latent_mode_weight[5].sum() == 0
    noise = estimate_noise(cleared, SlamConfig())
    seen = resolve(cleared.observations, noise, SlamConfig(), fit_prior(cleared.observations, SlamConfig()))
    assert seen.latent_modes is not None and not seen.latent_modes.several[5]
    assert seen.latent_variance[5, 0] == LARGE_VARIANCE


@pytest.mark.parametrize("seed", [0, 1])
def test_the_plain_em_with_modes_never_falls_and_finds_the_category(seed: int) -> None:
    """Its evidence is that of the mixture, and started at the wrong means its latents reach the truth of most."""
    problem, latent, _ = flips(seed, wrong=0.3, objects=3)
    place = np.stack([4.0 * np.arange(3) - 8, np.zeros(3), np.full(3, 14.0)], axis=1)
    start = make_pose(np.tile(np.eye(3), (3, 1, 1)), place)
    state = em_init(problem, SlamConfig(), start, latent + 0.5)
    bounds = []
    for _ in range(4):
        state, info = em_step(state)
        bounds.append(info.bound)
    assert (np.diff(bounds) > -1e-8 * np.abs(bounds[:-1])).all()
    np.testing.assert_allclose(state.latent, latent, atol=5 * SCALE / np.sqrt(FRAMES))
    shares, weights, _ = e_step(state)
    assert weights.shape == (len(problem.observations), 3) and np.isfinite(shares).all()


def test_online_tracks_stay_whole_and_are_saved_with_their_modes(tmp_path: Path) -> None:
    """Half of the drive, a file, the other half: the same tracks as without the file, one landmark an object."""
    problem, latent, _ = flips()
    table = problem.observations
    config = SlamConfig(odometry_rotation_scale=0.001, odometry_translation_ratio=0.01)
    slam = IncrementalSlam(config, SlamProblem(problem.odometry[:4], table.select(table.frame < 4)))
    for t in range(10):
        slam.update(problem.odometry[t], table.select(table.frame == t))
    assert slam.tracker is not None and slam.tracker.latent_modes is not None
    assert slam.tracker.latent_modes.several.all() and slam.tracker.total == len(latent)
    slam.save(tmp_path / "state.npz")
    again = IncrementalSlam.load(tmp_path / "state.npz")
    for t in range(10, 16):
        for one in (slam, again):
            one.update(problem.odometry[t], table.select(table.frame == t))
    assert again.tracker is not None and again.tracker.latent_modes is not None
    np.testing.assert_array_equal(again.tracker.latent_modes.mean, slam.tracker.latent_modes.mean)
    np.testing.assert_array_equal(again.tracker.latent_modes.log_weight, slam.tracker.latent_modes.log_weight)
    assert slam.tracker.total == len(latent) and len(slam.landmarks()) == len(again.landmarks()) == len(latent)
    error = (slam.tracker.latent - latent[np.argsort(np.argsort(slam.tracker.mean[:, 0]))]) / np.sqrt(
        slam.tracker.latent_variance
    )
    assert np.abs(error).max() < 5  # each track is of its true category by now
