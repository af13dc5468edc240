"""Do two maps show one place, and how do they lie to each other? Constellations of landmarks, by evidence.

Nothing is known of the relative pose, so that positions alone cannot be compared: two pairs of landmarks fit together when their
distances in both maps agree within the maps' own joint covariances (drift between far landmarks included). A clique of such pairs
is a constellation; a rigid motion is fitted to it by generalised least squares, and its evidence is a marginal likelihood,

    log odds = log int p(T) prod_k N(a_k - T b_k) dT + sum_k [log ratio of latents and categories + log share - log density],

with the motion integrated out (Laplace) under a uniform prior over SO(3) and over all translations at which the maps
overlap, against landmarks of the second map that lie anywhere. Objects come and go: a share of `STILL_THERE` is expected to
stand where it stood, and what the first map ought to show of the second and does not counts against the place.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import networkx
import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.geometry.alignment import umeyama
from nolbo_ppl.geometry.pose import adjoint, inverse, make_pose, se3_exp, skew, transform
from nolbo_ppl.inference.slam.consistent_cliques import CLIQUE_BUDGET, FEATURE_MINIMUM, NODE_BUDGET, promising_nodes
from nolbo_ppl.inference.slam.slam_problem import SlamConfig

STILL_THERE = 0.5
"""Share of the objects of a place that a second visit is expected to find where they were."""
DISTANCE_GATE = 9.0
"""Largest squared difference of two distances, in units of its variance."""
RESIDUAL_GATE = 16.0
"""Largest squared residual of a matched pair given the others, in units of its covariance (3 degrees of freedom: p = 0.001)."""
MIN_PAIRS = 4
"""Pairs that a common place needs at least: three points fit one another by chance."""
SCORED = 30
"""Constellations, the largest and most alike first, that are fitted."""


@dataclass(frozen=True)
class MapPoints:
    """What a map shows of itself to another."""

    position: Float[np.ndarray, "m 3"]
    """Landmarks in the map's own world, m."""
    covariance: Float[np.ndarray, "m 3 m 3"]
    """Their joint posterior covariance, m^2: drift between far ones is in it."""
    camera: Float[np.ndarray, "n 3"]
    """Where the camera was."""
    reach: float
    """How far from the camera landmarks lie, m."""


@dataclass(frozen=True)
class CommonPlace:
    """A place that two maps share."""

    T_a_b: Float[np.ndarray, "4 4"]
    """Pose of the second map's world in the first one's."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance [rotation rad, position m] in the tangent space at `T_a_b` (`T_a_b exp(xi)`)."""
    a: Int[np.ndarray, " c"]
    """Landmarks of the first map, ..."""
    b: Int[np.ndarray, " c"]
    """... and those of the second that are the same objects."""
    log_odds: float
    """Log evidence of one place over two, nats."""
    margin: float
    """How far that is above the best constellation of another relative pose, nats."""


def distance_spread(points: MapPoints) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "m m"]]:
    """Distances between all landmarks of a map, and their variances."""
    gap = points.position - points.position[:, None]
    distance = np.linalg.norm(gap, axis=2)
    unit = gap / np.maximum(distance, 1e-9)[..., None]
    cross = points.covariance.transpose(0, 2, 1, 3)
    own = cross[np.arange(len(cross)), np.arange(len(cross))]
    between = own[:, None] + own[None] - cross - np.swapaxes(cross, 2, 3)
    return distance, np.maximum(np.einsum("mki,mkij,mkj->mk", unit, between, unit), 0.0)


def fits_together(
    first: MapPoints, second: MapPoints, i: Int[np.ndarray, " p"], j: Int[np.ndarray, " p"], floor: float
) -> Bool[np.ndarray, "p p"]:
    """Which pairs (i of the first map, j of the second) can hold at once: equal distances, no landmark used twice."""
    distance_a, variance_a = distance_spread(first)
    distance_b, variance_b = distance_spread(second)
    gap = distance_a[np.ix_(i, i)] - distance_b[np.ix_(j, j)]
    variance = variance_a[np.ix_(i, i)] + variance_b[np.ix_(j, j)] + 2 * floor**2
    return (gap**2 < DISTANCE_GATE * variance) & (i[:, None] != i[None]) & (j[:, None] != j[None])


