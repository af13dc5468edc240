"""Queries on the amortised posterior (NOLBO, appendix III): load a model, show it images, get distributions back."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nolbo_ppl.devices import device_of
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.boxes import boxes_in_image, suppress
from nolbo_ppl.inference.posterior.decode import SelectedRegions, assemble
from nolbo_ppl.inference.posterior.decoded_shapes import DecodedShape, decode_latents, extents, sampled_shapes
from nolbo_ppl.inference.posterior.folded_networks import FoldedNetworks, NetworksOfQueries
from nolbo_ppl.inference.posterior.metric_size import MetricKnowledge, shape_hulls
from nolbo_ppl.inference.posterior.preprocess import Image as Image
from nolbo_ppl.inference.posterior.preprocess import PreprocessedImage, as_sequence, preprocess_all, same_shape
from nolbo_ppl.inference.posterior.preprocess import guessed_intrinsics as guessed_intrinsics
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.image_shift import ODDS_PER_SHIFT, SCALE_PER_SHIFT, excess
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.observed_scene import Detail, Encoding, RegionParameters
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.models.scene_batch import decode_box
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors

CANDIDATE = 0.02
"""Regions of at least this objectness count towards the object they describe."""

Found: TypeAlias = tuple[Int[Tensor, " n"], Int[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, "n 4"] | None]
"""Regions of a batch to answer for: image, number, log odds, and boxes to look at where they are given, px."""


class ObservationModel:
    """A trained observation model, ready for images of any size.

    Args:
        model: the networks; put into evaluation mode.
        calibration: factors on the guide's posterior.

    Example:
        >>> import nolbo_ppl
        >>> model = nolbo_ppl.load("tiny")
        >>> photograph = np.full((96, 160, 3), 128, dtype=np.uint8)  # nothing to be seen
        >>> len(model.observe(photograph, intrinsics=[150.0, 150.0, 80.0, 48.0]))
        0
        >>> model.decode(model.prior_mean()[:1]).shape  # the shape of the first category's mean
        (1, 32, 32, 32)
    """

    def __init__(self, model: Nolbo, calibration: Calibration | None = None) -> None:
        self.model = model.eval().requires_grad_(False)
        self.calibration = calibration or Calibration()
        self.config = model.config
        self._prior_mean = model.story.prior.label_mean().detach().cpu()
        self._prior = model.story.prior if self.device.type == "cpu" else copy.deepcopy(model.story.prior).cpu()
        self._networks = FoldedNetworks(self.model)

    @property
    def device(self) -> torch.device:
        """Where the networks are; answers are arrays in the memory of the CPU, wherever they come from."""
        return next(self.model.parameters()).device

    def to(self, device: str | torch.device) -> ObservationModel:
        """The same model on a device (`nolbo_ppl.devices.device_of`); the networks themselves are moved."""
        return ObservationModel(self.model.to(device_of(device)), self.calibration)

    def prior_mean(self) -> Float[np.ndarray, "labels d"]:
        """mu_psi(l) of every category."""
        return self._prior_mean.numpy()

    @torch.inference_mode()
    def decode(self, latent: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n v v v"]:
        """Occupancy probability of each voxel of the canonical grid, for given shape latents."""
        z = torch.as_tensor(np.asarray(latent), dtype=self._prior_mean.dtype)  # moved where it is decoded
        if z.dim() != 2 or z.shape[1] != self.config.latent_dim:
            raise input_error("shape latents", got=tuple(z.shape), expected=f"(n, {self.config.latent_dim})")
        if len(z) == 0:
            return np.zeros((0,) + (self.config.voxel_size,) * 3, dtype=np.float32)
        return decode_latents(self._decoded, z)

    @torch.inference_mode()
    def shape_posterior(self, packed: UInt8[np.ndarray, "n bytes"]) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
        """Mean and scale of q(z | true shape) of packed voxel grids: the shape autoencoder's posterior."""
        loc, scale = self.model.shape_guide.posterior(torch.as_tensor(packed).to(self.device))
        return loc.cpu().numpy(), scale.cpu().numpy()

    def observe(
        self,
        images: Image | Sequence[Image],
        intrinsics: Any = None,
        *,
        threshold: float = 0.3,
        iou_threshold: float = 0.45,
        size: int | None = None,
        decode: bool = True,
        samples: int = 8,
        seed: int = 0,
        batch: int = 16,
    ) -> Any:
        """Posterior of every object of an image, or of each image of a sequence.

        Args:
            images: one image or a sequence of images, of any sizes; they are scaled to the network's own.
            intrinsics: [fx, fy, cx, cy] in px of the given image, one for all or one an image (in a list None where they are
                unknown). Without them the camera is taken to see 60 degrees across, and positions are as good as that guess.
            threshold: least objectness of a detection.
            iou_threshold: overlap above which the less certain of two regions is taken to describe the same object. Only
                one region is responsible for an object, so that the probabilities of all that describe it add up.
            size: longer side, px, that images are scaled to, a multiple of 32; the network's own by default. It is fully
                convolutional: a larger side suits wide images with objects that would else be too small.
            decode: decode shapes (voxels, sizes, meshes); without it sizes are the category's mean proportions.
            samples: samples of the shape latent behind the voxel mean and variance.
            seed: seed of those samples.
            batch: images that go through the network at once.

        Returns:
            `ObjectPosteriors`, or a list of them for a sequence.

        Raises:
            InputError: an image or its intrinsics cannot be used.
        """
        sequence, single = as_sequence(images)
        prepared = self._preprocess_all(sequence, intrinsics, size)
        if not 0 < threshold < 1:
            raise input_error("threshold of the objectness", got=threshold, expected="a probability between 0 and 1")

        def detect(networks: NetworksOfQueries, encoding: Encoding, logit: Tensor, group: list[int]) -> Found:
            return *self._detections(networks, encoding, logit, threshold, iou_threshold), None

        results = self._observe(prepared, detect, decode, samples, seed, batch)
        return results[0] if single else results

    def observe_boxes(
        self,
        images: Sequence[Image],
        intrinsics: Any,
        boxes: Sequence[Float[np.ndarray, "n 4"]],
        *,
        size: int | None = None,
        decode: bool = True,
        samples: int = 8,
        seed: int = 0,
        batch: int = 16,
    ) -> list[ObjectPosteriors]:
        """Posterior of the region responsible for each given box (px of the given image), in the order of the boxes.

        The responsible predictor is the one of the box's cell whose own box overlaps it most (NOLBO, implementation). The
        guide refines its answer by the given box.

        Raises:
            InputError: boxes that are not finite, not corners in order, outside of their image or less than a pixel wide;
                names image and box. What sticks out of the image is cut off.
        """
        if len(boxes) != len(images):
            raise input_error("boxes", got=f"{len(boxes)} lists", expected=f"one list for each of {len(images)} images")
        prepared = self._preprocess_all(images, intrinsics, size)
        checked = []
        for i, (image, given) in enumerate(zip(prepared, boxes)):
            height, width = image.image.shape[-2:]
            checked.append(boxes_in_image(given, (round(width / image.scale[0]), round(height / image.scale[1])), i))

        def responsible(networks: NetworksOfQueries, encoding: Encoding, logit: Tensor, group: list[int]) -> Found:
            scaled = [checked[i] * np.tile(prepared[i].scale, 2) for i in group]
            row = torch.from_numpy(np.repeat(np.arange(len(group)), [len(part) for part in scaled]))
            box = torch.as_tensor(np.concatenate(scaled), dtype=logit.dtype)
            at = self.device
            region = networks.guide.responsible_region(encoding, row.to(at), box.to(at)).cpu()
            return row, region, logit[row, region], box

        return self._observe(prepared, responsible, decode, samples, seed, batch)

    @torch.inference_mode()
    def encode(
        self, image: UInt8[Tensor, "b 3 h w"], detail: Detail | None = None, networks: NetworksOfQueries | None = None
    ) -> Encoding:
        """The network's forward pass over a batch of prepared images, and the same larger where there are any."""
        at = self.device
        larger = None if detail is None else Detail(detail.image.to(at), detail.factor.to(at))
        return (networks or self._networks.current()).guide.encode(image.to(at), larger)

    def _decoded(self, latent: Float[Tensor, "n d"]) -> Float[Tensor, "n v v v"]:
        """Log odds of the voxels of latents."""
        return self._networks.decoder(latent.to(self.device))

    @torch.inference_mode()
    def _observe(
        self,
        prepared: list[PreprocessedImage],
        find: Callable[[NetworksOfQueries, Encoding, Tensor, list[int]], Found],
        decode: bool,
        samples: int,
        seed: int,
        batch: int,
    ) -> list[ObjectPosteriors]:
        """Run batches of images of one shape; `find` gives what to answer for.

        The networks run where they are. What is chosen of their output, a few numbers an object, is brought to the CPU and
        answered there, in double precision where the formulas want it, which not every device has.
        """
        networks = self._networks.current()  # looked for changed weights once, not at every use
        shapes = self._shapes(networks, decode, samples, seed)
        results: dict[int, ObjectPosteriors] = {}
        for group in same_shape(prepared, batch):
            images = torch.stack([prepared[i].image for i in group])
            encoding = self.encode(images, detail_of([prepared[i] for i in group]), networks)
            shift = None if encoding.shift is None else encoding.shift.cpu()
            logit = self.calibration.objectness(encoding.objectness_logit.cpu())
            if shift is not None:
                logit = logit - ODDS_PER_SHIFT * excess(shift)[:, None]
            row, region, odds, look_at = find(networks, encoding, logit, group)
            camera = torch.stack([prepared[i].camera for i in group])[row]
            scale = np.stack([prepared[i].scale for i in group])[row.numpy()]
            q = self._parameters(networks, encoding, row, region, look_at)
            if shift is not None:
                q = q.widened(1 + SCALE_PER_SHIFT * excess(shift)[row])
            known = self._metric_knowledge(networks, encoding, row, [prepared[i] for i in group])
            regions = SelectedRegions(q, region, encoding.columns, odds, camera, scale, known)
            answer = assemble(regions, self.config, self._prior, self._prior_mean, shapes)
            ends = np.searchsorted(row.numpy(), np.arange(len(group) + 1))
            for k, i in enumerate(group):
                one = answer[slice(ends[k], ends[k + 1])]
                if encoding.generated is not None:  # of generated scenes the guide's own range is left alone
                    one = replace(one, sized=bool(encoding.generated[k] < 0.5))
                one = replace(one, position_tails=self.calibration.stated_tails)
                results[i] = one if shift is None else replace(one, shift=float(shift[k]))
        return [results[i] for i in range(len(prepared))]

    def _shapes(
        self, networks: NetworksOfQueries, decode: bool, samples: int, seed: int
    ) -> Callable[[RegionParameters, Tensor], DecodedShape]:
        """Shapes of regions from their posterior and diagonals, m."""

        def decoded(latent: Float[Tensor, "n d"]) -> Float[Tensor, "n v v v"]:
            return networks.decoder(latent.to(self.device))

        def shapes(q: RegionParameters, diagonal: Tensor) -> DecodedShape:
            metres = diagonal.numpy()
            if not decode:
                return DecodedShape(None, None, self._category_extents[q.label_logits.argmax(-1)] * metres[:, None])
            side = self.config.voxel_size
            return sampled_shapes(decoded, side, q.shape_loc, q.shape_scale, metres, samples, seed)

        return shapes

    def _metric_knowledge(
        self, networks: NetworksOfQueries, encoding: Encoding, row: Int[Tensor, " n"], images: Sequence[PreprocessedImage]
    ) -> MetricKnowledge | None:
        """What else tells sizes and distances of objects in these images; None for models that know no photographs."""
        guide = networks.guide
        if encoding.generated is None or not isinstance(guide, HybridGuide):
            return None
        return MetricKnowledge(
            self._shape_hulls,
            guide.sizes if self.device.type == "cpu" else copy.deepcopy(guide.sizes).cpu(),
            1 - encoding.generated.cpu()[row],
            torch.tensor([image.guessed for image in images], device="cpu")[row],
            torch.tensor([image.extent for image in images], device="cpu")[row],
        )

    def _preprocess_all(self, images: Sequence[Any], intrinsics: Any, size: int | None) -> list[PreprocessedImage]:
        cuts_out = bool(self.config.detector or self.config.shape_look)
        size = self.config.image_size if size is None else size
        return preprocess_all(images, intrinsics, size, self._prior_mean.dtype, cuts_out)

    def _parameters(
        self,
        networks: NetworksOfQueries,
        encoding: Encoding,
        row: Int[Tensor, " n"],
        region: Int[Tensor, " n"],
        box: Float[Tensor, "n 4"] | None,
    ) -> RegionParameters:
        at = self.device
        look_at = None if box is None else box.to(at)
        q = networks.guide.parameters_at(encoding, row.to(at), region.to(at), box=look_at).map(Tensor.cpu)
        return self.calibration.apply(q.at_map_category(self._prior_mean))

    def _boxes(
        self, networks: NetworksOfQueries, encoding: Encoding, row: Int[Tensor, " n"], region: Int[Tensor, " n"]
    ) -> Float[Tensor, "n 4"]:
        """Boxes of regions, px of the scaled image; no RoI refinement is needed for them."""
        at = self.device
        q = networks.guide.parameters_at(encoding, row.to(at), region.to(at), look=False)
        return decode_box(q.box_loc.cpu(), region // self.config.predictors, encoding.columns, self.config)

    def _detections(
        self, networks: NetworksOfQueries, encoding: Encoding, logit: Tensor, threshold: float, iou_threshold: float
    ) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"], Float[Tensor, " n"]]:
        """Row, region and log odds of the objects above the threshold, best first in a row.

        Regions whose boxes overlap describe one object, for which exactly one of them is responsible: the probability
        that it is there is the sum of theirs. The most probable region answers for it. With a detector's evidence, which
        gives one object to many regions, its probability is that of the most probable one.
        """
        least = min(threshold, CANDIDATE)
        row, region = (logit > math.log(least / (1 - least))).nonzero(as_tuple=True)
        if len(region) == 0:
            return row, region, logit.new_empty(0)
        box = self._boxes(networks, encoding, row, region)
        kept, stands_for = suppress(box, logit[row, region], iou_threshold, group=row)
        probability = torch.sigmoid(logit[row, region].double())
        if not self.config.detector:
            probability = torch.zeros_like(probability).index_add_(0, stands_for, probability)
        probability = self.calibration.limited(probability)
        kept = kept[probability[kept] > threshold]
        kept = kept[torch.argsort(probability[kept], descending=True, stable=True)]
        kept = kept[torch.argsort(row[kept], stable=True)]
        return row[kept], region[kept], torch.logit(probability[kept])

    @cached_property
    def _shape_hulls(self) -> Float[Tensor, "labels p 3"]:
        """Points on the hull of each category's mean shape, in diagonals."""
        return torch.as_tensor(shape_hulls(self.decode(self.prior_mean())), dtype=self._prior_mean.dtype)

    @cached_property
    def _category_extents(self) -> Float[np.ndarray, "labels 3"]:
        """Extents, in diagonals, of each category's mean shape."""
        return extents(self.decode(self.prior_mean()))


def detail_of(images: Sequence[PreprocessedImage]) -> Detail | None:
    """The larger images of a batch of one shape; None where there are none."""
    details = [image.detail for image in images if image.detail is not None]
    if not details:
        return None
    factor = torch.tensor([image.detail_factor for image in images], dtype=images[0].camera.dtype, device="cpu")
    return Detail(torch.stack(details), factor)
