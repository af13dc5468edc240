"""Curves of precision and recall, neighbours in latent spaces, viewpoints by category."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.evaluation.labelled_scenes import GeneratedScenes
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.metrics.voxel import voxel_average_precision
from nolbo_ppl.models.model_config import nano
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.reproduction.object_answers import (
    BINS,
    ObjectAnswers,
    answers_at_boxes,
    nearest_category_accuracy,
    occupancy_curve,
)
from nolbo_ppl.reproduction.paper_numbers import CATEGORIES as PAPER_CATEGORIES
from nolbo_ppl.reproduction.tables_of_objects import accuracy_row, median_row, plane_map, prior_samples
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator


def counts(probability: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    index = np.minimum((probability * BINS).astype(int), BINS - 1)
    return tuple(np.bincount(index[part], minlength=BINS)[None] for part in (truth, ~truth))  # type: ignore[return-value]


def test_precision_and_recall_by_thresholds() -> None:
    """At every threshold: by counting voxels above it; the area is that of the exact curve of probabilities in whole bins."""
    rng = np.random.default_rng(0)
    truth = rng.random(8**3) < 0.3
    probability = (rng.integers(0, BINS, 8**3) + 0.5) / BINS
    probability = np.where(truth, np.sqrt(probability), probability)
    probability = (np.floor(probability * BINS) + 0.5) / BINS
    curve = occupancy_curve(*counts(probability, truth))
    assert (np.diff(curve.threshold) < 0).all() and curve.recall[-1] == 1.0
    for threshold, precision, recall in zip(curve.threshold, curve.precision, curve.recall):
        above = probability >= threshold
        assert recall == pytest.approx(truth[above].sum() / truth.sum()) and precision == pytest.approx(truth[above].mean())
    exact = voxel_average_precision(probability.reshape(1, 8, 8, 8), truth.reshape(1, 8, 8, 8))
    assert curve.area == pytest.approx(float(exact[0]), abs=1e-9)


def test_neighbours_of_the_same_category() -> None:
    rng = np.random.default_rng(1)
    label = np.arange(60) % 3
    apart = 20.0 * label[:, None] + rng.normal(size=(60, 4))
    assert nearest_category_accuracy(apart, label) == 1.0
    mixed = nearest_category_accuracy(rng.normal(size=(3000, 2)), rng.integers(0, 2, 3000))
    assert mixed == pytest.approx(0.5, abs=5 * np.sqrt(0.25 / 3000) * 2)
    assert np.isnan(nearest_category_accuracy(apart[:4], label[:4]))


def made_up(error: np.ndarray, category: np.ndarray, scene: np.ndarray) -> ObjectAnswers:
    n = len(error)
    zeros = np.zeros((n, BINS), int)
    return ObjectAnswers(scene, category, category, error, np.zeros((n, 2)), np.full(n, np.nan), zeros, zeros)


def test_rows_of_viewpoints() -> None:
    """Table 1 by hand: cars of 10 and 50 degrees, a chair of 20; categories without an object have no figure."""
    car, chair = CATEGORIES.index("car"), CATEGORIES.index("chair")
    found = made_up(np.radians([10.0, 50.0, 20.0, np.nan]), np.array([car, car, chair, chair]), np.array([0, 1, 1, 2]))
    accuracy, median = accuracy_row([found]), median_row([found])
    by_name = dict(zip([*PAPER_CATEGORIES, "mean"], zip(accuracy, median)))
    assert by_name["car"][0].value == 0.5 and by_name["car"][1].value == pytest.approx(30.0)
    assert by_name["chair"][0].value == 1.0 and by_name["chair"][1].value == pytest.approx(20.0)
    assert by_name["bus"][0].value is None
    assert by_name["mean"][0].value == 0.75 and by_name["mean"][1].value == pytest.approx(25.0)
    other = made_up(np.radians([10.0, 20.0, 20.0]), np.array([car, car, chair]), np.array([0, 1, 1]))
    two = dict(zip([*PAPER_CATEGORIES, "mean"], accuracy_row([found, other])))
    assert two["car"].value == 0.75 and two["car"].count == 2 and two["car"].low is not None


def test_answers_at_true_boxes() -> None:
    torch.set_default_dtype(torch.float32)
    scenes = GeneratedScenes(SceneGenerator(preset("easy", 64), 5, instances=2), 3)
    objects = [one.select(np.flatnonzero(one.counts())) for one in (scenes[i] for i in range(3))]
    for method in ("nolbo", "ae"):
        config = nano() if method == "nolbo" else nano().__class__(**{**nano().__dict__, "method": "ae"})
        found = answers_at_boxes(ObservationModel(Nolbo.from_seed(config, 0)), scenes)
        assert len(found.scene) == sum(len(one) for one in objects)
        assert found.category.tolist() == [label for one in objects for label in one.labels(config.categories)]
        assert np.isfinite(found.rotation_error).all() == (method == "nolbo")
        assert (found.occupied.sum(1) + found.empty.sum(1) == 32**3).all()
        occupied = [bits for one in objects for bits in np.unpackbits(one.voxels, axis=1).sum(1)]
        assert found.occupied.sum(1).tolist() == occupied
        assert ((found.iou >= 0) & (found.iou <= 1)).all()


def test_maps_of_latent_spaces() -> None:
    """Samples of the prior have its moments; a map keeps clusters together."""
    mean = np.array([[0.0, 0, 0], [30.0, 0, 0]])
    points, label = prior_samples(mean, 4000, np.random.default_rng(0))
    for k in (0, 1):
        assert np.abs(points[label == k].mean(0) - mean[k]).max() < 5 / np.sqrt(2000)
    pytest.importorskip("sklearn")
    flat = plane_map(points[:60])
    assert flat.shape == (60, 2) and nearest_category_accuracy(flat, label[:60]) == 1.0
