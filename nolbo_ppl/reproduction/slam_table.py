"""Table 2: SLAM with what each network observes, on generated drives along the paths of KITTI 00, 06 and 08."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from nolbo_ppl.data.simulate import simulate_odometry
from nolbo_ppl.data.simulated_paths import figure_of_eight, looking_ahead
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.boxes import pairwise_iou
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve
from nolbo_ppl.inference.slam.map_files import association_table
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.io.npz import Npz, save_npz
from nolbo_ppl.io.observations import read_observations, write_observations
from nolbo_ppl.io.trajectories import read_trajectory
from nolbo_ppl.metrics.association import association_pairs
from nolbo_ppl.metrics.trajectory import trajectory_errors
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.reproduction.budgets import IN_SLAM, NETWORKS, ReproduceConfig
from nolbo_ppl.reproduction.paper_numbers import ATE, RPE
from nolbo_ppl.reproduction.result_table import ResultTable, over_seeds
from nolbo_ppl.reproduction.trained_networks import trained
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.synthetic.worlds.path_world import make_path_world
from nolbo_ppl.synthetic.worlds.world_frame import render_frame

SEQUENCES = ("00", "06", "08")
"""Paths of KITTI odometry that are driven."""
ROTATION_SCALE, TRANSLATION_RATIO = 0.006, 0.02
"""White noise of the odometry's steps, rad and m per m: as weak as the paper's, whose error is 31 on paths of kilometres."""
RENDERED = 128
"""Side of the scenes that shipped weights learnt from, px (`TrainConfig.render_sizes`)."""
LOOP_GAP = 60
"""Frames between two detections of an object that are a loop pair."""
OVERLAP = 0.5
"""Overlap of a detection's box with the object it is of."""
CLUTTER = 0.1
"""Overlap below which a detection is of no object; between the two nobody knows whose it is."""
UNKNOWN = -2
"""In the place of an object's number: nobody knows; such detections have no say in loop pairs."""


@dataclass(frozen=True)
class Drive:
    """A generated drive: its images and what is true of them."""

    name: str
    T_world_camera: Float[np.ndarray, "n 4 4"]
    """True poses."""
    images: UInt8[np.ndarray, "n h w 3"]
    intrinsics: Float[np.ndarray, " 4"]
    """[fx, fy, cx, cy] px."""
    frame: Int[np.ndarray, " k"]
    """Frame of each label."""
    box: Float[np.ndarray, "k 4"]
    """Its box, px."""
    object: Int[np.ndarray, " k"]
    """Its object."""


def paths(config: ReproduceConfig) -> dict[str, Float[np.ndarray, "n 4 4"]]:
    """Paths to drive, by name: of KITTI where the folder of data has them (poses/00.txt), else generated ones that come back.

    Raises:
        InputError: a folder of data without any of the paths.
    """
    if config.folder is not None:
        files = {name: config.folder / "poses" / f"{name}.txt" for name in SEQUENCES}
        found = {name: read_trajectory(file).T_world_camera for name, file in files.items() if file.is_file()}
        if not found:
            raise input_error("no paths", expected="poses/00.txt, poses/06.txt or poses/08.txt", file=config.folder)
        return found
    return {"eight": figure_of_eight(800, 2, 90.0), "oval": _oval(400), "block": _block(500)}


def _oval(frames: int) -> Float[np.ndarray, "n 4 4"]:
    """One lap and a quarter of an oval with two long sides, as KITTI 06."""
    angle = np.linspace(0.0, 2.5 * np.pi, frames)
    return looking_ahead(np.stack([20 * np.sin(angle), np.zeros(frames), 110 * (1 - np.cos(angle))], axis=1))


def _block(frames: int) -> Float[np.ndarray, "n 4 4"]:
    """A rounded square, driven once and a half."""
    angle = np.linspace(0.0, 3 * np.pi, frames)
    radius = 80 / (np.abs(np.cos(angle)) ** 4 + np.abs(np.sin(angle)) ** 4) ** 0.25
    return looking_ahead(np.stack([radius * np.sin(angle), np.zeros(frames), radius * (1 - np.cos(angle))], axis=1))


