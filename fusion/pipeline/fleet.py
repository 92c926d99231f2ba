"""Runs a fleet: one process per campaign, as many at a time as processors and memory allow; one that fails does not stop the others."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import numpy as np
import psutil
import rich.table

from fusion.campaign.config import load_campaign
from fusion.common import FusionError
from fusion.messages import cell
from fusion.pipeline.stages import kept_results
from fusion.pipeline.workers import start_module
from fusion.report.charts.comparison import plot_trend
from fusion.report.charts.style import Chart, embed
from fusion.report.conclusions import headline
from fusion.report.exports.tables import write_table_book
from fusion.report.numbers import measured, number
from fusion.report.page import render_page
from fusion.results.folder import MANIFEST, claim, open_folder
from fusion.results.progress import Report, silent
from fusion.results.results import read_results
from fusion.results.store import write_atomically, write_json, write_text
from thermography.common import usable_processors

# Campaigns of a fleet: found in folders, each with a name of its own; and whether the results of one are still those
# of its files.

#: Names in the folder of a fleet that are its own, in lower case: not every file system tells case apart.
RESERVED = frozenset({"logs", "fleet.json", "fleet.csv", "fleet.xlsx", "fleet.html", MANIFEST, ".stages"})
#: Campaign files that are looked for in a folder and in all folders in it.
CAMPAIGN_FILE = "campaign.toml"


class FleetError(FusionError):
    """A fleet without campaigns, or with campaigns that cannot be distinguished; the message says what to do."""


@dataclass(frozen=True)
class Member:
    """One campaign of a fleet: its file, and a name for it that is unique in the fleet, with ``/`` between folders."""

    name: str
    campaign: Path


def find_members(paths: Sequence[Path]) -> list[Member]:
    """Return the campaigns of a fleet, sorted by name."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            found = sorted(path.rglob(CAMPAIGN_FILE))
            if not found:
                raise FleetError(
                    f"{path}: holds no {CAMPAIGN_FILE}; thermofuse init {path} writes one, of several laser tests one for each; or "
                    "name the campaign files, or the folder above theirs"
                )
            files += found
        elif path.is_file():
            files.append(path)
        else:
            raise FleetError(f"{path}: is not there; name campaign files, or folders that hold them")
    absolute = list(dict.fromkeys(path.resolve() for path in files))
    in_folder = Counter(path.parent for path in absolute)
    common = Path(os.path.commonpath([path.parent for path in absolute]))
    members = []
    for path in absolute:
        place = path.parent.relative_to(common)
        if in_folder[path.parent] > 1 or place == Path():
            place = place / (path.stem if in_folder[path.parent] > 1 else path.parent.name)
        if place.parts[0].lower() in RESERVED:
            raise FleetError(
                f"{path}: its results would be written to the folder {place.parts[0]}, which is reserved for the fleet; rename the folder "
                "of this campaign, or name another one above it"
            )
        members.append(Member(place.as_posix(), path))
    names = {member.name: member for member in members}
    if len(names) < len(members):
        twice = next(name for name, count in Counter(member.name for member in members).items() if count > 1)
        raise FleetError(f"two campaigns would have the results folder {twice}; rename one of their files")
    for name, member in names.items():
        outer = next((str(above) for above in map(Path.as_posix, Path(name).parents) if above in names), None)
        if outer is not None:
            raise FleetError(
                f"{member.campaign}: is in the folder of {names[outer].campaign}, so their results would too; move one of them"
            )
    return sorted(members, key=lambda member: member.name)


def is_unchanged(member: Member, folder: Path) -> bool:
    """Return whether a folder holds the whole results of a campaign as it is now, as ``thermofuse run --resume`` judges it."""
    try:
        return kept_results(load_campaign(member.campaign), folder) is not None
    except (FusionError, OSError):
        return False


# What a fleet found, one row per campaign: as JSON, as CSV, and as a table for the terminal.

