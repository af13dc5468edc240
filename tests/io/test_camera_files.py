"""Cameras as calibration tools write them; a distortion that is given is never dropped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.camera_files import CameraIntrinsics, read_camera, read_intrinsics, write_camera

RADIAL = (-0.28, 0.07, 0.0002, 0.00002, 0.0)
OPENCV = """%YAML:1.0
---
image_width: 384
image_height: 192
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 200., 0., 192., 0., 201., 96., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.28, 0.07, 0.0002, 0.00002, 0. ]
"""
ROS = """image_width: 384
image_height: 192
camera_name: left
camera_matrix: {rows: 3, cols: 3, data: [200, 0, 192, 0, 201, 96, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.28, 0.07, 0.0002, 0.00002, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [180, 0, 190, 0, 0, 181, 95, 0, 0, 0, 1, 0]}
"""
TOPIC = """header: {seq: 1, frame_id: cam}
height: 192
width: 384
distortion_model: "plumb_bob"
D: [-0.28, 0.07, 0.0002, 0.00002, 0.0]
K: [200.0, 0.0, 192.0, 0.0, 201.0, 96.0, 0.0, 0.0, 1.0]
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [200, 201, 192, 96]
  resolution: [384, 192]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  intrinsics: [1, 1, 1, 1]
"""
EUROC = """sensor_type: camera
T_BS: {cols: 4, rows: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
rate_hz: 20
resolution: [384, 192]
camera_model: pinhole
intrinsics: [200, 201, 192, 96] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]
"""
ORB = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: 200
Camera.fy: 201
Camera.cx: 192
Camera.cy: 96
Camera.k1: -0.28
Camera.k2: 0.07
Camera.p1: 0.0002
Camera.p2: 0.00002
Camera.width: 384
Camera.height: 192
ORBextractor.nFeatures: 1000
"""
VINS = """%YAML:1.0
model_type: PINHOLE
camera_name: camera
image_width: 384
image_height: 192
distortion_parameters: {k1: -0.28, k2: 0.07, p1: 0.0002, p2: 0.00002}
projection_parameters: {fx: 200, fy: 201, cx: 192, cy: 96}
"""


@pytest.mark.parametrize(
    "text", [OPENCV, ROS, TOPIC, KALIBR, EUROC, ORB, VINS], ids=["opencv", "ros", "topic", "kalibr", "euroc", "orb", "vins"]
)
def test_yaml_of_the_calibration_tools(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    found = read_camera(tmp_path / "c.yaml", (384, 192))
    assert found.model == "radial-tangential" and found.distortion[:4] == RADIAL[:4]
    np.testing.assert_array_equal(found.vector, [200, 201, 192, 96])
    assert (found.width, found.height) == (384, 192)
    with pytest.raises(InputError, match=r"c\.yaml: camera with distortion"):
        read_intrinsics(tmp_path / "c.yaml")  # four numbers cannot hold it


@pytest.mark.parametrize(
    ("text", "model", "count"),
    [
        (KALIBR.replace("radtan", "equidistant"), "fisheye", 4),
        (ORB.replace("PinHole", "KannalaBrandt8").replace("p1", "k3").replace("p2", "k4"), "fisheye", 4),
        (TOPIC.replace("plumb_bob", "rational_polynomial").replace("0.0]\nK", "0.0, 0.1, 0.2, 0.3]\nK"), "rational", 8),
        (ROS.replace("[-0.28, 0.07, 0.0002, 0.00002, 0]", "[0, 0, 0, 0, 0]"), None, 0),
        (ORB.replace("-0.28", "0").replace("0.07", "0").replace("0.0002", "0").replace("0.00002", "0"), None, 0),
    ],
)
def test_other_lenses(tmp_path: Path, text: str, model: str | None, count: int) -> None:
    (tmp_path / "c.yaml").write_text(text)
    found = read_camera(tmp_path / "c.yaml")
    assert found.model == model and len(found.distortion) == count


@pytest.mark.parametrize(
    "text",
    [
        '{"fx":200,"fy":201,"cx":192,"cy":96,"distortion":[-0.28,0.07,0.0002,0.00002,0]}',
        '{"fx":200,"fy":201,"cx":192,"cy":96,"k1":-0.28,"k2":0.07,"p1":0.0002,"p2":0.00002}',
        '{"camera_matrix":[[200,0,192],[0,201,96],[0,0,1]],"dist_coeffs":[[-0.28,0.07,0.0002,0.00002,0]]}',
        '{"fl_x":200,"fl_y":201,"cx":192,"cy":96,"w":384,"h":192,"k1":-0.28,"k2":0.07,"p1":0.0002,"p2":0.00002}',
    ],
)
def test_json_keeps_its_distortion(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.json").write_text(text)
    found = read_camera(tmp_path / "c.json", (384, 192))
    assert found.model == "radial-tangential" and found.distortion == RADIAL
    write_camera(tmp_path / "back.json", found)
    assert read_camera(tmp_path / "back.json") == found


def test_numbers_keep_their_distortion(tmp_path: Path) -> None:
    for text in ("200 0 192\n0 201 96\n0 0 1\n-0.28 0.07 0.0002 0.00002 0\n", "200 201 192 96 -0.28 0.07 0.0002 0.00002 0"):
        (tmp_path / "c.txt").write_text(text)
        found = read_camera(tmp_path / "c.txt")
        assert found.vector.tolist() == [200, 201, 192, 96] and found.distortion == RADIAL


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("c.json", '{"fx":200,"fy":201,"cx":192,"cy":96,"lens":3}', "unknown fields of a camera: got lens"),
        ("c.json", '{"fx":200,"fy":201,"cx":192,"cy":96,"distortion":[1,2,3]}', "distortion: got 3 numbers"),
        ("c.json", '{"fx":200,"fy":201,"cx":192,"cy":96,"distortion":["a",2,3,4]}', "distortion: got .*finite numbers"),
        ("c.yaml", "a: 1\n", r"c\.yaml: no camera in the file: got a, expected YAML of OpenCV"),
        ("c.yaml", "- 1\n", "not a camera: got list"),
        ("c.yaml", "fx: [1\n", r"c\.yaml:1: not valid YAML"),
        ("c.yaml", "a: &a [1]\nb: *a\n", "YAML with anchors"),
        ("c.yaml", "!!python/object/apply:os.system ['x']\n", "not valid YAML"),
        ("c.yaml", KALIBR.replace("camera_model: pinhole", "camera_model: omni"), "camera model: got omni"),
        ("c.yaml", KALIBR.replace("radtan", "fov"), "distortion model: got fov"),
        ("c.yaml", OPENCV.replace("200., 0.,", "200., 3.,"), "camera matrix with skew"),
        ("c.txt", "200 3 192\n0 201 96\n0 0 1\n", r"c\.txt:1: camera matrix with skew"),
    ],
)
def test_what_is_not_understood_is_named(tmp_path: Path, name: str, text: str, match: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=match):
        read_camera(tmp_path / name)


def test_a_pincushion_is_zoomed_and_a_pinhole_is_left() -> None:
    plain = CameraIntrinsics(200.0, 200.0, 192.0, 96.0)
    assert plain.undistorted((384, 192)) is plain
    lens = ("radial-tangential", (0.2, 0.0, 0.0, 0.0))
    made = CameraIntrinsics(200.0, 200.0, 192.0, 96.0, None, None, *lens).undistorted((384, 192))
    assert not made.is_distorted and made.fx > 205 and made.fx == made.fy
