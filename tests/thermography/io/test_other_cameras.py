"""Frames of temperatures of any camera: TIFF, NumPy, NetCDF, Zarr and text; their scale, times, and what they lack."""

import importlib.metadata
import pickle
import struct
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import xarray as xr
from PIL import Image

from tests.thermography.flir_mutations import sequence
from tests.thermography.plan_scene import SC660
from thermography.common import ThermographyError
from thermography.io import other_cameras as frame_readers
from thermography.io.flir import FlirReader, read_frame
from thermography.io.flir_writer import write_jpeg
from thermography.io.frame import RejectedFrame
from thermography.io.other_cameras import (
    FrameReaderError,
    NetcdfReader,
    NumpyReader,
    PngReader,
    StackContents,
    StackError,
    StackOptions,
    TemperatureReader,
    TextReader,
    TiffReader,
    encode,
    find_reader,
    index_recordings,
    plug_ins,
    read_stack,
    readers,
)
from thermography.radiometry.planck import calibrate, counts_from_temperature, override

STACK = (20.0 + np.arange(3 * 10 * 12).reshape(3, 10, 12) / 50.0).astype(np.float32)
TIMES = np.array(["2026-03-09T06:30:00", "2026-03-09T06:30:10", "2026-03-09T06:30:20"], "datetime64[ns]")
EVERY_10_S = StackOptions(unit="degC", start=TIMES[0], interval_s=10.0)


def store(folder: Path, kind: str, *, units: str = "degC") -> Path:
    path = folder / f"stack.{kind}"
    if kind == "npy":
        np.save(path, STACK)
    elif kind == "tif":
        tifffile.imwrite(path, STACK, photometric="minisblack")
    else:
        attrs = {"units": units, "units_metadata": "temperature: on_scale"}
        dataset = xr.Dataset({"surface": (("time", "row", "column"), STACK, attrs)}, coords={"time": TIMES})
        if kind == "nc":
            dataset.to_netcdf(path, engine="h5netcdf")
        else:
            dataset.to_zarr(path, consolidated=False, zarr_format=3)
            path = path / "zarr.json"
    return path


@pytest.mark.parametrize("kind", ["npy", "tif", "nc", "zarr"])
def test_every_frame_comes_back_with_its_time(tmp_path, kind):
    path = store(tmp_path, kind)
    frames, rejected = index_recordings([path], EVERY_10_S if kind in ("npy", "tif") else StackOptions())
    assert rejected == []
    assert [frame.time for frame in frames] == TIMES.astype("datetime64[ms]").tolist()
    for frame, image in zip(frames, STACK, strict=True):
        assert frame.shape == (10, 12)
        assert pickle.loads(pickle.dumps(frame)).read_temperature() == pytest.approx(image, abs=1e-5)


def test_kelvin_a_folder_of_zarr_and_the_time_tag_of_a_tiff_are_read(tmp_path):
    frames, _ = index_recordings([store(tmp_path, "nc", units="K")])
    assert frames[0].read_temperature()[0, 0] == pytest.approx(20.0 - 273.15)
    folder = store(tmp_path, "zarr").parent
    assert len(index_recordings([folder])[0]) == 3
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, STACK[0], datetime="2026:03:09 07:30:00")
    (frame,), _ = index_recordings([path], StackOptions(unit="degC", time_zone="Europe/Vienna"))
    assert frame.time == TIMES[0]


@pytest.mark.parametrize(
    ("names", "listed"), [("", "none over three dimensions; write variable = "), ("ab", "a, b over three dimensions")]
)
def test_the_variable_must_be_known(tmp_path, names, listed):
    path = tmp_path / "a.nc"
    xr.Dataset(dict.fromkeys(names, (("time", "row", "column"), STACK))).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(StackError, match=f"holds the variables {listed}"):
        index_recordings([path])
    if names:
        options = StackOptions(unit="degC", variable="b", start=TIMES[0], interval_s=1.0)
        assert len(index_recordings([path], options)[0]) == 3


def test_what_is_no_stack_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(3))
    with pytest.raises(ThermographyError, match=r"an array of shape \(3,\) and type float64; save numbers as"):
        NumpyReader().contents(tmp_path / "a.npy", EVERY_10_S)
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((8, 8, 3), np.uint8), photometric="rgb")
    with pytest.raises(ThermographyError, match="colours are not temperatures; export radiometric TIFF"):
        TiffReader().contents(tmp_path / "a.tif", EVERY_10_S)
    (tmp_path / "a.nc").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(ThermographyError, match=r"cannot be opened .* write it again"):
        NetcdfReader().contents(tmp_path / "a.nc", EVERY_10_S)


def test_a_tiff_whose_strips_do_not_fill_its_page_is_refused_before_memory_is_taken(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, STACK[0], photometric="minisblack")
    with tifffile.TiffFile(path) as file:
        at = file.pages[0].tags["ImageLength"].valueoffset
    content = bytearray(path.read_bytes())
    content[at : at + 2] = (60_000).to_bytes(2, "little")
    path.write_bytes(content)
    with pytest.raises(ThermographyError, match=r"a\.tif: page 0 is damaged \(.*contradict one another\); export"):
        TiffReader().read_values(path, 0, EVERY_10_S)


