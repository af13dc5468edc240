"""nolbo_ppl: calibrated posteriors over every object of an image, and object SLAM by expectation-maximisation on them.

The names below are the public interface: they stay, and change with a warning. Every other module may change.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nolbo_ppl.citations import citation as citation
    from nolbo_ppl.cli.evaluate import EvaluateConfig as EvaluateConfig
    from nolbo_ppl.cli.evaluate import run as evaluate
    from nolbo_ppl.errors import InputError as InputError
    from nolbo_ppl.errors import NolboError as NolboError
    from nolbo_ppl.inference.association.marginals import association_marginals as association_marginals
    from nolbo_ppl.inference.elbo import SceneELBO as SceneELBO
    from nolbo_ppl.inference.posterior.model_folder import load as load
    from nolbo_ppl.inference.posterior.predictor import ObservationModel as ObservationModel
    from nolbo_ppl.inference.slam.incremental.incremental_slam import IncrementalSlam as IncrementalSlam
    from nolbo_ppl.inference.slam.slam_problem import SlamConfig as SlamConfig
    from nolbo_ppl.inference.slam.slam_problem import SlamProblem as SlamProblem
    from nolbo_ppl.inference.slam.slam_result import SlamResult as SlamResult
    from nolbo_ppl.inference.slam.solve import solve as solve
    from nolbo_ppl.io.observations import read_observations as read_observations
    from nolbo_ppl.io.observations import write_observations as write_observations
    from nolbo_ppl.io.trajectories import read_trajectory as read_trajectory
    from nolbo_ppl.models.generative import GenerativeModel as GenerativeModel
    from nolbo_ppl.models.guide import Guide as Guide
    from nolbo_ppl.models.scene_batch import SceneBatch as SceneBatch
    from nolbo_ppl.odometry.visual_odometry import estimate_odometry as estimate_odometry
    from nolbo_ppl.pipeline.mapping_pipeline import run_pipeline as run
    from nolbo_ppl.pipeline.run_config import RunConfig as RunConfig
    from nolbo_ppl.structures.annotations import Annotations as Annotations
    from nolbo_ppl.structures.detections import Detections as Detections
    from nolbo_ppl.structures.landmark import Landmark as Landmark
    from nolbo_ppl.structures.object_posteriors import ObjectPosteriors as ObjectPosteriors
    from nolbo_ppl.training.train_config import TrainConfig as TrainConfig
    from nolbo_ppl.training.trainer import run as train

from nolbo_ppl import _moved
from nolbo_ppl._version import __version__

_moved.install()

PUBLIC: dict[str, str] = {
    # from images to posteriors
    "load": "inference.posterior.model_folder:load",
    "ObservationModel": "inference.posterior.predictor:ObservationModel",
    "ObjectPosteriors": "structures.object_posteriors:ObjectPosteriors",
    # detections, trajectories
    "Detections": "structures.detections:Detections",
    "read_observations": "io.observations:read_observations",
    "write_observations": "io.observations:write_observations",
    "read_trajectory": "io.trajectories:read_trajectory",
    "estimate_odometry": "odometry.visual_odometry:estimate_odometry",
    # from detections to a map
    "SlamProblem": "inference.slam.slam_problem:SlamProblem",
    "SlamConfig": "inference.slam.slam_problem:SlamConfig",
    "solve": "inference.slam.solve:solve",
    "IncrementalSlam": "inference.slam.incremental.incremental_slam:IncrementalSlam",
    "SlamResult": "inference.slam.slam_result:SlamResult",
    "Landmark": "structures.landmark:Landmark",
    "association_marginals": "inference.association.marginals:association_marginals",
    # the model, its guide and the bound
    "Annotations": "structures.annotations:Annotations",
    "SceneBatch": "models.scene_batch:SceneBatch",
    "GenerativeModel": "models.generative:GenerativeModel",
    "Guide": "models.guide:Guide",
    "SceneELBO": "inference.elbo:SceneELBO",
    # the whole way
    "train": "train:",
    "TrainConfig": "training.train_config:TrainConfig",
    "evaluate": "cli.evaluate:run",
    "EvaluateConfig": "cli.evaluate:EvaluateConfig",
    "run": "pipeline.mapping_pipeline:run_pipeline",
    "RunConfig": "pipeline.run_config:RunConfig",
    # errors, references
    "NolboError": "errors:NolboError",
    "InputError": "errors:InputError",
    "citation": "citations:citation",
}
"""The public names: module and name within it (none: the module itself, which can be called)."""
__all__ = [
    "Annotations",
    "Detections",
    "EvaluateConfig",
    "GenerativeModel",
    "Guide",
    "IncrementalSlam",
    "InputError",
    "Landmark",
    "NolboError",
    "ObjectPosteriors",
    "ObservationModel",
    "RunConfig",
    "SceneBatch",
    "SceneELBO",
    "SlamConfig",
    "SlamProblem",
    "SlamResult",
    "TrainConfig",
    "__version__",
    "association_marginals",
    "citation",
    "estimate_odometry",
    "evaluate",
    "load",
    "read_observations",
    "read_trajectory",
    "run",
    "solve",
    "train",
    "write_observations",
]


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for, so that `import nolbo_ppl` stays light."""
    if name in _moved.RENAMED[""]:
        return _moved.renamed(__name__)(name)
    if name not in PUBLIC:
        raise AttributeError(f"module 'nolbo_ppl' has no attribute {name!r}")
    import importlib

    module, _, attribute = PUBLIC[name].partition(":")
    found = importlib.import_module(f"nolbo_ppl.{module}")
    return getattr(found, attribute) if attribute else found


def __dir__() -> list[str]:
    """The public names."""
    return list(__all__)


class _Package(ModuleType):
    """The package: a module that is imported by a path of 0.1.0 (`nolbo_ppl.evaluate`) does not hide the public name."""

    def __setattr__(self, name: str, value: Any) -> None:
        """Bind a name, as importing a submodule does, unless a public function or class has it."""
        if not (isinstance(value, ModuleType) and PUBLIC.get(name, ":").partition(":")[2]):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
