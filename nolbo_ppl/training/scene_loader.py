"""What the trainer asks for: the batch of a step, with the teacher's latents, augmented; and batches of shapes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from nolbo_ppl._moved import renamed
from nolbo_ppl.data.augment import Augmentation, augment
from nolbo_ppl.data.loader import BatchedScenes, batch_indices
from nolbo_ppl.data.mirror import mirror, mirror_voxels
from nolbo_ppl.data.scene_cache import CachedScenes
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.voxels import resized_bits
from nolbo_ppl.models.baselines.single_object import one_object_batch
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.models.shape_vae import ShapeBatch
from nolbo_ppl.structures.label_arrays import CERTAINTY, Arrays
from nolbo_ppl.synthetic.assets.shape_library import VOXELS
from nolbo_ppl.training.stages import DECODE_STREAM, seeded_noise

JITTER_STREAM = 2**41
"""Added to a step's number, it gives the random numbers that move the crops of objects."""
BOX_JITTER = 0.08
"""Standard deviation of what a crop's middle is moved by, in extents of its box, and of its box's log extents."""


def to_batch(arrays: Arrays) -> SceneBatch:
    """Arrays of a loader as the batch that story and guide take."""
    return SceneBatch(**{name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()})


def drawn_labels(arrays: Arrays, draws: Float[np.ndarray, "2 b m"] | None = None) -> Arrays:
    """Labels of a model as certain ones: objects and categories kept with their probabilities.

    An object that is not kept is background, a category that is not kept is missing; the mean over many draws is the objective
    of soft labels, with every site and no other bound.

    Args:
        arrays: of a loader, perhaps with `confidence` and `category_confidence`.
        draws: uniform numbers for objects and categories; without them what is likelier than not is kept.
    """
    rest = {name: value for name, value in arrays.items() if name not in CERTAINTY}
    level = np.full((2, *arrays["present"].shape), 0.5) if draws is None else draws
    if CERTAINTY[0] in arrays:
        rest["present"] = arrays["present"] & (arrays[CERTAINTY[0]] >= level[0])
    if CERTAINTY[1] in arrays:
        rest["category"] = np.where(arrays[CERTAINTY[1]] >= level[1], arrays["category"], -1)
    return rest


class SceneSubset:
    """Some scenes of a data set as a data set."""

    def __init__(self, scenes: BatchedScenes, index: Int[np.ndarray, " n"]) -> None:
        self.scenes, self.index = scenes, index

    def __len__(self) -> int:
        return len(self.index)

    def batch(self, indices: Int[np.ndarray, " b"]) -> Arrays:
        """The scenes of these numbers."""
        return self.scenes.batch(self.index[np.asarray(indices)])


class ConcatScenes:
    """Several data sets of one pool of shapes, one after the other; smaller images are enlarged to the size of the largest,
    voxels (kept at 32^3) brought to the side that the networks decode."""

    def __init__(self, parts: Sequence[CachedScenes], voxel_side: int = VOXELS) -> None:
        self.parts, self.voxel_side = parts, voxel_side
        self._first = np.cumsum([0, *(len(part) for part in parts)])
        self.size = max(part.size for part in parts)

    def __len__(self) -> int:
        return int(self._first[-1])

    def batch(self, indices: Int[np.ndarray, " b"]) -> Arrays:
        """The scenes of these numbers."""
        index = np.asarray(indices)
        owner = np.searchsorted(self._first, index, side="right") - 1
        result: Arrays = {}
        for number, part in enumerate(self.parts):
            rows = np.flatnonzero(owner == number)
            if not len(rows):
                continue
            for name, value in enlarged(part.batch(index[rows] - self._first[number]), self.size).items():
                if name not in result:
                    result[name] = np.empty((len(index), *value.shape[1:]), value.dtype)
                result[name][rows] = value
        if "voxels" in result:
            result["voxels"] = resized_bits(result["voxels"], VOXELS, self.voxel_side)
        return result

    def shapes(self) -> tuple[Int[np.ndarray, " n"], UInt8[np.ndarray, "n bytes"], Int[np.ndarray, " n"]]:
        """Number, voxels and category of every shape, each once."""
        number, packed, category = (np.concatenate(values) for values in zip(*(part.shapes() for part in self.parts)))
        number, first = np.unique(number, return_index=True)
        return number, resized_bits(packed[first], VOXELS, self.voxel_side), category[first]


