"""The stages of training, each an optimisation of its own: shapes, single objects, scenes (NOLBO, training details)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
import torch.distributed as distributed
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.elbo import INCLUSIVE, PAPER, PURE_BOUND, ElboResult, SceneELBO, SceneLoss
from nolbo_ppl.inference.svi import OptimizerConfig, OptimizerState
from nolbo_ppl.models.baselines.method import MethodName
from nolbo_ppl.models.normalisation import set_joint
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.models.shape_vae import ShapeBatch
from nolbo_ppl.training.method_objectives import ADVERSARIAL_TERMS, AdversarialLoss, JointLoss, image_weights

OBJECTIVES: dict[str, Mapping[str, float]] = {"inclusive": INCLUSIVE, "elbo": PURE_BOUND, "paper": PAPER}
"""Weights of the terms by the name of the objective."""

JOINT = "joint"
"""Name of the stage on scenes in which the shape autoencoder learns along (`JointLoss`)."""
DECODE_STREAM = 2**40
"""Added to a step's number, it gives the random numbers that choose which objects are decoded."""


@dataclass(frozen=True)
class TrainingStage:
    """One stage: what is trained, on which terms, for how long."""

    name: str
    """`shapes`, `single`, `scenes` or `joint`."""
    optimisation: OptimizerConfig
    """Optimiser and schedule."""
    weights: Mapping[str, float]
    """Weights of the terms of the loss."""
    freeze: int = 0
    """Steps, from the first, during which decoder and prior networks stay as they are (normalisation included)."""
    freeze_encoder: bool = False
    """The image encoder stays as it is (normalisation included)."""
    shape_look_alone: bool = False
    """The guide stays as it is, but for its look at shapes."""
    decode: int = 0
    """Objects decoded a step; their voxel term stands for all objects. 0 where voxels have no weight, and for all
    shapes in the stage of shapes."""


class ShapeLoss(nn.Module):
    """Bound of the shape autoencoder as one module."""

    def __init__(self, model: Nolbo, elbo: SceneELBO) -> None:
        super().__init__()
        self.story, self.guide, self.elbo = model.shape_model, model.shape_guide, elbo

    def forward(self, batch: ShapeBatch, decode: int | None = None) -> ElboResult:
        """Evaluate the bound, in nats a shape."""
        return self.elbo.evaluate(self.story, self.guide, batch, scenes=len(batch.voxels), decode=decode)


class StageRun:
    """A stage under way: sets what trains and what is frozen, makes steps.

    Args:
        model: the networks.
        stage: what to do with them.
        half_precision: networks in bfloat16.
        average_every: with several processes, the steps each makes by itself on its share of the batches before weights,
            moving averages and the optimiser's state are averaged over all (local SGD; Stich, 2019). At 1 they share
            every step: gradients and statistics of the joint batch, which costs far more exchange.
    """

    def __init__(self, model: Nolbo, stage: TrainingStage, half_precision: bool = False, average_every: int = 1) -> None:
        self.model, self.stage, self.average_every = model, stage, average_every
        self._frozen: bool | None = None
        model.requires_grad_(True)
        model.set_half_precision(half_precision)
        weights = {name: weight for name, weight in stage.weights.items() if name not in ADVERSARIAL_TERMS}
        if stage.name == "shapes":
            model.guide.requires_grad_(False)
            module: nn.Module = ShapeLoss(model, SceneELBO(weights))
        else:
            joint = stage.name == JOINT
            model.shape_guide.requires_grad_(joint)
            if stage.freeze >= stage.optimisation.steps:
                model.story.requires_grad_(False)
            if stage.freeze_encoder:
                model.guide.encoder.requires_grad_(False)
            if stage.shape_look_alone:
                model.guide.requires_grad_(False)
                model.guide.get_submodule("shape_look").requires_grad_(True)
            rebuilt = weights.pop("voxels", 0.0) if joint else 0.0
            module = SceneLoss(model.story, model.guide, SceneELBO(weights))
            if joint:
                module = JointLoss(module, model, rebuilt)
        if not {*ADVERSARIAL_TERMS}.isdisjoint(stage.weights):
            module = AdversarialLoss(module, model, stage.weights)
        together = distributed.is_available() and distributed.is_initialized()
        self._local = together and average_every > 1
        set_joint(model, not self._local)
        if together and not self._local:
            module = DistributedDataParallel(module, find_unused_parameters=True)
        self.state: OptimizerState = optimisation.init(model, module, stage.optimisation)

    def set_modes(self) -> bool:
        """Training and evaluation modes and frozen parts for the next step; returns whether the story is frozen."""
        frozen = self.stage.name != "shapes" and self.state.step < self.stage.freeze
        if self._frozen != frozen or not self.model.training:
            self.model.train()
            if self.stage.name != "shapes":
                self.model.shape_guide.train(self.stage.name == JOINT)
                self.model.story.train(not frozen)
                for parameter in self.model.story.parameters():
                    parameter.requires_grad_(not frozen)
                if self.stage.freeze_encoder:
                    self.model.guide.encoder.eval()
                if self.stage.shape_look_alone:
                    self.model.guide.eval()
                    self.model.guide.get_submodule("shape_look").train()
            self._frozen = frozen
        return frozen

    def step(self, batch: SceneBatch | ShapeBatch) -> optimisation.StepInfo:
        """One optimiser step."""
        self.set_modes()
        shapes = self.stage.name == "shapes"
        arguments = {"decode": (self.stage.decode or None) if shapes else self.stage.decode}
        self.state, info = optimisation.step(self.state, batch, **arguments)
        if self._local and (self.finished or self.state.step % self.average_every == 0):
            optimisation.average_over_processes(self.state)
        return info

    @property
    def finished(self) -> bool:
        """All steps are done."""
        return self.state.step >= self.stage.optimisation.steps

    def averaged(self) -> Nolbo:
        """A copy of the networks with the averaged weights, in evaluation mode."""
        like = next(self.model.parameters())
        copy = Nolbo.from_seed(self.model.config, 0).to(like.device, like.dtype)
        copy.load_state_dict(self.state.average)
        return copy.eval().requires_grad_(False)

    def load_ema(self) -> None:
        """End the stage: the networks take the averaged weights."""
        self.model.load_state_dict(self.state.average)


def scene_weights(objective: str, changes: Mapping[str, float] | None = None, method: MethodName = "nolbo") -> dict[str, float]:
    """Weights of an objective, with other weights for some terms; methods other than NOLBO have terms of their own.

    Voxel terms are thousands of nats an object while the latent is wrong: at full weight they drown every other head.
    """
    weights = {**image_weights(method, OBJECTIVES[objective]), **(changes or {})}
    return {name: weight for name, weight in weights.items() if weight}


def shorten(stage: TrainingStage, steps: int) -> TrainingStage:
    """The same stage with another number of steps, its freeze in proportion."""
    freeze = round(stage.freeze * steps / max(stage.optimisation.steps, 1))
    return replace(stage, optimisation=replace(stage.optimisation, steps=steps), freeze=freeze)


def seeded_noise(seed: int, step: int, *shape: int) -> torch.Tensor:
    """Standard normal noise that depends on seed and step only: drawn on the CPU, so that it is the same for every device."""
    generator = torch.Generator("cpu").manual_seed((seed * 1_000_003 + step) % 2**63)
    return torch.randn(*shape, generator=generator, device="cpu")
