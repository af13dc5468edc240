"""The scale of monocular odometry from neighbouring frames: what carries one frame's detections onto the next one's.

A first estimate, before tracks exist, for odometry whose unit of length is unknown and wanders. Detections have positions in
metres; carried by a step of the odometry times a scale they lie on the next frame's detections if the scale is right. The
log likelihood of a grid of log scales is summed over windows of the drive, a detection that meets nothing costing a constant,
and a random walk of the log scale between the windows is smoothed forwards and backwards on the grid, which is exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.special import logsumexp, softmax

from nolbo_ppl.geometry.pose import chain, relative
from nolbo_ppl.inference.slam.slam_problem import SlamConfig, SlamProblem

GAPS = (1, 3, 8)
"""Frames between the detections compared: short steps tell the scale only over several frames."""
WINDOW = 10
"""Steps that share one scale."""
NOTHING_MET = -6.0
"""Log density, in units of the peak, of a detection that no carried one explains."""
COARSE = np.arange(-6.0, 6.01, 0.1)
"""Log scales tried for the whole drive."""
FINE = np.arange(-1.2, 1.2001, 0.01)
"""Log scales tried about the best of them, window by window."""
COARSE_FRAMES = 200
"""Frames the coarse grid looks at."""
UNSTATED = (0.2, 0.05)
"""Standard deviation of a position that states none: m, and m per m of range."""
WALKS = np.array([0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032])
"""Standard deviations of the log scale's change a step that are compared where none is stated."""
USUAL_WALK = 0.004
"""Centre of their log-normal prior, which is as wide as a factor of e."""
TOLD = 0.3
"""Standard deviation of the log scale above which the detections do not tell it."""


@dataclass(frozen=True)
class ScaleProfile:
    """Scale of every step of the odometry before the map is known."""

    log_scale: Float[np.ndarray, " n-1"]
    """Posterior mean of the log of the scale, metres per unit of the odometry."""
    deviation: Float[np.ndarray, " n-1"]
    """Its standard deviation."""
    walk: float
    """Standard deviation of its change from one step to the next."""

    @property
    def told(self) -> bool:
        """Whether the detections tell the scale at all."""
        return bool(len(self.deviation)) and bool(np.median(self.deviation) < TOLD)


def rescaled(problem: SlamProblem, factor: Float[np.ndarray, " n-1"]) -> SlamProblem:
    """The problem with the length of each step of the odometry, and its stated covariance, times a factor.

    Example:
        >>> from nolbo_ppl.geometry.pose import make_pose
        >>> from nolbo_ppl.io.observations import Detections
        >>> odometry = make_pose(np.tile(np.eye(3), (3, 1, 1)), np.array([[0, 0, 0.0], [0, 0, 1], [0, 0, 2]]))
        >>> seen = Detections.from_arrays([0], [[0, 0, 5.0]], position_scale=0.1)
        >>> rescaled(SlamProblem(odometry, seen), np.array([2.0, 3.0])).odometry[:, 2, 3].tolist()
        [0.0, 2.0, 5.0]
    """
    steps = relative(problem.odometry[:-1], problem.odometry[1:]).copy()
    steps[:, :3, 3] *= factor[:, None]
    covariance = problem.odometry_covariance
    if covariance is not None:
        unit = np.concatenate([np.ones((len(steps), 3)), np.repeat(factor[:, None], 3, axis=1)], axis=1)
        covariance = unit[:, :, None] * covariance * unit[:, None, :]
    return replace(problem, odometry=chain(problem.odometry[0], steps), odometry_covariance=covariance)


