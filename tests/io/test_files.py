"""Files: atomic writing, and JSON whose every damage is one error that names file and line."""

from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.fields import is_number, is_whole, number_array
from nolbo_ppl.io.files import (
    TEMPORARY,
    atomic_path,
    existing_file,
    inside,
    read_json,
    read_json_object,
    read_jsonl,
    write_json,
    write_jsonl,
)

JSON_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63) + 1, 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=5,
)


@settings(max_examples=25, deadline=None)
@given(rows=st.lists(st.dictionaries(st.text(), JSON_VALUES, max_size=3), max_size=2))
def test_what_is_written_is_read_back(rows: list[dict], tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("json")
    write_jsonl(folder / "a.jsonl", rows)
    assert [row for _, row in read_jsonl(folder / "a.jsonl")] == rows
    write_json(folder / "a.json", rows)
    assert read_json(folder / "a.json") == rows


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"a": 1}\n{"category": "caf\xe9"}\n', r":2: not a text file: got byte 0xe9, expected UTF-8"),
        ('{"a": 1}'.encode("utf-16"), r":1: not a text file"),
        (b'\n{"a": 1, "b": 2, "a": 3}', r":2: .*key 'a' stands twice"),
        (b'{"a": NaN}', r":1: .*NaN"),
        (b'{"a": 1e400}', r":1: .*1e400 is out of range"),
        (b'{"a": 1' + b"0" * 400 + b"}", r":1: .*out of range"),
        (b'{"a": ' + b"9" * 5000 + b"}", r":1: .*out of range"),
        (b'{"a": ' + b"[" * 3000 + b"]" * 3000 + b"}", r":1: .*nested too deeply"),
        (b'{"a": 1', r":1: .*truncated"),
        (b"[1]", r":1: not a JSON object: got list"),
    ],
)
def test_damaged_lines_of_json_name_file_and_line(content: bytes, message: str, tmp_path: Path) -> None:
    file = tmp_path / "x.jsonl"
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"x\.jsonl" + message):
        list(read_jsonl(file))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"a": "\n\n\xe9"}', r":3: not a text file"),
        (b'{"a": 1, "a": 2}', r"key 'a' stands twice"),
        (b'{"a": -Infinity}', r"-Infinity"),
        (b"[" * 3000, r"nested too deeply"),
        (b'{"a":\n 1,}', r":2: not valid JSON"),
        (b"", r"not valid JSON"),
        (b"[]", r"not a JSON object: got list"),
    ],
)
def test_damaged_json_names_the_file(content: bytes, message: str, tmp_path: Path) -> None:
    file = tmp_path / "x.json"
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"x\.json" + ".*" + message):
        read_json_object(file)


def test_the_mark_of_some_editors_before_the_text_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_bytes(b"\xef\xbb\xbf" + b'{"a": 1}\r\n')
    assert read_json(tmp_path / "x.json") == {"a": 1}
    assert list(read_jsonl(tmp_path / "x.json")) == [(1, {"a": 1})]


def test_what_is_no_file_is_said(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, message in (
        (tmp_path / "none", "no such file"),
        (tmp_path, "not a file: got a folder"),
        (tmp_path / "pipe", "not a file: got a pipe or a device"),
        (Path(os.devnull), "not a file: got a pipe or a device"),
        (tmp_path / ("x" * 300), "cannot be read: got File name too long"),
    ):
        with pytest.raises(InputError, match=message):
            existing_file(path)
        with pytest.raises(InputError, match=message):
            list(read_jsonl(path))


def test_a_file_nobody_may_read_is_said(tmp_path: Path) -> None:
    file = tmp_path / "x.json"
    file.write_text("{}")
    file.chmod(0)
    if os.access(file, os.R_OK):
        pytest.skip("this user may read everything")
    with pytest.raises(InputError, match=r"x\.json: cannot be read: got Permission denied"):
        read_json(file)


def test_atomic_writing_names_the_file_and_leaves_the_old_one(tmp_path: Path) -> None:
    file = tmp_path / "x.txt"
    file.write_text("old")
    with pytest.raises(OSError, match="No space left") as caught, atomic_path(file) as temporary:
        assert TEMPORARY.fullmatch(temporary.name)
        temporary.write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert caught.value.filename == str(file)
    assert [path.name for path in tmp_path.iterdir()] == ["x.txt"]
    assert file.read_text() == "old"
    with atomic_path(file) as temporary:
        temporary.write_text("new")
    assert file.read_text() == "new"
    assert stat.S_IMODE(file.stat().st_mode) & 0o400


def test_names_stay_within_their_folder(tmp_path: Path) -> None:
    (tmp_path / "folder" / "deep").mkdir(parents=True)
    folder = tmp_path / "folder"
    (tmp_path / "secret.png").touch()
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    (folder / "circle").symlink_to(folder / "circle")
    for name in ("../secret.png", "/etc/passwd", "link.png", "deep/../../secret.png", "", "a\0b", "circle"):
        assert inside(folder, name) is None, name
    assert inside(folder, "half \ud800 a pair") is None
    for name in ("a.png", "deep/../a.png", "images/000.png"):
        assert inside(folder, name) == folder / name


@given(value=JSON_VALUES)
def test_numbers_are_numbers(value: object) -> None:
    """What counts as a number keeps its value in float64 and stays finite in float32 and squared."""
    if is_number(value):
        assert json.loads(json.dumps(value)) == value
        assert float(value) == value or abs(float(value) - value) <= 1e-15 * abs(value)
        assert float(value) ** 2 < 1e61
    assert not is_number(str(value))
    array = number_array([value, 1], (2,))
    assert (array is not None) == is_number(value)
    assert not is_whole(value) or isinstance(value, int)


def test_arrays_of_numbers() -> None:
    assert number_array([[1, 2], [3.5, 4]], (2, 2)).tolist() == [[1.0, 2.0], [3.5, 4.0]]
    for bad in ([[1, 2], [3]], [[1, 2], [3, "4"]], [[1, 2], [3, False]], [[1, 2], [3, 1e31]], [1, 2], "12", None, [[1, 2], 3]):
        assert number_array(bad, (2, 2)) is None
    assert number_array([], (None, 3)) is None or number_array([], (None, 3)).size == 0
