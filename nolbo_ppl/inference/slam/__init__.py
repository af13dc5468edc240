"""Object SLAM by EM on a GTSAM factor graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nolbo_ppl._moved import renamed
from nolbo_ppl.inference.slam.data_association import Associations
from nolbo_ppl.inference.slam.em import EmStepInfo, step
from nolbo_ppl.inference.slam.graph import GraphError, LandmarkEqualities
from nolbo_ppl.inference.slam.ground_truth_association import solve_with_associations
from nolbo_ppl.inference.slam.incremental.incremental_slam import IncrementalInfo, IncrementalSlam, solve_incremental
from nolbo_ppl.inference.slam.incremental.keyframes import KeyframeConfig
from nolbo_ppl.inference.slam.initialise import SlamState, init
from nolbo_ppl.inference.slam.map_refinement import finish
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.reference_em import ReferenceEmInfo, ReferenceEmState, em_init, em_solve, em_step
from nolbo_ppl.inference.slam.sessions import JointMap, SessionsResult, solve_sessions
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.slam_result import SlamResult
from nolbo_ppl.inference.slam.solve import iterate, solve
from nolbo_ppl.inference.slam.tracking import Tracklets
from nolbo_ppl.structures.landmark import Landmark

__all__ = [
    "Associations",
    "GraphError",
    "Landmark",
    "JointMap",
    "LandmarkEqualities",
    "NoiseModel",
    "IncrementalSlam",
    "KeyframeConfig",
    "IncrementalInfo",
    "ReferenceEmInfo",
    "ReferenceEmState",
    "SessionsResult",
    "SlamConfig",
    "SlamProblem",
    "SlamResult",
    "SlamState",
    "EmStepInfo",
    "Tracklets",
    "estimate_noise",
    "finish",
    "init",
    "iterate",
    "em_init",
    "em_solve",
    "em_step",
    "solve",
    "solve_incremental",
    "solve_sessions",
    "solve_with_associations",
    "step",
]


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