def window_scores(
    problem: SlamProblem, log_scale: Float[np.ndarray, " g"], frames: Int[np.ndarray, " f"]
) -> Float[np.ndarray, "w g"]:
    """Log likelihood of each log scale in each window of `WINDOW` steps, from pairs of frames that begin at the given ones."""
    table, n = problem.observations, len(problem)
    order = np.argsort(table.frame, kind="stable")
    start = np.searchsorted(table.frame[order], np.arange(n + 1))
    distance = np.linalg.norm(table.position, axis=1)
    variance = np.trace(table.position_covariance, axis1=1, axis2=2) / 3
    variance = np.where(np.isfinite(variance), variance, (UNSTATED[0] + UNSTATED[1] * distance) ** 2)
    category = np.unique([name or "" for name in table.category], return_inverse=True)[1] if len(table) else np.zeros(0, int)
    named = np.array([name is not None for name in table.category], dtype=bool)
    scale = np.exp(log_scale)
    out = np.zeros((max((n - 2) // WINDOW + 1, 1), len(log_scale)))
    for t in frames.tolist():
        a = order[start[t] : start[t + 1]]
        for gap in GAPS:
            if t + gap >= n or not len(a):
                continue
            b = order[start[t + gap] : start[t + gap + 1]]
            if not len(b):
                continue
            T = relative(problem.odometry[t], problem.odometry[t + gap])
            u = table.position[b][:, None] - (table.position[a] @ T[:3, :3])[None]
            c = T[:3, 3] @ T[:3, :3]
            v = variance[b][:, None] + variance[a][None]
            constant, linear, square = np.sum(u**2, axis=2) / v, 2 * (u @ c) / v, (c @ c) / v
            other = (category[b][:, None] != category[a][None]) & named[b][:, None] & named[a][None]
            # Distance of every pair at every scale: |u + scale c|^2 / v.
            away = constant[..., None] + linear[..., None] * scale + square[..., None] * scale**2
            log_density = np.where(other[..., None], -np.inf, -0.5 * away)
            met = np.logaddexp.reduce(log_density, axis=1)
            out[t // WINDOW] += np.logaddexp(met, NOTHING_MET).sum(axis=0) / len(GAPS)
    return out


def smooth(score: Float[np.ndarray, "w g"], grid: Float[np.ndarray, " g"], walk: float) -> tuple[Float[np.ndarray, "w g"], float]:
    """Posterior over the grid in each window under a random walk between neighbouring windows, and the log evidence.

    Forwards and backwards on the grid, uniform at first.

    Args:
        score: log likelihood of each window.
        grid: values, evenly spaced.
        walk: standard deviation of the change between windows.
    """
    walk = max(walk, 0.7 * float(grid[1] - grid[0]))  # narrower ones never leave a grid point
    kernel = np.exp(-0.5 * ((grid[:, None] - grid[None]) / walk) ** 2)
    kernel /= kernel.sum(axis=0, keepdims=True)
    kernel = np.maximum(kernel, 1e-300)  # a jump of the scale is improbable, not a sum of zeros

    def moved(by: np.ndarray, log_value: np.ndarray) -> np.ndarray:
        largest = log_value.max()
        return np.asarray(np.log(by @ np.exp(log_value - largest)) + largest)

    forward, backward = score - np.log(len(grid)), np.zeros_like(score)
    for w in range(1, len(score)):
        forward[w] = score[w] + moved(kernel, forward[w - 1])
    for w in range(len(score) - 2, -1, -1):
        backward[w] = moved(kernel.T, backward[w + 1] + score[w + 1])
    return softmax(forward + backward, axis=1), float(logsumexp(forward[-1]))


def scale_profile(problem: SlamProblem, walk: float | None = None) -> ScaleProfile:
    """Scale of every step of the odometry from neighbouring frames.

    Args:
        problem: the drive; positions in metres, odometry in any unit.
        walk: standard deviation of the change of the log scale from one step to the next. None: the most probable of `WALKS`.
    """
    steps = len(problem) - 1
    if steps < 1:
        return ScaleProfile(np.zeros(0), np.zeros(0), walk or USUAL_WALK)
    some = np.unique(np.linspace(0, steps - 1, min(steps, COARSE_FRAMES)).astype(np.int64))
    # Without anything to tell, the odometry's own unit: a weak prior about it.
    centre = float(COARSE[np.argmax(window_scores(problem, COARSE, some).sum(axis=0) - 0.5 * (COARSE / 3.0) ** 2)])
    score = window_scores(problem, centre + FINE, np.arange(steps))
    if walk is None:
        prior = -0.5 * np.log(WALKS / USUAL_WALK) ** 2
        walk = float(WALKS[np.argmax(prior + [smooth(score, FINE, w * np.sqrt(WINDOW))[1] for w in WALKS])])
    posterior, _ = smooth(score, FINE, walk * np.sqrt(WINDOW))
    mean = posterior @ FINE
    deviation = np.sqrt(np.maximum(posterior @ FINE**2 - mean**2, 0.0))
    middle = np.minimum(WINDOW * np.arange(len(score)) + 0.5 * (WINDOW - 1), steps - 1)
    step = np.arange(steps)
    return ScaleProfile(centre + np.interp(step, middle, mean), np.interp(step, middle, deviation), walk)


@dataclass(frozen=True)
class MetricProblem:
    """A drive whose odometry is in metres but for the last part."""

    problem: SlamProblem
    """The drive."""
    factor: Float[np.ndarray, " n-1"] | None
    """Factors its steps were multiplied by; None: it was in metres."""
    walk: float | None
    """Standard deviation of the scale's change from one step to the next; None: the scale is no state."""
    warnings: tuple[str, ...] = ()
    """What is not told by the detections, in words."""


def metric_problem(problem: SlamProblem, config: SlamConfig) -> MetricProblem:
    """The drive in metres as far as neighbouring frames tell, where `SlamConfig.scale_drift` says that it is not."""
    if not config.scale_drift:
        return MetricProblem(problem, None, None)
    profile = scale_profile(problem, config.scale_walk)
    factor = np.exp(profile.log_scale)
    warnings = () if profile.told else ("the scale of the odometry is a guess: detections of neighbouring frames do not tell it",)
    return MetricProblem(rescaled(problem, factor), factor, profile.walk, warnings)
