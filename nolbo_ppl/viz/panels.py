"""The panels of one object's posterior: classes, azimuth, position, latent; and where all objects are."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from nolbo_ppl.structures.object_posteriors import ObjectPosteriors
from nolbo_ppl.viz.overlay import bearing_range_ellipse
from nolbo_ppl.viz.style import INK, MUTED, category_colour, grid, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHOWN = 4
"""Categories in the bars of the class posterior."""
MIN_MODE = 0.05
"""Azimuth modes of less weight are drawn in the density but not marked."""


def draw_classes(axes: Axes, observations: ObjectPosteriors, index: int) -> None:
    """Bars of the most probable categories; a dot marks the one of maximum likelihood over the prior means."""
    posterior = observations.class_posterior[index]
    best = np.argsort(-posterior, kind="stable")[:SHOWN]
    colours = [category_colour(observations.categories[k], observations.categories) for k in best]
    axes.barh(np.arange(len(best)), posterior[best], height=0.62, color=colours)
    for y, k in enumerate(best):
        probability = posterior[k]
        likeliest = observations.categories[k] == observations.category[index]
        text = f"{observations.categories[k]} {probability:.2f}" + (" •" if likeliest else "")
        inside = probability > 0.72
        axes.text(
            probability - 0.03 if inside else probability + 0.03,
            y,
            text,
            va="center",
            fontsize=7,
            ha="right" if inside else "left",
            color="white" if inside else INK,
        )
    axes.set(xlim=(0, 1), ylim=(SHOWN - 0.4, -0.6), yticks=[], xticks=[0, 0.5, 1])
    axes.set_title("class posterior (• likeliest)")


def azimuth_density(observations: ObjectPosteriors, index: int, angle: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Density of the azimuth posterior at angles in rad: a mixture of von Mises."""
    from scipy.special import i0e

    modes = observations.viewpoint_modes
    weight, mean, kappa = modes.weights[index], modes.azimuth[index], np.asarray(modes.concentration[index], np.float64)
    each = np.exp(kappa * (np.cos(angle[:, None] - mean) - 1)) / (2 * math.pi * i0e(kappa))
    return each @ weight


def draw_azimuth(axes: Axes, observations: ObjectPosteriors, index: int, colour: str) -> None:
    """Azimuth density around the object seen from above, its front at the bottom: where the camera stands."""
    angle = np.linspace(-math.pi, math.pi, 721)
    density = azimuth_density(observations, index, angle)
    around = np.stack((np.sin(angle), -np.cos(angle)), axis=1)
    inner, outer = 0.45, 1.05
    edge = around * (inner + (outer - inner) * density / density.max())[:, None]
    hole = inner * around[::-1]
    axes.fill(*np.concatenate((edge, hole)).T, color=colour, alpha=0.5, linewidth=0)
    axes.plot(*edge.T, color=colour, linewidth=1.0)
    axes.plot(*hole.T, color=MUTED, linewidth=0.6)
    modes = observations.viewpoint_modes
    for weight, mean in zip(modes.weights[index], modes.azimuth[index]):
        if weight >= MIN_MODE:
            x, y = inner * math.sin(mean), -inner * math.cos(mean)
            axes.plot([0, x], [0, y], color=INK, linewidth=0.4 + 2.0 * float(weight), solid_capstyle="butt")
    for text, x, y in (("front", 0, -1.19), ("back", 0, 1.19), ("90°", 1.27, 0), ("-90°", -1.27, 0)):
        axes.text(x, y, text, ha="center", va="center", fontsize=6.5, color=MUTED)
    axes.set(xlim=(-1.42, 1.42), ylim=(-1.26, 1.26), aspect="equal")
    plain(axes)
    axes.set_title(f"azimuth {math.degrees(observations.viewpoint[index, 0]):.0f}°")


def distance_density(
    position: Float[np.ndarray, " 3"], covariance: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], float]:
    """Distances, m, the density of the distance there, 1/m, and the scale of its logarithm.

    The guide states a normal density of the logarithm of the distance; the covariance of the position holds its scale to first
    order (`position_covariance`). A normal density of the distance itself would reach behind the camera.

    >>> x, density, scale = distance_density(np.array([0.0, 0.0, 5.0]), np.diag([0.01, 0.01, 9.0]))
    >>> bool(x.min() > 0), round(float(np.sum((density[1:] + density[:-1]) / 2 * np.diff(x))), 2), round(scale, 2)
    (True, 1.0, 0.6)
    """
    distance = float(np.linalg.norm(position))
    ray = position / distance
    scale = math.sqrt(float(ray @ covariance @ ray)) / distance
    x = distance * np.exp(scale * np.linspace(-3.3, 3.3, 241))
    density = np.exp(-0.5 * (np.log(x / distance) / scale) ** 2) / (x * scale * math.sqrt(2 * math.pi))
    return x, density, scale


