"""COCO-style photographs as scenes: boxes, categories, viewpoints, and what is not labelled."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nolbo_ppl.data.converters.photographs import convert_photographs, read_photographs
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.errors import InputError
from nolbo_ppl.training.scene_loader import SceneLoader, ShapeTable, enlarged, join_batches, to_batch
from nolbo_ppl.training.stage_data import shares


def write(folder: Path, **changes: Any) -> Path:
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for name, size in (("a.png", (90, 60)), ("b.png", (60, 80))):
        Image.fromarray(rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)).save(folder / "images" / name)
    content = {
        "categories": [{"id": 6, "name": "car"}, {"id": 2, "name": "bicycle"}, {"id": 9, "name": "person"}],
        "images": [
            {"id": 1, "file_name": "a.png", "width": 90, "height": 60, "exhaustive": ["car"], "source": "s"},
            {"id": 2, "file_name": "b.png", "width": 60, "height": 80},
        ],
        "annotations": [
            {"id": 1, "image_id": 1, "category_id": 6, "bbox": [10, 20, 40, 30], "azimuth": 300, "elevation": 5, "theta": 2},
            {"id": 2, "image_id": 1, "category_id": 2, "bbox": [60, 20, 20, 20], "difficult": 1},
            {"id": 3, "image_id": 2, "category_id": 9, "bbox": [0, 0, 9, 9]},
        ],
    }
    content.update(changes)
    (folder / "val.json").write_text(json.dumps(content), encoding="utf-8")
    return folder


def test_labels_arrive_in_batches(tmp_path: Path) -> None:
    photographs = read_photographs(write(tmp_path / "data"))
    assert convert_photographs(photographs, tmp_path / "out") == {"images": 2, "objects": 1, "viewpoints": 1}
    folder = SceneFolder(tmp_path / "out", size=96)
    batch = to_batch(folder.batch([0, 1]))
    assert batch.exhaustive is not None and batch.ignore is not None
    car = folder.categories.index("car")
    assert batch.exhaustive[0].nonzero().flatten().tolist() == [car] and bool(batch.exhaustive[1].all())
    # 90 x 60 px in a square of 96: scaled by 96 / 90, 16 px down
    np.testing.assert_allclose(batch.ignore[0, 0], np.array([60, 20, 80, 40]) * 96 / 90 + np.array([0, 16, 0, 16]), rtol=1e-5)
    np.testing.assert_allclose(batch.box[0, 0], np.array([10, 20, 50, 50]) * 96 / 90 + np.array([0, 16, 0, 16]), rtol=1e-5)
    assert not batch.present[1].any() and not batch.has_position.any()
    # allocentric angles come back; PASCAL3D+'s in-plane rotation is measured the other way
    np.testing.assert_allclose(np.degrees(batch.viewpoint[0, 0].numpy()), [-60, 5, -2], atol=0.01)


def test_augmented_images_keep_what_is_not_labelled(tmp_path: Path) -> None:
    convert_photographs(read_photographs(write(tmp_path / "data")), tmp_path / "out")
    folder = SceneFolder(tmp_path / "out", size=96)
    supply = SceneLoader(folder, ShapeTable(*folder.shapes()), 2, 0, 4, size=192)
    small, large = to_batch(folder.batch([0])), supply.prepared(np.array([0]))
    assert small.ignore is not None and large.ignore is not None
    torch.testing.assert_close(large.ignore, 2 * small.ignore)


def test_mixed_batches_say_what_each_part_knows(tmp_path: Path) -> None:
    convert_photographs(read_photographs(write(tmp_path / "data")), tmp_path / "out")
    folder = SceneFolder(tmp_path / "out", size=96)
    first = to_batch(folder.batch([0]))
    latents = {"shape_loc": torch.ones(1, 8, 3), "shape_scale": torch.ones(1, 8, 3), "shape_index": torch.zeros(1, 8)}
    plain = first.replace(ignore=None, exhaustive=None, **latents)
    both = join_batches([first, plain])
    assert both.exhaustive is not None and both.ignore is not None and both.shape_loc is not None
    assert bool(both.exhaustive[1].all()) and not both.ignore[1].any()
    assert both.shape_index is not None and both.shape_index[0].tolist() == [-1] * 8
    assert not both.shape_loc[0].any()
    assert shares((0.3, 0.2, 0.5), 32) == [10, 6, 16] and sum(shares((1, 1, 1), 32)) == 32
    assert shares((1e-6, 1.0), 4) == [1, 3]
    with pytest.raises(InputError, match="batch"):
        shares((1, 1, 1), 2)


def test_enlarged_scenes_keep_their_labels(tmp_path: Path) -> None:
    convert_photographs(read_photographs(write(tmp_path / "data")), tmp_path / "out")
    arrays = SceneFolder(tmp_path / "out", size=96).batch([0])
    large = enlarged(arrays, 192)
    assert large["image"].shape[-2:] == (192, 192)
    np.testing.assert_allclose(large["box"], 2 * arrays["box"])
    np.testing.assert_allclose(large["intrinsics"], 2 * arrays["intrinsics"])
    assert enlarged(arrays, 96) is arrays


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"images": [{"id": 1, "file_name": "none.png", "width": 9, "height": 9}]}, "none.png"),
        ({"annotations": [{"id": 7, "image_id": 1, "category_id": 6, "bbox": [1, 2, 3]}]}, "annotation 7"),
        ({"annotations": 3}, "COCO"),
        ({"images": []}, "without images"),
    ],
)
def test_malformed_files_are_named(tmp_path: Path, changes: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        read_photographs(write(tmp_path, **changes))