@dataclass(frozen=True)
class Fit:
    """A rigid motion between matched landmarks."""

    T_a_b: Float[np.ndarray, "4 4"]
    """The motion."""
    information: Float[np.ndarray, "6 6"]
    """Information about [rotation, translation] in the first world's axes about the centre of the pairs."""
    centre: Float[np.ndarray, " 3"]
    """That centre."""
    square: Float[np.ndarray, " c"]
    """Squared residual of each pair given all others, in units of its covariance."""
    log_density: float
    """Log density of all residuals at once."""

    @property
    def covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance in the tangent space at `T_a_b` on its right: [rotation, position]."""
        # Left at the centre -> left at the origin: v + c x w; then by the adjoint of the inverse.
        shift = np.eye(6)
        shift[3:, :3] = skew(self.centre)
        A = adjoint(inverse(self.T_a_b)) @ shift
        return A @ np.linalg.inv(self.information) @ A.T


def fit_motion(
    first: MapPoints, second: MapPoints, a: Int[np.ndarray, " c"], b: Int[np.ndarray, " c"], floor: float, repeats: int = 3
) -> Fit:
    """The rigid motion of matched landmarks by generalised least squares under both maps' joint covariance.

    The exact one: of posterior samples the small eigenvalues come out too small as the group grows, and the factor form that
    mends this for loops costs 1.3 nats where no drift is shared.
    """
    R, t, _ = umeyama(second.position[b], first.position[a], with_scale=False)
    T = make_pose(R, t)
    size = 3 * len(a)
    of_first = first.covariance[np.ix_(a, np.arange(3), a, np.arange(3))].reshape(size, size)
    of_second = second.covariance[np.ix_(b, np.arange(3), b, np.arange(3))]
    for _ in range(repeats):
        moved = transform(T, second.position[b])
        gap = (first.position[a] - moved).ravel()
        turned = np.einsum("ij,cjdl,kl->cidk", T[:3, :3], of_second, T[:3, :3]).reshape(size, size)
        C = of_first + turned + 2 * floor**2 * np.eye(size)
        centre = moved.mean(axis=0)
        J = np.concatenate([np.concatenate([-skew(x), np.eye(3)], axis=1) for x in moved - centre])
        solved = np.linalg.solve(C, np.column_stack([J, gap]))
        information = J.T @ solved[:, :6] + 1e-9 * np.eye(6)
        delta = np.linalg.solve(information, J.T @ solved[:, 6])
        about = make_pose(np.eye(3), centre)
        T = about @ se3_exp(delta) @ inverse(about) @ T
    residual = (first.position[a] - transform(T, second.position[b])).ravel()
    log_density = -0.5 * float(residual @ np.linalg.solve(C, residual) + np.linalg.slogdet(2 * np.pi * C)[1])
    # Each pair's residual given all others', drift and motion taken off: an object that has moved stands out of its group,
    # however far both maps may have drifted.
    precision = np.linalg.inv(C)
    projected = precision @ J
    precision = precision - projected @ np.linalg.solve(information, projected.T)
    weighted = (precision @ residual).reshape(-1, 3)
    own = precision.reshape(len(a), 3, len(a), 3)[np.arange(len(a)), :, np.arange(len(a))]
    square = np.einsum("ci,cij,cj->c", weighted, np.linalg.pinv(own, hermitian=True), weighted)
    return Fit(T, information, centre, square, log_density)


def extents(points: Float[np.ndarray, "m 3"], floor: float) -> Float[np.ndarray, " 3"]:
    """Sides of the box about some points along their principal axes, longest first; none is thinner than six times `floor`."""
    centred = points - points.mean(axis=0)
    return np.maximum(np.sqrt(12.0) * np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(points)), 6 * floor)


def ought_to_match(first: MapPoints, second: MapPoints, T_a_b: np.ndarray, matched: Int[np.ndarray, " c"]) -> int:
    """Landmarks of the second map that lie where the first one looked, and have no partner there."""
    moved = transform(T_a_b, second.position)
    near = np.array([np.linalg.norm(first.camera - x, axis=1).min() < first.reach for x in moved], dtype=bool)
    near[matched] = False
    return int(near.sum())


def place_log_odds(
    first: MapPoints,
    second: MapPoints,
    fit: Fit,
    log_feature: Float[np.ndarray, " c"],
    b: Int[np.ndarray, " c"],
    floor: float,
) -> float:
    """Log marginal likelihood of the matched landmarks being the same objects, over two places that have none in common."""
    sides_a, sides_b = extents(first.position, floor), extents(second.position, floor)
    log_density = np.log(len(second.position)) - np.log(sides_b).sum()  # objects per m^3 of the second map
    log_prior = -np.log(8 * np.pi**2) - np.log(sides_a + sides_b).sum()
    motion = fit.log_density + 3 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(fit.information)[1] + log_prior
    objects = np.sum(log_feature + np.log(STILL_THERE) - log_density)
    missing = ought_to_match(first, second, fit.T_a_b, b) * np.log(1 - STILL_THERE)
    return float(motion + objects + missing)


def _without_outliers(
    first: MapPoints, second: MapPoints, a: np.ndarray, b: np.ndarray, floor: float
) -> tuple[np.ndarray, np.ndarray, Fit] | None:
    """Fit, drop the worst where it does not fit, fit again; None where too few stay."""
    while len(a) >= MIN_PAIRS:
        fit = fit_motion(first, second, a, b, floor)
        worst = int(np.argmax(fit.square))
        if fit.square[worst] < RESIDUAL_GATE:
            return a, b, fit
        a, b = np.delete(a, worst), np.delete(b, worst)
    return None


def _extended(
    first: MapPoints, second: MapPoints, fit: Fit, log_feature: Float[np.ndarray, "m k"], floor: float
) -> tuple[np.ndarray, np.ndarray]:
    """All pairs that the motion puts together, one to one, the most alike first."""
    moved = transform(fit.T_a_b, second.position)
    own = np.einsum("mimi->m", first.covariance)[:, None] + np.einsum("mimi->m", second.covariance)[None]
    square = np.sum((first.position[:, None] - moved[None]) ** 2, axis=2) / (own / 3 + 2 * floor**2)
    i, j = np.nonzero((square < RESIDUAL_GATE) & (log_feature > FEATURE_MINIMUM))
    a, b = [], []
    for k in np.argsort(-(log_feature[i, j] - 0.5 * square[i, j]), kind="stable"):
        if i[k] not in a and j[k] not in b:
            a.append(i[k])
            b.append(j[k])
    return np.array(a, dtype=np.int64), np.array(b, dtype=np.int64)


def find_common_place(
    first: MapPoints, second: MapPoints, log_feature: Float[np.ndarray, "m k"], config: SlamConfig, floor: float
) -> CommonPlace | None:
    """The common place of two maps, or None: too few landmarks that fit, too little evidence, or two poses that fit alike.

    Args:
        first: map whose world the answer is in.
        second: the other one.
        log_feature: log ratio of latent and category of each pair being one object to being two, nats.
        config: `clique_log_odds` has to be reached, half of it as the margin over any other relative pose.
        floor: standard deviation of one object's mapped position from visit to visit, m.
    """
    i, j = np.nonzero(log_feature > FEATURE_MINIMUM)
    if len(i) < MIN_PAIRS or not len(first.position) or not len(second.position):
        return None
    best = np.argsort(-log_feature[i, j], kind="stable")[:NODE_BUDGET]
    i, j = i[best], j[best]
    together = fits_together(first, second, i, j, floor)
    nodes = promising_nodes(together, MIN_PAIRS)
    if len(nodes) < MIN_PAIRS:
        return None
    graph = networkx.Graph()
    graph.add_edges_from(np.argwhere(np.triu(together[np.ix_(nodes, nodes)], 1)).tolist())
    cliques = [nodes[np.array(c)] for c in islice(networkx.find_cliques(graph), CLIQUE_BUDGET) if len(c) >= MIN_PAIRS]
    cliques.sort(key=lambda c: -(3.0 * len(c) + float(log_feature[i[c], j[c]].sum())))
    found: list[tuple[float, np.ndarray, np.ndarray, Fit]] = []
    for clique in cliques[:SCORED]:
        kept = _without_outliers(first, second, i[clique], j[clique], floor)
        if kept is None or any(_same_motion(kept[2], fit, second, floor) for _, _, _, fit in found):
            continue
        more = _without_outliers(first, second, *_extended(first, second, kept[2], log_feature, floor), floor)
        a, b, fit = kept if more is None or len(more[0]) < len(kept[0]) else more
        found.append((place_log_odds(first, second, fit, log_feature[a, b], b, floor), a, b, fit))
    if not found:
        return None
    found.sort(key=lambda item: -item[0])
    log_odds, a, b, fit = found[0]
    rivals = [value for value, _, _, other in found[1:] if not _same_motion(fit, other, second, floor)]
    margin = log_odds - max([0.0, *rivals])
    if log_odds < config.clique_log_odds or margin < config.clique_log_odds / 2:
        return None
    return CommonPlace(fit.T_a_b, fit.covariance, a, b, log_odds, margin)


def _same_motion(fit: Fit, other: Fit, second: MapPoints, floor: float) -> bool:
    """Whether two motions put the second map at one place, within what either knows."""
    gap = transform(fit.T_a_b, second.position) - transform(other.T_a_b, second.position)
    deviation = np.sqrt(max(np.trace(np.linalg.inv(fit.information)[3:, 3:]), 0.0))
    return bool(np.sqrt(np.mean(np.sum(gap**2, axis=1))) < 6 * (floor + deviation))
