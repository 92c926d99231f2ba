"""Logged tables: units come from the headings, rows that cannot be used are listed, a record keeps its numbers."""

from __future__ import annotations

import json
import os
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from fusion.campaign.config import CampaignError, DriversTable, HeaderRows, load_campaign
from fusion.campaign.draft import Asker, write_campaign
from fusion.campaign.inputs import pipe_notices, read_record
from fusion.campaign.logs import (
    ContactSensors,
    TableError,
    _formatted_times,
    _usual_step_s,
    read_drivers,
    read_rows,
    read_sensors,
    split_heading,
    unwrapped,
)
from tests.fusion.campaign_parts import without

RECORD = """\
[campaign]
title = "Spindle"

[record]
file = "{file}"
time = "{time}"
temperatures = ["t*"]
displacements = ["ch*"]
drivers = ["spindle*"]
{more}
"""


def record(folder: Path, content: str, *, time: str = "time [min]", more: str = "") -> Path:
    (folder / "record.csv").write_text(content, encoding="utf-8")
    (folder / "campaign.toml").write_text(RECORD.format(file="record.csv", time=time, more=more), encoding="utf-8")
    return folder / "campaign.toml"


def test_a_column_without_a_unit_is_refused() -> None:
    with pytest.raises(TableError, match=r'the column "duty" has no unit; .* for example "duty \[1\]"'):
        split_heading(Path("drivers.csv"), "duty")


@pytest.mark.parametrize(
    ("text", "how", "columns", "lines", "units", "odd"),
    [
        ('a,b\n1,"x\ny"\n2,z\n3,4,5\n', {}, {"a": [1, 2], "b": ["x\ny", "z"]}, [2, 4], {}, [(5, "3 fields")]),
        ("a,b\n1,2\n# 3,4\n\n5,6\n", {}, {"a": ["1", "# 3", "5"], "b": [2, 4, 6]}, [2, 3, 5], {}, [(3, "# 3")]),
        ("t,T,n\n1,20 °C,4\n2,68 °F,5\n3,,6\n", {}, {"t": [1, 2, 3], "T": [20.0, 20.0, None], "n": [4, 5, 6]}, [2, 3, 4],
         {"T": "degC"}, []),
        ("t,T,unit\n1,20,°C\n2,21,°C\n", {}, {"t": [1, 2], "T": [20, 21], "unit": ["°C", "°C"]}, [2, 3], {"T": "°C"}, []),
        ("t,T\n0,20\n1,-999\n2,---\n3,1e38\n4,24\n", {"missing": [-999]},
         {"t": [0, 1, 2, 3, 4], "T": ["20", None, "---", "1e38", "24"]}, [2, 3, 4, 5, 6], {}, [(3, "-999"), (4, "---"), (5, "1e38")]),
        ("t,T\n0,20\n1,21\n2,22\nMean,21\nMax,22\n", {}, {"t": ["0", "1", "2"], "T": [20, 21, 22]}, [2, 3, 4], {},
         [(5, "Mean"), (6, "Max")]),
        ("t;Z\n0;1,234\n1;12,345\n2;1,234,567\n", {}, {"t": [0, 1, 2], "Z": ["1234", "12345", "1234567"]}, [2, 3, 4], {}, []),
        ("Mill\nt;T;Z\ns;°C;mm\n0;20,5;1\n30;21,5;2\n", {"header": HeaderRows(names=2, units=3, values=4)},
         {"t": [0, 30], "T": [20.5, 21.5], "Z": [1, 2]}, [4, 5], {"t": "s", "T": "°C", "Z": "mm"}, []),
        ("0;20,5;1\n30;21,5;2\n", {"header": HeaderRows(values=1)}, {"1": [0, 30], "2": [20.5, 21.5], "3": [1, 2]}, [1, 2], {}, []),
        ("t   oil temp  Z\n0   20.5      1.5\n30            2.5\n60  22.5      3.5\n90  23.5      4.5\n", {},
         {"t": [0, 30, 60, 90], "oil temp": [20.5, None, 22.5, 23.5], "Z": [1.5, 2.5, 3.5, 4.5]}, [2, 3, 4, 5], {}, []),
        ("t,T\n20260309063000,20\n20260309063100,21\n", {}, {"t": ["20260309T063000", "20260309T063100"], "T": [20, 21]}, [2, 3], {}, []),
    ],
)  # fmt: skip
def test_rows_of_a_text(
    tmp_path: Path, text: str, how: dict[str, Any], columns: dict[str, list[Any]], lines: list[int], units: dict[str, str],
    odd: list[tuple[int, str]],
) -> None:  # fmt: skip
    (tmp_path / "log.csv").write_text(text, encoding="utf-8")
    rows = read_rows(tmp_path / "log.csv", **how)
    assert rows.frame.astype(object).where(rows.frame.notna(), None).to_dict("list") == columns
    assert rows.frame.index.tolist() == lines and rows.units == units
    assert [(one.line, one.value) for one in [*rows.left_out, *chain(*rows.marks.values())]] == odd


