"""The last part of a calibration, from whole answers: tails of positions, and how certain an object may be called.

The factors of `calibrate` are fitted on single regions. What is handed out are answers: regions of one object put together, whose
probabilities add up, and positions at boxes. Both numbers here are fitted on those, on held-out scenes.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.metrics.heavy_tails import fit_student_t, supported_probability
from nolbo_ppl.models.posterior_calibration import CERTAIN, Calibration

MIN_CASES = 50
"""Fewer held-out objects or detections than this change nothing."""


def calibrate_answers(
    calibration: Calibration,
    squared: Float[np.ndarray, " n"],
    objectness: Float[np.ndarray, " k"],
    right: Bool[np.ndarray, " k"],
) -> Calibration:
    """The calibration with tails and limit fitted.

    Args:
        calibration: that of the answers; its own `objectness_limit` must still be `CERTAIN`.
        squared: squared distances of the true positions under the stated covariances.
        objectness: of detections that are judged.
        right: whether each is an object.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> found = calibrate_answers(Calibration(), 1.5 * rng.f(3, 4.0, 500), np.full(98, 0.9999), np.ones(98, bool))
        >>> round(found.objectness_limit, 3), 2.5 < found.position_dof < 7
        (0.99, True)
    """
    changes: dict[str, float] = {}
    if len(squared) >= MIN_CASES:
        tails = fit_student_t(squared, 3)
        changes |= {"position_dof": tails.dof, "position_spread": tails.spread}
    if len(objectness) >= MIN_CASES:
        changes["objectness_limit"] = min(supported_probability(objectness, right.astype(np.float64)), CERTAIN)
    return dataclasses.replace(calibration, **changes)
