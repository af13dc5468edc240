"""Shapes of landmarks: posterior latents decoded to voxels, with the variance the latent's uncertainty leaves to each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.landmarks import Voxels
from nolbo_ppl.io.landmarks import write_voxels as write_voxels
from nolbo_ppl.structures.landmark import Landmark


class LatentDecoder(Protocol):
    """What decoding needs of a model (`nolbo_ppl.ObservationModel`)."""

    def decode(self, latent: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n v v v"]:
        """Occupancy probabilities of latents; raises InputError when their dimension is not the model's."""


def decode_landmarks(
    landmarks: Sequence[Landmark], model: LatentDecoder, *, samples: int = 8, seed: int = 0
) -> dict[str, Voxels]:
    """Mean and variance of each voxel's occupancy probability over samples of each landmark's latent, by landmark name.

    Landmarks without a latent are left out. All landmarks share the same draws, so that a landmark's answer does not
    depend on the others.

    Args:
        landmarks: the map.
        model: decodes latents.
        samples: samples of each latent, at least 2.
        seed: seed of those samples.

    Raises:
        InputError: fewer than 2 samples, or latents that do not have the model's dimension.
    """
    if samples < 2:
        raise input_error("samples of the landmarks' latents", got=samples, expected="at least 2, for a variance")
    out: dict[str, Voxels] = {}
    for landmark in landmarks:
        if landmark.latent is None or landmark.latent_variance is None:
            continue
        noise = np.random.default_rng(seed).standard_normal((samples, len(landmark.latent)))
        occupancy = model.decode(landmark.latent + np.sqrt(landmark.latent_variance) * noise)
        out[landmark.name] = occupancy.mean(axis=0), occupancy.var(axis=0, ddof=1)
    return out
