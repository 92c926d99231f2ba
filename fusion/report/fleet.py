"""What a fleet found, one row per campaign: as page, workbook, CSV and JSON, and as a table for the terminal."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import date, datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple
from urllib.parse import quote

import numpy as np
import pandas as pd
import rich.table
import xarray as xr

from fusion.common import FusionError
from fusion.common.messages import cell
from fusion.report.charts.comparison import plot_history
from fusion.report.charts.style import Chart, embed
from fusion.report.exports.tables import Bars, Bound, Linked, conditions_of, write_workbook
from fusion.report.findings import findings, headline
from fusion.report.page import render_page
from fusion.report.wording import ISO230_TERMS, say
from fusion.results.numbers import fixed, measured, upper_first
from fusion.results.parts import Quantity
from fusion.results.results import Results, read_results
from fusion.results.store import has_product, read_json, read_json_object, read_product
from interferometry.io.tables import DATED
from thermography.common import spreadsheet_text
from thermography.large_arrays import in_pieces

State = Literal["finished", "kept", "failed", "stopped", "waiting"]
SUMMARY = "fleet.json"


@dataclass(frozen=True)
class Row:
    """One campaign of a fleet and what became of it.

    Attributes
    ----------
    state : "finished" now, "kept" from an earlier fleet, "failed", "stopped" in the middle, or "waiting" to be run
    verdict, headline : of the closed loop, and as a sentence; empty where there is none
    drift_um, drift_u_um : largest range of the drift over the targets or displacements, and its standard uncertainty
    axis : as the campaign file names it
    A_um, A_u_um and so on : values by ISO 230-2 of the quoted window, each with its standard uncertainty
    machine, serial, date : as the campaign file names them, and the day of the first reading
    decision : the least favourable of the decisions by ISO 14253-1 against the stated tolerances; empty where none is stated
    windows_otherwise : how many windows of five cycles decide otherwise; empty where no tolerance is stated
    acceptance : whether the test meets what ISO 230-2 asks of an acceptance test; None where the readings do not show it
    maximum_degC, maximum_u_degC
        Highest temperature that a camera measured in a picture, a region or a field, and its standard uncertainty.
    above_range : whether it is the end of the calibrated range, which pixels are above
    held_out_um : root mean square error of the final model on what was held out
    anomalies, warnings : positions that stand out, and warnings
    seconds, peak_MB : wall time of its run, s, and largest memory of its process; 0 where it was not measured
    log : file with everything that its run said, as seen from the summary
    conditions : conditions of the test by name, empty where they are not stated
    """

    name: str
    state: State = "waiting"
    exit_code: int | None = None
    title: str = ""
    verdict: str = ""
    headline: str = ""
    drift_um: float | None = None
    drift_u_um: float | None = None
    axis: str = ""
    A_um: float | None = None
    A_u_um: float | None = None
    R_um: float | None = None
    R_u_um: float | None = None
    E_um: float | None = None
    E_u_um: float | None = None
    M_um: float | None = None
    M_u_um: float | None = None
    B_um: float | None = None
    B_u_um: float | None = None
    machine: str = ""
    date: str = ""
    decision: str = ""
    windows_otherwise: str = ""
    acceptance: bool | None = None
    maximum_degC: float | None = None
    maximum_u_degC: float | None = None
    held_out_um: float | None = None
    anomalies: int | None = None
    warnings: int | None = None
    inputs: str = ""
    message: str = ""
    seconds: float = 0.0
    peak_MB: float = 0.0
    log: str = ""
    serial: str = ""
    above_range: bool = False
    conditions: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_whole(self) -> bool:
        """Whether its results are there."""
        return self.state in ("finished", "kept")

    @property
    def report(self) -> str:
        """Its report as seen from the summary; empty where there is none."""
        return f"{self.name}/report.html" if self.is_whole else ""


#: Columns of the CSV, and keys of a row in ``fleet.json``, which has the conditions too.
_COLUMNS = tuple(one.name for one in fields(Row) if one.name != "conditions")


def with_findings(row: Row, folder: Path) -> Row:
    """Return a row with what the results of its run say."""
    try:
        results = read_results(folder)
        maps = read_product(folder, "fields") if has_product(folder, "fields.nc") else None
    except (FusionError, OSError) as error:
        return replace(row, state="failed", message=str(error))
    loop, listed = results.loop, conditions_of(results)
    conditions = {one.key: one.text for one in listed}
    stated = read_json_object(folder / "provenance.json").get("parameters", {}).get("report", {})
    iso = results.iso230
    decided = [one.decision for one in iso.tolerances] if iso else []
    maxima = {one.maximum_degC: one.overrange_pictures > 0 for one in results.regions or ()}
    if maps is not None:
        maxima[_hottest_cell(maps)] = False
    hottest = max((one for one in maxima if one.value is not None), key=lambda one: one.value or 0.0, default=_UNKNOWN)
    numbers: dict[str, Any] = {"maximum_degC": hottest.value, "maximum_u_degC": hottest.u}
    for one in findings(results):
        if one.value is not None:
            numbers |= {f"{one.code}_{one.unit}": one.value.value, f"{one.code}_u_{one.unit}": one.value.u}
    return replace(
        row,
        title=results.campaign,
        machine=conditions.get("machine") or stated.get("machine", ""),
        serial=conditions.get("machine_serial_number") or stated.get("machine_serial_number", ""),
        date=_day(results, conditions, maps),
        decision=next((one for one in _DECISIONS if one in decided), ""),
        windows_otherwise=say("windows_otherwise", iso, iso) if iso and decided else "",
        acceptance=iso.is_acceptance_test if iso else None,
        above_range=maxima.get(hottest, False),
        verdict="" if loop is None else say("verdict_word", loop),
        headline="" if loop is None else headline(results),
        axis=conditions.get("axis", ""),
        anomalies=None if results.anomalies is None else len(results.anomalies),
        warnings=len(results.warnings),
        inputs="" if results.inputs is None else results.inputs.state,
        conditions={one.name: one.text for one in listed},
        # Of an axis in another unit than the columns have there is none.
        **{name: number for name, number in numbers.items() if name in _COLUMNS},
    )


_UNKNOWN = Quantity(value=None, u=None)


def _hottest_cell(maps: xr.Dataset) -> Quantity:
    """Return the highest temperature of a cell in any field, degC; the fields are read one after another."""
    hottest = _UNKNOWN
    for (_, degC), (_, u_K) in zip(in_pieces(maps["temperature"]), in_pieces(maps["temperature_u"]), strict=True):
        if np.isfinite(degC).any():
            at = int(np.nanargmax(degC))
            if hottest.value is None or degC.flat[at] > hottest.value:
                u = float(u_K.flat[at])
                hottest = Quantity(value=float(degC.flat[at]), u=u if np.isfinite(u) else None)
    return hottest


def _day(results: Results, conditions: Mapping[str, str], maps: xr.Dataset | None) -> str:
    """Return the day of the first reading or picture; empty where no file says it."""
    if results.time is not None:
        return results.time.day
    pictures = results.thermograms.cameras if results.thermograms else ()
    if first := [one.first for one in pictures if one.first]:
        return min(first)[:10]
    if maps is not None and (taken := maps["time"].values.min()) > DATED:
        return str(np.datetime_as_string(taken, "D"))
    return conditions.get("date", "")[:10]


def as_json(rows: Sequence[Row], *, started: str, finished: str) -> dict[str, Any]:
    """Return the content of ``fleet.json``."""
    campaigns = [{**asdict(row), "report": row.report} for row in rows]
    return {"software": "thermofuse", "schema": 1, "started": started, "finished": finished, "campaigns": campaigns}


def read_rows(folder: Path) -> dict[str, Row]:
    """Return the rows of an earlier fleet by name; none where there is no ``fleet.json`` of this layout."""
    try:
        content = read_json(folder / SUMMARY)
        rows = [Row(**{one.name: item[one.name] for one in fields(Row)}) for item in content["campaigns"]]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return {row.name: row for row in rows}


def as_csv(rows: Sequence[Row]) -> str:
    """Return the content of ``fleet.csv``: one line per campaign, no text of which a spreadsheet takes for a formula."""
    written = io.StringIO()
    writer = csv.writer(written, lineterminator="\n")
    writer.writerow([*_COLUMNS, "report"])
    for row in rows:
        values = [*(getattr(row, name) for name in _COLUMNS), row.report]
        writer.writerow([spreadsheet_text(value) if isinstance(value, str) else value for value in values])
    return written.getvalue()


#: Decisions by ISO 14253-1, the least favourable first.
_DECISIONS = ("fail", "not measured", "not decided within the uncertainty", "pass")


class Column(NamedTuple):
    """A column of the summary: its heading, the attribute of a row that it shows, and what it means where its heading does not say it."""

    heading: str
    key: str
    meaning: str = ""

    @property
    def u(self) -> str:
        """The attribute with its standard uncertainty; empty where a row has none."""
        name = self.key.replace("_", "_u_", 1)
        return name if name in _COLUMNS and name != self.key else ""

    @property
    def is_text(self) -> bool:
        """Whether it holds texts; the others hold numbers."""
        return self.key in _TEXT


_TEXT = {one.name for one in fields(Row) if one.type in ("str", "State")}
#: What was found, as page and workbook show it.
FINDINGS = (
    Column("campaign", "name"),
    *(Column(f"{symbol} / µm", f"{symbol}_um") for symbol in ISO230_TERMS),
    Column("maximum / °C", "maximum_degC", "Maximum: highest temperature that a camera measured."),
    Column("held-out error / µm", "held_out_um", "Held-out error: of the last model, on what took no part in it."),
    Column(
        "decision",
        "decision",
        "Decision: the least favourable of the stated tolerances (ISO 14253-1); not decided where one lies within the uncertainty; no "
        "acceptance where the test does not meet what ISO 230-2 asks for.",
    ),
    Column(
        "decided otherwise",
        "windows_otherwise",
        "Decided otherwise: windows of five cycles of the same test that would not keep or fail the same tolerances.",
    ),
    Column(
        "drift / µm",
        "drift_um",
        "Drift: largest range over the targets, or of a displacement, from scatter and estimate alone.",
    ),
    Column("verdict", "verdict"),
    Column("machine", "machine"),
    Column("serial number", "serial"),
    Column("axis", "axis"),
    Column("date", "date"),
    Column("anomalies", "anomalies", "Anomalies: positions that stand out from the others."),
    Column("warnings", "warnings"),
    Column("inputs", "inputs"),
)
#: How the runs went.
RUNS = (
    Column("state", "state"),
    Column("exit code", "exit_code"),
    Column("time / s", "seconds"),
    Column("memory / MB", "peak_MB"),
)
#: What only the workbook has room for.
_IN_FULL = (Column("title", "title"), Column("conclusion", "headline"), Column("message", "message"))
#: What the terminal has room for beside the findings, and what it has not.
_IN_TERMINAL = ("exit_code",)
_NOT_IN_TERMINAL = ("machine", "serial", "date")


def shown(row: Row, column: Column) -> str:
    """Return what a row shows in a column; a dash where there is nothing."""
    value = getattr(row, column.key)
    if column.key == "verdict":
        return value.replace("_", " ") or ("not modelled" if row.is_whole else row.state)
    if value is None or value == "" or (value == 0.0 and column.key in ("seconds", "peak_MB")):
        return "–"
    if column.key == "decision":
        return _decided(row)
    if column.key == "maximum_degC" and row.above_range:
        return f"> {fixed(value, 0)}"
    if column.key == "peak_MB":
        return f"{value:.0f}"
    return measured(value, getattr(row, column.u) if column.u else None) if isinstance(value, float) else str(value)


def _decided(row: Row) -> str:
    """Return the decision in short, with what makes it no acceptance."""
    return row.decision.removesuffix(" within the uncertainty") + (", no acceptance" if row.acceptance is False else "")


def filled(rows: Sequence[Row], columns: Sequence[Column]) -> list[Column]:
    """Return those columns in which some row has something."""
    return [column for column in columns if any(shown(row, column) != "–" for row in rows)]


def count_decisions(rows: Sequence[Row]) -> dict[str, int]:
    """Return how many campaigns there are of each decision, the most favourable first, and without one."""
    whole = [row for row in rows if row.is_whole]
    judged = sorted((row for row in whole if row.decision), key=lambda row: -_DECISIONS.index(row.decision))
    unjudged = len(whole) - len(judged)
    return {**Counter(map(_decided, judged)), **({"without a tolerance": unjudged} if unjudged else {})}


# The workbook of a fleet: a summary, one row per campaign, and what is stated of each test.


def write_book(path: Path, rows: Sequence[Row]) -> None:
    """Write the workbook of a fleet, without columns in which nothing is."""
    sheets = {"Summary": _summary_of(rows), "Campaigns": _campaigns_of(rows)}
    if any(text for row in rows for text in row.conditions.values()):
        sheets["Conditions"] = _conditions_of(rows)
    write_workbook(path, sheets, Bars("Campaigns", ("A / µm", "R / µm"), beside="Summary"))


def _link(row: Row) -> str | Linked:
    return Linked(row.name, quote(row.report)) if row.report else row.name


def _summary_of(rows: Sequence[Row]) -> pd.DataFrame:
    """Return counts of campaigns and decisions, the largest A, R and maximum, and the first and last date with their campaigns."""
    lines: list[tuple[object, ...]] = [("campaigns", len(rows), None, None)]
    lines += [(state, count, None, None) for state, count in Counter(row.state for row in rows).items()]
    lines += [(f"decision: {decision}", count, None, None) for decision, count in count_decisions(rows).items()]
    for key, named in (
        ("A_um", "largest A / µm"),
        ("R_um", "largest R / µm"),
        ("maximum_degC", "highest temperature / °C"),
    ):
        known = [row for row in rows if getattr(row, key) is not None]
        if known:
            most = max(known, key=lambda row: getattr(row, key))
            u = getattr(most, Column("", key).u)
            lines.append((named, _value(most, key), None if u is None else 2 * u, _link(most)))
    dated = sorted((row for row in rows if row.date), key=lambda row: row.date)
    for named, row in zip(("newest date", "oldest date"), (*dated[-1:], *dated[:1]), strict=False):
        lines.append((named, _value(row, "date"), None, _link(row)))
    return pd.DataFrame(lines, columns=["finding", "value", "U (k = 2)", "campaign"], dtype=object)


def _campaigns_of(rows: Sequence[Row]) -> pd.DataFrame:
    """Return the findings of every campaign with expanded uncertainties, then how its run went."""
    table: dict[str, list[object]] = {}
    for column in filled(rows, (*FINDINGS, *_IN_FULL, *RUNS)):
        table[column.heading] = [_value(row, column.key) for row in rows]
        if column.u and any(getattr(row, column.u) is not None for row in rows):
            quantity, _, unit = column.heading.partition(" / ")
            expanded = [None if (u := getattr(row, column.u)) is None else 2 * u for row in rows]
            table[f"U({quantity}) (k = 2) / {unit.replace('°C', 'K')}"] = list(expanded)
    return pd.DataFrame({heading: pd.Series(values, dtype=object) for heading, values in table.items()})


def _value(row: Row, key: str) -> object:
    """Return what a row holds as a cell: its name with a link to the report, a day as a day, a bound as one."""
    value = getattr(row, key)
    if key == "name":
        return _link(row)
    if key == "date":
        return date.fromisoformat(value[:10]) if value else None
    if key == "maximum_degC" and row.above_range:
        return Bound(value)
    if key in ("decision", "verdict"):
        told = shown(row, Column("", key))
        return None if told == "–" else told
    return value


def _conditions_of(rows: Sequence[Row]) -> pd.DataFrame:
    """Return what is stated of each test, without conditions that none states."""
    asked = dict.fromkeys(name for row in rows for name, text in row.conditions.items() if text)
    return pd.DataFrame(
        [
            {"campaign": _link(row), **{name: row.conditions.get(name) or "not stated" for name in asked}}
            for row in rows
            if row.conditions
        ],
        dtype=object,
    )


def summary_table(rows: Sequence[Row], title: str) -> rich.table.Table:
    """Return the rows of a fleet as a table for the terminal."""
    printed = rich.table.Table(title=cell(title), title_justify="left")
    named = [one for one in FINDINGS if one.key not in _NOT_IN_TERMINAL] + [
        one for one in RUNS if one.key in _IN_TERMINAL
    ]
    columns = filled(rows, named)
    for column in columns:
        printed.add_column(column.heading, justify="left" if column.is_text else "right", overflow="fold")
    for row in rows:
        printed.add_row(*(cell(shown(row, column)) for column in columns))
    return printed


def count_line(rows: Sequence[Row]) -> str:
    """Return how many campaigns ended how, in words."""
    words: dict[State, str] = {
        "finished": "finished",
        "kept": "kept from before, unchanged",
        "failed": "failed",
        "stopped": "stopped",
        "waiting": "not started",
    }
    counts = Counter(row.state for row in rows)
    told = [f"{counts[state]} {text}" for state, text in words.items() if counts[state]]
    return f"{len(rows)} campaigns: {', '.join(told)}"


# The page of a fleet: what failed and why, then one row per campaign with a link to its report.


def render_fleet(rows: Sequence[Row], *, started: str) -> str:
    """Return the page of a fleet as HTML text."""
    histories = draw_histories(rows)
    columns, runs = filled(rows, FINDINGS[1:]), filled(rows, RUNS)
    decisions = count_decisions(rows) if any(row.decision for row in rows) else {}
    return render_page(
        "fleet.html.j2",
        embed({f"history_{k}": one.chart for k, one in enumerate(histories)}),
        ("fleet.js",),
        histories=[
            (f"history_{k}", one.name, [(row, quote(row.report)) for row in one.rows])
            for k, one in enumerate(histories)
        ],
        counts=count_line(rows),
        decisions=", ".join(f"{count} {decision}" for decision, count in decisions.items()),
        started=f"{datetime.fromisoformat(started):%Y-%m-%d %H:%M} UTC",
        meanings=[column.meaning for column in columns if column.meaning],
        by_iso230=any(column.key == "A_um" for column in columns),
        headings=[(upper_first(column.heading), not column.is_text) for column in columns],
        rows=[(row, quote(row.report), [shown(row, column) for column in columns]) for row in rows],
        run_headings=[(upper_first(column.heading), not column.is_text) for column in runs],
        runs=[(row, quote(row.log), [shown(row, column) for column in runs]) for row in rows],
        failed=[(row, quote(row.log)) for row in rows if row.state == "failed"],
        summary={"assumptions": {}},
    )


class History(NamedTuple):
    """The tests of one axis of one machine in the order of their dates."""

    name: str
    chart: Chart
    rows: Sequence[Row]


def draw_histories(rows: Sequence[Row]) -> list[History]:
    """Draw A and R over the dates of every axis that was tested twice or more; tests of a machine state it, or share a folder."""
    tests: dict[tuple[str, str, str], list[Row]] = {}
    for row in sorted(rows, key=lambda row: row.date):
        machine = row.machine or ("" if row.serial else row.name.rpartition("/")[0])
        if row.date and row.A_um is not None and (machine or row.serial):
            tests.setdefault((machine, row.serial, row.axis), []).append(row)
    histories = []
    for (machine, serial, axis), dated in tests.items():
        if len({row.date for row in dated}) < 2:
            continue
        found = {
            name: (
                np.array([getattr(row, f"{name}_um") for row in dated], float),
                np.array([getattr(row, f"{name}_u_um") for row in dated], float),
            )
            for name in "AR"
        }
        words = (machine, serial and f"serial number {serial}", axis and f"axis {axis}")
        chart = plot_history(np.array([row.date for row in dated], "datetime64[D]"), found)
        histories.append(History(", ".join(word for word in words if word), chart, dated))
    return histories
