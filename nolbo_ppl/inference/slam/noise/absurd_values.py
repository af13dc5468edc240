"""Values that would take the whole map away, set aside one by one and named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nolbo_ppl.inference.slam.slam_problem import SlamProblem
from nolbo_ppl.structures.detections import Detections

ABSURD = 1e4
"""A latent coordinate this many robust scales from the median of all is no latent."""
FEW = 0.02
"""More than this part of all latents so far out are a population, however wide."""
MOST_MODES = 12
"""Modes of an orientation that are kept, the heaviest: cost grows with their square."""


def without_absurd_values(problem: SlamProblem) -> tuple[SlamProblem, tuple[str, ...]]:
    """The problem without absurd latents and without more than `MOST_MODES` modes, and what was set aside, in words."""
    table, warnings = problem.observations, []
    if table.latent_dim and table.has_latent.any():
        table, text = _latents(table)
        warnings += text
    if table.modes > MOST_MODES:
        order = np.argsort(-table.mode_weight, axis=1, kind="stable")[:, :MOST_MODES]
        rows = np.arange(len(table))[:, None]
        weight = table.mode_weight[rows, order]
        lost = float(np.max(1 - weight.sum(axis=1)[table.mode_weight.sum(axis=1) > 0], initial=0.0))
        total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
        table = replace(
            table,
            mode_weight=np.where(table.mode_weight.sum(axis=1, keepdims=True) > 0, weight / total, 0.0),
            mode_rotation=table.mode_rotation[rows, order],
            mode_std=table.mode_std[rows, order],
        )
        warnings.append(
            f"orientations have up to {problem.observations.modes} modes: the {MOST_MODES} heaviest of each are kept "
            f"(at most {lost:.2f} of a weight is lost)"
        )
    return (problem if table is problem.observations else replace(problem, observations=table)), tuple(warnings)


def _latents(table: Detections) -> tuple[Detections, list[str]]:
    """Latents far outside all others become missing."""
    known = table.has_latent
    latent = table.latent[known]
    middle = np.median(latent, axis=0)
    width = np.median(np.abs(latent - middle), axis=0)
    scale = table.latent_scale[known]
    width = np.maximum(width, np.nan_to_num(np.median(scale, axis=0))) + 1e-9 * (1 + np.abs(middle))
    with np.errstate(over="ignore"):
        far = ~(np.abs(latent / width - middle / width) < ABSURD).all(axis=1)
    if not far.any() or far.sum() > max(1, FEW * len(latent)):
        return table, []
    rows = np.flatnonzero(known)[far]
    cleared = table.latent.copy()
    cleared[rows] = np.nan
    names = [str(table.id[k]) if table.id[k] is not None else f"row {k}" for k in rows[:3]]
    more = f" and {len(rows) - 3} more" if len(rows) > 3 else ""
    text = f"the latent of {', '.join(names)}{more} lies {ABSURD:g} times the spread of all others away: set aside"
    weight = table.latent_mode_weight.copy()
    weight[rows] = 0.0
    return replace(table, latent=cleared, latent_mode_weight=weight), [text]
