"""Objects of a map in 3D: decoded shapes at their poses, ellipsoids of their positions, names."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import matrix_to_quaternion
from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.report.report_plots import colour_of
from nolbo_ppl.report.shape_thumbnails import shape_surface
from nolbo_ppl.structures.landmark import Landmark

if TYPE_CHECKING:
    from viser import ViserServer

Rgb = tuple[int, int, int]
CHI2_95 = 7.814727903251179
"""95 % quantile of chi square with three degrees of freedom: the square radius of an ellipsoid."""
NO_SIZE = 1.0
"""Diagonal of an object whose size is not known, m."""


def rgb(colour: str) -> Rgb:
    """`#rrggbb` as three numbers."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def ellipsoid(covariance: Float[np.ndarray, "3 3"]) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Half axes, m, and the rotation whose columns they lie along, of the region of 95 % of a normal density."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    if np.linalg.det(vectors) < 0:
        vectors[:, 0] = -vectors[:, 0]
    return np.sqrt(CHI2_95 * np.maximum(values, 1e-12)), vectors


def add_shape(server: ViserServer, name: str, run: RunFolder, landmark: Landmark) -> Any:
    """The decoded surface in metres; a box of its size where nothing was decoded, a small ball without a size."""
    quaternion, colour = matrix_to_quaternion(landmark.T_world_object[:3, :3])[[3, 0, 1, 2]], rgb(colour_of(run, landmark))
    voxels = run.voxels(landmark.name)
    if voxels is not None:
        vertices, faces = shape_surface(voxels[0])
        if len(faces):
            metres = vertices * (landmark.diagonal or NO_SIZE)
            return server.scene.add_mesh_simple(
                name,
                metres.astype(np.float32),
                faces.astype(np.uint32),
                color=colour,
                flat_shading=False,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
                wxyz=quaternion,
                position=landmark.position,
            )
    if landmark.size is not None:
        size: Any = tuple(landmark.size.tolist())
        return server.scene.add_box(
            name, colour, size, opacity=0.6, cast_shadow=False, receive_shadow=False, wxyz=quaternion, position=landmark.position
        )
    return server.scene.add_icosphere(
        name, 0.15 * NO_SIZE, colour, subdivisions=2, cast_shadow=False, receive_shadow=False, position=landmark.position
    )


def label_of(landmark: Landmark) -> str:
    """Name, category, existence."""
    words = [landmark.name, *([landmark.category] if landmark.category else [])]
    return " ".join(words) + (f" ({landmark.existence:.2f})" if np.isfinite(landmark.existence) else "")


def add_objects(add: Callable[[str, str, Any], Any], run: RunFolder, server: ViserServer) -> None:
    """Every landmark; without decoded voxels the run's `map.glb` stands for the shapes, where there is one.

    Nodes are numbered: names are any text, and a slash in one would nest nodes.

    Args:
        add: remembers a node by layer and name.
        run: the run.
        server: the server.
    """
    whole = run.mesh
    from_file = whole.is_file() and not run.voxel_names
    if from_file:
        turn = (0.0, 1.0, 0.0, 0.0)  # glTF has y up: half a turn about x gives the world of the run
        add("objects", "/objects/map", server.scene.add_glb("/objects/map", whole.read_bytes(), wxyz=turn))
    for k, landmark in enumerate(run.landmarks):
        if not from_file:
            add("objects", f"/objects/{k}", add_shape(server, f"/objects/{k}", run, landmark))
        if np.isfinite(landmark.position_covariance).all():
            radii, R = ellipsoid(landmark.position_covariance)
            handle = server.scene.add_icosphere(
                f"/ellipsoids/{k}",
                1.0,
                rgb(colour_of(run, landmark)),
                subdivisions=3,
                scale=tuple(radii.tolist()),
                opacity=0.22,
                wxyz=matrix_to_quaternion(R)[[3, 0, 1, 2]],
                position=landmark.position,
                cast_shadow=False,
                receive_shadow=False,
            )
            add("ellipsoids", f"/ellipsoids/{k}", handle)
        add("labels", f"/labels/{k}", server.scene.add_label(f"/labels/{k}", label_of(landmark), position=landmark.position))
