"""The stages of a run, one method each: keyframes and odometry, observing, EM, map, crops, figures, report."""

from __future__ import annotations

import dataclasses
import logging
import os
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import input_error
from nolbo_ppl.evaluation.map_calibration import map_calibration
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.posterior.multiscale import MultiScalePredictor
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve, solve_incremental
from nolbo_ppl.inference.slam.map_files import library_versions, write_result
from nolbo_ppl.io.files import read_json
from nolbo_ppl.io.noise_file import write_noise
from nolbo_ppl.io.ros_maps import MCAP, write_map_mcap
from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.io.trajectories import Trajectory
from nolbo_ppl.pipeline.map_mesh import build_scene, write_glb
from nolbo_ppl.pipeline.perception import DepthSource, observe_sequence
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.pipeline.run_inputs import RunInputs, depth_of_drive, estimate_or_read, keyframe_rows, open_run_inputs
from nolbo_ppl.pipeline.run_summary import summarise
from nolbo_ppl.pipeline.stage_keys import STAGES, StageName, json_of, stage_settings
from nolbo_ppl.pipeline.stage_store import PipelineStage, run_stages
from nolbo_ppl.pipeline.thumbnails import all_views, write_thumbnails
from nolbo_ppl.renamed_options import stored_names
from nolbo_ppl.viz.map_plots import draw_slam_result

LOG = logging.getLogger(__name__)


class ObjectMappingPipeline:
    """A run under way: what its stages share, each part read when a stage first needs it.

    Args:
        config: options.

    Raises:
        InputError: an input is missing or would be overwritten.
    """

    def __init__(self, config: RunConfig) -> None:
        self.config, self.out, self.run = config, config.out, RunFolder(config.out)
        check_folders(config)
        self.drive: RunInputs = open_run_inputs(config)
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}

    @cached_property
    def model(self) -> ObservationModel:
        """The observation model."""
        return load(self.config.model, self.config.device)

    @cached_property
    def slam_config(self) -> SlamConfig:
        """Settings of the EM, with what the model knows of its own views."""
        config, known = self.config.slam, self.model.calibration
        if config.latent_correlation is None:
            config = dataclasses.replace(config, latent_correlation=known.shape_correlation)
        return config

    def read(self, k: int) -> np.ndarray:
        """Image of a keyframe."""
        return self.drive.frames.frame(int(self.run.keyframes[k]))

    @property
    def problem(self) -> SlamProblem:
        """What SLAM is given."""
        odometry, detections = self.run.odometry, self.run.detections
        assert odometry is not None and detections is not None  # stages before have written them
        return SlamProblem(odometry, detections, odometry_covariance=self.run.odometry_covariance)

    # -- stages -------------------------------------------------------------------------------------------------------

    def odometry(self) -> None:
        """Odometry of the sequence, its keyframes, the camera, true poses."""
        found = estimate_or_read(self.drive, self.config)
        rows = keyframe_rows(found, self.config)
        used = self.drive.used[rows]
        self.run.write_camera(self.drive.camera)
        if self.drive.truth is not None:
            self.run.write_ground_truth(self.drive.truth[used])
        self.run.write_odometry(*found.at(rows))
        self.run.write_frames(
            [
                {"frame": k, "image": placed(self.drive.file(i), self.out), "index": i, "time": self.drive.frames.time(i)}
                for k, i in enumerate(used.tolist())
            ]
        )

    def depth_source(self) -> DepthSource:
        """Depth of the keyframes, where there is any."""
        return depth_of_drive(self.drive, self.config, self.run.keyframes.tolist())

    def observe(self) -> None:
        """The guide on every keyframe."""
        config = self.config
        options: dict[str, Any] = {
            "threshold": config.score_threshold,
            "iou_threshold": config.nms_iou_threshold,
            "decode": False,
            "batch": config.batch,
        }
        if len(config.test_sizes) > 1:
            ask = partial(MultiScalePredictor(self.model, config.test_sizes).observe, **options)
        else:
            ask = partial(self.model.observe, size=config.test_sizes[0], **options)
        names, times = self.run.image_names, [row.get("time") for row in self.run.frames]
        seen = observe_sequence(
            ask, self.read, names, self.drive.intrinsics, self.depth_source(), config.batch, times, config.refines_by_height
        )
        self.run.write_detections(seen)

    def slam(self) -> None:
        """EM: trajectory, landmarks, associations, decoded shapes, where every iteration stood."""
        config, problem = self.config, self.problem
        result: SlamResult = (solve_incremental if config.online else solve)(problem, self.slam_config)
        for text in result.state.noise.warnings:
            LOG.warning("%s", text)
        write_noise(self.run.slam / "noise.npz", result.state.noise)
        truth = self.run.truth_given
        stated = None if truth is None else map_calibration(result, truth)
        write_result(self.run.slam, result, Trajectory(problem.odometry), truth, model=self.model, calibration=stated)
        draw_slam_result(self.run.slam / "map.png", problem.odometry, result, self.run.truth_given)

    def map(self) -> None:
        """Landmarks' shapes in the world as one GLB."""
        run = self.run
        shapes = {name: voxels[0] for name in run.voxel_names if (voxels := run.voxels(name)) is not None}
        write_glb(run.mesh, build_scene(run.landmarks, shapes, run.estimate))
        if self.config.mcap:
            times = [row.get("time") for row in run.frames]
            known = np.array(times, dtype=np.float64) if times and None not in times else None
            write_map_mcap(self.out / MCAP, Trajectory(run.estimate, known), run.landmarks, run.odometry)

    def crops(self) -> None:
        """The best picture of each landmark, and its views."""
        seen, found = self.run.detections, self.run.associations
        assert seen is not None and found is not None
        write_thumbnails(self.run.crops, all_views(seen, found, [landmark.name for landmark in self.run.landmarks]), self.read)

    def figures(self) -> None:
        """summary.json, and whose each observation is where the truth tells."""
        config = self.config
        summary, objects = summarise(
            self.run,
            self.seconds,
            self.cpu_seconds,
            self.problem,
            drive=config.truth_objects,
            model=None if config.truth_objects is None else self.model,
            config=self.slam_config,
            loop_gap=config.min_loop_gap,
            seed=config.seed,
        )
        if objects is not None:
            self.run.write_objects(objects)
        self.run.write_summary(summary | {"remarks": list(self.drive.remarks)})

    def report(self) -> None:
        """report.html."""
        from nolbo_ppl.report import write_report  # only a run with a report needs it

        write_report(self.out)

    def stages(self) -> list[PipelineStage]:
        """All stages in order, each with what it depends on."""
        settings = stage_settings(self.config, self.drive.fingerprint)
        work: dict[StageName, tuple[tuple[str, ...], Callable[[], None]]] = {
            "odometry": (
                ("frames.jsonl", "intrinsics.json", "odometry.txt", "odometry_covariance.npz?", "truth.txt?"),
                self.odometry,
            ),
            "observe": (("observations.jsonl",), self.observe),
            "slam": (("slam",), self.slam),
            "map": (("map.glb", f"{MCAP}?"), self.map),
            "crops": (("crops",), self.crops),
            "figures": (("summary.json", "objects.json?"), self.figures),
            "report": (("report.html",), self.report),
        }
        wanted = STAGES if self.config.report else STAGES[:-1]
        return [PipelineStage(name, work[name][0], settings[name], work[name][1]) for name in wanted]


