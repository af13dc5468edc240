"""Distributions of the generative story and the guide: Pyro `TorchDistribution`s with registered KLs."""

from __future__ import annotations

from nolbo_ppl.models.distributions.bernoulli import (
    Objectness,
    bernoulli_entropy,
    log_kappa_objectness,
    objectness_cross_entropy,
    objectness_kl_exclusive,
    objectness_kl_inclusive,
    objectness_prior,
)
from nolbo_ppl.models.distributions.circular import circular
from nolbo_ppl.models.distributions.gaussian_mixture import (
    component_log_prob,
    enumerated_kl,
    gaussian_mixture_log_prob,
    kl_to_each_component,
    label_posterior,
)
from nolbo_ppl.models.distributions.matrix_fisher import (
    LOG_HAAR_VOLUME,
    MatrixFisher,
    concentration_to_scale,
    log_normalizer,
    mean_resultant,
    rotation_constraint,
    scale_to_concentration,
)
from nolbo_ppl.models.distributions.reparam import NoisyNormal
from nolbo_ppl.models.distributions.sincos_normal import SinCosNormal, sincos_to_angle
from nolbo_ppl.models.distributions.symmetric_matrix_fisher import SymmetricMatrixFisher
from nolbo_ppl.models.distributions.viewpoint import ViewpointMixture, ViewpointNormal
from nolbo_ppl.models.distributions.viewpoint_kl import kl_sincos_to_sincos
from nolbo_ppl.models.distributions.viewpoint_sincos import ViewpointSinCos
from nolbo_ppl.models.distributions.von_mises import MAX_CONCENTRATION, VonMisesMixture
from nolbo_ppl.models.distributions.von_mises_kl import kl_mixture_to_mixture, kl_mixture_to_wrapped, kl_wrapped_to_mixture
from nolbo_ppl.models.distributions.wrapped_normal import (
    TrigonometricMoments,
    WrappedNormal,
    kl_of_angles,
    wrapped_normal_moments,
)
from nolbo_ppl.models.distributions.wrapped_normal_kl import wrapped_normal_kl

__all__ = [
    "LOG_HAAR_VOLUME",
    "MAX_CONCENTRATION",
    "MatrixFisher",
    "NoisyNormal",
    "Objectness",
    "SinCosNormal",
    "SymmetricMatrixFisher",
    "TrigonometricMoments",
    "ViewpointMixture",
    "ViewpointNormal",
    "ViewpointSinCos",
    "VonMisesMixture",
    "WrappedNormal",
    "bernoulli_entropy",
    "circular",
    "component_log_prob",
    "concentration_to_scale",
    "enumerated_kl",
    "gaussian_mixture_log_prob",
    "kl_mixture_to_mixture",
    "kl_mixture_to_wrapped",
    "kl_of_angles",
    "kl_sincos_to_sincos",
    "kl_to_each_component",
    "kl_wrapped_to_mixture",
    "label_posterior",
    "log_kappa_objectness",
    "log_normalizer",
    "mean_resultant",
    "objectness_cross_entropy",
    "objectness_kl_exclusive",
    "objectness_kl_inclusive",
    "objectness_prior",
    "rotation_constraint",
    "scale_to_concentration",
    "sincos_to_angle",
    "wrapped_normal_kl",
    "wrapped_normal_moments",
]
