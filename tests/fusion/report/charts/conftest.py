"""Products of the small campaign for charts, and a small plan."""

import numpy as np
import pytest
import xarray as xr

from fusion.results.store import read_dataset, read_grouped, read_tree


def parts_of(drawn, kind):
    """The parts of a figure that are no marks, of one kind."""
    return [
        one for place in ("center", "below", "right") for one in drawn.properties.get(place, ()) if one.kind == kind
    ]


@pytest.fixture(scope="session")
def deviations(results_folder):
    return read_grouped(results_folder / "deviations.nc")


@pytest.fixture(scope="session")
def fused(results_folder):
    return read_tree(results_folder / "fusion.nc")


@pytest.fixture(scope="session")
def fields(results_folder):
    return read_dataset(results_folder / "fields.nc")


@pytest.fixture
def plan_of_cells():
    """2 by 3 cells of 10 mm with p-values in every step; the sensitivity is 100 times p."""
    p = np.array([[[0.005, 0.03, 0.08], [0.5, np.nan, 0.9]]])
    dims = ("channel", "y", "x")
    return xr.Dataset(
        {"p_value": (dims, p), "sensitivity": (dims, 100 * p)},
        {"channel": ["common"], "y": [5.0, 15.0], "x": [5.0, 15.0, 25.0]},
    )
