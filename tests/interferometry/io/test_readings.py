"""Readings from tables of one reading per line and of one run per column: dialects, checks, and the Dataset of all."""

import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
import xarray as xr

from interferometry.deviations import DUPLICATE, MISSING, OUT_OF_ORDER, UNREADABLE, sort_readings
from interferometry.io.faults import LaserFormatError
from interferometry.io.readings import (
    NotStated,
    Reading,
    Readings,
    check_and_assemble,
    find_wide_table,
    is_environment_log,
    passes_by_order,
    read_deviations,
    read_environment,
)
from interferometry.io.tables import read_grids
from tests.interferometry.io.test_workbook import write_ods


def test_what_times_do_not_tell_is_noted(tmp_path):
    (tmp_path / "t.csv").write_text(
        "run,direction,position [mm],deviation [um]\n1,forward,0,0\n1,forward,20,0\n1,back,9,\n"
    )
    test = read_deviations(tmp_path / "t.csv")
    assert np.isfinite(test["deviation"].sel(direction="positive").values).sum() == 2
    assert json.loads(test.attrs["notes"]) == [
        "forward was taken as the positive direction: the file gives no times that tell the travel"
    ]
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


HEADER = "cycle,direction,target,position_mm,time,deviation_um"


def rows(cycles: int = 3, targets: int = 3) -> list[str]:
    """Lines of a complete test; line 2 of the file is cycle 1, positive, target 1."""
    lines, second = [], 0
    for cycle in range(1, cycles + 1):
        for direction, order in (("positive", range(1, targets + 1)), ("negative", range(targets, 0, -1))):
            for target in order:
                time = f"2026-03-09T06:{30 + second // 60:02d}:{second % 60:02d}+00:00"
                lines.append(f"{cycle},{direction},{target},{20 * (target - 1)},{time},{cycle + 0.1 * target:.1f}")
                second += 6
    return lines


def write(folder: Path, lines: list[str], header: str = HEADER) -> Path:
    path = folder / "laser.csv"
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


def left_out(dataset: object) -> list[dict[str, object]]:
    return json.loads(dataset.attrs["left_out"])


def test_a_complete_file_comes_back_cell_by_cell(tmp_path):
    deviations = read_deviations(write(tmp_path, rows()))
    assert deviations.sizes == {"cycle": 3, "direction": 2, "target": 3}
    assert deviations["deviation"].sel(cycle=2, direction="negative", target=3) == pytest.approx(2.3)
    assert deviations["time"].values[0, 1, 2] == np.datetime64("2026-03-09T06:30:18")
    assert deviations["position"].values.tolist() == [0.0, 20.0, 40.0]
    assert deviations["time"].attrs["origin"] == "recorded"
    assert left_out(deviations) == []
    assert not deviations["quality_flag"].any()


@pytest.mark.parametrize(
    ("line", "column", "value", "reason"),
    [
        (4, 1, "sideways", "is neither 'positive' nor 'negative'"),
        (5, 5, "nan", "is not a finite number"),
        (5, 5, "", "is not a number"),
        (6, 5, "-1e20", "is not a finite number"),
        (7, 4, "half past six", "is not an ISO 8601 time"),
        (8, 0, "1.5", "is not a whole number from 1"),
        (9, 2, "0", "is not a whole number from 1"),
        (10, 3, "abc", "is not a number"),
        (11, 4, "2026-03-10T06:30:54+00:00", "is not a time within cycle 2"),
        (12, 3, "21", "target 2 is at 20.0 mm elsewhere"),
    ],
)
def test_one_bad_reading_is_left_out_with_its_line(tmp_path, line, column, value, reason):
    lines = rows()
    fields = lines[line - 2].split(",")
    fields[column] = value
    lines[line - 2] = ",".join(fields)
    deviations = read_deviations(write(tmp_path, lines))
    listed = left_out(deviations)
    assert len(listed) == 1
    assert listed[0]["line"] == line
    assert reason in str(listed[0]["reason"])
    assert listed[0]["path"] == "laser.csv"
    assert int(np.isnan(deviations["deviation"]).sum()) == deviations.attrs["missing"] == 1


def test_unreadable_repeated_and_disordered_readings_are_flagged_in_their_cells(tmp_path):
    lines = rows()
    lines[0] = lines[0].rsplit(",", 1)[0] + ",---"
    flagged = read_deviations(write(tmp_path, lines))["quality_flag"].values
    assert flagged[0, 0, 0] == MISSING.mask | UNREADABLE.mask
    assert flagged.astype(bool).sum() == 1
    lines = rows()
    lines.insert(1, lines[0].rsplit(",", 1)[0] + ",99.0")
    deviations = read_deviations(write(tmp_path, lines))
    assert deviations["deviation"].values[0, 0, 0] == pytest.approx(1.1)
    assert left_out(deviations)[0]["reason"] == ("cycle 1 positive target 1 already occurs on line 2, which is kept")
    assert deviations["quality_flag"].values[0, 0, 0] == DUPLICATE.mask
    lines = rows(targets=5)
    lines[1] = lines[1].replace("06:30:06", "06:30:19")
    flagged = read_deviations(write(tmp_path, lines))["quality_flag"].values
    assert flagged[0, 0, 1] == OUT_OF_ORDER.mask
    assert np.count_nonzero(flagged) == 1
    lines = rows()
    del lines[7]
    deviations = read_deviations(write(tmp_path, lines))
    assert deviations.attrs["missing"] == 1
    assert sort_readings(deviations).sizes["reading"] == 17


