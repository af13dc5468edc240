"""Images of a mix of data sets as they were given, and which of them are generated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from nolbo_ppl.data.converters.photographs import convert_photographs, read_photographs
from nolbo_ppl.synthetic.dataset_writer import write_scenes
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.training.stage_data import TrainingData, evenly
from nolbo_ppl.training.train_config import TrainConfig
from tests.data.converters.test_photographs import write


def test_images_keep_their_aspect_and_their_kind(tmp_path: Path) -> None:
    """Photographs, a rendered folder and rendered scenes: sizes as on disk, rendered ones generated, in one order."""
    photographs = read_photographs(write(tmp_path / "labels"))
    convert_photographs(photographs * 10, tmp_path / "photographs")
    write_scenes(tmp_path / "rendered", SceneGenerator(preset("easy", 64), 3, instances=2), 12)
    config = TrainConfig(
        tmp_path / "run", scenes=(tmp_path / "photographs", tmp_path / "rendered"), mix=(0.4, 0.3, 0.3), difficulty="easy",
        batch=4, count=12, cache=tmp_path / "cache", image_size=64, single_steps=0, shape_steps=0, workers=1, render_sizes=(64,),
    )  # fmt: skip
    data = TrainingData(config, 0, 1, torch.device("cpu"))
    images, generated = list(data.plain_images(5)), data.plain_generated(False, 5)
    assert generated.tolist() == [False] * 5 + [True] * 10 and len(images) == 15
    sizes = {np.asarray(Image.open(photo.image)).shape for photo in photographs}
    assert {image.shape for image in images[:5]} <= sizes and any(h != w for h, w, _ in sizes)
    assert {image.shape for image in images[5:]} == {(64, 64, 3)}
    held_out = sum(len(batch.image) for batch in data.plain(True, 5))
    assert len(data.plain_generated(True, 5)) == held_out


def test_numbers_are_spread_evenly() -> None:
    assert evenly(10, 4).tolist() == [0, 3, 6, 9] and evenly(3, 9).tolist() == [0, 1, 2]
