"""A look of its own at each object's shape: the object cut out at one size, an encoder that learns nothing but shapes.

The RoI refinement shares its encoder with everything that is asked of an image, most of all with finding objects. What sets
an instance apart from its category is little of that. Here the object is cut out (`crops`) and sent through a second encoder,
which adds to the mean and log scale of the shape latent that the guide has found so far; all other outputs stay as they are.
Nothing is added before any training, so that a trained guide may be given this look, and learn it alone
(`nolbo train --learn shape_look`).
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nolbo_ppl.models.backbones import TinyEncoder
from nolbo_ppl.models.crops import BOX_SIDE, SIDE, cut_out_detailed
from nolbo_ppl.models.layers import OutputLinear
from nolbo_ppl.models.model_config import ModelConfig

BOX_SHARE = BOX_SIDE / SIDE
"""Longer side of the object's box over the crop's."""
CELL_CHANNELS = 32
"""Channels that each cell of the crop is narrowed to."""
CONTEXT_SCALE = 4.0
"""Raw outputs are read as `tanh(output / 4)`: log probabilities and natural parameters may be large."""


class ShapeLook(nn.Module):
    """Crops of objects, and what the guide says of them so far -> what is added to the raw outputs of the shape latent.

    Args:
        outputs: raw outputs of a region (`RegionHead.sizes`, summed).
        config: side of the crops, encoder, width of the hidden layers, dimensions of the latent.

    Example:
        >>> import dataclasses
        >>> from nolbo_ppl.models.model_config import nano
        >>> look = ShapeLook(5, dataclasses.replace(nano(), shape_look=32))
        >>> image = torch.zeros(1, 3, 64, 64)
        >>> look((image,), torch.tensor([0]), torch.tensor([[8.0, 8, 40, 30]]), torch.zeros(1, 5)).shape  # 2 x 16 dimensions
        torch.Size([1, 32])
    """

    def __init__(self, outputs: int, config: ModelConfig) -> None:
        super().__init__()
        self.side, hidden = config.shape_look, config.head_width
        self.encoder: nn.Module = TinyEncoder(config)
        cells = (self.side // TinyEncoder.stride) ** 2
        self.narrow = nn.Sequential(
            nn.Conv2d(self.encoder.channels, CELL_CHANNELS, 1, bias=False),
            nn.GroupNorm(4, CELL_CHANNELS),
            nn.GELU(),
        )
        last = OutputLinear(hidden, 2 * config.latent_dim)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.judge = nn.Sequential(
            nn.Linear(CELL_CHANNELS * cells + outputs, hidden),
            nn.LayerNorm(hidden),
            nn.GELU(),
            nn.Linear(hidden, hidden),
            nn.LayerNorm(hidden),
            nn.GELU(),
            last,
        )

    def forward(
        self,
        levels: tuple[Float[Tensor, "b 3 _ _"], ...],
        row: Int[Tensor, " n"],
        box: Float[Tensor, "n 4"],
        raw: Float[Tensor, "n outputs"],
        detail: Float[Tensor, " b"] | None = None,
    ) -> Float[Tensor, "n 2*d"]:
        """What the look adds to the raw mean and log scale of each object's shape latent.

        Args:
            levels: the normalised images at falling sizes (`crops.image_levels`).
            row: the image of each object.
            box: where it is, [x0, y0, x1, y1], px of the image.
            raw: the guide's outputs so far; no gradient goes into them.
            detail: pixels of the largest images over those of the boxes; None where they are the same.
        """
        with torch.no_grad():
            crops = cut_out_detailed(levels, detail, row, box.detach(), self.side, BOX_SHARE * self.side)
        maps, _ = self.encoder(crops.image)
        seen = self.narrow(maps).flatten(1)
        context = torch.tanh(raw.detach() / CONTEXT_SCALE).to(seen.dtype)
        return self.judge(torch.cat((seen, context), -1))
