"""The paper's programme, every stage, on tiny data sets in their own layouts; what each takes from the one before."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from nolbo_ppl import load
from nolbo_ppl.cli import main
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.svi import OptimizerConfig, learning_rate
from nolbo_ppl.models.backbones import Darknet19Encoder
from nolbo_ppl.models.classifiers import (
    BINS,
    PictureBatch,
    PictureClassifier,
    bin_centres,
    bin_targets,
    classification_terms,
    predicted_viewpoint,
)
from nolbo_ppl.training import paper_loop, paper_stages, scene_stages
from nolbo_ppl.training.paper_config import PaperConfig
from nolbo_ppl.training.paper_stages import run_paper
from nolbo_ppl.training.scene_stages import voxel_precision
from tests.archive_layouts import make_imagenet, make_modelnet, make_pascal, make_rendered
from tests.factories import random_batch, tiny_config, tiny_model
from tests.paper_worker import programme

NARROW = 1 / 64


@pytest.fixture(autouse=True)
def _float32() -> None:
    torch.set_default_dtype(torch.float32)


def options(stage: str, data: Path, out: Path, **changes: Any) -> PaperConfig:
    values: dict[str, Any] = {
        "width": NARROW, "steps": 4, "batch": 4, "bf16": False, "device": "cpu", "workers": 1, "log_every": 1,
        "evaluate_every": 2, "checkpoint_every": 2, "cache": out.parent / "cache", "latent_dim": 4, "decode": 3,
    }  # fmt: skip
    if stage in ("imagenet", "viewpoint"):
        values["sizes"] = (32,)
    if stage in ("single", "multi"):
        values |= {"categories": ("car", "chair"), "sizes": (32, 64), "batch": 4}
    if stage == "single":
        values["phases"] = (32, 64)
    return PaperConfig(stage, data, out, **{**values, **changes})


def rows(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_every_stage_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = tmp_path / "data"
    make_imagenet(data / "imagenet")
    make_rendered(data / "rendered")
    make_modelnet(data / "ModelNet40")
    make_pascal(data / "pascal")
    for split in ("train", "val"):
        cache = str(tmp_path / "cache")
        convert = ["convert", "pascal3d", "--data", str(data / "pascal"), "--out", str(data / split), "--split", split]
        main([*convert, "--grid", "64", "--cache", cache])

    imagenet = run_paper(options("imagenet", data / "imagenet", tmp_path / "imagenet"))
    assert imagenet.out.name == "core.safetensors" and 0 <= imagenet.held_out["top1"] <= imagenet.held_out["top5"] == 1
    viewpoint = run_paper(options("viewpoint", data / "rendered", tmp_path / "viewpoint", core=tmp_path / "imagenet"))
    assert set(viewpoint.held_out) == {"acc_pi6", "med_err_deg"}
    changed = load_file(viewpoint.out)["0.0.weight"] - load_file(imagenet.out)["0.0.weight"]
    assert 0 < float(changed.abs().max()) < 0.1  # four steps from where the first stage ended

    vae = run_paper(options("vae", data / "ModelNet40", tmp_path / "vae", steps=6))
    assert set(vae.held_out) == {"voxel_iou", "category"}
    assert load(vae.out).config.categories == ("lamp", "table") and load(vae.out).config.voxel_size == 64

    single = options(
        "single", data / "train", tmp_path / "single", validation=data / "val", core=viewpoint.out, decoder=tmp_path / "vae",
        switch=1.0, phase_steps=2, steps=6,
    )  # fmt: skip
    found = run_paper(single)
    stages = [row["stage"] for row in rows(tmp_path / "single") if "loss" in row]
    assert stages == ["single-32", "single-32", "single-64", "single-64", "single", "single"]
    assert 0 < found.held_out["voxel_map"] <= 1
    terms = next(row for row in rows(tmp_path / "single") if "loss" in row)
    for name in ("objectness_inclusive", "shape_kl", "voxels", "orientation_kl", "rotation", "box", "box_kl"):
        assert math.isfinite(terms[f"terms/{name}"])

    multi = run_paper(
        options(
            "multi", data / "train", tmp_path / "multi", validation=data / "val", initial=tmp_path / "single", steps=8,
            freeze_epochs=2, batch=6,
        )
    )  # fmt: skip
    rates = [row["learning_rate"] for row in rows(tmp_path / "multi") if "loss" in row]
    assert rates[:2] == [1e-5, 1e-5] and rates[2] > 5e-5  # one epoch of two steps, then 1e-4
    before, after = load_file(tmp_path / "single" / "model" / "model.safetensors"), load_file(multi.out / "model.safetensors")
    assert not torch.equal(before["guide.encoder.neck.0.0.weight"], after["guide.encoder.neck.0.0.weight"])
    model = load(multi.out)
    answer = model.observe(np.zeros((64, 96, 3), np.uint8), threshold=1e-4)
    assert answer.categories == ("car", "chair")
    card = (multi.out / "README.md").read_text()
    assert "--stage multi" in card and "voxel_map" in card and "nolbo_ppl.load" in card

    again = dataclasses.replace(single, resume=True)
    assert run_paper(again).held_out == pytest.approx(found.held_out, rel=1e-4)  # all done: the same networks, in 32 bits


def test_a_stage_goes_on_where_its_checkpoint_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_imagenet(tmp_path / "data")
    whole = run_paper(options("imagenet", tmp_path / "data", tmp_path / "whole"))
    original, count = paper_stages.PictureRun.step, [0]

    def dying(self: Any, batch: Any) -> Any:
        if count[0] == 3:
            raise KeyboardInterrupt
        count[0] += 1
        return original(self, batch)

    with monkeypatch.context() as patch:
        patch.setattr(paper_stages.PictureRun, "step", dying)
        with pytest.raises(KeyboardInterrupt):
            run_paper(options("imagenet", tmp_path / "data", tmp_path / "cut"))
    cut = run_paper(options("imagenet", tmp_path / "data", tmp_path / "cut"))
    a, b = load_file(whole.out), load_file(cut.out)
    assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
    assert [row["step"] for row in rows(tmp_path / "cut") if "loss" in row] == [1, 2, 3, 4]
    with pytest.raises(InputError, match="another configuration"):
        run_paper(options("imagenet", tmp_path / "data", tmp_path / "cut", seed=1))


def test_a_phase_ends_at_its_accuracy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_pascal(tmp_path / "pascal", scenes=4)
    main(
        [
            "convert",
            "pascal3d",
            "--data",
            str(tmp_path / "pascal"),
            "--out",
            str(tmp_path / "scenes"),
            "--cache",
            str(tmp_path / "c"),
        ]
    )
    reached = iter([0.5, 0.71, 0.2, 0.9, 0.9, 0.9])
    monkeypatch.setattr(scene_stages, "validate", lambda *_: {})
    monkeypatch.setattr(scene_stages, "voxel_precision", lambda *_: {"voxel_map": next(reached)})
    monkeypatch.setattr(paper_loop, "calibrate", lambda *_: paper_loop.Calibration())
    run_paper(
        options("single", tmp_path / "scenes", tmp_path / "run", steps=6, evaluate_every=1, decode=0, weights={"voxels": 0.0})
    )
    stages = [row["stage"] for row in rows(tmp_path / "run") if "loss" in row]
    assert stages == ["single-32", "single-32", "single-64", "single-64", "single", "single"]


def test_the_rate_is_held_then_rises() -> None:
    config = OptimizerConfig(20, 1e-4, start_rate=1e-5, hold=5, warmup=2, decay=0.0)
    rates = [learning_rate(config, step) for step in range(9)]
    assert rates == pytest.approx([1e-5] * 5 + [5.5e-5, 1e-4, 1e-4, 1e-4])


def test_bins_of_angles() -> None:
    torch.set_default_dtype(torch.float64)
    turn = bin_targets(torch.tensor([math.radians(359.6)]), BINS[0])
    assert int(turn.argmax()) == 0 and float(turn[0, 359]) > float(turn[0, 2])  # round the circle
    tilt = bin_targets(torch.tensor([math.radians(-90.0)]), BINS[1])
    assert int(tilt.argmax()) == 0 and float(tilt[0, 180]) < 1e-20
    assert float(turn.sum()) == pytest.approx(1) and float(turn[0, 1] / turn[0, 4]) == pytest.approx(math.exp(1.0))  # 3 degrees
    logits = torch.full((1, sum(BINS)), -10.0)
    for offset, at in ((0, 30), (BINS[0], 90 + 12), (BINS[0] + BINS[1], 350)):
        logits[0, offset + at] = 10.0
    found = torch.rad2deg(predicted_viewpoint(logits))[0]
    assert found.tolist() == pytest.approx([30.0, 12.0, 350.0])
    assert torch.rad2deg(bin_centres(BINS[1], torch.device("cpu"), torch.float64))[[0, 90, 180]].tolist() == pytest.approx(
        [-90, 0, 90]
    )


def test_each_category_has_viewpoints_of_its_own() -> None:
    torch.manual_seed(0)
    model = PictureClassifier(3, viewpoints=True, width=NARROW).eval()
    image = torch.randint(0, 256, (2, 3, 32, 32), dtype=torch.uint8)
    batch = PictureBatch(image, torch.tensor([2, 0]), torch.zeros(2, 3))
    outputs = model(batch)
    whole = model.head(model.core((image.float() - 127.5) / 64).mean((2, 3))).unflatten(-1, (3, -1))
    torch.testing.assert_close(outputs, torch.stack((whole[0, 2], whole[1, 0])), atol=1e-5, rtol=1e-4)
    terms = classification_terms(model, outputs, batch)
    assert set(terms) == {"azimuth", "elevation", "in_plane"} and all(float(value.detach()) < 0 for value in terms.values())


def test_the_core_is_darknets_and_narrows() -> None:
    full = Darknet19Encoder()
    kernels = [module for module in full.core.modules() if isinstance(module, torch.nn.Conv2d)]
    assert len(kernels) == 18 and full.channels == 1024 and kernels[-1].out_channels == 1024
    assert PictureClassifier(10, width=1.0).core.state_dict().keys() == full.core.state_dict().keys()
    assert Darknet19Encoder(0.25).channels == 256 and Darknet19Encoder(1e-3).channels == 4


def test_voxel_precision_is_one_for_a_decoder_that_knows() -> None:
    torch.set_default_dtype(torch.float64)
    config = tiny_config()
    model, batch = tiny_model(config), random_batch(config, scenes=2, slots=2)
    found = voxel_precision(model, iter([batch]))["voxel_map"]
    assert 0.2 < found < 0.45  # random voxels, three tenths of them filled
    assert voxel_precision(model, iter([batch.replace(has_voxels=torch.zeros_like(batch.has_voxels))])) == {}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0.0}, "width"),
        ({"sizes": (33,)}, "multiples of 32"),
        ({"sizes": (32, 64)}, "one side"),
        ({"decoder": Path("x")}, "weights for the stage imagenet"),
        ({"switch": 0.0}, "switch"),
        ({"steps": -1}, "steps"),
        ({"learning_rate": 1e9}, "learning_rate"),
    ],
)
def test_options_are_checked(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PaperConfig("imagenet", Path("d"), Path("o"), **changes)


def test_a_stage_needs_the_weights_of_the_one_before() -> None:
    with pytest.raises(InputError, match="stage multi without initial"):
        PaperConfig("multi", Path("d"), Path("o"))


def test_a_core_of_another_width_is_refused(tmp_path: Path) -> None:
    make_imagenet(tmp_path / "data")
    run_paper(options("imagenet", tmp_path / "data", tmp_path / "a", steps=1))
    make_rendered(tmp_path / "rendered")
    with pytest.raises(InputError, match=r"core\.safetensors"):
        run_paper(options("viewpoint", tmp_path / "rendered", tmp_path / "b", core=tmp_path / "a", width=1 / 8, steps=1))


def test_the_command_refuses_a_folder_of_something_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", "--stage", "imagenet", "--data", str(tmp_path), "--out", str(tmp_path / "run"), "--device", "cpu"])
    assert stop.value.code == 2 and "not a folder of ImageNet" in capsys.readouterr().err


@pytest.mark.slow
def test_two_processes_of_torchrun_learn_what_one_does(tmp_path: Path) -> None:
    """Pictures, shapes, single objects and scenes in two processes, which die in the third step of the last stage and go on:
    the networks of one process with the joint batch."""
    data = tmp_path / "data"
    make_imagenet(data / "imagenet")
    make_modelnet(data / "ModelNet40")
    make_pascal(data / "pascal")
    for split in ("train", "val"):
        convert = ["convert", "pascal3d", "--data", str(data / "pascal"), "--out", str(data / split), "--split", split]
        main([*convert, "--grid", "64", "--cache", str(tmp_path / "cache")])
    programme(data, tmp_path / "one", tmp_path / "one")
    worker = Path(__file__).resolve().parents[1] / "paper_worker.py"
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", str(worker)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}

    def run(*stop: str) -> subprocess.CompletedProcess[str]:
        arguments = [*launch, str(data), str(tmp_path / "two"), str(tmp_path / "one"), *stop]
        return subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=400)

    killed = run("3")
    assert killed.returncode != 0 and "exitcode  : 3" in killed.stderr, killed.stderr[-2000:]
    assert (
        not (tmp_path / "two" / "multi" / "model").exists() and (tmp_path / "two" / "multi" / "checkpoint.safetensors").exists()
    )
    done = run()
    assert done.returncode == 0, done.stderr[-2000:]
    # Pictures of a pixel in the last layers, four of them to normalise by: rounding counts there.
    most = {"imagenet/core": 1e-3, "vae/model/model": 1e-4, "single/model/model": 1e-4, "multi/model/model": 1e-4}
    for name, limit in most.items():
        one, two = (load_file(tmp_path / side / f"{name}.safetensors") for side in ("one", "two"))
        assert one.keys() == two.keys()
        of_statistics = [key for key in one if "running" in key]
        for keys in (of_statistics, [key for key in one if key not in of_statistics and one[key].is_floating_point()]):
            a, b = (torch.cat([tensors[key].flatten().double() for key in keys]) for tensors in (one, two))
            # AdamW turns the rounding of a gradient near zero into a whole step: single weights differ, all together hardly.
            assert float((a - b).norm() / a.norm()) < limit, name
        first, other = (
            next(row for row in rows(tmp_path / side / name.split("/")[0]) if "loss" in row) for side in ("one", "two")
        )
        assert other["gradient_norm"] == pytest.approx(first["gradient_norm"], rel=10 * limit), name
    steps = [row["step"] for row in rows(tmp_path / "two" / "multi") if "loss" in row]
    assert steps == [1, 2, 3, 4]
