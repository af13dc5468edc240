"""Detection: greedy matching of boxes, precision and recall, average precision at an IoU threshold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.boxes import pairwise_iou


@dataclass(frozen=True)
class Matches:
    """What became of the detections of all images, best score first."""

    scene: Int[np.ndarray, " n"]
    """Image of each detection."""
    detection: Int[np.ndarray, " n"]
    """Its row among the detections of that image."""
    score: Float[np.ndarray, " n"]
    """Its score, falling."""
    truth: Int[np.ndarray, " n"]
    """Row of the truth it is matched to, among those of its image; -1 for none."""
    ignored: Bool[np.ndarray, " n"]
    """Matched to an ignored truth, or unmatched in a region to ignore: counts neither for nor against."""
    truths: Int[np.ndarray, " scenes"]
    """Number of truths to be found in each image, ignored ones left out."""

    @property
    def correct(self) -> Bool[np.ndarray, " n"]:
        """Matched to a truth that counts."""
        counted: np.ndarray = (self.truth >= 0) & ~self.ignored
        return counted

    def select(self, rows: Bool[np.ndarray, " n"]) -> Matches:
        """Some of the detections; the truths stay what they are."""
        names = ("scene", "detection", "score", "truth", "ignored")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


@dataclass(frozen=True)
class PrecisionRecall:
    """Precision and recall of the detections whose score is at least each threshold."""

    threshold: Float[np.ndarray, " k"]
    """The distinct scores, falling."""
    precision: Float[np.ndarray, " k"]
    recall: Float[np.ndarray, " k"]

    @property
    def area(self) -> float:
        """Average precision without interpolation, `sum_t (recall_t - recall_t-1) precision_t`."""
        return float((np.diff(self.recall, prepend=0.0) * self.precision).sum())


def match_image(
    box: Float[np.ndarray, "n 4"],
    score: Float[np.ndarray, " n"],
    truth_box: Float[np.ndarray, "m 4"],
    ignore: Bool[np.ndarray, " m"],
    iou_threshold: float = 0.5,
) -> Int[np.ndarray, " n"]:
    """Truth that each detection of one image is matched to, or -1: greedy by score, as in COCO's evaluation.

    A detection takes the truth it overlaps most among those that count, are not taken and overlap it by at least
    `iou_threshold`. Only when there is none may it fall on an ignored truth, which is never used up.

    Raises:
        InputError: shapes do not match, or a score is not finite.
    """
    box, truth_box = np.asarray(box, dtype=np.float64), np.asarray(truth_box, dtype=np.float64)
    score, ignore = np.asarray(score, dtype=np.float64), np.asarray(ignore, dtype=bool)
    if box.shape != (len(score), 4) or truth_box.shape != (len(ignore), 4):
        raise input_error(
            "boxes",
            got=f"{box.shape} with {len(score)} scores, {truth_box.shape} with {len(ignore)} ignore flags",
            expected="(n, 4) with n scores, (m, 4) with m flags",
        )
    if not np.isfinite(score).all():
        raise input_error("score of a detection", got=score[~np.isfinite(score)][0], expected="a finite number")
    matched = np.full(len(box), -1)
    if not len(box) or not len(truth_box):
        return matched
    iou = pairwise_iou(torch.from_numpy(box), torch.from_numpy(truth_box)).numpy().copy()
    iou[iou < iou_threshold] = -1.0
    for i in np.argsort(-score, kind="stable"):
        candidates = np.where(ignore, -1.0, iou[i])
        best = int(candidates.argmax())
        if candidates[best] < 0:
            best = int(iou[i].argmax())
        if iou[i, best] < 0:
            continue
        matched[i] = best
        if not ignore[best]:
            iou[:, best] = -1.0
    return matched


def in_regions(box: Float[np.ndarray, "n 4"], region: Float[np.ndarray, "k 4"], share: float = 0.5) -> Bool[np.ndarray, " n"]:
    """Whether at least `share` of a box lies in one of the regions: a region may hold several objects, so that the overlap
    is measured against the box alone, as COCO does for crowds and KITTI for its DontCare regions.
    """
    box, region = np.asarray(box, dtype=np.float64).reshape(-1, 4), np.asarray(region, dtype=np.float64).reshape(-1, 4)
    low = np.maximum(box[:, None, :2], region[None, :, :2])
    high = np.minimum(box[:, None, 2:], region[None, :, 2:])
    covered = np.prod(np.clip(high - low, 0, None), axis=-1)
    area = np.prod(np.clip(box[:, 2:] - box[:, :2], 0, None), axis=-1)
    mostly: np.ndarray = (covered >= share * area[:, None]).any(1) & (area > 0)
    return mostly


def match(
    boxes: Sequence[Float[np.ndarray, "_ 4"]],
    scores: Sequence[Float[np.ndarray, " _"]],
    truth_boxes: Sequence[Float[np.ndarray, "_ 4"]],
    ignores: Sequence[Bool[np.ndarray, " _"]],
    iou_threshold: float = 0.5,
    regions: Sequence[Float[np.ndarray, "_ 4"]] | None = None,
) -> Matches:
    """Match the detections of every image and put them in the order of their scores (one entry an image in each list).

    Args:
        boxes: boxes of the detections.
        scores: their scores.
        truth_boxes: boxes of the truths.
        ignores: truths that do not count.
        iou_threshold: least overlap of a match.
        regions: boxes of parts of the images whose content is not labelled, if there are any.

    Raises:
        InputError: the lists differ in length, or as `match_image`.
    """
    lengths = {len(boxes), len(scores), len(truth_boxes), len(ignores)}
    if len(lengths) != 1:
        raise input_error("lists of images", got=sorted(lengths), expected="one entry an image in each")
    found = [match_image(*image, iou_threshold) for image in zip(boxes, scores, truth_boxes, ignores)]
    ignored = [np.asarray(flag, dtype=bool)[m] & (m >= 0) if len(flag) else m >= 0 for m, flag in zip(found, ignores)]
    if regions is not None:
        if len(regions) != len(found):
            raise input_error("regions to ignore", got=f"{len(regions)} lists", expected=f"one for each of {len(found)} images")
        ignored = [flag | ((m < 0) & in_regions(box, part)) for flag, m, box, part in zip(ignored, found, boxes, regions)]
    sizes = [len(m) for m in found]
    scene = np.repeat(np.arange(len(found)), sizes)
    score = _join(scores, np.float64)
    order = np.argsort(-score, kind="stable")
    return Matches(
        scene=scene[order],
        detection=_join([np.arange(size) for size in sizes], np.int64)[order],
        score=score[order],
        truth=_join(found, np.int64)[order],
        ignored=_join(ignored, bool)[order],
        truths=np.array([int((~np.asarray(flag, dtype=bool)).sum()) for flag in ignores], dtype=np.int64),
    )


def _join(parts: Sequence[np.ndarray], dtype: type) -> np.ndarray:
    return np.concatenate([np.asarray(part, dtype=dtype) for part in parts]) if len(parts) else np.empty(0, dtype=dtype)


def precision_recall(matches: Matches) -> PrecisionRecall:
    """Precision and recall at every distinct score.

    Raises:
        InputError: there is no truth to be found.
    """
    if not matches.truths.sum():
        raise input_error("recall without a truth", got="0 truths", expected="at least 1 that is not ignored")
    kept = ~matches.ignored
    last = _last_of_ties(matches.score[kept])
    hits = np.cumsum(matches.correct[kept])[last]
    return PrecisionRecall(matches.score[kept][last], hits / (last + 1), hits / matches.truths.sum())


def average_precision(matches: Matches, weights: Float[np.ndarray, "b scenes"] | None = None) -> Float[np.ndarray, " b"]:
    """Area under precision against recall, all-point interpolation (Pascal VOC 2010, COCO), one value a row of weights.

    The precision at a recall is the largest at that or any higher recall. Detections of one score enter together.

    Args:
        matches: the matched detections.
        weights: how often each scene counts; once, when not given. Rows without a truth give NaN.
    """
    weights = np.ones((1, len(matches.truths))) if weights is None else weights
    kept = ~matches.ignored
    total = weights @ matches.truths
    if not kept.any():
        return np.where(total > 0, 0.0, np.nan)
    weight = weights[:, matches.scene[kept]]
    last = _last_of_ties(matches.score[kept])
    hits = np.cumsum(weight * matches.correct[kept], axis=1)[:, last]
    entered = np.cumsum(weight, axis=1)[:, last]
    precision = hits / np.maximum(entered, 1e-300)
    envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    gained = (np.diff(hits, axis=1, prepend=0.0) * envelope).sum(1)
    return np.where(total > 0, gained / np.where(total > 0, total, 1.0), np.nan)


def _last_of_ties(score: Float[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
    """Index of the last of each run of equal scores."""
    return np.flatnonzero(np.append(np.diff(score) != 0, True)) if len(score) else np.empty(0, dtype=np.int64)
