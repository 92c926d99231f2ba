"""The chart of contact sensors: solid lines, the camera dashed, nothing of a faulty sensor as if it were sound."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.report.charts.sensors import plot_sensors

START = np.datetime64("2026-03-09T08:00", "ns")
HOURS = START + np.arange(4) * np.timedelta64(1, "h")


def sensors() -> xr.Dataset:
    rise = np.array([[0.0, 0.0], [1.0, 2.0], [2.0, 4.0], [3.0, 90.0]])
    return xr.Dataset(
        {
            "rise": (("time", "sensor"), rise),
            "camera_rise": (("camera_time", "sensor"), np.array([[0.0, np.nan], [1.1, np.nan]])),
            "is_faulty": ("sensor", [False, True]),
            "fault_time": ("sensor", np.array(["NaT", HOURS[3]], "datetime64[ns]")),
        },
        {"time": HOURS, "camera_time": HOURS[:2], "sensor": ["t1", "t2"]},
    )


def test_sound_and_faulty_parts_and_the_camera_are_told_apart() -> None:
    chart = plot_sensors(sensors())
    named = [item.label.value for item in chart.figure.legend[0].items]
    assert named == ["t1", "camera at t1", "t2", "t2 after its fault (not used)"]
    assert "0 to 4 K" in chart.seen.replace("0.00", "0").replace("4.00", "4")
    assert set(chart.columns["source"]) == {"contact sensor", "camera"}
