"""The card of a trained model: README.md beside its weights, made from the run alone."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.models.model_config import ModelConfig

CARD = "README.md"
REPEATED = ("scenes",)
"""Options that are given once for each of their values."""


def command_of(options: Mapping[str, Any], defaults: Mapping[str, Any]) -> str:
    """The command line of a run: options that are not the defaults, as JSON keeps both."""
    words = ["nolbo", "train"]
    for name, value in options.items():
        if value == defaults.get(name) or value is None:
            continue
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        elif isinstance(value, Mapping):
            words += [f"--{flag}", *(str(word) for pair in value.items() for word in pair)]
        elif name in REPEATED:
            words += [word for one in value for word in (f"--{flag}", str(one))]
        elif isinstance(value, list):
            words += [f"--{flag}", *map(str, value)]
        else:
            words += [f"--{flag}", str(value)]
    return shlex.join(words)


def model_card(config: ModelConfig, meta: Mapping[str, Any], parameters: int, defaults: Mapping[str, Any]) -> str:
    """The text of a card.

    Args:
        config: the networks.
        meta: what `config.json` tells beside them: `training`, `held_out`, `calibrated`, `versions`.
        parameters: number of weights.
        defaults: options of a run of which nothing was said.
    """
    training, held_out = meta.get("training", {}), meta.get("held_out", {})
    name = Path(str(training.get("out", "model"))).name
    categories = ", ".join(config.categories)
    lines = [
        f"# {name}",
        "",
        f"Observation model of `nolbo_ppl`: encoder {config.encoder}, {config.image_size} px, {len(config.categories)} "
        f"categories, {config.latent_dim} latent dimensions, {config.voxel_size}^3 voxels, {parameters / 1e6:.1f} M parameters.",
        "",
        f"Categories: {categories}.",
        "",
        "```python",
        "import nolbo_ppl",
        'model = nolbo_ppl.load("PATH_OF_THIS_FOLDER")',
        "```",
        "",
        "## Training",
        "",
        f"    {command_of(training, defaults)}",
        "",
        "All options stand in `config.json` under `training`.",
    ]
    versions = ", ".join(f"{package} {version}" for package, version in meta.get("versions", {}).items())
    if versions:
        lines += ["", f"Made with {versions}."]
    lines += ["", "## Figures", ""]
    plain = {key: value for key, value in held_out.items() if "/" not in key}
    if plain:
        lines += ["Held-out data of the run itself, by the averaged weights; measure on your own with `nolbo evaluate`.", ""]
        lines += ["| figure | value |", "|---|---|", *(f"| {key} | {value:.4g} |" for key, value in sorted(plain.items()))]
    else:
        lines.append("None were measured.")
    calibrated = (
        "Scales of the posterior are calibrated on held-out objects." if meta.get("calibrated") else "Scales are not calibrated."
    )
    return "\n".join([*lines, "", calibrated, "", "Licence: state that of your data here before you publish these weights.", ""])


def write_card(folder: Path, config: ModelConfig, meta: Mapping[str, Any], parameters: int, defaults: Mapping[str, Any]) -> None:
    """Write the card of a model's folder; one that somebody has edited is replaced with the weights it described."""
    with atomic_path(folder / CARD) as temporary:
        temporary.write_text(model_card(config, meta, parameters, defaults), encoding="utf-8")
