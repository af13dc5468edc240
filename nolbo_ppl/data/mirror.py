"""The mirror image of a scene, with its labels: a picture of the mirrored objects.

Turning an image over alone would make azimuths wrong. Here everything is reflected: left and right of the camera
(x of the camera frame) and of each object (x of the object frame), so that boxes, viewpoints, positions and voxels are those of a
scene that could have been rendered as well. A reflected object is another instance of its category.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from nolbo_ppl.errors import input_error
from nolbo_ppl.models.scene_batch import SceneBatch


def mirror_voxels(packed: UInt8[Tensor, "*n bytes"]) -> UInt8[Tensor, "*n bytes"]:
    """Packed grids reflected along their first axis, the object's x.

    Raises:
        InputError: the bytes are not those of a grid whose layers fill whole bytes (4^3, 8^3, 32^3, ...).
    """
    size = round((8 * packed.shape[-1]) ** (1 / 3))
    if size**3 != 8 * packed.shape[-1] or size * size % 8:
        raise input_error("packed voxels to mirror", got=f"{packed.shape[-1]} bytes", expected="n^3 / 8, n a multiple of 4")
    return packed.unflatten(-1, (size, size * size // 8)).flip(-2).flatten(-2)


def mirror(batch: SceneBatch, chosen: Bool[Tensor, " b"]) -> SceneBatch:
    """The batch with the chosen scenes mirrored. Their instance labels are -1: mirrored instances have none.

    Latents of the shape autoencoder are left as they are: they must be those of the mirrored voxels
    (`nolbo_ppl.training.scene_loader.ShapeTable.add_shape_targets`).
    """
    width = batch.image.shape[-1]
    fx, fy, cx, cy = batch.intrinsics.unbind(-1)
    x0, y0, x1, y1 = batch.box.unbind(-1)
    azimuth, elevation, in_plane = batch.viewpoint.unbind(-1)
    across = torch.tensor([-1.0, 1.0, 1.0], dtype=batch.position.dtype)

    def where(mirrored: Tensor, plain: Tensor) -> Tensor:
        return torch.where(chosen.view(-1, *(1,) * (plain.dim() - 1)), mirrored, plain)

    ignore = batch.ignore
    if ignore is not None:
        left, top, right, bottom = ignore.unbind(-1)
        ignore = where(torch.stack((width - right, top, width - left, bottom), -1), ignore)
    return batch.replace(
        ignore=ignore,
        image=where(batch.image.flip(-1), batch.image),
        intrinsics=where(torch.stack((fx, fy, width - cx, cy), -1), batch.intrinsics),
        box=where(torch.stack((width - x1, y0, width - x0, y1), -1), batch.box),
        viewpoint=where(torch.stack((-azimuth, elevation, -in_plane), -1), batch.viewpoint),
        position=where(batch.position * across, batch.position),
        voxels=where(mirror_voxels(batch.voxels), batch.voxels),
        instance=where(torch.full_like(batch.instance, -1), batch.instance),
    )
