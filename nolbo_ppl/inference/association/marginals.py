"""Association marginals: which detection is which landmark, with a choice of exact and approximate associators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.association.assignment import best_assignments
from nolbo_ppl.inference.association.exact import BUDGET, GATE, sum_associations
from nolbo_ppl.inference.association.k_best import k_best_associations
from nolbo_ppl.inference.association.problem import Frames, infeasible_error, pack_frames

Associator = Literal["exact", "belief_propagation", "softmax", "hungarian", "k_best"]
"""How marginals are found.

exact: the sum over all joint associations (belief propagation for components beyond the budget, which says so).
belief_propagation: loopy, with Bethe's evidence. softmax: each detection by itself, as if landmarks could take several.
hungarian: the best association alone, 0 or 1. k_best: the k best ones, renormalised.
"""


@dataclass(frozen=True)
class AssociationMarginals:
    """Posterior of the association of one frame."""

    weights: Float[np.ndarray, "n m"]
    """Probability of each detection being each landmark; columns sum to at most 1."""
    null: Float[np.ndarray, " n"]
    """Probability of each detection being no landmark; with its row of `weights` it sums to 1."""
    log_evidence: float
    """Log of the summed weight of all joint associations in nats; for approximations, what they put in its place."""
    exact: bool
    """True when the sum over joint associations is complete (up to `gate`)."""
    residual: float | None
    """Belief propagation: largest disagreement of detections and landmarks about a weight at the end; else None."""


def association_marginals(
    log_likelihood: ArrayLike,
    log_null: ArrayLike,
    *,
    associator: Associator = "exact",
    budget: int = BUDGET,
    gate: float = GATE,
    k: int = 200,
) -> AssociationMarginals:
    """Marginals of the joint association of n detections with m landmarks (the E-step, docs/em.md).

    Each detection goes to one landmark or to its own null hypothesis, each landmark takes at most one detection, and a
    joint association weighs the exponential of the sum of its entries. The derivative of `log_evidence` by
    `log_likelihood` is `weights`.

    Args:
        log_likelihood: [n, m] log weight of each detection and landmark in nats, -inf for the impossible.
        log_null: [n] log weight of each detection's null hypothesis in nats, -inf when it must be a landmark.
        associator: how to find them, see `Associator`.
        budget: largest number of subsets the exact sum may keep for one connected component (8 bytes each).
        gate: reduced weights (see `assignment`) below this are taken as zero: an association through one is 1 / gate
            times less probable than the best, or worse. Many ties can add up: an error of 1e-12 on random problems,
            of up to 2^(n - 2) gate in a contrived staircase of exact ties without null hypotheses. 0 keeps all.
        k: how many associations "k_best" sums.

    Raises:
        InputError: wrong shapes, NaN, plus infinity, or no association possible; names detection and landmark.

    Example:
        >>> import nolbo_ppl
        >>> log_likelihood = np.log([[0.8, 0.1], [0.7, 0.1]])  # two detections that look like the first of two landmarks
        >>> found = nolbo_ppl.association_marginals(log_likelihood, log_null=np.log([0.1, 0.1]))
        >>> found.weights.round(3)  # which takes one of them only
        array([[0.485, 0.242],
               [0.424, 0.273]])
    """
    problem = (log_likelihood, log_null)
    return association_marginals_batch([problem], associator=associator, budget=budget, gate=gate, k=k)[0]


def association_marginals_batch(
    problems: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    associator: Associator = "exact",
    budget: int = BUDGET,
    gate: float = GATE,
    k: int = 200,
) -> list[AssociationMarginals]:
    """`association_marginals` of every (log_likelihood, log_null), for thousands of small frames in compiled calls.

    The results of "exact" are views of arrays shared by the batch.
    """
    if associator not in get_args(Associator):
        raise input_error("unknown associator", got=repr(associator), expected=" or ".join(get_args(Associator)))
    if not 0.0 <= gate < 1.0:
        raise input_error("gate of reduced weights", got=gate, expected="a value from 0 to below 1")
    frames = pack_frames(problems)
    if associator == "exact":
        return _exact(frames, budget, gate)
    if associator == "belief_propagation":
        return _exact(frames, 0, gate)
    if associator == "softmax":
        return [_softmax(frames, frame) for frame in range(len(frames))]
    if associator == "hungarian":
        return _hungarian(frames)
    if k < 1:
        raise input_error("number of associations to list", got=k, expected="k of at least 1")
    best_assignments(frames)  # an infeasible frame raises here, by its number in the batch
    return [_k_best(frames, frame, k) for frame in range(len(frames))]


def _exact(frames: Frames, budget: int, gate: float) -> list[AssociationMarginals]:
    """Exact sums within the budget, belief propagation beyond it."""
    sums = sum_associations(frames, budget=budget, gate=gate)
    evidence, exact, residual = sums.log_evidence.tolist(), sums.exact.tolist(), sums.residual.tolist()
    return [
        AssociationMarginals(
            weights=frames.matrix(sums.weights, frame),
            null=frames.rows(sums.null, frame),
            log_evidence=evidence[frame],
            exact=exact[frame] and budget > 0,
            residual=None if exact[frame] else residual[frame],
        )
        for frame in range(len(frames))
    ]


def _softmax(frames: Frames, frame: int) -> AssociationMarginals:
    """Every detection by itself; the evidence is that of a model in which landmarks take any number of detections."""
    scores = np.column_stack([frames.matrix(frames.log_likelihood, frame), frames.rows(frames.log_null, frame)])
    largest = scores.max(axis=1)
    if len(largest) and largest.min() == -np.inf:
        raise infeasible_error(frames, frame, int(np.argmin(largest)), np.full(len(frames.log_null), -1))
    odds = np.exp(scores - largest[:, None])
    total = odds.sum(axis=1)
    probability = odds / total[:, None]
    return AssociationMarginals(
        weights=probability[:, :-1],
        null=probability[:, -1],
        log_evidence=float((np.log(total) + largest).sum()),
        exact=False,
        residual=None,
    )


def _hungarian(frames: Frames) -> list[AssociationMarginals]:
    """The best association alone; the evidence is its log weight, a lower bound."""
    best = best_assignments(frames)
    results = []
    for frame in range(len(frames)):
        match = frames.rows(best.match, frame)
        weights = np.zeros(frames.shape(frame))
        placed = np.flatnonzero(match >= 0)
        weights[placed, match[placed]] = 1.0
        results.append(AssociationMarginals(weights, (match < 0).astype(float), float(best.log_weight[frame]), False, None))
    return results


def _k_best(frames: Frames, frame: int, k: int) -> AssociationMarginals:
    """The k best associations, renormalised; the evidence is their sum, a lower bound. Exact when there are no more."""
    listed = k_best_associations(frames.matrix(frames.log_likelihood, frame), frames.rows(frames.log_null, frame), k + 1)
    kept = listed[:k]
    logs = np.array([association.log_weight for association in kept])
    odds = np.exp(logs - logs[0])
    total = odds.sum()
    weights, null = np.zeros(frames.shape(frame)), np.zeros(frames.shape(frame)[0])
    for association, probability in zip(kept, odds / total):
        placed = association.landmark >= 0
        weights[np.flatnonzero(placed), association.landmark[placed]] += probability
        null[~placed] += probability
    return AssociationMarginals(weights, null, float(logs[0] + np.log(total)), len(listed) <= k, None)
