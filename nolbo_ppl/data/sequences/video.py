"""Frames of a video file, decoded when they are asked for."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from nolbo_ppl.data.sequences.image_sequence import FrameSequence
from nolbo_ppl.errors import input_error

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
"""Files that are opened as videos."""


class VideoFile(FrameSequence):
    """A video file. Frames in order cost one decoding; a step back starts from the beginning.

    Opening it runs over the file once: numbers of frames in headers are often wrong, and seeking is by key frames.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        """Count the frames. Raises `InputError` for a file that is missing or no video."""
        self.path = Path(path)
        if not self.path.is_file():
            raise input_error("no such video", file=self.path)
        self._capture: Any
        self._next = 0
        self._times: list[float] = []
        self._rewind()
        while self._capture.grab():
            self._times.append(self._stamp())
        if not self._times:
            raise input_error("no frame in the video", expected="a file OpenCV can decode", file=self.path)
        # A container without time stamps reports zeros: then the rate of frames, where known, tells the time.
        self._timed = len(self._times) == 1 or bool((np.diff(self._times) > 0).all())
        self._rewind()
        width, height = (int(self._capture.get(key)) for key in (3, 4))  # CAP_PROP_FRAME_WIDTH, CAP_PROP_FRAME_HEIGHT
        self._size = (width, height)

    def _rewind(self) -> None:
        import cv2

        if hasattr(self, "_capture"):
            self._capture.release()
        self._capture = cv2.VideoCapture(str(self.path))
        self._next = 0
        if not self._capture.isOpened():
            raise input_error("not a video", expected="a file OpenCV can decode", file=self.path)

    def _stamp(self) -> float:
        return float(self._capture.get(0)) / 1000.0  # CAP_PROP_POS_MSEC

    def __len__(self) -> int:
        return len(self._times)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self._size

    def frame(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """Frame k in RGB."""
        self.check(k)
        if k < self._next:
            self._rewind()
        good = True
        while good and self._next < k:
            good = self._capture.grab()
            self._next += 1
        image = None
        if good:
            good, image = self._capture.read()
            self._next += 1
        if not good or image is None:
            raise input_error(f"frame {k} cannot be decoded", file=self.path)
        return np.ascontiguousarray(image[..., ::-1])

    def time(self, k: int, /) -> float | None:
        """Time of frame k in s."""
        self.check(k)
        if self._timed:
            return self._times[k]
        rate = float(self._capture.get(5))  # CAP_PROP_FPS
        return k / rate if rate > 0 else None

    def name(self, k: int, /) -> str:
        """File name and number of frame k."""
        self.check(k)
        return f"{self.path.name}#{k:06d}"

    def close(self) -> None:
        """Release the file; a later frame opens it anew."""
        self._capture.release()
        self._next = len(self) + 1
