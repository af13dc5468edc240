"""Networks grown into larger ones that start as what they were, so that what was learnt is kept.

New residual blocks start as the identity (their last normalisation multiplies by zero; in the encoder the activation after
the sum is applied once more, which shrinks what was negative), new inputs of the RoI refinement start at weight zero.
"""

from __future__ import annotations

import dataclasses
import re

import torch
from torch import Tensor

from nolbo_ppl.errors import input_error
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observation_model import Nolbo

GROWING = ("encoder_blocks", "glimpse_maps", "glimpse_blocks", "glimpse_detail")
"""Fields of the configuration that may grow."""


def grown_config(config: ModelConfig, larger: ModelConfig) -> ModelConfig:
    """A configuration with the growing fields of a larger one, everything else as it is.

    Raises:
        InputError: one of those fields is smaller in `larger`, or there is no RoI refinement to grow.
    """
    if not config.glimpse:
        raise input_error("networks to grow", got="no RoI refinement", expected="networks with one")
    for name in GROWING:
        before, after = getattr(config, name), getattr(larger, name)
        pairs = zip(before, after, strict=True) if isinstance(before, tuple) else [(before, after)]
        if any(a < b for b, a in pairs):
            raise input_error(f"{name} of networks to grow", got=after, expected=f"at least {before}")
    return dataclasses.replace(config, **{name: getattr(larger, name) for name in GROWING})


@torch.no_grad()
def grow(model: Nolbo, config: ModelConfig, seed: int) -> Nolbo:
    """Networks of a configuration from `grown_config` that compute what the given ones do.

    Args:
        model: the networks to start from.
        config: the larger configuration.
        seed: of the first weights of new blocks, whose output is multiplied by zero.
    """
    larger = Nolbo.from_seed(config, seed).to(next(model.parameters()).dtype)
    state, old = larger.state_dict(), model.state_dict()
    renamed = {_renamed(name, model.config, config): value for name, value in old.items()}
    for name in state:
        if name in renamed:
            state[name] = _widened(renamed[name], state[name])
        elif name.endswith("glimpse.detail.weight") or re.search(r"encoder\.(stem|middle|deep)\.\d+\.norm\.weight$", name):
            state[name] = torch.zeros_like(state[name])
    larger.load_state_dict(state)
    return larger


def _renamed(name: str, before: ModelConfig, after: ModelConfig) -> str:
    """Name of a weight among the larger networks: new blocks of the RoI refinement stand before its last convolution."""
    shift = after.glimpse_blocks - before.glimpse_blocks
    match = re.fullmatch(r"(.*glimpse\.look\.)(\d+)(\..*)", name)
    if match is None or int(match[2]) < 3 + before.glimpse_blocks:
        return name
    return f"{match[1]}{int(match[2]) + shift}{match[3]}"


def _widened(value: Tensor, like: Tensor) -> Tensor:
    """A weight with zeros for the inputs it did not have."""
    if value.shape == like.shape:
        return value.clone()
    wide = torch.zeros_like(like)
    wide[tuple(slice(0, n) for n in value.shape)] = value
    return wide
