"""What the map states against what is true: background, existence, category, and the parts they are made of."""

from __future__ import annotations

from dataclasses import replace
from math import comb

import gtsam
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import beta, multivariate_normal

from nolbo_ppl.data.simulate import DetectorConfig, SimulatedSequence, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve, solve_with_associations
from nolbo_ppl.inference.slam.class_posterior import class_posterior, fit_confusion, votes_log_likelihood
from nolbo_ppl.inference.slam.detection_features import fit_prior
from nolbo_ppl.inference.slam.detection_pairs import detection_pairs
from nolbo_ppl.inference.slam.exposures import exposures_of
from nolbo_ppl.inference.slam.frame_model import initial_frame_model
from nolbo_ppl.inference.slam.graph import to_values
from nolbo_ppl.inference.slam.initialise import base_graph
from nolbo_ppl.inference.slam.linearisation import linearise
from nolbo_ppl.inference.slam.measurements import resolve
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.slam_state import SlamState
from nolbo_ppl.io.observations import Detections

CONFIG = SlamConfig(odometry_rotation_scale=0.01, odometry_translation_ratio=0.01)


def solved(seed: int, detector: DetectorConfig) -> tuple[SimulatedSequence, SlamResult]:
    """A small world whose objectness is the exact posterior of a true detection given its score."""
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=2, radius=22.0, frames_per_lap=45)[:60]
    world = WorldConfig(objects=25, categories=6, latent_dim=6)
    drive = simulate_sequence(truth, rng, world=world, detector=detector, odometry_rotation_scale=0.01)
    score, real = np.clip(drive.observations.objectness, 1e-6, 1 - 1e-6), drive.object_of >= 0
    true, false = (beta(10 * mean, 10 * (1 - mean)).pdf(score) for mean in detector.objectness)
    share = real.mean()
    table = replace(drive.observations, objectness=share * true / (share * true + (1 - share) * false))
    drive = replace(drive, observations=table)
    return drive, solve(SlamProblem(drive.odometry, table), CONFIG)


def log_score(stated: np.ndarray, happened: np.ndarray) -> float:
    p = np.clip(stated, 1e-6, 1 - 1e-6)
    return float(-np.mean(np.where(happened, np.log(p), np.log1p(-p))))


@pytest.fixture(scope="module")
def worlds() -> list[tuple[SimulatedSequence, SlamResult]]:
    weak = DetectorConfig(objectness=(0.65, 0.4), clutter_rate=0.5, miss_rate=0.2)
    return [solved(0, weak), solved(1, replace(weak, clutter_rate=3.0, miss_rate=0.3)), solved(2, replace(weak, miss_rate=0.6))]


def test_background_knows_more_than_objectness(worlds: list[tuple[SimulatedSequence, SlamResult]]) -> None:
    stated = np.concatenate([result.associations.background for _, result in worlds])
    alone = np.concatenate([1 - drive.observations.objectness for drive, _ in worlds])
    false = np.concatenate([drive.object_of < 0 for drive, _ in worlds])
    assert log_score(stated, false) < 0.5 * log_score(alone, false)
    for low, high in ((0.0, 0.5), (0.5, 1.01)):
        inside = (stated >= low) & (stated < high)
        assert inside.sum() > 50
        assert abs(stated[inside].mean() - false[inside].mean()) < 0.1


def test_existence_is_what_exists(worlds: list[tuple[SimulatedSequence, SlamResult]]) -> None:
    stated, real = [], []
    for drive, result in worlds:
        found = result.associations
        for j, probability in enumerate(result.existence()):
            mine = found.landmark == j
            true = found.weight[mine] @ (drive.object_of[found.row[mine]] >= 0)
            stated.append(probability)
            real.append(true > 0.5 * found.weight[mine].sum())
    assert len(stated) > 40
    assert abs(np.mean(stated) - np.mean(real)) < 0.06
    assert log_score(np.array(stated), np.array(real)) < 0.25


