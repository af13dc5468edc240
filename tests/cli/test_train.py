"""Training end to end on tiny folders: exact resumption, refusals, partial labels, instances, several processes."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.cli import main
from nolbo_ppl.cli.train import TrainConfig, run
from nolbo_ppl.data import scene_cache as cache
from nolbo_ppl.errors import InputError, NolboError
from nolbo_ppl.inference.elbo import SHAPE_STAGE
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.io.files import read_json, read_jsonl, write_jsonl
from nolbo_ppl.io.tensors import load_tensors
from nolbo_ppl.models.model_config import ModelConfig, nano, tiny
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.synthetic.dataset_writer import write_scenes
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.training import stage_data as training
from nolbo_ppl.training.stages import StageRun


@pytest.fixture(autouse=True)
def _single_precision(_float64: None) -> Iterator[None]:
    """As users train: float32, one thread."""
    threads = torch.get_num_threads()
    torch.set_default_dtype(torch.float32)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A training folder of 12 scenes of 64 px, and 26 held-out ones."""
    root = tmp_path_factory.mktemp("folders")
    for name, seed, count in (("train", 3, 12), ("held_out", 4, 26)):
        write_scenes(root / name, SceneGenerator(preset("easy", 64), seed, instances=2), count)
    return root / "train", root / "held_out"


def config_of(folders: tuple[Path, Path], out: Path, **changes: Any) -> TrainConfig:
    """Four, three and six steps of the three stages; a checkpoint every second step."""
    values: dict[str, Any] = {
        "out": out,
        "preset": "nano",
        "scenes": folders[0],
        "validation": folders[1],
        "batch": 4,
        "shape_batch": 4,
        "shape_steps": 4,
        "single_steps": 3,
        "scene_steps": 6,
        "checkpoint_every": 2,
        "log_every": 1,
        "evaluate_every": 3,
        "evaluate_scenes": 4,
        "threads": 1,
        "bf16": False,
    }
    return TrainConfig(**{**values, **changes})


def arguments_of(config: TrainConfig) -> list[str]:
    """The command line of a configuration."""
    result = []
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), field.name.replace("_", "-")
        if value == field.default or value in ((), {}):
            continue
        if isinstance(value, dict):
            result += [f"--{name}", *(str(part) for item in value.items() for part in item)]
            continue
        if isinstance(value, tuple):
            result += [f"--{name}", *map(str, value)]
            continue
        result += [f"--{name}" if value else f"--no-{name}"] if isinstance(value, bool) else [f"--{name}", str(value)]
    return result


def weights(out: Path) -> dict[str, Tensor]:
    return load_tensors(out / "model" / "model.safetensors")[0]


def rows(out: Path) -> list[dict[str, Any]]:
    return [row for _, row in read_jsonl(out / "metrics.jsonl")]


def learnt(row: dict[str, Any]) -> dict[str, Any]:
    """A row of metrics without the clock."""
    return {key: value for key, value in row.items() if key not in ("seconds", "waited")}


def assert_same(a: dict[str, Tensor], b: dict[str, Tensor], tolerance: float = 0.0) -> None:
    assert a.keys() == b.keys()
    for name, value in a.items():
        difference = float((value.double() - b[name].double()).abs().max()) if value.numel() else 0.0
        assert difference <= tolerance, f"{name} differs by {difference}"


