"""Files of other people and of other verbs, for `fuzz.py`: detections, labels, meshes, videos, bags, drives, saved systems."""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_surfaces import Surface

OBJ = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 1\nvt 0.5 0.5\nf 1 2 3\nf 1/1 3/1 4/1\nf -4 -3 -1\nf 2 3 4\n"
OFF = b"OFF\n4 4 6\n0 0 0\n1 0 0\n1 1 0\n0 1 1\n3 0 1 2\n3 0 2 3\n3 0 1 3\n3 1 2 3\n"
KITTI_LABEL = b"""Car 0.00 0 1.85 10.0 12.0 40.0 36.0 1.5 1.6 3.9 1.0 1.5 9.0 1.7
Van 0.1 1 -1.2 5 6 30 40 2.0 1.9 4.9 -3 1.6 12 -1.2 0.8
"""
KITTI_CAMERA = b"P0: 700 0 600 0 0 700 170 0 0 0 1 0\nP2: 700 0 600 45 0 700 170 0.2 0 0 1 0.003\n"
KALIBR = b"""cam0:
  camera_model: pinhole
  intrinsics: [50.0, 51.0, 32.0, 24.0]
  distortion_model: radtan
  distortion_coeffs: [-0.01, 0.002, 0.0001, 0.0002]
  resolution: [64, 48]
"""
OPENCV = b"""%YAML:1.0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [50., 0., 32., 0., 51., 24., 0., 0., 1.]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [-0.01, 0.002, 0.0001, 0.0002, 0.]
image_width: 64
image_height: 48
"""
VOC = b"""<annotation><filename>a.png</filename><size><width>64</width><height>48</height><depth>3</depth></size>
<object><name>car</name><difficult>0</difficult><bndbox><xmin>4</xmin><ymin>5</ymin><xmax>30</xmax><ymax>40</ymax></bndbox></object>
<object><name>chair</name><bndbox><xmin>1</xmin><ymin>1</ymin><xmax>9</xmax><ymax>9</ymax></bndbox></object></annotation>
"""
COLMAP = b"# images\n1 1 0 0 0 0.5 0 2 1 a.png\n10 12 3 20 22 -1\n2 0.7071068 0 0.7071068 0 0.1 0 1 1 b.png\n\n"
CATALOGUE = b"name#1=Office chair\nmodel#1=/chair/chair.obj\nwidth#1=60\ndepth#1=60\nheight#1=90\ncreator#1=A\nlicense#1=CC0\n"


