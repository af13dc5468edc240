"""Two views of one instance: the same shape, all else different, and nothing but the arguments decides."""

import dataclasses

import numpy as np
import pytest

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.evaluation.instance_views import MIN_VISIBILITY, InstanceViews, render_view
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.synthetic.shapes import shape_from_seed


@pytest.fixture(scope="module")
def source():
    return SceneGenerator(preset("standard", 64), seed=3, instances=5)


def test_views_show_the_instance_and_differ_in_all_else(source):
    views = InstanceViews(source, 4, CATEGORIES)
    for category in ("car", "bottle", "aeroplane"):
        one, two = views.pair(category, 2)
        shape = source.pool.item(category, 2).shape
        assert shape.instance == shape_from_seed(category, 300_002).instance
        for view in (one, two):
            assert len(view.box) == 1 and view.category[0] == category
            assert view.visibility[0] >= MIN_VISIBILITY and view.diagonal[0] == pytest.approx(shape.diagonal)
            np.testing.assert_array_equal(view.voxels[0], source.pool.item(category, 2).voxels)
            assert max(view.box[0, 2:] - view.box[0, :2]) > 12
        assert (one.image != two.image).mean() > 0.5
        assert np.abs(one.R_camera_object - two.R_camera_object).max() > 0.01 and (one.intrinsics != two.intrinsics).any()


def test_a_view_depends_on_its_arguments_alone(source):
    again = dataclasses.replace(source)
    render_view(again, "chair", 0, 0)  # what was rendered before does not matter
    np.testing.assert_array_equal(render_view(source, "car", 1, 1).image, render_view(again, "car", 1, 1).image)
    assert (render_view(source, "car", 1, 1).image != render_view(source, "car", 2, 1).image).any()


def test_instances_are_listed_by_category():
    shapes = [shape_from_seed(name, k) for name, count in (("car", 3), ("bus", 1), ("chair", 2)) for k in range(count)]
    source = SceneGenerator(preset("easy", 64), cad=tuple(shapes))
    assert InstanceViews(source, 2, CATEGORIES).instances == [("car", 0), ("car", 1), ("chair", 0), ("chair", 1)]
    assert InstanceViews(source, 100, ("chair",)).instances == [("chair", 0), ("chair", 1)]
    assert InstanceViews(source, 100, ("bus",)).instances == []
