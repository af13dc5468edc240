"""What a model with a detector knows of images as a whole, and of categories: statistics, fitted when its networks are done.

Whether an image is a photograph or a generated scene (`Fusion.generated`), how unlike both it is (`ImageShift`), and what objects
of each category measure (`CategorySizes`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nolbo_ppl.inference.posterior.preprocess import preprocess
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.synthetic.assets.cad_sizes import TYPICAL_DIAGONAL
from nolbo_ppl.synthetic.shapes import shape_from_seed

HELD_OUT_EVERY = 4
"""One image of so many sets the scale of scores, and where photographs end and generated scenes begin."""
MIN_IMAGES = 40
"""Of fewer images of a kind nothing is learnt."""
RIDGE = 0.03
"""Penalty on the squared weights of the classifier: with none it takes photographs of other cameras for generated scenes."""
SHAPES = 24
"""Generated shapes of a category behind the spread of its sizes."""
MIN_SIZE_SPREAD = 0.12
"""Least spread of log diagonals: families of one kind of chair are no measure of all chairs."""


@torch.no_grad()
def contexts_of(guide: HybridGuide, images: Iterable[UInt8[np.ndarray, "h w 3"]]) -> Float[Tensor, "n c"]:
    """What describes each image as a whole."""
    weight, found = guide.head.objectness.weight, []
    for image in images:
        prepared = preprocess(image, None, guide.config.image_size, weight.dtype)
        found.append(guide.gather(prepared.image[None].to(weight.device)).context.cpu())
    return torch.cat(found) if found else torch.zeros(0, guide.fusion.domain.in_features, dtype=weight.dtype)


def fit_domain(guide: HybridGuide, context: Float[Tensor, "n c"], generated: Bool[Tensor, " n"]) -> dict[str, float]:
    """Fit classifier and shift scores. Nothing is fitted with fewer than `MIN_IMAGES` of a kind.

    Returns what every fourth image says, which no weight was fitted to. Those images also set the border and the scale of the
    scores, so that the figures tell whether the fit went wrong, not how well it does on images of other sources.

    Args:
        guide: receives them.
        context: what describes each image (`contexts_of`, `EvidenceTable.context`).
        generated: which are generated scenes.
    """
    figures: dict[str, float] = {}
    held = torch.arange(len(context), device=context.device) % HELD_OUT_EVERY == 0
    for kind, chosen in enumerate((~generated, generated)):
        if int(chosen.sum()) >= MIN_IMAGES:
            guide.shift.learn(kind, context[chosen & ~held], context[chosen & held])
    if min(int(generated.sum()), int((~generated).sum())) < MIN_IMAGES:
        return figures
    _fit_classifier(guide, context[~held], generated[~held])
    with torch.no_grad():
        fusion = guide.fusion
        odds = fusion.domain(fusion.domain_norm(context[held]))[:, 0]
        photographs, scenes = odds[~generated[held]], odds[generated[held]]
        # The border lies between the most doubtful of both kinds: what is like neither is taken for a photograph more often
        # than by maximum likelihood, which never saw it.
        border = (torch.quantile(photographs, 0.99) + torch.quantile(scenes, 0.01)) / 2
        fusion.domain.bias.sub_(border)
        figures["domain/photographs_right"] = float((photographs < border).double().mean())
        figures["domain/generated_right"] = float((scenes > border).double().mean())
        figures["shift/held_out_above_1"] = float((guide.shift(context[held]) > 1).double().mean())
    return figures


def _fit_classifier(guide: HybridGuide, context: Float[Tensor, "n c"], generated: Bool[Tensor, " n"]) -> None:
    """Ridge logistic regression of both kinds in equal weight."""
    fusion = guide.fusion
    with torch.no_grad():
        fusion.domain_norm.weight.fill_(1.0)
        fusion.domain_norm.bias.zero_()
        x = fusion.domain_norm(context).double()
        mean, spread = x.mean(0), x.std(0).clamp_min(1e-3)
        x = (x - mean) / spread
    target = generated.double()
    weight = torch.where(generated, 0.5 / target.mean(), 0.5 / (1 - target.mean()))
    parameters = torch.zeros(x.shape[1] + 1, dtype=torch.float64, device=x.device, requires_grad=True)
    optimizer = torch.optim.LBFGS([parameters], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        odds = x @ parameters[:-1] + parameters[-1]
        value = torch.nn.functional.binary_cross_entropy_with_logits(odds, target, weight=weight)
        value = value + RIDGE * parameters[:-1].square().sum()
        value.backward()
        return value

    optimizer.step(loss)
    with torch.no_grad():
        slope = parameters[:-1].detach() / spread
        fusion.domain.weight.copy_(slope[None])
        fusion.domain.bias.fill_(float(parameters[-1].detach() - slope @ mean))


def learn_sizes(guide: HybridGuide, categories: Sequence[str], seed: int) -> None:
    """Sizes of the categories that are known: a common specimen's, with the spread of the generated family or more.

    Families alone would not do for the mean: their cars are as long as estates.
    """
    for label, name in enumerate(categories):
        if name not in TYPICAL_DIAGONAL:
            continue
        spread = MIN_SIZE_SPREAD
        try:
            own = np.log([shape_from_seed(name, seed + k).diagonal for k in range(SHAPES)])
            spread = max(spread, float(own.std()))
        except ValueError:  # no family of this name
            spread = 0.3  # the table is good to a third
        middle = math.log(TYPICAL_DIAGONAL[name])
        guide.sizes.learn(label, torch.tensor([middle - spread / math.sqrt(2), middle + spread / math.sqrt(2)]))