@pytest.mark.parametrize(
    ("form", "texts", "seconds"),
    [
        ("%H%M%S", ["93005.0", "235959", "000001"], [34205, 86399, 86401]),
        ("%H:%M:%S", ["23:59:59", "24:00:01"], [86399, 86401]),
        ("%M:%S", ["59:59", "60:01"], [3599, 3601]),
        ("%d.%m.%Y %H:%M", ["02.01.1970 00:01", "?"], [86460, None]),
    ],
)
def test_times_of_a_stated_form_count_on_over_midnight(form: str, texts: list[str], seconds: list[int | None]) -> None:
    stated = DriversTable(file="log.csv", time="t", time_format=form)
    expected = ["NaT" if one is None else np.datetime64(one, "s") for one in seconds]
    found, _ = _formatted_times(Path("log.csv"), pd.Series(texts), stated)
    np.testing.assert_array_equal(found, np.array(expected, "M8[ns]"))


def test_a_counter_that_begins_again_counts_on_and_pauses_are_several_steps() -> None:
    np.testing.assert_array_equal(
        unwrapped(np.array([65534.0, np.nan, 65535, 0, 1]))[0], [65534, np.nan, 65535, 65536, 65537]
    )
    assert unwrapped(np.array([2.0**32 - 1, 0.0, 1.0]))[1].startswith(
        "; its counter of 32 bits begins again at 0 (1 time)"
    )
    falling = np.array([65535.0, 60000.0, 60001.0, 60002.0])
    assert unwrapped(falling) == (pytest.approx(falling), "")
    assert _usual_step_s(np.array([0.0, 10.0, 20.0, 30.0, 100.0])) == 10.0


def test_drivers_are_sorted_and_bad_lines_listed(tmp_path: Path) -> None:
    path = tmp_path / "drivers.csv"
    path.write_text(
        "time,duty [1],speed [1/min]\n"
        "2026-03-09T06:31:00+00:00,0.5,1000\n"
        "2026-03-09T07:30:00+01:00,0.4,900\n"
        "2026-03-09T06:32:00+00:00,much,900\n"
        "2026-03-09T06:31:00+00:00,0.6,1000\n"
        "2026-03-09T06:33:00+00:00,0.7,1100\n"
    )
    drivers = read_drivers(path)
    np.testing.assert_array_equal(drivers["duty"].values, [0.4, 0.5, 0.7])
    assert drivers["speed"].attrs["units"] == "1/min"
    assert str(drivers["time"].values[0]) == "2026-03-09T06:30:00.000000000"
    assert [(one["line"], one["value"]) for one in json.loads(drivers.attrs["left_out"])] == [
        (4, "much"), (5, "2026-03-09T06:31:00+00:00"),
    ]  # fmt: skip
    path.write_text("time\n2026-03-09T06:31:00+00:00\n")
    with pytest.raises(TableError, match=r'there is no column apart from time; add one named "name \[unit\]"'):
        read_drivers(path)
    path.write_text("time,t [degC],t [K]\n2026-03-09T06:31:00+00:00,1,2\n")
    with pytest.raises(TableError, match="more than one column is named t; give each its own name"):
        read_drivers(path)
    path.write_text("stamp,t [degC],t (degC)\n2026-03-09T06:31:00+00:00,1,2\n")
    with pytest.raises(TableError, match="more than one column is named t degC; give each its own name"):
        read_drivers(path, DriversTable(file="drivers.csv", time="stamp").layout)


