"""report.html in a headless chromium: offline, readable on a phone, the map answers; the page of two sessions; printing."""

import json
import re
import shutil
import stat
import tempfile

import pytest
from playwright.sync_api import sync_playwright

from fusion.common import FusionError
from fusion.report import page as pdf
from fusion.report.page import ProductsError, report_of
from fusion.results.store import DamagedProductError
from tests.browser import CHROMIUM, record_faults


@pytest.fixture(scope="module")
def report(results_folder):
    return results_folder / "report.html"


@pytest.fixture(scope="module")
def opened(report):
    """The report in a desktop window, and everything that went wrong or left the file while it loaded."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed (Debian: apt-get install chromium)")
    faults = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 900}, bypass_csp=True)
        record_faults(page, faults, own=("file://", "data:"))
        page.goto(report.as_uri())
        yield page, faults
        browser.close()


@pytest.fixture(scope="module")
def made_anew(report):
    """The report once more, from its products."""
    return report_of(report.parent)


def test_it_opens_offline_without_a_fault(opened, report):
    page, faults = opened
    assert faults == []
    assert "Small campaign" in page.title()
    assert report.stat().st_size < 8e6
    links = "[...document.querySelectorAll('[src], [href]')].map(e => e.getAttribute('src') ?? e.getAttribute('href'))"
    assert [link for link in page.evaluate(links) if not link.startswith(("#", "data:"))] == []


def test_every_section_and_figure_is_there(opened):
    page, _ = opened
    sections = "summary data registration fields drift paper iso230 anomalies correlation loop glossary"
    for section in sections.split():
        assert page.locator(f"section#{section}").count() == 1, section
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    figures = page.locator("figure svg, figure .drawing")
    assert figures.count() >= 18
    for at in range(figures.count()):
        box = figures.nth(at).bounding_box()
        assert box["width"] > 300 and box["height"] > 80
    ids = page.evaluate("[...document.querySelectorAll('[id]')].map(e => e.id)")
    assert len(ids) == len(set(ids))
    for target in page.evaluate("[...document.querySelectorAll('nav a')].map(a => a.getAttribute('href').slice(1))"):
        assert target in ids
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = false)")


def test_a_link_of_the_contents_opens_the_appendix(opened):
    page, _ = opened
    assert not page.locator("section#paper").is_visible()
    page.locator("nav.contents a[href='#paper']").click()
    assert page.locator("section#paper").is_visible()
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = false)")


def test_what_a_reader_acts_on_comes_before_the_statistics(opened):
    page, _ = opened
    order = page.evaluate("[...document.querySelectorAll('section[id]')].map(s => s.id)")
    sections = "summary iso230 drift anomalies fields cause place data appendix paper loop glossary"
    wanted = sections.split()
    assert [name for name in order if name in wanted] == wanted


@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_scrolls_sideways(opened, width):
    page, _ = opened
    page.set_viewport_size({"width": width, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.set_viewport_size({"width": 1280, "height": 900})


def test_the_map_follows_slider_menu_and_play(opened):
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
    assert 15 < float(found[1]) < float(found[2]) < 40
    play = figure.get_by_role("button", name="Play")
    play.click()
    page.wait_for_function("document.querySelector('#figure-thermal_map output').textContent == '3'")
    figure.get_by_role("button", name="Stop").click()
    assert faults == []


def test_tables_have_captions_and_charts_say_what_is_seen(opened):
    page, _ = opened
    bare = "[...document.querySelectorAll('table')].filter(t => !t.caption && t.closest('.scroll')).length"
    assert page.evaluate(bare) == 0
    said = page.evaluate("[...document.querySelectorAll('.drawing')].map(d => d.getAttribute('aria-label'))")
    assert len(said) >= 25
    assert all(len(text) > 30 and text.endswith(".") for text in said), said
    assert page.locator("a.skip").get_attribute("href") == "#main"
    page.evaluate("document.getElementById('cause').scrollIntoView()")
    nav = page.locator("nav.contents").bounding_box()
    assert nav["y"] == 0  # it stays at hand


@pytest.mark.parametrize(("scheme", "rules"), [("light", {}), ("dark", {"runOnly": ["color-contrast"]})])
def test_no_rule_of_accessibility_is_broken(opened, scheme, rules):
    """A theme changes colours alone."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-playwright-python is not installed")
    page, _ = opened
    page.wait_for_function("document.documentElement.dataset.charts == 'drawn'")
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": 390, "height": 844})
    found = axe.Axe().run(page, options={"resultTypes": ["violations"], **rules}).response["violations"]
    page.set_viewport_size({"width": 1280, "height": 900})
    page.emulate_media(color_scheme="light")
    assert [(fault["id"], [node["target"] for node in fault["nodes"]][:3]) for fault in found] == []