def test_a_png_of_16_bits_is_a_frame_and_a_photo_is_none(tmp_path):
    counts = np.arange(28000, 28000 + 12 * 16, dtype="u2").reshape(12, 16)
    for name, picture in (("a", counts), ("photo", (counts // 256).astype("u1"))):
        Image.fromarray(picture).save(tmp_path / f"{name}.png")
    assert isinstance(find_reader(tmp_path / "a.png"), PngReader) and find_reader(tmp_path / "photo.png") is None
    with pytest.raises(StackError, match="whole numbers of 16 bits; write the scale"):
        index_recordings([tmp_path / "a.png"], EVERY_10_S)
    options = StackOptions(unit="K", scale=0.01, start=TIMES[0], interval_s=10.0)
    frames, _ = index_recordings([tmp_path / "a.png"], options)
    np.testing.assert_allclose(frames[0].read_temperature(), counts * 0.01 - 273.15, atol=1e-9)
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:60])
    with pytest.raises(ThermographyError, match=r"a\.png: damaged PNG .*; export it again"):
        PngReader().read_values(tmp_path / "a.png", 0, options)


def test_a_tiff_whose_first_page_lies_beyond_its_end_is_refused(tmp_path):
    (tmp_path / "a.tif").write_bytes(b"II*\0" + (64).to_bytes(4, "little"))
    with pytest.raises(
        ThermographyError, match=r"a\.tif: damaged TIFF \(no page, or one without a size\); export it again"
    ):
        TiffReader().contents(tmp_path / "a.tif", EVERY_10_S)


@pytest.mark.parametrize("kind", ["complex64", "bool"])
def test_values_that_are_no_real_numbers_are_named_by_their_type(tmp_path, kind):
    tifffile.imwrite(tmp_path / "a.tif", STACK[0].astype(kind), photometric="minisblack")
    message = rf"a\.tif: values of type {kind} are not temperatures; export radiometric TIFF"
    with pytest.raises(ThermographyError, match=message):
        TiffReader().contents(tmp_path / "a.tif", EVERY_10_S)


@pytest.mark.parametrize(
    "kind", [np.dtype([("a", "f4"), ("b", "i4")]), np.dtype("V8"), np.dtype("c16"), h5py.string_dtype()]
)
def test_a_variable_of_no_numbers_is_refused(tmp_path, kind):
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file.create_dataset("temperature", (3, 4, 5), kind)
    with pytest.raises(ThermographyError, match="are not temperatures; write real numbers"):
        read_stack(tmp_path / "a.nc")


def test_what_a_library_says_of_a_long_attribute_is_cut(tmp_path):
    time = xr.DataArray(np.arange(3), dims="time", attrs={"units": "days since 2026-01-01", "calendar": "x" * 50_000})
    values = xr.DataArray(np.zeros((3, 4, 5)), dims=("time", "y", "x"), coords={"time": time})
    values.to_dataset(name="temperature").to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with pytest.raises(ThermographyError, match=r"cannot be opened \(.*\); write it again") as error:
        read_stack(tmp_path / "a.nc")
    assert len(str(error.value)) < 1_000


def test_a_zarr_store_of_very_many_arrays_is_not_opened(tmp_path):
    xr.DataArray(np.zeros((3, 4, 5)), dims=("time", "y", "x"), name="temperature").to_dataset().to_zarr(
        tmp_path / "a", consolidated=False, zarr_format=3
    )
    read_stack(tmp_path / "a" / "zarr.json")
    for number in range(1_000):
        (tmp_path / "a" / f"v{number}").mkdir()
    with pytest.raises(ThermographyError, match="it holds more than 1000 arrays and groups"):
        read_stack(tmp_path / "a" / "zarr.json")


IMAGE = np.round(20.0 + np.arange(10 * 12).reshape(10, 12) / 7.0, 2)
READER = TextReader()


def rows(delimiter: str, *, decimal: str = ".", end: str = "") -> str:
    lines = (delimiter.join(f"{value:.2f}".replace(".", decimal) for value in row) for row in IMAGE)
    return "".join(f"{line}{end}\n" for line in lines)


@pytest.mark.parametrize(
    "text",
    [
        rows(","),
        rows(";", decimal=","),
        rows("\t", decimal=","),
        rows(" "),
        rows(";", end=";"),
        "Camera: X\nEmissivity;0,95\n[Data]\n" + rows(";", decimal=",") + "\nMean;26\n",
        ";".join(f"x{i}" for i in range(12)) + "\n" + rows(";"),
    ],
)
def test_a_frame_is_the_longest_block_of_numbers(tmp_path, text):
    path = tmp_path / "frame.csv"
    for encoding in ("utf-8", "utf-16"):
        path.write_text(text, encoding=encoding)
        assert READER.recognises(path, path.read_bytes()[:512])
        assert READER.contents(path, StackOptions()).shape == IMAGE.shape
        assert READER.read_values(path, 0, StackOptions()).tolist() == IMAGE.tolist()


def test_pixels_without_a_number_are_missing_and_tables_are_no_frames(tmp_path):
    path = tmp_path / "frame.csv"
    path.write_text(rows(";").replace("20.14", "---", 1))
    values = READER.read_values(path, 0, StackOptions())
    assert np.isnan(values[0, 1])
    assert np.isfinite(values).sum() == values.size - 1
    path = tmp_path / "report.md"
    path.write_text("\n".join(f"word | 1 | 2 | {row} | 3 | word | 4 | word" for row in range(9)).replace("|", ";"))
    assert not TextReader().holds_a_frame(path)
    path = tmp_path / "laser.csv"
    path.write_text("time,a,b\n1,2,3\n" * 20)
    assert not READER.holds_a_frame(path)
    path.write_text("\t".join(["1.5"] * 9) + "\n" + ("\t".join(["2.5"] * 9) + "\n") * 500)
    assert not READER.holds_a_frame(path)
    with pytest.raises(ThermographyError, match="no block of at least 8 x 8 numbers in the proportions of a"):
        READER.contents(path, StackOptions())


@pytest.mark.real_data
def test_an_export_of_the_vendors_program_is_its_picture(real_file):
    folder = "gpereyrairujo__IRimage/Windows/IRimage/test"
    values = READER.read_values(real_file(f"{folder}/csv/test_image.csv"), 0, StackOptions())
    frame = read_frame(real_file(f"{folder}/test_image.jpg"))
    # The program prints three decimals, and calculates in single precision.
    assert values == pytest.approx(calibrate(frame.counts, frame.parameters), abs=5e-3)


def test_a_picture_is_told_from_a_log_by_its_first_lines_and_sized_without_reading_it(tmp_path):
    rows = [";".join(f"{20 + column / 10:.1f}".replace(".", ",") for column in range(40)) + ";" for _ in range(30)]
    named = ";".join(f"t{column} [degC]" for column in range(40))
    assert READER.begins_a_frame("\n".join(["File: a", "Emissivity: 0.95", *rows]))
    assert not READER.begins_a_frame("\n".join([named, *rows]))
    path = tmp_path / "a.csv"
    for text in ("\n".join(rows), "\n".join([*rows[:4], rows[4].replace("20,1", ""), *rows[5:]])):
        path.write_text(text)
        assert READER.contents(path, StackOptions()).shape == READER.read_values(path, 0, StackOptions()).shape


@pytest.mark.parametrize("text", ["1," * 20_000, ";" * 20_000, "\n" * 200_000], ids=["numbers", "marks", "lines"])
def test_a_line_or_a_table_longer_than_a_frame_is_passed_over(tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_text(text + "\n" + "1,2,3,4,5,6,7,8\n" * 8)
    if text.startswith("\n"):
        assert not TextReader().holds_a_frame(path)
    else:
        assert TextReader().read_values(path, 0, StackOptions()).shape == (8, 8)


def test_the_scale_is_the_inverse_of_the_calibration():
    temperature = np.linspace(-40.0, 159.0, 2000)
    parameters = StackOptions().parameters
    back = calibrate(encode(temperature, parameters), parameters)
    # Half a step: 17 mK at -40, 2.4 mK at 20 degC and 1.1 mK at 100 degC.
    step = 0.5 / np.gradient(counts_from_temperature(temperature, parameters), temperature)
    assert (np.abs(back - temperature) <= step + 1e-4).all()
    near = (temperature > 15) & (temperature < 40)
    assert np.std(back[near] - temperature[near]) < 1.6e-3


def test_emissivities_and_pixels_without_temperature_are_calculated_as_for_counts():
    for parameters in (StackOptions().parameters, StackOptions(emissivity=0.9).parameters):
        counts = encode(np.array([np.nan, -300.0, 400.0, np.inf]), parameters)
        assert counts.tolist() == [0, 0, 65535, 65535]
        assert np.isnan(calibrate(counts[:1], parameters)).all()
    options = StackOptions(emissivity=0.95, reflected_temperature_K=295.15)
    given = options.parameters
    truth = np.array([25.0, 30.0, 35.0])
    wrong = calibrate(np.rint(counts_from_temperature(truth, override(given, emissivity=0.9))).astype(np.uint16), given)
    right = calibrate(encode(wrong, given), override(given, emissivity=0.9))
    assert right == pytest.approx(truth, abs=6e-3)


def frames(folder: Path, options: StackOptions, *, name: str = "IR_20260309_063000.npy", count: int = 1) -> list[str]:
    np.save(folder / name, np.full((count, 4, 5), 20.0) + np.arange(count)[:, None, None])
    found, rejected = index_recordings([folder / name], options)
    assert rejected == []
    return [str(frame.time) for frame in found]


def test_times_from_the_name_a_table_or_a_start(tmp_path):
    options = StackOptions(unit="degC", time_in_name="%Y%m%d_%H%M%S", time_zone="Europe/Vienna", interval_s=0.5)
    assert frames(tmp_path, options) == ["2026-03-09T05:30:00.000"]
    assert frames(tmp_path, options, count=2) == ["2026-03-09T05:30:00.000", "2026-03-09T05:30:00.500"]
    with pytest.raises(StackError, match=r"the name 'b.npy' holds no time of the form '%Y%m%d_%H%M%S'"):
        frames(tmp_path, options, name="b.npy")
    with pytest.raises(StackError, match=r"20261025_023000.npy: .* occurs twice or not at all in Europe/Vienna"):
        frames(tmp_path, options, name="20261025_023000.npy")
    listed = {(tmp_path / "IR_20260309_063000.npy", 1): TIMES[0]}
    assert frames(tmp_path, StackOptions(unit="degC", times=listed), count=2) == ["2026-03-09T06:30:00.000", "NaT"]
    with pytest.raises(StackError, match=r"the table of times has no line for it; add one per frame"):
        frames(tmp_path, StackOptions(unit="degC", times=listed), name="c.npy")
    with pytest.raises(StackError, match='2 frames and one time; write interval = "10 s"'):
        frames(tmp_path, StackOptions(unit="degC", start=TIMES[0]), count=2)


def test_scale_offset_and_kelvin(tmp_path):
    np.save(tmp_path / "a.npy", np.full((4, 5), 7329, np.uint16))
    options = StackOptions(unit="K", scale=0.04, start=TIMES[0])
    (frame,), _ = index_recordings([tmp_path / "a.npy"], options)
    assert frame.read_temperature() == pytest.approx(np.full((4, 5), 20.01))
    with pytest.raises(StackError, match=r"whole numbers of 16 bits; write the scale of a count .* scale = 0.04"):
        index_recordings([tmp_path / "a.npy"], StackOptions(unit="K", start=TIMES[0]))


SMALL_IMAGE = 20.0 + np.arange(12 * 16).reshape(12, 16) / 10.0


def test_the_content_and_not_the_name_decides(tmp_path):
    write_jpeg(tmp_path / "a.txt", np.full((8, 8), 18000, np.uint16), SC660, "2026-03-09T06:33:47")
    tifffile.imwrite(tmp_path / "b.jpg", SMALL_IMAGE.astype(np.float32))
    assert isinstance(find_reader(tmp_path / "a.txt"), FlirReader)
    frames, rejected = index_recordings([tmp_path / "a.txt", tmp_path / "b.jpg"], EVERY_10_S)
    assert [frame.path.name for frame in frames] == ["b.jpg", "a.txt"]
    assert rejected == []


def test_files_of_no_known_kind_are_rejected_with_the_reason(tmp_path):
    (tmp_path / "a.bin").write_bytes(bytes(range(256)))
    frames, rejected = index_recordings([tmp_path / "a.bin", tmp_path / "none.tif"], EVERY_10_S)
    assert frames == []
    assert "a.bin: not a known thermal file; docs/formats.md lists them" in rejected[0].reason
    assert "No such file" in rejected[1].reason


class ReaderOfOnes(TemperatureReader):
    """A plug-in: files that begin with ONES hold ten frames of one degree."""

    name = "ones"

    def recognises(self, path: Path, start: bytes) -> bool:
        return start.startswith(b"ONES")

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        return StackContents(10, (4, 5), "degC")

    def read_values(self, path: Path, index: int, options: StackOptions) -> np.ndarray:
        return np.ones((4, 5))


class Unusable:
    """A plug-in without the methods of a reader."""


def forget_plug_ins():
    readers.cache_clear()
    plug_ins.cache_clear()


@pytest.fixture
def plug_in(monkeypatch):
    forget_plug_ins()
    yield monkeypatch
    forget_plug_ins()


def named(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    entry = importlib.metadata.EntryPoint("mine", f"{__name__}:{name}", frame_readers.ENTRY_POINT_GROUP)
    monkeypatch.setattr(entry.__class__, "load", lambda self: globals()[name])
    monkeypatch.setattr(frame_readers, "entry_points", lambda group: [entry])


def test_a_plug_in_is_found_by_its_entry_point(tmp_path, plug_in):
    named(plug_in, "ReaderOfOnes")
    (tmp_path / "a.one").write_bytes(b"ONES")
    frames, rejected = index_recordings([tmp_path / "a.one"], EVERY_10_S)
    assert (len(frames), rejected) == (10, [])
    assert frames[3].time == np.datetime64("2026-03-09T06:30:30")
    # The scale of counts resolves 5 mK.
    assert frames[3].read_temperature() == pytest.approx(np.ones((4, 5)))


def test_plug_ins_are_loaded_once_before_the_threads(tmp_path, plug_in):
    loaded = []

    def load(self):
        loaded.append(threading.current_thread())
        time.sleep(0.05)  # long enough that other threads would begin to load meanwhile
        return ReaderOfOnes

    named(plug_in, "ReaderOfOnes")
    plug_in.setattr(importlib.metadata.EntryPoint, "load", load)
    paths = [tmp_path / f"{number}.one" for number in range(8)]
    for path in paths:
        path.write_bytes(b"ONES")
    index_recordings(paths, EVERY_10_S)
    assert loaded == [threading.current_thread()]


def test_a_plug_in_that_cannot_be_used_is_no_fault_of_the_files(tmp_path, plug_in):
    named(plug_in, "Unusable")
    np.save(tmp_path / "a.npy", SMALL_IMAGE)
    with pytest.raises(FrameReaderError, match=r"the plug-in mine = .* lacks name, recognises or index"):
        index_recordings([tmp_path / "a.npy"], EVERY_10_S)


def test_every_reader_keeps_the_protocol():
    assert all(isinstance(reader, frame_readers.FrameReader) for reader in readers())


def test_damaged_files_raise_no_foreign_error(tmp_path):
    np.save(tmp_path / "a.npy", SMALL_IMAGE)
    tifffile.imwrite(tmp_path / "b.tif", np.stack([SMALL_IMAGE] * 2).astype(np.float32), photometric="minisblack")
    np.savetxt(tmp_path / "c.csv", SMALL_IMAGE, delimiter=";", fmt="%.2f")
    rng = np.random.default_rng(7)
    outcomes = {"read": 0, "refused": 0}
    for i in range(240):
        original = sorted(tmp_path.glob("[abc].*"))[i % 3]
        content = bytearray(original.read_bytes())
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.integers(0, len(content)))
            content[at : at + int(rng.integers(0, 9))] = rng.bytes(int(rng.integers(0, 9)))
        path = tmp_path / f"damaged{original.suffix}"
        path.write_bytes(bytes(content[: int(rng.integers(1, len(content) + 1))] if i % 5 == 0 else content))
        try:
            frames, rejected = index_recordings([path], EVERY_10_S)
            for frame in frames:
                frame.read_counts()
            assert all(isinstance(one, RejectedFrame) for one in rejected)
            outcomes["read" if frames else "refused"] += 1
        except (ThermographyError, OSError):
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 20


def test_what_the_options_must_say_is_asked_for(tmp_path):
    np.save(tmp_path / "a.npy", SMALL_IMAGE)
    with pytest.raises(StackError, match='nothing says whether values are degC or K; write unit = "degC"'):
        index_recordings([tmp_path / "a.npy"])
    with pytest.raises(StackError, match=r"the file holds no times; write time_in_name = .* times = .* or start = "):
        index_recordings([tmp_path / "a.npy"], StackOptions(unit="K"))


@pytest.mark.parametrize(
    ("heading", "unit", "time"),
    [
        ("Temperature [K]", "K", None),
        ("[Settings]\nTempUnit=°C\nRecDate=05.03.2024\nRecTime=11:00:00\n[Data]", "degC", "2024-03-05T11:00:00"),
        ("Emissivity:;0.95\nRefl. temp:;20.0 °C", "", None),
    ],
)
def test_unit_and_time_of_a_text_stand_above_its_numbers(tmp_path, heading, unit, time):
    rows = "\n".join(";".join(["295.15"] * 12) for _ in range(9))
    (tmp_path / "a.csv").write_bytes(f"{heading}\n{rows}\n".encode("cp1252"))
    contents = read_stack(tmp_path / "a.csv").contents
    assert contents.unit == unit and contents.zoned is False
    assert contents.times == (None if time is None else (np.datetime64(time),))


def test_a_unit_of_fahrenheit_above_the_numbers_is_refused(tmp_path):
    rows = "\n".join(";".join(["72.5"] * 12) for _ in range(9))
    (tmp_path / "a.csv").write_text(f"TempUnit=°F\n{rows}\n")
    with pytest.raises(ThermographyError, match="°F; export °C or K"):
        read_stack(tmp_path / "a.csv")


def test_elapsed_times_of_a_store_need_the_time_of_the_first_frame_alone(tmp_path):
    hours = ("time", np.array([0.0, 0.25, 1.5]), {"units": "hours"})
    frames = (("time", "y", "x"), np.full((3, 9, 12), 20.0), {"units": "degC"})
    xr.Dataset({"t": frames}, coords={"time": hours}).to_netcdf(tmp_path / "a.nc")
    start = np.datetime64("2026-03-09T06:30")
    frames, rejected = index_recordings([tmp_path / "a.nc"], StackOptions(start=start))
    assert not rejected
    assert [one.time for one in frames] == [start + np.timedelta64(minutes, "m") for minutes in (0, 15, 90)]


@pytest.mark.parametrize(("axes", "count"), [(None, 0), ("frame, row, column", 30), ("row, column, frame", 50)])
def test_axes_of_an_array_that_its_shape_does_not_tell_are_stated(tmp_path, axes, count):
    np.save(tmp_path / "a.npy", np.arange(60_000.0).reshape(30, 40, 50))
    options = StackOptions(unit="K", axes=axes, start=np.datetime64("2026-03-09"), interval_s=1.0)
    if axes is None:
        with pytest.raises(StackError, match="nothing says which axis"):
            index_recordings([tmp_path / "a.npy"], options)
        return
    frames, _ = index_recordings([tmp_path / "a.npy"], options)
    assert len(frames) == count


def public_format(path: Path, kind: int, values: np.ndarray, *, quantity: int = 0) -> Path:
    """A file of FLIR's header fpfimg.h: offset, quantity, kind of pixels, columns and rows at 0x24, the time at 0x248."""
    head = bytearray(892)
    head[:24] = b"FPF Public Image Format\0"
    struct.pack_into("<2I4H", head, 0x20, 2, 892, quantity, kind, values.shape[1], values.shape[0])
    struct.pack_into("<7i", head, 0x248, 2026, 3, 9, 6, 30, 10, 250)
    path.write_bytes(bytes(head) + values.tobytes())
    return path


def test_the_public_format_of_flir_is_read_with_its_time(tmp_path):
    path = public_format(tmp_path / "a.fpf", 2, STACK[0] + np.float32(273.15))
    (frame,), rejected = index_recordings([path], StackOptions(unit="K"))
    assert not rejected and frame.time == np.datetime64("2026-03-09T06:30:10.250")
    np.testing.assert_allclose(frame.read_temperature(), STACK[0], atol=1e-4)
    with pytest.raises(StackError, match='write unit = "degC" or unit = "K"'):
        index_recordings([path])
    for content, told in (
        (public_format(tmp_path / "b.fpf", 2, STACK[0], quantity=4).read_bytes(), "image type 4 in format 2"),
        (path.read_bytes()[:500], "shorter than the header of 892"),
    ):
        path.write_bytes(content)
        assert told in index_recordings([path], StackOptions(unit="K"))[1][0].reason
    path.write_bytes(public_format(tmp_path / "b.fpf", 2, STACK[0]).read_bytes()[:-4])
    (cut,), _ = index_recordings([path], StackOptions(unit="K"))
    with pytest.raises(ThermographyError, match="119 of 12 x 10 pixels"):
        cut.read_temperature()


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.mp4", b"\0\0\0\x1cftypmp42\0\0\0\1", "a video of colours"),
        ("a.seq", b"AFF\0\0\0", "an AFF sequence"),
        ("a.ats", b"\0\1\2", "an ATS recording"),
        ("a.dat", b"MATLAB 5.0 MAT-file\0", "a MATLAB file; write its frames"),
        ("a.npz", b"PK\3\4", r"a file of several NumPy arrays; save"),
        ("a.fit", b"SIMPLE  =                    T" + b" " * 500, "a FITS file; save its frames"),
        ("a.optris", b"Optris\0\1", "raw data of an Optris camera"),
    ],
)
def test_files_of_cameras_that_are_not_read_are_named_for_what_they_are(tmp_path, name, content, told):
    (tmp_path / name).write_bytes(content)
    (rejected,) = index_recordings([tmp_path / name])[1]
    assert told in rejected.reason and "not text" not in rejected.reason


