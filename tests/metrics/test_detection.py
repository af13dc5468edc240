import numpy as np
import pytest
from sklearn.metrics import average_precision_score

from nolbo_ppl.errors import InputError
from nolbo_ppl.metrics.detection import Matches, average_precision, match, match_image, precision_recall


def made(score, correct, truths, scene=None, ignored=None):
    """Matches with given outcomes, in any order of scores."""
    score, correct = np.asarray(score, dtype=float), np.asarray(correct, dtype=bool)
    scene = np.zeros(len(score), dtype=int) if scene is None else np.asarray(scene)
    ignored = np.zeros(len(score), dtype=bool) if ignored is None else np.asarray(ignored, dtype=bool)
    order = np.argsort(-score, kind="stable")
    truth = np.where(correct | ignored, 0, -1)
    rows = np.arange(len(score))[order]
    return Matches(scene[order], rows, score[order], truth[order], ignored[order], np.asarray(truths))


def brute_force_average_precision(score, correct, total):
    """The definition: integral over recall of the largest precision at that or a higher recall."""
    points = []
    for threshold in sorted(set(score), reverse=True):
        entered = [c for s, c in zip(score, correct) if s >= threshold]
        points.append((sum(entered) / total, sum(entered) / len(entered)))
    area, steps = 0.0, 2000 * total
    for k in range(steps):
        recall = (k + 0.5) / steps
        area += max((p for r, p in points if r >= recall), default=0.0) / steps
    return area


def test_average_precision_hand_computed():
    # precision 1, 1/2, 2/3 at recall 1/4, 1/4, 2/4; one truth of four is never found and one more at precision 3/5.
    matches = made([0.9, 0.8, 0.7, 0.6, 0.5], [1, 0, 1, 0, 1], [4])
    assert average_precision(matches)[0] == pytest.approx(0.25 * 1 + 0.25 * 2 / 3 + 0.25 * 3 / 5, abs=1e-15)
    pr = precision_recall(matches)
    np.testing.assert_allclose(pr.precision, [1, 1 / 2, 2 / 3, 2 / 4, 3 / 5])
    np.testing.assert_allclose(pr.recall, [0.25, 0.25, 0.5, 0.5, 0.75])


@pytest.mark.parametrize("seed", range(6))
def test_average_precision_against_its_definition(seed):
    rng = np.random.default_rng(seed)
    n, total = 30, 12
    score = rng.integers(0, 12, n) / 12  # many ties
    correct = np.zeros(n, dtype=bool)
    correct[rng.choice(n, 9, replace=False)] = True
    expected = brute_force_average_precision(score.tolist(), correct.tolist(), total)
    assert average_precision(made(score, correct, [total]))[0] == pytest.approx(expected, abs=1e-3)


def test_average_precision_equals_scikit_learn_where_precision_falls():
    # Interpolation changes nothing when precision never rises: all true detections first.
    rng = np.random.default_rng(3)
    score = np.sort(rng.random(40))[::-1]
    correct = np.arange(40) < 17
    expected = average_precision_score(correct, score)
    assert average_precision(made(score, correct, [17]))[0] == pytest.approx(expected, abs=1e-12)


def test_interpolation_never_lowers_scikit_learns_value():
    rng = np.random.default_rng(4)
    for _ in range(20):
        score, correct = rng.random(30), rng.random(30) < 0.5
        assert average_precision(made(score, correct, [correct.sum()]))[0] >= average_precision_score(correct, score)


def test_weights_equal_repeated_scenes():
    rng = np.random.default_rng(5)
    n = 60
    score, correct, scene = rng.integers(0, 20, n) / 20, rng.random(n) < 0.6, rng.integers(0, 5, n)
    truths = np.bincount(scene, weights=correct, minlength=5).astype(int) + 1
    weights = np.array([[1, 1, 1, 1, 1], [0, 2, 1, 0, 3], [4, 0, 0, 0, 1]], dtype=float)
    values = average_precision(made(score, correct, truths, scene), weights)
    for row, value in zip(weights.astype(int), values):
        copies = [np.repeat(a, row[scene]) for a in (score, correct)]
        assert value == pytest.approx(average_precision(made(*copies, [int(row @ truths)]))[0], abs=1e-12)


def test_resample_without_truth_is_undefined_and_without_detection_zero():
    matches = made([0.5], [True], [1, 0], scene=[0])
    values = average_precision(matches, np.array([[0.0, 2.0], [2.0, 0.0]]))
    assert np.isnan(values[0]) and values[1] == 1.0
    assert average_precision(made([], [], [3]))[0] == 0.0


