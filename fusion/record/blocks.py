"""A record of sensors and channels, reduced to blocks of time on which its displacements are modelled.

A record holds thousands of samples in which a machine hardly moves. They are averaged over blocks that are short beside any thermal
time constant; drivers are averaged after they are raised to a power, because heat follows a power of the speed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.readings import Readings, Series, sample_noise
from fusion.effects.thermal import SENSOR_PREFIX
from fusion.errors import FusionError

#: Blocks that a record is averaged to at most: more cost time and hold no more of what is slow.
MOST_BLOCKS = 600
#: Blocks below which nothing can be held out.
LEAST_BLOCKS = 40
#: Powers of a driver in the heat it makes: friction of a torque that is constant and of one that grows with the speed.
EXPONENTS = (1, 2)
#: A load cycle starts where a driver leaves its rest; rest is this share of its range above its minimum.
_REST_SHARE = 0.02
#: A driver is switched where it changes by this share of its range from one block to the next.
_SWITCHED = 0.2
#: Most and fewest parts that a record is cut into for forward chaining.
_MOST_CHAINED = 8
_LEAST_CHAINED = 4


class RecordError(FusionError):
    """A record that cannot be modelled; the message says what is missing and what to do."""


@dataclass(frozen=True)
class Record:
    """A record on its blocks.

    Attributes
    ----------
    start : time of the first sample, UTC
    seconds : (blocks,) middle of each block, s since the first sample
    block_s : length of a block, s
    displacement : (blocks, channels) mean, um; NaN where a block holds no sample
    temperature : (blocks, sensors) mean, degC, gaps interpolated
    temperature_noise : (sensors,) standard uncertainty of a block mean from the scatter of the samples, K
    drivers : driver to its powers, exponent to (blocks,) values as a share of the driver's largest size
    channels, sensors : names
    duplicates : sensors left out because they are a linear combination of the others
    chained : (blocks,) number of the chronological block of each row for forward chaining, from 0
    gaps : values that were interpolated, by column
    """

    start: np.datetime64
    seconds: Array
    block_s: float
    displacement: Array
    temperature: Array
    temperature_noise: Array
    drivers: Mapping[str, Mapping[int, Array]]
    channels: tuple[str, ...]
    sensors: tuple[str, ...]
    duplicates: tuple[str, ...]
    chained: NDArray[np.int64]
    gaps: Mapping[str, int]

    @property
    def rise(self) -> Array:
        """Temperatures minus their first block, K (blocks, sensors)."""
        return self.temperature - self.temperature[0]

    def switched(self) -> NDArray[np.bool_]:
        """Blocks within two blocks of a switching of any driver (blocks,): what happens there may be its consequence."""
        near = np.zeros(self.seconds.size, bool)
        for powers in self.drivers.values():
            change = np.abs(np.diff(powers[1], prepend=powers[1][0])) > _SWITCHED * np.ptp(powers[1])
            near |= np.convolve(change, np.ones(5), "same") > 0
        return near

    def view(self) -> Readings:
        """The record as readings of one place, so that effects that only need time, series and drivers work on it."""
        one = np.ones(self.seconds.size)
        series = {"mean_rise": Series(self.seconds, self.rise.mean(axis=1), "K")}
        series |= {
            f"{SENSOR_PREFIX}{name}": Series(self.seconds, self.rise[:, k], "K") for k, name in enumerate(self.sensors)
        }
        series |= {name: Series(self.seconds, powers[1], "1") for name, powers in self.drivers.items()}
        return Readings(
            seconds=self.seconds,
            response=np.nanmean(self.displacement, axis=1),
            cycle=np.arange(1, self.seconds.size + 1),
            target=one.astype(np.int64),
            position_mm=one,
            sign=one,
            targets=np.array([1]),
            positions_mm=np.array([1.0]),
            series=series,
            drivers=tuple(self.drivers),
            left_out={},
        )


@dataclass(frozen=True)
class _Blocks:
    """How samples fall into blocks: place of each sample among the blocks that hold any, middle of each of those, s."""

    source: str
    place: NDArray[np.intp]
    seconds: Array
    length_s: float
    gaps: dict[str, int]

    def mean(self, values: Array) -> Array:
        """Mean over each block, NaN where it holds no value."""
        known = np.isfinite(values)
        total = np.bincount(self.place[known], values[known], minlength=self.seconds.size)
        number = np.bincount(self.place[known], minlength=self.seconds.size)
        return np.where(number > 0, total / np.maximum(number, 1), np.nan)

    def filled(self, name: str, values: Array) -> Array:
        """Mean over each block, gaps interpolated and counted."""
        column = self.mean(values)
        known = np.isfinite(column)
        if known.sum() < 0.5 * known.size:
            raise RecordError(
                f'{self.source}: column "{name}" has values in {known.sum()} of {known.size} blocks of {self.length_s:g} s; leave it '
                "out of [record]"
            )
        if not known.all():
            self.gaps[name] = int((~known).sum())
        return np.asarray(np.interp(self.seconds, self.seconds[known], column[known]))


def reduce_record(table: xr.Dataset) -> Record:
    """Average a record over blocks; blocks without any sample (a pause) are left out.

    Parameters
    ----------
    table : Dataset
        As :func:`fusion.campaign.logged_tables.read_record` returns it.

    Raises
    ------
    RecordError
        if it is too short, or a channel, a sensor or a driver holds too few values.
    """
    time = table["time"].values.astype("datetime64[ns]")
    elapsed = np.asarray((time - time[0]) / np.timedelta64(1, "s"), np.float64)
    blocks = _lay_blocks(str(table.attrs.get("source", "record")), elapsed)
    channels = tuple(str(name) for name in table["channel"].values)
    displacement = np.column_stack([blocks.mean(table["displacement"].values[:, k]) for k in range(len(channels))])
    for k, name in enumerate(channels):
        known = displacement[np.isfinite(displacement[:, k]), k]
        if known.size < LEAST_BLOCKS or np.ptp(known) == 0.0:
            fault = "never moves" if known.size >= LEAST_BLOCKS else "holds too few values"
            raise RecordError(f'{blocks.source}: channel "{name}" {fault}; leave it out of [record]')
    sensors = [str(name) for name in table["sensor"].values]
    samples = table["temperature"].values
    temperature = np.column_stack([blocks.filled(name, samples[:, k]) for k, name in enumerate(sensors)])
    kept = independent(temperature)
    if not kept:
        raise RecordError(f"{blocks.source}: no temperature changes; there is nothing that a displacement could follow")
    per_block = max(1.0, elapsed.size / blocks.seconds.size)
    drivers = _drivers(table, blocks)
    return Record(
        start=time[0],
        seconds=blocks.seconds,
        block_s=blocks.length_s,
        displacement=displacement,
        temperature=temperature[:, kept],
        temperature_noise=np.array([sample_noise(samples[np.isfinite(samples[:, k]), k]) for k in kept])
        / np.sqrt(per_block),
        drivers=drivers,
        channels=channels,
        sensors=tuple(sensors[k] for k in kept),
        duplicates=tuple(name for k, name in enumerate(sensors) if k not in kept),
        chained=chained_blocks(blocks.seconds, [powers[1] for powers in drivers.values()]),
        gaps=blocks.gaps,
    )


def _lay_blocks(source: str, elapsed: Array) -> _Blocks:
    """Cut the time of the samples (s since the first) into blocks of equal length."""
    times = np.unique(elapsed)
    if times.size < LEAST_BLOCKS:
        raise RecordError(
            f"{source}: {times.size} samples are too few to hold a part out; a record needs at least {LEAST_BLOCKS}"
        )
    step = float(np.median(np.diff(times)))
    length = step * max(1, int(np.ceil(times.size / MOST_BLOCKS)))
    # A sample that comes a little early still belongs to its own block.
    number = np.floor((elapsed + 0.5 * step) / length).astype(int)
    numbers, place = np.unique(number, return_inverse=True)
    return _Blocks(source, place, np.asarray((numbers + 0.5) * length - 0.5 * step, np.float64), length, {})


def _drivers(table: xr.Dataset, blocks: _Blocks) -> dict[str, dict[int, Array]]:
    """Powers of every driver as shares of its largest size; one that never changes is left out."""
    drivers: dict[str, dict[int, Array]] = {}
    for k, name in enumerate(str(one) for one in table["driver_name"].values):
        values = table["driver"].values[:, k]
        largest = float(np.nanmax(np.abs(values), initial=0.0))
        if largest == 0.0 or np.nanmin(values) == np.nanmax(values):
            continue
        drivers[name] = {exponent: blocks.filled(name, (values / largest) ** exponent) for exponent in EXPONENTS}
    return drivers


def independent(columns: Array, *, tolerance: float = 1e-8) -> list[int]:
    """Columns of which a part is not a linear combination of those before.

    Parameters
    ----------
    columns : (n, k) in any unit
    tolerance : smallest share of a column's variance that must be independent

    Returns
    -------
    list of int
        Their places, in order.
    """
    kept: list[int] = []
    centred = columns - columns.mean(axis=0)
    basis = np.empty((columns.shape[0], 0))
    for k in range(columns.shape[1]):
        own = float(centred[:, k] @ centred[:, k])
        left = centred[:, k] - basis @ (basis.T @ centred[:, k])
        left -= basis @ (basis.T @ left)
        rest = float(left @ left)
        if own > 0.0 and rest > tolerance * own:
            kept.append(k)
            basis = np.column_stack([basis, left / np.sqrt(rest)])
    return kept


def chained_blocks(seconds: Array, drivers: list[Array]) -> NDArray[np.int64]:
    """Divide a record into parts for forward chaining: load cycles where a driver starts from rest often enough, else equal parts.

    A part begins where a driver leaves its rest, so that a model is always asked to predict a whole load cycle.

    Parameters
    ----------
    seconds : (blocks,) s
    drivers : (blocks,) each

    Returns
    -------
    (blocks,) ndarray of int
        Number of the part of every block, from 0.
    """
    least = (seconds[-1] - seconds[0]) / _MOST_CHAINED
    starts: list[float] = []
    for values in drivers:
        rest = values <= values.min() + _REST_SHARE * np.ptp(values)
        starts += list(seconds[1:][rest[:-1] & ~rest[1:]])
    bounds: list[float] = []
    for start in sorted(starts):
        # The first block may hold what was logged before the first load.
        early = start - seconds[0] < least
        if not early and (not bounds or start - bounds[-1] >= least) and seconds[-1] - start >= 0.5 * least:
            bounds.append(start)
    if len(bounds) + 1 < _LEAST_CHAINED:
        bounds = list(np.linspace(seconds[0], seconds[-1], _MOST_CHAINED + 1)[1:-1])
    # A load that hardly ever rests leaves parts too long to tell anything from their few predictions.
    edges = [float(seconds[0]), *bounds, float(seconds[-1])]
    longest = (seconds[-1] - seconds[0]) / _LEAST_CHAINED
    cuts = [np.linspace(first, last, int(np.ceil((last - first) / longest)) + 1)[1:] for first, last in pairwise(edges)]
    return np.searchsorted(np.concatenate(cuts)[:-1], seconds, side="right").astype(np.int64)
