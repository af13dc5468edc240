"""Frames of a camera with a lens, as a pinhole camera would have taken them."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.data.sequences.bag_frames import BagFrames
from nolbo_ppl.data.sequences.image_sequence import FrameSequence, ImageFolder
from nolbo_ppl.geometry.camera import guessed_pinhole
from nolbo_ppl.geometry.distortion import undistort_depth, undistort_image
from nolbo_ppl.io.camera_files import CameraIntrinsics, camera_of_images, read_camera
from nolbo_ppl.io.images import exif_focal_length, image_size


class UndistortedFrames(FrameSequence):
    """A sequence whose frames are undistorted when they are read. `pinhole` is the camera of what is returned."""

    def __init__(self, source: FrameSequence, camera: CameraIntrinsics) -> None:
        """Frames of `source`, taken by `camera`."""
        self.source, self.camera, self.path = source, camera, source.path

    def __len__(self) -> int:
        return len(self.source)

    @cached_property
    def pinhole(self) -> CameraIntrinsics:
        """The camera of the undistorted frames."""
        return self.camera.undistorted(self.size)

    def frame(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """Frame k in RGB, without the distortion of the lens."""
        image = self.source.frame(k)
        if self.camera.model is None:
            return image
        return undistort_image(image, self.camera.vector, self.camera.model, self.camera.distortion, self.pinhole.vector)

    def time(self, k: int, /) -> float | None:
        """Time of frame k in s."""
        return self.source.time(k)

    def name(self, k: int, /) -> str:
        """Name of frame k."""
        return self.source.name(k)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames, px."""
        return self.source.size

    @property
    def has_depth(self) -> bool:
        """Whether frames bring depth images."""
        return self.source.has_depth

    def depth(self, k: int, /) -> Float[np.ndarray, "h w"] | None:
        """Depth of frame k in m, without the distortion of the lens, 0 where unknown; None where there is no depth image."""
        found = self.source.depth(k)
        return None if found is None else self.depth_of_lens(found)

    def depth_of_lens(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """A depth image that is registered to a frame as the lens took it, without the distortion; 0 where unknown."""
        camera, model = self.camera, self.camera.model
        if model is None:
            return depth
        return undistort_depth(depth, camera.vector, model, camera.distortion, self.pinhole.vector, self.size)


def without_distortion(frames: FrameSequence, camera: CameraIntrinsics) -> tuple[FrameSequence, CameraIntrinsics]:
    """Frames and camera as they are, or undistorted frames and their pinhole camera where the lens distorts."""
    if not camera.is_distorted:
        return frames, camera
    made = UndistortedFrames(frames, camera)
    return made, made.pinhole


def guessed_camera(size: tuple[int, int], focal: float | None = None) -> tuple[CameraIntrinsics, str]:
    """A camera for images whose camera nobody knows, and what that means for the figures.

    Args:
        size: width and height of the images, px.
        focal: focal length in px, where the images tell it (EXIF); else 60 degrees across are taken for granted.
    """
    width, height = size
    told = focal is not None
    focal = focal if focal is not None else float(guessed_pinhole(width, height)[0])
    across = np.degrees(2 * np.arctan(width / 2 / focal))
    origin = "from the EXIF focal length" if told else "without any evidence"
    remark = (
        f"intrinsics are guessed {origin}: {focal:.0f} px, {across:.0f} degrees across, no distortion; a focal length wrong by "
        "x % puts every object about x % too near or too far, turns are wrong by as much, and the stated uncertainties know "
        "nothing of it: calibrate the camera"
    )
    return CameraIntrinsics(float(focal), float(focal), width / 2, height / 2, width, height), remark


def photographed_cameras(frames: FrameSequence) -> list[Float[np.ndarray, " 4"] | None]:
    """Intrinsics [fx, fy, cx, cy], px, of every image of a folder by the focal length in its EXIF data; None where it tells none.

    Without distortion, the principal point in the middle: what a phone's or a camera's own file is good for.
    """
    cameras: list[Float[np.ndarray, " 4"] | None] = [None] * len(frames)
    for k, file in enumerate(frames.files if isinstance(frames, ImageFolder) else ()):
        focal = exif_focal_length(file)
        if focal is not None:
            width, height = image_size(file)
            cameras[k] = np.array([focal, focal, width / 2, height / 2])
    return cameras


def recorded_camera(frames: FrameSequence) -> tuple[CameraIntrinsics, str] | None:
    """The camera that a bag recorded with its images, and a remark that says so; None where there is none.

    Raises:
        InputError: a camera info without a calibration, or one of images of another size.
    """
    found = camera_of_images(frames.path, frames.topic, frames.size) if isinstance(frames, BagFrames) else None
    return None if found is None else (found[0], f"the camera is that of {found[1]}")


def frames_with_camera(frames: FrameSequence, file: Path | None) -> tuple[FrameSequence, CameraIntrinsics, str]:
    """Frames without distortion, their pinhole camera, and what has to be said of it ("" where it was given).

    The camera is that of the file, else the one a bag recorded, else a guess, by the EXIF focal length where there is one.

    Raises:
        InputError: a camera that cannot be read, or does not belong to these images.
    """
    if file is not None:
        return *without_distortion(frames, read_camera(file, frames.size)), ""
    recorded = recorded_camera(frames)
    if recorded is not None:
        return *without_distortion(frames, recorded[0]), recorded[1]
    first = frames.files[0] if isinstance(frames, ImageFolder) else None
    camera, remark = guessed_camera(frames.size, None if first is None else exif_focal_length(first))
    return frames, camera, remark
