"""The contract of a Dataset: kept, or every broken promise in one message."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

from fusion.products.contracts import ContractError, check, read_fusion, read_product, require_own
from fusion.products.store import DamagedProductError, file_sha256, write_dataset, write_json


def test_a_broken_contract_is_told_whole() -> None:
    contract = {"rise": (("y", "x"), "K", "f"), "time": (("cycle",), "", "M"), "count": (("y", "x"), "1", "i")}
    dataset = xr.Dataset(
        {
            "rise": (("x", "y"), np.zeros((2, 3)), {"units": "degC"}),
            "count": (("y", "x"), np.zeros((3, 2)), {"units": "1"}),
        }
    )
    with pytest.raises(ContractError) as error:
        check(dataset, contract, name="the fields")
    assert str(error.value) == (
        "the fields breaks its contract: rise has dims (x, y), not (y, x); rise is in 'degC', not 'K'; time is missing; "
        "count is of type float64, not of kind 'i'"
    )
    good = dataset[["rise"]].transpose("y", "x")
    good["rise"].attrs["units"] = "K"
    assert check(good, {"rise": contract["rise"]}, name="the fields") is good


def sensors() -> xr.Dataset:
    over_time = {name: (("time", "sensor"), np.zeros((2, 1))) for name in ("temperature", "rise")}
    return xr.Dataset({**over_time, **{name: ("sensor", [0.0]) for name in ("x", "y", "is_faulty", "fault")}})


def test_a_netcdf_of_another_kind_under_the_name_of_a_product_is_told(tmp_path: Path) -> None:
    write_dataset(tmp_path / "sensors.nc", sensors())
    assert read_product(tmp_path, "sensors").identical(sensors())
    for name in ("fields", "deviations", "fusion"):
        write_dataset(tmp_path / f"{name}.nc", sensors())
        read = read_fusion if name == "fusion" else lambda folder, name=name: read_product(folder, name)
        with pytest.raises(
            DamagedProductError,
            match=rf"{name}\.nc: is another kind of file: .* not in it; put the file of this run back",
        ):
            read(tmp_path)
    write_dataset(tmp_path / "sensors.nc", sensors().transpose("sensor", "time"))
    with pytest.raises(DamagedProductError, match=r"temperature \(time, sensor\), rise \(time, sensor\) not in it"):
        read_product(tmp_path, "sensors")


def test_a_product_of_another_run_is_told_by_its_hash(tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "sensors.nc", sensors())
    listed = {"sensors.nc": {"bytes": path.stat().st_size, "sha256": file_sha256(path)}}
    write_json(tmp_path / "provenance.json", {"products": listed})
    require_own(tmp_path, ["sensors.nc", "absent.nc"])
    write_dataset(path, sensors() + 1.0)
    with pytest.raises(
        DamagedProductError, match=r"sensors\.nc: is not the file that this run wrote .* put that file back, or run"
    ):
        read_product(tmp_path, "sensors")
    for damaged in ({}, {"products": {"sensors.nc": {}}}, {"products": 1}):
        write_json(tmp_path / "provenance.json", damaged)
        require_own(tmp_path, ["sensors.nc"])


def test_fields_of_another_kind_are_not_left_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.products.store.IN_MEMORY_BYTES", 1_000)
    path = write_dataset(tmp_path / "fields.nc", xr.Dataset({"rise": ("x", np.zeros(1_000))}))
    with pytest.raises(DamagedProductError, match="another kind of file") as told:
        read_product(tmp_path, "fields")
    assert told.tb is not None, "the stack still holds what was opened"
    # A file that is open for reading cannot be opened for writing.
    with h5py.File(path, "r+"):
        pass
