"""What a model answered beside what was true, one row an object or a detection: what the figures are computed from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.metrics.detection import Matches


@dataclass(frozen=True)
class ObjectRecords:
    """What a model says at the true boxes, one row an object; NaN (or -1) where the truth has no such label."""

    scene: Int[np.ndarray, " n"]
    """Row of the scene."""
    slot: Int[np.ndarray, " n"]
    """Row of the object among those of its scene."""
    category: Int[np.ndarray, " n"]
    """True category, -1 when unlabelled."""
    symmetry: Int[np.ndarray, " n"]
    """Order of the object's symmetry: 1 none, n n-fold, 0 free."""
    side: Float[np.ndarray, " n"]
    """Longer side of the true box, px."""
    visibility: Float[np.ndarray, " n"]
    """Visible share."""
    likeliest: Int[np.ndarray, " n"]
    """Category of maximum likelihood over the prior means."""
    class_posterior: Float[np.ndarray, "n labels"]
    """q(l | I)."""
    rotation_error: Float[np.ndarray, " n"]
    """Geodesic angle up to symmetry, rad."""
    azimuth_error: Float[np.ndarray, " n"]
    """Signed difference of the allocentric azimuths, rad; objects without symmetry only."""
    azimuth_mass: Float[np.ndarray, " n"]
    """Mass of the azimuth posterior denser than at the truth; not for a free axis."""
    azimuth_log_density: Float[np.ndarray, " n"]
    """Log density of the azimuth posterior at the truth, nats per rad; objects without symmetry only."""
    azimuth_crps: Float[np.ndarray, " n"]
    """Circular ranked probability score, rad; objects without symmetry only."""
    tilt_mass: Float[np.ndarray, " n"]
    """Mass of the region of elevation and in-plane rotation that reaches to the truth."""
    position_mass: Float[np.ndarray, " n"]
    """Mass of the region of the position that reaches to the truth."""
    position_squared: Float[np.ndarray, " n"]
    """Squared distance of the true position under the stated covariance."""
    position_log_density: Float[np.ndarray, " n"]
    """Log density of the position's Gaussian at the truth, nats per m^3."""
    position_tails_mass: Float[np.ndarray, " n"]
    """As `position_mass`, of the posterior with tails (Student's t) that the model's calibration states."""
    position_tails_log_density: Float[np.ndarray, " n"]
    """Its log density at the truth, nats per m^3."""
    range_error: Float[np.ndarray, " n"]
    """Relative error of the distance, absolute value."""
    depth_error: Float[np.ndarray, " n"]
    """Relative error of the depth (along the optical axis), absolute value."""
    sized_depth_error: Float[np.ndarray, " n"]
    """The same, of the depth that follows when the object's true size is told."""
    latent_mass: Float[np.ndarray, " n"]
    """Mass of the region of the shape latent, a mixture over categories, that reaches to the mean the shape autoencoder gives the
    true shape."""
    latent_log_density: Float[np.ndarray, " n"]
    """Log density of that mixture at that mean, nats."""
    latent_gaussian_mass: Float[np.ndarray, " n"]
    """As `latent_mass`, of the likeliest category's Gaussian alone."""
    latent_gaussian_log_density: Float[np.ndarray, " n"]
    """Its log density, nats."""
    voxel_iou: Float[np.ndarray, " n"]
    """IoU of the decoded posterior mean."""
    category_iou: Float[np.ndarray, " n"]
    """IoU of the decoded prior mean of the true category."""
    teacher_iou: Float[np.ndarray, " n"]
    """IoU of decoding what the shape autoencoder gives the true shape: the ceiling."""
    voxel_ap: Float[np.ndarray, " n"]
    """Average precision of occupancy."""

    def __len__(self) -> int:
        return len(self.scene)

    def select(self, rows: Bool[np.ndarray, " n"] | Int[np.ndarray, " k"]) -> ObjectRecords:
        """Some of the objects."""
        return replace(self, **{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def concatenate(parts: Sequence[ObjectRecords]) -> ObjectRecords:
    """Join records. Raises `InputError` when there is none."""
    if not parts:
        raise input_error("no records to join", got=0, expected="at least one")
    names = [field.name for field in fields(ObjectRecords)]
    return ObjectRecords(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


@dataclass(frozen=True)
class DetectionRecords:
    """Matched detections: of any category, and of each category by its own score."""

    all: Matches
    """Every detection scored by its objectness, against truths of any category."""
    by_category: tuple[Matches, ...]
    """Detections of each category (its most probable one) scored by objectness times posterior."""
