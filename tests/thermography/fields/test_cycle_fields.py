"""The written fields keep the climate and forecast conventions: the official checker has nothing to say."""

import json

import numpy as np
import pytest
import xarray as xr

from tests.thermography.plan_scene import DISCS, GRID, START, Scene, record
from thermography.fields.moving import reduce_moving_frames
from thermography.fields.still import reduce_frames
from thermography.registration.register import register


@pytest.fixture(scope="module")
def products(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cf")
    image = Scene(disc_K=-4.0).render()
    registration = register(image, DISCS, grid=GRID)
    frames = record(folder / "a.seq", [image, image + 0.5, image + 1.0])
    bounds = START + np.arange(4) * np.timedelta64(1, "s")
    paths = {}
    for name, fields in {
        "still": reduce_frames(frames, registration, GRID, bounds),
        "moving": reduce_moving_frames(frames, registration, GRID, bounds, direction=(-1, 0)),
    }.items():
        paths[name] = folder / f"{name}.nc"
        fields.to_netcdf(paths[name], engine="h5netcdf")
    return paths


# The checker opens its own tables and sockets and leaves them to the garbage collector.
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["still", "moving"])
def test_official_checker_finds_nothing(products, tmp_path, name):
    runner = pytest.importorskip("compliance_checker.runner")
    runner.CheckSuite.load_all_available_checkers()
    report = tmp_path / "report.json"
    _, errors = runner.ComplianceChecker.run_checker(
        str(products[name]),
        ["cf:1.11"],
        verbose=0,
        criteria="strict",
        output_filename=str(report),
        output_format="json",
    )
    found = json.loads(report.read_text())["cf:1.11"]
    messages = [
        f"{item['name']}: {message}"
        for level in ("high_priorities", "medium_priorities", "low_priorities")
        for item in found[level]
        for message in item["msgs"]
    ]
    assert messages == []
    assert not errors


def test_fields_come_back_equal_and_labelled(products):
    with xr.open_dataset(products["still"], engine="h5netcdf") as fields:
        assert fields["temperature"].attrs["standard_name"] == "surface_temperature"
        assert fields["x"].attrs["standard_name"] == "projection_x_coordinate"
        assert fields["cycle_time"].dtype.kind == "M"
        assert float(fields["temperature_rise"].isel(cycle=2).median()) == pytest.approx(1.0, abs=0.01)