@pytest.mark.parametrize(
    ("heading", "stated"),
    [
        (
            "File Path:,C:\\x.seq\n\nParameters:,Emissivity:,0.93\n,Refl. Temp.:,22.5 °C\n,Distance:,1.0 m\n\n",
            (0.93, 295.65),
        ),
        ("Emissivity;0,9\nReflected apparent temperature;293,15 K\n\n", (0.9, 293.15)),
        ("a note\n", (None, None)),
    ],
)
def test_emissivity_and_surroundings_of_an_exported_picture_stand_in_its_heading(tmp_path, heading, stated):
    path = tmp_path / "a.csv"
    mark = ";" if ";" in heading else ","
    rows = "\n".join(mark.join(f"{20 + row + column / 100:.2f}" for column in range(40)) for row in range(30))
    path.write_text(heading + rows, encoding="utf-8")
    ((frame,), _) = index_recordings([path], StackOptions(unit="degC", start=np.datetime64("2026-03-09T06:30", "ns")))
    assert (frame.options.emissivity, frame.options.reflected_temperature_K) == pytest.approx(stated)
    assert frame.read_temperature()[0, 1] == pytest.approx(20.01)
    # What the campaign file states takes precedence.
    ((frame,), _) = index_recordings(
        [path], StackOptions(unit="degC", start=np.datetime64("2026-03-09T06:30", "ns"), emissivity=0.5)
    )
    assert frame.parameters.emissivity == 0.5


