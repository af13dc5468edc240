"""What the running map answers while driving: landmarks with existence, class, covariance and latent.

Existence: every detection that was put to a landmark multiplies the odds that there is an object by
`1 - s + s N(x_k | the landmark so far) q(o_k) / ((1 - q(o_k)) lambda_clutter)`, where s is the probability that the detection
was put to the right landmark; the first one by `lambda_new q(o_1) / ((1 - q(o_1)) lambda_clutter)`. The product of predictive
densities is the marginal likelihood (chain rule). Categories: as the batch does, from the votes of all views (`class_posterior`).
"""

from __future__ import annotations

import numpy as np

from nolbo_ppl.inference.slam.class_posterior import class_posterior, fit_confusion
from nolbo_ppl.inference.slam.detection_features import LARGE_VARIANCE, FeaturePrior, variance_of_shape
from nolbo_ppl.inference.slam.incremental.incremental_graph import IncrementalGraph
from nolbo_ppl.inference.slam.incremental.running_map import RunningLandmark, RunningMap, variance_between_views
from nolbo_ppl.inference.slam.slam_problem import SlamConfig
from nolbo_ppl.structures.landmark import Landmark


def class_posteriors(landmarks: list[RunningLandmark], prior: FeaturePrior) -> list[dict[str, float]]:
    """Posterior over categories of every landmark from the votes of its views; empty where no category is known."""
    if not prior.categories:
        return [{} for _ in landmarks]
    votes = np.array([j.votes for j in landmarks])
    confusion = fit_confusion(votes, prior.log_frequency, prior.category_error)
    posterior = class_posterior(votes, prior.log_frequency, confusion)
    return [{name: float(p) for name, p in zip(prior.categories, row)} for row in posterior]


def map_landmarks(running: RunningMap, graph: IncrementalGraph, config: SlamConfig) -> tuple[Landmark, ...]:
    """All landmarks of the running map with their answers."""
    landmarks = [running.landmarks[j] for j in running.numbers.tolist()]
    if not landmarks:
        return ()
    correlation = config.latent_correlation or 0.0
    variance = variance_of_shape(variance_between_views(landmarks, correlation), correlation)
    classes = class_posteriors(landmarks, running.prior)
    out = []
    for row, landmark in enumerate(landmarks):
        T = graph.landmark(landmark.number)
        covariance, R = graph.landmark_covariance(landmark.number), T[:3, :3]
        covariance[3:, 3:] += R.T @ landmark.shared_covariance() @ R
        known = len(variance[row]) > 0 and bool(variance[row, 0] < LARGE_VARIANCE)
        out.append(
            Landmark(
                name=f"L{landmark.number}",
                index=landmark.number,
                T_world_object=T,
                covariance=covariance,
                position_covariance=R @ covariance[3:, 3:] @ R.T,
                oriented=landmark.oriented,
                existence=float(1.0 / (1.0 + np.exp(-np.clip(landmark.log_odds, -700, 700)))),
                class_posterior=classes[row],
                latent=landmark.latent if known else None,
                latent_variance=variance[row] if known else None,
                size=landmark.size / landmark.sizes if landmark.sizes else None,
                detections=float(landmark.views),
                first_frame=landmark.first,
                last_frame=landmark.last,
            )
        )
    return tuple(out)
