"""report.html in a headless chromium: offline, no error, readable on a phone, the map answers to slider and pointer."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest

from fusion.report.html import ProductsError, report_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed (Debian: apt-get install chromium)"),
]

from playwright.sync_api import Page, sync_playwright  # noqa: E402


@pytest.fixture(scope="module")
def report(results_folder: Path) -> Path:
    return results_folder / "report.html"


@pytest.fixture(scope="module")
def opened(report: Path) -> Iterator[tuple[Page, list[str]]]:
    """The report in a desktop window, and everything that went wrong or left the file while it loaded."""
    faults: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 900}, bypass_csp=True)
        page.on("pageerror", lambda error: faults.append(f"page error: {error}"))
        page.on(
            "console", lambda message: faults.append(f"console: {message.text}") if message.type == "error" else None
        )
        page.on(
            "request", lambda request: faults.append(f"request: {request.url}") if is_foreign(request.url) else None
        )
        page.goto(report.as_uri())
        yield page, faults
        browser.close()


def is_foreign(url: str) -> bool:
    return not url.startswith(("file://", "data:"))


def test_it_opens_offline_without_a_fault(opened: tuple[Page, list[str]], report: Path) -> None:
    page, faults = opened
    assert faults == []
    assert "Small campaign" in page.title()
    assert report.stat().st_size < 8e6
    links = "[...document.querySelectorAll('[src], [href]')].map(e => e.getAttribute('src') ?? e.getAttribute('href'))"
    assert [link for link in page.evaluate(links) if not link.startswith(("#", "data:"))] == []


def test_every_section_and_figure_is_there(opened: tuple[Page, list[str]]) -> None:
    page, _ = opened
    for section in (
        "summary",
        "data",
        "registration",
        "fields",
        "drift",
        "paper",
        "iso230",
        "anomalies",
        "correlation",
        "loop",
        "glossary",
    ):
        assert page.locator(f"section#{section}").count() == 1, section
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    figures = page.locator("figure svg, figure .drawing")
    assert figures.count() >= 18
    for at in range(figures.count()):
        box = figures.nth(at).bounding_box()
        assert box is not None and box["width"] > 300 and box["height"] > 80
    ids = page.evaluate("[...document.querySelectorAll('[id]')].map(e => e.id)")
    assert len(ids) == len(set(ids))
    for target in page.evaluate("[...document.querySelectorAll('nav a')].map(a => a.getAttribute('href').slice(1))"):
        assert target in ids
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = false)")


def test_a_link_of_the_contents_opens_the_appendix(opened: tuple[Page, list[str]]) -> None:
    page, _ = opened
    assert not page.locator("section#paper").is_visible()
    page.locator("nav.contents a[href='#paper']").click()
    assert page.locator("section#paper").is_visible()
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = false)")


def test_what_a_reader_acts_on_comes_before_the_statistics(opened: tuple[Page, list[str]]) -> None:
    page, _ = opened
    order = page.evaluate("[...document.querySelectorAll('section[id]')].map(s => s.id)")
    wanted = [
        "summary",
        "iso230",
        "drift",
        "anomalies",
        "fields",
        "cause",
        "place",
        "data",
        "appendix",
        "paper",
        "loop",
        "glossary",
    ]
    assert [name for name in order if name in wanted] == wanted


def test_the_summary_comes_first_and_fits_one_screen(opened: tuple[Page, list[str]]) -> None:
    page, _ = opened
    box = page.locator("section#summary").bounding_box()
    assert box is not None and box["y"] + box["height"] < 900
    assert "a reversal error that changes" in page.locator("section#summary .headline").inner_text()


@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_scrolls_sideways(opened: tuple[Page, list[str]], width: int) -> None:
    page, _ = opened
    page.set_viewport_size({"width": width, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.set_viewport_size({"width": 1280, "height": 900})


def test_the_map_follows_slider_menu_and_play(opened: tuple[Page, list[str]]) -> None:
    page, faults = opened
    figure = page.locator("#figure-thermal_map")
    figure.scroll_into_view_if_needed()
    page.wait_for_function("document.documentElement.dataset.charts == 'drawn'")
    slider, shown = figure.locator("input[type=range]"), figure.locator("output")
    assert shown.inner_text() == "24"
    slider.focus()
    page.keyboard.press("Home")
    assert shown.inner_text() == "1"
    figure.locator("select").select_option("temperature")
    said = figure.locator(".drawing").get_attribute("aria-label") or ""
    found = re.fullmatch(r"Plan of the table in cycle 1: temperature ([\d.]+) to ([\d.]+) °C\.", said)
    assert found is not None and 15 < float(found[1]) < float(found[2]) < 40
    play = figure.get_by_role("button", name="Play")
    play.click()
    page.wait_for_function("document.querySelector('#figure-thermal_map output').textContent == '3'")
    figure.get_by_role("button", name="Stop").click()
    assert faults == []


def test_tables_have_captions_and_charts_say_what_is_seen(opened: tuple[Page, list[str]]) -> None:
    page, _ = opened
    assert (
        page.evaluate("[...document.querySelectorAll('table')].filter(t => !t.caption && t.closest('.scroll')).length")
        == 0
    )
    said = page.evaluate("[...document.querySelectorAll('.drawing')].map(d => d.getAttribute('aria-label'))")
    assert len(said) >= 25
    assert all(len(text) > 30 and text.endswith(".") for text in said), said
    assert page.locator("a.skip").get_attribute("href") == "#main"
    page.evaluate("document.getElementById('loop').scrollIntoView()")
    nav = page.locator("nav.contents").bounding_box()
    assert nav is not None and nav["y"] == 0  # it stays at hand


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_rule_of_accessibility_is_broken(opened: tuple[Page, list[str]], scheme: Literal["light", "dark"]) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-playwright-python is not installed")
    page, _ = opened
    page.wait_for_function("document.documentElement.dataset.charts == 'drawn'")
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": 390, "height": 844})
    found = axe.Axe().run(page).response["violations"]
    page.set_viewport_size({"width": 1280, "height": 900})
    page.emulate_media(color_scheme="light")
    assert [(fault["id"], [node["target"] for node in fault["nodes"]][:3]) for fault in found] == []


def test_it_is_made_anew_from_its_products(report: Path, tmp_path: Path) -> None:
    page = report_of(report.parent)
    assert len(page) == pytest.approx(report.stat().st_size, rel=0.02)
    shutil.copy(report.parent / "results.json", tmp_path / "results.json")
    with pytest.raises(ProductsError, match=r"provenance\.json is missing; run the campaign again"):
        report_of(tmp_path)
    no_input = '{"inputs": {"laser.csv": -1}, "versions": {}, "parameters": {"campaign": {}}}'
    for text in ("null", "[]", '{"inputs": {}, "versions": {}, "parameters": {"campaign": 5}}', no_input):
        (tmp_path / "provenance.json").write_text(text)
        with pytest.raises(
            ProductsError, match=r"provenance\.json: not the provenance of a run; run the campaign again"
        ):
            report_of(tmp_path)


def test_it_prints(opened: tuple[Page, list[str]]) -> None:
    page, _ = opened
    assert page.pdf(format="A4").startswith(b"%PDF")


def test_no_link_of_the_contents_hides_behind_the_button(opened: tuple[Page, list[str]]) -> None:
    page, _ = opened
    for width in (700, 1400):
        page.set_viewport_size({"width": width, "height": 900})
        boxes = page.evaluate(
            "[...document.querySelectorAll('nav.contents > *')].map(e => { const r = e.getBoundingClientRect(); "
            "return [r.left, r.right, r.top, r.bottom]; })"
        )
        left, _, top, bottom = boxes[-1]
        assert all(right <= left or low <= top or high >= bottom for _, right, high, low in boxes[:-1])
        assert max(right for _, right, _, _ in boxes) <= width
