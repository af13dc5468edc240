"""Scales of the odometry: by the evidence of the tracked objects first, by that of the closed loops later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nolbo_ppl.inference.slam.graph import SlamEstimate
from nolbo_ppl.inference.slam.linearisation import Linearisation
from nolbo_ppl.inference.slam.noise.fitted_residuals import squared_ratio
from nolbo_ppl.inference.slam.noise.neighbour_gaps import SURE_GAIN
from nolbo_ppl.inference.slam.noise.noise_estimation import TOO_SMALL, step_sigmas
from nolbo_ppl.inference.slam.noise.scale_evidence import ScaleEvidence, scale_evidence, scale_posterior
from nolbo_ppl.inference.slam.slam_problem import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.slam_state import SlamState

WINDOW = 200
"""Frames the evidence is taken from: where most detections are."""
GRID = np.log(4.0) * np.arange(-3, 4)
"""Log factors tried on scales nobody stated: 1/64 to 64 times the default."""
LARGEST_WINDOW = 400
"""The same for the map at the end, loops closed."""
STATED_GRID = np.log(4.0) * np.arange(0, 11)
"""The same for stated ones, which are only ever raised: a covariance of 1e-12 is a scale 4 000 times too small."""
MIN_STATED = 10.0
"""Steps' worth of information below which residuals over the posterior change no scale."""
LARGEST_CHANGE = 4.0
"""Largest factor on a scale in one update."""
MIN_SUPPORT = 2.0
"""A correction of the odometry must gain as much log evidence over an odometry without noise, nats."""
NO_NOISE = 1 / 64
"""Factor on the default scales that stands for an odometry without noise."""
LEFT_BEHIND = 2.0
"""A scale of translations so many times the stated or the default one leaves the odometry: a run that ends so has a rival that
keeps it."""
WORTHLESS = 0.4
"""Scale over the length of the steps from which on a warning says that the detections contradict the odometry."""
WELL_STATED = 30.0
"""Steps' worth of information below which a scale nobody stated is called a guess."""


def stated_sigmas(problem: SlamProblem, config: SlamConfig) -> tuple[bool, bool]:
    """Whether the user stated the rotation and the translation scale."""
    if problem.odometry_covariance is not None:
        return True, True
    return config.odometry_rotation_scale is not None, (
        config.odometry_translation_scale is not None or config.odometry_translation_ratio is not None
    )


def densest_window(state: SlamState, length: int = WINDOW) -> SlamState:
    """The problem cut to the frames in a row with most detections, landmarks seen twice there alone."""
    n = len(state.problem)
    frame = state.problem.observations.frame[state.rows]
    if n > length:
        counts = np.concatenate([[0], np.cumsum(np.bincount(frame, minlength=n))])
        first = int(np.argmax(counts[length:] - counts[:-length]))
    else:
        first, length = 0, n
    inside = (frame >= first) & (frame < first + length)
    seen = np.bincount(state.landmark[inside], minlength=len(state.static))
    inside &= seen[state.landmark] >= 2
    names, landmark = np.unique(state.landmark[inside], return_inverse=True)
    table = state.problem.observations.select(state.rows[inside])
    table = replace(table, frame=table.frame - first)
    noise = replace(
        state.noise,
        rotation_step=state.noise.rotation_step[first : first + length - 1],
        translation_step=state.noise.translation_step[first : first + length - 1],
        position_covariance=state.noise.position_covariance[state.rows[inside]],
        rotation_scale=state.noise.rotation_scale[state.rows[inside]],
        latent_scale=state.noise.latent_scale[state.rows[inside]],
    )
    problem = SlamProblem(state.problem.odometry[first : first + length], table)
    scale = state.estimate.scale
    estimate = SlamEstimate(
        state.estimate.T_world_camera[first : first + length],
        state.estimate.T_world_landmark[names],
        None if scale is None else scale[first : first + length - 1],
    )
    return replace(
        state,
        problem=problem,
        noise=noise,
        rows=np.arange(len(table)),
        landmark=landmark.astype(np.int64),
        weight=state.weight[inside],
        static=names,
        estimate=estimate,
    )


