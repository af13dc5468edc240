"""The E-step of single detections against a map: exact marginals of every frame under the generative model of a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import expit

from nolbo_ppl.inference.slam.detection_pairs import detection_pairs
from nolbo_ppl.inference.slam.existence import contribution, detected_log_odds, existence_log_odds, score_correlation
from nolbo_ppl.inference.slam.exposures import exposures_of, exposures_of_places
from nolbo_ppl.inference.slam.frame_marginals import frame_marginals
from nolbo_ppl.inference.slam.frame_model import FrameModel, initial_frame_model
from nolbo_ppl.inference.slam.frame_model_fit import estimate_frame_model
from nolbo_ppl.inference.slam.linearisation import Linearisation
from nolbo_ppl.inference.slam.slam_state import SlamState

LISTED = 1e-4
"""Marginals below this are not listed."""
ROUNDS = 5
"""E-steps, and M-steps of the model of a frame, of one association."""


@dataclass(frozen=True)
class Associations:
    """Marginal association of every detection, sparse: rows of the table, landmark numbers, probabilities."""

    row: Int[np.ndarray, " p"]
    """Detection of each entry."""
    landmark: Int[np.ndarray, " p"]
    """Landmark of each entry."""
    weight: Float[np.ndarray, " p"]
    """Its probability."""
    new: Float[np.ndarray, " k"]
    """Probability of each detection being an object the map does not hold."""
    background: Float[np.ndarray, " k"]
    """Probability of each detection being no object."""
    log_evidence: Float[np.ndarray, " f"]
    """Log evidence of each frame with detections, nats."""
    exact: bool
    """Whether every frame was summed exactly."""
    existence: Float[np.ndarray, " m"]
    """Probability of each landmark being an object."""
    model: FrameModel
    """The model of a frame, as estimated."""


def associate_detections(state: SlamState, linearisation: Linearisation, rng: np.random.Generator) -> Associations:
    """Marginals of all detections over the landmarks of a map, and the model of a frame they are computed with.

    Every landmark is a Bernoulli component: in each frame it is missed with probability `1 - r P_D`, or causes one
    detection. Odds of detection k of frame t (docs/em.md), over those of clutter:

    - landmark j: `s_k p(z_k | l_j) r_j P_D / (1 - r_j P_D)`, position, latent, orientation and existence without k itself;
    - an object the map does not hold: `s_k (density of objects) P(missed wherever else it was in view)`;
    - background: the density of clutter at that range.

    E-step and M-step of the model of the frame alternate `ROUNDS` times.

    Args:
        state: the map; its rows, landmarks and weights say which detection placed which landmark.
        linearisation: of its graph.
        rng: draws the posterior samples of relative positions.
    """
    seen, config = state.measurements, state.config
    m = len(state.estimate.T_world_landmark)
    pairs = detection_pairs(state, linearisation, rng)
    model = state.frame_model or initial_frame_model(seen, config, len(state.problem))
    T_world_camera = state.estimate.T_world_camera
    of_landmark = exposures_of(model, T_world_camera, state.estimate.T_world_landmark[:, :3, 3])
    places = exposures_of_places(model, T_world_camera, seen)
    moving = moving_detections(state)
    log_odds, weight = np.full(m, 50.0), np.zeros(len(pairs))  # every landmark exists until the first E-step
    hit_cell = model.cell(pairs.local)
    log_density = model.log_detection_density(seen.position)
    for _ in range(ROUNDS):
        score = model.log_score_ratio(seen)
        log_clutter = model.log_clutter(seen, log_density)
        log_once = places.log_only_here(model)
        log_once[moving] = 0.0  # it was elsewhere
        log_new = score + log_once + np.log(model.unmapped)
        log_new += np.log(model.birth_intensity) if model.birth_intensity is not None else model.log_objects(seen, log_density)
        log_null = np.logaddexp(log_new, log_clutter)
        log_odds_without = log_odds[pairs.landmark] - contribution(state, pairs, weight, model, of_landmark, log_density)
        log_detected = detected_log_odds(state, pairs, weight, model, of_landmark, log_odds_without)
        value = score[pairs.row] + pairs.log_position + pairs.log_feature + log_detected
        found = frame_marginals(seen.frame, pairs.row, pairs.landmark, value, log_null, associator=config.associator)
        weight = found.weight
        new = found.null * np.exp(log_new - log_null)
        background = np.maximum(found.null - new, 0.0)
        hits = np.bincount(pairs.landmark, weight, minlength=m).astype(np.float64)
        model = replace(model, score_correlation=score_correlation(seen, pairs, weight))
        # Rates first, by what existed so far: under those that the first round begins with, every object seen in few of the
        # frames that have it somewhere in view would be none, and what is left would make the rates higher still.
        model = estimate_frame_model(
            model, seen, background, new, np.exp(log_once), of_landmark, places.middle, hit_cell, weight, expit(log_odds), hits
        )
        log_odds = existence_log_odds(state, pairs, weight, model, of_landmark, log_density)
    listed = weight > LISTED
    return Associations(
        row=pairs.row[listed],
        landmark=pairs.landmark[listed],
        weight=weight[listed],
        new=new,
        background=background,
        log_evidence=found.log_evidence,
        exact=found.exact,
        existence=expit(log_odds),
        model=model,
    )


def rates_report(found: Associations, frames: int) -> dict[str, float]:
    """Rates with their posterior, by name: a Poisson rate given its expected count is gamma, a share is beta."""
    model, n = found.model, len(found.background)
    false, unmapped = float(found.background.sum()) + 0.5, float(found.new.sum()) + 0.5
    share = false / (n + 1.0)
    return {
        "clutter_per_frame": false / frames,
        "clutter_per_frame_std": float(np.sqrt(false)) / frames,
        "unmapped_per_frame": unmapped / frames,
        "unmapped_per_frame_std": float(np.sqrt(unmapped)) / frames,
        "clutter_share": share,
        "clutter_share_std": float(np.sqrt(share * (1 - share) / (n + 2.0))),
        "detection_probability": float(np.median(model.detection_probability)),
        "detection_concentration": model.concentration,
        "score_slope": model.score_slope,
        "score_correlation": model.score_correlation,
    }


def moving_detections(state: SlamState) -> Bool[np.ndarray, " n"]:
    """Detections of tracks that move."""
    track = state.tracklets.of_observation
    return (track >= 0) & state.tracklets.moving[np.maximum(track, 0)] if len(state.tracklets) else np.zeros(len(track), bool)
