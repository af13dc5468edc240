"""`nolbo data check`: every format is told by a look, what it holds is right, and what is wrong is said."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageColor

from nolbo_ppl.cli import main
from nolbo_ppl.cli.data import check_data
from nolbo_ppl.data.format_registry import FORMATS, FormatReport, recognise, register
from nolbo_ppl.errors import InputError
from nolbo_ppl.io.observations import write_observations
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.viz.style import category_colour


def text(path: Path, content: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return path


def pictures(folder: Path, count: int = 3, size: tuple[int, int] = (40, 30)) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        Image.new("RGB", size, (10 * k, 20, 30)).save(folder / f"frame{k}.png")
    return folder


def observed(path: Path) -> Path:
    write_observations(path, Detections.from_arrays([0, 2], [[0, 0, 5.0], [1, 0, 8]], category=["car", "bus"]))
    return path


def scenes(folder: Path) -> Path:
    pictures(folder / "images", 2)
    row = {"intrinsics": [40, 40, 20, 15], "objects": [{"box": [5, 5, 20, 20], "category": "car"}]}
    lines = [json.dumps({"image": f"images/frame{k}.png", **row}) for k in range(2)]
    text(folder / "scenes.jsonl", "\n".join(lines) + "\n")
    return folder


def arrays(path: Path) -> Path:
    np.savez(path, covariance=np.zeros((3, 6, 6)))
    return path


def coco(path: Path) -> Path:
    content = {
        "images": [{"id": 1, "file_name": "a.jpg", "width": 9, "height": 9}],
        "categories": [{"id": 3, "name": "car"}],
        "annotations": [
            {"id": 1, "image_id": 1, "category_id": 3, "bbox": [1, 1, 3, 3], "segmentation": [[1, 1, 4, 1, 4, 4, 1, 4]]},
            {"id": 2, "image_id": 7, "category_id": 3, "bbox": [1, 1, 0, 3]},
        ],
    }
    return text(path, json.dumps(content))


TUM = "".join(f"{100 + 0.1 * k} {k} 0 0 0 0 0 1\n" for k in range(5))
KITTI = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(5))
EUROC = "#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z\n" + "".join(
    f"{1403636579763555584 + 10**8 * k},{k},0,0,1,0,0,0\n" for k in range(3)
)
RESULTS = json.dumps([{"image_id": 1, "category_id": 3, "bbox": [1, 2, 3, 4], "score": 0.5}])
OA = json.dumps([{"file_name": "a.png", "detections": [{"category_id": 0, "detection_score": 0.5, "bbox": [1, 2, 3, 4]}]}])
OMNI = json.dumps(
    [
        {
            "image_id": 0,
            "instances": [
                {
                    "category": "car",
                    "bbox": [1, 2, 3, 4],
                    "center_cam": [0, 0, 5],
                    "dimensions": [1, 1, 1],
                    "pose": np.eye(3).tolist(),
                }
            ],
        }
    ]
)
LABEL = "Car 0.00 0 -1.5 100 100 200 200 1.5 1.6 3.9 1.0 1.6 12.0 0.1\n"
VOC = (
    "<annotation><filename>a.jpg</filename><size><width>9</width><height>9</height></size><object><name>car</name>"
    "<bndbox><xmin>1</xmin><ymin>1</ymin><xmax>5</xmax><ymax>5</ymax></bndbox></object></annotation>"
)
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
LANDMARKS = json.dumps([{"name": "L0", "position": [0, 0, 1], "existence": 0.9, "category": "car"}])
CASES: dict[str, tuple[str, Callable[[Path], Path], dict[str, Any]]] = {
    "images": ("images", lambda f: pictures(f / "i"), {"frames": 3, "sizes": {"40 x 30": 3}}),
    "kitti folder": ("images", lambda f: pictures(f / "s" / "image_2").parent, {"frames": 3}),
    "picture": ("image", lambda f: pictures(f / "i") / "frame0.png", {"size": [40, 30]}),
    "tum": ("trajectory", lambda f: text(f / "a.txt", TUM), {"poses": 5, "length": 4.0, "rate": 10.0}),
    "kitti": ("trajectory", lambda f: text(f / "a.txt", KITTI), {"poses": 5, "length": 4.0}),
    "euroc": ("trajectory", lambda f: text(f / "a.csv", EUROC), {"poses": 3}),
    "camera json": ("camera", lambda f: text(f / "k.json", '{"fx": 9, "fy": 9, "cx": 4, "cy": 3}'), {"fx": 9}),
    "camera text": ("camera", lambda f: text(f / "k.txt", "9 9 4 3\n"), {"fx": 9.0}),
    "kitti calib": ("camera", lambda f: text(f / "calib.txt", "P2: 7 0 3 0 0 7 2 0 0 0 1 0\n"), {"fx": 7.0}),
    "observations": ("observations", lambda f: observed(f / "o.jsonl"), {"detections": 2, "frames": [0, 2]}),
    "boxes": ("box-lines", lambda f: text(f / "b.jsonl", '{"frame": 0, "box": [0, 0, 1, 1]}\n'), {"detections": 1}),
    "scenes": ("scenes", lambda f: scenes(f / "s"), {"images": 2, "objects": 2, "categories": {"car": 2}}),
    "results": ("coco-results", lambda f: text(f / "r.json", RESULTS), {"detections": 1, "categories": {"car": 1}}),
    "oa-slam": ("oa-slam", lambda f: text(f / "o.json", OA), {"detections": 1}),
    "omni3d": ("omni3d", lambda f: text(f / "c.json", OMNI), {"with_position": 1}),
    "yolo": ("yolo", lambda f: text(f / "y" / "a.txt", "2 0.5 0.5 0.1 0.1 0.9\n").parent, {"categories": {"car": 1}}),
    "kitti labels": ("kitti-labels", lambda f: text(f / "l" / "0.txt", LABEL).parent, {"with_position": 1}),
    "coco": ("coco", lambda f: coco(f / "i.json"), {"objects": 2, "masks": 1}),
    "voc": ("voc-annotations", lambda f: text(f / "v" / "a.xml", VOC).parent, {"images": 1, "categories": {"car": 1}}),
    "npz": ("npz", lambda f: arrays(f / "a.npz"), {"arrays": {"covariance": "3 x 6 x 6"}}),
    "mesh": ("mesh", lambda f: text(f / "a.obj", OBJ), {"vertices": 3, "faces": 1}),
    "landmarks": ("landmarks", lambda f: text(f / "landmarks.json", LANDMARKS), {"landmarks": 1, "in_map": 1}),
}


@pytest.mark.parametrize("case", CASES)
def test_every_format_is_told(case: str, tmp_path: Path) -> None:
    name, make, facts = CASES[case]
    report = check_data(make(tmp_path))
    assert report.format == name, report
    assert {key: report.facts.get(key) for key in facts} == facts
    json.dumps(report.as_json(), allow_nan=False)
    assert report.facts == check_data(make(tmp_path), name).facts


def test_bags_are_told(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from tests.bags import BagWriter

    with BagWriter(tmp_path / "bag", "mcap") as bag:
        for k in range(3):
            bag.image("/cam", 1.0 + k, np.zeros((8, 12, 3), np.uint8), "rgb8")
            bag.odometry("/odom", 1.0 + k, np.eye(4), "base")
    report = check_data(tmp_path / "bag")
    assert report.format == "rosbag" and report.facts["images"]["frames"] == 3
    assert report.facts["topics"]["/odom"] == {"type": "nav_msgs/msg/Odometry", "messages": 3, "read": True}


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (
            lambda f: text(f / "a.txt", TUM + "103.5 x 0 0 0 0 0 1\n"),
            "not a row of numbers",
        ),
        (lambda f: text(f / "a.txt", KITTI + "1 0 0 900 0 1 0 0 0 0 1 0\n"), "a jump of 896 m after row 4"),
        (lambda f: text(f / "a.txt", TUM + "100.4 9 0 0 0 0 0 1\n"), "repeat a time"),
        (lambda f: (pictures(f / "i"), text(f / "i" / "x.png", "no picture"))[1].parent, "not a readable image"),
        (lambda f: (pictures(f / "i"), Image.new("L", (9, 9)).save(f / "i" / "z.png"))[0] or f / "i", "images of 2 sizes"),
        (lambda f: text(f / "k.json", '{"fx": 9, "fy": 9, "cx": 4, "cy": 3, "k9": 1}'), "unknown fields of a camera"),
        (lambda f: coco(f / "i.json"), "annotation 2 is of an image that is not listed"),
        (lambda f: text(f / "i.json", json.dumps({**json.loads(coco(f / "i.json").read_text()), "images": [{}]})), "with an id"),
        (lambda f: text(f / "r.json", RESULTS.replace("0.5", "7")), "score: got 7.0"),
        (lambda f: text(f / "notes.md", "# notes"), "no format fits"),
        (lambda f: f, "the folder is empty"),
    ],
)
def test_what_is_wrong_is_said(make: Callable[[Path], Path], match: str, tmp_path: Path) -> None:
    report = check_data(make(tmp_path))
    assert any(match in problem for problem in report.problems), report.problems


def test_a_folder_of_several_things(tmp_path: Path) -> None:
    pictures(tmp_path / "drive" / "frames" / "left")
    text(tmp_path / "drive" / "odometry.txt", TUM)
    text(tmp_path / "drive" / "notes.md", "# notes")
    report = check_data(tmp_path / "drive")
    assert report.format == "folder" and [name for name, _ in report.parts] == ["frames", "odometry.txt"]
    assert report.parts[1][1].facts["poses"] == 5 and report.pictures is not None


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, sheet = scenes(tmp_path / "s"), tmp_path / "sheet.png"
    main(["data", "check", str(folder), "--out", str(sheet)])
    assert "labelled scenes [scenes]" in capsys.readouterr().out
    colours = np.asarray(Image.open(sheet)).reshape(-1, 3)
    drawn = (colours == ImageColor.getrgb(category_colour("car"))).all(axis=1)
    assert Image.open(sheet).size == (640, 254) and drawn.sum() > 300  # the boxes
    main(["data", "check", "scenes", str(folder), "--json"])
    assert json.loads(capsys.readouterr().out)["objects"] == 2
    with pytest.raises(SystemExit) as end:
        main(["data", "check", str(text(tmp_path / "a.txt", KITTI + "1 0 0 900 0 1 0 0 0 0 1 0\n"))])
    assert end.value.code == 1 and "wrong: a jump" in capsys.readouterr().out
    main(["data", "check", str(folder / "images" / "frame0.png")])
    assert "size: 40 x 30" in capsys.readouterr().out
    for arguments, match in (
        (["check", str(tmp_path / "nothing")], "no such file or folder"),
        (["check", "voc-annotations", str(tmp_path / "nothing")], "no such file or folder"),
        (["check", "nonsense", str(folder)], "no such format: got nonsense"),
        (["look", str(folder)], "expected check"),
        (["check", str(tmp_path / "a.txt"), "--out", str(sheet)], "no pictures for a contact sheet"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["data", *arguments])
        assert end.value.code == 2 and match in capsys.readouterr().err


def test_a_format_of_ones_own(tmp_path: Path) -> None:
    @register("own", "a format of one's own", lambda look: float(look.suffix == ".own"))
    def report_own(path: Path) -> FormatReport:
        return FormatReport("own", "a format of one's own", {"bytes": path.stat().st_size})

    try:
        assert check_data(text(tmp_path / "a.own", "abc")).facts == {"bytes": 3}
        with pytest.raises(InputError, match="no such format"):
            check_data(tmp_path, "owner")
    finally:
        del FORMATS["own"]


REAL = {
    "tum/fr2_desk_ORB.txt": "trajectory",
    "kitti_odometry/poses/06.txt": "trajectory",
    "annotations/coco/instances_val2017.json": "coco",
    "annotations/voc2012": "voc-annotations",
    "annotations/stanford_cars/cars_test_annos.mat": "stanford-cars",
    "sequences/kitti_raw_0005": "images",
    "kitti_tracking/labels": "kitti-labels",
    "backgrounds": "images",
}


@pytest.mark.parametrize("name", REAL)
def test_real_files_are_told(name: str, data_dir: Path) -> None:
    if not (data_dir / name).exists():
        pytest.skip(f"{name} is not there")
    best = recognise(data_dir / name)[0][1].name
    assert best == REAL[name] or (best == "matlab-annotations" and REAL[name] == "stanford-cars")
