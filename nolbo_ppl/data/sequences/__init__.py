"""Sequences of frames: folders of images, TUM RGB-D folders and video files, read one at a time; camera intrinsics."""

from __future__ import annotations

from nolbo_ppl.data.sequences.image_sequence import FrameSequence, ImageFolder, TumFolder
from nolbo_ppl.data.sequences.opening import open_frames
from nolbo_ppl.data.sequences.undistorted import UndistortedFrames, guessed_camera, without_distortion
from nolbo_ppl.data.sequences.video import VideoFile
from nolbo_ppl.io.camera_files import CameraIntrinsics, read_camera, read_intrinsics, write_camera
from nolbo_ppl.io.text import read_lengths, read_times

__all__ = [
    "CameraIntrinsics",
    "FrameSequence",
    "ImageFolder",
    "TumFolder",
    "UndistortedFrames",
    "VideoFile",
    "guessed_camera",
    "open_frames",
    "read_camera",
    "read_intrinsics",
    "read_lengths",
    "read_times",
    "without_distortion",
    "write_camera",
]
