"""The public interface: every name has an example in its docstring, and every example runs."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import nolbo_ppl

SLOW = {"train", "evaluate", "run"}
"""Examples that take seconds."""
NAMES = [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in nolbo_ppl.PUBLIC]


def test_names_are_listed_once() -> None:
    assert sorted(nolbo_ppl.PUBLIC) == sorted(set(nolbo_ppl.__all__) - {"__version__"})
    assert 20 <= len(nolbo_ppl.PUBLIC) <= 30
    tree = ast.parse(Path(nolbo_ppl.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))  # what type checkers see
    seen = {alias.asname: f"{node.module}:{alias.name}" for node in block.body for alias in node.names}  # type: ignore[attr-defined]
    assert set(seen) == set(nolbo_ppl.PUBLIC)
    for name, place in nolbo_ppl.PUBLIC.items():
        assert name == "train" or seen[name] == f"nolbo_ppl.{place}"


def test_names_lead_to_what_they_say() -> None:
    assert dir(nolbo_ppl) == nolbo_ppl.__all__
    for name in nolbo_ppl.PUBLIC:
        found = getattr(nolbo_ppl, name)
        assert callable(found) and inspect.getdoc(found)
    import nolbo_ppl.train as module

    assert module is nolbo_ppl.train and isinstance(module, ModuleType)  # to import the module does not hide the function


@pytest.fixture
def single_precision() -> Iterator[None]:
    """What users have: the other tests run in double precision."""
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    yield
    torch.set_default_dtype(default)


@pytest.mark.usefixtures("single_precision")
@pytest.mark.parametrize("name", NAMES)
def test_the_example_of_a_public_name_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    found = getattr(nolbo_ppl, name)
    module = found if isinstance(found, ModuleType) else sys.modules[found.__module__]
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE | doctest.IGNORE_EXCEPTION_DETAIL
    runner = doctest.DocTestRunner(optionflags=flags, verbose=False)
    tests = doctest.DocTestFinder().find(found, name, module, globs={**vars(module), "np": np})
    own = next(test for test in tests if test.name == name)
    assert own.examples, f"nolbo_ppl.{name} has no example in its docstring"
    told: list[str] = []
    for test in tests:
        runner.run(test, out=told.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(told)


def internals_with_examples() -> list[str]:
    """Functions and classes outside of the public interface whose docstrings hold an example, as `module:name`."""
    package, found = Path(nolbo_ppl.__file__).parent, []
    for path in sorted(package.rglob("*.py")):
        module = ".".join(path.relative_to(package).with_suffix("").parts)
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and f"{module}:{node.name}" not in nolbo_ppl.PUBLIC.values():
                texts = [ast.get_docstring(x) for x in ast.walk(node) if isinstance(x, ast.FunctionDef | ast.ClassDef)]
                if any(text and ">>>" in text for text in texts):
                    found.append(f"{module}:{node.name}")
    return found


@pytest.mark.usefixtures("single_precision")
@pytest.mark.parametrize("place", internals_with_examples())
def test_the_example_of_an_internal_runs(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    module = importlib.import_module("nolbo_ppl." + place.partition(":")[0])
    name = place.partition(":")[2]
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE | doctest.IGNORE_EXCEPTION_DETAIL
    runner = doctest.DocTestRunner(optionflags=flags, verbose=False)
    tests = doctest.DocTestFinder().find(getattr(module, name), name, module, globs={**vars(module), "np": np})
    told: list[str] = []
    for test in tests:
        runner.run(test, out=told.append)
    results = runner.summarize(verbose=False)
    assert results.attempted and not results.failed, "".join(told)


@pytest.mark.parametrize(
    ("program", "seconds"), [("import nolbo_ppl", 0.2), ("from nolbo_ppl.cli import main; main(['--help'])", 0.5)]
)
def test_what_is_light_stays_light(program: str, seconds: float) -> None:
    """Processor time beyond that of an empty program, the best of three: waiting for other programs does not count."""

    def spent(text: str) -> float:
        timed = f"import time\n{text}\nimport sys\nsys.stderr.write(str(time.process_time()))"
        return min(float(subprocess.run([sys.executable, "-c", timed], capture_output=True, text=True).stderr) for _ in range(3))

    assert spent(f"try:\n    {program}\nexcept SystemExit: pass") - spent("") < seconds


@pytest.mark.parametrize("name", ["evaluate", "run"])
def test_an_import_path_of_the_first_version_does_not_hide_the_public_name(name: str) -> None:
    sys.modules.pop(f"nolbo_ppl.{name}", None)
    with pytest.warns(FutureWarning, match=f"nolbo_ppl.{name} moved"):
        old = importlib.import_module(f"nolbo_ppl.{name}")
    assert old.main is importlib.import_module(f"nolbo_ppl.cli.{name}").main
    assert callable(getattr(nolbo_ppl, name))
