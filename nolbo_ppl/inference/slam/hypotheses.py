"""Several maps where one is not sure: runs from different starts, compared by their log evidence.

The first run anneals from the odometry. The second begins with the best whole association of the tracklets
(`best_associations`), which is searched for quite otherwise, or with a wider drift where the odometry's scales are guesses. Where
the two agree, only associations that come near the best have a run too; else up to `SlamConfig.hypotheses` runs: which loops an
annealed run closes can depend on its samples and on how wide a drift it begins with, so further ones differ in both, and the next
best associations have their turns. Where a run left the odometry far behind what was said of it, one that keeps it competes with
it: wrong associations want loose odometry, and loose odometry lets wrong associations be. Runs that end at one trajectory are
one hypothesis; weights are the shares of the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count, islice

import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import relative, se3_log
from nolbo_ppl.inference.slam.best_associations import WholeAssociation, best_associations, with_association
from nolbo_ppl.inference.slam.data_association import Associations
from nolbo_ppl.inference.slam.em import EmStepInfo
from nolbo_ppl.inference.slam.graph import SlamEstimate
from nolbo_ppl.inference.slam.map_evidence import map_log_evidence, trajectory_distance
from nolbo_ppl.inference.slam.map_refinement import finish
from nolbo_ppl.inference.slam.noise.noise_estimation import step_sigmas
from nolbo_ppl.inference.slam.noise.odometry_noise import leaves_odometry, stated_sigmas
from nolbo_ppl.inference.slam.shared_errors import linearise_answer
from nolbo_ppl.inference.slam.slam_state import SlamState

DRIFT_FACTORS = (1.0, 3.0, 0.5, 6.0)
"""Factors on odometry scales nobody stated with which the runs begin; further runs repeat them."""
SAME_MAP = 1.0
"""Runs whose trajectories are closer than this many typical detection scales are one hypothesis."""
SAME_EVIDENCE = 5.0
"""Two runs at one trajectory whose log evidence is closer than this agree, nats."""
SAME_SHARE = 0.3
"""Two runs whose trajectories are closer than this share of `SAME_MAP` agree whatever their evidence, ..."""
SAME_COUNT = 0.05
"""... if their numbers of landmarks differ by no more than this share."""
RIVAL = 5.0
"""Whole associations less than this below the best have a run of their own even where two runs agree, nats."""
AMBIGUOUS = 0.05
"""A rival with more weight than this makes the answer ambiguous."""
RAISED = 3.0
"""Stated scales of the odometry raised by more than this at the end of a run: it is repeated from its start."""
PREFERENCE = 0.02
"""Nats a detection by which a run that leaves the odometry far behind must be more probable than one that keeps it: evidence of
large graphs is no truer than that (scales a few percent apart move it by a hundred nats)."""
MIN_WEIGHT = 1e-4
"""Hypotheses of less weight are not kept."""


@dataclass(frozen=True)
class MapHypothesis:
    """One of several maps that explain the detections."""

    weight: float
    """Posterior probability among the hypotheses."""
    log_evidence: float
    """Log evidence, nats, comparable between hypotheses."""
    state: SlamState
    """Its final state."""
    associations: Associations
    """Its associations."""

    @property
    def T_world_camera(self) -> Float[np.ndarray, "n 4 4"]:
        """Its trajectory."""
        return self.state.estimate.T_world_camera

    def pose_covariances(self, rows: np.ndarray) -> Float[np.ndarray, "r 6 6"]:
        """Covariances of its poses given its associations."""
        linearisation = linearise_answer(self.state)
        return linearisation.covariance(linearisation.landmarks + rows)


@dataclass(frozen=True)
class Run:
    """One annealed run to its end."""

    state: SlamState
    associations: Associations
    infos: tuple[EmStepInfo, ...]
    history: tuple[SlamEstimate, ...]
    log_evidence: float

    @property
    def closed(self) -> bool:
        """Whether tracks of different passes were joined."""
        return any(info.strong_links or info.closings for info in self.infos)


def start_of_run(state: SlamState, k: int) -> SlamState:
    """The state run k begins with: other samples, another drift where nobody stated it and none is kept."""
    if k == 0:
        return state
    factor = DRIFT_FACTORS[k % len(DRIFT_FACTORS)]
    rotation, translation = stated_sigmas(state.problem, state.config)
    noise = replace(
        state.noise,
        rotation_step=state.noise.rotation_step * (1.0 if rotation or state.odometry_kept else factor),
        translation_step=state.noise.translation_step * (1.0 if translation or state.odometry_kept else factor),
    )
    annealing = state.config.annealing
    if k % 2:  # a slower start, and more samples
        annealing = (2 * annealing[0], *annealing)
    config = replace(state.config, seed=state.config.seed + 1000 * k, annealing=annealing, samples=2 * state.config.samples)
    return replace(state, noise=noise, config=config)


def raised_odometry(start: SlamState, end: SlamState) -> SlamState | None:
    """The start with the odometry's scales of the end, where stated ones were raised by more than `RAISED`; else None."""
    if not any(stated_sigmas(start.problem, start.config)) or not len(start.noise.rotation_step):
        return None
    ratios = (
        float(np.median(end.noise.rotation_step / start.noise.rotation_step)),
        float(np.median(end.noise.translation_step / start.noise.translation_step)),
    )
    if max(ratios) < RAISED:
        return None
    noise = replace(
        start.noise,
        rotation_step=start.noise.rotation_step * max(ratios[0], 1.0),
        translation_step=start.noise.translation_step * max(ratios[1], 1.0),
        warnings=end.noise.warnings,
    )
    return replace(start, noise=noise)


