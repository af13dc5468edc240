"""Detections of other people: every format says the same, and boxes alone place objects with an honest covariance."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.cli.convert import main
from nolbo_ppl.data.converters.coco_names import COCO_IDS
from nolbo_ppl.data.converters.foreign_detections import observations_of, read_foreign_detections
from nolbo_ppl.errors import InputError
from nolbo_ppl.io.observations import read_observations

CAMERA = np.array([500.0, 510.0, 320.0, 240.0])
SIZE = (640, 480)
BOXES = np.array([[100.0, 120, 220, 200], [300, 200, 330, 290], [400, 100, 500, 300]])
OA_SLAM = '[{"file_name": "a", "detections": [{"bbox": %s, "category_id": %s, "detection_score": 1}]}]'
SCORES = (0.9, 0.5, 0.75)
CATEGORIES = ("car", "person", "chair")
IMAGES = ("f10.png", "f2.png", "f2.png")  # natural order: f2 is frame 0


def written(folder: Path, form: str) -> Path:
    """The three boxes in a format."""
    folder.mkdir(exist_ok=True)
    number = {name: k for k, name in COCO_IDS.items()}
    if form == "coco":
        rows = [
            {"image_id": image, "category_id": number[c], "bbox": [b[0], b[1], b[2] - b[0], b[3] - b[1]], "score": s}
            for image, c, b, s in zip(IMAGES, CATEGORIES, BOXES.tolist(), SCORES)
        ]
        (folder / "a.json").write_text(json.dumps(rows))
        return folder / "a.json"
    if form == "oa-slam":
        place = {name: list(COCO_IDS.values()).index(name) for name in CATEGORIES}
        rows = [
            {
                "file_name": image,
                "detections": [
                    {"category_id": place[c], "detection_score": s, "bbox": b}
                    for i, c, b, s in zip(IMAGES, CATEGORIES, BOXES.tolist(), SCORES)
                    if i == image
                ],
            }
            for image in sorted(set(IMAGES))
        ]
        (folder / "a.json").write_text(json.dumps(rows))
        return folder / "a.json"
    for image in set(IMAGES):
        text = ""
        for i, c, b, s in zip(IMAGES, CATEGORIES, BOXES, SCORES):
            if i != image:
                continue
            if form == "yolo":
                x, y, w, h = (b[0] + b[2]) / 1280, (b[1] + b[3]) / 960, (b[2] - b[0]) / 640, (b[3] - b[1]) / 480
                text += f"{list(COCO_IDS.values()).index(c)} {x} {y} {w} {h} {s}\n"
            else:
                kind = {"person": "Pedestrian"}.get(c, c.capitalize())
                text += f"{kind} -1 -1 -10 {b[0]} {b[1]} {b[2]} {b[3]} -1 -1 -1 -1000 -1000 -1000 -10 {s}\n"
        (folder / f"{Path(image).stem}.txt").write_text(text)
    return folder


@pytest.mark.parametrize("form", ["coco", "oa-slam", "yolo", "kitti"])
def test_every_format_says_the_same(tmp_path: Path, form: str) -> None:
    found = read_foreign_detections(written(tmp_path / "d", form), form, size=SIZE)  # type: ignore[arg-type]
    order = [1, 2, 0]
    assert found.frame.tolist() == [0, 0, 1] and found.category == tuple(CATEGORIES[k] for k in order)
    np.testing.assert_allclose(found.box, BOXES[order], atol=1e-9)
    np.testing.assert_allclose(found.score, np.array(SCORES)[order])
    assert np.isnan(found.position).all()
    path = tmp_path / "d" / "a.json" if form in ("coco", "oa-slam") else tmp_path / "d"
    images = ["f1.png", "f2.png", "f10.png"]
    shifted = read_foreign_detections(path, form, size=SIZE, images=images)  # type: ignore[arg-type]
    assert shifted.frame.tolist() == [1, 1, 2]


def test_three_dimensional_labels_agree(tmp_path: Path) -> None:
    """The same car as a KITTI label and in Omni3D's camera frame: bottom centre against centre, yaw against matrix."""
    h, w, length, turn = 1.5, 1.7, 4.2, 0.4
    centre = np.array([2.0, 0.9, 15.0])
    label = f"Car 0 0 0 300 200 400 260 {h} {w} {length} {centre[0]} {centre[1] + h / 2} {centre[2]} {turn} 0.8\n"
    (tmp_path / "000003.txt").write_text(label)
    kitti = read_foreign_detections(tmp_path, "kitti")
    np.testing.assert_allclose(kitti.position[0], centre)
    np.testing.assert_allclose(kitti.size[0], [w, length, h])
    R = kitti.rotation[0]
    np.testing.assert_allclose(R @ [0, 0, 1], [0, -1, 0], atol=1e-12)  # up
    np.testing.assert_allclose(R @ [0, -1, 0], [np.cos(turn), 0, -np.sin(turn)], atol=1e-12)  # KITTI: front at turn 0 is x
    theirs = R @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    item = {
        "category": "car",
        "score": 0.8,
        "bbox": [300, 200, 100, 60],
        "center_cam": centre.tolist(),
        "dimensions": [w, h, length],
        "pose": theirs.tolist(),
    }
    (tmp_path / "o.json").write_text(json.dumps([{"image_id": 3, "K": [], "instances": [item]}]))
    omni = read_foreign_detections(tmp_path / "o.json", "omni3d")
    for name in ("frame", "box", "score", "position", "rotation", "size"):
        np.testing.assert_allclose(getattr(omni, name), getattr(kitti, name), atol=1e-9, err_msg=name)


