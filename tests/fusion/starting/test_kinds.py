"""Kinds of files by their content, whatever they are called."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fusion.starting.describe import describe_file
from fusion.starting.kinds import Kind, column_unit, is_displacement, is_temperature, is_time, recognise
from tests.thermography.flir_mutations import frame
from thermography import inspection
from thermography.io import frame_readers
from thermography.io.flir import FlirReader
from thermography.io.flir_writer import write_sequence
from thermography.io.temperature_frames import StackContents, StackOptions, TemperatureReader


class OwnReader(TemperatureReader):
    """A plug-in for files that the FLIR reader would take too."""

    name = "own"

    def recognises(self, path: Path, start: bytes) -> bool:
        return path.suffix == ".own"

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        return StackContents(1, (2, 3), "degC")

    def read_values(self, path: Path, index: int, options: StackOptions) -> np.ndarray:
        return np.ones((2, 3))


class OwnCounts(FlirReader):
    """A plug-in for counts."""

    name = "own counts"

    def recognises(self, path: Path, start: bytes) -> bool:
        return path.suffix == ".own"


@pytest.mark.parametrize("reader", [OwnReader(), OwnCounts()])
def test_plug_ins_are_asked_before_the_reader_of_flir_files_as_in_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: TemperatureReader | FlirReader
) -> None:
    for name in ("a.own", "b.seq"):
        write_sequence(tmp_path / name, [frame(6, 8, seconds=0)])
    for module in (frame_readers, inspection):
        monkeypatch.setattr(module, "plug_ins", lambda: (reader,))
    monkeypatch.setattr(frame_readers, "readers", lambda: (reader, FlirReader()))
    assert recognise(tmp_path / "b.seq").kind is Kind.FRAMES
    own = recognise(tmp_path / "a.own")
    if isinstance(reader, TemperatureReader):
        assert own.kind is Kind.STACK and describe_file(own)[0].endswith("a.own: own, 1 frame of 3 x 2")
    else:
        assert own.kind is Kind.UNKNOWN and own.reason.startswith("counts that the plug-in own counts reads; name the")


@pytest.mark.parametrize(
    ("name", "text", "kind"),
    [
        ("a.toml", '[campaign]\ntitle = "A"\n[record]\nfile = "a.csv"\n', Kind.CAMPAIGN),
        ("a.toml", '[campaign]\ntitle = "A"\n[test]\ncycles = 3\n', Kind.RECIPE),
        ("a.toml", "[tool]\nx = 1\n", Kind.UNKNOWN),
        ("a.toml", "[tool\n", Kind.UNKNOWN),
        ("a.csv", "name,x_mm,y_mm,diameter_mm\nF1,40,20,16\n", Kind.FIDUCIALS),
        ("a.csv", "name,x_mm,y_mm\nmotor,1,2\n", Kind.REGIONS),
        ("a.csv", "# logged\n\ntime;air_temperature_degC;air_pressure_hPa\n", Kind.ENVIRONMENT),
        ("a.csv", "Zeit;Lufttemperatur [°C];Luftdruck [hPa]\n", Kind.ENVIRONMENT),
        ("a.csv", "Position [mm],1+ [um],1- [um]\n0,0.1,0.2\n100,0.3,0.4\n", Kind.DEVIATIONS),
        ("a.csv", "time,spindle [1/min],pump [1]\n2026-03-09T06:30:00Z,1,0\n", Kind.DRIVERS),
        ("a.txt", "zeit (s)\tt1(°C)\tch1(um)\n0\t20\t0\n", Kind.RECORD),
        (
            "a.csv",
            "cycle,direction,target,position_mm,time,deviation_um\n1,positive,1,0,2026-03-09T06:30:00Z,0.1\n",
            Kind.DEVIATIONS,
        ),
        ("a.yml", "%YAML:1.0\ncamera_matrix: !!opencv-matrix\n", Kind.LENS),
        ("a.md", "# Notes\n\nNothing measured.\n", Kind.UNKNOWN),
        ("a.bin", "\0\1\2", Kind.UNKNOWN),
    ],
)
def test_the_content_decides(tmp_path: Path, name: str, text: str, kind: Kind) -> None:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    found = recognise(path)
    assert found.kind is kind
    assert bool(found.reason) is (kind is Kind.UNKNOWN) and len(found.reason) < 180


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "cp1252"])
def test_a_record_is_known_in_every_encoding(tmp_path: Path, encoding: str) -> None:
    rows = ["Zeit [s];T1 [°C];Z [µm]", *(f"{30 * row};20,5;1,25" for row in range(9000))]
    for count in (3, 4, len(rows)):
        (tmp_path / "a.csv").write_text("\n".join(rows[:count]) + "\n", encoding=encoding)
        found = recognise(tmp_path / "a.csv")
        assert (found.kind, found.headings) == (Kind.RECORD, ("Zeit [s]", "T1 [°C]", "Z [µm]"))


def test_a_workbook_is_looked_into(tmp_path: Path) -> None:
    pd.DataFrame({"time (s)": [0, 1], "t1(°C)": [20, 20], "ch1(um)": [0, 1]}).to_excel(tmp_path / "a.xlsx", index=False)
    assert recognise(tmp_path / "a.xlsx").kind is Kind.RECORD
    pd.DataFrame({"a": [0, 1]}).to_excel(tmp_path / "b.xlsx", index=False)
    assert recognise(tmp_path / "b.xlsx").kind is Kind.UNKNOWN


def test_a_photo_is_no_thermal_frame(tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff\xe0" + b"\0" * 40 + b"\xff\xd9")
    found = recognise(tmp_path / "photo.jpg")
    assert (found.kind, bool(found.reason)) == (Kind.UNKNOWN, True)


def test_other_encodings_are_read(tmp_path: Path) -> None:
    for encoding in ("utf-16", "cp1252", "utf-8-sig"):
        (tmp_path / "a.csv").write_text("time (s);t1 (°C);ch1 (µm)\n0;20;0\n", encoding=encoding)
        assert recognise(tmp_path / "a.csv").kind is Kind.RECORD


@pytest.mark.real_data
def test_real_files_are_of_their_kind(real_file: Callable[[str], Path]) -> None:
    assert recognise(real_file("friedcucumber__RenishawWork/data/22.rtl")).kind is Kind.DEVIATIONS
    assert recognise(real_file("CAIVIAC__FL_THERMAL/data/data.xlsx")).kind is Kind.RECORD
    assert recognise(real_file("gtatters__Thermimage/inst/extdata/SampleCSQ.csq")).kind is Kind.FRAMES


def test_headings_say_what_a_column_is() -> None:
    assert column_unit("t1 [°C]") == "degC" and column_unit("speed") == ""
    assert is_temperature("t1(K)") and not is_temperature("rise")
    assert is_displacement("ch1 [µm]") and not is_displacement("length [m2]")
    assert is_time("time") and is_time("時間(s)") and not is_time("speed [1/min]")


def test_frames_of_temperatures_are_recognised_as_arrays_and_as_text(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.full((8, 9), 20.0))
    (tmp_path / "b.csv").write_text("\n".join(";".join(["20,1"] * 9) for _ in range(8)))
    assert [recognise(tmp_path / name).kind for name in ("a.npy", "b.csv")] == [Kind.STACK, Kind.STACK]
    assert "NumPy array, 1 frame of 9 x 8" in describe_file(recognise(tmp_path / "a.npy"))[0]


@pytest.mark.parametrize("time", ["Datum", "Zeit", "fecha y hora", "时间", "Date"])
def test_a_record_is_known_by_the_time_column_of_any_language(tmp_path: Path, time: str) -> None:
    rows = "09.03.2026 06:30;20,5;0,25\n09.03.2026 06:31;20,6;0,35\n"
    (tmp_path / "a.csv").write_text(f"{time};Lager [°C];Z [µm]\n{rows}", encoding="utf-8")
    found = recognise(tmp_path / "a.csv")
    assert found.kind is Kind.RECORD and f"time in the column {time}" in describe_file(found)[0]


def test_places_of_sensors_are_no_corners_of_regions(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("name,x_mm,y_mm\nT1,50,50\nT2,150,50\n")
    found = recognise(path)
    assert found.kind is Kind.PLACES
    assert describe_file(found)[0].endswith("places of 2 contact sensors on the plan: T1 and T2")
    path.write_text("name,x_mm,y_mm\nmotor,0,0\nmotor,9,0\nmotor,9,9\n")
    assert recognise(path).kind is Kind.REGIONS
