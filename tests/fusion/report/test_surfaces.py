"""Whatever prints a quantity prints one value: print, notebook, terminal, report, sheet, workbook, fleet, comparison."""

from __future__ import annotations

import io
import re
import shutil
from collections.abc import Iterator, Mapping
from html import unescape
from pathlib import Path

import docx
import openpyxl
import pypdf
import pytest
from rich.console import Console
from rich.table import Table

from fusion.pipeline.compare import compare_campaigns
from fusion.pipeline.iso230 import read_test
from fusion.pipeline.iso230_3 import read_thermal_tests
from fusion.pipeline.run import run_campaign
from fusion.report.campaign import thermal_test_tables
from fusion.report.comparison import render_comparison
from fusion.report.exports.export import export_results
from fusion.report.findings import summary_table
from fusion.report.fleet import Row, render_fleet, with_findings, write_book
from fusion.report.sheet import describe_sheet, iso230_tables, write_iso230, write_thermal_tests
from fusion.report.wording import ISO230_TERMS, ONE_WAY_TERMS
from fusion.results.numbers import measured
from fusion.results.results import read_results
from tests.browser import CHROMIUM
from tests.fusion.campaign_parts import simulated
from tests.fusion.conftest import RECIPE, draw_no_charts
from tests.fusion.report.page_tables import tables_of

pytestmark = pytest.mark.chain

ANOMALY = '[[anomaly]]\ntarget = 3\nkind = "structural"\namplitude_um = 1.5\n'
STATED = """
[acceptance]
A = "20 um"
R = "6 um"
A_unidirectional = "20 um"
R_unidirectional = "6 um"
E_unidirectional = "20 um"

[report]
machine = "Mill"
"""
#: A value with its expanded uncertainty, a number, a decision by ISO 14253-1, and a day.
VALUE, NUMBER, DAY = r"(−?[\d.]+ ± [\d.]+)", r"([\d.]+)", r"(\d{4}-\d\d-\d\d)"
DECISION = r"(pass|fail|not decided)"


def on_one_line(page: str) -> str:
    """The text of a page, without scripts, drawings and marks."""
    without = re.sub(r"<(script|style|svg)\b.*?</\1>", " ", page, flags=re.DOTALL)
    return " ".join(unescape(re.sub("<[/!a-z][^>]*>", " ", without)).split())


def printed(*tables: Table) -> str:
    """What a terminal shows, without the lines of its tables."""
    shown = Console(width=500, file=io.StringIO())
    for table in tables:
        shown.print(table)
    return " ".join(re.sub("[─-╿]", " ", shown.file.getvalue()).split())


def workbook(path: Path) -> dict[str, list[dict[str, object]]]:
    """The rows of every sheet of a workbook by heading."""
    sheets = {}
    for sheet in openpyxl.load_workbook(path):
        headings, *rows = sheet.iter_rows(values_only=True)
        sheets[sheet.title] = [dict(zip(headings, row, strict=True)) for row in rows]
    return sheets


def in_print(path: Path) -> str:
    """The text of a PDF."""
    return " ".join(" ".join(page.extract_text() for page in pypdf.PdfReader(path).pages).split())


def in_words(book: Path) -> str:
    """The numbers of the workbook of a run, each row as a line of what others print."""
    sheets = workbook(book)
    lines = [f"{row['finding']} {row['value']}" for row in sheets["Summary"]]
    for row in sheets.get("Distortions", ()):
        lines.append(
            f"{row['quantity']} {row['unit']} whole {measured(row['whole test'], row['U(whole test) (k = 2)'] / 2)}"
        )
    for row in sheets.get("Predictions", ()):
        lines.append(f"{row['prediction']} {row['rmse / µm']:.9f}")
    for row in sheets.get("A R E M B", ()):
        found = measured(row["value / µm"], row["U (k = 2) / µm"] / 2)
        lines.append(f"{ISO230_TERMS[row['quantity']]} {found} {row['limit / µm'] or '–'} {row['decision']}")
    lines += [f"{row['condition']} {row['stated or logged']}" for row in sheets["Conditions"]]
    lines += [f"evaluated {row['window']}." for row in sheets.get("ISO 230-2 positions", ())]
    return " ".join(" ".join(lines).split())


def in_columns(book: Path) -> str:
    """The row of the only campaign in the workbook of a fleet: value and expanded uncertainty as others print them."""
    (row,) = workbook(book)["Campaigns"]
    lines = []
    for heading, value in row.items():
        expanded = row.get(f"U({heading.partition(' / ')[0]}) (k = 2) / µm")
        lines.append(f"{heading} {value if expanded is None else measured(value, expanded / 2)};")
    return " ".join(lines)


