"""The map as one GLB file: decoded shapes of the landmarks at their places, metric, coloured by category, and the path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.data.simulate import R_WORLD_UPRIGHT
from nolbo_ppl.geometry.pose import make_pose, quaternion_to_matrix
from nolbo_ppl.geometry.voxels import voxels_to_mesh
from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.viz.style import category_colour

if TYPE_CHECKING:
    from trimesh import Scene

LEAST_EXISTENCE = 0.5
"""Landmarks that are more likely background are left out."""
LEAST_DETECTIONS = 0.5
"""So are those that in the end no detection is put on."""
PATH_COLOUR = "#2f6fde"
"""The camera's path."""
T_GLTF_WORLD = np.diag([1.0, -1.0, -1.0, 1.0])
"""glTF has y up; the world of a run has x right, y down, z forward."""


def stands(row: Mapping[str, Any]) -> bool:
    """Whether a row of `landmarks.json` is part of the map: more likely an object than not, and with detections."""
    return row["existence"] >= LEAST_EXISTENCE and row.get("detections", 1.0) >= LEAST_DETECTIONS


def landmark_pose(row: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    """T_world_object of a row of `landmarks.json`; upright where no orientation was observed."""
    rotation = row.get("rotation")
    R = R_WORLD_UPRIGHT if rotation is None else quaternion_to_matrix(np.array(rotation, dtype=np.float64))
    return make_pose(R, np.array(row["position"], dtype=np.float64))


def landmark_mesh(
    row: Mapping[str, Any], occupancy: Float[np.ndarray, "n n n"], level: float = 0.5
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Surface of a landmark in the world, m: marching cubes on its voxels, scaled by its diagonal, at its pose.

    A shape of which no voxel reaches `level` is cut at half its highest probability instead.
    """
    top = float(np.max(occupancy))
    vertices, faces = voxels_to_mesh(occupancy, level if top > level else max(top / 2, 1e-6))
    T = landmark_pose(row)
    diagonal = float(np.linalg.norm(row["size"])) if row.get("size") is not None else 1.0
    return (diagonal * vertices) @ T[:3, :3].T + T[:3, 3], faces


def _colour(hexadecimal: str, alpha: float = 1.0) -> list[int]:
    return [int(hexadecimal[i : i + 2], 16) for i in (1, 3, 5)] + [round(255 * alpha)]


def build_scene(
    landmarks: Sequence[Mapping[str, Any]],
    voxels: Mapping[str, Float[np.ndarray, "n n n"]],
    T_world_camera: Float[np.ndarray, "k 4 4"],
) -> Scene:
    """Landmarks that have voxels, as nodes of their names, and the camera's path, under a root that turns y up.

    Args:
        landmarks: rows of `landmarks.json`.
        voxels: mean occupancy by name of the landmark.
        T_world_camera: corrected poses.
    """
    import trimesh  # delayed: heavy to import
    from trimesh.visual.material import PBRMaterial

    scene = trimesh.Scene()
    scene.graph.update(frame_from=scene.graph.base_frame, frame_to="run", matrix=T_GLTF_WORLD)
    categories = sorted({str(row["category"]) for row in landmarks if row.get("category")})
    materials: dict[str, PBRMaterial] = {}
    for row in landmarks:
        if row["name"] not in voxels or not stands(row):
            continue
        vertices, faces = landmark_mesh(row, np.asarray(voxels[row["name"]], dtype=np.float64))
        if not len(faces):
            continue
        category = str(row.get("category") or "object")
        material = materials.setdefault(
            category,
            PBRMaterial(
                name=category,
                baseColorFactor=_colour(category_colour(category, categories)),
                metallicFactor=0.0,
                roughnessFactor=0.8,
                doubleSided=True,
            ),
        )
        mesh = trimesh.Trimesh(vertices, faces, process=False, visual=trimesh.visual.TextureVisuals(material=material))
        scene.add_geometry(mesh, node_name=row["name"], geom_name=row["name"], parent_node_name="run")
    path = T_world_camera[:, :3, 3]
    if len(path) > 1:
        way = trimesh.load_path(path)
        way.colors = np.tile(_colour(PATH_COLOUR), (len(way.entities), 1))
    else:
        way = trimesh.PointCloud(path, colors=_colour(PATH_COLOUR))
    scene.add_geometry(way, node_name="trajectory", geom_name="trajectory", parent_node_name="run")
    return scene


def write_glb(path: str | PathLike[str], scene: Scene) -> None:
    """Write a scene as binary glTF, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(scene.export(file_type="glb"))