def enlarged(arrays: Arrays, size: int) -> Arrays:
    """Square scenes brought to a side of `size` px, labels with them."""
    side = arrays["image"].shape[-1]
    if side == size:
        return arrays
    image = torch.nn.functional.interpolate(
        torch.from_numpy(arrays["image"]).float(), (size, size), mode="bilinear", align_corners=False
    )
    factor = np.float32(size / side)
    changes = {"image": image.round().to(torch.uint8).numpy(), "intrinsics": arrays["intrinsics"] * factor}
    return {**arrays, **changes, "box": arrays["box"] * factor}


class ShapeTable:
    """Every labelled shape of a data set once, in the order of its number.

    Args:
        number: number of each shape, ascending.
        packed: its voxels, packed bits.
        category: its category label.
        known: names of instances with labels of their own are numbered below this; others are "novel".
    """

    def __init__(
        self,
        number: Int[np.ndarray, " n"],
        packed: UInt8[np.ndarray, "n bytes"],
        category: Int[np.ndarray, " n"],
        known: int = 0,
    ) -> None:
        self.number, self.known = number, known
        self.packed, self.category = torch.from_numpy(packed), torch.from_numpy(category)
        self.loc: Float[Tensor, "n d"] | None = None
        self.scale: Float[Tensor, "n d"] | None = None

    def __len__(self) -> int:
        return len(self.number)

    def batch(self, size: int, seed: int, step: int, latent_dim: int, part: slice = slice(None)) -> ShapeBatch:
        """The shapes of a training step, every epoch a new permutation; depends on seed and step only."""
        index = torch.from_numpy(batch_indices(len(self), size, seed, step))[part]
        instance = torch.from_numpy(self.number)[index]
        instance = torch.where(instance < self.known, instance, -1)
        noise = seeded_noise(seed, step, size, latent_dim)[part]
        return ShapeBatch(self.packed[index], self.category[index], instance, noise)

    @torch.no_grad()
    def encode_shapes(self, model: Nolbo, mirrored: bool = False) -> None:
        """Let the trained shape guide encode every shape: the truth of the shape latent in later stages.

        Args:
            model: the networks.
            mirrored: encode every shape's mirror image too.
        """
        model.shape_guide.eval()
        sides = [self.packed, mirror_voxels(self.packed)] if mirrored and len(self) else [self.packed]
        device = next(model.shape_guide.parameters()).device
        parts = [model.shape_guide.posterior(part.to(device)) for side in sides for part in side.split(256)]
        self.loc = torch.cat([loc.cpu() for loc, _ in parts])
        self.scale = torch.cat([scale.cpu() for _, scale in parts])

    def add_shape_targets(self, batch: SceneBatch, mirrored: Bool[Tensor, " b"] | None = None) -> SceneBatch:
        """The batch with the teacher's posterior of each object; a shape that is not in the table is unknown.

        Args:
            batch: scenes with the numbers of their shapes.
            mirrored: scenes that will be mirrored; the table must have been taught both sides.

        Raises:
            InputError: mirrored scenes, of a table that knows no mirrored shape.
        """
        if self.loc is None or self.scale is None or len(self) == 0:
            return batch.replace(has_voxels=torch.zeros_like(batch.has_voxels)) if len(self) == 0 else batch
        row = torch.from_numpy(np.searchsorted(self.number, batch.instance.numpy()).clip(0, len(self) - 1))
        known = torch.from_numpy(self.number)[row] == batch.instance
        if mirrored is not None:
            if len(self.loc) != 2 * len(self):
                raise input_error("latents of mirrored shapes", got="a table taught one side", do="teach(model, mirrored=True)")
            row = row + mirrored[:, None] * len(self)
        return batch.replace(
            shape_loc=self.loc[row],
            shape_scale=self.scale[row],
            has_voxels=batch.has_voxels & known,
            shape_index=torch.where(known, row, -1),
        )