def test_drivers_of_another_layout_are_those_of_headings_that_say_everything(tmp_path: Path) -> None:
    """A logger's table: a line about the station, a row of units, a mark for no reading, local times with day and month swapped."""
    (tmp_path / "plain.csv").write_text(
        "time,Speed [rpm],Load [%]\n2026-03-09T06:30:00,900,10\n2026-03-09T06:31:00,1000,20\n"
    )
    (tmp_path / "logger.csv").write_text(
        "Station 7\nStamp;RECORD;Speed;Load\n;RN;rpm;%\n09/03/2026 06:30;1;900;10\n09/03/2026 06:31;2;1000;20\n09/03/2026 06:32;3;-999;20\n"
    )
    layout = DriversTable.model_validate(
        {"file": "logger.csv", "header_rows": {"names": 2, "units": 3, "values": 4}, "time": "Stamp", "missing": [-999],
         "time_format": "%d/%m/%Y %H:%M", "columns": {"Speed": "rpm", "Lo*": {"role": "driver"}}}
    ).layout  # fmt: skip
    plain, logged = read_drivers(tmp_path / "plain.csv"), read_drivers(tmp_path / "logger.csv", layout)
    xr.testing.assert_equal(plain, logged)
    assert plain["time"].attrs == logged["time"].attrs and logged["Speed"].attrs["units"] == "rpm"
    assert [one["line"] for one in json.loads(logged.attrs["left_out"])] == [6]
    assert DriversTable(file="drivers.csv", time_zone="Europe/Vienna").layout is None


@pytest.mark.parametrize(
    ("delimiter", "point", "end"), [(",", ".", ""), (";", ",", ""), (";", ".", ""), ("\t", ".", ""), (";", ",", ";")]
)
def test_a_record_may_be_written_as_any_spreadsheet_does(tmp_path: Path, delimiter: str, point: str, end: str) -> None:
    lines = ["time [min]|t1 [degC]|ch1 [um]|spindle [rpm]", "0|20.5|1.25|0", "1|21.5|-2.5|500"]
    written = [line.replace("|", delimiter) for line in lines[:1]]
    written += [line.replace(".", point).replace("|", delimiter) + end for line in lines[1:]]
    data = read_record(load_campaign(record(tmp_path, "# logger 7\n" + "\n".join(written) + "\n")))
    np.testing.assert_array_equal(data["temperature"].values[:, 0], [20.5, 21.5])
    np.testing.assert_array_equal(data["displacement"].values[:, 0], [1.25, -2.5])


def test_a_number_sign_in_a_heading_is_part_of_it_and_lines_are_counted_in_the_file(tmp_path: Path) -> None:
    rows = "".join(f"{k},20,1,0\n" for k in range(5))
    campaign = record(
        tmp_path, f"# logger 7\ntime [min],t #1 [degC],ch1 [um],spindle [rpm]\n{rows}?,20,1,0\n5,20,1,0,7\n"
    )
    data = read_record(load_campaign(campaign))
    assert data["sensor"].values.tolist() == ["t #1"]
    assert data.sizes["time"] == 5
    no_time, misfit = json.loads(data.attrs["left_out"])
    assert misfit == {"path": "record.csv", "line": 9, "value": "5 fields", "reason": "4 were expected"}
    assert (no_time["line"], no_time["value"]) == (8, "?")


