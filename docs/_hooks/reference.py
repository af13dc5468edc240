"""Reference pages from docstrings: the public names first, the help of every command, then all modules, a page a package."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "nolbo_ppl"
ANSI = re.compile(r"\x1b\[[0-9;]*m")


def verbs() -> dict[str, str]:
    """The commands and what they do."""
    return importlib.import_module("nolbo_ppl.cli").VERBS


def modules_of(package: Path) -> list[str]:
    """Dotted names of the modules of a package, the package itself first when it holds names of its own."""
    dotted = ".".join(package.relative_to(ROOT).parts)
    names = [f"{dotted}.{path.stem}" for path in sorted(package.glob("*.py")) if not path.stem.startswith("_")]
    if package == PACKAGE:
        names = [name for name in names if name.split(".")[-1] not in {"train", "slam"}]
    return names


def packages() -> list[Path]:
    """The package and all packages below it that hold modules."""
    found = [PACKAGE, *(path.parent for path in sorted(PACKAGE.rglob("__init__.py")) if path.parent != PACKAGE)]
    return [package for package in found if modules_of(package)]


def package_page(package: Path) -> str:
    """The page of a package: its docstring, then every module."""
    dotted = ".".join(package.relative_to(ROOT).parts)
    about = ast.get_docstring(ast.parse((package / "__init__.py").read_text(encoding="utf-8"))) or ""
    parts = [f"# {dotted}", about, *(f"::: {name}" for name in modules_of(package))]
    return "\n\n".join(part for part in parts if part) + "\n"


def command_page() -> str:
    """The help of every command."""
    parts = [
        "# Commands",
        "`nolbo VERB [options]`. Every option is also a field of the verb's dataclass, so that a command can be called from "
        "Python: `nolbo_ppl.cli.VERB` holds the dataclass and `run`.",
    ]
    for verb, about in verbs().items():
        parts += [f"## nolbo {verb}", about[:1].upper() + about[1:] + ".", f"```text\n{help_of(verb)}\n```"]
    return "\n\n".join(parts) + "\n"


def help_of(verb: str) -> str:
    """What `nolbo VERB --help` prints."""
    import contextlib
    import io
    import os

    main = importlib.import_module(f"nolbo_ppl.cli.{verb}").main
    out, columns = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "100"
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            main(["--help"])
    finally:
        if columns is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = columns
    lines = [line.rstrip() for line in ANSI.sub("", out.getvalue()).strip().splitlines()]
    return "\n".join(lines)


def public_page() -> str:
    """The public names, in the order of `nolbo_ppl.PUBLIC`."""
    parts = [
        "# Public interface",
        "These names are imported from `nolbo_ppl` itself. They stay, and change only with a warning for a release; every other "
        "module is an internal that may change. Each has an example, which the tests run.",
    ]
    for name, place in importlib.import_module("nolbo_ppl").PUBLIC.items():
        module, _, attribute = place.partition(":")
        identifier = f"nolbo_ppl.{module}.{attribute}" if attribute else "nolbo_ppl.training.trainer.run"
        parts += [f"## nolbo_ppl.{name}", f"::: {identifier}"]
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """Address and text of every page made here."""
    made = {"reference/public.md": public_page(), "reference/commands.md": command_page()}
    for package in packages():
        name = "_".join(package.relative_to(ROOT).parts[1:]) or "nolbo_ppl"
        made[f"reference/{name}.md"] = package_page(package)
    return made


def on_config(config: Any, **_: Any) -> Any:
    """Fill the Reference section of the navigation."""
    internals: list[dict[str, str]] = []
    for package in packages():
        name = "_".join(package.relative_to(ROOT).parts[1:]) or "nolbo_ppl"
        internals.append({".".join(package.relative_to(ROOT).parts): f"reference/{name}.md"})
    entries: list[dict[str, Any]] = [
        {"Public interface": "reference/public.md"},
        {"Commands": "reference/commands.md"},
        {"Internals (may change)": internals},
    ]
    for section in config.nav:
        if "Reference" in section:
            section["Reference"] = entries
    return config


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Add the pages."""
    for address, text in pages().items():
        files.append(File.generated(config, address, content=text))
    return files
