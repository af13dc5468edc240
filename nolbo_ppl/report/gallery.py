"""Gallery of the landmarks: best picture, decoded shape and its uncertainty, class posterior, figures."""

from __future__ import annotations

import numpy as np
from PIL import Image

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.images import open_image
from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.report.report_plots import category_number, colour_of
from nolbo_ppl.report.shape_thumbnails import data_uri, photo_uri, render_shape
from nolbo_ppl.report.svg import element, escape
from nolbo_ppl.report.wording import say
from nolbo_ppl.structures.landmark import Landmark
from nolbo_ppl.viz.style import MUTED, category_colour

MOST_CARDS = 300
"""Landmarks shown, the best seen ones first: the page stays under some ten megabytes."""
VIEW = 128
"""Longer side of a view, px."""
WHOLE = 0.995
"""A view with at least this weight is the landmark's without a word."""
MOST_BARS = 4
"""Categories of a posterior that are shown."""


def order(run: RunFolder) -> list[int]:
    """Landmarks by the weight of their detections, the best seen first."""
    return sorted(range(len(run.landmarks)), key=lambda k: -np.nan_to_num(run.landmarks[k].detections))[:MOST_CARDS]


def _image(uri: str, alt: str, caption: str, empty: str = "") -> str:
    inside = f'<img src="{uri}" alt="{escape(alt)}">' if uri else element("div", escape(empty), class_="missing")
    return element("figure", inside + element("figcaption", escape(caption)))


def pictures(run: RunFolder, landmark: Landmark) -> str:
    """The best crop, the shape, the shape's uncertainty; those that exist."""
    crop, voxels, out = run.crop(landmark.name), run.voxels(landmark.name), ""
    if crop is not None:
        try:
            image = Image.fromarray(open_image(crop, shorter_side=224))
            out += _image(photo_uri(image, 224), f"best view of {landmark.name}", "best view")
        except InputError:
            out += _image("", "", "best view", "unreadable picture")
    elif run.crops.is_dir():
        out += _image("", "", "best view", "no picture")
    if voxels is not None:
        shape, doubt = render_shape(*voxels, colour_of(run, landmark))
        out += _image(data_uri(shape, 48), f"shape of {landmark.name}", "decoded shape")
        out += _image(data_uri(doubt, 48), f"uncertainty of {landmark.name}", "its uncertainty")
    elif run.voxel_names:
        out += _image("", "", "decoded shape", "no shape")
    return element("div", out, class_="pictures") if out else ""


def all_views(run: RunFolder, landmark: Landmark) -> str:
    """The pictures of a landmark's views, folded; empty without any. A click on the landmark in a map shows them as well."""
    found = run.views.get(landmark.name)
    if found is None or not found.pictures:
        return ""
    shown = ""
    for view in found.pictures:
        try:
            uri = photo_uri(Image.fromarray(open_image(view.file, shorter_side=VIEW)), VIEW)
        except InputError:
            continue
        caption = f"frame {view.frame}" + ("" if view.weight >= WHOLE else f", weight {view.weight:.2f}")
        picture = f'<img src="{uri}" alt="{escape(f"{landmark.name} in frame {view.frame}")}">'
        shown += element("figure", picture + element("figcaption", escape(caption)))
    told = f"{len(found.pictures)} of {found.count} views" if len(found.pictures) < found.count else f"all {found.count} views"
    return (
        element("details", element("summary", told) + element("div", shown, class_="view-grid"), class_="views") if shown else ""
    )


def posterior_bars(run: RunFolder, landmark: Landmark) -> str:
    """The most probable categories as bars."""
    found = sorted(landmark.class_posterior.items(), key=lambda item: -item[1])[:MOST_BARS]
    rows = ""
    for category, p in found:
        colour = category_colour(category, run.categories) if category in run.categories else MUTED
        bar = element("span", "", class_="bar", style=f"width:{100 * min(max(p, 0), 1):.1f}%;background:{colour}")
        rows += element(
            "div",
            element("span", escape(category), class_="bar-name")
            + element("span", bar, class_="bar-track")
            + element("span", f"{p:.3f}", class_="bar-value"),
            class_="bar-row",
        )
    return element("div", rows, class_="bars") if rows else ""


def facts(landmark: Landmark) -> str:
    """Figures of one landmark."""
    rows = []
    if np.isfinite(landmark.existence):
        rows.append(("existence", f"{landmark.existence:.3f}"))
    if np.isfinite(landmark.detections):
        rows.append(("detections", f"{landmark.detections:.1f}"))
    if landmark.frames is not None:
        rows.append(("frames", f"{landmark.frames[0]} – {landmark.frames[1]}"))
    rows.append(("position, m", ", ".join(f"{v:.2f}" for v in landmark.position)))
    if np.isfinite(landmark.spread):
        rows.append(("worst axis, m", f"± {say(landmark.spread)}"))
    if landmark.size is not None:
        rows.append(("size, m", " × ".join(f"{v:.2f}" for v in landmark.size)))
    return element("dl", "".join(element("dt", escape(k)) + element("dd", escape(v)) for k, v in rows))


def card(run: RunFolder, k: int) -> str:
    """One landmark."""
    landmark = run.landmarks[k]
    dot = element("span", "", class_="swatch", style=f"background:{colour_of(run, landmark)}")
    name = element("b", escape(landmark.name)) + (f" {escape(landmark.category)}" if landmark.category else "")
    body = pictures(run, landmark) + posterior_bars(run, landmark) + facts(landmark) + all_views(run, landmark)
    return element(
        "article",
        element("h3", dot + element("span", name)) + body,
        id=f"card-{k}",
        class_="card",
        data_detections=float(np.nan_to_num(landmark.detections)),
        data_existence=float(np.nan_to_num(landmark.existence)),
        data_spread=float(np.nan_to_num(landmark.spread)),
        data_first=landmark.frames[0] if landmark.frames else 0,
        data_category=category_number(run, landmark),
    )


def gallery(run: RunFolder) -> str:
    """All cards under controls that sort and filter them."""
    shown = order(run)
    sorts = (
        ("detections", "most detections"),
        ("existence", "surest"),
        ("first", "first seen"),
        ("spread", "least certain place"),
    )
    choices = "".join(element("option", label, value=key) for key, label in sorts)
    controls = element("label", "Sort by " + element("select", choices, data_sort="cards"))
    kinds = element("option", "all categories", value="all")
    kinds += "".join(element("option", escape(name), value=number) for number, name in enumerate(run.categories))
    if len(run.categories) > 1:
        controls += element("label", "Show " + element("select", kinds, data_filter="cards"))
    rest = len(run.landmarks) - len(shown)
    note = element("p", f"{rest} more landmarks with fewer detections are in landmarks.json.", class_="note") if rest else ""
    return (
        element("div", controls, class_="controls") + element("div", "".join(card(run, k) for k in shown), class_="cards") + note
    )
