"""Logged tables: units come from the headings, rows that cannot be used are listed, a record keeps its numbers."""
# ruff: noqa: E501 - messages are quoted whole

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fusion.campaign.config import load_campaign
from fusion.campaign.logged_tables import TableError, read_drivers, split_heading
from fusion.campaign.record_runs import read_record
from fusion.errors import FusionError
from interferometry.io.faults import LaserFormatError

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


def test_headings_carry_name_and_unit() -> None:
    assert split_heading(Path("x"), "t1 [degC]") == ("t1", "degC")
    assert split_heading(Path("x"), "t1(°C)") == ("t1", "degC")
    assert split_heading(Path("x"), "head (deg C)") == ("head", "degC")
    assert split_heading(Path("x"), "Z [Microns]") == ("Z", "um")
    assert split_heading(Path("x"), "spindle speed (RPM) ") == ("spindle speed", "RPM")
    with pytest.raises(
        TableError, match=r'the column "duty" has no unit; write it in the heading, for example "duty \[1\]"'
    ):
        split_heading(Path("drivers.csv"), "duty")


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
    with pytest.raises(TableError, match=r'there is no column beside time; add one named "name \[unit\]"'):
        read_drivers(path)
    path.write_text("time,t [degC],t [K]\n2026-03-09T06:31:00+00:00,1,2\n")
    with pytest.raises(TableError, match="more than one column is named t; give each its own name"):
        read_drivers(path)


def test_a_record_is_converted_to_the_units_of_the_calculation(tmp_path: Path) -> None:
    campaign = record(
        tmp_path, "time [min],t1 [K],t2 [degC],ch1 [mm],spindle [rpm]\n0,293.15,21,0.001,0\n1,294.15,22,0.002,500\n"
    )
    data = read_record(load_campaign(campaign))
    np.testing.assert_allclose(data["temperature"].values, [[20.0, 21.0], [21.0, 22.0]])
    np.testing.assert_allclose(data["displacement"].values, [[1.0], [2.0]])
    np.testing.assert_allclose(np.diff(data["time"].values) / np.timedelta64(1, "s"), [60.0])
    assert data["driver_units"].values.tolist() == ["rpm"]


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
    assert [(one["line"], one["value"]) for one in json.loads(data.attrs["left_out"])] == [(9, "5 fields"), (8, "?")]


def test_lines_of_a_record_that_do_not_fit_its_header_are_listed(tmp_path: Path) -> None:
    rows = "".join(f"{k},20,1,0\n" for k in range(5))
    campaign = record(tmp_path, f"time [min],t1 [degC],ch1 [um],spindle [rpm]\n{rows}5,20,1,0,7\n6,20,1,0\n")
    data = read_record(load_campaign(campaign))
    assert data.sizes["time"] == 6
    assert json.loads(data.attrs["left_out"]) == [
        {"path": "record.csv", "line": 7, "value": "5 fields", "reason": "4 were expected"}
    ]


def test_a_time_of_day_that_is_missing_is_listed(tmp_path: Path) -> None:
    rows = "".join(f"2026-03-09 06:3{k}:00,20,1,0\n" for k in range(6))
    data = read_record(
        load_campaign(record(tmp_path, f"time,t1 [degC],ch1 [um],spindle [rpm]\n,20,1,0\n{rows}", time="time"))
    )
    assert data.sizes["time"] == 6
    assert [(one["line"], one["reason"]) for one in json.loads(data.attrs["left_out"])] == [(2, "is not a time")]


