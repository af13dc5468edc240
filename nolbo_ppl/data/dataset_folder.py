"""Read a data set from its folder: scenes made by `nolbo scenes`, or a user's own images and labels."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from nolbo_ppl.categories import CATEGORIES, CATEGORY_SYMMETRY
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.voxels import resized_bits
from nolbo_ppl.io.files import read_jsonl
from nolbo_ppl.io.images import image_size, open_image
from nolbo_ppl.io.npz import read_voxels, voxel_side
from nolbo_ppl.io.scenes import image_field, parse_record
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.structures.label_arrays import (
    SLOTS,
    Arrays,
    allocentric_viewpoints,
    assemble,
    empty_labels,
    fill_annotations,
    fill_regions,
)
from nolbo_ppl.synthetic.assets.shape_library import VOXELS
from nolbo_ppl.synthetic.dataset_writer import SCENES

PADDING = 114
"""Grey value of the bars beside an image that is not square."""


def letterbox(
    image: UInt8[np.ndarray, "h w 3"], size: int
) -> tuple[UInt8[np.ndarray, "{size} {size} 3"], float, tuple[float, float]]:
    """Scale an image uniformly to fit a square, centred between grey bars; also the scale and the shift in px.

    A pixel (u, v) of the image goes to (scale u + shift_x, scale v + shift_y).
    """
    height, width = image.shape[:2]
    scale = size / max(height, width)
    new_width, new_height = max(1, round(width * scale)), max(1, round(height * scale))
    if (new_width, new_height) != (width, height):
        resized = Image.fromarray(image).resize((new_width, new_height), Image.Resampling.BILINEAR, reducing_gap=2.0)
        image = np.asarray(resized)
    left, top = (size - new_width) // 2, (size - new_height) // 2
    canvas = np.full((size, size, 3), PADDING, dtype=np.uint8)
    canvas[top : top + new_height, left : left + new_width] = image
    return canvas, scale, (float(left), float(top))


class SceneFolder:
    """A data set on disk; `batch` gathers any of its images at the network's size.

    Every line is checked when the folder is opened; images are decoded when they are asked for.

    Attributes:
        path: the folder.
        records: the checked lines, in order.
        categories: names the category numbers stand for.
        instances: names the instance numbers stand for, sorted.
        size: height and width of the images of a batch, px.
        slots: object slots an image: enough for the image with the most objects.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        categories: Sequence[str] = CATEGORIES,
        instances: Sequence[str] | None = None,
        size: int = 128,
        slots: int | None = None,
        symmetry: Sequence[int] | None = None,
        voxel_side: int = VOXELS,
    ) -> None:
        """Open a folder.

        Args:
            path: the folder, or its `scenes.jsonl`.
            categories: known category names.
            instances: known instance names; by default those that occur. Others count as unlabelled.
            size: height and width the images are brought to, a multiple of 32.
            slots: object slots an image; by default 8, or more when an image has more objects.
            symmetry: order of each of `categories` for objects that state none; by default `CATEGORY_SYMMETRY`, 1 for names
                unknown there.
            voxel_side: side of the grids of a batch; those of the file are brought to it.

        Raises:
            InputError: anything malformed, naming file, line and field.
        """
        self.path = Path(path)
        if self.path.name == SCENES:
            self.path = self.path.parent
        if size <= 0 or size % 32:
            raise input_error("image size", got=size, expected="a positive multiple of 32")
        if not self.path.is_dir():
            raise input_error("no such data set", got=path, expected=f"a folder with {SCENES}")
        self.categories, self.size, self.voxel_side = tuple(categories), size, voxel_side
        if symmetry is not None and len(symmetry) != len(self.categories):
            raise input_error("symmetry", got=len(symmetry), expected=f"one of each of {len(self.categories)} categories")
        self._symmetries = CATEGORY_SYMMETRY if symmetry is None else dict(zip(self.categories, symmetry))
        self.records: list[Annotations] = []
        self.image_sizes: list[tuple[int, int]] = []
        self._read_lines()
        found = {name for record in self.records for name in record.instance if name is not None}
        self.instances: tuple[str, ...] = tuple(sorted(found)) if instances is None else tuple(instances)
        self._number = {name: number for number, name in enumerate(self.instances)}
        most = max(len(record) for record in self.records)
        self.slots = max(SLOTS, most) if slots is None else slots
        if most > self.slots:
            raise input_error("more objects in an image than slots", got=most, expected=f"at most {self.slots}")
        self._voxels = self._read_voxels()
        self.labels = self._label_arrays()

    def _read_lines(self) -> None:
        file = self.path / SCENES
        for line, row in read_jsonl(file):
            image = image_field(row, self.path, file, line)
            size = image_size(image, named_by=(file, line))
            self.records.append(parse_record(row, file, line, self.categories, size, image, self._symmetries))
            self.image_sizes.append(size)
        if not self.records:
            raise input_error("a data set without images", got=file, expected="at least one line")

    def _read_voxels(self) -> dict[str, UInt8[np.ndarray, " bytes"]]:
        file = self.path / "voxels.npz"
        if not file.is_file():
            return {}
        stored = voxel_side(file)
        return {name: resized_bits(bits, stored, self.voxel_side) for name, bits in read_voxels(file, stored).items()}

    def _placing(self, row: int) -> tuple[float, float, float]:
        """Scale and shift (px) that `letterbox` gives the image of a row."""
        width, height = self.image_sizes[row]
        scale = self.size / max(width, height)
        left = (self.size - max(1, round(width * scale))) // 2
        top = (self.size - max(1, round(height * scale))) // 2
        return scale, float(left), float(top)

    def _label_arrays(self) -> Arrays:
        labels = empty_labels(len(self.records), self.slots)
        placings = [self._placing(row) for row in range(len(self.records))]
        for row, (record, placing) in enumerate(zip(self.records, placings)):
            numbers = [self._number.get(name or "", -1) for name in record.instance]
            fill_annotations(labels, row, record, self.categories, numbers, placing)
        labels["viewpoint"] = allocentric_viewpoints(labels)
        fill_regions(labels, self.records, self.categories, placings)
        return labels

    def __len__(self) -> int:
        return len(self.records)

    def image(self, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """The image of a row at its own size. Raises `InputError` when it cannot be decoded."""
        file = self.records[index].file
        assert file is not None  # `image_field` has found it
        return open_image(file)

    def voxels(self, index: int) -> UInt8[np.ndarray, "m bytes"]:
        """Packed grids of the objects of a row, all zero where one is unknown."""
        grids = [self._voxels.get(name or "") for name in self.records[index].instance]
        empty = np.zeros(self.voxel_side**3 // 8, dtype=np.uint8)
        return np.array([empty if bits is None else bits for bits in grids], dtype=np.uint8).reshape(len(grids), len(empty))

    def intrinsics(self, index: int) -> Float[np.ndarray, " 4"]:
        """Intrinsics of a row at the image's own size."""
        return self.records[index].intrinsics

    def batch(self, indices: Sequence[int] | Int[np.ndarray, " b"]) -> Arrays:
        """The images of these rows, in the layout of `nolbo_ppl.models.scene_batch.SceneBatch`, as NumPy arrays.

        Raises:
            InputError: a row that is not there, or an image that cannot be decoded.
        """
        index = np.asarray(indices, dtype=np.int64)
        if index.size and (index.min() < 0 or index.max() >= len(self)):
            raise input_error("no such image in the data set", got=index.tolist(), expected=f"0 to {len(self) - 1}")
        images = np.stack([letterbox(self.image(int(i)), self.size)[0].transpose(2, 0, 1) for i in index])
        labels = {name: array[index] for name, array in self.labels.items()}
        voxels = np.zeros((len(index), self.slots, self.voxel_side**3 // 8), dtype=np.uint8)
        has_voxels = np.zeros((len(index), self.slots), dtype=np.bool_)
        for row, i in enumerate(index):
            for slot, name in enumerate(self.records[i].instance):
                bits = self._voxels.get(name or "")
                if bits is not None:
                    voxels[row, slot], has_voxels[row, slot] = bits, True
        return assemble(images, labels, voxels, has_voxels)

    def shapes(self) -> tuple[Int[np.ndarray, " n"], UInt8[np.ndarray, "n bytes"], Int[np.ndarray, " n"]]:
        """Number, packed voxels and category of every instance with known voxels and category, by ascending number."""
        found: dict[int, tuple[np.ndarray, int]] = {}
        for record in self.records:
            for name, label in zip(record.instance, record.labels(self.categories).tolist()):
                bits = self._voxels.get(name or "")
                number = self._number.get(name or "", -1)
                if bits is not None and number >= 0 and label >= 0:
                    found[number] = (bits, label)
        order = sorted(found)
        packed = np.array([found[n][0] for n in order], dtype=np.uint8).reshape(len(found), self.voxel_side**3 // 8)
        category = np.array([found[n][1] for n in order], dtype=np.int64)
        return np.array(order, dtype=np.int64), packed, category
