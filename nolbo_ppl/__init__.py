"""nolbo_ppl: calibrated posteriors over every object of an image, and object SLAM by expectation-maximisation on them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nolbo_ppl.citations import citation as citation
    from nolbo_ppl.inference.posterior.model_folder import load as load
    from nolbo_ppl.inference.posterior.predictor import ObservationModel as ObservationModel
    from nolbo_ppl.structures.object_posteriors import ObjectPosteriors as ObjectPosteriors

from nolbo_ppl import _moved
from nolbo_ppl._version import __version__

_moved.install()

_LAZY = {
    "load": "nolbo_ppl.inference.posterior.model_folder",
    "ObservationModel": "nolbo_ppl.inference.posterior.predictor",
    "ObjectPosteriors": "nolbo_ppl.structures.object_posteriors",
    "citation": "nolbo_ppl.citations",
}
__all__ = ["ObservationModel", "ObjectPosteriors", "__version__", "citation", "load"]


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for, so that `import nolbo_ppl` stays light."""
    if name == "Observations":
        return _moved.renamed("nolbo_ppl", {name: "ObjectPosteriors"})(name)
    if name not in _LAZY:
        raise AttributeError(f"module 'nolbo_ppl' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_LAZY[name]), name)