def odometry_by_evidence(state: SlamState) -> SlamState:
    """Scales of the odometry that the tracked objects make probable, where nobody stated them.

    Before loops close the evidence often bounds a scale from above alone. The one in use is then a standard deviation above
    the posterior's mean: too wide a drift is annealed away as loops close, too narrow a one closes none.
    """
    free = (not stated_sigmas(state.problem, state.config)[0], not stated_sigmas(state.problem, state.config)[1])
    window = densest_window(state)
    if not any(free) or len(window.rows) < 20 or len(window.problem) < 10:
        return state
    report, warnings = dict(state.noise.report), list(state.noise.warnings)
    evidence = scale_evidence(window)
    factors = np.ones(2)
    if any(free):
        found = scale_posterior(evidence, free, grid=GRID)
        factors = np.exp(found.mean + found.deviation)
        for name, spread, is_free in zip(("rotation", "translation"), found.deviation, free):
            if is_free:
                report[f"odometry_{name}_log_spread"] = float(spread)
    return _scaled(state, factors, report, warnings)


def _scaled(state: SlamState, factors: np.ndarray, report: dict[str, float], warnings: list[str]) -> SlamState:
    noise = replace(
        state.noise,
        rotation_step=state.noise.rotation_step * factors[0],
        translation_step=state.noise.translation_step * factors[1],
        report=report,
        warnings=tuple(dict.fromkeys(warnings)),
    )
    report["odometry_rotation_scale"] = float(np.median(noise.rotation_step))
    report["odometry_translation_scale"] = float(np.median(noise.translation_step))
    return replace(state, noise=noise)


def residual_ratios(state: SlamState, linearisation: Linearisation) -> tuple[tuple[float, float], tuple[float, float]]:
    """Squared ratio of the odometry's residuals to what the model expects after the fit, and how many steps tell it.

    For rotation and translation. The odometry's rows follow the six of the first pose's prior.
    """
    rng = np.random.default_rng(state.config.seed + 7919)
    end = 6 * len(state.problem)
    count = linearisation.affordable(min(state.config.samples, 24))
    expected = linearisation.residual_samples(count, rng)[6:end].reshape(-1, 6, count)
    residual = linearisation.residual[6:end].reshape(-1, 6)
    out = []
    for part in (slice(3), slice(3, 6)):
        out.append(squared_ratio(residual[:, part].ravel(), expected[:, part].reshape(-1, expected.shape[2])))
    return out[0], out[1]


def most_probable(evidence: ScaleEvidence, stated: tuple[bool, bool]) -> tuple[float, float]:
    """Factors of 1 or more with the highest evidence, one axis after the other, twice; between grid points by a parabola.

    A third of the evaluations of the whole grid.
    """
    log_factor = np.zeros(2)
    for sweep in range(2):
        for axis in (0, 1):
            if not stated[axis]:
                continue
            values = []
            for x in STATED_GRID:
                trial = log_factor.copy()
                trial[axis] = x
                values.append(evidence.solve(float(np.exp(trial[0])), float(np.exp(trial[1])))[0])
            k = int(np.argmax(values))
            log_factor[axis] = STATED_GRID[k]
            if sweep and 0 < k < len(values) - 1:
                left, middle, right = values[k - 1 : k + 2]
                bend = left - 2 * middle + right
                log_factor[axis] += 0.5 * (left - right) / bend * (STATED_GRID[1] - STATED_GRID[0]) if bend < 0 else 0.0
    return float(np.exp(log_factor[0])), float(np.exp(log_factor[1]))