def test_boxes_alone_hold_the_truth_as_often_as_they_say() -> None:
    """4000 objects of random heights seen in boxes with a few px of noise: 90 % regions hold 90 % of them."""
    rng = np.random.default_rng(0)
    n = 4000
    height = np.maximum(1.6 + 0.15 * rng.standard_normal(n), 0.5)
    place = np.column_stack([rng.uniform(-2, 2, n), rng.uniform(-1, 1, n), rng.uniform(6, 20, n)])
    pixel = place[:, :2] / place[:, 2:] * CAMERA[:2] + CAMERA[2:]
    tall = CAMERA[1] * height / place[:, 2]
    half = np.column_stack([0.2 * tall, 0.5 * tall])
    centre = pixel + 0.05 * 2 * half * rng.standard_normal((n, 2))
    from nolbo_ppl.data.converters.foreign_detections import ForeignDetections

    found = ForeignDetections(
        np.arange(n),
        np.concatenate([centre - half, centre + half], axis=1),
        np.full(n, 0.9),
        ("post",) * n,
        np.full((n, 3), np.nan),
        np.full((n, 3, 3), np.nan),
        np.full((n, 3), np.nan),
    )
    table, left_out = observations_of(found, CAMERA, None, {"post": (1.6, 0.15)})
    assert len(table) == n and sum(left_out.values()) == 0
    error = table.position - place
    inside = np.einsum("ni,nij,nj->n", error, np.linalg.inv(table.position_covariance), error) < 6.251
    assert 0.87 < inside.mean() < 0.97


def test_what_is_left_out_is_counted(tmp_path: Path) -> None:
    found = read_foreign_detections(written(tmp_path / "d", "coco"), "coco")
    table, left_out = observations_of(found, CAMERA, (640, 240), {"car": (1.5, 0.1), "person": (1.7, 0.1)}, 0.6)
    assert len(table) == 1 and table.category == ("car",)
    assert left_out == {"below the score": 1, "without a height of their category": 1, "cut off by the image": 0}


def test_the_command_writes_observations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "k.json").write_text(json.dumps({"fx": 500, "fy": 510, "cx": 320, "cy": 240, "width": 640, "height": 480}))
    data = written(tmp_path / "d", "coco")
    main(
        [
            "detections",
            "--data",
            str(data),
            "--format",
            "coco",
            "--intrinsics",
            str(tmp_path / "k.json"),
            "--out",
            str(tmp_path / "o"),
        ]
    )
    table = read_observations(tmp_path / "o" / "observations.jsonl", frames=2)
    assert len(table) == 3 and "3 of 3 detections" in capsys.readouterr().out
    car = table.position[table.category.index("car")]
    assert car[2] == pytest.approx(510 * 1.53 / 80)


@pytest.mark.parametrize(
    ("form", "text", "match"),
    [
        ("coco", '[{"image_id": 1, "category_id": 12, "bbox": [0, 0, 1, 1]}]', "category without a name: got 12"),
        ("coco", '[{"image_id": 1, "category_id": 1, "bbox": [0, 0, 0, 1]}]', "box 0: got .*expected x0 < x1"),
        ("coco", '[{"image_id": 1, "category_id": 1, "bbox": [0, 0, 1, 1], "score": 3}]', "score: got 3.0"),
        ("coco", '{"images": [], "model": 1}', "not detections in the format coco: got KeyError: 'annotations'"),
        ("coco", '[{"image_id": 1}]', "not detections in the format coco: got KeyError"),
        ("coco", '[{"image_id": 1, "category_id": 1, "bbox": [true, 0, 1, 1]}]', "bbox of detection 0: got .*expected 4 numbers"),
        ("coco", '[{"image_id": 1, "category_id": 1, "bbox": ["0", "0", "1", "1"]}]', "bbox of detection 0"),
        ("coco", '[{"image_id": 1, "category_id": 1, "bbox": [0, 0, 1, 1], "score": true}]', "score of detection 0: got True"),
        ("coco", '[{"image_id": 1, "category_id": true, "bbox": [0, 0, 1, 1]}]', "category without a name: got True"),
        (
            "oa-slam",
            '[{"file_name": "a", "detections": [{"bbox": [0, 0, 1], "category_id": 1, "detection_score": 1}]}]',
            "bbox of",
        ),
        (
            "oa-slam",
            '[{"file_name": "a", "detections": [{"bbox": [0, 0, 1, 1], "category_id": -1, "detection_score": 1}]}]',
            "got -1",
        ),
        ("omni3d", '{"images": []}', "not detections in the format omni3d"),
        ("kitti", "Car 1 2\n", "a.json:1: not a KITTI label: got Car 1 2"),
    ],
)
def test_damage_is_named(tmp_path: Path, form: str, text: str, match: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=match):
        read_foreign_detections(tmp_path / "a.json", form)  # type: ignore[arg-type]


