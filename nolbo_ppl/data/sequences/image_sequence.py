"""Frames in files: any folder of images, and the RGB-D folders of TUM."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import inside, is_file
from nolbo_ppl.io.images import IMAGE_SUFFIXES, image_size, list_images, open_depth_image, open_image
from nolbo_ppl.io.text import read_words
from nolbo_ppl.io.trajectories import match_times

TUM_DEPTH_UNIT = 1.0 / 5000.0
"""Metres of one grey value of a TUM depth image."""
DEPTH_TOLERANCE = 0.02
"""A depth image belongs to a frame when their times differ by no more, s."""


class FrameSequence(ABC):
    """Frames in order of time, read when they are asked for."""

    path: Path
    """What was opened."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of frames."""

    @abstractmethod
    def frame(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """Frame k in RGB.

        Raises:
            InputError: no such frame, a file that is no image, or one of another size than the first.
        """

    def image(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """Frame k in RGB, at its own size where the sizes of a folder's images differ.

        Raises:
            InputError: no such frame, or a file that is no image.
        """
        return self.frame(k)

    @abstractmethod
    def time(self, k: int, /) -> float | None:
        """Time of frame k in s; None where nothing tells it. Raises `InputError` for a frame that is not there."""

    @abstractmethod
    def name(self, k: int, /) -> str:
        """Name of frame k: its file, or its number in the video. Raises `InputError` for a frame that is not there."""

    @property
    @abstractmethod
    def size(self) -> tuple[int, int]:
        """Width and height of the frames, px."""

    @property
    def times(self) -> Float[np.ndarray, " n"] | None:
        """Times of all frames in s; None unless all are known."""
        stamps = [self.time(k) for k in range(len(self))]
        return None if any(stamp is None for stamp in stamps) else np.array(stamps, dtype=np.float64)

    @property
    def has_depth(self) -> bool:
        """Whether frames bring depth images."""
        return False

    def depth(self, k: int, /) -> Float[np.ndarray, "h w"] | None:
        """Depth of frame k in m, 0 where unknown; None where there is no depth image."""
        self.check(k)
        return None

    def check(self, k: int) -> None:
        """Raise `InputError` unless there is a frame k."""
        if not 0 <= k < len(self):
            raise input_error("no such frame", got=k, expected=f"0 to {len(self) - 1}", file=self.path)


list_frames = list_images  # its name of 0.1.0


def read_image(path: Path, file: Path | None = None, line: int | None = None) -> UInt8[np.ndarray, "h w 3"]:
    """`open_image`; `file` and `line` name the list that named the image."""
    return open_image(path, named_by=None if file is None else (file, line))


class ImageFolder(FrameSequence):
    """The images of a folder, in natural order of their names."""

    def __init__(
        self,
        path: str | PathLike[str],
        files: Sequence[Path],
        times: Float[np.ndarray, " n"] | None = None,
        listing: tuple[Path, Sequence[int]] | None = None,
    ) -> None:
        """Frames in these files; `listing` is the file that lists them and the line of each, for messages."""
        self.path, self.files, self._times, self._listing = Path(path), list(files), times, listing
        if not self.files:
            raise input_error("no image", expected="files ending in " + ", ".join(IMAGE_SUFFIXES), file=self.path)
        self._size: tuple[int, int] | None = None

    def __len__(self) -> int:
        return len(self.files)

    def _named_by(self, k: int) -> tuple[Path, int] | None:
        return None if self._listing is None else (self._listing[0], self._listing[1][k])

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the first frame, px."""
        if self._size is None:
            self._size = image_size(self.files[0], named_by=self._named_by(0))
        return self._size

    def image(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """Frame k in RGB, at its own size."""
        self.check(k)
        return open_image(self.files[k], named_by=self._named_by(k))

    def frame(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """Frame k in RGB."""
        image = self.image(k)
        found = image.shape[1], image.shape[0]
        if found != self.size:
            raise input_error(
                "image of another size",
                got=f"{found[0]} x {found[1]} px",
                expected=f"{self.size[0]} x {self.size[1]} px as the first",
                file=self.files[k],
            )
        return image

    def time(self, k: int, /) -> float | None:
        """Time of frame k in s."""
        self.check(k)
        return None if self._times is None else float(self._times[k])

    def name(self, k: int, /) -> str:
        """File name of frame k."""
        self.check(k)
        return self.files[k].name


def read_listing(path: Path) -> tuple[list[int], Float[np.ndarray, " n"], list[Path]]:
    """Lines, times and files of a TUM list, `time file` a line. Raises `InputError` naming the line."""
    lines: list[int] = []
    times: list[float] = []
    files: list[Path] = []
    for number, words in read_words(path):
        try:
            stamp = float(words[0])
        except ValueError:
            stamp = float("nan")
        if len(words) != 2 or not np.isfinite(stamp):
            raise input_error(
                "not a row of a TUM list", got=repr(" ".join(words)[:80]), expected="`time file`", file=path, line=number
            )
        if times and stamp <= times[-1]:
            raise input_error("time does not increase", got=words[0], file=path, line=number)
        file = inside(path.parent, words[1], follow=True)
        if file is None:
            raise input_error("image outside of the folder", got=words[1], do="link it into the folder", file=path, line=number)
        if not is_file(file):
            raise input_error("no such image", got=words[1], file=path, line=number)
        lines.append(number)
        times.append(stamp)
        files.append(file)
    if not lines:
        raise input_error("no frame in the list", expected="rows of `time file`", file=path)
    return lines, np.array(times), files


class TumFolder(ImageFolder):
    """A TUM RGB-D folder: `rgb.txt` lists times and images, `depth.txt`, where present, depth images."""

    def __init__(self, path: str | PathLike[str]) -> None:
        """Read the lists. Raises `InputError` naming file and line."""
        path = Path(path)
        lines, times, files = read_listing(path / "rgb.txt")
        super().__init__(path, files, times, (path / "rgb.txt", lines))
        self.depth_files: dict[int, Path] = {}
        if (path / "depth.txt").is_file():
            _, depth_times, depth_files = read_listing(path / "depth.txt")
            rows, partners = match_times(times, depth_times, DEPTH_TOLERANCE)
            self.depth_files = {int(row): depth_files[int(partner)] for row, partner in zip(rows, partners)}

    @property
    def has_depth(self) -> bool:
        """Whether some frames bring depth images."""
        return bool(self.depth_files)

    def depth(self, k: int, /) -> Float[np.ndarray, "h w"] | None:
        """Depth of frame k in m, 0 where unknown; None where no depth image was taken within 20 ms."""
        self.check(k)
        if k not in self.depth_files:
            return None
        file = self.depth_files[k]
        values = open_depth_image(file)
        if values.shape != (self.size[1], self.size[0]):
            raise input_error("depth image of another shape", got=values.shape, expected=(self.size[1], self.size[0]), file=file)
        return values.astype(np.float64) * TUM_DEPTH_UNIT