@pytest.mark.parametrize(
    ("content", "time", "message"),
    [
        ("time [min],t1 [bar],ch1 [um],spindle [rpm]\n0,1,1,1\n1,1,1,1\n", "time [min]", r'"t1 \[bar\]": "bar" is not a unit'),
        ("time [min],t1 [degC],ch1 [um],spindle [rpm]\n0,20,1,1,5\n1,21,1,1,5\n", "time [min]", "more fields than the header names"),
        ("time [min],t1 [degC],ch1,spindle [rpm]\n0,1,1,1\n1,1,1,1\n", "time [min]", 'the column "ch1" has no unit'),
        ("time [min],t1 [degC],ch1 [um],spindle [rpm]\n0,a,1,1\n1,b,1,1\n", "time [min]", r'the column "t1 \[degC\]" contains no numbers'),
        ("time [min],t1 [degC],ch1 [um]\n0,1,1\n1,1,1\n", "time [min]", r'no column is named "spindle\*"'),
        ("time [min],t1 [degC],ch1 [um],spindle [rpm]\n0,1,1,1\n", "clock [s]", r'no column is named "clock \[s\]"'),
    ],
)  # fmt: skip
def test_records_that_cannot_be_used_name_the_column(tmp_path: Path, content: str, time: str, message: str) -> None:
    campaign = record(tmp_path, content, time=time)
    with pytest.raises(ValueError, match=message):
        read_record(load_campaign(campaign))


def test_one_mark_for_no_reading_costs_one_reading(tmp_path: Path) -> None:
    """A column with such a mark is text; its decimal commas and typographic minus signs are numbers all the same."""
    rows = ["Zeit [s];T1 [°C];Z [µm]", "0;20,5;1,5", "30;21;---", "60;22,5;\u22122,5", "90;n/a;3"]
    path = tmp_path / "campaign.toml"
    path.write_text(
        '[campaign]\ntitle = "Record"\n[record]\nfile = "log.csv"\ntime = "Zeit [s]"\ntemperatures = ["T1 [°C]"]\n'
        'displacements = ["Z [µm]"]\n',
        encoding="utf-8",
    )
    for encoding in ("utf-8", "utf-16"):
        (tmp_path / "log.csv").write_text("\n".join(rows) + "\n", encoding=encoding)
        table = read_record(load_campaign(path))
        np.testing.assert_array_equal(table["temperature"].values.ravel(), [20.5, 21.0, 22.5, np.nan])
        np.testing.assert_array_equal(table["displacement"].values.ravel(), [1.5, np.nan, -2.5, 3.0])
    (tmp_path / "log.csv").write_text("\n".join(rows).replace("\u2212", "-") + "\n", encoding="cp1252")
    assert read_record(load_campaign(path))["temperature"].values[2, 0] == 22.5


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("oil in/out", 'call it for example "oil in-out"'),
        ("deviation", 'the name of a result; rename it, for example "logged deviation"'),
        ("duty_series", "the name of a result"),
        ("warm_up", "the name of a result"),
    ],
)
def test_names_that_the_products_cannot_keep_are_refused(tmp_path: Path, name: str, message: str) -> None:
    path = tmp_path / "drivers.csv"
    path.write_text(f"time,{name} [1]\n2026-03-09T06:00:00Z,1\n2026-03-09T06:01:00Z,2\n")
    with pytest.raises(TableError, match=message):
        read_drivers(path)


# Contact sensors of a campaign file: read in degC, each with its place on the plan.


SENSORS = '\n[sensors]\nfile = "sensors.csv"\nplaces = "places.csv"\n'
LOG = "time,t1 [degC],t2 [K]\n2026-03-09T08:00:00Z,20.0,293.15\n2026-03-09T08:01:00Z,20.5,293.35\n"
PLACES = "name,x_mm,y_mm\nt1,500,90\nt2,200,90\n"


