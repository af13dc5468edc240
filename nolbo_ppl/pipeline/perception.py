"""The guide on every keyframe: detections of a sequence, positions refined where depth is at hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.data.sequences import FrameSequence, UndistortedFrames, open_frames
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.ros_bags import is_bag
from nolbo_ppl.odometry import MeasuredDepth
from nolbo_ppl.pipeline.depth_refinement import DepthScale, read_depth, refine_positions, stereo_depth, stereo_scale
from nolbo_ppl.pipeline.size_refinement import refine_by_height
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors

STRUCTURED_LIGHT = 0.0015
"""Growth of the error of a structured light camera's depth with its square, 1/m (Khoshelham and Elberink 2012)."""
PIXELS_AT_ONCE = 1 << 25
"""Pixels of the images in memory at once (100 MB of colours), or one image: sixteen photographs of a phone are a gigabyte."""
Picture = UInt8[np.ndarray, "h w 3"]
Observe = Callable[[Sequence[Picture], Float[np.ndarray, " 4"]], Sequence[ObjectPosteriors]]
"""Images of one camera and its intrinsics to what is observed in each."""


class DepthSource(Protocol):
    """Depth of a keyframe."""

    scale: DepthScale
    """Its errors."""

    def depth(self, k: int, image: Picture) -> Float[np.ndarray, "h w"] | None:
        """Depth of a keyframe's image along the optical axis, m, NaN unknown; None when there is none."""


class DepthImages:
    """Depth from a folder of 16 bit pictures.

    Args:
        paths: one a keyframe, None where there is none.
        scale: what their numbers mean.
        lens: frames whose distortion is taken out of the pictures as well.
    """

    def __init__(self, paths: Sequence[Path | None], scale: DepthScale, lens: UndistortedFrames | None = None) -> None:
        self.paths, self.scale, self.lens = tuple(paths), scale, lens

    def depth(self, k: int, image: Picture) -> Float[np.ndarray, "h w"] | None:
        """Depth of a keyframe."""
        path = self.paths[k]
        if path is None:
            return None
        found = read_depth(path, self.scale)
        if self.lens is None:
            return found
        pinhole = self.lens.depth_of_lens(found)
        return np.where(pinhole > 0, pinhole, np.nan)


class StereoPairs:
    """Depth by matching the right image of each keyframe.

    Args:
        right: reads the right image of a keyframe.
        focal: focal length, px.
        baseline: distance of the cameras, m.
    """

    def __init__(self, right: Callable[[int], Picture], focal: float, baseline: float) -> None:
        self.right, self.focal, self.baseline = right, focal, baseline
        self.scale = stereo_scale(focal, baseline)

    def depth(self, k: int, image: Picture) -> Float[np.ndarray, "h w"] | None:
        """Depth of a keyframe."""
        return stereo_depth(image, self.right(k), self.focal, self.baseline)


class SequenceDepth:
    """Depth the sequence itself brings (a TUM RGB-D folder), where it does.

    Args:
        frames: the images.
        index: image of every keyframe.
    """

    def __init__(self, frames: FrameSequence, index: Sequence[int]) -> None:
        self.frames, self.index, self.scale = frames, tuple(index), DepthScale(ratio=STRUCTURED_LIGHT)

    def depth(self, k: int, image: Picture) -> Float[np.ndarray, "h w"] | None:
        """Depth of a keyframe."""
        known = self.frames.depth(self.index[k])
        return None if known is None else np.where(known > 0, known, np.nan)


