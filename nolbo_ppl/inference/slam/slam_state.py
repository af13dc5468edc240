"""State of the EM: what is fixed for a drive, and what an iteration changes."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.inference.slam.detection_features import FeaturePrior
from nolbo_ppl.inference.slam.frame_model import FrameModel
from nolbo_ppl.inference.slam.graph import (
    LandmarkEqualities,
    ObservationFactors,
    SlamEstimate,
    add_landmark_priors,
    add_observation_factors,
    odometry_factors,
    resolve_observations,
)
from nolbo_ppl.inference.slam.loop_candidates import TrackletFeatures
from nolbo_ppl.inference.slam.measurements import Measurements, resolve
from nolbo_ppl.inference.slam.noise.odometry_scale import rescaled
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.tracking import Tracklets


@dataclass(frozen=True)
class SlamState:
    """Everything an iteration reads and returns."""

    problem: SlamProblem
    """Odometry and observations."""
    config: SlamConfig
    """Settings."""
    noise: NoiseModel
    """Scales in use."""
    prior: FeaturePrior
    """Population of features."""
    tracklets: Tracklets
    """Short-term tracks, numbered with moving ones."""
    static: Int[np.ndarray, " m"]
    """Tracks that are landmarks of the graph."""
    rows: Int[np.ndarray, " k"]
    """Detections in the graph."""
    landmark: Int[np.ndarray, " k"]
    """Landmark (index into `static`) of each of them."""
    weight: Float[np.ndarray, " k"]
    """Their weights: probability of being that object rather than background."""
    features: TrackletFeatures
    """Features of the landmarks."""
    estimate: SlamEstimate
    """Poses and landmarks."""
    links: LandmarkEqualities
    """Weighted links in use."""
    typical_range: float
    """Median range of detections, m."""
    iteration: int = 0
    """Iterations done."""
    closing: bool = True
    """Whether constellation rounds still run."""
    graph_error: float = 0.0
    """Half the sum of squared whitened residuals of the last M-step."""
    closed: dict[int, int] = field(default_factory=dict)
    """Tracklets closed by constellation, newer to older."""

    odometry_scale: Float[np.ndarray, " n-1"] | None = None
    """Factors the steps of the given odometry were multiplied by in `problem`, where its scale drifts (`scale_drift`)."""

    odometry_kept: bool = False
    """The odometry's translations are no looser than was said: a run that asks what the detections are worth if it is so good."""

    frame_model: FrameModel | None = None
    """Model of a frame's detections, once the map has been associated."""

    @cached_property
    def measurements(self) -> Measurements:
        """The detections, everything resolved under the noise in use."""
        return resolve(self.problem.observations, self.noise, self.config, self.prior)

    @property
    def link_scale(self) -> float:
        """How much one object's measured position varies between passes, m: half the typical detection scale."""
        return link_scale(self.noise)


def given_odometry(state: SlamState) -> Float[np.ndarray, "n 4 4"]:
    """The odometry as it was handed in, in its own unit."""
    if state.odometry_scale is None:
        return state.problem.odometry
    return rescaled(state.problem, 1.0 / state.odometry_scale).odometry


def object_log_density(noise: NoiseModel) -> float:
    """Log density of objects in view, per m^3: the prior of "another object" wherever two tracklets or landmarks are compared.

    That is the density of detections a frame, five times the rate of first ones. A gap's density is weighed against it.
    """
    return float(np.log(5.0 * noise.birth_intensity))


def link_scale(noise: NoiseModel) -> float:
    """Half the median scale of a detected position, m."""
    if not len(noise.position_covariance):
        return 0.1
    return 0.5 * float(np.sqrt(np.median(np.trace(noise.position_covariance, axis1=1, axis2=2)) / 3))


def measured_graph(state: SlamState) -> tuple[gtsam.NonlinearFactorGraph, ObservationFactors]:
    """Odometry, weighted observations and weak priors of a state, in this order, and the observations' factors."""
    factors = resolve_observations(
        state.measurements,
        state.noise,
        state.config,
        state.estimate,
        state.rows,
        state.landmark,
        state.weight,
    )
    graph = odometry_factors(state.problem, state.noise)
    add_observation_factors(graph, factors)
    add_landmark_priors(graph, state.estimate.T_world_landmark, state.typical_range, state.features.oriented)
    return graph, factors