def read(folder: Path, log: str = LOG, places: str = PLACES) -> ContactSensors | None:
    (folder / "sensors.csv").write_text(log, encoding="utf-8")
    (folder / "places.csv").write_text(places, encoding="utf-8")
    return read_sensors(load_campaign(without(folder / "campaign.toml", "thermography", added=SENSORS)))


def test_temperatures_are_read_with_their_places(copied: Path) -> None:
    sensors = read(copied)
    assert sensors is not None and sensors.names == ["t1", "t2"]
    assert sensors.temperature.values[-1].tolist() == pytest.approx([20.5, 20.2])
    assert sensors.x_mm.tolist() == [500.0, 200.0] and sensors.u_K == 0.2


def test_a_sensor_may_have_a_name_that_no_driver_can_have(copied: Path) -> None:
    sensors = read(
        copied,
        LOG.replace("t1", "in/out").replace("t2", "e\u0301"),
        PLACES.replace("t1", "in/out").replace("t2", "\u00e9"),
    )
    assert sensors is not None and sensors.names == ["in/out", "e\u0301"]


@pytest.mark.parametrize(
    ("log", "places", "fault"),
    [
        (LOG.replace("[K]", "[bar]"), PLACES, 'the column "t2"'),
        (LOG, PLACES.replace("t2,", "t3,"), r"t2, t3 is in only one of the two files"),
        (LOG, PLACES.replace("200,90", "900,90"), r"line 3: x 900 mm, y 90 mm is outside the plan of 700 x 180 mm"),
        (LOG, PLACES.replace("200,90", "left,90"), "line 3: .*write the place in mm"),
    ],
)
def test_what_does_not_fit_is_named(copied: Path, log: str, places: str, fault: str) -> None:
    with pytest.raises(TableError, match=fault):
        read(copied, log, places)


def long_log(*, broken: bool) -> str:
    """Two hours of three sensors, of which the second may jump by 15 K half way."""
    minutes = np.arange(120)
    warm = 20.0 + 4.0 * (1.0 - np.exp(-minutes / 40.0))[:, None] * np.array([1.0, 0.8, 0.9])
    warm += np.random.default_rng(2).normal(0.0, 0.02, warm.shape)
    warm[60:, 1] += 15.0 if broken else 0.0
    stamps = np.datetime64("2026-03-09T08:00:00") + 60 * minutes
    rows = [f"{stamp}Z,{a:.3f},{b:.3f},{c:.3f}" for stamp, (a, b, c) in zip(stamps, warm, strict=True)]
    return "\n".join(["time,t1 [degC],t2 [degC],t3 [degC]", *rows]) + "\n"


def test_a_sensor_that_breaks_is_left_out_and_named(copied: Path) -> None:
    places = PLACES + "t3,350,90\n"
    whole = read(copied, long_log(broken=False), places)
    assert whole is not None and whole.faults == () and whole.names == ["t1", "t2", "t3"]
    sensors = read(copied, long_log(broken=True), places)
    assert sensors is not None and sensors.names == ["t1", "t3"] and sensors.x_mm.tolist() == [500.0, 350.0]
    (fault,) = sensors.faults
    assert fault.sensor == 1 and "jumps by 15 K" in fault.words and fault.onset_s == pytest.approx(3600.0, abs=120.0)
    # The others keep every sample.
    assert sensors.temperature.shape == (120, 2) and sensors.logged.shape == (120, 3)


# Runs of a record: read in the order of their times, held to the same columns, and refused where they cannot be one test.


HEADING = "time,t1 [degC],ch1 [um],speed [rpm]"
CAMPAIGN = """\
[campaign]
title = "Runs"

[record]
{runs}
time = "{time}"
temperatures = ["t*"]
displacements = ["ch*"]
drivers = ["speed*"]
"""


