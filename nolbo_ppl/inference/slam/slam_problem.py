"""Settings of the object SLAM, and the problem it solves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from nolbo_ppl.categories import CATEGORY_SYMMETRY
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import is_rotation
from nolbo_ppl.inference.association.marginals import Associator
from nolbo_ppl.io.observations import Detections, check_table
from nolbo_ppl.renamed_options import renamed_options
from nolbo_ppl.structures.noise_model import NoiseModel as NoiseModel

_LIMITS: dict[str, tuple[float, float, bool]] = {
    "odometry_rotation_scale": (1e-9, 10.0, False),
    "odometry_translation_scale": (0.0, 1e6, False),
    "odometry_translation_ratio": (0.0, 1e3, False),
    "position_scale": (0.0, 1e6, False),
    "position_ratio": (0.0, 1e3, False),
    "rotation_scale": (1e-9, 10.0, False),
    "latent_scale": (1e-12, 1e12, False),
    "latent_correlation": (0.0, 1.0, False),
    "birth_intensity": (1e-30, 1e12, False),
    "clutter_intensity": (1e-30, 1e12, False),
    "flip_probability": (0.0, 1.0, False),
    "orientation_outlier": (1e-12, 0.999, False),
    "category_error": (1e-9, 0.499, False),
    "scale_walk": (1e-6, 1.0, False),
    "track_gap": (0, 10**9, True),
    "track_minimum": (1, 10**9, True),
    "motion_log_odds": (0.0, 1e12, False),
    "samples": (8, 100_000, True),
    "clique_window": (2, 10_000, True),
    "clique_minimum": (2, 10_000, True),
    "clique_log_odds": (-1e6, 1e6, False),
    "clique_rounds": (0, 10_000, True),
    "em_iterations": (0, 10_000, True),
    "equality_minimum": (0.0, 1.0, False),
    "merge_weight": (0.0, 1.0, False),
    "robust_width": (1e-6, 1e6, False),
    "hypotheses": (1, 1000, True),
    "seed": (0, 2**63 - 1, True),
}
"""Least and largest value of every number, and whether it must be whole."""


def _check_number(name: str, value: object, low: float, high: float, whole: bool) -> None:
    """Refuse what is no number, not finite, or out of range.

    Raises:
        InputError: names the setting.
    """
    kind = "a whole number" if whole else "a finite number"
    good = not isinstance(value, (bool, np.bool_)) and isinstance(value, (int, np.integer) if whole else (int, float, np.number))
    if not good or not low <= value <= high:  # type: ignore[operator]
        raise input_error(f"setting `{name}` is out of range", got=value, expected=f"{kind} from {low:g} to {high:g}")


@renamed_options(
    new_rate="birth_intensity",
    clutter_rate="clutter_intensity",
    constellation_size="clique_window",
    constellation_minimum="clique_minimum",
    constellation_log_odds="clique_log_odds",
    constellation_rounds="clique_rounds",
    link_minimum="equality_minimum",
)
@dataclass(frozen=True)
class SlamConfig:
    """How objects are tracked, associated and mapped. None: estimated from the data.

    Example:
        >>> import nolbo_ppl
        >>> config = nolbo_ppl.SlamConfig(odometry_translation_ratio=0.02, category_symmetry={"mug": 1, "bottle": 0})
        >>> config.position_scale is None  # estimated from the data
        True
    """

    odometry_rotation_scale: float | None = None
    """Standard deviation of each angle of one odometry step, rad."""
    odometry_translation_scale: float | None = None
    """Standard deviation of each coordinate of one odometry step, m."""
    odometry_translation_ratio: float | None = None
    """The part of it that grows with the length of the step, m per m."""
    scale_drift: bool = False
    """The odometry's unit of length is unknown and wanders, as a single camera's does: its scale is estimated at every step."""
    scale_walk: float | None = None
    """Standard deviation of the change of the log of that scale from one step to the next."""
    position_scale: float | None = None
    """Standard deviation of an observed position at range 0, m, for observations that state none."""
    position_ratio: float | None = None
    """Its growth with range, m per m."""
    position_tails: tuple[float, float] | None = None
    """Student's t in place of Gaussians for observed positions: degrees of freedom, and the factor on their stated covariances
    that makes them its scale matrices. None: Gaussian, or what `stated_tails` asks for."""
    stated_tails: bool = False
    """Take the law that detections state for their positions (`Detections.position_tails`; what a model's calibration found).
    It is that of single detections, in its bulk narrower than their covariances, and views of one object err together: on four
    generated drives the error after SLAM was 0.088, 0.084, 0.064 and 0.124 m with it, 0.090, 0.127, 0.063 and 0.100 m without."""
    rotation_scale: float | None = None
    """Standard deviation of each angle of an observed orientation, rad, for observations that state none."""
    latent_scale: float | None = None
    """Standard deviation of a latent coordinate, for observations that state none."""
    latent_correlation: float | None = None
    """Correlation of the latent's errors in two detections of one object. None: 0, and in a run from images what the model's
    calibration says. Without it many views of one side would pass for certainty about the whole shape."""
    birth_intensity: float | None = None
    """Intensity of landmarks not seen before: their expected number per m^3 of the observed space."""
    clutter_intensity: float | None = None
    """Intensity of clutter: expected number of false detections per m^3 of the observed space and frame."""
    field_of_view: tuple[float, float] | None = None
    """Full horizontal and vertical angle of the camera's view, rad (`2 arctan(width / 2 fx)`). None: learnt from where detections
    lie. Objects in view that are not detected speak against their existence."""
    objectness_limits: tuple[float, float] = (0.02, 0.98)
    """Objectness is clipped to this, so that background always remains possible."""
    objectness_prior: float | None = None
    """Share of true detections among those that objectness was calibrated on: objectness is a posterior, its odds over the
    odds of this share are the likelihood ratio of the score. None: the mean objectness of these detections."""
    correct_scales: bool = True
    """Raise stated scales that the data show to be too small (always reported)."""
    flip_probability: float = 0.03
    """Prior probability that an orientation is turned by 180 degrees about the object's vertical axis."""
    orientation_outlier: float = 0.05
    """Prior probability that an orientation says nothing."""
    category_error: float = 0.05
    """Prior probability that a category is wrong."""
    category_symmetry: Mapping[str, int] = field(default_factory=lambda: dict(CATEGORY_SYMMETRY))
    """Symmetry about the object's vertical axis by category, where an observation declares none."""
    track_gap: int = 8
    """A short-term track ends after this many frames without a detection."""
    track_minimum: int = 2
    """Tracks with fewer detections found no landmark."""
    motion_log_odds: float = 8.0
    """A track whose motion is favoured by more than this many nats is moving, and not used."""
    samples: int = 64
    """Posterior samples of the linearised graph that carry all relative covariances; up to four times as many on short drives."""
    annealing: tuple[float, ...] = (4.0, 2.0, 1.0)
    """Factors on the relative covariances in the first rounds; the last one stays."""
    clique_window: int = 14
    """Tracklets, one after the other in time, whose candidate pairs are searched together for a clique that closes a loop."""
    clique_minimum: int = 3
    """Pairs of tracklets that must be consistent with one another (a clique) to close a loop together."""
    clique_log_odds: float = 8.0
    """Log evidence, in nats above new landmarks, that a clique must reach."""
    clique_rounds: int = 8
    """Most rounds of closing loops by cliques."""
    em_iterations: int = 4
    """Iterations of the soft EM between tracklets after that."""
    equality_minimum: float = 0.02
    """Equalities of two tracklets of lower weight are left out of the M-step."""
    merge_weight: float = 0.5
    """Tracklets linked by more than this become one landmark."""
    robust_width: float = 1.0
    """Width of the Cauchy kernel on links between tracklets, in standard deviations."""
    hypotheses: int = 4
    """Most runs, from different starts, from which the map is chosen by evidence; two that agree without a rival end the search.
    Each costs a whole run."""
    seed: int = 0
    """Seed of the posterior samples."""
    associator: Associator = "exact"
    """How association marginals are computed (see `nolbo_ppl.inference.association`)."""

    def __post_init__(self) -> None:
        for name, (low, high, whole) in _LIMITS.items():
            value = getattr(self, name)
            if value is not None:
                _check_number(name, value, low, high, whole)
        if self.latent_correlation is not None and not self.latent_correlation < 1:
            raise input_error("latent_correlation", got=self.latent_correlation, expected="a correlation from 0 to below 1")
        low_high = tuple(self.objectness_limits)
        if len(low_high) != 2 or not all(isinstance(x, (int, float)) for x in low_high) or not 0 < low_high[0] < low_high[1] < 1:
            raise input_error("objectness_limits", got=self.objectness_limits, expected="two numbers, 0 < least < largest < 1")
        if not len(self.annealing):
            raise input_error("annealing", got=self.annealing, expected="one factor or more")
        for factor in self.annealing:
            _check_number("annealing", factor, 1e-3, 1e6, False)
        if self.position_tails is not None:
            if len(self.position_tails) != 2:
                raise input_error("position_tails", got=self.position_tails, expected="degrees of freedom and a factor")
            _check_number("position_tails", self.position_tails[0], 1.0, 1e9, False)
            _check_number("position_tails", self.position_tails[1], 1e-4, 1e4, False)
        if self.objectness_prior is not None and not 0 < self.objectness_prior < 1:
            raise input_error("objectness_prior", got=self.objectness_prior, expected="a share between 0 and 1")
        if self.field_of_view is not None and not all(0 < angle <= 2 * np.pi for angle in self.field_of_view):
            raise input_error("field_of_view", got=self.field_of_view, expected="two angles above 0 and at most 2 pi")


def metric_odometry(config: SlamConfig, what: str) -> SlamConfig:
    """The configuration, for what takes the odometry's lengths as metres.

    Raises:
        InputError: it asks for a scale that drifts.
    """
    if config.scale_drift:
        raise input_error(
            f"scale_drift in {what}",
            got=True,
            expected="odometry in metres",
            do="use the batch solver, `solve` (without --online)",
        )
    return config


STEP_SCALE_LIMITS = (1e-12, 1e6)
"""Least and largest standard deviation of an odometry step, rad and m: beyond, squares leave what 64 bits resolve."""


def check_step_covariance(covariance: np.ndarray, steps: int) -> None:
    """Refuse covariances of odometry steps that no graph can use.

    Raises:
        InputError: a wrong shape, or a row that is not finite, not symmetric, not positive definite, or out of range.
    """
    if covariance.shape != (steps, 6, 6):
        raise input_error(
            "odometry covariance has the wrong shape",
            got=covariance.shape,
            expected=(steps, 6, 6),
            do="give one 6 x 6 matrix a step, [rotation rad, translation m]",
        )
    finite = np.isfinite(covariance).all(axis=(1, 2))
    usable = np.where(finite[:, None, None], covariance, np.eye(6))
    largest = np.abs(usable).max(axis=(1, 2), initial=0)
    symmetric = np.abs(usable - np.swapaxes(usable, 1, 2)).max(axis=(1, 2), initial=0) <= 1e-6 * largest
    # Rotations and translations have units of their own: their correlation is what must be positive definite.
    scale = np.sqrt(np.maximum(np.diagonal(usable, axis1=1, axis2=2), 1e-300))
    correlation = usable / scale[:, :, None] / scale[:, None, :]
    positive = np.linalg.eigvalsh(np.where(symmetric[:, None, None], correlation, np.eye(6)))[:, 0] > 1e-9
    for good, what in ((finite, "finite"), (symmetric, "symmetric"), (positive, "positive definite")):
        if not good.all():
            row = int(np.argmin(good))
            raise input_error(f"odometry covariance of step {row} (rows {row} to {row + 1}) is not {what}", got=covariance[row])
    low, high = STEP_SCALE_LIMITS
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    outside = ((variance < low**2) | (variance > high**2)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise input_error(
            f"odometry covariance of step {row} (rows {row} to {row + 1}) is out of range",
            got=variance[row],
            expected=f"standard deviations from {low:g} to {high:g} rad and m",
        )


@dataclass(frozen=True)
class SlamProblem:
    """Odometry and observations of one drive.

    Example:
        >>> import nolbo_ppl
        >>> from nolbo_ppl.geometry.pose import make_pose
        >>> odometry = make_pose(np.tile(np.eye(3), (3, 1, 1)), np.array([[0, 0, 0.0], [0, 0, 1], [0, 0, 2]]))
        >>> seen = nolbo_ppl.Detections.from_arrays([0, 1, 2], [[1, 0, 6.0], [1, 0, 5], [1, 0, 4]], position_scale=0.1)
        >>> len(nolbo_ppl.SlamProblem(odometry, seen))
        3
    """

    odometry: Float[np.ndarray, "n 4 4"]
    """Drifting T_world_camera, one row a frame."""
    observations: Detections
    """Detections in these frames, rows in any order."""
    odometry_covariance: Float[np.ndarray, "n-1 6 6"] | None = None
    """Covariance of every odometry step, [rotation rad, translation m] in the tangent space of T_earlier_later at the later
    camera (GTSAM's Pose3); None: scales of the configuration, or of the data."""

    def __post_init__(self) -> None:
        T = self.odometry
        if T.ndim != 3 or T.shape[1:] != (4, 4) or len(T) == 0:
            raise input_error("odometry is no trajectory", got=f"shape {T.shape}", expected="[n, 4, 4], n at least 1")
        bad = ~np.isfinite(T).all(axis=(1, 2)) | ~is_rotation(np.nan_to_num(T[:, :3, :3]))
        if bad.any():
            raise input_error(
                "odometry holds a row that is no pose",
                got=T[int(np.argmax(bad))],
                expected="finite, orthonormal",
                do=f"look at row {int(np.argmax(bad))}",
            )
        if self.odometry_covariance is not None:
            check_step_covariance(self.odometry_covariance, len(T) - 1)
        check_table(self.observations, len(T))

    def __len__(self) -> int:
        return len(self.odometry)
