"""What the documents say works: command lines parse, Python blocks run, the site builds without a warning."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro

from nolbo_ppl.cli import VERBS, main

ROOT = Path(__file__).resolve().parents[1]
TOP = [ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "SECURITY.md", "benchmarks/README.md")]
PAGES = [*TOP, *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(nolbo [a-z]+[^`\n]*?)`")
PROSE = {"VERB"}
"""In place of a verb: the command stands for all of them."""


def blocks(page: Path, *languages: str) -> Iterator[str]:
    """Fenced blocks of a page in these languages ("" for none)."""
    for language, text in FENCE.findall(page.read_text(encoding="utf-8")):
        if language in languages:
            yield text


def commands(page: Path) -> list[str]:
    """Command lines of `nolbo` on a page: whole ones in blocks, and those in the text that have options."""
    found = []
    for text in blocks(page, "", "bash", "sh", "console"):
        for line in text.replace("\\\n", " ").splitlines():
            line = re.sub(r"\s#.*$", "", line).strip().removeprefix("$ ")
            line = re.sub(r"^(\w+=\S+ )*(\.venv/bin/)?", "", line)
            if line.startswith("nolbo "):
                found.append(line)
            elif "-m nolbo_ppl." in line and "..." not in line:  # torchrun ... -m nolbo_ppl.train OPTIONS
                found.append("nolbo " + line.split("-m nolbo_ppl.", 1)[1])
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    found += [line for line in INLINE.findall(text) if " --" in line and "..." not in line and "[" not in line]
    return [line for line in found if line.split()[1] not in PROSE and "--help" not in line]


class Parsed(Exception):
    """The command line was understood."""


@pytest.fixture
def parse_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Verbs stop once their arguments are parsed."""
    real = tyro.cli

    def cli(*args: Any, **kwargs: Any) -> Any:
        real(*args, **kwargs)
        raise Parsed

    monkeypatch.setattr(tyro, "cli", cli)


