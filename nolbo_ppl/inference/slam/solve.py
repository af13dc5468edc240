"""The whole of it: `solve` runs `init`, `step` until nothing changes, and `finish`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from nolbo_ppl.inference.slam.em import EmStepInfo, step
from nolbo_ppl.inference.slam.hypotheses import ambiguity, explore
from nolbo_ppl.inference.slam.initialise import SlamState, first_estimate, init
from nolbo_ppl.inference.slam.slam_problem import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.slam_result import SlamResult
from nolbo_ppl.inference.slam.slam_state import given_odometry


def iterate(
    state: SlamState, on_step: Callable[[SlamState, EmStepInfo], None] | None = None
) -> tuple[SlamState, tuple[EmStepInfo, ...]]:
    """Constellation rounds until they find nothing new, then the soft EM until the trajectory rests."""
    infos: list[EmStepInfo] = []
    remaining = state.config.em_iterations
    if len(state.static) < 2:
        return state, ()
    while remaining > 0:
        phase_closing = state.closing
        state, info = step(state)
        infos.append(info)
        if on_step is not None:
            on_step(state, info)
        if not phase_closing:
            remaining -= 1
            if info.change < 0.1 * state.link_scale:
                break
    return state, tuple(infos)


def solve(
    problem: SlamProblem, config: SlamConfig | None = None, on_step: Callable[[SlamState, EmStepInfo], None] | None = None
) -> SlamResult:
    """Odometry and observations in, corrected trajectory and map out.

    Args:
        problem: the drive.
        config: settings; the defaults estimate every scale.
        on_step: called after each iteration.

    Raises:
        InputError: malformed input.
        GraphError: GTSAM could not solve the graph; names pose or landmark.

    Example:
        >>> import nolbo_ppl
        >>> from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
        >>> rng = np.random.default_rng(0)
        >>> drive = simulate_sequence(simulate_circuit(rng, frames_per_lap=30), rng, world=WorldConfig(objects=15))

        >>> result = nolbo_ppl.solve(nolbo_ppl.SlamProblem(drive.odometry, drive.observations))
        >>> result.T_world_camera.shape, len(result.landmarks) > 5
        ((60, 4, 4), True)
    """
    config = config or SlamConfig()
    start = time.perf_counter()
    state = init(problem, config)
    seconds = {"tracklets": time.perf_counter() - start}
    result = complete(state, on_step, config.hypotheses)
    return replace(result, seconds=seconds | result.seconds)


def complete(state: SlamState, on_step: Callable[[SlamState, EmStepInfo], None] | None = None, hypotheses: int = 1) -> SlamResult:
    """Iterate a state to its end, by several runs where they disagree; what every iteration of the best one held is kept.

    Args:
        state: where the EM begins.
        on_step: called after each iteration.
        hypotheses: runs at most (`solve` takes the configured number).
    """
    start = first_estimate(state.measurements, given_odometry(state), state.config, state.rows, state.landmark, len(state.static))
    clock = time.perf_counter()
    config = state.config
    state = replace(state, config=replace(config, hypotheses=hypotheses))
    best, maps = explore(state, iterate, on_step)
    state = replace(best.state, config=config)
    warnings = list(state.noise.warnings) + without_a_map(state)
    text = ambiguity(maps)
    if text is not None:
        warnings.append(text)
    state = replace(state, noise=replace(state.noise, warnings=tuple(dict.fromkeys(warnings))))
    seconds = {"em": time.perf_counter() - clock}
    return SlamResult(
        state=state,
        associations=best.associations,
        infos=best.infos,
        seconds=seconds,
        history=(start, *best.history, state.estimate),
        hypotheses=maps,
    )


def without_a_map(state: SlamState) -> list[str]:
    """Why no landmark is left, in words; nothing where some are."""
    if len(state.static) or not len(state.problem.observations):
        return []
    moving = int(state.tracklets.moving.sum())
    if moving:
        return [f"no landmark is left: all {moving} tracks move against the odometry; state the odometry's scales if they do not"]
    if not len(state.tracklets):
        return ["no landmark is left: no object was detected twice in a row where the scales expect it"]
    return ["no landmark is left: every track is more probably background; look at the stated scales, objectness and rates"]
