"""Object SLAM by EM on a GTSAM factor graph."""

from __future__ import annotations

from nolbo_ppl.inference.slam.config import NoiseModel, SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.em import StepInfo, step
from nolbo_ppl.inference.slam.finish import finish
from nolbo_ppl.inference.slam.graph import GraphError, Links
from nolbo_ppl.inference.slam.noise import estimate_noise
from nolbo_ppl.inference.slam.observe import Associations
from nolbo_ppl.inference.slam.online import ObjectSlam, OnlineInfo, solve_online
from nolbo_ppl.inference.slam.oracle import solve_with_associations
from nolbo_ppl.inference.slam.plain import PlainInfo, PlainState, plain_init, plain_solve, plain_step
from nolbo_ppl.inference.slam.result import Landmark, SlamResult
from nolbo_ppl.inference.slam.solve import iterate, solve
from nolbo_ppl.inference.slam.state import SlamState, init
from nolbo_ppl.inference.slam.tracklets import Tracklets

__all__ = [
    "Associations",
    "GraphError",
    "Landmark",
    "Links",
    "NoiseModel",
    "ObjectSlam",
    "OnlineInfo",
    "PlainInfo",
    "PlainState",
    "SlamConfig",
    "SlamProblem",
    "SlamResult",
    "SlamState",
    "StepInfo",
    "Tracklets",
    "estimate_noise",
    "finish",
    "init",
    "iterate",
    "plain_init",
    "plain_solve",
    "plain_step",
    "solve",
    "solve_online",
    "solve_with_associations",
    "step",
]
