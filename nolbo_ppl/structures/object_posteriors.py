"""What the guide observed in one image: the posterior of every detected object, as plain arrays with answers on top."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl._moved import renamed
from nolbo_ppl.geometry.pose import quaternion_to_matrix
from nolbo_ppl.geometry.voxels import voxels_to_mesh
from nolbo_ppl.structures.detection_records import rounded_quaternion, significant, to_records
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.structures.latent_modes import LatentModes

MIN_CONCENTRATION = 0.1
"""Concentrations below this leave the azimuth open; the scale of a mode grows no further."""
MIN_MODE_WEIGHT = 1e-3
"""Orientation modes of less weight are left out of detections."""


@dataclass(frozen=True)
class ViewpointModes:
    """Azimuth posterior of n objects: von Mises mixtures of K modes."""

    weights: Float[np.ndarray, "n modes"]
    """Weight of each mode."""
    azimuth: Float[np.ndarray, "n modes"]
    """Mean direction of each mode, rad."""
    concentration: Float[np.ndarray, "n modes"]
    """Concentration of each mode; the scale in rad is about 1 / sqrt(concentration)."""


@dataclass(frozen=True)
class RotationModes:
    """Orientation posterior of n objects as K egocentric rotations: the azimuth's modes turned into the camera's frame."""

    weights: Float[np.ndarray, "n modes"]
    """Weight of each mode."""
    R_camera_object: Float[np.ndarray, "n modes 3 3"]
    """Rotation at the mode's azimuth and the mean elevation and in-plane rotation."""
    scale: Float[np.ndarray, "n modes"]
    """Scale of the rotation about the mode, rad: root mean square over the three angles' scales."""


