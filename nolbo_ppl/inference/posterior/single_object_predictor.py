"""Queries on NOLBO for single objects: another detector finds them, each is looked at by itself (NOLBOSingle of the paper)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from nolbo_ppl.devices import device_of
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.boxes import boxes_in_image
from nolbo_ppl.inference.posterior.decode import SelectedRegions, assemble
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.posterior.preprocess import Image, as_sequence, checked, intrinsics_of
from nolbo_ppl.models.baselines.single_object import crop_objects
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.observed_scene import RegionParameters
from nolbo_ppl.models.posterior_calibration import CERTAIN, Calibration
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors


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
        sequence, single = as_sequence(images)
        found = self.detector.observe(
            sequence, intrinsics, threshold=threshold, iou_threshold=iou_threshold, size=size, decode=False, batch=batch
        )
        boxes, objectness = [one.box for one in found], [one.objectness for one in found]
        results = self._look(_checked_all(sequence, intrinsics), boxes, objectness, decode, samples, seed, batch)
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
        seen = _checked_all(images, intrinsics)
        inside = [boxes_in_image(given, image.shape[1::-1], i) for i, ((image, _), given) in enumerate(zip(seen, boxes))]
        certain = [np.full(len(given), CERTAIN) for given in inside]
        return self._look(seen, inside, certain, decode, samples, seed, batch)

    @torch.inference_mode()
    def _look(
        self,
        seen: Sequence[tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, " 4"]]],
        boxes: Sequence[Float[np.ndarray, "n 4"]],
        objectness: Sequence[Float[np.ndarray, " n"]],
        decode: bool,
        samples: int,
        seed: int,
        batch: int,
    ) -> list[ObjectPosteriors]:
        """Posterior of each box, from its crop; `seen` are images with their intrinsics, px."""
        results = []
        dtype, side, at = self._prior_mean.dtype, self.config.image_size, self.device
        networks = self._networks.current()
        shapes = self._shapes(networks, decode, samples, seed)
        for (image, camera), given, certainty in zip(seen, boxes, objectness):
            pixels = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
            box = torch.as_tensor(np.asarray(given).reshape(-1, 4), dtype=dtype)
            row = torch.zeros(len(box), dtype=torch.long, device="cpu")
            crops = crop_objects(pixels[None].to(dtype), row, box, side)
            local, found, numbers = crops.into(box), [], []
            for first in range(0, max(len(box), 1), 4 * batch):
                part = slice(first, first + 4 * batch)
                rows = torch.arange(len(box[part]), device="cpu")
                encoding = self.encode(crops.image[part] if len(box) else pixels.new_zeros((1, 3, side, side)), networks=networks)
                numbers.append(networks.guide.responsible_region(encoding, rows.to(at), local[part].to(at)).cpu())
                found.append(self._parameters(networks, encoding, rows, numbers[-1], local[part]))
            regions = SelectedRegions(
                RegionParameters.concatenate(found),
                torch.cat(numbers),
                encoding.columns,
                torch.logit(torch.as_tensor(certainty, dtype=torch.float64)),
                crops.camera(torch.as_tensor(camera, dtype=dtype).expand(len(box), 4)),
                np.ones((len(box), 2)),
            )
            answer = assemble(regions, self.config, self._prior, self._prior_mean, shapes)
            back = crops.back(torch.as_tensor(answer.box, dtype=dtype)).numpy()
            scale = answer.box_scale / np.concatenate([crops.factor.numpy()[:, None].repeat(2, 1), np.ones((len(back), 2))], 1)
            tails = self.calibration.stated_tails
            results.append(dataclasses.replace(answer, box=back, box_scale=scale, position_tails=tails))
        return results


def _checked_all(images: Sequence[Any], intrinsics: Any) -> list[tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, " 4"]]]:
    """Images as arrays with their intrinsics, px; see `nolbo_ppl.inference.posterior.preprocess.checked`."""
    return [checked(image, intrinsics_of(intrinsics, i, len(images))) for i, image in enumerate(images)]
