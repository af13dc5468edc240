"""Drives: generated worlds, a camera on a closed path through them, and the truth of every frame."""

from typing import TYPE_CHECKING

from nolbo_ppl._moved import renamed
from nolbo_ppl.synthetic.worlds.sequence_folder import SequenceSummary, write_sequence_folder
from nolbo_ppl.synthetic.worlds.sequence_reader import SequenceFolder, SequenceObject, read_objects, read_sequence_folder
from nolbo_ppl.synthetic.worlds.world import World, make_world
from nolbo_ppl.synthetic.worlds.world_config import SequenceConfig, sequence_preset
from nolbo_ppl.synthetic.worlds.world_frame import RenderedFrame, render_frame

__all__ = [
    "SequenceFolder",
    "SequenceConfig",
    "SequenceObject",
    "SequenceSummary",
    "RenderedFrame",
    "World",
    "sequence_preset",
    "make_world",
    "read_sequence_folder",
    "read_objects",
    "render_frame",
    "write_sequence_folder",
]


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
