"""Hotspots against fields whose peaks are known, and means over regions."""

import numpy as np
import pytest
import xarray as xr

from thermography.common import ThermographyError
from thermography.fields import hotspots as module
from thermography.fields.hotspots import common_part, detect_hotspots, region_series
from thermography.registration.plan import PolygonError

pytestmark = pytest.mark.long

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


def test_two_peaks_50_mm_apart_and_a_low_one_are_found(rng):
    noise = rng.normal(0, 0.014, (36, 140))
    spots = detect_hotspots(plane((300.0, 90.0, 2.0, 15.0), (350.0, 90.0, 1.6, 15.0)) + noise)
    assert [spot.x_mm for spot in spots] == pytest.approx([300, 350], abs=2)
    (low,) = detect_hotspots(plane((300.0, 90.0, 0.16, 30.0)) + noise)
    assert low.peak_rise_K == pytest.approx(0.16, abs=3 * low.peak_rise_u_K)


@pytest.mark.parametrize("x0", [685.0, 700.0, 710.0])
def test_a_peak_at_the_edge_is_known_to_the_edge(rng, x0):
    """What lies beyond the edge is not seen: the warmest place is the edge itself."""
    for width in (15.0, 30.0, 60.0):
        (spot,) = detect_hotspots(plane((x0, 90.0, 2.0, width)) + rng.normal(0, 0.03, (36, 140)))
        assert spot.at_edge and abs(spot.x_mm - min(x0, 700.0)) < 3 * spot.x_u_mm


def test_noise_and_flat_fields_hold_no_hotspot(rng):
    flat = plane()
    assert detect_hotspots(flat) == []
    assert detect_hotspots(flat + rng.normal(0, 0.015, flat.shape)) == []
    assert detect_hotspots(flat + np.nan) == []


def test_masked_discs_neither_make_nor_break_hotspots(rng):
    field = plane((300.0, 90.0, 2.0, 40.0)) + rng.normal(0, 0.014, (36, 140))
    field[16:20, 60:64] = np.nan
    field[4:8, 100:104] = np.nan
    (spot,) = detect_hotspots(field)
    assert np.hypot(spot.x_mm - 300, spot.y_mm - 90) < 15


def test_what_is_no_field_is_refused():
    with pytest.raises(ThermographyError, match="dims"):
        detect_hotspots(plane().transpose())


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


def test_prominences_are_exact():
    field = np.zeros((3, 9))
    field[1] = [0.0, 2.0, 5.0, 3.0, 4.0, 9.0, 6.0, 8.0, 1.0]
    expected = np.zeros((3, 9))
    expected[1, [2, 5, 7]] = [5.0 - 3.0, 9.0, 8.0 - 6.0]
    np.testing.assert_array_equal(module._prominences(field, np.argsort(field, axis=None)[::-1]), expected)
    # Cells that touch at a corner are connected.
    corner = np.array([[7.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 6.0]])
    assert module._prominences(corner, np.argsort(corner, axis=None)[::-1])[2, 2] == 2.0


def test_prominence_limits_ranks_and_edges():
    assert detect_hotspots(plane((202.5, 92.5, 0.09, 30.0)) + 20.0) == []
    (spot,) = detect_hotspots(plane((202.5, 92.5, 0.12, 30.0)) + 20.0)
    assert spot.prominence_K == pytest.approx(0.12, rel=0.05) and spot.peak_rise_K == pytest.approx(20.12, rel=1e-3)
    slope = plane(slope=0.01)
    (spot,) = detect_hotspots(slope + 0.02 * slope["y"])
    assert (spot.x_mm, spot.y_mm, spot.at_edge) == (697.5, 177.5, True)
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


def test_a_closed_ring_of_empty_cells_makes_no_hotspot(rng):
    """The border of a named surface is empty; within it the field goes on."""
    field = plane(slope=2.0 / 700.0) + 1.0
    within = (abs(field["x"] - 345) < 55) & (abs(field["y"] - 85) < 45)
    ring = (abs(field["x"] - 345) < 65) & (abs(field["y"] - 85) < 55) & ~within
    whole = detect_hotspots(field)
    assert len(detect_hotspots(field.where(~ring))) == len(whole) == 1
    # A surface of low emissivity is noisier.
    noise_u = xr.where(within, 0.12, 0.02).transpose("y", "x")
    noisy = (field + noise_u * rng.normal(0, 1, field.shape)).where(~ring)
    assert all(spot.x_mm > 600 for spot in detect_hotspots(noisy, noise_u=noise_u))


def test_a_peak_below_no_rise_is_none_and_noise_alone_has_none(rng):
    assert detect_hotspots(plane((300.0, 90.0, 1.0, 20.0)) - 1.5) == []
    # 20 fields whose highest cell stands six standard deviations above the lowest.
    for _ in range(20):
        assert detect_hotspots(plane() + rng.normal(0, 0.2, (36, 140))) == []


@pytest.mark.parametrize("width", [7.0, 20.0])
def test_place_and_rise_are_right_within_their_uncertainty(rng, width):
    """Cells of 5 mm are means over 8 x 8 points; 12 peaks give the root mean square of a normal value to 20 %."""
    over = []
    for _ in range(12):
        x0, y0, height = rng.uniform(200, 500), rng.uniform(60, 120), rng.uniform(1, 3)
        points = [(np.arange(8 * n) + 0.5) * 5.0 / 8 for n in (140, 36)]
        fine = height * np.exp(-((points[0] - x0) ** 2 + (points[1][:, None] - y0) ** 2) / (2 * width**2))
        cells = fine.reshape(36, 8, 140, 8).mean(axis=(1, 3)) + rng.normal(0, 0.014, (36, 140))
        (spot,) = detect_hotspots(plane().copy(data=cells))
        errors = np.array([spot.x_mm - x0, spot.y_mm - y0, spot.peak_rise_K - height])
        over.append(errors / (spot.x_u_mm, spot.y_u_mm, spot.peak_rise_u_K))
    assert 0.3 < np.sqrt(np.mean(np.square(over))) < 1.4
    assert np.abs(over).max() < 4.0


