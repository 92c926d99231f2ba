"""Tables of position by run as labs keep them in spreadsheets, in both orientations, and what they lack."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import openpyxl
import pytest
import xarray as xr

from interferometry.io.delimited import read_grids
from interferometry.io.faults import LaserFormatError
from interferometry.io.readers import read_deviations
from interferometry.io.wide_table import find_wide_table
from tests.interferometry.io.test_workbook import write_ods

EXPECTED = np.array([[[1.25, 1.5, 1.75], [0.75, 0.5, 0.25]], [[2.25, 2.5, 2.75], [1.75, 1.5, 1.25]]])
ROWS = [(0, 1.25, 0.75, 2.25, 1.75), (20, 1.5, 0.5, 2.5, 1.5), (40, 1.75, 0.25, 2.75, 1.25)]
DATA = "\n".join(",".join(map(str, row)) for row in ROWS)
BY_DIRECTION = "\n".join(",".join(str(row[i]) for i in (0, 1, 3, 2, 4)) for row in ROWS)
BESIDE = "{0},{1},1.25,1.5,1.75\n{0},{2},.75,.5,.25\n{3},{1},2.25,2.5,2.75\n{3},{2},1.75,1.5,1.25\n"


def read(folder: Path, text: str, **options: bool) -> xr.Dataset:
    path = folder / "wide.csv"
    path.write_text(text, encoding="utf-8")
    return read_deviations(path, **options)


DIALECTS = {
    "signs": f"Position [mm],1+ [um],1- [um],2+ [um],2- [um]\n{DATA}",
    "signs first": f"Position [mm],+1 [um],-1 [um],+2 [um],-2 [um]\n{DATA}",
    "words": f"Unit: µm\nPosition (mm),Run 1 forward,Run 1 reverse,Run 2 forward,Run 2 reverse\n{DATA}",
    "alternating runs": f"Position (mm),Run 1 + (µm),Run 2 - (µm),Run 3 + (µm),Run 4 - (µm)\n{DATA}",
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


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_gives_the_same_test(tmp_path: Path, dialect: str) -> None:
    test = read(tmp_path, DIALECTS[dialect])
    assert test["position"].values.tolist() == [0.0, 20.0, 40.0]
    assert test["deviation"].values.tolist() == EXPECTED.tolist()
    assert test["time"].attrs["origin"] == "none"
    assert test.attrs["missing"] == 0


def test_columns_that_are_no_runs_are_named(tmp_path: Path) -> None:
    assert json.loads(read(tmp_path, DIALECTS["summary columns"]).attrs["columns_ignored"]) == ["Mean + [um]", "s"]


@pytest.mark.parametrize("kind", ["xlsx", "ods"])
def test_a_sheet_with_merged_headings(tmp_path: Path, kind: str) -> None:
    rows = [
        ["Deviations [um]"],
        ["Position [mm]", "Cycle 1", "", "Cycle 2", ""],
        ["", "+", "-", "+", "-"],
        *map(list, ROWS),
    ]
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
    assert read_deviations(path)["deviation"].values.tolist() == EXPECTED.tolist()


def test_empty_cells_are_missing_and_words_are_left_out(tmp_path: Path) -> None:
    text = DIALECTS["signs"].replace("0,1.25,", "0,,").replace("20,1.5", "20,fail")
    test = read(tmp_path, text + "\nMean,1,1,1,1\n")
    assert np.isnan(test["deviation"].values[0, 0, :2]).all()
    assert test.attrs["missing"] == 2
    (line,) = json.loads(test.attrs["left_out"])
    assert (line["line"], line["value"], line["reason"]) == (3, "fail", "is not a number")


def test_a_rotary_axis_in_degrees_and_arcseconds(tmp_path: Path) -> None:
    text = DIALECTS["signs"].replace("[mm]", "[deg]").replace("[um]", "[arcsec]")
    test = read(tmp_path, text, rotary=True)
    assert test["deviation"].attrs["units"] == "arcsec"
    assert test["deviation"].values == pytest.approx(EXPECTED, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            f"Position,1+ [um],1- [um],2+ [um],2- [um]\n{DATA}",
            r"line 1: the positions have no unit; .* \"Position \[mm\]\"",
        ),
        (f"Position [mm],1+,1-,2+,2-\n{DATA}", "the deviations have no unit; write it in the headings"),
        (f"Position [deg],1+ [um],1- [um],2+ [um],2- [um]\n{DATA}", "positions in deg, deviations in um; give both as"),
        (f"Position [mm],1+ [um],1- [um],2+ [um],- [um]\n{DATA}", "'- .um.' has no number, but other runs have"),
        (
            f"Position [mm],1 [um],2 [um],3 [um],4 [um]\n{DATA}",
            "no table of deviations; line 1 has columns of position",
        ),
        ("Position [mm],1+ [um],1- [um]\n0,1,2\n0,1,2\n20,1,2\n", r"cycle 1 positive target 1|targets .* both stand"),
    ],
)
def test_what_a_table_lacks_is_named(tmp_path: Path, text: str, message: str) -> None:
    if "0,1,2\n0,1,2" in text:
        assert message.split("|")[0] in read(tmp_path, text).attrs["left_out"]
        return
    with pytest.raises(LaserFormatError, match=message):
        read(tmp_path, text)


def test_one_wide_line_above_many_short_ones_does_not_fill_the_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("Position [mm]" + "," * 16_000 + "\n" + "1\n" * 100_000)
    tracemalloc.start()
    (grid,) = read_grids(path)
    assert find_wide_table(grid) is None
    assert tracemalloc.get_traced_memory()[1] < 4 * path.stat().st_size + 200e6
    tracemalloc.stop()
