"""Options of the paper's own training programme, stage by stage (NOLBO, training details; docs/training.md)."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from nolbo_ppl.categories import CATEGORIES, CATEGORY_SYMMETRY
from nolbo_ppl.errors import input_error
from nolbo_ppl.models.backbones import narrowed
from nolbo_ppl.models.model_config import PRESETS, ModelConfig
from nolbo_ppl.training.train_config import DEFAULT_CACHE, LARGEST_RATE

StageName = Literal["imagenet", "viewpoint", "vae", "single", "multi"]
MULTI_SCALE = tuple(range(320, 609, 32))
"""Sides, px, that a step chooses from where images are of several scales (YOLO9000)."""
FREE_FIELDS = (
    *(
        "out",
        "cache",
        "workers",
        "threads",
        "log_every",
        "evaluate_every",
        "evaluate_pictures",
        "checkpoint_every",
        "tensorboard",
    ),
    *("resume", "device", "compile", "prefetch"),
)
"""Fields a resumed run may change: they do not touch what is learnt."""


@dataclass(frozen=True)
class StageDefaults:
    """What a stage takes where an option is not given."""

    epochs: int
    batch: int
    learning_rate: float
    optimizer: Literal["adamw", "muon"]
    sizes: tuple[int, ...]
    """Side of the images; of single and several objects, the phases' last sizes."""


DEFAULTS: dict[StageName, StageDefaults] = {
    "imagenet": StageDefaults(60, 128, 1e-3, "adamw", (224,)),
    "viewpoint": StageDefaults(4, 128, 3e-4, "adamw", (224,)),
    "vae": StageDefaults(150, 32, 2e-3, "adamw", ()),
    "single": StageDefaults(100, 32, 1e-4, "adamw", MULTI_SCALE),
    "multi": StageDefaults(60, 16, 1e-4, "adamw", MULTI_SCALE),
}
"""The paper states the multi-object stage (Adam, 1e-5 for an epoch, then 1e-4; 20 epochs frozen) and the switches of sizes; the
other numbers are ours."""