PICTURE = np.round(20.0 + np.arange(24)[:, None] / 7 + np.arange(32) / 3, 3)
JOINED = {
    "blank": lambda k, rows: ["", *rows],
    "commas": lambda k, rows: ["," * 31, *rows],
    "named line": lambda k, rows: [f"Frame {k}", *rows],
    "named first": lambda k, rows: [f"Frame {k},{rows[0]}", *("," + row for row in rows[1:])],
    "named all": lambda k, rows: [f"Frame {k},{row}" for row in rows],
    "numbered": lambda k, rows: [f"{k},{row}" for row in rows],
    "numbered rows": lambda k, rows: [f"{k},{number},{row}" for number, row in enumerate(rows)],
    "pandas": lambda k, rows: [",".join(["", *map(str, range(32))]), *(f"{n},{row}" for n, row in enumerate(rows))],
    "quoted": lambda k, rows: ["", *('"' + row.replace(",", '","').replace(".", ",") + '"' for row in rows)],
    "°C": lambda k, rows: ["", *(row.replace(",", " °C,") + " °C" for row in rows)],
    "minus": lambda k, rows: ["", *(row.replace("-", "\N{MINUS SIGN}") for row in rows)],
}


@pytest.mark.parametrize("count", [1, 2, 6])
@pytest.mark.parametrize("layout", JOINED)
def test_several_frames_of_one_text_are_each_read(tmp_path, layout, count):
    pictures = [PICTURE + 0.5 * k - (25.0 if layout == "minus" else 0.0) for k in range(count)]
    lines = ["File:,C:\\x.seq", "", "Parameters:,Emissivity:,0.95", ""]
    for k, picture in enumerate(pictures, 1):
        lines += JOINED[layout](k, [",".join(f"{value:.3f}" for value in row) for row in picture])
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    contents = READER.contents(path, StackOptions())
    assert (contents.frames, contents.shape, contents.emissivity) == (count, (24, 32), 0.95)
    assert contents.unit == ("degC" if layout == "°C" else "")
    np.testing.assert_allclose([READER.read_values(path, k, StackOptions()) for k in range(count)], pictures, atol=1e-9)


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (lambda rows: rows + rows, "32 x 48 numbers repeat one scene 2 times; put an empty line"),
        (lambda rows: [*rows, "", *rows[:20]], "blocks of 20 and of 24 lines with 32 numbers"),
        (lambda rows: [*rows[:9], "busy", *rows[9:]], "blocks of 9 and of 15 lines with 32 numbers"),
        (lambda rows: [*rows[:-1], rows[-1][:20]], "line 24 holds 3 numbers, those above it 32: it was cut"),
        (lambda rows: [*rows[:-1], rows[-1] + ",1.0"], "line 24 holds 33 numbers, others 32"),
        (lambda rows: [row.replace(".", ",") for row in rows], "the comma stands in numbers and between them"),
        (lambda rows: [row.replace(",", " °F,") + " °F" for row in rows], "°F; export °C or K"),
    ],
)
def test_frames_that_are_not_told_apart_and_numbers_in_doubt_are_refused(tmp_path, edit, told):
    path = tmp_path / "a.csv"
    path.write_text("\n".join(edit([",".join(f"{value:.3f}" for value in row) for row in PICTURE])), encoding="utf-8")
    with pytest.raises(ThermographyError, match=told):
        READER.contents(path, StackOptions())