def test_it_is_made_anew_from_its_products(made_anew, report, tmp_path):
    assert len(made_anew) == pytest.approx(report.stat().st_size, rel=0.02)
    shutil.copy(report.parent / "results.json", tmp_path / "results.json")
    with pytest.raises(ProductsError, match=r"provenance\.json is missing; run the campaign again"):
        report_of(tmp_path)
    whole = json.loads((report.parent / "provenance.json").read_text(encoding="utf-8"))
    (tmp_path / "provenance.json").write_text(json.dumps(whole))
    with pytest.raises(DamagedProductError, match=r"\w+\.nc is missing; put the file back, or run the campaign again"):
        report_of(tmp_path)
    damaged = [
        None, [], *({key: value for key, value in whole.items() if key != lost} for lost in ("started", "finished", "command", "inputs")),
        {**whole, "versions": {}}, {**whole, "parameters": {"campaign": 5}}, {**whole, "inputs": {"laser.csv": -1}},
    ]  # fmt: skip
    for content in damaged:
        (tmp_path / "provenance.json").write_text(json.dumps(content))
        with pytest.raises(FusionError, match=r"provenance\.json: not the provenance of a run; run the campaign"):
            report_of(tmp_path)


def test_charts_follow_a_dark_page_and_paper_is_white(opened):
    """Lines turn by a filter, which no export sees; the frame of a map by its colours, which paper must not keep."""
    page, _ = opened
    page.wait_for_function("document.documentElement.dataset.charts == 'drawn'")
    looks = """() => {
      const map = [...Bokeh.index.roots].find((one) => one.model.name === "plan").model;
      const line = document.querySelector("#figure-drift .drawing"), plain = (colour) => colour?.value ?? colour;
      return [getComputedStyle(line).filter, plain(map.below[0].axis_label_text_color), plain(map.border_fill_color)].join();
    }"""
    night, day = "invert(0.9) hue-rotate(180deg),#e7ecee,", "none,#1f2a30,#ffffff"
    page.emulate_media(color_scheme="dark")
    page.wait_for_function(f"({looks})() === '{night}'")
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    drawn = page.locator("#figure-thermal_map svg.printed").evaluate("part => part.outerHTML")
    assert "#1f2a30" in drawn and "#e7ecee" not in drawn
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert page.evaluate(looks) == night
    page.emulate_media(color_scheme="light")
    page.wait_for_function(f"({looks})() === '{day}'")


def test_no_link_of_the_contents_hides_behind_the_button(opened):
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


def test_the_browser_that_is_named_must_exist():
    with pytest.raises(pdf.PrintError, match='--browser "no-such-browser": there is no such program'):
        pdf.find_browser("no-such-browser")


def test_without_a_browser_the_remedy_is_told(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(pdf.PrintError, match=r"no browser that can print was found .* press its button Print"):
        pdf.find_browser()


def test_a_browser_that_fails_leaves_the_old_file(tmp_path):
    broken = tmp_path / "browser"
    broken.write_text("#!/bin/sh\necho cannot open display >&2\nexit 3\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    out = tmp_path / "report.pdf"
    out.write_bytes(b"old")
    with pytest.raises(pdf.PrintError, match="ended with 3 and printed nothing: cannot open display"):
        pdf.print_pdf("<p>page</p>", out, browser=str(broken))
    assert out.read_bytes() == b"old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["browser", "report.pdf"]


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed (Debian: apt-get install chromium)")
def test_the_report_is_printed_on_a4_with_its_charts(made_anew, tmp_path, monkeypatch):
    tempfile.gettempdir()
    monkeypatch.setenv("TMPDIR", "/absent")  # as a service has it: the browser gets a folder of its own
    written = pdf.print_pdf(made_anew, tmp_path / "report.pdf", browser=CHROMIUM)
    content = written.read_bytes()
    assert content.startswith(b"%PDF")
    boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", content)
    assert {(round(float(width)), round(float(height))) for width, height in boxes} == {(595, 842)}
    assert 6 <= len(re.findall(rb"/Type /Page\b", content)) <= 12
    assert len(content) > 300_000  # charts are drawings in it, not blank places
