"""The ablation harness: every variant is a valid run that differs from the default, and budgets buy equal compute."""

import importlib.util
import sys
from pathlib import Path

import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.elbo import SceneELBO
from nolbo_ppl.io.files import write_json


@pytest.fixture(scope="module")
def ablations():
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "ablations.py"
    specification = importlib.util.spec_from_file_location("ablations", path)
    module = sys.modules["ablations"] = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    yield module
    del sys.modules["ablations"]


@pytest.fixture
def settings(ablations, tmp_path, monkeypatch):
    monkeypatch.setattr(ablations, "named_instances", lambda settings: tmp_path / "named")
    return ablations.Settings(out=tmp_path, seconds=0.0)


def test_every_variant_is_a_run_of_its_own(ablations, settings):
    seen = {}
    for name in ablations.VARIANTS:
        config = ablations.training_config(name, settings)
        for stage in config.stages():
            SceneELBO(stage.weights)  # names of terms are checked here
        identity = config.identity()
        assert all(identity != other for other in seen.values()), name
        seen[name] = identity
    assert seen["default"]["networks"] == {"image_size": 128}
    assert seen["no-glimpse"]["networks"] == {"image_size": 128, "glimpse": 0}
    assert ablations.training_config("no-glimpse", settings).model().glimpse == 0
    assert ablations.training_config("size-96", settings).model().image_size == 96
    assert ablations.training_config("sincos", settings).model().azimuth_components == 1
    assert [stage.name for stage in ablations.training_config("no-shapes", settings).stages()] == ["single", "scenes"]


def test_a_budget_buys_the_same_seconds_whatever_a_step_costs(ablations):
    for costs in (
        {"shapes": 0.2, "single": 0.5, "scenes": 0.4},
        {"single": 0.1, "scenes": 1.7},
        {"shapes": 0.3, "scenes": 0.05},
    ):
        steps = ablations.steps_for(3600.0, costs)
        assert set(steps) == set(costs)
        assert sum(steps[name] * costs[name] for name in costs) == pytest.approx(3600, rel=2e-3)
    assert ablations.steps_for(0.01, {"scenes": 5.0}) == {"scenes": 1}


def test_a_plan_is_kept_and_bound_to_its_budget(ablations, settings, tmp_path):
    from dataclasses import replace

    plan = {"seconds": 60.0, "seconds_a_step": {}, "steps": {"shapes": 7, "single": 3, "scenes": 11}}
    write_json(tmp_path / "default" / "plan.json", plan)
    config, kept = ablations.planned("default", replace(settings, seconds=60.0))
    assert (config.shape_steps, config.single_steps, config.scene_steps) == (7, 3, 11) and kept == plan
    with pytest.raises(InputError, match="another budget than before"):
        ablations.planned("default", replace(settings, seconds=61.0))
    with pytest.raises(InputError, match=r"unknown variants.*\['best'\]"):
        ablations.main(replace(settings, only=("best",)))


def test_what_is_measured_is_not_trained_again(ablations, settings, tmp_path, capsys, monkeypatch):
    from dataclasses import replace

    monkeypatch.setattr(ablations, "run", None)  # calling it would raise
    figures = dict.fromkeys(ablations.FIGURES, 0.5)
    intervals = {**{key: [0.4, 0.6] for key in ablations.FIGURES}, "ap50": None}
    for name in ("default", "elbo"):
        result = {"variant": name, "question": "q", "words": "w", "steps": {"shapes": 1, "scenes": 2}}
        write_json(tmp_path / name / "result.json", {**result, "figures": {**figures, "map50": None}, "intervals": intervals})
    ablations.main(replace(settings, only=("elbo",)))
    table = (tmp_path / "table.md").read_text().splitlines()
    assert len(table) == 4 and table[2].startswith("| q | default: w | 1 + 2 | 0.500 | - | 0.500 (0.400 to 0.600) |")
    assert all(line.count("|") == table[0].count("|") for line in table)
    assert "elbo: w" in capsys.readouterr().out
