"""The report of a record: the facts that its templates state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from fusion.analysis.alignment.sensor_health import describe_fault
from fusion.analysis.levels import RECORD_ENTRY_LEVEL
from fusion.report.campaign import DECIDED_BEFORE, MOST_STEPS, errors_table, refused_effects, steps_table
from fusion.report.findings import first_screen, headline, next_steps
from fusion.report.thermal_test import describe_thermal_tests
from fusion.results.loop import RecordLoop
from fusion.results.numbers import duration, join, moment
from fusion.results.progress import counted
from fusion.results.results import Results

#: Largest number of channels with charts; all of them are in fusion.nc.
_MOST_CHANNELS = 6
#: Sections of the report with their titles in the contents.
_SECTIONS = (
    ("next", "What to do"), ("record", "Record"), ("iso230-3", "ISO 230-3"), ("loop", "Cause"),
    ("chained", "Forward chaining"), ("data", "Data"),
    ("uncertainty", "Uncertainty"), ("glossary", "Glossary"), ("provenance", "Provenance"),
)  # fmt: skip
_ERRORS = ("rmse_persistence_um", "rmse_declared_um", "rmse_final_um")


def shown_channels(record: xr.Dataset) -> list[str]:
    """Return the channels that get charts."""
    return [str(name) for name in record["channel"].values[:_MOST_CHANNELS]]


def describe_record(results: Results, record: xr.Dataset, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return the facts of a record that the templates of its report state."""
    loop = results.loop
    assert isinstance(loop, RecordLoop)
    first, last = record["time"].values[[0, -1]]
    block_s = float(record.attrs["block_s"])
    span = duration(float((last - first) / np.timedelta64(1, "s")) + block_s)
    # The times of a record whose campaign file does not state the beginning count from zero.
    start = first if first >= np.datetime64("1971-01-01") else None
    channels, drivers = (join([str(name) for name in record[dim].values]) for dim in ("channel", "driver_name"))
    zone = results.time.zone if results.time else None
    begun = "start not stated" if start is None else moment(start, zone)
    tested = results.iso230_3[0].distortions if results.iso230_3 else ()
    distances = [one for one in tested if one.name in shown_channels(record)]
    return {
        "zone": zone,
        "figures": (),
        "verdict": loop.verdict,
        "headline": headline(results),
        "doubts": (),
        "unverified": (),
        "untouched": "",
        "measured": (
            f"{counted(record.sizes['channel'], 'displacement')} and {counted(record.sizes['sensor'], 'temperature')} over "
            f"{_measured_time(loop, span)}" + (f", with {drivers} as driver" if drivers else "")
        ),
        "first_screen": first_screen(
            results, provenance["parameters"].get("report", {}), "", "" if start is None else begun
        ),
        "next": next_steps(results)[:MOST_STEPS],
        "contents": [one for one in _SECTIONS if one[0] != "iso230-3" or results.iso230_3],
        "thermal_tests": describe_thermal_tests(results.iso230_3 or ()),
        "assumptions": {"iso230-3": ""},
        "laser": None,
        "camera": None,
        "thermograms": None,
        "data": [
            ("Channels", channels),
            ("Sensors", join([str(name) for name in record["sensor"].values])),
            ("Time", f"{begun}, {span}; averaged over {record.sizes['time']} blocks of {duration(block_s)}"),
        ],
        "shown": list(enumerate(shown_channels(record))),
        "moved": max(distances, key=lambda one: one.whole.value or 0.0, default=None),
        "omitted": max(0, record.sizes["channel"] - _MOST_CHANNELS),
        "faults": [(one, describe_fault(one)) for one in loop.sensor_faults],
        "steps": steps_table(loop),
        "errors": errors_table(loop),
        "error_keys": _ERRORS,
        "refused": refused_effects(loop),
        "chained_means": {name: _mean_chained(loop, name) for name in _ERRORS},
        "levels": {"entry": RECORD_ENTRY_LEVEL},
        "decided_before": DECIDED_BEFORE,
    }


def _mean_chained(loop: RecordLoop, name: str) -> float | None:
    """Return an error, mean over the forward-chained parts, um."""
    values = [getattr(part, name) for part in loop.chained if getattr(part, name) is not None]
    return float(np.mean(values)) if values else None


def _measured_time(loop: RecordLoop, span: str) -> str:
    """Return how long was measured; of several runs without the time between them."""
    hours = [run.duration_h for run in loop.runs if run.duration_h is not None]
    if not hours or len(hours) < len(loop.runs):
        return span
    return f"{duration(3600.0 * sum(hours))} in {counted(len(hours), 'run')}"
