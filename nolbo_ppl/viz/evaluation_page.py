"""One page of an evaluation: every figure and every picture in a single HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any

from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.io.images import open_image

CAPTIONS = {
    "precision_recall": "Precision against recall: every detection by its objectness (left), each category by its own score.",
    "reliability": "Stated probabilities against frequencies, with 95 % intervals; truths inside posterior regions.",
    "confusion": "Category of maximum likelihood over the prior means, at the true boxes.",
    "viewpoint": "Errors of the viewpoint: cumulative, signed azimuth (front taken for back shows at 180), by category.",
    "retrieval": "The same instance found again among those of its category, from another view in other light.",
    "examples": "Objects answered best, at the median and worst: axes and shapes, estimate beside truth.",
    "detections": "Whole scenes answered best, at the median and worst.",
}
"""What each picture shows, in the order of the page."""
WORDS = {
    "ap50": "detection: average precision at IoU 0.5, any category",
    "map50": "detection: mean average precision over categories",
    "category_accuracy": "category by maximum likelihood over the prior means",
    "acc_pi6": "viewpoint within 30°, mean over categories without symmetry",
    "med_err_deg": "median viewpoint error, degrees, mean over those categories",
    "acc_pi6_all": "viewpoint within 30°, mean over all categories",
    "azimuth_acc_pi6": "azimuth alone within 30°",
    "voxel_iou": "IoU of the decoded shape",
    "voxel_iou_gain": "its gain over the mean of the true category",
    "voxel_iou_ceiling": "IoU of decoding the true shape's own latent",
    "voxel_ap": "average precision of occupancy",
    "ece_objectness": "expected calibration error of objectness",
    "ece_class": "expected calibration error of the category",
    "azimuth_log_score": "log score of the azimuth, nats (less is better)",
    "azimuth_crps_deg": "ranked probability score of the azimuth, degrees",
    "median_range_error": "median relative error of the distance",
    "median_depth_error": "median relative error of the depth",
    "median_depth_error_known_size": "the same, the object's true size known",
    "class_log_score": "log score of the category, nats (less is better)",
    "objectness_log_score": "log score of objectness, nats",
    "objectness_brier": "Brier score of objectness",
    "position_log_score": "log score of the position's Gaussian, nats per m³",
    "position_tails_log_score": "the same, of the law with tails",
    "latent_log_score": "log score of the shape latent, nats",
    "latent_gaussian_log_score": "the same, of the likeliest category's Gaussian",
    "ece_objectness_if_perfect": "calibration error a perfect forecaster would show: objectness",
    "ece_class_if_perfect": "the same: category",
    "ece_objectness_debiased": "calibration error of objectness less what noise makes (root mean square)",
    "ece_class_debiased": "the same: category",
    **{
        f"coverage{level}_{region}": f"truths in the {level} % region: {words}"
        for region, words in (
            ("orientation", "azimuth"),
            ("tilt", "elevation, in-plane rotation"),
            ("position", "position"),
            ("position_tails", "position, law with tails"),
            ("latent", "shape latent"),
            ("latent_gaussian", "shape latent, the likeliest category's Gaussian"),
        )
        for level in (50, 68, 90, 95, 99)
    },
    "category_found": "category of the objects found",
    "false_without_objects": "detections above 0.5 in an image without objects",
    "viewpoint_found": "objects with a known azimuth that are found",
    "azimuth_median_deg": "median error of the azimuth, degrees",
    "azimuth_flips": "azimuth within 30° of the opposite one",
    "azimuth_coverage90": "truths in the 90 % region: azimuth of the objects found",
    "azimuth_acc_pi6_all": "azimuth within 30°, of all objects with a known one",
    "retrieval_recall1": "same instance found first (evidence ratio)",
    "retrieval_recall5": "same instance among the first five",
    "retrieval_recall1_overlap": "found first, by overlap of the posteriors",
    "retrieval_recall1_euclidean": "found first, by distance of the means",
    "retrieval_median_rank": "median place of the same instance",
}
"""What each figure is."""

LARGE = 500_000
"""Pictures of more bytes go into the page as JPEG."""
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #22262b; max-width: 1100px; margin: 2em auto; padding: 0 1.2em; }
h1 { font-size: 1.5em; margin-bottom: 0.2em; } h2 { font-size: 1.1em; margin: 2em 0 0.5em; }
p { color: #5b636c; margin: 0.3em 0; } code { background: #f1f3f5; padding: 0.1em 0.3em; }
div.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: 0.85em; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25em 0.7em; text-align: right; border-bottom: 1px solid #e3e7eb; white-space: nowrap; }
th:first-child, td:first-child, td.words { text-align: left; } th { font-weight: 600; border-bottom: 1px solid #8a929b; }
td.words { color: #5b636c; } figure { margin: 1em 0 2em; } img { max-width: 100%; height: auto; }
figcaption { color: #5b636c; font-size: 0.9em; }
"""