def test_a_tall_picture_is_one(tmp_path):
    row, column = np.mgrid[:48, :32]
    for picture in (
        20.0 + row / 7 + column / 3,
        20.0 + 5.0 * np.hypot(row - 30, column - 12) ** 0.5,
        20.0 + 3.0 * (column > 9),
    ):
        np.savetxt(tmp_path / "a.csv", picture, delimiter=";", fmt="%.2f")
        assert READER.contents(tmp_path / "a.csv", StackOptions()).shape == (48, 32)


@pytest.mark.parametrize("order", ["tyx", "yxt", "txy", "xyt"])
@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
def test_dimensions_of_a_store_are_known_by_name(tmp_path, order, engine):
    names = {"t": "time", "y": "y", "x": "x"}
    values = xr.DataArray(STACK, dims=("time", "y", "x"), coords={"time": TIMES}, attrs={"units": "degC"})
    values.transpose(*(names[each] for each in order)).to_dataset(name="a").to_netcdf(tmp_path / "a.nc", engine=engine)
    found, _ = index_recordings([tmp_path / "a.nc"])
    assert [frame.time for frame in found] == list(TIMES)
    np.testing.assert_allclose([frame.read_temperature() for frame in found], STACK, atol=1e-5)


@pytest.mark.parametrize("kind", ["one frame", "band", "group", "unnamed", "axis", "frames with times"])
def test_one_frame_a_band_and_a_group_are_read(tmp_path, kind):
    values = xr.DataArray(STACK, dims=("time", "y", "x"), coords={"time": TIMES}, attrs={"units": "degC"})
    if kind == "one frame":
        values = values.isel(time=1)
    elif kind == "band":
        values = values.expand_dims("band", axis=1)
    elif kind == "unnamed":
        values = values.rename(y="a", x="b").transpose("a", "b", "time")
    elif kind == "axis":
        values = (
            values.rename(y="a", x="b")
            .assign_coords(a=("a", np.arange(10.0), {"axis": "Y"}))
            .transpose("time", "b", "a")
        )
    elif kind == "frames with times":
        values = values.rename(time="n").rename(n="number").drop_vars("number").assign_coords(time=("number", TIMES))
    group = "camera/left" if kind == "group" else None
    values.to_dataset(name="picture").to_netcdf(tmp_path / "a.nc", engine="h5netcdf", group=group)
    found, _ = index_recordings([tmp_path / "a.nc"])
    which = [1] if kind == "one frame" else [0, 1, 2]
    assert [frame.time for frame in found] == list(TIMES[which])
    np.testing.assert_allclose([frame.read_temperature() for frame in found], STACK[which], atol=1e-5)