def render_drive(config: ReproduceConfig, name: str, path: Float[np.ndarray, "n 4 4"]) -> Drive:
    """Render a drive along a path, or read it where that was done before."""
    sizes = config.sizes
    file = config.out / "drives" / config.budget / f"{name}.npz"
    if not file.is_file():
        world = make_path_world(path, sizes.step, sizes.frame_size, seed=_number(name), frames=sizes.frames)
        images, frame, box, ids = [], [], [], []
        for k in progress_bar(range(world.config.frames), f"rendering {name}", "frame"):
            seen = render_frame(world, k)
            images.append(seen.rendered.image)
            frame += [k] * len(seen.ids)
            box += [label.box for label in seen.rendered.labels]
            ids += [int(str(one).removeprefix("O")) for one in seen.ids]
        arrays = {
            "T_world_camera": world.T_world_camera,
            "images": np.array(images),
            "intrinsics": world.intrinsics,
            "frame": np.array(frame, dtype=np.int64),
            "box": np.array(box).reshape(-1, 4),
            "object": np.array(ids, dtype=np.int64),
        }
        file.parent.mkdir(parents=True, exist_ok=True)
        save_npz(file, arrays)
    with Npz(file, largest=1 << 31) as stored:
        return Drive(name, *(stored.array(part, kinds="fiu") for part in
                             ("T_world_camera", "images", "intrinsics", "frame", "box", "object")))  # fmt: skip


def _number(name: str) -> int:
    """A seed of a drive's name."""
    return sum((k + 1) * ord(letter) for k, letter in enumerate(name))


def observe_drive(model: ObservationModel, drive: Drive, zoom: float, batch: int = 16) -> Detections:
    """What a network observes in every frame, without shapes.

    Args:
        model: the network.
        drive: its images.
        zoom: how many times larger than they were rendered the network saw the scenes it learnt from. Frames are enlarged as
            much, so that objects keep the size in px they were learnt at: smaller ones are taken to be nearer than they are.
        batch: frames at once.
    """
    tables = []
    size = max(32, round(zoom * max(drive.images.shape[1:3]) / 32) * 32)
    for first in progress_bar(range(0, len(drive.images), batch), f"observing {drive.name}", "batch"):
        part = list(drive.images[first : first + batch])
        for k, seen in enumerate(model.observe(part, drive.intrinsics, size=size, decode=False, batch=batch)):
            tables.append(seen.detections(first + k))
    return Detections.concatenate(tables)


def observations_of(config: ReproduceConfig, drive: Drive, name: str, seed: int, model: ObservationModel) -> Detections:
    """What a network observes of a drive, kept in a file that later calls read."""
    file = config.out / "observations" / config.budget / f"{drive.name}-{config.label(name, seed)}.jsonl"
    if not file.is_file():
        rendered = RENDERED if name in config.weights else config.sizes.render_size
        write_observations(file, observe_drive(model, drive, model.config.image_size / rendered))
    return read_observations(file)


def true_objects(detections: Detections, drive: Drive) -> Int[np.ndarray, " n"]:
    """True object of each detection by the overlap of boxes, -1 for none, `UNKNOWN` for a box that fits none well."""
    out = np.full(len(detections), -1)
    for frame in np.unique(detections.frame):
        rows, labels = np.flatnonzero(detections.frame == frame), np.flatnonzero(drive.frame == frame)
        if len(labels):
            iou = pairwise_iou(torch.from_numpy(detections.box[rows]), torch.from_numpy(drive.box[labels])).numpy()
            best, overlap = iou.argmax(1), iou.max(1)
            out[rows] = np.where(overlap >= OVERLAP, drive.object[labels[best]], np.where(overlap < CLUTTER, -1, UNKNOWN))
    return out


@dataclass(frozen=True)
class DriveScores:
    """Errors of one estimate of a drive."""

    ate: float
    """m, aligned by a rigid motion."""
    rpe: float
    """m over one step."""
    loop_recall: float
    """Share of loop pairs of detections of one object that are put on one landmark; NaN for odometry alone, or without a pair."""
    loop_precision: float
    """Share of the loop pairs put on one landmark that are one object; NaN for odometry alone, or where none was put."""


def odometry_of(drive: Drive, seed: int) -> Float[np.ndarray, "n 4 4"]:
    """The visual odometry of a drive: its true steps with white noise."""
    rng = np.random.default_rng([_number(drive.name), seed])
    return simulate_odometry(
        drive.T_world_camera, rng, rotation_scale=ROTATION_SCALE, translation_ratio=TRANSLATION_RATIO, planar=True
    )


