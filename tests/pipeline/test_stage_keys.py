"""Every option says which stage it changes; a change redoes that stage and those after it, and none before."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from nolbo_ppl.inference.slam import SlamConfig
from nolbo_ppl.odometry import OdometryConfig
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.pipeline.stage_keys import STAGES, affects, stage_settings
from nolbo_ppl.pipeline.stage_store import PipelineStage, fingerprints

OPTIONS = {field.name: field for field in dataclasses.fields(RunConfig)}


def prints(config: RunConfig, images: Any = 1) -> dict[str, str]:
    """Fingerprint of each stage."""
    settings = stage_settings(config, lambda: images)
    return fingerprints([PipelineStage(name, (), settings[name], lambda: None) for name in STAGES])


@pytest.fixture
def config(tmp_path: Path) -> RunConfig:
    for name in ("intrinsics", "odometry", "truth", "step_lengths"):
        (tmp_path / name).write_text(name)
    for name in ("depth", "right", "drive", "model"):
        (tmp_path / name).mkdir()
        for file in ("objects.json", "scenes.jsonl", "config.json", "model.safetensors"):
            (tmp_path / name / file).write_text("0")
    return RunConfig(tmp_path / "images", tmp_path / "out", intrinsics=tmp_path / "intrinsics")


def changed(name: str, folder: Path) -> dict[str, Any]:
    """Options with another value of one of them."""
    special: dict[str, dict[str, Any]] = {
        "baseline": {"baseline": 0.3, "right": folder / "right"},
        "camera_height": {"camera_height": 1.5},
        "test_sizes": {"test_sizes": (576, 864)},
        "slam": {"slam": dataclasses.replace(SlamConfig(), seed=7)},
        "visual": {"visual": dataclasses.replace(OdometryConfig(), seed=7)},
        "images": {},
        "truth_objects": {"truth_objects": folder / "drive"},
        "right": {"right": folder / "right", "baseline": 0.3},
    }
    files = {key: {key: folder / key} for key in ("odometry", "truth", "step_lengths", "depth", "model", "out")}
    files["model"] = {"model": str(folder / "model")}
    files["intrinsics"] = {"intrinsics": folder / "truth"}
    default = OPTIONS[name].default
    if name in special or name in files:
        return {**files, **special}[name]
    return {name: not default if isinstance(default, bool) else default / 2 if isinstance(default, float) and default else 3}


@pytest.mark.parametrize("name", OPTIONS)
def test_an_option_changes_its_stage_and_those_after_it(name: str, config: RunConfig, tmp_path: Path) -> None:
    assert "stage" in OPTIONS[name].metadata, f"say which stage --{name} changes: field(metadata=affects(...)), None for none"
    stage = OPTIONS[name].metadata["stage"]
    before = prints(config)
    after = prints(dataclasses.replace(config, **changed(name, tmp_path)), images=2 if name == "images" else 1)
    redone = [key for key in STAGES if before[key] != after[key]]
    assert redone == ([] if stage is None else list(STAGES[STAGES.index(stage) :]))


@pytest.mark.parametrize(
    ("option", "file", "stage"),
    [
        ("odometry", "odometry", "odometry"),
        ("depth", "depth/new.png", "odometry"),
        ("model", "model/model.safetensors", "observe"),
        ("truth_objects", "drive/objects.json", "figures"),
    ],
)
def test_what_lies_where_an_option_leads_counts(option: str, file: str, stage: str, config: RunConfig, tmp_path: Path) -> None:
    place = tmp_path / file.split("/")[0]
    config = dataclasses.replace(config, **{option: str(place) if option == "model" else place})
    before = prints(config)
    (tmp_path / file).write_text("something else")
    after = prints(config)
    assert next(key for key in STAGES if before[key] != after[key]) == stage


@pytest.mark.parametrize("option", ["odometry", "depth"])
def test_what_a_bag_that_is_a_folder_holds_counts(option: str, config: RunConfig, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("")
    config = dataclasses.replace(config, **{option: Path(f"{bag}:/topic")})
    (bag / "0.mcap").write_bytes(b"recorded")
    before = prints(config)
    (bag / "0.mcap").write_bytes(b"recorded anew")
    assert prints(config)["odometry"] != before["odometry"]


def test_an_option_without_a_stage_is_refused() -> None:
    @dataclasses.dataclass(frozen=True)
    class Forgetful:
        every: int = dataclasses.field(default=1, metadata=affects("odometry"))
        forgotten: int = 2

    with pytest.raises(KeyError, match="stage"):
        stage_settings(Forgetful(), lambda: None)
