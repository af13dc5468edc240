"""How often places are in view, by brute force; and objects seen once in simulated worlds beside what their exposures predict."""

from dataclasses import replace

import numpy as np

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.geometry.pose import inverse, transform
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.detection_features import fit_prior
from nolbo_ppl.inference.slam.exposures import exposures_of, exposures_of_places
from nolbo_ppl.inference.slam.frame_model import initial_frame_model
from nolbo_ppl.inference.slam.measurements import resolve
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise

MISSED = 0.3


def drive(seed):
    """A world without clutter: detections, their objects, the true poses, and the true model of a frame."""
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=2, radius=22.0, frames_per_lap=45)[:60]
    found = simulate_sequence(
        truth,
        rng,
        world=WorldConfig(objects=40, categories=4, latent_dim=0),
        detector=DetectorConfig(clutter_rate=0.0, miss_rate=MISSED),
    )
    problem, config = SlamProblem(truth, found.observations), SlamConfig()
    noise = estimate_noise(problem, config)
    seen = resolve(problem.observations, noise, config, fit_prior(problem.observations, config, noise))
    model = initial_frame_model(seen, config, len(truth))
    edges = np.linspace(2.0, 25.0, len(model.range_edges))  # the detector's own view
    azimuths = np.linspace(-np.pi / 4, np.pi / 4, len(model.azimuth_edges))
    model = replace(model, range_edges=edges, azimuth_edges=azimuths)
    alike = np.full_like(model.detection_probability, 1 - MISSED)
    return seen, found.object_of, truth, replace(model, detection_probability=alike, concentration=1e4)


def test_exposures_are_frames_with_the_place_in_view():
    seen, _, T_world_camera, model = drive(0)
    point = transform(T_world_camera[seen.frame], seen.position)[::7]
    found = exposures_of(model, T_world_camera, point)
    for j, place in enumerate(point):
        cells = [int(model.cell(transform(inverse(T), place[None]))[0]) for T in T_world_camera]
        assert found.count[j].tolist() == np.bincount([c for c in cells if c >= 0], minlength=found.count.shape[1]).tolist()


def test_only_here_averages_over_the_places_it_can_be():
    """Against samples of the whole covariance, each kept where its own frame could have detected it."""
    expected = sampled = 0.0
    variance = 0.0
    rng = np.random.default_rng(5)
    for seed in range(6):
        seen, _, T_world_camera, model = drive(seed)
        tall = replace(model, elevation_limits=(-1.5, 1.5))  # nodes lie in the plane of the view
        expected += np.exp(exposures_of_places(tall, T_world_camera, seen).log_only_here(tall)).sum()
        root = np.linalg.cholesky(seen.covariance)
        values, kept = np.zeros((40, len(seen))), np.zeros((40, len(seen)), dtype=bool)
        for k in range(40):
            place = seen.position + np.einsum("nij,nj->ni", root, rng.normal(size=(len(seen), 3)))
            kept[k] = tall.cell(place) >= 0
            count = exposures_of(tall, T_world_camera, transform(T_world_camera[seen.frame], place)).count.sum(axis=1)
            values[k] = MISSED ** np.maximum(count - 1, 0)
        number = np.maximum(kept.sum(axis=0), 1)
        mean = (values * kept).sum(axis=0) / number
        sampled += mean.sum()
        variance += ((((values - mean) ** 2) * kept).sum(axis=0) / number**2).sum()
    assert abs(expected - sampled) < 5 * np.sqrt(variance) + 0.05 * sampled


def test_objects_seen_once_are_as_many_as_predicted():
    """An object that is detected and missed wherever else it was in view: its expected number is a sum over all detections."""
    expected, at_measured_place, once = 0.0, 0.0, 0
    for seed in range(20):
        seen, object_of, T_world_camera, model = drive(100 + seed)
        places = exposures_of_places(model, T_world_camera, seen)
        expected += np.exp(places.log_only_here(model)).sum()
        at_measured_place += np.sum(MISSED ** np.maximum(places.middle.count.sum(axis=1) - 1, 0))
        once += int((np.bincount(object_of) == 1).sum())
    assert once > 20
    assert abs(expected - once) < 2 * np.sqrt(once)
    assert at_measured_place - once > 2 * np.sqrt(once)
