"""Region series against fields that can be integrated by hand."""

import numpy as np
import pytest
import xarray as xr

from thermography.fields.regions import common_part, region_series
from thermography.registration.polygon import PolygonError

X, Y = np.arange(140) * 5.0 + 2.5, np.arange(36) * 5.0 + 2.5
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
    series = region_series(noisy, {"square": [(100, 40), (150, 40), (150, 90), (100, 90)]})
    scatter = (
        series["mean"] - region_series(fields, {"square": [(100, 40), (150, 40), (150, 90), (100, 90)]})["mean"]
    ).std()
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
    square = {"square": [(100, 40), (150, 40), (150, 90), (100, 90)]}
    series = region_series(rise, square, common_u=common_part(fields, "temperature_rise"))
    np.testing.assert_allclose(series["mean_u"], np.hypot(0.05, 0.0014), rtol=0.002)
    assert "mean_u" not in region_series(rise, square)


def test_masked_cells_take_no_part():
    fields = stack(lambda x, y: np.where((x > 300) & (x < 320), np.nan, 1.0), grow=0.0)
    series = region_series(fields, {"r": [(280, 50), (340, 50), (340, 100), (280, 100)]})
    np.testing.assert_allclose(series["mean"], 1.0)
    np.testing.assert_allclose(series["n"], (60 - 20) * 50 / 25, rtol=0.01)


@pytest.mark.parametrize(
    ("region", "message"),
    [
        ([(0, 0), (1, 1)], r"r: corners have shape \(2, 2\); a polygon needs at least three"),
        ([(800, 0), (900, 0), (900, 50)], r"r: \(x 800..900, y 0..50 mm\) holds no part of the plan"),
        ([(301, 50), (319, 50), (319, 80), (301, 80)], "r: all its cells are masked or out of view"),
    ],
)
def test_regions_off_the_plan_are_refused(region, message):
    fields = stack(lambda x, y: np.where((x > 300) & (x < 320), np.nan, 1.0))
    with pytest.raises(PolygonError, match=message):
        region_series(fields, {"r": region})
