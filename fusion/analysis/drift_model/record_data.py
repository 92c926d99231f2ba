"""A record of sensors and channels, reduced to blocks of time on which its displacements are modelled.

A record holds thousands of samples in which a machine hardly moves. They are averaged over blocks that are short beside any thermal
time constant; drivers are averaged after they are raised to a power, because heat follows a power of the speed.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import Readings, Series, known_mean, sample_noise
from fusion.analysis.effects.thermal import SENSOR_PREFIX
from fusion.common import Array, FusionError
from interferometry.deviations import resolution

#: Blocks that a record is averaged to at most: more cost time and hold no more of what is slow.
MOST_BLOCKS = 600
#: Times as many blocks as that may be filled in part: a pause cuts blocks in two.
_CUT = 1.1
#: Blocks below which nothing can be held out.
LEAST_BLOCKS = 40
#: Blocks below which a run of several shows nothing.
LEAST_RUN_BLOCKS = 10
#: Powers of a driver in the heat it makes: friction of a torque that is constant and of one that grows with the speed.
EXPONENTS = (1, 2)
#: A load cycle starts where a driver leaves its rest; rest is this share of its range above its minimum.
_REST_SHARE = 0.02
#: A driver is switched where it changes by this share of its range from one block to the next.
_SWITCHED = 0.2
#: Coordinate that names the columns, smallest and largest value of every variable: absolute zero and 3000 degC, a position of 100 m,
#: and for a driver, whose unit is free, a tenth of the largest single-precision number, which loggers write for no value.
_POSSIBLE = {
    "temperature": ("sensor", -273.15, 3000.0),
    "displacement": ("channel", -1e8, 1e8),
    "driver": ("driver_name", -3e37, 3e37),
}
#: Share of its largest size by which a constant may differ from its mean.
_ROUNDING = 1e-12
#: Share of its squared length that a column must keep beside those before it.
_DEPENDENT = 1e-8
#: Noise of single samples, in steps of their digits, from which on rounding acts as noise that a mean reduces.
_DITHER = 0.5
#: Blocks on either side of a switching that are near it.
_NEAR_SWITCHING = 2
#: Most and fewest parts that a record is cut into for forward chaining.
_MOST_CHAINED = 8
_LEAST_CHAINED = 4


class RecordError(FusionError):
    """A record that cannot be modelled; the message says what is missing and what to do."""


@dataclass(frozen=True)
class RecordedRun:
    """One run of a record, named as its table: its first sample in UTC and on the record's own axis, s, and whether it is held out."""

    name: str
    start: np.datetime64
    first_s: float
    held_out: bool


@dataclass(frozen=True)
class Samples:
    """Raw samples of a record on its axis of time, s: displacements, um, NaN where there is none; sensors and drivers by their names, degC
    and share of the driver's largest size; and the block and the run that holds each.
    """

    seconds: Array
    block: NDArray[np.intp]
    run: NDArray[np.intp]
    displacement: Array
    moved: Array
    names: tuple[str, ...]


