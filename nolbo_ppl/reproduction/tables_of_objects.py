"""Table 1 (viewpoints), the curves of precision and recall, and the maps of the latent spaces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import input_error
from nolbo_ppl.metrics.detection import PrecisionRecall
from nolbo_ppl.metrics.intervals import IntervalEstimate, estimate, resample_weights, widened
from nolbo_ppl.metrics.statistics import Weights, by_group, mean_of_defined, weighted_mean, weighted_median
from nolbo_ppl.metrics.viewpoint_error import ACCURATE
from nolbo_ppl.reproduction.budgets import NETWORKS, ReproduceConfig
from nolbo_ppl.reproduction.object_answers import (
    ObjectAnswers,
    answers_at_boxes,
    categories_shown,
    nearest_category_accuracy,
    occupancy_curve,
)
from nolbo_ppl.reproduction.paper_numbers import ACCURACY, MEDIAN_ERROR
from nolbo_ppl.reproduction.paper_numbers import CATEGORIES as PAPER_CATEGORIES
from nolbo_ppl.reproduction.result_table import ResultTable, over_seeds
from nolbo_ppl.reproduction.trained_networks import check_scenes, held_out_scenes, trained

RESAMPLES = 300
"""Bootstrap resamples of the scenes, for the interval of a single seed."""
OF_VAE_GAN = ("chair", "sofa")
"""Categories the paper measures the 3D-VAE-GAN on, of those at hand (its third is bench)."""
SHOWN = 10
"""Categories on a map of a latent space, drawn at random as in the paper."""
MOST_POINTS = 1200
"""Points on a map of a latent space."""


def answers(config: ReproduceConfig, name: str, seed: int) -> ObjectAnswers:
    """What a network of a seed answers at the true boxes of the held-out scenes."""
    check_scenes(config)
    model = trained(config, name, seed)
    return answers_at_boxes(model, held_out_scenes(config, model.config.categories, model.config.symmetry))


def viewpoint_table(config: ReproduceConfig) -> ResultTable:
    """Acc_pi/6 and median error by category with true boxes, by the protocol of PASCAL3D+; networks that state a viewpoint.

    The mean is over categories. Intervals are over seeds, of one seed over its scenes.
    """
    table = ResultTable(
        "Viewpoints with ground truth boxes (Table 1)",
        ("measure", *PAPER_CATEGORIES, "mean"),
        "Acc: share within 30 degrees; MedErr: median geodesic error, degrees, up to the symmetry of a shape where it is known. "
        f"Data: {config.data}, budget {config.budget}, {config.networks_of_each} seeds.",
    )
    for name in config.chosen(("multi16", "multi128", "single16")):
        found = [answers(config, name, seed) for seed in range(config.networks_of_each)]
        for measure, row in (("Acc", accuracy_row(found)), ("MedErr", median_row(found))):
            table.add(f"{NETWORKS[name].title}, here", [measure, *row])
    for measure, paper in (("Acc", ACCURACY), ("MedErr", MEDIAN_ERROR)):
        for title, numbers in paper.items():
            table.add(title, [measure, *numbers, round(float(np.mean(numbers)), 3)])
    return table


def accuracy_row(found: list[ObjectAnswers]) -> list[IntervalEstimate]:
    """Acc_pi/6 of every category of Table 1, and their mean."""
    return _row(found, lambda error: (error < ACCURATE).astype(np.float64), weighted_mean, proportion=True)


def median_row(found: list[ObjectAnswers]) -> list[IntervalEstimate]:
    """Median error of every category of Table 1, degrees, and the mean of these."""
    return _row(found, np.degrees, weighted_median, proportion=False)


def _row(
    found: list[ObjectAnswers],
    figure: Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, " n"]],
    average: Callable[..., np.ndarray],
    proportion: bool,
) -> list[IntervalEstimate]:
    """A statistic by category and its mean over categories; `figure` makes what is averaged from errors, rad."""
    labels = [CATEGORIES.index(name) for name in PAPER_CATEGORIES]
    known = [one.select(np.isfinite(one.rotation_error) & (one.category >= 0)) for one in found]
    if len(known) > 1:
        values = [_point(figure(one.rotation_error), one.category, labels, average) for one in known]
        return [over_seeds(column) for column in np.array(values).T]
    (one,) = known
    if not len(one.scene):
        return [IntervalEstimate(None, None, None, 0)] * (len(labels) + 1)
    scene = np.unique(one.scene, return_inverse=True)[1]
    weights = resample_weights(int(scene.max()) + 1, RESAMPLES, np.random.default_rng(0))
    value = figure(one.rotation_error)
    row = []
    for label in labels:
        rows = one.category == label

        def statistic(w: Weights, rows: np.ndarray = rows) -> np.ndarray:
            return average(value[rows], w[:, scene[rows]])

        result = estimate(statistic, weights, int(rows.sum()))
        row.append(widened(result) if proportion and result.count else result)

    def over_categories(w: Weights) -> np.ndarray:
        return mean_of_defined(by_group(average, value, one.category, len(CATEGORIES), w[:, scene]))

    return [*row, estimate(over_categories, weights, len(value))]


def _point(value: np.ndarray, category: np.ndarray, labels: list[int], average: Callable[..., np.ndarray]) -> np.ndarray:
    """The statistic of every category and their mean, of one seed."""
    ones = np.ones((1, len(value)))
    by_label = by_group(average, value, category, len(CATEGORIES), ones)[0]
    return np.append(by_label[labels], mean_of_defined(by_label[None])[0])


def reconstruction(config: ReproduceConfig) -> tuple[ResultTable, dict[str, PrecisionRecall]]:
    """Average precision and IoU of the shapes by network, and the curves of the first seed."""
    table = ResultTable(
        "3D reconstruction (figure of precision and recall)",
        ("AP", "voxel IoU", "AP of chair, sofa", "IoU of chair, sofa"),
        "AP: area under precision and recall of occupancy over all voxels of all objects, at true boxes, in the canonical pose. "
        "The paper shows a curve without numbers, of its 3D-VAE-GAN for bench, chair and sofa only. "
        f"Data: {config.data}, budget {config.budget}, {config.networks_of_each} seeds.",
    )
    curves: dict[str, PrecisionRecall] = {}
    some = [CATEGORIES.index(name) for name in OF_VAE_GAN]
    for name in config.chosen(tuple(NETWORKS)):
        figures = []
        for seed in range(config.networks_of_each):
            found = answers(config, name, seed)
            part = found.select(np.isin(found.category, some))
            curve = occupancy_curve(found.occupied, found.empty)
            curves.setdefault(NETWORKS[name].title, curve)
            figures.append(
                (
                    curve.area,
                    _mean_iou(found.iou),
                    occupancy_curve(part.occupied, part.empty).area if part.occupied.any() else np.nan,
                    _mean_iou(part.iou),
                )
            )
        table.add(NETWORKS[name].title, [over_seeds(column) for column in np.array(figures).T])
    return table, curves


def _mean_iou(iou: Float[np.ndarray, " n"]) -> float:
    known = iou[np.isfinite(iou)]
    return float(known.mean()) if len(known) else float("nan")


def latent_maps(config: ReproduceConfig) -> tuple[ResultTable, dict[str, tuple[np.ndarray, np.ndarray]], list[str]]:
    """Plane maps of the latent spaces by t-SNE, with samples of the prior (NOLBO, figure of latent spaces).

    Returns:
        How well categories group (accuracy of the nearest neighbours' category, before the map), the points and labels of every
        map, and the names of the labels.
    """
    table = ResultTable(
        "Categories in the latent space (figure of latent spaces)",
        ("5 nearest neighbours", "maximum likelihood"),
        "Share of objects whose five nearest neighbours in the latent space are most often of their own category, and of "
        "those whose category is that of the nearest prior mean (networks with a label-conditioned prior). "
        f"Data: {config.data}, budget {config.budget}, {config.networks_of_each} seeds.",
    )
    maps: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    shown: list[int] = []
    for name in config.chosen(tuple(NETWORKS)):
        nearest, likeliest = [], []
        for seed in range(config.networks_of_each):
            found = answers(config, name, seed)
            found = found.select(found.category >= 0)
            shown = shown or list(categories_shown(found.category, SHOWN, np.random.default_rng(0)))
            nearest.append(nearest_category_accuracy(found.latent, found.category))
            model = trained(config, name, seed)
            has_prior = model.config.description.label_prior
            likeliest.append(float((found.likeliest == found.category).mean()) if has_prior else np.nan)
            if seed == 0:
                rows = np.flatnonzero(np.isin(found.category, shown))[:MOST_POINTS]
                maps[NETWORKS[name].title] = plane_map(found.latent[rows]), found.category[rows]
                if name == "multi16":
                    points, label = prior_samples(model.prior_mean()[shown], len(rows), np.random.default_rng(0))
                    maps["prior"] = plane_map(points), np.array(shown)[label]
        table.add(NETWORKS[name].title, [over_seeds(nearest), over_seeds(likeliest)])
    return table, maps, list(CATEGORIES)


def prior_samples(
    mean: Float[np.ndarray, "l d"], count: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n d"], Int[np.ndarray, " n"]]:
    """Samples of N(mu_psi(l), I) with as many of every label, and their labels."""
    label = np.arange(count) % len(mean)
    return mean[label] + rng.standard_normal((count, mean.shape[1])), label


def plane_map(latent: Float[np.ndarray, "n d"], seed: int = 0) -> Float[np.ndarray, "n 2"]:
    """t-SNE (van der Maaten & Hinton 2008) of latents; needs the extra `reproduce` (scikit-learn).

    Raises:
        InputError: scikit-learn is not installed, or there are fewer than four points.
    """
    try:
        from sklearn.manifold import TSNE
    except ImportError:
        raise input_error("t-SNE", got="no package `sklearn`", do="pip install 'nolbo-ppl[reproduce]'") from None
    if len(latent) < 4:
        raise input_error("points of a map", got=len(latent), expected="at least 4")
    perplexity = min(30.0, (len(latent) - 1) / 3)
    return TSNE(perplexity=perplexity, init="pca", random_state=seed).fit_transform(np.asarray(latent, dtype=np.float64))
