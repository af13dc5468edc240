"""The evidence lower bound of a scene, by name, and the inclusive objective beside it (NOLBO eq. ELBO; docs/bound.md).

For each latent site of the guide the bound has one term, `-KL(q || p)`, analytic; for each observed site of the story
one expected log likelihood, in closed form where the site carries one, else at the guide's sample. Discrete sites that
the guide marks for enumeration (a missing category or instance) are summed out exactly: every later term is averaged
under q(l | I), and the site's own KL is a finite sum.

Names: `objectness`, `shape_kl`, `voxels`, `orientation_kl`, `rotation`, `box_kl`, `box`, `range_kl`, `range`, and where
they occur `label_kl`, `instance_kl`, `instance_label_kl`. Each is a number in nats whose sum is the bound.
The inclusive terms are `-KL(p(z | truth) || q(z | I))` (the forward KL, as in wake-sleep and amortised inference), named
`<latent>_inclusive`.

`SceneELBO` is a `pyro.infer.ELBO`: what `TraceMeanField_ELBO` and `TraceEnum_ELBO` do together, with a weight for each term.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from pyro import poutine
from pyro.distributions import TorchDistribution
from pyro.infer import ELBO
from pyro.poutine.messenger import Messenger
from pyro.util import warn_if_nan
from torch import Tensor
from torch.distributions import kl_divergence

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import NolboError, input_error

KL_TERMS = {
    "objectness": "objectness",
    "label": "label_kl",
    "instance": "instance_label_kl",
    "shape_latent": "shape_kl",
    "instance_latent": "instance_kl",
    "orientation_latent": "orientation_kl",
    "box_latent": "box_kl",
    "range_latent": "range_kl",
}
"""Name of the KL term of each latent site."""

LIKELIHOOD_TERMS = ("voxels", "rotation", "box", "range")
"""Observed sites, whose term has the name of the site."""

INCLUSIVE_TERMS = {
    "objectness": "objectness_inclusive",
    "label": "label_inclusive",
    "shape_latent": "shape_inclusive",
    "instance_latent": "instance_inclusive",
    "orientation_latent": "orientation_inclusive",
    "box_latent": "box_inclusive",
    "range_latent": "range_inclusive",
}
"""Name of the inclusive term of each latent site whose truth can be known in training."""

INCLUSIVE_PARTS = ("azimuth_inclusive", "tilt_inclusive")
"""Parts of inclusive terms, with weights of their own: the azimuth, and elevation with in-plane rotation, of
`orientation_inclusive`."""

SHAPE_LABEL = "shape_label"
"""Expected log probability of the label given the shape latent, under the mixture prior (`shape_vae`): no part of the
bound. It keeps the categories of the prior apart, so that maximum likelihood over the prior means can tell them."""

BOUND_TERMS = (*KL_TERMS.values(), *LIKELIHOOD_TERMS)
"""Every term of the pure bound."""

SHAPE_STAGE: dict[str, float] = {"shape_kl": 2.0, "voxels": 1.0, "instance_kl": 2.0, SHAPE_LABEL: 20.0}
"""Weights of the shape autoencoder's stage. Voxels are thousands of nats, so that at weight one the latents of a category
scatter more than its unit prior and the means of categories lie close beside them."""

PURE_BOUND: dict[str, float] = dict.fromkeys(BOUND_TERMS, 1.0)
"""Weights of the pure bound: its negative sum is the loss that `objective="elbo"` minimises."""

PAPER: dict[str, float] = {**PURE_BOUND, "objectness": 0.0, "objectness_inclusive": 1.0}
"""The paper's training loss: the bound, with the objectness KL turned round (binary cross-entropy up to a constant)."""

