"""Figures on photographs of which not everything is labelled, against cases counted by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.data.converters.photographs import Photograph
from nolbo_ppl.errors import InputError
from nolbo_ppl.evaluation.photograph_scores import PhotographDetections, Viewpoints, match_photographs, photograph_scores

NAMES = ("car", "boat")


def photo(boxes: list, labels: list, exhaustive: set, ignore: list | None = None, source: str = "a") -> Photograph:
    n = len(boxes)
    return Photograph(
        Path("x.png"), 200, 200, source, frozenset(exhaustive), np.array(boxes, dtype=float).reshape(-1, 4),
        np.array(labels, dtype=int), np.array(ignore or [False] * n, dtype=bool), np.full((n, 3), np.nan),
    )  # fmt: skip


def answer(boxes: list, objectness: list, labels: list, sure: float = 0.9) -> PhotographDetections:
    posterior = np.full((len(boxes), 2), 1 - sure)
    posterior[np.arange(len(boxes)), labels] = sure
    box = np.array(boxes, dtype=float).reshape(-1, 4)
    return PhotographDetections(box, np.array(objectness, dtype=float), posterior, np.zeros(len(box)))


CAR, OTHER, SMALL, FREE = [10, 10, 60, 60], [100, 100, 160, 160], [70, 10, 80, 20], [10, 100, 60, 150]


def test_unlabelled_categories_do_not_count_against() -> None:
    photos = [photo([CAR], [0], {0}), photo([CAR], [0], {0, 1})]
    answers = [answer([CAR, FREE], [0.9, 0.8], [0, 1])] * 2
    found = match_photographs(photos, answers)
    # the free box is called a boat: unknown in the first photograph, wrong in the second
    assert found.ignored.sum() == 1 and found.correct.sum() == 2
    scores = photograph_scores(photos, answers, NAMES, np.random.default_rng(0), 50)
    assert scores.figures["ap50"].value == 1.0  # the wrong one comes last
    assert scores.figures["category_found"].value == 1.0


def test_small_and_difficult_objects_do_not_count() -> None:
    photos = [photo([CAR, SMALL, OTHER], [0, 0, 1], {0, 1}, [False, False, True])]
    answers = [answer([SMALL, OTHER], [0.9, 0.8], [0, 1])]
    found = match_photographs(photos, answers)
    assert found.truths.tolist() == [1] and not found.correct.any() and found.ignored.all()


def test_false_detections_and_calibration_by_hand() -> None:
    photos = [photo([], [], {0, 1}), photo([CAR], [0], {0, 1}), photo([], [], {0})]
    answers = [answer([CAR, FREE], [0.7, 0.6], [0, 0]), answer([CAR], [0.9], [1], sure=0.6), answer([CAR], [0.9], [1])]
    scores = photograph_scores(photos, answers, NAMES, np.random.default_rng(0), 50)
    assert scores.figures["false_without_objects"].value == 2.0  # of the first: the last is not labelled throughout
    assert scores.figures["false_without_objects"].count == 1
    # judged: 0.7 and 0.6 wrong, 0.9 right
    assert scores.figures["ece_objectness"].value == pytest.approx((0.7 + 0.6 + 0.1) / 3)
    assert scores.figures["category_found"].value == 0.0
    assert scores.figures["ece_class"].value == pytest.approx(0.6)
    assert scores.by_size["small (24-64 px)"]["objects"] == 1


def test_the_error_that_noise_alone_leaves() -> None:
    """Three detections at one half: a perfect forecaster is off by 1/2 in a quarter of cases, by 1/6 in the others."""
    photos = [photo([CAR], [0], {0, 1})]
    answers = [answer([CAR, FREE, OTHER], [0.5, 0.5, 0.5], [0, 0, 0], sure=1.0)]
    figures = photograph_scores(photos, answers, NAMES, np.random.default_rng(0), 50).figures
    null = figures["ece_objectness_if_perfect"]
    assert null.value == pytest.approx(0.25, abs=5 * np.sqrt(1 / 48 / 200))  # 200 draws of variance 1/12 - 1/16
    assert null.count == 3 and figures["ece_class_if_perfect"].value == 0.0  # certain, and so never wrong


def test_viewpoints_of_what_is_found() -> None:
    photos = [photo([CAR], [0], {0, 1})]
    views = Viewpoints(
        np.zeros(4, dtype=int), np.radians([5.0, -170.0, 20.0, 90.0]), np.array([0.5, 0.99, 0.2, 0.1]),
        np.array([True, True, True, False]),
    )  # fmt: skip
    scores = photograph_scores(photos, [answer([CAR], [0.9], [0])], NAMES, np.random.default_rng(0), 50, views)
    figures = {name: one.value for name, one in scores.figures.items()}
    assert figures["viewpoint_found"] == 0.75
    assert figures["azimuth_acc_pi6"] == pytest.approx(2 / 3) and figures["azimuth_flips"] == pytest.approx(1 / 3)
    assert figures["azimuth_median_deg"] == pytest.approx(20.0) and figures["azimuth_coverage90"] == pytest.approx(2 / 3)
    assert figures["azimuth_acc_pi6_all"] == 0.5


def test_nothing_to_find_is_an_error() -> None:
    with pytest.raises(InputError, match="no object"):
        photograph_scores([photo([], [], {0})], [answer([], [], [])], NAMES, np.random.default_rng(0))