@pytest.fixture(scope="module")
def uninterrupted(folders: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing disturbed."""
    out = tmp_path_factory.mktemp("uninterrupted") / "run"
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    summary = run(config_of(folders, out))
    torch.set_default_dtype(default)
    assert summary.steps == 13
    assert 0 <= summary.waiting < 1
    return out


def test_the_model_can_be_loaded_and_tells_how_it_came_about(uninterrupted: Path) -> None:
    model = load(uninterrupted / "model")
    assert model.config.image_size == 64
    values = read_json(uninterrupted / "model" / "config.json")
    card = (uninterrupted / "model" / "README.md").read_text()
    assert "nolbo train" in card and "| box50 |" in card  # what to publish beside the weights
    assert values["training"]["preset"] == "nano"
    assert values["calibrated"] is True
    assert set(values["held_out"]) >= {"bound", "bound/voxels", "inclusive/objectness", "box50", "category"}
    history = rows(uninterrupted)
    shapes = [row["loss"] for row in history if row["stage"] == "shapes"]
    assert shapes[-1] < shapes[0]


def test_a_run_can_start_from_trained_weights(folders: tuple[Path, Path], uninterrupted: Path, tmp_path: Path) -> None:
    """Without steps the weights are those given; shapes stay as they are; another form of the networks is refused."""
    start = str(uninterrupted / "model")
    config = config_of(folders, tmp_path / "same", initial=start, shape_steps=0, single_steps=0, scene_steps=0)
    run(config)
    assert_same(weights(tmp_path / "same"), weights(uninterrupted))
    run(config_of(folders, tmp_path / "more", initial=start, shape_steps=0, single_steps=0, scene_steps=2))
    before, after = weights(uninterrupted), weights(tmp_path / "more")
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed and all(name.startswith("guide.") for name in changed)
    with pytest.raises(InputError, match="initial weights of another form"):
        config_of(folders, tmp_path / "other", initial=start, latent_dim=8).model()


def test_a_run_can_start_from_grown_weights(folders: tuple[Path, Path], uninterrupted: Path, tmp_path: Path) -> None:
    """The preset's blocks with everything else of the initial networks, whose weights are kept; and it trains."""
    start = str(uninterrupted / "model")
    grown = {"initial": start, "grow": True, "preset": "tiny", "shape_steps": 0, "single_steps": 0}
    run(config_of(folders, tmp_path / "grown", scene_steps=0, **grown))
    before, after = load(start).model, load(tmp_path / "grown" / "model").model
    assert after.config.encoder_blocks == tiny().encoder_blocks
    assert after.config.encoder_channels == before.config.encoder_channels == nano().encoder_channels
    assert torch.equal(after.guide.encoder.deep[1].first[0].weight, before.guide.encoder.deep[1].first[0].weight)
    assert torch.equal(after.guide.encoder.deep[3].norm.weight, torch.zeros(nano().encoder_channels[3]))
    run(config_of(folders, tmp_path / "trained", scene_steps=2, **grown))
    moved = load(tmp_path / "trained" / "model").model.guide.encoder.deep[3].norm.weight
    assert float(moved.abs().sum()) > 0
    with pytest.raises(InputError, match="networks to grow: got no initial weights"):
        config_of(folders, tmp_path / "none", grow=True)


def test_mixed_difficulties_are_thirds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the generated scenes is `standard`, one `full`, one from worlds; held-out scenes as well."""
    monkeypatch.setattr(cache, "BLOCK", 4)
    config = TrainConfig(
        tmp_path / "run",
        preset="nano",
        difficulty="mixed",
        count=12,
        evaluate_scenes=4,
        cache=tmp_path,
        single_steps=0,
        workers=1,
    )
    monkeypatch.setattr(training, "MIN_HELD_OUT", 4)
    data = training.TrainingData(config, 0, 1)
    assert len(data.train) == 12
    sources = [read_json(path) for path in (tmp_path / "scenes").glob("*/source.json")]
    assert len(sources) == 6
    assert {one["config"]["objects"][1] for one in sources if "config" in one} == {4, 6}
    assert {one["seed"] for one in sources if "views" in one} == {0, training.VALIDATION_SEED}
    from_worlds = data.train.batch(np.arange(8, 12))
    assert (from_worlds["instance"][from_worlds["present"]] >= 1_000_000).all()
    first = data.train.batch(np.arange(4))["image"]
    np.testing.assert_array_equal(first[0], SceneGenerator(preset("standard", 64), 0).render(0).image.transpose(2, 0, 1))


def test_metrics_have_a_row_a_step_whose_terms_make_the_loss(uninterrupted: Path) -> None:
    history = rows(uninterrupted)
    steps = [(row["stage"], row["step"]) for row in history if "loss" in row]
    assert steps == [
        *(("shapes", i) for i in range(1, 5)),
        *(("single", i) for i in range(1, 4)),
        *(("scenes", i) for i in range(1, 7)),
    ]
    for row in history:
        if row["stage"] == "shapes":
            weighted = sum(weight * row.get(f"terms/{name}", 0.0) for name, weight in SHAPE_STAGE.items())
            assert row["loss"] == pytest.approx(-weighted, rel=1e-6)
    assert [(row["stage"], row["step"]) for row in history if "bound" in row] == [("scenes", 3)]


@pytest.mark.parametrize("steps_before", [1, 3, 4, 5, 6, 10, 12])
def test_an_interrupted_run_ends_bit_for_bit_like_an_undisturbed_one(
    folders: tuple[Path, Path], uninterrupted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps_before: int
) -> None:
    config, made, original = config_of(folders, tmp_path), 0, StageRun.step

    def step(self: StageRun, batch: Any) -> Any:
        nonlocal made
        if made == steps_before:
            raise KeyboardInterrupt
        made += 1
        return original(self, batch)

    monkeypatch.setattr(StageRun, "step", step)
    with pytest.raises(KeyboardInterrupt):
        run(config)
    monkeypatch.setattr(StageRun, "step", original)
    assert not (tmp_path / "model").exists()
    run(config)
    assert_same(weights(tmp_path), weights(uninterrupted))
    assert list(map(learnt, rows(tmp_path))) == list(map(learnt, rows(uninterrupted)))


def test_interrupted_while_it_calibrates(
    folders: tuple[Path, Path], uninterrupted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import nolbo_ppl.training.trainer

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(nolbo_ppl.training.trainer, "calibrate", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(config_of(folders, tmp_path))
    run(config_of(folders, tmp_path))
    assert_same(weights(tmp_path), weights(uninterrupted))
    assert read_json(tmp_path / "model/config.json")["calibration"] == pytest.approx(
        read_json(uninterrupted / "model/config.json")["calibration"]
    )


@pytest.mark.slow
def test_a_killed_process_leaves_nothing_that_stops_the_next(
    folders: tuple[Path, Path], uninterrupted: Path, tmp_path: Path
) -> None:
    config = config_of(folders, tmp_path / "run")
    command = [sys.executable, "-m", "nolbo_ppl.cli.train", *arguments_of(config)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    for stage in ("shapes", "scenes"):  # once in the first stage, once in the last
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and process.poll() is None:
            file = config.out / "metrics.jsonl"
            if file.is_file() and f'"stage": "{stage}", "step": 3' in file.read_text(encoding="utf-8"):
                break
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.communicate()
    with (config.out / "metrics.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"stage": "scenes", "st')  # as a power cut may leave it
    run(config)
    assert_same(weights(config.out), weights(uninterrupted))
    assert list(map(learnt, rows(config.out))) == list(map(learnt, rows(uninterrupted)))


def test_a_finished_run_is_left_as_it_is(folders: tuple[Path, Path], uninterrupted: Path) -> None:
    before, history = weights(uninterrupted), rows(uninterrupted)
    summary = run(config_of(folders, uninterrupted))
    assert summary.waiting == 0
    assert_same(weights(uninterrupted), before)
    assert rows(uninterrupted) == history


def test_another_configuration_is_refused(folders: tuple[Path, Path], uninterrupted: Path) -> None:
    with pytest.raises(InputError, match=r"belongs to another configuration: got differing fields \['batch', 'seed'\]"):
        run(config_of(folders, uninterrupted, seed=1, batch=8))
    with pytest.raises(InputError, match=r"the folder holds a run.*choose another --out, or resume"):
        run(config_of(folders, uninterrupted, resume=False))


def test_a_truncated_checkpoint_is_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "checkpoint.safetensors").write_bytes(b"\x10\0\0\0\0\0\0\0{")
    with pytest.raises(InputError, match=r"checkpoint\.safetensors.*truncated"):
        run(config_of(folders, tmp_path))


def test_logging_and_checkpoints_do_not_touch_what_is_learnt(
    folders: tuple[Path, Path], uninterrupted: Path, tmp_path: Path
) -> None:
    run(config_of(folders, tmp_path, log_every=5, checkpoint_every=100, evaluate_every=1, tensorboard=True))
    assert_same(weights(tmp_path), weights(uninterrupted))
    assert list((tmp_path / "tensorboard").iterdir())


OPTIONAL = ("category", "instance", "rotation", "position", "size", "visibility", "symmetry")


def partly_labelled(folder: Path, out: Path) -> Path:
    """A folder whose objects lack one label or another; one image has boxes alone, one has none at all."""
    (out / "images").mkdir(parents=True)
    records = []
    for line, row in read_jsonl(folder / "scenes.jsonl"):
        source = folder / row["image"]
        (out / row["image"]).write_bytes(source.read_bytes())
        for i, thing in enumerate(row["objects"]):
            for k, name in enumerate(OPTIONAL):
                if line == 1 or (line + i) % 7 == k:
                    thing.pop(name, None)
        if line == 2:
            row["objects"] = []
        records.append(row)
    write_jsonl(out / "scenes.jsonl", records)
    (out / "voxels.npz").write_bytes((folder / "voxels.npz").read_bytes())
    return out


@pytest.mark.parametrize("objective", ["inclusive", "elbo", "paper"])
def test_partly_labelled_scenes_are_data_too(folders: tuple[Path, Path], tmp_path: Path, objective: Any) -> None:
    folder = partly_labelled(folders[0], tmp_path / "partly")
    changes: dict[str, Any] = {} if objective == "inclusive" else {"orientation": "angle", "freeze": 0.5, "decode": 3}
    summary = run(config_of((folder, folders[1]), tmp_path / "run", objective=objective, **changes))
    assert np.isfinite(summary.held_out["bound"])
    terms = {key for row in rows(tmp_path / "run") for key in row if key.startswith("terms/")}
    assert ("terms/label_inclusive" if objective == "inclusive" else "terms/label_kl") in terms


def test_boxes_alone_train_and_are_not_calibrated_on_a_handful(folders: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "boxes/images").mkdir(parents=True)
    records = []
    for _, row in read_jsonl(folders[0] / "scenes.jsonl"):
        (tmp_path / "boxes" / row["image"]).write_bytes((folders[0] / row["image"]).read_bytes())
        records.append({**row, "objects": [{"box": thing["box"]} for thing in row["objects"]]})
    write_jsonl(tmp_path / "boxes/scenes.jsonl", records)
    pair = (tmp_path / "boxes", tmp_path / "boxes")
    with pytest.raises(InputError, match=r"no shapes to learn.*use --shape-steps 0"):
        run(config_of(pair, tmp_path / "refused"))
    run(config_of(pair, tmp_path / "run", shape_steps=0, validation=None))
    values = read_json(tmp_path / "run/model/config.json")
    assert values["calibrated"] is False
    assert values["calibration"] == dataclasses.asdict(Calibration())
    with_objects = [row for row in rows(tmp_path / "run") if "loss" in row]
    assert all(row["terms/azimuth_inclusive"] == row["terms/tilt_inclusive"] == 0 for row in with_objects)
    assert all(row["terms/box_inclusive"] < 0 for row in with_objects)


def test_instance_labels_split_the_latent(folders: tuple[Path, Path], tmp_path: Path) -> None:
    run(config_of(folders, tmp_path, instance_labels=True))
    model = load(tmp_path / "model")
    named = {thing["instance"] for _, row in read_jsonl(folders[0] / "scenes.jsonl") for thing in row["objects"]}
    assert set(model.config.instances) == named
    assert model.config.category_dim == model.config.instance_dim == 8
    assert all(
        model.config.categories[category] == name.rsplit("-", 1)[0]
        for name, category in zip(model.config.instances, model.config.instance_category)
    )
    assert any("terms/instance_inclusive" in row for row in rows(tmp_path) if row["stage"] == "scenes")
    image = np.full((64, 64, 3), 90, dtype=np.uint8)
    posterior = model.observe(image, threshold=1e-6).instance_log_posterior
    assert posterior is not None
    assert posterior.shape[1] == len(named) + 1


def renamed(folder: Path, out: Path, names: tuple[str, ...]) -> Path:
    """A folder whose objects have other categories, by the number of their own."""
    (out / "images").mkdir(parents=True)
    records = []
    for _, row in read_jsonl(folder / "scenes.jsonl"):
        (out / row["image"]).write_bytes((folder / row["image"]).read_bytes())
        for thing in row["objects"]:
            thing["category"] = names[CATEGORIES.index(thing["category"]) % len(names)]
            del thing["symmetry"]
        records.append(row)
    write_jsonl(out / "scenes.jsonl", records)
    (out / "voxels.npz").write_bytes((folder / "voxels.npz").read_bytes())
    return out


def test_own_categories_train_by_the_command_line(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = tuple(renamed(folder, tmp_path / name, ("box", "mug")) for folder, name in zip(folders, ("train", "held_out")))
    config = config_of(pair, tmp_path / "run", categories=("box", "mug"), symmetry=(2, 1))
    command = ["train", *arguments_of(config)]
    assert "--categories box mug --symmetry 2 1" in " ".join(command)
    main(command)
    model = load(tmp_path / "run" / "model")
    assert (model.config.categories, model.config.symmetry) == (("box", "mug"), (2, 1))
    assert {"category", "bound"} <= set(json.loads(capsys.readouterr().out)["held_out"])
    found = model.observe(np.full((64, 64, 3), 90, dtype=np.uint8), threshold=1e-6)
    assert found.class_posterior.shape[1] == 2

    start = str(tmp_path / "run" / "model")
    assert config_of(pair, tmp_path / "more", initial=start, categories=("box", "mug")).model() == model.config
    for other in ({"categories": ("mug", "box")}, {"categories": ("box", "mug"), "symmetry": (1, 1)}):
        with pytest.raises(InputError, match="initial weights of other categories: got box mug of symmetry 2 1"):
            config_of(pair, tmp_path / "other", initial=start, **other).model()
    with pytest.raises(InputError, match=r"scenes\.jsonl:\d+: objects\[0\]\.category: got '(box|mug)', expected one of"):
        run(config_of(pair, tmp_path / "preset"))


def test_symmetry_of_own_categories_is_that_of_their_names_or_none(folders: tuple[Path, Path], tmp_path: Path) -> None:
    def model(**changes: Any) -> ModelConfig:
        return config_of(folders, tmp_path, **changes).model()

    assert model(categories=("bottle", "mug", "car")).symmetry == (0, 1, 1)
    assert model(categories=("bottle", "mug"), symmetry=(1, 4)).symmetry == (1, 4)
    assert model() == nano()
    with pytest.raises(InputError, match="category names must be unique"):
        model(categories=("mug", "mug"))


def test_a_checkpoint_older_than_own_categories_goes_on(folders: tuple[Path, Path], tmp_path: Path) -> None:
    identity = config_of(folders, tmp_path).identity()
    assert "categories" not in identity and "symmetry" not in identity and "mirror" in identity
    own = config_of(folders, tmp_path, categories=("box", "mug"), symmetry=(2, 1)).identity()
    assert (own["categories"], own["symmetry"]) == (["box", "mug"], [2, 1])


def test_image_sizes_vary_by_step(folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen, original = set(), StageRun.step

    def step(self: StageRun, batch: Any) -> Any:
        if hasattr(batch, "image"):
            seen.add(tuple(batch.image.shape[2:]))
        return original(self, batch)

    monkeypatch.setattr(StageRun, "step", step)
    run(config_of(folders, tmp_path, sizes=(32, 64, 96), shape_steps=1, scene_steps=12, single_steps=0))
    assert seen == {(32, 32), (64, 64), (96, 96)}


@pytest.mark.parametrize("broken", ["position", "box", "intrinsics", "rotation"])
def test_nan_in_data_is_refused(folders: tuple[Path, Path], tmp_path: Path, broken: str) -> None:
    folder = tmp_path / "broken"
    (folder / "images").mkdir(parents=True)
    lines = []
    for number, row in read_jsonl(folders[0] / "scenes.jsonl"):
        (folder / row["image"]).write_bytes((folders[0] / row["image"]).read_bytes())
        if number == 3:
            target = row if broken == "intrinsics" else row["objects"][0]
            target[broken] = [float("nan"), *target[broken][1:]]
        lines.append(json.dumps(row))
    (folder / "scenes.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"scenes\.jsonl:3:"):
        run(config_of((folder, folders[1]), tmp_path / "run"))


def test_a_loss_that_is_not_finite_stops_the_run_and_names_the_term(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from nolbo_ppl.training.scene_loader import SceneLoader

    original = SceneLoader.batch

    def batch(self: SceneLoader, step: int) -> Any:
        found = original(self, step)
        return found if step < 2 or found.noise is None else found.replace(noise=found.noise * torch.nan)

    monkeypatch.setattr(SceneLoader, "batch", batch)
    with pytest.raises(NolboError, match=r"loss of step 2 is nan: terms that are not finite: \{'voxels': nan\}"):
        run(config_of(folders, tmp_path, objective="elbo", orientation="angle"))


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"batch": 0}, "batch: got 0, expected at least 1"),
        ({"freeze": 1.5}, "freeze: got 1.5"),
        ({"sizes": (100,)}, "sizes: got \\(100,\\), expected positive multiples of 32"),
        ({"scenes": None, "validation": None, "instance_labels": True}, "give one folder of --scenes"),
        ({"scenes": None}, "held-out scenes without training scenes"),
        ({"symmetry": (2, 1)}, "symmetry: got 2 for 0 categories, expected one for each of --categories"),
        ({"categories": ("box", "mug"), "symmetry": (2,)}, "symmetry: got 1 for 2 categories"),
        ({"categories": ("box",), "symmetry": (-1,)}, r"symmetry: got \(-1,\), expected 1 \(none\)"),
        ({"scenes": None, "validation": None, "categories": ("car", "bus")}, "own categories: got generated.*give --scenes"),
    ],
)
def test_ill_formed_options(folders: tuple[Path, Path], tmp_path: Path, changes: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        config_of(folders, tmp_path, **changes)


DOUBLE_PRECISION = """
import sys, torch
import nolbo_ppl.training.scene_loader as supply
from nolbo_ppl.cli.train import main
torch.set_default_dtype(torch.float64)
to_batch = supply.to_batch
supply.to_batch = lambda arrays: to_batch(arrays).to(torch.float64)
main(sys.argv[1:])
"""


@pytest.mark.slow
def test_two_processes_learn_what_one_does_with_the_joint_batch(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """In double precision, and without the augmentation's float32: Adam turns rounding of small gradients into steps.

    With AdamW, for Muon's iteration is in bfloat16 whatever the weights are.
    """
    script = tmp_path / "train.py"
    script.write_text(DOUBLE_PRECISION, encoding="utf-8")
    shared: dict[str, Any] = {"weights": {"voxels": 1e-3}, "decode": 100, "freeze": 0.5, "augment": False, "optimizer": "adamw"}
    one, two = (config_of(folders, tmp_path / name, **shared) for name in ("one", "two"))
    several = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    for start, config in (([], one), (several, two)):
        done = subprocess.run(
            [sys.executable, *start, str(script), *arguments_of(config)],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-3000:]
    assert_same(weights(two.out), weights(one.out), 1e-5)
