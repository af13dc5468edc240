"""`nolbo reproduce`: every table from nothing at the smallest budget, and what it refuses."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from nolbo_ppl.cli import main
from nolbo_ppl.cli.reproduce import TARGETS, run
from nolbo_ppl.data.simulated_paths import figure_of_eight
from nolbo_ppl.errors import InputError
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory
from nolbo_ppl.reproduction.budgets import ReproduceConfig
from nolbo_ppl.reproduction.paper_numbers import ATE


@pytest.fixture(autouse=True)
def _single_precision(_float64: None) -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_default_dtype(torch.float32)
    yield
    torch.set_num_threads(threads)


def cells(path: Path) -> dict[tuple[str, str], str]:
    rows = list(csv.reader(path.open(encoding="utf-8")))
    return {(row[0], row[1]): row[2] for row in rows[1:]}


@pytest.mark.slow
def test_tables_from_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two networks trained once serve every table of objects; SLAM on a path of a folder; the paper's numbers beside ours."""
    pytest.importorskip("sklearn")
    out = tmp_path / "out"
    options = ["--out", str(out), "--budget", "smoke", "--networks", "multi16", "ae16", "--threads", "1"]
    for target in ("pr", "tsne", "table1", "mle"):
        main(["reproduce", target, *options])
        assert capsys.readouterr().out == (out / f"{target}.md").read_text(encoding="utf-8")
        assert json.loads((out / f"{target}.json").read_text())["budget"] == "smoke"
    assert (out / "pr.png").stat().st_size > 1000 and (out / "tsne.png").stat().st_size > 1000
    assert {name for name, _ in cells(out / "pr.csv")} == {"NOLBOMulti16", "AE16"}
    assert 0 <= float(cells(out / "pr.csv")[("AE16", "AP")]) <= 1
    assert cells(out / "table1.csv")[("NOLBO, the paper", "car")] in ("0.96", "8.6")
    (tmp_path / "data" / "poses").mkdir(parents=True)
    write_trajectory(tmp_path / "data" / "poses" / "06.txt", Trajectory(figure_of_eight(60, 1, 30.0)))
    main(["reproduce", "table2", *options, "--data", str(tmp_path / "data"), "--networks", "ae16"])
    found = cells(out / "table2.csv")
    assert {name for name, _ in found} == {"AE16", "VO"}
    assert float(found[("VO", "paper: ATE")]) == ATE["vo"] and float(found[("VO", "ATE over VO")]) == 1.0
    before = (out / "slam" / "smoke" / "06-ae16-0-0.json").stat().st_mtime_ns
    run("table2", ReproduceConfig(out, data=str(tmp_path / "data"), budget="smoke", networks=("ae16",), threads=1))
    assert (out / "slam" / "smoke" / "06-ae16-0-0.json").stat().st_mtime_ns == before  # kept, not computed again


def test_what_cannot_be_reproduced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        ([], "nothing to reproduce"),
        (["table3", "--out", str(tmp_path)], "nothing to reproduce of that name"),
        (["mle", "--out", str(tmp_path / "a"), "--data", str(tmp_path)], "no archive of shapes"),
        (["table2", "--out", str(tmp_path / "a"), "--data", str(tmp_path)], "no paths"),
        (["table1", "--out", str(tmp_path / "a"), "--data", str(tmp_path)], "no labelled scenes"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["reproduce", *arguments])
        assert stopped.value.code == 2 and message in capsys.readouterr().err
    with pytest.raises(InputError, match="nothing to reproduce of that name"):
        run("figure1", ReproduceConfig(tmp_path))
    with pytest.raises(SystemExit):
        main(["reproduce", "--help"])
    text = capsys.readouterr().out
    assert all(name in text for name in TARGETS)
