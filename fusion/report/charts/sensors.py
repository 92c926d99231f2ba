"""Contact sensors over time, beside the camera at the same places."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.report.charts.style import CATEGORIES, Chart, add_series, add_zero_line, new_figure, span_words
from fusion.report.wording import join, number


def plot_sensors(sensors: xr.Dataset) -> Chart:
    """Draw the rise of every contact sensor, and that of the camera at its place where there is one.

    Parameters
    ----------
    sensors : Dataset
        Content of sensors.nc.

    Returns
    -------
    Chart
        A faulty sensor is drawn up to its fault, thin beyond it.
    """
    start = sensors["time"].values[0]
    if "camera_time" in sensors:
        start = min(start, sensors["camera_time"].values[0])
    drawn = new_figure(x="time since the first temperature / h", y="rise / K", height=340, legend_columns=5)
    add_zero_line(drawn)
    columns: dict[str, list[np.ndarray]] = {"sensor": [], "source": [], "time / h": [], "rise / K": []}
    said = []
    for k, name in enumerate(sensors["sensor"].values):
        one, colour = sensors.sel(sensor=name), CATEGORIES[k % len(CATEGORIES)]
        hours = _hours(sensors["time"].values, start)
        sound = (
            sensors["time"].values < one["fault_time"].values if bool(one["is_faulty"]) else np.ones(hours.size, bool)
        )
        add_series(drawn, hours[sound], one["rise"].values[sound], name=str(name), colour=colour)
        if not sound.all():
            label = f"{name} after its fault (not used)"
            add_series(
                drawn, hours[~sound], one["rise"].values[~sound], name=label, colour=colour, dash="dotted", width=1.0
            )
        said.append(f"{name} {number(float(one['rise'].values[sound][-1]), 2)} K")
        _add_rows(columns, str(name), "contact sensor", hours, one["rise"].values)
        if "camera_rise" in sensors and bool(one["camera_rise"].notnull().any()):
            at = _hours(sensors["camera_time"].values, start)
            add_series(
                drawn, at, one["camera_rise"].values, name=f"camera at {name}", colour=colour, dash="dashed", width=1.2
            )
            _add_rows(columns, str(name), "camera", at, one["camera_rise"].values)
    every = sensors["rise"].where(sensors["time"] < sensors["fault_time"].fillna(np.datetime64("2262-01-01", "ns")))
    seen = f"Rise of {len(said)} contact sensors: {span_words(every, 'K')}; at the end of its use {join(said)}."
    return Chart(drawn, seen, {name: np.concatenate(parts) for name, parts in columns.items()})


def _hours(times: np.ndarray, start: np.datetime64) -> np.ndarray:
    return np.asarray((times - start) / np.timedelta64(1, "h"), float)


def _add_rows(
    columns: dict[str, list[np.ndarray]], sensor: str, source: str, hours: np.ndarray, rise: np.ndarray
) -> None:
    """Add the values of a line to what the reader can download."""
    columns["sensor"].append(np.full(hours.size, sensor))
    columns["source"].append(np.full(hours.size, source))
    columns["time / h"].append(hours)
    columns["rise / K"].append(rise)
