"""nolbo_ppl: calibrated posteriors over every object of an image, and object SLAM by expectation-maximisation on them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nolbo_ppl.citations import citation as citation
    from nolbo_ppl.inference.observations import Observations as Observations
    from nolbo_ppl.inference.queries import ObservationModel as ObservationModel
    from nolbo_ppl.inference.weights import load as load

__version__ = "0.1.0"

_LAZY = {
    "load": "nolbo_ppl.inference.weights",
    "ObservationModel": "nolbo_ppl.inference.queries",
    "Observations": "nolbo_ppl.inference.observations",
    "citation": "nolbo_ppl.citations",
}
__all__ = ["ObservationModel", "Observations", "__version__", "citation", "load"]


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for, so that `import nolbo_ppl` stays light."""
    if name not in _LAZY:
        raise AttributeError(f"module 'nolbo_ppl' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_LAZY[name]), name)
