"""One labelled image: what is known stands in arrays, what is not is NaN, -1 or None."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.scenes import annotations_record, parse_record
from nolbo_ppl.structures.annotations import ARRAYS, Annotations

CAMERA = [100.0, 100.0, 50.0, 40.0]


def line(**change: object) -> dict[str, object]:
    thing = {"box": [1, 2, 30, 40], "category": "car", "instance": "a", "id": "O7", "rotation": [0, 0, 0, 1], **change}
    return {"image": "x.png", "intrinsics": CAMERA, "objects": [thing, {"box": [0, 0, 5, 5]}], "ignore": [[50, 0, 60, 9]]}


def parsed(row: dict[str, object]) -> Annotations:
    return parse_record(row, Path("scenes.jsonl"), 3, ("bus", "car"), (100, 80), Path("x.png"), {"car": 2})


def test_a_line_of_labels() -> None:
    seen = parsed({**line(position=[0, 0, 4], size=2.5, visibility=0.25), "exhaustive": ["car"]})
    assert len(seen) == 2 and seen.category == ("car", None) and seen.instance == ("a", None) and seen.id == ("O7", None)
    assert seen.labels(("bus", "car")).tolist() == [1, -1] and seen.labels(("bus",)).tolist() == [-1, -1]
    np.testing.assert_array_equal(seen.R_camera_object[0], np.eye(3))
    assert np.isnan(seen.R_camera_object[1]).all() and np.isnan(seen.position[1]).all()
    assert seen.symmetry.tolist() == [2, 1] and seen.visibility.tolist() == [0.25, 1.0]
    assert seen.diagonal[0] == 2.5 and np.isnan(seen.diagonal[1])
    assert seen.exhaustive == ("car",) and seen.ignore.tolist() == [[50.0, 0.0, 60.0, 9.0]]
    assert seen.side.tolist() == [38.0, 5.0]
    assert seen.counts().tolist() == [False, False] and seen.counts(min_visibility=0.2).tolist() == [True, False]
    assert seen.file == Path("x.png")
    with pytest.raises(InputError, match="labels without their image"):
        _ = seen.image


def test_what_was_read_is_written_as_the_same_line() -> None:
    """Every field, and objects of which little is known."""
    row = {**line(position=[0.1, 0, 4], size=2.5, dimensions=[2.0, 1.2, 0.9], visibility=0.25, symmetry=2), "exhaustive": ["car"]}
    seen = parsed(row)
    again = annotations_record(seen, "x.png")
    bare = {"box": [0, 0, 5, 5], "visibility": 1.0, "symmetry": 1}
    assert again == {**row, "objects": [row["objects"][0], bare]}  # type: ignore[index]
    twice = parsed(again)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(twice, name), getattr(seen, name), err_msg=name)
    assert parsed(line(dimensions=[2.0, 1.0, 2.0])).diagonal[0] == 3.0  # the box's diagonal, where only its sides are stated


@pytest.mark.parametrize("exhaustive", ["car", ["tram"], [["car"]], [3]])
def test_categories_that_are_labelled_throughout_are_known_ones(exhaustive: object) -> None:
    with pytest.raises(InputError, match=r"scenes.jsonl:3: exhaustive: .*bus, car"):
        parsed({**line(), "exhaustive": exhaustive})


def test_an_image_without_objects() -> None:
    none = parsed({"image": "x.png", "intrinsics": CAMERA, "objects": []})
    assert len(none) == 0 and none.counts().shape == (0,) and none.labels(("car",)).shape == (0,) and none.side.shape == (0,)
    assert none.exhaustive is None and none.ignore.shape == (0, 4)


def test_some_of_the_objects() -> None:
    rng = np.random.default_rng(0)
    seen = Annotations.from_arrays(
        CAMERA,
        rng.random((3, 4)),
        category=["a", "b", None],
        id=["x", "y", "z"],
        position=[None, [0, 0, 1], [0, 0, 2]],
        voxels=np.arange(12, dtype=np.uint8).reshape(3, 4),
    )
    part = seen.select(np.array([True, False, True]))
    assert part.id == ("x", "z") and part.category == ("a", None)
    for name in (*ARRAYS, "voxels"):
        np.testing.assert_array_equal(getattr(part, name), getattr(seen, name)[[0, 2]])
    assert np.isnan(seen.position[0]).all() and seen.position[2, 2] == 2


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"category": ["car"]}, "category of labelled objects: got 1, expected 2"),
        ({"position": [[0, 0, 1]]}, r"position of labelled objects: .*expected 2 of \(3,\)"),
        ({"diagonal": [1.0, [2.0]]}, "diagonal of labelled objects"),
        ({"voxels": np.zeros((3, 4), np.uint8)}, "voxels of labelled objects: got 3"),
    ],
)
def test_lengths_must_match(change: dict[str, object], match: str) -> None:
    with pytest.raises(InputError, match=match):
        Annotations.from_arrays(CAMERA, np.ones((2, 4)), **change)  # type: ignore[arg-type]
