"""The readings of a campaign as one time-ordered series, with what was logged beside them.

A positioning campaign and a record of displacement channels become the same object, so that effects, search and tests are written once:
a *site* is a target approached from one direction, or a channel; every site has its own constant, and the drift that nobody explains
enters each reading with known loadings (common shift and stretch, or one drift per channel).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numba import njit
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.errors import FusionError

#: Names of the air and material quantities that a laser's environment unit logs.
ENVIRONMENT = ("air_temperature", "air_pressure", "relative_humidity", "material_temperature")

#: A stretch without samples counts as a gap from this many usual intervals on.
_GAP_INTERVALS = 5.0


class ReadingsError(FusionError):
    """A campaign that holds too little to be modelled; the message says what is missing."""


@njit(cache=True)
def _first_order(seconds: Array, values: Array, time_constant_s: float, start: Array) -> Array:
    """Response (m, columns) of a first-order system to values (m, columns) that are linear between samples."""
    response = np.empty_like(values)
    response[0] = start
    for k in range(seconds.size - 1):
        step = seconds[k + 1] - seconds[k]
        decay = np.exp(-step / time_constant_s)
        ramp = (values[k + 1] - values[k]) / step * time_constant_s
        response[k + 1] = (response[k] - values[k] + ramp) * decay + values[k + 1] - ramp
    return response


@dataclass(frozen=True)
class Series:
    """A logged quantity on its own times.

    Attributes
    ----------
    seconds : (m,) s since the first reading, increasing
    values : (m,) one value for all sites, or (m, targets) one per target
    units : unit of the values
    """

    seconds: Array
    values: Array
    units: str

    def lagged(self, time_constant_s: float, *, at_rest: float | None = None) -> Series:
        """Response of a first-order system to the series, exact for values that are linear between samples.

        ``at_rest`` is the input before the first sample; by default the first sample itself (steady state).
        """
        if time_constant_s <= 0.0:
            return self
        values = self.values if self.values.ndim == 2 else self.values[:, None]
        start = values[0] if at_rest is None else np.full(values.shape[1], at_rest)
        response = _first_order(self.seconds, np.ascontiguousarray(values), time_constant_s, start)
        return Series(self.seconds, response.reshape(self.values.shape), self.units)


@dataclass(frozen=True)
class Gap:
    """A stretch in which a series has no sample and is taken as a straight line.

    Attributes
    ----------
    series : its name
    start_s, end_s : the samples beside the gap, s since the first reading
    """

    series: str
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Readings:
    """All readings of a positioning campaign, sorted by time.

    Attributes
    ----------
    seconds, response : (n,) time since the first reading in s, deviation in um
    cycle, target : (n,) numbers from 1
    position_mm, sign : (n,) axis position, and +1 or -1 for a positive or negative approach
    positions_mm : (targets,) axis position of each target
    series : what was seen and logged, by name
    drivers : names of the series that were logged as drivers
    left_out : how many readings could not be used, by reason
    """

    seconds: Array
    response: Array
    cycle: NDArray[np.int64]
    target: NDArray[np.int64]
    position_mm: Array
    sign: Array
    targets: NDArray[np.int64]
    positions_mm: Array
    series: Mapping[str, Series]
    drivers: tuple[str, ...]
    left_out: Mapping[str, int]

    @property
    def span_mm(self) -> float:
        """Largest distance from the laser's zero, mm."""
        return float(np.abs(self.positions_mm).max())

    @property
    def share(self) -> Array:
        """Position as a share of the travel, (n,)."""
        return self.position_mm / self.span_mm

    @property
    def site(self) -> NDArray[np.int64]:
        """Number of the site, a target approached from one direction: twice the target's index, plus 1 for a negative approach, (n,)."""
        return self.target_index * 2 + (self.sign < 0)

    @property
    def loadings(self) -> Array:
        """How a common shift and a stretch enter each reading, (n, 2)."""
        return np.column_stack([np.ones_like(self.share), self.share])

    @property
    def target_index(self) -> NDArray[np.int64]:
        """Place of each reading's target in ``targets``, (n,)."""
        return np.searchsorted(self.targets, self.target)

    @property
    def profile(self) -> Array:
        """Columns of the static profile: one constant per target, one reversal per target that both directions reach, (n, k)."""
        one_hot = (self.target_index[:, None] == np.arange(self.targets.size)).astype(float)
        approach = one_hot * (0.5 * self.sign)[:, None]
        both = np.array([np.unique(self.sign[self.target_index == k]).size == 2 for k in range(self.targets.size)])
        return np.column_stack([one_hot, approach[:, both]])

    def at(self, series: Series) -> Array:
        """A series interpolated at every reading's time (and at its target where the series has one value per target), (n,)."""
        if series.values.ndim == 1:
            return np.interp(self.seconds, series.seconds, series.values)
        column = np.empty(self.seconds.size)
        for k in range(self.targets.size):
            here = self.target_index == k
            column[here] = np.interp(self.seconds[here], series.seconds, series.values[:, k])
        return column

    def gaps(self) -> list[Gap]:
        """Stretches without a sample, five times the usual interval and more, in what was logged while readings were taken."""
        found = []
        logged = {*self.drivers, *ENVIRONMENT}
        for name, series in self.series.items():
            if name not in logged:
                continue
            steps = np.diff(series.seconds)
            if steps.size < 3:
                continue
            for k in np.flatnonzero(steps > _GAP_INTERVALS * np.median(steps)):
                start, end = float(series.seconds[k]), float(series.seconds[k + 1])
                if end > self.seconds[0] and start < self.seconds[-1]:
                    found.append(Gap(name, start, end))
        return found

    def subset(self, keep: NDArray[np.bool_]) -> Readings:
        """Only the readings that are kept; series stay whole."""
        return Readings(
            self.seconds[keep],
            self.response[keep],
            self.cycle[keep],
            self.target[keep],
            self.position_mm[keep],
            self.sign[keep],
            self.targets,
            self.positions_mm,
            self.series,
            self.drivers,
            self.left_out,
        )


