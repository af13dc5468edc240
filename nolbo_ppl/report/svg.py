"""Small SVG: escaped elements, axes with round ticks, lines and 95 % ellipses. Colours are left to the style sheet."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

CHI2_95 = 5.991464547107979
"""95 % quantile of chi square with two degrees of freedom: the square radius of an ellipse in a plane."""
MOST_POINTS = 1500
"""Lines of more points are thinned: no screen shows more."""


def escape(value: object) -> str:
    """Text that means itself in HTML, between tags and in quoted attributes."""
    return html.escape(str(value), quote=True)


def number(value: float) -> str:
    """A coordinate in px with two decimals: maps are looked at a hundred times as large."""
    return f"{value:.2f}".rstrip("0").rstrip(".") if abs(value) >= 0.005 else "0"


def element(tag: str, content: str | None = None, /, **attributes: object) -> str:
    """An element; `content` is markup, attributes are escaped (`class_` -> class, `data_tip` -> data-tip), None left out."""
    shown = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(value)}"' for name, value in attributes.items() if value is not None
    )
    return f"<{tag}{shown}/>" if content is None else f"<{tag}{shown}>{content}</{tag}>"


def text(x: float, y: float, content: object, **attributes: object) -> str:
    """Text at a place."""
    return element("text", escape(content), x=number(x), y=number(y), **attributes)


def group(parts: Iterable[str], **attributes: object) -> str:
    """Elements together, for instance as a layer that a button hides."""
    return element("g", "".join(parts), **attributes)


def round_ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Round numbers (1, 2 or 5 times a power of ten apart) inside an interval; about `count` of them."""
    if not high > low:
        return [low]
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def tick_label(value: float) -> str:
    """A tick without a trailing fraction or a negative zero."""
    return f"{value:.6g}" if abs(value) > 1e-12 else "0"


