"""Detections of other people's detectors: COCO, YOLO, KITTI, Omni3D and OA-SLAM files as observations of objects.

A box without a position becomes one where the height of its category is known: the range is that height over the box's, with
the spread of the heights as its spread. Such an observation is a long ellipsoid along its ray; what one view leaves open, the
views together settle in the graph.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.data.converters.coco_names import COCO_IDS, COCO_NAMES, HEIGHTS
from nolbo_ppl.data.converters.foreign_fields import category_name, mask_of, numbers_of, score_of
from nolbo_ppl.data.converters.kitti_tracking import car_rotation
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.masks import MaskMoments
from nolbo_ppl.io.fields import is_number, number_array
from nolbo_ppl.io.files import read_json, read_jsonl
from nolbo_ppl.io.images import natural
from nolbo_ppl.io.text import read_words
from nolbo_ppl.structures.detections import Detections

DetectionFormat = Literal["coco", "yolo", "kitti", "omni3d", "oa-slam", "lines"]
"""`coco`: results JSON, boxes or masks; `yolo`: a folder of text files; `kitti`: label files, 2D and 3D; `omni3d`: annotations or
Cube R-CNN's results; `oa-slam`: a list of `file_name` and `detections` with corners; `lines`: JSON Lines of boxes or masks (see
`read_lines`)."""
RIM = 2.0
"""Boxes that come this near to the image's edge, px, may be cut off: their height says nothing."""
CENTRE_SHARE = 0.05
"""Standard deviation of a box's centre from the object's, in parts of the box."""


@dataclass(frozen=True)
class ForeignDetections:
    """Boxes of a file in order of the frames; positions, rotations and sizes where the detector gives them, else NaN."""

    frame: Int[np.ndarray, " n"]
    """Number of the image: its place in the list of images, or in natural order of their names."""
    box: Float[np.ndarray, "n 4"]
    """x0 y0 x1 y1, px."""
    score: Float[np.ndarray, " n"]
    """Confidence, 0 to 1."""
    category: tuple[str, ...]
    """Names, blanks as underscores."""
    position: Float[np.ndarray, "n 3"]
    """Centre in the camera frame, m."""
    rotation: Float[np.ndarray, "n 3 3"]
    """R_camera_object (front -y, z up)."""
    size: Float[np.ndarray, "n 3"]
    """Extent along the object's axes, m."""
    mask_centre: Float[np.ndarray, "n 2"] | None = None
    """Centre of mass of the object's pixels, px, where a mask is given, else NaN."""
    covariance: Float[np.ndarray, "n 3 3"] | None = None
    """Covariance of the position, m^2, where the detector states it, else NaN."""

    @property
    def centre(self) -> Float[np.ndarray, "n 2"]:
        """Where the object's centre is seen, px: the centre of its mask, or else of its box."""
        middle = 0.5 * (self.box[:, :2] + self.box[:, 2:])
        return middle if self.mask_centre is None else np.where(np.isfinite(self.mask_centre), self.mask_centre, middle)

    def __len__(self) -> int:
        return len(self.frame)

    def placed(
        self,
        rows: Int[np.ndarray, " k"],
        position: Float[np.ndarray, "n 3"],
        covariance: Float[np.ndarray, "n 3 3"],
        shared: Float[np.ndarray, "n 3 3"] | None = None,
    ) -> Detections:
        """Some of the detections as observations for SLAM, with positions in their camera frames, m, that all of them have got.

        Their identifiers are `d` and their number here.
        """
        return Detections.from_arrays(
            self.frame[rows],
            position[rows],
            position_covariance=covariance[rows],
            position_shared=None if shared is None else shared[rows],
            rotation=self.rotation[rows],
            objectness=np.clip(self.score[rows], 1e-3, 1 - 1e-3),
            category=[self.category[k] for k in rows],
            size=self.size[rows],
            box=self.box[rows],
            id=[f"d{k}" for k in rows],
        )


def is_whole(box: Float[np.ndarray, "n 4"], size: Sequence[float] | Float[np.ndarray, " 2"]) -> Bool[np.ndarray, " n"]:
    """Boxes that keep away from the rim of an image of this width and height, px; false for NaN."""
    return np.logical_and((box[:, :2] > RIM).all(axis=1), (box[:, 2:] < np.asarray(size) - RIM).all(axis=1))


@dataclass
class _Row:
    image: str
    box: Sequence[float]
    score: float
    category: str
    position: Sequence[float] | None = None
    rotation: np.ndarray | None = None
    size: Sequence[float] | None = None
    mask: MaskMoments | None = None