def test_byte_order_mark_crlf_and_semicolons_with_decimal_commas(tmp_path):
    lines = [line.replace(",", ";").replace(".", ",") for line in rows()]
    path = tmp_path / "laser.csv"
    text = "\r\n".join([HEADER.replace(",", ";"), "", *lines]) + "\r\n"
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert read_deviations(path).equals(read_deviations(write(tmp_path, rows())))


def test_other_zones_become_utc_and_a_missing_zone_is_stated(tmp_path):
    utc = read_deviations(write(tmp_path, rows()))
    shifted = [line.replace("T06:", "T08:").replace("+00:00", "+02:00") for line in rows()]
    converted = read_deviations(write(tmp_path, shifted))
    assert (converted["time"].values == utc["time"].values).all()
    assert converted["time"].attrs["reference"] == "converted to UTC from +0200"
    bare = read_deviations(write(tmp_path, [line.replace("+00:00", "") for line in rows()]))
    assert bare["time"].attrs["reference"] == "no zone in the file: taken as UTC"


def test_lines_in_any_order_give_the_same_test(tmp_path, rng):
    shuffled = list(rng.permutation(rows()))
    assert read_deviations(write(tmp_path, shuffled)).equals(read_deviations(write(tmp_path, rows())))


def test_overlapping_cycles_and_targets_that_move_or_coincide_are_refused(tmp_path):
    lines = rows()
    lines[5] = lines[5].replace("06:30:30", "06:30:36")
    with pytest.raises(LaserFormatError, match=r"cycle 2 begins at .* \(line 8\) before cycle 1 ends at .* \(line 7\)"):
        read_deviations(write(tmp_path, lines))
    lines = [line.replace(",2,20,", ",2,25,") if line.startswith(("2", "3")) else line for line in rows()]
    with pytest.raises(
        LaserFormatError, match=r"target 2 is at 20\.0 mm on line 3 but at 25\.0 mm elsewhere \(2 of 6 read"
    ):
        read_deviations(write(tmp_path, lines))
    lines = [line.replace(",3,40,", ",3,20,") for line in rows()]
    with pytest.raises(LaserFormatError, match=r"targets 2 and 3 are both at 20.0 mm"):
        read_deviations(write(tmp_path, lines))


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (HEADER.replace("time,", ""), "18 of 18 lines cannot be used, the first is line 2: '' does not have 5 fields"),
        (HEADER + ",time", "column time occurs more than once"),
    ],
)
def test_a_wrong_column_is_refused(tmp_path, header, message):
    with pytest.raises(LaserFormatError, match=message):
        read_deviations(write(tmp_path, rows(), header))


def test_files_without_readings_or_without_text_are_refused(tmp_path):
    with pytest.raises(LaserFormatError, match="no reading below the header"):
        read_deviations(write(tmp_path, []))
    empty = tmp_path / "empty.csv"
    empty.write_bytes(b"")
    with pytest.raises(LaserFormatError, match="the file is empty"):
        read_deviations(empty)
    empty.write_bytes(b"cycle\x00\xff\xfe")
    with pytest.raises(LaserFormatError, match="character 6 is a zero byte, so the file is not text"):
        read_deviations(empty)


ENVIRONMENT = "time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC"


def test_environment_is_sorted_and_its_faults_are_listed(tmp_path):
    path = tmp_path / "environment.csv"
    lines = [
        "2026-03-09T06:32:00Z,23.7,1000.0,42,23.8",
        "2026-03-09T06:30:00Z,23.5,1000.2,42,23.9",
        "2026-03-09T06:31:00Z,23.6,101.3,42,23.9",
        "2026-03-09T06:30:00Z,23.6,1000.2,42,23.9",
        "2026-03-09T06:33:00Z,23.6,1000.2,42,-10",
        "2026-03-09T06:34:00Z,23.6,1000.2,42,24.0",
        "2026-03-09T06:35:00Z,23.6,1000.2,42,24.0",
    ]
    path.write_text("\n".join([ENVIRONMENT, *lines]), encoding="utf-8")
    environment = read_environment(path)
    assert environment["air_temperature"].values.tolist() == [23.5, 23.7, 23.6, 23.6]
    reasons = {one["line"]: one["reason"] for one in left_out(environment)}
    assert "is outside 500 .. 1200, the range of air_pressure_hPa in its unit" in str(reasons[4])
    assert "occurs on an earlier line too" in str(reasons[5])
    assert "is outside -9 .. 80" in str(reasons[6])


def test_further_columns_of_the_environment_are_read_in_their_own_units(tmp_path):
    """What is no number there leaves the line its air; a heading without a unit, or of a column that has a role, is no quantity."""
    path = tmp_path / "environment.csv"
    lines = [
        "2026-03-09T06:30:00Z,23.5,1000.2,42,23.9,19.5,3.25,door open,1",
        "2026-03-09T06:31:00Z,23.6,1000.2,42,23.9,,3.5,,2",
    ]
    path.write_text(
        "\n".join([f"{ENVIRONMENT},room [degC],coolant flow (l/min),remark,cycle [1]", *lines]), encoding="utf-8"
    )
    environment = read_environment(path)
    np.testing.assert_array_equal(environment["room"], [19.5, np.nan])
    np.testing.assert_array_equal(environment["coolant flow"], [3.25, 3.5])
    assert [environment[name].attrs["units"] for name in ("room", "coolant flow")] == ["degC", "l/min"]
    assert environment.sizes["time"] == 2 and not left_out(environment)
    assert not {"remark", "cycle"} & {str(name) for name in environment.data_vars}


