"""The table's temperature as series of coarse cells: what logs and drift are held against, quick to compare at many lags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.first_order_lag import respond

#: Side of a coarse cell, mm: finer than heat spreads in the minutes between two frames.
_COARSE_MM = 20.0
#: Frames nearer to each other than this say the same, s.
_LEAST_STEP_S = 60.0
#: Fewest frames from which a course can be told from another one.
_LEAST_FRAMES = 12


@dataclass(frozen=True)
class FieldSeries:
    """Temperature of coarse cells over time.

    Attributes
    ----------
    start : datetime64[ns]
        Time of the first frame.
    seconds : (n,) ndarray, s
        Times since `start`, at least a minute apart.
    temperature : (n, cells) ndarray, degC
        Means over coarse cells that every frame shows whole.
    x_mm, y_mm : (cells,) ndarray, mm
        Centres of the cells.
    """

    start: np.datetime64
    seconds: Array
    temperature: Array
    x_mm: Array
    y_mm: Array

    def since_start(self, times: NDArray[np.datetime64]) -> Array:
        """Return times, (m,) datetime64, as seconds since `start`."""
        return np.asarray((times.astype("datetime64[ns]") - self.start) / np.timedelta64(1, "s"), float)

    def near(self, place_mm: tuple[float, float]) -> FieldSeries:
        """Return one cell: the temperature at a plan point, linear between the cells about it; the nearest cell where none is."""
        away = np.abs([self.x_mm - place_mm[0], self.y_mm - place_mm[1]])
        weight = np.prod(np.maximum(1.0 - away / _COARSE_MM, 0.0), axis=0)
        if not weight.sum() > 0.0:
            weight[np.argmin(np.hypot(*away))] = 1.0
        temperature = self.temperature @ (weight / weight.sum())
        return FieldSeries(
            self.start, self.seconds, temperature[:, None], np.array([place_mm[0]]), np.array([place_mm[1]])
        )

    def lagged(self, time_constant_s: float) -> Array:
        """Return what a sensor of a time constant, s, would show on every cell, (n, cells), degC."""
        return respond(self.temperature, self.seconds, time_constant_s=time_constant_s)


def thin_fields(fields: xr.Dataset) -> FieldSeries | None:
    """Reduce the fields to coarse cells and to frames at least a minute apart.

    Parameters
    ----------
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``, on the laser's clock.

    Returns
    -------
    FieldSeries or None
        None where fewer than 12 frames remain, or no coarse cell is seen whole by all of them.
    """
    time = fields["time"].values.astype("datetime64[ns]")
    seconds = (time - time[0]) / np.timedelta64(1, "s")
    kept = [0]
    for k in range(1, seconds.size):
        if seconds[k] - seconds[kept[-1]] >= _LEAST_STEP_S:
            kept.append(k)
    frames = fields["frame_temperature"].isel(time=kept)
    cell_mm = abs(float(np.median(np.diff(fields["x"].values))))
    count = max(1, round(_COARSE_MM / cell_mm))
    coarse = frames.coarsen(x=count, y=count, boundary="trim").reduce(np.mean)
    values = coarse.values.reshape(len(kept), -1).astype(float)
    seen = np.isfinite(values).all(axis=0)
    if len(kept) < _LEAST_FRAMES or not seen.any():
        return None
    y, x = np.meshgrid(coarse["y"].values, coarse["x"].values, indexing="ij")
    return FieldSeries(time[0], seconds[kept], values[:, seen], x.ravel()[seen], y.ravel()[seen])
