"""Products of a run as the screens read them, and the places that are chosen."""

import shutil

import h5py
import numpy as np
import pytest

from fusion.app.results.data import Place, Products, Selection
from fusion.results.results import ResultsError
from fusion.results.store import DamagedProductError, read_dataset, write_dataset


def test_maps_and_places_are_those_of_the_file(products, results_folder):
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


def test_one_scale_holds_all_cycles_and_the_fields_stay_on_disk(products, results_folder):
    scale, whole = products.scale(products.layers[0])
    rise = read_dataset(results_folder / "fields.nc")["temperature_rise"]
    assert whole and scale["low"] <= float(rise.min()) and scale["high"] >= float(rise.max())
    assert products.fields["temperature_rise"].variable._in_memory is False


def test_cycles_are_those_of_the_test(products):
    assert products.cycles.tolist() == list(range(1, 25))
    assert products.field_hours.shape == (24,) and products.field_hours[0] > 0


def test_a_laser_alone_a_camera_alone_and_no_results(results_folder, tmp_path):
    laser = shutil.copytree(results_folder, tmp_path / "laser")
    (laser / "fields.nc").unlink()
    alone = Products(laser)
    assert alone.fields is None and alone.layers == [] and alone.cycles.size == 24
    camera = shutil.copytree(results_folder, tmp_path / "camera")
    for name in ("deviations.nc", "fusion.nc"):
        (camera / name).unlink()
    seen = Products(camera)
    assert seen.deviations is None and seen.drift is None
    assert seen.cycles.size == 24 and seen.field_hours[0] == 0.0
    with pytest.raises(ResultsError, match=r"there is no results\.json in it"):
        Products(tmp_path)


@pytest.mark.parametrize("name", ["fields", "deviations"])
def test_a_damaged_product_is_named(results_folder, tmp_path, name):
    (tmp_path / "results.json").write_bytes((results_folder / "results.json").read_bytes())
    (tmp_path / f"{name}.nc").write_bytes((results_folder / f"{name}.nc").read_bytes()[:5000])
    with pytest.raises(DamagedProductError, match=rf"{name}\.nc"):
        getattr(Products(tmp_path), name)


def test_fields_of_another_kind_are_told_and_not_left_open(results_folder, tmp_path):
    (tmp_path / "results.json").write_bytes((results_folder / "results.json").read_bytes())
    (tmp_path / "fields.nc").write_bytes((results_folder / "deviations.nc").read_bytes())
    seen = Products(tmp_path)
    with pytest.raises(DamagedProductError, match="another kind of file") as told:
        seen.fields  # noqa: B018 - it is opened when it is asked for
    assert told.tb is not None, "the stack still holds what was opened"
    # A file that is open for reading cannot be opened for writing.
    with h5py.File(tmp_path / "fields.nc", "r+"):
        pass


def test_products_that_the_run_did_not_write_are_told(results_folder, tmp_path):
    for name in ("results.json", "provenance.json", "fields.nc"):
        (tmp_path / name).write_bytes((results_folder / name).read_bytes())
    write_dataset(tmp_path / "fields.nc", read_dataset(tmp_path / "fields.nc").isel(cycle=slice(5)))
    with pytest.raises(DamagedProductError, match=r"fields\.nc: is not the file that this run wrote"):
        Products(tmp_path).fields  # noqa: B018 - it is opened when it is asked for
    text = (tmp_path / "results.json").read_text(encoding="utf-8")
    (tmp_path / "results.json").write_text(text.replace("Small campaign", "Another campaign"), encoding="utf-8")
    with pytest.raises(DamagedProductError, match=r"results\.json: is not the file that this run wrote"):
        Products(tmp_path)


def test_a_place_is_added_once_and_named():
    selection = Selection()
    for _ in range(2):
        selection.add(Place(10.0, 20.0, 0.0))
    selection.add(Place(10.0, 20.0, 30.0))
    assert [place.words for place in selection.places] == ["x 10 mm, y 20 mm", "x 10 mm, y 20 mm, 30 mm square"]