INCLUSIVE: dict[str, float] = {
    "objectness_inclusive": 0.8,
    "label_inclusive": 3.0,
    "shape_inclusive": 0.75,
    "instance_inclusive": 0.75,
    "azimuth_inclusive": 2.5,
    "tilt_inclusive": 0.2,
    "box_inclusive": 0.3,
    "range_inclusive": 0.3,
}
"""The default objective: the inclusive KL wherever the truth of a latent is known in training.

The weights balance the gradients that reach the encoder. The gradient of a Gaussian's log density grows as one over its
scale: at equal weights elevation and in-plane rotation, soon known to a few degrees, had 12 times the gradient of the
category, and categories and azimuths were not learnt."""


@dataclass
class ElboResult:
    """The terms of one evaluation, summed over regions and objects of the batch, in nats (a term to be maximised)."""

    terms: dict[str, Tensor]
    """By name; terms of weight zero are missing unless they were asked for."""
    loss: Tensor
    """Weighted negative sum, divided by the number of scenes."""


class SceneELBO(ELBO):
    """Bound and inclusive terms of a model and guide, through their Pyro traces.

    With the default weights the loss estimates what `Trace_ELBO` estimates, the negative bound summed over a batch, with
    closed forms in place of samples where there are any. It goes where any bound of Pyro's goes:
    `SVI(model.story, model.guide, optim, loss=SceneELBO())`, and `SceneELBO()(model.story, model.guide)` is a torch module.

    Args:
        weights: weight of each term in the loss, by name (see the module's docstring); others have weight 0.
        num_particles: runs of guide and model that a loss is the mean of.
        retain_graph: keep the graph after a backward pass. An `ObservedScene` holds the encoder's graph: with several
            particles, or for a second step on the same scene, it is needed.

    Raises:
        InputError: a weight has an unknown name or is not a finite number, or there are no particles.

    Example:
        >>> SceneELBO({"box": 2.0, "box_kl": 1.0}).weights
        {'box': 2.0, 'box_kl': 1.0}
    """

    def __init__(
        self, weights: Mapping[str, float] = PURE_BOUND, num_particles: int = 1, retain_graph: bool | None = None
    ) -> None:
        super().__init__(num_particles=num_particles, max_plate_nesting=2, retain_graph=retain_graph)
        if num_particles < 1:
            raise input_error("num_particles", got=num_particles, expected="at least 1")
        known = {*BOUND_TERMS, *INCLUSIVE_TERMS.values(), *INCLUSIVE_PARTS, SHAPE_LABEL}
        unknown = sorted(set(weights) - known)
        if unknown:
            raise input_error("unknown term of the bound", got=unknown, expected=f"names among {sorted(known)}")
        for name, weight in weights.items():
            if not math.isfinite(float(weight)):
                raise input_error(f"weight of {name}", got=weight, expected="a finite number")
        self.weights = {name: float(weight) for name, weight in weights.items() if weight != 0}

    def evaluate(
        self, model: Callable[..., Any], guide: Callable[..., Any], *args: Any, scenes: int = 1, **kwargs: Any
    ) -> ElboResult:
        """Loss and weighted terms of one run of guide and model.

        Args:
            model: the generative model.
            guide: its guide.
            *args: what both are run on.
            scenes: number of scenes of the batch; the loss is the mean over scenes.
            **kwargs: further arguments of both.
        """
        terms = self.terms(model, guide, *args, names=set(self.weights), **kwargs)
        weighted = [self.weights[name] * value for name, value in terms.items()]
        total = torch.stack(weighted).sum() if weighted else torch.zeros((), device=_device_of(guide))
        return ElboResult(terms, -total / scenes)

    def terms(
        self,
        model: Callable[..., Any],
        guide: Callable[..., Any],
        *args: Any,
        names: set[str] | None = None,
        **kwargs: Any,
    ) -> dict[str, Tensor]:
        """Terms by name; without `names` those of the pure bound, whose sum is the bound itself.

        Raises:
            NolboError: guide and model do not have the same latent sites.
        """
        wanted = set(BOUND_TERMS) if names is None else names
        model_trace, guide_trace = self._get_trace(model, guide, args, kwargs)
        enumerated = _enumerated(guide_trace)
        terms: dict[str, Tensor] = {}
        for name, site in model_trace.nodes.items():
            if site["type"] != "sample" or name not in (*KL_TERMS, *LIKELIHOOD_TERMS, SHAPE_LABEL):
                continue
            if name in LIKELIHOOD_TERMS or name == SHAPE_LABEL:
                if name in wanted:
                    terms[name] = _reduce(_log_likelihood(site, guide_trace), site, site["mask"], enumerated)
                continue
            q = guide_trace.nodes.get(name)
            if q is None:
                continue
            if KL_TERMS[name] in wanted and not q["is_observed"]:
                kl = _enumerated_kl(site, q) if name in enumerated else kl_divergence(q["fn"], site["fn"])
                skip = name if name in enumerated else None
                terms[KL_TERMS[name]] = -_reduce(kl, site, site["mask"], enumerated, skip)
            mask = site["infer"].get("target_mask", site["mask"])
            for part, divergence_to in site["infer"].get("target_parts", {}).items():
                if part in wanted:
                    terms[part] = -_reduce(divergence_to(q["fn"]), site, mask, {})
            target = site["infer"].get("target")
            if target is not None and INCLUSIVE_TERMS.get(name) in wanted:
                divergence = kl_divergence(target, q["infer"].get("posterior", q["fn"]))
                terms[INCLUSIVE_TERMS[name]] = -_reduce(divergence, site, mask, {})
        return terms

    def differentiable_loss(self, model: Callable[..., Any], guide: Callable[..., Any], *args: Any, **kwargs: Any) -> Tensor:
        """The weighted negative sum of the terms, nats summed over the batch, with its graph."""
        losses = [self.evaluate(model, guide, *args, **kwargs).loss for _ in range(self.num_particles)]
        return torch.stack(losses).mean()

    def loss(self, model: Callable[..., Any], guide: Callable[..., Any], *args: Any, **kwargs: Any) -> float:
        """The same as a number, without gradients."""
        with torch.no_grad():
            value = float(self.differentiable_loss(model, guide, *args, **kwargs))
        warn_if_nan(value, "loss")
        return value

    def loss_and_grads(self, model: Callable[..., Any], guide: Callable[..., Any], *args: Any, **kwargs: Any) -> float:
        """The loss as a number; its gradients are added to those of the parameters. What `SVI` calls."""
        total = 0.0
        for _ in range(self.num_particles):
            loss = self.evaluate(model, guide, *args, **kwargs).loss / self.num_particles
            if loss.requires_grad:
                loss.backward(retain_graph=self.retain_graph)
            total += float(loss.detach())
        warn_if_nan(total, "loss")
        return total

    def _get_trace(
        self, model: Callable[..., Any], guide: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> tuple[poutine.Trace, poutine.Trace]:
        """Traces of model and guide, the model run at the guide's values, missing labels enumerated."""
        guide_trace = poutine.trace(poutine.enum(guide, first_available_dim=-1 - self.max_plate_nesting)).get_trace(
            *args, **kwargs
        )
        model_trace = poutine.trace(_Replay(guide_trace)(model)).get_trace(*args, **kwargs)
        self._check_sites(model_trace, guide_trace)
        return model_trace, guide_trace

    @staticmethod
    def _check_sites(model_trace: poutine.Trace, guide_trace: poutine.Trace) -> None:
        latent = {n for n, s in model_trace.nodes.items() if s["type"] == "sample" and not s["is_observed"]} & set(KL_TERMS)
        guided = {n for n, s in guide_trace.nodes.items() if s["type"] == "sample" and not s["is_observed"]} & set(KL_TERMS)
        if latent != guided:
            raise NolboError(
                f"model and guide disagree about latent sites: only in the model {sorted(latent - guided)}, "
                f"only in the guide {sorted(guided - latent)}"
            )


class _Replay(Messenger):
    """Run the model at the guide's values. Pyro's own replay overwrites the model's `infer` (the targets) by the guide's."""

    def __init__(self, guide_trace: poutine.Trace) -> None:
        super().__init__()
        self.guide_trace = guide_trace

    def _pyro_sample(self, msg: Any) -> None:
        guide_site = self.guide_trace.nodes.get(msg["name"])
        if guide_site is not None and guide_site["type"] == "sample" and not msg["is_observed"]:
            msg["done"] = True
            msg["value"] = guide_site["value"]


def _enumerated(guide_trace: poutine.Trace) -> dict[str, tuple[int, Tensor]]:
    """Dimension and probabilities q(value) of each enumerated site of the guide, dimension counted from the right."""
    found = {}
    for name, site in guide_trace.nodes.items():
        if site["type"] == "sample" and site["infer"].get("_enumerate_dim") is not None:
            found[name] = (site["infer"]["_enumerate_dim"], site["fn"].log_prob(site["value"]).exp())
    return found


def _enumerated_kl(model_site: dict[str, Any], guide_site: dict[str, Any]) -> Tensor:
    """sum_l q(l) (log q(l) - log p(l)), values of probability zero contributing nothing."""
    q: TorchDistribution = guide_site["fn"]
    log_q, log_p = q.log_prob(guide_site["value"]), model_site["fn"].log_prob(guide_site["value"])
    probability = log_q.exp()
    positive = probability > 0
    dim = guide_site["infer"]["_enumerate_dim"]
    difference = torch.where(positive, log_q, 0.0) - torch.where(positive, log_p, 0.0)
    return (probability * difference).sum(dim, keepdim=True)


def _log_likelihood(site: dict[str, Any], guide_trace: poutine.Trace) -> Tensor:
    """Expected log likelihood in closed form where the site has one, else at the sample."""
    closed_form = site["infer"].get("expected_log_prob")
    if closed_form is None:
        return site["fn"].log_prob(site["value"])
    latent, expectation = closed_form
    return expectation(guide_trace.nodes[latent]["fn"])


def _reduce(
    value: Tensor,
    site: dict[str, Any],
    mask: Tensor | bool | None,
    enumerated: Mapping[str, tuple[int, Tensor]],
    skip: str | None = None,
) -> Tensor:
    """Average over enumerated sites, mask, scale, sum."""
    for name, (dim, probability) in sorted(enumerated.items(), key=lambda item: item[1][0]):
        if name != skip and value.dim() >= -dim and value.shape[dim] > 1:
            positive = probability > 0
            value = torch.where(positive, probability * torch.where(positive, value, 0.0), 0.0).sum(dim, keepdim=True)
    if mask is not None:
        value = torch.where(torch.as_tensor(mask, device=value.device), value, value.new_zeros(()))
    return (value * site["scale"]).sum()


def _device_of(guide: Callable[..., Any]) -> torch.device | None:
    """Where the parameters of a guide lie; None (torch's default) where it has none."""
    parameters = guide.parameters() if isinstance(guide, torch.nn.Module) else iter(())
    return next((parameter.device for parameter in parameters), None)


class SceneLoss(torch.nn.Module):
    """Loss of a batch as one module: what a trainer, or a distributed wrapper of it, calls.

    Args:
        story: the generative model.
        guide: its guide; a module with `observe(batch)`.
        elbo: the weighted terms, the same object that `SVI` takes as its loss.
    """

    def __init__(self, story: torch.nn.Module, guide: torch.nn.Module, elbo: SceneELBO) -> None:
        super().__init__()
        self.story, self.guide, self.elbo = story, guide, elbo

    def forward(self, batch: Any, decode: int | None = 0) -> ElboResult:
        """Encode the batch, find the responsible regions, and evaluate the objective."""
        scene = self.guide.observe(batch)  # type: ignore[operator]
        return self.elbo.evaluate(self.story, self.guide, scene, scenes=len(batch.image), decode=decode)


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
