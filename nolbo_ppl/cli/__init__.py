"""`nolbo VERB ...`: one command, its verbs as modules that are imported only when they are called."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from nolbo_ppl._version import __version__
from nolbo_ppl.errors import NolboError

VERBS = {
    "demo": "a small drive, from its images to a map with a report",
    "scenes": "write a data set of generated scenes",
    "train": "train an observation model",
    "curves": "draw the curves of a training run",
    "evaluate": "measure a model on unseen scenes",
    "observe": "posteriors of the objects in a folder of images",
    "convert": "bring real data into the formats of slam and evaluate",
    "simulate": "write a simulated world for slam: odometry, detections, truth",
    "slam": "correct a trajectory and map objects, from odometry and observations",
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
    """Run a verb; an error of the library ends with its message and exit status 2, without a traceback."""
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
    try:
        importlib.import_module(f"nolbo_ppl.cli.{args[0]}").main(args[1:])
    except NolboError as error:
        print(f"nolbo {args[0]}: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print(f"nolbo {args[0]}: interrupted", file=sys.stderr)
        raise SystemExit(130) from None
