"""The package as a whole: what it exports, how light it is, that imports run downwards, what its files hold."""

from __future__ import annotations

import ast
import functools
import graphlib
import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
import warnings
from operator import attrgetter
from pathlib import Path

import jaxtyping
import numpy as np
import pytest

import nolbo_ppl
from nolbo_ppl._moved import MOVED, RENAMED
from nolbo_ppl.citations import REFERENCES
from nolbo_ppl.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "nolbo_ppl"

LAYERS = (
    ("errors", "_version", "_moved", "categories", "citations", "parallel", "progress", "devices", "renamed_options"),
    ("geometry",),
    ("structures",),
    ("io",),
    ("metrics",),
    ("models",),
    ("inference",),
    ("odometry",),
    ("synthetic",),
    ("data",),
    ("training",),
    ("evaluation",),
    ("viz",),
    ("report",),
    ("pipeline",),
    ("reproduction",),
    ("cli",),
    ("train", "slam", "__main__"),
)
"""From the bottom up: a module imports from its own room and those before it, wherever the import stands in it."""


def layer_of(module: str) -> int:
    """Layer of the longest name that the module belongs to."""
    inside = module.removeprefix("nolbo_ppl.") + "."
    names = {name: i for i, layer in enumerate(LAYERS) for name in layer if inside.startswith(name + ".")}
    return names[max(names, key=len)]


@functools.cache
def tree_of(path: Path) -> ast.Module:
    """A file, parsed once for all tests: several look at every module."""
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def imported(path: Path) -> set[str]:
    """Modules of the package that a file imports: at its top, within functions, for types alone."""
    found: set[str] = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.ImportFrom) and node.module == "nolbo_ppl":
            found.update(f"nolbo_ppl.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("nolbo_ppl."):
            found.add(node.module)
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names if alias.name.startswith("nolbo_ppl."))
    return found


def modules() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_downwards(path: Path) -> None:
    name = "nolbo_ppl." + ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    for module in imported(path):
        assert layer_of(module) <= layer_of(name), f"{name} imports {module}"


def test_the_drawn_tree_is_the_tree() -> None:
    """Rooms in the order of the layers, and modules at the top."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").split("```")[1]
    rooms = [name for layer in reversed(LAYERS) for name in layer if (PACKAGE / name).is_dir()]
    assert re.findall(r"^  (\w+)/", text, re.MULTILINE) == [*rooms, "weights"]
    modules = {path.name for path in PACKAGE.glob("*.py")} - {"__init__.py", "__main__.py"}
    assert set(re.findall(r"\w+\.py", text)) == modules
    inner = {path.parent.name for path in (PACKAGE / "inference").glob("*/**/__init__.py")}
    assert inner == set(re.findall(r"(\w+)/", text.partition("  inference/")[2].partition("\n  models/")[0]))


def test_the_check_of_imports_sees_an_import() -> None:
    assert "nolbo_ppl.models.observation_model" in imported(PACKAGE / "training" / "trainer.py")
    assert layer_of("nolbo_ppl.cli.train") > layer_of("nolbo_ppl.models.observation_model")


def module_of(path: Path) -> str:
    """Dotted name of a file of the package."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(("nolbo_ppl", *(part for part in parts if part != "__init__")))


def test_no_modules_import_each_other_in_a_circle() -> None:
    known = {module_of(path) for path in modules()}
    packages = {module_of(path) for path in modules() if path.name == "__init__.py"}
    graph = {module_of(path): (imported(path) & known) - packages for path in modules()}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


def test_file_names_stand_once() -> None:
    counts: dict[str, list[str]] = {}
    for path in modules():
        if not path.stem.startswith("__") and path.parent.name != "cli":  # a verb may be named like a room's module
            counts.setdefault(path.stem, []).append(str(path.relative_to(PACKAGE)))
    assert not {name: places for name, places in counts.items() if len(places) > 1}


def test_class_names_stand_once() -> None:
    places: dict[str, list[str]] = {}
    for path in modules():
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(str(path.relative_to(PACKAGE)))
    assert not {name: where for name, where in places.items() if len(where) > 1}


def test_no_room_holds_more_than_a_quarter_of_the_code() -> None:
    lines: dict[str, int] = {}
    for path in modules():
        room = path.relative_to(PACKAGE).parts[0]
        lines[room] = lines.get(room, 0) + len(path.read_text(encoding="utf-8").splitlines())
    assert max(lines.values()) <= 0.25 * sum(lines.values()), lines


@pytest.mark.parametrize("old", sorted(MOVED))
def test_import_paths_of_the_first_version_name_the_new_module(old: str) -> None:
    new = importlib.import_module(f"nolbo_ppl.{MOVED[old]}")
    specification = new.__spec__
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the package above it may have moved, too
        importlib.import_module(f"nolbo_ppl.{old}".rpartition(".")[0])
    with pytest.warns(FutureWarning, match=re.escape(f"nolbo_ppl.{old} moved to nolbo_ppl.{MOVED[old]}")):
        sys.modules.pop(f"nolbo_ppl.{old}", None)
        assert importlib.import_module(f"nolbo_ppl.{old}") is new
    assert new.__spec__ is specification


def test_names_of_a_module_that_became_a_room_are_found() -> None:
    with pytest.warns(FutureWarning, match=r"nolbo_ppl.io.write_json moved to nolbo_ppl.io.files"):
        from nolbo_ppl.io import write_json
    assert write_json.__module__ == "nolbo_ppl.io.files"
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = importlib.import_module("nolbo_ppl.io").nothing


