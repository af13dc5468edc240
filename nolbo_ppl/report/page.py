"""The page around the sections: one file with its style and script inside, and nothing loaded from anywhere."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.io.run_folder import RunFolder, read_run
from nolbo_ppl.report.headline import headline, warnings
from nolbo_ppl.report.sections import SECTIONS
from nolbo_ppl.report.svg import element, escape

ASSETS = Path(__file__).parent / "assets"
"""Style sheet and script."""
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
"""The browser itself refuses every address."""

VIEWS = element(
    "dialog",
    element("div", "", class_="sheet")
    + element(
        "form",
        element("button", "To its card", value="card", data_to_card="")
        + element("button", "Close", value="close", data_close=""),
        method="dialog",
        class_="foot",
    ),
    id="views",
    aria_label="Views of a landmark",
)
"""Where all the views of a landmark are shown."""


def build_page(run: RunFolder, title: str | None = None) -> str:
    """The report as HTML."""
    title = run.path.resolve().name if title is None else title
    parts, links = [], []
    for anchor, name, make in SECTIONS:
        body = make(run)
        if body:
            links.append(element("a", escape(name), href=f"#{anchor}"))
            parts.append(element("section", element("h2", escape(name)) + body, id=anchor))
    style, script = ((ASSETS / name).read_text(encoding="utf-8") for name in ("report.css", "report.js"))
    switch = element("button", "Light / dark", type="button", data_theme_switch="", class_="switch")
    kicker = element("p", "Report of a run", class_="kicker")
    header = element("header", kicker + element("h1", escape(title)) + headline(run) + warnings(run))
    conventions = "Lengths in m, angles as stated. Poses are T_world_camera; camera x right, y down, z forward."
    frame_note = element("p", conventions, class_="note")
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            element("title", escape(f"{title} – nolbo")),
            f"<style>{style}</style>",
            "</head>",
            "<body>",
            element("nav", "".join(links) + switch),
            element("main", header + "".join(parts) + frame_note),
            element("div", "", id="tip", role="status", hidden="hidden"),
            VIEWS,
            f"<script>{script}</script>",
            "</body>",
            "</html>",
            "",
        ]
    )


def write_report(
    run_dir: str | PathLike[str],
    *,
    odometry: str | PathLike[str] | None = None,
    observations: str | PathLike[str] | None = None,
    truth: str | PathLike[str] | None = None,
    out: str | PathLike[str] | None = None,
    title: str | None = None,
) -> Path:
    """Write `report.html` of a folder of `nolbo run` or `nolbo slam`, atomically; returns its path.

    Args:
        run_dir: the folder; whatever it lacks is left out of the report.
        odometry: trajectory before the correction, where the folder has no `odometry.txt`.
        observations: what SLAM was given, where the folder has no `observations.jsonl`.
        truth: true trajectory, where the folder has no `truth.txt`.
        out: the file; `report.html` in the folder by default.
        title: heading; the name of the folder by default.

    Raises:
        InputError: no result in the folder, or a file that is malformed or does not match.
    """
    run = read_run(run_dir, odometry=odometry, observations=observations, truth=truth)
    page = build_page(run, title)
    path = run.path / "report.html" if out is None else Path(out)
    with atomic_path(path) as temporary:
        temporary.write_bytes(page.encode("utf-8", "replace"))  # an id may hold half a surrogate pair
    return path
