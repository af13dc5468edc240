"""The online system's factor graph on iSAM2: factors are added, moved to another landmark, and taken away in small steps.

Every factor is kept here as numbers besides its slot in iSAM2. That is what lets two landmarks become one (the factors of the
one are handed to the other), a stretch of keyframes become one (`condense`), and the whole be written to a file.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import adjoint, inverse
from nolbo_ppl.inference.slam.graph import (
    FIRM_ROTATION_SIGMA,
    GAUGE_SCALE,
    PRIOR_POSITION_RATIO,
    PRIOR_ROTATION,
    UNINFORMATIVE_ROTATION_SIGMA,
    ObservationFactors,
    SlamEstimate,
    landmark_key,
    named_error,
    pose_key,
    resolve_observations,
)
from nolbo_ppl.inference.slam.incremental.condensation import condensed_observations
from nolbo_ppl.inference.slam.incremental.hanging_poses import HangingPoses
from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig

RELINEARISE_ROTATION, RELINEARISE_POSITION = 0.05, 10.0
"""Changes in rad and m beyond which a variable is linearised anew."""
MIN_WEIGHT = 1e-3
"""Observations of lower weight are left out."""
GAUGE, PRIOR, STEP, OBSERVATION = range(4)
"""Kinds of factors: of a first pose, of a landmark, between poses, of a landmark from a pose."""


@dataclass
class Factor:
    """One factor of the running graph."""

    kind: int
    """GAUGE, PRIOR, STEP or OBSERVATION."""
    a: int
    """Pose, or the landmark of a PRIOR."""
    b: int
    """Later pose of a STEP, landmark of an OBSERVATION, else -1."""
    T: Float[np.ndarray, "4 4"]
    """Measured pose (GAUGE, PRIOR) or relative pose."""
    covariance: Float[np.ndarray, "6 6"]
    """Its covariance, [rotation rad, position m]."""
    slot: int = -1
    """Where iSAM2 holds it; -1 while it waits."""
    built: gtsam.NonlinearFactor | None = None
    """As GTSAM has it, once it was asked for (`build_all`)."""

    def variables(self) -> tuple[int, ...]:
        """Keys of its variables."""
        if self.kind == PRIOR:
            return (landmark_key(self.a),)
        if self.kind == GAUGE:
            return (pose_key(self.a),)
        return pose_key(self.a), pose_key(self.b) if self.kind == STEP else landmark_key(self.b)

    def build(self) -> gtsam.NonlinearFactor:
        """As GTSAM has it."""
        return build_all([self])[0]


def build_all(factors: list[Factor]) -> list[gtsam.NonlinearFactor]:
    """Factors as GTSAM has them, each made once: condensing asks again for those that were committed (half its time)."""
    new = [f for f in factors if f.built is None]
    if new:
        roots = np.linalg.inv(np.linalg.cholesky(np.array([f.covariance for f in new])))
        for factor, root in zip(new, roots):
            model = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
            keys, T = factor.variables(), gtsam.Pose3(factor.T)
            if len(keys) == 1:
                factor.built = gtsam.PriorFactorPose3(keys[0], T, model)
            else:
                factor.built = gtsam.BetweenFactorPose3(keys[0], keys[1], T, model)
    return [f.built for f in factors if f.built is not None]  # all of them


def compose(first: Factor, second: Factor) -> Factor:
    """Two steps that follow each other as one: `T = T_1 T_2`, `C = Ad(T_2^-1) C_1 Ad(T_2^-1)' + C_2`."""
    carry = adjoint(inverse(second.T))
    return Factor(STEP, first.a, second.b, first.T @ second.T, carry @ first.covariance @ carry.T + second.covariance)


class IncrementalGraph:
    """Factors and first values wait until `commit`; `pose` and `landmark` answer with what is known now."""

    def __init__(self) -> None:
        self.careful = False
        self.isam = new_isam()
        self.factors: dict[int, Factor] = {}
        self.of_pose: dict[int, set[int]] = {}
        self.of_landmark: dict[int, set[int]] = {}
        self.first_values: dict[int, Float[np.ndarray, "4 4"]] = {}
        self.added: list[int] = []
        self.removed: list[int] = []
        self.serial = 0
        self.poses = 0
        self.landmarks = 0
        self.hanging = HangingPoses()

    # -- factors ------------------------------------------------------------------------------------------------------

    def add(self, factor: Factor) -> int:
        """Let a factor wait; returns its number."""
        number = self.serial
        self.serial += 1
        self.keep(number, factor)
        self.added.append(number)
        return number

    def keep(self, number: int, factor: Factor) -> None:
        """Hold a factor under its number, without handing it to iSAM2."""
        self.factors[number] = factor
        for holder, member in self._members(factor):
            holder.setdefault(member, set()).add(number)

    def remove(self, number: int) -> None:
        """Take a factor out with the next `commit`."""
        factor = self.factors.pop(number)
        for holder, member in self._members(factor):
            holder[member].discard(number)
            if not holder[member]:
                del holder[member]
        if factor.slot >= 0:
            self.removed.append(factor.slot)
        else:
            self.added.remove(number)

    def _members(self, factor: Factor) -> list[tuple[dict[int, set[int]], int]]:
        if factor.kind == PRIOR:
            return [(self.of_landmark, factor.a)]
        if factor.kind == GAUGE:
            return [(self.of_pose, factor.a)]
        return [(self.of_pose, factor.a), (self.of_pose if factor.kind == STEP else self.of_landmark, factor.b)]

    def add_first_pose(
        self, T_world_camera: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"] | None = None
    ) -> None:
        """The pose a drive hangs on: held fixed, or known with this covariance."""
        self.first_values[pose_key(self.poses)] = T_world_camera
        self.add(Factor(GAUGE, self.poses, -1, T_world_camera, GAUGE_SCALE**2 * np.eye(6) if covariance is None else covariance))
        self.poses += 1

    def add_pose(
        self, step: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"], T_world_camera: Float[np.ndarray, "4 4"]
    ) -> None:
        """The next pose, at its first value, and the odometry step that leads to it."""
        self.first_values[pose_key(self.poses)] = T_world_camera
        self.add(Factor(STEP, self.poses - 1, self.poses, step, covariance))
        self.poses += 1

    def add_landmark(self, T_world_landmark: Float[np.ndarray, "4 4"], distance: float, oriented: bool = True) -> int:
        """A new landmark with its weak prior, firm on a rotation that nobody will observe; returns its number."""
        self.first_values[landmark_key(self.landmarks)] = T_world_landmark
        rotation = PRIOR_ROTATION * UNINFORMATIVE_ROTATION_SIGMA if oriented else FIRM_ROTATION_SIGMA
        sigmas = np.array([rotation] * 3 + [PRIOR_POSITION_RATIO * max(distance, 1e-3)] * 3)
        self.add(Factor(PRIOR, self.landmarks, -1, T_world_landmark, np.diag(sigmas**2)))
        self.landmarks += 1
        return self.landmarks - 1

    def observe(
        self,
        measurements: Measurements,
        noise: NoiseModel,
        config: SlamConfig,
        rows: list[int],
        frame: int,
        T_world_camera: Float[np.ndarray, "4 4"],
        landmarks: list[int],
    ) -> Float[np.ndarray, "k 4 4"]:
        """Factors of detections of one keyframe (`measurements` hold that alone); returns where the landmarks stand."""
        if not rows:
            return np.zeros((0, 4, 4))
        estimate = SlamEstimate(T_world_camera[None], np.array([self.landmark(j) for j in landmarks]))
        count = len(rows)
        found = resolve_observations(measurements, noise, config, estimate, np.array(rows), np.arange(count), np.ones(count))
        self._add_observations(found, frame, landmarks)
        return estimate.T_world_landmark

    def _add_observations(self, found: ObservationFactors, frame: int, landmarks: list[int]) -> None:
        for k in np.flatnonzero(found.weight > MIN_WEIGHT):
            j, covariance = landmarks[int(found.landmark[k])], found.covariance[k] / found.weight[k]
            self.add(Factor(OBSERVATION, frame, j, found.T_camera_landmark[k], covariance))

    # -- fewer variables ----------------------------------------------------------------------------------------------

    def merge(self, a: int, b: int, T_a_b: Float[np.ndarray, "4 4"], *, agree: bool = True) -> None:
        """Hand all observations of landmark a to landmark b, and drop a.

        Args:
            T_a_b: the turn between their axes (half turn or symmetry), `L_b = L_a T_a_b`.
            agree: whether their orientations do; if not, a's say nothing from now on.
        """
        turn = np.kron(np.eye(2), T_a_b[:3, :3])
        for number in sorted(self.of_landmark[a]):
            factor = self.factors[number]
            self.remove(number)
            if factor.kind != OBSERVATION:
                continue
            covariance = turn.T @ factor.covariance @ turn
            if not agree:
                covariance = covariance.copy()
                covariance[:3], covariance[:, :3] = 0.0, 0.0
                covariance[:3, :3] = UNINFORMATIVE_ROTATION_SIGMA**2 * np.eye(3)
            self.add(Factor(OBSERVATION, factor.a, b, factor.T @ T_a_b, covariance))
        self.first_values.pop(landmark_key(a), None)

    def steps_of(self, pose: int) -> tuple[int | None, int | None]:
        """Numbers of the steps that lead to a pose and away from it."""
        before = after = None
        for number in self.of_pose[pose]:
            factor = self.factors[number]
            if factor.kind == STEP:
                before, after = (number, after) if factor.b == pose else (before, number)
        return before, after

    def condense(self, poses: list[int]) -> None:
        """Let the middle one of consecutive poses stand for all of them.

        It takes over their observations, fused in a solve of this stretch alone; the odometry between what remains is
        composed. Observations become independent of one another given that pose, which they nearly are: what is lost is
        tested. The others keep their place relative to it.
        """
        anchor = poses[len(poses) // 2]
        numbers = sorted({n for p in poses for n in self.of_pose[p]})
        inside = set(poses)
        local = [
            f for f in (self.factors[n] for n in numbers) if f.kind == OBSERVATION or (f.kind == STEP and {f.a, f.b} <= inside)
        ]
        T_pose = {p: self.pose(p) for p in poses}
        T_landmark = {f.b: self.landmark(f.b) for f in local if f.kind == OBSERVATION}
        fused = condensed_observations(build_all(local), T_pose, T_landmark, anchor)
        for number in numbers:
            if self.factors[number].kind == OBSERVATION:
                self.remove(number)
        for j, T, covariance in fused:
            self.add(Factor(OBSERVATION, anchor, j, T, covariance))
        for pose in poses:
            if pose != anchor:
                self._bridge(pose, anchor)

    def drop(self, pose: int, onto: int) -> None:
        """Forget the observations of a pose, and the pose; its place is kept relative to another one."""
        for number in sorted(self.of_pose[pose]):
            if self.factors[number].kind == OBSERVATION:
                self.remove(number)
        self._bridge(pose, onto)

    def forget(self, poses: list[int], onto: int) -> None:
        """Take out poses with all their factors; their places, and those that hang on them, are kept relative to another one."""
        T_onto = inverse(self.pose(onto))
        for pose in poses:
            T = T_onto @ self.pose(pose)
            for number in sorted(self.of_pose.get(pose, ())):
                self.remove(number)
            self.hanging.hang(pose, onto, T)

    def _bridge(self, pose: int, onto: int) -> None:
        """Eliminate a pose that has steps alone: exact, but for its place, which is frozen relative to `onto`."""
        T = inverse(self.pose(onto)) @ self.pose(pose)
        before, after = self.steps_of(pose)
        if before is not None and after is not None:
            self.add(compose(self.factors[before], self.factors[after]))
        for number in (before, after):
            if number is not None:
                self.remove(number)
        self.hanging.hang(pose, onto, T)

    # -- solving ------------------------------------------------------------------------------------------------------

    def commit(self, *, force: bool = False) -> gtsam.ISAM2Result:
        """Hand what waits to iSAM2; `force` linearises anew whatever has moved enough.

        Raises:
            GraphError: GTSAM could not solve it; names the variable.
        """
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        needed: set[int] = set()
        added = [self.factors[number] for number in self.added]
        for factor, built in zip(added, build_all(added)):
            graph.add(built)
            needed.update(factor.variables())
        for key, T in self.first_values.items():
            if key in needed:
                values.insert(key, gtsam.Pose3(T))
        try:
            result = self.isam.update(graph, values, self.removed, force_relinearize=force)
        except RuntimeError as error:
            if self.careful:
                raise named_error(error) from None
            self.careful = True
            result = self.restart(self._points())
        for number, slot in zip(self.added, result.getNewFactorsIndices()):
            self.factors[number].slot = int(slot)
        self.added, self.removed, self.first_values = [], [], {}
        return result

    def settle(self, repeats: int = 3) -> None:
        """Solve again after the map has moved far."""
        for _ in range(repeats):
            if not self.commit(force=True).getVariablesRelinearized():
                break

    def rebuild(self) -> None:
        """A new iSAM2 with the same factors, linearised where the estimate stands: what a file can hold and give back."""
        self.commit()
        values = self.isam.calculateEstimate()
        poses = {key: values.atPose3(key).matrix() for key in values.keys()}  # noqa: SIM118 - no dictionary
        self.restart(poses)

    def _points(self) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Where every variable that has a factor is linearised, or will be."""
        needed = {key for factor in self.factors.values() for key in factor.variables()}
        points = self.isam.getLinearizationPoint()
        held = {key: points.atPose3(key).matrix() for key in needed if points.exists(key)}
        return held | {key: T for key, T in self.first_values.items() if key in needed}

    def restart(self, values: dict[int, Float[np.ndarray, "4 4"]]) -> gtsam.ISAM2Result:
        """Put all factors into a new iSAM2 at the given values."""
        self.isam = new_isam(self.careful)
        self.first_values = dict(values)
        self.added = sorted(self.factors)
        self.removed = []
        for factor in self.factors.values():
            factor.slot = -1
        return self.commit()

    # -- answers ------------------------------------------------------------------------------------------------------

    def _value(self, key: int) -> Float[np.ndarray, "4 4"]:
        waiting = self.first_values.get(key)
        return waiting if waiting is not None else self.isam.calculateEstimatePose3(key).matrix()

    def pose(self, frame: int) -> Float[np.ndarray, "4 4"]:
        """Pose of a keyframe; its first value while it waits."""
        if frame in self.hanging:
            onto, T = self.hanging.root(frame)
            return self._value(pose_key(onto)) @ T
        return self._value(pose_key(frame))

    def landmark(self, number: int) -> Float[np.ndarray, "4 4"]:
        """Pose of a landmark; its first value while it waits."""
        return self._value(landmark_key(number))

    def landmark_covariance(self, number: int) -> Float[np.ndarray, "6 6"]:
        """Covariance of a landmark, [rotation rad, position m] in its own frame, the first pose held fixed."""
        return np.array(self.isam.marginalCovariance(landmark_key(number)))

    def pose_covariance(self, frame: int) -> Float[np.ndarray, "6 6"]:
        """Covariance of a pose, [rotation rad, position m] in the camera's frame; that of the pose it hangs on, carried."""
        if frame not in self.hanging:
            return np.asarray(self.isam.marginalCovariance(pose_key(frame)))
        onto, T = self.hanging.root(frame)
        carry = adjoint(inverse(T))
        return carry @ np.asarray(self.isam.marginalCovariance(pose_key(onto))) @ carry.T

    def trajectory(self) -> Float[np.ndarray, "n 4 4"]:
        """All poses."""
        values = self.isam.calculateEstimate()
        return self.hanging.places(self.poses, lambda i: values.atPose3(pose_key(i)).matrix())

    def landmarks_of(self, poses: Iterable[int]) -> set[int]:
        """Landmarks observed from the given poses."""
        numbers = {n for p in poses for n in self.of_pose.get(p, ())}
        return {self.factors[n].b for n in numbers if self.factors[n].kind == OBSERVATION}

    def watchers(self, landmark: int) -> list[int]:
        """Poses that observe a landmark, oldest first."""
        return sorted({self.factors[n].a for n in self.of_landmark[landmark] if self.factors[n].kind == OBSERVATION})


def new_isam(careful: bool = False) -> gtsam.ISAM2:
    """iSAM2 as the running graph needs it; `careful` for scales that Cholesky cannot take."""
    parameters = gtsam.ISAM2Params()
    # Between-factors are linear in positions: only rotations that have moved need a new linearisation point.
    thresholds = gtsam.ISAM2ThresholdMap()
    for symbol in "xl":
        thresholds.insert((symbol, np.repeat([RELINEARISE_ROTATION, RELINEARISE_POSITION], 3)))
    parameters.setRelinearizeThreshold(thresholds)
    parameters.relinearizeSkip = 10
    parameters.findUnusedFactorSlots = True
    # QR takes any spread of scales, but its cost grows with the factors a landmark has: 1.7 to 19 ms a keyframe in 5 laps,
    # against 1.1 to 2.1 ms by Cholesky.
    parameters.setFactorization("QR" if careful else "CHOLESKY")
    return gtsam.ISAM2(parameters)
