"""The stages of a run, one method each: keyframes and odometry, observing, EM, map, crops, figures, report."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from functools import cached_property, partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.data.sequences import open_frames, write_camera
from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.posterior.multiscale import MultiScalePredictor
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve, solve_online
from nolbo_ppl.inference.slam.map_files import library_versions, write_result
from nolbo_ppl.io.files import read_json, read_jsonl, write_json, write_jsonl
from nolbo_ppl.io.npz import Npz, save_npz
from nolbo_ppl.io.observations import read_observations
from nolbo_ppl.io.trajectories import Trajectory, covariance_beside, read_trajectory, write_trajectory
from nolbo_ppl.pipeline.depth_refinement import DepthScale
from nolbo_ppl.pipeline.map_mesh import build_scene, write_glb
from nolbo_ppl.pipeline.noise_file import write_noise
from nolbo_ppl.pipeline.perception import (
    DepthPictures,
    DepthSource,
    SequenceDepth,
    StereoPairs,
    beside,
    observed_rows,
)
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.pipeline.run_inputs import RunInputs, estimate_or_read, keyframe_rows, open_drive
from nolbo_ppl.pipeline.run_summary import summarise
from nolbo_ppl.pipeline.stage_store import PipelineStage, run_stages
from nolbo_ppl.pipeline.thumbnails import best_views, write_crops
from nolbo_ppl.viz.map_plots import draw_slam_result


class ObjectMappingPipeline:
    """A run under way: what its stages share, each part read when a stage first needs it.

    Args:
        config: options.

    Raises:
        InputError: an input is missing or would be overwritten.
    """

    def __init__(self, config: RunConfig) -> None:
        self.config, self.out = config, config.out
        check_folders(config)
        self.drive: RunInputs = open_drive(config)
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}

    @cached_property
    def model(self) -> ObservationModel:
        """The observation model."""
        return load(self.config.model)

    @cached_property
    def slam_config(self) -> SlamConfig:
        """Settings of the EM, with what the model knows of its own views."""
        if self.config.slam.latent_correlation is not None:
            return self.config.slam
        return dataclasses.replace(self.config.slam, latent_correlation=self.model.calibration.shape_correlation)

    @cached_property
    def keyframes(self) -> np.ndarray:
        """Index in the sequence of every keyframe."""
        return np.array([row["index"] for _, row in read_jsonl(self.out / "frames.jsonl")], dtype=np.int64)

    @property
    def names(self) -> tuple[str, ...]:
        """Image of every keyframe, as `frames.jsonl` has it."""
        return tuple(row["image"] for _, row in read_jsonl(self.out / "frames.jsonl"))

    def read(self, k: int) -> np.ndarray:
        """Image of a keyframe."""
        return self.drive.frames.frame(int(self.keyframes[k]))

    @property
    def problem(self) -> SlamProblem:
        """What SLAM is given."""
        odometry = read_trajectory(self.out / "odometry.txt").T_world_camera
        table = read_observations(self.out / "observations.jsonl", frames=len(odometry))
        return SlamProblem(odometry, table, odometry_covariance=covariance_beside(self.out / "odometry.txt"))

    @property
    def truth(self) -> np.ndarray | None:
        """True poses of the keyframes."""
        path = self.out / "truth.txt"
        return read_trajectory(path, lost=True).T_world_camera if path.is_file() else None

    # -- stages -------------------------------------------------------------------------------------------------------

    def odometry(self) -> None:
        """Odometry of the sequence, its keyframes, the camera, true poses."""
        found = estimate_or_read(self.drive, self.config)
        rows = keyframe_rows(found, self.config)
        used = self.drive.used[rows]
        write_camera(self.out / "intrinsics.json", self.drive.camera)
        T, covariance = found.at(rows)
        if covariance is not None:
            save_npz(self.out / "odometry_covariance.npz", {"covariance": covariance})
        if self.drive.truth is not None:
            write_trajectory(self.out / "truth.txt", Trajectory(self.drive.truth[used]))
        write_trajectory(self.out / "odometry.txt", Trajectory(T))
        write_jsonl(
            self.out / "frames.jsonl",
            (
                {"frame": k, "image": placed(self.drive.file(i), self.out), "index": i, "time": self.drive.frames.time(i)}
                for k, i in enumerate(used.tolist())
            ),
        )

    def depth_source(self) -> DepthSource:
        """Depth of the keyframes, where there is any."""
        config = self.config
        if config.depth is not None:
            return DepthPictures(beside(config.depth, self.names, self.keyframes.tolist()), DepthScale(config.depth_unit))
        if config.right is not None and config.baseline is not None:
            right = open_frames(config.right)
            return StereoPairs(lambda k: right.frame(int(self.keyframes[k])), float(self.drive.intrinsics[0]), config.baseline)
        return SequenceDepth(self.drive.frames, self.keyframes.tolist())

    def observe(self) -> None:
        """The guide on every keyframe."""
        config = self.config
        options: dict[str, Any] = {
            "threshold": config.threshold,
            "iou_threshold": config.overlap,
            "decode": False,
            "batch": config.batch,
        }
        if len(config.sizes) > 1:
            ask = partial(MultiScalePredictor(self.model, config.sizes).observe, **options)
        else:
            ask = partial(self.model.observe, size=config.sizes[0], **options)
        rows = observed_rows(ask, self.read, self.names, self.drive.intrinsics, self.depth_source(), config.batch)
        write_jsonl(self.out / "observations.jsonl", rows)

    def slam(self) -> None:
        """EM: trajectory, landmarks, associations, decoded shapes, where every iteration stood."""
        config, problem = self.config, self.problem
        result: SlamResult = (solve_online if config.online else solve)(problem, self.slam_config)
        write_noise(self.out / "slam" / "noise.npz", result.state.noise)
        write_result(self.out / "slam", result, Trajectory(problem.odometry), self.truth, model=self.model)
        draw_slam_result(self.out / "slam" / "map.png", problem.odometry, result, self.truth)

    def map(self) -> None:
        """Landmarks' shapes in the world as one GLB."""
        landmarks = read_json(self.out / "slam" / "landmarks.json")
        with Npz(self.out / "slam" / "landmarks_voxels.npz") as arrays:
            voxels = {name.removesuffix("/mean"): arrays.array(name) for name in arrays.names if name.endswith("/mean")}
        poses = read_trajectory(self.out / "slam" / "trajectory.txt").T_world_camera
        write_glb(self.out / "map.glb", build_scene(landmarks, voxels, poses))

    def crops(self) -> None:
        """The best picture of each landmark."""
        seen = [row for _, row in read_jsonl(self.out / "observations.jsonl")]
        found = [row for _, row in read_jsonl(self.out / "slam" / "associations.jsonl")]
        write_crops(self.out / "crops", best_views(seen, found), self.read)

    def figures(self) -> None:
        """summary.json, and whose each observation is where the truth tells."""
        config = self.config
        summary, objects = summarise(
            self.out,
            self.seconds,
            self.cpu_seconds,
            self.problem,
            drive=config.truth_objects,
            model=None if config.truth_objects is None else self.model,
            config=self.slam_config,
            loop_gap=config.loop_gap,
            seed=config.seed,
        )
        if objects is not None:
            write_json(self.out / "objects.json", objects)
        write_json(self.out / "summary.json", summary | {"remarks": list(self.drive.remarks)})

    def report(self) -> None:
        """report.html."""
        from nolbo_ppl.report import write_report  # only a run with a report needs it

        write_report(self.out)

    def stages(self) -> list[PipelineStage]:
        """All stages in order, each with what it depends on."""
        config = self.config
        plain = json_of(config)

        def of(*names: str) -> dict[str, Any]:
            return {name: plain[name] for name in names}

        inputs = {name: digest(getattr(config, name)) for name in ("intrinsics", "odometry", "truth", "wheel")}
        way = of("every", "keyframe_distance", "keyframe_angle", "camera_height", "camera_pitch", "visual")
        seen = of("sizes", "threshold", "overlap", "depth", "depth_unit", "right", "baseline")
        stages = [
            PipelineStage(
                "odometry",
                ("frames.jsonl", "intrinsics.json", "odometry.txt", "odometry_covariance.npz?", "truth.txt?"),
                {**inputs, **way, "images": self.drive.fingerprint()},
                self.odometry,
            ),
            PipelineStage("observe", ("observations.jsonl",), {**seen, "model": model_digest(config.model)}, self.observe),
            PipelineStage("slam", ("slam",), of("slam", "online"), self.slam),
            PipelineStage("map", ("map.glb",), {}, self.map),
            PipelineStage("crops", ("crops",), {}, self.crops),
            PipelineStage(
                "figures",
                ("summary.json", "objects.json?"),
                {**of("loop_gap", "seed"), "drive": drive_digest(config.truth_objects)},
                self.figures,
            ),
        ]
        return [*stages, PipelineStage("report", ("report.html",), {}, self.report)] if config.report else stages


