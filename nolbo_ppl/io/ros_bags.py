"""Recordings of ROS, without ROS: rosbag1, rosbag2 (SQLite and MCAP) and single MCAP files (extra `ros`: the package rosbags).

A bag is named by its path; one topic of it by `PATH:/topic`, wherever a verb takes a file. Messages are read one at a time: what
a bag holds never lies in memory at once. Types come from the package's own definitions; of what a bag states about its types
only the definitions of `vision_msgs` are used, which differ between versions.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import InputError, input_error

SUFFIXES = (".bag", ".mcap", ".db3")
"""Endings of bags that are one file."""
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERAS = ("sensor_msgs/msg/CameraInfo",)
POSES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
DETECTIONS = ("vision_msgs/msg/Detection3DArray", "vision_msgs/msg/Detection2DArray")
TRANSFORMS = ("tf2_msgs/msg/TFMessage",)
READ = (*IMAGES, *CAMERAS, *POSES, *DETECTIONS, *TRANSFORMS)
"""Types of messages that are read."""
NEAR = 8
"""Messages that are passed over rather than looked up anew."""


@dataclass(frozen=True)
class Topic:
    """One topic of a bag."""

    name: str
    """Its name."""
    type: str
    """Type of its messages, as ROS 2 writes it."""
    count: int
    """Number of its messages."""


def split_topic(path: str | PathLike[str]) -> tuple[Path, str | None]:
    """The file and the topic of `PATH:/topic`; no topic where there is none.

    Example:
        >>> split_topic("drive.mcap:/camera/image"), split_topic("drive.mcap")
        ((PosixPath('drive.mcap'), '/camera/image'), (PosixPath('drive.mcap'), None))
    """
    path = Path(path)
    before, colon, topic = str(path).rpartition(":/")
    return (Path(before), "/" + topic) if colon and not path.exists() and looks_like_bag(Path(before)) else (path, None)


def looks_like_bag(path: Path) -> bool:
    """Whether a path, without a topic, is that of a bag: by its ending, or a folder with `metadata.yaml`."""
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").is_file()


def is_bag(path: str | PathLike[str]) -> bool:
    """Whether a path is that of a bag, with or without a topic."""
    return looks_like_bag(split_topic(path)[0])


@contextmanager
def _reading(path: Path, what: str) -> Iterator[None]:
    """Whatever damaged bytes make the reader run into becomes an `InputError` that names the bag."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # the reader raises errors of its own, of SQLite, of struct, of decompressors, of absurd lengths
        text = " ".join(str(error).split()) or type(error).__name__
        do = "was it cut short? `ros2 bag reindex` or `rosbag reindex` mend bags that were not closed"
        raise input_error(what, got=text, do=do, file=path) from None


