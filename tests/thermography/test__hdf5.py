"""What several folders of the package use: HDF5 files that are refused, and the scatter by the median."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy import stats

from fusion.results.store import DamagedProductError, read_dataset
from thermography.common import scatter_by_median
from thermography.io.other_cameras import StackOptions, hdf5_fault, index_recordings

SHAPE = (3, 4, 5)


def written(path: Path, kind: str) -> Path:
    secret = path.with_name("secret.txt")
    secret.write_bytes(b"not for strangers" * 20)
    with h5py.File(path, "w") as file:
        file.create_group("deep/er")["sound"] = np.zeros(SHAPE)
        if kind == "storage":
            file.create_dataset("deep/temperature", SHAPE, "f4", external=[(str(secret), 0, 240)])
        elif kind == "virtual":
            layout = h5py.VirtualLayout(SHAPE, "f4")
            layout[...] = h5py.VirtualSource(str(secret), "x", SHAPE)
            file.create_virtual_dataset("temperature", layout)
        elif kind == "link":
            file["deep/temperature"] = h5py.ExternalLink(str(secret), "/x")
        elif kind == "sparse":
            file.create_dataset("temperature", (1 << 20, 480, 640), "f4", chunks=(1, 480, 640))
        elif kind == "many":
            for number in range(1_000):
                file.create_group(f"g{number}")
        elif kind == "circle":
            file["deep/er/again"] = file["deep"]
        elif kind == "branches":
            for level in range(10):
                file.create_group(f"{level}")
                for branch in "abc":
                    file[f"{level}/{branch}"] = h5py.SoftLink(f"/{level + 1}")
        elif kind == "twice":
            file["temperature"] = np.full(SHAPE, 20.0)
            file["again"], file["er"] = file["temperature"], h5py.SoftLink("/deep/er")
    return path


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("storage", "the values of deep/temperature are in another file"),
        ("virtual", "the values of temperature are in another file"),
        ("link", "deep/temperature is in another file"),
        ("sparse", "temperature states 1.29e+03 GB, more than the file holds"),
        ("many", "it holds more than 1000 datasets and groups"),
        ("circle", "it nests groups more than 20 deep"),
        ("branches", "it holds more than 1000 datasets and groups"),
    ],
)
def test_what_the_library_would_read_is_refused(tmp_path, kind, told):
    path = written(tmp_path / "a.nc", kind)
    assert hdf5_fault(path).startswith(told)
    _, (rejected,) = index_recordings([path], StackOptions(unit="degC"))
    assert told in rejected.reason
    with pytest.raises(DamagedProductError, match=r"is no product of thermofuse: .*; run the campaign again"):
        read_dataset(path)


def test_a_file_that_holds_its_values_is_read(tmp_path):
    assert hdf5_fault(written(tmp_path / "a.nc", "twice")) == ""


@pytest.mark.parametrize("shape", [(5,), (24,), (3, 7)])
def test_scatter_is_that_of_the_library(shape):
    values = np.random.default_rng(4).normal(3.0, 0.5, shape)
    assert scatter_by_median(values) == stats.median_abs_deviation(values, axis=None, scale="normal")
    about_zero = stats.median_abs_deviation(values, axis=None, center=lambda x, axis: 0.0, scale="normal")
    assert scatter_by_median(values, centre=0.0) == about_zero > scatter_by_median(values)


def test_missing_values_are_left_out_and_a_few_strange_ones_change_little():
    values = np.array([1.0, np.nan, 2.0, 3.0, 4.0, 5.0])
    one = 1.4826022185056018
    assert scatter_by_median(values) == pytest.approx(one)
    assert scatter_by_median([1.0, 2.0, 3.0, 4.0, 1e9]) == pytest.approx(one)


@pytest.mark.parametrize("values", [[], [np.nan, np.nan]])
def test_without_values_there_is_no_scatter(values):
    assert np.isnan(scatter_by_median(values))
