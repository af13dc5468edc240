"""The best association and its dual potentials."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from nolbo_ppl.inference.association import map_association
from nolbo_ppl.inference.association.assignment import best_assignments
from nolbo_ppl.inference.association.problem import pack_frames


def test_best_of_all(problems, enumerate_associations) -> None:
    for likelihood, null in problems:
        truth = enumerate_associations(likelihood, null)
        ours = map_association(likelihood, null)
        assert ours.log_weight == pytest.approx(truth.log_weight.max(), rel=1e-14, abs=1e-11)
        used = ours.landmark[ours.landmark >= 0]
        assert len(set(used.tolist())) == len(used)
        entries = [null[i] if j < 0 else likelihood[i, j] for i, j in enumerate(ours.landmark)]
        assert sum(entries) == pytest.approx(ours.log_weight, rel=1e-14, abs=1e-11)


def test_larger_problems_against_scipy() -> None:
    rng = np.random.default_rng(6)
    for n, m in [(40, 60), (60, 40), (25, 25)]:
        likelihood, null = 500 * rng.normal(size=(n, m)), 500 * rng.normal(size=n) - 400
        nulls = np.where(np.eye(n, dtype=bool), null[:, None], -1e9)
        padded = np.hstack([likelihood, nulls])
        rows, columns = linear_sum_assignment(padded, maximize=True)
        assert map_association(likelihood, null).log_weight == pytest.approx(padded[rows, columns].sum(), rel=1e-13)


def test_potentials_prove_it_best(problems) -> None:
    """Weak duality: feasible potentials bound every association, and reach the best one."""
    for likelihood, null in problems:
        frames = pack_frames([(likelihood, null)])
        best = best_assignments(frames)
        u, v = best.row_potential, best.column_potential
        slack = u[:, None] + v[None] - likelihood
        assert (slack >= -1e-9).all() and (u - null >= -1e-9).all() and (v >= 0).all()
        for i, j in enumerate(best.match):
            assert (u[i] - null[i] if j < 0 else slack[i, j]) == pytest.approx(0, abs=1e-9)
        assert set(np.flatnonzero(v > 0)) <= set(best.match)
        assert u.sum() + v.sum() == pytest.approx(best.log_weight[0], rel=1e-13, abs=1e-9)
