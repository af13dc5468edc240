"""What sets each of the compared methods apart: what holds its latent, and how images are tied to shapes (NOLBO, experiments).

All share image encoder, detection heads, decoder and 3D encoder. A method is one row of the table below:

| method | prior of the latent | image's latent | tied to the shape by | categories | viewpoint |
|---|---|---|---|---|---|
| `nolbo` | N(mu_psi(l), I) | a distribution | the shape's own posterior | yes | yes |
| `single` | the same, on crops of one object | a distribution | the same | yes | yes |
| `ae` | none | a point | decoding it to the true voxels | no | no |
| `vvae` | N(0, I) | a distribution | the same | no | no |
| `tlnet` | none | a point | regression onto the shape autoencoder's latent | no | no |
| `vaegan` | N(0, I), and a discriminator of shapes | a distribution | decoding it to the true voxels | no | no |

The paper does not say whether its baselines know categories and viewpoints. As published they do not: the 2D-3D autoencoder, the
TL-network (Girdhar et al. 2016) and the 3D-VAE-GAN (Wu et al. 2016) give a latent and a shape in its canonical pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

MethodName = Literal["nolbo", "single", "ae", "vvae", "tlnet", "vaegan"]


@dataclass(frozen=True)
class Method:
    """One of the compared methods."""

    title: str
    """What tables call it."""
    label_prior: bool
    """The latent's prior is a Gaussian about its label's mean; else about zero."""
    point: bool
    """The latent of an image, and of a shape, is a point: its sample is its mean, its scale one unit."""
    decoded: bool
    """Images learn through the decoder, which learns along; else their latent is drawn to that of the true shape."""
    describes: bool
    """Says category and viewpoint of an object."""
    one_object: bool = False
    """Sees crops of one object each, whose boxes another detector gives."""
    joint: bool = False
    """Ends with a phase in which the shape autoencoder learns along."""
    adversary: bool = False
    """A discriminator tells decoded samples of the prior from true shapes."""


METHODS: dict[MethodName, Method] = {
    "nolbo": Method("NOLBOMulti", label_prior=True, point=False, decoded=False, describes=True),
    "single": Method("NOLBOSingle", label_prior=True, point=False, decoded=False, describes=True, one_object=True),
    "ae": Method("AE", label_prior=False, point=True, decoded=True, describes=False),
    "vvae": Method("vVAE", label_prior=False, point=False, decoded=True, describes=False),
    "tlnet": Method("TLNet", label_prior=False, point=True, decoded=False, describes=False, joint=True),
    "vaegan": Method("3D-VAE-GAN", label_prior=False, point=False, decoded=True, describes=False, adversary=True),
}
"""Every method by the name that options use."""