class Bag:
    """An open bag.

    Args:
        path: `*.bag`, `*.mcap`, `*.db3`, or the folder of a rosbag2 recording.

    Raises:
        InputError: the extra `ros` is not installed, no such file, or not a bag that can be read; names it.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        try:
            from rosbags.rosbag1 import Reader as Reader1
            from rosbags.rosbag2 import Reader as Reader2
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            do = "install the extra: pip install 'nolbo-ppl[ros]'"
            raise input_error("bags need the package rosbags", do=do, file=self.path) from None
        if not self.path.exists():
            raise input_error("no such bag", file=self.path)
        first = self.path.suffix.lower() == ".bag"
        with _reading(self.path, "not a readable bag"):
            self._reader: Any = Reader1(self.path) if first else Reader2(self.path)
            self._reader.open()
            self._store: Any = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
            self._first = first
            self._register()
            self.topics = {
                name: Topic(name, info.msgtype or "several types", info.msgcount) for name, info in self._reader.topics.items()
            }

    def _register(self) -> None:
        """Definitions that the package lacks: vision_msgs as the bag states them, or else those of its version 4."""
        from rosbags.interfaces import MessageDefinitionFormat
        from rosbags.typesys import get_types_from_msg

        from nolbo_ppl.io.ros_definitions import VISION, WRITTEN

        texts = {
            connection.msgtype: connection.msgdef.data
            for connection in self._reader.connections
            if connection.msgtype in VISION and connection.msgdef.format == MessageDefinitionFormat.MSG
        }  # stated ones first: they decide what their parts are
        for name, text in (texts | {name: VISION[name] for name in VISION if name not in texts} | WRITTEN).items():
            package = name.split("/")[0] + "/"
            types = get_types_from_msg(text, name)
            self._store.register({k: v for k, v in types.items() if k.startswith(package) and k not in self._store.types})

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def of_types(self, types: Collection[str]) -> list[Topic]:
        """Topics of these types that hold messages, in order of their names."""
        return [topic for _, topic in sorted(self.topics.items()) if topic.type in types and topic.count]

    def listed(self) -> str:
        """All topics in words, those that can be read first."""
        order = sorted(self.topics.values(), key=lambda topic: (topic.type not in READ, topic.name))
        return ", ".join(f"{topic.name} ({topic.type}, {topic.count})" for topic in order) or "no topic"

    def topic(self, name: str | None, types: Collection[str], what: str) -> Topic:
        """The topic of a name, or the only one of these types.

        Raises:
            InputError: no such topic, one of another type or without messages, or several to choose from; lists the topics.
        """
        if name is not None:
            found = self.topics.get(name)
            if found is None:
                raise input_error(f"no topic {name}", got=self.listed(), file=self.path)
            if found.type not in types:
                raise input_error(f"topic {name} is no {what}", got=found.type, expected=" or ".join(types), file=self.path)
            if not found.count:
                raise input_error(f"topic {name} has no messages", file=self.path)
            return found
        fitting = self.of_types(types)
        if len(fitting) != 1:
            several = f"several topics of {what}" if fitting else f"no topic of {what}"
            got = ", ".join(topic.name for topic in fitting) or self.listed()
            do = f"name one: {self.path.name}:/topic" if fitting else None
            raise input_error(several, got=got, expected="one of type " + " or ".join(types), do=do, file=self.path)
        return fitting[0]

    def raw(self, topic: str, start: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Time of recording, ns, and bytes of every message of a topic, from a time on."""
        connections = [one for one in self._reader.connections if one.topic == topic]
        with _reading(self.path, f"topic {topic} cannot be read"):
            for _, time, data in self._reader.messages(connections, start=start):
                yield time, data

    def decode(self, topic: str, data: bytes) -> Any:
        """A message of its bytes. Raises `InputError` naming the bag and the topic."""
        with _reading(self.path, f"a message of {topic} cannot be read"):
            kind = self.topics[topic].type
            return self._store.deserialize_ros1(data, kind) if self._first else self._store.deserialize_cdr(data, kind)

    def messages(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Time, s, and every message of a topic: its own stamp, that of recording where it has none."""
        for time, data in self.raw(topic):
            message = self.decode(topic, data)
            yield _seconds(getattr(message, "header", None), time), message

    def stamp(self, data: bytes, recorded: int) -> int:
        """Time of the header that a message begins with, ns, without decoding it; that of recording where it is zero."""
        if self._first:
            seconds, nanoseconds = struct.unpack_from("<II", data, 4)
        else:
            seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
        return seconds * 10**9 + nanoseconds or recorded


def _seconds(header: Any, recorded: int) -> float:
    if header is None or not (header.stamp.sec or header.stamp.nanosec):
        return recorded * 1e-9
    return float(header.stamp.sec + header.stamp.nanosec * 1e-9)


class TopicCursor:
    """The messages of a topic by number: in order they cost one pass; elsewhere the bag's index leads.

    Opening it runs over the topic once, for the times. Each has the bag open for itself.

    Args:
        path: the bag.
        name: the topic, None for the only one of these types.
        types: types of messages that are wanted.
        what: what they are, for messages to the user.

    Raises:
        InputError: see `Bag` and `Bag.topic`, or times that do not increase.
    """

    def __init__(self, path: Path, name: str | None, types: Collection[str], what: str) -> None:
        self.bag = Bag(path)
        self.topic = self.bag.topic(name, types, what)
        recorded: list[int] = []
        stamps: list[int] = []
        for time, data in self.bag.raw(self.topic.name):
            recorded.append(time)
            with _reading(path, f"a message of {self.topic.name} cannot be read"):
                stamps.append(self.bag.stamp(data, time))
        self._recorded: Int[np.ndarray, " n"] = np.array(recorded, dtype=np.int64)
        times = np.array(stamps, dtype=np.int64)
        if not len(times):
            raise input_error(f"topic {self.topic.name} has no messages", file=path)
        if (np.diff(times) <= 0).any():
            times = self._recorded  # drivers that do not stamp, or two cameras on one topic
        if (np.diff(times) <= 0).any():
            k = int(np.argmax(np.diff(times) <= 0)) + 1
            raise input_error(f"times of {self.topic.name} do not increase", got=f"message {k}", file=path)
        self.times: Float[np.ndarray, " n"] = times * 1e-9
        self._messages: Iterator[tuple[int, bytes]] | None = None
        self._next = 0

    def __len__(self) -> int:
        return len(self.times)

    def message(self, k: int) -> Any:
        """Message k. Raises `InputError` when it cannot be read."""
        if self._messages is None or not self._next <= k <= self._next + NEAR:
            first = int(np.searchsorted(self._recorded, self._recorded[k]))
            self._messages, self._next = self.bag.raw(self.topic.name, int(self._recorded[k])), first
        for _, data in self._messages:
            self._next += 1
            if self._next == k + 1:
                return self.bag.decode(self.topic.name, data)
        self._messages = None
        raise input_error(f"message {k} of {self.topic.name} is gone", do="did the bag change meanwhile?", file=self.bag.path)
