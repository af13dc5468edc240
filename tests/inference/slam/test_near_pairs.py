"""What keeps cost linear: near pairs by a tree, frames in parts, candidates in runs, each the same as the whole matrix."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, se3_exp, transform
from nolbo_ppl.inference.association import Associator
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, loop_candidates, near_pairs
from nolbo_ppl.inference.slam import frame_marginals as frames_module
from nolbo_ppl.inference.slam.detection_features import FeaturePrior, fit_prior
from nolbo_ppl.inference.slam.exposures import exposures_of
from nolbo_ppl.inference.slam.frame_marginals import frame_marginals
from nolbo_ppl.inference.slam.frame_model import initial_frame_model
from nolbo_ppl.inference.slam.graph import SlamEstimate
from nolbo_ppl.inference.slam.latent_population import LatentPopulation
from nolbo_ppl.inference.slam.loop_candidates import PosteriorSamples, TrackletFeatures, candidate_pairs
from nolbo_ppl.inference.slam.measurements import resolve
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.structures.detections import Detections


@pytest.mark.parametrize("chunk", [1, 50, 1 << 21])
def test_near_pairs_are_all_and_in_order(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    a, b = 5 * rng.standard_normal((300, 3)), 5 * rng.standard_normal((250, 3))
    square_a, square_b = rng.uniform(0, 3, 300), rng.exponential(2, 250)
    square_a[0] = 1e4  # near to all
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    expected = np.nonzero(distance**2 <= square_a[:, None] + square_b[None])
    assert 500 < len(expected[0]) < 20000
    for dense in (0, 10**9):
        monkeypatch.setattr(near_pairs, "DENSE_PAIRS", dense)
        monkeypatch.setattr(near_pairs, "CHUNK_PAIRS", chunk)
        found = near_pairs.near_pairs(a, square_a, b, square_b)
        for got, want in zip(found, expected):
            np.testing.assert_array_equal(got, want)
        assert all(len(x) == 0 for x in near_pairs.near_pairs(a, square_a, b[:0], square_b[:0]))


def test_too_many_near_pairs_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(near_pairs, "DENSE_PAIRS", 0)
    monkeypatch.setattr(near_pairs, "MAX_PAIRS", 99)
    point = np.zeros((10, 3))
    with pytest.raises(InputError, match="too many detections that could be one another's"):
        near_pairs.near_pairs(point, np.ones(10), point, np.ones(10))
    assert len(near_pairs.near_pairs(point[:9], np.ones(9), point, np.ones(10))[0]) == 90


def random_frames(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Three frames of 12 detections, of which some have no partner, others hang together."""
    frame = rng.permutation(np.repeat([3, 5, 9], 12))
    row, landmark = np.nonzero(rng.random((36, 15)) < 0.12)
    return frame, row, landmark, rng.normal(0, 2, len(row)), rng.normal(0, 1, 36)


@pytest.mark.parametrize("associator", ["exact", "softmax", "hungarian"])
def test_a_frame_in_parts_is_the_whole_frame(associator: Associator, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        problem = random_frames(rng)
        whole = frame_marginals(*problem, associator=associator)
        with monkeypatch.context() as patch:
            patch.setattr(frames_module, "SMALL_MATRIX", 0)
            parts = frame_marginals(*problem, associator=associator)
        for name in ("weight", "null", "log_evidence"):
            np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), atol=1e-10)
        assert parts.exact == whole.exact


def test_a_part_beyond_all_bounds_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frames_module, "SMALL_MATRIX", 0)
    monkeypatch.setattr(frames_module, "LARGEST_MATRIX", 8)
    pairs = np.array([0, 1, 2]), np.array([0, 0, 0])
    frame_marginals(np.zeros(3, int), *pairs, np.zeros(3), np.zeros(3))
    pairs = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
    with pytest.raises(InputError, match="3 detections and 3 objects that hang together"):
        frame_marginals(np.zeros(3, int), *pairs, np.zeros(9), np.zeros(3))


