"""Exact data association: marginals, best association and joint samples of detections against landmarks."""

from __future__ import annotations

from nolbo_ppl.inference.association.assignment import Association, map_association
from nolbo_ppl.inference.association.k_best import k_best_associations
from nolbo_ppl.inference.association.marginals import (
    AssociationMarginals,
    Associator,
    association_marginals,
    association_marginals_batch,
)
from nolbo_ppl.inference.association.sampling import sample_associations

__all__ = [
    "Association",
    "AssociationMarginals",
    "Associator",
    "association_marginals",
    "association_marginals_batch",
    "k_best_associations",
    "map_association",
    "sample_associations",
]