def with_odometry_kept(start: SlamState, end: SlamState) -> SlamState | None:
    """The start with translations no looser than stated, or than the default, for good; None where the end's are not far looser.

    That of rotations is found anew: bearings tell it, and ranges do not bend them, but in a map of wrong associations it is
    as wrong as all else (0.03 rad in place of 0.006).

    A detector whose errors are wrongly stated (objects smaller than it learnt from, say) contradicts the odometry step after
    step. Which of the two errs is then asked of the evidence of the whole map: in a drive of 494 frames seen at half the size
    that the network learnt from, stated scales were raised 15-fold and 8.3 m of error became 94 m, with a log evidence of 6 557;
    kept, the same detections gave 4.7 m and 9 107.
    """
    if not len(start.noise.rotation_step):
        return None
    rotation, translation, _ = step_sigmas(start.problem, start.config)
    if not leaves_odometry(end):
        return None
    if not stated_sigmas(start.problem, start.config)[0]:
        rotation = start.noise.rotation_step
    translation = np.minimum(start.noise.translation_step, translation)
    report = {name: value for name, value in start.noise.report.items() if not name.startswith("odometry_")}
    report |= {"odometry_rotation_scale": float(np.median(rotation)), "odometry_translation_scale": float(np.median(translation))}
    noise = replace(start.noise, rotation_step=rotation, translation_step=translation, report=report)
    return replace(start, noise=noise, odometry_kept=True)


def told_of_kept(state: SlamState, other: Run) -> SlamState:
    """The state with a warning that its odometry was kept against another run, in whose map it errs far more."""
    ratio = float(np.median(other.state.noise.translation_step / state.noise.translation_step))
    text = (
        f"detections contradict the odometry: they would have its translations err {ratio:.3g} times as much, but the map as a "
        "whole is more probable with the odometry kept. Are ranges poor (very small objects, sizes misjudged, the wrong camera)?"
    )
    return replace(state, noise=replace(state.noise, warnings=(*state.noise.warnings, text)))


def run_to_end(
    state: SlamState,
    iterate: Callable[[SlamState, Callable[[SlamState, EmStepInfo], None]], tuple[SlamState, tuple[EmStepInfo, ...]]],
    on_step: Callable[[SlamState, EmStepInfo], None] | None,
) -> Run:
    """Iterate, finish, and weigh."""
    history: list[SlamEstimate] = []

    def record(state: SlamState, info: EmStepInfo) -> None:
        history.append(state.estimate)
        if on_step is not None:
            on_step(state, info)

    config = state.config
    state, infos = iterate(state, record)
    state, associations = finish(state)
    return Run(replace(state, config=config), associations, infos, tuple(history), map_log_evidence(state))


def agree(first: Run, second: Run, distance: float, same: float) -> bool:
    """Whether two runs from different starts ended at one map: trajectories well within `same`, landmarks counted alike.

    Two that closed no loop agree on nothing: that neither found one is no evidence that there is none.

    The evidence of two that did need not agree: scales of the noise that settled a few percent apart move it by a hundred
    nats on a drive whose maps no eye could tell apart.
    """
    if not (first.closed and second.closed):
        return False
    if distance < same and abs(first.log_evidence - second.log_evidence) < SAME_EVIDENCE:
        return True
    counts = len(first.state.static), len(second.state.static)
    return distance < SAME_SHARE * same and abs(counts[0] - counts[1]) <= SAME_COUNT * max(counts)


def starts_after_first(state: SlamState, associations: list[WholeAssociation]) -> Iterator[SlamState]:
    """Starts of the runs after the first, without end: anneals and associations in turn.

    Where a scale of the odometry is a guess, an anneal from a drift three times as wide comes first, for the search believes the
    guess (a small room: 15 landmarks for 15 objects, 21 when the association came first); else the best association does.
    """
    anneals = (start_of_run(state, k) for k in count(1))
    if not all(stated_sigmas(state.problem, state.config)):
        yield next(anneals)
    for association in associations:
        yield with_association(state, association)
        yield next(anneals)
    yield from anneals


