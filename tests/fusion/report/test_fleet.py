"""What a fleet found: one row per campaign, on a page, in a workbook, and in a summary that runs nothing that a file holds."""

import csv
import datetime
import io
import json
from dataclasses import replace

import numpy as np
import openpyxl
import pytest
from rich.console import Console

from fusion.report.fleet import (
    FINDINGS,
    RUNS,
    SUMMARY,
    Row,
    as_csv,
    as_json,
    count_decisions,
    count_line,
    draw_histories,
    filled,
    read_rows,
    render_fleet,
    shown,
    summary_table,
    with_findings,
    write_book,
)
from fusion.report.wording import say
from fusion.results.results import assemble, read_results
from fusion.results.store import open_dataset, write_json
from tests.browser import CHROMIUM, record_faults
from tests.fusion.report.exports.small_run import write_fields
from tests.fusion.results_sample import MOVED, RECORD_LOOP

FAILED = Row("b", state="failed", exit_code=2, message='=HYPERLINK("x")', seconds=1.5, log="logs/b.log")


@pytest.fixture(scope="module")
def whole(results_folder):
    return with_findings(Row("a", state="finished", exit_code=0, seconds=61.2, peak_MB=412.0), results_folder)


def test_a_row_says_what_the_results_say(whole, results_folder):
    results = read_results(results_folder)
    assert whole.title == results.campaign
    assert whole.verdict == say("verdict_word", results.loop)
    assert whole.drift_um == max(results.drift.range_um)
    assert whole.drift_u_um in results.drift.range_u_um
    assert (whole.anomalies, whole.warnings) == (len(results.anomalies), len(results.warnings))
    assert whole.report == "a/report.html"
    quoted = results.iso230
    assert (whole.A_um, whole.A_u_um, whole.B_um) == (quoted.A_um.value, quoted.A_um.u, quoted.B_um.value)
    told = {column.heading: shown(whole, column) for column in (*FINDINGS, *RUNS)}
    assert (told["campaign"], told["axis"]) == ("a", "X")
    assert "±" in told["drift / µm"] and "±" in told["A / µm"]
    assert (told["exit code"], told["time / s"], told["memory / MB"]) == ("0", "61.2", "412")
    assert (whole.date, whole.held_out_um) == (results.time.first[:10], results.loop.rmse_final_um)
    columns = [column.heading for column in filled([FAILED], (*FINDINGS, *RUNS))]
    assert columns == ["campaign", "verdict", "state", "exit code", "time / s"]


def test_the_maximum_is_that_of_the_fields_beside_a_laser(whole, results_folder):
    maps = open_dataset(results_folder / "fields.nc")
    highest = float(maps["temperature"].max())
    assert whole.maximum_degC == pytest.approx(highest)
    at = maps["temperature_u"].where(maps["temperature"] == maps["temperature"].max())
    assert whole.maximum_u_degC == pytest.approx(float(at.max()))


AT = {"file": "b.jpg", "frame": 0, "time": None, "column_px": 1, "row_px": 2}
PICTURES = {
    "thermograms": {
        "pictures": 2,
        "cameras": [{"name": "C", "pictures": 2, "first": "2024-11-19T19:19:15Z", "last": "2024-11-20T19:21:14Z"}],
        "series": "C",
        "scene": "still",
        "largest_shift_px": 0.1,
        "emissivity": 0.95,
        "indicated_degC": 391.0,
    },
    "regions": [
        {
            "name": "whole picture", "kind": "box", "camera": "C", "pictures": 2, "emissivity": 0.95,
            "maximum_degC": {"value": 311.67, "u": None}, "maximum_at": AT, "minimum_degC": {"value": 16.4, "u": 1.2}, "minimum_at": AT,
            "mean_degC": {"value": 31.7, "u": 1.3}, "overrange_pictures": 1, "overrange_pixels": 9, "underrange_pictures": 0,
            "underrange_pixels": 0,
        }
    ],
}  # fmt: skip


def row_of(folder, **parts):
    """The row of a run that found these parts."""
    write_json(folder / "results.json", assemble("R", parts, []).as_json())
    return with_findings(Row("r", state="finished", exit_code=0), folder)


def test_a_maximum_beyond_the_calibrated_range_is_a_bound_and_pictures_have_a_date(tmp_path):
    stated = {"parameters": {"report": {"machine": "Mill 7", "machine_serial_number": "M-7"}}}
    (tmp_path / "provenance.json").write_text(json.dumps(stated))
    row = row_of(tmp_path, **PICTURES)
    assert (row.date, row.machine, row.serial) == ("2024-11-19", "Mill 7", "M-7")
    assert '<td class="n">&gt; 312</td>' in render_fleet([row], started=STARTED)
    write_book(tmp_path / "fleet.xlsx", [row])
    cells = {cell.value: cell for cell in openpyxl.load_workbook(tmp_path / "fleet.xlsx")["Campaigns"][2]}
    assert cells[311.67].number_format == '"> "0'


