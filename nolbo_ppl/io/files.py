"""Files: written atomically (nothing half-written is ever left behind), JSON and JSON Lines read with every check.

Whatever a file, or the system about a file, can get wrong becomes one `InputError` that names file and line.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nolbo_ppl.errors import InputError, input_error

LARGEST_WHOLE = 2**63 - 1
"""Largest whole number that a JSON file may hold: what comes after are arrays of 64 bits."""
TEMPORARY = re.compile(r"\..*\.\d+\.tmp(\.[^.]*)?")
"""Names of the temporary files of `atomic_path`; a killed process leaves one."""


@contextmanager
def reading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn what the system says about a file while it is read into an `InputError` that names it."""
    try:
        yield
    except InputError:
        raise
    except FileNotFoundError:
        raise input_error("no such file", file=path) from None
    except OSError as error:
        raise input_error("cannot be read", got=error.strerror or error, file=path) from None
    except MemoryError:
        raise input_error("needs more memory than there is", file=path) from None


def existing_file(path: str | os.PathLike[str]) -> Path:
    """The path of a regular file.

    Raises:
        InputError: there is nothing, a folder, a pipe or a device (whose end might never come), or it cannot be looked at.
    """
    path = Path(path)
    with reading(path):
        regular = path.is_file() or not path.stat()
    if not regular:
        kind = "a folder" if path.is_dir() else "a pipe or a device"
        raise input_error("not a file", got=kind, expected="a regular file", file=path)
    return path


def is_file(path: str | os.PathLike[str]) -> bool:
    """Whether there is a regular file; false, too, for names that no file can have."""
    try:
        return Path(path).is_file()
    except (OSError, UnicodeEncodeError):
        return False


def inside(folder: str | os.PathLike[str], name: str, *, follow: bool = False) -> Path | None:
    """Path of a name within a folder, None where it leads out of it: by `..`, as an absolute path, or over a link.

    Args:
        folder: the folder.
        name: a name that some file holds, and that need not be well meant.
        follow: links lead where they like: who put them into the folder has said so.
    """
    plain = os.path.normpath(name) if name and "\0" not in name else ".."
    if os.path.isabs(plain) or plain.split(os.sep)[0] == "..":
        return None
    path, root = Path(folder) / name, Path(folder).resolve()
    if follow:
        return path
    try:
        return path if path.resolve().is_relative_to(root) else None
    except (OSError, RuntimeError, UnicodeEncodeError):  # names that are too long, or no text; links in a circle
        return None


def to_the_end(clean_up: Callable[[], None]) -> None:
    """Clean up, once more where Ctrl-C or a signal falls into it: it takes milliseconds, and half of it leaves files behind.

    Args:
        clean_up: may be called again after any part of it.
    """
    try:
        clean_up()
    except Exception:
        raise
    except BaseException:
        clean_up()
        raise


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path` that replaces `path` when the block ends, and vanishes when it raises.

    The parent folder is made. The temporary name keeps the suffix, so that writers which look at it still work.

    Raises:
        OSError: it cannot be written; carries the file's name.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename in (None, str(temporary), os.fspath(temporary)):
            error.filename = str(path)  # a full disk is told without any name
        raise
    finally:
        to_the_end(lambda: temporary.unlink(missing_ok=True))


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` as indented JSON, atomically; NaN and infinity raise, since JSON has neither."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def write_jsonl(path: str | os.PathLike[str], rows: Iterable[dict[str, Any]]) -> None:
    """Write one JSON object a line, atomically; NaN and infinity raise."""
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for row in rows:
            file.write(json.dumps(row, allow_nan=False) + "\n")


def _constant(name: str) -> float:
    raise ValueError(f"{name} is not a number JSON knows")


def _real(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is out of range")
    return value


def _whole(text: str) -> int:
    if len(text) > 20 or abs(int(text)) > LARGEST_WHOLE:
        raise ValueError(f"{text[:40]} is out of range")
    return int(text)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The last of two equal keys would win in silence."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"key {next(key for key in keys if keys.count(key) > 1)!r} stands twice")
    return found


_DECODER = json.JSONDecoder(object_pairs_hook=_object, parse_float=_real, parse_int=_whole, parse_constant=_constant)


def _parse(text: str) -> Any:
    """One JSON value; whatever is wrong with it is a `ValueError`."""
    try:
        return _DECODER.decode(text)
    except RecursionError:
        raise ValueError("brackets are nested too deeply") from None


def _decoded(data: bytes, path: Path, first: int = 1) -> str:
    """UTF-8 text, with or without the mark some editors put first."""
    try:
        return data.decode("utf-8-sig" if first == 1 else "utf-8")
    except UnicodeDecodeError as error:
        line = first + data.count(b"\n", 0, error.start)
        wide = first == 1 and data[:2] in (b"\xff\xfe", b"\xfe\xff")
        got = "UTF-16" if wide else f"byte {data[error.start]:#04x}"
        raise input_error("not a text file", got=got, expected="UTF-8", do="save it as UTF-8", file=path, line=line) from None


def read_text(path: str | os.PathLike[str]) -> str:
    """A text file in UTF-8. Raises `InputError` naming file, and the line that is no text."""
    path = existing_file(path)
    with reading(path):
        return _decoded(path.read_bytes(), path)


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read one JSON file.

    Raises:
        InputError: missing, malformed, a key that stands twice, NaN, infinity or numbers beyond 64 bits; names file and line.
    """
    path = Path(path)
    text = read_text(path)
    try:
        return _parse(text)
    except json.JSONDecodeError as error:
        raise input_error("not valid JSON", got=error.msg, file=path, line=error.lineno) from None
    except ValueError as error:
        raise input_error("not valid JSON", got=error, file=path) from None


def read_json_object(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read one JSON file that holds an object. Raises `InputError` as `read_json`, and for any other value."""
    value = read_json(path)
    if not isinstance(value, dict):
        raise input_error("not a JSON object", got=type(value).__name__, expected="{...}", file=path)
    return value


def read_jsonl(path: str | os.PathLike[str]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield (line number from 1, object) of a JSON Lines file; blank lines are skipped.

    Raises:
        InputError: the file is missing, a line is no JSON object, or holds what `read_json` refuses; names file and line.
    """
    path = existing_file(path)
    with reading(path), path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            text = _decoded(line, path, number).strip()
            if not text:
                continue
            try:
                row = _parse(text)
            except ValueError as error:
                raise input_error(
                    "not a line of JSON",
                    got=f"{text[:80]!r} ({error})",
                    expected="one JSON object a line",
                    do="is the file truncated?",
                    file=path,
                    line=number,
                ) from None
            if not isinstance(row, dict):
                raise input_error("not a JSON object", got=type(row).__name__, expected="{...}", file=path, line=number)
            yield number, row