class SceneLoader:
    """Shuffled, augmented batches of scenes; step s is a function of (seed, s) alone, whatever came before.

    Args:
        scenes: the data set.
        table: its shapes, for the teacher's latents.
        batch_size: scenes of the joint batch over all processes.
        seed: seed of order, augmentation and noise.
        latent_dim: dimensions of the shape latent, for its noise.
        augmentation: what is done to the images, None for nothing.
        size: longer side images are brought to, px, a multiple of 32; None for the data set's own.
        sizes: sides to choose from in its place, a step.
        known_instances: numbers below this are instance labels of the model.
        rank: number of this process.
        world: number of processes; each takes an equal part of the joint batch.
        crop: side, px, of crops of one object a scene, in place of the scenes; 0 for the scenes.
    """

    def __init__(
        self,
        scenes: BatchedScenes,
        table: ShapeTable,
        batch_size: int,
        seed: int,
        latent_dim: int,
        augmentation: Augmentation | None = None,
        size: int | None = None,
        sizes: Sequence[int] | None = None,
        known_instances: int = 0,
        rank: int = 0,
        world: int = 1,
        crop: int = 0,
    ) -> None:
        if batch_size % world:
            raise input_error("batch size", got=batch_size, expected=f"a multiple of the {world} processes")
        self.scenes, self.table, self.batch_size, self.seed = scenes, table, batch_size, seed
        self.latent_dim, self.augmentation, self.known = latent_dim, augmentation, known_instances
        self.size, self.sizes, self.crop = size, tuple(sizes) if sizes else (), crop
        self.part = slice(rank * batch_size // world, (rank + 1) * batch_size // world)

    def batch(self, step: int) -> SceneBatch:
        """The batch of a step (this process's part of it)."""
        index = batch_indices(len(self.scenes), self.batch_size, self.seed, step)[self.part]
        generator = np.random.default_rng([self.seed, step, 1])
        mirrored = None
        if self.augmentation is not None and self.augmentation.mirror_probability > 0:
            drawn = np.random.default_rng([self.seed, step, 2]).random(self.batch_size)[self.part]
            mirrored = torch.from_numpy(drawn < self.augmentation.mirror_probability)
        batch = self._labelled(index, mirrored, np.random.default_rng([self.seed, step, 3]))
        size = int(generator.choice(self.sizes)) if self.sizes else self._other(batch)
        if self.augmentation is not None or size is not None:
            seeds = generator.integers(2**63, size=self.batch_size)[self.part]
            batch = augment(batch, self.augmentation, seeds, size)
        noise = seeded_noise(self.seed, step, self.batch_size, batch.box.shape[1], self.latent_dim)
        order = seeded_noise(self.seed, step + DECODE_STREAM, self.batch_size, batch.box.shape[1])
        batch = batch.replace(noise=noise[self.part], decode_order=order[self.part])
        if not self.crop:
            return batch
        jitter = BOX_JITTER * seeded_noise(self.seed, step + JITTER_STREAM, self.batch_size, 4)[self.part]
        return one_object_batch(batch, self.crop, jitter)

    def prepared(self, index: Int[np.ndarray, " b"]) -> SceneBatch:
        """Scenes of these numbers without augmentation, with the teacher's latents."""
        batch = self._labelled(index)
        size = self._other(batch)
        batch = batch if size is None else augment(batch, None, np.zeros(len(index), dtype=np.int64), size)
        return one_object_batch(batch, self.crop) if self.crop else batch

    def _other(self, batch: SceneBatch) -> int | None:
        """The side images are brought to, or None where they have it."""
        return None if self.size is None or self.size == max(batch.image.shape[-2:]) else self.size

    def _labelled(
        self, index: Int[np.ndarray, " b"], mirrored: Bool[Tensor, " b"] | None = None, rng: np.random.Generator | None = None
    ) -> SceneBatch:
        """Scenes of these numbers as they are, or mirrored, with the teacher's latents; labels of models drawn by `rng`."""
        arrays = self.scenes.batch(index)
        draws = None
        if rng is not None and not {*CERTAINTY}.isdisjoint(arrays):
            draws = rng.random((2, self.batch_size, arrays["present"].shape[1]))[:, self.part]
        batch = self.table.add_shape_targets(to_batch(drawn_labels(arrays, draws)), mirrored)
        if mirrored is not None:
            batch = mirror(batch, mirrored)
        return batch.replace(instance=torch.where(batch.instance < self.known, batch.instance, -1))


class MixedSceneLoader:
    """Batches with a fixed number of scenes from each of several data sets, put together.

    Args:
        parts: the supply of each data set; all give images of one size.
    """

    def __init__(self, parts: Sequence[SceneLoader]) -> None:
        self.parts = tuple(parts)

    def batch(self, step: int) -> SceneBatch:
        """The batch of a step: scenes of the first data set, then of the second, ..."""
        return join_batches([part.batch(step) for part in self.parts])


def join_batches(batches: Sequence[SceneBatch]) -> SceneBatch:
    """Batches of images of one size as one; object slots and regions to ignore are filled up to the largest number.

    A field that only some batches have is filled with what its absence means.
    """
    slots = max(batch.box.shape[1] for batch in batches)
    regions = max((0 if batch.ignore is None else batch.ignore.shape[1]) for batch in batches)
    labels = next((batch.exhaustive.shape[1] for batch in batches if batch.exhaustive is not None), 0)
    latent = next((batch.shape_loc.shape[2] for batch in batches if batch.shape_loc is not None), 0)
    voxels = max(batch.voxels.shape[2] for batch in batches)
    joined: dict[str, Any] = {}
    for field in dataclasses.fields(SceneBatch):
        parts = []
        for batch in batches:
            value, scenes, at = getattr(batch, field.name), len(batch.image), batch.box
            if value is None:
                missing = {
                    "ignore": at.new_zeros(scenes, 0, 4), "exhaustive": torch.ones(scenes, labels, dtype=torch.bool),
                    "shape_index": torch.full(batch.present.shape, -1), "shape_loc": at.new_zeros(*at.shape[:2], latent),
                    "shape_scale": at.new_ones(*at.shape[:2], latent),
                }  # fmt: skip
                value = missing.get(field.name)
            if value is not None and field.name not in ("image", "intrinsics", "exhaustive"):
                value = _filled(value, regions if field.name == "ignore" else slots, field.name)
            if field.name == "image" and value.dtype != torch.float32 and len(batches) > 1:
                value = value.float()
            parts.append(value)
        absent = any(part is None for part in parts) or (field.name == "exhaustive" and not labels)
        absent |= (field.name.startswith("shape_") and not latent) or (field.name == "ignore" and not regions)
        joined[field.name] = None if absent else torch.cat(parts)
    if any(batch.voxels.shape[2] != voxels for batch in batches):
        raise input_error("voxels of data sets to mix", got=[batch.voxels.shape[2] for batch in batches], expected="one size")
    return SceneBatch(**joined)


_EMPTY = {"category": -1.0, "instance": -1.0, "shape_index": -1.0, "symmetry": 1.0, "diagonal": 1.0, "visibility": 1.0,
          "shape_scale": 1.0}  # fmt: skip
"""What an empty slot holds where it is not zero."""


def _filled(value: Tensor, count: int, name: str) -> Tensor:
    """A field with slots added up to a number of them."""
    more = value.new_full((len(value), count - value.shape[1], *value.shape[2:]), _EMPTY.get(name, 0.0))
    return torch.cat((value, more), 1)


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
