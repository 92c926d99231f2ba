"""The readings of a positioning campaign as one time-ordered series, with the series that were logged with them.

A *site* is a target position approached from one direction. Every site has its own constant, and the unexplained drift enters each
reading with known loadings: a common shift, and a stretch proportional to the axis position.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fusion.common import Array, FusionError
from interferometry.common import DEVIATION_ATTRIBUTES, DEVIATIONS
from thermofuse.resources import variables
from thermofuse.units import conform
from thermography.common import scatter_by_median

if TYPE_CHECKING:
    import xarray as xr

#: Names of the air and material quantities that the environment unit of a laser logs.
ENVIRONMENT = ("air_temperature", "air_pressure", "relative_humidity", "material_temperature")

#: A time without samples is a gap from this many median sampling intervals on.
_GAP_INTERVALS = 5.0


class ReadingsError(FusionError):
    """A campaign with too few readings to be modelled; the message says what is missing."""


def check_readings(dataset: xr.Dataset, name: str, source: str, error: type[FusionError]) -> xr.Dataset:
    """Return deviations, or what was aligned with them, in the units of their contracts; refuse what lacks deviation, time or position."""
    needs = {variable: DEVIATIONS[variable][0] for variable in ("deviation", "time", "position")}
    described = DEVIATION_ATTRIBUTES | variables("aligned")[1]
    return conform(dataset, needs, described, name=name, source=source, error=error)


@dataclass(frozen=True)
class Series:
    """A logged quantity on its own times: `seconds` (m,) since the first reading, increasing, s; `values` (m,), or (m, targets) with one
    per target position, in `units`; `first` the numbers of the samples with which runs begin, which have nothing to do with each other.
    """

    seconds: Array
    values: Array
    units: str
    first: tuple[int, ...] = (0,)

    def runs(self) -> list[Series]:
        """Return every run by itself."""
        ends = [*self.first[1:], self.seconds.size]
        return [
            Series(self.seconds[first:end], self.values[first:end], self.units)
            for first, end in zip(self.first, ends, strict=True)
        ]

    def lagged(self, time_constant_s: float, *, at_rest: float | None = None) -> Series:
        """Return the response of a first-order system to the series; see `fusion.analysis.alignment.first_order_lag.respond`."""
        if time_constant_s <= 0.0:
            return self
        if len(self.first) > 1:
            responses = [run.lagged(time_constant_s, at_rest=at_rest).values for run in self.runs()]
            return Series(self.seconds, np.concatenate(responses), self.units, self.first)
        values = self.values if self.values.ndim == 2 else self.values[:, None]
        start = None if at_rest is None else np.full(values.shape[1], at_rest)

        from fusion.analysis.alignment.first_order_lag import respond  # compiled: a campaign file is checked without it

        response = respond(values, self.seconds, time_constant_s=time_constant_s, start=start)
        return Series(self.seconds, response.reshape(self.values.shape), self.units)


@dataclass(frozen=True)
class Gap:
    """A time in which a series has no sample and is interpolated linearly: from one sample to the next, s since the first reading."""

    series: str
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Readings:
    """All readings of a positioning campaign, sorted by time.

    Attributes
    ----------
    seconds : (n,) ndarray, s
        Time since the first reading.
    response : (n,) ndarray, um
        Positioning deviation.
    cycle, target : (n,) ndarray of int
        Numbers of the cycle and of the target position, from 1.
    position_mm : (n,) ndarray, mm
        Axis position.
    sign : (n,) ndarray
        +1 for a positive approach, -1 for a negative one.
    targets : (targets,) ndarray of int
        Numbers of the target positions.
    positions_mm : (targets,) ndarray, mm
        Axis position of each target.
    series : mapping of str to Series
        Reduced fields, environment and drivers, by name.
    drivers : tuple of str
        Names of the series that were logged as drivers.
    left_out : mapping of str to int
        Number of readings that could not be used, by reason.
    places : int or None
        Places along the axis at which contact sensors measured its temperature; None where no such sensors replace the camera.
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
    places: int | None = None

    @property
    def span_mm(self) -> float:
        """Largest distance from the laser's zero, mm."""
        return float(np.abs(self.positions_mm).max())

    @property
    def share(self) -> Array:
        """Axis position over `span_mm`, (n,)."""
        return self.position_mm / self.span_mm

    @property
    def site(self) -> NDArray[np.int64]:
        """Number of the site, a target approached from one direction: twice the target's index, plus 1 for a negative approach, (n,)."""
        return self.target_index * 2 + (self.sign < 0)

    @property
    def loadings(self) -> Array:
        """Loadings of each reading on a common shift and on a stretch that is 1 at `span_mm`, (n, 2)."""
        return np.column_stack([np.ones_like(self.share), self.share])

    @property
    def target_index(self) -> NDArray[np.int64]:
        """Index of each reading's target in `targets`, (n,)."""
        order = np.argsort(self.targets)
        return order[np.searchsorted(self.targets, self.target, sorter=order)]

    @property
    def profile(self) -> Array:
        """Regressors of the static profile, (n, k): a constant per target, and a reversal per target with both approaches."""
        one_hot = (self.target_index[:, None] == np.arange(self.targets.size)).astype(float)
        approach = one_hot * (0.5 * self.sign)[:, None]
        both = np.array([np.unique(self.sign[self.target_index == k]).size == 2 for k in range(self.targets.size)])
        return np.column_stack([one_hot, approach[:, both]])

    def by_site(self, values: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Return the cycles, the sites, and values (n,) by both (cycles, sites), NaN where a reading is missing."""
        (cycles, cycle), (sites, site) = (np.unique(own, return_inverse=True) for own in (self.cycle, self.site))
        matrix = np.full((cycles.size, sites.size), np.nan)
        matrix[cycle, site] = values
        return cycles, sites, matrix

    def at(self, series: Series) -> Array:
        """Return a series at the time of every reading (and at its target, where the series has one value per target)."""
        if series.values.ndim == 1:
            return np.interp(self.seconds, series.seconds, series.values)
        column = np.empty(self.seconds.size)
        for k in range(self.targets.size):
            rows = self.target_index == k
            column[rows] = np.interp(self.seconds[rows], series.seconds, series.values[:, k])
        return column

    def gaps(self) -> list[Gap]:
        """Return the gaps of drivers and environment between the first and the last reading: five median intervals and longer."""
        gaps = []
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
                    gaps.append(Gap(name, start, end))
        return gaps

    def subset(self, keep: NDArray[np.bool_]) -> Readings:
        """Return the readings where `keep`, (n,) bool, is true; series stay complete."""
        per_reading = ("seconds", "response", "cycle", "target", "position_mm", "sign")
        return replace(self, **{name: getattr(self, name)[keep] for name in per_reading}, places=None)


def known_mean(values: Array, axis: int | None = None) -> Array:
    """Mean over the values that are known, NaN where there is none."""
    known = np.isfinite(values)
    number = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.asarray(np.where(number > 0, total / np.maximum(number, 1), np.nan))


def sample_noise(samples: Array) -> float:
    """Estimate the noise of single samples of a slow series from their second differences."""
    return float(scatter_by_median(np.diff(samples, 2)) / np.sqrt(6.0))


def read_fused(fused: xr.Dataset) -> Readings:
    """Return the readings of an aligned campaign."""
    fused = check_readings(fused, "fused", "align", ReadingsError)
    deviation = fused["deviation"].values
    time = fused["time"].values.astype("datetime64[ns]")
    present = np.isfinite(deviation) & ~np.isnat(time)
    inside = fused["inside_frames"].values if "inside_frames" in fused else np.ones_like(present)
    used = present & inside
    cycle, direction, target = np.nonzero(used)
    if np.unique(cycle).size < 3 or np.unique(target).size < 3:
        within = " within the frames' time" if "inside_frames" in fused else ""
        raise ReadingsError(
            f"{np.unique(cycle).size} cycles and {np.unique(target).size} targets have readings{within}; "
            "the model of the drift needs at least 3 of each"
        )
    stamps = time[used]
    order = np.argsort(stamps, kind="stable")
    start = time[present].min()
    sign = np.where(fused["direction"].values[direction] == "positive", 1.0, -1.0)
    series = _series(fused, start)
    return Readings(
        seconds=_seconds(stamps, start)[order],
        response=deviation[used][order],
        cycle=fused["cycle"].values[cycle][order].astype(np.int64),
        target=fused["target"].values[target][order].astype(np.int64),
        position_mm=fused["position"].values[target][order].astype(float),
        sign=sign[order],
        targets=fused["target"].values.astype(np.int64),
        positions_mm=fused["position"].values.astype(float),
        series=series,
        drivers=tuple(
            name for name in series if f"{name}_series" in fused and "driver_time" in fused[f"{name}_series"].dims
        ),
        left_out={"missing": int((~present).sum()), "outside the frames' time": int((present & ~inside).sum())},
        places=int(fused["axis_places"]) if "axis_places" in fused else None,
    )


def _seconds(time: NDArray[np.datetime64], start: np.datetime64) -> Array:
    return np.asarray((time.astype("datetime64[ns]") - start) / np.timedelta64(1, "s"), float)


def _series(fused: xr.Dataset, start: np.datetime64) -> dict[str, Series]:
    """Every ``<name>_series`` of the fused Dataset on its own time axis, without the samples that have no value."""
    series = {}
    for variable in fused.data_vars:
        name = str(variable)
        if not name.endswith("_series"):
            continue
        column = fused[name]
        values = column.values.astype(float)
        finite = np.isfinite(values) if values.ndim == 1 else np.isfinite(values).all(axis=1)
        seconds = _seconds(fused[column.dims[0]].values, start)[finite]
        series[name.removesuffix("_series")] = Series(seconds, values[finite], str(column.attrs.get("units", "1")))
    return series
