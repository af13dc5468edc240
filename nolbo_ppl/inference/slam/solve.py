"""The whole of it: `solve` runs `init`, `step` until nothing changes, and `finish`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from nolbo_ppl.inference.slam.config import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.em import StepInfo, step
from nolbo_ppl.inference.slam.finish import finish
from nolbo_ppl.inference.slam.result import SlamResult
from nolbo_ppl.inference.slam.state import SlamState, init


def iterate(
    state: SlamState, on_step: Callable[[SlamState, StepInfo], None] | None = None
) -> tuple[SlamState, tuple[StepInfo, ...]]:
    """Constellation rounds until they find nothing new, then the soft EM until the trajectory rests."""
    infos: list[StepInfo] = []
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
    problem: SlamProblem, config: SlamConfig | None = None, on_step: Callable[[SlamState, StepInfo], None] | None = None
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
    seconds = {}
    clock = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[name] = now - clock
        clock = now

    state = init(problem, config)
    lap("tracklets")
    state, infos = iterate(state, on_step)
    lap("em")
    state, associations = finish(state)
    lap("map")
    return SlamResult(state=replace(state), associations=associations, infos=infos, seconds=seconds)
