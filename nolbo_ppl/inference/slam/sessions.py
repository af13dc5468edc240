"""Several drives, one map: each is solved alone, maps that share a place are joined, and the joint problem is solved.

Drives may be of one robot on other days or of several robots; nothing is known of how their worlds lie to each other. Which maps
share a place, and in which relative pose, is decided by constellations of landmarks (`common_place`); "no common place" is an
answer. The joint graph holds both trajectories with a step that says nothing between them, and all detections associated
anew, so that the covariance of the relative pose is that of the whole problem.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import adjoint, inverse
from nolbo_ppl.inference.slam.common_place import CommonPlace, MapPoints, find_common_place
from nolbo_ppl.inference.slam.detection_features import fit_prior
from nolbo_ppl.inference.slam.em import make_landmark_equalities
from nolbo_ppl.inference.slam.graph import LandmarkEqualities, SlamEstimate, add_landmark_equalities, optimize
from nolbo_ppl.inference.slam.initialise import base_graph, tracklet_features
from nolbo_ppl.inference.slam.loop_candidates import PosteriorSamples, feature_log_ratio
from nolbo_ppl.inference.slam.map_refinement import finish
from nolbo_ppl.inference.slam.measurements import resolve
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem, metric_odometry
from nolbo_ppl.inference.slam.slam_result import SlamResult
from nolbo_ppl.inference.slam.slam_state import SlamState
from nolbo_ppl.inference.slam.solve import solve
from nolbo_ppl.inference.slam.tracking import Tracklets
from nolbo_ppl.structures.detections import Detections

UNKNOWN_STEP = (1.0, 1e3)
"""Standard deviations of the step from one session's end to the next one's start, rad and m: it says nothing."""
SURE = 0.5
"""Associations of more than this carry over into the joint problem."""


@dataclass(frozen=True)
class JointMap:
    """One map of the sessions that share places."""

    sessions: tuple[int, ...]
    """Numbers of the sessions, in the order of their frames in `result`."""
    starts: tuple[int, ...]
    """First row of each of them in `result.T_world_camera`."""
    result: SlamResult
    """Trajectories one behind the other, in the world of the first session, and the map."""
    T_world_session: Float[np.ndarray, "k 4 4"]
    """Pose of each session's own world; the identity for the first."""
    covariance: Float[np.ndarray, "k 6 6"]
    """Their covariances [rotation rad, position m] (`T_world_session exp(xi)`); zero for the first."""

    def trajectory(self, session: int) -> Float[np.ndarray, "n 4 4"]:
        """T_world_camera of one session in the joint world.

        Raises:
            InputError: the session is not in this map.
        """
        if session not in self.sessions:
            raise input_error("no such session in this map", got=session, expected=self.sessions)
        k = self.sessions.index(session)
        ends = (*self.starts[1:], len(self.result.T_world_camera))
        return self.result.T_world_camera[self.starts[k] : ends[k]]


@dataclass(frozen=True)
class SessionsResult:
    """All sessions, in as many maps as there are places without a connection."""

    maps: tuple[JointMap, ...]
    """The maps; one where all sessions share places."""
    places: dict[tuple[int, int], CommonPlace]
    """Common places that were found, by numbers of two sessions; `T_a_b` is the second one's world in the first one's."""
    alone: tuple[SlamResult, ...]
    """Every session solved by itself."""

    def map_of(self, session: int) -> JointMap:
        """The map a session is in."""
        return next(joint for joint in self.maps if session in joint.sessions)


def joined_problem(problems: Sequence[SlamProblem], T_world_session: Sequence[np.ndarray]) -> SlamProblem:
    """Sessions one behind the other as one problem; identifiers of detections get the session's number in front.

    Covariances of steps are kept where all sessions state them.
    """
    starts = np.concatenate([[0], np.cumsum([len(p) for p in problems])])
    tables = [
        replace(p.observations, frame=p.observations.frame + start, id=tuple(f"{k}/{name}" for name in p.observations.id))
        for k, (p, start) in enumerate(zip(problems, starts))
    ]
    covariances = [p.odometry_covariance for p in problems]
    covariance = None
    if all(c is not None for c in covariances):
        unknown = np.diag(np.repeat(UNKNOWN_STEP, 3) ** 2)[None]
        parts = [part for c in covariances if c is not None for part in (unknown, c)]
        covariance = np.concatenate(parts[1:])
    odometry = np.concatenate([T @ p.odometry for T, p in zip(T_world_session, problems)])
    return SlamProblem(odometry, Detections.concatenate(tables), covariance)


