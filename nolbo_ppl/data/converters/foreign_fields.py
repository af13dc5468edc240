"""Fields of detections of other people: names, numbers, scores and masks, each refused with its file where it is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nolbo_ppl.errors import InputError, input_error
from nolbo_ppl.geometry.masks import MaskMoments, mask_moments
from nolbo_ppl.io.fields import is_number, number_array


def mask_of(value: Any, what: str, path: Path, line: int | None = None) -> MaskMoments | None:
    """Moments of a mask. Raises `InputError` naming the file, and what it belongs to."""
    if not value:
        return None
    try:
        return mask_moments(value)
    except InputError as error:
        raise input_error(what, got=error, file=path, line=line) from None


def category_name(value: object, names: Sequence[str] | Mapping[int, str], where: dict[str, Any]) -> str:
    """Name of a category given by name or number. Raises `InputError` for a number without a name."""
    if isinstance(value, str):
        return value.strip().replace(" ", "_")
    try:
        if not is_number(value, 0, 1e9) or value != int(value):  # -1 would be the last name, 1.5 the second
            raise ValueError
        return names[int(value)].replace(" ", "_")
    except (KeyError, IndexError, ValueError):
        raise input_error("category without a name", got=value, do="give the names of the categories", **where) from None


def numbers_of(value: Any, count: int, what: str, path: Path) -> list[float]:
    """So many finite numbers: true, false and text are none. Raises `InputError` naming the file."""
    found = number_array(value, (count,), 1e9)
    if found is None:
        raise input_error(what, got=repr(value)[:80], expected=f"{count} numbers", file=path)
    return [float(x) for x in found]


def score_of(value: Any, what: str, path: Path) -> float:
    """A number (its range is checked with all others). Raises `InputError` naming the file."""
    if not is_number(value):
        raise input_error(what, got=repr(value)[:80], expected="a number from 0 to 1", file=path)
    return float(value)
