"""Shared fixtures: float64 by default, module-local parameters, and the folder of real data."""

from __future__ import annotations

import inspect
import os
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest
import torch

SHAPES_CHECKED = [
    f"nolbo_ppl.{room}"
    for room in (
        "geometry",
        "structures",
        "io",
        "metrics",
        "models.distributions",
        "inference.association.exact",
        "inference.association.k_best",
        "inference.association.marginals",
        "inference.association.problem",
    )
]
"""Rooms whose annotations are enforced in the tests: what has another shape or type than is written is an error.

Functions that numba compiles check their own arguments, and cannot be wrapped: the rooms that hold them are not listed."""
jaxtyping.install_import_hook(SHAPES_CHECKED, "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")


UNCHECKED = "tests/inference/slam/"
"""Tests that solve whole drives: poses are composed some ten thousand times in each, and checks make them a fifth slower. The
tests of `geometry`, of the commands and of runs check the same calls."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """A test that expects an error hands in what is wrong, and is about the library's own message: nothing checks before it.

    Before its fixtures, which may be those of a whole module.
    """
    test = inspect.unwrap(item.function) if isinstance(item, pytest.Function) else None
    bad_input = test is not None and "raises" in test.__code__.co_names
    jaxtyping.config.update("jaxtyping_disable", bad_input or item.nodeid.startswith(UNCHECKED))


@pytest.fixture(autouse=True)
def _float64() -> Iterator[None]:
    """Mathematics is tested in double precision."""
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(default)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data, outside the repository for its licences: `$NOLBO_DATA` or `../shared/data`."""
    path = Path(os.environ.get("NOLBO_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"real data not found at {path}: set NOLBO_DATA to its folder")
    return path


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests of a GPU are skipped without one. With several workers the slow tests come first: at the end, one worker would run
    them while the others wait."""
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="no CUDA device"))
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: item.get_closest_marker("slow") is None)