@pytest.mark.usefixtures("parse_only")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_line_is_understood(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for line in commands(page):
        verb, *arguments = shlex.split(line)[1:]
        assert verb in VERBS, f"{line!r}: no such verb"
        module = import_module(f"nolbo_ppl.cli.{verb}")
        if any(word.isupper() or word == "..." for word in arguments if not word.startswith("-")):
            arguments = ["1" if word.isupper() else word for word in arguments]  # --seed N, --out DIR
        try:
            module.main(arguments)
        except Parsed:
            continue
        except SystemExit:
            # In prose only some options are named: what is missing may be missing, what is there must be known.
            error = capsys.readouterr().err
            inside = line not in "".join(blocks(page, "", "bash", "sh", "console"))
            assert inside and "Required" in error and "Unrecognized" not in error, f"{line!r}:\n{error}"


def test_the_parser_would_refuse_a_wrong_option(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        import_module("nolbo_ppl.cli.observe").main(["--images", "a", "--out", "b", "--no-such-option", "1"])
    assert "no-such-option" in capsys.readouterr().err


LONG = ("run(kitchen)",)
"""Blocks that take minutes: tests of their own run them on less."""
SCENES = """
from nolbo_ppl.synthetic.dataset_writer import write_scenes
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
write_scenes("scenes", SceneGenerator(preset("easy"), seed=5), 2)
"""
SEEN = """
import nolbo_ppl
from pathlib import Path
from PIL import Image
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
source, shipped = SceneGenerator(preset("easy"), seed=5), nolbo_ppl.load("tiny")
image = next(image for image in (source.render(i).image for i in range(50)) if len(shipped.observe(image, decode=False)))
Path("scenes/images").mkdir(parents=True)
Image.fromarray(image).save("scenes/images/000000.png")
import numpy as np
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory
Path("drive/images").mkdir(parents=True)
for frame in range(12):  # the camera stands still
    Image.fromarray(image).save(f"drive/images/{frame:06d}.png")
write_trajectory("drive/odometry.txt", Trajectory(make_pose(np.tile(np.eye(3), (12, 1, 1)), np.zeros((12, 3)))))
"""
DRIVE = """
import numpy as np
from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
rng = np.random.default_rng(0)
drive = simulate_sequence(simulate_circuit(rng, laps=2, frames_per_lap=40), rng, world=WorldConfig(objects=25))
odometry, seen = drive.odometry, drive.observations
frame, position, R_camera_object, latent, names = seen.frame, seen.position, seen.rotation, seen.latent, seen.category
"""
FOUND = {"README.md": "assert len(result.landmarks) >= 1 and len(detections) >= 12"}
"""What the blocks of a page have made when they have run."""
GIVEN = {"README.md": SEEN, "docs/bound.md": SCENES, "docs/slam.md": DRIVE}
"""What a page takes for granted: a folder of scenes, an image with an object the shipped weights see, or a user's own arrays."""
ELSEWHERE = "without-torch.md"
"""A page whose block needs exported networks: `tests/inference/posterior/test_onnx_export.py` runs it, with torch blocked."""
WITH_PYTHON = [page for page in PAGES if any(blocks(page, "python")) and page.name != ELSEWHERE]


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_PYTHON, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_blocks_run_in_order(page: Path, tmp_path: Path) -> None:
    code = [GIVEN.get(page.relative_to(ROOT).as_posix(), "")]
    for text in blocks(page, "python"):
        compile(text, str(page), "exec")
        if not any(mark in text for mark in LONG):
            code.append(text)
    code.append(FOUND.get(page.relative_to(ROOT).as_posix(), ""))
    (tmp_path / "block.py").write_text("\n".join(code), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-W", "error::SyntaxWarning", "block.py"], cwd=tmp_path, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr[-3000:]


def test_every_benchmark_is_listed() -> None:
    scripts = [path for path in (ROOT / "benchmarks").glob("*.py") if "__main__" in path.read_text(encoding="utf-8")]
    text = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    assert scripts and not [path.name for path in scripts if path.name not in text]


def test_json_blocks_are_json() -> None:
    for page in PAGES:
        for text in blocks(page, "json"):
            json.loads(text)


def test_links_between_documents_lead_somewhere() -> None:
    for page in PAGES:
        text = FENCE.sub("", page.read_text(encoding="utf-8"))
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            made = target.startswith("reference/")  # pages that the build makes
            if "://" not in target and not target.startswith("#") and not made:
                assert (page.parent / target.split("#")[0]).exists(), f"{page.name}: {target}"


def test_modules_that_the_documents_name_are_there() -> None:
    named = set()
    for page in PAGES:
        text = FENCE.sub("", page.read_text(encoding="utf-8"))
        named |= {(page.name, name) for name in re.findall(r"`(nolbo_ppl(?:\.\w+)+)", text)}
    assert named
    for page_name, name in sorted(named):
        parts, found = name.split("."), ROOT
        while parts and (found / parts[0]).is_dir():
            found /= parts.pop(0)
        module = found / f"{parts[0]}.py" if parts else found / "__init__.py"
        source = module if module.is_file() else found / "__init__.py"  # else a name that the package itself holds
        left = parts[1:] if module.is_file() else parts
        assert all(part in source.read_text(encoding="utf-8") for part in left[:1]), f"{page_name}: {name}"


@pytest.mark.slow
def test_own_categories_train_as_the_how_to_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Command lines and configuration of docs/howto/own-categories.md, with the folder of docs/howto/own-data.md."""
    own_data, own_categories = ROOT / "docs/howto/own-data.md", ROOT / "docs/howto/own-categories.md"
    folder = next(text for text in blocks(own_data, "python") if "scenes.jsonl" in text)
    folder = folder.replace('"my_folder"', '"kitchen"').replace('"car"', '"mug"').replace("range(4)", "range(12)")

    monkeypatch.chdir(tmp_path)
    torch.set_default_dtype(torch.float32)  # as users have it; in this process, since to import torch takes seconds
    exec(compile(folder, "folder.py", "exec"), {"__name__": "__main__"})
    (tmp_path / "kitchen_held_out").symlink_to("kitchen")
    short = {"preset": "nano", "shape_steps": 2, "single_steps": 0, "scene_steps": 2, "batch": 4, "workers": 1}
    options = {
        "train": [text for name, value in short.items() for text in (f"--{name.replace('_', '-')}", str(value))],
        "evaluate": ["--resamples", "20", "--no-pictures"],
        "observe": [],
    }
    for line in (line for line in commands(own_categories) if line.split()[1] in options):
        verb, *arguments = shlex.split(line)[1:]
        main([verb, *arguments, *options.pop(verb)])
    assert not options, "a verb is missing on the page"
    config = json.loads((tmp_path / "runs/kitchen/model/config.json").read_text())["model"]
    assert (config["categories"], config["symmetry"]) == (["box", "mug"], [2, 1])
    figures = json.loads((tmp_path / "figures/metrics.json").read_text())
    assert figures["categories"] == ["box", "mug"] and figures["by_category"]["mug"]["objects"] == 12

    python = next(text for text in blocks(own_categories, "python") if "run(kitchen)" in text)
    python = python.replace("symmetry=(2, 1),", "symmetry=(2, 1), **" + repr(short) + ",")
    before = (tmp_path / "runs/kitchen/checkpoint.safetensors").read_bytes()
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(python, "train.py", "exec"), names)  # the same run, which is finished
    assert names["kitchen"].identity()["categories"] == ["box", "mug"]
    assert (tmp_path / "runs/kitchen/checkpoint.safetensors").read_bytes() == before


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="mkdocs is not installed: pip install -e '.[docs]'")
    import os

    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        # Notebooks are run by a test of their own; what is pretty (colours of sources, breaks in signatures) cannot be wrong.
        env={**os.environ, "NOLBO_DOCS_EXECUTE": "0", "NOLBO_DOCS_PRETTY": "false", "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    reference = (tmp_path / "site/reference/inference_slam/index.html").read_text(encoding="utf-8")
    assert "SlamConfig" in reference and "Standard deviation of each angle of one odometry step" in reference
    assert "<math" in (tmp_path / "site/em/index.html").read_text(encoding="utf-8")
    commands_page = (tmp_path / "site/reference/commands/index.html").read_text(encoding="utf-8")
    assert all(f"nolbo {verb}" in commands_page for verb in VERBS)
