"""Import paths of version 0.1.0: each still imports, warns once, and names the module that took its place.

One table and one finder instead of a hundred modules of two lines; it goes with version 0.3.0.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.abc import InspectLoader, Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from operator import attrgetter
from types import CodeType, ModuleType
from typing import Any

MOVED = {
    "convert": "cli.convert",
    "curves": "cli.curves",
    "data.antialias": "synthetic.renderer.antialias",
    "data.arrays": "structures.label_arrays",
    "data.backdrop": "synthetic.scenes.environment",
    "data.cache": "data.scene_cache",
    "data.cad": "synthetic.assets.cad",
    "data.cad_mesh": "synthetic.assets.cad_mesh",
    "data.cad_sizes": "synthetic.assets.cad_sizes",
    "data.clutter": "synthetic.scenes.distractors",
    "data.compose": "synthetic.scenes.scene_sampler",
    "data.convert": "data.converters",
    "data.convert.common": "data.converters.converted",
    "data.convert.kitti_object": "data.converters.kitti_object",
    "data.convert.kitti_poles": "data.converters.kitti_poles",
    "data.convert.kitti_tracking": "data.converters.kitti_tracking",
    "data.convert.ycbv_slam": "data.converters.ycbv_slam",
    "data.dataset": "synthetic.dataset_writer",
    "data.drive": "synthetic.worlds",
    "data.drive.builder": "synthetic.worlds.world_mesh",
    "data.drive.config": "synthetic.worlds.world_config",
    "data.drive.folder": "synthetic.worlds.sequence_folder",
    "data.drive.frame": "synthetic.worlds.world_frame",
    "data.drive.indoor": "synthetic.worlds.indoor",
    "data.drive.path": "synthetic.worlds.camera_path",
    "data.drive.placing": "synthetic.worlds.placing",
    "data.drive.read": "synthetic.worlds.sequence_reader",
    "data.drive.scenery": "synthetic.worlds.scenery",
    "data.drive.street": "synthetic.worlds.street",
    "data.drive.street_ground": "synthetic.worlds.street_ground",
    "data.drive.views": "synthetic.worlds.world_views",
    "data.drive.world": "synthetic.worlds.world",
    "data.folder": "data.dataset_folder",
    "data.footprint": "synthetic.scenes.footprint",
    "data.frames": "data.sequences",
    "data.frames.intrinsics": "io.camera_files",
    "data.frames.opening": "data.sequences.opening",
    "data.frames.sequence": "data.sequences.image_sequence",
    "data.frames.video": "data.sequences.video",
    "data.instance_views": "evaluation.instance_views",
    "data.materials": "synthetic.renderer.materials",
    "data.observation_table": "structures.detections",
    "data.observations": "io.observations",
    "data.pictures": "synthetic.scenes.background_images",
    "data.pool": "synthetic.assets.shape_library",
    "data.record": "io.scenes",
    "data.render": "synthetic.renderer.ray_casting",
    "data.scene": "synthetic.scenes.render_scene",
    "data.scene_config": "synthetic.scenes.scene_config",
    "data.shading": "synthetic.renderer.shading",
    "data.shapes": "synthetic.shapes",
    "data.shapes.air": "synthetic.shapes.air",
    "data.shapes.air_parts": "synthetic.shapes.air_parts",
    "data.shapes.airliners": "synthetic.shapes.airliners",
    "data.shapes.bicycle": "synthetic.shapes.bicycle",
    "data.shapes.builder": "synthetic.shapes.shape_builder",
    "data.shapes.bus": "synthetic.shapes.bus",
    "data.shapes.families": "synthetic.shapes.families",
    "data.shapes.household": "synthetic.shapes.household",
    "data.shapes.hull": "synthetic.shapes.hull",
    "data.shapes.locomotives": "synthetic.shapes.locomotives",
    "data.shapes.motorbike": "synthetic.shapes.motorbike",
    "data.shapes.polygon": "synthetic.shapes.polygon",
    "data.shapes.primitives": "synthetic.shapes.primitives",
    "data.shapes.rail": "synthetic.shapes.rail",
    "data.shapes.rail_parts": "synthetic.shapes.rail_parts",
    "data.shapes.road": "synthetic.shapes.road",
    "data.shapes.sailing": "synthetic.shapes.sailing",
    "data.shapes.seats": "synthetic.shapes.seats",
    "data.shapes.shape": "synthetic.shapes.canonical_shape",
    "data.shapes.tables": "synthetic.shapes.tables",
    "data.shapes.tubes": "synthetic.shapes.tubes",
    "data.shapes.water": "synthetic.shapes.water",
    "data.shapes.working_boats": "synthetic.shapes.working_boats",
    "data.source": "synthetic.scenes.scene_generator",
    "data.supply": "training.scene_loader",
    "data.textures": "synthetic.renderer.textures",
    "data.training": "training.stage_data",
    "data.trajectories": "io.trajectories",
    "data.truth": "evaluation.labelled_scenes",
    "data.view": "synthetic.renderer.camera_view",
    "data.workers": "parallel",
    "demo": "cli.demo",
    "drive": "cli.drive",
    "evaluate": "cli.evaluate",
    "inference.answers": "inference.posterior.decode",
    "inference.calibrate": "training.calibrate",
    "inference.checkpoint": "io.tensors",
    "inference.growth": "training.net2net",
    "inference.journal": "training.training_log",
    "inference.measure": "evaluation.measure",
    "inference.monitor": "training.validation",
    "inference.observations": "structures.object_posteriors",
    "inference.optimisation": "inference.svi",
    "inference.prepare": "inference.posterior.preprocess",
    "inference.pyramid": "inference.posterior.multiscale",
    "inference.queries": "inference.posterior.predictor",
    "inference.shape_answers": "inference.posterior.decoded_shapes",
    "inference.slam.calibration": "inference.slam.noise.residual_calibration",
    "inference.slam.config": "inference.slam.slam_problem",
    "inference.slam.constellation": "inference.slam.consistent_cliques",
    "inference.slam.drift": "inference.slam.incremental.drift_graph",
    "inference.slam.evidence": "inference.slam.loop_candidates",
    "inference.slam.export": "inference.slam.map_files",
    "inference.slam.features": "inference.slam.detection_features",
    "inference.slam.finish": "inference.slam.map_refinement",
    "inference.slam.observe": "inference.slam.data_association",
    "inference.slam.odometry": "inference.slam.noise.odometry_noise",
    "inference.slam.online": "inference.slam.incremental.incremental_slam",
    "inference.slam.online_graph": "inference.slam.incremental.incremental_graph",
    "inference.slam.online_loops": "inference.slam.incremental.incremental_loops",
    "inference.slam.oracle": "inference.slam.ground_truth_association",
    "inference.slam.plain": "inference.slam.reference_em",
    "inference.slam.result": "inference.slam.slam_result",
    "inference.slam.shapes": "inference.slam.landmark_shapes",
    "inference.slam.state": "inference.slam.initialise",
    "inference.slam.state_types": "inference.slam.slam_state",
    "inference.slam.tracklets": "inference.slam.tracking",
    "inference.stages": "training.stages",
    "inference.train_config": "training.train_config",
    "inference.visual_odometry": "odometry",
    "inference.visual_odometry.compose": "odometry.step_composition",
    "inference.visual_odometry.config": "odometry.odometry_config",
    "inference.visual_odometry.epipolar": "odometry.epipolar",
    "inference.visual_odometry.features": "odometry.keypoints",
    "inference.visual_odometry.ground": "odometry.ground_scale",
    "inference.visual_odometry.odometry": "odometry.visual_odometry",
    "inference.visual_odometry.rotation": "odometry.pure_rotation",
    "inference.weights": "inference.posterior.model_folder",
    "metrics.figures": "evaluation.scores",
    "metrics.records": "evaluation.records",
    "metrics.retrieval": "evaluation.retrieval",
    "metrics.viewpoint": "metrics.viewpoint_error",
    "mission": "pipeline",
    "mission.config": "pipeline.run_config",
    "mission.crops": "pipeline.thumbnails",
    "mission.demo": "pipeline.demo_run",
    "mission.depth": "pipeline.depth_refinement",
    "mission.figures": "evaluation.sequence_scores",
    "mission.noise": "io.noise_file",
    "mission.observe": "pipeline.perception",
    "mission.pipeline": "pipeline.mapping_pipeline",
    "mission.scene": "pipeline.map_mesh",
    "mission.sequence": "pipeline.run_inputs",
    "mission.stages": "pipeline.stage_store",
    "mission.summary": "pipeline.run_summary",
    "mission.truth": "evaluation.sequence_truth",
    "models.calibration": "models.posterior_calibration",
    "models.config": "models.model_config",
    "models.glimpse": "models.roi_refinement",
    "models.nolbo": "models.observation_model",
    "models.scene": "models.scene_batch",
    "models.shape": "models.shape_networks",
    "models.story": "models.generative",
    "observe": "cli.observe",
    "run": "cli.run",
    "scenes": "cli.scenes",
    "view": "cli.view",
    "viz.detections": "viz.detection_plots",
    "viz.evaluation": "viz.evaluation_plots",
    "viz.examples": "viz.example_plots",
    "viz.observations": "viz.posterior_plots",
    "viz.report": "report",
    "viz.report.em": "report.em_section",
    "viz.report.folder": "io.run_folder",
    "viz.report.gallery": "report.gallery",
    "viz.report.headline": "report.headline",
    "viz.report.heatmap": "report.weight_heatmap",
    "viz.report.landmarks": "io.landmarks",
    "viz.report.loops": "report.loop_section",
    "viz.report.page": "report.page",
    "viz.report.plots": "report.report_plots",
    "viz.report.sections": "report.sections",
    "viz.report.shapes": "report.shape_thumbnails",
    "viz.report.svg": "report.svg",
    "viz.report.text": "report.wording",
    "viz.report.viewer": "report.viewer",
    "viz.report.viewer_objects": "report.viewer_objects",
    "viz.shape": "viz.shape_plots",
    "viz.slam": "viz.map_plots",
    "viz.training": "viz.training_plots",
}
"""Old name to new name of modules, both without the package's own name."""

