"""Input that cannot be used is refused by name."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.association import (
    association_marginals,
    association_marginals_batch,
    map_association,
    sample_associations,
)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, -1e16])
def test_unusable_values_name_detection_and_landmark(value: float) -> None:
    likelihood, null = np.zeros((3, 4)), np.zeros(3)
    likelihood[2, 1] = value
    got = r"got (nan|inf|1e\+300|-1e\+16)"
    with pytest.raises(InputError, match=r"log likelihood of detection 2 and landmark 1: " + got):
        association_marginals(likelihood, null)
    with pytest.raises(InputError, match=r"log likelihood of frame 1, detection 2 and landmark 1"):
        association_marginals_batch([(np.zeros((1, 1)), np.zeros(1)), (likelihood, null)])
    with pytest.raises(InputError, match="detection 2 and landmark 1"):
        map_association(likelihood, null)
    null[1] = value
    with pytest.raises(InputError, match=r"null hypothesis of detection 1: " + got):
        association_marginals(np.zeros((3, 4)), null)


@pytest.mark.parametrize("associator", ["exact", "belief_propagation", "hungarian", "k_best", "softmax"])
def test_a_detection_that_cannot_go_anywhere_is_named(associator) -> None:
    likelihood, null = np.zeros((3, 2)), np.array([0.0, -np.inf, 0.0])
    likelihood[1] = -np.inf
    with pytest.raises(InputError, match=r"infeasible association: detection 1 .*-inf for every landmark"):
        association_marginals(likelihood, null, associator=associator)
    with pytest.raises(InputError, match=r"infeasible association: frame 1, detection 1"):
        association_marginals_batch([(np.zeros((2, 2)), np.zeros(2)), (likelihood, null)], associator=associator)


@pytest.mark.parametrize("associator", ["exact", "belief_propagation", "hungarian", "k_best"])
def test_rivals_for_too_few_landmarks_are_named(associator) -> None:
    likelihood = np.full((4, 5), -np.inf)
    likelihood[0, 3] = 0.0
    likelihood[1:, [0, 2]] = 0.0
    with pytest.raises(InputError, match=r"detection 3 cannot go .*detections \[1, 2, 3\].* landmarks \[0, 2\] alone"):
        association_marginals(likelihood, np.full(4, -np.inf), associator=associator)
    with pytest.raises(InputError, match=r"frame 2, detection 3 cannot go .*detections \[1, 2, 3\]"):
        fine = np.zeros((4, 5)), np.full(4, -np.inf)
        association_marginals_batch([fine, fine, (likelihood, np.full(4, -np.inf))], associator=associator)
    with pytest.raises(InputError, match="infeasible association: detection 3"):
        map_association(likelihood, np.full(4, -np.inf))
    with pytest.raises(InputError, match="infeasible association: detection 3"):
        sample_associations(likelihood, np.full(4, -np.inf), rng=np.random.default_rng(0))


def test_no_landmark_and_no_null() -> None:
    with pytest.raises(InputError, match="infeasible association: detection 0"):
        association_marginals(np.zeros((1, 0)), np.array([-np.inf]))


def test_large_magnitudes_of_real_distances_are_fine() -> None:
    """A jump of 10 km at 1 cm: 5e11 nats. Differences within a detection are still resolved."""
    likelihood = np.array([[-5e11, -5e11 - 2.0], [-3.0, -1.0]])
    ours = association_marginals(likelihood, np.array([-np.inf, -5.0]))
    swapped = np.exp([-1.0, -2.0 - 3.0, 0.0 - 5.0, -2.0 - 5.0])  # (0, 1), (1, 0), (0, null), (1, null)
    assert ours.weights[0, 0] == pytest.approx((swapped[0] + swapped[2]) / swapped.sum(), abs=1e-3)


@pytest.mark.parametrize(
    ("likelihood", "null"),
    [(np.zeros(3), np.zeros(3)), (np.zeros((3, 2)), np.zeros(2)), (np.zeros((3, 2)), np.zeros((3, 1)))],
)
def test_wrong_shapes(likelihood, null) -> None:
    with pytest.raises(InputError, match=r"wrong shapes: got log_likelihood \[.*expected \[n, m\] and \[n\]"):
        association_marginals(likelihood, null)


def test_inputs_stay_as_they_were_and_need_not_be_contiguous() -> None:
    rng = np.random.default_rng(0)
    wide = rng.normal(size=(8, 6))
    null, before = rng.normal(size=6), wide.copy()
    transposed = association_marginals(wide.T[:, ::2], null)
    plain = association_marginals(np.ascontiguousarray(wide.T[:, ::2]), null)
    np.testing.assert_array_equal(transposed.weights, plain.weights)
    np.testing.assert_array_equal(wide, before)
    lists = association_marginals([[0.0, 1.0]], [0.5])
    assert lists.weights.shape == (1, 2)
    assert association_marginals(wide.astype(np.float32), wide[:, 0].astype(np.float32)).weights.dtype == np.float64