def raise_stated(state: SlamState, stated: tuple[bool, bool]) -> SlamState:
    """Stated scales that the evidence of the map says are too small by more than a third: reported, and raised."""
    window = densest_window(state, LARGEST_WINDOW)
    if len(window.problem) < 3 or len(window.rows) < 20:
        return state
    evidence = scale_evidence(window)
    one = evidence.solve(1.0, 1.0)[0]
    # A first look far up, before the grid is paid for.
    far = max(
        evidence.solve(float(f) if stated[0] else 1.0, float(f) if stated[1] else 1.0)[0] for f in np.exp(STATED_GRID[1::2])
    )
    near = max(evidence.solve(2.0 if stated[0] else 1.0, 1.0)[0], evidence.solve(1.0, 2.0 if stated[1] else 1.0)[0])
    if max(far, near) < one + SURE_GAIN:
        return state
    best = most_probable(evidence, stated)
    report, warnings, factors = dict(state.noise.report), list(state.noise.warnings), np.ones(2)
    for axis, name in enumerate(("rotation", "translation")):
        ratio = best[axis]
        if stated[axis] and ratio > TOO_SMALL:
            warnings = [w for w in warnings if not w.startswith(f"stated odometry {name}")]
            warnings.append(f"stated odometry {name} scale is too small: the evidence favours {ratio:.3g} times as much")
            factors[axis] = ratio if state.config.correct_scales else 1.0
    return _scaled(state, factors, report, warnings)


def settle_odometry(state: SlamState) -> tuple[SlamState, tuple[float, float]]:
    """The scales the answer is given with, and factors on them for the trajectory: what nothing supports is not corrected.

    A scale that the closed map still does not tell is the posterior's mean of the tracks. Then the evidence is compared with
    that of an odometry without noise, for rotations, translations and both: where it gains less than `MIN_SUPPORT` the
    trajectory keeps the odometry's own steps, so that good odometry is not bent by poor detections; the covariances keep the
    scale. Where scales are guesses a warning says so, and how far half and twice of them would move the trajectory.
    """
    free = (not stated_sigmas(state.problem, state.config)[0], not stated_sigmas(state.problem, state.config)[1])
    if len(state.problem) < 3 or not len(state.rows) or state.odometry_kept:
        return state, (1.0, 1.0)
    if not all(free):
        state = raise_stated(state, (not free[0], not free[1]))
    if not any(free):
        return state, (1.0, 1.0)
    report, warnings = dict(state.noise.report), list(state.noise.warnings)
    names = ("rotation", "translation")
    told = [report.get(f"odometry_{name}_told", 0.0) for name in names]
    back = np.array(
        [
            np.exp(-report.pop(f"odometry_{name}_log_spread", 0.0)) if is_free and t < MIN_STATED else 1.0
            for name, is_free, t in zip(names, free, told)
        ]
    )
    state = _scaled(state, back, report, warnings)
    window = densest_window(state, LARGEST_WINDOW)
    if len(window.problem) < 3 or not len(window.rows):
        return state, (1.0, 1.0)
    evidence = scale_evidence(window)
    default = step_sigmas(state.problem, state.config)
    least = [
        min(NO_NOISE * float(np.median(d) / np.median(used)), 1.0)
        for d, used in zip(default[:2], (state.noise.rotation_step, state.noise.translation_step))
    ]
    choices = [(a, b) for a in ((1.0, least[0]) if free[0] else (1.0,)) for b in ((1.0, least[1]) if free[1] else (1.0,))]
    chosen = _stiffest(choices, np.array([evidence.solve(a, b)[0] for a, b in choices]))
    if min(choices[chosen]) < 1 and len(window.problem) < len(state.problem):
        # What the frames of the window do not tell, loops of the whole drive may: 1.4 m of error became 2.8 without asking them.
        whole = scale_evidence(state)
        chosen = _stiffest(choices, np.array([whole.solve(a, b)[0] for a, b in choices]))
    guesses = [name for name, is_free, t in zip(names, free, told) if is_free and t < WELL_STATED]
    if guesses:
        report = dict(state.noise.report)
        landmarks, poses = len(window.static), len(window.problem)
        place = [evidence.solve(*(f if is_free else 1.0 for is_free in free))[1] for f in (1.0, 0.5, 2.0)]
        moves = [
            float(np.sqrt(np.mean((x - place[0])[6 * landmarks : 6 * (landmarks + poses)].reshape(-1, 6)[:, 3:] ** 2) * 3))
            for x in place[1:]
        ]
        report["odometry_half_moves"], report["odometry_twice_moves"] = moves
        warnings.append(
            f"odometry {' and '.join(guesses)} scale is a guess (nobody stated it, and the detections tell it badly): half of it "
            f"would move the trajectory by {moves[0]:.3g} m, twice by {moves[1]:.3g} m"
        )
        state = replace(state, noise=replace(state.noise, report=report, warnings=tuple(dict.fromkeys(warnings))))
    return state, choices[chosen]