def in_pairs(page: str) -> str:
    """The counts of the page of a fleet, then every heading of its only row with its cell."""
    headings, cells = tables_of(page)["Campaigns"]
    pairs = zip(headings, cells, strict=True)
    return on_one_line(f"{page.partition('<table')[0]} {' '.join(f'{heading} {cell};' for heading, cell in pairs)}")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The results of a test with a camera, an anomalous position, an effect that is missing, and tolerances."""
    folder = tmp_path_factory.mktemp("surfaces")
    campaign = simulated(folder, f"{RECIPE}\n{ANOMALY}")
    campaign.write_text(campaign.read_text() + STATED)
    with pytest.MonkeyPatch.context() as patch:
        draw_no_charts(patch)
        run_campaign(campaign, folder / "results")
    return folder / "results"


def common_surfaces(run: Path, out: Path) -> dict[str, str]:
    """The text of what every run has, and of its sheet in a folder."""
    results = read_results(run)
    document = docx.Document(out / "sheet.docx")
    cells = [cell.text for table in document.tables for row in table.rows for cell in row.cells]
    (book,) = export_results(run, "xlsx", out).files
    row = with_findings(Row("mill", state="finished", exit_code=0, seconds=1.0, peak_MB=1.0), run)
    write_book(out / "fleet.xlsx", [row])
    return {
        "print": str(results),
        "notebook": on_one_line(results._repr_html_()),
        "terminal": printed(summary_table(results)),
        "report": on_one_line((run / "report.html").read_text(encoding="utf-8")),
        "sheet": on_one_line((out / "sheet.html").read_text(encoding="utf-8")),
        "Word": " ".join(" ".join([*(one.text for one in document.paragraphs), *cells]).split()),
        "workbook": in_words(book),
        "fleet": in_pairs(render_fleet([row], started="2026-03-10T00:00:00")),
        "fleet workbook": in_columns(out / "fleet.xlsx"),
    }


@pytest.fixture(scope="module")
def record_surfaces(spindle, tmp_path_factory) -> Mapping[str, str]:
    """The text of every surface of the record."""
    folder = shutil.copytree(spindle, tmp_path_factory.mktemp("record") / "spindle")
    title, tests, files, _ = read_thermal_tests(folder / "results")
    for name in ("sheet.html", "sheet.docx"):
        write_thermal_tests(folder / name, title, tests, files=files)
    shown = printed(*thermal_test_tables(tests, title=title))
    return {**common_surfaces(folder / "results", folder), "iso230-3": shown}


@pytest.fixture(scope="module")
def surfaces(run, tmp_path_factory) -> Mapping[str, str]:
    """The text of every surface."""
    out = tmp_path_factory.mktemp("out")
    test = read_test(run, None)
    sheet = describe_sheet(test.title, test.part, files=test.files)
    for name in ("sheet.html", "sheet.docx"):
        write_iso230(out / name, sheet, test.part, test.dataset, remarks=test.remarks)
    if CHROMIUM:
        write_iso230(out / "sheet.pdf", sheet, test.part, test.dataset, remarks=test.remarks)
    again = shutil.copytree(run, out / "again")
    return {
        **common_surfaces(run, out),
        **({"PDF": in_print(out / "sheet.pdf")} if CHROMIUM else {}),
        "iso230": printed(*iso230_tables(test.part, test.dataset, title=test.title)),
        "comparison": on_one_line(render_comparison(compare_campaigns([run, again]))),
    }


#: Surfaces that show a table of the values of the axis, and those that show the summary of the terminal.
TABLED = ("iso230", "report", "sheet", "Word", "workbook", "comparison")
SUMMARISED = ("terminal", "report", "workbook")
PRINTED, FLEET, STATED_ON = (
    ("print", "notebook"),
    ("fleet", "fleet workbook"),
    ("sheet", "Word", "workbook", "comparison"),
)


def on(surfaces: tuple[str, ...], *patterns: str) -> dict[str, tuple[str, ...]]:
    """The same patterns on several surfaces."""
    return dict.fromkeys(surfaces, patterns)


def places() -> Iterator[tuple[str, dict[str, tuple[str, ...]]]]:
    """Where each quantity stands: patterns whose group is its value, by surface."""
    for symbol, term in ISO230_TERMS.items():
        told = {} if symbol in "EM" else on(("terminal",), rf"\b{symbol} = {VALUE} µm")
        tile = (rf"\b{symbol}, ISO 230-2 {VALUE} µm",) if symbol == "A" else ()
        yield symbol, {
            **on(TABLED, rf"{term} {VALUE}"), **on(PRINTED, rf"\b{symbol} {VALUE} µm"), **on(FLEET, rf"\b{symbol} / µm {VALUE}"), **told,
            "report": (rf"{term} {VALUE}", *tile),
            "comparison": (rf"{term} {VALUE} ", rf"{symbol} by ISO 230-2 {VALUE} µm"),
        }  # fmt: skip
    one_way = [(symbol, arrow, term) for symbol, term in ONE_WAY_TERMS.items() for arrow in "↑↓"]
    for symbol, arrow, term in one_way:
        yield f"{symbol}{arrow}", on(TABLED[:4], rf"{term}{arrow} {VALUE}")
    for symbol, title, surfaces in (
        ("A", ISO230_TERMS["A"], TABLED), ("R", ISO230_TERMS["R"], TABLED),
        *((f"{symbol}{arrow}", f"{term}{arrow}", TABLED[:4]) for symbol, arrow, term in one_way),
    ):  # fmt: skip
        listed = rf"(Pass|Fail|Not decided): (?:(?!Pass:|Fail:|Not decided:).)*?(?<!\w){symbol} ≤ "
        judged = rf"{title} {VALUE.replace('(', '(?:')} \d+ {DECISION}"
        yield f"decision on {symbol}", {
            **on(surfaces, judged), "report": (judged, listed),
            "comparison": (rf"{symbol} at most \d+ µm {DECISION}",),
        }  # fmt: skip
    yield (
        "decision",
        {"fleet": (rf"Decision {DECISION}", rf"Decisions: 1 {DECISION}"), "fleet workbook": (rf"decision {DECISION}",)},
    )
    cycles = r"(cycles \d+ to \d+)"
    yield "window", {
        **on(PRINTED, rf"{cycles}: A"), **on(SUMMARISED, rf"By ISO 230-2, {cycles}: A"), "iso230": (rf"Small campaign, {cycles}",),
        "report": (rf"Evaluated: {cycles}", rf"ISO 230-2 {VALUE.replace('(', '(?:')} µm {cycles}"),
        **on(("sheet", "Word"), rf"Values of {cycles}"), "workbook": (rf"evaluated {cycles}\.", rf"By ISO 230-2, {cycles}: A"),
        "comparison": (rf"ISO 230-2 window {cycles}",),
    }  # fmt: skip
    drifted = rf"drifted by {VALUE} µm at position"
    yield "largest drift", {
        **on(SUMMARISED, drifted), "report": (drifted, rf"Largest drift {VALUE} µm"), "fleet": (rf"Drift / µm {VALUE}",),
        "fleet workbook": (rf"drift / µm {VALUE}",), "comparison": (rf"largest drift during the test {VALUE} µm",),
    }  # fmt: skip
    where = rf"drifted by \S+ ± \S+ µm at position \d \({NUMBER} mm\)"
    yield "place of the largest drift", {
        **on(SUMMARISED, where), "report": (where, rf"Largest drift \S+ ± \S+ µm {NUMBER} mm"),
    }  # fmt: skip
    yield "held-out error before", {
        **on(PRINTED, rf"held-out error:? {NUMBER} ->"), **on(SUMMARISED, rf"held-out error {NUMBER} ->"),
        "report": (rf"declared model {NUMBER}",),
    }  # fmt: skip
    yield "held-out error after", {
        **on(PRINTED, rf"-> {NUMBER} µm"), **on(SUMMARISED, rf"held-out error [\d.]+ -> {NUMBER} µm"),
        "report": (rf"Held-out error {NUMBER} µm", rf"with the added effects {NUMBER}"),
        **on(FLEET, rf"[Hh]eld-out error / µm {NUMBER}"),
    }  # fmt: skip
    words = {"print": r"verdict:? (\w+)", "terminal": r"verdict (\w+)(?:: | \()", "fleet": r"[Vv]erdict (\w+)"}
    yield "verdict", {
        **on(PRINTED, words["print"]), **on(("terminal", "workbook"), words["terminal"]), **on(FLEET, words["fleet"]),
    }  # fmt: skip
    apart = r"Position (\d+) \(\d+ mm\) repeats worse"
    yield "position that stands out", {
        **on(PRINTED, r"anomalies:? position (\d+)"), **on(SUMMARISED, apart),
        "comparison": (r"positions that stand out Position (\d+)",),
    }  # fmt: skip
    yield (
        "p of it",
        {
            **on(PRINTED, r"structural, p (\S+ [\d.]+),"),
            **on(SUMMARISED, r"µm \(p (\S+ [\d.]+), resolution"),
        },
    )
    yield (
        "expansion coefficient",
        {"report": (rf"{VALUE} ppm/K, of which",), "comparison": (rf"expansion of the axis {VALUE} ppm/K",)},
    )
    yield (
        "date",
        {
            **on(STATED_ON, rf"Date of the test {DAY}"),
            "report": (rf"Mill, X axis, {DAY}", rf"Date of the test {DAY}"),
            **on(FLEET, rf"[Dd]ate {DAY}"),
        },
    )
    yield (
        "machine",
        {
            **on(STATED_ON, r"Machine (\w+)"),
            "report": (r"campaign (\w+), X axis,", r"Machine (\w+)"),
            **on(FLEET, r"[Mm]achine (\w+)"),
        },
    )
    yield "warnings", {**on(PRINTED, r"warnings:? (\d+)"), **on(FLEET, r"[Ww]arnings (\d+)")}
    yield (
        "inputs",
        {
            **on(PRINTED, r"inputs:? (\w+)"),
            **on(("terminal", "workbook"), r"inputs (\w+) in"),
            **on(FLEET, r"[Ii]nputs (\w+)"),
        },
    )


def places_of_a_record() -> Iterator[tuple[str, dict[str, tuple[str, ...]]]]:
    """The same of a record."""
    row = rf"X µm {VALUE.replace('(', '(?:')} {VALUE}"
    yield "largest drift", {
        **on(("report", "sheet", "Word", "iso230-3"), row), "report": (row, rf"Largest drift {VALUE} µm"),
        "workbook": (rf"X µm whole {VALUE}",), "fleet": (rf"Drift / µm {VALUE}",), "fleet workbook": (rf"drift / µm {VALUE}",),
    }  # fmt: skip
    yield "held-out error after", {
        **on(PRINTED, rf"-> {NUMBER} µm"), "terminal": (rf"held-out error [\d.]+ -> {NUMBER} µm", rf"falls from [\d.]+ to {NUMBER} µm"),
        "report": (rf"Held-out error {NUMBER} µm", rf"with the added effects {NUMBER}"), **on(FLEET, rf"[Hh]eld-out error / µm {NUMBER}"),
        "workbook": (rf"held-out error [\d.]+ -> {NUMBER} µm", rf"with the added effects {NUMBER}"),
    }  # fmt: skip
    yield "verdict", {
        **on(PRINTED, r"verdict:? (\w+)"), **on(("terminal", "workbook"), r"verdict (\w+):"), **on(FLEET, r"[Vv]erdict (\w+)"),
    }  # fmt: skip
    yield "date", {
        **on(("sheet", "Word", "workbook"), rf"Date of the test {DAY}"), "report": (rf"machine not stated, {DAY}",),
        **on(FLEET, rf"[Dd]ate {DAY}"),
    }  # fmt: skip
    yield "warnings", {**on(PRINTED, r"warnings:? (\d+)"), **on(FLEET, r"[Ww]arnings (\d+)")}


def to_the_digits_of_both(texts: set[str]) -> set[str]:
    """Numbers without an uncertainty, rounded to the decimals of the one with the fewest; other texts in small letters."""
    if not all(re.fullmatch(r"\d+(\.\d+)?", text) for text in texts):
        return {text.lower() for text in texts}
    decimals = min(len(text.partition(".")[2]) for text in texts)
    return {f"{round(float(text), decimals):.{decimals}f}" for text in texts}


def hold_one_value(surfaces: Mapping[str, str], stands: Mapping[str, tuple[str, ...]]) -> None:
    """Every place of a quantity has a value, at least two surfaces show it, and they all show the same; a sheet its print too."""
    if "PDF" in surfaces and "sheet" in stands:
        stands = {**stands, "PDF": stands["sheet"]}
    every = [(surface, pattern) for surface, patterns in stands.items() for pattern in patterns]
    found = {(surface, pattern): re.findall(pattern, surfaces[surface]) for surface, pattern in every}
    assert len(stands) >= 2 and not [place for place, values in found.items() if not values]
    assert len(to_the_digits_of_both({value for values in found.values() for value in values})) == 1, found


@pytest.mark.parametrize("stands", [pytest.param(one, id=name) for name, one in places()])
def test_a_quantity_of_an_axis_has_one_value_wherever_it_is_printed(surfaces, stands):
    hold_one_value(surfaces, stands)


@pytest.mark.parametrize("stands", [pytest.param(one, id=name) for name, one in places_of_a_record()])
def test_a_quantity_of_a_record_has_one_value_wherever_it_is_printed(record_surfaces, stands):
    hold_one_value(record_surfaces, stands)
