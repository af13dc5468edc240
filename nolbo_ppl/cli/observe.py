"""`nolbo observe`: posteriors of the objects in a folder of images, as `observations.jsonl` and pictures."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from nolbo_ppl.data.sequences.image_sequence import FrameSequence
from nolbo_ppl.data.sequences.opening import open_frames
from nolbo_ppl.data.sequences.undistorted import guessed_camera, photographed_cameras, recorded_camera, without_distortion
from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.posterior.predictor import ObservationModel, guessed_intrinsics
from nolbo_ppl.io.camera_files import read_camera
from nolbo_ppl.io.files import atomic_path, write_jsonl
from nolbo_ppl.io.output_folder import output_folder
from nolbo_ppl.pipeline.perception import observe_images
from nolbo_ppl.renamed_options import current_arguments, renamed_options
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors


@renamed_options(threshold="score_threshold")
@dataclass(frozen=True)
class ObserveConfig:
    """What to observe and where to write."""

    images: Path
    """Folder of images, a video or a bag of ROS; a detection's `frame` is the index of its image in natural order of the names
    (frame2 before frame10), the same as in `nolbo odometry` and `nolbo run`."""
    out: Path
    """Folder for observations.jsonl and the pictures."""
    model: str = "photo"
    """Name of weights in the package (`photo` for photographs, `tiny` for generated scenes), or a folder with a model of your
    own."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx fy cx cy in px of the images, the same for all; without them those of each photograph's EXIF data, and where there are
    none 60 degrees across are taken for granted."""
    camera: Path | None = None
    """A file with the camera instead (see `nolbo run --intrinsics`), whose distortion is taken out of the images."""
    score_threshold: float = 0.3
    """Least objectness of a detection."""
    pictures: bool = True
    """Draw the posterior over each image."""
    batch: int = 16
    """Images that go through the network at once."""
    seed: int = 0
    """Seed of the samples behind the voxels' mean and variance."""
    size: int | None = None
    """Longer side, px, at which the network looks at each image, a multiple of 32; its own by default. Larger for wide
    images whose objects would else be too small."""
    topic: str | None = None
    """Topic of the images of a bag; by default its only one. Its camera info gives the camera."""
    device: str = "auto"
    """Where the networks run: `auto`, `cpu`, `cuda`, `cuda:N` or `mps`."""
    bf16: bool = False
    """Networks in bfloat16."""


@dataclass(frozen=True)
class ObserveSummary:
    """What was done."""

    images: int
    """Images observed."""
    detections: int
    """Lines of observations.jsonl."""
    file: Path
    """The observations."""
    guessed: str = ""
    """What a guessed camera means for the positions; empty where the camera was given."""


def run(config: ObserveConfig) -> ObserveSummary:
    """Observe every image of the folder; the results appear complete or not at all.

    Raises:
        InputError: no images, no such model, or an output folder that holds something else.
    """
    frames = open_frames(config.images, config.topic)
    model = load(config.model, config.device, half_precision=config.bf16)
    recorded = recorded_camera(frames) if config.camera is None and config.intrinsics is None else None
    if recorded is not None:
        frames, camera = without_distortion(frames, recorded[0])
        config = replace(config, intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy))
    if config.camera is not None:
        if config.intrinsics is not None:
            raise input_error("--camera and --intrinsics", got="both", expected="one of the two")
        frames, camera = without_distortion(frames, read_camera(config.camera, frames.size))
        config = replace(config, intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy))
    if config.out.resolve() == config.images.resolve():
        raise input_error("pictures would be written over the images", got=config.out, do="choose another --out")
    cameras: list[np.ndarray | None] = photographed_cameras(frames)
    if config.intrinsics is not None:
        cameras = [np.array(config.intrinsics)] * len(frames)
    names = [picture_name(frames.name(k)) for k in range(len(frames))] if config.pictures else []
    with output_folder(config.out, ("observations.jsonl", *names), is_own=is_result) as folder:
        rows = list(_rows(config, frames, cameras, model, folder))
        write_jsonl(folder / "observations.jsonl", rows)
    return ObserveSummary(len(frames), len(rows), config.out / "observations.jsonl", _remark(frames, cameras))


def _remark(frames: FrameSequence, cameras: Sequence[np.ndarray | None]) -> str:
    """What cameras that nobody gave mean for the positions."""
    known = sum(camera is not None for camera in cameras)
    told = f"{known} of {len(frames)} images tell their focal length (EXIF); of the others " if known else ""
    return "" if known == len(frames) else told + guessed_camera(frames.size)[1]


def picture_name(name: str) -> str:
    """File of a frame's picture."""
    return f"{name if '#' in name else Path(name).stem}.png"


def is_result(folder: Path) -> bool:
    """Whether a folder holds observations that others may replace; those of a run belong to it."""
    return (folder / "observations.jsonl").is_file() and not (folder / "run.json").exists()


def _rows(
    config: ObserveConfig, frames: FrameSequence, cameras: Sequence[np.ndarray | None], model: ObservationModel, folder: Path
) -> Iterator[dict]:
    answer = partial(model.observe, threshold=config.score_threshold, size=config.size, batch=config.batch, seed=config.seed)
    ahead = iter(cameras)  # images are asked for in their order

    def observe(images: Sequence[np.ndarray]) -> Sequence[ObjectPosteriors]:
        found: Sequence[ObjectPosteriors] = answer(images, [next(ahead) for _ in images])
        return found

    for k, image, observed in observe_images(observe, frames.image, len(frames), config.batch):
        yield from observed.to_records(k, frames.name(k))
        if config.pictures:
            _draw(cameras[k], folder / picture_name(frames.name(k)), image, observed, model)


def _draw(
    camera: np.ndarray | None, path: Path, image: np.ndarray, observations: ObjectPosteriors, model: ObservationModel
) -> None:
    """The posterior over the image, as `OUT/NAME.png`."""
    from nolbo_ppl.viz.posterior_plots import draw_observations  # matplotlib is only needed for pictures

    camera = guessed_intrinsics(image) if camera is None else camera
    with atomic_path(path) as temporary:
        draw_observations(image, observations, camera, prior_mean=model.prior_mean(), path=temporary)


def main(args: Sequence[str] | None = None) -> None:
    """Parse the command line and observe."""
    import tyro

    summary = run(
        tyro.cli(
            ObserveConfig,
            args=current_arguments(ObserveConfig, args),
            prog="nolbo observe",
            description=__doc__,
        )
    )
    sys.stdout.write(f"{summary.detections} objects in {summary.images} images: {summary.file}\n")
    if summary.guessed:
        sys.stdout.write(summary.guessed + "\n")


if __name__ == "__main__":
    main()
