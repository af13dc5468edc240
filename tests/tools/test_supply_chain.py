"""The bill of materials and the constraints of lowest versions, from the project's own metadata."""

from __future__ import annotations

import hashlib
import json
import re
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))
import audit
import bill_of_materials as bom
from lower_bounds import lower_bounds

ROOT = Path(__file__).resolve().parents[2]


def test_lower_bounds_are_those_of_the_project(tmp_path: Path) -> None:
    found = lower_bounds(ROOT / "pyproject.toml", ("onnx",))
    for text in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]:
        stated = Requirement(text)
        assert str(stated.specifier) == f">={found.pop(stated.name.lower())}"
    assert "onnx" in found and "ruff" not in found
    file = tmp_path / "pyproject.toml"
    file.write_text('[project]\nname = "x"\ndependencies = ["a>=1.0", "b[c] >= 2", "x[d]"]\n')
    assert lower_bounds(file) == {"a": "1.0", "b": "2"}
    file.write_text('[project]\nname = "x"\ndependencies = ["a==1.0"]\n')
    with pytest.raises(ValueError, match="states no lower bound"):
        lower_bounds(file)


def test_the_bill_names_all_that_is_needed_and_the_weights(tmp_path: Path) -> None:
    wheel = tmp_path / "x.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("nolbo_ppl/weights/one/model.safetensors", b"weights")
        archive.writestr("nolbo_ppl/__init__.py", b"")
    bill = bom.bill_of_materials(wheel)
    assert bill == bom.bill_of_materials(wheel)
    json.dumps(bill)
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    assert re.fullmatch(r"urn:uuid:[0-9a-f-]{36}", bill["serialNumber"])
    own = bill["metadata"]["component"]
    assert own["hashes"][0]["content"] == hashlib.sha256(wheel.read_bytes()).hexdigest()
    assert own["purl"] == f"pkg:pypi/nolbo-ppl@{metadata.version('nolbo-ppl')}"
    libraries = {entry["name"]: entry for entry in bill["components"] if entry["type"] == "library"}
    # What dependencies need is there too, with what is installed; what only the tests need is not.
    assert {"torch", "numpy", "gtsam", "mpmath", "networkx"} <= set(libraries) and "ruff" not in libraries
    for name in ("torch", "numpy", "mpmath"):
        assert libraries[name]["version"] == metadata.version(name)
    models = [entry for entry in bill["components"] if entry["type"] == "machine-learning-model"]
    assert models[0]["name"] == "one" and models[0]["hashes"][0]["content"] == hashlib.sha256(b"weights").hexdigest()
    known = {own["bom-ref"], *(entry["bom-ref"] for entry in bill["components"])}
    for link in bill["dependencies"]:
        assert {link["ref"], *link["dependsOn"]} <= known
    direct = next(link for link in bill["dependencies"] if link["ref"] == own["bom-ref"])["dependsOn"]
    assert len(direct) == len([text for text in metadata.requires("nolbo-ppl") or () if "extra" not in text])


def test_shapes_are_text() -> None:
    """jaxtyping 0.3.0, the lowest version allowed, knows no bare ellipsis."""
    bare = re.compile(r"\b(?:Float|Int|Bool|UInt8|Shaped|Num)\[[^\[\]\"]*, \.\.\.\]")
    assert bare.search("Float[np.ndarray, ...]") and not bare.search('Float[np.ndarray, "..."]')
    files = sorted((ROOT / "nolbo_ppl").rglob("*.py"))
    assert len(files) > 100
    assert [str(file) for file in files if bare.search(file.read_text(encoding="utf-8"))] == []


def test_what_an_advisory_service_knows_is_told_by_name() -> None:
    advisory = {"id": "PYSEC-1", "aliases": ["CVE-2"], "fix_versions": ["1.1", "2.0"]}
    report = {
        "dependencies": [
            {"name": "a", "version": "1.0", "vulns": [advisory, {"id": "PYSEC-3", "fix_versions": []}]},
            {"name": "b", "version": "2.0", "vulns": []},
            {"name": "c", "skip_reason": "not on the index"},
        ]
    }
    known, told = audit.judge(report)
    assert known == ["a 1.0: PYSEC-1, mended in 1.1, 2.0", "a 1.0: PYSEC-3, mended in no version"]
    assert told == ["not audited: c: not on the index"]
    known, told = audit.judge(report, {"CVE-2": "the function is not called"})
    assert len(known) == 1 and "excepted: a 1.0: CVE-2: the function is not called" in told


def test_packages_of_an_environment_are_asked_for_without_local_versions(tmp_path: Path) -> None:
    for name, version in (("torch", "2.9.0+cpu"), ("A_b", "1.0"), ("nolbo-ppl", "0.2.0")):
        folder = tmp_path / f"{name}-{version}.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    assert audit.pinned(tmp_path) == ["a-b==1.0", "torch==2.9.0"]


@pytest.mark.parametrize(
    ("answers", "status", "said"),
    [
        (["no route", "no route"], 3, "nothing was audited"),
        (
            ["no route", {"dependencies": [{"name": "a", "version": "1", "vulns": []}]}],
            0,
            "1 of 1 packages audited at osv: 0 known",
        ),
        ([{"dependencies": [{"name": "a", "skip_reason": "not there"}]}, "no route"], 3, "pypi: knows none of 1 packages"),
        ([{"dependencies": [{"name": "a", "version": "1", "vulns": [{"id": "X"}]}]}], 1, "a 1: X, mended in no version"),
    ],
)
def test_the_audit_asks_one_service_after_another(
    answers: list[object],
    status: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "a-1.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: a\nVersion: 1\n")
    waiting = list(answers)
    monkeypatch.setattr(audit, "ask", lambda *_: waiting.pop(0))
    monkeypatch.setattr(sys, "argv", ["audit.py", "--path", str(tmp_path)])
    assert audit.main() == status and not waiting
    out, error = capsys.readouterr()
    assert said in out + error
    monkeypatch.setattr(sys, "argv", ["audit.py", "--path", str(tmp_path / "none")])
    assert audit.main() == 2
