"""Tutorial pages from the notebooks: text, code, and what each cell showed when it was run.

Notebooks are executed once for a text and for the shipped weights; what they showed is kept in build/notebooks. With
NOLBO_DOCS_EXECUTE=0 they are not executed: pages hold text and code alone.
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
ORDER = (
    "posterior_of_a_scene",
    "latent_space",
    "shape_from_many_views",
    "em_step_by_step",
    "slam_on_a_drive",
)
"""Tutorials in the order of the navigation; others follow by name."""
HIDDEN = re.compile(r"^(# *)?%.*\n?", re.MULTILINE)


def notebooks() -> list[Path]:
    """All notebooks, in the order of the navigation."""
    found = {path.stem: path for path in sorted((ROOT / "notebooks").glob("*.py"))}
    return [found.pop(name) for name in ORDER if name in found] + list(found.values())


def title_of(path: Path) -> str:
    """The notebook's first heading."""
    match = re.search(r"^# # (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return match[1] if match else path.stem


def executed(path: Path) -> Any:
    """The notebook with its outputs, from the store when neither text nor weights have changed."""
    notebook = jupytext.read(path)
    if os.environ.get("NOLBO_DOCS_EXECUTE") == "0":
        return notebook
    digest = hashlib.sha256(path.read_bytes())
    for weights in sorted((ROOT / "nolbo_ppl" / "weights").rglob("*.safetensors")):
        digest.update(weights.read_bytes())
    kept = ROOT / "build" / "notebooks" / f"{path.stem}-{digest.hexdigest()[:16]}.ipynb"
    if kept.is_file():
        return nbformat.read(kept, as_version=4)
    from nbclient import NotebookClient

    os.environ.setdefault("OMP_NUM_THREADS", "1")  # spinning OpenMP threads slow each other down
    os.environ.setdefault("PYTHONWARNINGS", "ignore:IProgress not found")  # tqdm's, for want of widgets
    resources = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=1200, kernel_name="python3", resources=resources).execute()
    kept.parent.mkdir(parents=True, exist_ok=True)
    temporary = kept.with_suffix(".tmp")
    nbformat.write(notebook, temporary)
    os.replace(temporary, kept)
    return notebook


def page(path: Path) -> tuple[str, dict[str, bytes]]:
    """Markdown of a notebook, and its pictures by name."""
    parts, pictures = [], {}
    for cell in executed(path).cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source.replace("](../docs/", "](../"))
            continue
        source = HIDDEN.sub("", cell.source).strip()
        if source:
            parts.append(f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}-{len(pictures)}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                parts.append(f"![]({name})")
            elif output.get("name") == "stdout":
                parts.append(f"```text\n{output['text'].rstrip()}\n```")
            elif "text/plain" in data:
                parts.append(f"```text\n{data['text/plain'].rstrip()}\n```")
    note = f"*This page is the notebook `notebooks/{path.name}`, run on the shipped weights.*"
    return "\n\n".join([*parts[:1], note, *parts[1:]]) + "\n", pictures


def on_config(config: Any, **_: Any) -> Any:
    """Fill the Tutorials section of the navigation."""
    for section in config.nav:
        if "Tutorials" in section:
            section["Tutorials"] = [{title_of(path): f"tutorials/{path.stem}.md"} for path in notebooks()]
    return config


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Add the pages and their pictures."""
    for path in notebooks():
        text, pictures = page(path)
        files.append(File.generated(config, f"tutorials/{path.stem}.md", content=text))
        for name, picture in pictures.items():
            files.append(File.generated(config, f"tutorials/{name}", content=picture))
    return files
