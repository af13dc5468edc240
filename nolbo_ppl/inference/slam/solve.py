"""The whole of it: `solve` runs `init`, `step` until nothing changes, and `finish`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from nolbo_ppl.inference.slam.em import EmStepInfo, step
from nolbo_ppl.inference.slam.initialise import SlamState, first_estimate, init
from nolbo_ppl.inference.slam.map_refinement import finish
from nolbo_ppl.inference.slam.slam_problem import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.slam_result import SlamResult


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
    """
    config = config or SlamConfig()
    start = time.perf_counter()
    state = init(problem, config)
    seconds = {"tracklets": time.perf_counter() - start}
    result = complete(state, on_step)
    return replace(result, seconds=seconds | result.seconds)


def complete(state: SlamState, on_step: Callable[[SlamState, EmStepInfo], None] | None = None) -> SlamResult:
    """Iterate a state, finish it, and keep what every iteration held."""
    start = first_estimate(
        state.measurements, state.problem.odometry, state.config, state.rows, state.landmark, len(state.static)
    )
    history = [start]

    def record(state: SlamState, info: EmStepInfo) -> None:
        history.append(state.estimate)
        if on_step is not None:
            on_step(state, info)

    clock = time.perf_counter()
    state, infos = iterate(state, record)
    middle = time.perf_counter()
    state, associations = finish(state)
    seconds = {"em": middle - clock, "map": time.perf_counter() - middle}
    return SlamResult(state=state, associations=associations, infos=infos, seconds=seconds, history=(*history, state.estimate))
