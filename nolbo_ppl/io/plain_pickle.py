"""Pickles of plain values that others distribute, read without running anything in them.

A pickle is a program: Python's own reader runs it, and whoever wrote the file can run what they like. Here the program is only
looked at: numbers, texts, lists, tuples and dictionaries are built, and any other instruction is an error.
"""

from __future__ import annotations

import os
import pickletools
from typing import Any

from nolbo_ppl.errors import InputError, input_error
from nolbo_ppl.io.files import existing_file, reading

LARGEST = 1 << 28
"""Longest file, bytes."""
_VALUES = frozenset(
    [
        "INT",
        "BININT",
        "BININT1",
        "BININT2",
        "LONG",
        "LONG1",
        "LONG4",
        "FLOAT",
        "BINFLOAT",
        "STRING",
        "BINSTRING",
        "SHORT_BINSTRING",
        "UNICODE",
        "BINUNICODE",
        "SHORT_BINUNICODE",
    ]
)
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_PUT = frozenset(("PUT", "BINPUT", "LONG_BINPUT"))
_GET = frozenset(("GET", "BINGET", "LONG_BINGET"))
_EMPTY: dict[str, type] = {"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


class _Mark:
    """Where a group of values begins on the stack."""


def read_plain_pickle(path: str | os.PathLike[str]) -> Any:
    """The value of a pickle that holds numbers, texts, lists, tuples and dictionaries alone.

    Raises:
        InputError: missing, damaged, or with an instruction that makes anything else; names the file.
    """
    path = existing_file(path)
    with reading(path):
        if path.stat().st_size > LARGEST:
            raise input_error("a pickle", got=f"{path.stat().st_size} bytes", expected=f"at most {LARGEST}", file=path)
        data = path.read_bytes()
    stack: list[Any] = []
    memory: dict[Any, Any] = {}

    def taken(count: int) -> list[Any]:
        values = [stack.pop() for _ in range(count)][::-1]
        if any(isinstance(value, _Mark) for value in values):
            raise TypeError("a mark in the place of a value")
        return values

    def group() -> list[Any]:
        at = max(k for k, value in enumerate(stack) if isinstance(value, _Mark))
        values = stack[at + 1 :]
        del stack[at:]
        return values

    try:
        for code, argument, _ in pickletools.genops(data):
            name = code.name
            if name in _VALUES:
                stack.append(argument)
            elif name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            elif name == "MARK":
                stack.append(_Mark())
            elif name in _EMPTY:
                stack.append(_EMPTY[name]())
            elif name in ("LIST", "TUPLE"):
                values = group()
                stack.append(values if name == "LIST" else tuple(values))
            elif name == "DICT":
                values = group()
                stack.append(dict(zip(values[::2], values[1::2], strict=True)))
            elif name in _TUPLES:
                stack.append(tuple(taken(_TUPLES[name])))
            elif name in ("SETITEM", "SETITEMS"):
                values = group() if name == "SETITEMS" else taken(2)
                _of(stack, dict).update(zip(values[::2], values[1::2], strict=True))
            elif name in ("APPEND", "APPENDS"):
                values = group() if name == "APPENDS" else taken(1)
                _of(stack, list).extend(values)
            elif name in _PUT or name == "MEMOIZE":
                (value,) = taken(1)
                memory[argument if name in _PUT else len(memory)] = value
                stack.append(value)
            elif name in _GET:
                stack.append(memory[argument])
            elif name == "STOP":
                (value,) = taken(len(stack))
                return value
            elif name not in ("PROTO", "FRAME"):
                raise input_error(
                    "a pickle of plain values", got=f"the instruction {name}", expected="none but values", file=path
                )
    except InputError:
        raise
    except Exception as error:  # damaged files fail in the parser's own many ways, or take from an empty stack
        raise input_error("a damaged pickle", got=f"{type(error).__name__}: {error}", file=path) from None
    raise input_error("a damaged pickle", got="no end", file=path)


def _of(stack: list[Any], kind: type) -> Any:
    """The value on top, which must be of a kind."""
    if not isinstance(stack[-1], kind):
        raise TypeError(f"{type(stack[-1]).__name__} in the place of a {kind.__name__}")
    return stack[-1]
