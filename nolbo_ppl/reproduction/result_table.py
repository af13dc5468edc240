"""Tables of figures with their intervals, as Markdown and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.metrics.intervals import IntervalEstimate


@dataclass(frozen=True)
class ResultTable:
    """Named rows of estimates.

    Example:
        >>> table = ResultTable("Errors", ("ATE, m",))
        >>> table.add("VO", [IntervalEstimate(3.0, 2.5, 3.5, 4)])
        >>> print(table.markdown(2).splitlines()[-1])
        | VO | 3.00 [2.50, 3.50] |
    """

    title: str
    """What is shown."""
    columns: tuple[str, ...]
    """Names of the columns after the first."""
    note: str = ""
    """How it was measured."""
    rows: list[tuple[str, tuple[IntervalEstimate | str | None, ...]]] = field(default_factory=list)
    """Name and cells of each row; None where there is nothing to say."""

    def add(self, name: str, cells: Sequence[IntervalEstimate | str | float | None]) -> None:
        """Append a row; plain numbers are estimates without an interval."""
        own = tuple(IntervalEstimate(float(c), None, None, 0) if isinstance(c, int | float) else c for c in cells)
        self.rows.append((name, own))

    def markdown(self, digits: int = 3) -> str:
        """The table in Markdown, under its title, its note below."""
        head = ["", *self.columns]
        lines = [f"## {self.title}", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        lines += ["| " + " | ".join([name, *(_text(cell, digits) for cell in cells)]) + " |" for name, cells in self.rows]
        return "\n".join([*lines, *(["", self.note] if self.note else [])]) + "\n"

    def csv(self) -> str:
        """One line a cell: row, column, value, low, high, count; texts in the place of values."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["row", "column", "value", "low", "high", "count"])
        for name, cells in self.rows:
            for column, cell in zip(self.columns, cells):
                if isinstance(cell, IntervalEstimate):
                    numbers = ("" if v is None else repr(float(v)) for v in (cell.value, cell.low, cell.high))
                    writer.writerow([name, column, *numbers, cell.count])
                elif cell is not None:
                    writer.writerow([name, column, cell, "", "", ""])
        return text.getvalue()

    def write(self, folder: Path, name: str, digits: int = 3) -> None:
        """Write `NAME.md` and `NAME.csv` into a folder."""
        for suffix, text in ((".md", self.markdown(digits)), (".csv", self.csv())):
            with atomic_path(folder / f"{name}{suffix}") as temporary:
                temporary.write_text(text, encoding="utf-8")


def _text(cell: IntervalEstimate | str | None, digits: int) -> str:
    if cell is None or isinstance(cell, str):
        return cell or "-"
    if cell.value is None:
        return "-"
    interval = "" if cell.low is None or cell.high is None else f" [{cell.low:.{digits}f}, {cell.high:.{digits}f}]"
    return f"{cell.value:.{digits}f}{interval}"


def over_seeds(values: Sequence[float] | Float[np.ndarray, " n"], level: float = 0.95) -> IntervalEstimate:
    """Mean over seeds with Student's interval; no interval for a single seed. Seeds without a figure (NaN) are left out.

    Example:
        >>> estimate = over_seeds([1.0, 2.0, 3.0])
        >>> round(estimate.value, 3), round(estimate.low, 3), round(estimate.high, 3), estimate.count
        (2.0, -0.484, 4.484, 3)
    """
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    n = len(known)
    if not n:
        return IntervalEstimate(None, None, None, 0)
    mean = float(known.mean())
    if n == 1:
        return IntervalEstimate(mean, None, None, 1)
    half = float(student.ppf((1 + level) / 2, n - 1) * known.std(ddof=1) / np.sqrt(n))
    return IntervalEstimate(mean, mean - half, mean + half, n)
