"""The demonstration: its comparison with the truth on made-up answers, and all of it with a short run."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from nolbo_ppl.data.scene import Rendered
from nolbo_ppl.data.scene_config import preset
from nolbo_ppl.data.source import SceneSource
from nolbo_ppl.demo import DemoConfig, Found, compare, figures, object_table, run
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.rotation import viewpoint_to_matrix
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.inference.observations import Observations, ViewpointModes
from nolbo_ppl.inference.weights import save
from nolbo_ppl.models.calibration import Calibration
from nolbo_ppl.models.config import PRESETS
from nolbo_ppl.models.nolbo import Nolbo

CATEGORIES = PRESETS["tiny"]().categories


@pytest.fixture(scope="module")
def rendered() -> Rendered:
    """A scene with several objects."""
    source = SceneSource(preset("easy", 64), seed=5, instances=1)
    return next(scene for scene in map(source.render, range(30)) if len(scene.labels) >= 2)


def truthful(rendered: Rendered) -> Observations:
    """Answers that are the truth itself, with a scale of 10 cm."""
    labels = rendered.labels
    n = len(labels)
    label = np.array([CATEGORIES.index(one.category) for one in labels])
    log_posterior = np.log(np.where(np.arange(len(CATEGORIES)) == label[:, None], 0.89, 0.01))
    voxels = np.stack([unpack_voxels(one.item.voxels[None], 32)[0] for one in labels]).astype(np.float64)
    return Observations(
        categories=CATEGORIES,
        objectness=np.linspace(0.9, 0.8, n),
        box=np.array([one.box for one in labels]),
        box_scale=np.ones((n, 4)),
        class_log_posterior=log_posterior,
        class_log_likelihood=log_posterior,
        instance_log_posterior=None,
        latent=np.zeros((n, 16)),
        latent_scale=np.ones((n, 16)),
        position=np.array([one.position for one in labels]),
        position_covariance=np.tile(0.01 * np.eye(3), (n, 1, 1)),
        viewpoint_modes=ViewpointModes(np.ones((n, 1)), np.zeros((n, 1)), np.ones((n, 1))),
        elevation_inplane=np.zeros((n, 2)),
        elevation_inplane_scale=np.ones((n, 2)),
        viewpoint=np.zeros((n, 3)),
        R_camera_object=np.array([one.R_camera_object for one in labels]),
        rotation_scale=np.ones(n),
        diagonal=np.array([one.size for one in labels]),
        diagonal_log_scale=np.ones(n),
        size=np.array([one.dimensions for one in labels]),
        voxel_mean=voxels,
        voxel_variance=np.zeros_like(voxels),
    )


def test_the_truth_compares_perfectly(rendered: Rendered) -> None:
    objects, spurious = compare(3, rendered, truthful(rendered))
    assert spurious == 0
    assert [one.scene for one in objects] == [3] * len(rendered.labels)
    for one, label in zip(objects, rendered.labels):
        assert one.said == one.category == label.category
        assert one.probability == pytest.approx(0.89)
        assert one.rotation_error == pytest.approx(0, abs=1e-6)
        assert one.said_distance == pytest.approx(one.distance)
        assert one.distance_scale == pytest.approx(0.1)
        assert one.position_mass == pytest.approx(0, abs=1e-12)
        assert one.voxel_iou == 1


def test_errors_are_those_that_were_put_in(rendered: Rendered) -> None:
    said = truthful(rendered)
    turn = viewpoint_to_matrix(torch.tensor([0.0, math.pi / 2 + 0.3, 0.0])).numpy()
    turn = turn @ viewpoint_to_matrix(torch.tensor([0.0, math.pi / 2, 0.0])).numpy().T
    ray = said.position / np.linalg.norm(said.position, axis=1, keepdims=True)
    wrong = dataclasses.replace(
        said, R_camera_object=said.R_camera_object @ turn, position=said.position + 0.25 * ray
    )
    objects, _ = compare(0, rendered, wrong)
    for one, label in zip(objects, rendered.labels):
        assert one.rotation_error <= 0.3 + 1e-6
        if label.symmetry == 1:
            assert one.rotation_error == pytest.approx(0.3, abs=1e-6)
        assert one.said_distance - one.distance == pytest.approx(0.25)
        # 2.5 scales: chi-square of three degrees of freedom at 6.25
        assert one.position_mass == pytest.approx(0.8999, abs=2e-4)


def test_missed_and_spurious(rendered: Rendered) -> None:
    said = truthful(rendered)
    moved = dataclasses.replace(said, box=np.where(np.arange(len(said))[:, None] == 0, said.box + 1000, said.box))
    objects, spurious = compare(0, rendered, moved)
    assert spurious == 1
    assert objects[0].said == "missed"
    assert math.isnan(objects[0].voxel_iou)
    assert all(one.said != "missed" for one in objects[1:])
    assert "missed" in object_table(objects).splitlines()[1]
    assert compare(0, rendered, said[[]])[1] == 0


def test_figures_count_only_what_counts() -> None:
    common = {"scene": 0, "visibility": 1.0, "side": 30.0, "distance": 4.0}
    good = {"said": "car", "rotation_error": 0.1, "said_distance": 5.0, "position_mass": 0.95, "voxel_iou": 0.5}
    objects = [
        Found(category="car", **common, **good),
        Found(category="bus", **common, **{**good, "rotation_error": 0.3, "said_distance": 4.0, "position_mass": 0.1}),
        Found(category="boat", **common),
        Found(category="sofa", **{**common, "side": 5.0}),
        Found(category="chair", **{**common, "visibility": 0.2}, **good),
    ]
    assert figures(objects, spurious=1) == pytest.approx({
        "objects": 3, "recall": 2 / 3, "precision": 3 / 4, "category_accuracy": 0.5,
        "rotation_error_deg": math.degrees(0.2), "distance_error": 0.125, "position_in_90": 0.5, "voxel_iou": 0.5,
    })  # fmt: skip
    assert figures([], 0) == {"objects": 0, "recall": 0, "precision": 0}


def test_a_wrong_model_or_option_fails_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such model"):
        run(DemoConfig(out=tmp_path / "out", model="huge"))
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="scenes: got 0, expected at least 1"):
        DemoConfig(scenes=0)


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Caches of 16 scenes a shard, and single precision."""
    monkeypatch.setattr("nolbo_ppl.data.cache.BLOCK", 16)
    torch.set_default_dtype(torch.float32)
    yield


