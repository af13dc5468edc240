"""The latent's mixture over categories of the shipped weights, beside the likeliest category's Gaussian, on generated scenes."""

from __future__ import annotations

import numpy as np

from nolbo_ppl import load
from nolbo_ppl.evaluation.labelled_scenes import GeneratedScenes
from nolbo_ppl.evaluation.measure import measure_objects
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator


def test_the_mixture_scores_no_worse_than_one_gaussian() -> None:
    """Where two categories are likely the truth is at one of them: one Gaussian is sure of the wrong one at times."""
    model = load("tiny", "cpu")
    scenes = GeneratedScenes(SceneGenerator(preset("full", model.config.image_size), 424242), 12)
    truth = [scenes[i] for i in range(len(scenes))]
    slots = [np.flatnonzero(scene.counts(12.0, 0.5)) for scene in truth]
    answers = model.observe_boxes(
        [scene.image for scene in truth],
        np.array([scene.intrinsics for scene in truth]),
        [scene.box[rows] for scene, rows in zip(truth, slots)],
        decode=False,
    )
    found = measure_objects(truth, answers, slots, range(len(truth)), model)
    weights = [answer.latent_modes.weight for answer in answers if answer.latent_modes is not None]
    several = (np.concatenate(weights) > 0).sum(axis=1) > 1
    known = np.isfinite(found.latent_log_density)
    assert (several & known).sum() >= 5
    assert found.latent_log_density[known].mean() > found.latent_gaussian_log_density[known].mean()
    alone = known & ~several
    np.testing.assert_allclose(found.latent_log_density[alone], found.latent_gaussian_log_density[alone], rtol=1e-9)
    np.testing.assert_array_equal(found.latent_mass[alone], found.latent_gaussian_mass[alone])
    both = several & known  # the mixture holds its truths more often
    assert np.mean(found.latent_mass[both] <= 0.95) >= np.mean(found.latent_gaussian_mass[both] <= 0.95)
