"""`nolbo report`: a file is written, what is no run is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from nolbo_ppl.cli.report import main
from nolbo_ppl.errors import InputError
from tests.report.factory import make_slam


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    make_slam(out)
    return out


def test_writes_the_report_into_the_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(folder)])
    assert capsys.readouterr().out == f"{folder / 'report.html'}\n"
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>") and page.rstrip().endswith("</html>")
    assert "http://" not in page.replace("http://www.w3.org/", "") and "https://" not in page
    assert list(folder.glob(".report*")) == []


def test_options_name_what_the_folder_lacks(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    inputs = ["--odometry", str(folder / "odometry.txt"), "--truth", str(folder / "truth.txt")]
    inputs += ["--observations", str(folder / "observations.jsonl")]
    main([str(folder / "slam"), "--out", str(out), "--title", "two & two", *inputs])
    page = out.read_text(encoding="utf-8")
    assert "<h1>two &amp; two</h1>" in page and 'id="errors"' in page and "returns to" in page
    assert not (folder / "slam" / "report.html").exists()


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no result of a run"):
        main([str(tmp_path)])
