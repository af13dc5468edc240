"""`nolbo convert`: public data sets into odometry, truth and observations for `nolbo slam`, or scenes for `nolbo evaluate`."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from nolbo_ppl.cli.convert_archives import Bop, Coco, ObjectNet3d, Pascal3d, Pix3d, StanfordCars, Voc
from nolbo_ppl.data.converters import (
    Converted,
    convert_kitti_drive,
    convert_kitti_object,
    convert_kitti_poles,
    convert_kitti_tracking,
    convert_photographs,
    convert_ycbv_slam,
    read_photographs,
    write_converted,
)
from nolbo_ppl.data.converters.foreign_detections import DetectionFormat, observations_of, read_foreign_detections
from nolbo_ppl.data.converters.placed_boxes import observations_by_parallax, read_heights, undistorted
from nolbo_ppl.data.converters.pseudo_labels import MIN_CONFIDENCE, SUSPECTED, write_pseudo_labels
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.io.camera_files import read_camera
from nolbo_ppl.io.files import read_json_object, write_json
from nolbo_ppl.io.images import images_of
from nolbo_ppl.io.observations import write_observations
from nolbo_ppl.io.output_folder import output_folder
from nolbo_ppl.io.text import read_words
from nolbo_ppl.io.trajectories import COVARIANCE, read_trajectory


@dataclass(frozen=True)
class KittiObject:
    """KITTI object detection: street images with 3D boxes of cars, as scenes for `nolbo evaluate`."""

    data: Path
    """Folder `kitti_object` with image_2/, label_2/ and calib/."""
    out: Path
    """Folder for images/, scenes.jsonl, source.json."""

    def write(self) -> str:
        """Run it and say what was written."""
        counts = convert_kitti_object(self.data, self.out)
        return f"{counts['images']} images, {counts['objects']} cars, {counts['ignore']} regions to ignore"


@dataclass(frozen=True)
class KittiDrive:
    """Frames of a drive with labels by track (KITTI tracking), as scenes for `nolbo evaluate`."""

    images: Path
    """Folder of the frames, in the order of their names."""
    labels: Path
    """File of labels that begin with frame and track (`labels/0000.txt`)."""
    calib: Path
    """File with the projection of camera 2 (`calib/0000.txt`)."""
    out: Path
    """Folder for images/, scenes.jsonl, source.json."""

    def write(self) -> str:
        """Run it and say what was written."""
        counts = convert_kitti_drive(self.images, self.labels, self.calib, self.out)
        return f"{counts['images']} images, {counts['objects']} cars, {counts['ignore']} regions to ignore"


@dataclass(frozen=True)
class KittiPoles:
    """KITTI odometry with simulated detections of the real pole map."""

    data: Path
    """Folder `kitti_odometry` with poses/, poles/ and odometry."""
    sequence: str
    """Two digits."""
    out: Path
    """Folder for odometry.txt, truth.txt, observations.jsonl, objects.json, source.json."""
    odometry: str = "odometry_f2f"
    """Folder of the odometry."""
    every: int = 1
    """Keep every this many frames."""
    seed: int = 0
    """Seed of the detections."""
    position_scale: float = 0.1
    """Noise of a position at range 0, m."""
    position_ratio: float = 0.03
    """Its growth with range, m per m."""
    miss_rate: float = 0.15
    """Probability that a pole in view is missed."""
    clutter_rate: float = 0.5
    """Mean false detections a frame."""
    maximum_range: float = 30.0
    """m."""

    def convert(self) -> Converted:
        """Run it."""
        return convert_kitti_poles(
            self.data,
            self.sequence,
            odometry=self.odometry,
            every=self.every,
            seed=self.seed,
            position_scale=self.position_scale,
            position_ratio=self.position_ratio,
            miss_rate=self.miss_rate,
            clutter_rate=self.clutter_rate,
            maximum_range=self.maximum_range,
        )


@dataclass(frozen=True)
class KittiTracking:
    """KITTI tracking: real car detections, rebuilt ego motion with added drift."""

    data: Path
    """Folder `kitti_tracking` with labels/, detections_car/ and pseudo_ego/."""
    sequence: str
    """Four digits."""
    out: Path
    """Folder for odometry.txt, truth.txt, observations.jsonl, objects.json, source.json."""
    seed: int = 0
    """Seed of the drift."""
    rotation_drift: float = float(np.deg2rad(0.3))
    """Heading error of one frame, rad."""
    translation_drift: float = 0.02
    """Position error of one frame, m per m."""
    minimum_score: float = 0.0
    """Detections below are left out."""

    def convert(self) -> Converted:
        """Run it."""
        return convert_kitti_tracking(
            self.data,
            self.sequence,
            seed=self.seed,
            rotation_drift=self.rotation_drift,
            translation_drift=self.translation_drift,
            minimum_score=self.minimum_score,
        )


@dataclass(frozen=True)
class Photographs:
    """Labelled photographs (COCO's JSON), as scenes for `nolbo train`."""

    data: Path
    """The JSON file; images lie in the folder `images` beside it."""
    out: Path
    """Folder for images/, scenes.jsonl, source.json."""
    leave_out: tuple[str, ...] = ()
    """Names of sources (`source` of an image) to leave out."""

    def write(self) -> str:
        """Run it and say what was written."""
        photographs = [one for one in read_photographs(self.data) if one.source not in self.leave_out]
        counts = convert_photographs(photographs, self.out)
        return f"{counts['images']} photographs, {counts['objects']} objects, {counts['viewpoints']} viewpoints"


@dataclass(frozen=True)
class PseudoLabels:
    """Photographs without labels, labelled by a model with its confidence, as scenes for `nolbo train`."""

    images: Path
    """Folder of photographs."""
    out: Path
    """Folder for images/, scenes.jsonl, source.json."""
    model: str = "photo"
    """Name of shipped weights, or a folder with a model."""
    min_confidence: float = MIN_CONFIDENCE
    """Least probability of an object that becomes a label."""
    suspected: float = SUSPECTED
    """From this probability on it is a region to ignore; what is less is background."""

    def write(self) -> str:
        """Run it and say what was written."""
        images = sorted(images_of(self.images, recursive=True))
        counts = write_pseudo_labels(images, load(self.model), self.out, self.min_confidence, self.suspected)
        return f"{counts['images']} photographs, {counts['objects']} objects, {counts['ignore']} regions to ignore"


@dataclass(frozen=True)
class YcbvSlam:
    """YCB-Video SLAM: real 6D detections with heavy tails, real odometry with added drift."""

    data: Path
    """Folder `ycbv_slam` of NPZ files."""
    sequence: str
    """Four digits."""
    out: Path
    """Folder for odometry.txt, truth.txt, observations.jsonl, objects.json, source.json."""
    detections: str = "det_initial"
    """det_initial, det_selftrained or det_supervised."""
    every: int = 10
    """Keep every this many frames."""
    seed: int = 0
    """Seed of the drift."""
    rotation_drift: float = float(np.deg2rad(1.0))
    """Error of each angle of one step, rad."""
    translation_drift: float = 0.005
    """Error of each coordinate of one step, m."""

    def convert(self) -> Converted:
        """Run it."""
        return convert_ycbv_slam(
            self.data,
            self.sequence,
            detections=self.detections,
            every=self.every,
            seed=self.seed,
            rotation_drift=self.rotation_drift,
            translation_drift=self.translation_drift,
        )


@dataclass(frozen=True)
class ForeignFile:
    """Detections of another detector (COCO, YOLO, KITTI, Omni3D, OA-SLAM, JSON Lines) as observations for `nolbo slam`."""

    data: Path
    """The file; of YOLO and KITTI also the folder of files."""
    format: DetectionFormat
    """Its format."""
    intrinsics: Path
    """The camera (see `nolbo run --intrinsics`); a distortion is taken out of the boxes."""
    out: Path
    """Folder for observations.jsonl."""
    images: Path | None = None
    """Folder of the images, whose order gives their numbers; else the order of the names in the file."""
    names: Path | None = None
    """Names of the categories, one a line, in order of their numbers; COCO's by default."""
    heights: Path | None = None
    """JSON: height and standard deviation, m, by category. Without `--odometry` boxes alone need them; everyday values are the
    default then."""
    odometry: Path | None = None
    """Odometry, a row an image: boxes alone are triangulated, with the heights that are given, or without any."""
    minimum_score: float = 0.3
    """Detections below are left out."""

    def write(self) -> str:
        """Run it and say what was written."""
        camera = read_camera(self.intrinsics)
        size = (camera.width, camera.height) if camera.width and camera.height else None
        heights = None if self.heights is None else read_heights(self.heights)
        names = None if self.names is None else [" ".join(words) for _, words in read_words(self.names)]
        images = None if self.images is None else [path.name for path in images_of(self.images)]
        found = read_foreign_detections(self.data, self.format, images=images, names=names, size=size)
        found = undistorted(found, camera)
        if self.odometry is None:
            table, left_out = observations_of(found, camera.vector, size, heights, self.minimum_score)
        else:
            poses = read_trajectory(self.odometry).T_world_camera
            table, left_out = observations_by_parallax(found, poses, camera.vector, size, heights, self.minimum_score)
        write_observations(self.out / "observations.jsonl", table)
        write_json(self.out / "source.json", {"kind": "detections", "format": self.format, "left_out": left_out})
        reasons = "".join(f", {count} left out {why}" for why, count in left_out.items() if count)
        return f"{len(table)} of {len(found)} detections{reasons},"


Source = (
    Annotated[ForeignFile, tyro.conf.subcommand("detections")]
    | Annotated[KittiObject, tyro.conf.subcommand("kitti-object")]
    | Annotated[KittiDrive, tyro.conf.subcommand("kitti-drive")]
    | Annotated[KittiPoles, tyro.conf.subcommand("kitti-poles")]
    | Annotated[KittiTracking, tyro.conf.subcommand("kitti-tracking")]
    | Annotated[Photographs, tyro.conf.subcommand("photographs")]
    | Annotated[PseudoLabels, tyro.conf.subcommand("pseudo-labels")]
    | Annotated[YcbvSlam, tyro.conf.subcommand("ycbv-slam")]
    | Annotated[Bop, tyro.conf.subcommand("bop")]
    | Annotated[Pascal3d, tyro.conf.subcommand("pascal3d")]
    | Annotated[ObjectNet3d, tyro.conf.subcommand("objectnet3d")]
    | Annotated[Voc, tyro.conf.subcommand("voc")]
    | Annotated[Coco, tyro.conf.subcommand("coco")]
    | Annotated[Pix3d, tyro.conf.subcommand("pix3d")]
    | Annotated[StanfordCars, tyro.conf.subcommand("stanford-cars")]
)


DRIVE = ("odometry.txt", "truth.txt", COVARIANCE, "observations.jsonl", "objects.json", "source.json")
SCENES = ("images", "scenes.jsonl", "voxels.npz", "trajectories", "source.json")
"""Files of what is converted."""


def is_converted(folder: Path) -> bool:
    """Whether a folder holds converted data that others may replace; generated scenes state no kind."""
    return (folder / "source.json").is_file() and "kind" in read_json_object(folder / "source.json")


def main(args: list[str] | None = None) -> None:
    """Command line of `nolbo convert`."""
    source: Any = tyro.cli(Source, prog="nolbo convert", args=args)  # type: ignore[arg-type]
    names = SCENES if hasattr(source, "write") and not isinstance(source, ForeignFile) else DRIVE
    inputs = [
        getattr(source, name, None)
        for name in ("data", "images", "intrinsics", "names", "heights", "odometry", "labels", "calib")
    ]
    with output_folder(source.out, names, is_own=is_converted, inputs=inputs) as folder:
        if hasattr(source, "write"):
            written = dataclasses.replace(source, out=folder).write()
        else:
            data = source.convert()
            write_converted(folder, data)
            written = f"{len(data.odometry)} frames, {len(data.observations)} observations"
    sys.stdout.write(f"{written} written to {source.out}\n")


if __name__ == "__main__":
    main()
