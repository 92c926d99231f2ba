"""The screen *Results* in a browser: linked selection, keyboard, results that lack an instrument, texts of a file."""

import json
import shutil
from functools import partial
from pathlib import Path
from zipfile import ZipFile

import pytest

from fusion.app.results import _put, _write_sheet, _write_thermal_sheet
from fusion.pipeline.iso230_3 import StatedTests
from fusion.report.page import ProductsError
from fusion.results.parts import ThermalTest
from fusion.results.store import file_sha256


@pytest.fixture(scope="module")
def page(app, new_page):
    """The application, with results of a laser alone whose title is markup beside the whole ones."""
    laser = shutil.copytree(app[1] / "results", app[1] / "laser_alone")
    (laser / "fields.nc").unlink()
    results = json.loads((laser / "results.json").read_text(encoding="utf-8"))
    results["campaign"] = "<img src=x onerror=alert(1)>"
    (laser / "results.json").write_text(json.dumps(results), encoding="utf-8")
    provenance = json.loads((laser / "provenance.json").read_text(encoding="utf-8"))
    provenance["products"]["results.json"]["sha256"] = file_sha256(laser / "results.json")
    (laser / "provenance.json").write_text(json.dumps(provenance), encoding="utf-8")
    return new_page(app[0], width=390)


def test_a_sheet_in_word_is_written_and_replaced_whole(products, tmp_path):
    out = tmp_path / "sheet.docx"
    for _ in range(2):
        _put(out, partial(_write_sheet, products.folder))
        assert "Accuracy and repeatability" in ZipFile(out).read("word/document.xml").decode()

    _write_thermal_sheet(products.folder, tmp_path / "thermal.docx")
    assert "Thermal effects by ISO 230-3" in ZipFile(tmp_path / "thermal.docx").read("word/document.xml").decode()

    def failing(path):
        path.write_bytes(b"half")
        raise OSError("disk full")

    before = out.read_bytes()
    with pytest.raises(OSError, match="disk full"):
        _put(out, failing)
    assert out.read_bytes() == before


def test_a_sheet_that_could_not_say_whose_test_it_was_is_not_written(tmp_path, monkeypatch):
    nameless = StatedTests("T", (ThermalTest.model_construct(conditions=()),), {})
    monkeypatch.setattr("fusion.app.results.read_thermal_tests", lambda results: nameless)
    with pytest.raises(ProductsError, match="do not say whose test it was; run the campaign again"):
        _write_thermal_sheet(tmp_path, tmp_path / "sheet.docx")
    assert not list(tmp_path.iterdir())


def opened(page, part):
    """Open a screen or a part of it."""
    page.get_by_role("button", name=part, exact=True).first.click()


def name_folder(page, folder):
    page.get_by_label("Results folder").fill(str(folder))
    page.get_by_label("Results folder").press("Enter")
    opened(page, "Open")


def test_a_cycle_and_a_position_are_chosen_by_keyboard(page):
    opened(page, "Results")
    opened(page, "Map")
    page.get_by_text("Cycle 24 (").wait_for()
    page.get_by_role("slider").focus()
    # A key that is pressed while the screen still answers the last one starts from the old cycle.
    for cycle in (23, 22, 21, 20):
        page.keyboard.press("ArrowLeft")
        page.get_by_text(f"Cycle {cycle} (").wait_for()
    page.get_by_role("button", name="Readings", exact=True).press("Enter")
    menu = page.get_by_label("Position", exact=True)
    menu.focus()
    menu.select_option("Position 5 (200 mm)")
    page.get_by_text("Readings at 200 mm").wait_for()
    opened(page, "Map")
    page.get_by_text("Cycle 20 (").wait_for()
    page.wait_for_function("document.documentElement.scrollWidth <= 390")


def test_places_are_added_by_keyboard_and_by_click(page):
    page.get_by_role("textbox", name="x / mm").fill("300")
    page.get_by_role("textbox", name="x / mm").press("Enter")
    page.get_by_role("button", name="Add place").press("Enter")
    page.get_by_text("over time. x 300 mm").wait_for()
    page.wait_for_timeout(1000)
    page.locator(".bk-Figure:visible").first.click(position={"x": 220, "y": 45})
    page.get_by_text("over time. x 300 mm").filter(has_text=";").wait_for()


def test_the_report_stands_first_and_says_what_was_found(page):
    opened(page, "Report")
    report = page.frame_locator("iframe[title=Report]")
    report.locator("#summary .answers").wait_for()
    report.get_by_role("heading", name="Next").wait_for()
    page.wait_for_function("document.documentElement.scrollWidth <= 390")


def test_a_laser_alone_shows_what_there_is_and_its_texts_are_no_markup(page, app):
    name_folder(page, app[1] / "laser_alone")
    page.get_by_text("<img src=x onerror=alert(1)>").wait_for()
    opened(page, "Readings")
    page.get_by_text("Readings at").first.wait_for()
    assert page.get_by_text("Map", exact=True).count() == 0


def test_the_sheet_is_written_in_word_by_a_click_and_handed_over(page, app, ask, cookie):
    opened(page, "Results")
    name_folder(page, app[1] / "results")
    page.get_by_text("Small campaign", exact=True).wait_for()
    page.get_by_role("button", name="Test sheet to sign (Word)").press("Enter")
    page.get_by_role("link", name="Save sheet.docx").wait_for()
    answer = ask(app[0], "/report/results/sheet.docx", Cookie=cookie)
    assert answer.status == 200 and answer.headers["Content-Disposition"] == 'attachment; filename="sheet.docx"'
    assert answer.body[:2] == b"PK"


def test_a_folder_without_results_says_so(page, app):
    name_folder(page, app[1] / "thermal")
    page.get_by_role("alert").filter(has_text="there is no results.json in it").wait_for()
    name_folder(page, Path("/"))
    page.get_by_role("alert").filter(has_text="outside").wait_for()
