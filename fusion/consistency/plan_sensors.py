"""Contact sensors on the table against each other, and against the camera that sees their places."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from fusion._typing import Array
from fusion.alignment.sensor_health import examine_sensors
from fusion.consistency.checks import Check
from fusion.consistency.field_series import field_at

#: Largest difference between camera and sensors in standard uncertainties.
_LIMIT = 3.0
#: Standard uncertainty of the rise under a surface probe beside that of the surface (contact, stem conduction), as a share of it.
_CONTACT = 0.02
_FIGURES = "temperatures, rises, the declared coefficients, and every cause that follows them"


def check_sensors(temperature: xr.DataArray, *, file: str, left_out: Sequence[str] = ()) -> list[Check]:
    """Check that no contact sensor in use jumps, ramps, sticks or falls silent by itself.

    Parameters
    ----------
    temperature : (time, sensor) DataArray, degC
        ``time`` in UTC.
    file : str
        The file, for the message.
    left_out : sequence of str
        Sensors that are not in use, each with what is wrong with it.

    Returns
    -------
    list of Check
        ``plan_sensors`` (docs/method/sensor-health.md).
    """
    times = temperature["time"].values
    seconds = np.asarray((times - times[0]) / np.timedelta64(1, "s"), float)
    clear = [fault for fault in examine_sensors(seconds, temperature.values) if fault.is_clear]
    named = "; ".join(f"{temperature['sensor'].values[fault.sensor]} {fault.words}" for fault in clear)
    return [
        Check(
            "plan_sensors",
            float(len(clear)),
            0.0,
            not clear,
            f"{file}: {named}."
            if clear
            else f"No {'other ' if left_out else ''}contact sensor of {file} jumps, ramps, sticks or falls silent by itself"
            + (f"; left out: {'; '.join(left_out)}." if left_out else "."),
            f"Look at contact and cable, and leave the column out of {file}." if clear else "",
            _FIGURES,
        )
    ]


def compare_sensors(
    fields: xr.Dataset, temperature: xr.DataArray, x_mm: Array, y_mm: Array, *, u_K: float
) -> list[Check]:
    """Check the camera's rise at the places of contact sensors against theirs.

    Parameters
    ----------
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``, on the laser's clock.
    temperature : (time, sensor) DataArray, degC
        ``time`` in UTC.
    x_mm, y_mm : (sensors,) ndarray, mm
        Places on the plan.
    u_K : float, K
        Standard uncertainty of one sensor.

    Returns
    -------
    list of Check
        ``sensors_rise``: the largest difference of the rises over the common time, in standard uncertainties of camera (the cell's),
        sensor and contact; empty where no sensor is seen or no frame lies within the sensors' time.
    """
    compared = []
    for k, name in enumerate(temperature["sensor"].values):
        seen = field_at(fields, (float(x_mm[k]), float(y_mm[k])))
        if seen is None:
            continue
        at = seen.since_start(temperature["time"].values)
        inside = (seen.seconds >= at[0]) & (seen.seconds <= at[-1])
        if inside.sum() < 2:
            continue
        logged = np.interp(seen.seconds[inside], at, temperature.values[:, k])
        camera = seen.temperature[inside, 0]
        # Means over the first and the last tenth: what is compared is the rise, not its noise.
        ends = max(1, int(inside.sum()) // 10)
        rises = [float(values[-ends:].mean() - values[:ends].mean()) for values in (camera, logged)]
        cell = fields["temperature_rise_u"].isel(cycle=-1).sel(x=x_mm[k], y=y_mm[k], method="nearest")
        u = float(np.sqrt(np.nan_to_num(float(cell)) ** 2 + 2.0 * u_K**2 + (_CONTACT * rises[1]) ** 2))
        compared.append((abs(rises[0] - rises[1]) / u, str(name), rises[0], rises[1], u))
    if not compared:
        return []
    worst, sensor, camera_K, sensor_K, u = max(compared)
    passed = worst <= _LIMIT
    return [
        Check(
            "sensors_rise",
            worst,
            _LIMIT,
            passed,
            f"At {sensor} the camera shows a rise of {camera_K:.2f} K, the sensor of {sensor_K:.2f} K; standard uncertainty of the "
            f"difference {u:.2f} K ({len(compared)} sensors compared, this one differs most).",
            ""
            if passed
            else "Check emissivity and reflected_temperature, the places of the sensors and their contact.",
            _FIGURES,
        )
    ]
