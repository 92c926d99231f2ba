"""One row per campaign: what it says, and that no text of a file acts in a spreadsheet or a terminal."""

import csv
import io
import json
from dataclasses import replace

import pytest
from rich.console import Console

from fusion.fleet.summary import (
    SUMMARY,
    Row,
    as_csv,
    as_json,
    cells,
    count_line,
    read_rows,
    summary_table,
    with_findings,
)
from fusion.products.results import read_results
from fusion.products.store import write_json

FAILED = Row("b", state="failed", exit_code=2, message='=HYPERLINK("x")', seconds=1.5, log="logs/b.log")


@pytest.fixture(scope="module")
def whole(results_folder):
    return with_findings(Row("a", state="finished", exit_code=0, seconds=61.2, peak_MB=412.0), results_folder)


def test_a_row_says_what_the_results_say(whole, results_folder):
    results = read_results(results_folder)
    assert whole.title == results.campaign
    assert whole.verdict == results.loop.verdict
    assert whole.drift_um == max(results.drift.range_um)
    assert whole.drift_u_um in results.drift.range_u_um
    assert (whole.anomalies, whole.warnings) == (len(results.anomalies), len(results.warnings))
    assert whole.report == "a/report.html"
    shown = cells(whole)
    assert shown[0] == "a"
    assert shown[2].endswith(" µm") and "±" in shown[2]
    assert shown[6:] == ["0", "61.2", "412"]
    assert cells(FAILED)[1:4] == ["failed", "–", "–"]


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


def test_no_text_is_a_formula_for_a_spreadsheet(whole):
    lines = list(csv.DictReader(io.StringIO(as_csv([replace(whole, title="+1"), FAILED]))))
    assert [line["title"] for line in lines] == ["'+1", ""]
    assert lines[1]["message"] == '\'=HYPERLINK("x")'
    assert float(lines[0]["drift_um"]) == whole.drift_um
    assert "key" not in lines[0]


def test_no_text_is_a_style_for_the_terminal(whole):
    told = io.StringIO()
    Console(file=told, width=160).print(summary_table([replace(whole, name="[red]a[/red]"), FAILED], "2 [b]campaigns"))
    assert "[red]a[/red]" in told.getvalue()
    assert "2 [b]campaigns" in told.getvalue()


def test_endings_are_counted(whole):
    rows = [whole, replace(whole, state="kept"), FAILED, replace(FAILED, state="stopped"), Row("c")]
    assert count_line(rows) == (
        "5 campaigns: 1 finished, 1 kept from before, unchanged, 1 failed, 1 stopped, 1 not started"
    )
