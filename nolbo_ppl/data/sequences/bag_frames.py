"""Frames of a topic of a ROS bag, decoded when they are asked for."""

from __future__ import annotations

from os import PathLike

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.data.sequences.image_sequence import DEPTH_TOLERANCE, FrameSequence
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.ros_bags import IMAGES, TopicCursor, split_topic
from nolbo_ppl.io.ros_messages import depth_of, image_of
from nolbo_ppl.io.trajectories import match_times


class BagFrames(FrameSequence):
    """Images of a bag, one message in memory at a time; frames in order cost one pass over the bag.

    Args:
        path: the bag, or `BAG:/topic`.
        topic: topic of the images; the only one that has some by default.
        depth: `BAG:/topic` of depth images: a frame has that one within 20 ms.

    Raises:
        InputError: not a bag, no such topic (lists those there are), one of another type, or a damaged message.
    """

    def __init__(self, path: str | PathLike[str], topic: str | None = None, depth: str | PathLike[str] | None = None) -> None:
        self.path, named = split_topic(path)
        if topic is not None and named is not None and topic != named:
            raise input_error("two topics of images", got=f"{named} and --topic {topic}", expected="one", file=self.path)
        self._images = TopicCursor(self.path, topic or named, IMAGES, "images")
        self.topic = self._images.topic.name
        self._depth: TopicCursor | None = None
        self._depth_of: dict[int, int] = {}
        if depth is not None:
            file, name = split_topic(depth)
            self._depth = TopicCursor(file, name, IMAGES, "depth images")
            rows, partners = match_times(self._images.times, self._depth.times, DEPTH_TOLERANCE)
            self._depth_of = dict(zip(rows.tolist(), partners.tolist()))
        first = self.image(0)
        self._size = (first.shape[1], first.shape[0])

    def __len__(self) -> int:
        return len(self._images)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the first frame, px."""
        return self._size

    @property
    def times(self) -> Float[np.ndarray, " n"]:
        """Times of all frames, s: the stamps of their headers."""
        return self._images.times

    def image(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """Frame k in RGB, at its own size."""
        self.check(k)
        return image_of(self._images.message(k), self.name(k), self.path)

    def frame(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """Frame k in RGB."""
        image = self.image(k)
        found = (image.shape[1], image.shape[0])
        if found != self.size:
            got, expected = f"{found[0]} x {found[1]} px", f"{self.size[0]} x {self.size[1]} px as the first"
            raise input_error(f"image of another size: {self.name(k)}", got=got, expected=expected, file=self.path)
        return image

    def time(self, k: int, /) -> float:
        """Time of frame k, s."""
        self.check(k)
        return float(self._images.times[k])

    def name(self, k: int, /) -> str:
        """Topic and number of frame k."""
        self.check(k)
        return f"{self.topic.strip('/').replace('/', '_')}#{k:06d}"

    @property
    def has_depth(self) -> bool:
        """Whether some frames bring depth images."""
        return bool(self._depth_of)

    def depth(self, k: int, /) -> Float[np.ndarray, "h w"] | None:
        """Depth of frame k, m, 0 where unknown; None where no depth image was taken within 20 ms."""
        self.check(k)
        if self._depth is None or k not in self._depth_of:
            return None
        values = depth_of(self._depth.message(self._depth_of[k]), f"{self._depth.topic.name}#{k}", self.path)
        if values.shape != (self.size[1], self.size[0]):
            got = f"{values.shape[1]} x {values.shape[0]} px"
            raise input_error(f"depth image of another size than {self.name(k)}", got=got, expected=self.size, file=self.path)
        return values
