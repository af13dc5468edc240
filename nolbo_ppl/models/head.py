"""The head of the guide: features of a cell -> parameters of the posterior of each of its predictors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nolbo_ppl.models.layers import OutputLinear
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observed_scene import RegionParameters
from nolbo_ppl.models.roi_refinement import RoiRefinement
from nolbo_ppl.models.scene_batch import decode_box, encode_box
from nolbo_ppl.models.shape_networks import bounded_exp


class RegionHead(nn.Module):
    """Features -> objectness of every region, and the raw outputs of the regions that are asked for.

    The small encoder has a hidden part (two layers with layer norm) and a RoI refinement by the object's box, run only where
    they are wanted: a scene has far more cells than objects. darknet19 has the paper's linear 1 x 1 head without bias.
    """

    def __init__(
        self, channels: int, config: ModelConfig, fine_channels: Sequence[int] = (), fine_strides: Sequence[int] = ()
    ) -> None:
        super().__init__()
        self.config = config
        d, modes = config.latent_dim, config.azimuth_components
        self.sizes = (len(config.categories), 2 * d, 3 * modes, 4, 8, 8)
        outputs = config.predictors * sum(self.sizes)
        linear = config.encoder == "darknet19"
        self.objectness = OutputLinear(channels, config.predictors, bias=not linear)
        width = config.head_width
        if linear:
            self.outputs: nn.Module = OutputLinear(channels, outputs, bias=False)
        else:
            last = OutputLinear(width, outputs)
            self.outputs = nn.Sequential(
                nn.Linear(channels, width),
                nn.LayerNorm(width),
                nn.GELU(),
                nn.Linear(width, width),
                nn.LayerNorm(width),
                nn.GELU(),
                last,
            )
            nn.init.constant_(self.objectness.bias, -4.0)
            nn.init.normal_(last.weight, std=0.02)
        self.glimpse: RoiRefinement | None = None
        if config.glimpse:
            self.glimpse = RoiRefinement(fine_channels, fine_strides, sum(self.sizes) - self.sizes[4], config)
        self.register_buffer("start", self._start(), persistent=False)

    def box_latent(self, raw: Float[Tensor, "*n outputs"]) -> Float[Tensor, "*n 4"]:
        """Mean of the box latent among raw outputs."""
        first = sum(self.sizes[:4])
        return raw[..., first : first + 4]

    def refine(
        self,
        raw: Float[Tensor, "n outputs"],
        maps: Sequence[Tensor],
        row: Int[Tensor, " n"],
        cell: Int[Tensor, " n"],
        columns: int,
        box: Float[Tensor, "n 4"] | None = None,
    ) -> Float[Tensor, "n outputs"]:
        """Raw outputs refined by each region's own box, or by a given one; the box itself stays as it is.

        Args:
            raw: outputs of the regions from their cells.
            maps: the encoder's finer maps.
            row: the image of each region.
            cell: the cell of each region.
            columns: cells in a row of the image.
            box: where to look, [x0, y0, x1, y1], px, instead of at the region's own box.
        """
        if self.glimpse is None:
            return raw
        if box is None:
            place = self.box_latent(raw).detach()
            box = decode_box(place, cell, columns, self.config)
        else:
            place = encode_box(box, cell, columns, self.config)
        change = self.glimpse(maps, row, box, place.clamp(-8, 8)).to(raw.dtype)
        first = sum(self.sizes[:4])
        keep = change.new_zeros(len(change), self.sizes[4])
        return raw + torch.cat((change[:, :first], keep, change[:, first:]), -1)

    def _start(self) -> Float[Tensor, "predictors outputs"]:
        """Where the outputs start.

        Azimuth modes at concentration 1, spread evenly (0, 90, 180 and 270 degrees for four); box sizes of the
        predictors apart from each other. Predictors that start alike stay alike: which one is responsible is then a toss
        of a coin that no objectness can foresee.
        """
        predictors, modes = self.config.predictors, self.config.azimuth_components
        start = torch.zeros(predictors, sum(self.sizes))
        _, _, azimuth, _, box, _ = start.split(self.sizes, -1)
        turn = torch.arange(modes) * (2 * math.pi / modes)
        azimuth[:, modes:] = torch.stack((torch.cos(turn), torch.sin(turn)), -1).flatten()
        if predictors > 1:
            box[:, 2:4] = torch.linspace(-1, 1, predictors)[:, None]
        return start

    def forward(self, features: Float[Tensor, "*n c"]) -> Float[Tensor, "*n predictors outputs"]:
        """Raw outputs of every predictor of each cell."""
        return self.outputs(features).unflatten(-1, self.start.shape) + self.start

    def parameters_of(self, raw: Float[Tensor, "*n outputs"], prior_mean: Float[Tensor, "labels d"]) -> RegionParameters:
        """Posterior parameters of raw outputs.

        The mean of the shape latent is the expected prior mean under the category's probabilities plus a residual: the
        network then only has to learn what sets an instance apart from its category.
        """
        label, shape, azimuth, angle, box, range_ = raw.split(self.sizes, -1)
        residual, shape_raw = shape.chunk(2, -1)
        modes = self.config.azimuth_components
        natural = azimuth[..., modes:].unflatten(-1, (modes, 2))
        angle_loc, angle_raw = angle.chunk(2, -1)
        box_loc, box_raw = box.chunk(2, -1)
        range_loc, range_raw = range_.chunk(2, -1)
        method = self.config.description
        if not method.describes:  # every category and every azimuth alike; the outputs stay without use
            label, natural, angle_loc = torch.zeros_like(label), torch.zeros_like(natural), torch.zeros_like(angle_loc)
        return RegionParameters(
            label_logits=label,
            shape_loc=torch.softmax(label, -1) @ prior_mean.to(raw.dtype) + residual,
            shape_scale=torch.ones_like(shape_raw) if method.point else bounded_exp(shape_raw, -4.0, 2.0),
            azimuth_logits=azimuth[..., :modes] if method.describes else torch.zeros_like(azimuth[..., :modes]),
            azimuth_natural=natural,
            angle_loc=angle_loc,
            angle_scale=0.3 * bounded_exp(angle_raw, -3.0, 1.5),
            box_loc=box_loc,
            box_scale=0.3 * bounded_exp(box_raw, -5.0, 3.0),
            range_loc=range_loc,
            range_scale=0.3 * bounded_exp(range_raw, -5.0, 3.0),
        )
