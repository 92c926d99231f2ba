"""Products of a run as the screens read them, and the places that are chosen."""

import shutil

import numpy as np
import pytest

from fusion.app.results import Place, Products, Selection
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