def write_runs(folder: Path, runs: str, *, time: str = "time", **tables: str) -> Path:
    """A campaign file and the tables of its runs, by name."""
    for name, content in tables.items():
        (folder / f"{name}.csv").write_text(content, encoding="utf-8")
    (folder / "campaign.toml").write_text(CAMPAIGN.format(runs=runs, time=time), encoding="utf-8")
    return folder / "campaign.toml"


def stamped(day: int, *, heading: str = HEADING, hours: int = 3) -> str:
    """Rows from six o'clock on, one an hour."""
    rows = [f"2026-01-{day:02d}T{6 + hour:02d}:00:00Z,{20 + hour},{day},{hour}" for hour in range(hours)]
    return "\n".join([heading, *rows]) + "\n"


def elapsed(first: float = 0.0) -> str:
    """Three rows, one a minute."""
    return "\n".join([HEADING.replace("time", "time [s]"), *(f"{first + 60 * k},20,{k},{k}" for k in range(3))]) + "\n"


def test_runs_are_joined_in_the_order_of_their_times(tmp_path: Path) -> None:
    campaign = write_runs(tmp_path, 'files = "r*.csv"', r1=stamped(9), r2=stamped(7), r3=stamped(8))
    data = read_record(load_campaign(campaign))
    assert json.loads(data.attrs["runs"]) == ["r2.csv", "r3.csv", "r1.csv"]
    assert data["displacement"].values[:, 0].tolist() == [7.0] * 3 + [8.0] * 3 + [9.0] * 3
    assert data["run"].values.tolist() == [0] * 3 + [1] * 3 + [2] * 3
    assert json.loads(data.attrs["test"]) == [2]
    assert (np.diff(data["time"].values) > np.timedelta64(0)).all()


def test_kelvins_around_zero_are_a_rise_and_a_stated_range_says_what_is_no_reading(tmp_path: Path) -> None:
    rows = [
        f"{k},{0.05 * k - 0.02},{293.15 + k},{950.0 if k == 7 else 20.0 + k - 99.0 * (k == 8)},{k},0" for k in range(10)
    ]
    content = "\n".join(["time [min],t1 rise [K],t2 [K],t3 [degC],ch1 [um],spindle [1/min]", *rows])
    more = '[record.columns]\n"t3*" = {unit = "degC", range = ["-20 degC", "300 degC"]}'
    data = read_record(load_campaign(record(tmp_path, content, more=more)))
    np.testing.assert_allclose(data["temperature"].values[:, 0], 0.05 * np.arange(10) - 0.02)
    np.testing.assert_allclose(data["temperature"].values[:, 1], 20.0 + np.arange(10))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(data["temperature"].values[:, 2])), [7, 8])
    assert json.loads(data.attrs["rises"]) == ["t1 rise"]


def test_columns_of_a_run_may_stand_in_another_order(tmp_path: Path) -> None:
    rows = {
        "time [s],t1 [degC],t2 [degC],ch1 [um],ch2 [um],speed 1 [1/s],speed 2 [rpm]": "{k},20,21,{k},5,7,8",
        "time [s],speed 2 [rpm],t2 [degC],t1 [degC],ch2 [um],ch1 [um],speed 1 [1/s]": "{k},8,21,20,5,{k},7",
    }
    first, other = ("\n".join([names, *(row.format(k=60 * k) for k in range(3))]) for names, row in rows.items())
    campaign = load_campaign(write_runs(tmp_path, 'files = "r*.csv"', time="time [s]", r1=first, r2=first))
    expected = read_record(campaign)
    (tmp_path / "r2.csv").write_text(other)
    xr.testing.assert_identical(read_record(campaign), expected)


