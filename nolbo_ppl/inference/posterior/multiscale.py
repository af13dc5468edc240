"""Pictures larger than those a model was trained on: looked at in several sizes, the answers put together.

A network knows objects of the pixel sizes it has seen. In a street image the near car is thirty times as large as the
far one: each size of the image answers for the objects it shows at a trained size, and of two answers for one object the
more certain one stays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.boxes import nms
from nolbo_ppl.inference.posterior.predictor import Image, ObservationModel
from nolbo_ppl.structures.latent_modes import LatentModes
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors, ViewpointModes

TRAINED_SIDES = (0.11, 0.94)
"""Longer sides of boxes the network has seen in training, as shares of its image size (14 to 120 px of 128)."""


class MultiScalePredictor:
    """A model that looks at every image in several sizes; it answers as `ObservationModel` does.

    Args:
        model: the model.
        sizes: longer sides, px, each image is brought to.

    Raises:
        InputError: no size, or one that is no positive multiple of 32.
    """

    def __init__(self, model: ObservationModel, sizes: Sequence[int]) -> None:
        if not sizes or any(size <= 0 or size % 32 for size in sizes):
            raise input_error("sizes of the images", got=tuple(sizes), expected="positive multiples of 32, one or more")
        self.model, self.sizes = model, tuple(sorted(set(sizes)))
        self.config, self.calibration = model.config, model.calibration
        self.decode, self.shape_posterior, self.prior_mean = model.decode, model.shape_posterior, model.prior_mean

    def observe(
        self,
        images: Sequence[Image],
        intrinsics: Any = None,
        *,
        threshold: float = 0.3,
        iou_threshold: float = 0.45,
        decode: bool = True,
        batch: int = 16,
    ) -> list[ObjectPosteriors]:
        """Posterior of every object of each image, best objectness first."""
        levels = [
            self.model.observe(
                images, intrinsics, threshold=threshold, iou_threshold=iou_threshold, decode=decode, batch=batch, size=size
            )
            for size in self.sizes
        ]
        merged = []
        for image, found in zip(images, zip(*levels)):
            shown = [one[self._shown(side_of(one.box), level, image)] for level, one in enumerate(found)]
            every = join(shown)
            kept = nms(torch.as_tensor(every.box), torch.as_tensor(every.objectness), iou_threshold).numpy()
            merged.append(every[kept])
        return merged

    def observe_boxes(
        self,
        images: Sequence[Image],
        intrinsics: Any,
        boxes: Sequence[Float[np.ndarray, "n 4"]],
        *,
        decode: bool = True,
        batch: int = 16,
    ) -> list[ObjectPosteriors]:
        """Posterior of the region responsible for each given box, at the size that shows it best."""
        best = [self._best(side_of(np.asarray(box).reshape(-1, 4)), image) for box, image in zip(boxes, images)]
        levels = [
            self.model.observe_boxes(
                images,
                intrinsics,
                [np.asarray(box).reshape(-1, 4)[at == level] for box, at in zip(boxes, best)],
                decode=decode,
                batch=batch,
                size=size,
            )
            for level, size in enumerate(self.sizes)
        ]
        # Rows of the joined answers come level by level: put them back into the order of the boxes.
        return [join(found)[np.argsort(np.argsort(at, kind="stable"))] for found, at in zip(zip(*levels), best)]

    def _network_side(self, side: Float[np.ndarray, " n"], level: int, image: Image) -> Float[np.ndarray, " n"]:
        """Longer sides of boxes at a level, as shares of the network's image size."""
        height, width = image.shape[:2] if image.shape[-1] == 3 else image.shape[-2:]
        return side * (self.sizes[level] / max(height, width) / self.config.image_size)

    def _shown(self, side: Float[np.ndarray, " n"], level: int, image: Image) -> Bool[np.ndarray, " n"]:
        """Which boxes a level answers for: trained sizes; the ends of the pyramid answer for what is beyond them too."""
        share = self._network_side(side, level, image)
        large_enough = share >= TRAINED_SIDES[0] if level < len(self.sizes) - 1 else np.ones(len(share), dtype=bool)
        return large_enough & (share <= TRAINED_SIDES[1]) if level > 0 else large_enough

    def _best(self, side: Float[np.ndarray, " n"], image: Image) -> Int[np.ndarray, " n"]:
        """Level at which each box is nearest the middle of the trained sizes (geometric)."""
        middle = 0.5 * np.log(TRAINED_SIDES).sum()
        share = np.stack([self._network_side(side, level, image) for level in range(len(self.sizes))])
        return np.abs(np.log(np.maximum(share, 1e-9)) - middle).argmin(0)


def side_of(box: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """Longer side of each box."""
    return np.maximum(box[:, 2] - box[:, 0], box[:, 3] - box[:, 1])


def join(parts: Sequence[ObjectPosteriors]) -> ObjectPosteriors:
    """Answers for one image put together, in order. Raises `InputError` when there is nothing to join."""
    if not parts:
        raise input_error("no observations to join", got=0, expected="at least one set")

    def together(values: list[Any]) -> Any:
        if isinstance(values[0], (ViewpointModes, LatentModes)):
            names = [field.name for field in dataclasses.fields(values[0])]
            return type(values[0])(*(np.concatenate([getattr(value, name) for value in values]) for name in names))
        return np.concatenate(values) if isinstance(values[0], np.ndarray) else values[0]

    names = [field.name for field in dataclasses.fields(ObjectPosteriors)]
    return ObjectPosteriors(**{name: together([getattr(part, name) for part in parts]) for name in names})