State = Literal["finished", "kept", "failed", "stopped", "waiting"]
SUMMARY = "fleet.json"


@dataclass(frozen=True)
class Row:
    """One campaign of a fleet and what became of it.

    Attributes
    ----------
    state : str
        "finished" now, "kept" from an earlier fleet, "failed", "stopped" in the middle, or "waiting" to be run.
    verdict, headline : str
        Of the closed loop, and as a sentence; empty where there is none.
    drift_um, drift_u_um : float or None, um
        Largest range of the drift over the targets, and its standard uncertainty.
    axis : str
        As the campaign file names it.
    A_um, A_u_um and so on : float or None, um
        Values by ISO 230-2 of the most settled window, each with its standard uncertainty.
    machine, date : str
        As the campaign file names it, and the day of the first reading.
    decision : str
        The least favourable of the decisions by ISO 14253-1 against the stated tolerances; empty where none is stated.
    maximum_degC, maximum_u_degC : float or None, degC
        Highest temperature in any picture of a camera that measured alone, and its standard uncertainty.
    held_out_um : float or None, um
        Root mean square error of the final model on what was held out.
    anomalies, warnings : int or None
        Positions that stand out, and warnings.
    seconds, peak_MB : float
        Wall time of its run, s, and largest memory of its process; 0 where it was not measured.
    log : str
        File with everything that its run said, as seen from the summary.
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

    @property
    def is_whole(self) -> bool:
        """Whether its results are there."""
        return self.state in ("finished", "kept")

    @property
    def report(self) -> str:
        """Its report as seen from the summary; empty where there is none."""
        return f"{self.name}/report.html" if self.is_whole else ""


#: Columns of the CSV, and keys of a row in ``fleet.json``.
_COLUMNS = tuple(field.name for field in fields(Row))


def with_findings(row: Row, folder: Path) -> Row:
    """Return a row with what the results of its run say."""
    try:
        results = read_results(folder)
    except (FusionError, OSError) as error:
        return replace(row, state="failed", message=str(error))
    drift = results.drift
    ranges = () if drift is None else zip(drift.range_um, drift.range_u_um, strict=True)
    known = [(value, u) for value, u in ranges if value is not None]
    most, most_u = max(known, key=lambda one: one[0]) if known else (None, None)
    test = results.iso230
    # The columns are lengths.
    values = (
        {}
        if test is None or test.unit != "um"
        else {name: getattr(test.settled or test, f"{name}_um") for name in _SYMBOLS}
    )
    stated = {} if test is None else {one.name: one.text for one in test.conditions}
    decided = [one.decision for one in test.tolerances] if test else []
    highest = [one.maximum_degC for one in results.regions or () if one.maximum_degC.value is not None]
    hottest = max(highest, key=lambda one: one.value or 0.0, default=None)
    return replace(
        row,
        title=results.campaign,
        machine=stated.get("Machine", ""),
        date=results.time.first[:10] if results.time else "",
        decision=next((one for one in _DECISIONS if one in decided), ""),
        maximum_degC=hottest.value if hottest else None,
        maximum_u_degC=hottest.u if hottest else None,
        held_out_um=None if results.loop is None else results.loop.rmse_final_um,
        verdict="" if results.loop is None else results.loop.verdict,
        headline="" if results.loop is None else headline(results),
        drift_um=most,
        drift_u_um=most_u,
        axis=stated.get("Axis", ""),
        **{f"{name}_um": one.value for name, one in values.items()},
        **{f"{name}_u_um": one.u for name, one in values.items()},
        anomalies=None if results.anomalies is None else len(results.anomalies),
        warnings=len(results.warnings),
        inputs="" if results.inputs is None else results.inputs.state,
    )


def as_json(rows: Sequence[Row], *, started: str, finished: str) -> dict[str, Any]:
    """Return the content of ``fleet.json``."""
    campaigns = [{**asdict(row), "report": row.report} for row in rows]
    return {"software": "thermofuse", "schema": 1, "started": started, "finished": finished, "campaigns": campaigns}


def read_rows(folder: Path) -> dict[str, Row]:
    """Return the rows of an earlier fleet by name; none where there is no ``fleet.json`` of this layout."""
    try:
        content = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        rows = [Row(**{key: item[key] for key in _COLUMNS}) for item in content["campaigns"]]
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
        writer.writerow([_no_formula(value) if isinstance(value, str) else value for value in values])
    return written.getvalue()


def write_book(path: Path, rows: Sequence[Row]) -> None:
    """Write the workbook of a fleet: one line per campaign that can be sorted and filtered, without columns in which nothing is."""
    whole = [{**asdict(row), "report": row.report} for row in rows]
    kept = [name for name in (*_COLUMNS, "report") if any(line[name] not in (None, "") for line in whole)]
    headings = [f"{name} (standard uncertainty, k = 1)" if "_u_" in name else name for name in kept]
    write_table_book(path, "Campaigns", headings, [[line[name] for name in kept] for line in whole], chart="A_um")


def _no_formula(text: str) -> str:
    """Return a text with an apostrophe before a sign with which formulas begin."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


