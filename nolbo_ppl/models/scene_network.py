"""The network that knows generated scenes, beside the detector of a guide of photographs: what `tiny` says of a whole image.

It stays as it was learnt. The guide's own encoder looks at objects that are cut out, one size and one object at a time;
trained for that, it forgets where objects are: the same evidence of its features found 0.015 of full scenes (average precision),
that of the network as it was 0.70.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nolbo_ppl.models.backbones import make_encoder
from nolbo_ppl.models.head import RegionHead
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.scene_batch import decode_box

PREFIX = "guide.scene."
"""What the names of its weights begin with."""


@dataclass
class ScenePredictions:
    """What the network says of every predictor of each cell of a batch of images."""

    log_odds: Float[Tensor, "b k"]
    """That there is an object."""
    labels: Float[Tensor, "b k l"]
    """Log probability of each category."""
    box: Float[Tensor, "b k 4"]
    """[x0, y0, x1, y1], px of the image that the network saw."""
    features: Float[Tensor, "b c"]
    """Mean features of each image."""


class SceneNetwork(nn.Module):
    """Encoder and head without RoI refinement, for evidence about whole images; never trained."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = dataclasses.replace(config, glimpse=0, detector="")
        self.encoder = make_encoder(self.config)
        self.head = RegionHead(self.encoder.channels, self.config)

    def train(self, mode: bool = True) -> SceneNetwork:
        """Always evaluation mode."""
        return super().train(False)

    @torch.no_grad()
    def forward(self, image: Float[Tensor, "b 3 h w"]) -> ScenePredictions:
        """Predictions for normalised images, sides multiples of the stride."""
        dtype = self.head.objectness.weight.dtype
        maps, _ = self.encoder(image.contiguous(memory_format=torch.channels_last))
        features = maps.flatten(2).transpose(1, 2)
        raw, logit = self.head(features).to(dtype), self.head.objectness(features).to(dtype)
        cell = torch.arange(raw.shape[1], device=raw.device)[:, None].expand(-1, self.config.predictors)
        return ScenePredictions(
            logit.flatten(1),
            torch.log_softmax(raw[..., : self.head.sizes[0]], -1).flatten(1, 2),
            decode_box(self.head.box_latent(raw), cell, maps.shape[3], self.config).flatten(1, 2),
            features.mean(1).to(dtype),
        )


def scene_weights_of(state: dict[str, Tensor], own: list[str]) -> dict[str, Tensor]:
    """The scene network's weights from those of a guide that looks at whole images with its own encoder and head.

    Args:
        state: weights of the other model, by name.
        own: names of the model's weights.
    """
    others = {name: name.replace(PREFIX, "guide.", 1) for name in own if name.startswith(PREFIX)}
    return {name: state[other] for name, other in others.items() if other in state}