def open_depth(
    frames: FrameSequence,
    index: Sequence[int],
    folder: Path | None = None,
    unit: float = DepthScale().unit,
    right: Path | None = None,
    baseline: float | None = None,
    focal: float = 1.0,
) -> DepthSource:
    """Depth of some frames: from a folder of pictures, a second camera, or what the sequence itself brings.

    Args:
        frames: the sequence.
        index: which of its frames, in the order they are asked for.
        folder: depth pictures, or `BAG:/topic`.
        unit: metres of one step of them.
        right: images of the right camera of a rectified pair.
        baseline: distance of the two cameras, m.
        focal: focal length of the pair, px.

    Raises:
        InputError: pictures that belong to no frame.
    """
    if folder is not None and not is_bag(folder):  # frames of a bag bring its depth themselves
        lens = frames if isinstance(frames, UndistortedFrames) else None
        return DepthImages(beside(folder, [frames.name(k) for k in index], index), DepthScale(unit), lens)
    if right is not None and baseline is not None:
        other = open_frames(right)
        return StereoPairs(lambda k: other.frame(index[k]), focal, baseline)
    return SequenceDepth(frames, index)


def depth_noise(source: DepthSource) -> MeasuredDepth:
    """Noise of the depths for visual odometry, whose steps rest on single pixels; its residuals correct it."""
    if isinstance(source, StereoPairs):
        return MeasuredDepth(ratio=source.scale.ratio)
    return MeasuredDepth(ratio=STRUCTURED_LIGHT)


def beside(folder: Path, images: Sequence[str], index: Sequence[int]) -> list[Path | None]:
    """The file of a folder that belongs to each image: of the same stem, or, where no stem fits, of the same number.

    Raises:
        InputError: no such folder, or neither stems nor numbers fit.
    """
    if not folder.is_dir():
        raise input_error("no such folder", file=folder)
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".png", ".jpg", ".jpeg", ".tif", ".tiff"))
    by_stem = {path.stem: path for path in files}
    found = [by_stem.get(Path(image).stem) for image in images]
    if any(found):
        return found
    if len(files) <= max(index, default=-1):
        raise input_error(
            "pictures that belong to no image", got=f"{len(files)} files", expected="the images' names, or one each", file=folder
        )
    return [files[i] for i in index]


def observe_sequence(
    observe: Observe,
    read: Callable[[int], Picture],
    names: Sequence[str],
    intrinsics: Float[np.ndarray, " 4"],
    depth: DepthSource,
    batch: int,
    times: Sequence[float | None] = (),
    usual_heights: bool = False,
) -> Detections:
    """Detections of every keyframe.

    Args:
        observe: posteriors of each of some images of one camera.
        read: image of a keyframe.
        names: what each keyframe's image is called.
        intrinsics: [fx, fy, cx, cy], px.
        depth: refines positions where it is known.
        batch: images in memory at once.
        times: seconds of each keyframe; none where nobody knows them.
        usual_heights: refine positions by the usual heights of categories where there is no depth.
    """
    tables = []
    for k, image, observed in observe_images(lambda images: observe(images, intrinsics), read, len(names), batch):
        known = depth.depth(k, image)
        if known is not None:
            observed = refine_positions(observed, known, (image.shape[1], image.shape[0]), depth.scale)
        elif usual_heights:
            observed = refine_by_height(observed, intrinsics, (image.shape[1], image.shape[0]))
        tables.append(observed.detections(k, names[k], times[k] if times else None))
    return Detections.concatenate(tables)


def observe_images(
    observe: Callable[[Sequence[Picture]], Sequence[ObjectPosteriors]], read: Callable[[int], Picture], count: int, batch: int
) -> Iterator[tuple[int, Picture, ObjectPosteriors]]:
    """Number, image and posteriors of every image of a sequence, in order.

    Args:
        observe: posteriors of each of some images.
        read: image of a number.
        count: how many there are.
        batch: images in memory, and through the network, at once; fewer where they are large.
    """
    with progress_bar(None, "observing", "image", total=count) as bar:
        first, images, pixels = 0, [], 0
        for k in range(count):
            images.append(read(k))
            pixels += images[-1].shape[0] * images[-1].shape[1]
            if len(images) == batch or pixels >= PIXELS_AT_ONCE or k == count - 1:
                yield from zip(range(first, k + 1), images, observe(images))
                bar.update(len(images))
                first, images, pixels = k + 1, [], 0