@pytest.mark.slow
def test_the_whole_demonstration(small_blocks: None, tmp_path: Path) -> None:
    model = tmp_path / "model"
    save(model, Nolbo.from_seed(PRESETS["nano"](), 0), Calibration(objectness_slope=40.0, objectness_shift=158.5), {})
    config = DemoConfig(
        out=tmp_path / "demo", model=str(model), shape_steps=12, scene_steps=24, count=32, scenes=2, workers=1,
        threshold=0.9,
    )  # fmt: skip
    summary = run(config)
    lines = summary.text.splitlines()
    tables = [i for i, line in enumerate(lines) if ", nats a " in line]
    assert [lines[i].split("  ")[0] for i in tables] == ["shapes, nats a shape", "unseen scenes, nats a scene"]
    for start in tables:  # every column of the table sums to its last row
        rows = []
        for line in lines[start + 1 :]:
            if not line.startswith("  "):
                break
            rows.append([float(word) for word in line.split()[1:]])
        *terms, total = np.array(rows)
        np.testing.assert_allclose(np.sum(terms, axis=0), total, atol=0.06 * len(terms))
        if start == tables[0]:
            assert total[-1] > total[0]  # so few steps raise the bound of shapes, not yet that of scenes
    assert summary.picture.is_file()
    written = json.loads((config.out / "demo.json").read_text(encoding="utf-8"))
    assert written["figures"] == summary.figures
    assert len(summary.objects) > 0
    again = run(config)  # a finished run is not repeated
    assert again.text.splitlines()[:18] == lines[:18]
    assert again.training.waiting == 0
