"""The thermal map: whole at its rim, one scale that holds all values, compact and exact to the decimals that are shown."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from bokeh.models import Arrow

from fusion.products.results_axis import HotspotPart
from fusion.report.charts import thermal_map
from fusion.report.charts.style import Chart


def decoded(chart: Chart, name: str, shape: tuple[int, int, int]) -> np.ndarray:
    """The maps as the script of the page builds them."""
    source, about = chart.figure.tags
    steps = np.cumsum(source.data[name].reshape(shape[0], -1), axis=0, dtype=np.int16)
    scale = next(one for one in about["scales"] if one["name"] == name)
    return np.where(steps == -32768, np.nan, steps * scale["step"]).reshape(shape)


def test_every_cycle_comes_back_to_the_decimals_that_are_shown(fields: xr.Dataset) -> None:
    chart, found = thermal_map.plot_thermal_map(fields)
    rise = fields["temperature_rise"].values
    np.testing.assert_allclose(decoded(chart, "rise", rise.shape), rise, atol=0.00501)
    u = fields["temperature_rise_u"].values
    np.testing.assert_allclose(decoded(chart, "standard uncertainty of the rise", u.shape), u, atol=0.000501)
    assert found.quantities == [
        "rise", "temperature", "rate", "standard uncertainty of the rise", "frames averaged",
    ]  # fmt: skip
    assert found.cycles == fields["cycle"].values.tolist()
    assert found.note == ""


def test_a_cell_that_is_lost_in_one_cycle_returns(fields: xr.Dataset) -> None:
    holed = fields.copy(deep=True)
    holed["temperature_rise"][4, 2, 3] = np.nan
    rise = holed["temperature_rise"].values
    np.testing.assert_allclose(decoded(thermal_map.plot_thermal_map(holed)[0], "rise", rise.shape), rise, atol=0.00501)


def test_the_scale_holds_every_value_but_a_far_one(fields: xr.Dataset) -> None:
    _, about = thermal_map.plot_thermal_map(fields)[0].figure.tags
    rise = fields["temperature_rise"]
    assert about["scales"][0]["high"] == pytest.approx(float(rise.max()))
    rate = about["scales"][2]
    assert rate["low"] == -rate["high"]
    far = fields.copy(deep=True)
    far["temperature_rise"][3, 0, 0] = 500.0
    _, about = thermal_map.plot_thermal_map(far)[0].figure.tags
    assert about["scales"][0]["high"] < 2 * float(rise.max())


def test_line_and_hotspots_are_drawn_whole(fields: xr.Dataset) -> None:
    edge = float(fields["x"].max())
    spot = HotspotPart(name="hotspot 1", x_mm=edge, y_mm=90.0, peak_rise_K=1.0, targets=(), p_value=None, lag_s=None)
    position = xr.DataArray(np.arange(6)[::-1] * 50.0, dims="target", coords={"target": fields["target"].values})
    chart, _ = thermal_map.plot_thermal_map(fields, [spot], position)
    assert chart.figure.x_range.end > edge + 10
    line = chart.figure.renderers[1].data_source.data["x"]
    np.testing.assert_array_equal(line, fields["target_x"].values[::-1])
    (arrow,) = chart.figure.select(Arrow)
    assert np.sign(arrow.x_end - arrow.x_start) == np.sign(line[-1] - line[-2])
    assert "1 hotspots are ringed" not in chart.seen and "1 hotspot is ringed" in chart.seen
    assert f"in cycle {int(fields['cycle'][-1])} the rise is" in chart.seen


def test_a_long_recording_is_thinned_and_says_so(fields: xr.Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = fields.drop_dims(["time"])
    long = xr.concat([maps, maps.assign_coords(cycle=maps["cycle"] + 24)], "cycle", data_vars="minimal")
    cells = fields.sizes["x"] * fields.sizes["y"]
    monkeypatch.setattr(thermal_map, "_MAP_BUDGET", 5 * cells * 26)
    _, found = thermal_map.plot_thermal_map(long)
    assert found.note == "The map shows 25 of 48 cycles; fields.nc holds all."
    assert found.cycles == [*range(1, 48, 2), 48]
    monkeypatch.setattr(thermal_map, "_MAP_BUDGET", 5 * cells * 20)
    assert thermal_map.plot_thermal_map(long)[1].note.startswith("The map shows means of 2 × 2 cells")


def test_a_recording_without_readings_has_a_map_without_a_line(fields: xr.Dataset) -> None:
    alone = fields.drop_vars(["target", "target_x", "target_y"])
    chart, found = thermal_map.plot_thermal_map(alone)
    assert found.quantities and not chart.figure.select(type=Arrow)