def _coco(path: Path, names: Mapping[int, str] | None) -> list[_Row]:
    content = read_json(path)
    images: dict[Any, str] = {}
    if isinstance(content, dict):
        images = {image["id"]: str(image["file_name"]) for image in content.get("images", [])}
        names = {int(c["id"]): str(c["name"]) for c in content.get("categories", [])} or names
        content = content["annotations"]
    rows = []
    for k, item in enumerate(content):
        if item.get("iscrowd"):
            continue  # a crowd is no object
        mask = mask_of(item.get("segmentation"), f"segmentation of detection {k}", path)
        if item.get("bbox") is None and mask is not None:
            box = mask.box.tolist()
        else:
            x, y, w, h = numbers_of(item["bbox"], 4, f"bbox of detection {k}", path)
            box = [x, y, x + w, y + h]
        image = images.get(item["image_id"], str(item["image_id"]))
        category = category_name(item.get("category_name", item.get("category_id")), names or COCO_IDS, {"file": path})
        rows.append(_Row(image, box, score_of(item.get("score", 1.0), f"score of detection {k}", path), category, mask=mask))
    return rows


LINE = ("frame", "image", "time", "id", "box", "mask", "score", "objectness", "category", "position", "rotation", "size")
"""Fields of a line of boxes."""


def read_lines(path: Path) -> list[_Row]:
    """JSON Lines of boxes: `frame` (a number) or `image` (a name), `box` [x0, y0, x1, y1] px or `mask`, `category`, `score`.

    A mask is COCO's: polygons, or `{"size": [h, w], "counts": ...}`; where there is no box, it is the mask's. `objectness` is
    another name of `score`, 1 by default.

    Raises:
        InputError: a field that is missing, malformed or unknown; names file and line.
    """
    rows = []
    for number, item in read_jsonl(path):
        where: dict[str, Any] = {"file": path, "line": number}
        unknown = sorted(set(item) - set(LINE))
        if unknown:
            raise input_error("unknown field", got=unknown, expected=f"some of {sorted(LINE)}", **where)
        if item.get("position") is not None:
            raise input_error("a box with a position", expected="boxes alone", do="nolbo slam reads such lines itself", **where)
        mask = mask_of(item.get("mask"), "mask", path, number)
        box = number_array(item.get("box"), (4,), 1e6) if item.get("box") is not None else None if mask is None else mask.box
        if box is None:
            raise input_error("no box", got=item.get("box"), expected="`box` [x0, y0, x1, y1] in px, or `mask`", **where)
        image = item.get("image") if item.get("frame") is None else item["frame"]
        if isinstance(image, bool) or not isinstance(image, int | str) or (isinstance(image, int) and image < 0):
            raise input_error("no image", got=image, expected="`frame`, a number from 0, or `image`, a name", **where)
        score, category = item.get("score", item.get("objectness", 1.0)), item.get("category", "object")
        if not is_number(score, 0, 1):
            raise input_error("score", got=score, expected="0 to 1", **where)
        if not isinstance(category, str):
            raise input_error("`category` is no name", got=category, expected="a string", **where)
        rows.append(_Row(str(image), box.tolist(), float(score), category.replace(" ", "_"), mask=mask))
    return rows


def _oa_slam(path: Path, names: Sequence[str] | None) -> list[_Row]:
    return [
        _Row(
            str(image["file_name"]),
            numbers_of(item["bbox"], 4, f"bbox of a detection in {image['file_name']}", path),
            score_of(item["detection_score"], f"detection_score of a detection in {image['file_name']}", path),
            category_name(item["category_id"], names or COCO_NAMES, {"file": path}),
        )
        for image in read_json(path)
        for item in image["detections"]
    ]


def _yolo(folder: Path, names: Sequence[str] | None, size: tuple[int, int] | None) -> list[_Row]:
    if size is None:
        raise input_error("YOLO boxes are parts of the image", expected="its width and height", do="state them with the camera")
    rows = []
    for path in sorted(folder.glob("*.txt"), key=natural):
        for number, words in read_words(path):
            where: dict[str, Any] = {"file": path, "line": number}
            try:
                values = [float(word) for word in words]
            except ValueError:
                values = []
            if len(values) not in (5, 6) or min(values[1:]) < 0 or max(values[1:]) > 1:
                raise input_error(
                    "not a YOLO label", got=" ".join(words)[:60], expected="class x y w h [score], parts of the image", **where
                )
            x, y, w, h = np.array(values[1:5]) * np.tile(size, 2)
            score = values[5] if len(values) == 6 else 1.0
            category = category_name(values[0], names or COCO_NAMES, where)
            rows.append(_Row(path.stem, [x - w / 2, y - h / 2, x + w / 2, y + h / 2], score, category))
    return rows