def test_the_rates_found_are_those_of_the_world(worlds: list[tuple[SimulatedSequence, SlamResult]]) -> None:
    for (drive, result), miss in zip(worlds, (0.2, 0.3, 0.6)):
        false = (drive.object_of < 0).sum()
        assert abs(result.associations.background.sum() - false) < 5 + 0.15 * false
        model = result.associations.model
        assert abs(np.median(model.detection_probability) - (1 - miss)) < 0.15


def test_an_object_that_leaves_is_doubted() -> None:
    """Two detections of one place, then in view without any: existence falls with every miss."""
    odometry = np.tile(np.eye(4), (60, 1, 1))
    rng = np.random.default_rng(0)
    # Three objects seen throughout teach the detector's reliability.
    steady = np.array([[-2.0, 0.0, 8.0], [0.0, 0.0, 9.0], [2.5, 0.0, 8.5]])
    frames = np.repeat(np.arange(60), 3)
    position = np.tile(steady, (60, 1)) + 0.1 * rng.standard_normal((180, 3))
    stated = []
    for first in (58, 30):  # in view and unseen before
        seen = np.array([[1.0, 0.5, 8.0], [1.05, 0.45, 8.02]])
        table = Detections.from_arrays(
            np.concatenate([frames, [first, first + 1]]),
            np.concatenate([position, seen]),
            position_scale=0.1,
            objectness=np.concatenate([np.full(180, 0.9), [0.6, 0.6]]),
        )
        config = replace(CONFIG, odometry_rotation_scale=1e-3, odometry_translation_scale=1e-3, odometry_translation_ratio=0.0)
        result = solve(SlamProblem(odometry, table), config)
        stated.append(result.associations.background[-2:].mean())
    assert min(stated) > 0.5


def test_category_of_objects_that_are_confused_again_and_again() -> None:
    """A seventh of the objects is taken for another category in 70 % of its views: stated probabilities hold on average."""
    stated, right = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        true, prone = rng.integers(6, size=20), rng.random(20) < 0.15
        other = (true + rng.integers(1, 6, 20)) % 6
        votes = np.zeros((20, 6))
        for i in range(20):
            for _ in range(rng.integers(2, 9)):
                votes[i, other[i] if prone[i] and rng.random() < 0.7 else true[i]] += 1
        frequency = np.log((votes.sum(axis=0) + 1) / (votes.sum() + 6))
        posterior = class_posterior(votes, frequency, fit_confusion(votes, frequency, 0.05))
        np.testing.assert_allclose(posterior.sum(axis=1), 1.0)
        stated += posterior.max(axis=1).tolist()
        right += (posterior.argmax(axis=1) == true).tolist()
    assert abs(np.mean(stated) - np.mean(right)) < 0.05


def test_votes_are_a_mixture_over_rates() -> None:
    """The closed form against quadrature over the unknown rate of a prone object."""
    votes, error, prone = np.array([[3.0, 2.0, 1.0]]), 0.05, 0.2
    for c in range(3):
        clean = (1 - prone) * (1 - error) ** votes[0, c] * (error / 2) ** (6 - votes[0, c])
        mixed = 0.0
        for o in {0, 1, 2} - {c}:
            rest = 6 - votes[0, c] - votes[0, o]
            mixed += (
                quad(lambda x, a, b: (1 - x) ** a * x**b, 0, 1, (votes[0, c], votes[0, o]))[0] * (error / 2) ** rest * prone / 2
            )
        assert votes_log_likelihood(votes, error, prone)[0, c] == pytest.approx(np.log(clean + mixed), abs=1e-9)


def test_patterns_of_detections_have_mass_one() -> None:
    table = Detections.from_arrays([0, 1], [[0.0, 0.0, 5.0], [0.0, 0.0, 6.0]], position_scale=0.1)
    noise = estimate_noise(SlamProblem(np.tile(np.eye(4), (2, 1, 1)), table), CONFIG)
    model = initial_frame_model(resolve(table, noise, CONFIG, fit_prior(table, CONFIG, noise)), CONFIG, 2)
    hits = np.arange(8.0)
    value = np.exp(model.log_pattern(hits, np.full(8, 7.0), np.full(8, 0.6)))
    assert sum(comb(7, int(h)) * p for h, p in zip(hits, value)) == pytest.approx(1.0)


