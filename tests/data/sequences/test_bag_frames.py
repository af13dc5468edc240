"""A bag is streamed: of one of 60 MB no more than a few chunks lie in memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.data.sequences import open_frames
from tests.bags import KINDS, BagWriter, path_of

pytest.importorskip("rosbags")


@pytest.mark.parametrize("kind", KINDS)
def test_memory_does_not_grow_with_the_bag(tmp_path: Path, kind: str) -> None:
    """Python's own allocations, which hold the messages and the images: 66 frames of 0.92 MB."""
    path, frame = path_of(tmp_path, kind), np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    with BagWriter(path, kind) as bag:
        for k in range(66):
            frame[0, 0] = k
            bag.image("/cam", 1.0 + k / 30, frame, "bgr8")
    size = sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]))
    assert size > 60e6
    tracemalloc.start()
    frames = open_frames(path)
    assert [int(frames.frame(k)[0, 0, 0]) for k in range(len(frames))] == list(range(66))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12e6, f"{peak / 1e6:.1f} MB"