def test_a_unit_that_is_not_known_is_refused_and_deep_nests_are_not_walked(tmp_path):
    values = xr.DataArray(STACK, dims=("time", "y", "x"), attrs={"units": "degF"})
    values.to_dataset(name="a").to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with pytest.raises(StackError, match="a is in 'degF'; write it in degC or K"):
        read_stack(tmp_path / "a.nc")
    with h5py.File(tmp_path / "b.nc", "w") as file:
        file.create_group("/".join("g" * 30))
    with pytest.raises(ThermographyError, match="nests groups more than 20 deep"):
        read_stack(tmp_path / "b.nc")


def test_pages_of_a_pyramid_and_of_colours_are_passed_over_by_name(tmp_path):
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as file:
        file.write(STACK[0][::2, ::2], photometric="minisblack", subfiletype=1)
        file.write(STACK[0], photometric="minisblack", extratags=[(42113, 2, 0, "-9999", True)])
        file.write(np.zeros((20, 24, 3), np.uint8), photometric="rgb")
        file.write(np.where(STACK[1] == STACK[1].min(), -9999, STACK[1]), photometric="minisblack")
        file.write(STACK[1][:5], photometric="minisblack")
    found, _ = index_recordings([path], EVERY_10_S)
    np.testing.assert_allclose(found[0].read_temperature(), STACK[0], atol=1e-5)
    assert np.isnan(found[1].read_temperature()).sum() == (STACK[1] == STACK[1].min()).sum() and len(found) == 2
    assert found[0].notes == tuple(
        f"pages passed over, reduced or of colours: 1 of {size}" for size in ("6 x 5", "24 x 20", "12 x 5")
    )
    colours = np.zeros((3, 256), np.uint16)
    tifffile.imwrite(path, np.zeros((9, 9), np.uint8), photometric="palette", colormap=colours)
    with pytest.raises(ThermographyError, match="colours are not temperatures; export radiometric"):
        read_stack(path)


