"""Object SLAM under the name a roboticist types first: those of `nolbo_ppl.inference.slam`, lazily."""

from __future__ import annotations

import importlib
from typing import Any

from nolbo_ppl._moved import moved_names

VERB = ("SlamArguments", "run")
"""Names that this module had in 0.1.0, when it was the command."""


def __getattr__(name: str) -> Any:
    """The name in `nolbo_ppl.inference.slam`."""
    if name in VERB:
        return moved_names(__name__, "nolbo_ppl.cli.slam")(name)
    return getattr(importlib.import_module("nolbo_ppl.inference.slam"), name)


def __dir__() -> list[str]:
    """The public names."""
    return list(importlib.import_module("nolbo_ppl.inference.slam").__all__)


if __name__ == "__main__":
    from nolbo_ppl.cli.slam import main

    main()
