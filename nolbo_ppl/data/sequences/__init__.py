"""Sequences of frames: folders of images, TUM RGB-D folders, videos and ROS bags, read one at a time; camera intrinsics."""

from __future__ import annotations

from nolbo_ppl.data.sequences.bag_frames import BagFrames
from nolbo_ppl.data.sequences.image_sequence import FrameSequence, ImageFolder, TumFolder
from nolbo_ppl.data.sequences.opening import open_frames
from nolbo_ppl.data.sequences.undistorted import (
    UndistortedFrames,
    frames_with_camera,
    guessed_camera,
    recorded_camera,
    without_distortion,
)
from nolbo_ppl.data.sequences.video import VideoFile
from nolbo_ppl.io.camera_files import CameraIntrinsics, read_camera, read_intrinsics, write_camera
from nolbo_ppl.io.text import read_lengths, read_times

__all__ = [
    "BagFrames",
    "CameraIntrinsics",
    "FrameSequence",
    "ImageFolder",
    "TumFolder",
    "UndistortedFrames",
    "VideoFile",
    "frames_with_camera",
    "guessed_camera",
    "open_frames",
    "read_camera",
    "read_intrinsics",
    "read_lengths",
    "read_times",
    "recorded_camera",
    "without_distortion",
    "write_camera",
]
