"""What was recorded when: spans with their gaps, logs in their units."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.report.charts.timeline import plot_timeline, recorded_spans


def test_a_missing_value_is_a_gap_and_uneven_steps_are_not() -> None:
    steady = np.delete(np.arange(20.0), 3)
    assert recorded_spans(steady) == [(0.0, 2.0), (4.0, 19.0)]
    assert recorded_spans(np.array([0.0, 1.1, 2.0, 3.2, np.nan])) == [(0.0, 3.2)]
    assert recorded_spans(np.array([2.0])) == [(2.0, 2.0)]
    assert recorded_spans(np.array([np.nan])) == []


def test_recordings_and_logs_share_the_time_axis(fused: xr.DataTree) -> None:
    root = fused.to_dataset()
    chart = plot_timeline(root)
    assert chart.columns["recording"] == ["readings", "frames", "environment log", "driver log"]
    assert chart.seen.startswith("Recorded over ")
    assert "no gaps" in chart.seen
    bars, *below = chart.figure.children
    assert {drawn.title.text for drawn in below} >= {"air temperature", "air pressure", "duty"}
    assert all(drawn.x_range is bars.x_range for drawn in below)
    (pressure,) = [drawn for drawn in below if drawn.title.text == "air pressure"]
    assert pressure.yaxis.axis_label == "hPa"
    np.testing.assert_array_equal(pressure.renderers[0].data_source.data["y"], root["air_pressure_series"])


def test_a_gap_of_the_frames_is_seen(fused: xr.DataTree) -> None:
    root = fused.to_dataset()
    kept = [at for at in range(root.sizes["frame_time"]) if at not in (8, 9)]
    chart = plot_timeline(root.isel(frame_time=kept))
    assert chart.columns["recording"].count("frames") == 2
    assert "gaps: frames 1" in chart.seen
