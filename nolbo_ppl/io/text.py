"""Text files of words and numbers: lines without comments, with their numbers for the errors."""

from __future__ import annotations

from pathlib import Path

from nolbo_ppl.io.files import read_text


def read_words(path: Path) -> list[tuple[int, list[str]]]:
    """Line numbers and words of a text file without comments and blank lines. Raises `InputError` when it is none."""
    lines = read_text(path).splitlines()
    split = [(number, line.split("#", 1)[0].replace(",", " ").split()) for number, line in enumerate(lines, start=1)]
    return [(number, words) for number, words in split if words]