@dataclass(frozen=True)
class PaperConfig:
    """One stage of the paper's programme; each is a run of its own, resumable, in several processes under torchrun.

    `imagenet`: darknet19's core on classified pictures. `viewpoint`: the same core on rendered viewpoints. `vae`: decoder, prior
    and 3D encoder on CAD shapes. `single`: the whole network on crops of single objects, from core and decoder, with a fresh
    prior; 224 px, then 448, then several scales, each from an accuracy of the reconstruction on. `multi`: whole scenes, decoder
    and prior frozen for 20 epochs.
    """

    stage: StageName
    """Which."""
    data: Path
    """`imagenet`: folder with train/ and val/. `viewpoint`: folder of Render for CNN. `vae`: folder of ModelNet. `single`,
    `multi`: folder of scenes, as `nolbo convert pascal3d|objectnet3d|pix3d --grid 64` writes them."""
    out: Path
    """Folder of the run."""
    validation: Path | None = None
    """`single`, `multi`: folder of held-out scenes; the last tenth of `data` by default. Other data sets have official splits."""
    core: Path | None = None
    """`viewpoint`, `single`: run, or core.safetensors, whose encoder core is gone on with."""
    decoder: Path | None = None
    """`single`: run of the stage `vae`, or a model's folder, whose decoder and 3D encoder are gone on with."""
    initial: Path | None = None
    """`multi`: run of the stage `single`, or a model's folder."""
    width: float = 1.0
    """Factor on the channels of all networks; 1 is the paper's."""
    latent_dim: int = 16
    """Dimensions of the shape latent."""
    categories: tuple[str, ...] = CATEGORIES
    """`single`, `multi`: names of the labels (forty: `nolbo_ppl.categories.PAPER_CATEGORIES`); `vae` has the data's classes."""
    objective: Literal["paper", "elbo", "inclusive"] = "paper"
    """`single`, `multi`: the paper's bound, the pure one, or the inclusive objective (docs/bound.md)."""
    weights: dict[str, float] = field(default_factory=dict)
    """Weights of single terms in place of the objective's own; voxels have 0.003 in the paper's bound by default: at full weight
    they drown every other head."""
    epochs: int = 0
    """Times the data is gone through; 0 for the stage's own number."""
    steps: int = 0
    """Optimiser steps in place of `epochs`."""
    batch: int = 0
    """Pictures, shapes or scenes a step over all processes; 0 for the stage's own number."""
    learning_rate: float = 0.0
    """0 for the stage's own."""
    optimizer: Literal["adamw", "muon"] | None = None
    """The stage's own by default."""
    sizes: tuple[int, ...] = ()
    """Sides of the images, px, multiples of 32: one for `imagenet` and `viewpoint`; of `single` and `multi` those that a step
    chooses from in the last phase."""
    phases: tuple[int, ...] = (224, 448)
    """`single`: sides of the phases before the one of several scales."""
    switch: float = 0.7
    """`single`: mean average precision of the voxels of held-out objects that ends a phase."""
    phase_steps: int = 0
    """`single`: most steps of a phase before the last, whatever its accuracy; 0 for no limit."""
    freeze_epochs: int = 20
    """`multi`: epochs with decoder and prior as they are."""
    first_rate: float = 1e-5
    """`multi`: learning rate of the first epoch."""
    decode: int = 16
    """`single`, `multi`: objects decoded a step; their term stands for all."""
    augment: bool = True
    """Blur, colours, scale and translation at random."""
    mirror: bool = True
    """Mirror half of the scenes with their labels and shapes."""
    seed: int = 0
    """Seed of weights, order, augmentation and noise."""
    bf16: bool = True
    """Networks in bfloat16."""
    device: str = "auto"
    """`auto`, `cpu`, `cuda`, `cuda:N` or `mps`."""
    compile: bool = False
    """Let torch compile encoder and decoder."""
    prefetch: int = 2
    """Batches prepared ahead."""
    workers: int = 2
    """Processes that read pictures and fill meshes."""
    threads: int = 0
    """Threads of torch; 0 leaves torch's own choice."""
    cache: Path = DEFAULT_CACHE
    """Where voxels of CAD files are kept."""
    log_every: int = 20
    """Steps between rows of metrics.jsonl."""
    evaluate_every: int = 1000
    """Steps between looks at held-out data; `single` may switch its phase then."""
    evaluate_pictures: int = 2000
    """Held-out pictures, shapes or scenes of each look, at most."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""
    tensorboard: bool = False
    """Write TensorBoard files too."""
    resume: bool = True
    """Go on from the run's checkpoint where there is one."""

    def __post_init__(self) -> None:
        positive = ("log_every", "evaluate_every", "checkpoint_every", "workers", "prefetch", "evaluate_pictures", "latent_dim")
        for name in positive:
            if getattr(self, name) < 1:
                raise input_error(name, got=getattr(self, name), expected="at least 1")
        for name in ("epochs", "steps", "batch", "phase_steps", "freeze_epochs", "decode", "seed", "threads"):
            if getattr(self, name) < 0:
                raise input_error(name, got=getattr(self, name), expected="at least 0")
        for name in ("learning_rate", "first_rate"):
            if not 0 <= getattr(self, name) <= LARGEST_RATE:
                raise input_error(name, got=getattr(self, name), expected=f"0 to {LARGEST_RATE:g}")
        if not 0 < self.width <= 4:
            raise input_error("width", got=self.width, expected="a factor above 0, at most 4")
        if not 0 < self.switch <= 1:
            raise input_error("switch", got=self.switch, expected="an average precision above 0, up to 1")
        for name in ("sizes", "phases"):
            if any(size <= 0 or size % 32 for size in getattr(self, name)):
                raise input_error(name, got=getattr(self, name), expected="positive multiples of 32")
        if self.stage in ("imagenet", "viewpoint") and len(self.sizes) > 1:
            raise input_error("sizes", got=self.sizes, expected="one side for pictures of one object")
        given = {name for name in ("core", "decoder", "initial") if getattr(self, name) is not None}
        takes = {"imagenet": set(), "viewpoint": {"core"}, "vae": set(), "single": {"core", "decoder"}, "multi": {"initial"}}[
            self.stage
        ]
        if given - takes:
            expected = f"of {sorted(takes)}" if takes else "none"
            raise input_error(f"weights for the stage {self.stage}", got=sorted(given), expected=expected)
        if self.stage == "multi" and self.initial is None:
            raise input_error("the stage multi without initial weights", do="give --initial RUN_OF_THE_STAGE_SINGLE")

    def default(self, name: str) -> Any:
        """An option, or the stage's own value where it is not given."""
        given = getattr(self, name)
        return given if given else getattr(DEFAULTS[self.stage], name)

    def steps_of(self, count: int) -> int:
        """Optimiser steps, for so many pictures, shapes or scenes."""
        return self.steps or self.default("epochs") * self.epoch(count)

    def epoch(self, count: int) -> int:
        """Steps in which every one of so many is seen once."""
        return max(1, -(-count // self.default("batch")))

    def scene_terms(self) -> dict[str, float]:
        """Changed weights of the objective's terms."""
        return {**({"voxels": 0.003} if self.objective == "paper" else {}), **self.weights}

    def model(self, categories: tuple[str, ...]) -> ModelConfig:
        """The paper's networks for some categories, their channels by `width`."""
        base = PRESETS["paper"]()
        return dataclasses.replace(
            base,
            categories=categories,
            symmetry=tuple(CATEGORY_SYMMETRY.get(name, 1) for name in categories),
            latent_dim=self.latent_dim,
            encoder_width=self.width,
            decoder_channels=tuple(narrowed(c, self.width) for c in base.decoder_channels),
            voxel_encoder_channels=tuple(narrowed(c, self.width) for c in base.voxel_encoder_channels),
        )

    def to_json(self) -> dict[str, Any]:
        """As JSON keeps it."""
        return json.loads(json.dumps(dataclasses.asdict(self), default=str))

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must agree with."""
        return {name: value for name, value in self.to_json().items() if name not in FREE_FIELDS}