@dataclass(frozen=True)
class ObjectPosteriors:
    """Posteriors of the n objects of one image, best objectness first; metres, radians, the camera's frame.

    Example:
        >>> import nolbo_ppl
        >>> image = np.random.default_rng(0).integers(0, 256, (96, 96, 3), dtype=np.uint8)
        >>> boxes, intrinsics = np.array([[20.0, 20.0, 70.0, 60.0]]), [100.0, 100.0, 48.0, 48.0]
        >>> (seen,) = nolbo_ppl.load("tiny").observe_boxes([image], intrinsics, [boxes], decode=False)
        >>> seen.class_posterior.sum().round(6), seen.position.shape, seen.position_covariance.shape
        (np.float64(1.0), (1, 3), (1, 3, 3))
        >>> seen.detections(frame=7, image="photograph.png").id  # as SLAM takes them
        ('000007-000',)
    """

    categories: tuple[str, ...]
    """Names of the category labels."""
    objectness: Float[np.ndarray, " n"]
    """q(o = 1 | I)."""
    box: Float[np.ndarray, "n 4"]
    """Mean image box [x0, y0, x1, y1], px of the image that was given."""
    box_scale: Float[np.ndarray, "n 4"]
    """Scales of (centre x, centre y, log width, log height): px, px, and nats."""
    class_log_posterior: Float[np.ndarray, "n labels"]
    """log q(l | I), normalised."""
    class_log_likelihood: Float[np.ndarray, "n labels"]
    """log N(mu_q; mu_psi(l), I) of each category, whose argmax is the maximum-likelihood category (NOLBO eq. MLEproblemfinal)."""
    instance_log_posterior: Float[np.ndarray, "n instances"] | None
    """Normalised log posterior of known instances ("novel" last); None for models without instance labels."""
    latent: Float[np.ndarray, "n d"]
    """Mean of the shape latent, where the likeliest category puts it."""
    latent_scale: Float[np.ndarray, "n d"]
    """Scale of the shape latent."""
    position: Float[np.ndarray, "n 3"]
    """Centre of the object's box in the camera frame, m."""
    position_covariance: Float[np.ndarray, "n 3 3"]
    """Its covariance, m^2."""
    viewpoint_modes: ViewpointModes
    """Azimuth posterior, allocentric."""
    elevation_inplane: Float[np.ndarray, "n 2"]
    """Mean elevation and in-plane rotation, allocentric, rad."""
    elevation_inplane_scale: Float[np.ndarray, "n 2"]
    """Their scales, rad."""
    viewpoint: Float[np.ndarray, "n 3"]
    """(azimuth, elevation, in-plane) at the highest posterior density, allocentric, rad."""
    R_camera_object: Float[np.ndarray, "n 3 3"]
    """Egocentric rotation at that viewpoint."""
    rotation_scale: Float[np.ndarray, " n"]
    """Scale of the rotation about its mode, rad: root mean square over the three angles' scales of the best mode."""
    diagonal: Float[np.ndarray, " n"]
    """Diagonal of the object's box, m."""
    diagonal_log_scale: Float[np.ndarray, " n"]
    """Scale of the log diagonal."""
    size: Float[np.ndarray, "n 3"]
    """Extents of the object along its own x, y, z axes, m: the diagonal times the decoded shape's extents."""
    voxel_mean: Float[np.ndarray, "n v v v"] | None
    """Posterior mean occupancy of the canonical grid; None when shapes were not decoded."""
    voxel_variance: Float[np.ndarray, "n v v v"] | None
    """Posterior variance of each voxel's occupancy probability over the shape latent."""
    describes: bool = True
    """The model states categories and viewpoints; without them all are equally likely here, and missing in detections
    (`nolbo_ppl.models.baselines.method`)."""
    sized: bool = False
    """Distances and sizes already hold what a box's height and a category's size tell; who knows better sizes replaces them,
    for the same height counted twice would be too sure."""
    position_tails: tuple[float, float] | None = None
    """Law of the true positions about these: degrees of freedom of Student's t, and the factor on the covariance that makes it
    the scale matrix (the model's calibration). None: Gaussian."""
    shift: float | None = None
    """How unlike the images that were learnt from this image is: 0 like the middle one, 1 as 3 in 100; beyond, objects are less
    probable and every scale is wider. None for models that cannot tell."""
    latent_modes: LatentModes | None = None
    """The latent as a mixture over likely categories, all with `latent_scale`; the first is `latent`. None: that one alone."""

    def __len__(self) -> int:
        return len(self.objectness)

    def __getitem__(self, index: Int[np.ndarray, " k"] | Bool[np.ndarray, " n"] | slice | list[int]) -> ObjectPosteriors:
        """Some of the objects."""
        fields: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value = value[index]
            elif isinstance(value, (ViewpointModes, LatentModes)):
                value = type(value)(*(getattr(value, f.name)[index] for f in dataclasses.fields(value)))
            fields[field.name] = value
        return ObjectPosteriors(**fields)

    @property
    def category(self) -> list[str]:
        """Maximum-likelihood category of each object, `argmax_l N(mu_q; mu_psi(l), I)`; "object" where none is stated."""
        if not self.describes:
            return ["object"] * len(self)
        return [self.categories[i] for i in self.class_log_likelihood.argmax(-1)]

    @property
    def class_posterior(self) -> Float[np.ndarray, "n labels"]:
        """q(l | I)."""
        probability: np.ndarray = np.exp(self.class_log_posterior)
        return probability

    def latent_log_density(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Log density of each object's latent posterior at a latent, nats: the mixture over categories."""
        modes = self.latent_modes or LatentModes.of_one(self.latent)
        return modes.log_density(z, self.latent_scale)

    def mesh(self, index: int, metric: bool = True) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
        """Mesh of an object's mean shape by marching cubes, in its own frame; in metres, or in units of the diagonal.

        Raises:
            ValueError: shapes were not decoded.
        """
        if self.voxel_mean is None:
            raise ValueError("shapes were not decoded: observe with decode=True")
        vertices, faces = voxels_to_mesh(self.voxel_mean[index])
        return vertices * (self.diagonal[index] if metric else 1.0), faces

    def rotation_modes(self) -> RotationModes:
        """Every azimuth mode as an egocentric rotation: the guide's angles are seen along the ray through the object, so each
        mode is turned by the smallest rotation from the optical axis to that ray (docs/story.md, conventions).
        """
        import torch

        from nolbo_ppl.geometry.rotation import allocentric_to_egocentric, viewpoint_to_matrix  # torch is only needed here

        azimuth = np.asarray(self.viewpoint_modes.azimuth, dtype=np.float64)
        tilt = np.broadcast_to(np.asarray(self.elevation_inplane, dtype=np.float64)[:, None], (*azimuth.shape, 2))
        viewpoint = torch.from_numpy(np.concatenate([azimuth[..., None], tilt], axis=-1))
        ray = torch.from_numpy(np.asarray(self.position, dtype=np.float64))[:, None].expand(*azimuth.shape, 3)
        R = allocentric_to_egocentric(viewpoint_to_matrix(viewpoint), ray).numpy()
        variance = 1.0 / np.maximum(np.asarray(self.viewpoint_modes.concentration, dtype=np.float64), MIN_CONCENTRATION)
        tilt_variance = (np.asarray(self.elevation_inplane_scale, dtype=np.float64) ** 2).sum(axis=-1, keepdims=True)
        weights = np.asarray(self.viewpoint_modes.weights, dtype=np.float64)
        return RotationModes(weights, R, np.sqrt((variance + tilt_variance) / 3))

    def detections(self, frame: int, image: str | None = None, time: float | None = None) -> Detections:
        """The objects as SLAM takes them; with those of other frames (`Detections.concatenate`) they make a `SlamProblem`.

        Numbers are rounded to seven significant digits (covariances to ten): a file holds exactly what is here.

        Args:
            frame: row of the odometry, from 0.
            image: name of the image.
            time: its time, s.
        """
        if not self.describes:
            return self._undescribed(frame, image, time)
        n, labels = len(self), self.class_log_likelihood.argmax(-1)
        modes = self.rotation_modes()
        kept = modes.weights >= MIN_MODE_WEIGHT
        weight = np.where(kept, modes.weights, 0.0)
        weight = significant(weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300))
        order = np.argsort(~kept, axis=1, kind="stable")  # modes that are left out go last

        def first(values: np.ndarray) -> np.ndarray:
            return np.take_along_axis(values, order.reshape(*order.shape, *(1,) * (values.ndim - 2)), axis=1)

        def as_in_files(R: np.ndarray) -> np.ndarray:
            return quaternion_to_matrix(rounded_quaternion(R))

        return Detections(
            frame=np.full(n, frame, dtype=np.int64),
            position=significant(self.position),
            position_covariance=significant(self.position_covariance, 10),
            rotation=as_in_files(np.asarray(self.R_camera_object, dtype=np.float64)),
            rotation_scale=significant(self.rotation_scale),
            latent=significant(self.latent),
            latent_scale=significant(self.latent_scale),
            objectness=significant(self.objectness),
            category=tuple(self.categories[k] for k in labels),
            size=significant(self.size),
            symmetry=np.full(n, -1, dtype=np.int64),
            id=tuple(f"{frame:06d}-{i:03d}" for i in range(n)),
            mode_weight=first(weight),
            mode_rotation=first(np.where(kept[..., None, None], as_in_files(modes.R_camera_object), np.eye(3))),
            mode_std=first(np.where(kept, significant(modes.scale), 1.0)),
            image=(image,) * n,
            time=np.full(n, np.nan if time is None else time),
            box=significant(self.box),
            class_names=self.categories,
            class_posterior=significant(self.class_posterior),
            viewpoint=significant(self.viewpoint),
            azimuth_weight=significant(self.viewpoint_modes.weights),
            azimuth=significant(self.viewpoint_modes.azimuth),
            azimuth_concentration=significant(self.viewpoint_modes.concentration),
            position_tails=self._tails,
            **self._several_latent_modes(),
        )

    def _several_latent_modes(self) -> dict[str, Float[np.ndarray, "n K *d"]]:
        """The latent's modes as detections hold them: nothing of an object that has one, which `latent` says."""
        modes = self.latent_modes
        if modes is None or not (modes.weight[:, 1:] > 0).any():
            return {}
        several = (modes.weight > 0).sum(axis=1) > 1
        weight = np.where(several[:, None], significant(modes.weight), 0.0)
        kept = weight > 0
        count = int(kept.sum(axis=1).max())  # heaviest first
        mean = np.where(kept[..., None], significant(modes.mean), 0.0)
        return {"latent_mode_weight": weight[:, :count], "latent_mode": mean[:, :count]}

    def _undescribed(self, frame: int, image: str | None, time: float | None) -> Detections:
        """Detections without category and orientation: box, position, size and latent."""
        n = len(self)
        table = Detections.from_arrays(
            np.full(n, frame),
            significant(self.position),
            position_covariance=significant(self.position_covariance, 10),
            latent=significant(self.latent),
            latent_scale=significant(self.latent_scale),
            objectness=significant(self.objectness),
            size=significant(self.size),
            id=[f"{frame:06d}-{i:03d}" for i in range(n)],
            image=[image] * n,
            time=np.full(n, np.nan if time is None else time),
            box=significant(self.box),
        )
        return dataclasses.replace(table, position_tails=self._tails)

    @property
    def _tails(self) -> Float[np.ndarray, "n 2"]:
        """A row of `Detections.position_tails` for each object."""
        return np.tile(significant(np.array(self.position_tails or (np.nan, np.nan))), (len(self), 1))

    def to_records(self, frame: int, image: str) -> Iterator[dict[str, Any]]:
        """One JSON-able dictionary an object, the lines of `observations.jsonl`."""
        return to_records(self.detections(frame, image))

    def rows(self, frame: int, image: str) -> Iterator[dict[str, Any]]:
        """`to_records` under its name of 0.1.0."""
        warnings.warn("ObjectPosteriors.rows is now to_records; the old name goes with 0.3.0", FutureWarning, stacklevel=2)
        return self.to_records(frame, image)


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
