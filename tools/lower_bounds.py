"""Constraints that pin every dependency to the lowest version pyproject.toml allows: `python tools/lower_bounds.py > FILE`.

`make test-lowest` installs under them, so that a bound that is too low is found by a test and not by a user.
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from pathlib import Path

NAMED = re.compile(r"^([A-Za-z0-9._-]+)(?:\[[^\]]*\])?>=([0-9][A-Za-z0-9.]*)$")


def lower_bounds(project: Path, extras: tuple[str, ...] = ()) -> dict[str, str]:
    """Name and least version of the dependencies of a pyproject.toml, and of those of some extras.

    Raises:
        ValueError: a dependency states no lower bound.
    """
    table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    stated = [*table["dependencies"], *(item for extra in extras for item in table["optional-dependencies"][extra])]
    found: dict[str, str] = {}
    for text in stated:
        plain = text.partition(";")[0].replace(" ", "")
        if plain.startswith(f"{table['name']}["):  # an extra of its own
            continue
        matched = NAMED.match(plain)
        if matched is None:
            raise ValueError(f"{text!r} states no lower bound")
        found[matched[1].lower()] = matched[2]
    return found


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--project", type=Path, default=Path("pyproject.toml"))
    parser.add_argument("--extras", nargs="*", default=[])
    parser.add_argument("--without", nargs="*", default=[], help="names that stay free")
    options = parser.parse_args()
    bounds = lower_bounds(options.project, tuple(options.extras))
    sys.stdout.write("".join(f"{name}=={version}\n" for name, version in bounds.items() if name not in options.without))


if __name__ == "__main__":
    main()
