"""Errors that all views of an object have in common: what they make of covariances that took views for independent.

A detector that is off the same way in every view of an object (a box's centre is not where the object's centre is seen, a
network takes a tall car for a near one) does not become better by looking again. The graph weighs its observations as if each
had an error of its own; its answer is the same linear function of them whatever their errors are, so that its covariance is

    (J'J)^-1 J' N N' J (J'J)^-1

with the whitened observations' true covariance N N' in place of the identity (White 1980, Econometrica 48(4)): for every
landmark one vector of three standard normal numbers, seen through each view's root of `position_shared`, and the rest of each
view's covariance independent. Making that vector a state would weigh views better; GTSAM has no such factor, and for views that
are alike both have the same answer.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse

from nolbo_ppl.inference.slam.graph import MINIMUM_WEIGHT, ObservationFactors, odometry_rows
from nolbo_ppl.inference.slam.linearisation import Linearisation, linearise
from nolbo_ppl.inference.slam.slam_state import SlamState, measured_graph


def error_root(state: SlamState, factors: ObservationFactors, rows: int) -> scipy.sparse.csr_matrix | None:
    """Root of the covariance of a linearised graph's whitened errors, a column for each independent source; None: the identity.

    Args:
        state: whose graph it is.
        factors: its observations; those of enough weight follow the odometry in the graph.
        rows: rows of the linearised graph.
    """
    kept = np.flatnonzero(factors.weight > MINIMUM_WEIGHT)
    shared = state.measurements.shared_root[state.rows[factors.index[kept]]]
    if not shared.any():
        return None
    R = factors.T_camera_landmark[kept][:, :3, :3]
    whitening = np.linalg.inv(np.linalg.cholesky(factors.covariance[kept] / factors.weight[kept][:, None, None]))
    of_object = whitening[:, :, 3:] @ np.swapaxes(R, 1, 2) @ shared
    # What the graph takes for a view's covariance may be larger than what was stated, and by its weight; it is never less.
    value, axes = np.linalg.eigh(np.eye(6) - of_object @ np.swapaxes(of_object, 1, 2))
    own = axes * np.sqrt(np.clip(value, 0.0, None))[:, None]
    begin, count = odometry_rows(len(state.problem) - 1, state.noise), len(kept)
    at = begin + 6 * np.arange(count)[:, None] + np.arange(6)
    used, landmark = np.unique(factors.landmark[kept], return_inverse=True)
    row = np.broadcast_to(at[:, :, None], own.shape).ravel()
    own_column = np.broadcast_to(at[:, None, :], own.shape).ravel()
    shared_row = np.broadcast_to(at[:, :, None], of_object.shape).ravel()
    shared_column = np.broadcast_to((rows + 3 * landmark[:, None] + np.arange(3))[:, None], of_object.shape).ravel()
    other = np.concatenate([np.arange(begin), np.arange(begin + 6 * count, rows)])
    return scipy.sparse.csr_matrix(
        (
            np.concatenate([np.ones(len(other)), own.ravel(), of_object.ravel()]),
            (np.concatenate([other, row, shared_row]), np.concatenate([other, own_column, shared_column])),
        ),
        shape=(rows, rows + 3 * len(used)),
    )


def linearise_answer(state: SlamState) -> Linearisation:
    """A state's graph without links, linearised at its estimate, with the errors that views share: what answers are read from.

    Raises:
        GraphError: the system is indeterminate.
    """
    graph, factors = measured_graph(state)
    found = linearise(graph, state.estimate)
    return found.with_errors(error_root(state, factors, found.jacobian.shape[0]))
