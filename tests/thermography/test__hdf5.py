"""HDF5 files that show other files of the machine, or state values that nobody wrote."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from fusion.products.store import DamagedProductError, read_dataset
from thermography._hdf5 import hdf5_fault
from thermography.io.frame_readers import index_recordings
from thermography.io.temperature_frames import StackOptions

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
            file["temperature"] = np.full(SHAPE, 20.0)
    return path


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("storage", "the values of deep/temperature stand in another file"),
        ("virtual", "the values of temperature stand in another file"),
        ("link", "deep/temperature stands in another file"),
        ("sparse", "temperature states 1.29e+03 GB, which a file of"),
        ("many", "it holds more than 1000 datasets and groups"),
    ],
)
def test_what_the_library_would_read_is_refused(tmp_path: Path, kind: str, told: str) -> None:
    path = written(tmp_path / "a.nc", kind)
    assert hdf5_fault(path).startswith(told)
    _, (rejected,) = index_recordings([path], StackOptions(unit="degC"))
    assert told in rejected.reason
    with pytest.raises(DamagedProductError, match=r"is no product of thermofuse: .*; run the campaign again"):
        read_dataset(path)


def test_a_file_that_holds_its_values_is_read(tmp_path: Path) -> None:
    assert hdf5_fault(written(tmp_path / "a.nc", "circle")) == ""
