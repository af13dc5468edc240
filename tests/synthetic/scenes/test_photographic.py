"""Scenes as a phone takes them: lens effects against plain sums, daylight, people and plants; other scenes stay as they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.synthetic.renderer.lens import compressed, motion_blurred, vignetted
from nolbo_ppl.synthetic.renderer.materials import sample_material
from nolbo_ppl.synthetic.scenes.distractors import unit_mesh
from nolbo_ppl.synthetic.scenes.occluders import sample_occluder, sample_person, sample_plant
from nolbo_ppl.synthetic.scenes.scene_config import photographic, preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator


def test_motion_spreads_light_along_its_path() -> None:
    point = np.zeros((21, 21, 3), dtype=np.float32)
    point[10, 10] = 1.0
    out = motion_blurred(point, np.array([6.0, -3.0]))[..., 0]
    assert out.sum() == pytest.approx(1.0, rel=1e-5)  # no light is lost
    y, x = np.mgrid[:21, :21]
    mean = np.array([(out * x).sum(), (out * y).sum()])
    np.testing.assert_allclose(mean, [10, 10], atol=1e-5)
    moment = np.array([[(out * (x - 10) ** 2).sum(), (out * (x - 10) * (y - 10)).sum()], [0, (out * (y - 10) ** 2).sum()]])
    assert moment[0, 1] < 0 and moment[0, 0] / moment[1, 1] == pytest.approx(4.0, rel=0.3)  # along (2, -1)
    assert motion_blurred(point, np.zeros(2)) is point


def test_vignetting_and_compression() -> None:
    white = np.ones((40, 60, 3), dtype=np.float32)
    out = vignetted(white, 0.4)
    corner = 1 - 0.4 * ((1 - 1 / 60) ** 2 + (1 - 1 / 40) ** 2) / 2
    assert out.dtype == np.float32 and out[0, 0, 0] == pytest.approx(corner) and out[20, 30, 0] == pytest.approx(1, abs=1e-3)
    image = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    errors = [np.abs(compressed(image, q).astype(int) - image).mean() for q in (20, 60, 95)]
    assert errors[0] > errors[1] > errors[2] > 0 and compressed(image, 100) is image


@pytest.mark.parametrize("make", [sample_person, sample_plant])
def test_occluders_are_things_of_their_height(make) -> None:  # type: ignore[no-untyped-def]
    for seed in range(20):
        parts, roles = make(np.random.default_rng(seed))
        assert len(parts) == len(roles)
        points = np.concatenate([unit_mesh(p.kind)[0] @ p.linear.T + p.offset for p in parts])
        height = np.ptp(points[:, 2])
        assert (1.6 < height < 2.0) if make is sample_person else (0.6 < height < 1.5)
        assert abs(points[:, 2].min()) < 0.25
        for role in set(roles):
            assert min(sample_material(role, np.random.default_rng(0)).albedo) >= 0
        parts, _, box = sample_occluder(np.random.default_rng(seed))
        assert np.linalg.norm(box[1] - box[0]) == pytest.approx(1.0)
        np.testing.assert_allclose(box[0] + box[1], 0, atol=1e-9)


def test_photographic_scenes_are_drawn_from_their_number_alone() -> None:
    config = photographic(preset("full", 64))
    source, again = SceneGenerator(config, 5, instances=2), SceneGenerator(config, 5, instances=2)
    for index in (0, 3):
        np.testing.assert_array_equal(source.render(index).image, again.render(index).image)
    scenes = [source.scene(k) for k in range(24)]
    assert any(len(scene.view.lights) == 0 for scene in scenes)  # overcast
    assert len({scene.jpeg_quality for scene in scenes}) > 8
    assert max(np.hypot(*scene.motion) for scene in scenes) <= config.motion_blur
    clutter = [sum(p.instance_id < 0 for p in scene.view.placed) for scene in scenes]
    assert max(clutter) > 20  # people have many parts


def test_other_scenes_and_their_caches_stay_as_they_were() -> None:
    plain = preset("full", 64)
    assert not {"motion_blur", "vignetting", "jpeg_quality", "occluders", "daylight"} & set(plain.described())
    assert photographic(plain).described()["occluders"] == 2
    one = SceneGenerator(plain, 5, instances=2).scene(2)
    assert (one.motion, one.vignetting, one.jpeg_quality) == ((0.0, 0.0), 0.0, 100)
    other = SceneGenerator(replace(plain, jpeg_quality=(40, 40)), 5, instances=2).scene(2)
    assert other.exposure == one.exposure and other.noise_seed == one.noise_seed  # nothing else is drawn anew
    assert [p.instance_id for p in other.view.placed] == [p.instance_id for p in one.view.placed]
    with pytest.raises(InputError, match="jpeg_quality"):
        replace(plain, jpeg_quality=(0, 50))