def test_fields_without_a_laser_have_a_date_and_a_maximum(tmp_path):
    write_fields(tmp_path)
    row = row_of(tmp_path)
    assert (row.date, row.maximum_degC, row.maximum_u_degC) == ("2026-03-09", 1.0, 1.0)


def test_the_date_and_the_machine_of_a_record_are_those_of_its_test(tmp_path):
    conditions = [
        {"key": "date", "name": "Date of the test", "text": "2026-01-05 06:00 UTC to 2026-01-06 06:00 UTC"},
        {"key": "machine", "name": "Machine", "text": "Mill 9"},
    ]
    row = row_of(tmp_path, loop=RECORD_LOOP, iso230_3=[{**MOVED, "conditions": conditions}])
    assert (row.drift_um, row.date, row.machine) == (89.2, "2026-01-05", "Mill 9")


def monthly(whole, count):
    """Monthly tests of one axis of a machine."""
    return [
        replace(
            whole, name=f"m/{month}", date=f"2026-{month:02d}-01", machine="Mill 7", serial="M-7", A_um=5.0 + 0.1 * month,
            decision="pass",
        )
        for month in range(1, count + 1)
    ]  # fmt: skip


def test_the_tests_of_one_axis_of_one_machine_are_drawn_over_their_dates_with_links(whole):
    rows = monthly(whole, 9)
    [history] = draw_histories([*reversed(rows), replace(rows[0], axis="Y"), replace(rows[0], serial="M-8")])
    assert history.name == "Mill 7, serial number M-7, axis X" and history.rows == rows
    assert list(history.chart.columns["date"]) == [row.date for row in rows]
    np.testing.assert_allclose(history.chart.columns["A / µm"], [row.A_um for row in rows])
    np.testing.assert_allclose(history.chart.columns["U(A) (k = 2) / µm"], 2 * whole.A_u_um)
    assert "control limits" in history.chart.seen
    assert "control limits" not in draw_histories(rows[:2])[0].chart.seen
    # One date is no trend, and tests that neither name a machine nor share a folder are not taken for those of one.
    assert draw_histories(rows[:1]) == []
    unnamed = [replace(row, name=row.date, machine="", serial="") for row in rows]
    assert draw_histories(unnamed) == []
    page = render_fleet(rows, started=STARTED)
    assert page.count("<figure") == 1 and '2026-03-01 <a href="m/3/report.html">m/3</a>' in page


def test_decisions_are_counted(whole):
    open_one, refused = (replace(whole, decision="pass", acceptance=one) for one in (None, False))
    rows = [
        replace(open_one, decision=one) for one in ("fail", "pass", "pass", "not decided within the uncertainty", "")
    ]
    assert count_decisions([*rows, refused, FAILED]) == {
        "pass": 2, "pass, no acceptance": 1, "not decided": 1, "fail": 1, "without a tolerance": 1,
    }  # fmt: skip


