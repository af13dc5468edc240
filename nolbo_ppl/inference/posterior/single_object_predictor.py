"""Queries on NOLBO for single objects: another detector finds them, each is looked at by itself (NOLBOSingle of the paper)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nolbo_ppl.devices import device_of
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.boxes import boxes_in_image
from nolbo_ppl.inference.posterior.decode import SelectedRegions, assemble
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.posterior.preprocess import Image, guessed_intrinsics, intrinsics_of
from nolbo_ppl.models.baselines.single_object import crop_objects
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors, ViewpointModes


class SingleObjectModel(ObservationModel):
    """A model trained on crops, with the detector whose boxes it is shown.

    Args:
        model: the networks.
        calibration: factors on the guide's posterior.
        detector: gives boxes and objectness of whole images.
    """

    def __init__(self, model: Nolbo, calibration: Calibration | None, detector: ObservationModel) -> None:
        super().__init__(model, calibration)
        self.detector = detector

    def to(self, device: str | torch.device) -> SingleObjectModel:
        """The same model, and its detector, on a device; see `ObservationModel.to`."""
        target = device_of(device)
        return SingleObjectModel(self.model.to(target), self.calibration, self.detector.to(target))

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
        """As `ObservationModel.observe`; boxes and objectness are the detector's, `size` is the side its images are scaled to."""
        single = (isinstance(images, np.ndarray) and images.ndim == 3) or (isinstance(images, Tensor) and images.dim() == 3)
        sequence: list[Any] = [images] if single else list(images)  # type: ignore[list-item]
        found = self.detector.observe(
            sequence, intrinsics, threshold=threshold, iou_threshold=iou_threshold, size=size, decode=False, batch=batch
        )
        boxes, objectness = [one.box for one in found], [one.objectness for one in found]
        results = self._look(sequence, intrinsics, boxes, objectness, decode, samples, seed, batch)
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
        """As `ObservationModel.observe_boxes`; what is given is taken to be an object. `size` is without use: crops have one."""
        if len(boxes) != len(images):
            raise input_error("boxes", got=f"{len(boxes)} lists", expected=f"one list for each of {len(images)} images")
        checked = [boxes_in_image(given, _shape(image)[::-1], i) for i, (image, given) in enumerate(zip(images, boxes))]
        certain = [np.ones(len(given)) for given in checked]
        return self._look(images, intrinsics, checked, certain, decode, samples, seed, batch)

    @torch.inference_mode()
    def _look(
        self,
        images: Sequence[Any],
        intrinsics: Any,
        boxes: Sequence[Float[np.ndarray, "n 4"]],
        objectness: Sequence[Float[np.ndarray, " n"]],
        decode: bool,
        samples: int,
        seed: int,
        batch: int,
    ) -> list[ObjectPosteriors]:
        """Posterior of each box, from its crop."""
        results = []
        dtype, side = self._prior_mean.dtype, self.config.image_size
        for i, (image, given, certainty) in enumerate(zip(images, boxes, objectness)):
            pixels = (
                image.cpu() if isinstance(image, Tensor) else torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
            )
            camera = intrinsics_of(intrinsics, i, len(images))
            camera = guessed_intrinsics(pixels.permute(1, 2, 0).numpy()) if camera is None else camera
            box = torch.as_tensor(np.asarray(given).reshape(-1, 4), dtype=dtype)
            row = torch.zeros(len(box), dtype=torch.long, device="cpu")
            crops = crop_objects(pixels[None].to(dtype), row, box, side)
            parts = []
            for first in range(0, max(len(box), 1), 4 * batch):
                part = slice(first, first + 4 * batch)
                rows = torch.arange(len(box[part]), device="cpu")
                encoding = self.encode(crops.image[part] if len(box) else pixels.new_zeros((1, 3, side, side)))
                local = crops.into(box)[part]
                at = self.device
                region = self._networks.guide.responsible_region(encoding, rows.to(at), local.to(at)).cpu()
                cameras = crops.camera(torch.as_tensor(camera, dtype=dtype).expand(len(box), 4))[part]
                probability = torch.as_tensor(np.asarray(certainty), dtype=torch.float64)[part].clamp_min(1e-6)
                probability = self.calibration.limited(probability)
                selected = SelectedRegions(
                    self._parameters(encoding, rows, region, local),
                    region,
                    encoding.columns,
                    torch.logit(probability),
                    cameras,
                    np.ones((len(rows), 2)),
                )
                shapes = self._shapes(decode, samples, seed)
                parts.append(assemble(selected, self.config, self._prior, self._prior_mean, shapes))
            answer = _joined(parts)
            back = crops.back(torch.as_tensor(answer.box, dtype=dtype)).numpy()
            scale = answer.box_scale / np.concatenate([crops.factor.numpy()[:, None].repeat(2, 1), np.ones((len(back), 2))], 1)
            results.append(dataclasses.replace(answer, box=back, box_scale=scale))
        return results


def _shape(image: Any) -> tuple[int, int]:
    """Height and width."""
    height, width = image.shape[-2:] if isinstance(image, Tensor) else image.shape[:2]
    return int(height), int(width)


def _joined(parts: Sequence[ObjectPosteriors]) -> ObjectPosteriors:
    """Posteriors of objects of one image, one part after the other."""
    if len(parts) == 1:
        return parts[0]
    joined: dict[str, Any] = {}
    for field in dataclasses.fields(ObjectPosteriors):
        values = [getattr(part, field.name) for part in parts]
        if isinstance(values[0], np.ndarray):
            joined[field.name] = np.concatenate(values)
        elif isinstance(values[0], ViewpointModes):
            names = [inner.name for inner in dataclasses.fields(ViewpointModes)]
            joined[field.name] = ViewpointModes(*(np.concatenate([getattr(v, n) for v in values]) for n in names))
        else:
            joined[field.name] = values[0]
    return ObjectPosteriors(**joined)