def cells(row: Row) -> list[str]:
    """Return a row as page and terminal show it, in the order of `HEADINGS`; a dash where there is nothing."""
    return [
        row.name,
        row.machine or "–",
        row.axis or "–",
        row.date or "–",
        row.decision or "–",
        row.verdict.replace("_", " ") or ("not modelled" if row.is_whole else row.state),
        *(measured(getattr(row, f"{name}_um"), getattr(row, f"{name}_u_um")) for name in ("drift", *_SYMBOLS)),
        measured(row.maximum_degC, row.maximum_u_degC),
        "–" if row.held_out_um is None else number(row.held_out_um, 3),
        *("–" if count is None else str(count) for count in (row.anomalies, row.warnings)),
        row.inputs or "–",
        "–" if row.exit_code is None else str(row.exit_code),
        number(row.seconds, 3) if row.seconds else "–",
        f"{row.peak_MB:.0f}" if row.peak_MB else "–",
    ]


_SYMBOLS = ("A", "R", "E", "M", "B")
#: Decisions by ISO 14253-1, the least favourable first.
_DECISIONS = ("fail", "not measured", "not decided within the uncertainty", "pass")
#: Headings of `cells`.
HEADINGS = (
    *(
        "campaign",
        "machine",
        "axis",
        "date",
        "decision",
        "verdict",
        "drift / µm",
        *(f"{name} / µm" for name in _SYMBOLS),
    ),
    *("maximum / °C", "held-out error / µm"),
    *("anomalies", "warnings", "inputs", "exit code", "time / s", "memory / MB"),
)
#: Those of text; the others head numbers.
TEXT = ("campaign", "machine", "axis", "date", "decision", "verdict", "inputs")
#: What the page alone shows.
_COST = ("machine", "date", "time / s", "memory / MB")


def columns(rows: Sequence[Row]) -> dict[str, list[str]]:
    """Return the cells of all rows by heading, without columns in which no row has anything."""
    shown = zip(HEADINGS, zip(*map(cells, rows), strict=True), strict=True)
    return {heading: list(column) for heading, column in shown if set(column) != {"–"}}


