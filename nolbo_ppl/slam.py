"""Object SLAM under the name a roboticist types first: those of `nolbo_ppl.inference.slam`, lazily."""

from __future__ import annotations

import importlib
from typing import Any


def __getattr__(name: str) -> Any:
    """The name in `nolbo_ppl.inference.slam`."""
    return getattr(importlib.import_module("nolbo_ppl.inference.slam"), name)


def __dir__() -> list[str]:
    """The public names."""
    return list(importlib.import_module("nolbo_ppl.inference.slam").__all__)


if __name__ == "__main__":
    from nolbo_ppl.cli.slam import main

    main()
