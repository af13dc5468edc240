"""What the scenes of a data set look like: ranges and probabilities, with three presets."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import input_error

RENDERED = 128
"""Greatest side, px, of scenes generated to learn from and to measure on; networks that look at larger images see them
enlarged."""
DIFFICULTIES: tuple[str, ...] = ("easy", "standard", "full")


@dataclass(frozen=True)
class SceneConfig:
    """Ranges are (least, greatest), drawn uniformly unless the field says otherwise."""

    size: int = 128
    """Height and width of the image, px; a multiple of 32."""
    categories: tuple[str, ...] = CATEGORIES
    """Categories drawn, each as often as the others."""
    objects: tuple[int, int] = (1, 4)
    """Number of objects tried in a scene; fewer remain where there is no room."""
    empty_probability: float = 0.03
    """Share of scenes without any object."""
    clutter: tuple[int, int] = (0, 2)
    """Number of things that are no object."""
    object_pixels: tuple[float, float] = (26.0, 0.9)
    """Projected box diagonal of an object: least in px, greatest as a share of the image size; drawn log-uniformly."""
    clutter_pixels: tuple[float, float] = (8.0, 0.6)
    """The same for clutter."""
    focal: tuple[float, float] = (0.75, 2.5)
    """Focal length over image size, drawn log-uniformly."""
    principal_point: float = 0.03
    """Greatest shift of the principal point from the middle, over image size."""
    elevation: tuple[float, float] = (2.0, 45.0)
    """Downward tilt of the optical axis, degrees."""
    steep_probability: float = 0.08
    """Share of scenes seen from steeper above, up to `steep_elevation`."""
    steep_elevation: float = 78.0
    """Greatest tilt of those, degrees."""
    least_elevation: float = -6.0
    """Least elevation from which an object is seen, degrees (large objects near a low camera)."""
    roll: float = 6.0
    """Scale (standard deviation) of the roll of the camera, degrees, cut at three times that."""
    flying_probability: float = 0.4
    """Share of aeroplanes that are in the air, banked and pitched."""
    near_probability: float = 0.2
    """Share of objects placed beside one that is there already, so that they occlude each other."""
    truncation_probability: float = 0.06
    """Share of objects whose centre may lie anywhere in the image, so that its border cuts them."""
    single_material: float = 0.0
    """Share of objects whose parts all have one paint, as CAD meshes without materials do."""
    least_visibility: float = 0.15
    """Objects of which less is seen are taken out of the scene (not only out of the labels)."""
    least_box: float = 5.0
    """Objects whose box has a side below this many px are taken out of the scene too."""
    backgrounds: tuple[float, float, float, float] = (0.5, 0.3, 0.15, 0.05)
    """Weights of: plain ground and sky, textured ground and sky, a room with a wall, a drawn picture."""
    photographs: float = 0.5
    """Share of scenes before a photograph, when a folder of photographs is given."""
    muted: float = 0.9
    """Share of grounds and walls in muted colours."""
    sun_elevation: tuple[float, float] = (25.0, 80.0)
    """Height of the main light, degrees."""
    second_light_probability: float = 0.25
    """Share of scenes with a second, weaker light; it throws shadows too."""
    tint: float = 0.1
    """Greatest departure of the light's channels from white, as a share."""
    exposure: tuple[float, float] = (0.75, 1.25)
    """Factor on the light that reaches the sensor."""
    blur: float = 0.5
    """Greatest scale of the blur, px."""
    noise: float = 0.01
    """Greatest scale of the sensor noise, over full range."""
    supersample: int = 1
    """Rays a pixel along each side; 2 costs four times the rays and removes jagged edges."""
    motion_blur: float = 0.0
    """Greatest path of the camera during the exposure, px."""
    vignetting: float = 0.0
    """Greatest share of the light that is lost in the corners."""
    jpeg_quality: tuple[int, int] = (100, 100)
    """Quality of the compression; 100 is none."""
    occluders: int = 0
    """Greatest number of people and plants in a scene."""
    daylight: float = 0.0
    """Share of scenes in the open that are lit by the sky they show: a sun whose colour follows its height, or clouds alone."""

    def __post_init__(self) -> None:
        if self.size <= 0 or self.size % 32:
            raise input_error("size of the scenes", got=self.size, expected="a positive multiple of 32")
        unknown = sorted(set(self.categories) - set(CATEGORIES))
        if unknown or not self.categories:
            raise input_error("categories of the scenes", got=list(self.categories), expected=", ".join(CATEGORIES))
        if not 0 <= self.objects[0] <= self.objects[1] <= 8:
            raise input_error("number of objects a scene", got=self.objects, expected="least <= greatest <= 8")
        if self.supersample < 1:
            raise input_error("rays a pixel", got=self.supersample, expected="at least 1")
        if not 1 <= self.jpeg_quality[0] <= self.jpeg_quality[1] <= 100:
            raise input_error("jpeg_quality", got=self.jpeg_quality, expected="1 <= least <= greatest <= 100")
        if not (0 <= self.vignetting <= 1 and 0 <= self.daylight <= 1):
            raise input_error("vignetting and daylight", got=(self.vignetting, self.daylight), expected="shares from 0 to 1")
        if self.motion_blur < 0 or self.occluders < 0:
            raise input_error("motion_blur and occluders", got=(self.motion_blur, self.occluders), expected="at least 0")

    def described(self) -> dict[str, Any]:
        """All fields by name, those that are newer than some caches only where they differ from their default."""
        values = asdict(self)
        newer = ("motion_blur", "vignetting", "jpeg_quality", "occluders", "daylight")
        defaults = {field.name: field.default for field in fields(self)}
        return {name: value for name, value in values.items() if name not in newer or value != defaults[name]}