def _kitti(path: Path) -> list[_Row]:
    """Label files of KITTI, one an image (15 or 16 columns), or one a drive that begins with frame and track (17 or 18)."""
    rows = []
    for file in [path] if path.is_file() else sorted(path.glob("*.txt"), key=natural):
        for number, words in read_words(file):
            first = 2 if len(words) in (17, 18) and words[0].lstrip("-").isdigit() else 0
            kind, rest = (words[first], words[first + 1 :]) if len(words) > first else ("", [])
            try:
                values = [float(word) for word in rest]
            except ValueError:
                values = []
            if len(values) not in (14, 15):
                raise input_error(
                    "not a KITTI label", got=" ".join(words)[:60], expected="a type and 14 or 15 numbers", file=file, line=number
                )
            if kind in ("DontCare", "Misc"):
                continue
            category = {"Pedestrian": "person", "Person_sitting": "person", "Cyclist": "bicycle", "Van": "car"}.get(
                kind, kind.lower()
            )
            row = _Row(words[0] if first else file.stem, values[3:7], 1.0, category)
            row.score = values[14] if len(values) == 15 else 1.0
            h, w, length, x, y, z, turn = values[7:14]
            if min(h, w, length) > 0 and z > 0:
                row.position, row.size = [x, y - h / 2, z], [w, length, h]  # KITTI's point is on the ground under the object
                row.rotation = car_rotation(np.array([turn]))[0]
            rows.append(row)
    return rows


def _omni3d(path: Path, names: Mapping[int, str] | None) -> list[_Row]:
    """Omni3D's annotations, and the results of Cube R-CNN: `center_cam`, `dimensions` (width, height, length) and `R_cam`.

    Their boxes are x right, y down, z forward of the object at rest: turned to z up and front to -y here.
    """
    content = read_json(path)
    rows = []
    to_canonical = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # columns: our axes in theirs
    if isinstance(content, dict):
        images = {image["id"]: str(image.get("file_path", image["id"])) for image in content["images"]}
        names = {int(c["id"]): str(c["name"]) for c in content.get("categories", [])} or names
        entries = [(images[item["image_id"]], item) for item in content["annotations"]]
    else:
        entries = [(str(image.get("file_path", image["image_id"])), item) for image in content for item in image["instances"]]
    for k, (image, item) in enumerate(entries):
        category = category_name(
            item.get("category_name", item.get("category", item.get("category_id"))), names or {}, {"file": path}
        )
        given = item.get("bbox2D_tight", item.get("bbox2D_proj"))
        box = None if given is None else numbers_of(given, 4, f"2D box of object {k}", path)
        if box is None or min(box) < 0:
            x, y, w, h = numbers_of(item["bbox"], 4, f"bbox of object {k}", path)
            box = [x, y, x + w, y + h]
        width, height, length = numbers_of(item["dimensions"], 3, f"dimensions of object {k}", path)
        centre = numbers_of(item["center_cam"], 3, f"center_cam of object {k}", path)
        R = number_array(item.get("R_cam", item.get("pose")), (3, 3), 2.0)
        if R is None:
            raise input_error(f"R_cam of object {k}", got=repr(item.get("R_cam"))[:80], expected="a rotation, 3 x 3", file=path)
        score = score_of(item.get("score", 1.0), f"score of object {k}", path)
        rows.append(_Row(image, box, score, category, centre, R @ to_canonical, [width, length, height]))
    return rows


def read_foreign_detections(
    path: str | PathLike[str],
    form: DetectionFormat,
    *,
    images: Sequence[str] | None = None,
    names: Sequence[str] | None = None,
    size: tuple[int, int] | None = None,
) -> ForeignDetections:
    """Read detections of other people.

    Args:
        path: the file; of YOLO and KITTI also the folder of files.
        form: its format.
        images: names of the images in order of the frames; else those of the file in natural order, or their numbers.
        names: names of the categories in order of their numbers; COCO's by default.
        size: width and height of the images, px (YOLO).

    Raises:
        InputError: malformed, a category without a name, a box of an image that is not listed, a score beyond 0 to 1 in every
            format but KITTI's; names the file.
    """
    path = Path(path)
    if not path.exists():
        raise input_error("no such detections", file=path)
    numbered = None if names is None else dict(enumerate(names))
    try:
        if form == "coco":
            rows = _coco(path, numbered)
        elif form == "oa-slam":
            rows = _oa_slam(path, names)
        elif form == "yolo":
            rows = _yolo(path, names, size)
        elif form == "kitti":
            rows = _kitti(path)
        elif form == "lines":
            rows = read_lines(path)
        else:
            rows = _omni3d(path, numbered)
        box = np.array([row.box for row in rows], dtype=np.float64).reshape(-1, 4)
        position = np.array([row.position or [np.nan] * 3 for row in rows], dtype=np.float64).reshape(-1, 3)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        if isinstance(error, ValueError) and str(error).startswith(str(path)):
            raise
        raise input_error(f"not detections in the format {form}", got=f"{type(error).__name__}: {error}", file=path) from None
    if not np.isfinite(box).all() or (box[:, :2] >= box[:, 2:]).any():
        bad = int(np.argmax(~np.isfinite(box).all(axis=1) | (box[:, :2] >= box[:, 2:]).any(axis=1)))
        raise input_error(f"box {bad}", got=json.dumps(box[bad].tolist()), expected="x0 < x1 and y0 < y1", file=path)
    frame = _frames([row.image for row in rows], images, path)
    score = np.array([row.score for row in rows], dtype=np.float64)
    if form == "kitti":  # scores of detectors there are log odds, or missing
        score = np.where((score < 0) | (score > 1), 1 / (1 + np.exp(-np.clip(score, -50, 50))), score)
    if not ((score >= 0) & (score <= 1)).all():
        raise input_error("score", got=float(score[np.argmax((score < 0) | (score > 1))]), expected="0 to 1", file=path)
    order = np.argsort(frame, kind="stable")
    unknown = np.full((3, 3), np.nan)
    return ForeignDetections(
        frame[order],
        box[order],
        score[order],
        tuple(rows[i].category for i in order),
        position[order],
        np.array([unknown if rows[i].rotation is None else rows[i].rotation for i in order]).reshape(-1, 3, 3),
        np.array([rows[i].size or [np.nan] * 3 for i in order], dtype=np.float64).reshape(-1, 3),
        np.array([np.full(2, np.nan) if (m := rows[i].mask) is None else m.centre for i in order]).reshape(-1, 2),
    )


