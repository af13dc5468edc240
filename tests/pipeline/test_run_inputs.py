"""What a run is made from: poses by row and by time, lengths, pictures that belong to images, depth on the way."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.data.sequences import open_frames
from nolbo_ppl.errors import InputError
from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.odometry import GroundHeight, KnownLengths, MeasuredDepth, StepFlag
from nolbo_ppl.pipeline.depth_refinement import DepthScale
from nolbo_ppl.pipeline.perception import DepthImages, SequenceDepth, StereoPairs, beside, observe_sequence
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.pipeline.run_inputs import depth_of_drive, lengths_between, open_run_inputs, scale_of
from nolbo_ppl.pipeline.run_summary import odometry_scores
from nolbo_ppl.structures.detections import Detections
from tests.simulated_sequence import CAMERA, SimulatedDrive


def test_where_lengths_come_from(drive: SimulatedDrive, tmp_path: Path) -> None:
    folder = drive.folder
    (tmp_path / "wheel.txt").write_text("\n".join(str(0.5 + 0.01 * k) for k in range(119)) + "\n")
    (tmp_path / "short.txt").write_text("1.0\n")

    def scale(**change: Any) -> Any:
        values: dict[str, Any] = {
            "images": folder / "images",
            "intrinsics": folder / "intrinsics.json",
            "out": tmp_path / "run",
            "frame_stride": 3,
            **change,
        }
        config = RunConfig(**values)
        return scale_of(open_run_inputs(config), config)

    by_wheel = scale(step_lengths=tmp_path / "wheel.txt", truth=folder / "truth.txt")
    assert isinstance(by_wheel, KnownLengths)
    np.testing.assert_allclose(by_wheel.lengths[:2], [3 * 0.51, 3 * 0.54])  # three steps each
    by_truth = scale(truth=folder / "truth.txt")
    position = drive.truth[::3, :3, 3]
    np.testing.assert_allclose(by_truth.lengths, np.linalg.norm(np.diff(position, axis=0), axis=1), atol=1e-9)
    assert scale(camera_height=1.6, camera_pitch=0.1) == GroundHeight(1.6, pitch=0.1)
    with pytest.raises(InputError, match="lengths of steps: got 1 numbers, expected 119"):
        scale(step_lengths=tmp_path / "short.txt")


def test_lengths_of_steps_that_are_left_out_add_up() -> None:
    np.testing.assert_allclose(lengths_between(np.array([1.0, 2.0, 4.0, 8.0]), np.array([0, 1, 3, 4])), [1.0, 6.0, 8.0])


def test_pictures_beside_the_images(tmp_path: Path) -> None:
    for name in ("000003.png", "000001.png", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    images = [f"../images/{k:06d}.jpg" for k in (1, 2, 3)]
    assert beside(tmp_path, images, [1, 2, 3]) == [tmp_path / "000001.png", None, tmp_path / "000003.png"]
    # No name fits: by number.
    assert beside(tmp_path, ["a.png", "b.png"], [0, 1]) == [tmp_path / "000001.png", tmp_path / "000003.png"]
    with pytest.raises(InputError, match="pictures that belong to no image: got 2 files"):
        beside(tmp_path, ["a.png"], [2])
    with pytest.raises(InputError, match="no such folder"):
        beside(tmp_path / "none", ["a.png"], [0])


def test_depth_sharpens_what_is_written(drive: SimulatedDrive, tmp_path: Path) -> None:
    """Depth pictures of a wall as far as one of the objects: those near it are moved and told more sharply, others stay."""
    frames = open_frames(drive.folder / "images")
    table = drive.model.table
    busiest = np.argsort(-np.bincount(table.frame), kind="stable")[:3].tolist()
    names = [f"{k:06d}.png" for k in busiest]
    nearest = float(table.position[np.isin(table.frame, busiest), 2].min())
    for name in names:
        Image.fromarray(np.full((96, 192), round(5000 * nearest), dtype=np.uint16)).save(tmp_path / name)

    def seen(depth: Any) -> Detections:
        read = [frames.frame(k) for k in busiest].__getitem__
        observe = partial(drive.model.observe, threshold=0.05, batch=2, decode=False)
        return observe_sequence(observe, read, names, CAMERA, depth, 2, [0.0, 0.5, 1.0])

    plain = seen(SequenceDepth(frames, busiest))  # plain images bring no depth
    sharp = seen(DepthImages([tmp_path / name for name in names], DepthScale(unit=1 / 5000)))
    assert plain.id == sharp.id and set(plain.image) <= set(names) and set(plain.time) <= {0.0, 0.5, 1.0}
    moved = (plain.position != sharp.position).any(axis=1)
    np.testing.assert_array_equal(plain.position_covariance[~moved], sharp.position_covariance[~moved])
    for before, after in zip(plain.position_covariance[moved], sharp.position_covariance[moved]):
        assert np.trace(after) < np.trace(before)
    for before, after in zip(plain.position[moved], sharp.position[moved]):
        turned = np.linalg.norm(np.cross(before, after)) / np.dot(after, after)
        assert turned < 0.02  # along the ray, but for what correlates with it
    assert 0 < moved.sum() < len(plain)
    known = seen(DepthImages([None, None, None], DepthScale()))
    np.testing.assert_array_equal(known.position, plain.position)


def test_stereo_pairs_match_left_and_right() -> None:
    rng = np.random.default_rng(0)
    texture = np.kron(rng.integers(0, 256, (24, 60, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    source = StereoPairs(lambda k: texture[:, 12:212], 100.0, 0.3)
    depth = source.depth(0, texture[:, :200])
    assert depth is not None and np.nanmedian(depth[10:-10, 40:-10]) == pytest.approx(100.0 * 0.3 / 12, rel=0.02)


def test_doubtful_steps_are_counted_in_the_summary(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    flags = np.array([0, StepFlag.STILL, StepFlag.WEAK | StepFlag.NO_SCALE, 0], dtype=np.uint8)
    poses = np.tile(np.eye(4), (5, 1, 1))
    run.write_odometry(poses, np.tile(np.eye(6), (4, 1, 1)), flags)
    counted = odometry_scores(RunFolder(tmp_path))["odometry"]
    assert counted["steps"] == 4 and counted["doubtful"] == 2
    assert {name for name, count in counted.items() if count == 1} == {"STILL", "WEAK", "NO_SCALE"}
    given = RunFolder(tmp_path / "given")
    given.path.mkdir()
    given.write_odometry(poses, np.tile(np.eye(6), (4, 1, 1)))
    assert odometry_scores(RunFolder(given.path)) == {}


def test_lengths_come_from_depth_before_the_truth(tmp_path: Path) -> None:
    """Visual odometry takes a height or a wheel where it is given, then depth images, then the truth."""
    (tmp_path / "images").mkdir()
    (tmp_path / "depth").mkdir()
    for k in range(2):
        Image.new("RGB", (64, 48), (90, 90, 90)).save(tmp_path / "images" / f"{k}.png")
        Image.fromarray(np.full((48, 64), 1000, dtype=np.uint16)).save(tmp_path / "depth" / f"{k}.png")
    (tmp_path / "camera.txt").write_text("60 60 32 24 0.01 0 0 0 0")  # a lens, whose distortion is taken out of both
    (tmp_path / "truth.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {k}\n" for k in range(2)))
    made = {"images": tmp_path / "images", "out": tmp_path / "out", "intrinsics": tmp_path / "camera.txt"}
    both = RunConfig(**made, truth=tmp_path / "truth.txt", depth=tmp_path / "depth", depth_unit=0.001)
    drive = open_run_inputs(both)
    assert isinstance(scale_of(drive, both), MeasuredDepth)
    depth = depth_of_drive(drive, both, [1]).depth(0, drive.frames.frame(1))
    assert depth is not None and depth.shape == (48, 64) and np.nanmedian(depth) == pytest.approx(1.0)
    assert isinstance(scale_of(drive, replace(both, camera_height=1.5)), GroundHeight)
    assert isinstance(scale_of(drive, replace(both, depth=None)), KnownLengths)
