from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from fusion.app.results.products import Products
from fusion.products.results import ResultsError
from fusion.products.store import DamagedProductError, read_dataset, write_dataset


@pytest.fixture(scope="module")
def products(results_folder: Path) -> Products:
    return Products(results_folder)


def test_maps_and_places_are_those_of_the_file(products: Products, results_folder: Path) -> None:
    fields = read_dataset(results_folder / "fields.nc")
    rise = products.layers[0]
    assert rise.variable == "temperature_rise"
    np.testing.assert_array_equal(products.map_of(rise, 7), fields["temperature_rise"].sel(cycle=7).values)
    series, cells = products.place_over_time(rise, 350.0, 90.0, 0.0)
    nearest = fields["temperature_rise"].sel(x=350.0, y=90.0, method="nearest")
    assert cells == 1
    np.testing.assert_allclose(series, nearest.values)
    wide, many = products.place_over_time(rise, 350.0, 90.0, 80.0)
    inside = fields["temperature_rise"].where((abs(fields["x"] - 350) <= 40) & (abs(fields["y"] - 90) <= 40), drop=True)
    assert many == inside[0].size
    np.testing.assert_allclose(wide, inside.mean(["x", "y"]).values, rtol=1e-5)


def test_one_scale_holds_all_cycles_and_the_fields_stay_on_disk(products: Products, results_folder: Path) -> None:
    scale, whole = products.scale(products.layers[0])
    rise = read_dataset(results_folder / "fields.nc")["temperature_rise"]
    assert whole and scale["low"] <= float(rise.min()) and scale["high"] >= float(rise.max())
    assert products.fields is not None and products.fields["temperature_rise"].variable._in_memory is False


def test_targets_and_cycles_are_those_of_the_test(products: Products) -> None:
    assert products.cycles.tolist() == list(range(1, 25))
    assert [place for _, place in products.targets] == sorted(place for _, place in products.targets)
    assert products.field_hours.shape == (24,) and products.field_hours[0] > 0


def test_a_laser_alone_a_camera_alone_and_no_results(results_folder: Path, tmp_path: Path) -> None:
    laser = shutil.copytree(results_folder, tmp_path / "laser")
    (laser / "fields.nc").unlink()
    alone = Products(laser)
    assert alone.fields is None and alone.layers == [] and len(alone.targets) == 6
    camera = shutil.copytree(results_folder, tmp_path / "camera")
    for name in ("deviations.nc", "fusion.nc"):
        (camera / name).unlink()
    seen = Products(camera)
    assert seen.deviations is None and seen.drift is None and seen.loop is None and seen.targets == []
    assert seen.cycles.size == 24 and seen.field_hours[0] == 0.0
    with pytest.raises(ResultsError, match=r"there is no results\.json in it"):
        Products(tmp_path)


@pytest.mark.parametrize("name", ["fields", "deviations", "fusion"])
def test_a_damaged_product_is_named(results_folder: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / "results.json").write_bytes((results_folder / "results.json").read_bytes())
    (tmp_path / f"{name}.nc").write_bytes((results_folder / f"{name}.nc").read_bytes()[:5000])
    with pytest.raises(DamagedProductError, match=rf"{name}\.nc"):
        getattr(Products(tmp_path), name)


def test_fields_of_another_kind_are_told_and_not_left_open(results_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "results.json").write_bytes((results_folder / "results.json").read_bytes())
    (tmp_path / "fields.nc").write_bytes((results_folder / "deviations.nc").read_bytes())
    seen = Products(tmp_path)
    with pytest.raises(DamagedProductError, match="another kind of file") as told:
        seen.fields  # noqa: B018 - it is opened when it is asked for
    assert told.tb is not None, "the stack still holds what was opened"
    # A file that is open for reading cannot be opened for writing.
    with h5py.File(tmp_path / "fields.nc", "r+"):
        pass


def test_products_that_the_run_did_not_write_are_told(results_folder: Path, tmp_path: Path) -> None:
    for name in ("results.json", "provenance.json", "fields.nc"):
        (tmp_path / name).write_bytes((results_folder / name).read_bytes())
    write_dataset(tmp_path / "fields.nc", read_dataset(tmp_path / "fields.nc").isel(cycle=slice(5)))
    with pytest.raises(DamagedProductError, match=r"fields\.nc: is not the file that this run wrote"):
        Products(tmp_path).fields  # noqa: B018 - it is opened when it is asked for
    text = (tmp_path / "results.json").read_text(encoding="utf-8")
    (tmp_path / "results.json").write_text(text.replace("Small campaign", "Another campaign"), encoding="utf-8")
    with pytest.raises(DamagedProductError, match=r"results\.json: is not the file that this run wrote"):
        Products(tmp_path)
