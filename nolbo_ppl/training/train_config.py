"""The configuration of a training run, and the stages it stands for."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from nolbo_ppl.categories import CATEGORY_SYMMETRY
from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.svi import OptimizerConfig
from nolbo_ppl.models.baselines.method import METHODS, MethodName
from nolbo_ppl.models.model_config import PRESETS, ModelConfig
from nolbo_ppl.training.method_objectives import DECODED, shape_weights
from nolbo_ppl.training.net2net import grown_config
from nolbo_ppl.training.stages import JOINT, TrainingStage, scene_weights

DEFAULT_CACHE = Path("~/.cache/nolbo_ppl")
"""Where rendered scenes are kept between runs."""
FREE_FIELDS = (
    "out",
    "photographs",
    "cache",
    "threads",
    "workers",
    "log_every",
    "checkpoint_every",
    "tensorboard",
    "resume",
    "evaluate_every",
    "device",
    "compile",
    "prefetch",
)
"""Fields a resumed run may change: they do not touch what is learnt."""
NEW_FIELDS = {
    "method": "nolbo",
    "initial_part": "all",
    "freeze_encoder": False,
    "joint": 0.25,
    "shape_decode": 0,
    "shape_look": 0,
    "learn": "all",
}
"""Fields that a checkpoint need not name where they have these values, for the same reason as `OPTIONAL_FIELDS`."""
OPTIONAL_FIELDS = (
    "categories",
    "symmetry",
    "grow",
    "detector",
    "scenes",
    "mix",
    "render_sizes",
    "unlabelled",
    "photographic",
    "evidence_scenes",
)
"""Fields that a checkpoint need not name where they are empty: checkpoints are older than they are."""


SHAPE_TERMS = ("shape_kl", "shape_inclusive", "voxels")
"""Terms that a look at shapes learns from."""
LARGEST_RATE = 10.0
"""Learning rates above throw every weight away at the first step."""


@dataclass(frozen=True)
class TrainConfig:
    """Everything a training run depends on.

    Example:
        >>> import nolbo_ppl
        >>> nolbo_ppl.TrainConfig(preset="nano", latent_dim=8).model().latent_dim
        8
    """

    out: Path = Path("runs/tiny")
    """Folder of the run: configuration, metrics.jsonl, checkpoint, and at the end the model."""
    preset: Literal["nano", "tiny", "photo", "paper"] = "tiny"
    """Networks: `tiny` for CPUs, `photo` for photographs, `paper` for darknet19 and 64^3 voxels, `nano` for demonstrations."""
    detector: Path | None = None
    """ONNX file of YOLOX-nano, whose predictions the preset `photo` starts from (extra `onnx`); not needed with the
    weights of such a preset as `initial`."""
    objective: Literal["inclusive", "elbo", "paper"] = "inclusive"
    """What is maximised: the inclusive objective, the pure bound, or the paper's (the bound with objectness turned)."""
    method: MethodName = "nolbo"
    """What is trained: NOLBO, or what it is compared with on the same encoder and decoder (`nolbo_ppl.models.baselines.method`):
    `single` (NOLBO on crops of one object), `ae` (2D-3D autoencoder), `vvae` (vanilla VAE), `tlnet` (TL-network), `vaegan`
    (3D-VAE-GAN)."""
    orientation: Literal["mixture", "angle", "sincos"] | None = None
    """Form of the orientation latent; the preset's by default."""
    instance_labels: bool = False
    """Give every instance of `scenes` a label: the latent is split in halves for category and instance."""
    categories: tuple[str, ...] = ()
    """Names of your own categories, in the order of their labels; the preset's by default."""
    symmetry: tuple[int, ...] = ()
    """Symmetry of each of `categories` about the vertical axis: 1 none, n for n-fold, 0 free; by default that of
    `nolbo_ppl.categories` for the names known there, and 1 for others."""
    latent_dim: int | None = None
    """Dimensions of the shape latent; the preset's by default."""
    image_size: int | None = None
    """Side in px of the images the network looks at, a multiple of 32; the preset's, or the initial weights', by default."""
    scenes: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """Folder of a data set written by `nolbo scenes`, or of your own; may be given several times. Without it scenes are
    generated."""
    mix: tuple[float, ...] = ()
    """Share of each of `scenes` in every batch; one number more than folders is that of generated scenes. By default a
    single folder stands alone, several have equal shares."""
    render_sizes: tuple[int, ...] = ()
    """Sides, px, at which generated scenes are rendered, as many of each; 128 or less by default."""
    photographic: bool = False
    """Generated scenes as a phone would take them (see `nolbo scenes --photographic`)."""
    validation: Path | None = None
    """Folder of held-out scenes; with `scenes` and without this, the last tenth of `scenes` is held out."""
    count: int = 16384
    """Number of generated training scenes."""
    single_count: int = 1024
    """Number of generated scenes with one object, for the second stage."""
    difficulty: Literal["easy", "standard", "full", "mixed"] = "standard"
    """Difficulty of the generated scenes; `mixed` is a third standard, a third full, and a third views of worlds to drive
    through (`nolbo_ppl.synthetic.worlds`)."""
    backgrounds: Path | None = None
    """Folder of photographs behind the generated scenes (with `mixed`, behind the full ones)."""
    initial: str | None = None
    """Weights to start from: a name of shipped weights, or the folder of a model; the networks' configuration is theirs.
    With `--shape-steps 0` the shape networks stay as they are."""
    initial_part: Literal["all", "detection", "features"] = "all"
    """What is taken of the initial weights: everything; or the features (image encoder, convolutions of decoder and 3D encoder),
    for networks of the preset whose heads, latent and prior start afresh; or (`detection`) these and all of the head that does
    not describe the shape latent, so that only latent and prior do."""
    freeze_encoder: bool = False
    """The image encoder stays as it is: a quarter of the time a step, for comparing what is built on one encoder."""
    shape_look: int = 0
    """Give the networks a look of its own at shapes: side of its crops, px, a multiple of 16
    (`nolbo_ppl.models.shape_look`). That of the initial weights by default."""
    learn: Literal["all", "shape_look"] = "all"
    """What is learnt of the guide: everything, or its look at shapes alone, all else of the initial weights as it is."""
    grow: bool = False
    """Grow the initial networks to the blocks and the RoI refinement of the preset (`nolbo_ppl.training.net2net`)."""
    cache: Path = DEFAULT_CACHE
    """Where generated scenes are kept."""
    seed: int = 0
    """Seed of weights, scenes, order, augmentation and noise."""
    shape_steps: int = 1200
    """Steps of the shape autoencoder."""
    single_steps: int = 60
    """Steps on images of one object."""
    scene_steps: int = 4000
    """Steps on scenes."""
    freeze: float = 1.0
    """Share of the scene steps during which decoder and prior networks stay frozen."""
    joint: float = 0.25
    """`--method tlnet`: share of the scene steps, at the end, that are its third phase, in which the shape autoencoder learns
    along."""
    decode: int = 12
    """Objects decoded a step where the objective has voxels; their term stands for all objects."""
    weights: dict[str, float] = field(default_factory=dict)
    """Weights of single terms (names: `nolbo_ppl.inference.elbo`) in place of the objective's own, as `voxels 0.002`."""
    average_every: int = 1
    """With several processes (`torchrun`): steps that each makes by itself before their weights are averaged; at 1 they
    share every step, as one process with the joint batch would make it."""
    batch: int = 64
    """Scenes a step, over all processes."""
    shape_batch: int = 32
    """Shapes a step."""
    shape_decode: int = 0
    """Shapes decoded a step, which stand for all: the decoder costs four times what the 3D encoder does. 0 for all."""
    learning_rate: float = 2.5e-3
    """Rate of the stages on images after their warm-up."""
    optimizer: Literal["muon", "adamw"] = "muon"
    """Optimiser of the stages on images; shapes are learnt by AdamW."""
    sizes: tuple[int, ...] = ()
    """Image sides to choose from each step, multiples of 32; empty for the preset's own."""
    augment: bool = True
    """Blur, colour, scale and translation at random; half the scenes mirrored."""
    mirror: bool = True
    """Mirror scenes with their labels and shapes, where images are augmented; never with instance labels, for a mirrored
    instance is another one. Leave it out where left and right set categories apart."""
    bf16: bool = True
    """Networks in bfloat16."""
    device: str = "auto"
    """`auto` (a CUDA device where there is one, else Apple's, else the CPU), `cpu`, `cuda`, `cuda:N` or `mps`. A run may go on
    on another one."""
    compile: bool = False
    """Let torch compile encoder and decoder (`torch.compile`). What it gains has not been measured."""
    prefetch: int = 2
    """Batches prepared ahead of the step that takes them, in page-locked memory for CUDA devices."""
    threads: int = 0
    """Threads of torch; 0 leaves torch's own choice."""
    workers: int = 2
    """Processes that render scenes."""
    log_every: int = 20
    """Steps between rows of metrics.jsonl."""
    evaluate_every: int = 1000
    """Steps between looks at the held-out scenes."""
    evaluate_scenes: int = 512
    """Held-out scenes of each look; the calibration at the end uses all."""
    photographs: Path | None = None
    """Labelled photographs (COCO-style JSON), not trained on. A detector's evidence is fitted on every third, from the first; the
    finished model is measured on every third, from the second, as `nolbo evaluate --photographs FILE --part 1 3` does."""
    unlabelled: Path | None = None
    """Folder of photographs without labels. A model with a detector learns from them too what tells photographs from generated
    scenes, and how unlike an image is to those it knows."""
    evidence_scenes: int = 1200
    """Scenes of each data set, at most, from which a model with a detector learns to weigh its evidence at the end."""
    checkpoint_every: int = 100
    """Steps between checkpoints."""
    tensorboard: bool = False
    """Write TensorBoard files into the run's folder too (needs the extra `tensorboard`)."""
    resume: bool = True
    """Go on from the run's checkpoint where there is one; otherwise a folder with a checkpoint is refused."""

    def __post_init__(self) -> None:
        if isinstance(self.scenes, str | Path) or self.scenes is None:
            object.__setattr__(self, "scenes", () if not self.scenes else (Path(self.scenes),))
        if self.mix and len(self.mix) - len(self.scenes) not in (0, 1):
            raise input_error(
                "mix",
                got=f"{len(self.mix)} shares of {len(self.scenes)} folders",
                expected="a share of each of --scenes, and one more for generated scenes if they are wanted",
            )
        if any(share <= 0 for share in self.mix):
            raise input_error("mix", got=self.mix, expected="positive shares")
        if any(size % 32 or size <= 0 for size in self.render_sizes):
            raise input_error("render_sizes", got=self.render_sizes, expected="positive multiples of 32")
        if self.initial_part != "all" and (self.initial is None or self.grow or self.preset == "photo"):
            raise input_error(
                "initial_part",
                got=f"initial {self.initial}, grow {self.grow}, preset {self.preset}",
                expected="--initial, neither --grow nor the preset photo",
            )
        if self.learn != "all" and (self.initial is None or self.shape_steps or self.initial_part != "all" or self.grow):
            raise input_error(
                f"learn {self.learn}",
                got=f"initial {self.initial}, {self.shape_steps} steps of shapes, part {self.initial_part}, grow {self.grow}",
                expected="all of some --initial weights as they are, and --shape-steps 0",
            )
        if self.detector is not None and self.preset != "photo":
            raise input_error("a detector", got=f"preset {self.preset}", do="add --preset photo")
        if self.instance_labels and (len(self.scenes) > 1 or self.generated):
            raise input_error("instance labels of several data sets", do="give one folder of --scenes")
        at_least_one = (
            "batch",
            "shape_batch",
            "log_every",
            "evaluate_every",
            "checkpoint_every",
            "count",
            "workers",
            "average_every",
            "prefetch",
        )
        for name in at_least_one:
            if getattr(self, name) < 1:
                raise input_error(name, got=getattr(self, name), expected="at least 1")
        if self.checkpoint_every % self.average_every:
            raise input_error(
                "checkpoint_every",
                got=self.checkpoint_every,
                expected=f"a multiple of average_every, {self.average_every}",
                do="a run goes on exactly only from where the weights of all processes were averaged",
            )
        for name in (
            "shape_steps",
            "single_steps",
            "scene_steps",
            "single_count",
            "decode",
            "shape_decode",
            "threads",
            "evaluate_scenes",
            "seed",
        ):
            if getattr(self, name) < 0:
                raise input_error(name, got=getattr(self, name), expected="at least 0")
        if not 0 < self.learning_rate <= LARGEST_RATE:
            raise input_error("learning_rate", got=self.learning_rate, expected=f"above 0, at most {LARGEST_RATE:g}")
        if not all(0 <= weight < 1e9 for weight in self.weights.values()):
            raise input_error("weights", got=self.weights, expected="finite numbers of at least 0")
        if not 0 <= self.freeze <= 1:
            raise input_error("freeze", got=self.freeze, expected="a share from 0 to 1")
        if not 0 <= self.joint <= 1:
            raise input_error("joint", got=self.joint, expected="a share from 0 to 1")
        if any(size % 32 or size <= 0 for size in self.sizes):
            raise input_error("sizes", got=self.sizes, expected="positive multiples of 32")
        if self.grow and self.initial is None:
            raise input_error("networks to grow", got="no initial weights", do="give --initial, or leave --grow out")
        if self.instance_labels and not self.scenes:
            raise input_error("instance labels", got="generated scenes", do="give --scenes with its own instances")
        if self.validation is not None and not self.scenes:
            raise input_error("held-out scenes without training scenes", do="give --scenes too")
        if self.categories and not self.scenes:
            raise input_error(
                "own categories",
                got="generated scenes, which show the twelve of `nolbo_ppl.categories`",
                do="give --scenes with labels of these names",
            )
        if self.symmetry and len(self.symmetry) != len(self.categories):
            raise input_error(
                "symmetry",
                got=f"{len(self.symmetry)} for {len(self.categories)} categories",
                expected="one for each of --categories",
            )
        if any(order < 0 for order in self.symmetry):
            raise input_error("symmetry", got=self.symmetry, expected="1 (none), n (n-fold) or 0 (free) for each category")

    @property
    def start(self) -> str | None:
        """Weights to start from: `initial`; those of the preset `photo` start from `tiny`'s."""
        return "tiny" if self.preset == "photo" and self.initial is None else self.initial

    @property
    def generated(self) -> bool:
        """Whether generated scenes are learnt from."""
        return not self.scenes or len(self.mix) > len(self.scenes)

    def model(self) -> ModelConfig:
        """Configuration of the networks. Raises `InputError` where initial weights and other fields disagree."""
        if self.start is not None and self.initial_part == "all":
            config = load(self.start, "cpu").config
            if config.method != self.method:
                got = f"weights of method {config.method}"
                raise input_error("initial weights of another method", got=got, do="give --initial-part features")
            if self.orientation not in (None, config.orientation) or self.latent_dim not in (None, config.latent_dim):
                raise input_error(
                    "initial weights of another form",
                    got=f"orientation {config.orientation}, {config.latent_dim} dimensions",
                    do="leave --orientation and --latent-dim out",
                )
            if self.categories not in ((), config.categories) or self.symmetry not in ((), config.symmetry):
                raise input_error(
                    "initial weights of other categories",
                    got=f"{' '.join(config.categories)} of symmetry {' '.join(map(str, config.symmetry))}",
                    expected=f"{' '.join(self.categories)} of symmetry {' '.join(map(str, self._symmetry()))}",
                    do="leave --categories and --symmetry out, or train without --initial",
                )
            if self.preset == "photo" and not config.detector:
                config = dataclasses.replace(config, detector="yolox_nano", image_size=PRESETS["photo"]().image_size)
            if self.shape_look:
                if config.shape_look not in (0, self.shape_look):
                    raise input_error("shape_look", got=self.shape_look, expected=f"{config.shape_look}, as the initial weights")
                config = dataclasses.replace(config, shape_look=self.shape_look)
            if self.learn == "shape_look" and not config.shape_look:
                raise input_error("learn shape_look", got="weights without such a look", do="add --shape-look 96")
            if self.grow:
                config = grown_config(config, PRESETS[self.preset]())
            return config if self.image_size is None else dataclasses.replace(config, image_size=self.image_size)
        changes: dict[str, Any] = {"method": self.method, "shape_look": self.shape_look}
        if self.categories:
            changes["categories"], changes["symmetry"] = self.categories, self._symmetry()
        if self.image_size is not None:
            changes["image_size"] = self.image_size
        if self.orientation is not None:
            changes["orientation"] = self.orientation
            changes["azimuth_components"] = 4 if self.orientation == "mixture" else 1
        if self.latent_dim is not None:
            changes["latent_dim"] = self.latent_dim
        return dataclasses.replace(PRESETS[self.preset](), **changes)

    @property
    def joint_steps(self) -> int:
        """Steps of the phase in which the shape autoencoder learns along; none of methods without it."""
        return round(self.joint * self.scene_steps) if METHODS[self.method].joint else 0

    def _symmetry(self) -> tuple[int, ...]:
        """Declared symmetry of each of `categories`."""
        return self.symmetry or tuple(CATEGORY_SYMMETRY.get(name, 1) for name in self.categories)

    def stages(self) -> list[TrainingStage]:
        """The stages that have steps."""
        weights = scene_weights(self.objective, self.weights, self.method)
        if self.learn == "shape_look":
            weights = {name: weight for name, weight in weights.items() if name in SHAPE_TERMS}
        decoded = METHODS[self.method].decoded  # the decoder learns along
        images = OptimizerConfig(learning_rate=self.learning_rate, optimizer=self.optimizer)
        joint = self.joint_steps
        alone = self.scene_steps - joint
        stages = [
            TrainingStage(
                "shapes",
                OptimizerConfig(self.shape_steps, 2e-3, warmup=min(50, self.shape_steps), clip=5000.0, ema=0.99),
                shape_weights(self.method),
                decode=self.shape_decode,
            ),
            TrainingStage(
                "single",
                dataclasses.replace(images, steps=self.single_steps, decay=0.0, warmup=min(100, self.single_steps)),
                weights,
                freeze=0 if decoded else self.single_steps,
                freeze_encoder=self.freeze_encoder,
                shape_look_alone=self.learn == "shape_look",
                decode=self.decode if decoded else 0,
            ),
            TrainingStage(
                "scenes",
                dataclasses.replace(images, steps=alone, warmup=min(100, alone)),
                weights,
                freeze=0 if decoded else alone if self.learn == "shape_look" else round(self.freeze * alone),
                freeze_encoder=self.freeze_encoder,
                shape_look_alone=self.learn == "shape_look",
                decode=self.decode if weights.get("voxels") else 0,
            ),
            TrainingStage(
                JOINT,
                dataclasses.replace(images, steps=joint, warmup=min(100, joint)),
                {**weights, "voxels": weights.get("voxels", DECODED)},
                freeze_encoder=self.freeze_encoder,
                decode=self.decode,
            ),
        ]
        return [stage for stage in stages if stage.optimisation.steps > 0]

    def to_json(self) -> dict[str, Any]:
        """As JSON keeps it."""
        return json.loads(json.dumps(dataclasses.asdict(self), default=str))

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must agree with: everything but the fields that do not touch what is learnt."""
        values = self.to_json()
        left_out = {k for k, v in values.items() if (k in OPTIONAL_FIELDS and not v) or (k in NEW_FIELDS and v == NEW_FIELDS[k])}
        return {k: v for k, v in values.items() if k not in FREE_FIELDS and k not in left_out}