def summary_table(rows: Sequence[Row], title: str) -> rich.table.Table:
    """Return the rows of a fleet as a table for the terminal."""
    printed = rich.table.Table(title=cell(title), title_justify="left")
    shown = {heading: column for heading, column in columns(rows).items() if heading not in _COST}
    for heading in shown:
        printed.add_column(heading, justify="left" if heading in TEXT else "right", overflow="fold")
    for line in zip(*shown.values(), strict=True):
        printed.add_row(*map(cell, line))
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
    shown = columns(rows)
    trends = draw_trends(rows)
    return render_page(
        "fleet.html.j2",
        embed({f"trend_{k}": chart for k, chart in enumerate(trends.values())}),
        ("fleet.js",),
        trends=[(f"trend_{k}", f"{name}. {_TREND}") for k, name in enumerate(trends)],
        counts=count_line(rows),
        started=f"{datetime.fromisoformat(started):%Y-%m-%d %H:%M} UTC",
        headings=[(heading[0].upper() + heading[1:], heading not in TEXT) for heading in shown],
        rows=[
            (row, quote(row.report), line[1:])
            for row, line in zip(rows, zip(*shown.values(), strict=True), strict=True)
        ],
        failed=[(row, quote(row.log)) for row in rows if row.state == "failed"],
        summary={"assumptions": {}},
    )


_TREND = "With expanded uncertainties (k = 2); dashed: control limits of a chart of individuals, from eight tests on."


def draw_trends(rows: Sequence[Row]) -> dict[str, Chart]:
    """Draw A, R and B over the dates of every axis that was tested three times or more; tests of a machine state it, or share a folder."""
    tests: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row.date and row.A_um is not None:
            tests.setdefault((row.machine or row.name.rpartition("/")[0], row.axis), []).append(row)
    charts = {}
    for (machine, axis), dated in tests.items():
        dates = np.array([row.date for row in dated], "datetime64[D]")
        for name in "ARB":
            values, u = (np.array([getattr(row, f"{name}_{key}") for row in dated], float) for key in ("um", "u_um"))
            if (chart := plot_trend(dates, values, u, name)) is not None:
                charts[", ".join(word for word in (machine, axis and f"axis {axis}", name) if word)] = chart
    return charts


#: Memory that a run is taken to need until one has been seen, bytes.
_USUAL_BYTES = 1e9
_POLL_S = 0.1
#: Time for runs that were asked to stop, s: a run ends within a second of itself.
_STOP_S = 0.7
#: Beside its own threads, libraries start one per processor in every process unless these say otherwise.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_PAGE, _TABLE, _BOOK, _LOGS = "fleet.html", "fleet.csv", "fleet.xlsx", "logs"


@dataclass
class _Running:
    """The process of a campaign, the monotonic time at which it began, s, and the largest memory seen so far, bytes."""

    process: subprocess.Popen[bytes]
    begun: float
    peak: float = 0.0

    def measure(self) -> float:
        """Return the memory of the process now, bytes, and keep the largest."""
        now = 0.0
        with suppress(psutil.Error):
            now = float(psutil.Process(self.process.pid).memory_info().rss)
        self.peak = max(self.peak, now)
        return now


