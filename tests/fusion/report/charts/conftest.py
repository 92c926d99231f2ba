"""Products of the small campaign for charts, and a small plan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.products.store import read_dataset, read_tree


@pytest.fixture
def deviations(results_folder: Path) -> xr.Dataset:
    return read_dataset(results_folder / "deviations.nc")


@pytest.fixture
def fused(results_folder: Path) -> xr.DataTree:
    return read_tree(results_folder / "fusion.nc")


@pytest.fixture
def fields(results_folder: Path) -> xr.Dataset:
    return read_dataset(results_folder / "fields.nc")


@pytest.fixture
def plan_of_cells() -> xr.Dataset:
    """2 by 3 cells of 10 mm with p-values in every step; the sensitivity is 100 times p."""
    p = np.array([[[0.005, 0.03, 0.08], [0.5, np.nan, 0.9]]])
    dims = ("channel", "y", "x")
    return xr.Dataset(
        {"p_value": (dims, p), "sensitivity": (dims, 100 * p)},
        {"channel": ["common"], "y": [5.0, 15.0], "x": [5.0, 15.0, 25.0]},
    )