def _frames(found: Sequence[str], images: Sequence[str] | None, path: Path) -> Int[np.ndarray, " n"]:
    """Numbers of the frames: places in a list, whole numbers that the file gives, or natural order of its names."""
    if images is None and all(name.isdigit() for name in found):
        return np.array([int(name) for name in found], dtype=np.int64)
    names = list(images) if images is not None else [str(p) for p in sorted({Path(name) for name in found}, key=natural)]
    place = {Path(name).name: k for k, name in enumerate(names)} | {Path(name).stem: k for k, name in enumerate(names)}
    keys = [Path(name).name if Path(name).name in place else Path(name).stem for name in found]
    missing = next((name for name, key in zip(found, keys) if key not in place), None)
    if missing is not None:
        raise input_error(
            "detections of an image that is not there", got=missing, expected=f"one of {len(names)} images", file=path
        )
    return np.array([place[key] for key in keys], dtype=np.int64)


def observations_of(
    found: ForeignDetections,
    intrinsics: Float[np.ndarray, " 4"],
    size: tuple[int, int] | None = None,
    heights: Mapping[str, tuple[float, float]] | None = None,
    minimum_score: float = 0.0,
) -> tuple[Detections, dict[str, int]]:
    """Observations for SLAM, and how many detections were left out and why.

    A box whose object has no position is placed on the ray of its centre at the range where its category's height fills it,
    `z = f H / h`: with the standard deviation of `H` over `H` along the ray, and that of the centre across.

    Args:
        found: detections.
        intrinsics: fx, fy, cx, cy, px, of images without distortion.
        size: width and height of the images: boxes at the rim are cut off, and left out where they need a height.
        heights: height and standard deviation by category, m; `HEIGHTS` by default.
        minimum_score: detections below are left out.
    """
    heights = HEIGHTS if heights is None else heights
    count = len(found)
    centre = found.centre
    extent = found.box[:, 2:] - found.box[:, :2]
    placed = np.isfinite(found.position).all(axis=1)
    known = np.array([c in heights for c in found.category], dtype=bool)
    whole = np.ones(count, dtype=bool) if size is None else is_whole(found.box, size)
    scored = found.score >= minimum_score
    keep = scored & (placed | (known & whole))
    H, spread = np.array([heights.get(c, (np.nan, np.nan)) for c in found.category]).reshape(-1, 2).T
    ray = np.column_stack([(centre - intrinsics[2:]) / intrinsics[:2], np.ones(count)])
    depth = intrinsics[1] * H / extent[:, 1]
    position = np.where(placed[:, None], found.position, depth[:, None] * ray)
    covariance = np.full((count, 3, 3), np.nan) if found.covariance is None else found.covariance.copy()
    across = depth[:, None] * np.maximum(CENTRE_SHARE * extent, 1.0) / intrinsics[:2]
    for k in np.flatnonzero(keep & ~placed):
        along = ray[k] * depth[k] * np.hypot(spread[k] / H[k], CENTRE_SHARE)
        covariance[k] = np.outer(along, along) + np.diag([across[k, 0] ** 2, across[k, 1] ** 2, (0.1 * spread[k]) ** 2])
    left_out = {
        "below the score": int((~scored).sum()),
        "without a height of their category": int((scored & ~placed & ~known).sum()),
        "cut off by the image": int((scored & ~placed & known & ~whole).sum()),
    }
    return found.placed(np.flatnonzero(keep), position, covariance), left_out
