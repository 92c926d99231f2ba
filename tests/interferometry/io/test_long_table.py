"""Tables with one reading per line: languages, units, dates and numbering of labs, and every broken promise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import openpyxl
import pytest
import xarray as xr

from interferometry.io.faults import LaserFormatError
from interferometry.io.readers import read_deviations

#: Cycle, sign, target, position in mm, second and deviation in um of a small test.
TEST = [
    (
        cycle,
        sign,
        target,
        20.0 * (target - 1),
        60 * cycle + (6 * target if sign > 0 else 40 - 6 * target),
        cycle + 0.25 * target * sign,
    )
    for cycle in (1, 2)
    for sign in (1, -1)
    for target in (1, 2, 3)
]
EXPECTED = np.array([[[c + 0.25 * t * s for t in (1, 2, 3)] for s in (1, -1)] for c in (1, 2)])


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


DIALECTS = {
    "german": table(
        "Zyklus;Richtung;Punkt;Sollposition [mm];Datum;Uhrzeit;Abweichung [µm]",
        "{c};{d};{t};{p};9.3.2026;{clock};{e}",
        decimal=",",
        plus="vorwärts",
        minus="rückwärts",
    ),
    "french": table(
        "Cycle;Sens;Point de mesure;Position cible (mm);Date;Heure;Écart (µm)",
        "{c};{d};{t};{p};09.03.2026;{clock};{e}",
        decimal=",",
        plus="aller",
        minus="retour",
    ),
    "spanish": table(
        "Ciclo;Sentido;Punto;Posición (mm);Fecha y hora;Desviación (µm)",
        "{c};{d};{t};{p};9.3.2026 {clock};{e}",
        decimal=",",
        plus="ida",
        minus="vuelta",
    ),
    "chinese": table(
        "循环,方向,目标,位置(mm),时间,偏差(μm)", "{c},{d},{t},{p},2026年3月9日 {clock},{e}", plus="正向", minus="反向"
    ),
    "signs": table("cycle,direction,target,position_mm,time,deviation_um", "{c},{d},{t},{p},2026-03-09T{clock},{e}"),
    "typographic minus": table(
        "cycle,direction,target,position_mm,time,deviation_um", "{c},{d},{t},{p},2026-03-09T{clock},{e}", minus="−"
    ).replace(",-", ",−"),
    "forward": table(
        "Cycle\tApproach\tTarget No.\tTarget [mm]\tTime\tError [um]",
        "{c}\t{d}\t{t}\t{p}\t2026-03-09 {clock}\t{e}",
        plus="Forward",
        minus="Reverse",
    ),
    "nanometres": table(
        "cycle,direction,target,position_mm,time,deviation_nm", "{c},{d},{t},{p},2026-03-09T{clock},{nm}"
    ),
    "millimetres": table(
        "cycle,direction,target,position_mm,time,deviation_mm", "{c},{d},{t},{p},2026-03-09T{clock},{mm}"
    ),
    "inches": table(
        "cycle,direction,target,position (inch),time,deviation_um", "{c},{d},{t},{inch},2026-03-09T{clock},{e}"
    ),
    "measured": table(
        "cycle,direction,target,position (mm),measured (mm),time", "{c},{d},{t},{p},{measured},2026-03-09T{clock}"
    ),
    "no targets": table("cycle,direction,position_mm,time,deviation_um", "{c},{d},{p},2026-03-09T{clock},{e}"),
    "from 0": table(
        "cycle,direction,target,position_mm,time,deviation_um", "{zero},{d},{tz},{p},2026-03-09T{clock},{e}"
    ),
    "runs": table("run,direction,target,position_mm,time,deviation_um", "{run},{d},{t},{p},2026-03-09T{clock},{e}"),
    "named numbers": table(
        "cycle,direction,target,position_mm,time,deviation_um", "Cycle {c},{d},P{t},{p},2026-03-09T{clock},{e}"
    ),
    "units row": table(
        "cycle,direction,target,position,time,deviation\n,,,mm,,um", "{c},{d},{t},{p},2026-03-09T{clock},{e}"
    ),
    "title": "Machine;X axis\nOperator;N.N.\n\n"
    + table("cycle;direction;target;position_mm;time;deviation_um", "{c};{d};{t};{p};2026-03-09T{clock};{e}"),
    "quoted": table(
        "cycle,direction,target,position_mm,time,deviation_um",
        '"{c}","{d}","{t}","{p}","2026-03-09T{clock}","{e}"',
        decimal=",",
    ),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_gives_the_same_test(tmp_path: Path, dialect: str) -> None:
    test = read(tmp_path, DIALECTS[dialect])
    # Inches of nine decimals place a target within 1e-8 mm; all other numbers are exact.
    assert test["position"].values == pytest.approx([0.0, 20.0, 40.0], abs=1e-7)
    assert test["deviation"].values == pytest.approx(EXPECTED, abs=1e-9)
    assert test["time"].values[0, 0, 0] == np.datetime64("2026-03-09T06:01:06")
    assert (test["deviation"].attrs["units"], test["position"].attrs["units"]) == ("um", "mm")
    assert json.loads(test.attrs["left_out"]) == []


@pytest.mark.parametrize(("dialect", "encoding"), [("german", "cp1252"), ("german", "utf-16"), ("chinese", "gb18030")])
def test_encodings_of_spreadsheet_programs(tmp_path: Path, dialect: str, encoding: str) -> None:
    assert read(tmp_path, DIALECTS[dialect], encoding).equals(read(tmp_path, DIALECTS[dialect]))


def test_a_sheet_with_title_merged_cycles_and_dates_is_read_among_others(tmp_path: Path) -> None:
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
    with pytest.raises(
        LaserFormatError, match="the sheets 'X axis', 'Y axis' each hold a table of deviations; name one"
    ):
        read_deviations(path)
    assert read_deviations(path, sheet="Y axis").equals(test)
    with pytest.raises(LaserFormatError, match="there is no sheet 'Z'; the sheets are 'Sheet', 'X axis', 'Y axis'"):
        read_deviations(path, sheet="Z")


def test_forward_runs_to_smaller_positions_are_the_negative_direction(tmp_path: Path) -> None:
    turned = DIALECTS["forward"].replace("Forward", "?").replace("Reverse", "Forward").replace("?", "Reverse")
    test = read(tmp_path, turned)
    assert test["deviation"].values.tolist() == EXPECTED.tolist()
    assert json.loads(test.attrs["notes"]) == [
        "the forward runs lead to smaller positions: they are the negative direction"
    ]


def test_numbering_from_0_is_told(tmp_path: Path) -> None:
    assert json.loads(read(tmp_path, DIALECTS["from 0"]).attrs["notes"]) == [
        "the file numbers its cycles from 0: 1 was added",
        "the file numbers its targets from 0: 1 was added",
    ]


def test_a_rotary_axis_keeps_its_units_and_is_refused_elsewhere(tmp_path: Path) -> None:
    text = table("cycle,direction,position (°),deviation (arcsec)", "{c},{d},{p},{e}")
    test = read(tmp_path, text, rotary=True)
    assert (test["deviation"].attrs["units"], test["position"].attrs["units"]) == ("arcsec", "deg")
    assert test["deviation"].values == pytest.approx(EXPECTED, abs=1e-6)
    with pytest.raises(
        LaserFormatError, match=r"the positions are angles; .* only the evaluation by ISO 230-2 is done"
    ):
        read(tmp_path, text)


def test_a_table_without_times_says_so(tmp_path: Path) -> None:
    test = read(tmp_path, table("cycle,direction,position_mm,deviation_um", "{c},{d},{p},{e}"))
    assert test["time"].attrs["origin"] == "none"
    assert np.isnat(test["time"].values).all()
    assert not test["quality_flag"].any()


@pytest.mark.parametrize("mark", ["9999", "-99999.999", "1_2.5", "−−1"])
def test_a_mark_for_no_reading_is_no_value(tmp_path: Path, mark: str) -> None:
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
            r"line 1: the column 'position' has no unit; .*\[mm\]",
        ),
        (
            "cycle,direction,position_mm,deviation_degC",
            "{c},{d},{p},{e}",
            "position in mm, deviation in degc; give both as lengths",
        ),
        (
            "cycle,direction,position_mm,error_um,deviation_um",
            "{c},{d},{p},{e},{e}",
            "'error_um' and 'deviation_um' both name the deviation",
        ),
        (
            "cycle,direction,position_mm,time,deviation_um",
            "{c},{d},{p},3/9/2026 {clock},{e}",
            "line 2: '3/9/2026 .* the day or the month first",
        ),
        (
            "cycle,position_mm,deviation_um",
            "{c},{p},{e}",
            "has columns of cycle, position, deviation, but no column of a direction",
        ),
        ("a,b,c,d", "{c},{d},{p},{e}", "no table of deviations; line 1 is 'a,b,c,d'; expected one reading per line"),
    ],
)
def test_what_a_table_lacks_is_named(tmp_path: Path, header: str, line: str, message: str) -> None:
    with pytest.raises(LaserFormatError, match=message):
        read(tmp_path, table(header, line))