def joined_noise(noises: Sequence[NoiseModel], sizes: Sequence[float]) -> NoiseModel:
    """Scales of all sessions; rates, factors and reported values are means weighted by the sessions' numbers of frames."""

    def steps(values: Sequence[np.ndarray], between: float) -> np.ndarray:
        parts = [part for x in values for part in (np.array([between]), x)]
        return np.concatenate(parts[1:])

    def mean(values: Sequence[float]) -> float:
        return float(np.average(values, weights=sizes))

    correlation = None
    if any(x.step_correlation is not None for x in noises):
        each = [
            np.tile(np.eye(6), (len(x.rotation_step), 1, 1)) if x.step_correlation is None else x.step_correlation for x in noises
        ]
        correlation = np.concatenate([part for x in each for part in (np.eye(6)[None], x)][1:])
    names = set.intersection(*(set(x.report) for x in noises))
    return replace(
        noises[0],
        rotation_step=steps([x.rotation_step for x in noises], UNKNOWN_STEP[0]),
        translation_step=steps([x.translation_step for x in noises], UNKNOWN_STEP[1]),
        position_covariance=np.concatenate([x.position_covariance for x in noises]),
        rotation_scale=np.concatenate([x.rotation_scale for x in noises]),
        latent_scale=_stacked([x.latent_scale for x in noises]),
        birth_intensity=float(np.exp(mean([np.log(x.birth_intensity) for x in noises]))),
        clutter_intensity=float(np.exp(mean([np.log(x.clutter_intensity) for x in noises]))),
        report={name: mean([x.report[name] for x in noises]) for name in sorted(names)},
        warnings=tuple(dict.fromkeys(f"session {k}: {text}" for k, x in enumerate(noises) for text in x.warnings)),
        position_factor=mean([x.position_factor for x in noises]),
        range_factor=mean([x.range_factor for x in noises]),
        rotation_factor=mean([x.rotation_factor for x in noises]),
        step_correlation=correlation,
    )


def _stacked(scales: Sequence[np.ndarray]) -> np.ndarray:
    """Scales of latents; those of sessions without latents are ones."""
    d = max(x.shape[1] for x in scales)
    return np.concatenate([x if x.shape[1] == d else np.ones((len(x), d)) for x in scales])


def joined_state(states: Sequence[SlamState], T_world_session: Sequence[np.ndarray], config: SlamConfig) -> SlamState:
    """The maps of all sessions side by side in one state, each where `T_world_session` puts it; nothing is joined yet."""
    problem = joined_problem([s.problem for s in states], T_world_session)
    noise = joined_noise([s.noise for s in states], [len(s.problem) for s in states])
    prior = fit_prior(problem.observations, config, noise)
    frames = np.concatenate([[0], np.cumsum([len(s.problem) for s in states])])
    rows_before = np.concatenate([[0], np.cumsum([len(s.problem.observations) for s in states])])
    tracks_before = np.concatenate([[0], np.cumsum([len(s.tracklets) for s in states])])
    landmarks_before = np.concatenate([[0], np.cumsum([len(s.static) for s in states])])
    rows, landmark, weight = [], [], []
    for k, state in enumerate(states):
        sure = np.flatnonzero(state.weight > SURE)  # a detection's marginals sum to one: no row twice
        rows.append(state.rows[sure] + rows_before[k])
        landmark.append(state.landmark[sure] + landmarks_before[k])
        weight.append(state.weight[sure])
    tracks = [s.tracklets for s in states]
    of = [np.where(t.of_observation >= 0, t.of_observation + tracks_before[k], -1) for k, t in enumerate(tracks)]
    tracklets = Tracklets(
        np.concatenate(of),
        np.concatenate([t.weight for t in tracks]),
        np.concatenate([t.first + frames[k] for k, t in enumerate(tracks)]),
        np.concatenate([t.last + frames[k] for k, t in enumerate(tracks)]),
        np.concatenate([t.count for t in tracks]),
        np.concatenate([t.moving for t in tracks]),
    )
    row, of_landmark, weights = np.concatenate(rows), np.concatenate(landmark), np.concatenate(weight)
    estimate = SlamEstimate(
        np.concatenate([T @ s.estimate.T_world_camera for T, s in zip(T_world_session, states)]),
        np.concatenate([T @ s.estimate.T_world_landmark for T, s in zip(T_world_session, states)]),
    )
    count = len(estimate.T_world_landmark)
    measurements = resolve(problem.observations, noise, config, prior)
    return SlamState(
        problem=problem,
        config=config,
        noise=noise,
        prior=prior,
        tracklets=tracklets,
        static=np.arange(count),
        rows=row,
        landmark=of_landmark,
        weight=weights,
        features=tracklet_features(measurements, config, prior, row, of_landmark, weights, count),
        estimate=estimate,
        links=LandmarkEqualities.none(),
        typical_range=float(np.mean([s.typical_range for s in states])),
    )


