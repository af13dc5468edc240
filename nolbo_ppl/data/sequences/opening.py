"""Which kind of sequence a path is."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nolbo_ppl.data.sequences.bag_frames import BagFrames
from nolbo_ppl.data.sequences.image_sequence import FrameSequence, ImageFolder, TumFolder, list_frames
from nolbo_ppl.data.sequences.video import VIDEO_SUFFIXES, VideoFile
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.images import IMAGE_SUFFIXES
from nolbo_ppl.io.ros_bags import is_bag
from nolbo_ppl.io.text import read_times

IMAGE_FOLDERS = ("image_2", "image_0", "image_02", "images", "rgb", "data")
"""Folders inside the given one that hold its images, in this order of preference (KITTI's left colour camera first)."""


def find_times(folder: Path, top: Path, count: int) -> Float[np.ndarray, " n"] | None:
    """Times of a folder of images from `times.txt` in it or above it, up to the folder that was named and its parent.

    Raises:
        InputError: a file of times that does not fit the images.
    """
    for place in dict.fromkeys((folder, top, folder.parent)):
        file = place / "times.txt"
        if file.is_file():
            times = read_times(file)
            if len(times) != count:
                raise input_error(
                    "times do not match the images",
                    got=f"{len(times)} times",
                    expected=f"{count} images in {folder}",
                    do="remove the file to go without times",
                    file=file,
                )
            return times
    return None


def open_frames(path: str | PathLike[str], topic: str | None = None, depth: str | PathLike[str] | None = None) -> FrameSequence:
    """Open a sequence: a TUM RGB-D folder (`rgb.txt`), a folder of images or one that holds `image_2` or the like, one image,
    a video, or a topic of a ROS bag (extra `ros`).

    Args:
        path: the folder or file; of a bag also `BAG:/topic`.
        topic: topic of a bag; the only one with images by default.
        depth: `BAG:/topic` of the depth images that belong to those of a bag.

    Raises:
        InputError: nothing there, no image, lists or times that are malformed (names file and line).
    """
    path = Path(path)
    if is_bag(path):
        return BagFrames(path, topic, depth)
    if topic is not None:
        raise input_error("--topic", got=topic, expected="a bag of ROS as --images", file=path)
    if path.is_file():
        if path.suffix.lower() in IMAGE_SUFFIXES:
            return ImageFolder(path, [path])
        if path.suffix.lower() not in VIDEO_SUFFIXES:
            raise input_error(
                "not a sequence of frames",
                got=path.name,
                expected="a folder, an image, a video (" + ", ".join(VIDEO_SUFFIXES) + ") or a bag of ROS (.bag, .mcap, .db3)",
                file=path,
            )
        return VideoFile(path)
    if not path.is_dir():
        raise input_error("no such folder or video", file=path)
    if (path / "rgb.txt").is_file():
        return TumFolder(path)
    candidates = [path, *(path / name for name in IMAGE_FOLDERS), *(path / name / "data" for name in ("image_02",))]
    for folder in candidates:
        files = list_frames(folder) if folder.is_dir() else []
        if files:
            return ImageFolder(path, files, find_times(folder, path, len(files)))
    raise input_error(
        "no image in the folder", expected="images in it, in " + ", ".join(IMAGE_FOLDERS) + ", or rgb.txt (TUM)", file=path
    )
