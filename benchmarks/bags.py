"""A bag of gigabytes, read as a sequence of images: memory, and time against real time.

    python benchmarks/bags.py [--gigabytes 2] [--kind mcap]

Needs the extra `ros`. The bag is written into a folder of its own and deleted. Prints one JSON object; memory is the largest
resident set of a process that reads every frame in order, less that of one that has imported the same.
"""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

SIZE = (640, 480)
RATE = 30.0
"""Frames a second."""


@dataclass(frozen=True)
class Arguments:
    """What to write and read."""

    gigabytes: float = 2.0
    """Size of the bag."""
    kind: Literal["mcap", "db3", "bag"] = "mcap"
    """MCAP, SQLite, or rosbag1."""
    folder: Path | None = None
    """Where it is written; a temporary folder by default."""


def write(path: Path, kind: str, frames: int) -> None:
    """Images of noise at 30 Hz."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    first = kind == "bag"
    store: Any = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
    name = "sensor_msgs/msg/Image"
    pixels = np.random.default_rng(0).integers(0, 256, SIZE[0] * SIZE[1] * 3, dtype=np.uint8)
    with Writer1(path) if first else Writer(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/camera/image", name, typestore=store)
        for k in range(frames):
            stamp = round((1 + k / RATE) * 1e9)
            when = store.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            more = {"seq": k} if first else {}
            header = store.types["std_msgs/msg/Header"](stamp=when, frame_id="camera", **more)
            pixels[:3] = k % 256
            message = store.types[name](header, SIZE[1], SIZE[0], "bgr8", 0, SIZE[0] * 3, pixels)
            data = store.serialize_ros1(message, name) if first else store.serialize_cdr(message, name)
            writer.write(connection, stamp, data)


def read(path: str) -> dict[str, Any]:
    """Every frame in order, in this process."""
    from nolbo_ppl.data.sequences import open_frames

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin, work = time.perf_counter(), time.process_time()
    frames = open_frames(path)
    opened = time.perf_counter() - begin
    good = all(frames.frame(k)[0, 0, 0] == k % 256 for k in range(len(frames)))
    seconds, cpu = time.perf_counter() - begin, time.process_time() - work
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "frames": len(frames),
        "right": bool(good),
        "opening_seconds": round(opened, 2),
        "seconds": round(seconds, 2),
        "cpu_seconds": round(cpu, 2),
        "times_real_time": round(len(frames) / RATE / seconds, 2),
        "memory_before_mb": round(before / 1024),
        "memory_peak_mb": round(peak / 1024),
    }


def main() -> None:
    """Write, read in a process of its own, delete."""
    if sys.argv[1:2] == ["--read"]:
        print(json.dumps(read(sys.argv[2])))
        return
    arguments = tyro.cli(Arguments)
    frames = round(arguments.gigabytes * 1e9 / (SIZE[0] * SIZE[1] * 3))
    folder = Path(tempfile.mkdtemp(prefix="bags-", dir=arguments.folder))
    try:
        path = folder / ("drive.bag" if arguments.kind == "bag" else "drive")
        write(path, arguments.kind, frames)
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        done = subprocess.run([sys.executable, __file__, "--read", str(path)], capture_output=True, text=True, check=True)
        print(json.dumps({"kind": arguments.kind, "bytes": size, **json.loads(done.stdout)}, indent=1))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