def test_a_pipe_among_the_runs_is_left_out_and_named(tmp_path: Path) -> None:
    campaign = load_campaign(write_runs(tmp_path, 'files = "r*.csv"', r1=stamped(9), r2=stamped(7)))
    assert pipe_notices(campaign) == []
    os.mkfifo(tmp_path / "r3.csv")
    assert json.loads(read_record(campaign).attrs["runs"]) == ["r2.csv", "r1.csv"]
    (notice,) = pipe_notices(campaign)
    assert notice.message == "record.files also matches 1 pipe, socket or device, which is left out: r3.csv."


def test_runs_that_count_from_their_own_zero_follow_the_order_of_the_files(tmp_path: Path) -> None:
    runs = 'files = ["b.csv", "a.csv"]\ntest = "b.csv"'
    campaign = write_runs(tmp_path, runs, time="time [s]", a=elapsed(), b=elapsed(1.0))
    data = read_record(load_campaign(campaign))
    assert json.loads(data.attrs["runs"]) == ["b.csv", "a.csv"]
    assert json.loads(data.attrs["test"]) == [0]
    assert (np.diff(data["time"].values) > np.timedelta64(0)).all()
    assert [str(path) for path in load_campaign(campaign).files_of("record")] == ["b.csv", "a.csv"]


@pytest.mark.parametrize("drafted", [False, True])
def test_the_last_of_ten_runs_is_the_tenth(tmp_path: Path, drafted: bool) -> None:
    """Runs that count from their own zero stay in the order of their names, numbers by size, of which the last is held out."""
    for number in range(1, 11):
        rows = "".join(f"{minute},{20 + 0.1 * minute},{number}\n" for minute in range(5))
        (tmp_path / f"run_{number}.csv").write_text(f"time [min],t1 [degC],ch1 [um]\n{rows}")
    if drafted:
        write_campaign(tmp_path, Asker(None))
    else:
        (tmp_path / "campaign.toml").write_text(
            '[campaign]\ntitle = "Runs"\n[record]\nfiles = ["run_*.csv"]\ntime = "time [min]"\n'
            'temperatures = ["t*"]\ndisplacements = ["ch*"]\n'
        )
    data = read_record(load_campaign(tmp_path / "campaign.toml"))
    assert json.loads(data.attrs["runs"]) == [f"run_{number}.csv" for number in range(1, 11)]
    assert json.loads(data.attrs["test"]) == [9]


def test_runs_that_begin_minutes_after_their_zero_are_no_reason_to_refuse(tmp_path: Path) -> None:
    campaign = write_runs(tmp_path, 'files = "r*.csv"', time="time [s]", r1=elapsed(), r2=elapsed(90.0), r3=elapsed())
    data = read_record(load_campaign(campaign))
    assert json.loads(data.attrs["runs"]) == ["r1.csv", "r2.csv", "r3.csv"]
    assert data.attrs["own_zero"] == 1 and data.sizes["time"] == 9


