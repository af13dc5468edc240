"""Configuration of the generative story and its guide, and the presets `nano`, `tiny`, `photo` and `paper`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from nolbo_ppl.categories import CATEGORIES, CATEGORY_SYMMETRY
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.fields import check_fields
from nolbo_ppl.models.baselines.method import METHODS, Method, MethodName

LARGEST = 8192
"""Largest whole number a configuration may hold: widths, sides, labels; networks beyond do not fit any memory."""
LARGEST_OF = {
    **dict.fromkeys(("encoder_blocks", "glimpse_blocks", "glimpse", "predictors", "azimuth_components"), 64),
    **dict.fromkeys(("symmetry", "instance_category"), 100_000),
    "shape_look": 512,
}
"""The same of single fields: blocks are modules of their own."""


@dataclass(frozen=True)
class ModelConfig:
    """Everything that fixes the shape of the networks and the constants of the story."""

    categories: tuple[str, ...] = CATEGORIES
    """Names of the object categories, in the order of their labels."""
    symmetry: tuple[int, ...] = tuple(CATEGORY_SYMMETRY.values())
    """Declared symmetry about the vertical axis by category: 1 none, n for n-fold, 0 free."""
    instances: tuple[str, ...] = ()
    """Names of the instances with labels of their own; empty for a latent of categories only."""
    instance_category: tuple[int, ...] = ()
    """Category label of each instance."""
    encoder: Literal["tiny", "darknet19"] = "tiny"
    """Image encoder: a small residual network of stride 16 for CPUs, or the paper's darknet19 of stride 32."""
    encoder_channels: tuple[int, int, int, int] = (16, 32, 64, 128)
    """Channels of the tiny encoder at strides 2, 4, 8 and 16."""
    encoder_blocks: tuple[int, int, int] = (1, 2, 2)
    """Residual blocks of the tiny encoder at strides 4, 8 and 16."""
    encoder_width: float = 1.0
    """Factor on the channels of darknet19."""
    head_width: int = 320
    """Width of the head's hidden layers (tiny encoder only; darknet19 has a linear head as the paper)."""
    glimpse: int = 7
    """Side of the grid of features sampled over each object's box, which refines its posterior; 0 for none
    (darknet19, whose head is the paper's, has none)."""
    glimpse_width: int = 96
    """Channels of the RoI refinement, a multiple of 4."""
    glimpse_maps: int = 2
    """Maps of the encoder that the RoI refinement samples, from the finest on: strides 4, 8, 16."""
    glimpse_blocks: int = 0
    """Residual blocks of the RoI refinement."""
    glimpse_detail: bool = False
    """The RoI refinement samples the finest map twice as densely too."""
    shape_look: int = 0
    """Side, px, of a crop of each object that an encoder of its own looks at for the shape latent alone, a multiple of 16
    (`nolbo_ppl.models.shape_look`; tiny encoder only); 0 for none."""
    predictors: int = 2
    """Predictors P of each cell; a scene of G x G cells has K = G G P regions."""
    image_size: int = 128
    """Side in pixels that images are brought to, a multiple of 32. Other multiples of 32 work as well."""
    latent_dim: int = 16
    """Dimensions of the shape latent; with instance labels half of them describe the category, half the instance."""
    prior_width: int = 64
    """Width of the hidden layer of each prior network."""
    voxel_size: Literal[32, 64] = 32
    """Voxels along each side of the decoded grid."""
    decoder_channels: tuple[int, ...] = (128, 64, 32)
    """Channels of the decoder from its 4^3 grid on; each transposed convolution doubles the grid."""
    voxel_encoder_channels: tuple[int, ...] = (32, 64, 64)
    """Channels of the 3D encoder of the shape autoencoder; each layer halves the grid (the first two together, by patches)."""
    voxel_patches: bool = True
    """Write the finest voxels as 2^3 and read them as 4^3 patches, by matrix products; else transposed convolutions of
    kernel 4 and convolutions throughout, as 3D-GAN (a third of the speed on CPUs, whose single-channel kernels are slow)."""
    orientation: Literal["mixture", "angle", "sincos"] = "mixture"
    """Form of the orientation latent: a mixture of von Mises azimuths, one wrapped normal an angle, or the paper's
    factorised Gaussian on (sin, cos)."""
    azimuth_components: int = 4
    """Modes of the azimuth mixture."""
    max_concentration: float = 300.0
    """Largest von Mises concentration of a mode (its scale is then 0.058 rad, close to the story's 0.05)."""
    orientation_scale: float = 0.05
    """Scale in rad of the story's orientation latent about the true viewpoint."""
    rotation_concentration: float = 200.0
    """Matrix-Fisher concentration of the observed rotation; 200 stands for a scale of 0.05 rad."""
    objectness_epsilon: float = 1e-3
    """p(o = 0 | object) = p(o = 1 | background) of the story."""
    box_loc: tuple[float, float, float, float] = (0.0, 0.0, 0.9, 0.9)
    """Affine map of the box latent, shift: (centre offset / stride, log size / stride)."""
    box_spread: tuple[float, float, float, float] = (0.3, 0.3, 0.8, 0.8)
    """Affine map of the box latent, factor."""
    box_scale: float = 0.05
    """Scale of the observed box about its latent, in latent units."""
    range_loc: tuple[float, float, float, float] = (-3.0, 0.0, 0.0, 0.8)
    """Affine map of the range latent, shift: (log(range / pixels per radian), offset of the projected centre from the box's
    centre in box sizes, log diagonal in m)."""
    range_spread: tuple[float, float, float, float] = (1.2, 0.15, 0.15, 1.2)
    """Affine map of the range latent, factor."""
    range_scale: float = 0.02
    """Scale of the observed range, direction and size about their latent, in latent units."""

    detector: Literal["", "yolox_nano"] = ""
    """Detector whose predictions are evidence beside the tiny encoder's (`nolbo_ppl.models.hybrid_guide`); none by default."""

    method: MethodName = "nolbo"
    """The method, or one of those it is compared with (`nolbo_ppl.models.baselines.method`)."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise input_error("method", got=repr(self.method), expected=f"one of {list(METHODS)}")
        if self.method != "nolbo" and (self.instances or self.detector):
            got = "a detector" if self.detector else "instance labels"
            raise input_error(f"method {self.method!r}", got=got, expected="neither instance labels nor a detector")
        if len(self.symmetry) != len(self.categories):
            raise input_error("one symmetry per category is needed", got=len(self.symmetry), expected=len(self.categories))
        if len(set(self.categories)) != len(self.categories) or not self.categories:
            raise input_error("category names must be unique", got=self.categories, expected="at least one, no duplicates")
        if len(self.instance_category) != len(self.instances):
            raise input_error(
                "one category per instance is needed", got=len(self.instance_category), expected=len(self.instances)
            )
        if not all(0 <= category < len(self.categories) for category in self.instance_category):
            raise input_error(
                "category of an instance", got=self.instance_category, expected=f"labels below {len(self.categories)}"
            )
        if self.azimuth_components < 1:
            raise input_error("azimuth_components", got=self.azimuth_components, expected="at least 1")
        if self.orientation != "mixture" and self.azimuth_components != 1:
            raise input_error(
                f"orientation {self.orientation!r} has one azimuth mode",
                got=f"{self.azimuth_components} components",
                expected="azimuth_components=1",
                do="modes that are never trained would answer queries",
            )
        if self.instances and self.latent_dim % 2:
            raise input_error("a latent split in two halves", got=self.latent_dim, expected="an even latent_dim")
        if self.glimpse and self.encoder == "darknet19":
            raise input_error("RoI refinement of darknet19", got=f"glimpse={self.glimpse}", expected="glimpse=0")
        if self.glimpse < 0 or self.glimpse_width < 4 or self.glimpse_width % 4:
            raise input_error(
                "RoI refinement",
                got=f"glimpse={self.glimpse}, glimpse_width={self.glimpse_width}",
                expected="glimpse >= 0 and glimpse_width a positive multiple of 4",
            )
        if not 1 <= self.glimpse_maps <= 3 or self.glimpse_blocks < 0:
            raise input_error(
                "RoI refinement",
                got=f"glimpse_maps={self.glimpse_maps}, glimpse_blocks={self.glimpse_blocks}",
                expected="1 to 3 maps, blocks >= 0",
            )
        if self.detector and (self.encoder != "tiny" or self.instances or not self.glimpse):
            raise input_error(
                "a detector beside the encoder",
                got=f"encoder {self.encoder}, glimpse {self.glimpse}",
                expected="the tiny encoder with RoI refinement, no instance labels",
            )
        if self.shape_look < 0 or self.shape_look % 16:
            raise input_error("shape_look", got=self.shape_look, expected="a multiple of 16, or 0")
        if self.shape_look and (self.encoder != "tiny" or self.instances or self.method != "nolbo"):
            got = f"encoder {self.encoder}, {len(self.instances)} instances, method {self.method}"
            raise input_error("a look at shapes", got=got, expected="the tiny encoder, no instance labels, method nolbo")
        if self.image_size % 32 or self.image_size <= 0:
            raise input_error("image_size", got=self.image_size, expected="a positive multiple of 32")
        for name in ("decoder_channels", "voxel_encoder_channels"):
            channels = getattr(self, name)
            if 4 * 2 ** len(channels) != self.voxel_size:
                raise input_error(
                    f"{name} do not reach the voxel grid",
                    got=f"{len(channels)} for {self.voxel_size}",
                    expected="one channel count per doubling of a 4^3 grid",
                )
        scales = ("max_concentration", "orientation_scale", "rotation_concentration", "box_scale", "range_scale")
        positive = (*scales, "encoder_width", "head_width", "predictors", "latent_dim", "prior_width")
        lists = ("encoder_channels", "decoder_channels", "voxel_encoder_channels", "box_spread", "range_spread")
        for name, numbers in [(n, (getattr(self, n),)) for n in positive] + [(n, getattr(self, n)) for n in lists]:
            if not all(number > 0 for number in numbers):
                raise input_error(name, got=getattr(self, name), expected="above 0")
        if not 0 < self.objectness_epsilon < 0.5:
            raise input_error("objectness_epsilon", got=self.objectness_epsilon, expected="a number in (0, 0.5)")

    @property
    def description(self) -> Method:
        """What sets the method apart."""
        return METHODS[self.method]

    @property
    def stride(self) -> int:
        """Pixels of a cell's side."""
        return 16 if self.encoder == "tiny" else 32

    @property
    def category_dim(self) -> int:
        """Dimensions of the latent that describe the category."""
        return self.latent_dim // 2 if self.instances else self.latent_dim

    @property
    def instance_dim(self) -> int:
        """Dimensions of the latent that describe the instance; 0 without instance labels."""
        return self.latent_dim - self.category_dim

    def to_json(self) -> dict[str, Any]:
        """As a dictionary that JSON can hold."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> ModelConfig:
        """From `to_json`'s dictionary. Raises `InputError` naming a field that is unknown, of another type or out of range."""
        if not isinstance(values, dict):
            raise input_error("model configuration", got=type(values).__name__, expected="an object")
        return cls(**check_fields(cls, values, "a model configuration", LARGEST, LARGEST_OF))


