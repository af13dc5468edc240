"""The best whole associations of a drive's tracklets: a beam search over which tracklets are one object.

Tracklets are taken in the order of time. Each founds an object or is one seen before; the gap between the two has a Gaussian
density under the joint covariance of all tracklets, and conditioning on it moves and narrows everything that comes later. The
product over a drive is the joint density of all gaps, whatever their order: decisions early in a loop are judged by what they
make of its end, which annealing, window by window, does not do. This is multiple hypothesis tracking (Reid 1979) on tracklets
in place of detections, linearised once; the soft EM that starts from its answers is not bound by them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.inference.slam.em import make_landmark_equalities
from nolbo_ppl.inference.slam.gaussian import squared_distance
from nolbo_ppl.inference.slam.graph import add_landmark_equalities, optimize
from nolbo_ppl.inference.slam.initialise import base_graph, inlier_weights
from nolbo_ppl.inference.slam.linearisation import linearise
from nolbo_ppl.inference.slam.loop_candidates import PosteriorSamples, feature_log_ratio
from nolbo_ppl.inference.slam.slam_state import SlamState

MOST_TRACKLETS = 300
"""Drives of more tracklets are not searched: the cost of one conditioning grows with the square of their number."""
BEAM = 24
"""Associations kept after each tracklet."""
WORST = 30.0
"""Associations of which nothing remains but this many nats below the best are dropped."""
BRANCHES = 4
"""Older objects one tracklet is tried on in each association."""
GATE = 25.0
"""Squared Mahalanobis distance of a gap beyond which it is not tried."""
PROBES = 8
"""Camera positions, evenly over the drive, by which two associations are told apart."""
ALIKE = 2
"""Associations kept of which both trajectory and its uncertainty are alike."""
SAME_PATH, OTHER_PATH = 1.0, 2.0
"""Trajectories are alike when their probes differ by less than the first, in standard deviations of a gap's coordinate (root mean
square). Answers differ by the second at least: the soft EM takes what is nearer to one map."""


@dataclass(frozen=True)
class WholeAssociation:
    """Which tracklets are one object."""

    root: Int[np.ndarray, " m"]
    """First tracklet of each one's object."""
    log_odds: float
    """Joint log density of all gaps and features over that of all tracklets being objects of their own, nats."""


@dataclass
class _Branch:
    """An association of the tracklets so far."""

    log_odds: float
    root: np.ndarray
    last: np.ndarray
    index: np.ndarray
    """Tracklets that still matter: the objects' first ones, then all to come; after them `mean` has the probes."""
    mean: np.ndarray
    covariance: np.ndarray

    @property
    def path(self) -> np.ndarray:
        """Means of the probes."""
        return self.mean[len(self.index) :]


@dataclass
class _Child:
    """A branch with one more tracklet decided, not yet carried out."""

    log_odds: float
    parent: _Branch
    object: int
    """Place of the older tracklet in the parent's `index`; -1: a new object."""
    path: np.ndarray
    """Means of the probes."""
    spread: float
    """Trace of their covariance."""


def positions_with_covariance(
    state: SlamState, frames: Int[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "m+p 3"], Float[np.ndarray, "m+p 3 m+p 3"]]:
    """World positions of the tracklets and of the camera at some frames, and their joint covariance without links, m and m^2."""
    linearisation = linearise(base_graph(state), state.estimate)
    blocks = np.concatenate([np.arange(linearisation.landmarks), linearisation.landmarks + frames])
    joint = linearisation.joint_covariance(blocks)[:, 3:, :, 3:]
    T = np.concatenate([state.estimate.T_world_landmark, state.estimate.T_world_camera[frames]])
    R = T[:, :3, :3]
    return T[:, :3, 3], np.einsum("aij,ajbk,blk->aibl", R, joint, R)


def tracklet_log_ratios(state: SlamState) -> Float[np.ndarray, "m m"]:
    """Log ratio of each row's latent and category given that it is the column's object to those of any object, nats."""
    m = len(state.static)
    a, b = np.divmod(np.arange(m * m), m)
    plain = replace(state.features, oriented=np.zeros(m, dtype=bool))  # orientations turn with the drift that is sought
    none = PosteriorSamples(np.zeros((m, 3, 1)), np.zeros((m, 3, 1)))
    return feature_log_ratio(state.estimate, none, plain, state.prior, state.config, a, b).reshape(m, m)


def best_associations(state: SlamState, count: int = 4) -> list[WholeAssociation]:
    """The best whole associations that place the end of the drive differently, best first; none for a drive too long.

    Args:
        state: the state of `init`, nothing closed.
        count: associations at most.
    """
    m = len(state.static)
    if not 2 <= m <= MOST_TRACKLETS:
        return []
    frames = np.unique(np.linspace(0, len(state.problem) - 1, PROBES + 1).astype(int)[1:])
    position, joint = positions_with_covariance(state, frames)
    return search(
        position,
        joint,
        state.features.first,
        state.features.last,
        tracklet_log_ratios(state),
        floor=state.link_scale,
        log_new=float(np.log(state.noise.birth_intensity)),
        count=count,
    )


