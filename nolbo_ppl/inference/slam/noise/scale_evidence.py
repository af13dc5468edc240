"""Evidence of the odometry's scales: Laplace, on one linearisation, with a bias of the odometry integrated out.

With the graph linearised once, `H = H_rest + H_rotation / a^2 + H_translation / b^2` for factors a and b on the scales of
rotations and translations: an evidence costs one sparse factorisation. A bias (a turn a step, a part of the length of each
step) is six more unknowns of the same system, so that it does not pass for noise.

Detections count with frozen weights. A Cauchy kernel on them, as this module once had, grows slower than the log
determinant falls: it preferred the tightest odometry in every world, by 10 nats where 2.5 and 10 times the default was true.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from nolbo_ppl.inference.slam.linearisation import linearise
from nolbo_ppl.inference.slam.noise.fitted_residuals import whole_graph
from nolbo_ppl.inference.slam.slam_state import SlamState

BIAS_ROTATION = 0.5
"""Prior scale of a turn common to all steps, in units of the median scale of a step's rotation."""
BIAS_RATIO = 0.03
"""Prior scale of a displacement common to all steps, as a part of their length."""
PRIOR_WIDTH = float(np.log(10.0))
"""Standard deviation of the log of a scale's factor on the default: a tenth to a hundred times are within two."""


@dataclass(frozen=True)
class ScaleEvidence:
    """A linearised graph in parts that the factors on the odometry's scales multiply."""

    normal: tuple[scipy.sparse.csc_matrix, scipy.sparse.csc_matrix, scipy.sparse.csc_matrix]
    """`J' J` of all else, of rotations, of translations."""
    gradient: tuple[np.ndarray, np.ndarray, np.ndarray]
    """`J' r` of the same."""
    square: tuple[float, float, float]
    """`r' r` of the same."""
    steps: int
    """Steps of the odometry."""

    def solve(self, rotation: float, translation: float) -> tuple[float, np.ndarray, np.ndarray]:
        """Log evidence (nats, up to a constant) of factors on both scales; the solution, whose last six are the bias, and the
        covariance of these."""
        weight = (1.0, rotation**-2, translation**-2)
        H = sum(w * part for w, part in zip(weight, self.normal)).tocsc()
        g = np.sum([w * part for w, part in zip(weight, self.gradient)], axis=0)
        factor = scipy.sparse.linalg.splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        right = np.zeros((len(g), 7))
        right[:, 0] = g
        right[np.arange(len(g) - 6, len(g)), np.arange(1, 7)] = 1.0
        solution = factor.solve(right)
        error = 0.5 * (sum(w * part for w, part in zip(weight, self.square)) - g @ solution[:, 0])
        determinant = float(np.sum(np.log(np.abs(factor.U.diagonal()))))
        value = -error - 0.5 * determinant - 3 * self.steps * (np.log(rotation) + np.log(translation))
        return float(value), -solution[:, 0], solution[-6:, 1:]


def scale_evidence(state: SlamState) -> ScaleEvidence:
    """Linearise the state's graph, links under their kernels included.

    Raises:
        GraphError: the system is indeterminate.
    """
    linearisation = linearise(whole_graph(state)[0], state.estimate)
    steps = len(state.problem) - 1
    rows = np.arange(linearisation.jacobian.shape[0])
    odometry = (rows >= 6) & (rows < 6 * (steps + 1))
    rotation, translation = odometry & (rows % 6 < 3), odometry & (rows % 6 >= 3)
    length = np.linalg.norm(np.diff(state.problem.odometry[:, :3, 3], axis=0), axis=1)
    bias = np.zeros((len(rows) + 6, 6))
    step = (rows[odometry] - 6) // 6
    column = rows[odometry] % 6
    unit = np.where(column < 3, 1.0 / state.noise.rotation_step[step], length[step] / state.noise.translation_step[step])
    bias[rows[odometry], column] = -unit
    scale = np.repeat([BIAS_ROTATION * float(np.median(state.noise.rotation_step)), BIAS_RATIO], 3)
    bias[len(rows) :] = np.diag(1.0 / scale)
    J = scipy.sparse.hstack(
        [scipy.sparse.vstack([linearisation.jacobian, scipy.sparse.csc_matrix((6, linearisation.jacobian.shape[1]))]), bias]
    ).tocsr()
    r = np.concatenate([linearisation.residual, np.zeros(6)])
    rest = np.concatenate([~odometry, np.ones(6, bool)])
    parts = [np.flatnonzero(rest), np.flatnonzero(rotation), np.flatnonzero(translation)]
    normal = [(J[k].T @ J[k]).tocsc() for k in parts]
    return ScaleEvidence(
        (normal[0], normal[1], normal[2]),
        (J[parts[0]].T @ r[parts[0]], J[parts[1]].T @ r[parts[1]], J[parts[2]].T @ r[parts[2]]),
        (float(r[parts[0]] @ r[parts[0]]), float(r[parts[1]] @ r[parts[1]]), float(r[parts[2]] @ r[parts[2]])),
        steps,
    )


@dataclass(frozen=True)
class ScalePosterior:
    """Posterior of the factors on both scales of the odometry, on a grid of their logs."""

    mean: Float[np.ndarray, " 2"]
    """Mean of the log factors, rotation and translation."""
    deviation: Float[np.ndarray, " 2"]
    """Their standard deviations."""
    gain: Float[np.ndarray, " 2"]
    """Log evidence of the best factor over that of no noise at all (the least factor of the grid), each, nats."""
    over_one: float
    """Log evidence of the best pair over that of one and one, nats."""
    bias: Float[np.ndarray, " 6"]
    """Bias at the mean: turn a step, rad; displacement a length, m per m."""
    bias_deviation: Float[np.ndarray, " 6"]
    """Its standard deviations."""


def scale_posterior(
    evidence: ScaleEvidence,
    free: tuple[bool, bool],
    *,
    grid: Float[np.ndarray, " g"],
    centre: tuple[float, float] = (0.0, 0.0),
    width: float = PRIOR_WIDTH,
) -> ScalePosterior:
    """Evidence over a grid of log factors under a normal prior on them; scales that are not free stay at one.

    Args:
        evidence: the linearised graph.
        free: whether rotation and translation are asked for.
        grid: log factors.
        centre: log factors the prior is centred at (the default over the scale in use).
        width: its standard deviation.
    """
    axes = [grid if is_free else np.zeros(1) for is_free in free]
    value = np.array([[evidence.solve(float(np.exp(a)), float(np.exp(b)))[0] for b in axes[1]] for a in axes[0]])
    prior = [-0.5 * ((axis - c) / width) ** 2 if is_free else np.zeros(1) for axis, c, is_free in zip(axes, centre, free)]
    log_posterior = value + prior[0][:, None] + prior[1][None]
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()
    shares = (weight.sum(axis=1), weight.sum(axis=0))
    mean = np.array([share @ axis for share, axis in zip(shares, axes)])
    deviation = np.array([np.sqrt(share @ (axis - m) ** 2) for share, axis, m in zip(shares, axes, mean)])
    best = value.max()
    gain = np.array([best - value[0].max(), best - value[:, 0].max()])
    one = [int(np.argmin(np.abs(axis))) for axis in axes]
    _, solution, covariance = evidence.solve(float(np.exp(mean[0])), float(np.exp(mean[1])))
    return ScalePosterior(
        mean, deviation, gain, float(best - value[one[0], one[1]]), solution[-6:], np.sqrt(np.maximum(np.diag(covariance), 0.0))
    )