OTHER_UNITS = "time,air_temperature_degF,pressure (kPa),humidity (%),sample temperature [K]"


@pytest.mark.parametrize(
    ("header", "line", "message"),
    [
        (
            ENVIRONMENT,
            "23.7,101.3,42,23.8",
            r"1 of 1 lines .* line 2: '101\.3' is outside 500 \.\. 1200, .* air_pressure_hP",
        ),
        (ENVIRONMENT, "23.7,1000.1,0.45,23.8", r"'0.45' is outside 1 .. 100, the range of relative_humidity_percent"),
        (
            OTHER_UNITS.replace("kPa", "mm"),
            "68,101.3,42,293.15",
            "line 1: the unit of 'pressure .mm.' is none of a pressure",
        ),
        ("time,air_temperature_degC", "20", "line 1 lacks air_pressure_hPa, relative_humidity_percent, material"),
    ],
)
def test_environment_in_another_unit_or_without_a_column_is_refused(tmp_path, header, line, message):
    path = tmp_path / "environment.csv"
    path.write_text(f"{header}\n2026-03-09T06:32:00Z,{line}\n", encoding="utf-8")
    with pytest.raises(LaserFormatError, match=message):
        read_environment(path)


@pytest.mark.parametrize("read", [read_deviations, read_environment])
def test_a_missing_file_is_named_by_the_error(read, tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        read(tmp_path / "laser.csv")
    assert Path(caught.value.filename) == tmp_path / "laser.csv"


HEADINGS = {
    "english": "time,air temperature (°C),air pressure (hPa),humidity (%),material temperature (°C)",
    "german": "Zeit,Lufttemperatur [°C],Luftdruck [hPa],Luftfeuchte [%],Materialtemperatur [°C]",
    "french": "Heure,Température de l'air (°C),Pression (hPa),Humidité (%),Température matière (°C)",
    "spanish": "Hora,Temperatura del aire (°C),Presión (hPa),Humedad (%),Temperatura del material (°C)",
    "chinese": "时间,空气温度(°C),气压(hPa),湿度(%),材料温度(°C)",
}


@pytest.mark.parametrize("language", HEADINGS)
def test_environment_headings_in_five_languages(tmp_path, language):
    path = tmp_path / "environment.csv"
    path.write_text(HEADINGS[language] + "\n2026-03-09T06:30:00Z,23.5,1000.2,42,23.9\n", encoding="utf-8")
    assert is_environment_log(path)
    assert read_environment(path)["air_pressure"].values.tolist() == [1000.2]


def test_environment_in_other_units_is_converted(tmp_path):
    path = tmp_path / "environment.csv"
    path.write_text(OTHER_UNITS + "\n2026-03-09T06:32:00Z,68,101.3,42,293.15\n", encoding="utf-8")
    environment = read_environment(path)
    values = [float(environment[name][0]) for name in ("air_temperature", "air_pressure", "material_temperature")]
    assert values == pytest.approx([20.0, 1013.0, 20.0], abs=1e-9)


def test_a_report_of_averages_is_no_test(tmp_path):
    path = tmp_path / "x.pos"
    path.write_text("Position   \tBidirectional Avg Error\n0\t0.001\n10\t0.002\n")
    with pytest.raises(LaserFormatError, match="a report of averages over runs holds no single reading; export the"):
        read_deviations(path)


#: Cycle, sign, target, position in mm, second and deviation in um of a small test.
TEST = [
    (c, sign, t, 20.0 * (t - 1), 60 * c + (6 * t if sign > 0 else 40 - 6 * t), c + 0.25 * t * sign)
    for c in (1, 2)
    for sign in (1, -1)
    for t in (1, 2, 3)
]
EXPECTED = np.array([[[c + 0.25 * t * s for t in (1, 2, 3)] for s in (1, -1)] for c in (1, 2)])
LINE = "{c},{d},{t},{p},2026-03-09T{clock},{e}"


def table(header: str, line: str, *, minus: str = "-", plus: str = "+", decimal: str = ".") -> str:
    rows = [header]
    for cycle, sign, target, position, second, deviation in TEST:
        clock = f"{6 + second // 3600:02d}:{second // 60 % 60:02d}:{second % 60:02d}"
        rows.append(
            line.format(
                c=cycle,
                d=plus if sign > 0 else minus,
                t=target,
                p=str(position).replace(".", decimal),
                clock=clock,
                e=str(deviation).replace(".", decimal),
                nm=deviation * 1e3,
                negative=-deviation,
                tenths=deviation * 10,
                mm=f"{deviation / 1e3:.6f}",
                measured=f"{position + deviation / 1e3:.6f}",
                inch=f"{position / 25.4:.9f}",
                zero=cycle - 1,
                tz=target - 1,
                run=2 * cycle - (1 if sign > 0 else 0),
            )
        )
    return "\n".join(rows) + "\n"


def read(folder: Path, text: str, encoding: str = "utf-8", **options: bool) -> xr.Dataset:
    path = folder / "laser.csv"
    path.write_bytes(text.encode(encoding))
    return read_deviations(path, **options)


SIGNS = table(HEADER, LINE)
DIALECTS = {
    "german": table(
        "Zyklus;Richtung;Punkt;Sollposition [mm];Datum;Uhrzeit;Abweichung [µm]",
        "{c};{d};{t};{p};9.3.2026;{clock};{e}",
        decimal=",",
        plus="vorwärts",
        minus="rückwärts",
    ),
    "chinese": table(
        "循环,方向,目标,位置(mm),时间,偏差(μm)", "{c},{d},{t},{p},2026年3月9日 {clock},{e}", plus="正向", minus="反向"
    ),
    "signs": SIGNS,
    "typographic minus": table(HEADER, LINE, minus="−").replace(",-", ",−"),
    "forward": table(
        "Cycle\tApproach\tTarget No.\tTarget [mm]\tTime\tError [um]",
        LINE.replace(",", "\t").replace("T{", " {"),
        plus="Forward",
        minus="Reverse",
    ),
    "nanometres": table(HEADER.replace("_um", "_nm"), LINE.replace("{e}", "{nm}")),
    "millimetres": table(HEADER.replace("_um", "_mm"), LINE.replace("{e}", "{mm}")),
    "inches": table(HEADER.replace("position_mm", "position (inch)"), LINE.replace("{p}", "{inch}")),
    "measured": table(HEADER.replace("deviation_um", "measured (mm)"), LINE.replace("{e}", "{measured}")),
    "reading of a laser beside the air": table(
        HEADER.replace("deviation_um", "Laser reading (mm),Air temp (C)"), LINE.replace("{e}", "{measured},20.1")
    ),
    "letters": table(HEADER, LINE, plus="F", minus="B"),
    "arrows": table(HEADER, LINE, plus="→", minus="←"),
    "order of the positions": table(HEADER.replace("direction,", ""), LINE.replace("{d},", "")),
    "directions that only number": table(HEADER, LINE, plus="0", minus="1"),
    "target minus measured": table(f"{HEADER},measured (mm)", LINE.replace("{e}", "{negative},{measured}")),
    "shares of a unit": table(HEADER.replace("deviation_um", "Abweichung / 0.1 µm"), LINE.replace("{e}", "{tenths}")),
    "no targets": table(HEADER.replace("target,", ""), LINE.replace("{t},", "")),
    "from 0": table(HEADER, LINE.replace("{c}", "{zero}").replace("{t}", "{tz}")),
    "runs": table(HEADER.replace("cycle", "run"), LINE.replace("{c}", "{run}")),
    "named numbers": table(HEADER, LINE.replace("{c}", "Cycle {c}").replace("{t}", "P{t}")),
    "units row": table("cycle,direction,target,position,time,deviation\n,,,mm,,um", LINE),
    "title": "Machine;X axis\nOperator;N.N.\n\n" + SIGNS.replace(",", ";"),
    "quoted": table(HEADER, '"{c}","{d}","{t}","{p}","2026-03-09T{clock}","{e}"', decimal=","),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_gives_the_same_test(tmp_path, dialect):
    test = read(tmp_path, DIALECTS[dialect])
    # Inches of nine decimals place a target within 1e-8 mm; all other numbers are exact.
    assert test["position"].values == pytest.approx([0.0, 20.0, 40.0], abs=1e-7)
    assert test["deviation"].values == pytest.approx(EXPECTED, abs=1e-9)
    assert test["time"].values[0, 0, 0] == np.datetime64("2026-03-09T06:01:06")
    assert (test["deviation"].attrs["units"], test["position"].attrs["units"]) == ("um", "mm")
    assert json.loads(test.attrs["left_out"]) == []


def test_a_sheet_with_title_merged_cycles_and_dates_is_read_among_others(tmp_path):
    book = openpyxl.Workbook()
    book.active.append(["Operator", "N.N."])
    sheet = book.create_sheet("X axis")
    sheet.append(["Positioning test of the X axis"])
    sheet.merge_cells("A1:F1")
    sheet.append(["Cycle", "Direction", "Position [mm]", "Date", "Time", "Deviation [µm]"])
    for row, (cycle, sign, _, position, second, deviation) in enumerate(TEST):
        day = np.datetime64("2026-03-09").item()
        clock = (np.datetime64("2026-03-09T06:00") + np.timedelta64(second, "s")).item().time()
        sheet.append([cycle if row % 6 == 0 else None, sign, position, day, clock, deviation])
    sheet.merge_cells("A3:A8")
    sheet.merge_cells("A9:A14")
    path = tmp_path / "laser.xlsx"
    book.save(path)
    test = read_deviations(path)
    assert test["deviation"].values.tolist() == EXPECTED.tolist()
    assert test["time"].values[0, 0, 0] == np.datetime64("2026-03-09T06:01:06")
    book.copy_worksheet(sheet).title = "Y axis"
    book.save(path)
    with pytest.raises(LaserFormatError, match="the sheets 'X axis', 'Y axis' each hold a table of deviations; name"):
        read_deviations(path)
    assert read_deviations(path, sheet="Y axis").equals(test)
    with pytest.raises(LaserFormatError, match="there is no sheet 'Z'; the sheets are 'Sheet', 'X axis', 'Y axis'"):
        read_deviations(path, sheet="Z")


def test_turned_directions_and_numbering_from_0_are_told(tmp_path):
    turned = DIALECTS["forward"].replace("Forward", "?").replace("Reverse", "Forward").replace("?", "Reverse")
    test = read(tmp_path, turned)
    assert test["deviation"].values.tolist() == EXPECTED.tolist()
    (note,) = json.loads(test.attrs["notes"])
    assert note.startswith("the forward runs lead to smaller positions")
    assert json.loads(read(tmp_path, DIALECTS["from 0"]).attrs["notes"]) == [
        "the file numbers its cycles from 0: 1 was added",
        "the file numbers its targets from 0: 1 was added",
    ]


def test_a_rotary_axis_keeps_its_units_and_is_refused_elsewhere(tmp_path):
    text = table("cycle,direction,position (°),deviation (arcsec)", "{c},{d},{p},{e}")
    test = read(tmp_path, text, rotary=True)
    assert (test["deviation"].attrs["units"], test["position"].attrs["units"]) == ("arcsec", "deg")
    assert test["deviation"].values == pytest.approx(EXPECTED, abs=1e-6)
    with pytest.raises(
        LaserFormatError, match=r"the positions are angles; a rotary axis is evaluated by ISO 230-2 alone"
    ):
        read(tmp_path, text)


def test_a_table_without_times_says_so(tmp_path):
    test = read(tmp_path, table("cycle,direction,position_mm,deviation_um", "{c},{d},{p},{e}"))
    assert test["time"].attrs["origin"] == "none"
    assert np.isnat(test["time"].values).all()
    assert not test["quality_flag"].any()


@pytest.mark.parametrize("mark", ["9999", "-99999.999", "1_2.5", "−−1"])
def test_a_mark_for_no_reading_is_no_value(tmp_path, mark):
    test = read(tmp_path, DIALECTS["signs"].replace("01:06,1.25", f"01:06,{mark}"))
    assert np.isnan(test["deviation"].values[0, 0, 0])
    (line,) = json.loads(test.attrs["left_out"])
    assert (line["line"], line["value"]) == (2, mark)


@pytest.mark.parametrize(
    ("header", "line", "message"),
    [
        (
            "cycle,direction,position,deviation_um",
            "{c},{d},{p},{e}",
            "no heading states a unit of the positions.* position_unit as one of",
        ),
        ("cycle,direction,position_mm,deviation_degC", "{c},{d},{p},{e}", "positions in mm, deviations in degC; give"),
        (f"{HEADER},error_um", f"{LINE},{{e}}", "'deviation_um' and 'error_um' both name the deviation"),
        (HEADER, LINE.replace("2026-03-09T", "3/9/2026 "), "line 2: '3/9/2026 .* may be 2026-09-03 .* or 2026-03-09"),
        (
            "cycle,position_mm,deviation_um",
            "{c},{p},{e}",
            "line 1: no heading or column names the direction .* 'positive first'",
        ),
        ("a,b,c,d", "{c},{d},{p},{e}", "no table of deviations; line 1 is 'a,b,c,d'; expected one reading per line"),
    ],
)
def test_what_a_table_lacks_is_named(tmp_path, header, line, message):
    with pytest.raises(LaserFormatError, match=message):
        read(tmp_path, table(header, line))


WIDE_EXPECTED = np.array([[[1.25, 1.5, 1.75], [0.75, 0.5, 0.25]], [[2.25, 2.5, 2.75], [1.75, 1.5, 1.25]]])
ROWS = [(0, 1.25, 0.75, 2.25, 1.75), (20, 1.5, 0.5, 2.5, 1.5), (40, 1.75, 0.25, 2.75, 1.25)]
DATA = "\n".join(",".join(map(str, row)) for row in ROWS)
#: The runs of each direction below their title, those back as they were measured.
BLOCK = {
    "Forward": "\n".join(f"{row[0]},{row[1]},{row[3]},9" for row in ROWS) + "\n",
    "Reverse": "\n".join(f"{row[0]},{row[2]},{row[4]},9" for row in ROWS[::-1]),
}
BY_DIRECTION = "\n".join(",".join(str(row[i]) for i in (0, 1, 3, 2, 4)) for row in ROWS)
RUNS_SORTED = "".join(f"{run},{row[0]},{row[run]}\n" for run in (1, 2, 3, 4) for row in ROWS)
BESIDE = "{0},{1},1.25,1.5,1.75\n{0},{2},.75,.5,.25\n{3},{1},2.25,2.5,2.75\n{3},{2},1.75,1.5,1.25\n"


def read_wide(folder: Path, text: str, **options: Any) -> xr.Dataset:
    path = folder / "wide.csv"
    path.write_text(text, encoding="utf-8")
    return read_deviations(path, **options)


WIDE_DIALECTS = {
    "signs": f"Position [mm],1+ [um],1- [um],2+ [um],2- [um]\n{DATA}",
    "signs first": f"Position [mm],+1 [um],-1 [um],+2 [um],-2 [um]\n{DATA}",
    "words": f"Unit: µm\nPosition (mm),Run 1 forward,Run 1 reverse,Run 2 forward,Run 2 reverse\n{DATA}",
    "alternating runs": f"Position (mm),Run 1 + (µm),Run 2 - (µm),Run 3 + (µm),Run 4 - (µm)\n{DATA}",
    "letters": f"Unit: µm\nPosition (mm),X1f,X1b,X2f,X2b\n{DATA}",
    "arrows": f"Unit: µm\nPosition (mm),→ 1,← 1,-> 2,<- 2\n{DATA}",
    "measured": "Position (mm),F1,R1,F2,R2\n"
    + "\n".join(f"{p}," + ",".join(f"{p + d / 1e3:.5f}" for d in row) for p, *row in ROWS),
    "blocks": "Unit: um\n" + "\n".join(f"{way}\nPosition (mm),1,2,Mean\n{BLOCK[way]}" for way in BLOCK),
    "a block for each run": "\n".join(
        f"Run {k} {way}\nPosition (mm),Error (um)\n"
        + "\n".join(f"{row[0]},{row[2 * k - (way == 'forward')]}" for row in ROWS)
        for k in (1, 2)
        for way in ("forward", "reverse")
    ),
    "form of ISO 230-2": "\n".join(
        [
            ",Position i," + ",".join(f"{k}," for k in (1, 2, 3)),
            ",Target position Pi (mm)," + ",".join(f"{row[0]}," for row in ROWS),
            ",Approach direction" + ",↑,↓" * 3,
            *(
                f"{'Positional deviations (µm)' if j == 1 else ''},j = {j},"
                + ",".join(f"{row[2 * j - 1]},{row[2 * j]}" for row in ROWS)
                for j in (1, 2)
            ),
            ",Mean deviation" + ",9,9" * 3,
        ]
    ),
    "words and arrows": f",Forward ↑ [µm],,Reverse ↓ [µm],\nPi [mm],1,2,1,2\n{BY_DIRECTION}",
    "there and back": "Position (mm),Cycle 1 [um],Cycle 2 [um]\n"
    + "\n".join([*(f"{p},{a},{c}" for p, a, _, c, _ in ROWS), *(f"{p},{b},{d}" for p, _, b, _, d in ROWS[::-1])]),
    "two rows": f"Deviations in µm\nPosition (mm),Cycle 1,,Cycle 2,\n,+,-,+,-\n{DATA}",
    "rows above": f"Abweichungen [µm]\n,Zyklus 1,,Zyklus 2,\nSollposition [mm],+,-,+,-\n{DATA}",
    "by direction": f"Écarts (µm),,,,\n,Aller,,Retour,\nPosition cible (mm),1,2,1,2\n{BY_DIRECTION}",
    "unnumbered": f"Unit,um\nPosition [mm],+,-,+,-\n{DATA}",
    "units row": f"Position,1+,1-,2+,2-\nmm,um,um,um,um\n{DATA}",
    "chinese": f"位置(mm),第1次正向(μm),第1次反向(μm),第2次正向(μm),第2次反向(μm)\n{DATA}",
    "summary columns": "Position [mm],1+ [um],1- [um],2+ [um],2- [um],Mean + [um],s\n"
    + "\n".join(f"{line},0.5,0.1" for line in DATA.split("\n")),
    "runs down": "Deviation [um]\nRun \\ Position [mm],Direction,0,20,40\n" + BESIDE.format(1, "+", "-", 2),
    "runs down, units in the headings": "Unit: um\nCycle,Direction,0 mm,20 mm,40 mm\n"
    + BESIDE.format(1, "fwd", "rev", 2),
    "runs down in one label": "Unit: um\nRun,0 mm,20 mm,40 mm\n" + BESIDE.replace(",{", "{").format(1, "+", "-", 2),
}


@pytest.mark.parametrize("dialect", WIDE_DIALECTS)
def test_every_dialect_of_a_wide_table_gives_the_same_test(tmp_path, dialect):
    test = read_wide(tmp_path, WIDE_DIALECTS[dialect])
    assert test["position"].values.tolist() == [0.0, 20.0, 40.0]
    assert test["deviation"].values.tolist() == WIDE_EXPECTED.tolist()
    assert test["time"].attrs["origin"] == "none"
    assert test.attrs["missing"] == 0


@pytest.mark.parametrize(
    "text", [f"Position [mm],1 [um],2 [um],3 [um],4 [um]\n{DATA}", "run,position_mm,deviation_um\n" + RUNS_SORTED]
)
def test_stated_directions_are_used_where_the_table_names_none(tmp_path, text):
    stated = {"positive first": WIDE_EXPECTED, "negative first": WIDE_EXPECTED[:, ::-1]}
    for directions, expected in stated.items():
        assert read_wide(tmp_path, text, directions=directions)["deviation"].values.tolist() == expected.tolist()
    one_way = read_wide(tmp_path, text, directions="negative")["deviation"]
    assert one_way.shape == (4, 2, 3)
    assert np.isnan(one_way.values[:, 0]).all()
    assert one_way.values[:, 1].tolist() == WIDE_EXPECTED.reshape(4, 3).tolist()
    for refused in ({"directions": "both"}, {}):
        with pytest.raises(LaserFormatError, match="'positive first'"):
            read_wide(tmp_path, text, **refused)
    with pytest.raises(LaserFormatError, match="the table names the direction of its runs; remove directions"):
        read_wide(tmp_path, WIDE_DIALECTS["signs"], directions="positive")


def test_a_sheet_for_each_direction_and_positions_that_only_one_of_them_has(tmp_path):
    book = openpyxl.Workbook()
    for way, rows in BLOCK.items():
        sheet = book.create_sheet(way)
        sheet.append(["Position [mm]", "1 [um]", "2 [um]", "Mean"])
        for row in rows.split():
            sheet.append([float(text) for text in row.split(",")])
    book.save(tmp_path / "a.xlsx")
    assert read_deviations(tmp_path / "a.xlsx")["deviation"].values.tolist() == WIDE_EXPECTED.tolist()
    sheet["A3"] = 21.0
    book.save(tmp_path / "a.xlsx")
    with pytest.raises(LaserFormatError, match="line 3: position 21 of 'Reverse' does not occur in 'Forward'"):
        read_deviations(tmp_path / "a.xlsx")


@pytest.mark.parametrize("unit", ["tenths", "um/m", "1/8 um", "counts"])
@pytest.mark.parametrize("heading", ["Deviations [{}]", "Deviations in {}", "Unit: {}", "Unit,{}", "Abweichung / {}"])
def test_a_unit_that_is_none_is_asked_or_refused(tmp_path, unit, heading):
    with pytest.raises(NotStated) as asked:
        read_wide(tmp_path, f"{heading.format(unit)}\nPosition [mm],1+,1-,2+,2-\n{DATA}")
    assert asked.value.keys == ("deviation_unit",)
    with pytest.raises(LaserFormatError, match="no column of a deviation"):
        read(tmp_path, SIGNS.replace("deviation_um", f"deviation [{unit}]"))


def test_the_order_of_positions_tells_the_direction_only_of_a_test_in_both(tmp_path):
    there, back = [0.0, 10.0, 20.0], [20.0, 10.0, 0.0]
    assert passes_by_order([*there, *back], [0] * 6) == [(1, "positive")] * 3 + [(2, "negative")] * 3
    # The last target is read once; a test that was broken off.
    assert passes_by_order([*there, *back[1:], 10.0], [0] * 6) == [(1, "positive")] * 3 + [(2, "negative")] * 2 + [
        (3, "positive")
    ]
    assert passes_by_order([*back, *there], [1] * 3 + [2] * 3) == [(1, "negative")] * 3 + [(2, "positive")] * 3
    unknown = [
        [*there, *there],
        [0.0, 0.0, 10.0, 10.0, 20.0, 20.0],
        [0.0, 10.0, 10.0, 20.0],
        [0.0, 10.0, 0.0, 10.0, 20.0, 10.0],
        there,
    ]
    for positions in unknown:
        assert passes_by_order(positions, [0] * len(positions)) is None


def test_columns_that_are_no_runs_empty_cells_and_words_are_named(tmp_path):
    ignored = read_wide(tmp_path, WIDE_DIALECTS["summary columns"]).attrs["columns_ignored"]
    assert json.loads(ignored) == ["Mean + [um]", "s"]
    text = WIDE_DIALECTS["signs"].replace("0,1.25,", "0,,").replace("20,1.5", "20,fail")
    form = read_wide(tmp_path, WIDE_DIALECTS["form of ISO 230-2"]).attrs["columns_ignored"]
    assert json.loads(form) == ["Mean deviation"]
    test = read_wide(tmp_path, text + "\nMean,1,1,1,1\n")
    assert np.isnan(test["deviation"].values[0, 0, :2]).all()
    assert test.attrs["missing"] == 2
    (line,) = json.loads(test.attrs["left_out"])
    assert (line["line"], line["value"], line["reason"]) == (3, "fail", "is not a number")
    twice = read_wide(tmp_path, "Position [mm],1+ [um],1- [um]\n0,1,2\n0,1,2\n20,1,2\n")
    assert "cycle 1 positive target 1" in twice.attrs["left_out"]


@pytest.mark.parametrize("kind", ["xlsx", "ods"])
def test_a_sheet_with_merged_headings(tmp_path, kind):
    headings = [["Deviations [um]"], ["Position [mm]", "Cycle 1", "", "Cycle 2", ""], ["", "+", "-", "+", "-"]]
    rows = [*headings, *map(list, ROWS)]
    path = tmp_path / f"wide.{kind}"
    if kind == "ods":
        write_ods(path, rows)
    else:
        book = openpyxl.Workbook()
        for row in rows:
            book.active.append([value if value != "" else None for value in row])
        for cells in ("A1:E1", "A2:A3", "B2:C2", "D2:E2"):
            book.active.merge_cells(cells)
        book.save(path)
    assert read_deviations(path)["deviation"].values.tolist() == WIDE_EXPECTED.tolist()


@pytest.mark.parametrize(
    ("text", "lacking"),
    [
        (f"Target,Run1+,Run1-,Run2+,Run2-\n{DATA}", ("position_unit", "deviation_unit")),
        (f"Position,1+ [um],1- [um],2+ [um],2- [um]\n{DATA}", ("position_unit",)),
        (f"Target [mm],up 1,down 1,up 2,down 2\n{DATA}", ("deviation_unit",)),
        (f"Target [mm],1,2,3,4\n{DATA}", ("deviation_unit", "directions")),
        (f"Position [mm],1 fwd [um],1 rev [um],2 fwd,2 rev\n{DATA}", ()),
    ],
)
def test_what_no_heading_states_is_asked_and_taken_as_it_is_stated(tmp_path, text, lacking):
    choices = {"position_unit": "mm", "deviation_unit": "um", "directions": "positive first"}
    stated = {key: choices[key] for key in lacking}
    if lacking:
        with pytest.raises(NotStated) as refused:
            read_wide(tmp_path, text)
        assert refused.value.keys == lacking
    test = read_wide(tmp_path, text, **stated)
    assert test["deviation"].values == pytest.approx(WIDE_EXPECTED, abs=1e-6)
    if "deviation_unit" in stated:
        in_mm = read_wide(tmp_path, text, **(stated | {"deviation_unit": "mm"}))
        assert in_mm["deviation"].values == pytest.approx(1e3 * WIDE_EXPECTED, abs=1e-6)
    for contrary in ({"position_unit": "in"}, {"deviation_unit": "nm"}):
        if not contrary.keys() & stated:
            with pytest.raises(LaserFormatError, match=r"the table states the unit .* remove"):
                read_wide(tmp_path, text, **stated, **contrary)


def test_a_direction_that_the_order_of_the_positions_contradicts_is_asked(tmp_path):
    """Runs named "-" towards larger positions: another sign of the travel; sorted lines of both directions contradict nothing."""
    head = "run,direction,position_mm,deviation_um\n"
    lines = {"+": [f"{{}},{{}},{p},{p / 10}" for p in (0, 20, 40)]}
    lines["-"] = lines["+"][::-1]

    def written(*runs):
        return head + "\n".join(line.format(n, sign) for n, sign, order in runs for line in lines[order])

    with pytest.raises(NotStated, match="against the sign of the travel") as refused:
        read_wide(tmp_path, written((1, "-", "+"), (1, "+", "-")))
    assert refused.value.keys == ("directions",)
    turned = read_wide(tmp_path, written((1, "-", "+"), (1, "+", "-")), directions="positive first")
    assert turned.sizes["cycle"] == 1
    assert read_wide(tmp_path, written((1, "+", "+"), (1, "-", "+"))).attrs["missing"] == 0


def test_numbers_of_targets_are_no_positions(tmp_path):
    with pytest.raises(LaserFormatError, match="no table of deviations"):
        read_wide(tmp_path, "Target,1+,1-,2+,2-\n1,0.1,0.2,0.1,0.3\n2,0.4,0.2,0.1,0.3\n3,0.1,0.2,0.1,0.3\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"Position [deg],1+ [um],1- [um],2+ [um],2- [um]\n{DATA}", "positions in deg, deviations in um; give both as"),
        (f"Position [mm],1+ [um],1- [um],2+ [um],- [um]\n{DATA}", "'- .um.' has no number, but other runs have"),
        (
            f"Position [mm],1 [um],2 [um],3 [um],4 [um]\n{DATA}",
            "line 1: no heading or column names the direction of the runs.* state directions",
        ),
    ],
)
def test_what_a_wide_table_lacks_is_named(tmp_path, text, message):
    with pytest.raises(LaserFormatError, match=message):
        read_wide(tmp_path, text)


@pytest.mark.long
def test_one_wide_line_above_many_short_ones_does_not_fill_the_memory(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("Position [mm]" + "," * 1_900 + "\n" + "1\n" * 25_000)
    tracemalloc.start()
    (grid,) = read_grids(path)
    assert find_wide_table(grid) is None
    # A place for every cell would be 380 MB.
    assert tracemalloc.get_traced_memory()[1] < 4 * path.stat().st_size + 200e6
    tracemalloc.stop()


def test_a_cycle_and_a_target_for_every_reading_do_not_fill_the_memory(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "cycle,target,position (mm),direction,deviation (um)\n"
        + "".join(f"{i},{i},{i},+,0.1\n" for i in range(1, 1_601))
    )
    with pytest.raises(
        LaserFormatError, match=r"1600 cycles in 2 directions at 1600 targets are more than 5,000,000 readings; give"
    ):
        read_deviations(path)


def test_a_title_and_headings_in_two_units_are_refused(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("Deviations in um\nPosition [mm];1+ [mm];1- [mm]\n0;0.001;0.002\n100;0.003;0.004\n")
    with pytest.raises(LaserFormatError, match="in um by the title and in mm by the headings"):
        read_deviations(path)


def test_a_column_that_may_part_thousands_beside_decimal_commas_is_refused(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("Position [mm];1+ [um];1- [um]\n0,0;1.050;1.150\n100,0;1.060;1.160\n200,0;1.070;1.170\n")
    with pytest.raises(LaserFormatError, match=r"'1\.050' may part thousands or decimals"):
        read_deviations(path)
    path.write_text("Position [mm];1+ [nm];1- [nm]\n0,0;950;1.150\n100,0;1.060;160\n200,0;1.070;170\n")
    assert read_deviations(path)["deviation"].values[0, 0].tolist() == [0.95, 1.06, 1.07]
