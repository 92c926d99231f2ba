"""FLIR files opened with xarray: lazy, with parameters as variables, and with a list of what could not be used."""

import importlib
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.thermography.flir_mutations import PARAMETERS, TIME, frame, jpeg, patch, sequence
from thermography.io import xarray_backend
from thermography.io.flir import FlirFrameReference, index_frames, read_frame
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import FlirFormatError
from thermography.io.xarray_backend import FlirBackendEntrypoint
from thermography.radiometry.planck import RadiometryError, calibrate, override


def _open(path, **options) -> xr.Dataset:
    return xr.open_dataset(path, engine=FlirBackendEntrypoint, **options)


def test_no_pixel_is_read_at_open(tmp_path, monkeypatch):
    written = sequence(tmp_path / "a.seq", frames=6)
    read = []
    original = FlirFrameReference.read_counts
    monkeypatch.setattr(FlirFrameReference, "read_counts", lambda self: read.append(self.index) or original(self))
    dataset = _open(tmp_path / "a.seq")
    chosen = dataset["counts"].isel(time=slice(1, 5, 2), row=slice(2, 9, 3), column=[0, 5])
    assert read == []
    np.testing.assert_array_equal(chosen[1], written[3].counts[2:9:3][:, [0, 5]])
    assert set(read) == {3}


@pytest.mark.parametrize(
    "selection",
    [
        {"time": 2},
        {"time": -1, "row": 3},
        {"time": [0, 3, 1], "column": slice(None, None, -2)},
        {"time": slice(4, None, -1), "row": [1, 1], "column": 7},
        {"time": [], "row": 0},
    ],
)
def test_every_kind_of_selection_equals_the_array(tmp_path, selection):
    written = sequence(tmp_path / "a.seq", "png", frames=5)
    everything = xr.DataArray(np.stack([each.counts for each in written]), dims=("time", "row", "column"))
    dataset = _open(tmp_path / "a.seq")
    np.testing.assert_array_equal(dataset["counts"].isel(selection), everything.isel(selection))


def test_contents_of_a_dataset(tmp_path):
    sequence(tmp_path / "a.seq", frames=3)
    dataset = _open(tmp_path / "a.seq")
    assert dataset["counts"].dims == ("time", "row", "column") and dataset["counts"].dtype == np.uint16
    np.testing.assert_array_equal(dataset["time"], TIME + np.arange(3).astype("timedelta64[s]"))
    assert dataset["emissivity"].dims == () and float(dataset["planck_r1"]) == PARAMETERS.planck_r1
    assert dataset["reflected_temperature"].attrs == {"units": "K", "units_metadata": "temperature: on_scale"}
    assert dataset["camera_temperature"].sel(sensor="TSLens").values.tolist() == [299.25] * 3
    assert json.loads(dataset.attrs["camera"])["serial"] == "404003980"
    scalars = [float(variable) for variable in dataset.data_vars.values() if variable.ndim == 0]
    assert sorted(scalars) == sorted(vars(PARAMETERS).values())
    assert json.loads(dataset.attrs["rejected"]) == [] and json.loads(dataset.attrs["notes"]) == []


def test_parameters_that_vary_lie_along_time(tmp_path):
    for second, emissivity in enumerate((0.5, 0.75)):
        each = frame(seconds=second)
        write_jpeg(tmp_path / f"{second}.jpg", each.counts, override(PARAMETERS, emissivity=emissivity), each.time)
    dataset = _open(sorted(tmp_path.iterdir()))
    assert dataset["emissivity"].dims == ("time",) and dataset["emissivity"].values.tolist() == [0.5, 0.75]
    assert dataset["camera_temperature"].shape == (2, 0)


def test_dask_chunks_read_in_parallel_and_pickle(tmp_path):
    import pickle

    written = sequence(tmp_path / "a.seq", frames=7)
    dataset = _open(tmp_path / "a.seq", chunks={"time": 2})
    assert dataset["counts"].chunks[0] == (2, 2, 2, 1)
    mean = pickle.loads(pickle.dumps(dataset["counts"].mean("time"))).compute(scheduler="threads")
    np.testing.assert_allclose(mean, np.mean([each.counts for each in written], axis=0))


