"""Contact sensors as a product of their own: their rises, their places, and the camera's rise at these places."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from fusion._typing import Array
from fusion.alignment.sensor_health import SensorFault
from thermography.fields.tasks.pieces import piece_slices

_KELVIN = {"units": "K", "units_metadata": "temperature: difference"}
_MM = {"units": "mm"}


def join_sensors(
    logged: xr.DataArray, x_mm: Array, y_mm: Array, faults: Sequence[SensorFault], fields: xr.Dataset | None
) -> xr.Dataset:
    """Return the contact sensors as sensors.nc holds them.

    Parameters
    ----------
    logged : (time, sensor) DataArray, degC
        As logged, faulty sensors too; NaN where a sensor gave nothing.
    x_mm, y_mm : (sensors,) ndarray, mm
        Places on the plan.
    faults : sequence of SensorFault
        What is clearly wrong with a sensor.
    fields : Dataset or None
        Fields on the laser's clock; None without a camera.

    Returns
    -------
    Dataset
        ``temperature`` (degC) and ``rise`` (K) over time and sensor; place, ``is_faulty``, ``fault`` and ``fault_time`` by sensor; with
        fields also ``camera_rise`` (K) over ``camera_time`` and sensor, since the first sample of both.
    """
    names = [str(name) for name in logged["sensor"].values]
    wrong = {fault.sensor: fault for fault in faults}
    times = logged["time"].values
    onset = {k: times[0] + np.timedelta64(round(1e9 * fault.onset_s), "ns") for k, fault in wrong.items()}
    fault_time = np.array([onset.get(k, np.datetime64("NaT")) for k in range(len(names))], "datetime64[ns]")
    # Both rises start where both are recorded.
    start = times[0] if fields is None else max(times[0], fields["time"].values[0])
    joined = xr.Dataset(
        {
            "temperature": logged.assign_attrs(units="degC", units_metadata="temperature: on_scale"),
            "rise": (logged - _first_since(logged, "time", start)).assign_attrs(_KELVIN),
            "x": ("sensor", x_mm, _MM),
            "y": ("sensor", y_mm, _MM),
            "is_faulty": ("sensor", [k in wrong for k in range(len(names))]),
            "fault": ("sensor", [wrong[k].words if k in wrong else "" for k in range(len(names))]),
            "fault_time": ("sensor", fault_time),
        }
    )
    if fields is None:
        return joined
    places = {axis: xr.DataArray(at, dims="sensor") for axis, at in (("x", x_mm), ("y", y_mm))}
    frames = fields["frame_temperature"]
    parts = [frames[some].load().sel(places, method="nearest") for some in piece_slices(frames.shape)]
    seen = xr.concat(parts, "time").drop_vars(["x", "y"])
    seen = seen.rename(time="camera_time").transpose("camera_time", "sensor").astype(float)
    return joined.assign(camera_rise=(seen - _first_since(seen, "camera_time", start)).assign_attrs(_KELVIN))


def _first_since(temperature: xr.DataArray, dim: str, start: np.datetime64) -> xr.DataArray:
    """First temperature of every sensor from a time on, (sensor,) degC; NaN where there is none."""
    later = temperature.isel({dim: temperature[dim].values >= start})
    values = later.transpose(dim, "sensor").values
    first = np.full(values.shape[1], np.nan)
    for k in range(values.shape[1]):
        known = np.flatnonzero(np.isfinite(values[:, k]))
        if known.size:
            first[k] = values[known[0], k]
    return xr.DataArray(first, dims="sensor")


def describe_sensors(joined: xr.Dataset, *, file: str) -> list[dict[str, Any]]:
    """Return the part ``sensors`` of results.json.

    Parameters
    ----------
    joined : Dataset
        Content of sensors.nc.
    file : str
        Their file, as the campaign names it.
    """
    parts = []
    for name in joined["sensor"].values:
        one = joined.sel(sensor=name)
        faulty = bool(one["is_faulty"])
        used = joined["time"].values < one["fault_time"].values if faulty else np.ones(joined.sizes["time"], bool)
        last = np.flatnonzero(used & np.isfinite(one["rise"].values))
        camera = one["camera_rise"].dropna("camera_time").values if "camera_rise" in one else np.empty(0)
        parts.append(
            {
                "name": str(name),
                "file": file,
                "x_mm": float(one["x"]),
                "y_mm": float(one["y"]),
                "rise_K": float(one["rise"].values[last[-1]]) if last.size else None,
                "camera_rise_K": float(camera[-1]) if camera.size else None,
                "used": not faulty,
                "fault": str(one["fault"].values),
                "fault_time": f"{np.datetime_as_string(one['fault_time'].values, unit='s')}Z" if faulty else None,
            }
        )
    return parts
