"""The card of a trained model: the command of its run, its figures, nothing that the run does not know."""

from __future__ import annotations

import shlex
from pathlib import Path

import tyro

from nolbo_ppl.models.model_config import nano
from nolbo_ppl.training.model_card import command_of, model_card, write_card
from nolbo_ppl.training.train_config import TrainConfig

DEFAULTS = TrainConfig().to_json()


def test_the_command_makes_the_same_run() -> None:
    config = TrainConfig(
        Path("runs/my own"),
        preset="nano",
        scenes=(Path("a"), Path("b")),
        mix=(0.4, 0.6),
        weights={"voxels": 0.002},
        bf16=False,
        seed=3,
    )
    words = shlex.split(command_of(config.to_json(), DEFAULTS))
    assert words[:2] == ["nolbo", "train"] and "--no-bf16" in words
    assert not [word for word in words if word.startswith("--learning")]  # what is as by default is not said
    assert tyro.cli(TrainConfig, args=words[2:]) == config


def test_a_card_says_what_was_measured(tmp_path: Path) -> None:
    config = nano()
    meta = {
        "training": {**DEFAULTS, "out": "runs/mine", "seed": 5},
        "held_out": {"box50": 0.75, "bound/box": -3.0},
        "calibrated": True,
        "versions": {"torch": "2.9"},
    }
    write_card(tmp_path, config, meta, 3_500_000, DEFAULTS)
    text = (tmp_path / "README.md").read_text()
    assert text.startswith("# mine\n") and "3.5 M parameters" in text
    assert "| box50 | 0.75 |" in text and "bound/box" not in text and "torch 2.9" in text
    assert "--seed 5" in text and "are calibrated" in text and all(name in text for name in config.categories)
    nothing = model_card(config, {**meta, "held_out": {}, "calibrated": False}, 3_500_000, DEFAULTS)
    assert "None were measured." in nothing and "Scales are not calibrated." in nothing
