"""`objects.json`: what each detection is of, where the objects stand, what they are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.true_objects import CLUTTER, UNKNOWN, read_true_objects

GOOD: dict[str, Any] = {
    "objects": {"a": "o1", "b": None, "c": "o0"},
    "T_world_object": {"o1": np.eye(4).tolist(), "o9": np.eye(4).tolist()},
    "categories": {"o1": "chair"},
    "latents": {"o1": [1.0, 2.0]},
}


def write(folder: Path, **changes: Any) -> Path:
    file = folder / "objects.json"
    file.write_text(json.dumps(GOOD | changes))
    return file


def test_what_is_known_is_read_and_the_rest_is_left_open(tmp_path: Path) -> None:
    found = read_true_objects(write(tmp_path), ["c", "a", "b", "d"])
    np.testing.assert_array_equal(found.object_of, [0, 1, CLUTTER, UNKNOWN])
    assert found.category == (None, "chair", None)
    assert np.isnan(found.T_world_object[0]).all() and (found.T_world_object[1] == np.eye(4)).all()
    assert found.latent is not None and found.latent[1].tolist() == [1.0, 2.0] and np.isnan(found.latent[0]).all()
    assert read_true_objects(write(tmp_path, latents={}), ["a"]).latent is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"objects": [1]}, "a name or null"),
        ({"objects": {"x": "o1"}}, "other detections"),
        ({"T_world_object": {"o1": [[1, 2]]}}, "pose of object 'o1'"),
        ({"T_world_object": {"o1": (2 * np.eye(4)).tolist()}}, "rigid motion"),
        ({"latents": {"o1": [1.0], "o0": [1.0, 2.0]}}, "one length"),
        ({"categories": 1.5}, "`categories` of true objects: got 1.5"),
        ({"T_world_object": [[1]]}, "`T_world_object` of true objects"),
        ({"latents": "x"}, "`latents` of true objects"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read_true_objects(write(tmp_path, **changes), ["a", "b"])
    assert "objects.json" in str(error.value)
