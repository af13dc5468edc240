"""Pictures side by side with their boxes: what a data set looks like, and whether its boxes lie where they should."""

from __future__ import annotations

from collections.abc import Iterable
from os import PathLike

import numpy as np
from PIL import Image, ImageDraw

from nolbo_ppl.data.format_registry import LabelledPicture
from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.viz.style import category_colour

TILE = (320, 240)
"""Width and height of a picture on the sheet, px."""
LINE = 14
"""Height of its name, px."""
COLUMNS = 4
"""Pictures side by side."""


def contact_sheet(pictures: Iterable[LabelledPicture]) -> Image.Image | None:
    """The sheet; None of no pictures."""
    tiles = [_tile(one) for one in pictures]
    if not tiles:
        return None
    columns = min(COLUMNS, len(tiles))
    rows = -(-len(tiles) // columns)
    sheet = Image.new("RGB", (columns * TILE[0], rows * (TILE[1] + LINE)), (255, 255, 255))
    for k, tile in enumerate(tiles):
        sheet.paste(tile, ((k % columns) * TILE[0], (k // columns) * (TILE[1] + LINE)))
    return sheet


def _tile(one: LabelledPicture) -> Image.Image:
    tile = Image.new("RGB", (TILE[0], TILE[1] + LINE), (255, 255, 255))
    scale = min(TILE[0] / one.image.shape[1], TILE[1] / one.image.shape[0])
    size = (max(round(one.image.shape[1] * scale), 1), max(round(one.image.shape[0] * scale), 1))
    tile.paste(Image.fromarray(one.image).resize(size, Image.Resampling.BILINEAR), (0, LINE))
    draw = ImageDraw.Draw(tile)
    draw.text((2, 1), one.name.encode("ascii", "replace").decode()[-52:], fill=(0, 0, 0))
    names = sorted(set(one.labels))
    for box, label in zip(np.nan_to_num(one.boxes), one.labels):
        x0, y0, x1, y1 = (float(v) * scale for v in box)
        colour = category_colour(label, names)
        draw.rectangle((x0, y0 + LINE, max(x1, x0), max(y1, y0) + LINE), outline=colour, width=2)
        draw.text((x0 + 3, y0 + LINE + 2), label.encode("ascii", "replace").decode(), fill=colour)
    return tile


def write_contact_sheet(path: str | PathLike[str], pictures: Iterable[LabelledPicture]) -> bool:
    """Write it as a PNG file, atomically; false, and nothing written, where there are no pictures."""
    sheet = contact_sheet(pictures)
    if sheet is None:
        return False
    with atomic_path(path) as temporary:
        sheet.save(temporary, "PNG")
    return True
