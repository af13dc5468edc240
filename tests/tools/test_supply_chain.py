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
import bill_of_materials as bom
from lower_bounds import lower_bounds

ROOT = Path(__file__).resolve().parents[2]


def test_lower_bounds_are_those_of_the_project(tmp_path: Path) -> None:
    found = lower_bounds(ROOT / "pyproject.toml", ("detector",))
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
