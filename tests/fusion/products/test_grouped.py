"""Several results in one product: prefixes in a flat Dataset, groups in a NetCDF file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from fusion.products.grouped import by_approach, group, has, joined
from fusion.products.store import annotate, read_tree, write_dataset

READINGS = xr.Dataset({"deviation": ("target", [0.1, 0.2])}, {"target": [1, 2]})
DRIFT = xr.Dataset({"profile": ("target", [1.0, 2.0])}, {"target": [1, 2]})


def test_a_part_comes_back_under_its_own_names() -> None:
    product = joined(READINGS, drift=DRIFT)
    assert set(product.data_vars) == {"deviation", "drift_profile"}
    xr.testing.assert_equal(group(product, "drift"), DRIFT)
    assert has(product, "drift") and not has(product, "iso")


def test_every_group_opens_by_itself_with_its_coordinates(tmp_path: Path) -> None:
    maps = xr.Dataset(
        {"p_value": (("channel", "x"), np.ones((2, 3)))}, {"channel": ["common", "joint"], "x": [5.0, 15.0, 25.0]}
    )
    modes = xr.Dataset({"lag": (("channel", "mode"), np.zeros((2, 1)))}, {"mode": [1]})
    correlation = xr.DataTree(maps, children={"modes": xr.DataTree(modes)})
    tree = annotate(xr.DataTree(READINGS, children={"correlation": correlation}), title="x", history="y", provenance={})
    path = write_dataset(tmp_path / "fusion.nc", tree)
    with xr.open_dataset(path, engine="h5netcdf") as root:
        xr.testing.assert_equal(root, READINGS)
        assert root["deviation"].attrs["long_name"] == "deviation"
        assert root.attrs["title"] == "x"
    with xr.open_dataset(path, group="correlation", engine="h5netcdf") as plan:
        xr.testing.assert_equal(plan, maps)
    with xr.open_dataset(path, group="correlation/modes", engine="h5netcdf") as opened:
        assert list(opened["lag"].sel(mode=1)["channel"].values) == ["common", "joint"]
        assert set(opened.coords) == {"channel", "mode"}
    xr.testing.assert_identical(read_tree(path), tree)
    assert READINGS["deviation"].attrs == {}


def test_values_by_place_and_approach_are_those_of_their_labels() -> None:
    values = xr.DataArray(
        [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
        dims=("direction", "target"),
        coords={"direction": ["negative", "positive"], "target": [1, 2, 7]},
    )
    np.testing.assert_array_equal(by_approach(values, target=np.array([7, 1])), [[6.0, 3.0], [4.0, 1.0]])
