"""Augmentation of images with their labels: colour, blur, noise, scale and translation.

An image is never flipped alone, which would make azimuths wrong; whole scenes are mirrored, objects and all, before
(`nolbo_ppl.data.mirror`).

Scale and translation are a crop or a zoom: boxes and intrinsics follow, so that positions and viewpoints stay exact.
Every scene has a seed of its own: what is drawn does not depend on how a batch is spread over processes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nolbo_ppl.errors import input_error
from nolbo_ppl.models.scene_batch import SceneBatch


@dataclass(frozen=True)
class Augmentation:
    """Ranges and probabilities; ranges are (least, greatest)."""

    mirror_probability: float = 0.5
    """Share of scenes that are mirrored, labels and shapes with the image (done by `SceneLoader`, which knows the shapes)."""
    scale: tuple[float, float] = (0.85, 1.35)
    """Zoom factor, log-uniform."""
    translation: float = 0.08
    """Greatest shift along each side, as a share of the image."""
    geometric_probability: float = 0.7
    """Share of images that are scaled and shifted."""
    brightness: float = 25.0
    """Greatest change of brightness, of 255."""
    contrast: tuple[float, float] = (0.75, 1.35)
    """Factor of the contrast about mid-grey, log-uniform."""
    saturation: tuple[float, float] = (0.4, 1.4)
    """Factor of the saturation."""
    hue: float = 0.25
    """Greatest turn of the hue, rad."""
    inversion_probability: float = 0.01
    """Share of images with inverted colours."""
    blur_probability: float = 0.15
    """Share of blurred images."""
    noise_probability: float = 0.15
    """Share of images with added noise."""
    noise: float = 8.0
    """Greatest scale of the added noise, of 255."""
    least_visible: float = 0.1
    """Objects of which less stays visible in the image lose their label."""

    def __post_init__(self) -> None:
        if not 0 < self.scale[0] <= self.scale[1]:
            raise input_error("augmentation scale", got=self.scale, expected="0 < least <= greatest")


@dataclass(frozen=True)
class _Draws:
    """What was drawn for each image of a batch."""

    zoom: Float[np.ndarray, " b"]
    shift: Float[np.ndarray, "b 2"]
    colour: Float[np.ndarray, "b 3 3"]
    offset: Float[np.ndarray, " b"]
    blur: Float[np.ndarray, " b"]
    noise: Float[np.ndarray, " b"]


_LUMA = np.array([0.299, 0.587, 0.114])
_TO_YIQ = np.array([[0.299, 0.587, 0.114], [0.596, -0.274, -0.322], [0.211, -0.523, 0.312]])


def _draw(config: Augmentation, seeds: Int[np.ndarray, " b"]) -> _Draws:
    n = len(seeds)
    zoom, shift = np.ones(n), np.zeros((n, 2))
    colour, offset = np.empty((n, 3, 3)), np.zeros(n)
    blur, noise = np.zeros(n), np.zeros(n)
    from_yiq = np.linalg.inv(_TO_YIQ)
    for i, seed in enumerate(seeds):
        rng = np.random.default_rng(int(seed))
        u = rng.random(16)
        if u[0] < config.geometric_probability:
            zoom[i] = config.scale[0] * (config.scale[1] / config.scale[0]) ** u[1]
            shift[i] = (2 * u[2:4] - 1) * config.translation
        angle = (2 * u[4] - 1) * config.hue
        cosine, sine = np.cos(angle), np.sin(angle)
        turn = from_yiq @ np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]]) @ _TO_YIQ
        saturation = config.saturation[0] + (config.saturation[1] - config.saturation[0]) * u[5]
        grey = np.tile(_LUMA, (3, 1))
        contrast = config.contrast[0] * (config.contrast[1] / config.contrast[0]) ** u[6]
        colour[i] = contrast * (grey + saturation * (np.eye(3) - grey)) @ turn
        if u[7] < config.inversion_probability:
            colour[i] = -colour[i]
        offset[i] = (2 * u[8] - 1) * config.brightness
        if u[9] < config.blur_probability:
            blur[i] = u[10]
        if u[11] < config.noise_probability:
            noise[i] = u[12] * config.noise
    return _Draws(zoom, shift, colour, offset, blur, noise)


def augment(batch: SceneBatch, config: Augmentation | None, seeds: Int[np.ndarray, " b"], size: int | None = None) -> SceneBatch:
    """An augmented batch; images come back as floats in 0..255.

    Args:
        batch: scenes with square or oblong images.
        config: what is drawn; None for a change of size only.
        seeds: one seed a scene.
        size: longer side of the resulting images, a multiple of 32; None keeps the size.
    """
    if len(seeds) != len(batch.image):
        raise input_error("augmentation seeds", got=len(seeds), expected=f"one for each of {len(batch.image)} scenes")
    height, width = batch.image.shape[-2:]
    factor = 1.0 if size is None else size / max(height, width)
    target = (max(32, round(height * factor / 32) * 32), max(32, round(width * factor / 32) * 32))
    draws = None if config is None else _draw(config, seeds)
    zoom = np.ones(len(seeds)) if draws is None else draws.zoom
    shift = np.zeros((len(seeds), 2)) if draws is None else draws.shift
    image = batch.image.float()
    moved = size is not None or bool((zoom != 1).any()) or bool(shift.any())
    if moved:
        batch, image = _move(batch, image, zoom, shift, target, 0.0 if config is None else config.least_visible)
    if draws is not None:
        image = _colour(image, draws)
        image = _degrade(image, draws, seeds)
    return batch.replace(image=image)


def _move(
    batch: SceneBatch,
    image: Float[Tensor, "b 3 h w"],
    zoom: Float[np.ndarray, " b"],
    shift: Float[np.ndarray, "b 2"],
    target: tuple[int, int],
    least_visible: float,
) -> tuple[SceneBatch, Float[Tensor, "b 3 h2 w2"]]:
    """Zoom about the middle and shift: pixel x goes to `ratio * (zoom * (x - middle) + middle + shift)`."""
    height, width = image.shape[-2:]
    dtype = batch.box.dtype
    extent = torch.tensor([width, height], dtype=dtype)
    ratio = torch.tensor([target[1] / width, target[0] / height], dtype=dtype)
    z, t = torch.from_numpy(zoom).to(dtype)[:, None], torch.from_numpy(shift).to(dtype) * extent
    factor, constant = z * ratio, ratio * (extent / 2 * (1 - z) + t)
    inverse = torch.zeros(len(image), 2, 3, dtype=image.dtype)
    inverse[:, 0, 0] = inverse[:, 1, 1] = (1 / z[:, 0]).to(image.dtype)
    inverse[:, :, 2] = (-2 * t / (extent * z)).to(image.dtype)
    grid = torch.nn.functional.affine_grid(inverse, [len(image), 3, *target], align_corners=False)
    image = torch.nn.functional.grid_sample(image, grid, padding_mode="border", align_corners=False)
    whole = batch.box * factor.repeat(1, 2)[:, None] + constant.repeat(1, 2)[:, None]
    limit = torch.tensor([target[1], target[0]], dtype=dtype).repeat(2)
    box = torch.minimum(whole.clamp_min(0), limit)
    area = (box[..., 2:] - box[..., :2]).clamp_min(0).prod(-1)
    share = area / (whole[..., 2:] - whole[..., :2]).clamp_min(1e-6).prod(-1)
    visibility = batch.visibility * share.clamp(0, 1)
    side = (box[..., 2:] - box[..., :2]).amin(-1)
    present = batch.present & (visibility >= least_visible) & (side >= 2)
    middle = (box[..., :2] + box[..., 2:]) / 2  # slots that hold nothing keep a harmless box
    safe = torch.cat((middle.clamp_min(0), middle.clamp_min(0) + 1), -1)
    intrinsics = torch.cat((batch.intrinsics[:, :2] * factor, batch.intrinsics[:, 2:] * factor + constant), -1)
    ignore = batch.ignore
    if ignore is not None:
        ignore = torch.minimum((ignore * factor.repeat(1, 2)[:, None] + constant.repeat(1, 2)[:, None]).clamp_min(0), limit)
    moved = batch.replace(
        ignore=ignore,
        box=torch.where(present[..., None], box, safe),
        present=present,
        visibility=visibility,
        intrinsics=intrinsics,
    )
    return moved, image


def _colour(image: Float[Tensor, "b 3 h w"], draws: _Draws) -> Float[Tensor, "b 3 h w"]:
    """One affine map of the colours about mid-grey: brightness, contrast, saturation, hue, inversion."""
    matrix = torch.from_numpy(draws.colour).to(image.dtype)
    offset = torch.from_numpy(draws.offset).to(image.dtype)[:, None, None] + 127.5
    flat = (image - 127.5).flatten(2)
    return torch.baddbmm(offset, matrix, flat).clamp_(0, 255).unflatten(-1, image.shape[-2:])


def _degrade(image: Float[Tensor, "b 3 h w"], draws: _Draws, seeds: Int[np.ndarray, " b"]) -> Float[Tensor, "b 3 h w"]:
    """Blur some images, add noise to some."""
    blurred = np.flatnonzero(draws.blur)
    if len(blurred):
        weight = torch.from_numpy(draws.blur[blurred]).to(image.dtype)[:, None, None, None]
        part = image[blurred]
        smooth = torch.nn.functional.avg_pool2d(part, 3, 1, 1, count_include_pad=False)
        image[blurred] = part + weight * (smooth - part)
    for i in np.flatnonzero(draws.noise):
        generator = torch.Generator().manual_seed(int(seeds[i]))
        image[i] += float(draws.noise[i]) * torch.randn(image[i].shape, generator=generator, dtype=image.dtype)
    return image.clamp_(0, 255)