@pytest.mark.parametrize("flat", [False, True])
def test_the_density_of_detections_is_a_density(flat: bool) -> None:
    """Monte Carlo over a box: the detections a frame; a flat world is as thick as its measurement, not infinitely dense."""
    rng = np.random.default_rng(0)
    position = rng.uniform([-5, -1, 4], [5, 1, 20], (400, 3)) * [1, 0 if flat else 1, 1]
    table = Detections.from_arrays(np.repeat(np.arange(100), 4), position, position_scale=0.2)
    noise = estimate_noise(SlamProblem(np.tile(np.eye(4), (100, 1, 1)), table), replace(CONFIG, correct_scales=False))
    model = initial_frame_model(resolve(table, noise, CONFIG, fit_prior(table, CONFIG, noise)), CONFIG, 100)
    low, high = np.array([-15.0, -3.0, -6.0]), np.array([15.0, 3.0, 30.0])
    value = np.exp(model.log_detection_density(rng.uniform(low, high, (40000, 3)))) * np.prod(high - low)
    assert abs(value.mean() - 4.0) < 5 * value.std() / np.sqrt(len(value))
    assert np.exp(model.log_detection_density(position)).max() < 4.0 / (50 * 0.2)


def test_the_field_of_view_bounds_what_could_be_seen() -> None:
    table = Detections.from_arrays(np.zeros(20, int), np.linspace([-8, 0, 9], [8, 0, 10], 20), position_scale=0.1)
    noise = estimate_noise(SlamProblem(np.eye(4)[None], table), CONFIG)
    narrow = replace(CONFIG, field_of_view=(np.pi / 2, np.pi / 3))
    model = initial_frame_model(resolve(table, noise, narrow, fit_prior(table, narrow, noise)), narrow, 1)
    points = np.array([[0.0, 0.0, 10.0], [8.0, 0.0, 8.5], [-8.6, 0, 8.4], [0.0, 0.0, -10.0], [0.0, 9.0, 9.5]])
    seen = exposures_of(model, np.eye(4)[None], points)
    assert seen.count.sum(axis=1).tolist() == [1, 1, 0, 0, 0]
    with pytest.raises(InputError, match="field_of_view"):
        SlamConfig(field_of_view=(0.0, 1.0))


def test_identical_objects_give_no_evidence() -> None:
    """All latents are one point seen with noise: a match is worth nothing on average, in any dimension."""
    rng = np.random.default_rng(0)
    for d in (8, 128):
        latent = 0.7 * rng.standard_normal((600, d))
        table = Detections.from_arrays(np.arange(600), np.tile([0, 0, 5.0], (600, 1)), latent=latent, latent_scale=0.7)
        prior = fit_prior(table, CONFIG)
        landmark = 0.7 / np.sqrt(30) * rng.standard_normal((600, d))
        one = np.full((600, d), 0.7**2)
        none = np.full(600, -1)
        ratio = prior.log_likelihood_ratio(latent, one, none, landmark, one / 30, none)
        assert abs(ratio.mean()) < 0.5
        assert ratio.mean() < 0.3


