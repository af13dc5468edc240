"""A short fuzz of every reader; `make fuzz` goes on for as long as one likes."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import input_error

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import fuzz

SECONDS = 8.0


def test_no_reader_breaks() -> None:
    chosen = fuzz.surfaces()
    for name, count in fuzz.fuzz(chosen, SECONDS, seed=1, most=25).items():
        assert not count.defects, (name, count.defects[:3])
        assert count.inputs == count.clear + count.accepted > 0, name


def breaks(_: Path) -> None:
    raise ZeroDivisionError


def is_unclear(_: Path) -> None:
    raise input_error("bad value", got=1)


def is_clear(path: Path) -> None:
    raise input_error("bad value", got=1, file=path)


@pytest.mark.parametrize(
    ("read", "answer"),
    [
        (breaks, "ZeroDivisionError"),
        (is_unclear, "error without the file"),
        (is_clear, ""),
        (lambda _: {"a": [np.array([1.0, np.inf])]}, "not finite"),
        (lambda _: (np.array([1.0, np.nan]),), "not finite"),
        (lambda _: np.exp(np.array(1e6)) * 0 + 1, "warning: overflow"),
        (lambda _: np.zeros(2), None),
    ],
)
def test_the_judge_sees_each_kind_of_defect(read: object, answer: str | None, tmp_path: Path) -> None:
    found = fuzz.judge(fuzz.Surface("x.json", b"{}", read), b"{}", tmp_path / "x")
    assert found == answer if answer in ("", None) else answer in (found or "")


def test_missing_numbers_are_no_defects_where_a_file_may_leave_them_out(tmp_path: Path) -> None:
    surface = fuzz.Surface("x.json", b"{}", lambda _: np.array([1.0, np.nan]), missing=True)
    assert fuzz.judge(surface, b"{}", tmp_path / "x") is None


def test_slow_readers_are_defects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "SLOWEST", 1)

    def slow(_: Path) -> None:
        while True:
            pass

    assert fuzz.judge(fuzz.Surface("x.json", b"{}", slow), b"{}", tmp_path / "x") == "more than 1 s"


def test_mutations_differ_and_come_back() -> None:
    surface = next(one for one in fuzz.surfaces() if one.name == "objects.json")
    first = [fuzz.mutate(surface, random.Random(k)) for k in range(30)]
    assert first == [fuzz.mutate(surface, random.Random(k)) for k in range(30)]
    assert len(set(first)) > 20
