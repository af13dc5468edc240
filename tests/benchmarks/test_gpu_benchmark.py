"""`benchmarks/gpu.py` runs on the CPU with the code of a GPU, and sees networks that differ."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

FILE = Path(__file__).resolve().parents[2] / "benchmarks" / "gpu.py"


@pytest.fixture(scope="module")
def gpu() -> ModuleType:
    spec = importlib.util.spec_from_file_location("gpu_benchmark", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def _float32() -> None:
    torch.set_default_dtype(torch.float32)


def test_it_runs_on_the_cpu(gpu: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = gpu.main(gpu.Settings(tmp_path / "gpu.json", "cpu", presets=("nano",), quick=True))
    assert json.loads((tmp_path / "gpu.json").read_text())["rows"] == figures["rows"]
    kinds = [row["what"] for row in figures["rows"]]
    assert kinds == ["training step", "observe", "observe 4 boxes"]
    assert all(row["seconds"] > 0 and row["repetitions"] >= 2 for row in figures["rows"]) and figures["rows"][0]["memory_gb"] > 0
    assert figures["equality"][0]["equal"] and 0 < figures["equality"][0]["terms"] < 1e-3 and "nano" in capsys.readouterr().out


def test_it_sees_a_difference(gpu: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    original, calls = gpu.fresh, []

    def other(name: str, config: object) -> torch.nn.Module:
        model = original(name, config)
        calls.append(name)
        if len(calls) > 2:  # the second device's networks
            with torch.no_grad():
                model.guide.head.objectness.bias += 1.0
        return model

    monkeypatch.setattr(gpu, "fresh", other)
    assert not gpu.compare("nano", 64, torch.device("cpu"))["equal"]
