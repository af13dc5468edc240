"""Text files of words and numbers: lines without comments, with their numbers for the errors."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_text


def read_lines(path: Path) -> list[str]:
    """Lines of a text file in UTF-8, with or without a byte order mark. Raises `InputError` when it is none."""
    return read_text(path).splitlines()


def read_words(path: Path) -> list[tuple[int, list[str]]]:
    """Line numbers and words of a text file without comments and blank lines. Raises `InputError` when it is none."""
    split = [(number, line.split("#", 1)[0].replace(",", " ").split()) for number, line in enumerate(read_lines(path), start=1)]
    return [(number, words) for number, words in split if words]


def read_column(path: str | PathLike[str], what: str) -> list[tuple[int, float]]:
    """Line numbers and values of a file with one finite number a line; blank lines and `#` comments are skipped.

    Raises:
        InputError: the file is missing or empty, or a line holds anything else; names file and line.
    """
    path = Path(path)
    rows = []
    for number, words in read_words(path):
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != 1 or not np.isfinite(values[0]):
            raise input_error(f"not {what}", got=repr(" ".join(words)[:80]), expected="one number", file=path, line=number)
        rows.append((number, values[0]))
    if not rows:
        raise input_error("the file is empty", expected=f"{what} a line", file=path)
    return rows


def read_times(path: str | PathLike[str]) -> Float[np.ndarray, " n"]:
    """Times in s, one a line (`times.txt` of KITTI). Raises `InputError` naming the line, also where time stands still."""
    rows = read_column(path, "a time in seconds")
    times = np.array([value for _, value in rows])
    backwards = np.diff(times) <= 0
    if backwards.any():
        number, value = rows[int(np.argmax(backwards)) + 1]
        raise input_error("time does not increase", got=value, file=path, line=number)
    return times


def read_lengths(path: str | PathLike[str]) -> Float[np.ndarray, " n"]:
    """Lengths of steps in m, one a line: line k is the way from frame k - 1 to frame k, frames counted from 0.

    Raises:
        InputError: malformed or negative lengths; names file and line.
    """
    rows = read_column(path, "a length in metres")
    for number, value in rows:
        if value < 0:
            raise input_error("negative length", got=value, expected="metres from one frame to the next", file=path, line=number)
    return np.array([value for _, value in rows])
