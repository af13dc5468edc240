"""Formats of drives, by the readers that every verb uses: images, bags, trajectories, cameras, detections, maps, models."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.data.converters.foreign_detections import DetectionFormat, ForeignDetections, read_foreign_detections
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.data.format_registry import LIKELY, POSSIBLE, SURE, FormatReport, LabelledPicture, Look, register, spread
from nolbo_ppl.data.sequences import ImageFolder, frames_with_camera, open_frames
from nolbo_ppl.data.sequences.opening import IMAGE_FOLDERS
from nolbo_ppl.data.sequences.video import VIDEO_SUFFIXES
from nolbo_ppl.errors import InputError
from nolbo_ppl.io.camera_files import read_camera
from nolbo_ppl.io.files import read_jsonl
from nolbo_ppl.io.images import IMAGE_SUFFIXES, image_size, is_passed_over, open_image
from nolbo_ppl.io.landmarks import read_landmarks
from nolbo_ppl.io.npz import Npz
from nolbo_ppl.io.observations import read_observations
from nolbo_ppl.io.ros_bags import IMAGES, READ, Bag, looks_like_bag, split_topic
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory
from nolbo_ppl.io.trajectory_documents import is_colmap
from nolbo_ppl.synthetic.assets.cad import load_mesh
from nolbo_ppl.synthetic.dataset_writer import SCENES

LOOKED_AT = 300
"""Images whose headers are read; of more, so many evenly."""
JUMP = 20.0
"""A step longer than so many medians is named."""
MESHES = (".obj", ".off", ".glb", ".gltf", ".ply", ".stl")


def time_facts(times: np.ndarray | None) -> dict[str, Any]:
    """First and last time, rate and longest gap."""
    if times is None or len(times) < 2:
        return {}
    steps = np.diff(times)
    return {
        "times": [float(times[0]), float(times[-1])],
        "rate": round(float(1 / np.median(steps)), 3),
        "longest_gap": round(float(steps.max()), 4),
    }


# -- images, videos, bags -----------------------------------------------------------------------------------------------


def _image_folder(look: Look) -> float:
    if not look.is_folder:
        return 0.0
    if "rgb.txt" in look.names:
        return SURE
    own = sum(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in look.names)
    if own:
        return LIKELY if 2 * own >= len(look.names) else POSSIBLE
    return POSSIBLE if look.names & set(IMAGE_FOLDERS) else 0.0


@register("images", "a sequence of images (a folder, or TUM RGB-D)", _image_folder)
def report_images(path: Path) -> FormatReport:
    """Frames, sizes, times, and images that cannot be read."""
    frames = open_frames(path)
    problems: list[str] = []
    facts: dict[str, Any] = {"frames": len(frames)}
    if isinstance(frames, ImageFolder):
        sizes: Counter[tuple[int, int]] = Counter()
        for k in spread(len(frames), LOOKED_AT):
            try:
                sizes[image_size(frames.files[k])] += 1
            except InputError as error:
                problems.append(str(error))
        facts |= {"folder": str(frames.files[0].parent), "first": frames.name(0), "last": frames.name(len(frames) - 1)}
        facts["sizes"] = {f"{w} x {h}": count for (w, h), count in sizes.most_common()}
        if len(sizes) > 1:
            problems.append(f"images of {len(sizes)} sizes: nolbo observe takes them, a sequence needs one")
        hidden = sum(is_passed_over(entry) for entry in frames.files[0].parent.iterdir())
        facts |= {"passed_over": hidden} if hidden else {}
        depth = len(getattr(frames, "depth_files", {}))
        facts |= {"depth_images": depth} if depth else {}
    facts |= time_facts(frames.times)
    _, camera, remark = frames_with_camera(frames, None)
    facts |= {"camera": camera.as_dict(), "camera_remark": remark}
    return FormatReport("images", "a sequence of images", facts, tuple(problems), pictures=lambda: _pictures(frames))


def _pictures(frames: Any) -> Iterator[LabelledPicture]:
    for k in spread(len(frames)):
        try:
            yield LabelledPicture(frames.name(k), frames.image(k))
        except InputError:
            continue  # it is among the problems


@register("image", "a picture", lambda look: LIKELY if look.suffix in IMAGE_SUFFIXES and look.path.is_file() else 0.0)
def report_image(path: Path) -> FormatReport:
    """One picture."""
    image = open_image(path)
    facts = {"size": [image.shape[1], image.shape[0]]}
    return FormatReport("image", "a picture", facts, pictures=lambda: iter([LabelledPicture(path.name, image)]))


@register("video", "a video", lambda look: LIKELY if look.suffix in VIDEO_SUFFIXES and look.path.is_file() else 0.0)
def report_video(path: Path) -> FormatReport:
    """Frames, size, times."""
    frames = open_frames(path)
    facts = {"frames": len(frames), "size": list(frames.size), **time_facts(frames.times)}
    return FormatReport("video", "a video", facts, pictures=lambda: _pictures(frames))


@register("rosbag", "a recording of ROS", lambda look: SURE if looks_like_bag(split_topic(look.path)[0]) else 0.0)
def report_bag(path: Path) -> FormatReport:
    """Topics, what each is read as, times, and the frames of the first topic of images."""
    file, topic = split_topic(path)
    with Bag(file) as bag:
        rows = {one.name: {"type": one.type, "messages": one.count, "read": one.type in READ} for one in bag.topics.values()}
        images = [one.name for one in bag.of_types(IMAGES)]
    facts: dict[str, Any] = {"topics": rows}
    if topic is None and not images:
        return FormatReport("rosbag", "a recording of ROS", facts)
    chosen = topic or images[0]
    if rows.get(chosen, {}).get("type") not in IMAGES:
        return FormatReport("rosbag", "a recording of ROS", facts | {"topic": rows.get(chosen)})
    problems = []
    try:
        frames = open_frames(file, chosen)
        _, camera, remark = frames_with_camera(frames, None)
        facts |= {"images": {"topic": chosen, "frames": len(frames), "size": list(frames.size), **time_facts(frames.times)}}
        facts |= {"camera": camera.as_dict(), "camera_remark": remark}
        return FormatReport("rosbag", "a recording of ROS", facts, pictures=lambda: _pictures(frames))
    except InputError as error:
        problems.append(str(error))
    return FormatReport("rosbag", "a recording of ROS", facts, tuple(problems))


# -- trajectories, cameras ----------------------------------------------------------------------------------------------


def _trajectory(look: Look) -> float:
    if look.suffix == ".json":
        nuscenes = all(f'"{name}"' in look.text for name in ("timestamp", "rotation", "translation"))
        return LIKELY if nuscenes and look.text.lstrip().startswith("[") and "camera_intrinsic" not in look.text else 0.0
    if look.suffix == ".txt" and is_colmap(look.text.splitlines()):
        return SURE
    if look.suffix not in (".txt", ".csv", ".tum", ".kitti", ""):
        return 0.0
    if look.is_folder or not look.text:
        return 0.0
    columns = look.number_columns()
    if columns in (12, 13, 16):
        return LIKELY
    first = look.text.splitlines()[0]
    named = re.search(r"(^|[\s,_])q_?\w*_?w\b|qw", first) is not None and (look.suffix == ".csv" or first.startswith("#"))
    if columns == 8 or (columns > 8 and look.suffix == ".csv"):
        return LIKELY if columns == 8 else POSSIBLE
    return LIKELY if named else POSSIBLE if columns == 4 and look.rows[3:4] == [["0", "0", "0", "1"]] else 0.0


def trajectory_facts(found: Trajectory) -> tuple[dict[str, Any], list[str]]:
    """Rows, times, length, and what is odd: lost poses, repeated times, jumps."""
    T = found.T_world_camera[found.known]
    steps = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    facts: dict[str, Any] = {"poses": len(found), "lost": int((~found.known).sum()), "repeated_times": found.repeated_stamps}
    facts |= {"length": round(float(steps.sum()), 3), **time_facts(found.times)}
    problems = []
    if facts["lost"]:
        problems.append(f"{facts['lost']} rows hold no pose: as a truth they are left out, as an odometry refused")
    if facts["repeated_times"]:
        problems.append(f"{facts['repeated_times']} rows repeat a time: as a truth the first is taken, as an odometry refused")
    median = float(np.median(steps)) if len(steps) else 0.0
    if median > 0 and steps.max() > JUMP * median:
        k = int(np.argmax(steps))
        problems.append(f"a jump of {steps[k]:.3g} m after row {k}, {steps[k] / median:.0f} times the median step")
    return facts, problems


@register("trajectory", "a trajectory (KITTI, TUM, EuRoC, 4 x 4, COLMAP, nuScenes)", _trajectory)
def report_trajectory(path: Path) -> FormatReport:
    """Rows, times, length."""
    found = read_trajectory(path, lost=True, repeated=True)
    facts, problems = trajectory_facts(found)
    return FormatReport("trajectory", "a trajectory, T_world_camera", facts, tuple(problems))


def _camera(look: Look) -> float:
    if look.suffix in (".yaml", ".yml"):
        words = ("camera", "fx", "intrinsics", "projection_parameters")
        return LIKELY if any(word in look.text.lower() for word in words) else 0.0
    if look.suffix == ".json":
        return LIKELY if re.search(r'"(fx|fl_x|camera_matrix|K)"\s*:', look.text) and '"images"' not in look.text else 0.0
    if look.suffix == ".txt" and any(words[0].rstrip(":") in ("P0", "P2", "P_rect_02", "P_rect_00") for words in look.rows):
        return SURE
    return POSSIBLE if look.suffix == ".txt" and len(look.rows) == 1 and look.number_columns() in (4, 8, 9) else 0.0


@register("camera", "a camera", _camera)
def report_camera(path: Path) -> FormatReport:
    """Intrinsics, distortion, and how wide it looks."""
    camera = read_camera(path)
    facts = camera.as_dict()
    if camera.width:
        facts["degrees_across"] = round(float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx))), 1)
    problems = [] if camera.width else ["the file states no size of the images: they are taken to fit"]
    return FormatReport("camera", "a camera", facts, tuple(problems))


# -- detections, observations, scenes -----------------------------------------------------------------------------------


def box_facts(found: ForeignDetections) -> tuple[dict[str, Any], list[str]]:
    """Detections, frames, categories, scores, heights of boxes."""
    facts: dict[str, Any] = {"detections": len(found), "images": len(np.unique(found.frame))}
    if not len(found):
        return facts, ["no detections"]
    facts["categories"] = dict(Counter(found.category).most_common())
    facts["scores"] = [round(float(v), 4) for v in np.quantile(found.score, [0, 0.5, 1])]
    facts["with_position"] = int(np.isfinite(found.position).all(axis=1).sum())
    if found.mask_centre is not None:
        facts["with_mask"] = int(np.isfinite(found.mask_centre).all(axis=1).sum())
    if np.isfinite(found.box).all():
        facts["box_heights"] = [round(float(v), 1) for v in np.quantile(found.box[:, 3] - found.box[:, 1], [0, 0.5, 1])]
    problems = []
    if (found.score == 1).all():
        problems.append("every score is 1: labels, or scores that were not written")
    return facts, problems


def _detections(name: str, form: DetectionFormat) -> Any:
    def report(path: Path) -> FormatReport:
        size = (640, 480) if form == "yolo" else None  # parts of an image whose size nobody states
        facts, problems = box_facts(read_foreign_detections(path, form, size=size))
        if form == "yolo":
            facts.pop("box_heights", None)
        return FormatReport(name, f"detections ({form})", facts, tuple(problems))

    return report


def _json_with(*words: str, start: str = "") -> Any:
    def looks(look: Look) -> float:
        fits = look.suffix == ".json" and look.text.lstrip().startswith(start) and all(word in look.text for word in words)
        return LIKELY if fits else 0.0

    return looks


def _label_lines(look: Look, fits: Any) -> float:
    """Confidence by the first lines of a label file, or of the first of a folder."""
    if look.is_folder:
        first = next((name for name in sorted(look.names) if name.endswith(".txt")), None)
        only = all(name.endswith(".txt") for name in look.names)
        return _label_lines(Look(look.path / first), fits) if first is not None and only else 0.0
    return LIKELY if look.suffix == ".txt" and look.rows and all(fits(words) for words in look.rows[:5]) else 0.0


def _yolo_line(words: Sequence[str]) -> bool:
    try:
        values = [float(word) for word in words]
    except ValueError:
        return False
    return len(values) in (5, 6) and values[0] == int(values[0]) and min(values[1:]) >= 0 and max(values[1:]) <= 1


def _kitti_line(words: Sequence[str]) -> bool:
    return (len(words) in (15, 16) and words[0][0].isalpha()) or (len(words) in (17, 18) and words[2][0].isalpha())


register("coco-results", "detections, COCO results", _json_with('"image_id"', '"category_id"', start="["))(
    _detections("coco-results", "coco")
)
register("oa-slam", "detections, OA-SLAM", _json_with('"file_name"', '"detections"', start="["))(
    _detections("oa-slam", "oa-slam")
)
register("omni3d", "detections or labels, Omni3D", _json_with('"center_cam"'))(_detections("omni3d", "omni3d"))
register("yolo", "detections, YOLO", lambda look: 0.0 if not look.is_folder else _label_lines(look, _yolo_line))(
    _detections("yolo", "yolo")
)
register("kitti-labels", "detections or labels, KITTI", lambda look: _label_lines(look, _kitti_line))(
    _detections("kitti-labels", "kitti")
)


def _lines_with(*words: str) -> Any:
    def looks(look: Look) -> float:
        first = look.text.split("\n", 1)[0]
        return LIKELY if look.suffix in (".jsonl", ".ndjson") and all(re.search(word, first) for word in words) else 0.0

    return looks


@register("observations", "observations for SLAM", _lines_with('"frame"', '"position"'))
def report_observations(path: Path) -> FormatReport:
    """Detections, frames, categories, what is stated."""
    found = read_observations(path)
    if not len(found):
        return FormatReport("observations", "observations for nolbo slam", {"detections": 0}, ("no detections",))
    facts: dict[str, Any] = {"detections": len(found), "frames": [int(found.frame.min()), int(found.frame.max())]}
    facts["categories"] = dict(Counter(str(name) for name in found.category).most_common())
    stated = {"position_covariance": np.isfinite(found.position_covariance[:, 0, 0]), "rotation": found.has_rotation}
    stated |= {"latent": found.has_latent, "box": found.has_box, "size": np.isfinite(found.size).all(axis=1)}
    facts["stated"] = {name: int(rows.sum()) for name, rows in stated.items()}
    facts["objectness"] = [round(float(v), 4) for v in np.quantile(found.objectness, [0, 0.5, 1])]
    facts["ranges"] = [round(float(v), 2) for v in np.quantile(np.linalg.norm(found.position, axis=1), [0, 0.5, 1])]
    behind = int((found.position[:, 2] <= 0).sum())
    problems = [f"{behind} positions lie behind the camera (z is forward)"] if behind else []
    return FormatReport("observations", "observations for nolbo slam", facts, tuple(problems))


def _box_lines(look: Look) -> float:
    first = look.text.split("\n", 1)[0]
    return LIKELY if look.suffix == ".jsonl" and re.search('"(box|mask)"', first) and '"position"' not in first else 0.0


register("box-lines", "boxes or masks alone, JSON Lines", _box_lines)(_detections("box-lines", "lines"))


def stated_categories(path: Path) -> tuple[str, ...]:
    """Names of the categories in a folder of scenes: the library's where they are these, else those that occur, sorted."""
    found: set[str] = set()
    for _, row in read_jsonl(path if path.name == SCENES else path / SCENES):
        objects, listed = row.get("objects"), row.get("exhaustive")
        names = [thing.get("category") for thing in objects if isinstance(thing, dict)] if isinstance(objects, list) else []
        found |= {name for name in (*names, *(listed if isinstance(listed, list) else ())) if isinstance(name, str)}
    return CATEGORIES if found <= set(CATEGORIES) else tuple(sorted(found))


