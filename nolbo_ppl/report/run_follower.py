"""A run that is still going, in the viewer: the folder is looked at again and again, and what its stages add is shown."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from nolbo_ppl.errors import NolboError
from nolbo_ppl.io.files import read_json_object
from nolbo_ppl.io.run_folder import RECORD, RunFolder
from nolbo_ppl.report.viewer import Viewer, build_viewer

if TYPE_CHECKING:
    from viser import ViserServer

WATCHED = (
    RECORD,
    "frames.jsonl",
    "odometry.txt",
    "truth.txt",
    "observations.jsonl",
    "trajectory.txt",
    "landmarks.json",
    "slam/trajectory.txt",
    "slam/landmarks.json",
    "map.glb",
    "summary.json",
)
"""Files of the stages, each of which appears complete or not at all."""
Stamp = tuple[tuple[str, int, int], ...]


def stamp_of(folder: Path) -> Stamp:
    """Names, times and sizes of a run's files: it differs when a stage has ended, or has been taken away to be done again."""
    found = []
    for name in WATCHED:
        try:
            stat = (folder / name).stat()
        except OSError:
            continue
        found.append((name, stat.st_mtime_ns, stat.st_size))
    return tuple(found)


def stage_text(folder: Path) -> str:
    """Which stages are complete, in words; empty for a folder that is not a run's."""
    try:
        record = read_json_object(folder / RECORD) if (folder / RECORD).is_file() else {}
    except NolboError:  # written by somebody else, or gone meanwhile
        return ""
    complete = record.get("complete")
    if not isinstance(complete, list):
        return ""
    words = ", ".join(str(name).replace("`", "'") for name in complete)
    return f"Complete: {words}" if words else "No stage is complete yet"


class RunFollower:
    """Shows a run on a server and shows it anew when a stage has ended.

    Args:
        folder: of the run.
        read: reads it; raises `NolboError` while there is nothing to show.
        server: the server; everything on it is taken away before what is new is put there.

    Example:
        >>> import tempfile
        >>> stamp_of(Path(tempfile.mkdtemp()))
        ()
    """

    def __init__(self, folder: Path, read: Callable[[], RunFolder], server: ViserServer) -> None:
        self.folder, self._read, self._server = folder, read, server
        self.viewer: Viewer | None = None
        self._shown: Stamp | None = None

    def refresh(self) -> bool:
        """Look at the folder; returns whether it was shown anew.

        A folder that cannot be read, for a stage is being written or taken away, is looked at again the next time; what was
        shown stays.
        """
        stamp = stamp_of(self.folder)
        if stamp == self._shown:
            return False
        try:
            run = self._read()
        except (NolboError, OSError):
            if self.viewer is None and self._shown is None:
                self._server.gui.reset()
                self._server.gui.add_markdown("Waiting for the first stage of the run.")
            return False
        if stamp_of(self.folder) != stamp:  # it changed while it was read
            return False
        self._server.scene.reset()
        self._server.gui.reset()
        self.viewer = build_viewer(run, self._server)
        text = stage_text(self.folder)
        if text:
            self.viewer.gui["stages"] = self._server.gui.add_markdown(text)
        self._shown = stamp
        return True