def test_a_detection_is_judged_without_itself() -> None:
    """Its prediction is that of the graph solved again without it."""
    rng = np.random.default_rng(3)
    odometry = np.tile(np.eye(4), (3, 1, 1))
    odometry[:, 0, 3] = np.arange(3) * 0.5
    point = np.array([[0.4, 0.2, 6.0], [-1.0, 0.1, 7.0]])
    frame, owner = np.repeat(np.arange(3), 2), np.tile([0, 1], 3)
    position = point[owner] - odometry[frame, :3, 3] + 0.2 * rng.standard_normal((6, 3))
    table = Detections.from_arrays(frame, position, position_scale=0.2)
    config = SlamConfig(odometry_rotation_scale=0.005, odometry_translation_scale=0.1, correct_scales=False)
    problem = SlamProblem(odometry, table)
    state = solve_with_associations(problem, owner, config)
    pairs = detection_pairs(state, linearise(base_graph(state), state.estimate), np.random.default_rng(0))
    for k in (2, 5):
        pair = np.flatnonzero((pairs.row == k) & (pairs.landmark == owner[k]))[0]
        kept = owner.copy()
        kept[k] = -1
        rest = solve_with_associations(problem, kept, config)
        marginals = gtsam.Marginals(base_graph(rest), state_values(rest))
        keys = gtsam.KeyVector([gtsam.symbol("x", int(frame[k])), gtsam.symbol("l", int(owner[k]))])
        joint = marginals.jointMarginalCovariance(keys)
        blocks = np.block([[joint.at(a, b) for b in keys] for a in keys])
        T, L = rest.estimate.T_world_camera[frame[k]], rest.estimate.T_world_landmark[owner[k]]

        def local(step: np.ndarray, T: np.ndarray = T, L: np.ndarray = L) -> np.ndarray:
            camera, landmark = gtsam.Pose3(T).retract(step[:6]), gtsam.Pose3(L).retract(step[6:])
            return camera.transformTo(landmark.translation())

        H = np.stack([(local(1e-5 * e) - local(-1e-5 * e)) / 2e-5 for e in np.eye(12)], axis=1)
        expected = multivariate_normal(local(np.zeros(12)), H @ blocks @ H.T + 0.04 * np.eye(3)).logpdf(position[k])
        assert pairs.log_position[pair] == pytest.approx(expected, abs=0.15)


def state_values(state: SlamState) -> gtsam.Values:
    return to_values(state.estimate)


def test_samples_are_of_the_posterior(worlds: list[tuple[SimulatedSequence, SlamResult]]) -> None:
    """Positions of poses and landmarks spread as the marginal covariances say, and vary together."""
    _, result = worlds[0]
    poses, landmarks = result.sample(2000, seed=1)
    R = result.T_world_camera[40, :3, :3]
    exact = R @ result.pose_covariances(np.array([40]))[0, 3:, 3:] @ R.T
    if len(result.hypotheses) < 2:  # else the covariance is that of the mixture
        drawn = np.cov(poses[:, 40, :3, 3].T)
        error = np.sqrt((np.outer(np.diag(exact), np.diag(exact)) + exact**2) / 2000)
        assert (np.abs(drawn - exact) < 5 * error + 0.02 * np.abs(exact).max()).all()
    assert landmarks.shape == (2000, len(result.landmarks), 4, 4)
    found = result.associations
    j = int(found.landmark[np.argmax(found.row)])  # seen in the last frames, far from the first pose
    apart = poses[:, -1, :3, 3] - landmarks[:, j, :3, 3]
    assert np.trace(np.cov(apart.T)) < np.trace(np.cov(poses[:, -1, :3, 3].T)) + np.trace(np.cov(landmarks[:, j, :3, 3].T))


def test_expected_detections_are_as_many_as_there_were(worlds: list[tuple[SimulatedSequence, SlamResult]]) -> None:
    expected = sum(result.expected_detections(T).sum() for _, result in worlds for T in result.T_world_camera)
    seen = sum(result.associations.weight.sum() for _, result in worlds)
    assert abs(expected - seen) < 0.1 * seen
    with pytest.raises(InputError, match="no pose"):
        worlds[0][1].expected_detections(np.full((4, 4), np.nan))


def test_the_graph_is_gtsams_own(worlds: list[tuple[SimulatedSequence, SlamResult]]) -> None:
    """A user adds a factor, here a known position of the last pose, and solves again."""
    drive, result = worlds[0]
    last = len(drive.truth) - 1
    graph = result.graph.clone()
    key = gtsam.symbol("x", last)
    graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(drive.truth[last]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    answer = gtsam.LevenbergMarquardtOptimizer(graph, result.values).optimize()
    np.testing.assert_allclose(answer.atPose3(key).matrix(), drive.truth[last], atol=1e-2)
