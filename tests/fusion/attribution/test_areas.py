"""Places as areas: the piece of cells with the peak, and the rectangle around it."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.attribution.areas import Area, area_of, mode_cells, piece_with_peak


@pytest.fixture
def plan() -> xr.Dataset:
    return xr.Dataset(coords={"y": [5.0, 15.0, 25.0], "x": [5.0, 15.0, 25.0, 35.0]})


def test_the_rectangle_ends_at_the_edges_of_the_outermost_cells(plan: xr.Dataset) -> None:
    cells = np.zeros((3, 4), bool)
    cells[1, 1] = cells[2, 2] = True
    assert area_of(cells, plan) == Area(10.0, 30.0, 10.0, 30.0)
    assert area_of(np.zeros((3, 4), bool), plan) is None


def test_only_cells_that_are_connected_to_the_peak_belong_to_it() -> None:
    strength = np.array([[1.0, 0.6, 0.0, 0.9], [0.0, 0.0, 0.7, 0.0]])
    piece = piece_with_peak(strength, strength > 0.5)
    # Cells that touch at a corner are connected: all but none here.
    assert piece.sum() == 4
    apart = np.array([[1.0, 0.6, 0.0, 0.9]])
    np.testing.assert_array_equal(piece_with_peak(apart, apart > 0.5), [[True, True, False, False]])


def test_a_mode_reaches_to_half_of_its_peak_and_cells_that_were_not_seen_are_outside() -> None:
    pattern = np.array([[0.4, -1.0, -0.5, np.nan, 0.8]])
    np.testing.assert_array_equal(mode_cells(pattern), [[False, True, True, False, False]])