@pytest.mark.parametrize(
    ("content", "time", "message"),
    [
        ("time [min],t1 [bar],ch1 [um],spindle [rpm]\n0,1,1,1\n1,1,1,1\n", "time [min]", r'the column "t1 \[bar\]": "bar" is not a unit of a temperature'),
        ("time [min],t1 [degC],ch1 [um],spindle [rpm]\n0,20,1,1,5\n1,21,1,1,5\n", "time [min]", "the lines hold more fields than the header names; name every column"),
        ("time [min],t1 [degC],ch1,spindle [rpm]\n0,1,1,1\n1,1,1,1\n", "time [min]", 'the column "ch1" has no unit'),
        ("time [min],t1 [degC],ch1 [um],spindle [rpm]\n0,a,1,1\n1,b,1,1\n", "time [min]", r'the column "t1 \[degC\]" holds no number'),
        ("time [min],t1 [degC],ch1 [um]\n0,1,1\n1,1,1\n", "time [min]", r'no column is named "spindle\*"; the file has: t1 \[degC\], ch1 \[um\]'),
        ("time [min],t1 [degC],ch1 [um],spindle [rpm]\n0,1,1,1\n", "clock [s]", r'no column is named "clock \[s\]"; the file has: time \[min\]'),
    ],
)  # fmt: skip
def test_records_that_cannot_be_used_name_the_column(tmp_path: Path, content: str, time: str, message: str) -> None:
    campaign = record(tmp_path, content, time=time)
    with pytest.raises(ValueError, match=message):
        read_record(load_campaign(campaign))


@pytest.mark.real_data
def test_a_published_record_is_read_whole(tmp_path: Path, real_file: Callable[[str], Path]) -> None:
    """46.3 h of a spindle test: 16 temperatures, 5 displacements and the speed, every 15 s (11,115 rows)."""
    path = real_file("CAIVIAC__FL_THERMAL/data/data.xlsx")
    text = RECORD.format(file=path.as_posix(), time="時間(s)", more="")
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    data = read_record(load_campaign(tmp_path / "campaign.toml"))
    assert dict(data.sizes) == {"time": 11115, "sensor": 16, "channel": 5, "driver_name": 1}
    assert (data["time"].values[-1] - data["time"].values[0]) / np.timedelta64(1, "h") == pytest.approx(46.3, abs=0.05)
    assert data.attrs["left_out"] == "[]"


def test_damaged_spreadsheets_are_named_whatever_their_reader_raises(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Flipped bits and cut ends: the reader raises errors of zipfile, zlib, XML and missing keys, which are none of the package's."""
    pd.DataFrame({"time [s]": [0, 1], "t1 [degC]": [20.0, 20.5], "ch1 [um]": [0.0, 0.1]}).to_excel(
        tmp_path / "whole.xlsx", index=False
    )
    whole = np.frombuffer((tmp_path / "whole.xlsx").read_bytes(), np.uint8)
    (tmp_path / "campaign.toml").write_text(
        RECORD.format(file="damaged.xlsx", time="time [s]", more="").replace('drivers = ["spindle*"]', "")
    )
    refused = 0
    for number in range(40):
        damaged = whole.copy()
        damaged[rng.integers(0, whole.size, 6)] ^= 1 << rng.integers(0, 8, 6, dtype=np.uint8)
        (tmp_path / "damaged.xlsx").write_bytes(damaged[: None if number % 2 else rng.integers(whole.size)].tobytes())
        campaign = load_campaign(tmp_path / "campaign.toml")
        try:
            read_record(campaign)
        except (FusionError, LaserFormatError) as error:
            assert "damaged.xlsx" in str(error)
            refused += 1
    assert refused > 20
    monkeypatch.setattr("interferometry.io.workbook_limits._MOST_BYTES", 1000)
    (tmp_path / "damaged.xlsx").write_bytes(whole.tobytes())
    with pytest.raises(LaserFormatError, match=r"damaged\.xlsx: unpacks to 0\.0 GB, at most 1e-06 GB are read"):
        read_record(load_campaign(tmp_path / "campaign.toml"))


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
        ("oil in/out", "a name that no product can hold; begin it with a letter, leave / out"),
        ("=HYPERLINK", "a name that no product can hold"),
        ("x" * 101, "a name that no product can hold"),
        ("deviation", 'the name of a result; rename it, for example "logged deviation"'),
        ("duty_series", "the name of a result"),
    ],
)
def test_names_that_the_products_cannot_keep_are_refused(tmp_path: Path, name: str, message: str) -> None:
    path = tmp_path / "drivers.csv"
    path.write_text(f"time,{name} [1]\n2026-03-09T06:00:00Z,1\n2026-03-09T06:01:00Z,2\n")
    with pytest.raises(TableError, match=message):
        read_drivers(path)
