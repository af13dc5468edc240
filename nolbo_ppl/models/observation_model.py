"""The whole observation model: story, guide and shape guide under one roof, with one state dictionary."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import nn

from nolbo_ppl.models.baselines.adversary import Discriminator
from nolbo_ppl.models.generative import GenerativeModel
from nolbo_ppl.models.guide import Guide
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.shape_vae import ShapeGenerativeModel, ShapeGuide


class Nolbo(nn.Module):
    """Story (prior networks, decoder), image guide (encoder, head) and shape guide (3D encoder)."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.story = GenerativeModel(config)
        self.guide = HybridGuide(config, self.story.prior) if config.detector else Guide(config, self.story.prior)
        self.shape_guide = ShapeGuide(config)
        self.discriminator = Discriminator(config) if config.description.adversary else None

    def set_half_precision(self, enabled: bool) -> None:
        """Run the networks' convolutions and dense layers in bfloat16 (weights, latents and the bound stay as they are)."""
        for part in (self.guide, self.story.decoder, self.shape_guide.encoder):
            part.half_precision = enabled

    @property
    def shape_model(self) -> ShapeGenerativeModel:
        """The story of shapes alone, sharing prior and decoder."""
        return ShapeGenerativeModel(self.story)

    @classmethod
    def from_seed(cls, config: ModelConfig, seed: int) -> Nolbo:
        """Freshly initialised networks that depend on the seed only; torch's global generator is left as it was."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return cls(config)


@contextmanager
def evaluation_mode(model: nn.Module) -> Iterator[None]:
    """Networks in evaluation mode for a while; afterwards each part is in the mode it was in, frozen ones in evaluation mode."""
    training = [module for module in model.modules() if module.training]
    model.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True