@register("scenes", "labelled scenes", lambda look: SURE if "scenes.jsonl" in look.names else 0.0)
def report_scenes(path: Path) -> FormatReport:
    """Images, objects, categories, shapes."""
    folder = SceneFolder(path, stated_categories(path))
    names = [name for record in folder.records for name in record.category]
    facts: dict[str, Any] = {"images": len(folder), "objects": len(names), "instances": len(folder.instances)}
    facts["categories"] = dict(Counter(str(name) for name in names).most_common())
    sizes: Counter[tuple[int, int]] = Counter()
    problems = []
    for k in spread(len(folder), LOOKED_AT):
        file = folder.records[k].file
        try:
            assert file is not None  # the folder has found it
            sizes[image_size(file)] += 1
        except InputError as error:
            problems.append(str(error))
    facts["sizes"] = {f"{w} x {h}": count for (w, h), count in sizes.most_common()}

    def pictures() -> Iterator[LabelledPicture]:
        for k in spread(len(folder)):
            record = folder.records[k]
            if record.file is not None:
                labels = tuple(str(name) for name in record.category)
                yield LabelledPicture(record.file.name, open_image(record.file), record.box, labels)

    return FormatReport("scenes", "labelled scenes", facts, tuple(problems), pictures=pictures)


# -- maps, arrays, meshes -----------------------------------------------------------------------------------------------