def run_mission(config: RunConfig) -> dict[str, Any]:
    """Run what is not there yet; returns `summary.json`.

    Raises:
        NolboError: an input is missing, malformed, or does not fit the others; complete stages stay.
    """
    mission = ObjectMappingPipeline(config)
    run_stages(config.out, mission.stages(), json_of(config), library_versions(), mission.seconds, mission.cpu_seconds)
    return read_json(config.out / "summary.json")


def json_of(config: RunConfig) -> dict[str, Any]:
    """The options as JSON values."""

    def plain(value: Any) -> Any:
        return str(value) if isinstance(value, Path) else dict(value)

    return json.loads(json.dumps(dataclasses.asdict(config), default=plain))


def digest(path: Path | None) -> str | None:
    """Digest of a file's content, None without a file."""
    if path is None:
        return None
    if not path.is_file():
        raise input_error("no such file", file=path)
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def model_digest(name: str) -> Any:
    """What tells one model from another: its files, in a folder of one's own or in the package."""
    shipped = Path(str(resources.files("nolbo_ppl"))) / "weights" / name
    folder = next((place for place in (Path(name), shipped) if (place / "config.json").is_file()), None)
    return [name, *(() if folder is None else (digest(folder / file) for file in ("config.json", "model.safetensors")))]


def drive_digest(drive: Path | None) -> Any:
    """What tells the truth of one drive from another."""
    return None if drive is None else [str(drive), digest(drive / "objects.json"), digest(drive / "scenes.jsonl")]


def placed(path: Path, folder: Path) -> str:
    """A path as seen from a folder, so that both can be moved together."""
    return Path(os.path.relpath(path, folder)).as_posix()


def check_folders(config: RunConfig) -> None:
    """Refuse an output folder that holds, or is, an input: its files would be replaced.

    Raises:
        InputError: names the input.
    """
    out = config.out.resolve()
    files = {"intrinsics": config.intrinsics, "odometry": config.odometry, "truth": config.truth, "wheel": config.wheel}
    inputs = {"images": config.images, "truth-objects": config.truth_objects, "depth": config.depth, "right": config.right}
    inputs |= {name: None if path is None else path.parent for name, path in files.items()}
    for name, folder in inputs.items():
        if folder is not None and folder.resolve() == out:
            raise input_error(
                "results would be written over the input",
                got=f"--out {config.out}",
                expected=f"another folder than that of --{name}",
            )
