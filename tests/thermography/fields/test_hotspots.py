"""Hotspots against fields whose peaks are known."""

import numpy as np
import pytest
import xarray as xr

from thermography.errors import ThermographyError
from thermography.fields import hotspots as module
from thermography.fields.hotspots import detect_hotspots

X = np.arange(140) * 5.0 + 2.5
Y = np.arange(36) * 5.0 + 2.5


def plane(*peaks, slope=0.0):
    x, y = np.meshgrid(X, Y)
    values = slope * x
    for x0, y0, height, width in peaks:
        values = values + height * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * width**2))
    return xr.DataArray(values, dims=("y", "x"), coords={"y": Y, "x": X})


def test_two_peaks_are_found_where_they_are(rng):
    field = plane((203.0, 91.0, 3.0, 30.0), (551.0, 60.0, 1.5, 25.0))
    noisy = field + rng.normal(0, 0.014, field.shape)
    first, second = detect_hotspots(noisy)
    # A peak of width w in noise s is located to about s / height * w^2 / cell / sqrt(cells): below 1 mm here.
    assert (first.x_mm, first.y_mm) == pytest.approx((203.0, 91.0), abs=2)
    assert (second.x_mm, second.y_mm) == pytest.approx((551.0, 60.0), abs=3)
    assert first.peak_rise_K == pytest.approx(3.0, abs=0.04)
    assert second.peak_rise_K == pytest.approx(1.5, abs=0.04)
    # Above half its height a Gaussian covers 2 pi ln 2 w^2.
    assert first.area_mm2 == pytest.approx(2 * np.pi * np.log(2) * 30**2, rel=0.1)
    assert not first.at_edge
    assert (first.centroid_x_mm, first.centroid_y_mm) == pytest.approx((203.0, 91.0), abs=3)


def test_noise_and_flat_fields_hold_no_hotspot(rng):
    flat = plane()
    assert detect_hotspots(flat) == []
    assert detect_hotspots(flat + rng.normal(0, 0.015, flat.shape)) == []
    assert detect_hotspots(flat + np.nan) == []


def test_maximum_of_a_slope_is_marked_as_lying_at_the_edge():
    (spot,) = detect_hotspots(plane(slope=0.01))
    assert spot.at_edge
    assert spot.x_mm == pytest.approx(697.5)


def test_masked_discs_neither_make_nor_break_hotspots(rng):
    field = plane((300.0, 90.0, 2.0, 40.0)) + rng.normal(0, 0.014, (36, 140))
    field[16:20, 60:64] = np.nan
    field[4:8, 100:104] = np.nan
    (spot,) = detect_hotspots(field)
    assert np.hypot(spot.x_mm - 300, spot.y_mm - 90) < 15


def test_a_stack_is_refused():
    with pytest.raises(ValueError, match=r"give one field \(y, x\) of at least 3 x 3 cells"):
        detect_hotspots(xr.concat([plane()], "cycle"))


@pytest.mark.parametrize("rise", [None, np.zeros((4, 4)), "temperature_rise"])
def test_what_is_no_data_array_is_refused(rise):
    with pytest.raises(ThermographyError, match=rf"rise is of type {type(rise).__name__}; give a DataArray \(y, x\)"):
        detect_hotspots(rise)


def test_a_second_peak_within_six_standard_deviations_of_the_noise_is_none(rng):
    """Smoothing by one cell leaves noise of 0.006 K: maxima of the noise beside the peak, and a bump of 0.01 K, are not told."""
    noise = rng.normal(0, 0.02, (36, 140))
    for height, found in ((0.01, 1), (0.3, 2)):
        field = plane((500.0, 90.0, 1.0, 30.0), (200.0, 90.0, height, 15.0)) + noise
        assert len(detect_hotspots(field, least_prominence_K=0.0)) == found, height


def test_the_zone_of_a_peak_is_that_above_half_its_height_to_the_edges_of_its_cells():
    """A Gaussian of 30 mm, smoothed by a cell of 5 mm, falls to half within 35.8 mm: seven cells to either side of that of the peak."""
    (spot,) = detect_hotspots(plane((202.5, 92.5, 3.0, 30.0)))
    assert spot.extent_mm == (165.0, 240.0, 55.0, 130.0)
    assert (spot.centroid_x_mm, spot.centroid_y_mm) == pytest.approx((202.5, 92.5))
    assert spot.x_mm == pytest.approx(202.5) and spot.y_mm == pytest.approx(92.5)


def test_the_vertex_of_an_oblique_paraboloid_is_exact():
    row, column = np.mgrid[:9, :11]
    u, v = column - 5.3, row - 3.6
    values = 4.0 - 0.2 * u**2 - 0.3 * v**2 + 0.15 * u * v
    assert module._vertex(values, values, (4, 5)) == pytest.approx((5.3, 3.6, 4.0))
    # At the border of the plan the fit takes the cells that there are.
    assert module._vertex(values[:6, :7], values[:6, :7], (4, 5)) == pytest.approx((5.3, 3.6, 4.0))
    # A ridge has no vertex: the cell itself.
    ridge = -0.3 * v**2
    assert module._vertex(ridge, ridge, (4, 5))[:2] == (5.0, 4.0)


def test_the_prominence_of_a_peak_counts_from_the_saddle_to_a_higher_one():
    field = np.zeros((3, 9))
    field[1] = [0.0, 2.0, 5.0, 3.0, 4.0, 9.0, 6.0, 8.0, 1.0]
    assert module._saddle(field, (1, 2), 0.0) == 3.0
    assert module._saddle(field, (1, 7), 0.0) == 6.0
    assert module._saddle(field, (1, 5), 0.0) == 0.0
    # Cells that touch at a corner are connected.
    corner = np.array([[7.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 6.0]])
    assert module._saddle(corner, (2, 2), 0.0) == 4.0


def test_a_ripple_below_the_least_prominence_is_no_hotspot_on_a_warm_table():
    assert detect_hotspots(plane((202.5, 92.5, 0.09, 30.0)) + 20.0) == []
    (spot,) = detect_hotspots(plane((202.5, 92.5, 0.12, 30.0)) + 20.0)
    assert spot.prominence_K == pytest.approx(0.12, rel=0.05) and spot.peak_rise_K == pytest.approx(20.12, rel=1e-3)


def test_the_maximum_in_a_corner_of_the_plan_is_found_there():
    slope = plane(slope=0.01)
    (spot,) = detect_hotspots(slope + 0.02 * slope["y"])
    assert (spot.x_mm, spot.y_mm, spot.at_edge) == (697.5, 177.5, True)


def test_the_most_prominent_come_first_and_no_more_than_asked_for():
    field = plane((120.0, 90.0, 1.0, 20.0), (350.0, 90.0, 3.0, 20.0), (580.0, 90.0, 2.0, 20.0))
    assert [round(spot.x_mm) for spot in detect_hotspots(field)] == [350, 580, 120]
    assert [round(spot.x_mm) for spot in detect_hotspots(field, limit=2)] == [350, 580]


@pytest.mark.parametrize(
    ("place", "at_edge"),
    [((2.5, 92.5), True), ((697.5, 92.5), True), ((302.5, 2.5), True), ((302.5, 177.5), True), ((302.5, 92.5), False)],
)
def test_a_zone_that_reaches_any_edge_is_marked(place, at_edge):
    (spot,) = detect_hotspots(plane((*place, 3.0, 20.0)))
    assert spot.at_edge is at_edge