def write_page(values: Mapping[str, Any], pictures: Sequence[Path], path: str | PathLike[str]) -> None:
    """Write the page.

    Args:
        values: the content of metrics.json (`nolbo_ppl.evaluation.model_evaluation.metrics`).
        pictures: PNG files, put into the page itself.
        path: where it goes.
    """
    by_name = {picture.stem: picture for picture in pictures}
    configuration = values["configuration"]
    source = configuration["scenes"] or f"generated, {configuration['difficulty']}, seed {configuration['seed']}"
    if not configuration["scenes"]:
        source += "".join(f", {name} {configuration[name]}" for name in ("cad", "backgrounds") if configuration[name])
    parts = [
        f"<h1>Evaluation of {escape(str(configuration['model']))}</h1>",
        f"<p>{values['scenes']} scenes ({escape(source)}), {values['objects']} objects that count. Intervals are 95 %.</p>",
        "<h2>Figures</h2>",
        _figures(values),
        "<h2>By category</h2>",
        _rows("category", values["by_category"]),
        "<h2>By difficulty</h2>",
        _rows("objects with", values["by_difficulty"]),
    ]
    if len(values.get("peers") or ()) > 1:
        parts += ["<h2>Beside other detectors</h2>", _rows("model", values["peers"])]
    if values.get("retrieval"):
        parts += ["<h2>The same instance, by category</h2>", _rows("category", values["retrieval"])]
    for name in [*(n for n in CAPTIONS if n in by_name), *(n for n in by_name if n not in CAPTIONS)]:
        caption = escape(CAPTIONS.get(name, ""))
        image = f'<img alt="{escape(name)}" src="{_embedded(by_name[name])}">'
        parts += [f"<h2>{escape(name.replace('_', ' '))}</h2>", f"<figure>{image}<figcaption>{caption}</figcaption></figure>"]
    options = " ".join(f"{name}={value}" for name, value in configuration.items() if value not in (None, "", []))
    versions = " ".join(f"{name} {version}" for name, version in values["versions"].items())
    parts += ["<h2>Made by</h2>", f"<p><code>{escape(options)}</code></p>", f"<p>{escape(versions)}</p>"]
    head = f'<meta charset="utf-8"><title>nolbo evaluate</title><style>{STYLE}</style>'
    html = f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n' + "\n".join(parts) + "\n</body></html>\n"
    with atomic_path(path) as temporary:
        temporary.write_text(html, encoding="utf-8")


def _embedded(picture: Path) -> str:
    """A picture as a data address; large ones (photographs) as JPEG, a fifth of the size."""
    data, kind = picture.read_bytes(), "png"
    if len(data) > LARGE:
        from PIL import Image

        buffer = BytesIO()
        Image.fromarray(open_image(picture)).save(buffer, "JPEG", quality=88)
        data, kind = buffer.getvalue(), "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def _figures(values: Mapping[str, Any]) -> str:
    """Every figure that was measured, with its interval and its count."""
    rows = []
    for name, interval in values["intervals"].items():
        if values[name] is None:
            continue
        limits = "" if interval is None else f"{interval[0]:.3f} to {interval[1]:.3f}"
        cells = [f"<code>{escape(name)}</code>", f"{values[name]:.3f}", limits, str(values["counts"][name])]
        words = f'<td class="words">{escape(WORDS.get(name, ""))}</td>'
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + words + "</tr>")
    head = "<tr><th>figure</th><th>value</th><th>interval</th><th>of</th><th></th></tr>"
    return f'<div class="wide"><table>{head}{"".join(rows)}</table></div>'


def _rows(first: str, table: Mapping[str, Mapping[str, Any]]) -> str:
    """A table of tables: a row a name, a column a figure that is measured somewhere."""
    columns = [name for name in next(iter(table.values())) if any(row[name] is not None for row in table.values())]
    head = "".join(f"<th>{escape(name.replace('_', ' '))}</th>" for name in (first, *columns))
    body = "".join(
        f"<tr><td>{escape(name)}</td>" + "".join(f"<td>{_number(row[column])}</td>" for column in columns) + "</tr>"
        for name, row in table.items()
    )
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def _number(value: float | int | None) -> str:
    return "" if value is None else str(value) if isinstance(value, int) else f"{value:.3f}"