def written(write: Callable[[Path], Any], name: str = "file") -> bytes:
    """Content of the file that a function writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


def as_json(value: Any) -> bytes:
    """A JSON document."""
    return json.dumps(value).encode()


def detection_surfaces() -> list[Surface]:
    """Boxes and labels of other systems."""
    from nolbo_ppl.data.converters.foreign_detections import read_foreign_detections
    from nolbo_ppl.data.converters.kitti_object import read_calibration
    from nolbo_ppl.data.converters.placed_boxes import read_heights
    from nolbo_ppl.data.converters.voc import read_voc_annotation
    from nolbo_ppl.io.camera_files import read_camera
    from nolbo_ppl.io.coco_file import read_coco_images
    from nolbo_ppl.io.true_objects import read_true_objects

    mask = {"size": [48, 64], "counts": [100, 8, 40, 8, 2916]}
    coco = [{"image_id": 1, "category_id": 3, "bbox": [4.0, 5.0, 20.0, 16.0], "score": 0.9, "segmentation": mask}]
    coco.append({"image_id": 2, "category_id": 62, "bbox": [1, 2, 10, 10], "score": 0.5, "segmentation": [[1, 2, 11, 2, 11, 12]]})
    images = [{"id": k, "file_name": f"{k}.png", "width": 64, "height": 48} for k in (1, 2)]
    instances = {"images": images, "categories": [{"id": 3, "name": "car"}]}
    instances["annotations"] = [{"id": 1, "image_id": 1, "category_id": 3, "bbox": [4, 5, 20, 16], "iscrowd": 0}]
    solid = {"image_id": 1, "category_id": 3, "bbox2D_proj": [4, 5, 24, 21], "dimensions": [1.6, 1.5, 3.9], "score": 0.9}
    solid |= {"center_cam": [1.0, 0.2, 9.0], "R_cam": np.eye(3).tolist()}
    omni = {"images": images, "categories": [{"id": 3, "name": "car"}], "annotations": [solid]}
    oa = [{"file_name": "1.png", "detections": [{"category_id": 2, "detection_score": 0.9, "bbox": [4, 5, 24, 21]}]}]
    line = {"frame": 0, "box": [4, 5, 24, 21], "category": "car", "score": 0.9}
    truth = {"objects": {"a": "car-1", "b": None}, "T_world_object": {"car-1": np.eye(4).tolist()}}
    truth |= {"categories": {"car-1": "car"}, "latents": {"car-1": [0.1, 0.2]}}

    def boxes(form: Any, **options: Any) -> Callable[[Path], Any]:
        return lambda path: read_foreign_detections(path, form, **options)

    return [
        Surface("coco-results.json", as_json(coco), boxes("coco"), missing=True),
        Surface("omni3d.json", as_json(omni), boxes("omni3d"), missing=True),
        Surface("oa-slam.json", as_json(oa), boxes("oa-slam"), missing=True),
        Surface("boxes.jsonl", as_json(line) + b"\n" + as_json({**line, "frame": 1}) + b"\n", boxes("lines"), missing=True),
        Surface("labels/000001.txt", KITTI_LABEL, boxes("kitti"), missing=True),
        Surface(
            "yolo/1.txt",
            b"2 0.5 0.5 0.2 0.3 0.9\n0 0.1 0.2 0.05 0.1\n",
            lambda p: read_foreign_detections(p.parent, "yolo", size=(64, 48)),
            missing=True,
        ),
        Surface("instances.json", as_json(instances), lambda p: read_coco_images(p, p.parent)),
        Surface("annotation.xml", VOC, lambda p: read_voc_annotation(p, None)),
        Surface("calib.txt", KITTI_CAMERA, read_calibration),
        Surface("heights.json", as_json({"car": [1.5, 0.1], "chair": [0.9, 0.2]}), read_heights),
        Surface("true-objects.json", as_json(truth), lambda p: read_true_objects(p, ["a", "b", "c"]), missing=True),
        Surface("kalibr.yaml", KALIBR, read_camera),
        Surface("opencv.yaml", OPENCV, read_camera),
    ]


def pose_surfaces() -> list[Surface]:
    """Poses that are no tables, lists of images, and the noise of a run."""
    from nolbo_ppl.data.sequences.image_sequence import read_listing
    from nolbo_ppl.io.noise_file import read_noise, write_noise
    from nolbo_ppl.io.trajectories import read_trajectory
    from nolbo_ppl.structures.noise_model import NoiseModel

    ego = [{"token": "t", "timestamp": 10**6 * k, "rotation": [1, 0, 0, 0], "translation": [k, 0, 0]} for k in range(4)]
    step = np.full(3, 0.01)
    noise = NoiseModel(
        rotation_step=step,
        translation_step=step,
        position_covariance=np.tile(0.01 * np.eye(3), (4, 1, 1)),
        rotation_scale=np.full(4, 0.1),
        latent_scale=np.full((4, 2), 0.7),
        birth_intensity=1e-4,
        clutter_intensity=1e-4,
        report={},
        warnings=(),
    )
    names = (("a.png", b"x"), ("b.png", b"x"))
    return [
        Surface("images.txt", COLMAP, read_trajectory),
        Surface("ego_pose.json", as_json(ego), read_trajectory),
        Surface("rgb.txt", b"# time file\n1.0 a.png\n1.1 b.png\n", read_listing, names),
        Surface("noise.npz", written(lambda p: write_noise(p, noise), "noise.npz"), read_noise),
    ]


def shape_surfaces() -> list[Surface]:
    """Meshes and furniture libraries."""
    import trimesh

    from nolbo_ppl.synthetic.assets.cad import load_mesh
    from nolbo_ppl.synthetic.assets.sh3f_file import load_sh3f

    box = trimesh.creation.box((1.0, 2.0, 3.0))
    library = io.BytesIO()
    with zipfile.ZipFile(library, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("PluginFurnitureCatalog.properties", CATALOGUE)
        archive.writestr("chair/chair.obj", box.export(file_type="obj"))

    def mesh(path: Path) -> Any:
        return load_mesh(path)

    return [
        Surface("a.obj", OBJ, mesh),
        Surface("a.off", OFF, mesh),
        Surface("a.ply", box.export(file_type="ply"), mesh),
        Surface("a.stl", box.export(file_type="stl"), mesh),
        Surface("a.glb", box.export(file_type="glb"), mesh),
        Surface("a.sh3f", library.getvalue(), lambda p: load_sh3f(p, max_faces=None)),
    ]


def stream_surfaces() -> list[Surface]:
    """Videos and bags."""
    import cv2

    from nolbo_ppl.data.sequences.video import VideoFile
    from nolbo_ppl.io.trajectories import read_trajectory

    rng = np.random.default_rng(1)

    def video(path: Path) -> None:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))  # type: ignore[attr-defined]
        for _ in range(3):
            writer.write(rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
        writer.release()

    def frames(path: Path) -> Any:
        found = VideoFile(path)
        return [found.frame(k) for k in range(min(len(found), 5))], found.times

    def poses(path: Path, first: bool) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
        folder = path.with_name("recording")
        writer: Any = Writer1(path) if first else Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.open()
        name, types = "geometry_msgs/msg/PoseStamped", store.types
        connection = writer.add_connection("/pose", name, typestore=store)
        for k in range(4):
            stamp = types["builtin_interfaces/msg/Time"](sec=k, nanosec=0)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="map", **({"seq": k} if first else {}))
            position = types["geometry_msgs/msg/Point"](x=float(k), y=0.0, z=0.0)
            turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
            message = types[name](header=header, pose=types["geometry_msgs/msg/Pose"](position=position, orientation=turn))
            data = store.serialize_ros1(message, name) if first else store.serialize_cdr(message, name)
            writer.write(connection, k * 10**9, data)
        writer.close()
        if not first:
            next(folder.glob("*.mcap")).rename(path)

    def topic(path: Path) -> Any:
        return read_trajectory(Path(f"{path}:/pose"))

    found = [Surface("a.avi", written(video, "a.avi"), frames)]
    if find_spec("rosbags") is None:  # the extra `ros`
        return found
    return [
        *found,
        Surface("a.bag", written(lambda p: poses(p, True), "a.bag"), topic),
        Surface("a.mcap", written(lambda p: poses(p, False), "a.mcap"), topic),
    ]


def drive_surfaces(png: bytes) -> list[Surface]:
    """The files of a drive folder, each changed beside good ones."""
    from nolbo_ppl.synthetic.worlds.sequence_reader import read_sequence_folder

    thing = {"id": "a", "category": "car", "instance": "car-1", "symmetry": 1, "T_world_object": np.eye(4).tolist()}
    thing |= {"diagonal": 4.0, "dimensions": [1.0, 2.0, 3.0], "moving": False}
    seen = {
        "id": "a",
        "box": [4, 4, 30, 30],
        "category": "car",
        "rotation": [0, 0, 0, 1],
        "position": [0.1, 0.0, 3.0],
        "size": 1.0,
    }
    scenes = [{"image": f"images/{k}.png", "intrinsics": [50, 50, 32, 24], "objects": [seen]} for k in range(3)]
    camera = {"fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48}
    files = {
        "scenes.jsonl": b"".join(as_json(row) + b"\n" for row in scenes),
        "objects.json": as_json([thing]),
        "intrinsics.json": as_json(camera),
        "truth.txt": b"".join(b"1 0 0 %d 0 1 0 0 0 0 1 0\n" % k for k in range(3)),
        "times.txt": b"0.0\n0.1\n0.2\n",
        "drive.json": as_json({"complete": True, "frames": 3, "seed": 1}),
    }
    pictures = tuple((f"drive/images/{k}.png", png) for k in range(3))

    def read(path: Path) -> Any:
        found = read_sequence_folder(path.parent)
        return found.intrinsics, found.T_world_camera, found.times, found.objects, found.frames

    return [
        Surface(
            f"drive/{name}", files[name], read, (*pictures, *((f"drive/{o}", files[o]) for o in files if o != name)), missing=True
        )
        for name in files
    ]


def system_surfaces() -> list[Surface]:
    """A saved online system."""
    from nolbo_ppl.inference.slam import IncrementalSlam
    from nolbo_ppl.structures.detections import Detections

    slam, rng = IncrementalSlam(), np.random.default_rng(2)
    objects = np.array([[0.0, 0.5, 6.0], [2.0, 0.5, 7.0], [-2.0, 0.5, 8.0]])
    for k in range(6):
        T = np.eye(4)
        T[2, 3] = 0.2 * k
        seen = objects - T[:3, 3] + 0.02 * rng.standard_normal((3, 3))
        table = Detections.from_arrays(
            np.zeros(3, int), seen, position_scale=0.05, objectness=np.full(3, 0.9), category=["car"] * 3
        )
        slam.update(T, table)

    def read(path: Path) -> Any:
        again = IncrementalSlam.load(path)
        return again.trajectory(), again.landmarks()

    return [Surface("online.npz", written(slam.save, "online.npz"), read, missing=True)]


def foreign_surfaces(png: bytes) -> list[Surface]:
    """All of them."""
    return [
        *detection_surfaces(),
        *pose_surfaces(),
        *shape_surfaces(),
        *stream_surfaces(),
        *drive_surfaces(png),
        *system_surfaces(),
    ]
