"""Bags without ROS: images of every encoding, cameras, poses of bodies and cameras, and what damage is called."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.data.converters.ros_detections import read_bag_detections
from nolbo_ppl.data.sequences import BagFrames, frames_with_camera, open_frames
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import make_pose, so3_exp
from nolbo_ppl.io.camera_files import read_camera
from nolbo_ppl.io.ros_bags import TopicCursor, is_bag, split_topic
from nolbo_ppl.io.ros_messages import depth_of
from nolbo_ppl.io.trajectories import read_frame_poses, read_trajectory
from tests.bags import FORWARD, KINDS, BagWriter, path_of

pytest.importorskip("rosbags")
SIZE = (12, 8)


def colours(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)


def poses(count: int) -> np.ndarray:
    R = so3_exp(np.array([[0.0, 0.02 * k, 0.01 * k] for k in range(count)]))
    return make_pose(R, np.column_stack([0.1 * np.arange(count), np.zeros(count), 0.5 * np.arange(count)]))


@pytest.mark.parametrize("kind", KINDS)
def test_every_bag_gives_the_same_images_camera_and_poses(tmp_path: Path, kind: str) -> None:
    path, T = path_of(tmp_path, kind), poses(6)
    with BagWriter(path, kind) as bag:
        bag.static("base", "camera", FORWARD)
        for k in range(6):
            time = 100.0 + 0.1 * k
            bag.camera("/cam/camera_info", time, [9.0, 9.5, 6.0, 4.0], SIZE, [0.1, -0.05, 0.0, 0.0, 0.0])
            bag.image("/cam/image", time, colours(k), "rgb8")
            bag.odometry("/odom", time + 0.03, T[k] @ np.linalg.inv(FORWARD), "base")
            bag.pose_stamped("/mocap", time, T[k])
    frames = open_frames(path)
    assert isinstance(frames, BagFrames) and len(frames) == 6 and frames.size == SIZE
    np.testing.assert_allclose(frames.times, 100.0 + 0.1 * np.arange(6), atol=1e-6)
    for k in (0, 1, 5, 2, 2, 3):  # forth, a leap, back, the same again
        np.testing.assert_array_equal(frames.frame(k), colours(k))
    camera = read_camera(path, SIZE)
    assert camera.vector.tolist() == [9.0, 9.5, 6.0, 4.0] and camera.distortion[:2] == (0.1, -0.05)
    _, pinhole, remark = frames_with_camera(frames, None)
    assert not pinhole.is_distorted and remark == "the camera is that of /cam/camera_info"
    found = read_trajectory(f"{path}:/odom")
    np.testing.assert_allclose(found.T_world_camera, T, atol=1e-7)  # by the fixed transform, the camera's own
    np.testing.assert_allclose(read_trajectory(f"{path}:/mocap").T_world_camera, T, atol=1e-7)
    between = read_frame_poses(f"{path}:/odom", 6, frames.times, interpolate=True)
    assert between.known.tolist() == [False] + [True] * 5  # the odometry begins after the first image
    with pytest.raises(InputError, match=r"several topics of poses: got /mocap, /odom.*; name one"):
        read_trajectory(path)


def mosaic(rgb: tuple[int, int, int], pattern: str) -> np.ndarray:
    values = {"r": rgb[0], "g": rgb[1], "b": rgb[2]}
    tile = np.array([values[letter] for letter in pattern], np.uint8).reshape(2, 2)
    return np.tile(tile, (SIZE[1] // 2, SIZE[0] // 2))


def test_encodings(tmp_path: Path) -> None:
    rgb = colours(1)
    plain = np.full((SIZE[1], SIZE[0], 3), (200, 120, 40), np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, "PNG")
    cases = {
        "rgb8": (rgb, rgb),
        "bgr8": (rgb[:, :, ::-1], rgb),
        "rgba8": (np.dstack([rgb, rgb[:, :, :1]]), rgb),
        "bgra8": (np.dstack([rgb[:, :, ::-1], rgb[:, :, :1]]), rgb),
        "mono8": (rgb[:, :, 0], np.repeat(rgb[:, :, :1], 3, axis=2)),
        "mono16": (rgb[:, :, 0].astype(np.uint16) * 256 + 77, np.repeat(rgb[:, :, :1], 3, axis=2)),
    } | {f"bayer_{pattern}8": (mosaic((200, 120, 40), pattern), plain) for pattern in ("rggb", "bggr", "gbrg", "grbg")}
    path = tmp_path / "encodings"
    with BagWriter(path, "mcap") as bag:
        for k, (name, (values, _)) in enumerate(cases.items()):
            bag.image(f"/{name}", 1.0 + k, values, name)
        bag.compressed("/png", 50.0, buffer.getvalue(), "png")
        bag.image("/strange", 51.0, rgb[:, :, 0], "nv24")
    for name, (_, expected) in cases.items():
        np.testing.assert_array_equal(BagFrames(path, f"/{name}").frame(0), expected, err_msg=name)
    np.testing.assert_array_equal(BagFrames(f"{path}:/png").frame(0), rgb)
    with pytest.raises(InputError, match="encoding of strange#000000: got nv24, expected one of mono8"):
        BagFrames(path, "/strange")


def test_depth_in_metres(tmp_path: Path) -> None:
    millimetres = np.arange(SIZE[0] * SIZE[1], dtype=np.uint16).reshape(SIZE[1], SIZE[0]) * 20
    buffer = io.BytesIO()
    Image.fromarray(millimetres).save(buffer, "PNG")
    metres = np.where(millimetres == 0, np.nan, millimetres * 1e-3).astype(np.float32)
    path = tmp_path / "depth"
    with BagWriter(path, "db3") as bag:
        for k in range(3):
            bag.image("/rgb", 1.0 + k, colours(k), "rgb8")
            if k != 1:
                bag.image("/depth", 1.01 + k, millimetres + np.uint16(k), "16UC1")
        bag.image("/depth32", 1.0, metres, "32FC1")
        bag.compressed("/packed", 1.0, bytes(12) + buffer.getvalue(), "16UC1; compressedDepth")
    frames = open_frames(path, "/rgb", f"{path}:/depth")
    assert frames.depth(1) is None
    np.testing.assert_allclose(frames.depth(2), (millimetres + 2) * 1e-3)
    for topic in ("/depth32", "/packed"):
        cursor = TopicCursor(path, topic, ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"), "depth")
        np.testing.assert_allclose(depth_of(cursor.message(0), topic, path), millimetres * 1e-3, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_wrong_is_named(tmp_path: Path, kind: str) -> None:
    path = path_of(tmp_path, kind)
    with BagWriter(path, kind) as bag:
        for k in range(40):
            bag.image("/cam/image", 1.0 + k, np.random.default_rng(k).integers(0, 256, (64, 64, 3), dtype=np.uint8), "rgb8")
            bag.odometry("/odom", 1.0 + k, np.eye(4), "base")
    with pytest.raises(InputError, match=r"no topic /other: got /cam/image \(sensor_msgs/msg/Image, 40\), /odom"):
        open_frames(path, "/other")
    with pytest.raises(InputError, match="topic /odom is no images: got nav_msgs/msg/Odometry"):
        open_frames(path, "/odom")
    with pytest.raises(InputError, match="poses of `base`, which nothing ties to the camera"):
        read_trajectory(path)
    with pytest.raises(InputError, match="no topic of camera info"):
        read_camera(path)
    (tmp_path / "turned").mkdir()
    bad = path_of(tmp_path / "turned", kind)
    with BagWriter(bad, kind) as bag:
        bag.static("base", "camera", np.diag([np.nan, 1, 1, 1]))
        bag.image("/cam/image", 1.0, colours(0), "rgb8")
        bag.odometry("/odom", 1.0, np.eye(4), "base")
    with pytest.raises(InputError, match="a transform of /tf_static is no pose: got base to camera"):
        read_trajectory(bad)
    files = [path] if kind == "bag" else [file for file in path.iterdir() if file.suffix != ".yaml"]
    for file in files:
        whole = file.read_bytes()
        for share in (0.5, 0.9, 0.999):
            file.write_bytes(whole[: int(share * len(whole))])
            with pytest.raises(InputError, match=r"drive.*: .*(not a readable bag|cannot be read|is gone).*"):
                frames = open_frames(path, "/cam/image")
                for k in range(40):
                    frames.frame(k)
        if kind == "mcap":  # the length of its first record, after the file's mark and a byte: more than any memory holds
            file.write_bytes(whole[:9] + (1 << 62).to_bytes(8, "little") + whole[17:])
            with pytest.raises(InputError, match="not a readable bag"):
                open_frames(path, "/cam/image")
        file.write_bytes(whole)
    assert len(open_frames(path, "/cam/image")) == 40


def test_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(
        InputError, match=r"a.bag: bags need the package rosbags; install the extra: pip install 'nolbo-ppl\[ros\]'"
    ):
        open_frames(tmp_path / "a.bag")


def test_names_of_topics(tmp_path: Path) -> None:
    assert split_topic("a/b.bag:/x/y") == (Path("a/b.bag"), "/x/y")
    assert split_topic("a/images:/x") == (Path("a/images:/x"), None)  # no bag
    assert not is_bag(tmp_path) and not is_bag("poses.txt")
    (tmp_path / "metadata.yaml").write_text("")
    assert is_bag(f"{tmp_path}:/odom")


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_topics_without_messages_are_no_surprise(tmp_path: Path, kind: str) -> None:
    """Announced and never used: told where they are asked for, passed over where they are not."""
    path, used = path_of(tmp_path, kind), tmp_path / "used"
    types = {
        "/odom": "nav_msgs/msg/Odometry",
        "/cam/info": "sensor_msgs/msg/CameraInfo",
        "/found": "vision_msgs/msg/Detection3DArray",
    }
    with BagWriter(path, kind) as bag:
        bag.image("/cam/image", 1.0, colours(0), "rgb8")
        for topic, name in types.items():
            bag.connections[topic] = bag.writer.add_connection(topic, name, typestore=bag.store)
    for read, topic in zip((read_trajectory, read_camera, read_bag_detections), types):
        with pytest.raises(InputError, match=rf"topic {topic} has no messages"):
            read(Path(f"{path}:{topic}"))
    used.mkdir()
    with BagWriter(path_of(used, kind), kind) as bag:
        bag.connections["/cam/info"] = bag.writer.add_connection("/cam/info", types["/cam/info"], typestore=bag.store)
        bag.odometry("/odom", 1.0, np.eye(4), "camera")
    assert len(read_trajectory(path_of(used, kind)).T_world_camera) == 1
