"""nolbo_ppl: calibrated posteriors over every object of an image, and object SLAM by expectation-maximisation on them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nolbo_ppl.citations import citation as citation
    from nolbo_ppl.inference.posterior.model_folder import load as load
    from nolbo_ppl.inference.posterior.predictor import ObservationModel as ObservationModel
    from nolbo_ppl.inference.slam import SlamConfig as SlamConfig
    from nolbo_ppl.inference.slam import SlamProblem as SlamProblem
    from nolbo_ppl.inference.slam import SlamResult as SlamResult
    from nolbo_ppl.inference.slam import solve as solve
    from nolbo_ppl.io.observations import read_observations as read_observations
    from nolbo_ppl.io.observations import write_observations as write_observations
    from nolbo_ppl.io.trajectories import read_trajectory as read_trajectory
    from nolbo_ppl.structures.detections import Detections as Detections
    from nolbo_ppl.structures.landmark import Landmark as Landmark
    from nolbo_ppl.structures.object_posteriors import ObjectPosteriors as ObjectPosteriors

from nolbo_ppl import _moved
from nolbo_ppl._version import __version__

_moved.install()

_LAZY = {
    "load": "nolbo_ppl.inference.posterior.model_folder",
    "ObservationModel": "nolbo_ppl.inference.posterior.predictor",
    "ObjectPosteriors": "nolbo_ppl.structures.object_posteriors",
    "Detections": "nolbo_ppl.structures.detections",
    "read_observations": "nolbo_ppl.io.observations",
    "write_observations": "nolbo_ppl.io.observations",
    "read_trajectory": "nolbo_ppl.io.trajectories",
    "SlamProblem": "nolbo_ppl.inference.slam",
    "SlamConfig": "nolbo_ppl.inference.slam",
    "solve": "nolbo_ppl.inference.slam",
    "SlamResult": "nolbo_ppl.inference.slam",
    "Landmark": "nolbo_ppl.structures.landmark",
    "citation": "nolbo_ppl.citations",
}
__all__ = [
    "Detections",
    "Landmark",
    "ObjectPosteriors",
    "ObservationModel",
    "SlamConfig",
    "SlamProblem",
    "SlamResult",
    "__version__",
    "citation",
    "load",
    "read_observations",
    "read_trajectory",
    "solve",
    "write_observations",
]


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for, so that `import nolbo_ppl` stays light."""
    if name == "Observations":
        return _moved.renamed("nolbo_ppl", {name: "ObjectPosteriors"})(name)
    if name not in _LAZY:
        raise AttributeError(f"module 'nolbo_ppl' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_LAZY[name]), name)