@register("landmarks", "a map of landmarks", _json_with('"name"', '"position"', start="["))
def report_landmarks(path: Path) -> FormatReport:
    """Landmarks, categories, uncertainty."""
    found = read_landmarks(path)
    facts: dict[str, Any] = {"landmarks": len(found), "in_map": sum(one.in_map for one in found)}
    facts["categories"] = dict(Counter(str(one.category) for one in found).most_common())
    return FormatReport("landmarks", "a map of landmarks", facts)


@register("npz", "arrays (NPZ)", lambda look: SURE if look.suffix == ".npz" and look.head[:2] == b"PK" else 0.0)
def report_npz(path: Path) -> FormatReport:
    """Names and shapes."""
    with Npz(path) as archive:
        arrays = {name: " x ".join(map(str, header.shape)) for name, header in archive.headers.items()}
    return FormatReport("npz", "arrays (NPZ)", {"arrays": arrays})


@register("mesh", "a mesh", lambda look: LIKELY if look.suffix in MESHES and look.path.is_file() else 0.0)
def report_mesh(path: Path) -> FormatReport:
    """Vertices, faces, extent along the canonical axes."""
    vertices, faces = load_mesh(path)
    extent = (vertices.max(axis=0) - vertices.min(axis=0)).round(6).tolist() if len(vertices) else []
    return FormatReport("mesh", "a mesh", {"vertices": len(vertices), "faces": len(faces), "extent": extent})
