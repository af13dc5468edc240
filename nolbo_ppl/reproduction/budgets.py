"""How much a reproduction computes, which networks it compares, and what it is run on."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from nolbo_ppl.errors import input_error
from nolbo_ppl.models.baselines.method import METHODS, MethodName

BudgetName = Literal["smoke", "small", "full"]


@dataclass(frozen=True)
class Budget:
    """Sizes of everything that costs time; the same for every network compared."""

    scenes: int
    """Scenes to learn from."""
    held_out: int
    """Scenes to measure on."""
    shape_steps: int
    """Steps on shapes."""
    scene_steps: int
    """Steps on scenes (on crops, for single objects)."""
    batch: int
    """Scenes a step."""
    render_size: int
    """Side of the scenes, px."""
    image_size: int
    """Side at which the networks see them, px."""
    frames: int
    """Frames of a drive at most."""
    step: float
    """Metres between its frames."""
    frame_size: tuple[int, int]
    """Width and height of its images, px."""
    shape_vae_steps: int
    """Steps of the shape autoencoder that is classified with."""
    repeats: int
    """E-steps that are timed."""
    estep_frames: int
    """Frames of the drive they are timed on."""


BUDGETS: dict[BudgetName, Budget] = {
    "smoke": Budget(24, 12, 2, 2, 4, 64, 64, 40, 2.0, (128, 64), 3, 2, 30),
    "small": Budget(1024, 192, 120, 160, 16, 128, 192, 600, 2.5, (256, 128), 1600, 5, 100),
    "full": Budget(16384, 1024, 1200, 4000, 64, 128, 256, 4600, 1.0, (384, 192), 6000, 50, 800),
}
"""By name: a few seconds for tests, minutes a network on two cores, and what the shipped weights were trained with."""


@dataclass(frozen=True)
class ComparedNetwork:
    """A method at a size of its latent."""

    method: MethodName
    latent_dim: int

    @property
    def title(self) -> str:
        """What tables call it."""
        return f"{METHODS[self.method].title}{self.latent_dim}"


NETWORKS: dict[str, ComparedNetwork] = {
    "multi16": ComparedNetwork("nolbo", 16),
    "multi128": ComparedNetwork("nolbo", 128),
    "single16": ComparedNetwork("single", 16),
    "ae16": ComparedNetwork("ae", 16),
    "tlnet16": ComparedNetwork("tlnet", 16),
    "vvae16": ComparedNetwork("vvae", 16),
    "vaegan16": ComparedNetwork("vaegan", 16),
}
"""The networks of the paper's tables and figures."""
IN_SLAM = ("multi16", "multi128", "single16", "ae16", "tlnet16", "vvae16")
"""Those of Table 2; the paper has no SLAM with the 3D-VAE-GAN."""


@dataclass(frozen=True)
class ReproduceConfig:
    """What to reproduce, on what, and where the results go."""

    out: Path
    """Folder for tables, pictures and the trained networks; calling again goes on with what is there."""
    data: str = "generated"
    """`generated`, or a folder of data: labelled scenes (scenes.jsonl, as `nolbo convert` writes them) for table1, pr and tsne,
    KITTI odometry (poses/00.txt, ...) for table2, ModelNet10 (train.npz) for mle."""
    budget: BudgetName = "small"
    """How much is computed: `small` is minutes a network on two cores."""
    seeds: int = 1
    """Networks of each kind, trained and measured from so many seeds; intervals are over them."""
    trained: int = 0
    """Networks of each kind that are trained, where they are to be fewer than `seeds`: seeds of `table2` share them in turn, and
    its intervals are over the odometry's noise above all. 0 for one a seed."""
    networks: tuple[str, ...] = ()
    """Names of the networks to compare; all of them by default."""
    weights: dict[str, str] = field(default_factory=dict)
    """Weights to take in place of training a network: its name and a name of shipped weights or the folder of a model, as
    `multi16 tiny`."""
    device: str = "auto"
    """Where networks train and observe: `auto`, `cpu`, `cuda`, `cuda:N` or `mps`."""
    threads: int = 0
    """Threads of torch; 0 leaves torch's own choice."""
    workers: int = 1
    """Processes that render scenes."""

    def __post_init__(self) -> None:
        if not 0 <= self.trained <= self.seeds:
            raise input_error("trained", got=self.trained, expected=f"0 to {self.seeds}, the seeds")
        if self.seeds < 1 or self.workers < 1:
            raise input_error("seeds or workers", got=(self.seeds, self.workers), expected="at least 1")
        unknown = sorted({*self.networks, *self.weights} - set(NETWORKS))
        if unknown:
            raise input_error("unknown networks", got=unknown, expected=f"some of {sorted(NETWORKS)}")
        if self.data != "generated" and not Path(self.data).is_dir():
            raise input_error("no such folder", got=self.data, expected="`generated` or a folder of data", file=self.data)

    @property
    def sizes(self) -> Budget:
        """The budget's sizes."""
        return BUDGETS[self.budget]

    @property
    def folder(self) -> Path | None:
        """The folder of data, None for generated data."""
        return None if self.data == "generated" else Path(self.data)

    @property
    def networks_of_each(self) -> int:
        """How many networks of each kind are trained."""
        return self.trained or self.seeds

    def label(self, name: str, seed: int) -> str:
        """What files of a network are called; weights that were given are others than those trained here."""
        given = f"-{Path(self.weights[name]).name}" if name in self.weights else ""
        return f"{name}{given}-{seed % self.networks_of_each}"

    def chosen(self, among: tuple[str, ...]) -> tuple[str, ...]:
        """The networks to compare among some, in their order."""
        return tuple(name for name in among if not self.networks or name in self.networks)