def near_rivals(state: SlamState, associations: list[WholeAssociation]) -> Iterator[SlamState]:
    """Starts of the runs after two that agree: associations that come near the best one, where the search could be believed."""
    if all(stated_sigmas(state.problem, state.config)):
        for one in associations[1:]:
            if one.log_odds > associations[0].log_odds - RIVAL:
                yield with_association(state, one)


def explore(
    state: SlamState,
    iterate: Callable[[SlamState, Callable[[SlamState, EmStepInfo], None]], tuple[SlamState, tuple[EmStepInfo, ...]]],
    on_step: Callable[[SlamState, EmStepInfo], None] | None = None,
) -> tuple[Run, tuple[MapHypothesis, ...]]:
    """The best of up to `SlamConfig.hypotheses` runs, and all distinct maps with their weights, best first."""
    runs: list[Run] = []
    same = SAME_MAP * 2 * state.link_scale
    limit = max(state.config.hypotheses, 1)
    given = state
    runs.append(run_to_end(state, iterate, on_step))
    if (raised := raised_odometry(state, runs[0].state)) is not None:
        # Loops were judged under a drift far too small: once more under what the map now says.
        state = raised
        runs[0] = run_to_end(state, iterate, on_step)
    if (rival := with_odometry_kept(given, runs[0].state)) is not None:
        kept_run = run_to_end(rival, iterate, on_step)
        if kept_run.log_evidence > runs[0].log_evidence - PREFERENCE * len(state.problem.observations):
            state, runs[0] = rival, replace(kept_run, state=told_of_kept(kept_run.state, runs[0]))
    if limit > 1 and len(state.static) > 1:
        associations = best_associations(state, count=limit)
        starts = starts_after_first(state, associations)
        runs.append(run_to_end(next(starts), iterate, on_step))
        distance = trajectory_distance(runs[0].state.estimate.T_world_camera, runs[1].state.estimate.T_world_camera)
        if agree(runs[0], runs[1], distance, same):
            starts = near_rivals(state, associations)
        runs += [run_to_end(start, iterate, on_step) for start in islice(starts, limit - 2)]
    if len(runs) > 2:  # and the map without any loop: runs that disagree may all be wrong
        runs.append(run_to_end(state, lambda start, _: (start, ()), None))
    runs.sort(key=lambda run: -run.log_evidence)
    distinct: list[Run] = []
    for run in runs:
        T = run.state.estimate.T_world_camera
        if all(trajectory_distance(T, other.state.estimate.T_world_camera) >= same for other in distinct):
            distinct.append(run)
    weight = np.exp(np.array([run.log_evidence for run in distinct]) - distinct[0].log_evidence)
    weight /= weight.sum()
    config = state.config
    kept = [
        MapHypothesis(float(w), run.log_evidence, replace(run.state, config=config), run.associations)
        for w, run in zip(weight, distinct)
        if w > MIN_WEIGHT
    ]
    best = replace(distinct[0], state=replace(distinct[0].state, config=config))
    return best, tuple(kept)


def mixture_covariances(
    hypotheses: tuple[MapHypothesis, ...], T_world_camera: Float[np.ndarray, "n 4 4"], rows: np.ndarray
) -> Float[np.ndarray, "r 6 6"]:
    """Covariances about the given poses of the mixture of all hypotheses: `sum w (C + d d')`, d the other map's pose."""
    out = np.zeros((len(rows), 6, 6))
    for hypothesis in hypotheses:
        away = se3_log(relative(T_world_camera[rows], hypothesis.T_world_camera[rows]))
        out += hypothesis.weight * (hypothesis.pose_covariances(rows) + away[:, :, None] * away[:, None, :])
    return out


def ambiguity(hypotheses: tuple[MapHypothesis, ...]) -> str | None:
    """In words what the rivals differ in, or None where there is none to speak of."""
    rivals = [h for h in hypotheses[1:] if h.weight > AMBIGUOUS]
    if not rivals:
        return None
    best = hypotheses[0]
    parts = []
    for rival in rivals:
        gap = np.linalg.norm(rival.T_world_camera[:, :3, 3] - best.T_world_camera[:, :3, 3], axis=1)
        worst = int(np.argmax(gap))
        parts.append(
            f"one of weight {rival.weight:.2f} is {gap[worst]:.2f} m away at frame {worst} and has "
            f"{len(rival.state.static)} landmarks for {len(best.state.static)}"
        )
    return "ambiguous: other maps explain the detections nearly as well; " + "; ".join(parts)
