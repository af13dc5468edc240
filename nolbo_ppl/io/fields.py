"""Values of JSON files, checked where they are read: numbers are numbers, finite, and fit what comes after them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import UnionType
from typing import Any, Literal, TypeGuard, Union, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error

LARGEST = 1e30
"""Largest number taken from a file: its unit squared still fits 64 bits, itself 32 bits."""


def is_number(value: object, low: float = -LARGEST, high: float = LARGEST) -> TypeGuard[int | float]:
    """Whether a value is a finite number from `low` to `high`; true, false and text are none.

    Example:
        >>> is_number(3), is_number(True), is_number("3"), is_number(10**400), is_number(1e300)
        (True, False, False, False, False)
    """
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def is_whole(value: object, low: int = 0, high: int = 2**31 - 1) -> TypeGuard[int]:
    """Whether a value is a whole number from `low` to `high`; true and 3.0 are none."""
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def number_array(value: Any, shape: tuple[int | None, ...], largest: float = LARGEST) -> Float[np.ndarray, " ..."] | None:
    """Nested lists of finite numbers as a float64 array; None where they are anything else.

    `numpy.asarray` alone takes true for 1 and "2" for 2.

    Args:
        value: what the file holds.
        shape: length of each level; None for any length.
        largest: greatest absolute value.

    Example:
        >>> number_array([[1, 2.5]], (None, 2)).tolist()
        [[1.0, 2.5]]
        >>> number_array([True, 1], (2,)), number_array(["1", "2"], (2,)), number_array([1, [2]], (2,))
        (None, None, None)
    """
    if not _is_nested(value, shape, largest):
        return None
    array = np.array(value, dtype=np.float64)
    return array if array.ndim == len(shape) else None


def check_fields(cls: type, values: Mapping[str, Any], what: str, most: int, most_of: Mapping[str, int]) -> dict[str, Any]:
    """Values of a JSON object for a dataclass of flat fields; lists become tuples.

    Args:
        cls: the dataclass; its fields are bool, int, float, str, `Literal`, or tuples of one of them.
        values: what the file holds.
        what: what it is, for the messages.
        most: greatest whole number of any field, and longest list; numbers are 1e6 at most.
        most_of: greatest whole number by field, where it is another.

    Raises:
        InputError: an unknown field, or a value of another type or out of range; names the field.
    """
    hints = get_type_hints(cls)
    names = [field.name for field in dataclasses.fields(cls)]
    unknown = sorted(set(values) - set(names))
    if unknown:
        raise input_error(f"unknown fields of {what}", got=unknown, expected=f"some of {names}")
    found = {}
    for name, value in values.items():
        if not _fits(value, hints[name], most_of.get(name, most)):
            kind = hints[name].__name__ if isinstance(hints[name], type) else str(hints[name]).removeprefix("typing.")
            raise input_error(f"{what}: {name}", got=repr(value), expected=f"{kind}, at most {most_of.get(name, most)}")
        found[name] = tuple(value) if isinstance(value, list) else value
    return found


def _fits(value: Any, hint: Any, most: int) -> bool:
    if get_origin(hint) is tuple:
        inner = get_args(hint)
        if not isinstance(value, list | tuple) or len(value) > 100_000:
            return False
        inner = inner[:1] * len(value) if inner[1:] == (...,) else inner
        return len(inner) == len(value) and all(_fits(item, kind, most) for item, kind in zip(value, inner))
    if get_origin(hint) is Literal:
        return any(value == choice and type(value) is type(choice) for choice in get_args(hint))
    if hint is bool or hint is str:
        return isinstance(value, hint)
    if get_origin(hint) in (Union, UnionType):
        return any(_fits(value, kind, most) for kind in get_args(hint))
    if hint is type(None):
        return value is None
    return is_whole(value, 0, most) if hint is int else is_number(value, -1e6, 1e6)


def _is_nested(value: Any, shape: tuple[int | None, ...], largest: float) -> bool:
    if not shape:
        return is_number(value, -largest, largest)
    if not isinstance(value, list) or shape[0] not in (None, len(value)):
        return False
    return all(_is_nested(item, shape[1:], largest) for item in value)
