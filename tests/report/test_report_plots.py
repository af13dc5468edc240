"""Axes, ellipses, shapes, loops: what is drawn is where and what it should be."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.geometry.voxels import voxel_centres
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.report import read_run
from nolbo_ppl.report.em_section import json_script
from nolbo_ppl.report.loop_section import FoundLoop, find_loops, is_right, loop_scores
from nolbo_ppl.report.report_plots import map_axes, map_plot, outside
from nolbo_ppl.report.sections import world_map
from nolbo_ppl.report.shape_thumbnails import render_shape
from nolbo_ppl.report.svg import Axes, element, equal_axes, round_ticks
from nolbo_ppl.report.viewer_objects import ellipsoid
from nolbo_ppl.report.wording import say, score_tables
from nolbo_ppl.structures.association_table import AssociationTable


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.7, 12.2), (1e-6, 2e-6), (-1e5, 3e5), (5.0, 5.0)])
def test_ticks_are_round_evenly_spaced_and_inside(low: float, high: float) -> None:
    ticks = np.array(round_ticks(low, high))
    assert ticks.min() >= low - 1e-9 * abs(low) and ticks.max() <= high + 1e-9 * abs(high) and len(ticks) <= 14
    if high > low:
        assert len(ticks) >= 3
        step = np.diff(ticks)
        np.testing.assert_allclose(step, step[0])
        assert f"{step[0]:.4e}".split("e")[0] in ("1.0000", "2.0000", "5.0000")


def test_equal_axes_hold_all_points_at_one_scale() -> None:
    rng = np.random.default_rng(0)
    for stretch in ([1.0, 1.0], [100.0, 0.1], [0.1, 100.0], [0.0, 0.0]):
        points = rng.normal(size=(50, 2)) * stretch + [5.0, -8.0]
        axes = equal_axes(points)
        u, v = axes.px(points[:, 0]), axes.py(points[:, 1])
        assert u.min() >= axes.left and u.max() <= axes.width - axes.right
        assert v.min() >= axes.top and v.max() <= axes.height - axes.bottom
        down = (axes.height - axes.top - axes.bottom) / (axes.y[1] - axes.y[0])
        assert down == pytest.approx(axes.scale)


def test_ellipse_passes_through_points_at_the_quantile() -> None:
    """Points x with x' S^-1 x = 5.99 lie on the drawn ellipse, in px."""
    axes = Axes((-5.0, 5.0), (-4.0, 4.0), 572.0, 456.0, left=36.0, right=36.0, top=28.0, bottom=28.0)
    covariance, centre = np.array([[0.5, 0.3], [0.3, 0.4]]), np.array([1.0, -0.5])
    drawn = axes.ellipse(centre, covariance)
    rx, ry = (float(re.search(rf' {name}="([\d.]+)"', drawn)[1]) for name in ("rx", "ry"))  # type: ignore[index]
    x, y, angle = map(float, re.search(r"translate\(([\d.-]+) ([\d.-]+)\) rotate\(([\d.-]+)\)", drawn).groups())  # type: ignore[union-attr]
    turn = np.linspace(0, 2 * np.pi, 40)
    points = centre + np.sqrt(5.9915) * np.stack([np.cos(turn), np.sin(turn)], 1) @ np.linalg.cholesky(covariance).T
    offset = np.stack([axes.px(points[:, 0]) - x, axes.py(points[:, 1]) - y], axis=1)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    local = offset @ np.array([[c, -s], [s, c]])  # rotate() turns clockwise in a picture whose y points down
    np.testing.assert_allclose((local[:, 0] / rx) ** 2 + (local[:, 1] / ry) ** 2, 1.0, atol=0.01)


def test_ellipsoid_holds_the_probability_it_states() -> None:
    rng = np.random.default_rng(1)
    factor = rng.normal(size=(3, 3))
    covariance = factor @ factor.T
    radii, R = ellipsoid(covariance)
    assert np.linalg.det(R) == pytest.approx(1.0)
    local = rng.multivariate_normal(np.zeros(3), covariance, 40_000) @ R
    inside = np.mean(np.sum((local / radii) ** 2, axis=1) < 1)
    assert abs(inside - 0.95) < 5 * np.sqrt(0.95 * 0.05 / 40_000)


def test_shape_is_drawn_without_holes_where_it_is() -> None:
    """A ball covers the disc of its radius, a box in front of -y is seen on the left of the picture from its right."""
    for n in (8, 16, 32):
        axis = voxel_centres(n)
        distance = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)
        mean = 1 / (1 + np.exp((distance - 0.25) * 40))
        shape, doubt = render_shape(mean, mean * (1 - mean), "#4e79a7", size=120)
        pixel = ((np.arange(120) + 0.5) / 120 * 2 - 1) * 0.42
        radius = np.hypot(pixel[:, None], pixel)
        drawn = shape[..., 3] == 255
        assert drawn[radius < 0.22].all() and not drawn[radius > 0.28].any()
        np.testing.assert_array_equal(drawn, doubt[..., 3] == 255)
    block = np.zeros((16, 16, 16))
    block[6:10, 1:4, 6:10] = 1.0  # towards -y: the front
    columns = np.flatnonzero(render_shape(block, block, "#4e79a7", azimuth=np.pi / 2, elevation=0.0)[0][..., 3].any(axis=0))
    assert (
        len(columns) and columns.max() <= (1 - 0.25 / 0.42) / 2 * 224 + 1
    )  # azimuth 90 degrees looks from +x: the front is left
    nothing = render_shape(np.zeros((8, 8, 8)), np.zeros((8, 8, 8)), "#4e79a7")[0]
    assert not nothing.any()