def run_fleet(
    members: Sequence[Member],
    out: Path,
    *,
    jobs: int | None = None,
    resume: bool = False,
    report: Report = silent,
    say: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Run campaigns at the same time, each in a process of its own, and write one summary."""
    started = _now()
    campaigns = {member.name: member for member in members}
    rows = {member.name: Row(member.name) for member in members}
    jobs = jobs or usable_processors()

    def write_summary() -> None:
        write_json(out / SUMMARY, as_json([*rows.values()], started=started, finished=_now()))
        report("campaigns", sum(row.state not in ("waiting", "stopped") for row in rows.values()), len(rows))

    others = psutil.Process().children()
    with open_folder(out, resume=resume):
        claim(out, SUMMARY, _TABLE, _BOOK, _PAGE)
        for name, row in read_rows(out).items() if resume else ():
            # Rows of finished campaigns whose files and products are as an earlier fleet left them.
            if name in campaigns and row.is_whole and is_unchanged(campaigns[name], out / name):
                kept = with_findings(replace(row, state="kept"), out / name)
                rows |= {name: kept} if kept.is_whole else {}
        waiting = [name for name, row in rows.items() if row.state == "waiting"]
        running: dict[str, _Running] = {}
        largest = 0.0
        write_summary()
        try:
            while waiting or running:
                while waiting and has_room([*running.values()], jobs, largest or _USUAL_BYTES):
                    name = waiting.pop(0)
                    # Until it ends it is one that was stopped: a signal may come at any time.
                    rows[name] = replace(rows[name], state="stopped", log=f"{_LOGS}/{name}.log")
                    running[name] = _start(campaigns[name], out, rows[name].log, jobs=jobs, resume=resume)
                for name, one in list(running.items()):
                    one.measure()
                    if one.process.poll() is not None:
                        del running[name]
                        largest = max(largest, one.peak)
                        rows[name] = _ended(rows[name], one, campaigns[name], out)
                        write_summary()
                        say(rows[name])
                time.sleep(_POLL_S)
        finally:
            _stop(others)
            for name, one in running.items():
                rows[name] = replace(rows[name], seconds=round(time.monotonic() - one.begun, 1))
            write_summary()
            write_text(out / _TABLE, as_csv([*rows.values()]))
            write_atomically(out / _BOOK, lambda path: write_book(path, [*rows.values()]))
            write_text(out / _PAGE, render_fleet([*rows.values()], started=started))
    return list(rows.values())


def has_room(running: Sequence[_Running], jobs: int, largest: float) -> bool:
    """Whether another run may start: a processor is free, and `largest` bytes for it in addition to what those that run may still take."""
    if not running or len(running) >= jobs:
        return not running
    to_come = sum(max(largest - one.measure(), 0.0) for one in running)
    return float(psutil.virtual_memory().available) - to_come > largest


def _start(member: Member, out: Path, log: str, *, jobs: int, resume: bool) -> _Running:
    """Start the run of a campaign; everything that it says goes to its log."""
    folder = out / member.name
    command = ["run", str(member.campaign), "--out", str(folder), "--processes", "1"]
    command += ["--resume"] if resume and folder.is_dir() else []
    threads = str(max(usable_processors() // jobs, 1))

    (out / log).parent.mkdir(parents=True, exist_ok=True)
    with (out / log).open("wb") as stream:
        # A session of its own: a Ctrl-C at the terminal is for the fleet, which tells its runs to stop.
        process = start_module(
            "fusion.cli",
            *command,
            environment=dict.fromkeys(_THREAD_VARIABLES, threads) | {"PYTHONUNBUFFERED": "1"},
            stdout=stream,
            stderr=stream,
            start_new_session=True,
        )
    return _Running(process, time.monotonic())


def _ended(row: Row, one: _Running, member: Member, out: Path) -> Row:
    """Return the row of a run that has ended."""
    code: int = one.process.returncode
    # A process that a signal ended has a negative code; shells, and the command itself, say 128 and its number.
    exit_code = 128 - code if code < 0 else code
    seconds = round(time.monotonic() - one.begun, 1)
    row = replace(row, exit_code=exit_code, seconds=seconds, peak_MB=round(one.peak / 1e6))
    if code == 0:
        return with_findings(replace(row, state="finished"), out / row.name)
    # The row names the campaign: its folder need not be repeated, nor leave the machine with the summary.
    message = _last_message(out / row.log).replace(f"{member.campaign.parent}{os.sep}", "")
    if code == -9:
        message = "ended by the system, usually because memory ran out; run fewer at a time with --jobs"
    return replace(row, state="failed", message=message or f"ended with exit code {exit_code}; see {row.log}")


def _stop(others: Sequence[psutil.Process]) -> None:
    """Tell runs that are left to stop, also one that was being started; they keep their finished stages. Other children stay."""
    left = [process for process in psutil.Process().children() if process not in others]
    for process in left:
        with suppress(psutil.Error):
            process.terminate()
    psutil.wait_procs(left, timeout=_STOP_S)


def _last_message(log: Path) -> str:
    """Return the last thing that a run said of itself, without the name of the program."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    said = [line.removeprefix("thermofuse: ") for line in lines if line.startswith("thermofuse: ")]
    return said[-1] if said else next((line.strip() for line in reversed(lines) if line.strip()), "")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