def search(
    position: Float[np.ndarray, "n 3"],
    covariance: Float[np.ndarray, "n 3 n 3"],
    first: Int[np.ndarray, " m"],
    last: Int[np.ndarray, " m"],
    log_ratio: Float[np.ndarray, "m m"],
    *,
    floor: float,
    log_new: float,
    count: int,
) -> list[WholeAssociation]:
    """`best_associations` of positions and covariances that are given.

    Args:
        position: mean positions of the m tracklets, then of the probes by which associations are told apart, m.
        covariance: their joint covariance, m^2.
        first: first frame of each tracklet.
        last: its last frame; tracklets of one object do not overlap in time.
        log_ratio: of the features of a row given the column's object, nats.
        floor: standard deviation of each coordinate of a gap between two tracklets of one object, beyond the covariance, m.
        log_new: log density of objects, m^-3.
        count: associations at most.
    """
    m, n = len(first), len(position)
    order = np.argsort(first, kind="stable")
    place = np.concatenate([order, np.arange(m, n)])
    joint = covariance[place][:, :, place].reshape(3 * n, 3 * n)
    beam = [_Branch(0.0, np.arange(m), last.copy(), order, position[place], joint)]
    for step, a in enumerate(order.tolist()):
        children: list[_Child] = []
        for branch in beam:
            children += _children(branch, a, m - step, first, log_ratio, floor, log_new)
        beam = [_carry_out(child, a, last, floor) for child in _select(children, floor)]
    distinct: list[_Branch] = []
    for branch in sorted(beam, key=lambda branch: -branch.log_odds):
        if all(_deviation(branch.path, other.path) >= OTHER_PATH * floor for other in distinct):
            distinct.append(branch)
    return [WholeAssociation(branch.root, branch.log_odds) for branch in distinct[:count]]


def _children(
    branch: _Branch, a: int, left: int, first: np.ndarray, log_ratio: np.ndarray, floor: float, log_new: float
) -> list[_Child]:
    """Ways to decide tracklet a, the first of the `left` ones at the end of `index`."""
    objects = len(branch.index) - left  # the objects' first tracklets stand before those to come
    probes = np.arange(len(branch.index), len(branch.mean))
    blocks = branch.covariance.reshape(len(branch.mean), 3, -1, 3)
    path = branch.path
    out = [_Child(branch.log_odds, branch, -1, path, float(np.einsum("kii->", blocks[probes, :, probes])))]
    free = np.flatnonzero(branch.last[branch.index[:objects]] < first[a])
    if not len(free):
        return out
    gap = branch.mean[objects] - branch.mean[free]
    cross = blocks[objects][:, free].transpose(1, 0, 2)
    spread = blocks[objects, :, objects] + blocks[free, :, free] - cross - np.swapaxes(cross, 1, 2) + floor**2 * np.eye(3)
    square, log_det = squared_distance(gap, spread)
    value = -0.5 * (square + log_det) + log_ratio[a, branch.index[free]] - log_new
    value[square > GATE] = -np.inf
    for k in np.argsort(-value, kind="stable")[:BRANCHES]:
        if value[k] < -WORST:
            break
        lean = (blocks[probes, :, objects] - blocks[probes, :, free[k]]).reshape(-1, 3)
        gain = np.linalg.solve(spread[k], lean.T).T
        moved = path - (gain @ gap[k]).reshape(-1, 3)
        narrowed = out[0].spread - float(np.sum(gain * lean))
        out.append(_Child(branch.log_odds + float(value[k]), branch, int(free[k]), moved, narrowed))
    return out


def _select(children: list[_Child], floor: float) -> list[_Child]:
    """The best that are not too many of a kind."""
    children.sort(key=lambda child: -child.log_odds)
    kept: list[_Child] = []
    for child in children:
        if child.log_odds < children[0].log_odds - WORST or len(kept) == BEAM:
            break
        alike = 0
        for other in kept:
            near = _deviation(child.path, other.path) < SAME_PATH * floor
            alike += near and 0.5 < child.spread / other.spread < 2.0
        if alike < ALIKE:
            kept.append(child)
    return kept


def _deviation(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square of the differences of coordinates, m."""
    return float(np.sqrt(np.mean((a - b) ** 2)))


def _carry_out(child: _Child, a: int, last: np.ndarray, floor: float) -> _Branch:
    """The branch of a child: the tracklet becomes an object, or the object it is takes its place."""
    parent = child.parent
    if child.object < 0:
        return replace(parent, log_odds=child.log_odds)
    place = int(np.flatnonzero(parent.index == a)[0])
    older = int(parent.index[child.object])
    root, newest = parent.root.copy(), parent.last.copy()
    root[a] = older
    newest[older] = max(newest[older], last[a])
    n = len(parent.mean)
    lean = parent.covariance[:, 3 * place : 3 * place + 3] - parent.covariance[:, 3 * child.object : 3 * child.object + 3]
    gap = parent.mean[place] - parent.mean[child.object]
    rows = slice(3 * place, 3 * place + 3), slice(3 * child.object, 3 * child.object + 3)
    spread = lean[rows[0]] - lean[rows[1]] + floor**2 * np.eye(3)
    gain = np.linalg.solve(spread, lean.T).T
    stay = np.arange(n) != place
    keep = np.repeat(stay, 3)
    mean = (parent.mean - (gain @ gap).reshape(-1, 3))[stay]
    covariance = parent.covariance[np.ix_(keep, keep)] - gain[keep] @ lean[keep].T
    return _Branch(child.log_odds, root, newest, parent.index[stay[: len(parent.index)]], mean, covariance)


def with_association(state: SlamState, association: WholeAssociation) -> SlamState:
    """The state with the tracklets of each object linked and the graph solved, ready for the soft EM."""
    a = np.flatnonzero(association.root != np.arange(len(association.root)))
    links = make_landmark_equalities(state, a, association.root[a], np.ones(len(a)))
    graph = base_graph(state)
    add_landmark_equalities(graph, links, state.config.robust_width)
    estimate, _, error = optimize(graph, state.estimate, iterations=25)
    state = replace(
        state,
        estimate=estimate,
        links=links,
        graph_error=error,
        closed={int(i): int(association.root[i]) for i in a},
        closing=False,
        iteration=len(state.config.annealing),
    )
    return replace(state, weight=inlier_weights(state))
