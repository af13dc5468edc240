"""p_psi(z | l): a Gaussian mixture over labels whose means are prior networks, one for categories, one for instances."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.models.shape_networks import PriorNetwork, StandardPrior


class LabelPrior(nn.Module):
    """Prior networks of the category half and, with instance labels, of the instance half of the shape latent.

    An object of no known instance belongs to the extra instance "novel", the last one, whose mean is zero; within a
    category its n instances and "novel" have probability 1 / (n + 1) each.
    """

    instance_category: Tensor

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.category_dim, self.instance_dim = config.category_dim, config.instance_dim
        self.labels = len(config.categories)
        self.category: PriorNetwork | StandardPrior = (
            PriorNetwork(self.labels, self.category_dim, config.prior_width)
            if config.description.label_prior
            else StandardPrior(self.labels, self.category_dim)
        )
        self.instance = PriorNetwork(len(config.instances), self.instance_dim, config.prior_width) if config.instances else None
        self.register_buffer("instance_category", torch.tensor(config.instance_category, dtype=torch.long), persistent=False)

    def category_mean(self) -> Float[Tensor, "labels dc"]:
        """Means of the category half."""
        return self.category()

    def instance_mean(self) -> Float[Tensor, "instances di"]:
        """Means of the instance half, "novel" last."""
        assert self.instance is not None
        mean = self.instance()
        return torch.cat((mean, torch.zeros_like(mean[:1])))

    def label_mean(self) -> Float[Tensor, "labels d"]:
        """Prior mean of the whole latent by category; the instance half of an unknown instance is zero."""
        mean = self.category_mean()
        return torch.cat((mean, mean.new_zeros(self.labels, self.instance_dim)), -1) if self.instance_dim else mean

    def complete(self, batch: SceneBatch) -> SceneBatch:
        """A known instance tells its category where that is missing."""
        if self.instance is None:
            return batch
        told = self.instance_category[batch.instance.clamp_min(0)]
        return batch.replace(category=torch.where((batch.category < 0) & (batch.instance >= 0), told, batch.category))

    def instance_log_probability(self, label: Int[Tensor, "*n"]) -> Float[Tensor, "*n instances"]:
        """log p(i | l), "novel" last."""
        belongs = self.instance_category == label[..., None]
        log_p = -torch.log1p(belongs.sum(-1, keepdim=True).to(torch.get_default_dtype()))
        own = torch.where(belongs, log_p, log_p.new_tensor(-math.inf))
        return torch.cat((own, log_p), -1)
