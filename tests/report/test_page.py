"""The report in a browser: opens without a network, no script error, its controls work, any text is only text."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error
from nolbo_ppl.report import build_page, read_run, write_report
from nolbo_ppl.report import page as page_module
from nolbo_ppl.report.sections import SECTIONS
from tests.report.browser import Browser
from tests.report.factory import FRAMES, drive

EVIL = "\"><img src=x onerror=\"throw Error('script ran')\"></script><script>throw Error('script ran')</script>'&amp;"


@pytest.fixture(scope="module")
def report(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(run_folder, out=tmp_path_factory.mktemp("report") / "report.html")


@pytest.fixture(scope="module")
def page(report: Path, browser: Browser) -> Browser:
    browser.open(report.as_uri())
    browser.until("document.documentElement.dataset.ready === 'yes'")
    return browser


def test_the_script_parses() -> None:
    """Where there is no browser, node at least reads it; without either, its brackets are counted outside of texts."""
    script = Path(page_module.ASSETS / "report.js")
    node = shutil.which("node")
    if node is not None:
        done = subprocess.run([node, "--check", str(script)], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr
    plain = re.sub(r"`[^`]*`|\"[^\"\n]*\"|'[^'\n]*'|//[^\n]*", "", script.read_text(encoding="utf-8"))
    for opening, closing in ("()", "[]", "{}"):
        assert plain.count(opening) == plain.count(closing)


def test_the_page_holds_what_the_script_needs(run_folder: Path) -> None:
    """Without a browser: maps with their axes, views with their pictures, nothing that is loaded from elsewhere."""
    html = build_page(read_run(run_folder))
    stated = [json.loads(text.replace("&quot;", '"')) for text in re.findall(r'data-zoom="([^"]*)"', html)]
    assert len(stated) == len(MAPS) and all(a["x"][0] < a["x"][1] and a["box"][0] < a["box"][2] for a in stated)
    assert html.count('class="scene"') == len(MAPS) and html.count("data-to-card") == 2  # the button and the script
    assert html.count('class="views"') == len(read_run(run_folder).landmarks) - 1
    assert not re.search(r"(src|href)=\"(?!data:|#)", html)


def test_the_browser_tells_script_errors(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "bad.html").write_text("<script>console.log('fine')</script><script>missing.call()</script>")
    browser.open((tmp_path / "bad.html").as_uri())
    browser.run("1")
    assert any("missing is not defined" in error for error in browser.errors)


def test_opens_without_script_errors_and_without_a_network(page: Browser, report: Path) -> None:
    assert page.errors == []
    assert [url for url in page.requests if not url.startswith(("data:", report.as_uri()))] == []
    assert page.run("[...document.querySelectorAll('section')].map(x => x.id)") == [anchor for anchor, _, _ in SECTIONS]
    assert page.run("[...document.images].every(x => x.complete && x.naturalWidth > 0)")


def test_nothing_is_wider_than_the_page(page: Browser) -> None:
    assert page.run("document.documentElement.scrollWidth <= document.documentElement.clientWidth")


def test_headline_is_the_error_recomputed(page: Browser, run_folder: Path) -> None:
    run = read_run(run_folder)
    expected = absolute_trajectory_error(run.estimate, drive().truth).rmse
    shown = page.run("document.querySelector('.tile .value').textContent")
    assert float(shown.split()[0]) == pytest.approx(expected, rel=6e-3)
    script = "[...document.querySelectorAll('.tile')].map(x => [x.children[0].textContent, x.children[1].textContent])"
    tiles = dict(page.run(script))
    assert tiles["Keyframes"] == str(FRAMES) and tiles["Detections"] == str(len(drive().observations))
    assert {"Loop precision", "Loop recall", "Landmarks", "ATE after / before", "ATE / oracle"} <= set(tiles)


def test_axes_state_frame_and_unit(page: Browser) -> None:
    labels = page.run("[...document.querySelectorAll('svg text.label')].map(x => x.textContent)")
    assert "world x (right of the first camera), m" in labels and "world z (forward of the first camera), m" in labels
    assert "Position error, m" in labels and "Rotation error, °" in labels and "time since the start, s" in labels


def test_legend_hides_a_layer_in_its_own_figure(page: Browser) -> None:
    layers = "#trajectory [data-layer=odometry], #errors [data-layer=odometry]"
    script = f"[...document.querySelectorAll('{layers}')].map(x => x.classList.contains('off'))"
    assert set(page.run(script)) == {False}
    page.run("document.querySelector('#trajectory [data-toggle=odometry]').click()")
    assert page.run(script) == [True, False, False]
    page.run("document.querySelector('#trajectory [data-toggle=odometry]').click()")
    assert set(page.run(script)) == {False}


def test_slider_moves_trajectory_and_landmarks(page: Browser, run_folder: Path) -> None:
    def state() -> list[str]:
        return page.run(
            "['way', 'dots', 'say'].map(n => { const x = document.querySelector(`[data-em=${n}]`);"
            "return x.getAttribute('points') || x.getAttribute('d') || x.textContent; })"
        )

    last = state()
    page.run("{ const s = document.querySelector('[data-em=slider]'); s.value = 0; s.dispatchEvent(new Event('input')); }")
    first = state()
    assert first[0] != last[0] and "odometry" in first[2] and last[2].startswith("result")
    # The first iteration is the odometry, drawn thin underneath by other code.
    thin = page.run("document.querySelector('#em .faint').getAttribute('points')")
    assert first[0] == thin
    assert page.run("document.querySelector('#em .step.now').dataset.step") == "0"


def test_pointing_at_things_tells_about_them(page: Browser) -> None:
    event = "new PointerEvent('pointermove', {bubbles: true, clientX: 50, clientY: 50})"
    page.run(f"document.querySelector('#map [data-card] circle').dispatchEvent({event})")
    assert re.match(r"L\d+ – \w+.*\nexistence 1.000", page.run("document.getElementById('tip').innerText"))
    page.run("document.querySelector('#map [data-card=\"3\"]').dispatchEvent(new MouseEvent('click', {bubbles: true}))")
    assert page.run("document.querySelector('.card.lit').id") == "card-3"
    page.run("document.getElementById('views').close()")


def test_a_click_on_a_landmark_shows_all_its_views(page: Browser, run_folder: Path) -> None:
    first = read_run(run_folder).landmarks[0].name
    page.run("document.querySelector('#map [data-card=\"0\"]').dispatchEvent(new MouseEvent('click', {bubbles: true}))")
    assert page.run("document.getElementById('views').open")
    assert page.run("document.querySelector('#views h3').innerText").startswith(first)
    captions = page.run("[...document.querySelectorAll('#views figcaption')].map(x => x.textContent)")
    assert captions == ["frame 0", "frame 2, weight 0.50", "frame 4"]
    assert page.run("document.querySelector('#views summary').textContent") == "3 of 7 views"
    assert page.run("[...document.querySelectorAll('#views img')].every(x => x.src.startsWith('data:image/jpeg'))")
    page.run("document.querySelector('#views [data-close]').click()")
    assert not page.run("document.getElementById('views').open")
    # Without views, the card is what there is.
    last = len(read_run(run_folder).landmarks) - 1
    page.run(f"document.querySelector('#map [data-card=\"{last}\"]').dispatchEvent(new MouseEvent('click', {{bubbles: true}}))")
    assert not page.run("document.getElementById('views').open")
    assert page.run("document.querySelector('.card.lit').id") == f"card-{last}"


MAPS = ("trajectory", "map", "loops", "em")


@pytest.mark.parametrize("section", MAPS)
def test_maps_zoom_and_move_with_their_axes(page: Browser, section: str) -> None:
    """A place of the map keeps its coordinates: what the axes say of a landmark or a line is the same at any zoom."""
    script = f"""(() => {{
      const map = document.querySelector('#{section} svg[data-zoom]'), scene = map.querySelector('.scene');
      const line = scene.querySelector('polyline').points[0], state = JSON.parse(map.dataset.zoom);
      const at = new DOMPoint(line.x, line.y).matrixTransform(scene.transform.baseVal.consolidate()?.matrix || new DOMMatrix());
      const ticks = [...map.querySelectorAll('.frame text:not(.label)')];
      const across = ticks.filter(t => t.getAttribute('text-anchor') === 'middle');
      const read = t => [Number(t.getAttribute('x')), Number(t.textContent)];
      const [a, b] = [read(across[0]), read(across[across.length - 1])];
      return {{x: a[1] + (at.x - a[0]) / (b[0] - a[0]) * (b[1] - a[1]), span: Math.abs(b[1] - a[1]), ticks: across.length,
               true: state.x[0] + (line.x - state.box[0]) / (state.box[2] - state.box[0]) * (state.x[1] - state.x[0])}}; }})()"""
    rest = page.run(script)
    assert rest["x"] == pytest.approx(rest["true"], abs=1e-3)
    button = f"document.querySelectorAll('#{section} .zoom button')"
    page.run(f"{button}[0].click(); {button}[0].click(); {button}[0].click()")
    near = page.run(script)
    assert near["x"] == pytest.approx(rest["true"], abs=1e-2) and near["span"] < 0.5 * rest["span"] and near["ticks"] >= 2
    move = (
        f"(() => {{ const map = document.querySelector('#{section} svg[data-zoom]'), b = map.getBoundingClientRect();"
        "const at = (type, dx) => new PointerEvent(type, {bubbles: true, button: 0, pointerId: 1, clientX: b.left + 300 + dx,"
        " clientY: b.top + 150});"
        "map.dispatchEvent(at('pointerdown', 0)); map.dispatchEvent(at('pointermove', 40));"
        "map.dispatchEvent(at('pointerup', 40));"
        "return map.querySelector('.scene').getAttribute('transform'); })()"
    )
    before = page.run(f"document.querySelector('#{section} .scene').getAttribute('transform')")
    after = page.run(move)
    assert after != before and page.run(script)["x"] == pytest.approx(rest["true"], abs=1e-2)
    page.run(f"{button}[2].click()")
    home = page.run(script)
    assert home["x"] == pytest.approx(rest["true"], abs=1e-3) and home["span"] == pytest.approx(rest["span"])
    assert page.errors == []


def test_dots_keep_their_size_and_a_drag_is_no_click(page: Browser) -> None:
    radius = "document.querySelector('#map .scene circle').getBoundingClientRect().width"
    before = page.run(radius)
    page.run("document.querySelectorAll('#map .zoom button')[0].click()")
    assert page.run(radius) == pytest.approx(before, rel=0.05)
    page.run(
        "(() => { const dot = document.querySelector('#map [data-card=\"1\"] circle'), b = dot.getBoundingClientRect();"
        "const at = (kind, type, dx) => new kind(type, {bubbles: true, button: 0, pointerId: 1, clientX: b.left + dx,"
        " clientY: b.top});"
        "dot.dispatchEvent(at(PointerEvent, 'pointerdown', 0)); dot.dispatchEvent(at(PointerEvent, 'pointermove', 30));"
        "dot.dispatchEvent(at(PointerEvent, 'pointerup', 30)); dot.dispatchEvent(at(MouseEvent, 'click', 30)); })()"
    )
    assert not page.run("document.getElementById('views').open")
    page.run("document.querySelectorAll('#map .zoom button')[2].click()")


def test_heat_map_tells_the_weights_of_the_file(page: Browser, run_folder: Path) -> None:
    found = read_run(run_folder).associations
    assert found is not None
    script = """(() => { const x = document.querySelector('.heat'), b = x.getBoundingClientRect(), out = [];
      for (let r = 0; r < x.naturalHeight; r++) for (let c = 0; c < x.naturalWidth; c++) {
        x.dispatchEvent(new PointerEvent('pointermove', {bubbles: true,
          clientX: b.left + (c + .5) / x.naturalWidth * b.width, clientY: b.top + (r + .5) / x.naturalHeight * b.height}));
        out.push(document.getElementById('tip').textContent); } return out; })()"""
    page.run("document.querySelector('.heat').scrollIntoView()")
    names = [x.name for x in read_run(run_folder).landmarks]
    told = np.zeros((len(names), len(found)))
    for text in page.run(script):
        name, k, weight = re.fullmatch(r"(.+)\ndetection (\d+), frame \d+\nweight ([\d.]+)", text).groups()  # type: ignore[union-attr]
        if name in names:
            told[names.index(name), int(k)] = float(weight)
    expected = np.zeros_like(told)
    expected[found.landmark, found.row] = found.weight
    np.testing.assert_allclose(told, expected, atol=0.0101)


def test_cards_sort_and_filter(page: Browser) -> None:
    def choose(what: str, value: str) -> None:
        page.run(
            f"{{ const s = document.querySelector('[data-{what}]'); s.value = '{value}'; s.dispatchEvent(new Event('change')); }}"
        )

    choose("sort", "spread")
    spread = page.run("[...document.querySelectorAll('.card')].map(x => Number(x.dataset.spread))")
    assert spread == sorted(spread, reverse=True) and len(spread) >= 6
    choose("filter", "0")
    assert set(page.run("[...document.querySelectorAll('.card:not(.off)')].map(x => x.dataset.category)")) == {"0"}
    choose("filter", "all")
    assert page.run("document.querySelectorAll('.card.off').length") == 0
    pictures = page.run("document.querySelectorAll('.card .pictures img').length")
    assert pictures == 3 * len(spread) - 2  # one has no decoded shape


def test_theme_switch_changes_the_colours(page: Browser) -> None:
    colour = "getComputedStyle(document.body).backgroundColor"
    before = page.run(colour)
    page.run("document.querySelector('[data-theme-switch]').click()")
    assert page.run(colour) != before
    page.run("document.querySelector('[data-theme-switch]').click()")
    assert page.run(colour) == before and page.errors == []


def test_any_text_is_only_text(run_folder: Path, browser: Browser, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    text = json.dumps(EVIL)[1:-1]
    for name in ("landmarks.json", "associations.jsonl", "summary.json"):
        path = folder / "slam" / name
        path.write_text(path.read_text().replace('"L0"', f'"{text}"').replace('"car"', f'"{text}car"'))
    rows = read_json(folder / "slam" / "landmarks.json")
    rows[1]["name"] = "half \ud800 a pair"
    write_json(folder / "slam" / "landmarks.json", rows)
    for path in (folder / "observations.jsonl", folder / "slam" / "associations.jsonl", folder / "objects.json"):
        path.write_text(path.read_text().replace("000003-", f"{text}-"))
    write_json(
        folder / "run.json", {"command": [EVIL], "configuration": {EVIL: EVIL}, "versions": {EVIL: EVIL}, "complete": [EVIL]}
    )
    write_json(folder / "summary.json", {EVIL: {EVIL: 1.0}, "warnings": [EVIL]})
    browser.open(write_report(folder, title=EVIL).as_uri())
    browser.until("document.documentElement.dataset.ready === 'yes'")
    assert browser.errors == []
    assert browser.run("document.querySelector('h1').textContent") == EVIL
    assert browser.run("document.scripts.length") == 2  # the data of EM and the page's own
    assert EVIL in browser.run("[...document.querySelectorAll('.card b')].map(x => x.textContent)")
    assert browser.run("document.querySelector('.warnings li').textContent") == EVIL


def test_slam_folder_alone_gives_a_report(run_folder: Path, browser: Browser, tmp_path: Path) -> None:
    folder = tmp_path / "slam"
    shutil.copytree(run_folder / "slam", folder)
    for name in ("iterations.npz", "landmarks_voxels.npz"):
        (folder / name).unlink()
    browser.open(write_report(folder).as_uri())
    browser.until("document.documentElement.dataset.ready === 'yes'")
    assert browser.errors == []
    sections = browser.run("[...document.querySelectorAll('section')].map(x => x.id)")
    assert sections == ["trajectory", "map", "loops", "association", "landmarks", "calibration", "em", "figures", "how"]
    assert browser.run("document.querySelector('.tile .name').textContent") == "ATE"  # from the summary
    # With its inputs named, nothing is missing.
    inputs = {name: run_folder / f"{name}.txt" for name in ("odometry", "truth")}
    run = read_run(folder, observations=run_folder / "observations.jsonl", **inputs)
    assert 'id="errors"' in build_page(run) and "returns to" in build_page(run)


@pytest.mark.parametrize("missing", ["landmarks.json", "associations.jsonl", "summary.json", "map.png"])
def test_every_part_is_optional(run_folder: Path, tmp_path: Path, missing: str) -> None:
    shutil.copytree(run_folder / "slam", tmp_path / "slam")
    (tmp_path / "slam" / missing).unlink()
    assert write_report(tmp_path / "slam").stat().st_size > 20_000


def test_folder_without_a_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no result of a run"):
        write_report(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        write_report(tmp_path / "nowhere")
    assert list(tmp_path.iterdir()) == []
