"""Labelled voxel shapes in one file: what is read, what is refused, how they are split."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.data.voxel_archive import read_voxel_archive, stratified_split
from nolbo_ppl.errors import InputError


def write(path: Path, **changes: np.ndarray) -> Path:
    grid = np.random.default_rng(0).random((3, 6, 6, 6)) < 0.4
    grid[1] = False
    arrays = {
        "X": np.packbits(grid.reshape(3, -1), axis=1),
        "y": np.array([1, 0, 1], dtype=np.uint8),
        "classes": np.array(["chair", "sofa"]),
        "shape": np.array([6, 6, 6]),
    }
    np.savez(path, **{**arrays, **changes})
    return path


def test_shapes_are_centred_and_empty_ones_left_out(tmp_path: Path) -> None:
    archive = read_voxel_archive(write(tmp_path / "a.npz"), side=10)
    grid = np.random.default_rng(0).random((3, 6, 6, 6)) < 0.4
    assert archive.names == ("chair", "sofa") and archive.category.tolist() == [1, 1] and len(archive) == 2
    np.testing.assert_array_equal(archive.voxels[:, 2:8, 2:8, 2:8], grid[[0, 2]])
    assert archive.voxels.sum() == grid[[0, 2]].sum()
    assert archive.select(np.array([1])).category.tolist() == [1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": np.array([6, 6, 7])}, "array `shape`"),
        ({"shape": np.array([40, 40, 40])}, "array `shape`"),
        ({"X": np.zeros((3, 5), dtype=np.uint8)}, "array `X`"),
        ({"X": np.zeros((3, 27), dtype=np.uint16)}, "array `X`"),
        ({"y": np.array([0, 1])}, "array `y`"),
        ({"y": np.array([0, 1, 2])}, "array `y`"),
        ({"classes": np.array([0, 1])}, "array `classes`"),
    ],
)
def test_malformed_archives_name_the_array(changes: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read_voxel_archive(write(tmp_path / "a.npz", **changes))


def test_a_split_is_stratified() -> None:
    category = np.repeat([0, 1, 2], [100, 10, 2])
    train, test = stratified_split(category, 0.2, seed=3)
    assert sorted([*train, *test]) == list(range(112))
    assert np.bincount(category[test]).tolist() == [20, 2, 1]
    assert not np.array_equal(test, stratified_split(category, 0.2, seed=4)[1])
    with pytest.raises(InputError, match="share held out"):
        stratified_split(category, 1.0, seed=0)


def test_real_shapes_are_read(data_dir: Path) -> None:
    archive = read_voxel_archive(data_dir / "modelnet10" / "train.npz")
    assert len(archive) == 3984 and len(archive.names) == 10  # seven of 3991 are empty
    assert archive.voxels.reshape(len(archive), -1).any(1).all()
