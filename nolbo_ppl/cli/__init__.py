"""`nolbo VERB ...`: one command, its verbs as modules that are imported only when they are called."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import copy_context
from itertools import pairwise

from nolbo_ppl._version import __version__
from nolbo_ppl.errors import NolboError
from nolbo_ppl.progress import show_progress

VERBS = {
    "demo": "a small drive, from its images to a map with a report",
    "scenes": "write a data set of generated scenes",
    "train": "train an observation model",
    "curves": "draw the curves of a training run",
    "evaluate": "measure a model on unseen scenes",
    "reproduce": "the paper's tables and figures",
    "observe": "posteriors of the objects in a folder of images",
    "export": "guide and decoder as ONNX files, for programs without torch",
    "data": "what a file or folder is, what it holds, what is wrong with it",
    "convert": "bring real data into the formats of slam and evaluate",
    "simulate": "write a simulated world for slam: odometry, detections, truth",
    "slam": "correct a trajectory and map objects, from odometry and observations",
    "merge": "join the maps of several drives, where they share a place",
    "drive": "write a drive through a generated world: images, poses, objects",
    "odometry": "visual odometry of an image sequence",
    "run": "from the images of a drive to a corrected trajectory and a map of objects",
    "report": "one self-contained page about a run",
    "view": "a run in 3D, in the browser",
}
"""Name of each verb (its module in this package) and what it does."""


def usage() -> str:
    """The help text."""
    width = max(map(len, VERBS))
    lines = [f"  {name:<{width}}  {text}" for name, text in VERBS.items()]
    hint = "nolbo VERB --help tells the options; nolbo --version the version."
    return "\n".join(["usage: nolbo VERB [options]", "", *lines, "", hint])


def main(args: Sequence[str] | None = None) -> None:
    """Run a verb; an error of the library or of the system ends with its message and status 2, without a traceback.

    Ctrl-C ends with status 130, SIGTERM with 143, after temporary files and locks are gone.
    """
    args = list(sys.argv[1:] if args is None else args)
    if not args or args[0] in ("-h", "--help"):
        print(usage())
        return
    if args[0] == "--version":
        print(__version__)
        return
    if args[0] not in VERBS:
        print(f"nolbo: unknown verb {args[0]!r}\n\n{usage()}", file=sys.stderr)
        raise SystemExit(2)
    if _empty_output(args):
        raise _end(args[0], "--out is empty; name a folder (. for the current one)", 2)
    shown = copy_context()
    shown.run(show_progress)
    with _signals():
        try:
            shown.run(importlib.import_module(f"nolbo_ppl.cli.{args[0]}").main, args[1:])
            sys.stdout.flush()
        except NolboError as error:
            raise _end(args[0], str(error), 2) from None
        except BrokenPipeError:  # who reads the output has heard enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            raise SystemExit(128 + signal.SIGPIPE) from None
        except OSError as error:
            raise _end(args[0], system_message(error), 2) from None
        except MemoryError:
            raise _end(args[0], "needs more memory than there is", 2) from None
        except KeyboardInterrupt:
            raise _end(args[0], "interrupted", 128 + signal.SIGINT) from None
        except Stopped as stop:
            raise _end(args[0], f"stopped by signal {stop}", 128 + stop.number) from None


def _empty_output(args: Sequence[str]) -> bool:
    """Whether `--out` names nothing, as an unset variable of a script does: it would be the current folder."""
    return "--out=" in args or any(name == "--out" and not value.strip() for name, value in pairwise(args))


def system_message(error: OSError) -> str:
    """What the system says about a file: its name and why."""
    reason = error.strerror or str(error) or type(error).__name__
    names = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes | os.PathLike)]
    return ": ".join([" -> ".join(dict.fromkeys(names)), reason] if names else [reason])


def _end(verb: str, message: str, status: int) -> SystemExit:
    print(f"nolbo {verb}: {message}", file=sys.stderr)
    return SystemExit(status)


class Stopped(BaseException):
    """The process was asked to end: what is under way is cleaned up as on Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextmanager
def _signals() -> Iterator[None]:
    """Turn SIGTERM and SIGHUP into an exception, so that temporary files and locks go; only the main thread may."""

    def stop(number: int, _: object) -> None:
        raise Stopped(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ends = [number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) == signal.SIG_DFL]  # not nohup
    before = {number: signal.signal(number, stop) for number in ends}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
