"""Links that leave docs/ work on the site as they do in the repository: to tutorials, or to the file's own text."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\[([^\]\n]*)\]\(([^)\s]+?)(#[^)\s]*)?\)")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Point links at notebooks to their pages; other files of the repository are named, not linked."""
    folder = Path(page.file.src_uri).parent
    source = ROOT / "notebooks" if folder == Path("tutorials") else ROOT / "docs" / folder  # where the text was written

    def rewrite(match: re.Match[str]) -> str:
        text, target, anchor = match[1], match[2], match[3] or ""
        if "://" in target or target.startswith("#"):
            return match[0]
        path = Path(os.path.normpath(source / target))
        if path.is_relative_to(ROOT / "docs") or not path.exists():
            return match[0]
        path = path.relative_to(ROOT)
        if path.parts[0] == "notebooks" and path.suffix == ".py":
            return f"[{text}]({os.path.relpath(f'tutorials/{path.stem}.md', folder)}{anchor})"
        return f"{text} (`{path}`)" if text != str(path) else f"`{path}`"

    return LINK.sub(rewrite, markdown)