def test_a_dataset_survives_netcdf(tmp_path):
    sequence(tmp_path / "a.seq", frames=2)
    dataset = _open(tmp_path / "a.seq")
    dataset.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as stored:
        xr.testing.assert_identical(stored.load(), dataset.load())


def test_what_is_left_out_is_warned_of_and_listed(tmp_path):
    jpeg(tmp_path / "a.jpg")
    (tmp_path / "b.jpg").write_bytes(b"nothing")
    with pytest.warns(UserWarning, match=r"1 files or frames could not be used, the first: .*b\.jpg: at 0x0: expected"):
        dataset = _open(sorted(tmp_path.iterdir()))
    (rejected,) = json.loads(dataset.attrs["rejected"])
    assert rejected["path"].endswith("b.jpg") and "expected a JPEG" in rejected["reason"]


def test_no_frame_at_all_and_frames_of_other_sizes_are_refused(tmp_path):
    (tmp_path / "b.seq").write_bytes(b"nothing")
    with pytest.raises(FlirFormatError, match=r"no FLIR frame can be read: .*b\.seq"):
        _open(tmp_path / "b.seq")
    with pytest.raises(FlirFormatError, match="no FLIR frame can be read: no files were given"):
        FlirBackendEntrypoint().open_dataset([])
    write_sequence(tmp_path / "b.seq", [frame(8, 9), frame(9, 8, seconds=1)])
    with pytest.raises(FlirFormatError, match=r"frame 1 has \(rows, columns\) \(9, 8\), .* has \(8, 9\); open the"):
        _open(tmp_path / "b.seq")


def test_the_engine_is_declared_under_the_name_flir():
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    ((name, target),) = project["entry-points"]["xarray.backends"].items()
    module, attribute = target.split(":")
    assert name == "flir" and getattr(importlib.import_module(module), attribute) is FlirBackendEntrypoint


def test_files_are_recognised_by_their_start(tmp_path):
    sequence(tmp_path / "a.bin")
    (tmp_path / "b.bin").write_bytes(b"CDF\1")
    guess = FlirBackendEntrypoint().guess_can_open
    assert guess(tmp_path / "a.bin") and guess(str(tmp_path / "a.bin"))
    assert not guess(tmp_path / "b.bin") and not guess(tmp_path / "absent.seq") and not guess(3)
    assert not guess([tmp_path / "a.bin"])
    jpeg(tmp_path / "c.jpg")
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff\xe0" + bytes(40) + b"\xff\xd9")
    assert guess(tmp_path / "c.jpg") and not guess(tmp_path / "photo.jpg")


def test_temperature_is_calibrated_on_access_with_the_given_parameters(tmp_path):
    written = sequence(tmp_path / "a.seq", frames=3)
    warmer = override(PARAMETERS, emissivity=0.8, reflected_temperature_K=295.15)
    for options, parameters in (({}, PARAMETERS), ({"emissivity": 0.8, "reflected_temperature_degC": 22.0}, warmer)):
        dataset = _open(tmp_path / "a.seq", **options)
        assert dataset["temperature"].attrs["units"] == "degC" and dataset["temperature"].dtype == np.float32
        np.testing.assert_array_equal(dataset["temperature"][1, 2:5], calibrate(written[1].counts, parameters)[2:5])
        assert float(dataset["emissivity"]) == parameters.emissivity
    with pytest.raises(RadiometryError, match="emisivity: no such parameter; there are emissivity, object_distance_m"):
        FlirBackendEntrypoint().open_dataset(tmp_path / "a.seq", emisivity=0.9)