@dataclass(frozen=True)
class Axes:
    """A rectangle of the picture that shows a rectangle of the plane, y upwards."""

    x: tuple[float, float]
    y: tuple[float, float]
    width: float
    """Whole picture, px."""
    height: float
    left: float = 58.0
    right: float = 14.0
    top: float = 12.0
    bottom: float = 44.0

    def px(self, x: np.ndarray | float) -> np.ndarray:
        """Horizontal place in the picture."""
        span = self.width - self.left - self.right
        return self.left + (np.asarray(x, dtype=np.float64) - self.x[0]) / (self.x[1] - self.x[0]) * span

    def py(self, y: np.ndarray | float) -> np.ndarray:
        """Vertical place in the picture."""
        span = self.height - self.top - self.bottom
        return self.height - self.bottom - (np.asarray(y, dtype=np.float64) - self.y[0]) / (self.y[1] - self.y[0]) * span

    @property
    def scale(self) -> float:
        """px a unit, where both axes have the same."""
        return (self.width - self.left - self.right) / (self.x[1] - self.x[0])

    def points(self, xy: Float[np.ndarray, "n 2"]) -> str:
        """Points as an SVG list, thinned when there are too many; rows that are not finite are left out."""
        xy = np.asarray(xy)[np.isfinite(xy).all(axis=1)]
        if len(xy) > MOST_POINTS:
            xy = xy[np.unique(np.linspace(0, len(xy) - 1, MOST_POINTS).round().astype(int))]
        return " ".join(f"{number(u)},{number(v)}" for u, v in zip(self.px(xy[:, 0]), self.py(xy[:, 1])))

    def line(self, xy: Float[np.ndarray, "n 2"], **attributes: object) -> str:
        """A line through points."""
        return element("polyline", points=self.points(xy), **attributes)

    def frame(self, xlabel: str, ylabel: str) -> str:
        """Grid, ticks and labels."""
        x0, x1, y0, y1 = self.left, self.width - self.right, self.height - self.bottom, self.top
        across = max(2, int((x1 - x0) / 90))
        up = max(2, int((y0 - y1) / 42))
        parts = []
        for value in round_ticks(*self.x, across):
            u = float(self.px(value))
            parts.append(element("line", x1=number(u), x2=number(u), y1=number(y0), y2=number(y1)))
            parts.append(text(u, y0 + 16, tick_label(value), text_anchor="middle"))
        for value in round_ticks(*self.y, up):
            v = float(self.py(value))
            parts.append(element("line", x1=number(x0), x2=number(x1), y1=number(v), y2=number(v)))
            parts.append(text(x0 - 7, v + 3.5, tick_label(value), text_anchor="end"))
        parts.append(text((x0 + x1) / 2, self.height - 8, xlabel, text_anchor="middle", class_="label"))
        turned = f"rotate(-90 14 {number((y0 + y1) / 2)})"
        parts.append(text(14, (y0 + y1) / 2, ylabel, text_anchor="middle", class_="label", transform=turned))
        return group(parts, class_="frame")

    def clip(self, parts: Iterable[str]) -> str:
        """Elements of which only what lies inside the axes is shown."""
        x, y = self.left, self.top
        width, height = self.width - self.left - self.right, self.height - self.top - self.bottom
        box = f"{number(x)} {number(y)} {number(width)} {number(height)}"
        return element("svg", "".join(parts), x=number(x), y=number(y), width=number(width), height=number(height), viewBox=box)

    def holds(self, xy: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Which points lie inside the axes."""
        low, high = np.array([self.x[0], self.y[0]]), np.array([self.x[1], self.y[1]])
        return np.all((xy >= low) & (xy <= high), axis=1)

    def ellipse(self, centre: Float[np.ndarray, " 2"], covariance: Float[np.ndarray, "2 2"], **attributes: object) -> str:
        """The region of 95 % of a normal density, on axes of equal scale."""
        values, vectors = np.linalg.eigh(covariance)
        radii = np.sqrt(CHI2_95 * np.maximum(values, 0)) * self.scale
        angle = -math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))  # y points down in the picture
        place = f"translate({number(float(self.px(centre[0])))} {number(float(self.py(centre[1])))}) rotate({angle:.1f})"
        return element("ellipse", rx=number(max(radii[1], 0.3)), ry=number(max(radii[0], 0.3)), transform=place, **attributes)


def equal_axes(points: Float[np.ndarray, "n 2"], width: float = 980.0, heights: tuple[float, float] = (360.0, 640.0)) -> Axes:
    """Axes of equal scale around all points; the picture is as high as they need, within limits."""
    points = np.asarray(points)[np.isfinite(points).all(axis=1)]
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.ones(2))
    middle = (low + high) / 2
    span = np.maximum((high - low) * 1.08, max(float((high - low).max()) * 1e-3, 1e-3))
    empty = Axes((0, 1), (0, 1), width, 0)
    across, rims = width - empty.left - empty.right, empty.top + empty.bottom
    up = float(np.clip(across * span[1] / span[0] + rims, *heights)) - rims
    unit = max(span[0] / across, span[1] / up)
    half = np.array([across, up]) * unit / 2
    x, y = (middle[0] - half[0], middle[0] + half[0]), (middle[1] - half[1], middle[1] + half[1])
    return Axes((float(x[0]), float(x[1])), (float(y[0]), float(y[1])), width, up + rims)


def picture(axes: Axes, parts: Iterable[str], label: str, **attributes: object) -> str:
    """The whole SVG, scaled to the width it is given."""
    return element(
        "svg",
        "".join(parts),
        viewBox=f"0 0 {number(axes.width)} {number(axes.height)}",
        role="img",
        aria_label=label,
        **attributes,
    )


def zoomable(axes: Axes, labels: tuple[str, str], parts: Iterable[str], label: str) -> str:
    """A map that the page's script zooms and moves: axes that are drawn anew, and a scene inside of them.

    Without the script it is the same picture at rest.
    """
    stated = {
        "x": [round(value, 9) for value in axes.x],
        "y": [round(value, 9) for value in axes.y],
        "box": [axes.left, axes.top, axes.width - axes.right, axes.height - axes.bottom],
    }
    scene = axes.clip([group(parts, class_="scene")])
    return picture(axes, [axes.frame(*labels), scene], label, data_zoom=json.dumps(stated))
