"""True objects of a drive (`objects.json`): which object each detection is of, where the objects stand, what they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import is_rotation
from nolbo_ppl.io.fields import number_array
from nolbo_ppl.io.files import existing_file, read_json, read_json_object

CLUTTER, UNKNOWN = -1, -2
"""In place of an object's number: a detection of nothing, and one of which nobody says what it is of."""


BY_OBJECT = ("T_world_object", "categories", "latents")
"""What the file tells by object."""


@dataclass(frozen=True)
class TrueObjects:
    """The truth about detections and objects."""

    object_of: Int[np.ndarray, " k"]
    """Number of the object of each detection; `CLUTTER`, `UNKNOWN`."""
    T_world_object: Float[np.ndarray, "m 4 4"]
    """Pose of each object in the truth's world; NaN where it is not known."""
    category: tuple[str | None, ...]
    """Category of each object, None where it is not known."""
    latent: Float[np.ndarray, "m d"] | None = None
    """Shape latent of each object, where there are latents."""


def read_true_objects(path: str | PathLike[str], ids: Sequence[str]) -> TrueObjects:
    """Read `objects.json` as `nolbo simulate` and `nolbo convert` write it: `objects` by detection, `T_world_object` and, where
    they are known, `categories` and `latents` by object.

    Args:
        path: the file.
        ids: identifiers of the detections, in their order; those that the file does not name are `UNKNOWN`.

    Raises:
        InputError: no such file, no `objects`, none of the detections named, or a pose or latent that is none; names the file.
    """
    path = Path(existing_file(path))
    value = read_json_object(path)
    objects = value.get("objects")
    if not isinstance(objects, dict) or not all(isinstance(x, str) or x is None for x in objects.values()):
        raise input_error("true objects", expected="`objects`: a name or null by detection", file=path)
    if len(ids) and not any(name in objects for name in ids):
        raise input_error("true objects of other detections", got=list(objects)[:3], expected=list(ids)[:3], file=path)
    poses, categories, latents = (value.get(name) or {} for name in BY_OBJECT)
    for name, part in zip(BY_OBJECT, (poses, categories, latents)):
        if not isinstance(part, dict):
            raise input_error(f"`{name}` of true objects", got=repr(part)[:80], expected="values by object", file=path)
    names = sorted({x for x in objects.values() if x is not None} | set(poses))
    number = {name: k for k, name in enumerate(names)}
    of = [number[objects[i]] if objects.get(i) is not None else (CLUTTER if i in objects else UNKNOWN) for i in ids]
    T = np.full((len(names), 4, 4), np.nan)
    for name, pose in poses.items():
        given = number_array(pose, (4, 4))
        if given is None or not is_rotation(given[:3, :3]):
            raise input_error(f"pose of object {name!r}", got=pose, expected="a 4 x 4 rigid motion", file=path)
        T[number[name]] = given
    latent = None
    if latents:
        rows = {name: number_array(x, (None,)) for name, x in latents.items()}
        lengths = {None if x is None else len(x) for x in rows.values()}
        if None in lengths or len(lengths) > 1:
            raise input_error("latents of objects", got=sorted(map(str, lengths)), expected="numbers, one length", file=path)
        latent = np.full((len(names), int(next(iter(lengths)) or 0)), np.nan)
        for name, x in rows.items():
            if name in number:
                latent[number[name]] = x
    category = tuple(categories.get(name) if isinstance(categories.get(name), str) else None for name in names)
    return TrueObjects(np.array(of, dtype=np.int64), T, category, latent)


def trusted_objects(path: str | PathLike[str]) -> dict[str, str | None] | None:
    """True object of each detection by its id, None for clutter, without the rows whose truth is not trusted.

    As converters and runs write `objects.json`; None for other files of that name, which say nothing of detections.

    Raises:
        InputError: no such file, or no JSON.
    """
    value = read_json(path)
    found = value.get("objects") if isinstance(value, dict) else None
    if not isinstance(found, dict):
        return None
    trusted = value.get("trusted")
    kept = trusted if isinstance(trusted, list) and len(trusted) == len(found) else [True] * len(found)
    return {str(name): None if of is None else str(of) for (name, of), keep in zip(found.items(), kept) if keep}
