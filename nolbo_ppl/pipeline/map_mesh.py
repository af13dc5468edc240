"""The map as one GLB file: decoded shapes of the landmarks at their places, metric, coloured by category, and the path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.voxels import voxels_to_mesh
from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.structures.landmark import Landmark
from nolbo_ppl.viz.style import category_colour

if TYPE_CHECKING:
    from trimesh import Scene

PATH_COLOUR = "#2f6fde"
"""The camera's path."""
T_GLTF_WORLD = np.diag([1.0, -1.0, -1.0, 1.0])
"""glTF has y up; the world of a run has x right, y down, z forward."""


def landmark_mesh(
    landmark: Landmark, occupancy: Float[np.ndarray, "n n n"], level: float = 0.5
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Surface of a landmark in the world, m: marching cubes on its voxels, scaled by its diagonal, at its pose.

    A shape of which no voxel reaches `level` is cut at half its highest probability instead.
    """
    top = float(np.max(occupancy))
    vertices, faces = voxels_to_mesh(occupancy, level if top > level else max(top / 2, 1e-6))
    T, diagonal = landmark.T_world_object, landmark.diagonal or 1.0
    return (diagonal * vertices) @ T[:3, :3].T + T[:3, 3], faces


def _colour(hexadecimal: str, alpha: float = 1.0) -> list[int]:
    return [int(hexadecimal[i : i + 2], 16) for i in (1, 3, 5)] + [round(255 * alpha)]


def build_scene(
    landmarks: Sequence[Landmark],
    voxels: Mapping[str, Float[np.ndarray, "n n n"]],
    T_world_camera: Float[np.ndarray, "k 4 4"],
) -> Scene:
    """Landmarks that have voxels, as nodes of their names, and the camera's path, under a root that turns y up.

    Args:
        landmarks: the map; those that are more likely background, or left without detections, are not shown.
        voxels: mean occupancy by name of the landmark.
        T_world_camera: corrected poses.
    """
    import trimesh  # delayed: heavy to import
    from trimesh.visual.material import PBRMaterial

    scene = trimesh.Scene()
    scene.graph.update(frame_from=scene.graph.base_frame, frame_to="run", matrix=T_GLTF_WORLD)
    categories = sorted({landmark.category for landmark in landmarks if landmark.category})
    materials: dict[str, PBRMaterial] = {}
    for landmark in landmarks:
        if landmark.name not in voxels or not landmark.in_map:
            continue
        vertices, faces = landmark_mesh(landmark, np.asarray(voxels[landmark.name], dtype=np.float64))
        if not len(faces):
            continue
        category = landmark.category or "object"
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
        scene.add_geometry(mesh, node_name=landmark.name, geom_name=landmark.name, parent_node_name="run")
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
