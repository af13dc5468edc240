"""Smooth edges at a fraction of the rays: pixels that differ from a neighbour are rendered again with several rays."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.synthetic.renderer.camera_view import View
from nolbo_ppl.synthetic.renderer.ray_casting import Hits, shade, shade_rays, trace_pixels

CONTRAST = 0.08
"""Difference of display values (full range 1) from a neighbour from which on a pixel is rendered again."""


def uneven(colour: Float[np.ndarray, "height width 3"], contrast: float = CONTRAST) -> Bool[np.ndarray, "height width"]:
    """Pixels whose display value differs from the right, left, upper or lower neighbour by more than `contrast`."""
    display = np.sqrt(np.clip(colour, 0, 1))  # near enough to gamma 2.2, and ten times as fast
    flag = np.zeros(colour.shape[:2], dtype=bool)
    across = np.abs(np.diff(display, axis=1)).max(axis=-1) > contrast
    down = np.abs(np.diff(display, axis=0)).max(axis=-1) > contrast
    flag[:, 1:] |= across
    flag[:, :-1] |= across
    flag[1:] |= down
    flag[:-1] |= down
    return flag


def shade_smoothly(view: View, hits: Hits, rays: int, contrast: float = CONTRAST) -> Float[np.ndarray, "height width 3"]:
    """Linear RGB of every pixel, the mean of `rays` by `rays` rays where it differs from a neighbour.

    Four rays everywhere cost twice as much and look the same.

    Args:
        view: what there is to see; no background picture.
        hits: what one ray a pixel meets.
        rays: rays along each side of such a pixel; 1 renders none again.
        contrast: see `uneven`.
    """
    if view.backdrop.picture is not None:
        raise input_error("smooth edges before a picture", expected="a view without a background picture")
    colour = shade(view, hits)
    if rays == 1:
        return colour
    rows, columns = np.nonzero(uneven(colour, contrast))
    if not len(rows):  # a picture of one colour, as of a wall right before the camera
        return colour
    position = (np.arange(rays) + 0.5) / rays
    offsets = np.stack(np.meshgrid(position, position), axis=-1).reshape(-1, 2)
    slopes, index, face, depth = trace_pixels(view, hits.windows, rows, columns, offsets)
    again = shade_rays(view, slopes.reshape(-1, 2), index.ravel(), face.ravel(), depth.ravel())
    # Highlights are clipped before the mean, as they are in the picture: else one bright ray whitens the whole pixel.
    colour[rows, columns] = np.minimum(again, 1.2).reshape(len(rows), -1, 3).mean(axis=1)
    return colour
