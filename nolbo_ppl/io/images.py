"""Images: the one place that decides which files are images, their order, and how they are decoded.

Whatever the file is, every verb sees upright RGB of eight bits; depth images keep their values.
"""

from __future__ import annotations

import re
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Int, UInt8
from PIL import Image, ImageOps

from nolbo_ppl.errors import InputError, input_error

IMAGE_SUFFIXES: tuple[str, ...] = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".ppm", ".pgm", ".pnm", ".tif", ".tiff")
"""Endings of image files, in lower case; files of other names are passed over."""
DECODERS = ("PNG", "JPEG", "BMP", "WEBP", "PPM", "TIFF")
"""Decoders that may run. A file is decoded by its content, not by its name, and among the decoders of Pillow is one that
hands PostScript to an interpreter: only decoders of pixels are named."""
MAXIMUM_PIXELS = 1 << 26
"""Pixels (8192 x 8192) above which an image is refused before it is decoded: a file of 100 kB may hold gigabytes of zeros."""
BACKGROUND = (255, 255, 255)
"""Colour behind transparent pixels, as viewers show them; the colours stored under them are arbitrary."""
UNREADABLE = {".heic": "convert HEIC to JPEG or PNG first", ".heif": "convert HEIF to JPEG or PNG first"} | dict.fromkeys(
    (".cr2", ".nef", ".arw", ".dng", ".raw"), "develop raw files to JPEG, PNG or TIFF first"
)
"""Endings of pictures that are not read, and what to do about them."""

Source = tuple[str | PathLike[str], int | None]
File = str | PathLike[str] | BinaryIO | BytesIO
"""A file, or the bytes of one."""


def _label(file: File, label: str | None) -> str | PathLike[str]:
    """What a picture is called in messages."""
    return label or ("a picture in memory" if not isinstance(file, str | PathLike) else file)


def natural(path: Path) -> tuple[tuple[tuple[int, int, str], ...], str]:
    """Key of sorting in which frame2 comes before frame10; the plain name settles ties such as 01 and 1."""
    pieces = re.split(r"(\d+)", path.name)
    return tuple((0, int(piece), "") if piece.isdecimal() else (1, 0, piece) for piece in pieces), path.name


def is_passed_over(path: Path) -> bool:
    """Hidden files, and what archives of other systems leave behind (`._name`, `__MACOSX`)."""
    return path.name.startswith(".") or path.name == "__MACOSX"


