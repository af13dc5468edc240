"""What the model is told of a batch of scenes: images, and padded slots of labelled, partly labelled or no objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.camera import pixel_ray, project
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.structures.label_arrays import allocentric_viewpoints, assemble, empty_labels, fill_annotations, fill_regions

VOXEL_BYTES = 32**3 // 8
"""Bytes of a packed grid of 32^3 voxels."""


@dataclass
class SceneBatch:
    """B scenes with M padded object slots each; labels that are missing are masked or enumerated, never guessed.

    Example:
        >>> import nolbo_ppl, torch
        >>> none, some = torch.zeros(2, 1, dtype=torch.bool), torch.ones(2, 1, dtype=torch.bool)
        >>> scenes = nolbo_ppl.SceneBatch(  # two images with a box each; nothing else is known
        ...     image=torch.zeros(2, 3, 64, 64, dtype=torch.uint8), intrinsics=torch.tensor([[60.0, 60, 32, 32]]).repeat(2, 1),
        ...     present=some, box=torch.tensor([[[10.0, 10.0, 40.0, 50.0]]]).repeat(2, 1, 1), category=torch.full((2, 1), -1),
        ...     instance=torch.full((2, 1), -1), viewpoint=torch.zeros(2, 1, 3), has_viewpoint=none,
        ...     symmetry=torch.ones(2, 1, dtype=torch.int64), position=torch.zeros(2, 1, 3), has_position=none,
        ...     diagonal=torch.ones(2, 1), has_size=none, visibility=torch.ones(2, 1),
        ...     voxels=torch.zeros(2, 1, 32**3 // 8, dtype=torch.uint8), has_voxels=none,
        ... )
        >>> scenes[:1].image.shape
        torch.Size([1, 3, 64, 64])
    """

    image: UInt8[Tensor, "b 3 h w"]
    """Colours 0..255."""
    intrinsics: Float[Tensor, "b 4"]
    """[fx, fy, cx, cy] in px of this image."""
    present: Bool[Tensor, "b m"]
    """The slot holds an object."""
    box: Float[Tensor, "b m 4"]
    """[x0, y0, x1, y1] in px."""
    category: Int[Tensor, "b m"]
    """Category label, -1 where it is missing."""
    instance: Int[Tensor, "b m"]
    """Instance label, -1 where it is missing."""
    viewpoint: Float[Tensor, "b m 3"]
    """Allocentric (azimuth, elevation, in-plane) in rad."""
    has_viewpoint: Bool[Tensor, "b m"]
    """The viewpoint is known."""
    symmetry: Int[Tensor, "b m"]
    """Order of the object's symmetry about its vertical axis: 1 none, n n-fold, 0 free."""
    position: Float[Tensor, "b m 3"]
    """Box centre in the camera frame, m."""
    has_position: Bool[Tensor, "b m"]
    """The position is known."""
    diagonal: Float[Tensor, "b m"]
    """Diagonal of the object's box, m."""
    has_size: Bool[Tensor, "b m"]
    """The diagonal is known."""
    voxels: UInt8[Tensor, "b m bytes"]
    """Canonical voxels, packed bits in C order."""
    has_voxels: Bool[Tensor, "b m"]
    """The voxels are known."""
    visibility: Float[Tensor, "b m"]
    """Visible share of the object, 0 to 1."""
    shape_index: Int[Tensor, "b m"] | None = None
    """Row of the object's shape in the data set's table of shapes, -1 for none."""
    shape_loc: Float[Tensor, "b m d"] | None = None
    """Mean of the shape autoencoder's posterior of the true voxels."""
    shape_scale: Float[Tensor, "b m d"] | None = None
    """Scale of that posterior."""
    ignore: Float[Tensor, "b r 4"] | None = None
    """Boxes, px, of parts of the images whose objects are not labelled; empty boxes are none."""
    exhaustive: Bool[Tensor, "b labels"] | None = None
    """Categories of which every instance in the image is labelled; all of them when it is not given."""
    noise: Float[Tensor, "b m d"] | None = None
    """Standard normal noise of the shape latent's sample; drawn from torch's generator when it is not given."""
    decode_order: Float[Tensor, "b m"] | None = None
    """Random numbers: where only some objects are decoded, those of the smallest are; drawn from torch's generator when they
    are not given."""

    @classmethod
    def from_annotations(
        cls,
        scenes: Sequence[Annotations],
        categories: Sequence[str] = CATEGORIES,
        *,
        slots: int | None = None,
        instances: Mapping[str, int] | None = None,
    ) -> SceneBatch:
        """The network's batch of labelled images of one size.

        Args:
            scenes: the images with their labels.
            categories: names of the category labels (`model.config.categories`); other names are unlabelled.
            slots: object slots an image; as many as are needed by default.
            instances: label of a shape by its name; unlabelled by default.

        Raises:
            InputError: no image, images of several sizes, voxels in some of them alone, or more objects than slots.

        Example:
            >>> import numpy as np, nolbo_ppl
            >>> seen = nolbo_ppl.Annotations.from_arrays(
            ...     [60, 60, 32, 32], [[10, 10, 40, 50]], category=["car"], pixels=np.zeros((64, 64, 3), np.uint8))
            >>> nolbo_ppl.SceneBatch.from_annotations([seen], ("bus", "car")).category
            tensor([[1]])
        """
        shapes = {scene.image.shape for scene in scenes}
        voxel_bytes = {scene.voxels.shape[1] for scene in scenes if scene.voxels is not None and len(scene)}
        if len(shapes) != 1 or len(voxel_bytes) > 1:
            do = "bring them to one size (nolbo_ppl.data.dataset_folder.letterbox)"
            raise input_error("images of one batch", got=(sorted(shapes), sorted(voxel_bytes)), expected="one size", do=do)
        labels = empty_labels(len(scenes), max([slots or 1, *([] if slots else map(len, scenes))]))
        voxels = np.zeros((*labels["present"].shape, max(voxel_bytes, default=VOXEL_BYTES)), dtype=np.uint8)
        for row, scene in enumerate(scenes):
            numbers = [(instances or {}).get(name or "", -1) for name in scene.instance]
            fill_annotations(labels, row, scene, categories, numbers)
            if scene.voxels is not None and len(scene):
                voxels[row, : len(scene)] = scene.voxels
        labels["viewpoint"] = allocentric_viewpoints(labels)
        fill_regions(labels, scenes, categories, [(1.0, 0.0, 0.0)] * len(scenes))
        images = np.stack([scene.image.transpose(2, 0, 1) for scene in scenes])
        arrays = assemble(images, labels, voxels, np.asarray(voxels.any(axis=-1)))
        return cls(**{name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()})

    def replace(self, **changes: Any) -> SceneBatch:
        """A copy with other fields."""
        return dataclasses.replace(self, **changes)

    @property
    def device(self) -> torch.device:
        """Where it lies (`nolbo_ppl.devices.placed` puts it elsewhere)."""
        return self.image.device

    def to(self, dtype: torch.dtype) -> SceneBatch:
        """A copy with floating-point fields of another precision."""
        fields: dict[str, Any] = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return SceneBatch(**{k: v.to(dtype) if v is not None and v.is_floating_point() else v for k, v in fields.items()})

    def neutral(self) -> SceneBatch:
        """A copy whose masked values are harmless: a NaN or a zero range under a mask would still reach the gradients."""

        def where(mask: Tensor, value: Tensor, other: float) -> Tensor:
            return torch.where(mask.view(*mask.shape, *(1,) * (value.dim() - mask.dim())), value, other)

        shapes = {}
        if self.shape_loc is not None and self.shape_scale is not None:
            shapes["shape_loc"] = where(self.has_voxels, self.shape_loc, 0.0)
            shapes["shape_scale"] = where(self.has_voxels, self.shape_scale, 1.0)
        return self.replace(
            box=where(self.present, self.box, 0.0),
            viewpoint=where(self.has_viewpoint, self.viewpoint, 0.0),
            position=where(self.has_position, self.position, 1.0),
            diagonal=where(self.has_size, self.diagonal, 1.0),
            **shapes,
        )

    def __getitem__(self, index: slice | Tensor) -> SceneBatch:
        """Some of the scenes."""
        fields: dict[str, Any] = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        fields = {k: None if v is None else v[index] for k, v in fields.items()}
        return SceneBatch(**fields)


@dataclass
class Assignment:
    """Which region is responsible for each object, and what the story observes there, in latent units."""

    cell: Int[Tensor, "b m"]
    """Cell of the object's box centre, row by row."""
    predictor: Int[Tensor, "b m"]
    """Predictor of that cell that is responsible."""
    assigned: Bool[Tensor, "b m"]
    """The object has a region (false for padding, and for objects of a cell with more objects than predictors)."""
    is_object: Bool[Tensor, "b k"]
    """The region is responsible for an object."""
    box_target: Float[Tensor, "b m 4"]
    """Observed box in latent units."""
    range_target: Float[Tensor, "b m 4"]
    """Observed range, direction and size in latent units."""
    has_range: Bool[Tensor, "b m"]
    """The range is observed: position and size are both known."""
    counted: Bool[Tensor, "b k"] | None = None
    """Regions of which it is known whether they describe an object; all of them when it is not given."""


def grid_size(height: int, width: int, config: ModelConfig) -> tuple[int, int]:
    """Rows and columns of cells of an image."""
    return height // config.stride, width // config.stride


def cell_of(box: Float[Tensor, "*n 4"], rows: int, columns: int, stride: int) -> Int[Tensor, "*n"]:
    """Index, row by row, of the cell that holds each box's centre."""
    centre = (box[..., :2] + box[..., 2:]) / 2
    column = (centre[..., 0] / stride).floor().long().clamp(0, columns - 1)
    row = (centre[..., 1] / stride).floor().long().clamp(0, rows - 1)
    return row * columns + column


def cell_centre(cell: Int[Tensor, "*n"], columns: int, stride: int, dtype: torch.dtype) -> Float[Tensor, "*n 2"]:
    """Pixel coordinates (x, y) of the centre of each cell."""
    return (torch.stack((cell % columns, cell // columns), -1).to(dtype) + 0.5) * stride


def encode_box(box: Float[Tensor, "*n 4"], cell: Int[Tensor, "*n"], columns: int, config: ModelConfig) -> Float[Tensor, "*n 4"]:
    """Box in px -> latent units: centre offset from the cell and log size, in strides, through the fixed affine map."""
    centre, size = (box[..., :2] + box[..., 2:]) / 2, (box[..., 2:] - box[..., :2]).clamp_min(1e-3)
    offset = (centre - cell_centre(cell, columns, config.stride, box.dtype)) / config.stride
    raw = torch.cat((offset, torch.log(size / config.stride)), -1)
    return (raw - raw.new_tensor(config.box_loc)) / raw.new_tensor(config.box_spread)


def decode_box(
    latent: Float[Tensor, "*n 4"], cell: Int[Tensor, "*n"], columns: int, config: ModelConfig
) -> Float[Tensor, "*n 4"]:
    """Inverse of `encode_box`; log sizes are limited to exp(+-6) strides."""
    raw = latent * latent.new_tensor(config.box_spread) + latent.new_tensor(config.box_loc)
    centre = raw[..., :2] * config.stride + cell_centre(cell, columns, config.stride, latent.dtype)
    half = torch.exp(raw[..., 2:].clamp(-6, 6)) * (config.stride / 2)
    return torch.cat((centre - half, centre + half), -1)


def focal_length(intrinsics: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n"]:
    """Geometric mean of fx and fy, px."""
    return torch.sqrt(intrinsics[..., 0] * intrinsics[..., 1])


def pixels_per_radian(ray: Float[Tensor, "*n 3"], intrinsics: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n"]:
    """How many pixels a radian covers along a ray of the camera, of any length; geometric mean over its two directions.

    A pinhole camera draws what lies off its axis larger: by 1 / cos of the angle across, by 1 / cos^2 away from the middle
    (docs/story.md; the test takes the area of a small cone's picture).
    """
    cosine = ray[..., 2] / torch.linalg.vector_norm(ray, dim=-1)
    return focal_length(intrinsics) * cosine.clamp_min(1e-3) ** -1.5


def encode_range(
    position: Float[Tensor, "*n 3"],
    diagonal: Float[Tensor, "*n"],
    box: Float[Tensor, "*n 4"],
    intrinsics: Float[Tensor, "*n 4"],
    config: ModelConfig,
) -> Float[Tensor, "*n 4"]:
    """Position and size -> latent units: log(range / pixels per radian), centre's offset in box sizes, log diagonal.

    The range is divided by what the camera makes of a radian there, in px, since an image shows their ratio only: the same
    network then serves any camera, any scale of the image, and objects far off the axis of a wide lens, which it cannot tell
    from nearer ones before it.
    """
    distance = torch.linalg.vector_norm(position, dim=-1)
    log_range = torch.log(distance / pixels_per_radian(position, intrinsics))
    size = (box[..., 2:] - box[..., :2]).clamp_min(1e-3)
    offset = (project(position, intrinsics) - (box[..., :2] + box[..., 2:]) / 2) / size
    raw = torch.cat((log_range[..., None], offset, torch.log(diagonal)[..., None]), -1)
    return (raw - raw.new_tensor(config.range_loc)) / raw.new_tensor(config.range_spread)


def decode_range(
    latent: Float[Tensor, "*n 4"], box: Float[Tensor, "*n 4"], intrinsics: Float[Tensor, "*n 4"], config: ModelConfig
) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*n"]]:
    """Inverse of `encode_range`: position in the camera frame (m) and box diagonal (m)."""
    raw = latent * latent.new_tensor(config.range_spread) + latent.new_tensor(config.range_loc)
    pixel = (box[..., :2] + box[..., 2:]) / 2 + raw[..., 1:3] * (box[..., 2:] - box[..., :2])
    ray = pixel_ray(pixel, intrinsics)
    distance = torch.exp(raw[..., 0]) * pixels_per_radian(ray, intrinsics)
    return distance[..., None] * ray, torch.exp(raw[..., 3])


def pack_bits(voxels: Bool[Tensor, "*n v v v"]) -> UInt8[Tensor, "*n bytes"]:
    """Pack occupancy into bits as `numpy.packbits` does, C order."""
    weights = torch.tensor([128, 64, 32, 16, 8, 4, 2, 1], dtype=torch.uint8, device=voxels.device)
    return (voxels.flatten(-3).unflatten(-1, (-1, 8)).to(torch.uint8) * weights).sum(-1, dtype=torch.uint8)


def unpack_bits(packed: UInt8[Tensor, "*n bytes"], size: int) -> Bool[Tensor, "*n v v v"]:
    """Occupancy grids of packed bits (C order, most significant bit first, as `numpy.packbits` writes them)."""
    shifts = torch.arange(7, -1, -1, dtype=torch.uint8, device=packed.device)
    bits = (packed[..., None] >> shifts) & 1
    return bits.flatten(-2).unflatten(-1, (size, size, size)).bool()