def _stiffest(choices: list[tuple[float, float]], log_evidence: Float[np.ndarray, " c"]) -> int:
    """The choice that keeps most of the odometry among those that nothing speaks against."""
    return max(
        (k for k in range(len(choices)) if log_evidence[k] > log_evidence.max() - MIN_SUPPORT),
        key=lambda k: ((choices[k][0] < 1) + (choices[k][1] < 1), log_evidence[k]),
    )


def leaves_odometry(state: SlamState) -> bool:
    """Whether translations are taken to err far more than was stated, or than the default says."""
    said = step_sigmas(state.problem, state.config)[1]
    return bool(len(said)) and float(np.median(state.noise.translation_step / said)) >= LEFT_BEHIND


def warn_of_contradiction(state: SlamState) -> SlamState:
    """The state with a warning where the scale found for the odometry's translations is as long as its steps.

    So it is when odometry is lost, and when detections are taken for other objects than they are of, or are seen nearer or
    farther than they are all along: then the map follows them and leaves the odometry.
    """
    step = np.diff(state.problem.odometry[:, :3, 3], axis=0)
    if not len(step) or not len(state.rows):
        return state
    length, scale = float(np.median(np.linalg.norm(step, axis=1))), float(np.median(state.noise.translation_step))
    if length <= 0 or scale <= WORTHLESS * length:
        return state
    text = (
        f"detections contradict the odometry: its steps of {length:.3g} m are taken to err by {scale:.3g} m each. Is it lost, or "
        "are the detections poor (very small objects, the wrong camera)? Stated scales (odometry_translation_scale) with "
        "correct_scales=False keep it"
    )
    return replace(state, noise=replace(state.noise, warnings=(*state.noise.warnings, text)))


def refine_odometry(state: SlamState, linearisation: Linearisation) -> SlamState:
    """One update of the odometry's scales to the fixed point of the evidence: `sigma^2 <- sigma^2 sum r^2 / sum E[r^2]`.

    Scales nobody stated go up and down where `MIN_STATED` steps tell them. Stated ones stay unless they are too small by more
    than a third (reported, and raised with `correct_scales`). Of kept odometry, translations get no looser than was said.
    """
    if len(state.problem) < 3 or not len(state.rows):
        return state
    report, warnings = dict(state.noise.report), list(state.noise.warnings)
    factors = np.ones(2)
    ratios = residual_ratios(state, linearisation)
    for axis, name in enumerate(("rotation", "translation")):
        squared, told = ratios[axis]
        report[f"odometry_{name}_told"] = told
        if told < MIN_STATED:
            continue
        ratio = float(np.clip(np.sqrt(squared), 1 / LARGEST_CHANGE, LARGEST_CHANGE))
        if state.odometry_kept and name == "translation":
            said = step_sigmas(state.problem, state.config)[1]
            ratio = min(ratio, float(np.median(said / state.noise.translation_step)))
        if not stated_sigmas(state.problem, state.config)[axis]:
            factors[axis] = ratio
        elif ratio > TOO_SMALL:
            text = f"stated odometry {name} scale is too small: residuals are {ratio:.2f} times as wide"
            warnings = [w for w in warnings if not w.startswith(f"stated odometry {name}")] + [text]
            factors[axis] = ratio if state.config.correct_scales else 1.0
    return _scaled(state, factors, report, warnings)
