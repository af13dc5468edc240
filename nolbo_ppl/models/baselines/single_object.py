"""Objects cut out of images as images of their own: what NOLBO for single objects is trained on and shown.

A crop is what a camera with another focal length and principal point sees from the same place: rotation and position in the
camera's frame stay as they are, boxes and intrinsics change.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nolbo_ppl.models.crops import cut_out, image_levels
from nolbo_ppl.models.scene_batch import SceneBatch

OF_OBJECTS = (
    *("category", "instance", "viewpoint", "has_viewpoint", "symmetry", "position", "has_position", "diagonal", "has_size"),
    *("voxels", "has_voxels", "visibility", "shape_index", "shape_loc", "shape_scale", "noise", "decode_order"),
)
"""Fields of a batch with a row for every object that a crop leaves as they are."""
BOX_SHARE = 0.75
"""Longer side of the object's box over the side of its crop."""


@dataclass(frozen=True)
class ObjectCrops:
    """Objects cut out of images, with the map between the pixels of both."""

    image: Float[Tensor, "n 3 side side"]
    """Colours 0..255."""
    centre: Float[Tensor, "n 2"]
    """Where the crop's middle lies in the image, px."""
    factor: Float[Tensor, " n"]
    """Pixels of the crop over those of the image."""
    side: int
    """Side of the crops, px."""

    def into(self, box: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
        """Boxes of the image as boxes of the crops."""
        return (box - self.centre.repeat(1, 2)) * self.factor[:, None] + self.side / 2

    def back(self, box: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
        """Boxes of the crops as boxes of the image."""
        return (box - self.side / 2) / self.factor[:, None] + self.centre.repeat(1, 2)

    def camera(self, intrinsics: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
        """[fx, fy, cx, cy] of the camera that sees each crop, px."""
        focal = intrinsics[:, :2] * self.factor[:, None]
        return torch.cat((focal, (intrinsics[:, 2:] - self.centre) * self.factor[:, None] + self.side / 2), -1)


def crop_objects(image: Float[Tensor, "b 3 h w"], row: Int[Tensor, " n"], box: Float[Tensor, "n 4"], side: int) -> ObjectCrops:
    """Cut out squares about boxes.

    Args:
        image: colours 0..255.
        row: the image of each box.
        box: [x0, y0, x1, y1], px; its longer side is to have `BOX_SHARE` of the crop's.
        side: of the crops, px, a multiple of 32.
    """
    crops = cut_out(image_levels(image), row, box, side, BOX_SHARE * side)
    return ObjectCrops(crops.image, (box[:, :2] + box[:, 2:]) / 2, crops.factor, side)


def one_object_batch(batch: SceneBatch, side: int, jitter: Float[Tensor, "b 4"] | None = None) -> SceneBatch:
    """One object of every scene, cut out; the labels are those of the crop.

    The object is that of the smallest `decode_order` (a random one), or the one with the largest box where there is no order. A
    scene without an object gives its middle, without one.

    Args:
        batch: whole scenes.
        side: of the crops, px.
        jitter: what the crop's middle (x, y) and its box's log extents are moved by, in extents and nats: no detector is exact.
    """
    extent = batch.box[..., 2:] - batch.box[..., :2]
    order = batch.decode_order if batch.decode_order is not None else -extent.prod(-1)
    slot = torch.where(batch.present, order.to(batch.box.dtype), torch.inf).argmin(1)
    row = torch.arange(len(slot), device=slot.device)

    def chosen(value: Tensor | None) -> Any:
        return None if value is None else value[row, slot][:, None]

    height, width = batch.image.shape[-2:]
    whole = batch.box.new_tensor([0.0, 0.0, width, height])
    present, box = batch.present[row, slot], batch.box[row, slot]
    box = torch.where(present[:, None], box, whole)
    size = box[:, 2:] - box[:, :2]
    middle = (box[:, :2] + box[:, 2:]) / 2
    if jitter is not None:
        middle, size = middle + jitter[:, :2] * size, size * jitter[:, 2:].exp()
    crops = crop_objects(batch.image.to(box.dtype), row, torch.cat((middle - size / 2, middle + size / 2), -1), side)
    return batch.replace(
        image=crops.image,
        intrinsics=crops.camera(batch.intrinsics),
        present=present[:, None],
        box=crops.into(box)[:, None],
        ignore=None,
        exhaustive=None,
        **{name: chosen(getattr(batch, name)) for name in OF_OBJECTS},
    )
