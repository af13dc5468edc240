"""Text files of words and numbers: lines without comments, with their numbers for the errors."""

from __future__ import annotations

from pathlib import Path

from nolbo_ppl.io.files import read_text


def read_lines(path: Path) -> list[str]:
    """Lines of a text file in UTF-8, with or without a byte order mark. Raises `InputError` when it is none."""
    return read_text(path).splitlines()


def read_words(path: Path) -> list[tuple[int, list[str]]]:
    """Line numbers and words of a text file without comments and blank lines. Raises `InputError` when it is none."""
    split = [(number, line.split("#", 1)[0].replace(",", " ").split()) for number, line in enumerate(read_lines(path), start=1)]
    return [(number, words) for number, words in split if words]
