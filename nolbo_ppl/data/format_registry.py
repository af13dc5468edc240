"""What a file or folder is: formats that are read, each with a test that tells it by a look, and a report of what it holds.

A format registers itself with `register`; `nolbo data check` asks all of them. A test looks at names and first bytes, never at
a whole file; the report reads everything, by the reader that every verb uses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.errors import InputError, input_error
from nolbo_ppl.io.images import is_passed_over
from nolbo_ppl.io.ros_bags import split_topic

HEAD = 4096
"""Bytes of a file that tests look at."""
SURE, LIKELY, POSSIBLE = 1.0, 0.7, 0.3
"""Confidences of tests: only this format looks so; it does, and so might another; nothing speaks against it."""
UNKNOWN = "unknown"
"""Format of what no format fits."""
MOST_PARTS = 60
"""Parts of a folder that are looked into."""
SHOWN = 12
"""Pictures of a contact sheet."""


def spread(count: int, most: int = SHOWN) -> list[int]:
    """Places of at most so many of `count`, evenly, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist() if count else []


@dataclass(frozen=True)
class LabelledPicture:
    """A picture of a contact sheet."""

    name: str
    """What it is called."""
    image: UInt8[np.ndarray, "h w 3"]
    """RGB."""
    boxes: Float[np.ndarray, "n 4"] = field(default_factory=lambda: np.zeros((0, 4)))
    """x0 y0 x1 y1, px."""
    labels: tuple[str, ...] = ()
    """One a box."""


@dataclass(frozen=True)
class FormatReport:
    """What was found."""

    format: str
    """Name of the format; `unknown` where no format fits."""
    what: str
    """What that is."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Findings by name, as JSON has them."""
    problems: tuple[str, ...] = ()
    """What is wrong."""
    parts: tuple[tuple[str, FormatReport], ...] = ()
    """Of a folder of several things: its parts by name."""
    pictures: Callable[[], Iterator[LabelledPicture]] | None = None
    """Pictures for a contact sheet, read when they are asked for."""

    def as_json(self) -> dict[str, Any]:
        """Everything but the pictures."""
        out: dict[str, Any] = {"format": self.format, "what": self.what, **self.facts, "problems": list(self.problems)}
        if self.parts:
            out["parts"] = {name: report.as_json() for name, report in self.parts}
        return out


class Look:
    """A path as tests see it: its names and first bytes, read once.

    >>> Look("poses.txt").suffix
    '.txt'
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)

    @property
    def suffix(self) -> str:
        """Ending of the name, in lower case."""
        return self.path.suffix.lower()

    @cached_property
    def is_folder(self) -> bool:
        """Whether it is a folder."""
        return self.path.is_dir()

    @cached_property
    def names(self) -> frozenset[str]:
        """Names in the folder, but hidden ones; none of a file."""
        return frozenset(path.name for path in self.path.iterdir() if not is_passed_over(path)) if self.is_folder else frozenset()

    @cached_property
    def head(self) -> bytes:
        """First bytes of the file; none of a folder."""
        if not self.path.is_file():
            return b""
        with self.path.open("rb") as file:
            return file.read(HEAD)

    @cached_property
    def text(self) -> str:
        """First bytes as text; empty where they are none."""
        try:
            return self.head.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            return self.head[: error.start].decode("utf-8-sig", "replace") if error.start > len(self.head) - 4 else ""

    @cached_property
    def rows(self) -> list[list[str]]:
        """Words of the first whole lines without comments."""
        lines = self.text.splitlines()
        whole = lines[:-1] if len(self.head) == HEAD else lines
        split = [line.split("#", 1)[0].replace(",", " ").split() for line in whole]
        return [words for words in split if words]

    def number_columns(self) -> int:
        """Columns of a table of numbers, most of whose first lines are as wide; 0 where they are none."""
        widths = []
        for words in self.rows[:20]:
            try:
                [float(word) for word in words]
                widths.append(len(words))
            except ValueError:
                widths.append(0)
        common = max(set(widths), key=widths.count, default=0)
        return common if widths.count(common) > 0.6 * len(widths) else 0


@dataclass(frozen=True)
class Format:
    """One format."""

    name: str
    """Short name, as `nolbo data check NAME PATH` takes it."""
    what: str
    """What it is, in words."""
    looks_like: Callable[[Look], float]
    """Confidence that a path is of this format, 0 to 1, by a look."""
    report: Callable[[Path], FormatReport]
    """Everything about it; raises `InputError` where it cannot be read."""


FORMATS: dict[str, Format] = {}
"""Every format by its name."""


def register(name: str, what: str, looks_like: Callable[[Look], float]) -> Callable[[Callable[[Path], FormatReport]], Any]:
    """Decorator of a function that reports on a format.

    Example:
        >>> @register("example", "an example", lambda look: float(look.suffix == ".example"))
        ... def report_example(path):
        ...     return FormatReport("example", "an example", {"bytes": path.stat().st_size})
        >>> FORMATS.pop("example").what
        'an example'
    """

    def add(report: Callable[[Path], FormatReport]) -> Callable[[Path], FormatReport]:
        FORMATS[name] = Format(name, what, looks_like, report)
        return report

    return add


def recognise(path: str | PathLike[str]) -> list[tuple[float, Format]]:
    """Formats that a path may be of, the likeliest first."""
    look = Look(path)
    found = [(one.looks_like(look), one) for one in FORMATS.values()]
    return sorted([item for item in found if item[0] > 0], key=lambda item: -item[0])


def check_data(path: str | PathLike[str], name: str | None = None, depth: int = 3) -> FormatReport:
    """What a file or folder is, what it holds, and what is wrong with it.

    What cannot be read is a report with a problem, not an error. Of formats that look alike the first one that can be read is
    taken; a folder of no format is reported by its parts.

    Args:
        path: the file or folder.
        name: the format it shall be; None to tell it by a look.
        depth: how deep folders of no format are looked into.

    Raises:
        InputError: nothing there, or no format of this name.
    """
    path = Path(path)
    if name is not None and name not in FORMATS:
        raise input_error("no such format", got=name, expected="one of " + ", ".join(sorted(FORMATS)))
    if not split_topic(path)[0].exists():
        raise input_error("no such file or folder", file=path)
    found = [(SURE, FORMATS[name])] if name is not None else recognise(path)
    failure: FormatReport | None = None
    for _, one in found:
        try:
            return one.report(path)
        except InputError as error:
            failure = failure or FormatReport(one.name, one.what, problems=(str(error),))
    if failure is not None:
        return failure
    if not path.is_dir():
        return FormatReport(UNKNOWN, "a file of no format that is read", problems=("no format fits",))
    inside = sorted(entry for entry in path.iterdir() if not is_passed_over(entry))
    looked = [(entry.name, check_data(entry, depth=depth - 1)) for entry in inside[:MOST_PARTS] if depth > 0]
    parts = tuple((name, report) for name, report in looked if report.format != UNKNOWN)
    if not parts:
        empty = "the folder is empty" if not inside else "no format fits, nor any part of the folder"
        return FormatReport(UNKNOWN, "a folder of no format that is read", problems=(empty,))
    left = [f"{len(inside) - MOST_PARTS} more entries were not looked into"] if len(inside) > MOST_PARTS else []
    problems = [f"{name}: {text}" for name, report in parts for text in report.problems]
    pictures = next((report.pictures for _, report in parts if report.pictures is not None), None)
    return FormatReport("folder", "a folder of several things", problems=(*left, *problems), parts=parts, pictures=pictures)
