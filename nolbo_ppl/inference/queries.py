"""Queries on the amortised posterior (method section 4): load a model, show it images, get distributions back."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.boxes import box_iou, suppress
from nolbo_ppl.geometry.rotation import allocentric_to_egocentric, viewpoint_to_matrix
from nolbo_ppl.inference.observations import Observations, ViewpointModes
from nolbo_ppl.models.calibration import Calibration
from nolbo_ppl.models.distributions import VonMisesMixture, kl_to_each_component
from nolbo_ppl.models.guide import Encoding
from nolbo_ppl.models.head import RegionParameters
from nolbo_ppl.models.nolbo import Nolbo
from nolbo_ppl.models.scene import cell_of, decode_box, decode_range

Image = UInt8[np.ndarray, "h w 3"] | UInt8[Tensor, "3 h w"]
"""An image: a uint8 array of height x width x 3 colours, or a torch tensor with the colours first."""


def guessed_intrinsics(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, " 4"]:
    """Intrinsics of a camera that sees 60 degrees across: what is assumed when none are given."""
    height, width = image.shape[:2]
    focal = width / (2 * math.tan(math.radians(30)))
    return np.array([focal, focal, width / 2, height / 2])


@dataclass(frozen=True)
class _Prepared:
    """An image as the network takes it."""

    image: UInt8[Tensor, "3 h w"]
    camera: Float[Tensor, " 4"]
    scale: Float[np.ndarray, " 2"]

CANDIDATE = 0.02
"""Regions of at least this objectness count towards the object they describe."""


class ObservationModel:
    """A trained observation model, ready for images of any size.

    Args:
        model: the networks; put into evaluation mode.
        calibration: factors on the guide's posterior.
    """

    def __init__(self, model: Nolbo, calibration: Calibration | None = None) -> None:
        self.model = model.eval().requires_grad_(False)
        self.calibration = calibration or Calibration()
        self.config = model.config
        self._prior_mean = model.story.prior.label_mean().detach()

    def prior_mean(self) -> Float[np.ndarray, "labels d"]:
        """mu_psi(l) of every category."""
        return self._prior_mean.numpy()

    @torch.inference_mode()
    def decode(self, latent: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n v v v"]:
        """Occupancy probability of each voxel of the canonical grid, for given shape latents."""
        z = torch.as_tensor(np.asarray(latent), dtype=self._prior_mean.dtype)
        if z.dim() != 2 or z.shape[1] != self.config.latent_dim:
            raise input_error("shape latents", got=tuple(z.shape), expected=f"(n, {self.config.latent_dim})")
        if len(z) == 0:
            return np.zeros((0,) + (self.config.voxel_size,) * 3, dtype=np.float32)
        return torch.cat([torch.sigmoid(self.model.story.decoder(part)) for part in z.split(64)]).numpy()

    @torch.inference_mode()
    def shape_posterior(
        self, packed: UInt8[np.ndarray, "n bytes"]
    ) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
        """Mean and scale of q(z | true shape) of packed voxel grids: the shape autoencoder's posterior."""
        loc, scale = self.model.shape_guide.posterior(torch.as_tensor(packed))
        return loc.numpy(), scale.numpy()

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
            intrinsics: [fx, fy, cx, cy] in px of the given image, one for all or one an image. Without them the camera
                is taken to see 60 degrees across, and positions are as good as that guess.
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
            `Observations`, or a list of them for a sequence.

        Raises:
            InputError: an image or its intrinsics cannot be used.
        """
        single = (isinstance(images, np.ndarray) and images.ndim == 3) or (isinstance(images, Tensor) and images.dim() == 3)
        sequence: list[Any] = [images] if single else list(images)  # type: ignore[list-item]
        prepared = self._prepare_all(sequence, intrinsics, size)
        if not 0 < threshold < 1:
            raise input_error("threshold of the objectness", got=threshold, expected="a probability between 0 and 1")

        def detect(encoding: Encoding, logit: Tensor, group: list[int]) -> tuple[Tensor, Tensor, Tensor]:
            return self._detections(encoding, logit, threshold, iou_threshold)

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
    ) -> list[Observations]:
        """Posterior of the region responsible for each given box (px of the given image), in the order of the boxes.

        The responsible predictor is the one of the box's cell whose own box overlaps it most (method section 1).
        """
        if len(boxes) != len(images):
            raise input_error("boxes", got=f"{len(boxes)} lists", expected=f"one list for each of {len(images)} images")
        prepared = self._prepare_all(images, intrinsics, size)

        def responsible(encoding: Encoding, logit: Tensor, group: list[int]) -> tuple[Tensor, Tensor, Tensor]:
            scaled = [np.asarray(boxes[i], dtype=np.float64).reshape(-1, 4) * np.tile(prepared[i].scale, 2) for i in group]
            row = torch.repeat_interleave(torch.arange(len(group)), torch.tensor([len(part) for part in scaled]))
            region = self._responsible(encoding, row, torch.as_tensor(np.concatenate(scaled), dtype=logit.dtype))
            return row, region, logit[row, region]

        return self._observe(prepared, responsible, decode, samples, seed, batch)

    @torch.inference_mode()
    def encode(self, image: UInt8[Tensor, "b 3 h w"]) -> Encoding:
        """The network's forward pass over a batch of prepared images."""
        return self.model.guide.encode(image)

    @torch.inference_mode()
    def _observe(
        self,
        prepared: list[_Prepared],
        find: Callable[[Encoding, Tensor, list[int]], tuple[Tensor, Tensor, Tensor]],
        decode: bool,
        samples: int,
        seed: int,
        batch: int,
    ) -> list[Observations]:
        """Run batches of images of one shape; `find` gives row, region and log odds of what to answer for."""
        results: dict[int, Observations] = {}
        for group in _same_shape(prepared, batch):
            encoding = self.encode(torch.stack([prepared[i].image for i in group]))
            logit = self.calibration.objectness(encoding.objectness_logit)
            row, region, odds = find(encoding, logit, group)
            camera = torch.stack([prepared[i].camera for i in group])[row]
            scale = np.stack([prepared[i].scale for i in group])[row.numpy()]
            answer = self._answer(encoding, row, region, camera, scale, odds, decode, samples, seed)
            ends = np.searchsorted(row.numpy(), np.arange(len(group) + 1))
            for k, i in enumerate(group):
                results[i] = answer[slice(ends[k], ends[k + 1])]
        return [results[i] for i in range(len(prepared))]

    def _prepare_all(self, images: Sequence[Any], intrinsics: Any, size: int | None) -> list[_Prepared]:
        size = self.config.image_size if size is None else size
        if size <= 0 or size % 32:
            raise input_error("size of the scaled images", got=size, expected="a positive multiple of 32")
        return [self._prepare(image, _one_of(intrinsics, i, len(images)), size) for i, image in enumerate(images)]

    def _prepare(self, image: Any, intrinsics: Any, size: int) -> _Prepared:
        """Scale an image so that its longer side has the wanted size and both are multiples of 32."""
        if isinstance(image, Tensor):
            image = image.permute(1, 2, 0).numpy() if image.dim() == 3 else image.numpy()
        if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            got = (getattr(image, "shape", type(image).__name__), getattr(image, "dtype", ""))
            raise input_error("an image", got=got, expected="a uint8 array of shape (height, width, 3)")
        height, width = image.shape[:2]
        if min(height, width) < 8:
            raise input_error("an image", got=f"{width} x {height} px", expected="at least 8 x 8 px")
        if intrinsics is None:
            camera = guessed_intrinsics(image)
        else:
            camera = np.asarray(intrinsics, dtype=np.float64)
            if camera.shape != (4,) or not np.isfinite(camera).all() or (camera[:2] <= 0).any():
                raise input_error("intrinsics", got=intrinsics, expected="[fx, fy, cx, cy] in px with positive fx, fy")
        factor = size / max(height, width)
        new = [max(32, round(side * factor / 32) * 32) for side in (width, height)]
        if [width, height] != new:
            from PIL import Image as PillowImage

            image = np.asarray(PillowImage.fromarray(image).resize((new[0], new[1]), PillowImage.Resampling.BILINEAR))
        scale = np.array([new[0] / width, new[1] / height])
        tensor = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
        return _Prepared(tensor, torch.as_tensor(camera * np.tile(scale, 2), dtype=self._prior_mean.dtype), scale)

    def _parameters(self, encoding: Encoding, row: Int[Tensor, " n"], region: Int[Tensor, " n"]) -> RegionParameters:
        return self.calibration.apply(self.model.guide.parameters_at(encoding, row, region))

    def _detections(
        self, encoding: Encoding, logit: Tensor, threshold: float, iou_threshold: float
    ) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"], Float[Tensor, " n"]]:
        """Row, region and log odds of the objects above the threshold, best first in a row.

        Regions whose boxes overlap describe one object, for which exactly one of them is responsible: the probability
        that it is there is the sum of theirs. The most probable region answers for it.
        """
        least = min(threshold, CANDIDATE)
        row, region = (logit > math.log(least / (1 - least))).nonzero(as_tuple=True)
        if len(region) == 0:
            return row, region, logit.new_empty(0)
        q = self._parameters(encoding, row, region)
        box = decode_box(q.box_loc, region // self.config.predictors, encoding.columns, self.config)
        kept, stands_for = suppress(box, logit[row, region], iou_threshold, group=row)
        probability = torch.zeros(len(row), dtype=torch.float64)
        probability.index_add_(0, stands_for, torch.sigmoid(logit[row, region].double()))
        probability = probability.clamp(max=1 - 1e-6)
        kept = kept[probability[kept] > threshold]
        kept = kept[torch.argsort(probability[kept], descending=True, stable=True)]
        kept = kept[torch.argsort(row[kept], stable=True)]
        return row[kept], region[kept], torch.logit(probability[kept])

    def _responsible(
        self, encoding: Encoding, row: Int[Tensor, " n"], box: Float[Tensor, "n 4"]
    ) -> Int[Tensor, " n"]:
        p, columns = self.config.predictors, encoding.columns
        cell = cell_of(box, encoding.rows, columns, self.config.stride)
        region = (cell[:, None] * p + torch.arange(p)).flatten()
        q = self._parameters(encoding, row.repeat_interleave(p), region)
        own = decode_box(q.box_loc, region // p, columns, self.config).unflatten(0, (-1, p))
        return cell * p + box_iou(own, box[:, None]).argmax(-1)

    def _answer(
        self,
        encoding: Encoding,
        row: Int[Tensor, " n"],
        region: Int[Tensor, " n"],
        camera: Float[Tensor, "n 4"],
        scale: Float[np.ndarray, "n 2"],
        logit: Float[Tensor, " n"],
        decode: bool,
        samples: int,
        seed: int,
    ) -> Observations:
        """Everything the posterior of some regions says."""
        config = self.config
        q = self._parameters(encoding, row, region)
        box = decode_box(q.box_loc, region // config.predictors, encoding.columns, config)
        box_scale = q.box_scale * q.box_scale.new_tensor(config.box_spread)
        box_scale[:, :2] *= config.stride
        position, diagonal = decode_range(q.range_loc, box, camera, config)
        azimuth = VonMisesMixture(
            q.azimuth_logits, q.azimuth_natural, max_concentration=config.max_concentration, validate_args=False
        )  # fmt: skip
        # Sharp modes sit at a component's mean, a candidate of its own: a coarse grid finds the broad ones.
        viewpoint = torch.cat((azimuth.find_mode(grid=90)[:, None], q.angle_loc), -1)
        R = allocentric_to_egocentric(viewpoint_to_matrix(viewpoint), position)
        best = (azimuth.component_mean - viewpoint[:, :1]).cos().argmax(-1, keepdim=True)
        azimuth_variance = 1 / torch.gather(azimuth.concentration, -1, best)[:, 0].clamp_min(0.1)
        rotation_variance = (azimuth_variance + q.angle_scale.square().sum(-1)) / 3
        prior, half = self.model.story.prior, self.model.story.prior.category_dim
        squared = (q.shape_loc[:, None, :half] - self._prior_mean[:, :half]).square().sum(-1)
        instance_log_posterior = None
        if prior.instance is not None:
            kl = kl_to_each_component(q.shape_loc[:, half:], q.shape_scale[:, half:], prior.instance_mean())
            label = q.label_logits.argmax(-1)
            instance_log_posterior = torch.log_softmax(prior.instance_log_probability(label) - kl, -1).numpy()
        voxel_mean, voxel_variance, size = self._shape(q, diagonal, decode, samples, seed)
        return Observations(
            categories=config.categories,
            objectness=torch.sigmoid(logit.double()).numpy(),
            box=box.numpy() / np.tile(scale, 2),
            box_scale=np.concatenate((box_scale[:, :2].numpy() / scale, box_scale[:, 2:].numpy()), -1),
            class_log_posterior=torch.log_softmax(q.label_logits.double(), -1).numpy(),
            class_log_likelihood=(-0.5 * (squared + half * math.log(2 * math.pi))).numpy(),
            instance_log_posterior=instance_log_posterior,
            latent=q.shape_loc.numpy(),
            latent_scale=q.shape_scale.numpy(),
            position=position.double().numpy(),
            position_covariance=self._position_covariance(q, box, box_scale, position, camera).double().numpy(),
            viewpoint_modes=ViewpointModes(
                azimuth.weights.numpy(), azimuth.component_mean.numpy(), azimuth.concentration.numpy()
            ),
            elevation_inplane=q.angle_loc.numpy(),
            elevation_inplane_scale=q.angle_scale.numpy(),
            viewpoint=viewpoint.numpy(),
            R_camera_object=R.double().numpy(),
            rotation_scale=rotation_variance.sqrt().numpy(),
            diagonal=diagonal.numpy(),
            diagonal_log_scale=(q.range_scale[:, 3] * config.range_spread[3]).numpy(),
            size=size,
            voxel_mean=voxel_mean,
            voxel_variance=voxel_variance,
        )

    def _position_covariance(
        self, q: RegionParameters, box: Tensor, box_scale: Tensor, position: Tensor, camera: Tensor
    ) -> Float[Tensor, "n 3 3"]:
        """Covariance of the position to first order: along the ray from the range, across it from the centre's pixel.

        With slopes s = (x, y) / z and n^2 = 1 + |s|^2 the position is e^r f n^(1/2) (s, 1) (`decode_range`): a pixel turns
        the ray, and changes the range a little, for off the axis a radian covers more pixels.
        """
        unit, loc = (q.range_loc.new_tensor(v) for v in (self.config.range_spread, self.config.range_loc))
        spread, offset = q.range_scale * unit, q.range_loc * unit + loc
        extent = box[:, 2:] - box[:, :2]
        # the centre's pixel = the box's centre + offset * extent: three independent errors an axis
        relative = spread[:, 1:3].square() + (offset[:, 1:3] * box_scale[:, 2:]).square()
        pixel_variance = box_scale[:, :2].square() + extent.square() * relative
        along = position[:, :, None] * position[:, None, :] * spread[:, 0, None, None].square()
        depth = position[:, 2]
        across = torch.zeros_like(along)
        for axis in range(2):
            step = torch.zeros_like(position)
            step[:, axis] = depth / camera[:, axis]
            share = 0.5 * position[:, axis] * depth / position.square().sum(-1)  # s / (2 n^2)
            step = step + position * (share / camera[:, axis])[:, None]
            across = across + step[:, :, None] * step[:, None, :] * pixel_variance[:, axis, None, None]
        return along + across

    def _shape(
        self, q: RegionParameters, diagonal: Tensor, decode: bool, samples: int, seed: int
    ) -> tuple[Float[np.ndarray, "n v v v"] | None, Float[np.ndarray, "n v v v"] | None, Float[np.ndarray, "n 3"]]:
        """Mean and variance of the voxels over the shape latent, and metric extents."""
        n, d = q.shape_loc.shape
        if not decode:
            extents = self._category_extents()[q.label_logits.argmax(-1)]
            return None, None, extents * diagonal.numpy()[:, None]
        if samples < 2:
            raise input_error("samples of the shape latent", got=samples, expected="at least 2, for a variance")
        noise = np.random.default_rng(seed).standard_normal((samples, 1, d))  # shared: the same answer in any company
        latent = q.shape_loc + q.shape_scale * torch.as_tensor(noise, dtype=q.shape_loc.dtype)
        grid = (n,) + (self.config.voxel_size,) * 3
        mean, variance, size = np.empty(grid, np.float32), np.empty(grid, np.float32), np.empty((n, 3))
        latents, step = torch.cat((q.shape_loc[None], latent)), max(1, 64 // (samples + 1))
        for first in range(0, n, step):  # a few objects at a time: all samples of all objects would not fit the cache
            part = slice(first, first + step)
            chunk = latents[:, part]
            decoded = torch.sigmoid(self.model.story.decoder(chunk.flatten(0, 1))).unflatten(0, chunk.shape[:2])
            middle = decoded[1:].mean(0)
            squares = (decoded[1:] - middle).square_().sum(0)  # torch.var_mean takes 20 times as long here
            mean[part], variance[part] = middle.numpy(), (squares / (samples - 1)).numpy()
            size[part] = _extents(decoded[0].numpy()) * diagonal[part].numpy()[:, None]
        return mean, variance, size

    def _category_extents(self) -> Float[np.ndarray, "labels 3"]:
        """Extents, in diagonals, of each category's mean shape."""
        if not hasattr(self, "_extents_cache"):
            self._extents_cache = _extents(self.decode(self.prior_mean()))
        return self._extents_cache


def _extents(occupancy: Float[np.ndarray, "n v v v"]) -> Float[np.ndarray, "n 3"]:
    """Extents along x, y, z of occupied voxels in units of the grid's side, scaled to a diagonal of one."""
    n = occupancy.shape[1]
    result = np.empty((len(occupancy), 3))
    for i, grid in enumerate(occupancy > 0.5):
        for axis in range(3):
            used = np.flatnonzero(grid.any(axis=tuple({0, 1, 2} - {axis})))
            result[i, axis] = (used[-1] - used[0] + 1) / n if len(used) else 3**-0.5
    return result / np.linalg.norm(result, axis=1, keepdims=True)


def _one_of(intrinsics: Any, index: int, count: int) -> Any:
    """Intrinsics of one image, given for all at once or one an image."""
    if intrinsics is None:
        return None
    values = np.asarray(intrinsics, dtype=np.float64)
    if values.ndim == 1:
        return values
    if len(values) != count:
        raise input_error("intrinsics", got=f"{len(values)} rows", expected=f"one for all or one for each of {count} images")
    return values[index]


def _same_shape(prepared: list[_Prepared], batch: int) -> list[list[int]]:
    """Groups of at most `batch` images of one shape, in order."""
    groups: dict[tuple[int, ...], list[list[int]]] = {}
    for i, one in enumerate(prepared):
        of_shape = groups.setdefault(tuple(one.image.shape), [[]])
        if len(of_shape[-1]) == batch:
            of_shape.append([])
        of_shape[-1].append(i)
    return [group for of_shape in groups.values() for group in of_shape]


