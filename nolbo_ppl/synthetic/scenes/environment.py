"""Light and backdrop of a random scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from nolbo_ppl._moved import renamed
from nolbo_ppl.synthetic.renderer.camera_view import Environment, Light, Surface
from nolbo_ppl.synthetic.renderer.materials import hsv
from nolbo_ppl.synthetic.scenes.background_images import BackgroundImages, drawn_background
from nolbo_ppl.synthetic.scenes.scene_config import SceneConfig


def _tint(rng: np.random.Generator, tint: float) -> np.ndarray:
    """A colour near white: warm against cool, with a little green against magenta."""
    warm, green = rng.uniform(-tint, tint), rng.uniform(-tint, tint) * 0.3
    return np.array([1 + warm, 1 + green, 1 - warm])


def sample_light(
    config: SceneConfig, rng: np.random.Generator, R_camera_world: Float[np.ndarray, "3 3"]
) -> tuple[tuple[Light, ...], Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """One or two lights, and the ambient light from above and from below."""
    lights = []
    count = 1 + int(rng.random() < config.second_light_probability)
    strength = rng.uniform(0.4, 1.0)
    for number in range(count):
        azimuth, elevation = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(*config.sun_elevation))
        world = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        share = 1.0 if number == 0 else rng.uniform(0.2, 0.6)
        lights.append(Light(R_camera_world @ world, _tint(rng, config.tint) * strength * share))
    ambient = (1.15 - strength) * rng.uniform(0.6, 1.0)
    sky = _tint(rng, config.tint) * ambient
    return tuple(lights), sky, sky * rng.uniform(0.3, 0.8)


def daylight(
    lights: tuple[Light, ...], backdrop: Environment, up: Float[np.ndarray, " 3"], rng: np.random.Generator
) -> tuple[tuple[Light, ...], Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Lights and ambient light that go with a sky: the sun where the first light was, redder and weaker the lower it stands,
    or an overcast sky without one; from below what the ground throws back.

    Args:
        lights: lights drawn before; the direction of the first one is the sun's.
        backdrop: the sky and the ground.
        up: the world's up in the camera frame.
        rng: draws the weather.
    """
    sky = np.asarray(backdrop.zenith, dtype=np.float64)
    ground = np.asarray(backdrop.ground.colours, dtype=np.float64).mean(0)
    if rng.random() < 0.35:
        grey = sky.mean() * rng.uniform(0.9, 1.3) + 0.1
        above = np.full(3, grey) + 0.15 * (sky - sky.mean())
        return (), above, above * ground
    sine = float(np.clip(lights[0].direction @ up, 0.0, 1.0))
    height = min(sine / 0.5, 1.0)  # from 30 degrees on it is as white as it gets
    colour = np.array([1.0, 0.62 + 0.34 * height, 0.32 + 0.56 * height]) * rng.uniform(0.7, 1.2) * (0.45 + 0.55 * height)
    above = rng.uniform(0.25, 0.5) * (0.7 * sky / max(float(sky.max()), 1e-3) + 0.1)
    return (Light(lights[0].direction, colour),), above, ground * (above + 0.5 * sine * colour)


def _two_colours(rng: np.random.Generator, muted: bool) -> np.ndarray:
    """Two related albedos of a ground or wall."""
    hue = rng.choice([0.08, 0.1, 0.12, 0.25, 0.3, 0.6]) + rng.normal(0, 0.03) if muted else rng.random()
    saturation = rng.uniform(0.0, 0.3) if muted else rng.uniform(0.1, 0.75)
    value = rng.uniform(0.25, 0.85)
    other = np.clip(value + rng.normal(0, 0.15), 0.1, 0.95)
    shift = rng.normal(0, 0.02 if muted else 0.15)
    return np.array([hsv(hue % 1, saturation, value), hsv((hue + shift) % 1, saturation * rng.uniform(0.5, 1), other)])


def _surface(config: SceneConfig, rng: np.random.Generator, textured: bool) -> Surface:
    colours = _two_colours(rng, rng.random() < config.muted)
    if textured:
        pattern = str(rng.choice(["noise", "checker", "stripes", "tiles"], p=[0.55, 0.15, 0.15, 0.15]))
    else:
        pattern = "noise" if rng.random() < 0.6 else "plain"
        colours[1] = 0.8 * colours[0] + 0.2 * colours[1]
    frequency = float(np.exp(rng.uniform(np.log(0.7), np.log(8.0))))
    return Surface(colours, pattern, frequency, int(rng.integers(2**31)))


def sample_environment(
    config: SceneConfig,
    rng: np.random.Generator,
    R_camera_world: Float[np.ndarray, "3 3"],
    photographs: BackgroundImages | None,
) -> Environment:
    """Sky, ground, perhaps a wall; or a photograph or drawn picture in their place."""
    weights = np.array(config.backgrounds, dtype=np.float64)
    kind = int(rng.choice(4, p=weights / weights.sum()))
    photograph = photographs is not None and rng.random() < config.photographs
    blue = rng.random() < 0.6
    zenith = np.array(hsv(rng.uniform(0.55, 0.62), rng.uniform(0.3, 0.65), rng.uniform(0.6, 0.95)))
    if not blue:
        zenith = np.array(hsv(rng.random(), rng.uniform(0.0, 0.15), rng.uniform(0.35, 0.95)))
    pale = zenith.max() * rng.uniform(0.8, 1.1)
    horizon = np.clip(zenith * 0.35 + 0.65 * pale, 0, 1)
    ground = _surface(config, rng, textured=kind == 1 or (kind == 2 and rng.random() < 0.5))
    wall, distance, normal = None, 10.0, None
    if kind == 2:
        wall = _surface(config, rng, textured=rng.random() < 0.5)
        distance = float(np.exp(rng.uniform(np.log(3.0), np.log(12.0))))
        turn = rng.uniform(-0.6, 0.6)
        normal = R_camera_world @ np.array([np.sin(turn), np.cos(turn), 0.0])
    picture = None
    if photograph and photographs is not None:
        picture = photographs.crop(rng, config.size, config.size)
    elif kind == 3:
        picture = drawn_background(rng, config.size, config.size)
    return Environment(
        zenith,
        horizon,
        ground,
        wall,
        distance,
        normal,
        picture,
        clouds=rng.uniform(0, 0.8) if rng.random() < 0.6 else 0.0,
        seed=int(rng.integers(2**31)),
    )


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
