"""Tracks the online system still follows."""

from __future__ import annotations

from dataclasses import dataclass, field

from nolbo_ppl.inference.slam.incremental.running_map import RunningLandmark
from nolbo_ppl.inference.slam.measurements import Measurements


@dataclass
class LiveTrack:
    """A track the tracker still follows."""

    landmark: int
    """Its landmark, -1 while it has none."""
    draft: RunningLandmark
    """What it gathered until then."""
    waiting: list[tuple[int, Measurements]] = field(default_factory=list)
    """Detections that wait for a landmark: keyframe and measurement."""
    last: int = 0
    """Newest frame."""
