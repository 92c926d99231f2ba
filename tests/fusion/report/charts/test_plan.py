"""Charts of the table: the frame where it belongs, gaps as gaps, the rise along the axis."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.products.grouped import group
from fusion.report.charts import plan


def test_the_frame_lies_under_its_fiducials(fields: xr.Dataset) -> None:
    chart = plan.plot_registration(fields)
    picture, rings, _ = chart.figure.renderers
    assert (picture.glyph.x, picture.glyph.y, picture.glyph.dh) == (-0.5, -0.5, fields.sizes["row"])
    np.testing.assert_allclose(picture.data_source.data["image"][0], fields["reference_frame"], atol=1 / 64)
    np.testing.assert_array_equal(rings.data_source.data["row"], fields["fiducial_row"])
    assert chart.figure.y_range.start > chart.figure.y_range.end  # rows are counted downwards
    assert f"{fields.sizes['fiducial']} located fiducials" in chart.seen


def test_a_cycle_without_a_field_is_a_gap(fields: xr.Dataset) -> None:
    rise = fields["temperature_rise"].copy(deep=True)
    rise[5] = np.nan
    chart = plan.plot_rise_history(fields.assign(temperature_rise=rise))
    assert np.flatnonzero(np.isnan(chart.columns["mean rise / K"])).tolist() == [5]
    np.testing.assert_allclose(chart.columns["warmest cell / K"][-1], rise[-1].max())


def test_rise_along_the_axis_and_drift_against_it(fused: xr.DataTree, deviations: xr.Dataset) -> None:
    root = fused.to_dataset()
    along = plan.plot_axis_temperature(root)
    rise = root["local_rise"].mean("direction")
    last = along.columns["cycle"] == along.columns["cycle"].max()
    np.testing.assert_allclose(along.columns["rise / K"][last], rise.isel(cycle=-1))
    against = plan.plot_drift_temperature(root, group(deviations, "drift"))
    lines = against.figure.renderers[1].data_source.data
    np.testing.assert_allclose(lines["xs"][3], rise.isel(target=3))
    assert "no proof" in against.seen


def test_cells_lie_where_their_middles_are(plan_of_cells: xr.Dataset) -> None:
    assert plan.extent_of(plan_of_cells) == pytest.approx((0.0, 30.0, 0.0, 20.0))
    drawn = plan.new_plan((0.0, 30.0, 0.0, 20.0))
    assert drawn.match_aspect
    assert (drawn.x_range.start, drawn.x_range.end) == (0.0, 30.0)
