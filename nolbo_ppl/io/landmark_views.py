"""Pictures of the views of each landmark, in the folder of its crops: `views.json` lists the files in `views`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nolbo_ppl.io.fields import is_number
from nolbo_ppl.io.files import inside, read_json_object

VIEWS = "views"
"""Folder and list of the landmarks' views, within the folder of their crops."""


@dataclass(frozen=True)
class LandmarkView:
    """One picture of a landmark."""

    frame: int
    """Keyframe."""
    file: Path
    """The picture."""
    weight: float
    """Probability that what is seen is the landmark."""
    objectness: float
    """Probability that it is an object."""


@dataclass(frozen=True)
class LandmarkViews:
    """The pictures of a landmark."""

    count: int
    """How often it was seen; a picture may not have been kept of each."""
    pictures: tuple[LandmarkView, ...]
    """Those that were, in order of the frames."""


def view_of(row: object, crops: Path) -> LandmarkView | None:
    """A row of the list; None for one that is malformed, or whose file is not one of the views: the list may be from anywhere."""
    if not isinstance(row, dict) or not isinstance(row.get("file"), str) or not is_number(row.get("frame"), 0):
        return None
    path = inside(crops, f"{VIEWS}/{row['file']}")
    if path is None or path.parent != crops / VIEWS or not path.is_file():
        return None
    weight, objectness = (float(row[key]) if is_number(row.get(key), 0) else 1.0 for key in ("weight", "objectness"))
    return LandmarkView(int(row["frame"]), path, weight, objectness)


def read_views(crops: Path) -> dict[str, LandmarkViews]:
    """Views of each landmark that `views.json` lists, by its name; empty without a list.

    Raises:
        InputError: a list that is no JSON object.
    """
    file, found = crops / f"{VIEWS}.json", dict[str, LandmarkViews]()
    for name, seen in (read_json_object(file) if file.is_file() else {}).items():
        rows = seen.get("views") if isinstance(seen, dict) else None
        if isinstance(rows, list) and is_number(seen.get("count"), 0):
            views = [view for row in rows if (view := view_of(row, crops)) is not None]
            found[name] = LandmarkViews(int(seen["count"]), tuple(views))
    return found
