"""The header: every line is one line of ASCII, and says where the table comes from."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime

from fusion.products.results import read_results
from fusion.products.store import read_dataset
from fusion.report.exports.header import header_lines, read_origin
from fusion.report.exports.thermal_state import read_thermal_state


def lines_of(folder, **changes) -> list[str]:
    state = read_thermal_state(folder, read_dataset(folder / "deviations.nc"))
    origin = read_origin(folder, read_results(folder), state)
    stated = {
        "words": "A control",
        "axis": "X",
        "content": ["12 points"],
        "sign": "plus",
        "objections": [],
        "remarks": [],
    }
    return header_lines(origin, **{**stated, **changes}, exported=datetime(2026, 11, 22, 9, 30, tzinfo=UTC))


def test_the_header_names_source_state_and_trial(small_run) -> None:
    lines = lines_of(small_run)
    assert lines[0] == "Compensation table for A control, by thermofuse"
    digest = hashlib.sha256((small_run / "results.json").read_bytes()).hexdigest()
    assert lines[-1] == f"source: results.json, SHA-256 {digest}"
    assert {
        "machine: Mill 5, serial number 77",
        "axis: X",
        "verdict on the drift: explained",
        "exported: 2026-11-22 09:30 UTC",
        "12 points",
        "sign: plus",
    } <= set(lines)
    assert any(line.startswith("How to try it: ") and "one value of 0.010 mm" in line for line in lines)
    assert not any(line.startswith("FORCED") for line in lines)


def test_a_title_from_a_file_stays_on_its_line(small_run) -> None:
    """The title holds a line break and a command; a control would run what stands on a line of its own."""
    lines = lines_of(small_run, objections=["the verdict is\npartial"])
    assert "campaign: =1+1  ; M30 axis u" in lines
    assert lines[1] == "FORCED, although the verdict is partial"
    assert all(line.isascii() and line.isprintable() for line in lines)


def test_what_is_not_stated_is_said(small_run, tmp_path) -> None:
    for name in ("deviations.nc", "results.json"):
        (tmp_path / name).write_bytes((small_run / name).read_bytes())
    lines = lines_of(tmp_path, axis="")
    assert {
        "machine: not stated",
        "axis: not stated",
        "compensation that was active during the test: not stated",
    } <= set(lines)
