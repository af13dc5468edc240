"""A bill of materials (CycloneDX 1.6, JSON) of the package and all it needs, from the metadata of what is installed.

    python tools/bill_of_materials.py --wheel dist/nolbo_ppl-0.2.0-py3-none-any.whl --out dist/nolbo_ppl-0.2.0.cdx.json

Run it with the Python of an environment that holds the wheel and nothing else (`make wheel` does). It tells no time and draws no
random number: the same environment gives the same file.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import uuid
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

NAME = "nolbo-ppl"


def plain(name: str) -> str:
    """A project's name as the index spells it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def reference(found: metadata.Distribution) -> str:
    """Package URL of an installed project."""
    return f"pkg:pypi/{plain(found.name)}@{found.version}"


def needed(found: metadata.Distribution) -> list[str]:
    """Projects it needs in this environment, extras left out."""
    stated = [Requirement(text) for text in found.requires or ()]
    return sorted({plain(one.name) for one in stated if one.marker is None or one.marker.evaluate({"extra": ""})})


def closure(root: str) -> dict[str, metadata.Distribution]:
    """A project and all it needs, by name.

    Raises:
        importlib.metadata.PackageNotFoundError: one of them is not installed.
    """
    found: dict[str, metadata.Distribution] = {}
    waiting = [plain(root)]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name] = metadata.distribution(name)
            waiting += needed(found[name])
    return found


def licence(found: metadata.Distribution) -> list[dict[str, Any]]:
    """Its licence as its metadata states it: an expression, else the classifiers, else the first line of the text."""
    table = found.metadata
    expression = table.get("License-Expression")
    if expression:
        return [{"expression": expression}]
    named = [text.split(" :: ")[-1] for text in table.get_all("Classifier") or () if text.startswith("License :: ")]
    first = (table.get("License") or "").strip().splitlines()[:1]
    return [{"license": {"name": name}} for name in dict.fromkeys(named or first)]


def component(found: metadata.Distribution) -> dict[str, Any]:
    """An installed project as CycloneDX has it."""
    entry: dict[str, Any] = {"type": "library", "bom-ref": reference(found), "name": plain(found.name), "version": found.version}
    entry["purl"] = reference(found)
    stated = licence(found)
    return entry | ({"licenses": stated} if stated else {})


def weights_of(wheel: Path) -> list[dict[str, Any]]:
    """The shipped weights with their hashes."""
    with zipfile.ZipFile(wheel) as archive:
        files = sorted(name for name in archive.namelist() if name.endswith(".safetensors"))
        digests = {name: hashlib.sha256(archive.read(name)).hexdigest() for name in files}
    return [
        {
            "type": "machine-learning-model",
            "bom-ref": name,
            "name": Path(name).parent.name,
            "hashes": [{"alg": "SHA-256", "content": digest}],
        }
        for name, digest in digests.items()
    ]


def bill_of_materials(wheel: Path | None = None) -> dict[str, Any]:
    """The whole file."""
    found = closure(NAME)
    own = component(found[NAME]) | {"type": "application"}
    models: list[dict[str, Any]] = []
    if wheel is not None:
        own["hashes"] = [{"alg": "SHA-256", "content": hashlib.sha256(wheel.read_bytes()).hexdigest()}]
        models = weights_of(wheel)
    rest = [component(found[name]) for name in sorted(found) if name != NAME]
    links = [
        {"ref": reference(found[name]), "dependsOn": sorted(reference(found[other]) for other in needed(found[name]))}
        for name in sorted(found)
    ]
    bill: dict[str, Any] = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": own},
        "components": [*rest, *models],
        "dependencies": links,
    }
    bill["serialNumber"] = f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(bill, sort_keys=True))}"
    return bill


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wheel", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.write_text(json.dumps(bill_of_materials(options.wheel), indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
