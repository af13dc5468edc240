"""Classifiers that the paper's encoder core is trained as before it observes anything: pictures by class, objects by viewpoint.

NOLBO pre-trains darknet19's core on ImageNet (classes) and on Render for CNN (viewpoints), one after the other; the heads are
thrown away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from nolbo_ppl.devices import mixed_precision
from nolbo_ppl.models.backbones import Darknet19Encoder, normalise_image
from nolbo_ppl.models.layers import OutputLinear

BINS = (360, 181, 360)
"""One-degree bins of azimuth, elevation (-90 to 90) and in-plane rotation."""
SMOOTH_DEGREES = 3.0
"""How fast the wanted probability of a bin falls with its distance from the true one (Render for CNN, equation 1)."""


@dataclass
class PictureBatch:
    """Pictures of one object each, with the label or the viewpoint that is learnt."""

    image: UInt8[Tensor, "b 3 h w"]
    """Colours 0..255."""
    label: Int[Tensor, " b"]
    """Number of the class or category."""
    viewpoint: Float[Tensor, "b 3"] | None = None
    """Azimuth, elevation and in-plane rotation, rad."""


class PictureClassifier(nn.Module):
    """darknet19's core with the head of one task over the mean of its features.

    Args:
        labels: classes, or categories with viewpoints of their own.
        viewpoints: learn viewpoints, else classes.
        width: factor on the channels of the core.
    """

    def __init__(self, labels: int, viewpoints: bool = False, width: float = 1.0) -> None:
        super().__init__()
        encoder = Darknet19Encoder(width)
        self.core, self.labels, self.viewpoints, self.width = encoder.core, labels, viewpoints, width
        self.head = OutputLinear(encoder.channels, labels * (sum(BINS) if viewpoints else 1))
        self.half_precision = False

    def forward(self, batch: PictureBatch) -> Float[Tensor, "b outputs"]:
        """Log odds of the classes; with viewpoints those of the bins of each picture's own category."""
        dtype = self.head.weight.dtype
        image = normalise_image(batch.image, dtype).contiguous(memory_format=torch.channels_last)
        with mixed_precision(image.device, self.half_precision):
            features = self.core(image).mean((2, 3))
            outputs = self.head(features)
        outputs = outputs.to(dtype)
        if not self.viewpoints:
            return outputs
        own = batch.label[:, None, None].expand(-1, 1, sum(BINS))
        return outputs.unflatten(-1, (self.labels, sum(BINS))).gather(1, own)[:, 0]


def bin_centres(bins: int, device: torch.device, dtype: torch.dtype) -> Float[Tensor, " {bins}"]:
    """Angle of each bin, rad: round the circle, or from -90 to 90 degrees."""
    degrees = torch.arange(bins, device=device, dtype=dtype)
    return torch.deg2rad(degrees - (90 if bins == BINS[1] else 0))


def bin_targets(angle: Float[Tensor, " b"], bins: int) -> Float[Tensor, "b {bins}"]:
    """Wanted probability of each bin: falls exponentially with the distance from the true angle, round the circle for turns."""
    away = bin_centres(bins, angle.device, angle.dtype) - angle[:, None]
    if bins != BINS[1]:
        away = torch.remainder(away + math.pi, 2 * math.pi) - math.pi
    return torch.softmax(-away.abs() / math.radians(SMOOTH_DEGREES), -1)


def classification_terms(model: PictureClassifier, outputs: Float[Tensor, "b outputs"], batch: PictureBatch) -> dict[str, Tensor]:
    """Log likelihoods by name, nats summed over the batch: `class`, or `azimuth`, `elevation`, `in_plane`."""
    if not model.viewpoints:
        return {"class": -nn.functional.cross_entropy(outputs, batch.label, reduction="sum")}
    assert batch.viewpoint is not None
    terms = {}
    for name, logits, angle, bins in zip(
        ("azimuth", "elevation", "in_plane"), outputs.split(BINS, -1), batch.viewpoint.to(outputs).unbind(-1), BINS
    ):
        terms[name] = (bin_targets(angle, bins) * torch.log_softmax(logits, -1)).sum()
    return terms


def predicted_viewpoint(outputs: Float[Tensor, "b outputs"]) -> Float[Tensor, "b 3"]:
    """The likeliest bin of each angle, rad."""
    parts = outputs.split(BINS, -1)
    centres = [bin_centres(bins, outputs.device, outputs.dtype) for bins in BINS]
    return torch.stack([centre[part.argmax(-1)] for centre, part in zip(centres, parts)], -1)