def sample_noise(samples: Array) -> float:
    """Noise of single samples of a series from their second differences, in which whatever is slow cancels."""
    second = np.diff(samples, 2)
    return float(1.4826 * np.median(np.abs(second - np.median(second))) / np.sqrt(6.0))


def read_fused(fused: xr.Dataset) -> Readings:
    """Lay the fused Dataset out as readings.

    Raises
    ------
    ReadingsError
        if fewer than 3 cycles or 3 targets remain.
    """
    deviation = fused["deviation"].values
    time = fused["time"].values.astype("datetime64[ns]")
    present = np.isfinite(deviation) & ~np.isnat(time)
    inside = fused["inside_frames"].values if "inside_frames" in fused else np.ones_like(present)
    used = present & inside
    at_cycle, at_direction, at_target = np.nonzero(used)
    if np.unique(at_cycle).size < 3 or np.unique(at_target).size < 3:
        raise ReadingsError(
            f"{np.unique(at_cycle).size} cycles and {np.unique(at_target).size} targets have readings within the frames' time; "
            "the model of the drift needs at least 3 of each"
        )
    stamps = time[used]
    order = np.argsort(stamps, kind="stable")
    start = time[present].min()
    sign = np.where(fused["direction"].values[at_direction] == "positive", 1.0, -1.0)
    series = _series(fused, start)
    return Readings(
        seconds=_seconds(stamps, start)[order],
        response=deviation[used][order],
        cycle=fused["cycle"].values[at_cycle][order].astype(np.int64),
        target=fused["target"].values[at_target][order].astype(np.int64),
        position_mm=fused["position"].values[at_target][order].astype(float),
        sign=sign[order],
        targets=fused["target"].values.astype(np.int64),
        positions_mm=fused["position"].values.astype(float),
        series=series,
        drivers=tuple(
            name for name in series if f"{name}_series" in fused and "driver_time" in fused[f"{name}_series"].dims
        ),
        left_out={
            "missing": int((~present).sum()),
            "outside the frames' time": int((present & ~inside).sum()),
        },
    )


def _seconds(time: NDArray[np.datetime64], start: np.datetime64) -> Array:
    return np.asarray((time.astype("datetime64[ns]") - start) / np.timedelta64(1, "s"), float)


def _series(fused: xr.Dataset, start: np.datetime64) -> dict[str, Series]:
    """Every ``<name>_series`` of the fused Dataset on its own time axis, samples without a value left out."""
    series = {}
    for variable in fused.data_vars:
        name = str(variable)
        if not name.endswith("_series"):
            continue
        column = fused[name]
        values = column.values.astype(float)
        known = np.isfinite(values) if values.ndim == 1 else np.isfinite(values).all(axis=1)
        seconds = _seconds(fused[column.dims[0]].values, start)[known]
        series[name.removesuffix("_series")] = Series(seconds, values[known], str(column.attrs.get("units", "1")))
    return series
