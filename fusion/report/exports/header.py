"""The header of a compensation table: where it comes from, in which thermal state it holds, what it is predicted to do, how to try it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from fusion.products.results import Results
from fusion.products.store import DamagedProductError, file_sha256
from fusion.report.exports.thermal_state import ThermalState

_NOT_STATED = "not stated"


@dataclass(frozen=True)
class Origin:
    """The run that a table was made from.

    Attributes
    ----------
    campaign, machine, axis, active : str
        As the campaign file states them, machine with its serial number, `active` the compensation during the test; empty where it does
        not.
    verdict : str
        Verdict of the closed loop; empty where there was none.
    state : ThermalState
        When and how warm.
    results_sha256 : str
        SHA-256 of ``results.json``.
    """

    campaign: str
    machine: str
    axis: str
    active: str
    verdict: str
    state: ThermalState
    results_sha256: str


def read_origin(folder: Path, results: Results, state: ThermalState) -> Origin:
    """Return where a table comes from.

    Parameters
    ----------
    folder : Path
        Results folder; machine and axis are in ``provenance.json``.
    results : Results
        Results of the run.
    state : ThermalState
        When and how warm.
    """
    stated = _parameters(folder / "provenance.json")
    report = stated.get("report", {})
    serial = report.get("machine_serial_number")
    return Origin(
        campaign=results.campaign,
        machine=", serial number ".join(str(part) for part in (report.get("machine"), serial) if part),
        active=str(report.get("machine_compensation") or ""),
        axis=str(stated.get("campaign", {}).get("axis") or ""),
        verdict=results.loop.verdict if results.loop is not None else "",
        state=state,
        results_sha256=file_sha256(folder / "results.json"),
    )


def header_lines(
    origin: Origin,
    *,
    words: str,
    axis: str,
    content: Sequence[str],
    sign: str,
    objections: Sequence[str],
    remarks: Sequence[str],
    exported: datetime,
) -> list[str]:
    """Return the header of a table as lines of ASCII text.

    Parameters
    ----------
    origin : Origin
        The run.
    words : str
        The control.
    axis : str
        Axis in the control.
    content : sequence of str
        What the table holds and is predicted to do, one line each.
    sign : str
        Sign convention.
    objections : sequence of str
        Why the table should not have been made; it was forced.
    remarks : sequence of str
        What to know of single positions.
    exported : datetime
        Time of the export, UTC.
    """
    forced = [f"FORCED, although {reason}" for reason in objections]
    lines = [
        f"Compensation table for {words}, by thermofuse",
        *forced,
        f"campaign: {origin.campaign}",
        f"machine: {origin.machine or _NOT_STATED}",
        f"axis: {axis or _NOT_STATED}",
        f"measured: {origin.state.period()}",
        f"exported: {exported:%Y-%m-%d %H:%M} UTC",
        f"thermal state: {origin.state.sentence()}",
        f"verdict on the drift: {origin.verdict or 'not modelled'}",
        *content,
        f"sign: {sign}",
        *remarks,
        f"compensation that was active during the test: {origin.active or _NOT_STATED}",
        "Not on top of an active table: what was measured is what the table that was active during the test left.",
        "How to try it: switch the compensation on with one value of 0.010 mm and check with the laser in which direction the axis "
        "moves; then load the table, repeat the measurement of both approaches in the thermal state above, and compare.",
        f"source: results.json, SHA-256 {origin.results_sha256}",
    ]
    return [_one_line(line) for line in lines]


def _parameters(path: Path) -> Mapping[str, Any]:
    """Return the campaign as the provenance of a run states it; empty where the file is absent."""
    if not path.is_file():
        return {}
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")).get("parameters", {}))
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise DamagedProductError(
            f"{path}: is damaged or no product of thermofuse ({type(error).__name__}); run the campaign again"
        ) from None


def _one_line(text: str) -> str:
    """Return a text without line breaks and control characters, in ASCII: it may come from a file, and controls read no UTF-8."""
    plain = "".join(letter if letter.isprintable() else " " for letter in text)
    for found, written in (("µ", "u"), ("μ", "u"), ("−", "-"), ("–", "-"), ("±", "+-"), ("°C", "degC")):
        plain = plain.replace(found, written)
    return plain.encode("ascii", "replace").decode("ascii")