def associations(frames: list[int], labels: list[int]) -> AssociationTable:
    rows = np.array([k for k, j in enumerate(labels) if j >= 0])
    return AssociationTable(
        tuple(map(str, range(len(frames)))),
        rows,
        np.array(labels)[rows],
        np.ones(len(rows)),
        np.zeros(len(frames)),
        np.zeros(len(frames)),
        np.array(frames),
    )


def test_loops_are_the_returns_after_the_gap() -> None:
    found = associations([0, 1, 2, 20, 21, 33, 60, 60], [0, 0, 1, 0, 1, 0, 0, -1])
    assert find_loops(found, 15) == [FoundLoop(0, 1, 20), FoundLoop(1, 2, 21), FoundLoop(0, 33, 60)]
    assert find_loops(found, 18) == [FoundLoop(0, 1, 20), FoundLoop(1, 2, 21), FoundLoop(0, 33, 60)]
    assert find_loops(found, 19) == [FoundLoop(0, 33, 60)]


def test_loops_of_the_square_are_right(run_folder: Path) -> None:
    run = read_run(run_folder)
    assert run.associations is not None and run.associations.frame is not None
    loops = find_loops(run.associations, 10)
    assert loops and all(is_right(run, loop) for loop in loops)
    scores = loop_scores(run)
    assert scores is not None and scores["precision"] == 1.0
    # Pairs counted one by one.
    label, frame = run.associations.landmark_of, run.associations.frame
    pairs = sum(label[a] == label[b] >= 0 and abs(frame[a] - frame[b]) > 10 for a in range(len(frame)) for b in range(a))
    assert scores["found"] == pairs


class Elements(HTMLParser):
    """Names of the elements of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_markup_cannot_leave_attributes_tables_or_data() -> None:
    evil = "\"'></script><img src=x onerror=alert(1)>&lt;"
    assert Elements(element("g", data_tip=evil)).found == [("g", {"data-tip": evil})]
    tables = "".join(
        t for _, t in score_tables({evil: {evil: 1.0}, "b": {"x": {evil: 1}, "y": {evil: evil}}, "warnings": [evil]})
    )
    assert {tag for tag, _ in Elements(tables).found} <= {"div", "table", "thead", "tbody", "tr", "th", "td"}
    assert [tag for tag, _ in Elements(json_script([evil])).found] == ["script"]


def test_numbers_are_said_shortly() -> None:
    assert [say(x) for x in (None, float("nan"), 0.0, 3, 0.123456, 1234.6, 1e-7, True)] == [
        "–",
        "–",
        "0",
        "3",
        "0.1235",
        "1235",
        "1e-07",
        "yes",
    ]


def test_detections_whose_truth_is_not_trusted_are_not_judged(run_folder: Path, tmp_path: Path) -> None:
    shutil.copytree(run_folder, tmp_path / "run")
    before = loop_scores(read_run(run_folder))
    truth = read_json(run_folder / "objects.json")["objects"]
    # A wrong truth of every third detection spoils the precision; set aside as not trusted, it does not.
    wrong = {name: f"other {k}" if k % 3 == 0 else thing for k, (name, thing) in enumerate(truth.items())}
    write_json(tmp_path / "run" / "objects.json", {"objects": wrong})
    spoilt = loop_scores(read_run(tmp_path / "run"))
    write_json(tmp_path / "run" / "objects.json", {"objects": wrong, "trusted": [k % 3 != 0 for k in range(len(wrong))]})
    after = loop_scores(read_run(tmp_path / "run"))
    assert before is not None and spoilt is not None and after is not None
    assert before["precision"] == after["precision"] == 1.0 and spoilt["precision"] < 0.7  # type: ignore[operator]
    assert after["found"] < before["found"]  # type: ignore[operator]


def test_an_outlier_neither_shrinks_nor_covers_the_map(run_folder: Path) -> None:
    run = read_run(run_folder)
    plain = map_axes(run)
    assert outside(run, plain) == 0
    far = replace(run.landmarks[0], T_world_object=make_pose(np.eye(3), np.array([500.0, 0.0, 900.0])))
    vague = replace(run.landmarks[1], position_covariance=np.diag([400.0, 1.0, 400.0]))
    odd = read_run(run_folder)
    odd.landmarks = (far, vague, *run.landmarks[2:])
    assert map_axes(odd).scale >= plain.scale and outside(odd, map_axes(odd)) == 1
    drawn = map_plot(odd)
    assert drawn.count('class="ellipse wide"') == 1 and drawn.count('class="ellipse"') == len(run.landmarks) - 1
    assert "1 of 8 landmarks lie far outside the picture" in world_map(odd)
