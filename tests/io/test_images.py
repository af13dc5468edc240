"""Which files are images, in which order, and what is decoded."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.images import image_size, images_of, list_images, open_depth_image, open_image

GREY = np.arange(64, dtype=np.uint8).reshape(8, 8) * 3
COLOURS = np.random.default_rng(0).integers(0, 256, (8, 10, 3), dtype=np.uint8)


def test_natural_order_without_what_is_no_image(tmp_path: Path) -> None:
    for name in ("f10.png", "f2.TIF", "f1.jpeg", ".f0.png", "._f1.jpeg", "notes.txt", "Thumbs.db"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    for name in ("__MACOSX", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "f0.webp").write_bytes(b"")
    assert [path.name for path in list_images(tmp_path)] == ["f1.jpeg", "f2.TIF", "f10.png"]
    assert [str(path.relative_to(tmp_path)) for path in list_images(tmp_path, recursive=True)][3:] == ["b/f0.webp"]


def test_no_image(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder of images"):
        images_of(tmp_path / "none")
    (tmp_path / "IMG_1.HEIC").write_bytes(b"")
    with pytest.raises(InputError, match=r"no image in the folder: got files ending in \.heic.*convert HEIC to JPEG"):
        images_of(tmp_path)


@pytest.mark.parametrize("kind", ["png", "tif", "pgm"])
def test_sixteen_bits_are_read_as_eight(tmp_path: Path, kind: str) -> None:
    Image.fromarray(GREY.astype(np.uint16) * 256 + 255).save(tmp_path / f"a.{kind}")
    np.testing.assert_array_equal(open_image(tmp_path / f"a.{kind}"), np.repeat(GREY[..., None], 3, axis=2))


@pytest.mark.parametrize(("dtype", "factor"), [(np.int32, 1), (np.int32, 256), (np.float32, 1), (np.float32, 1 / 255)])
def test_tiff_of_thirty_two_bits(tmp_path: Path, dtype: type, factor: float) -> None:
    Image.fromarray((GREY.astype(float) * factor).astype(dtype)).save(tmp_path / "a.tif")
    np.testing.assert_array_equal(open_image(tmp_path / "a.tif")[..., 1], GREY)


@pytest.mark.parametrize("value", [-1.0, 1e6, np.nan])
def test_grey_values_without_a_known_range(tmp_path: Path, value: float) -> None:
    Image.fromarray(np.full((4, 4), value, np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(InputError, match=r"a\.tif: not a readable image: got grey values from"):
        open_image(tmp_path / "a.tif")


def test_transparent_pixels_lie_on_white(tmp_path: Path) -> None:
    layer = np.concatenate([COLOURS, np.full((8, 10, 1), 255, np.uint8)], axis=2)
    layer[0, 0, 3] = 0
    Image.fromarray(layer).save(tmp_path / "a.png")
    image = open_image(tmp_path / "a.png")
    assert image[0, 0].tolist() == [255, 255, 255]
    np.testing.assert_array_equal(image[1:], COLOURS[1:])


def test_palettes_one_bit_and_cmyk(tmp_path: Path) -> None:
    flat = np.zeros((6, 6, 3), np.uint8)
    flat[:3] = (200, 10, 30)
    Image.fromarray(flat).convert("P", palette=Image.Palette.ADAPTIVE).save(tmp_path / "palette.png")
    np.testing.assert_array_equal(open_image(tmp_path / "palette.png"), flat)
    Image.fromarray(flat[..., 0] > 0).save(tmp_path / "bits.png")
    np.testing.assert_array_equal(open_image(tmp_path / "bits.png")[..., 2], np.where(flat[..., 0] > 0, 255, 0))
    Image.fromarray(flat).convert("CMYK").save(tmp_path / "cmyk.tif")
    np.testing.assert_array_equal(open_image(tmp_path / "cmyk.tif"), flat)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_stand_upright(tmp_path: Path, orientation: int) -> None:
    """Orientation n stores the upright image turned by the inverse of what a viewer does to it (EXIF 2.3, tag 274)."""
    stored = {
        1: COLOURS,
        2: COLOURS[:, ::-1],
        3: COLOURS[::-1, ::-1],
        4: COLOURS[::-1],
        5: COLOURS.transpose(1, 0, 2),
        6: np.rot90(COLOURS, 1),
        7: COLOURS[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(COLOURS, -1),
    }[orientation]
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.ascontiguousarray(stored)).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_array_equal(open_image(tmp_path / "a.png"), COLOURS)
    assert image_size(tmp_path / "a.png") == (10, 8)


def test_only_decoders_of_pixels_run(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 96 48\n{ } loop\nshowpage\n")
    with pytest.raises(InputError, match=r"a\.png: not a readable image: got no image of a known kind"):
        open_image(tmp_path / "a.png")


def png(width: int, height: int, data: bytes) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")

    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


@pytest.mark.parametrize("side", [9000, 11000, 60000])
def test_sizes_are_looked_at_before_anything_is_decoded(tmp_path: Path, side: int) -> None:
    (tmp_path / "a.png").write_bytes(png(side, side, b"\0" * 1000))
    for reader in (open_image, image_size, open_depth_image):
        with pytest.raises(InputError, match=r"a\.png: image too large"):
            reader(tmp_path / "a.png")


def test_damaged_images_name_their_file_or_the_list_that_named_them(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(png(64, 64, b"\0" * 100))
    with pytest.raises(InputError, match=r"a\.png: not a readable image"):
        open_image(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"rgb\.txt:7: image a\.png: not a readable image"):
        open_image(tmp_path / "a.png", named_by=(tmp_path / "rgb.txt", 7))
    with pytest.raises(InputError, match=r"none\.png: not a readable image: got No such file"):
        open_image(tmp_path / "none.png")
    with pytest.raises(InputError, match="not a readable image: got Is a directory"):
        open_image(tmp_path)


def test_every_cut_of_a_file_is_refused_or_read(tmp_path: Path) -> None:
    """Nothing but `InputError` leaves the reader, wherever the file ends."""
    for kind in ("png", "jpg", "bmp", "webp", "ppm", "tif"):
        Image.fromarray(COLOURS).save(tmp_path / f"whole.{kind}")
        content = (tmp_path / f"whole.{kind}").read_bytes()
        refused = 0
        for end in range(0, len(content), max(1, len(content) // 40)):
            (tmp_path / f"cut.{kind}").write_bytes(content[:end])
            try:
                open_image(tmp_path / f"cut.{kind}")
            except InputError:
                refused += 1
        assert refused > 10, kind


def test_depth_keeps_its_values(tmp_path: Path) -> None:
    values = np.arange(64, dtype=np.uint16).reshape(8, 8) * 1000
    Image.fromarray(values).save(tmp_path / "a.png")
    np.testing.assert_array_equal(open_depth_image(tmp_path / "a.png"), values)
    Image.fromarray(COLOURS).save(tmp_path / "b.png")
    with pytest.raises(InputError, match=r"b\.png: not a depth image: got uint8 \(8, 10, 3\)"):
        open_depth_image(tmp_path / "b.png")


def test_jpeg_may_be_decoded_smaller(tmp_path: Path) -> None:
    Image.fromarray(np.full((400, 640, 3), 90, np.uint8)).save(tmp_path / "a.jpg")
    small = open_image(tmp_path / "a.jpg", shorter_side=100)
    assert small.shape == (100, 160, 3)
    assert abs(int(small.mean()) - 90) < 2