@pytest.mark.parametrize("written", ["as it is", "numbered columns", "pandas", "pandas of floats", "R"])
def test_numbers_of_rows_and_columns_are_no_pixels(tmp_path, written):
    """As ``DataFrame.to_csv`` and ``write.csv`` write a picture."""
    frame = PICTURE
    columns = {
        "numbered columns": range(32),
        "pandas": range(32),
        "pandas of floats": np.arange(32.0),
        "R": [f'"V{k}"' for k in range(1, 33)],
    }
    names = {"pandas": range(24), "pandas of floats": np.arange(24.0), "R": [f'"{k}"' for k in range(1, 25)]}.get(
        written
    )
    lines = [",".join(map(str, row)) for row in frame]
    lines = lines if names is None else [f"{name},{line}" for name, line in zip(names, lines, strict=True)]
    if written in columns:
        lines.insert(0, ("," if names is not None else "") + ",".join(map(str, columns[written])))
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines) + "\n")
    np.testing.assert_array_equal(TextReader().read_values(path, 0, StackOptions()), frame)
    assert TextReader().contents(path, StackOptions()).shape == (24, 32)


def test_bytes_before_the_first_frame_of_a_sequence_do_not_hide_it(tmp_path):
    sequence(tmp_path / "a.seq", frames=3)
    (tmp_path / "a.seq").write_bytes(b"\x07" * 100 + (tmp_path / "a.seq").read_bytes())
    frames, (rejected,) = index_recordings([tmp_path / "a.seq"])
    assert [frame.index for frame in frames] == [1, 2, 3] and "expected a JPEG" in rejected.reason


def test_frames_of_text_in_another_unit_are_left_out_by_name(tmp_path):
    rng = np.random.default_rng(4)
    for k, zero in enumerate((22.0, 295.15)):
        np.savetxt(tmp_path / f"f_2026030908000{k}.csv", zero + rng.random((24, 32)), fmt="%.2f", delimiter=";")
    frames, rejected = index_recordings(
        sorted(tmp_path.iterdir()), StackOptions(unit="degC", time_in_name="%Y%m%d%H%M%S")
    )
    assert len(frames) == 1 and "are not in degC" in rejected[0].reason