def test_the_workbook_has_links_dates_and_the_columns_of_the_page(whole, tmp_path):
    rows = [*monthly(whole, 9), FAILED]
    write_book(tmp_path / "fleet.xlsx", rows)
    book = openpyxl.load_workbook(tmp_path / "fleet.xlsx")
    assert book.sheetnames == ["Summary", "Campaigns", "Conditions"]
    sheet = book["Campaigns"]
    assert (sheet.freeze_panes, sheet.auto_filter.ref.startswith("A1:")) == ("B2", True)
    names = [cell.value for cell in sheet[1]]
    assert names[:5] == ["campaign", "A / µm", "U(A) (k = 2) / µm", "R / µm", "U(R) (k = 2) / µm"]
    assert names.index("decision") < names.index("state") and not [name for name in names if "_" in name]
    first = dict(zip(names, sheet[2], strict=True))
    assert first["campaign"].hyperlink.target == "m/1/report.html"
    assert first["U(A) (k = 2) / µm"].value == pytest.approx(2 * whole.A_u_um)
    assert first["date"].value == datetime.datetime(2026, 1, 1) and first["date"].number_format == "yyyy-mm-dd"
    message = sheet.cell(11, 1 + names.index("message"))
    assert (message.data_type, message.value) == ("s", '=HYPERLINK("x")')
    told = {row[0]: row[1:] for row in book["Summary"].iter_rows(min_row=2, values_only=True)}
    assert (told["campaigns"][0], told["decision: pass, no acceptance"][0], told["failed"][0]) == (10, 9, 1)
    assert told["largest A / µm"][0] == pytest.approx(5.9) and told["largest A / µm"][2] == "m/9"
    assert told["newest date"][0] == datetime.datetime(2026, 9, 1)
    assert book["Summary"]._charts
    asked = dict(zip(*book["Conditions"].iter_rows(max_row=2, values_only=True), strict=True))
    assert asked["campaign"] == "m/1" and asked["Axis"] == "X"


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed (Debian: apt-get install chromium)")
def test_the_page_in_a_browser(whole, tmp_path):
    """What is found fits a window of 1400 px, the name stays in sight on a phone, headings sort, and charts are dark in the dark."""
    playwright = pytest.importorskip("playwright.sync_api")
    address, faults = tmp_path / "fleet.html", []
    rows = [replace(row, A_um=value) for row, value in zip(monthly(whole, 3), (7.0, 30.0, 5.0), strict=True)]
    address.write_text(render_fleet(rows, started=STARTED), encoding="utf-8")
    with playwright.sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 900}, color_scheme="dark")
        record_faults(page, faults, own=("file:", "blob:", "data:"))
        page.goto(address.as_uri())
        right = "(at) => document.querySelectorAll('#campaigns thead th')[at].getBoundingClientRect().right"
        assert page.evaluate(right, 8) <= 1400
        page.get_by_role("button", name="A / µm").click()
        assert page.locator("#campaigns tbody th").all_inner_texts()[0].startswith("m/3")
        page.wait_for_function("document.documentElement.dataset.charts === 'drawn'")
        seen = page.locator(".drawing").screenshot()
        page.set_viewport_size({"width": 390, "height": 844})
        page.evaluate("document.querySelector('#campaigns .scroll').scrollLeft = 300")
        box = page.locator("#campaigns tbody th").first.bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] < 200
        browser.close()
    image = pytest.importorskip("PIL.Image").open(io.BytesIO(seen)).convert("L")
    brightness = np.asarray(image)
    assert np.median(brightness) < 60 and brightness.max() > 120
    assert faults == []


def test_results_that_cannot_be_read_are_a_failure(tmp_path):
    row = with_findings(Row("a", state="finished", exit_code=0), tmp_path)
    assert row.state == "failed"
    assert "there is no results.json" in row.message


def test_the_summary_is_read_back(whole, tmp_path):
    write_json(tmp_path / SUMMARY, as_json([whole, FAILED], started="2026-11-22T01:00:00+00:00", finished="later"))
    assert read_rows(tmp_path) == {"a": whole, "b": FAILED}
    assert json.loads((tmp_path / SUMMARY).read_text())["campaigns"][0]["report"] == "a/report.html"
    (tmp_path / SUMMARY).write_text('{"campaigns": [{"name": 1}]}')
    assert read_rows(tmp_path) == {}


def test_no_text_is_a_formula_for_a_spreadsheet_or_a_style_for_the_terminal(whole):
    lines = list(csv.DictReader(io.StringIO(as_csv([replace(whole, title="+1"), FAILED]))))
    assert [line["title"] for line in lines] == ["'+1", ""]
    assert lines[1]["message"] == '\'=HYPERLINK("x")'
    assert float(lines[0]["drift_um"]) == whole.drift_um
    assert "key" not in lines[0]
    told = io.StringIO()
    Console(file=told, width=240).print(summary_table([replace(whole, name="[red]a[/red]"), FAILED], "2 [b]campaigns"))
    assert "[red]a[/red]" in told.getvalue()
    assert "2 [b]campaigns" in told.getvalue()


def test_endings_are_counted(whole):
    rows = [whole, replace(whole, state="kept"), FAILED, replace(FAILED, state="stopped"), Row("c")]
    counted = "1 finished, 1 kept from before, unchanged, 1 failed, 1 stopped, 1 not started"
    assert count_line(rows) == f"5 campaigns: {counted}"


STARTED = "2026-11-22T01:30:00+00:00"
WHOLE = Row(
    "hall 1/<X>", "finished", 0, "<script>alert(1)</script>", "partial", drift_um=12.3, drift_u_um=0.4, anomalies=2,
    warnings=3, inputs="doubted",
)  # fmt: skip
BROKEN = Row("m/Y", "failed", 2, message="laser.csv, line 3: <img src=x>", log="logs/m_Y.log")


def test_the_page_escapes_what_files_hold_and_shows_failures_first():
    page = render_fleet([WHOLE, BROKEN], started=STARTED)
    assert "<script>alert" not in page and "<img" not in page
    assert "&lt;script&gt;alert(1)" in page
    assert 'href="hall%201/%3CX%3E/report.html"' in page
    assert page.index("laser.csv, line 3") < page.index("<h2>Campaigns</h2>")
    assert 'href="logs/m_Y.log"' in page
    assert "2 campaigns: 1 finished, 1 failed. Started 2026-11-22 01:30 UTC." in page
    assert "12.30 ± 0.80" in page and "A / µm" not in page
    assert "What failed" not in render_fleet([WHOLE], started=STARTED)