def tracklets(rng: np.random.Generator, m: int) -> tuple[SlamEstimate, PosteriorSamples, TrackletFeatures]:
    T = np.tile(np.eye(4), (m, 1, 1))
    T[:, :3, :] = se3_exp(rng.normal(0, 1, (m, 6)))[:, :3]
    latent, variance = rng.normal(0, 1, (m, 2)), np.full((m, 2), 0.3)
    density = loop_candidates.log_population(latent, variance)
    first = 5 * np.arange(m)
    features = TrackletFeatures(latent, variance, density, np.full(m, -1), np.ones(m, int), rng.random(m) < 0.7, first, first + 2)
    return SlamEstimate(np.eye(4)[None], T), PosteriorSamples(*(rng.normal(0, 0.4, (m, 3, 32)) for _ in range(2))), features


def test_candidates_in_runs_are_all_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    estimate, samples, features = tracklets(rng, 40)
    prior = FeaturePrior(np.zeros(2), LatentPopulation.of_one(np.zeros(2), np.ones(2)), (), np.zeros(0), 0.05)

    def found() -> loop_candidates.Pairs:
        return candidate_pairs(estimate, samples, features, prior, SlamConfig(), inflation=1.0, floor=0.2)

    whole = found()
    assert len(whole) > 300
    monkeypatch.setattr(loop_candidates, "CHUNK_PAIRS", 3 * 40)
    runs = found()
    for name in ("a", "b", "log_position", "log_feature"):
        np.testing.assert_allclose(getattr(runs, name), getattr(whole, name), rtol=1e-12)
    # With a limit, the best of each newer one are kept.
    monkeypatch.setattr(loop_candidates, "MAX_CANDIDATES", 4)
    few = found()
    value = whole.log_position + whole.log_feature
    expected = sorted(
        (int(a), int(whole.b[k]))
        for a in np.unique(whole.a)
        for k in sorted(np.flatnonzero(whole.a == a), key=lambda k: -value[k])[:4]
    )
    assert sorted(zip(few.a.tolist(), few.b.tolist())) == expected


def test_exposures_by_brute_force() -> None:
    rng = np.random.default_rng(3)
    table = Detections.from_arrays(np.zeros(30, int), rng.uniform([-6, -1, 3], [6, 1, 9], (30, 3)), position_scale=0.1)
    config = SlamConfig()
    problem = SlamProblem(np.eye(4)[None], table)
    noise = estimate_noise(problem, config)
    model = initial_frame_model(resolve(table, noise, config, fit_prior(table, config, noise)), config, 1)
    T = se3_exp(rng.normal(0, 1, (140, 6)))
    point = rng.uniform(-9, 9, (25, 3))
    found = exposures_of(model, T, point)
    expected = np.zeros_like(found.count)
    for pose in T:
        for j, p in enumerate(point):
            local = transform(inverse(pose), p)
            cell = int(model.cell(local[None])[0])
            if cell >= 0:
                expected[j, cell] += 1
    np.testing.assert_array_equal(found.count, expected)
    assert expected.sum() > 100
    number, mean = found.totals(model)
    np.testing.assert_array_equal(number, expected.sum(axis=1))
    assert mean[number > 0] == pytest.approx(model.detection_probability[0, 0])  # all cells are alike at first
    weight = rng.random(25)
    np.testing.assert_allclose(found.by_cell(weight), (weight[:, None] * expected).sum(axis=0))


PROGRAM = """
import resource, sys
import numpy as np
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.detection_features import fit_prior
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.tracking import build_tracklets
from nolbo_ppl.structures.detections import Detections
n = 6000
rng = np.random.default_rng(0)
place = rng.uniform([-60, -2, 2], [60, 2, 120], (n, 3))
place = np.tile(place, (2, 1)) + 0.05 * rng.standard_normal((2 * n, 3))
table = Detections.from_arrays(np.repeat([0, 1], n), place, position_scale=0.05)
problem = SlamProblem(np.tile(np.eye(4), (2, 1, 1)), table)
config = SlamConfig(odometry_rotation_scale=0.001, odometry_translation_scale=0.01)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
noise = estimate_noise(problem, config)
tracks = build_tracklets(problem, noise, config, fit_prior(table, config, noise))
print(len(tracks), (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def test_thousands_of_detections_in_a_frame_take_no_matrix() -> None:
    """6 000 in each of two frames: the matrix of gaps and covariances would hold 3.4 GB."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    tracks, megabytes = map(int, done.stdout.split())
    assert tracks > 5000
    assert megabytes < 700