def score_odometry(drive: Drive, odometry: Float[np.ndarray, "n 4 4"]) -> DriveScores:
    """Errors of the odometry alone."""
    errors = trajectory_errors(odometry, drive.T_world_camera)
    return DriveScores(errors["ate"], errors["rpe_translation"], np.nan, np.nan)


def score_slam(drive: Drive, odometry: Float[np.ndarray, "n 4 4"], detections: Detections, correlation: float) -> DriveScores:
    """Solve a drive with some detections and compare with the truth.

    Args:
        drive: the drive.
        odometry: what SLAM starts from.
        detections: of one network.
        correlation: of its latent's errors in two views of one object, by its calibration.
    """
    config = SlamConfig(latent_correlation=correlation, hypotheses=1)
    result: SlamResult = solve(SlamProblem(odometry, detections), config)
    errors = trajectory_errors(result.T_world_camera, drive.T_world_camera)
    landmark, truth = association_table(result).landmark_of, true_objects(detections, drive)
    told = truth != UNKNOWN
    pairs = association_pairs(detections.frame[told], truth[told], landmark[told], LOOP_GAP)
    recall = pairs.recall if pairs.true_pairs else np.nan
    precision = pairs.precision if pairs.found_pairs else np.nan
    return DriveScores(errors["ate"], errors["rpe_translation"], recall, precision)


def scores_of(config: ReproduceConfig, drive: Drive, name: str, seed: int) -> DriveScores:
    """Scores of a network, or of the odometry (`vo`), kept in a file that a later call reads."""
    network = "vo" if name == "vo" else config.label(name, seed)
    file = config.out / "slam" / config.budget / f"{drive.name}-{network}-{seed}.json"
    if not file.is_file():
        odometry = odometry_of(drive, seed)
        if name == "vo":
            scores = score_odometry(drive, odometry)
        else:
            model = trained(config, name, seed % config.networks_of_each)
            seen = observations_of(config, drive, name, seed, model)
            scores = score_slam(drive, odometry, seen, model.calibration.shape_correlation)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, {key: None if np.isnan(value) else value for key, value in vars(scores).items()})
    return DriveScores(**{key: np.nan if value is None else float(value) for key, value in read_json(file).items()})


def slam_table(config: ReproduceConfig) -> ResultTable:
    """ATE and RPE (mean over the drives) of every network and of the odometry, the paper's beside it."""
    drives = [render_drive(config, name, path) for name, path in paths(config).items()]
    length = ", ".join(f"{drive.name} ({len(drive.images)} frames)" for drive in drives)
    table = ResultTable(
        "SLAM with what each network observes (Table 2)",
        (
            "ATE, m",
            "RPE, m a step",
            "ATE over VO",
            "loop recall",
            "loop precision",
            "paper: ATE",
            "paper: RPE",
            "paper: ATE over VO",
        ),
        f"Generated drives {length}; odometry with {ROTATION_SCALE:g} rad and {100 * TRANSLATION_RATIO:g} % of white noise; "
        f"means over the drives, intervals over {config.seeds} seeds of the odometry; networks of each kind: "
        f"{config.networks_of_each}. The paper gives no units. Budget {config.budget}.",
    )
    odometry = [[scores_of(config, drive, "vo", seed) for drive in drives] for seed in range(config.seeds)]
    for name in (*config.chosen(IN_SLAM), "vo"):
        runs = [[scores_of(config, drive, name, seed) for drive in drives] for seed in range(config.seeds)]
        figures = [
            (
                np.mean([one.ate for one in run]),
                np.mean([one.rpe for one in run]),
                np.mean([one.ate for one in run]) / np.mean([one.ate for one in vo]),
                np.mean([one.loop_recall for one in run]),
                np.mean([one.loop_precision for one in run]),
            )
            for run, vo in zip(runs, odometry)
        ]
        cells = [over_seeds(column) for column in np.array(figures).T]
        title = "VO" if name == "vo" else NETWORKS[name].title
        table.add(title, [*cells, ATE[name], RPE[name], round(ATE[name] / ATE["vo"], 3)])
    return table