def list_images(folder: str | PathLike[str], *, recursive: bool = False) -> list[Path]:
    """Images of a folder in natural order of their names: the order of the frames in every verb.

    Hidden files, `._*` and `__MACOSX` are passed over. With `recursive`, those of sub-folders follow, folder by folder.

    Example:
        >>> import tempfile, pathlib
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> for name in ("frame10.png", "frame2.TIF", "._frame2.TIF", "notes.txt"):
        ...     _ = (folder / name).write_bytes(b"")
        >>> [path.name for path in list_images(folder)]
        ['frame2.TIF', 'frame10.png']
    """
    inside = [path for path in sorted(Path(folder).iterdir(), key=natural) if not is_passed_over(path)]
    found = [path for path in inside if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    if recursive:
        for path in inside:
            if path.is_dir():
                found += list_images(path, recursive=True)
    return found


def images_of(folder: str | PathLike[str], *, recursive: bool = False) -> list[Path]:
    """`list_images` of a folder that must hold some.

    Raises:
        InputError: no such folder, or no image in it; names pictures of kinds that are not read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise input_error("no such folder of images", file=folder)
    found = list_images(folder, recursive=recursive)
    if not found:
        others = sorted({path.suffix.lower() for path in folder.iterdir()} & UNREADABLE.keys())
        raise input_error(
            "no image in the folder",
            got=f"files ending in {', '.join(others)}" if others else None,
            expected="files ending in " + ", ".join(IMAGE_SUFFIXES),
            do=UNREADABLE[others[0]] if others else None,
            file=folder,
        )
    return found


def _failure(what: str, path: str | PathLike[str], got: object, named_by: Source | None, do: str | None = None) -> InputError:
    """The error of an image; `named_by` is the file and line that named it."""
    if named_by is None:
        return input_error(what, got=got, file=path, do=do)
    return input_error(f"image {Path(path).name}: {what}", got=got, file=named_by[0], line=named_by[1], do=do)


def _opened(file: File, named_by: Source | None, what: str = "not a readable image", label: str | None = None) -> Image.Image:
    """The header of an image, nothing decoded. Raises `InputError` when it is none, or too large."""
    path = _label(file, label)
    try:
        image = Image.open(file, formats=DECODERS)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise _failure("image too large", path, error, named_by, f"at most {MAXIMUM_PIXELS} pixels are read") from None
    except OSError as error:
        got = "no image of a known kind" if error.errno is None else error.strerror
        do = UNREADABLE.get(Path(path).suffix.lower())
        raise _failure(what, path, got, named_by, do) from None
    except Exception as error:  # decoders raise whatever a damaged header makes them run into
        raise _failure(what, path, error, named_by) from None
    if image.width * image.height > MAXIMUM_PIXELS:
        size = f"{image.width} x {image.height} px"
        image.close()
        raise _failure("image too large", path, size, named_by, f"at most {MAXIMUM_PIXELS} pixels are read")
    return image


def _upright(image: Image.Image) -> Image.Image:
    """The image as its camera was held (EXIF orientation); damaged EXIF data say nothing."""
    try:
        orientation = image.getexif().get(0x0112, 1)
    except Exception:  # as above; the pixels may still be good
        return image
    return ImageOps.exif_transpose(image) if orientation in range(2, 9) else image


def _eight_bits(values: np.ndarray, kind: str | None) -> UInt8[np.ndarray, "h w"]:
    """Grey values of more than eight bits as eight.

    Files of 16 bits have a nominal range, of which the upper 8 bits are kept: the same for dark and bright frames. Integers
    of 32 bits and floating point numbers (TIFF) have none; the smallest of 1, 255 and 65535 that holds all values is taken.

    Raises:
        ValueError: values outside of these ranges.
    """
    if values.dtype == np.uint16 or kind in ("PNG", "PPM"):
        return (values.astype(np.int64) >> 8).clip(0, 255).astype(np.uint8)
    low, high = float(values.min()), float(values.max())
    if not (low >= 0 and high <= 65535):
        raise ValueError(f"grey values from {low:g} to {high:g}, expected 0 to 1, 255 or 65535")
    if np.issubdtype(values.dtype, np.floating) and high <= 1:
        return np.round(values * 255).astype(np.uint8)
    return (values if high <= 255 else values / 256).astype(np.uint8)


def _rgb(image: Image.Image, kind: str | None) -> UInt8[np.ndarray, "h w 3"]:
    if image.mode.startswith(("I", "F")):
        return np.repeat(_eight_bits(np.asarray(image), kind)[..., None], 3, axis=2)
    if image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info:
        layer = image.convert("RGBA")
        return np.asarray(Image.alpha_composite(Image.new("RGBA", layer.size, (*BACKGROUND, 255)), layer).convert("RGB"))
    return np.asarray(image.convert("RGB"))


def open_image(
    path: File, *, named_by: Source | None = None, shorter_side: int | None = None, label: str | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Decode an image to upright RGB of eight bits.

    Grey images of 16 bits keep their upper 8 bits, transparent pixels lie on white, palettes are resolved, and the EXIF
    orientation of a camera is applied. Of files with several pictures the first is read.

    Args:
        path: the file, or its bytes; its content decides how it is decoded, among PNG, JPEG, BMP, WebP, PPM/PGM and TIFF.
        label: what bytes are called in messages.
        named_by: file and line of the list that named the image, for messages.
        shorter_side: JPEG files may be decoded smaller (by 2, 4 or 8), but with a shorter side of at least this many px.

    Returns:
        uint8 [height, width, 3], writable by nobody else.

    Raises:
        InputError: no such file, not an image, damaged, or larger than `MAXIMUM_PIXELS`; names the file.

    Example:
        >>> import tempfile, pathlib
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "grey.png"
        >>> Image.fromarray(np.full((2, 3), 0x7B00, np.uint16)).save(file)
        >>> open_image(file)[0, 0].tolist(), open_image(file).shape
        ([123, 123, 123], (2, 3, 3))
    """
    with _opened(path, named_by, label=label) as image:
        try:
            if shorter_side is not None:
                image.draft("RGB", (shorter_side, shorter_side))
            return np.array(_rgb(_upright(image), image.format))
        except Exception as error:  # decoders raise whatever damaged data make them run into
            raise _failure("not a readable image", _label(path, label), error, named_by) from None


def image_size(path: str | PathLike[str], *, named_by: Source | None = None) -> tuple[int, int]:
    """Width and height in px of what `open_image` returns, from the header alone. Raises `InputError` naming the file."""
    with _opened(path, named_by) as image:
        try:
            turned = image.getexif().get(0x0112, 1) in range(5, 9)
        except Exception:  # as in `_upright`
            turned = False
        return (image.height, image.width) if turned else (image.width, image.height)


def exif_focal_length(path: str | PathLike[str]) -> float | None:
    """Focal length in px from the 35 mm equivalent that a camera wrote into a photograph; None where there is none.

    The longer side of the picture is taken for the 36 mm of a film.
    """
    with _opened(path, None) as image:
        try:
            equivalent = float(image.getexif().get_ifd(0x8769).get(0xA405, 0))
        except Exception:  # damaged EXIF data say nothing
            return None
        return equivalent / 36 * max(image.size) if 5 <= equivalent <= 1000 else None


def open_depth_image(path: File, *, named_by: Source | None = None, label: str | None = None) -> Int[np.ndarray, "h w"]:
    """Values of an image of one channel of 16 or 32 bits, unscaled, as int64.

    Raises:
        InputError: not a readable image, or one of several channels or of 8 bits; names the file.
    """
    with _opened(path, named_by, "not a readable depth image", label) as image:
        try:
            values = np.asarray(image)
        except Exception as error:  # decoders raise whatever damaged data make them run into
            raise _failure("not a readable depth image", _label(path, label), error, named_by) from None
    if values.ndim != 2 or values.dtype not in (np.dtype(np.uint16), np.dtype(np.int32)):
        got = f"{values.dtype} {values.shape}, expected one channel of 16 bits"
        raise _failure("not a depth image", _label(path, label), got, named_by)
    return values.astype(np.int64)
