"""Values of JSON files, checked where they are read: numbers are numbers, finite, and fit what comes after them."""

from __future__ import annotations

from typing import Any, TypeGuard

import numpy as np
from jaxtyping import Float

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


def number_array(value: Any, shape: tuple[int | None, ...], largest: float = LARGEST) -> Float[np.ndarray, ...] | None:
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


def _is_nested(value: Any, shape: tuple[int | None, ...], largest: float) -> bool:
    if not shape:
        return is_number(value, -largest, largest)
    if not isinstance(value, list) or shape[0] not in (None, len(value)):
        return False
    return all(_is_nested(item, shape[1:], largest) for item in value)