def tiny() -> ModelConfig:
    """The default for CPUs: 4.2 M parameters (3.0 M of them the image guide), 192 px, 32^3 voxels."""
    return ModelConfig(encoder_blocks=(1, 3, 4), glimpse_maps=3, glimpse_blocks=2, glimpse_detail=True, image_size=192)


def photo() -> ModelConfig:
    """For photographs: `tiny` for objects cut out, the evidence of a detector and of `tiny` as it was beside it, 416 px, 6.9 M
    parameters."""
    return dataclasses.replace(tiny(), detector="yolox_nano", image_size=416)


def nano() -> ModelConfig:
    """For demonstrations and tests: 0.15 M parameters, 64 px, learns the outlines within minutes and no more."""
    return ModelConfig(
        encoder_channels=(8, 16, 32, 48),
        encoder_blocks=(0, 1, 1),
        head_width=96,
        glimpse_width=32,
        image_size=64,
        prior_width=32,
        decoder_channels=(32, 16, 8),
        voxel_encoder_channels=(16, 16, 32),
    )


def paper() -> ModelConfig:
    """The paper's network: darknet19, one orientation mode, 64^3 voxels, 448 px."""
    return ModelConfig(
        encoder="darknet19",
        glimpse=0,
        image_size=448,
        voxel_size=64,
        decoder_channels=(512, 256, 128, 64),
        voxel_encoder_channels=(64, 128, 256, 512),
        voxel_patches=False,
        orientation="angle",
        azimuth_components=1,
        max_concentration=400.0,
    )


PRESETS = {"nano": nano, "tiny": tiny, "photo": photo, "paper": paper}
"""The named configurations."""