@dataclass(frozen=True)
class Record:
    """A record on its blocks. Runs follow each other on one axis of time, with a border of one block between them.

    Attributes
    ----------
    start : time of the first sample, UTC
    seconds : (blocks,) middle of each block, s since the first sample, time between runs left out
    block_s : length of a block, s
    displacement : (blocks, channels) mean, um, of several runs minus that of each run's first block; NaN where a block holds no sample
    temperature : (blocks, sensors) mean, degC, gaps interpolated
    temperature_noise : (sensors,) standard uncertainty of a block mean from the scatter of the samples, K
    digits : column to the step in which it was recorded, um or K; 0 where none shows
    displacement_step, temperature_step : (channels,) um and (sensors,) K, the steps of readings that would round as much as a block mean is
    drivers : driver to its powers, exponent to (blocks,) values as a share of the driver's largest size
    channels, sensors : names
    duplicates : sensors left out because they are a linear combination of the others
    chained : (blocks,) number of the chronological block of each row for forward chaining, from 0
    gaps : values that were interpolated, by column
    impossible : samples beyond what can be measured, which count as missing, by column
    unusable : channels that cannot be modelled and are left out, with the reason
    runs : of a record of several runs; empty where there is one
    first : number of the first block of every run
    driver_sizes : driver to its largest size and the unit of that
    constant_drivers : loads that are left out because they never change, as "name (value unit)"
    samples : the raw samples; None of a record that is given as blocks
    """

    start: np.datetime64
    seconds: Array
    block_s: float
    displacement: Array
    temperature: Array
    temperature_noise: Array
    displacement_step: Array
    temperature_step: Array
    drivers: Mapping[str, Mapping[int, Array]]
    channels: tuple[str, ...]
    sensors: tuple[str, ...]
    chained: NDArray[np.int64]
    digits: Mapping[str, float] = field(default_factory=dict)
    duplicates: tuple[str, ...] = ()
    gaps: Mapping[str, int] = field(default_factory=dict)
    impossible: Mapping[str, int] = field(default_factory=dict)
    unusable: Mapping[str, str] = field(default_factory=dict)
    runs: tuple[RecordedRun, ...] = ()
    first: tuple[int, ...] = (0,)
    driver_sizes: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    constant_drivers: tuple[str, ...] = ()
    samples: Samples | None = None

    @property
    def readings(self) -> Samples:
        """The raw samples, or the blocks where no others are known."""
        if self.samples is not None:
            return self.samples
        moved = np.column_stack([self.temperature, *(powers[1] for powers in self.drivers.values())])
        block = np.arange(self.seconds.size)
        return Samples(self.seconds, block, self.run, self.displacement, moved, (*self.sensors, *self.drivers))

    @property
    def rise(self) -> Array:
        """Temperatures minus those of the run's first block, K (blocks, sensors)."""
        zero = self.temperature[np.asarray(self.first)[self.run]] if self.runs else self.temperature[0]
        return self.temperature - zero

    @property
    def run(self) -> NDArray[np.int64]:
        """Number of each block's run, from 0 (blocks,)."""
        return np.searchsorted(self.first, np.arange(self.seconds.size), side="right") - 1

    @property
    def time(self) -> NDArray[np.datetime64]:
        """Time of the middle of each block, UTC (blocks,)."""
        elapsed = np.round(self.seconds * 1e9).astype("m8[ns]")
        if not self.runs:
            return np.asarray(self.start + elapsed)
        zero = np.array([one.start - np.round(one.first_s * 1e9).astype("m8[ns]") for one in self.runs])
        return np.asarray(zero[self.run] + elapsed)

    def series(self, values: Array, units: str) -> Series:
        """Values on the blocks as a series that restarts with every run."""
        return Series(self.seconds, values, units, self.first)

    def switched(self) -> NDArray[np.bool_]:
        """Blocks within two blocks of a switching of any driver (blocks,): what happens there may be its consequence."""
        near = np.zeros(self.seconds.size, bool)
        for powers in self.drivers.values():
            change = np.abs(np.diff(powers[1], prepend=powers[1][0])) > _SWITCHED * np.ptp(powers[1])
            change[list(self.first)] = False
            switched = np.flatnonzero(change)
            for beside in range(-_NEAR_SWITCHING, _NEAR_SWITCHING + 1):
                here = np.clip(switched + beside, 0, near.size - 1)
                near[here[self.run[here] == self.run[switched]]] = True
        return near

    def view(self) -> Readings:
        """The record as readings of one place, so that effects that only need time, series and drivers work on it."""
        one = np.ones(self.seconds.size)
        rise = self.rise
        series = {"mean_rise": self.series(rise.mean(axis=1), "K")}
        series |= {f"{SENSOR_PREFIX}{name}": self.series(rise[:, k], "K") for k, name in enumerate(self.sensors)}
        series |= {name: self.series(powers[1], "1") for name, powers in self.drivers.items()}
        return Readings(
            seconds=self.seconds,
            response=known_mean(self.displacement, axis=1),
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
    """How samples fall into blocks: place of each sample among the blocks that hold any, middle of each of those, s; first one, and time
    of the first sample, of each run.
    """

    source: str
    place: NDArray[np.intp]
    seconds: Array
    length_s: float
    zero_s: tuple[float, ...]
    first: tuple[int, ...]
    names: tuple[str, ...]
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
        filled = []
        # Nothing is taken from another run.
        for run, rows in zip(self.names, self.rows(), strict=True):
            seconds, values = self.seconds[rows], column[rows]
            known = np.isfinite(values)
            if not known.any():
                raise RecordError(
                    f'{run}: column "{name}" has no value in this run; leave the column or the run out of [record]'
                )
            filled.append(np.interp(seconds, seconds[known], values[known]))
        return np.concatenate(filled)

    def samples(self, table: xr.Dataset, elapsed: Array, kept: Mapping[str, Sequence[str]]) -> Samples:
        """The samples of a table at times since its first, s, with the columns that are kept by variable."""
        run = np.searchsorted(self.first, self.place, side="right") - 1
        zero = np.array([elapsed[run == k].min() for k in range(len(self.first))])
        values = {
            name: table[name].sel({_POSSIBLE[name][0]: list(columns)}).values.astype(float)
            for name, columns in kept.items()
        }
        loads = values["driver"] / np.maximum(np.nanmax(np.abs(values["driver"]), axis=0, initial=0.0), 1e-300)
        return Samples(
            elapsed - zero[run] + np.array(self.zero_s)[run],
            self.place,
            run,
            values["displacement"],
            np.column_stack([values["temperature"], loads]),
            (*kept["temperature"], *kept["driver"]),
        )

    def rows(self) -> list[slice]:
        """Blocks of every run."""
        return [slice(first, last) for first, last in pairwise([*self.first, self.seconds.size])]

    def zeroed(self, values: Array) -> Array:
        """Block means of a channel; of several runs each minus its own first one, its zero."""
        mean = self.mean(values)
        if len(self.first) > 1:
            for rows in self.rows():
                mean[rows] -= mean[rows][np.argmax(np.isfinite(mean[rows]))]
        return mean

    def fault_of(self, mean: Array, chained: NDArray[np.int64]) -> str:
        """Why a channel of these block means cannot be modelled; empty where it can."""
        known = np.isfinite(mean)
        empty = [name for name, rows in zip(self.names, self.rows(), strict=True) if not known[rows].any()]
        if known.sum() < LEAST_BLOCKS:
            return "holds too few values"
        if np.ptp(mean[known]) == 0.0:
            return "never moves"
        if empty:
            return f"has no value in {empty[0]}"
        # The first prediction is made from the first two parts.
        return "" if known[chained < 2].mean() >= 0.5 else "has too few values at the beginning"


def reduce_record(table: xr.Dataset, *, constants: Collection[str] = ()) -> Record:
    """Average a record over blocks; blocks without any sample (a pause) are left out.

    Parameters
    ----------
    table : Dataset
        What `read_record` returns: temperatures in degC, displacements in um and drivers over time.
    constants : collection of str
        Drivers that are kept though they never change, as a model reads them.

    Returns
    -------
    Record
        Means over blocks of equal length, displacements and rises counted from the first block of each run.

    Raises
    ------
    RecordError
        If no displacement or no temperature can be modelled.

    Notes
    -----
    Blocks, digits and runs: docs/method/records.md.
    """
    time = table["time"].values.astype("datetime64[ns]")
    elapsed = np.asarray((time - time[0]) / np.timedelta64(1, "s"), np.float64)
    table, impossible = _without_impossible(table)
    blocks = _lay_blocks(table, elapsed)
    drivers, driver_sizes, constant_drivers = _drivers(table, blocks, constants)
    chained = _chained_runs(blocks, [powers[1] for powers in drivers.values()])
    moved = dict(zip(map(str, table["channel"].values), table["displacement"].values.T, strict=True))
    means = {name: blocks.zeroed(values) for name, values in moved.items()}
    faults = {name: blocks.fault_of(mean, chained) for name, mean in means.items()}
    channels = tuple(name for name in means if not faults[name])
    if not channels:
        told = "; ".join(f'channel "{name}" {fault}' for name, fault in faults.items())
        raise RecordError(f"{blocks.source}: {told}; leave it out of [record]")
    sensors = [str(name) for name in table["sensor"].values]
    samples = table["temperature"].values
    temperature = np.column_stack([blocks.filled(name, samples[:, k]) for k, name in enumerate(sensors)])
    kept = independent(temperature)
    if not kept:
        raise RecordError(
            f"{blocks.source}: no temperature changes; nothing that a displacement could follow; add sensors that warm"
        )
    per_block = max(1.0, elapsed.size / blocks.seconds.size)
    measured = {**dict(zip(sensors, samples.T, strict=True)), **moved}
    digits = {name: resolution(values) for name, values in measured.items()}

    def step(name: str) -> float:
        dithers = sample_noise(measured[name][np.isfinite(measured[name])]) >= _DITHER * digits[name]
        return digits[name] / np.sqrt(per_block) if dithers else digits[name]

    return Record(
        start=time[0],
        seconds=blocks.seconds,
        block_s=blocks.length_s,
        displacement=np.column_stack([means[name] for name in channels]),
        temperature=temperature[:, kept],
        temperature_noise=np.array([sample_noise(samples[np.isfinite(samples[:, k]), k]) for k in kept])
        / np.sqrt(per_block),
        digits=digits,
        displacement_step=np.array([step(name) for name in channels]),
        temperature_step=np.array([step(sensors[k]) for k in kept]),
        drivers=drivers,
        channels=channels,
        sensors=tuple(sensors[k] for k in kept),
        duplicates=tuple(name for k, name in enumerate(sensors) if k not in kept),
        chained=chained,
        gaps=blocks.gaps,
        impossible=impossible,
        unusable={name: fault for name, fault in faults.items() if fault},
        runs=_runs(table, blocks),
        first=blocks.first,
        driver_sizes=driver_sizes,
        constant_drivers=constant_drivers,
        samples=blocks.samples(
            table,
            elapsed,
            {"displacement": channels, "temperature": [sensors[k] for k in kept], "driver": list(drivers)},
        ),
    )


def _runs(table: xr.Dataset, blocks: _Blocks) -> tuple[RecordedRun, ...]:
    """The runs of a table of several; none of one."""
    if "runs" not in table.attrs:
        return ()
    test = json.loads(table.attrs["test"])
    time, run = table["time"].values.astype("datetime64[ns]"), table["run"].values
    return tuple(
        RecordedRun(name, time[run == k][0], zero_s, k in test)
        for k, (name, zero_s) in enumerate(zip(blocks.names, blocks.zero_s, strict=True))
    )


def _chained_runs(blocks: _Blocks, drivers: list[Array]) -> NDArray[np.int64]:
    """Parts for forward chaining, numbered through all runs; none holds blocks of two."""
    parts: list[NDArray[np.int64]] = []
    for rows in blocks.rows():
        start = int(parts[-1][-1]) + 1 if parts else 0
        parts.append(start + chained_blocks(blocks.seconds[rows], [values[rows] for values in drivers]))
    return np.concatenate(parts)


def _without_impossible(table: xr.Dataset) -> tuple[xr.Dataset, dict[str, int]]:
    """The record without samples beyond what can be measured, which loggers write for no value, and their number by column."""
    counts: dict[str, int] = {}
    kept = {}
    for variable, (names, low, high) in _POSSIBLE.items():
        values = table[variable]
        wrong = np.asarray((values < low) | (values > high))
        counts |= {str(name): int(n) for name, n in zip(values[names].values, wrong.sum(axis=0), strict=True) if n}
        kept[variable] = values.where(~wrong) if wrong.any() else values
    return table.assign(kept), counts


def _lay_blocks(table: xr.Dataset, elapsed: Array) -> _Blocks:
    """Cut the time of the samples (s since the first) into blocks of equal length, every run from its own first sample on."""
    source = str(table.attrs.get("source", "record"))
    names = tuple(json.loads(table.attrs["runs"])) if "runs" in table.attrs else (source,)
    run = table["run"].values if "runs" in table.attrs else np.zeros(elapsed.size, int)
    times = [elapsed[run == k] for k in range(len(names))]
    # Samples of one time, as after a clock that went back, count once.
    distinct = [np.unique(one) for one in times]
    samples = sum(one.size for one in distinct)
    if samples < LEAST_BLOCKS:
        raise RecordError(
            f"{source}: {samples} samples are too few to hold a part out; a record needs at least {LEAST_BLOCKS}"
        )
    step = float(np.median(np.concatenate([np.diff(one) for one in distinct])))

    def blocks_of(run_times: Array, length: float) -> NDArray[np.int64]:
        # A sample that comes a little early still belongs to its own block.
        return np.floor((run_times - run_times[0] + 0.5 * step) / length).astype(np.int64)

    # As many samples as share out evenly; more of a log whose samples come in bursts, each of which would fill blocks of its own.
    together = max(1, int(np.ceil(samples / MOST_BLOCKS)))
    while (filled := sum(np.unique(blocks_of(one, together * step)).size for one in times)) > _CUT * MOST_BLOCKS:
        together = int(np.ceil(together * filled / MOST_BLOCKS))
    length = together * step
    places, seconds, first, zeros, start = [], [], [0], [], 0.0
    for k in range(len(names)):
        numbers, place = np.unique(blocks_of(elapsed[run == k], length), return_inverse=True)
        if len(times) > 1 and numbers.size < LEAST_RUN_BLOCKS:
            raise RecordError(
                f"{names[k]}: the run fills {numbers.size} blocks of {length:g} s, fewer than {LEAST_RUN_BLOCKS}; leave it out of "
                "record.files"
            )
        places.append(place + first[-1])
        seconds.append(start + (numbers + 0.5) * length - 0.5 * step)
        first.append(first[-1] + numbers.size)
        zeros.append(start)
        # A border of one block lies between two runs.
        start += (float(numbers[-1]) + 2.0) * length
    return _Blocks(
        source, np.concatenate(places), np.concatenate(seconds), length, tuple(zeros), tuple(first[:-1]), names, {}
    )


def _drivers(
    table: xr.Dataset, blocks: _Blocks, kept: Collection[str]
) -> tuple[dict[str, dict[int, Array]], dict[str, tuple[float, str]], tuple[str, ...]]:
    """Powers of every driver as shares of its largest size, that size with its unit ("1" where the table states none), and loads that
    are left out because they never change.
    """
    units = table["driver_units"].values if "driver_units" in table else ["1"] * table.sizes["driver_name"]
    drivers, sizes, constant = {}, {}, []
    for k, name in enumerate(str(one) for one in table["driver_name"].values):
        values = table["driver"].values[:, k]
        largest = float(np.nanmax(np.abs(values), initial=0.0))
        if (largest == 0.0 or np.nanmin(values) == np.nanmax(values)) and name not in kept:
            constant += [f"{name} ({np.nanmax(values):g} {units[k]})"] if largest > 0.0 else []
            continue
        largest = largest or 1.0
        drivers[name] = {exponent: blocks.filled(name, (values / largest) ** exponent) for exponent in EXPONENTS}
        sizes[name] = (largest, str(units[k]))
    return drivers, sizes, tuple(constant)


def independent(columns: Array) -> list[int]:
    """Columns of which a part is not a linear combination of those before."""
    kept: list[int] = []
    centred = columns - columns.mean(axis=0)
    basis = np.empty((columns.shape[0], 0))
    for k in range(columns.shape[1]):
        # What a constant differs from its mean by is rounding.
        moves = np.abs(centred[:, k]).max(initial=0.0) > _ROUNDING * np.abs(columns[:, k]).max(initial=0.0)
        own = float(centred[:, k] @ centred[:, k]) if moves else 0.0
        left = centred[:, k] - basis @ (basis.T @ centred[:, k])
        left -= basis @ (basis.T @ left)
        rest = float(left @ left)
        if own > 0.0 and rest > _DEPENDENT * own:
            kept.append(k)
            basis = np.column_stack([basis, left / np.sqrt(rest)])
    return kept


def chained_blocks(seconds: Array, drivers: list[Array]) -> NDArray[np.int64]:
    """Divide a record into parts for forward chaining: load cycles where a driver starts from rest often enough, else equal parts."""
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