def test_masks_give_a_better_centre(tmp_path: Path) -> None:
    """An L: its centre of mass is not that of its box; polygons, run lengths, a box of the file's own or the mask's."""
    polygon = [[100.0, 100, 140, 100, 140, 110, 110, 110, 110, 160, 100, 160]]
    pixels = np.zeros((480, 640), bool)
    pixels[100:110, 100:140] = pixels[100:160, 100:110] = True
    flat = pixels.T.ravel()
    edges = np.flatnonzero(np.diff(flat)) + 1
    counts = np.diff(np.concatenate([[0], edges, [flat.size]])).tolist()
    centre = np.argwhere(pixels)[:, ::-1].mean(axis=0) + 0.5
    rows = [
        {"image_id": 0, "category_id": 62, "bbox": [100, 100, 40, 60], "score": 0.9, "segmentation": polygon},
        {"image_id": 1, "category_id": 62, "score": 0.9, "segmentation": {"size": [480, 640], "counts": counts}},
        {"image_id": 2, "category_id": 62, "bbox": [100, 100, 40, 60], "score": 0.9},
        {
            "image_id": 3,
            "category_id": 62,
            "bbox": [0, 0, 640, 480],
            "iscrowd": 1,
            "segmentation": {"size": [1, 1], "counts": [1]},
        },
    ]
    (tmp_path / "a.json").write_text(json.dumps(rows))
    lines = [
        {"frame": 0, "box": [100, 100, 140, 160], "mask": polygon, "category": "chair", "score": 0.9},
        {"frame": 1, "mask": {"size": [480, 640], "counts": counts}, "category": "chair", "objectness": 0.9},
        {"frame": 2, "box": [100, 100, 140, 160], "category": "chair", "score": 0.9},
    ]
    (tmp_path / "a.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    for name, form in (("a.json", "coco"), ("a.jsonl", "lines")):
        found = read_foreign_detections(tmp_path / name, form)  # type: ignore[arg-type]
        np.testing.assert_allclose(found.box, np.tile([100.0, 100, 140, 160], (3, 1)))
        np.testing.assert_allclose(found.centre, [centre, centre, [120, 130]])
        table, _ = observations_of(found, CAMERA)
        ray = table.position[:, :2] / table.position[:, 2:]
        np.testing.assert_allclose(ray * CAMERA[:2] + CAMERA[2:], found.centre)


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ('{"frame": 0}', "no box: expected `box`"),
        ('{"box": [0, 0, 1, 1]}', "no image: expected `frame`"),
        ('{"frame": 0, "box": [0, 0, 1, 1], "score": 2}', "score: got 2, expected 0 to 1"),
        ('{"frame": 0, "box": [0, 0, 1, 1], "boxx": 2}', "unknown field"),
        ('{"frame": 0, "box": [0, 0, 1, 1], "position": [0, 0, 1]}', "nolbo slam reads such lines itself"),
        ('{"frame": 0, "mask": [[1, 2]]}', "a.json:1: mask: got polygon of a mask"),
    ],
)
def test_damaged_lines_are_named(tmp_path: Path, line: str, match: str) -> None:
    (tmp_path / "a.json").write_text(line + "\n")
    with pytest.raises(InputError, match=match):
        read_foreign_detections(tmp_path / "a.json", "lines")


def test_an_odometry_that_lies_in_the_output_stays(tmp_path: Path) -> None:
    (tmp_path / "boxes.jsonl").write_text('{"frame": 0, "box": [100, 100, 120, 140]}\n')
    (tmp_path / "camera.txt").write_text("300 300 160 120\n")
    (tmp_path / "odometry.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    files = {"data": "boxes.jsonl", "intrinsics": "camera.txt", "odometry": "odometry.txt", "out": "."}
    options = [word for name, file in files.items() for word in (f"--{name}", str(tmp_path / file))]
    with pytest.raises(InputError, match="would replace an input"):
        main(["detections", "--format", "lines", *options])
    assert (tmp_path / "odometry.txt").is_file()
