"""Time of the E-step against the dimensions of the latent, and the share of the latent's distances in it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.detection_features import latent_log_density
from nolbo_ppl.inference.slam.reference_em import ReferenceEmState, e_step, em_init
from nolbo_ppl.reproduction.budgets import ReproduceConfig
from nolbo_ppl.reproduction.paper_numbers import ESTEP_RATIO
from nolbo_ppl.reproduction.result_table import ResultTable, over_seeds

DIMENSIONS = (16, 64, 128)
"""Dimensions of the latent that are timed."""
OBJECTS = 200
"""Landmarks of the map."""


@dataclass(frozen=True)
class EStepTime:
    """Seconds of E-steps, a row a repetition."""

    whole: Float[np.ndarray, " r"]
    """Of the whole E-step."""
    latent: Float[np.ndarray, " r"]
    """Of the densities of all latents under all landmarks, which are part of it."""
    keyframes: int
    """Keyframes with detections."""


def simulated_state(dimensions: int, frames: int, seed: int) -> ReferenceEmState:
    """A drive of two laps through a simulated world, at its true map; where objects stand does not depend on the dimensions."""
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, frames_per_lap=max(frames // 2, 2))
    sequence = simulate_sequence(truth, rng, world=WorldConfig(objects=OBJECTS, latent_dim=dimensions))
    world = sequence.world
    assert world is not None
    problem = SlamProblem(sequence.odometry, sequence.observations)
    return em_init(problem, SlamConfig(), make_pose(world.rotation, world.position), world.latent)


def time_e_step(state: ReferenceEmState, repeats: int, clock: Callable[[], float] = time.process_time) -> EStepTime:
    """Time the plain EM's E-step (docs/em.md; every detection against every landmark) and its latents alone.

    In processor time, which does not count what else the machine does.
    """
    whole, latent = [], []
    seen = state.measurements
    e_step(state)  # whatever is compiled at its first call
    for _ in range(repeats):
        start = clock()
        e_step(state)
        middle = clock()
        latent_log_density(seen.latent[:, None], state.latent[None], seen.latent_variance[:, None])
        end = clock()
        whole.append(middle - start)
        latent.append(end - middle)
    return EStepTime(np.array(whole), np.array(latent), len(np.unique(seen.frame)))


def e_step_table(config: ReproduceConfig) -> ResultTable:
    """Milliseconds a keyframe by dimension, the share of the latents, and the ratio to 16 dimensions."""
    table = ResultTable(
        "E-step against the dimensions of the latent",
        ("CPU ms a keyframe", "of these, latents", "share of latents", "time over that of 16"),
        f"Plain EM, every detection against {OBJECTS} landmarks, {config.sizes.estep_frames} frames; medians of "
        f"{config.sizes.repeats} repetitions, {config.seeds} worlds. "
        f"The paper: 16 dimensions are up to {ESTEP_RATIO:g} times faster than 128.",
    )
    by_dimension = {}
    for dimensions in DIMENSIONS:
        times = [
            time_e_step(simulated_state(dimensions, config.sizes.estep_frames, seed), config.sizes.repeats)
            for seed in range(config.seeds)
        ]
        by_dimension[dimensions] = times
        whole = np.array([1000 * np.median(one.whole) / one.keyframes for one in times])
        latent = np.array([1000 * np.median(one.latent) / one.keyframes for one in times])
        first = np.array([1000 * np.median(one.whole) / one.keyframes for one in by_dimension[DIMENSIONS[0]]])
        cells = [over_seeds(value) for value in (whole, latent, latent / whole, whole / first)]
        table.add(f"{dimensions} dimensions", cells)
    return table
