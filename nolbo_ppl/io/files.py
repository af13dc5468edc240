"""Files: atomic writing (nothing half-written is ever left behind) and reading with errors that name file and line."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nolbo_ppl.errors import input_error


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path` that replaces `path` when the block ends, and vanishes when it raises.

    The parent folder is made. The temporary name keeps the suffix, so that writers which look at it still work.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` as indented JSON, atomically; NaN and infinity raise, since JSON has neither."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read one JSON file. Raises `InputError` naming file and line when it is missing or malformed."""
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise input_error("no such file", file=path) from None
    except json.JSONDecodeError as error:
        raise input_error("not valid JSON", got=error.msg, file=path, line=error.lineno) from None


def write_jsonl(path: str | os.PathLike[str], rows: Iterable[dict[str, Any]]) -> None:
    """Write one JSON object a line, atomically; NaN and infinity raise."""
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for row in rows:
            file.write(json.dumps(row, allow_nan=False) + "\n")


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number JSON knows")


def read_jsonl(path: str | os.PathLike[str]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield (line number from 1, object) of a JSON Lines file; blank lines are skipped.

    Raises:
        InputError: the file is missing, a line is no JSON object, or holds NaN or infinity; names file and line.
    """
    path = Path(path)
    if not path.is_file():
        raise input_error("no such file", file=path)
    with path.open(encoding="utf-8") as file:
        for number, text in enumerate(file, start=1):
            if not text.strip():
                continue
            try:
                row = json.loads(text, parse_constant=_refuse_constant)
            except ValueError as error:
                raise input_error(
                    "not a line of JSON",
                    got=f"{text.strip()[:80]!r} ({error})",
                    expected="one JSON object a line",
                    do="is the file truncated?",
                    file=path,
                    line=number,
                ) from None
            if not isinstance(row, dict):
                raise input_error("not a JSON object", got=type(row).__name__, expected="{...}", file=path, line=number)
            yield number, row