@pytest.mark.parametrize("chunks", [None, {}, {"time": 2}])
def test_the_accessor_calibrates_anew(tmp_path, chunks):
    for second, emissivity in enumerate((0.5, 0.75, 0.9)):
        each = frame(seconds=second)
        write_jpeg(tmp_path / f"{second}.jpg", each.counts, override(PARAMETERS, emissivity=emissivity), each.time)
    dataset = _open(sorted(tmp_path.iterdir()), chunks=chunks)
    np.testing.assert_array_equal(dataset.flir.temperature(), dataset["temperature"])
    anew = dataset.flir.temperature(emissivity=0.8)
    assert (anew.chunks is None) is (chunks is None)
    np.testing.assert_array_equal(anew, _open(sorted(tmp_path.iterdir()), emissivity=0.8)["temperature"])
    part = dataset.isel(time=1, row=slice(2, 4))
    np.testing.assert_array_equal(part.flir.temperature(), dataset["temperature"][1, 2:4])
    with pytest.raises(RadiometryError, match="the Dataset has no counts; open it with engine='flir'"):
        dataset.drop_vars("counts").flir.temperature()
    assert dataset.flir.visible_light(2) is None


@pytest.mark.real_data
def test_regions_and_picture_of_real_files(real_file):
    spots = _open(real_file("gpereyrairujo__IRimage/Windows/IRimage/test/test_image.jpg"))
    assert [each.name for each in spots.flir.regions()] == ["Sp1", "Sp2"]
    with np.errstate(all="raise"):
        evaluated = spots.flir.evaluate(reference="Sp2")
    pixels = spots["temperature"][0].values[[57, 112], [66, 83]]
    np.testing.assert_allclose(evaluated["mean"][0, 1:], pixels, rtol=1e-6)
    assert float(evaluated["difference"][0, 1]) == pytest.approx(pixels[0] - pixels[1], abs=1e-4)
    picture = _open(real_file("frkatona__ThermalImageFitter/Nov19/FLIR2167.jpg")).flir.visible_light()
    assert picture.dims == ("visible_row", "visible_column", "channel") and picture.shape == (480, 640, 3)
    assert picture.attrs["offset_px"] == [10, -20]


def test_variables_can_be_dropped(tmp_path):
    sequence(tmp_path / "a.seq")
    assert "emissivity" not in _open(tmp_path / "a.seq", drop_variables="emissivity")
    assert "emissivity" not in _open(tmp_path / "a.seq", drop_variables=["emissivity", "planck_b"])


@pytest.mark.real_data
def test_a_real_series_of_jpegs_is_one_dataset(real_file):
    paths = [real_file(f"frkatona__ThermalImageFitter/Nov19/FLIR{number}.jpg") for number in range(2167, 2216, 2)]
    dataset = _open(paths[::-1])
    assert dict(dataset.sizes) == {"time": 25, "row": 96, "column": 128, "sensor": 4}
    assert (np.diff(dataset["time"]) > np.timedelta64(0)).all()
    np.testing.assert_array_equal(dataset["counts"][24], read_frame(paths[24]).counts)


def test_a_folder_read_by_threads_has_the_values_of_one_thread_and_tells_the_first_damaged_frame(tmp_path, monkeypatch):
    paths = []
    for number in range(30):
        paths.append(str(tmp_path / f"{number:02}.jpg"))
        one = frame(48, 64, seconds=number, seed=number)
        write_jpeg(Path(paths[-1]), one.counts, one.parameters, one.time, encoding="png")
    values = []
    for threads in (1, 4):
        monkeypatch.setattr(xarray_backend, "usable_threads", lambda threads=threads: threads)
        values.append([_open(paths)[name].values.tobytes() for name in ("counts", "temperature")])
    assert values[0] == values[1]
    dataset = _open(paths)
    for number in (11, 12, 25):
        reference = index_frames(paths[number])[0][0]
        place = reference.segments[0][0] + reference.samples.offset + 200
        patch(reference.path, (place, bytes([reference.path.read_bytes()[place] ^ 255])))
    with pytest.raises(FlirFormatError, match=r"11\.jpg"):
        dataset["temperature"].load()
