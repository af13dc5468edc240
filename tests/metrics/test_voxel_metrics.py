import numpy as np
import pytest
from sklearn.metrics import average_precision_score, jaccard_score

from nolbo_ppl.errors import InputError
from nolbo_ppl.metrics.voxel import voxel_average_precision, voxel_iou


def grids(seed, n=4, v=8):
    rng = np.random.default_rng(seed)
    truth = rng.random((n, v, v, v)) < 0.3
    probability = np.clip(0.6 * truth + 0.6 * rng.random(truth.shape) - 0.1, 0, 1)
    return np.round(probability, 2).astype(np.float32), truth  # rounding makes ties


def test_iou_against_scikit_learn():
    probability, truth = grids(0)
    expected = [jaccard_score(t.ravel(), p.ravel() > 0.5) for p, t in zip(probability, truth)]
    np.testing.assert_allclose(voxel_iou(probability, truth), expected, atol=1e-12)


def test_average_precision_against_scikit_learn():
    probability, truth = grids(1)
    expected = [average_precision_score(t.ravel(), p.ravel()) for p, t in zip(probability, truth)]
    np.testing.assert_allclose(voxel_average_precision(probability, truth), expected, atol=1e-12)


def test_exact_and_constant_predictions():
    _, truth = grids(2)
    np.testing.assert_array_equal(voxel_iou(truth.astype(float), truth), 1.0)
    np.testing.assert_array_equal(voxel_average_precision(truth.astype(float), truth), 1.0)
    constant = np.full(truth.shape, 0.2)
    np.testing.assert_array_equal(voxel_iou(constant, truth), 0.0)
    np.testing.assert_allclose(voxel_average_precision(constant, truth), truth.mean((1, 2, 3)))


def test_no_object_gives_no_value():
    empty = np.zeros((0, 4, 4, 4))
    assert voxel_iou(empty, empty > 0).shape == voxel_average_precision(empty, empty > 0).shape == (0,)


def test_errors():
    probability, truth = grids(3)
    with pytest.raises(InputError, match="voxel grids"):
        voxel_iou(probability[:, :4], truth)
    with pytest.raises(InputError, match=r"without an occupied voxel.*object 2"):
        voxel_average_precision(probability, truth & (np.arange(4) != 2)[:, None, None, None])
    with pytest.raises(InputError, match=r"occupancy probability.*not finite"):
        voxel_iou(np.where(truth, np.nan, probability), truth)