def test_runs_on_one_clock_without_a_date_keep_it(tmp_path: Path) -> None:
    campaign = write_runs(tmp_path, 'files = "r*.csv"', time="time [s]", r1=elapsed(600.0), r2=elapsed())
    data = read_record(load_campaign(campaign))
    assert json.loads(data.attrs["runs"]) == ["r2.csv", "r1.csv"] and data.attrs["own_zero"] == 0
    assert data["time"].values[3] - data["time"].values[0] == np.timedelta64(600, "s")


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ('files = ["q*.csv"]', "matches no file"),
        ('file = "a.csv"\nfiles = ["a.csv", "b.csv"]', "write either file"),
        ("", "write either file"),
        ('file = "a.csv"\ntest = ["a.csv"]', "test names runs among files"),
        ('files = ["a.csv", "b.csv"]\ntest = ["c.csv"]', "test names c.csv, .* the runs are a.csv, b.csv"),
        ('files = ["a.csv", "b.csv"]\ntest = ["*.csv"]', "test names c.csv"),
        ('files = ["a.csv", "b.csv"]\ntest = ["a.csv", "b.csv"]', "test names all 2 runs"),
    ],
)
def test_runs_that_are_named_wrongly_are_refused(tmp_path: Path, runs: str, message: str) -> None:
    campaign = write_runs(tmp_path, runs, a=stamped(1), b=stamped(2), c=stamped(3))
    with pytest.raises(CampaignError, match=message):
        load_campaign(campaign)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (stamped(2, heading="time,t1 [degC],ch2 [um],speed [rpm]"), "ch1, ch2 is not in both"),
        (stamped(2, heading="time,t1 [degC],ch1 [um],speed [1/s]"), '"speed" is in 1/s, in a.csv in rpm'),
        (stamped(1, hours=9), "begins at 2026-01-01T06:00:00, before .* has ended"),
    ],
)
def test_runs_that_cannot_be_one_record_are_refused(tmp_path: Path, other: str, message: str) -> None:
    campaign = write_runs(tmp_path, 'files = ["a.csv", "b.csv"]', a=stamped(1), b=other)
    with pytest.raises(TableError, match=message):
        read_record(load_campaign(campaign))


# Names that only a unit, a blank or a Unicode form tells apart.


@pytest.mark.parametrize(
    ("headings", "channels"),
    [
        (["ch [um]", "ch [mm]"], ["ch [um]", "ch [mm]"]),
        (["ch [um]", "ch(um)"], ["ch [um]", "ch(um)"]),
        (["ch\u00e9 [um]", "che\u0301 [um]"], ["ch\u00e9", "che\u0301"]),
        (["ch. x [um]", "ch 1 [um]"], ["ch. x", "ch 1"]),
        (["ch [um]", "ch (um)", "ch [um] [um]"], ["ch [um]", "ch (um)", "ch [um] [um]"]),
    ],
)
def test_every_column_stays_its_own(tmp_path: Path, headings: list[str], channels: list[str]) -> None:
    rows = [",".join(map(str, [k, 20 + k / 10, *(k * n for n in range(len(headings))), 0])) for k in range(9)]
    content = "\n".join([",".join(["time [min]", "t1 [degC]", *headings, "spindle [1]"]), *rows])
    table = read_record(load_campaign(record(tmp_path, content)))
    assert table["channel"].values.tolist() == channels
    factor = np.array([1000.0 if "mm" in heading else 1.0 for heading in headings])
    np.testing.assert_allclose(table["displacement"].values[1], np.arange(len(headings)) * factor)


@pytest.mark.parametrize("drafted", [False, True])
def test_a_line_break_in_a_heading_is_a_blank(tmp_path: Path, drafted: bool) -> None:
    rows = [f"{k},{20 + k / 10},{k},0" for k in range(9)] + ["?,20,0,0"]
    campaign = record(tmp_path, "\n".join(['time [min],"t1\nat the nut [degC]","ch\n1 [um]",spindle [1]', *rows]))
    if drafted:
        campaign.unlink()
        write_campaign(tmp_path, Asker(None))
    table = read_record(load_campaign(campaign))
    assert table["sensor"].values.tolist() == ["t1 at the nut"] and table["channel"].values.tolist() == ["ch 1"]
    assert table.sizes["time"] == 9
    assert [one["line"] for one in json.loads(table.attrs["left_out"])] == [13]


@pytest.mark.parametrize("second", ["ch [um]", "ch [um] ", " ch [um]"])
def test_headings_that_are_alike_are_refused_by_column(tmp_path: Path, second: str) -> None:
    rows = [f"{k},{20 + k / 10},{k / 3:.2f},{k / 5:.2f},0" for k in range(9)]
    content = "\n".join([f'time [min],t1 [degC],ch [um],"{second}",spindle [1]', *rows])
    with pytest.raises(TableError, match=r'the column "ch \[um\]\.1" has no unit'):
        read_record(load_campaign(record(tmp_path, content)))