def map_points(result: SlamResult) -> MapPoints:
    """What a solved session shows to others."""
    state = result.state
    R = state.estimate.T_world_landmark[:, :3, :3]
    joint = result.linearisation.joint_covariance(np.arange(len(R)))[:, 3:, :, 3:]
    covariance = np.einsum("mij,mjnk,nlk->minl", R, joint, R)
    camera = state.estimate.T_world_camera[:, :3, 3]
    position = state.estimate.T_world_landmark[:, :3, 3]
    away = [np.linalg.norm(camera - x, axis=1).min() for x in position]
    return MapPoints(position, covariance, camera, float(np.quantile(away, 0.95)) if away else 1.0)


def find_place(first: SlamResult, second: SlamResult, config: SlamConfig) -> CommonPlace | None:
    """The common place of two sessions that were solved alone, or None.

    Latents and categories of a pair count as between tracklets: over the population of all landmarks of both maps.
    """
    m, k = len(first.state.static), len(second.state.static)
    if not m or not k:
        return None
    both = joined_state((first.state, second.state), (np.eye(4), np.eye(4)), config)
    # How the two worlds are turned to each other is not known: orientations say nothing yet.
    features = replace(both.features, oriented=np.zeros(m + k, dtype=bool))
    a, b = np.repeat(np.arange(m), k), np.tile(np.arange(k), m)
    nothing = PosteriorSamples(np.zeros((0, 3, 0)), np.zeros((0, 3, 0)))
    ratio = feature_log_ratio(both.estimate, nothing, features, both.prior, config, b + m, a)
    return find_common_place(map_points(first), map_points(second), ratio.reshape(m, k), config, both.link_scale)


def connected(
    count: int, places: dict[tuple[int, int], CommonPlace]
) -> list[tuple[tuple[int, ...], list[Float[np.ndarray, "4 4"]], list[tuple[int, int]]]]:
    """Groups of sessions connected by places, the surest first: members, their poses in the first one's world, places used."""
    group: list[dict[int, np.ndarray]] = [{k: np.eye(4)} for k in range(count)]
    used: list[tuple[int, int]] = []
    for (a, b), place in sorted(places.items(), key=lambda item: -item[1].log_odds):
        one = next(g for g in group if a in g)
        other = next(g for g in group if b in g)
        if one is other:
            continue
        T = one[a] @ place.T_a_b @ inverse(other[b])
        one.update({k: T @ pose for k, pose in other.items()})
        group.remove(other)
        used.append((a, b))
    out = []
    for poses in group:
        members = tuple(sorted(poses))
        to_first = inverse(poses[members[0]])
        out.append((members, [to_first @ poses[k] for k in members], [pair for pair in used if pair[0] in poses]))
    return sorted(out, key=lambda item: item[0])


