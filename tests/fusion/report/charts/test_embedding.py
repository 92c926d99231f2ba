"""Charts in a page: found by screen readers, drawn when needed, their data saved as CSV, whole on paper; without any network."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from fusion.report.charts.embedding import chart_scripts, embed
from fusion.report.charts.style import Chart, new_figure

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def small_chart() -> Chart:
    drawn = new_figure(x="position / mm", y="drift / µm", height=200)
    drawn.line([0.0, 10.0], [1.5, -2.0])
    columns = {"position / mm": np.array([0.0, 10.0]), "name": ["=1+1", "a, b"], "drift / µm": [1.5, np.nan]}
    return Chart(drawn, 'Falls from 1.5 to −2.0 µm over "10" mm.', columns)


def test_an_embedded_chart_carries_its_document_and_its_columns() -> None:
    embedded = embed({"small": small_chart()})["small"]
    assert (embedded.name, embedded.height) == ("small", 200)
    assert "</" not in embedded.item
    item = json.loads(embedded.item)
    assert item["target_id"] == "drawing-small"
    (source,) = item["doc"]["roots"][0]["attributes"]["tags"]
    headings = [heading for heading, _ in source["attributes"]["data"]["entries"]]
    assert headings == ["position / mm", "name", "drift / µm"]


def test_the_library_is_inlined_whole() -> None:
    library, own = chart_scripts()
    assert "</script" not in library + own
    assert 1e6 < len(library) < 2e6


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed (Debian: apt-get install chromium)")
def test_a_small_page_draws_saves_and_prints(tmp_path: Path) -> None:
    import jinja2
    from playwright.sync_api import sync_playwright

    from fusion.report import page as pages

    folder = Path(pages.__file__).parent / "templates"
    text = (
        '{% from "charts.html.j2" import draw with context %}<!DOCTYPE html><html lang="en"><head><title>t</title></head>'
        '<body><div style="height: 3000px">far above</div>{{ draw("small", "A caption.") }}'
        "{% for text in scripts %}<script>{{ text }}</script>{% endfor %}</body></html>"
    )
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.DictLoader({"small.html": text}), jinja2.FileSystemLoader(folder)]),
        autoescape=True,
    )
    (tmp_path / "small.html").write_text(
        environment.get_template("small.html").render(figures=embed({"small": small_chart()}), scripts=chart_scripts()),
        encoding="utf-8",
    )
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page()
        faults: list[str] = []
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda request: None if request.url.startswith("file:") else faults.append(request.url))
        page.goto((tmp_path / "small.html").as_uri())
        page.wait_for_selector("html[data-charts=drawn]")
        drawing = page.get_by_role("img", name='Falls from 1.5 to −2.0 µm over "10" mm.')
        assert drawing.locator("canvas").count() > 0
        with page.expect_download() as download:
            page.get_by_role("button", name="Data").click()
        assert download.value.suggested_filename == "figure-small.csv"
        saved = Path(download.value.path()).read_text(encoding="utf-8-sig").splitlines()
        assert saved == ["position / mm,name,drift / µm", "0,'=1+1,1.5", '10,"a, b",']
        zoom = page.get_by_role("button", name="Zoom")
        zoom.click()
        assert zoom.get_attribute("aria-pressed") == "true"
        page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
        assert page.locator("svg.printed path").count() > 2
        assert page.locator("svg.printed").get_attribute("viewBox").endswith(" 200")
        page.evaluate("window.dispatchEvent(new Event('afterprint'))")
        assert page.locator("svg.printed").count() == 0
        assert faults == []
        browser.close()
