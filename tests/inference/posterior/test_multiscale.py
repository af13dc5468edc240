"""Several sizes of an image: which one answers for which object, and the order of the answers."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.posterior.multiscale import MultiScalePredictor, join, side_of
from nolbo_ppl.models.model_config import tiny
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors, ViewpointModes

IMAGE = np.zeros((300, 1280, 3), dtype=np.uint8)
BOX = np.array([[0, 0, 30, 20], [100, 0, 200, 80], [300, 0, 700, 290], [800, 5, 860, 40.0]])
"""Longer sides 30, 100, 400 and 60 px."""


def answers(box, objectness, mark):
    n = len(box)
    return ObjectPosteriors(
        categories=("car",),
        objectness=np.asarray(objectness, dtype=float),
        box=np.asarray(box, dtype=float).reshape(n, 4),
        box_scale=np.ones((n, 4)),
        class_log_posterior=np.zeros((n, 1)),
        class_log_likelihood=np.zeros((n, 1)),
        instance_log_posterior=None,
        latent=np.full((n, 2), float(mark)),
        latent_scale=np.ones((n, 2)),
        position=np.zeros((n, 3)),
        position_covariance=np.zeros((n, 3, 3)),
        viewpoint_modes=ViewpointModes(np.ones((n, 1)), np.full((n, 1), float(mark)), np.ones((n, 1))),
        elevation_inplane=np.zeros((n, 2)),
        elevation_inplane_scale=np.ones((n, 2)),
        viewpoint=np.zeros((n, 3)),
        R_camera_object=np.zeros((n, 3, 3)),
        rotation_scale=np.ones(n),
        diagonal=np.ones(n),
        diagonal_log_scale=np.ones(n),
        size=np.ones((n, 3)),
        voxel_mean=None,
        voxel_variance=None,
    )


class Eyes:
    """Answers with every box (or those asked for), marked by the size it looked at."""

    decode = shape_posterior = prior_mean = calibration = None

    def __init__(self, objectness):
        self.config, self.objectness, self.asked = dataclasses.replace(tiny(), image_size=128), objectness, []

    def observe(self, images, intrinsics, *, threshold, iou_threshold, decode, batch, size):
        return [answers(BOX, self.objectness[size], size) for _ in images]

    def observe_boxes(self, images, intrinsics, boxes, *, decode, batch, size):
        self.asked.append((size, [len(box) for box in boxes]))
        return [answers(box, np.ones(len(box)), size) for box in boxes]


def test_each_size_answers_for_what_it_shows_at_a_trained_size():
    """At 320 px a quarter of the size (7, 25, 100, 15 px), at 960 three quarters (22, 75, 300, 45): trained 14 to 120."""
    model = MultiScalePredictor(Eyes({320: [0.9, 0.5, 0.9, 0.9], 960: [0.8, 0.6, 1.0, 0.3]}), [960, 320])
    (found,) = model.observe([IMAGE])
    mark = {int(side): int(latent) for side, latent in zip(side_of(found.box), found.latent[:, 0])}
    # Only 960 shows the smallest, only 320 the largest; of the two answers for the others the surer one stays.
    assert mark == {30: 960, 100: 960, 400: 320, 60: 320}
    assert (np.diff(found.objectness) <= 0).all() and len(found) == 4


def test_the_ends_answer_for_what_is_beyond():
    one = MultiScalePredictor(Eyes({64: [0.9, 0.8, 0.7, 0.6]}), [64])
    assert len(one.observe([IMAGE])[0]) == 4


def test_boxes_keep_their_order():
    eyes = Eyes({})
    model = MultiScalePredictor(eyes, (320, 960))
    first, second = model.observe_boxes([IMAGE, IMAGE], None, [BOX, BOX[[2, 0]]])
    np.testing.assert_array_equal(first.box, BOX)
    np.testing.assert_array_equal(second.box, BOX[[2, 0]])
    # Nearest the geometric middle of the trained sizes, 41 px.
    assert first.latent[:, 0].tolist() == [960, 320, 320, 960] and second.latent[:, 0].tolist() == [320, 960]
    assert first.viewpoint_modes.azimuth[:, 0].tolist() == [960, 320, 320, 960]
    assert eyes.asked == [(320, [2, 1]), (960, [2, 1])]


def test_errors_and_interface():
    for sizes in ((), (0,), (100,)):
        with pytest.raises(InputError, match="sizes of the images"):
            MultiScalePredictor(SimpleNamespace(), sizes)
    with pytest.raises(InputError, match="no observations to join"):
        join([])
    assert len(join([answers(BOX, np.ones(4), 1)] * 2)) == 8


def test_a_pyramid_of_one_size_answers_as_the_model_does():
    """With a real network: one level, the network's own size, nothing dropped and nothing moved."""
    from nolbo_ppl.inference.posterior.predictor import ObservationModel
    from nolbo_ppl.models.observation_model import Nolbo

    model = ObservationModel(Nolbo.from_seed(dataclasses.replace(tiny(), image_size=128), 0))
    image = np.random.default_rng(0).integers(0, 256, (128, 128, 3), dtype=np.uint8)
    box = np.array([[10, 20, 60, 70], [50, 50, 90, 120.0]])
    plain, level = model.observe_boxes([image], None, [box], decode=False)[0], None
    pyramid = MultiScalePredictor(model, (128,))
    assert pyramid.calibration is model.calibration  # the law of the positions that an evaluation judges
    level = pyramid.observe_boxes([image], None, [box], decode=False)[0]
    for field in dataclasses.fields(ObjectPosteriors):
        a, b = getattr(plain, field.name), getattr(level, field.name)
        if isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b, err_msg=field.name)
    seen, merged = (
        m.observe([image], None, threshold=0.01, decode=False)[0] for m in (model, MultiScalePredictor(model, (128,)))
    )
    np.testing.assert_array_equal(np.sort(seen.objectness), np.sort(merged.objectness))
    assert len(merged) > 0