def solve_joint(
    alone: Sequence[SlamResult],
    sessions: tuple[int, ...],
    T_world_session: Sequence[np.ndarray],
    pairs: Sequence[tuple[int, int]],
    places: dict[tuple[int, int], CommonPlace],
    config: SlamConfig,
) -> JointMap:
    """Both trajectories and one map: matched landmarks linked, the graph solved, every detection associated anew.

    Args:
        alone: all sessions solved by themselves.
        sessions: those of this map.
        T_world_session: their worlds in that of the first.
        pairs: places that connect them, by numbers of two sessions.
        places: the places.
        config: settings.
    """
    clock = time.perf_counter()
    states = [alone[k].state for k in sessions]
    starts = tuple(int(x) for x in np.concatenate([[0], np.cumsum([len(s.problem) for s in states])])[:-1])
    before = dict(zip(sessions, np.concatenate([[0], np.cumsum([len(s.static) for s in states])])))
    if len(sessions) == 1:
        return JointMap(sessions, starts, alone[sessions[0]], np.eye(4)[None], np.zeros((1, 6, 6)))
    state = joined_state(states, T_world_session, config)
    start = state.estimate
    newer = np.concatenate([places[pair].b + before[pair[1]] for pair in pairs]).astype(np.int64)
    older = np.concatenate([places[pair].a + before[pair[0]] for pair in pairs]).astype(np.int64)
    a, b = np.maximum(newer, older), np.minimum(newer, older)
    links = make_landmark_equalities(state, a, b, np.ones(len(a)))
    graph = base_graph(state)
    add_landmark_equalities(graph, links, config.robust_width)
    estimate, _, error = optimize(graph, state.estimate, iterations=50)
    state = replace(state, estimate=estimate, links=links, graph_error=error, closing=False)
    state, associations = finish(state)
    result = SlamResult(
        state=state,
        associations=associations,
        infos=(),
        seconds={"em": time.perf_counter() - clock},
        history=(start, state.estimate),
    )
    first_camera = [s.problem.odometry[0] for s in states]
    poses = np.stack([result.T_world_camera[row] @ inverse(T) for row, T in zip(starts, first_camera)])
    covariance = _pose_covariances(result, np.array(starts), first_camera)
    return JointMap(sessions, starts, result, poses, covariance)


def _pose_covariances(
    result: SlamResult, starts: Int[np.ndarray, " k"], T_session_camera: Sequence[np.ndarray]
) -> Float[np.ndarray, "k 6 6"]:
    """Covariances of the sessions' worlds from those of their first poses, which each session's world fixes exactly."""
    covariance = result.pose_covariances(starts)
    covariance[0] = 0.0
    moved = [adjoint(T) @ C @ adjoint(T).T for T, C in zip(T_session_camera, covariance)]
    return np.stack(moved)


def solve_sessions(problems: Sequence[SlamProblem], config: SlamConfig | None = None) -> SessionsResult:
    """Several drives in, one map for each group of them that share places.

    Args:
        problems: the drives; where their worlds lie to each other need not be known.
        config: settings of every solve; `clique_log_odds` is what a common place must reach.

    Raises:
        InputError: no problem, a malformed one, or a configuration with `scale_drift`.
        GraphError: GTSAM could not solve a graph.

    Example:
        >>> import nolbo_ppl
        >>> from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
        >>> rng = np.random.default_rng(0)
        >>> drive = simulate_sequence(simulate_circuit(rng, frames_per_lap=30), rng, world=WorldConfig(objects=15))
        >>> seen, half = drive.observations, len(drive.odometry) // 2
        >>> parts = [
        ...     nolbo_ppl.SlamProblem(drive.odometry[:half], seen.select(seen.frame < half)),
        ...     nolbo_ppl.SlamProblem(drive.odometry[:half], seen.select(seen.frame < half)),
        ... ]
        >>> found = solve_sessions(parts, nolbo_ppl.SlamConfig(hypotheses=1))
        >>> len(found.maps), found.maps[0].sessions, bool(np.abs(found.maps[0].T_world_session[1] - np.eye(4)).max() < 0.1)
        (1, (0, 1), True)
    """
    config = metric_odometry(config or SlamConfig(), "several sessions")
    if not problems:
        raise input_error("no sessions to join", got=0, expected="one or more problems")
    dimensions = sorted({p.observations.latent_dim for p in problems} - {0})
    if len(dimensions) > 1:
        raise input_error("sessions have latents of different lengths", got=dimensions, expected="one model for all sessions")
    alone = tuple(solve(problem, config) for problem in problems)
    places = {}
    for b in range(len(alone)):
        for a in range(b):
            place = find_place(alone[a], alone[b], config)
            if place is not None:
                places[a, b] = place
    maps = tuple(
        solve_joint(alone, members, poses, pairs, places, config) for members, poses, pairs in connected(len(alone), places)
    )
    return SessionsResult(maps, places, alone)
