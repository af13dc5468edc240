"""What each stage of a run depends on, from the declarations of the options themselves.

Every field of `RunConfig` says in its metadata which stage it changes first; stages after that one depend on it through those
before them. A hand-kept list of names would leave stale results the day someone adds an option and forgets the list.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.ros_bags import is_bag, split_topic
from nolbo_ppl.renamed_options import stored_names

StageName = Literal["odometry", "observe", "slam", "map", "crops", "figures", "report"]
STAGES: tuple[StageName, ...] = ("odometry", "observe", "slam", "map", "crops", "figures", "report")
"""Stages of a run, in order."""
Content = Literal["value", "file", "folder", "images", "model", "drive"]
"""What of an option counts: what it says, or what lies where it leads."""


def affects(stage: StageName | None, content: Content = "value") -> dict[str, Any]:
    """Metadata of an option: the first stage whose result it changes (None: it changes no result), and what of it counts.

    >>> affects("observe", "folder")
    {'stage': 'observe', 'content': 'folder'}
    """
    return {"stage": stage, "content": content}


def stage_settings(config: Any, images: Callable[[], Any]) -> dict[StageName, dict[str, Any]]:
    """What each stage depends on besides the stages before it, as JSON.

    Args:
        config: options, a dataclass whose fields say what they affect.
        images: fingerprint of the images.

    Raises:
        InputError: a file that is named does not exist.
        KeyError: an option that names no stage.
    """
    plain = json_of(config)
    digests: Mapping[Content, Callable[[Any], Any]] = {
        "file": file_digest,
        "folder": folder_digest,
        "images": lambda _: images(),
        "model": model_digest,
        "drive": ground_truth_digest,
    }
    settings: dict[StageName, dict[str, Any]] = {stage: {} for stage in STAGES}
    for option in dataclasses.fields(config):
        stage, content = option.metadata["stage"], option.metadata["content"]
        if stage is not None:
            value = plain[option.name] if content == "value" else digests[content](getattr(config, option.name))
            settings[stage][option.name] = value
    return {stage: stored_names(config, values) for stage, values in settings.items()}


def json_of(config: Any) -> dict[str, Any]:
    """The options as JSON values."""

    def plain(value: Any) -> Any:
        return str(value) if isinstance(value, Path) else dict(value)

    return json.loads(json.dumps(dataclasses.asdict(config), default=plain))


def file_digest(path: Path | None) -> Any:
    """Digest of a file's content, None without a file; of a bag, which may be larger than memory, names and sizes.

    Raises:
        InputError: there is no such file.
    """
    if path is None:
        return None
    if is_bag(path):
        return folder_digest(path)
    if not path.is_file():
        raise input_error("no such file", file=path)
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def folder_digest(path: Path | None) -> Any:
    """Names and sizes of a folder's files, or of one file, or of those of a bag whose topic is named; None without one."""
    if path is None:
        return None
    place = split_topic(path)[0]
    files = [place] if place.is_file() else sorted(place.iterdir()) if place.is_dir() else []
    return [str(path), [[file.name, file.stat().st_size] for file in files if file.is_file()]]


def model_digest(name: str) -> Any:
    """What tells one model from another: its files, in a folder of one's own or in the package."""
    shipped = Path(str(resources.files("nolbo_ppl"))) / "weights" / name
    folder = next((place for place in (Path(name), shipped) if (place / "config.json").is_file()), None)
    return [name, *(() if folder is None else (file_digest(folder / file) for file in ("config.json", "model.safetensors")))]


def ground_truth_digest(drive: Path | None) -> Any:
    """What tells the truth of one drive from another."""
    return None if drive is None else [str(drive), file_digest(drive / "objects.json"), file_digest(drive / "scenes.jsonl")]