def test_ignored_detections_change_nothing():
    plain = made([0.9, 0.4], [1, 0], [2])
    padded = made([0.9, 0.8, 0.4, 0.3], [1, 0, 0, 0], [2], ignored=[0, 1, 0, 1])
    assert average_precision(plain)[0] == average_precision(padded)[0] == 0.5


BOX = np.array([10.0, 10.0, 30.0, 30.0])


def shifted(dx):
    """BOX moved right: IoU (20 - dx) / (20 + dx)."""
    return BOX + np.array([dx, 0, dx, 0])


def test_one_match_a_truth_by_score():
    found = match_image(np.stack([shifted(1), shifted(0)]), np.array([0.9, 0.8]), BOX[None], np.array([False]))
    np.testing.assert_array_equal(found, [0, -1])  # the better box comes too late


def test_match_takes_the_largest_overlap_and_leaves_the_rest():
    truth = np.stack([shifted(0), shifted(4)])
    found = match_image(np.stack([shifted(3), shifted(4)]), np.array([0.9, 0.8]), truth, np.zeros(2, dtype=bool))
    np.testing.assert_array_equal(found, [1, 0])  # the second finds its best truth taken, the other overlaps by 2/3


def test_threshold_is_inclusive():
    box, truth = shifted(20 / 3)[None], BOX[None]  # IoU 1/2 up to rounding
    assert match_image(box, np.ones(1), truth, np.array([False]), 0.5 - 1e-9)[0] == 0
    assert match_image(box, np.ones(1), truth, np.array([False]), 0.5 + 1e-9)[0] == -1


def test_truth_that_counts_goes_before_an_ignored_one():
    truth = np.stack([shifted(0), shifted(4)])
    found = match_image(shifted(0)[None], np.ones(1), truth, np.array([True, False]))
    np.testing.assert_array_equal(found, [1])


def test_ignored_truth_absorbs_any_number():
    found = match_image(np.stack([BOX] * 3), np.array([0.1, 0.2, 0.3]), BOX[None], np.array([True]))
    np.testing.assert_array_equal(found, [0, 0, 0])


@pytest.mark.parametrize("seed", range(5))
def test_matching_against_brute_force(seed):
    rng = np.random.default_rng(seed)
    n, m = 12, 7

    def boxes(k):
        corner = rng.uniform(0, 30, (k, 2))
        return np.concatenate((corner, corner + rng.uniform(5, 25, (k, 2))), 1)

    box, truth, score, ignore = boxes(n), boxes(m), rng.random(n), rng.random(m) < 0.3

    def iou(a, b):
        w, h = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
        inter = max(w, 0) * max(h, 0)
        return inter / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - inter)

    expected, taken = [-1] * n, set()
    for i in sorted(range(n), key=lambda i: -score[i]):
        free = [(iou(box[i], truth[j]), j) for j in range(m) if not ignore[j] and j not in taken]
        absorbed = [(iou(box[i], truth[j]), j) for j in range(m) if ignore[j]]
        for options in (free, absorbed):
            options = [o for o in options if o[0] >= 0.3]
            if options:
                expected[i] = max(options)[1]
                taken.add(expected[i])
                break
    np.testing.assert_array_equal(match_image(box, score, truth, ignore, 0.3), expected)


def test_match_keeps_the_books_of_every_image():
    matches = match(
        [np.stack([BOX, shifted(15)]), np.empty((0, 4)), BOX[None]],
        [np.array([0.3, 0.9]), np.empty(0), np.array([0.5])],
        [BOX[None], np.stack([BOX, shifted(20)]), BOX[None]],
        [np.array([False]), np.array([False, True]), np.array([True])],
    )
    np.testing.assert_array_equal(matches.scene, [0, 2, 0])
    np.testing.assert_array_equal(matches.detection, [1, 0, 0])
    np.testing.assert_array_equal(matches.truth, [-1, 0, 0])
    np.testing.assert_array_equal(matches.ignored, [False, True, False])
    np.testing.assert_array_equal(matches.correct, [False, False, True])
    np.testing.assert_array_equal(matches.truths, [1, 1, 0])


def test_errors():
    with pytest.raises(InputError, match="boxes"):
        match_image(np.zeros((2, 4)), np.zeros(3), np.zeros((1, 4)), np.zeros(1, dtype=bool))
    with pytest.raises(InputError, match=r"score of a detection.*nan"):
        match_image(np.zeros((1, 4)), np.array([np.nan]), np.zeros((1, 4)), np.zeros(1, dtype=bool))
    with pytest.raises(InputError, match=r"lists of images.*one entry an image"):
        match([np.zeros((0, 4))], [], [np.zeros((0, 4))], [np.zeros(0, dtype=bool)])
    with pytest.raises(InputError, match="recall without a truth"):
        precision_recall(made([0.5], [False], [0]))
