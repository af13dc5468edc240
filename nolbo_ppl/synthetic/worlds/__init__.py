"""Drives: generated worlds, a camera on a closed path through them, and the truth of every frame."""

from nolbo_ppl.synthetic.worlds.sequence_folder import DriveSummary, write_drive
from nolbo_ppl.synthetic.worlds.sequence_reader import DriveObject, SequenceFolder, read_drive, read_objects
from nolbo_ppl.synthetic.worlds.world import World, make_world
from nolbo_ppl.synthetic.worlds.world_config import DriveConfig, drive_preset
from nolbo_ppl.synthetic.worlds.world_frame import RenderedFrame, render_frame

__all__ = [
    "SequenceFolder",
    "DriveConfig",
    "DriveObject",
    "DriveSummary",
    "RenderedFrame",
    "World",
    "drive_preset",
    "make_world",
    "read_drive",
    "read_objects",
    "render_frame",
    "write_drive",
]
