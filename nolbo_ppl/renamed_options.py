"""Options under the names they had in 0.1.0: in Python, on the command line and in stored files; they go with 0.3.0."""

from __future__ import annotations

import dataclasses
import functools
import sys
import typing
import warnings
from collections.abc import Callable, Mapping, Sequence
from types import UnionType
from typing import Any, TypeVar

from nolbo_ppl.errors import InputError, input_error

T = TypeVar("T")


def renamed_options(**names: str) -> Callable[[type[T]], type[T]]:
    """Let a dataclass of options take and show old names of its fields (`old="new"`), with a `FutureWarning`.

    Both names at once are an error (`InputError`). `dataclasses.replace` takes old names too: it hands every field over by its
    name, so that a call which names them all and an old one besides is taken for a replacement.

    Example:
        >>> @renamed_options(wheel="step_lengths")
        ... @dataclasses.dataclass(frozen=True)
        ... class Options:
        ...     step_lengths: int = 1
        >>> with warnings.catch_warnings(record=True) as said:
        ...     warnings.simplefilter("always")
        ...     Options(wheel=3).wheel
        3
        >>> str(said[0].message)
        'Options: `wheel` is now `step_lengths`; the old name goes with 0.3.0'
    """

    def of(config: type[T]) -> type[T]:
        made = config.__init__
        options = [option.name for option in dataclasses.fields(config) if option.init]  # type: ignore[arg-type]

        @functools.wraps(made)
        def init(self: Any, *args: Any, **given: Any) -> None:
            replacement = given.keys() >= set(options)
            stated = given.keys() | set(options[: len(args)])
            for old in [name for name in names if name in given]:
                if names[old] in stated and not replacement:
                    raise _twice(config.__name__, old, names[old])
                _warn(config.__name__, old, names[old])
                given[names[old]] = given.pop(old)
            made(self, *args, **given)

        def shown(old: str) -> property:
            def get(self: Any) -> Any:
                _warn(config.__name__, old, names[old])
                return getattr(self, names[old])

            return property(get, doc=f"`{names[old]}` under its name of 0.1.0.")

        config.__init__ = init  # type: ignore[method-assign]
        for old in names:
            setattr(config, old, shown(old))
        setattr(config, _MARK, dict(names))
        return config

    return of


def current_arguments(config: Any, args: Sequence[str] | None, prefix: str = "") -> list[str]:
    """Arguments of a command line with the present names of options, a warning for each that had another.

    Args:
        config: the dataclass of the command.
        args: what was given; None: the command line of the process.
        prefix: of the options of a nested dataclass, `slam.`.

    Raises:
        InputError: an option is given by both of its names.
    """
    found = list(sys.argv[1:] if args is None else args)
    given = {text.partition("=")[0].replace("_", "-") for text in found}
    for old, new in getattr(config, _MARK, {}).items():
        former, current = ([f"{sign}{prefix}{name}".replace("_", "-") for sign in ("--", "--no-")] for name in (old, new))
        if given.intersection(former) and given.intersection(current):
            raise _twice("options", former[0], current[0])
        for i, text in enumerate(found):
            option, equals, value = text.partition("=")
            if option.replace("_", "-") in former:
                name = current[former.index(option.replace("_", "-"))]
                _warn("options", option, name)
                found[i] = name + equals + value
    for name, nested in _nested(config).items():
        found = current_arguments(nested, found, f"{prefix}{name}.")
    return found


def stored_names(config: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a dataclass (as `asdict` gives them) under the names that files of every version have: the old ones."""
    old = {new: name for name, new in getattr(config, _MARK, {}).items()}
    nested = _nested(config if isinstance(config, type) else type(config))
    return {
        old.get(name, name): stored_names(nested[name], value) if name in nested and isinstance(value, Mapping) else value
        for name, value in values.items()
    }


def current_names(config: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a dataclass from a file under their present names: the inverse of `stored_names`, without a warning.

    Raises:
        InputError: a value stands there by both of its names.
    """
    new = getattr(config, _MARK, {})
    both = next((old for old in values if old in new and new[old] in values), None)
    if both is not None:
        raise _twice("stored options", both, new[both])
    nested = _nested(config)
    found = {new.get(name, name): value for name, value in values.items()}
    return {
        name: current_names(nested[name], value) if name in nested and isinstance(value, Mapping) else value
        for name, value in found.items()
    }


_MARK = "__renamed_options__"


def _nested(config: Any) -> dict[str, Any]:
    """Fields of a dataclass that are dataclasses, by name."""
    if not dataclasses.is_dataclass(config):
        return {}
    hints = typing.get_type_hints(config)
    kinds = {f.name: hints[f.name] for f in dataclasses.fields(config)}
    parts = {
        n: [k for k in typing.get_args(kind) if isinstance(k, type)] if isinstance(kind, UnionType) else [kind]
        for n, kind in kinds.items()
    }
    return {name: kind for name, options in parts.items() for kind in options if dataclasses.is_dataclass(kind)}


def _warn(where: str, old: str, new: str) -> None:
    warnings.warn(f"{where}: `{old}` is now `{new}`; the old name goes with 0.3.0", FutureWarning, stacklevel=3)


def _twice(where: str, old: str, new: str) -> InputError:
    return input_error(
        f"{where}: `{old}` and `{new}` are one option",
        expected="one of its two names",
        do=f"give `{new}`; the old name goes with 0.3.0",
    )