def test_a_peak_under_a_disc_is_said_to_lie_there(rng):
    field = plane((300.0, 90.0, 2.0, 30.0)) + rng.normal(0, 0.014, (36, 140))
    hidden = field.where(np.hypot(field["x"] - 303, field["y"] - 87) > 16)
    (spot,) = detect_hotspots(hidden)
    assert spot.masked and not detect_hotspots(field)[0].masked
    assert abs(spot.x_mm - 300) < 3 * spot.x_u_mm and abs(spot.y_mm - 90) < 3 * spot.y_u_mm
    assert abs(spot.peak_rise_K - 2.0) < 3 * spot.peak_rise_u_K


def test_a_source_is_one_hotspot_over_all_cycles_with_onset_and_end(rng):
    """One warms up and stays, one passes in mid-test, nothing follows it."""
    passing = 1.5 * np.exp(-((np.arange(12) - 5.0) ** 2) / 2.0)
    lasting = 2.0 * (1 - np.exp(-np.arange(12) / 4.0))
    fields = [
        plane((500.0, 90.0, a, 30.0), (160.0, 60.0, b, 20.0)) + rng.normal(0, 0.014, (36, 140))
        for a, b in zip(lasting, passing, strict=True)
    ]
    first, second = detect_hotspots(xr.concat(fields, "cycle"))
    assert (round(first.x_mm / 10), first.cycle, first.onset_cycle, first.end_cycle) == (50, 11, 1, None)
    assert (round(second.x_mm / 10), second.cycle) == (16, 5)
    assert (second.onset_cycle, second.end_cycle) == (3, 7)
    assert second.peak_rise_K == pytest.approx(1.5, abs=4 * second.peak_rise_u_K)


SQUARE = {"square": [(100, 40), (150, 40), (150, 90), (100, 90)]}
TIMES = np.datetime64("2026-03-09T06:00:00", "ns") + np.arange(4) * np.timedelta64(60, "s")


def stack(function=lambda x, y: x + 10 * y, grow=1.0):
    x, y = np.meshgrid(X, Y)
    values = np.stack([function(x, y) + grow * i for i in range(4)])
    attrs = {"units": "K", "units_metadata": "temperature: difference"}
    return xr.DataArray(values, dims=("time", "y", "x"), coords={"time": TIMES, "y": Y, "x": X}, attrs=attrs)


def test_rectangle_and_triangle_of_a_plane_have_the_mean_of_their_centroid():
    square = [(101, 41), (199, 41), (199, 99), (101, 99)]
    triangle = [(200, 30), (500, 30), (200, 150)]
    series = region_series(stack(), {"square": square, "triangle": triangle})
    # Shares are counted by 100 points per cell.
    np.testing.assert_allclose(series["mean"].sel(region="square"), 150 + 10 * 70 + np.arange(4.0), atol=0.3)
    np.testing.assert_allclose(series["mean"].sel(region="triangle"), 300 + 10 * 70 + np.arange(4.0), atol=1.0)
    assert series["n"].sel(region="square").values[0] == pytest.approx(98 * 58 / 25, rel=0.01)
    assert float(series["max"].sel(region="square")[0]) == 197.5 + 10 * 97.5
    assert float(series["min"].sel(region="square")[0]) == 102.5 + 10 * 42.5
    assert series["mean"].attrs["units_metadata"] == "temperature: difference"


def test_stated_uncertainty_of_a_region_mean_is_its_scatter(rng):
    fields = xr.concat([stack(grow=0.0)] * 50, "time")
    noisy = fields + rng.normal(0, 0.014, fields.shape)
    series = region_series(noisy, SQUARE)
    scatter = (series["mean"] - region_series(fields, SQUARE)["mean"]).std()
    # 200 means give their standard deviation to 5 %.
    assert float(scatter) == pytest.approx(0.014 / 10, rel=0.15)
    assert float(series["mean_noise_u"].mean()) == pytest.approx(0.014 / 10, rel=0.05)


def test_what_all_cells_share_does_not_average_out(rng):
    rise = stack(grow=0.0) * 0.0 + 5.0 + rng.normal(0, 0.014, (4, 36, 140))
    fields = xr.Dataset(
        {
            "temperature_rise": rise,
            "temperature_rise_noise_u": rise * 0.0 + 0.014,
            "temperature_rise_u": rise * 0.0 + np.hypot(0.014, 0.05),
        }
    )
    series = region_series(rise, SQUARE, common_u=common_part(fields, "temperature_rise"))
    np.testing.assert_allclose(series["mean_u"], np.hypot(0.05, 0.0014), rtol=0.002)
    assert "mean_u" not in region_series(rise, SQUARE)


def test_masked_cells_take_no_part():
    fields = stack(lambda x, y: np.where((x > 300) & (x < 320), np.nan, 1.0), grow=0.0)
    series = region_series(fields, {"r": [(280, 50), (340, 50), (340, 100), (280, 100)]})
    np.testing.assert_allclose(series["mean"], 1.0)
    np.testing.assert_allclose(series["n"], (60 - 20) * 50 / 25, rtol=0.01)


def test_a_region_of_masked_cells_is_refused():
    fields = stack(lambda x, y: np.where((x > 300) & (x < 320), np.nan, 1.0))
    with pytest.raises(PolygonError, match="r: all its cells are masked or out of view"):
        region_series(fields, {"r": [(301, 50), (319, 50), (319, 80), (301, 80)]})
