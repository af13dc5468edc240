"""A batch of scenes as the guide observed it: what both the generative model and the guide are run on.

The generative model reads labels and responsible regions alone; encoding and posterior are the guide's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nolbo_ppl.models.scene_batch import Assignment, SceneBatch


@dataclass(frozen=True)
class Detail:
    """The images of a batch once more, larger than the network sees them whole: objects are cut out of these."""

    image: UInt8[Tensor, "b 3 h w"]
    factor: Float[Tensor, " b"]
    """Its pixels over those of the image that the network sees."""


@dataclass
class Encoding:
    """What the encoder made of a batch of images."""

    features: Float[Tensor, "b cells c"]
    """Features of each cell."""
    objectness_logit: Float[Tensor, "b k"]
    """Log odds of q(o | I) of every region; region = cell * predictors + predictor."""
    rows: int
    columns: int
    fine: tuple[Float[Tensor, "b _ _ _"], ...] = ()
    """Finer maps of the encoder, for the RoI refinement of each object."""
    shift: Float[Tensor, " b"] | None = None
    """How unlike the images learnt from each is (`nolbo_ppl.models.image_shift`); None where the guide cannot tell."""
    generated: Float[Tensor, " b"] | None = None
    """Probability that each is a generated scene; None where the guide cannot tell."""
    levels: tuple[Float[Tensor, "b 3 _ _"], ...] = ()
    """The normalised images at falling sizes, for looks at objects cut out of them; empty where the guide takes none."""
    detail: Float[Tensor, " b"] | None = None
    """Pixels of the largest of `levels` over those of each image; None: they are the same."""


@dataclass
class RegionParameters:
    """Parameters of q(. | I) of regions, any batch shape; latent units where not said otherwise."""

    label_logits: Float[Tensor, "*n labels"]
    """Log probabilities, up to a constant, of the category."""
    shape_loc: Float[Tensor, "*n d"]
    """Mean of the shape latent."""
    shape_scale: Float[Tensor, "*n d"]
    """Scale of the shape latent."""
    azimuth_logits: Float[Tensor, "*n modes"]
    """Log weights, up to a constant, of the azimuth's modes."""
    azimuth_natural: Float[Tensor, "*n modes 2"]
    """Natural parameters kappa (cos, sin) of each mode."""
    angle_loc: Float[Tensor, "*n 2"]
    """Mean elevation and in-plane rotation, rad."""
    angle_scale: Float[Tensor, "*n 2"]
    """Their scales, rad."""
    box_loc: Float[Tensor, "*n 4"]
    """Mean of the box latent."""
    box_scale: Float[Tensor, "*n 4"]
    """Scale of the box latent."""
    range_loc: Float[Tensor, "*n 4"]
    """Mean of the range latent."""
    range_scale: Float[Tensor, "*n 4"]
    """Scale of the range latent."""

    def at_map_category(self, prior_mean: Float[Tensor, "labels d"]) -> RegionParameters:
        """The same with the shape latent's mean where the likeliest category puts it.

        The guide's one Gaussian lies between categories it hesitates about (`RegionHead.parameters_of`), where no shape is:
        its mean there decodes to neither. Answers take the mean of the likeliest category's part; the scale, which spans
        them all, stays.

        Args:
            prior_mean: mean latent of each category.
        """
        probability = torch.softmax(self.label_logits, -1)
        likeliest = torch.nn.functional.one_hot(probability.argmax(-1), probability.shape[-1])
        shift = (likeliest - probability) @ prior_mean.to(probability.dtype)
        return dataclasses.replace(self, shape_loc=self.shape_loc + shift)

    def with_mirrored(self, mirrored: RegionParameters) -> RegionParameters:
        """The same with the azimuth's posterior averaged with what the mirror image of each region says of it."""
        logits = torch.cat((torch.log_softmax(self.azimuth_logits, -1), torch.log_softmax(mirrored.azimuth_logits, -1)), -1)
        turned = mirrored.azimuth_natural * mirrored.azimuth_natural.new_tensor([1.0, -1.0])
        natural = torch.cat((self.azimuth_natural, turned), -2)
        return dataclasses.replace(self, azimuth_logits=logits, azimuth_natural=natural)

    def widened(self, factor: Float[Tensor, "*n"]) -> RegionParameters:
        """The same with every scale this many times as large, categories as much less certain."""
        by = factor[..., None]
        return dataclasses.replace(
            self,
            label_logits=self.label_logits / by,
            shape_scale=self.shape_scale * by,
            azimuth_natural=self.azimuth_natural / by[..., None] ** 2,
            angle_scale=self.angle_scale * by,
            box_scale=self.box_scale * by,
            range_scale=self.range_scale * by,
        )

    @classmethod
    def concatenate(cls, parts: Sequence[RegionParameters]) -> RegionParameters:
        """Regions of several batches, one after the other."""
        names = [field.name for field in dataclasses.fields(cls)]
        return cls(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})

    def map(self, function: Callable[[Tensor], Tensor]) -> RegionParameters:
        """Apply a function to every tensor."""
        return RegionParameters(**{f.name: function(getattr(self, f.name)) for f in dataclasses.fields(self)})


@dataclass
class ObservedScene:
    """A batch with its encoding, its responsible regions and their posterior: what generative model and guide are run on."""

    batch: SceneBatch
    encoding: Encoding
    assignment: Assignment
    posterior: RegionParameters

    @property
    def left_out(self) -> Bool[Tensor, "b m"]:
        """Objects that no region is responsible for: their cell has more objects than predictors."""
        return self.batch.present & ~self.assignment.assigned