def run_pipeline(config: RunConfig) -> dict[str, Any]:
    """Run what is not there yet; returns `summary.json`.

    Raises:
        NolboError: an input is missing, malformed, or does not fit the others; complete stages stay.

    Example:
        >>> import nolbo_ppl, pathlib, tempfile
        >>> from PIL import Image
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> (folder / "images").mkdir()
        >>> for frame in range(3):  # a wall
        ...     Image.new("RGB", (96, 64), (120, 130, 140)).save(folder / "images" / f"{frame}.png")
        >>> _ = (folder / "camera.txt").write_text("80 80 48 32")
        >>> _ = (folder / "odometry.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {z}\\n" for z in range(3)))
        >>> config = nolbo_ppl.RunConfig(
        ...     folder / "images", folder / "run", intrinsics=folder / "camera.txt", odometry=folder / "odometry.txt",
        ...     test_sizes=(96,), report=False)
        >>> summary = nolbo_ppl.run(config)
        >>> summary["frames"], summary["observations"], summary["landmarks"]
        (3, 0, 0)
    """
    mission = ObjectMappingPipeline(config)
    run_stages(
        config.out,
        mission.stages(),
        stored_names(config, json_of(config)),
        library_versions(),
        mission.seconds,
        mission.cpu_seconds,
    )
    return read_json(config.out / "summary.json")


def placed(path: Path, folder: Path) -> str:
    """A path as seen from a folder, so that both can be moved together."""
    return Path(os.path.relpath(path, folder)).as_posix()


def check_folders(config: RunConfig) -> None:
    """Refuse an output folder that holds, or is, an input: its files would be replaced.

    Raises:
        InputError: names the input.
    """
    out = config.out.resolve()
    files = {
        "intrinsics": config.intrinsics,
        "odometry": config.odometry,
        "truth": config.truth,
        "step lengths": config.step_lengths,
    }
    inputs = {"images": config.images, "truth-objects": config.truth_objects, "depth": config.depth, "right": config.right}
    inputs |= {name: None if path is None else path.parent for name, path in files.items()}
    for name, folder in inputs.items():
        if folder is not None and folder.resolve() == out:
            raise input_error(
                "results would be written over the input",
                got=f"--out {config.out}",
                expected=f"another folder than that of --{name}",
            )


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
