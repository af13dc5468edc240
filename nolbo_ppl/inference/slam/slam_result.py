"""The answers: trajectory and map with uncertainty, and the questions users ask of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import inverse, is_rotation, se3_exp, transform
from nolbo_ppl.inference.slam.class_posterior import ConfusionModel, class_posterior, count_votes, fit_confusion
from nolbo_ppl.inference.slam.data_association import Associations
from nolbo_ppl.inference.slam.detection_features import LARGE_VARIANCE, variance_of_shape
from nolbo_ppl.inference.slam.em import EmStepInfo
from nolbo_ppl.inference.slam.graph import SlamEstimate, to_values
from nolbo_ppl.inference.slam.hypotheses import MapHypothesis, mixture_covariances
from nolbo_ppl.inference.slam.landmark_shapes import LatentDecoder, Voxels, decode_landmarks
from nolbo_ppl.inference.slam.linearisation import Linearisation
from nolbo_ppl.inference.slam.map_evidence import map_log_evidence
from nolbo_ppl.inference.slam.map_refinement import final_graph
from nolbo_ppl.inference.slam.shared_errors import linearise_answer
from nolbo_ppl.inference.slam.slam_state import SlamState
from nolbo_ppl.structures.landmark import Landmark


@dataclass(frozen=True)
class SlamResult:
    """Trajectory, map, associations and how they came about.

    Example:
        >>> import nolbo_ppl
        >>> from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
        >>> rng = np.random.default_rng(0)
        >>> drive = simulate_sequence(simulate_circuit(rng, frames_per_lap=30), rng, world=WorldConfig(objects=15))

        >>> result = nolbo_ppl.solve(nolbo_ppl.SlamProblem(drive.odometry, drive.observations))
        >>> result.pose_covariances(np.array([59])).shape  # of the last pose: rotation, position
        (1, 6, 6)
        >>> all(0 <= landmark.existence <= 1 for landmark in result.landmarks)
        True
    """

    state: SlamState
    """The final state."""
    associations: Associations
    """Marginal association of every detection."""
    infos: tuple[EmStepInfo, ...]
    """One record an iteration."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time by phase."""
    history: tuple[SlamEstimate, ...] = ()
    """Poses and landmarks of every iteration: odometry first, the result last."""
    hypotheses: tuple[MapHypothesis, ...] = ()
    """Distinct maps that explain the detections, with their weights, the best (this one) first."""

    @property
    def T_world_camera(self) -> Float[np.ndarray, "n 4 4"]:
        """Corrected camera poses, one row for each row of the odometry."""
        return self.state.estimate.T_world_camera

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The final factor graph as GTSAM's own: keys `gtsam.symbol("x", row)` for poses, `gtsam.symbol("l", j)` for landmarks.

        Example: add a factor of your own and solve again with
        `gtsam.LevenbergMarquardtOptimizer(graph, result.values).optimize()`.
        """
        return final_graph(self.state)

    @property
    def values(self) -> gtsam.Values:
        """The answer as GTSAM's values, under the keys of `graph`."""
        return to_values(self.state.estimate)

    @cached_property
    def linearisation(self) -> Linearisation:
        """The final graph linearised at the answer, with the errors that the views of an object share."""
        return linearise_answer(self.state)

    def pose_covariances(self, rows: Int[np.ndarray, " r"] | None = None) -> Float[np.ndarray, "r 6 6"]:
        """Covariances of poses, [rotation rad, position m] in the camera's own frame, the first pose held fixed.

        Where several hypotheses have weight they are those of the mixture, about this trajectory.
        """
        rows = np.arange(len(self.T_world_camera)) if rows is None else np.asarray(rows, dtype=np.int64)
        if len(rows) and (rows.min() < 0 or rows.max() >= len(self.T_world_camera)):
            raise input_error(
                "no such pose", got=[int(rows.min()), int(rows.max())], expected=f"0 to {len(self.T_world_camera) - 1}"
            )
        if len(self.hypotheses) > 1:
            return mixture_covariances(self.hypotheses, self.T_world_camera, rows)
        return self.linearisation.covariance(self.linearisation.landmarks + rows)

    def joint_covariance(
        self, poses: Int[np.ndarray, " r"], landmarks: Int[np.ndarray, " s"]
    ) -> Float[np.ndarray, "r+s 6 r+s 6"]:
        """Joint covariance of some poses and landmarks, in this order, [rotation rad, position m] each in its own frame.

        Example: `C = result.joint_covariance([], [0, 5])`; `C[0, :, 1]` is the cross-covariance of landmarks 0 and 5. Given the
        associations, of the best hypothesis alone.

        Raises:
            InputError: no such pose or landmark.
        """
        poses, landmarks = np.asarray(poses, dtype=np.int64), np.asarray(landmarks, dtype=np.int64)
        for name, rows, count in (("pose", poses, len(self.T_world_camera)), ("landmark", landmarks, len(self.state.static))):
            if len(rows) and (rows.min() < 0 or rows.max() >= count):
                raise input_error(f"no such {name}", got=[int(rows.min()), int(rows.max())], expected=f"0 to {count - 1}")
        return self.linearisation.joint_covariance(np.concatenate([self.linearisation.landmarks + poses, landmarks]))

    @cached_property
    def log_evidence(self) -> float:
        """Log marginal likelihood of the drive with this map, nats, to compare settings on one drive (`map_evidence`).

        Poses and landmarks are integrated out (Laplace), odometry and detections have their normalisers, each landmark costs its
        density. Differences are log Bayes factors of settings such as scales and rates, for the same detections.

        Example: is the odometry's rotation rather 0.001 or 0.01 rad a step?

        >>> import nolbo_ppl
        >>> from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
        >>> rng = np.random.default_rng(0)
        >>> truth = simulate_circuit(rng, frames_per_lap=30)
        >>> drive = simulate_sequence(truth, rng, world=WorldConfig(objects=15), odometry_rotation_scale=0.01)
        >>> def settings(scale):
        ...     return nolbo_ppl.SlamConfig(
        ...         odometry_rotation_scale=scale, odometry_translation_ratio=0.01, correct_scales=False, hypotheses=1)
        >>> problem = nolbo_ppl.SlamProblem(drive.odometry, drive.observations)
        >>> tight, true = (nolbo_ppl.solve(problem, settings(scale)).log_evidence for scale in (0.001, 0.01))
        >>> bool(true - tight > 5.0)
        True
        """
        return map_log_evidence(self.state)

    @property
    def scale(self) -> Float[np.ndarray, " n-1"] | None:
        """Metres per unit of the odometry at each of its steps, with `SlamConfig.scale_drift`; else None."""
        state = self.state
        if state.odometry_scale is None or state.estimate.scale is None:
            return None
        return state.odometry_scale * state.estimate.scale

    @cached_property
    def scale_standard_deviation(self) -> Float[np.ndarray, " n-1"] | None:
        """Posterior standard deviations of `scale`."""
        if self.state.odometry_scale is None:
            return None
        return self.state.odometry_scale * self.linearisation.scale_deviations()

    def landmark_covariances(self) -> Float[np.ndarray, "m 6 6"]:
        """Covariances of all landmarks, [rotation rad, position m] in the object's own frame."""
        return self.linearisation.covariance(np.arange(self.linearisation.landmarks))

    def sample(self, count: int, seed: int) -> tuple[Float[np.ndarray, "s n 4 4"], Float[np.ndarray, "s m 4 4"]]:
        """Joint samples of all poses and landmarks, T_world_camera and T_world_object (Laplace, given the associations).

        Example: `poses, landmarks = result.sample(100, seed=0)`, then
        `np.linalg.norm(poses[:, -1, :3, 3] - landmarks[:, 0, :3, 3], axis=1)` is the posterior of a distance, in m.

        Args:
            count: number of samples.
            seed: of the generator.
        """
        poses, landmarks = self.linearisation.samples(count, np.random.default_rng(seed))
        return (
            self.T_world_camera @ se3_exp(np.moveaxis(poses, 2, 0)),
            self.state.estimate.T_world_landmark @ se3_exp(np.moveaxis(landmarks, 2, 0)),
        )

    def expected_detections(self, T_world_camera: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " m"]:
        """Posterior probability that each landmark is detected from a pose: existence times detection probability there.

        Example: `result.expected_detections(result.T_world_camera[-1]).sum()` is the expected number of detections of mapped
        objects in the last frame, occlusion as it is on average.

        Raises:
            InputError: no pose.
        """
        T = np.asarray(T_world_camera, dtype=np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all() or not is_rotation(T[:3, :3]):
            raise input_error("T_world_camera is no pose", got=T, expected="a finite 4 x 4 rigid motion")
        local = transform(inverse(T), self.state.estimate.T_world_landmark[:, :3, 3])
        return self.existence() * self.associations.model.probability(local)

    @cached_property
    def landmarks(self) -> tuple[Landmark, ...]:
        """All landmarks with their answers."""
        state = self.state
        poses = state.estimate.T_world_landmark
        covariance = self.landmark_covariances()
        existence = self.existence()
        classes = self.class_posterior()
        total = np.bincount(self.associations.landmark, weights=self.associations.weight, minlength=len(poses))
        sizes = self._sizes()
        variance = variance_of_shape(state.features.latent_variance, state.config.latent_correlation or 0.0)
        out = []
        for j, T in enumerate(poses):
            R = T[:3, :3]
            known = state.features.latent.shape[1] > 0 and state.features.latent_variance[j, 0] < LARGE_VARIANCE
            out.append(
                Landmark(
                    name=f"L{j}",
                    index=j,
                    T_world_object=T,
                    covariance=covariance[j],
                    position_covariance=R @ covariance[j, 3:, 3:] @ R.T,
                    oriented=bool(state.features.oriented[j]),
                    existence=float(existence[j]),
                    class_posterior={c: float(p) for c, p in zip(state.prior.categories, classes[j])} if len(classes[j]) else {},
                    latent=state.features.latent[j] if known else None,
                    latent_variance=variance[j] if known else None,
                    size=sizes[j],
                    detections=float(total[j]),
                    first_frame=int(state.features.first[j]),
                    last_frame=int(state.features.last[j]),
                )
            )
        return tuple(out)

    def decode_landmarks(self, model: LatentDecoder, samples: int = 8, seed: int = 0) -> dict[str, Voxels]:
        """Mean and variance of the voxels of every landmark that has a latent (see `shapes.decode_landmarks`)."""
        return decode_landmarks(self.landmarks, model, samples=samples, seed=seed)

    def _sizes(self) -> list[np.ndarray | None]:
        table, state = self.state.problem.observations, self.state
        size = table.size[state.rows]
        known = np.isfinite(size).all(axis=1)
        total = np.bincount(state.landmark[known], weights=state.weight[known], minlength=len(state.static))
        summed = np.zeros((len(state.static), 3))
        np.add.at(summed, state.landmark[known], state.weight[known, None] * size[known])
        return [summed[j] / total[j] if total[j] > 0 else None for j in range(len(total))]

    def existence(self) -> Float[np.ndarray, " m"]:
        """Probability that each landmark is an object rather than background seen again and again (docs/em.md)."""
        return self.associations.existence

    @cached_property
    def confusion(self) -> ConfusionModel:
        """How categories are confused, and how alike the mistakes of one object's views are, as measured on the map."""
        return fit_confusion(self._votes, self.state.prior.log_frequency, self.state.config.category_error)

    @cached_property
    def _votes(self) -> Float[np.ndarray, "m c"]:
        """Categories reported of each landmark, by association weight."""
        state, found, categories = self.state, self.associations, self.state.prior.categories
        table = state.problem.observations
        stated = None
        if table.class_names:
            stated = np.zeros((len(table), len(categories)))
            for column, name in enumerate(table.class_names):
                if name in categories:
                    stated[:, categories.index(name)] = np.nan_to_num(table.class_posterior[:, column])
            stated = stated[found.row]
        category = state.measurements.category[found.row]
        return count_votes(category, stated, found.landmark, found.weight, len(state.static), len(categories))

    def class_posterior(self) -> Float[np.ndarray, "m c"]:
        """Posterior over categories of each landmark from all its detections; no columns where none was reported."""
        if not self.state.prior.categories:
            return np.zeros((len(self.state.static), 0))
        return class_posterior(self._votes, self.state.prior.log_frequency, self.confusion)
