"""Pickles of plain values, beside Python's own reader; what would run is refused, and not run."""

from __future__ import annotations

import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.plain_pickle import read_plain_pickle

SHARED = ["twice", 2**70]
VALUE: dict[Any, Any] = {
    "a.jpg": {"f": 346.41, "u": -25.0, "n": None, "yes": True, "no": False, "text": "\u00e4 'quoted'", "model": "8b72"},
    "b": [1, -2, 300, 70_000, 2**40, (), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4), [], {}, SHARED, SHARED],
    7: {},
}


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_values_of_every_protocol(tmp_path: Path, protocol: int) -> None:
    file = tmp_path / "a.pkl"
    file.write_bytes(pickle.dumps(VALUE, protocol=protocol))
    found = read_plain_pickle(file)
    assert found == VALUE and found["b"][-1] is found["b"][-2]
    assert found["a.jpg"]["yes"] is True and isinstance(found["b"][5], tuple)


class Harmful:
    """Would make a folder where it is unpickled."""

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.folder,)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_nothing_is_run(tmp_path: Path, protocol: int) -> None:
    file = tmp_path / "a.pkl"
    for value in ({"x": Harmful(str(tmp_path / "made"))}, OrderedDict(a=1), {1, 2}, b"bytes", complex(1, 2)):
        file.write_bytes(pickle.dumps(value, protocol=protocol))
        with pytest.raises(InputError, match=r"a\.pkl: a pickle of plain values: got the instruction"):
            read_plain_pickle(file)
    assert not (tmp_path / "made").exists()


def test_damaged_files_are_named(tmp_path: Path) -> None:
    file, whole = tmp_path / "a.pkl", pickle.dumps(VALUE, protocol=0)
    for data in (b"", b"no pickle", whole[: len(whole) // 2], whole[1:], b"s.", b"(.", b"d.", b"(I1\nd.", b"I1\nI2\n.", b"g7\n."):
        file.write_bytes(data)
        with pytest.raises(InputError, match=r"a\.pkl"):
            read_plain_pickle(file)
    with pytest.raises(InputError, match="no such file"):
        read_plain_pickle(tmp_path / "none.pkl")