def easy(size: int = 128) -> SceneConfig:
    """Up to three upright, whole objects on plain ground, little clutter: what the feasibility study learnt from."""
    return SceneConfig(
        size=size,
        objects=(1, 3),
        clutter=(0, 1),
        object_pixels=(20.0, 0.85),
        elevation=(8.0, 40.0),
        steep_probability=0.0,
        roll=2.0,
        near_probability=0.1,
        truncation_probability=0.0,
        least_visibility=0.4,
        backgrounds=(0.8, 0.2, 0.0, 0.0),
        muted=1.0,
        second_light_probability=0.0,
        tint=0.05,
        blur=0.0,
        noise=0.005,
    )


def standard(size: int = 128) -> SceneConfig:
    """The default: occlusion, shadows, clutter, textured backgrounds, light at random."""
    return SceneConfig(size=size)


def full(size: int = 128) -> SceneConfig:
    """Everything at random: heavy clutter and occlusion, truncation, drawn or photographic pictures, coloured light."""
    return SceneConfig(
        size=size,
        objects=(1, 6),
        clutter=(0, 8),
        object_pixels=(12.0, 1.0),
        focal=(0.6, 3.0),
        elevation=(0.0, 50.0),
        steep_probability=0.12,
        steep_elevation=85.0,
        roll=8.0,
        near_probability=0.45,
        truncation_probability=0.3,
        least_visibility=0.1,
        least_box=4.0,
        backgrounds=(0.15, 0.3, 0.2, 0.35),
        photographs=0.7,
        muted=0.4,
        sun_elevation=(10.0, 88.0),
        second_light_probability=0.4,
        tint=0.3,
        exposure=(0.5, 1.6),
        blur=0.9,
        noise=0.035,
    )


def photographic(config: SceneConfig) -> SceneConfig:
    """The same scenes as a phone would take them: motion, noise, poor exposure, vignetting, JPEG; daylight, people, plants.

    Lengths in px are those of 320 px, and follow the size.
    """
    share = config.size / 320
    return replace(
        config,
        exposure=(0.45, 1.7),
        blur=max(config.blur, 1.4 * share),
        noise=max(config.noise, 0.04),
        motion_blur=7.0 * share,
        vignetting=0.5,
        jpeg_quality=(30, 95),
        occluders=2,
        daylight=0.7,
    )


def rendered_size(image_size: int) -> int:
    """Side, px, of the scenes generated for a network that looks at images of `image_size`."""
    return min(image_size, RENDERED)


def preset(difficulty: str, size: int = 128) -> SceneConfig:
    """The preset of that name. Raises `InputError` for an unknown one."""
    makers = {"easy": easy, "standard": standard, "full": full}
    if difficulty not in makers:
        raise input_error("unknown difficulty", got=repr(difficulty), expected=", ".join(DIFFICULTIES))
    return replace(makers[difficulty](), size=size)