RENAMED: dict[str, dict[str, str]] = {
    "": {"Observations": "ObjectPosteriors"},
    "cli.slam": {"SlamArguments": "SlamRunConfig"},
    "data.simulate": {"simulate_drive": "simulate_sequence"},
    "evaluation.scores": {"figures": "score_intervals", "summary": "point_scores"},
    "inference.elbo": {"SceneElbo": "SceneELBO"},
    "inference.posterior.decoded_shapes": {"ShapeAnswer": "DecodedShape"},
    "inference.posterior.preprocess": {
        "Prepared": "PreprocessedImage",
        "prepare": "preprocess",
        "prepare_all": "preprocess_all",
    },
    "inference.slam": {
        "Links": "LandmarkEqualities",
        "ObjectSlam": "IncrementalSlam",
        "OnlineInfo": "IncrementalInfo",
        "PlainInfo": "ReferenceEmInfo",
        "PlainState": "ReferenceEmState",
        "StepInfo": "EmStepInfo",
        "plain_init": "em_init",
        "plain_solve": "em_solve",
        "plain_step": "em_step",
        "solve_online": "solve_incremental",
    },
    "inference.slam.graph": {
        "LOOSE_ROTATION": "UNINFORMATIVE_ROTATION_SIGMA",
        "Links": "LandmarkEqualities",
        "add_links": "add_landmark_equalities",
        "optimise": "optimize",
        "widened": "inflated",
    },
    "inference.slam.incremental.incremental_slam": {
        "ObjectSlam": "IncrementalSlam",
        "OnlineInfo": "IncrementalInfo",
        "solve_online": "solve_incremental",
    },
    "inference.slam.reference_em": {
        "PlainInfo": "ReferenceEmInfo",
        "PlainState": "ReferenceEmState",
        "plain_init": "em_init",
        "plain_solve": "em_solve",
        "plain_step": "em_step",
    },
    "inference.svi": {"OptimisationConfig": "OptimizerConfig", "OptimisationState": "OptimizerState"},
    "io.observations": {
        "ObservationTable": "Detections",
        "concatenate": "Detections.concatenate",
        "make_table": "Detections.from_arrays",
        "observation_row": "to_record",
    },
    "models.generative": {"Story": "GenerativeModel"},
    "models.roi_refinement": {"Glimpse": "RoiRefinement"},
    "models.shape_vae": {"ShapeStory": "ShapeGenerativeModel"},
    "pipeline.mapping_pipeline": {"run_mission": "run_pipeline"},
    "pipeline.run_inputs": {"open_drive": "open_run_inputs", "wheel_lengths": "read_step_lengths"},
    "structures.detections": {
        "ObservationTable": "Detections",
        "concatenate": "Detections.concatenate",
        "make_table": "Detections.from_arrays",
    },
    "structures.object_posteriors": {"Observations": "ObjectPosteriors"},
    "synthetic.assets.shape_library": {"ShapePool": "ShapeLibrary"},
    "synthetic.renderer.camera_view": {"Backdrop": "Environment"},
    "synthetic.scenes.background_images": {"Photographs": "BackgroundImages"},
    "synthetic.scenes.environment": {"sample_backdrop": "sample_environment"},
    "synthetic.scenes.scene_generator": {"SceneSource": "SceneGenerator"},
    "synthetic.worlds": {
        "DriveConfig": "SequenceConfig",
        "DriveObject": "SequenceObject",
        "DriveSummary": "SequenceSummary",
        "drive_preset": "sequence_preset",
        "read_drive": "read_sequence_folder",
        "write_drive": "write_sequence_folder",
    },
    "training.scene_loader": {"SceneSupply": "SceneLoader"},
    "training.training_log": {"Journal": "TrainingLogger"},
    "training.validation": {"held_out": "validate"},
}
"""Classes and functions by module: old name to new name, of the module or of a class in it."""


