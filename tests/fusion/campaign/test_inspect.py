"""Inspection: kinds of files by their content, descriptions of all of them, series of frames, and bars of time."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fusion.campaign.inspect import (
    Kind,
    Recording,
    describe_file,
    describe_series,
    input_files,
    inspect_paths,
    recognise,
    scan_folder,
    time_bars,
    write_frames,
)
from fusion.campaign.values import column_unit, is_displacement, is_temperature, is_time
from interferometry.io.faults import LaserFormatError
from tests.thermography.flir_mutations import PARAMETERS, frame
from thermography import inspection
from thermography.common import ThermographyError
from thermography.io import other_cameras as frame_readers
from thermography.io.flir import FlirReader
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import CameraIdentity
from thermography.io.other_cameras import StackContents, StackOptions, TemperatureReader


def test_a_folder_is_looked_into_and_its_series_summed_up(campaign_folder):
    found = list(inspect_paths([campaign_folder]))
    assert [one.kind for one in found].count(Kind.FRAMES) == 1 and len(found) == 6
    assert not any(one.fails for one in found)
    assert sum(len(one.shown()) for one in found) < 40


def test_a_bad_file_stops_nothing(copied):
    (copied / "laser.csv").write_text("cycle,direction,target,position_mm,time,deviation_um\nx,y,z,a,b,c\n")
    (copied / "notes.md").write_text("# Notes\n")
    absent = copied / "absent.csv"
    found = {Path(one.label).name: one for one in inspect_paths([absent, copied])}
    assert found["absent.csv"].fails and found["absent.csv"].fault == "No such file or directory"
    assert found["laser.csv"].fails
    # What nobody asked for and nothing reads is named, but is no failure.
    assert found["notes.md"].fault and not found["notes.md"].fails
    assert found["fiducials.csv"].lines and found["*.jpg"].lines
    assert json.loads(json.dumps([one.as_json() for one in found.values()]))[0]["fault"] == "No such file or directory"


def test_quiet_leaves_what_asks_for_action(copied):
    assert [line for one in inspect_paths([copied]) for line in one.shown(quiet=True)] == []
    text = (copied / "laser.csv").read_text().replace("1,positive,1,", "1,sideways,1,", 1)
    (copied / "laser.csv").write_text(text)
    lines = [line for one in inspect_paths([copied]) for line in one.shown(quiet=True)]
    assert lines and all(line.startswith(f"{copied / 'laser.csv'}: warning: ") for line in lines)


def test_exported_frames_of_the_same_name_are_kept_apart_and_none_is_overwritten(campaign_folder, tmp_path):
    thermal = sorted((campaign_folder / "thermal").iterdir())[:2]
    for name, path in zip("ab", thermal, strict=True):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x.jpg").write_bytes(path.read_bytes())
    told = list(write_frames([tmp_path / "a", tmp_path / "b"], tmp_path / "out", ["tiff"]))
    assert told == [f"written: {tmp_path / 'out' / name}" for name in ("a_x.jpg.tiff", "b_x.jpg.tiff")]
    with pytest.raises(ThermographyError, match=r"a_x\.jpg\.tiff exists already; name another folder"):
        list(write_frames([tmp_path / "a", tmp_path / "b"], tmp_path / "out", ["tiff"]))


def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
    pipe = tmp_path / "x.jpg"
    os.mkfifo(pipe)
    (found,) = inspect_paths([pipe])
    assert found.kind is Kind.UNREADABLE and found.fails and "name a file" in found.fault
    (in_folder,) = inspect_paths([tmp_path])
    assert in_folder.fails and in_folder.fault == found.fault, "what stands in a folder is named as well"
    assert [one.path for one in scan_folder(tmp_path).unknown] == [pipe]


def test_a_folder_without_files_is_told(tmp_path):
    (tmp_path / ".hidden").touch()
    (found,) = inspect_paths([tmp_path])
    assert found.fails and found.fault.startswith("contains no file to inspect")


ENVIRONMENT = "time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC"


def described(path: Path) -> list[str]:
    return describe_file(recognise(path))


def test_a_log_is_described_with_its_range_and_its_zone(tmp_path):
    path = tmp_path / "environment.csv"
    for zone, words in (("Z", "UTC in the file"), ("", "no zone in the file: taken as UTC")):
        rows = [f"2026-03-09T06:{minute:02d}:00{zone},{20 + minute / 10},1000,45,21" for minute in range(10)]
        path.write_text("\n".join([ENVIRONMENT, *rows]) + "\n")
        lines = described(path)
        assert lines[0] == f"{path}: environment, 10 rows, 2026-03-09 06:00 UTC to 2026-03-09 06:09 UTC, {words}"
        assert "  air_temperature 20.00 to 20.90 °C" in lines


def test_the_files_of_a_campaign(campaign_folder):
    campaign = described(campaign_folder / "campaign.toml")
    assert campaign[0].endswith("campaign, Small campaign") and "thermofuse check" in campaign[-1]
    assert "fiducials.csv: fiducials, 12 discs, x 40" in described(campaign_folder / "fiducials.csv")[0]
    assert "  duty" in described(campaign_folder / "drivers.csv")[1]
    laser = described(campaign_folder / "laser.csv")
    assert "deviations, 24 cycles, 6 targets from 0 to 250 mm, 288 of 288 readings" in laser[0]
    assert laser[2].endswith("times recorded, UTC in the file")


@pytest.mark.parametrize(
    ("error", "kind", "reason"),
    [
        (ZeroDivisionError(), Kind.UNKNOWN, "ZeroDivisionError in "),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "x"), Kind.UNKNOWN, "UnicodeDecodeError in "),
        (MemoryError(), Kind.UNKNOWN, "MemoryError in "),
        (LaserFormatError("log.csv: line 7 is cut"), Kind.UNKNOWN, "line 7 is cut"),
        (PermissionError(13, "Permission denied"), Kind.UNREADABLE, "Permission denied"),
    ],
)
def test_a_file_on_which_a_reader_fails_is_not_used_and_stops_no_other(tmp_path, monkeypatch, error, kind, reason):
    """Whatever a reader raises: one place tells why, and what nobody has foreseen with its type and place."""
    (tmp_path / "a.csv").write_text("time [s],t1 [degC],ch1 [um]\n0,20,0\n1,20,0\n")
    (tmp_path / "b.csv").write_text("name,x_mm,y_mm\nmotor,0,0\nmotor,9,0\nmotor,9,9\n")

    def fails(headings):
        if any(name.startswith("t1") for name in headings):
            raise error
        return Kind.REGIONS

    monkeypatch.setattr("fusion.campaign.inspect._by_headings", fails)
    # A table that one reader refuses may be one of another kind: here it is none.
    monkeypatch.setattr("fusion.campaign.inspect._logged_table", lambda path: None)
    content = scan_folder(tmp_path)
    assert [one.path.name for one in content.of(Kind.REGIONS)] == ["b.csv"]
    (unused,) = content.unknown
    assert (unused.path.name, unused.kind) == ("a.csv", kind) and reason in unused.reason
    told = {one.label: one for one in inspect_paths([tmp_path])}
    assert reason in told[str(tmp_path / "a.csv")].fault and not told[str(tmp_path / "b.csv")].fault


def test_a_text_with_fields_longer_than_any_cell_is_no_table(tmp_path):
    """Reports hold such lines: they stand beside the files of a measurement."""
    (tmp_path / "page.html").write_text(f"<script>\nvar a = [1, '{'x' * 200_000}']\n</script>\n" * 3)
    (tmp_path / "head.csv").write_text(f"time,'{'x' * 200_000}',b\n1,2,3\n")
    for name in ("page.html", "head.csv"):
        found = recognise(tmp_path / name)
        assert found.kind is Kind.UNKNOWN and "fault of the program" not in found.reason, name


def test_regions_lenses_recipes_and_records(tmp_path):
    (tmp_path / "regions.csv").write_text("name,x_mm,y_mm\nmotor,0,0\nmotor,9,0\nmotor,9,9\n")
    assert described(tmp_path / "regions.csv") == [f"{tmp_path / 'regions.csv'}: 1 region of the plan: motor"]
    (tmp_path / "lens.json").write_text(
        '{"camera_matrix": [[900,0,320],[0,900,240],[0,0,1]], "distortion_coefficients": [0.1,0,0,0]}'
    )
    assert described(tmp_path / "lens.json")[0].endswith("lens, focal length 900.0 px, centre 320.0, 240.0 px")
    (tmp_path / "recipe.toml").write_text('[campaign]\ntitle = "A"\n[test]\ncycles = 3\n')
    assert described(tmp_path / "recipe.toml")[0].endswith("recipe of a simulation, A")
    (tmp_path / "run.csv").write_text("time [s],t1 [degC],ch1 [um],speed [1/min]\n0,20,0,1\n1,20,0,1\n")
    assert described(tmp_path / "run.csv") == [
        f"{tmp_path / 'run.csv'}: record, 2 rows, time in the column time [s]",
        "  1 temperature: t1 [degC]",
        "  1 displacement: ch1 [um]",
        "  1 driver: speed [1/min]",
    ]


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
def test_plug_ins_are_asked_before_the_reader_of_flir_files_as_in_a_run(tmp_path, monkeypatch, reader):
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
        ("a.csv", "cycle,direction,target,position_mm,deviation_um\n1,positive,1,0,0.1\n", Kind.DEVIATIONS),
        ("a.yml", "%YAML:1.0\ncamera_matrix: !!opencv-matrix\n", Kind.LENS),
        ("a.md", "# Notes\n\nNothing measured.\n", Kind.UNKNOWN),
        ("a.bin", "\0\1\2", Kind.UNKNOWN),
    ],
)
def test_the_content_decides(tmp_path, name, text, kind):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    found = recognise(path)
    assert found.kind is kind
    assert bool(found.reason) is (kind is Kind.UNKNOWN) and len(found.reason) < 180


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_a_record_is_known_in_every_encoding(tmp_path, encoding):
    rows = ["Zeit [s];T1 [°C];Z [µm]", *(f"{30 * row};20,5;1,25" for row in range(9000))]
    for count in (3, 4, len(rows)):
        (tmp_path / "a.csv").write_text("\n".join(rows[:count]) + "\n", encoding=encoding)
        found = recognise(tmp_path / "a.csv")
        assert (found.kind, found.headings) == (Kind.RECORD, ("Zeit [s]", "T1 [°C]", "Z [µm]"))


def test_a_workbook_is_looked_into(tmp_path):
    pd.DataFrame({"time (s)": [0, 1], "t1(°C)": [20, 20], "ch1(um)": [0, 1]}).to_excel(tmp_path / "a.xlsx", index=False)
    assert recognise(tmp_path / "a.xlsx").kind is Kind.RECORD
    pd.DataFrame({"a": [0, 1]}).to_excel(tmp_path / "b.xlsx", index=False)
    assert recognise(tmp_path / "b.xlsx").kind is Kind.UNKNOWN


@pytest.mark.real_data
def test_real_files_are_of_their_kind(real_file):
    assert recognise(real_file("friedcucumber__RenishawWork/data/22.rtl")).kind is Kind.DEVIATIONS
    assert recognise(real_file("CAIVIAC__FL_THERMAL/data/data.xlsx")).kind is Kind.RECORD
    assert recognise(real_file("gtatters__Thermimage/inst/extdata/SampleCSQ.csq")).kind is Kind.FRAMES


def test_headings_say_what_a_column_is():
    assert column_unit("t1 [°C]") == "degC" and column_unit("speed") == ""
    assert is_temperature("t1(K)") and not is_temperature("rise")
    assert is_displacement("ch1 [µm]") and not is_displacement("length [m2]")
    assert is_time("time") and is_time("時間(s)") and not is_time("speed [1/min]")


def test_frames_of_temperatures_are_recognised_as_arrays_and_as_text(tmp_path):
    np.save(tmp_path / "a.npy", np.full((8, 9), 20.0))
    (tmp_path / "b.csv").write_text("\n".join(";".join(["20,1"] * 9) for _ in range(8)))
    assert [recognise(tmp_path / name).kind for name in ("a.npy", "b.csv")] == [Kind.STACK, Kind.STACK]
    assert "NumPy array, 1 frame of 9 x 8" in describe_file(recognise(tmp_path / "a.npy"))[0]


@pytest.mark.parametrize("time", ["Datum", "Zeit", "fecha y hora", "时间", "Date"])
def test_a_record_is_known_by_the_time_column_of_any_language(tmp_path, time):
    rows = "09.03.2026 06:30;20,5;0,25\n09.03.2026 06:31;20,6;0,35\n"
    (tmp_path / "a.csv").write_text(f"{time};Lager [°C];Z [µm]\n{rows}", encoding="utf-8")
    found = recognise(tmp_path / "a.csv")
    assert found.kind is Kind.RECORD and f"time in the column {time}" in describe_file(found)[0]


def test_places_of_sensors_are_no_corners_of_regions(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("name,x_mm,y_mm\nT1,50,50\nT2,150,50\n")
    found = recognise(path)
    assert found.kind is Kind.PLACES
    assert describe_file(found)[0].endswith("places of 2 contact sensors on the plan: T1 and T2")
    path.write_text("name,x_mm,y_mm\nmotor,0,0\nmotor,9,0\nmotor,9,9\n")
    assert recognise(path).kind is Kind.REGIONS


def test_a_campaign_folder_is_sorted_out(campaign_folder):
    content = scan_folder(campaign_folder)
    assert content.frames == ("thermal/*.jpg",)
    assert len(content.frame_files) == len(list((campaign_folder / "thermal").iterdir()))
    assert {kind: [content.relative(one.path) for one in files] for kind, files in content.files.items()} == {
        Kind.CAMPAIGN: ["campaign.toml"],
        Kind.DRIVERS: ["drivers.csv"],
        Kind.ENVIRONMENT: ["environment.csv"],
        Kind.FIDUCIALS: ["fiducials.csv"],
        Kind.DEVIATIONS: ["laser.csv"],
    }
    assert content.unknown == () and content.of(Kind.LENS) == ()


def test_photos_results_and_hidden_files_are_no_input(copied):
    (copied / "photos").mkdir()
    for name in "abcd":
        (copied / "photos" / f"{name}.jpg").write_bytes(b"\xff\xd8\xff\xe0" + b"\0" * 40 + b"\xff\xd9")
    (copied / "results").mkdir()
    (copied / "results" / "results.json").write_text("{}")
    (copied / "results" / "drift.csv").write_text("cycle,direction\n")
    (copied / ".hidden").write_text("x")
    content = scan_folder(copied)
    assert content.frames == ("thermal/*.jpg",)
    assert [content.relative(one.path) for one in content.unknown] == [f"photos/{name}.jpg" for name in "abcd"]


def test_links_to_folders_above_are_not_followed_for_ever(tmp_path):
    (tmp_path / "a.csv").write_text("x")
    for name in ("self", "again", "more"):
        (tmp_path / name).symlink_to(".")
    assert list(input_files(tmp_path)) == [tmp_path / "a.csv"]


def test_a_link_whose_file_is_gone_is_named_among_what_is_not_used(copied):
    (copied / "spindle.jpg").symlink_to("moved.jpg")
    (copied / "ring.csv").symlink_to("ring.csv")
    assert [(one.path.name, one.reason) for one in scan_folder(copied).unknown] == [
        ("ring.csv", "a link to ring.csv, where there is no file"),
        ("spindle.jpg", "a link to moved.jpg, where there is no file"),
    ]


def test_a_sound_series_is_ten_lines_at_most_and_a_few_frames_are_described_one_by_one(campaign_folder):
    paths = sorted((campaign_folder / "thermal").iterdir())
    lines = describe_series(paths, label="thermal/*.jpg")
    assert lines[0] == f"thermal/*.jpg: thermal frames, {len(paths)} files, {len(paths)} frames of 640 x 480"
    assert len(lines) <= 10 and not any("warning" in line for line in lines)
    assert any("0 gaps" in line for line in lines) and any("the same in all frames" in line for line in lines)
    frames = sorted((campaign_folder / "thermal").iterdir())[:2]
    assert [one.label for one in inspect_paths(frames)] == [str(frame) for frame in frames]


def test_two_cameras_a_gap_and_other_settings_are_named(tmp_path):
    counts = np.full((4, 6), 18_000, dtype=np.uint16)
    for k, minute in enumerate((0, 1, 2, 3, 4, 45, 46)):
        parameters = PARAMETERS if k < 5 else replace(PARAMETERS, emissivity=0.8)
        camera = CameraIdentity(model="SC660", serial="1" if k < 6 else "2")
        write_jpeg(tmp_path / f"{k}.jpg", counts, parameters, f"2026-03-09T06:{minute:02d}:00", camera=camera)
    (tmp_path / "9.jpg").write_bytes((tmp_path / "0.jpg").read_bytes()[:400])
    lines = describe_series(sorted(tmp_path.iterdir()), label="s")
    text = "\n".join(lines)
    assert "  6 frames of SC660 1, 6 x 4" in lines and "  1 frame of SC660 2, 6 x 4" in lines
    assert "    camera SC660, serial 2" in lines
    assert "a frame every 60 s, 1 gap: 2026-03-09 06:04 UTC, 41 min" in text
    assert "of the first frame; not the same in all: emissivity" in text
    assert "  warning: 1 frame left out: 9.jpg: " in text


def test_a_series_without_a_frame_is_refused(tmp_path, campaign_folder):
    whole = sorted((campaign_folder / "thermal").iterdir())[0].read_bytes()
    for name in "ab":
        (tmp_path / f"{name}.jpg").write_bytes(whole[:500])
    with pytest.raises(ThermographyError, match="s: no frame can be read; "):
        describe_series(sorted(tmp_path.iterdir()), label="s")


START = np.datetime64("2026-03-09T06:00:00", "ns")


def every(minutes: float, first_min: float, last_min: float) -> np.ndarray:
    steps = np.arange(first_min, last_min + 1e-9, minutes)
    return START + (steps * 60e9).astype("timedelta64[ns]")


def test_bars_lie_on_one_axis_and_name_gaps_and_recordings_without_times():
    lines = time_bars(
        [
            Recording("frames", every(2, 60, 120)),
            Recording("laser", every(1, 0, 60)),
            Recording("log", every(5, 0, 120)),
        ],
        width=40,
    )
    assert lines[0] == f"frames  {'·' * 20}{'█' * 20}"
    assert lines[1] == f"laser   {'█' * 20}{'·' * 20}"
    assert lines[2] == f"log     {'█' * 40}"
    assert lines[3] == "UTC     2026-03-09 06:00 2.0 h  2026-03-09 08:00"
    gap = np.concatenate([every(1, 0, 30), every(1, 90, 120)])
    untimed = np.full(3, np.datetime64("NaT", "ns"))
    lines = time_bars([Recording("frames", gap), Recording("laser", untimed)], width=40)
    assert lines[0] == f"frames  {'█' * 10}{'·' * 20}{'█' * 10}  1 gap"
    assert lines[1] == f"laser   no times{'·' * 32}"
    assert time_bars([Recording("laser", untimed)]) == []
    lines = time_bars([Recording("a", every(1, 0, 0)), Recording("b", every(1, 0, 60))], width=30)
    assert lines[0] == f"a    {'█'}{'·' * 29}"
    assert Recording("same", np.repeat(START, 4)).stretches() == [(START, START)]
    seconds = np.datetime64("1970-01-01", "ns") + (np.arange(0, 36_000, 60) * 10**9).astype("timedelta64[ns]")
    assert time_bars([Recording("record", seconds)], width=40)[1] == f"        start{'':<29}10.0 h"
