"""Single readings: the checks that hold for every table, and the Dataset of all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from interferometry.io.faults import LaserFormatError
from interferometry.io.readings import Reading, Readings, check_and_assemble, number_targets, turn_by_travel

NAT = np.datetime64("NaT", "ns")


def given(*cells: tuple[int, str, int, float], kind: str = "length") -> Readings:
    """Readings without times whose deviation is their place in the list."""
    readings = [Reading(2 + i, *cell, NAT, float(i)) for i, cell in enumerate(cells)]
    return Readings(Path("t.csv"), kind, readings)  # type: ignore[arg-type]


def test_readings_are_laid_out_by_cycle_direction_and_target() -> None:
    test = check_and_assemble(given((1, "positive", 1, 0.0), (1, "positive", 2, 20.0), (2, "negative", 2, 20.0)))
    assert test["deviation"].sel(cycle=2, direction="negative", target=2) == 2.0
    assert test.attrs["missing"] == 5
    assert test["time"].attrs["origin"] == "none"


def test_the_units_of_a_rotary_axis_stand_at_its_variables() -> None:
    test = check_and_assemble(given((1, "positive", 1, 0.0), kind="angle"))
    assert (test["deviation"].attrs["units"], test["position"].attrs["units"]) == ("arcsec", "deg")


def test_a_repeated_reading_is_named_and_the_first_kept() -> None:
    test = check_and_assemble(given((1, "positive", 1, 0.0), (1, "positive", 1, 0.0)))
    assert test["deviation"].values[0, 0, 0] == 0.0
    assert "already stands on line 2, which is kept" in test.attrs["left_out"]


def test_targets_that_move_are_refused() -> None:
    with pytest.raises(LaserFormatError, match=r"target 1 stands at 0.0 mm on line 2 but at 5.0 mm elsewhere \(4 of 4"):
        check_and_assemble(given(*((cycle, "positive", 1, 10.0 * (cycle > 2)) for cycle in (1, 2, 3, 4))))


def test_positions_number_the_targets_within_their_tolerance() -> None:
    assert number_targets([20.0, 0.0, 20.00001, -5.0]) == [3, 2, 3, 1]


def test_without_times_forward_is_positive_and_this_is_told() -> None:
    readings = given((1, "positive", 1, 0.0), (1, "positive", 2, 20.0))
    turn_by_travel(readings)
    assert [reading.direction for reading in readings.readings] == ["positive", "positive"]
    assert json.loads(check_and_assemble(readings).attrs["notes"]) == [
        "forward was taken as the positive direction: the file gives no times that tell the travel"
    ]


def test_times_without_seconds_are_told() -> None:
    cells = ((1, "positive", 1, 0.0), (1, "positive", 2, 20.0), (1, "negative", 2, 20.0))
    minutes = (0, 0, 1)
    readings = [
        Reading(2 + i, *cell, np.datetime64(f"2026-03-09T06:0{minute}", "ns"), 0.0)
        for i, (cell, minute) in enumerate(zip(cells, minutes, strict=True))
    ]
    test = check_and_assemble(Readings(Path("t.csv"), "length", readings, zones={"+0000": 2}))
    assert json.loads(test.attrs["notes"]) == [
        "warning: the times have no seconds, and 1 readings share theirs with others: export them with seconds"
    ]
