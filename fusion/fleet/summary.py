"""What a fleet found, one row per campaign: as JSON, as CSV, and as a table for the terminal."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import rich.table

from fusion.errors import FusionError
from fusion.products.results import read_results
from fusion.report.conclusions.answers import headline
from fusion.report.wording import measured, number
from fusion.terminal import cell

State = Literal["finished", "kept", "failed", "stopped", "waiting"]
SUMMARY = "fleet.json"


@dataclass(frozen=True)
class Row:
    """One campaign of a fleet and what became of it.

    Attributes
    ----------
    name : str
        Unique in the fleet.
    state : str
        "finished" now, "kept" from an earlier fleet, "failed", "stopped" in the middle, or "waiting" to be run.
    exit_code : int or None
        Of its run; None where it did not come to an end.
    title : str
        Title of the campaign.
    verdict : str
        Of the closed loop; empty where there is none.
    headline : str
        The verdict as a sentence.
    drift_um, drift_u_um : float or None, um
        Largest range of the drift over the targets, and its standard uncertainty.
    anomalies, warnings : int or None
        Positions that stand out, and warnings.
    inputs : str
        "sound", "corrected" or "doubted".
    message : str
        Why it failed.
    seconds : float
        Wall time of its run, s.
    peak_MB : float
        Largest memory of its process, MB; 0 where it was not measured.
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


def with_findings(row: Row, folder: Path) -> Row:
    """Return a row with what the results of its run say.

    Parameters
    ----------
    row : Row
        Of a campaign that was run.
    folder : Path
        Its results folder.

    Returns
    -------
    Row
        Failed, with the reason, where the results cannot be read.
    """
    try:
        results = read_results(folder)
    except (FusionError, OSError) as error:
        return replace(row, state="failed", message=str(error))
    drift = results.drift
    known = [] if drift is None else [k for k, value in enumerate(drift.range_um) if value is not None]
    most = max(known, key=lambda k: drift.range_um[k] or 0.0) if drift is not None and known else None
    return replace(
        row,
        title=results.campaign,
        verdict="" if results.loop is None else results.loop.verdict,
        headline="" if results.loop is None else headline(results),
        drift_um=None if drift is None or most is None else drift.range_um[most],
        drift_u_um=None if drift is None or most is None else drift.range_u_um[most],
        anomalies=None if results.anomalies is None else len(results.anomalies),
        warnings=len(results.warnings),
        inputs="" if results.inputs is None else results.inputs.state,
    )


def as_json(rows: Sequence[Row], *, started: str, finished: str) -> dict[str, Any]:
    """Return the content of ``fleet.json``.

    Parameters
    ----------
    rows : sequence of Row
    started, finished : str
        Times, UTC.
    """
    campaigns = [{**asdict(row), "report": row.report} for row in rows]
    return {"software": "thermofuse", "schema": 1, "started": started, "finished": finished, "campaigns": campaigns}


def read_rows(folder: Path) -> dict[str, Row]:
    """Return the rows of an earlier fleet by name; none where there is no ``fleet.json`` of this layout.

    Parameters
    ----------
    folder : Path
        Results folder of the fleet.
    """
    names = {field.name for field in fields(Row)}
    try:
        content = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        rows = [Row(**{key: item[key] for key in names}) for item in content["campaigns"]]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return {row.name: row for row in rows}


#: Columns of the CSV.
_COLUMNS = tuple(field.name for field in fields(Row))


def as_csv(rows: Sequence[Row]) -> str:
    """Return the content of ``fleet.csv``: one line per campaign, no text of which a spreadsheet takes for a formula.

    Parameters
    ----------
    rows : sequence of Row
    """
    written = io.StringIO()
    writer = csv.writer(written, lineterminator="\n")
    writer.writerow([*_COLUMNS, "report"])
    for row in rows:
        values = [*(getattr(row, name) for name in _COLUMNS), row.report]
        writer.writerow([_no_formula(value) if isinstance(value, str) else value for value in values])
    return written.getvalue()


def _no_formula(text: str) -> str:
    """Return a text with an apostrophe before a sign with which formulas begin."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


def cells(row: Row) -> list[str]:
    """Return a row as page and terminal show it: name, verdict, drift, positions that stand out, warnings, inputs, exit code.

    Parameters
    ----------
    row : Row
    """
    return [
        row.name,
        row.verdict.replace("_", " ") or ("not modelled" if row.is_whole else row.state),
        "–" if row.drift_um is None else measured(row.drift_um, row.drift_u_um, "µm"),
        *("–" if count is None else str(count) for count in (row.anomalies, row.warnings)),
        row.inputs or "–",
        "–" if row.exit_code is None else str(row.exit_code),
        number(row.seconds, 3) if row.seconds else "–",
        f"{row.peak_MB:.0f}" if row.peak_MB else "–",
    ]


#: Headings of `cells`.
HEADINGS = ("campaign", "verdict", "drift", "anomalies", "warnings", "inputs", "exit code", "time / s", "memory / MB")
#: Those of text; the others head numbers. The terminal shows them up to the exit code.
TEXT = ("campaign", "verdict", "inputs")
_SHOWN = 7


def summary_table(rows: Sequence[Row], title: str) -> rich.table.Table:
    """Return the rows of a fleet as a table for the terminal.

    Parameters
    ----------
    rows : sequence of Row
    title : str
        Line above the table.
    """
    printed = rich.table.Table(title=cell(title), title_justify="left")
    for heading in HEADINGS[:_SHOWN]:
        printed.add_column(heading, justify="left" if heading in TEXT else "right", overflow="fold")
    for row in rows:
        printed.add_row(*map(cell, cells(row)[:_SHOWN]))
    return printed


def count_line(rows: Sequence[Row]) -> str:
    """Return how many campaigns ended how, in words.

    Parameters
    ----------
    rows : sequence of Row
    """
    counts = {
        state: sum(row.state == state for row in rows) for state in ("finished", "kept", "failed", "stopped", "waiting")
    }
    words = {
        "finished": "finished",
        "kept": "kept from before, unchanged",
        "failed": "failed",
        "stopped": "stopped",
        "waiting": "not started",
    }
    told = [f"{count} {words[state]}" for state, count in counts.items() if count]
    return f"{len(rows)} campaigns: {', '.join(told)}"