@pytest.mark.parametrize(("module", "old", "new"), [(m, *names) for m in sorted(RENAMED) for names in RENAMED[m].items()])
def test_names_of_the_first_version_warn_and_work(module: str, old: str, new: str) -> None:
    home = importlib.import_module(f"nolbo_ppl.{module}".rstrip("."))
    with pytest.warns(FutureWarning, match=f"{old} is now {new}; the old name goes with 0.3.0"):
        assert getattr(home, old) == attrgetter(new)(home)
    assert not hasattr(home, "Nothing") and old not in vars(home)


def test_the_short_name_of_object_slam_holds_its_public_names() -> None:
    """`nolbo_ppl.slam` was the command in 0.1.0: what it had still works, with a warning."""
    program = "import nolbo_ppl.slam as s; print(s.solve.__module__, sorted(set(dir(s)) & {'SlamConfig', 'solve'}))"
    done = subprocess.run(
        [sys.executable, "-W", "error::FutureWarning", "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "nolbo_ppl.inference.slam.solve ['SlamConfig', 'solve']"
    short = importlib.import_module("nolbo_ppl.slam")
    with pytest.warns(FutureWarning, match=r"nolbo_ppl.slam.run moved to nolbo_ppl.cli.slam"):
        assert short.run is importlib.import_module("nolbo_ppl.cli.slam").run
    with pytest.raises(AttributeError, match="nothing"):
        _ = short.nothing


def test_importing_the_package_is_light() -> None:
    heavy = {"torch", "pyro", "matplotlib", "gtsam", "numpy"}
    program = f"import sys, nolbo_ppl, nolbo_ppl.cli; print(sorted(set(sys.modules) & {heavy}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_queries_do_not_import_what_only_slam_and_pictures_need() -> None:
    heavy = {"matplotlib", "gtsam", "trimesh", "tensorboard", "numba"}
    program = f"import sys, nolbo_ppl; nolbo_ppl.load; print(sorted(set(sys.modules) & {heavy}))"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.strip() == "[]"


def test_version_is_that_of_the_metadata() -> None:
    assert nolbo_ppl.__version__ == importlib.metadata.version("nolbo_ppl")
    for file in ("CITATION.cff", "CHANGELOG.md"):
        assert nolbo_ppl.__version__ in (ROOT / file).read_text(encoding="utf-8")


def test_everything_exported_is_there() -> None:
    for name in nolbo_ppl.__all__:
        assert getattr(nolbo_ppl, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = nolbo_ppl.nothing


def test_citation_tells_the_works_that_are_asked_for() -> None:
    assert nolbo_ppl.citation("pyro").startswith("@article{bingham2019pyro")
    assert nolbo_ppl.citation().count("\n@") == len(REFERENCES) - 1
    with pytest.raises(InputError, match=r"unknown reference: got \['bayes'\]"):
        nolbo_ppl.citation("bayes")


def test_links_at_the_root_are_relative() -> None:
    for name in ("models", "inference"):
        assert os.readlink(ROOT / name) == f"nolbo_ppl/{name}"


TEXT = {".py", ".md", ".toml", ".yml", ".yaml", ".json", ".jsonl", ".cff", ".txt", ""}


def tracked() -> list[Path]:
    """Files of the repository; skips where there is no git."""
    done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip("not a git checkout")
    return [ROOT / line for line in done.stdout.splitlines() if (ROOT / line).is_file()]


def test_no_file_names_a_machine() -> None:
    pattern = re.compile(rb"/(?:root|home/[a-z]+|work/[a-z]+|Users/[A-Za-z]+)/")
    for path in tracked():
        if path != Path(__file__).resolve() and path.suffix in TEXT:
            assert not pattern.search(path.read_bytes()), path


def test_weights_are_small_and_have_a_card() -> None:
    folders = [path.parent for path in (PACKAGE / "weights").glob("*/config.json")]
    for folder in folders:
        assert (folder / "model.safetensors").stat().st_size <= 15e6
        assert "nolbo train" in (folder / "README.md").read_text(encoding="utf-8")
        assert not list(folder.glob("*.pt")) + list(folder.glob("*.pkl"))


def test_the_licence_is_apache() -> None:
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert text.split()[:5] == ["Apache", "License", "Version", "2.0,", "January"]
    assert "END OF TERMS AND CONDITIONS" in text


def test_annotations_are_enforced_in_the_tests() -> None:
    """Shapes, their agreement among arguments, and types: by the hook of `conftest.py`, in every room it names."""
    from nolbo_ppl.geometry.pose import make_pose
    from tests.conftest import SHAPES_CHECKED

    assert make_pose(np.eye(3)[None], np.zeros((1, 3))).shape == (1, 4, 4)
    caught = 0
    for arguments in ((np.eye(4)[None], np.zeros((1, 3))), (np.eye(3)[None], np.zeros((1, 2))), ([1.0], np.zeros((1, 3)))):
        try:  # not `pytest.raises`, which marks tests that are left alone
            make_pose(*arguments)  # type: ignore[arg-type]
        except jaxtyping.TypeCheckError:
            caught += 1
    assert caught == 3
    for room in SHAPES_CHECKED:
        assert any(f"{path.relative_to(ROOT).with_suffix('')}".replace("/", ".").startswith(room) for path in modules()), room
