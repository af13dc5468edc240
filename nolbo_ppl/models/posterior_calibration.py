"""One calibration factor a head, fitted on held-out scenes: what turns the guide's scales into honest ones."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.fields import is_number
from nolbo_ppl.metrics.heavy_tails import GAUSSIAN_DOF, StudentT
from nolbo_ppl.models.observed_scene import RegionParameters

CERTAIN = 1 - 1e-6
"""Nothing is ever more certain than this."""


@dataclass(frozen=True)
class Calibration:
    """Factors on the guide's posterior; the default changes nothing."""

    objectness_slope: float = 1.0
    """Factor of the objectness log odds."""
    objectness_shift: float = 0.0
    """Added to the objectness log odds after the factor, nats."""
    label_slope: float = 1.0
    """Factor of the category's log probabilities (an inverse temperature)."""
    azimuth_concentration: float = 1.0
    """Factor of the von Mises concentrations of the azimuth."""
    angle_scale: float = 1.0
    """Factor of the scales of elevation and in-plane rotation."""
    shape_scale: float = 1.0
    """Factor of the scale of the shape latent."""
    box_scale: float = 1.0
    """Factor of the scale of the box latent."""
    range_scale: float = 1.0
    """Factor of the scale of the range latent."""
    shape_correlation: float = 0.0
    """Correlation of the shape latent's errors in two views of one object: what many views together can tell."""

    position_dof: float = GAUSSIAN_DOF
    """Degrees of freedom of Student's t about which true positions lie; 1e4: Gaussian."""
    position_spread: float = 1.0
    """Factor on the position's covariance that makes it the scale matrix of that law."""
    objectness_limit: float = CERTAIN
    """Probability of an object that is never exceeded: what held-out detections support."""

    def __post_init__(self) -> None:
        if not (is_number(self.shape_correlation) and 0 <= self.shape_correlation < 1):
            raise input_error("shape_correlation", got=self.shape_correlation, expected="a correlation from 0 to below 1")
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name == "shape_correlation":
                continue
            if field.name == "objectness_limit":
                if not (is_number(value) and 0.5 <= value < 1):
                    raise input_error("objectness_limit", got=value, expected="a probability from 0.5 to below 1")
                continue
            if not (is_number(value) and abs(value) < 1e6) or (field.name != "objectness_shift" and value <= 0):
                raise input_error(f"calibration factor {field.name}", got=value, expected="a positive finite number")

    def objectness(self, logit: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Calibrated log odds of q(o | I)."""
        return self.objectness_slope * logit + self.objectness_shift

    def limited(self, probability: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Probabilities brought below `objectness_limit` in proportion, so that their order stays."""
        return probability.clamp(max=CERTAIN) * (self.objectness_limit / CERTAIN)

    @property
    def position_tails(self) -> StudentT | None:
        """Law of true positions about their covariances; None where nobody fitted one."""
        if self.position_dof >= GAUSSIAN_DOF and self.position_spread == 1.0:
            return None
        return StudentT(self.position_dof, self.position_spread)

    @property
    def stated_tails(self) -> tuple[float, float] | None:
        """The same as two numbers, as answers state it: degrees of freedom and factor on the covariance."""
        return None if self.position_tails is None else (self.position_dof, self.position_spread)

    def apply(self, q: RegionParameters) -> RegionParameters:
        """Calibrated posterior parameters."""
        return dataclasses.replace(
            q,
            label_logits=q.label_logits * self.label_slope,
            azimuth_natural=q.azimuth_natural * self.azimuth_concentration,
            angle_scale=q.angle_scale * self.angle_scale,
            shape_scale=q.shape_scale * self.shape_scale,
            box_scale=q.box_scale * self.box_scale,
            range_scale=q.range_scale * self.range_scale,
        )

    def to_json(self) -> dict[str, float]:
        """As a dictionary that JSON can hold."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Calibration:
        """From `to_json`'s dictionary. Raises `InputError` naming a factor that is unknown or no number."""
        if not isinstance(values, dict):
            raise input_error("calibration", got=type(values).__name__, expected="an object of factors")
        unknown = sorted(set(values) - {field.name for field in dataclasses.fields(cls)})
        if unknown:
            raise input_error("unknown calibration factors", got=unknown)
        return cls(**values)
