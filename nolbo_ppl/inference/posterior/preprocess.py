"""Images and intrinsics of any origin, as the network takes them: checked, scaled to multiples of 32, batched by shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.camera import guessed_pinhole

Image = UInt8[np.ndarray, "h w 3"] | UInt8[Tensor, "3 h w"]
"""An image: a uint8 array of height x width x 3 colours, or a torch tensor with the colours first."""
PADDING = 114
"""Grey value of the bars beside an image."""
DETAIL = (1.15, 2.0)
"""Objects are cut out of an image this many times larger than the network sees it whole: where there is less to be gained it is
not kept, and no more for the sake of memory. What it gains has not been measured."""
DETAIL_PIXELS = 1 << 23
"""Pixels of the larger images of a batch (130 MB of normalised colours at all sizes), or one image."""
MIN_SIDE = 8
"""Least height and width of an image, px."""


@dataclass(frozen=True)
class PreprocessedImage:
    """An image as the network takes it."""

    image: UInt8[Tensor, "3 h w"]
    """Scaled; both sides are multiples of 32."""
    camera: Float[Tensor, " 4"]
    """[fx, fy, cx, cy], px of the scaled image."""
    scale: Float[np.ndarray, " 2"]
    """Width and height of the scaled image over those of the given one."""
    extent: tuple[int, int]
    """Width and height of the scaled image without its bars, px."""
    guessed: bool = False
    """The camera is a guess."""
    detail: UInt8[Tensor, "3 h2 w2"] | None = None
    """The image larger than `image`, for looks at objects cut out of it; None where the given one is hardly larger."""
    detail_factor: float = 1.0
    """Pixels of `detail` over those of `image`."""


def guessed_intrinsics(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, " 4"]:
    """Intrinsics [fx, fy, cx, cy], px, that are assumed when none are given: a camera that sees 60 degrees across."""
    return guessed_pinhole(image.shape[1], image.shape[0])


def as_sequence(images: Any) -> tuple[list[Any], bool]:
    """Images as a list, and whether one alone was given."""
    single = (isinstance(images, np.ndarray) and images.ndim == 3) or (isinstance(images, Tensor) and images.dim() == 3)
    return ([images] if single else list(images)), single


def checked(image: Any, intrinsics: Any) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, " 4"]]:
    """An image as an array, and its camera [fx, fy, cx, cy], px, guessed when None.

    Raises:
        InputError: no image, a tiny one, or intrinsics of no camera.
    """
    if isinstance(image, Tensor):
        image = (image.permute(1, 2, 0) if image.dim() == 3 else image).cpu().numpy()
    if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        got = (getattr(image, "shape", type(image).__name__), getattr(image, "dtype", ""))
        raise input_error("an image", got=got, expected="a uint8 array of shape (height, width, 3)")
    height, width = image.shape[:2]
    if min(height, width) < MIN_SIDE:
        raise input_error("an image", got=f"{width} x {height} px", expected=f"at least {MIN_SIDE} x {MIN_SIDE} px")
    if intrinsics is None:
        return image, guessed_intrinsics(image)
    camera = np.asarray(intrinsics, dtype=np.float64)
    if camera.shape != (4,) or not np.isfinite(camera).all() or (camera[:2] <= 0).any():
        raise input_error("intrinsics", got=intrinsics, expected="[fx, fy, cx, cy] in px with positive fx, fy")
    return image, camera


def preprocess(
    image: Any, intrinsics: Any, size: int, dtype: torch.dtype = torch.float32, detailed: bool = False
) -> PreprocessedImage:
    """Scale an image uniformly so that its longer side has the wanted size; grey bars make both multiples of 32.

    The rule of training (`nolbo_ppl.data.dataset_folder.letterbox`), with bars on the right and below: pixels keep their place.

    Args:
        image: see `Image`.
        intrinsics: [fx, fy, cx, cy] in px of the given image; guessed when None.
        size: longer side of the scaled image, px.
        dtype: of the scaled intrinsics.
        detailed: keep the image larger too, where it is (`DETAIL`).

    Raises:
        InputError: see `checked`.
    """
    image, camera = checked(image, intrinsics)
    height, width = image.shape[:2]
    factor = size / max(height, width)
    new = [max(1, round(side * factor)) for side in (width, height)]
    given, image = image, _resized(image, new)
    scale = np.array([new[0] / width, new[1] / height])
    tensor = _padded(image, [side + -side % 32 for side in new])
    scaled = torch.as_tensor(camera * np.tile(scale, 2), dtype=dtype)
    larger = min(1 / factor, DETAIL[1]) if detailed else 1.0
    detail = None
    if larger >= DETAIL[0]:
        sides = [max(1, round(side * factor * larger)) for side in (width, height)]
        detail = _padded(_resized(given, sides), [round(side * larger) for side in (tensor.shape[2], tensor.shape[1])])
    return PreprocessedImage(
        tensor, scaled, scale, (new[0], new[1]), intrinsics is None, detail, larger if detail is not None else 1.0
    )


def _resized(image: UInt8[np.ndarray, "h w 3"], sides: Sequence[int]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """An image of this width and height."""
    if [image.shape[1], image.shape[0]] == [*sides]:
        return image
    from PIL import Image as PillowImage

    return np.asarray(PillowImage.fromarray(image).resize((sides[0], sides[1]), PillowImage.Resampling.BILINEAR))


def _padded(image: UInt8[np.ndarray, "h w 3"], sides: Sequence[int]) -> UInt8[Tensor, "3 h2 w2"]:
    """The image with grey bars on the right and below, up to a width and height."""
    bars = [max(0, side - own) for side, own in zip(sides, (image.shape[1], image.shape[0]))]
    if any(bars):
        image = np.pad(image, ((0, bars[1]), (0, bars[0]), (0, 0)), constant_values=PADDING)
    return torch.from_numpy(np.ascontiguousarray(image[: sides[1], : sides[0]].transpose(2, 0, 1)))


def preprocess_all(
    images: Sequence[Any], intrinsics: Any, size: int, dtype: torch.dtype = torch.float32, detailed: bool = False
) -> list[PreprocessedImage]:
    """Images of any shapes, with intrinsics [4] for all or [n, 4], a row an image; see `preprocess`.

    Raises:
        InputError: a size that is no positive multiple of 32, another number of intrinsics than of images, or what `preprocess`
            refuses.
    """
    if size <= 0 or size % 32:
        raise input_error("size of the scaled images", got=size, expected="a positive multiple of 32")
    count = len(images)
    return [preprocess(image, intrinsics_of(intrinsics, i, count), size, dtype, detailed) for i, image in enumerate(images)]


def intrinsics_of(intrinsics: Any, index: int, count: int) -> Any:
    """Intrinsics of one of `count` images, given for all at once or one an image (None in a list: unknown); None where there are
    none.

    Raises:
        InputError: another number of rows than of images.
    """
    if intrinsics is None:
        return None
    if isinstance(intrinsics, list | tuple) and any(one is None for one in intrinsics):
        values: Any = intrinsics  # of some images alone
    else:
        values = np.asarray(intrinsics, dtype=np.float64)
        if values.ndim == 1:
            return values
    if len(values) != count:
        raise input_error("intrinsics", got=f"{len(values)} rows", expected=f"one for all or one for each of {count} images")
    return values[index]


def same_shape(prepared: Sequence[PreprocessedImage], batch: int) -> list[list[int]]:
    """Groups of at most `batch` images of one shape, in order, as numbers of the images; fewer where their details are large."""
    groups: dict[tuple[int, ...], list[list[int]]] = {}
    for i, one in enumerate(prepared):
        shape = (*one.image.shape, *(() if one.detail is None else one.detail.shape))
        of_shape = groups.setdefault(shape, [[]])
        pixels = 0 if one.detail is None else one.detail.shape[1] * one.detail.shape[2]
        if len(of_shape[-1]) == min(batch, max(1, DETAIL_PIXELS // max(pixels, 1))):
            of_shape.append([])
        of_shape[-1].append(i)
    return [group for of_shape in groups.values() for group in of_shape]


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
