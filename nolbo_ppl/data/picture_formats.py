"""Data sets of the paper's first stages for `nolbo data check`: ImageNet, Render for CNN, ModelNet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.data.format_registry import LIKELY, SURE, FormatReport, LabelledPicture, Look, register, spread
from nolbo_ppl.data.imagenet import open_imagenet
from nolbo_ppl.data.modelnet import modelnet_files
from nolbo_ppl.data.render_for_cnn import HELD_OUT, NAME, open_render_for_cnn
from nolbo_ppl.errors import InputError
from nolbo_ppl.io.images import open_image
from nolbo_ppl.synthetic.assets.off_file import read_off

MOST_PROBLEMS = 12
"""Problems that are named."""


def _pictures(files: Sequence[Path], labels: Sequence[str]) -> Iterator[LabelledPicture]:
    for k in spread(len(files)):
        image = open_image(files[k])
        box = np.array([[0.0, 0.0, image.shape[1], image.shape[0]]])
        yield LabelledPicture(files[k].name, image, box, (labels[k],))


def _first_folder(look: Look) -> Look | None:
    names = sorted(name for name in look.names if (look.path / name).is_dir())
    return Look(look.path / names[0]) if names else None


def _imagenet(look: Look) -> float:
    if look.names >= {"ILSVRC"}:
        return SURE
    inside = _first_folder(Look(look.path / "train")) if "train" in look.names and (look.path / "train").is_dir() else None
    return (
        LIKELY if inside is not None and any(name.upper().endswith((".JPEG", ".JPG", ".PNG")) for name in inside.names) else 0.0
    )


@register("imagenet", "ImageNet: pictures by class", _imagenet)
def report_imagenet(path: Path) -> FormatReport:
    """Pictures and classes of both splits."""
    train = open_imagenet(path, "train")
    facts: dict[str, Any] = {"classes": len(train.classes), "train": len(train)}
    problems = []
    try:
        facts["val"] = len(open_imagenet(path, "val", train.classes))
    except InputError as error:
        problems.append(str(error))
    count = np.bincount(train.label, minlength=len(train.classes))
    facts["pictures_of_a_class"] = [int(count.min()), int(count.max())]
    labels = [train.classes[i] for i in train.label]
    return FormatReport(
        "imagenet", "ImageNet: pictures by class", facts, tuple(problems), pictures=lambda: _pictures(train.files, labels)
    )


def _rendered(look: Look) -> float:
    for _ in range(3):
        if any(NAME.fullmatch(Path(name).stem) for name in sorted(look.names)[:20]):
            return SURE
        inside = _first_folder(look)
        if inside is None:
            return 0.0
        look = inside
    return 0.0


@register("render-for-cnn", "Render for CNN: pictures with viewpoints in their names", _rendered)
def report_render_for_cnn(path: Path) -> FormatReport:
    """Pictures by category, and ranges of their angles, degrees."""
    train = open_render_for_cnn(path)
    facts: dict[str, Any] = {"pictures": len(train), "held_out_every": f"{HELD_OUT} shapes"}
    facts["categories"] = dict(Counter(train.categories[i] for i in train.category).most_common())
    for name, value in zip(("azimuth", "elevation", "in_plane"), np.degrees(train.viewpoint).T):
        facts[name] = [round(float(value.min()), 1), round(float(value.max()), 1)]
    labels = [train.categories[i] for i in train.category]
    return FormatReport(
        "render-for-cnn",
        "Render for CNN: pictures with viewpoints in their names",
        facts,
        pictures=lambda: _pictures(train.files, labels),
    )


def _modelnet(look: Look) -> float:
    inside = _first_folder(look)
    if inside is None or not inside.names & {"train", "test"}:
        return 0.0
    split = inside.path / ("train" if "train" in inside.names else "test")
    return SURE if any(name.endswith(".off") for name in Look(split).names) else 0.0


@register("modelnet", "ModelNet: CAD models by class and split", _modelnet)
def report_modelnet(path: Path) -> FormatReport:
    """Models by class of both splits; every one is read."""
    facts: dict[str, Any] = {}
    problems = []
    for split in ("train", "test"):
        try:
            files = modelnet_files(path, split)  # type: ignore[arg-type]
        except InputError as error:
            problems.append(str(error))
            continue
        facts[split] = len(files)
        facts[f"{split}_classes"] = dict(Counter(name.split("/")[0] for name in files))
        for file in files.values():
            try:
                read_off(file)
            except InputError as error:
                problems.append(str(error))
    more = [f"{len(problems) - MOST_PROBLEMS} more models cannot be read"] if len(problems) > MOST_PROBLEMS else []
    return FormatReport("modelnet", "ModelNet: CAD models by class and split", facts, (*problems[:MOST_PROBLEMS], *more))