def draw_position(axes: Axes, observations: ObjectPosteriors, index: int, colour: str) -> None:
    """Density of the distance (log-normal) with its central 90 %, and the position and its scales in words."""
    position, covariance = observations.position[index], observations.position_covariance[index]
    x, density, log_scale = distance_density(position, covariance)
    density = density / density.max()
    distance = float(np.linalg.norm(position))
    low, high = (distance * math.exp(side * 1.6448536 * log_scale) for side in (-1, 1))
    middle = (x >= low) & (x <= high)
    axes.fill_between(x[middle], 0, density[middle], color=colour, alpha=0.45, linewidth=0)
    axes.plot(x, density, color=colour, linewidth=1.2)
    across = np.sqrt(np.diag(covariance))
    words = "\n".join(f"{name} {_uncertain(p, s)}" for name, p, s in zip("xyz", position, across))
    axes.text(0.98, 0.98, words, transform=axes.transAxes, va="top", ha="right", fontsize=6.2, linespacing=1.25)
    width = x[-1] - x[0]
    axes.set(xlim=(max(0.0, x[0] - 0.03 * width), x[-1] + 0.55 * width), ylim=(0, 1.12), yticks=[])
    axes.spines["left"].set_visible(False)
    axes.locator_params(axis="x", nbins=4)
    digits = max(0, min(4, 1 - math.floor(math.log10(max(distance * log_scale, 1e-9)))))
    axes.set_title(f"distance {distance:.{digits}f} m ({low:.{digits}f} to {high:.{digits}f})")


def _uncertain(value: float, scale: float) -> str:
    """Value and scale with two digits of the scale."""
    digits = max(0, min(4, 1 - math.floor(math.log10(max(scale, 1e-9)))))
    return f"{value:.{digits}f} ± {scale:.{digits}f}"


def draw_latent(
    axes: Axes,
    observations: ObjectPosteriors,
    index: int,
    colour: str,
    prior_mean: Float[np.ndarray, "labels d"] | None = None,
) -> None:
    """Mean and scale of each dimension of the shape latent; grey bars are the prior mean of its category."""
    mean, scale = observations.latent[index], observations.latent_scale[index]
    dimension = np.arange(len(mean))
    if prior_mean is not None:
        of_category = prior_mean[observations.categories.index(observations.category[index])]
        axes.bar(dimension, of_category, width=0.8, color="#dfe3e7", zorder=1)
    if len(mean) <= 32:
        axes.errorbar(dimension, mean, scale, fmt="o", color=colour, markersize=2.8, elinewidth=1.1, capsize=1.5, zorder=2)
    else:
        axes.fill_between(dimension, mean - scale, mean + scale, color=colour, alpha=0.35, linewidth=0)
        axes.plot(dimension, mean, color=colour, linewidth=0.8)
    axes.axhline(0, color=MUTED, linewidth=0.6, zorder=0.5)
    axes.margins(x=0.03)
    axes.set_title("shape latent, mean ± scale")
    axes.locator_params(axis="x", integer=True, nbins=9)
    axes.locator_params(axis="y", nbins=5)


def draw_range(axes: Axes, observations: ObjectPosteriors) -> None:
    """Where the objects are: bearing against distance (logarithmic) with 90 % regions and the way each one faces.

    Distances of one image may span centimetres to hundreds of metres; an arrow shows the front's direction seen from
    above, away from the camera pointing up.
    """
    axes.set_yscale("log")
    grid(axes)
    limits = []
    for i, category in enumerate(observations.category):
        colour = category_colour(category, observations.categories)
        outline = bearing_range_ellipse(observations.position[i], observations.position_covariance[i])
        x, y = np.degrees(outline[:, 0]), np.exp(outline[:, 1])
        axes.fill(x, y, color=colour, alpha=0.3, linewidth=0, zorder=2)
        axes.plot(x, y, color=colour, linewidth=1.2, zorder=3)
        limits.append((x.min(), x.max(), y.min(), y.max()))
    if limits:
        low, high = np.min(limits, axis=0), np.max(limits, axis=0)
        reach = max(abs(low[0]), abs(high[1]), 8.0) * 1.18
        axes.set(xlim=(-reach, reach), ylim=(low[2] / 1.35, high[3] * 1.45))
        _number_and_heading(axes, observations)
    axes.set(xlabel="bearing, degrees (right positive)", ylabel="distance, m")
    axes.set_title("positions, 90 % regions, fronts, from above")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if str(f"{value:e}")[0] in "25" else "")
    axes.tick_params(axis="y", which="minor", labelsize=6.5)


def _number_and_heading(axes: Axes, observations: ObjectPosteriors) -> None:
    """Numbers of the objects and arrows of their fronts."""
    for i, category in enumerate(observations.category):
        colour = category_colour(category, observations.categories)
        position = observations.position[i]
        at = (math.degrees(math.atan2(position[0], position[2])), float(np.linalg.norm(position)))
        front = -observations.R_camera_object[i][:, 1]
        heading = np.array([front[0], front[2]])
        length = np.linalg.norm(heading)
        if length > 0.2:
            axes.annotate(
                "",
                xy=at,
                xytext=tuple(22 * heading / length),
                textcoords="offset points",
                zorder=4,
                arrowprops={"arrowstyle": "<|-", "color": colour, "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0},
            )
        axes.annotate(
            str(i + 1),
            at,
            fontsize=7,
            color="white",
            ha="center",
            va="center",
            zorder=5,
            fontweight="bold",
            bbox={"boxstyle": "circle,pad=0.18", "facecolor": colour, "linewidth": 0},
        )
