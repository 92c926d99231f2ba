"""The rise of the table along the measured line from contact sensors, where no camera saw it.

Between two sensors the rise is a straight line along the axis, beyond the outermost ones it is theirs. How well that holds is asked of the
sensors themselves: each is predicted from the others.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion._typing import Array
from fusion.alignment.align import AlignmentError, AxisGeometry

#: Share of the travel that the sensors span at least.
_LEAST_SPAN = 0.5


def add_sensor_line(
    fused: xr.Dataset, temperature: xr.DataArray, x_mm: Array, y_mm: Array, axis: AxisGeometry, *, file: str
) -> xr.Dataset:
    """Give readings the mean rise of contact sensors and its integral along the measured line.

    Parameters
    ----------
    fused : Dataset
        As from `fusion.alignment.align.align_logs`.
    temperature : (time, sensor) DataArray, degC
        Without gaps; ``time`` on the laser's clock.
    x_mm, y_mm : (sensors,) ndarray, mm
        Places of the sensors on the plan; only their place along the axis counts.
    axis : AxisGeometry
        Where the measured line lies on the plan.
    file : str
        File of the temperatures, for the message.

    Returns
    -------
    Dataset
        With ``mean_rise_series`` (K) and ``axis_integral_series`` (K mm) along ``sensor_time``; ``interpolation_u`` (K), by which a sensor
        is missed by the line through the others, and ``axis_scale_u`` (1), the same as a share of the rise; ``axis_places`` (1), the
        different places along the axis.

    Raises
    ------
    AlignmentError
        If fewer than two places along the axis are known, they span less than half of the travel, or no reading lies within their time.

    Notes
    -----
    The distance of the neighbours is twice as large where a sensor is left out, so that ``interpolation_u`` is on the safe side between
    the sensors; it says nothing of a warm spot that lies between all of them.
    """
    step = np.asarray(axis.direction, float) / np.hypot(*axis.direction)
    along = (x_mm - axis.origin_mm[0]) * step[0] + (y_mm - axis.origin_mm[1]) * step[1]
    rise = temperature.values - temperature.values[0]
    places, group = np.unique(np.round(along, 1), return_inverse=True)
    rise = np.stack([rise[:, group == k].mean(axis=1) for k in range(places.size)], axis=1)
    position = fused["position"].values.astype(float)
    low, high = min(0.0, float(position.min())), max(0.0, float(position.max()))
    spanned = max(min(high, places[-1]) - max(low, places[0]), 0.0) / (high - low)
    if places.size < 2 or spanned < _LEAST_SPAN:
        raise AlignmentError(
            f"{file}: {places.size} places along the axis span {spanned:.0%} of the travel; the expansion of the axis needs at least two "
            f"over {_LEAST_SPAN:.0%} of it: add sensors, or give their temperatures as [drivers]"
        )
    times = temperature["time"].values.astype("datetime64[ns]")
    readings = fused["time"].values
    if times.size < 2 or times[-1] < np.nanmin(readings) or times[0] > np.nanmax(readings):
        raise AlignmentError(
            f"{file}: the sensors were logged at another time than the readings; check its date and zone"
        )
    samples = np.unique(np.concatenate([np.linspace(low, high, 200), position, places, [0.0]]))
    line = np.stack([np.interp(samples, places, row) for row in rise])
    integral = np.concatenate(
        [np.zeros((len(line), 1)), np.cumsum(0.5 * (line[:, 1:] + line[:, :-1]) * np.diff(samples), axis=1)], axis=1
    )
    integral -= integral[:, [int(np.argmin(np.abs(samples)))]]
    at_targets = integral[:, np.searchsorted(samples, position)]
    missed = _missed_K(places, rise)
    return fused.assign(
        mean_rise_series=(
            "sensor_time",
            rise.mean(axis=1),
            {"units": "K", "units_metadata": "temperature: difference"},
        ),
        axis_integral_series=(("sensor_time", "target"), at_targets, {"units": "K mm"}),
        interpolation_u=((), missed, {"units": "K"}),
        axis_places=((), int(places.size), {"units": "1"}),
        axis_scale_u=((), missed / max(float(np.sqrt((rise**2).mean())), 1e-12), {"units": "1"}),
    ).assign_coords(sensor_time=times)


def _missed_K(places: Array, rise: Array) -> float:
    """Root mean square by which every sensor is missed by the line through the others, K."""
    errors = []
    for k in range(places.size):
        others = np.arange(places.size) != k
        errors.append(rise[:, k] - [np.interp(places[k], places[others], row[others]) for row in rise])
    return float(np.sqrt(np.mean(np.square(errors))))
