"""Progress bars: quiet in a library, shown on a terminal by whoever asks for them (the commands do)."""

from __future__ import annotations

from collections.abc import Iterable
from contextvars import ContextVar
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from tqdm import tqdm

_SHOWN: ContextVar[bool] = ContextVar("nolbo_ppl_progress", default=False)
Item = TypeVar("Item")


def show_progress(shown: bool = True) -> None:
    """Show progress bars from now on, in this context, where the error stream is a terminal; or hide them again.

    Example:
        >>> show_progress()  # a notebook, a script of one's own
        >>> list(progress_bar(range(3), "counting", "number"))  # no terminal: nothing is drawn
        [0, 1, 2]
        >>> show_progress(False)
    """
    _SHOWN.set(shown)


def progress_bar(
    items: Iterable[Item] | None,
    name: str,
    unit: str,
    *,
    total: int | None = None,
    done: int = 0,
    shown: bool = True,
    leave: bool = True,
) -> tqdm[Item]:
    """A bar over some items, or one that is moved by `update`.

    Args:
        items: what is iterated over; None for a bar that is moved by hand.
        name: what is being done.
        unit: what is counted.
        total: how many there are, where `items` has no length.
        done: how many were done before.
        shown: False for a bar of no interest here, such as that of a second process.
        leave: leave the full bar on the terminal.
    """
    from tqdm import tqdm

    hidden = None if _SHOWN.get() and shown else True  # None: hidden where there is no terminal
    return tqdm(items, total=total, initial=done, desc=name, unit=unit, disable=hidden, leave=leave)
