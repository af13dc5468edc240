"""Frames from folders, TUM lists and videos, times, lengths and intrinsics, and every kind of damage."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.data.sequences import (
    CameraIntrinsics,
    ImageFolder,
    TumFolder,
    UndistortedFrames,
    VideoFile,
    guessed_camera,
    open_frames,
    read_camera,
    read_intrinsics,
    read_lengths,
    read_times,
    without_distortion,
    write_camera,
)
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.distortion import undistort_image
from nolbo_ppl.io.images import exif_focal_length


def picture(k: int, width: int = 32, height: int = 16) -> np.ndarray:
    image = np.full((height, width, 3), 10 * k, dtype=np.uint8)
    image[:, : width // 2] = [200, 10 * k, 30]
    return image


def folder_of(path: Path, names: list[str]) -> Path:
    path.mkdir(parents=True)
    for k, name in enumerate(names):
        Image.fromarray(picture(k)).save(path / name)
    return path


def test_images_come_in_natural_order(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "a", ["f1.png", "f2.png", "f10.png"])
    (folder / "notes.txt").write_text("no image")
    (folder / ".hidden.png").write_text("no image")
    frames = open_frames(folder)
    assert isinstance(frames, ImageFolder) and len(frames) == 3 and frames.size == (32, 16)
    assert [frames.name(k) for k in range(3)] == ["f1.png", "f2.png", "f10.png"]
    for k in range(3):
        np.testing.assert_array_equal(frames.frame(k), picture(k))
    assert frames.time(0) is None and frames.times is None and frames.depth(0) is None


@pytest.mark.parametrize("inside", ["image_2", "images", "image_02/data"])
def test_kitti_layouts_and_times(tmp_path: Path, inside: str) -> None:
    folder_of(tmp_path / inside, ["000000.png", "000001.png"])
    (tmp_path / "times.txt").write_text("0.0e+00\n1.04e-01\n")
    frames = open_frames(tmp_path)
    assert len(frames) == 2 and frames.time(1) == 0.104
    assert frames.times is not None and frames.times.tolist() == [0.0, 0.104]
    if inside != "image_02/data":  # the folder of images itself may be named as well
        assert open_frames(tmp_path / inside).time(1) == 0.104


def test_the_colour_camera_comes_first(tmp_path: Path) -> None:
    folder_of(tmp_path / "image_0", ["0.png"])
    folder_of(tmp_path / "image_2", ["1.png"])
    assert open_frames(tmp_path).name(0) == "1.png"


def test_grey_and_deep_images_are_rgb(tmp_path: Path) -> None:
    values = np.arange(64, dtype=np.uint16).reshape(8, 8) * 1000
    Image.fromarray(values).save(tmp_path / "0.png")
    Image.fromarray((values >> 8).astype(np.uint8)).save(tmp_path / "1.png")
    frames = open_frames(tmp_path)
    np.testing.assert_array_equal(frames.frame(0), frames.frame(1))
    assert frames.frame(1).shape == (8, 8, 3)


def test_frames_are_read_when_asked_for(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "a", ["0.png", "1.png", "2.png"])
    (folder / "1.png").write_bytes(b"not an image")
    Image.fromarray(picture(0, width=20)).save(folder / "2.png")
    frames = open_frames(folder)
    frames.frame(0)
    with pytest.raises(InputError, match=r"1\.png: not a readable image"):
        frames.frame(1)
    with pytest.raises(InputError, match=r"2\.png: image of another size: got 20 x 16 px, expected 32 x 16"):
        frames.frame(2)
    for k in (-1, 3):
        with pytest.raises(InputError, match=f"no such frame: got {k}, expected 0 to 2"):
            frames.frame(k)
        with pytest.raises(InputError, match="no such frame"):
            frames.time(k)


def test_nothing_to_open(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder or video"):
        open_frames(tmp_path / "none")
    with pytest.raises(InputError, match="no image in the folder"):
        open_frames(tmp_path)
    (tmp_path / "a.txt").write_text("text")
    with pytest.raises(InputError, match=r"a\.txt: not a sequence of frames"):
        open_frames(tmp_path / "a.txt")


def test_one_image_is_a_sequence_of_one(tmp_path: Path) -> None:
    colours = np.random.default_rng(0).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    for name in ("a.png", "b.png"):
        Image.fromarray(colours).save(tmp_path / name)
    frames = open_frames(tmp_path / "b.png")
    assert len(frames) == 1 and frames.size == (8, 6)
    np.testing.assert_array_equal(frames.image(0), colours)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("0\n1\n", "times do not match the images: got 2 times, expected 3"),
        ("0\nx\n2\n", r"times\.txt:2: not a time in seconds: got 'x'"),
        ("0\n1 2\n2\n", r"times\.txt:2: not a time"),
        ("0\nnan\n2\n", r"times\.txt:2: not a time"),
        ("0\n\n1 # first\n1\n", r"times\.txt:4: time does not increase"),
        ("", r"times\.txt: the file is empty: expected a time in seconds a line"),
    ],
)
def test_damaged_times(tmp_path: Path, text: str, match: str) -> None:
    folder_of(tmp_path / "images", ["0.png", "1.png", "2.png"])
    (tmp_path / "times.txt").write_text(text)
    with pytest.raises(InputError, match=match):
        open_frames(tmp_path)


def test_times_and_lengths(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("# s\n0.5\n\n1.5\n")
    np.testing.assert_array_equal(read_times(tmp_path / "t.txt"), [0.5, 1.5])
    (tmp_path / "l.txt").write_text("0.5\n0\n0.25 # slow\n")
    np.testing.assert_array_equal(read_lengths(tmp_path / "l.txt"), [0.5, 0.0, 0.25])
    (tmp_path / "l.txt").write_text("0.5\n-1\n")
    with pytest.raises(InputError, match=r"l\.txt:2: negative length"):
        read_lengths(tmp_path / "l.txt")
    with pytest.raises(InputError, match="no such file"):
        read_lengths(tmp_path / "none.txt")
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        read_times(tmp_path / "b.txt")


def tum(path: Path) -> Path:
    folder_of(path / "rgb", ["a.png", "b.png", "c.png"])
    (path / "depth").mkdir()
    for k in range(2):
        Image.fromarray(np.full((16, 32), 5000 * (k + 1), dtype=np.uint16)).save(path / "depth" / f"{k}.png")
    (path / "rgb.txt").write_text("# colour\n# file\n10.00 rgb/a.png\n10.03 rgb/b.png\n10.06 rgb/c.png\n")
    (path / "depth.txt").write_text("10.001 depth/0.png\n10.055 depth/1.png\n")
    return path


def test_tum_folder(tmp_path: Path) -> None:
    frames = open_frames(tum(tmp_path / "t"))
    assert isinstance(frames, TumFolder) and len(frames) == 3
    assert frames.times is not None and frames.times.tolist() == [10.0, 10.03, 10.06]
    np.testing.assert_array_equal(frames.frame(2), picture(2))
    depth = [frames.depth(k) for k in range(3)]
    assert depth[1] is None
    np.testing.assert_allclose(depth[0], np.full((16, 32), 1.0))  # type: ignore[arg-type]
    np.testing.assert_allclose(depth[2], np.full((16, 32), 2.0))  # type: ignore[arg-type]


def test_depth_of_a_lens_is_undistorted_with_its_frames(tmp_path: Path) -> None:
    frames = open_frames(tum(tmp_path / "t"))
    assert frames.has_depth
    lens = CameraIntrinsics(20.0, 20.0, 16.0, 8.0, model="radial-tangential", distortion=(0.05, 0.0, 0.0, 0.0))
    made = UndistortedFrames(frames, lens)
    depth = made.depth(0)
    assert made.has_depth and made.depth(1) is None and depth is not None and depth.shape == (16, 32)
    assert set(np.unique(depth)) == {1.0}  # zoomed in until every pixel was seen


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("10.03", r"rgb\.txt:2: not a row of a TUM list"),
        ("now rgb/b.png", r"rgb\.txt:2: not a row of a TUM list"),
        ("9.0 rgb/b.png", r"rgb\.txt:2: time does not increase"),
        ("10.03 rgb/none.png", r"rgb\.txt:2: no such image: got rgb/none\.png"),
    ],
)
def test_damaged_tum_lists(tmp_path: Path, line: str, match: str) -> None:
    path = tum(tmp_path / "t")
    (path / "rgb.txt").write_text(f"10.00 rgb/a.png\n{line}\n")
    with pytest.raises(InputError, match=match):
        open_frames(path)


def test_damaged_tum_images_name_the_line_of_the_list(tmp_path: Path) -> None:
    path = tum(tmp_path / "t")
    (path / "rgb" / "b.png").write_bytes(b"")
    (path / "depth" / "0.png").write_bytes(b"")
    frames = open_frames(path)
    with pytest.raises(InputError, match=r"rgb\.txt:4: image b\.png"):
        frames.frame(1)
    with pytest.raises(InputError, match=r"0\.png: not a readable depth image"):
        frames.depth(0)
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(path / "depth" / "0.png")
    with pytest.raises(InputError, match="depth image of another shape"):
        frames.depth(0)
    (path / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="no frame in the list"):
        open_frames(path)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 32))
    for k in range(9):
        writer.write(np.full((32, 64, 3), [20, 25 * k, 200], dtype=np.uint8))  # BGR
    writer.release()
    return path


def test_video(video: Path) -> None:
    frames = open_frames(video)
    assert isinstance(frames, VideoFile) and len(frames) == 9 and frames.size == (64, 32)
    for k in (0, 1, 5, 4, 8, 0):  # in order, over a gap, back
        image = frames.frame(k)
        assert image.shape == (32, 64, 3) and image.dtype == np.uint8
        np.testing.assert_allclose(image.reshape(-1, 3).mean(axis=0), [200, 25 * k, 20], atol=4)
    times = frames.times
    assert times is not None
    np.testing.assert_allclose(times, np.arange(9) / 10.0, atol=1e-6)
    assert frames.name(3) == "v.avi#000003"
    with pytest.raises(InputError, match="no such frame: got 9"):
        frames.frame(9)
    frames.close()
    assert frames.frame(2).shape == (32, 64, 3)


def test_what_is_no_video(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "v.mp4").write_bytes(b"not a video at all")
    with pytest.raises(InputError, match=r"v\.mp4: not a video"):
        open_frames(tmp_path / "v.mp4")
    with pytest.raises(InputError, match="no such video"):
        VideoFile(tmp_path / "w.mp4")


KITTI = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP2: 718 0 607 45 0 719 185 -0.1 0 0 1 0.002\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("k.json", '{"fx": 200, "fy": 201.5, "cx": 192, "cy": 96, "width": 384, "height": 192}', [200, 201.5, 192, 96]),
        ("k.json", '{"fx": 200, "fy": 201.5, "cx": 192, "cy": 96}', [200, 201.5, 192, 96]),
        ("calib.txt", KITTI, [718, 719, 607, 185]),
        ("calib.txt", KITTI.splitlines()[0], [700, 700, 600, 180]),
        ("calib.txt", KITTI.replace("P2:", "P_rect_02:"), [700, 700, 600, 180]),
        ("k.txt", "525.0 525.0 319.5 239.5\n", [525, 525, 319.5, 239.5]),
        ("k.txt", "# fx fy cx cy\n525,525,319.5,239.5", [525, 525, 319.5, 239.5]),
        ("k.txt", "525 0 319.5\n0 524 239.5\n0 0 1\n", [525, 524, 319.5, 239.5]),
    ],
)
def test_intrinsics(tmp_path: Path, name: str, text: str, expected: list[float]) -> None:
    (tmp_path / name).write_text(text)
    np.testing.assert_allclose(read_intrinsics(tmp_path / name), expected)


def test_intrinsics_round_trip(tmp_path: Path) -> None:
    camera = CameraIntrinsics(200.0, 201.0, 192.0, 96.0, 384, 192)
    write_camera(tmp_path / "k.json", camera)
    assert read_camera(tmp_path / "k.json") == camera == read_camera(tmp_path / "k.json", (384, 192))
    (tmp_path / "k.txt").write_text("200 201 192 96")
    assert read_camera(tmp_path / "k.txt", (384, 192)) == camera


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("k.json", "{", r"k\.json:1: not valid JSON"),
        ("k.json", "[1]", r"not intrinsics: got list"),
        ("k.json", '{"fx": 1, "fy": 1, "cx": 1}', "intrinsics: cy: got nothing"),
        ("k.json", '{"fx": "1", "fy": 1, "cx": 1, "cy": 1}', "intrinsics: fx"),
        ("k.json", '{"fx": true, "fy": 1, "cx": 1, "cy": 1}', "intrinsics: fx"),
        ("k.json", '{"fx": 200, "fy": 200, "cx": 1, "cy": 1, "width": 1.5}', "intrinsics: width"),
        ("k.json", '{"fx": -200, "fy": 200, "cx": 1, "cy": 1}', "focal lengths above 0"),
        ("k.txt", "", "no intrinsics in the file"),
        ("k.txt", "\n1 2 3\n", r"k\.txt:2: intrinsics: got 3 numbers"),
        ("k.txt", "1 2 3 4 0.1", r"k\.txt:1: intrinsics: got 5 numbers"),
        ("k.txt", "1 2 3 4x", r"k\.txt:1: not a row of numbers"),
        ("k.txt", "1 2 3 nan", r"k\.txt:1: intrinsics"),
        ("k.txt", "P1: 1 2 3\n", "no known row of a KITTI calibration: got P1"),
        ("k.txt", "\nP0: 1 2 3\n", r"k\.txt:2: P0 of a KITTI calibration: got 3 numbers"),
        ("k.txt", "P0: 1 0 1 0 0 1 1 0 0 0 2 0\n", "no projection"),
        ("k.txt", "P0: 1 0 1 0 0 1 1 0 0 0 one 0\n", r"k\.txt:1: not a row of numbers"),
    ],
)
def test_damaged_intrinsics(tmp_path: Path, name: str, text: str, match: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=match):
        read_intrinsics(tmp_path / name)


@pytest.mark.parametrize(
    ("values", "match"),
    [
        ({"fx": 200, "fy": 200, "cx": 192, "cy": 96, "width": 768, "height": 384}, "of another size: got 768 x 384 px"),
        ({"fx": 200, "fy": 200, "cx": 607, "cy": 96}, "principal point outside the image"),
        ({"fx": 2, "fy": 200, "cx": 192, "cy": 96}, "focal length does not fit the image"),
        ({"fx": 200, "fy": 9000, "cx": 192, "cy": 96}, "focal length does not fit the image"),
    ],
)
def test_intrinsics_of_other_images(tmp_path: Path, values: dict, match: str) -> None:
    (tmp_path / "k.json").write_text(json.dumps(values))
    with pytest.raises(InputError, match=match):
        read_intrinsics(tmp_path / "k.json", (384, 192))


def test_frames_without_the_distortion_of_their_lens(tmp_path: Path) -> None:
    """Every frame is remapped, the camera of what is returned is a pinhole, names and times stay."""
    folder_of(tmp_path / "i", ["0.png", "1.png"])
    (tmp_path / "i" / "times.txt").write_text("0\n0.5\n")
    lens = CameraIntrinsics(20.0, 20.0, 16.0, 8.0, None, None, "radial-tangential", (0.3, 0.0, 0.0, 0.0))
    frames, camera = without_distortion(open_frames(tmp_path / "i"), lens)
    assert not camera.is_distorted and camera.fx > 20 and (camera.width, camera.height) == (32, 16)
    plain = open_frames(tmp_path / "i")
    expected = undistort_image(plain.frame(1), lens.vector, "radial-tangential", lens.distortion, camera.vector)
    np.testing.assert_array_equal(frames.frame(1), expected)
    assert (frames.frame(1) != plain.frame(1)).any()
    assert (frames.name(1), frames.time(1), frames.size, len(frames)) == ("1.png", 0.5, (32, 16), 2)
    same, pinhole = without_distortion(plain, camera)
    assert same is plain and pinhole is camera


def test_a_guessed_camera_says_so(tmp_path: Path) -> None:
    camera, remark = guessed_camera((640, 480))
    assert camera.fx == pytest.approx(320 / np.tan(np.radians(30))) and "guessed without any evidence" in remark
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 27
    Image.fromarray(picture(0)).save(tmp_path / "p.jpg", exif=exif)
    focal = exif_focal_length(tmp_path / "p.jpg")
    assert focal == pytest.approx(27 / 36 * 32)
    assert "EXIF" in guessed_camera((32, 16), focal)[1]
