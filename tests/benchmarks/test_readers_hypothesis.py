"""Every reader against what hypothesis thinks of: JSON values of any kind anywhere, arrays of any type and shape, cut bytes."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import fuzz

EXAMPLES = 20
SURFACES = {surface.name: surface for surface in fuzz.surfaces()}

NUMBERS = st.one_of(st.integers(), st.floats(), st.sampled_from([2**63, -(2**70), 1e308, 5e-324, -0.0, 10**400]))
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=8)),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=6), inner, max_size=3)),
    max_leaves=8,
)
TYPES = st.sampled_from(["f8", "f4", "f2", "i8", "u1", "?", "c16", "U3", "S2", "M8[s]"])
ARRAYS = TYPES.flatmap(
    lambda kind: arrays.arrays(np.dtype(kind), arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=6))
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Ways to every value within a value."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(way for key, item in inner for way in places(item, (*path, key)))]


def put(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """The value with another one in a place."""
    if not path:
        return new
    copied = dict(value) if isinstance(value, dict) else list(value)
    copied[path[0]] = put(value[path[0]], path[1:], new)
    return copied


@st.composite
def changed_document(draw: st.DrawFn, good: bytes) -> bytes:
    """JSON, or JSON Lines, with another value in one place."""
    rows = [json.loads(line) for line in good.splitlines()] if good.count(b"\n{") else [json.loads(good)]
    at = draw(st.integers(0, len(rows) - 1))
    rows[at] = put(rows[at], draw(st.sampled_from(places(rows[at]))), draw(VALUES))
    return "".join(json.dumps(row) + "\n" for row in rows).encode()


@st.composite
def changed_archive(draw: st.DrawFn, good: bytes) -> bytes:
    """NPZ with other arrays under some names."""
    with np.load(io.BytesIO(good)) as archive:
        held = {name: archive[name] for name in archive.files}
    for name in draw(st.sets(st.sampled_from(sorted(held)), min_size=1)):
        held[name] = draw(ARRAYS)
    buffer = io.BytesIO()
    np.savez(buffer, **held)
    return buffer.getvalue()


@st.composite
def changed_data(draw: st.DrawFn, good: bytes) -> bytes:
    """Bytes with a piece cut out, put in, or repeated."""
    start = draw(st.integers(0, len(good)))
    end = min(start + draw(st.integers(0, 64)), len(good))
    piece = draw(st.one_of(st.binary(max_size=16), st.just(good[start:end] * 3), st.text(max_size=8).map(str.encode)))
    return good[:start] + piece + good[end:]


def inputs_of(surface: fuzz.Surface) -> st.SearchStrategy[bytes]:
    kinds: list[st.SearchStrategy[bytes]] = [changed_data(surface.good)]
    if surface.name.endswith((".json", ".jsonl")):
        kinds.append(changed_document(surface.good))
    if surface.name.endswith(".npz"):
        kinds.append(changed_archive(surface.good))
    return st.one_of(kinds)


@pytest.mark.parametrize("name", SURFACES)
def test_a_reader_accepts_or_says_what_is_wrong(name: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    surface, folder = SURFACES[name], tmp_path_factory.mktemp("reader") / "input"
    told = set()

    @settings(max_examples=EXAMPLES, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck))
    @given(data=inputs_of(surface))
    def read(data: bytes) -> None:
        answer = fuzz.judge(surface, data, folder)
        told.add(answer is None)
        assert not answer, answer

    read()
    assert told


def test_places_and_put_reach_everything() -> None:
    value = {"a": [1, {"b": 2}], "c": None}
    assert set(places(value)) == {(), ("a",), ("a", 0), ("a", 1), ("a", 1, "b"), ("c",)}
    assert put(value, ("a", 1, "b"), 3) == {"a": [1, {"b": 3}], "c": None}
    assert value["a"] == [1, {"b": 2}]