class _MovedLoader(Loader):
    """Loads the module of the new name under the old one."""

    def __init__(self, new: str) -> None:
        self.new = new

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module of the new name itself: its classes are the same objects under both names."""
        module = importlib.import_module(self.new)
        self.spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Give the module its own specification back; it ran when it was imported by its own name."""
        module.__spec__ = self.spec

    def get_code(self, fullname: str) -> CodeType | None:
        """The code of the new module, for `python -m`."""
        loader = getattr(importlib.util.find_spec(self.new), "loader", None)
        return loader.get_code(self.new) if isinstance(loader, InspectLoader) else None


class _MovedFinder(MetaPathFinder):
    """Finds modules by the names that they had in version 0.1.0."""

    def find_spec(self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """A specification that loads the new module, with a `FutureWarning`; None for names that did not move."""
        package, _, name = fullname.partition(".")
        if package != "nolbo_ppl" or name not in MOVED:
            return None
        new = f"nolbo_ppl.{MOVED[name]}"
        warnings.warn(f"{fullname} moved to {new}; the old name goes with nolbo_ppl 0.3.0", FutureWarning, stacklevel=2)
        return ModuleSpec(fullname, _MovedLoader(new), is_package=any(old.startswith(name + ".") for old in MOVED))


def install() -> None:
    """Let the old names be found; a second call changes nothing.

    First in the row: `nolbo_ppl.viz.report.page` would else be found in the folder of `nolbo_ppl.report`, a second module.
    """
    if not any(isinstance(finder, _MovedFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _MovedFinder())


def moved_names(package: str, module: str) -> Callable[[str], Any]:
    """`__getattr__` of a package that was a module in 0.1.0: its names are found in `module`, with a warning."""

    def get(name: str) -> Any:
        """The name in its new module."""
        if name.startswith("__"):
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        try:
            value = getattr(importlib.import_module(module), name)
        except AttributeError:
            raise AttributeError(f"module {package!r} has no attribute {name!r}") from None
        warnings.warn(f"{package}.{name} moved to {module}; the old name goes with 0.3.0", FutureWarning, stacklevel=2)
        return value

    return get


def renamed(module: str) -> Callable[[str], Any]:
    """`__getattr__` of a module whose names were others in 0.1.0 (`RENAMED`): those still work, with a warning."""
    names = RENAMED[module.removeprefix("nolbo_ppl").removeprefix(".")]

    def get(name: str) -> Any:
        """What the old name stands for."""
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warnings.warn(f"{module}.{name} is now {names[name]}; the old name goes with 0.3.0", FutureWarning, stacklevel=2)
        return attrgetter(names[name])(importlib.import_module(module))

    return get
