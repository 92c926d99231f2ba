"""A test by ISO 230-3 as report, page and terminal show it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import rich.table

from fusion.report.wording import Table, Words, print_table, quantity, table
from fusion.results.numbers import measured, number, print_unit, small
from fusion.results.thermal_test import ThermalDistortion, ThermalTest

if TYPE_CHECKING:
    from fusion.analysis.drift_model.verification import ChannelVerdict

_PERIODS = ("first_hour", "whole", "last_hour", "change")
_TITLES = ("first 60 min", "whole test", "last 60 min", "last − first")
_KINDS = {
    "environment": "Environmental temperature variation (ETVE)",
    "spindle": "Distortion by the rotating spindle",
    "linear axis": "Distortion by a moving linear axis",
    "rotary axis": "Distortion by rotary motion",
    "not stated": "Kind of test not stated",
}

#: Curves of one chart of a test; the others are in the table.
DRAWN = 8


def describe_thermal_tests(tests: Sequence[ThermalTest]) -> list[dict[str, Any]]:
    """Return what the templates state of every test."""
    return [
        {
            "title": f"{_KINDS[test.kind]}{', run ' + test.run if test.run else ''}, {number(test.duration_h)} h",
            "distortions": _distortions(test.distortions, "Displacement or tilt"),
            "temperatures": _distortions(test.temperatures, "Temperature") if test.temperatures else None,
            "budget": _budget(test),
            "remarks": test.remarks,
            "drawn": DRAWN,
        }
        for test in tests
    ]


def _budget(test: ThermalTest) -> Table:
    units = {one.name: print_unit(one.unit) for one in test.distortions}
    rows = [
        [
            one.name,
            one.source,
            "–" if one.u is None else f"{small(one.u)} {units.get(one.name, '')}".strip(),
            one.origin,
        ]
        for one in test.contributions
    ]
    return table([Words("Quantity"), Words("Source"), "u (k = 1)", Words("Origin")], rows)


def _distortions(found: Sequence[ThermalDistortion], title: str) -> Table:
    rows = [
        [
            one.name,
            print_unit(one.unit),
            *(quantity(getattr(one, period)) for period in _PERIODS),
            "–" if one.settling_min is None else number(one.settling_min, 3),
        ]
        for one in found
    ]
    return table([Words(title), Words("Unit"), *_TITLES, "settled after / min"], rows)


def thermal_test_tables(tests: Sequence[ThermalTest], *, title: str) -> list[rich.table.Table]:
    """Return the tables of tests for the terminal."""
    return [
        print_table(shown, f"{title}, {described['title']}" if name == "distortions" else name)
        for described in describe_thermal_tests(tests)
        for name in ("distortions", "temperatures", "budget")
        if (shown := described[name]) is not None
    ]


def verification_table(verdicts: Sequence[ChannelVerdict], *, title: str) -> rich.table.Table:
    """Return what was predicted and achieved for the terminal."""
    rows = [
        [
            one.name,
            "–" if one.before_um is None else number(one.before_um),
            f"{number(one.predicted_um)} [{number(one.predicted_low_um)} to {number(one.predicted_high_um)}]",
            number(one.achieved_um),
            measured(one.gain, one.gain_u),
            one.fault or "as predicted",
        ]
        for one in verdicts
    ]
    titles = ["without / µm", "predicted [95 %] / µm", "achieved / µm", "gain (k = 2)"]
    return print_table(table([Words("Displacement"), *titles, Words("Verdict")], rows), title)
