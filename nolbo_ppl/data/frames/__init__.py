"""Sequences of frames: folders of images, TUM RGB-D folders and video files, read one at a time; camera intrinsics."""

from __future__ import annotations

from nolbo_ppl.data.frames.intrinsics import CameraIntrinsics, read_camera, read_intrinsics, write_camera
from nolbo_ppl.data.frames.opening import open_frames
from nolbo_ppl.data.frames.sequence import FrameSequence, ImageFolder, TumFolder, read_lengths, read_times
from nolbo_ppl.data.frames.video import VideoFile

__all__ = [
    "CameraIntrinsics",
    "FrameSequence",
    "ImageFolder",
    "TumFolder",
    "VideoFile",
    "open_frames",
    "read_camera",
    "read_intrinsics",
    "read_lengths",
    "read_times",
    "write_camera",
]
