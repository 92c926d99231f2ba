"""TIFF, NumPy, NetCDF and Zarr: shapes, units, times, and what they lack."""

from __future__ import annotations

import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import xarray as xr

from thermography.errors import ThermographyError
from thermography.inspection import describe_stack
from thermography.io.array_frames import NetcdfReader, NumpyReader, TiffReader
from thermography.io.frame_readers import index_recordings
from thermography.io.temperature_frames import StackError, StackOptions

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
def test_every_frame_comes_back_with_its_time(tmp_path: Path, kind: str) -> None:
    path = store(tmp_path, kind)
    frames, rejected = index_recordings([path], EVERY_10_S if kind in ("npy", "tif") else StackOptions())
    assert rejected == []
    assert [frame.time for frame in frames] == TIMES.astype("datetime64[ms]").tolist()
    for frame, image in zip(frames, STACK, strict=True):
        assert frame.shape == (10, 12)
        assert pickle.loads(pickle.dumps(frame)).read_temperature() == pytest.approx(image, abs=1e-5)


def test_kelvin_by_the_units_of_the_variable(tmp_path: Path) -> None:
    frames, _ = index_recordings([store(tmp_path, "nc", units="K")])
    assert frames[0].read_temperature()[0, 0] == pytest.approx(20.0 - 273.15)  # type: ignore[attr-defined]


def test_a_folder_of_zarr_is_recognised(tmp_path: Path) -> None:
    folder = store(tmp_path, "zarr").parent
    assert len(index_recordings([folder])[0]) == 3


def test_the_time_of_a_single_tiff_is_its_tag(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, STACK[0], datetime="2026:03:09 07:30:00")
    (frame,), _ = index_recordings([path], StackOptions(unit="degC", time_zone="Europe/Vienna"))
    assert frame.time == TIMES[0]


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({}, r"holds the variables none over three dimensions; write variable = "),
        (
            {"a": (("time", "row", "column"), STACK), "b": (("time", "row", "column"), STACK)},
            "holds the variables a, b over",
        ),
    ],
)
def test_the_variable_must_be_known(tmp_path: Path, variables: dict, message: str) -> None:
    path = tmp_path / "a.nc"
    xr.Dataset(variables).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(StackError, match=message):
        index_recordings([path])
    if variables:
        options = StackOptions(unit="degC", variable="b", start=TIMES[0], interval_s=1.0)
        assert len(index_recordings([path], options)[0]) == 3


def test_what_is_no_stack_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros(3))
    with pytest.raises(
        ThermographyError, match=r"an array of shape \(3,\) and type float64; save numbers as \(row, column\)"
    ):
        NumpyReader().contents(tmp_path / "a.npy", EVERY_10_S)
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((8, 8, 3), np.uint8), photometric="rgb")
    with pytest.raises(
        ThermographyError, match="a picture in colours holds no temperatures; export the radiometric TIFF"
    ):
        TiffReader().contents(tmp_path / "a.tif", EVERY_10_S)
    (tmp_path / "a.nc").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(ThermographyError, match=r"cannot be opened .* write it again"):
        NetcdfReader().contents(tmp_path / "a.nc", EVERY_10_S)


def test_a_tiff_whose_strips_do_not_fill_its_page_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, STACK[0], photometric="minisblack")
    with tifffile.TiffFile(path) as file:
        at = file.pages[0].tags["ImageLength"].valueoffset
    content = bytearray(path.read_bytes())
    content[at : at + 2] = (60_000).to_bytes(2, "little")
    path.write_bytes(content)
    with pytest.raises(
        ThermographyError, match=r"a\.tif: page 0 is damaged \(.*contradict one another\); export it again"
    ):
        TiffReader().read_values(path, 0, EVERY_10_S)


@pytest.mark.parametrize("kind", ["complex64", "bool"])
def test_values_that_are_no_real_numbers_are_named_by_their_type(tmp_path: Path, kind: str) -> None:
    tifffile.imwrite(tmp_path / "a.tif", STACK[0].astype(kind), photometric="minisblack")
    message = rf"a\.tif: values of type {kind} are no temperatures; export floating-point or whole numbers"
    with pytest.raises(ThermographyError, match=message):
        TiffReader().contents(tmp_path / "a.tif", EVERY_10_S)


@pytest.mark.parametrize(
    "kind", [np.dtype([("a", "f4"), ("b", "i4")]), np.dtype("V8"), np.dtype("c16"), h5py.string_dtype()]
)
def test_a_variable_of_no_numbers_is_refused(tmp_path: Path, kind: np.dtype) -> None:
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file.create_dataset("temperature", (3, 4, 5), kind)
    with pytest.raises(ThermographyError, match="are no temperatures; write floating-point or whole numbers"):
        describe_stack(tmp_path / "a.nc")


def test_of_many_variables_a_message_names_some(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.nc", "w") as file:
        for number in range(8):
            file.create_dataset(f"v{number}", (3, 4, 5), "f4")
    with pytest.raises(StackError, match="the variables v0, v1, v2, v3, v4 and 3 more over three dimensions"):
        describe_stack(tmp_path / "a.nc")


def test_what_a_library_says_of_a_long_attribute_is_cut(tmp_path: Path) -> None:
    time = xr.DataArray(np.arange(3), dims="time", attrs={"units": "days since 2026-01-01", "calendar": "x" * 50_000})
    values = xr.DataArray(np.zeros((3, 4, 5)), dims=("time", "y", "x"), coords={"time": time})
    values.to_dataset(name="temperature").to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with pytest.raises(ThermographyError, match=r"cannot be opened .*xxx.*; write it again") as error:
        describe_stack(tmp_path / "a.nc")
    assert len(str(error.value)) < 1_000


def test_a_zarr_store_of_very_many_arrays_is_not_opened(tmp_path: Path) -> None:
    xr.DataArray(np.zeros((3, 4, 5)), dims=("time", "y", "x"), name="temperature").to_dataset().to_zarr(
        tmp_path / "a", consolidated=False, zarr_format=3
    )
    describe_stack(tmp_path / "a" / "zarr.json")
    for number in range(1_000):
        (tmp_path / "a" / f"v{number}").mkdir()
    with pytest.raises(ThermographyError, match="it holds more than 1000 arrays and groups"):
        describe_stack(tmp_path / "a" / "zarr.json")
