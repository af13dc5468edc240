"""A factor graph linearised and factorised once: what samples, marginals and joint covariances are read from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float, Int

from nolbo_ppl.inference.slam.graph import GraphError, SlamEstimate, named_error, to_values

SAMPLED_BLOCKS, LARGEST_SAMPLE = 20_000, 4
"""Samples of a small graph: as many as make so many poses and landmarks, at most this multiple of the configured number."""


@dataclass(frozen=True)
class Linearisation:
    """A linearised graph, factorised once: samples, marginals and joint covariances of any variables.

    Columns of the system: landmarks in order, then poses in order (GTSAM sorts its keys: 'l' before 'x'), six each; then the
    scales of the odometry's steps ('z'), where they are a state.
    """

    landmarks: int
    """Number of landmarks."""
    poses: int
    """Number of poses."""
    jacobian: scipy.sparse.csc_matrix
    """Whitened Jacobian."""
    factor: scipy.sparse.linalg.SuperLU
    """Factorisation of its normal matrix."""
    residual: np.ndarray
    """Whitened residuals at the point of linearisation, one a row of the Jacobian."""
    error_root: scipy.sparse.csr_matrix | None = None
    """Root of the covariance of the whitened errors (`shared_errors`); None: the identity, every row's error is its own."""

    def with_errors(self, root: scipy.sparse.csr_matrix | None) -> Linearisation:
        """The same system with errors of this root."""
        return replace(self, error_root=root)

    def errors(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "r s"]:
        """Samples of the whitened errors."""
        if self.error_root is None:
            return rng.standard_normal((self.jacobian.shape[0], count))
        return np.asarray(self.error_root @ rng.standard_normal((self.error_root.shape[1], count)))

    def affordable(self, count: int) -> int:
        """Number of samples, `count` or more where the graph is small: there a map must not depend on which were drawn."""
        return max(count, min(LARGEST_SAMPLE * count, SAMPLED_BLOCKS // (self.landmarks + self.poses)))

    def samples(self, count: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "n 6 s"], Float[np.ndarray, "m 6 s"]]:
        """Posterior samples in the tangent spaces of poses and landmarks: solve J'J d = J' e for e of N(0, I)."""
        noise = self.errors(count, rng)
        blocks = 6 * (self.landmarks + self.poses)
        delta = self.factor.solve(self.jacobian.T @ noise)[:blocks].reshape(-1, 6, count)
        return delta[self.landmarks :], delta[: self.landmarks]

    def residual_samples(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "r s"]:
        """Whitened residuals that the model itself expects after the fit: `e - J (J'J)^-1 J' e` for e of N(0, I).

        Their mean square is one less the row's leverage; it is sampled without cancellation where a fit takes nearly all away.
        """
        noise = self.errors(count, rng)
        return noise - self.jacobian @ self.factor.solve(self.jacobian.T @ noise)

    def _inverse_columns(self, columns: Int[np.ndarray, " c"]) -> Iterator[tuple[slice, Float[np.ndarray, "s p"]]]:
        """Columns of the inverse of the normal matrix, 64 blocks of six at a time, with the slice of `columns` that they are."""
        for start in range(0, len(columns), 384):
            part = slice(start, min(start + 384, len(columns)))
            right = np.zeros((self.jacobian.shape[1], part.stop - start))
            right[columns[part], np.arange(part.stop - start)] = 1.0
            yield part, self.factor.solve(right)

    def covariance(self, blocks: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b 6 6"]:
        """Marginal covariances of the given blocks (landmark j: j; pose i: landmarks + i)."""
        blocks = np.asarray(blocks, dtype=np.int64)
        columns = 6 * blocks[:, None] + np.arange(6)
        out = np.empty((len(blocks), 6, 6))
        for part, solution in self._inverse_columns(columns.ravel()):
            own = np.arange(part.start, part.stop).reshape(-1, 6)
            if self.error_root is None:
                out[own[:, 0] // 6] = solution[columns[own[:, 0] // 6][:, :, None], own[:, None] - part.start]
            else:
                seen = (self.error_root.T @ (self.jacobian @ solution)).reshape(-1, len(own), 6)
                out[own[:, 0] // 6] = np.einsum("sbi,sbj->bij", seen, seen)
        return 0.5 * (out + np.swapaxes(out, 1, 2))

    def joint_covariance(self, blocks: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b 6 b 6"]:
        """Joint covariance of the given blocks, numbered as in `covariance`; what two of them share is off the diagonal."""
        blocks = np.asarray(blocks, dtype=np.int64)
        columns = (6 * blocks[:, None] + np.arange(6)).ravel()
        out = np.empty((len(columns), len(columns)))
        if self.error_root is not None:
            seen = [self.error_root.T @ (self.jacobian @ solution) for _, solution in self._inverse_columns(columns)]
            whole = np.concatenate(seen, axis=1) if seen else np.zeros((0, 0))
            return (whole.T @ whole).reshape(len(blocks), 6, len(blocks), 6)
        for part, solution in self._inverse_columns(columns):
            out[:, part] = solution[columns]
        return (0.5 * (out + out.T)).reshape(len(blocks), 6, len(blocks), 6)

    def scale_deviations(self) -> Float[np.ndarray, " n-1"]:
        """Standard deviations of the scales of the odometry's steps; none where they are no state."""
        first, size = 6 * (self.landmarks + self.poses), self.jacobian.shape[1]
        variance = np.empty(size - first)
        for part, solution in self._inverse_columns(np.arange(first, size)):
            variance[part] = solution[first:][part].diagonal()
        return np.sqrt(np.maximum(variance, 0.0))

    def log_determinant(self) -> float:
        """Log determinant of the normal matrix."""
        return float(np.sum(np.log(np.abs(self.factor.U.diagonal()))))


def linearise(graph: gtsam.NonlinearFactorGraph, estimate: SlamEstimate) -> Linearisation:
    """Linearise at an estimate and factorise the normal matrix (SuperLU without pivoting: it is positive definite).

    Raises:
        GraphError: the system is indeterminate.
    """
    try:
        rows, columns, entries = graph.linearize(to_values(estimate)).sparseJacobian_()
    except RuntimeError as error:
        raise named_error(error) from None
    size = 6 * (len(estimate.T_world_camera) + len(estimate.T_world_landmark))
    size += 0 if estimate.scale is None else len(estimate.scale)
    system = scipy.sparse.csc_matrix((entries, (rows.astype(np.int64) - 1, columns.astype(np.int64) - 1)))
    jacobian = system[:, :size]
    # The last column is the right-hand side; GTSAM leaves it out where all residuals are zero.
    residual = -system[:, size].toarray().ravel() if system.shape[1] > size else np.zeros(system.shape[0])
    normal = (jacobian.T @ jacobian).tocsc()
    try:
        factor = scipy.sparse.linalg.splu(
            normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError as error:
        raise GraphError(f"the linearised graph is indeterminate: {error}") from None
    return Linearisation(len(estimate.T_world_landmark), len(estimate.T_world_camera), jacobian, factor, residual)
