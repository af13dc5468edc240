"""Tables with intervals, and the paper's own numbers."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t as student

from nolbo_ppl.errors import InputError
from nolbo_ppl.metrics.intervals import IntervalEstimate
from nolbo_ppl.reproduction.budgets import NETWORKS, ReproduceConfig
from nolbo_ppl.reproduction.paper_numbers import ACCURACY, ATE, CATEGORIES, MEDIAN_ERROR, RPE
from nolbo_ppl.reproduction.result_table import ResultTable, over_seeds
from nolbo_ppl.reproduction.trained_networks import own_scenes, scene_folder, trained


def test_intervals_over_seeds() -> None:
    values = np.array([2.0, 2.5, 1.0, np.nan, 4.0])
    known = values[np.isfinite(values)]
    found = over_seeds(values)
    low, high = student.interval(0.95, 3, known.mean(), known.std(ddof=1) / 2)
    assert (found.value, found.low, found.high, found.count) == pytest.approx((known.mean(), low, high, 4))
    assert over_seeds([3.0]) == IntervalEstimate(3.0, None, None, 1)
    assert over_seeds([np.nan]).value is None


def test_student_intervals_cover() -> None:
    """95 % of intervals of five draws hold the mean, within five standard errors of the share."""
    draws = np.random.default_rng(0).normal(7.0, 3.0, (2000, 5))
    found = [over_seeds(row) for row in draws]
    inside = np.mean([one.low is not None and one.high is not None and one.low <= 7.0 <= one.high for one in found])
    assert abs(inside - 0.95) < 5 * np.sqrt(0.95 * 0.05 / 2000)


def test_tables_are_written(tmp_path: Path) -> None:
    table = ResultTable("T", ("a", "b", "c"), "a note")
    table.add("x", [IntervalEstimate(1.0, 0.5, 1.5, 9), None, "text"])
    table.add("y", [2, 0.25, IntervalEstimate(None, None, None, 0)])
    table.write(tmp_path, "table", digits=2)
    text = (tmp_path / "table.md").read_text()
    assert "| x | 1.00 [0.50, 1.50] | - | text |" in text and "| y | 2.00 | 0.25 | - |" in text and text.endswith("a note\n")
    rows = list(csv.reader(io.StringIO((tmp_path / "table.csv").read_text())))
    assert rows[1] == ["x", "a", "1.0", "0.5", "1.5", "9"] and rows[2] == ["x", "c", "text", "", "", ""]
    assert [row[:3] for row in rows[3:]] == [["y", "a", "2.0"], ["y", "b", "0.25"], ["y", "c", ""]]


def test_the_papers_numbers() -> None:
    """What the text of the paper says of its own tables; the mean of its median errors is not the one it prints."""
    assert all(len(row) == len(CATEGORIES) for row in (*ACCURACY.values(), *MEDIAN_ERROR.values()))
    assert np.mean(ACCURACY["NOLBO, the paper"]) == pytest.approx(0.88, abs=0.01)
    assert np.mean(MEDIAN_ERROR["NOLBO, the paper"]) == pytest.approx(12.8, abs=0.05)
    assert ATE["multi16"] / ATE["vo"] == pytest.approx(0.84, abs=0.005)
    order = ["multi16", "multi128", "vo", "ae16", "single16", "tlnet16", "vvae16"]
    assert sorted(ATE, key=ATE.__getitem__) == order and set(RPE) == set(order)
    assert {*NETWORKS, "vo"} > set(order)


def test_options_of_reproductions(tmp_path: Path) -> None:
    assert ReproduceConfig(tmp_path, networks=("ae16", "multi16")).chosen(("multi16", "vvae16", "ae16")) == ("multi16", "ae16")
    for changes, message in (
        ({"seeds": 0}, "seeds"),
        ({"seeds": 2, "trained": 3}, "trained"),
        ({"networks": ("gan",)}, "unknown networks"),
        ({"weights": {"gan": "tiny"}}, "unknown networks"),
        ({"data": str(tmp_path / "none")}, "no such folder"),
    ):
        with pytest.raises(InputError, match=message):
            ReproduceConfig(tmp_path, **changes)  # type: ignore[arg-type]
    assert trained(ReproduceConfig(tmp_path, weights={"multi16": "tiny"}), "multi16", 0).config.latent_dim == 16
    with pytest.raises(InputError, match="weights of ae16: got weights of method nolbo, expected those of method ae"):
        trained(ReproduceConfig(tmp_path, weights={"ae16": "tiny"}), "ae16", 0)
    assert not list(tmp_path.iterdir())  # nothing was rendered or trained
    data = tmp_path / "data"
    data.mkdir()
    paths = ReproduceConfig(tmp_path, data=str(data))
    assert own_scenes(paths) is None  # a folder of paths or shapes is nothing to learn images from
    (data / "scenes.jsonl").touch()
    assert own_scenes(paths) == data == scene_folder(paths, held_out=True) and own_scenes(ReproduceConfig(tmp_path)) is None
