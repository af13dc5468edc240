import json

import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.viz.training_plots import draw_training, read_metrics


def write(path, rows):
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def run_rows():
    shapes = {"stage": "shapes", "loss": 1.0, "terms/shape_kl": -3.0}
    rows = [{**shapes, "step": s, "terms/voxels": -100.0 / s} for s in (1, 2, 3)]
    rows += [{"stage": "scenes", "step": s, "loss": 2.0, "terms/box": -5.0, "learning_rate": 1e-3} for s in (1, 2)]
    rows.append(
        {
            "stage": "scenes",
            "step": 2,
            "bound/voxels": -50.0,
            "bound/box": 1.5,
            "bound": -48.5,
            "acc_pi6": 0.4,
            "inclusive/box": -2.0,
            "med_err_deg": 40.0,
            "box50": 0.9,
        }
    )
    return rows


def test_steps_are_counted_over_the_stages(tmp_path):
    rows = read_metrics(write(tmp_path / "metrics.jsonl", run_rows()))
    assert [row["total_step"] for row in rows] == [1, 2, 3, 4, 5, 5]
    assert read_metrics(tmp_path) == rows  # the folder will do


def test_every_term_has_a_line_and_the_sum_is_their_sum(tmp_path):
    figure = draw_training(write(tmp_path / "metrics.jsonl", run_rows()), tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    panels = {axes.get_title(): axes for axes in figure.axes}
    lines = {line.get_label(): line for line in panels["shapes: terms of the loss, nats"].lines}
    assert set(lines) == {"voxels", "shape_kl", "sum"}
    assert list(lines["sum"].get_ydata()) == [-103.0, -53.0, -100 / 3 - 3]
    bound = {line.get_label(): line for line in panels["held out: bound by term, nats a scene"].lines}
    assert list(bound["sum"].get_ydata()) == [-48.5]
    assert {"acc_pi6", "box50"} <= {line.get_label() for line in panels["held out: figures"].lines}


def test_a_run_that_has_only_begun(tmp_path):
    figure = draw_training(write(tmp_path / "metrics.jsonl", run_rows()[:1]))
    assert [axes.get_title() for axes in figure.axes] == ["shapes: terms of the loss, nats"]


def test_errors(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_metrics(tmp_path / "missing.jsonl")
    with pytest.raises(InputError, match="no metrics"):
        read_metrics(write(tmp_path / "empty.jsonl", []))
    with pytest.raises(InputError, match=r'bad\.jsonl:1: a row of metrics.*"stage" and "step"'):
        read_metrics(write(tmp_path / "bad.jsonl", [{"step": 1}]))
