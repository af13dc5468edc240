"""Known vulnerabilities of the packages of an environment: `python tools/audit.py --path SITE_PACKAGES` (`make audit`).

Every package there but this one is asked for by name and version (without local parts, `2.9.0` for `2.9.0+cpu`) at the advisory
services that pip-audit knows, the first that answers. Ends with 0 where nothing is known or all of it is excepted below, 1 with a
list of what is known, 3 where no service answers: then nothing was audited.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

OWN = "nolbo-ppl"
SERVICES = ("pypi", "osv")
"""Advisory services, in the order they are asked."""
EXCEPTIONS: Mapping[str, str] = {}
"""Advisories that do not concern this package: identifier and why."""


def pinned(site_packages: Path) -> list[str]:
    """`name==version` of every package of an environment but our own, local parts of versions left out."""
    found = metadata.distributions(path=[str(site_packages)])
    lines = {(d.name.lower().replace("_", "-"), d.version.partition("+")[0]) for d in found}
    return [f"{name}=={version}" for name, version in sorted(lines) if name != OWN]


def ask(requirements: list[str], service: str) -> dict[str, Any] | str:
    """The report of one service, or what it said instead."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "requirements.txt"
        file.write_text("".join(line + "\n" for line in requirements), encoding="utf-8")
        command = [sys.executable, "-m", "pip_audit", "--requirement", str(file), "--no-deps", "--disable-pip"]
        command += ["--format", "json", "--progress-spinner", "off", "--vulnerability-service", service]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        report = json.loads(done.stdout)
        return report if isinstance(report, dict) and "dependencies" in report else done.stdout.strip()
    except ValueError:
        return (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1]


def judge(report: Mapping[str, Any], exceptions: Mapping[str, str] = EXCEPTIONS) -> tuple[list[str], list[str]]:
    """What is known of the packages of a report, in a line each, and what is told besides: exceptions, packages not found."""
    known, told = [], []
    for package in report["dependencies"]:
        name = f"{package['name']} {package.get('version', '')}".strip()
        if "skip_reason" in package:
            told.append(f"not audited: {name}: {package['skip_reason']}")
        for advisory in package.get("vulns", ()):
            names = {advisory["id"], *advisory.get("aliases", ())}
            excepted = sorted(names & set(exceptions))
            fixed = ", ".join(advisory.get("fix_versions", ())) or "no version"
            if excepted:
                told.append(f"excepted: {name}: {excepted[0]}: {exceptions[excepted[0]]}")
            else:
                known.append(f"{name}: {advisory['id']}, mended in {fixed}")
    return known, told


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--path", type=Path, required=True, help="site-packages of the environment")
    options = parser.parse_args()
    requirements = pinned(options.path)
    if not requirements:
        sys.stderr.write(f"audit: no package in {options.path}\n")
        return 2
    answers = []
    for service in SERVICES:
        report = ask(requirements, service)
        if isinstance(report, str):
            answers.append(f"{service}: {report}")
            continue
        audited = sum("skip_reason" not in package for package in report["dependencies"])
        if not audited:  # a mirror of the index without advisories: that nothing is known there says nothing
            answers.append(f"{service}: knows none of {len(requirements)} packages")
            continue
        known, told = judge(report)
        sys.stdout.write("".join(line + "\n" for line in (*told, *known)))
        sys.stdout.write(f"{audited} of {len(requirements)} packages audited at {service}: {len(known)} known vulnerabilities\n")
        return int(bool(known))
    sys.stderr.write("audit: no advisory service answers, nothing was audited\n" + "".join(f"  {one}\n" for one in answers))
    return 3


if __name__ == "__main__":
    sys.exit(main())
