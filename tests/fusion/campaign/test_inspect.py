"""Inspection: kinds of files by their content, descriptions of all of them, series of frames, and bars of time."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
import xarray as xr
from PIL import Image

from fusion.campaign.inspect import (
    Kind,
    Recording,
    describe_series,
    input_files,
    inspect_paths,
    recognise,
    scan_folder,
    time_bars,
    write_frames,
)
from fusion.campaign.values import FILE_KEYS
from interferometry.io.faults import LaserFormatError
from interferometry.io.readings import FILES, TABLES, read_deviations
from interferometry.io.writers import write_rtl
from tests.thermography.flir_mutations import PARAMETERS, frame
from tests.thermography.io.test_other_cameras import public_format
from thermofuse.resources import vocabulary
from thermography.common import ThermographyError
from thermography.io import other_cameras as frame_readers
from thermography.io.files import write_maps
from thermography.io.flir import FlirReader
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import CameraIdentity
from thermography.io.other_cameras import StackContents, StackOptions, TemperatureReader, find_reader, plug_ins, readers


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


AIR = "time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC"
DAY = "2026-03-09T06"
LASER = "cycle,direction,target,position_mm,time,deviation_um\n" + "".join(
    f"{c},{way},{t},{100 * t},{DAY}:{m:02d}:00Z,{t}.{c}\n"
    for m, (c, way, t) in enumerate((c, way, t) for c in (1, 2) for way in ("positive", "negative") for t in (1, 2))
)
ECMC_REPORT = "# ISO 230-2 motion test\n" + "".join(
    f"### Data {way}ward direction\n\ni |tgt_pos(i) [mm]|ref_pos(i,1) [mm]|ref_pos(i,2) [mm]|\n--- |--- |--- |--- |\n"
    "1|1.0|1.001|1.002|\n2|2.0|2.01|2.02|\n"
    for way in ("for", "back")
)
LENS = '{"camera_matrix": [[900,0,320],[0,900,240],[0,0,1]], "distortion_coefficients": [0.1,0,0,0]}'
LONG_TABLE = "".join(
    f"MILL:{name} 2026-03-09 06:{m:02d}:00.0 {m}.5\n" for m in range(9) for name in ("TEMP-1", "DISP-Z")
)


def write_sheet(columns: dict[str, list[float]]) -> Callable[[Path], None]:
    return partial(pd.DataFrame(columns).to_excel, index=False)


def write_map(path: Path) -> None:
    write_maps(path, {"temperature": np.full((2, 3), 20.5)}, units={"temperature": "degC"}, attributes={"cycle": 7})


def write_netcdf(path: Path) -> None:
    frames = xr.DataArray(np.full((8, 9, 2), 20.0), dims=("y", "x", "time"), name="t", attrs={"units": "degC"})
    frames.to_netcdf(path)


def write_linear_test(path: Path) -> None:
    path.with_suffix(".csv").write_text(LASER)
    write_rtl(path, read_deviations(path.with_suffix(".csv")))


def write_flir(path: Path) -> None:
    write_sequence(path, [frame(6, 8, seconds=0)])


#: Files of every kind: name, content or what writes it, and what is said of it. Each is of its kind by its content, and of no other.
SAMPLES: list[tuple[Kind, str, str | Callable[[Path], object], list[str]]] = [
    (Kind.CAMPAIGN, "a.toml", '[campaign]\ntitle = "A"\n[record]\nfile = "{run}"\nevery = "1 s"\n'
     '[record.columns]\n"t1 [degC]" = "degC"\n"ch1 [um]" = "um"\n', ["campaign, A", "  [record], every key is understood"]),
    (Kind.RECIPE, "a.toml", '[campaign]\ntitle = "A"\n[test]\ncycles = 3\n', ["recipe of a simulation, A"]),
    (Kind.FRAMES, "a.seq", write_flir, ["FLIR, 1 frame of 8 x 6, samples raw"]),
    (Kind.STACK, "a.npy", lambda path: np.save(path, np.full((8, 9), 20.0)),
     ["NumPy array, 1 frame of 9 x 8", "  values of the first frame 20 to 20"]),
    (Kind.STACK, "a.tif", lambda path: tifffile.imwrite(path, np.full((8, 9), 20.0, "f4")), ["TIFF of temperatures, 1 frame of 9 x 8"]),
    (Kind.STACK, "a.png", lambda path: Image.fromarray(np.full((8, 9), 29315, "u2")).save(path),
     ["PNG of 16 bits, 1 frame of 9 x 8", "  values of the first frame 29315 to 29315"]),
    (Kind.STACK, "a.fpf", lambda path: public_format(path, 2, np.full((8, 9), 20.0, "f4")), ["FLIR Public Format, 1 frame of 9 x 8"]),
    (Kind.STACK, "a.nc", write_netcdf, ["NetCDF or Zarr, 2 frames of 9 x 8", "  values of the first frame 20 to 20 degC"]),
    (Kind.STACK, "a.csv", "\n".join(";".join(["20,1"] * 9) for _ in range(8)), ["text with one temperature per pixel, 1 frame of 9 x 8"]),
    (Kind.STACK, "a.txt", "\n".join("\t".join(["20.1"] * 32) for _ in range(32)), []),
    (Kind.PRODUCT, "a.exr", write_map, ["OpenEXR maps of 3 x 2 cells: cycle 7", "  temperature 20.5 to 20.5 °C"]),
    (Kind.PRODUCT, "results.json", '{"campaign": "A"}', ["results of a run: thermofuse report FOLDER writes its page; campaign A"]),
    (Kind.LENS, "a.json", LENS, ["lens, focal length 900.0 px, centre 320.0, 240.0 px"]),
    (Kind.LENS, "a.yml", "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
     "   data: [ 900., 0., 320., 0., 900., 240., 0., 0., 1. ]\ndistortion_coefficients: [ 0.1, 0., 0., 0. ]\n", ["lens, focal"]),
    (Kind.FIDUCIALS, "a.csv", "name,x_mm,y_mm,diameter_mm\nF1,40,20,16\n" + "".join(f"F{k},{90 + k},{k},9\n" for k in range(2, 5)),
     ["fiducials, 4 discs, x 40 to 94 mm, y 2 to 20 mm"]),
    (Kind.REGIONS, "a.csv", "name,x_mm,y_mm\nmotor,0,0\nmotor,9,0\nmotor,9,9\n", ["1 region of the plan: motor"]),
    # A sensor has one place, a region several corners.
    (Kind.PLACES, "a.csv", "name,x_mm,y_mm\nT1,50,50\nT2,150,50\n", ["places of 2 contact sensors on the plan: T1 and T2"]),
    (Kind.ENVIRONMENT, "a.csv", AIR + "".join(f"\n{DAY}:{m:02d}:00Z,{20 + m / 10},1000,45,21" for m in range(10)),
     ["environment, 10 rows", "  2026-03-09 06:00 UTC to 2026-03-09 06:09 UTC, 9 min, UTC in the file", "  a row every 60 s, 0 gaps",
      "  air_temperature 20.00 to 20.90 °C"]),
    (Kind.ENVIRONMENT, "a.csv", f"# logged\n\n{AIR.replace(',', ';')}\n{DAY}:00:00;20;1000;45;21\n",
     ["environment, 1 row", "  2026-03-09 06:00 (no zone) to 2026-03-09 06:00 (no zone), 0 s, no zone in the file: taken as UTC"]),
    (Kind.ENVIRONMENT, "a.csv", "Zeit;Lufttemperatur [°C];Luftdruck [hPa];Luftfeuchte [%];Materialtemperatur [°C]\n"
     "9.3.2026 6:30:00;20;1000;45;21\n", []),
    (Kind.DRIVERS, "a.csv", f"time,spindle [1/min],pump [1]\n{DAY}:30:00Z,1,0\n{DAY}:31:00Z,9,0\n",
     ["drivers, 2 rows", "  2026-03-09 06:30 UTC to 2026-03-09 06:31 UTC, 60 s, UTC in the file", "  a row every 60 s, 0 gaps",
      "  spindle 1.00 to 9.00 1/min"]),
    (Kind.DEVIATIONS, "a.csv", LASER, ["deviations, 2 cycles, 2 targets from 100 to 200 mm, 8 of 8 readings"]),
    (Kind.DEVIATIONS, "a.csv", "Position [mm],1+ [um],1- [um]\n0,0.1,0.2\n100,0.3,0.4\n",
     ["deviations, 1 cycle, 2 targets from 0 to 100 mm, 4 of 4 readings", "  deviation 0.100 to 0.400 µm"]),
    (Kind.DEVIATIONS, "a.dat", "UNIT=mm\nTGT_DATA[1]=0\nTGT_DATA[2]=1\n" + "".join(
        f"REF_DATA_{way}[{t},1]={t - 1}.001\n" for way in ("FWD", "BWD") for t in (1, 2)), []),
    (Kind.DEVIATIONS, "a.rtl", write_linear_test, ["deviations, 2 cycles, 2 targets from 100 to 200 mm, 8 of 8 readings"]),
    (Kind.DEVIATIONS, "a.md", ECMC_REPORT, []),
    (Kind.RECORD, "a.csv", "time [s],t1 [degC],ch1 [um],speed [1/min]\n0,20,0,1\n1,20,0,1\n",
     ["record, 2 rows, time in the column time [s]", "  0 s to 1 s after a start that is not stated, 1 s", "  a row every 1 s, 0 gaps",
      "  t1 [degC]: temperature, °C, by its heading, 20 to 20", "  ch1 [um]: displacement, µm, by its heading, 0 to 0",
      "  speed [1/min]: driver, 1/min, by its heading, 1 to 1"]),
    # A table of many columns with a time and names is no picture; what only the values tell is said.
    (Kind.RECORD, "a.csv", "Time," + ",".join(f"T{k}" for k in range(60)) + ",X\n" + "".join(
        f"{60 * k},{','.join(f'{20 + n / 10 + k / 100:.2f}' for n in range(60))},{k}.5\n" for k in range(60)),
     ["record, 60 rows, time in the column Time", "  times 0 to 3540, in s?, which nothing states",
      "  T0 ... T59 (60 columns): temperature, °C, unit by its values, 20 to 26.49",
      "  X: displacement, µm, unit by its values, 0.5 to 59.5"]),
    *((Kind.RECORD, "a.csv", f"{time};Lager [°C];Z [µm]\n09.03.2026 06:30;20,5;0,25\n09.03.2026 06:31;20,6;0,35\n",
       [f"record, 2 rows, time in the column {time}"]) for time in ("Datum", "Zeit", "fecha y hora", "时间", "Date")),
    (Kind.RECORD, "a.xlsx", write_sheet({"time (s)": [0, 1], "t1(°C)": [20, 20], "ch1(um)": [0, 1]}), ["record, 2 rows"]),
    (Kind.RECORD, "a.log", LONG_TABLE, ["record, 18 rows, a line for every change"]),
]  # fmt: skip
#: What nothing reads, and why not.
UNREAD = [
    ("a.json", '{"ts":1.5,"bed":28.0}\n{"ts":2.5,"z":0.1}\n', "JSON, which is not read; write it as CSV"),
    ("a.csv", ",".join(["20"] * 50_000), "columns; the file is damaged or no table"),
    ("a.toml", "[tool]\nx = 1\n", "neither a campaign nor a recipe"),
    ("a.toml", "[tool\n", "this is not TOML"),
    ("a.md", "# Notes\n\nNothing measured.\n", "no rows of numbers"),
    ("a.xlsx", write_sheet({"a": [0, 1]}), "without a temperature and a displacement"),
    ("a.bin", "\0\1\2", "is a zero byte, so the file is not text"),
    ("a.csv", "hours [h],T1 [degC]\n0,20\n1,21\n2,22\n", "without a displacement"),
    ("a.irb", "\0\1\2", "a recording of InfraTec, whose layout is not public"),
    ("a.jpg", lambda path: path.write_bytes(b"\xff\xd8\xff\xe0" + b"\0" * 40), "the JPEG is not radiometric"),
]


def write_sample(folder: Path, name: str, content: str | Callable[[Path], object]) -> Path:
    (folder / "run.tab").write_text("t1 [degC],ch1 [um]\n20,0\n")
    if callable(content):
        content(folder / name)
    else:
        (folder / name).write_text(content.replace("{run}", "run.tab"), encoding="utf-8")
    return folder / name


@pytest.mark.parametrize(("kind", "name", "content", "told"), SAMPLES)
def test_a_file_of_every_kind_is_recognised_read_and_described(tmp_path, kind, name, content, told):
    path = write_sample(tmp_path, name, content)
    found = recognise(path)
    assert (found.kind, found.reason) == (kind, "")
    assert found.content is found.content, "a file is read once"
    first, *lines = found.kind.value.describe(found)
    assert first.startswith(told[0] if told else "") and {line.strip() for line in told[1:]} <= set(lines)


@pytest.mark.parametrize(("kind", "name", "content", "told"), SAMPLES)
def test_a_damaged_file_of_every_kind_stops_no_other(tmp_path, rng, kind, name, content, told):
    whole = write_sample(tmp_path, name, content).read_bytes()
    sound = write_sample(tmp_path, "sound.csv", "name,x_mm,y_mm\nmotor,0,0\nmotor,9,0\nmotor,9,9\n")
    for damaged in (
        whole[: len(whole) // 3],
        bytes(rng.permutation(np.frombuffer(whole, np.uint8))),
        b"",
        whole[:40] + whole,
    ):
        (tmp_path / name).write_bytes(damaged)
        looked_into = {one.label: one for one in inspect_paths([tmp_path / name, sound])}
        assert looked_into[str(sound)].kind is Kind.REGIONS and not looked_into[str(sound)].fault
        one = looked_into[str(tmp_path / name)]
        assert bool(one.fault) is not bool(one.lines) and "fault of the program" not in one.fault


def test_every_kind_has_a_sample_and_a_key_of_the_campaign_file():
    assert {kind for kind, *_ in SAMPLES} == set(Kind) - {Kind.UNKNOWN, Kind.UNREADABLE}
    keys = {f"{table}.{key}" for table, names in FILE_KEYS.items() for key in names}
    named = {kind for kind, *_ in SAMPLES} - {Kind.RECIPE, Kind.CAMPAIGN, Kind.PRODUCT}
    assert {kind.value.key for kind in named} <= keys and named == {kind for kind in Kind if kind.value.key}


def test_every_row_of_the_page_on_formats_is_a_declaration_and_has_a_sample(tmp_path):
    said, own = vocabulary("formats"), readers()[len(plug_ins()) :]
    assert [*said["kinds"]] == [kind.value.words for kind in Kind if kind not in (Kind.UNKNOWN, Kind.UNREADABLE)]
    assert {*said["frames"]} == {one.name for one in own} and [*said["deviations"]] == [
        one.name for one in (*FILES, *TABLES)
    ]
    paths = {kind: [] for kind in Kind}
    for k, (kind, name, content, _) in enumerate(SAMPLES):
        (folder := tmp_path / str(k)).mkdir()
        paths[kind].append(write_sample(folder, name, content))
    assert {find_reader(path) for path in (*paths[Kind.FRAMES], *paths[Kind.STACK])} == {*own}
    starts = [path.read_bytes() for path in paths[Kind.DEVIATIONS]]
    assert all(any(one.find(start) for start in starts) for one in FILES)


@pytest.mark.parametrize(("name", "content", "reason"), UNREAD)
def test_what_nothing_reads_is_told_with_the_reason(tmp_path, name, content, reason):
    found = recognise(write_sample(tmp_path, name, content))
    assert found.kind is Kind.UNKNOWN and reason in found.reason and len(found.reason) < 200


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

    def fails(found):
        raise error

    # A table that one reader refuses may be one of another kind: here it is none.
    declared = replace(Kind.RECORD.value, sniff=fails, may_be=lambda found: False)
    monkeypatch.setattr(Kind.RECORD, "_value_", declared)
    monkeypatch.setattr("fusion.campaign.inspect.Recognised.logged", "")
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
    monkeypatch.setattr(frame_readers, "plug_ins", lambda: (reader,))
    monkeypatch.setattr(frame_readers, "readers", lambda: (reader, FlirReader()))
    assert recognise(tmp_path / "b.seq").kind is Kind.FRAMES
    own = recognise(tmp_path / "a.own")
    if isinstance(reader, TemperatureReader):
        assert own.kind is Kind.STACK and own.kind.value.describe(own)[0] == "own, 1 frame of 3 x 2"
    else:
        assert own.kind is Kind.UNKNOWN and own.reason.startswith("counts that the plug-in own counts reads; name the")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_a_record_is_known_in_every_encoding(tmp_path, encoding):
    rows = ["Zeit [s];T1 [°C];Z [µm]", *(f"{30 * row};20,5;1,25" for row in range(9000))]
    for count in (3, 4, len(rows)):
        (tmp_path / "a.csv").write_text("\n".join(rows[:count]) + "\n", encoding=encoding)
        found = recognise(tmp_path / "a.csv")
        assert (found.kind, found.headings) == (Kind.RECORD, ("Zeit [s]", "T1 [°C]", "Z [µm]"))


def test_gaps_of_a_record_without_a_start_are_counted_from_it(tmp_path):
    rows = [f"{k + 100 * (k > 30)},{20 + k / 9:.2f},{k}" for k in range(60)]
    (tmp_path / "a.csv").write_text("\n".join(["t [s],T1 [degC],Z [um]", *rows]))
    found = recognise(tmp_path / "a.csv")
    assert "a row every 1 s, 1 gap: 30 s, 101 s" in found.kind.value.describe(found)


def test_a_record_may_log_the_air_pressure(tmp_path):
    rows = [
        f"09.03.2026 06:{k:02}:00;{21 + k / 9:.2f};1010,2;{k}".replace(".", ",").replace("09,03,", "09.03.")
        for k in range(50)
    ]
    (tmp_path / "a.csv").write_text("\n".join(["Zeit;Spindeltemperatur;Luftdruck;Verlagerung Z", *rows]))
    assert recognise(tmp_path / "a.csv").kind is Kind.RECORD


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


def test_products_of_a_run_are_told_for_what_they_are(results_folder):
    told = {one.label.removeprefix(f"{results_folder}/"): one for one in inspect_paths([results_folder])}
    assert {one.kind for one in told.values()} == {Kind.PRODUCT} and not any(one.fails for one in told.values())
    fields = xr.open_dataset(results_folder / "fields.nc")
    low, high = float(fields["temperature"].min()), float(fields["temperature"].max())
    assert f"temperature {low:.4g} to {high:.4g} °C" in told["fields.nc"].lines
    maps = told["maps/*.exr"].lines
    assert f"{fields.sizes['cycle']} files" in maps[0] and "rise 0 to 0 K" in maps


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
    assert lines[0] == f"thermal frames, {len(paths)} files, {len(paths)} frames of 640 x 480"
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
    assert "6 frames of SC660 1, 6 x 4" in lines and "1 frame of SC660 2, 6 x 4" in lines
    assert "  camera SC660, serial 2" in lines
    assert "a frame every 60 s, 1 gap: 2026-03-09 06:04 UTC, 41 min" in text
    assert "of the first frame; not the same in all: emissivity" in text
    assert "warning: 1 frame left out: 9.jpg: " in text


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


def test_a_picture_as_a_list_of_pixels_is_no_record(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("x,y,T\n" + "".join(f"{x},{y},{20 + x / 7:.3f}\n" for y in range(12) for x in range(16)))
    found = recognise(path)
    assert found.kind is Kind.UNKNOWN and found.reason.startswith("a list of pixels; export the picture")


def test_a_table_of_a_laser_with_temperatures_beside_is_no_record(tmp_path):
    there = [
        (cycle, sign, x) for cycle in (1, 2) for sign in "+-" for x in range(0, 500, 100)[:: 1 if sign == "+" else -1]
    ]
    lines = [
        f"2026-03-09 08:{k:02d},{cycle},{sign},{x},0.{k:03d},20.{k:02d}" for k, (cycle, sign, x) in enumerate(there)
    ]
    (tmp_path / "a.csv").write_text(
        "\n".join(["Time,Run,Direction,Target (mm),Error (um),Air temp (degC)", *lines]) + "\n"
    )
    assert recognise(tmp_path / "a.csv").kind is Kind.DEVIATIONS
