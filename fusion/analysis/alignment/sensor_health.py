"""Health of every channel before any model: temperatures are predicted from the others, from the loads and from their own past.

What a sensor does beyond that prediction is held against its own record. A fault is one excursion far above everything else the sensor
does in the same time; what a machine does, its switchings included, comes back with similar size. Of a displacement, whose sudden steps
may be true, only single readings are at fault: those that leave its course and come back, and those that repeat one value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import sample_noise
from fusion.analysis.levels import SENSOR_LEVEL
from fusion.common import Array
from fusion.results.loop import SensorFaultPart

# Changes of a temperature sensor over some time, and what others, loads and its own past leave of them.

#: Blocks of the coarse grid, and bins of the fine one that shows what happens within a sample or two.
BLOCKS, FINE_BINS = 600, 12_000
#: Durations of a change on the fine grid, bins.
_FINE_DURATIONS = (1, 2)
#: The longest duration leaves room for ten changes that do not overlap: fewer say nothing of the largest.
_LEAST_CHANGES = 30
#: Fewest blocks whose median is the level before or after a change: single spikes do not count.
_LEAST_MEDIAN = 3
#: One coefficient for so many changes that do not overlap.
_CHANGES_PER_COEFFICIENT = 5.0
#: Scale beyond which a residual counts less (Huber 1964: 95 % efficient for normal errors is 1.345; wider, because changes are bursts).
_HUBER = 2.0
_ITERATIONS = 8
#: Instants that are tried for the begin and the end of a ramp, before a closer look.
_INSTANTS = 32
#: A driver is switched where it changes by this share of its range.
_SWITCHED = 0.05


@dataclass(frozen=True)
class Grid:
    """Medians of the samples in equal steps of time.

    Attributes
    ----------
    seconds : (n,) middle of each step, s
    step_s : length of a step, s
    temperature : (n, sensors) interpolated where nothing was read, degC
    known : (n, sensors) True where something was read
    drivers : (n, k) loads as shares of their range, and their squares
    is_fine : whether it is the fine grid
    """

    seconds: Array
    step_s: float
    temperature: Array
    known: NDArray[np.bool_]
    drivers: Array
    is_fine: bool

    def durations(self) -> tuple[int, ...]:
        """Durations of the changes that are looked at, steps."""
        if self.is_fine:
            return _FINE_DURATIONS
        longest = max(1, self.seconds.size // _LEAST_CHANGES)
        return tuple(2**power for power in range(int(np.log2(longest)) + 1))

    @cached_property
    def resolution(self) -> Array:
        """Smallest difference of two values of every sensor, K (sensors,)."""
        steps = [np.diff(np.unique(column)) for column in self.temperature.T]
        return np.array([max(float(step.min(initial=np.inf)), 1e-9) if step.size else 1.0 for step in steps])

    def switchings(self, begin_s: float, end_s: float) -> tuple[bool, int]:
        """Whether a load was switched between two times, and how often loads were switched at all other times."""
        if self.drivers.shape[1] == 0:
            return False, 0
        switched = np.max(np.abs(np.diff(self.drivers, axis=0)), axis=1) > _SWITCHED
        # A switching spreads over two blocks.
        first = switched & ~np.r_[False, switched[:-1]]
        times = self.seconds[1:][first]
        inside = (times >= begin_s) & (times <= end_s)
        return bool(inside.any()), int((~inside).sum())


@dataclass(frozen=True)
class Ramp:
    """A level that changes to another one: begin and end, s, size, K, and standard uncertainty of the begin, s."""

    begin_s: float
    end_s: float
    size_K: float
    begin_u_s: float


def fit_ramp(seconds: Array, values: Array) -> Ramp:
    """Fit level, ramp, level by least absolute deviations."""
    place = np.arange(values.size, dtype=float)
    tried = np.unique(np.linspace(0, values.size - 1, _INSTANTS).round().astype(int))
    best = _best_ramp(place, values, tried, tried)
    spacing = int(np.diff(tried).max())
    if spacing > 1:
        near = [np.arange(max(0, at - spacing), min(values.size, at + spacing + 1)) for at in best[1:]]
        best = _best_ramp(place, values, *near)
    missed, begin, end = best
    size = float(np.median(values[end:]) - np.median(values[: begin + 1]))
    step = float(np.median(np.diff(seconds)))
    duration = float(seconds[end] - seconds[begin])
    scatter = 1.25 * missed / values.size * duration / max(abs(size), 1e-9)
    return Ramp(float(seconds[begin]), float(seconds[end]), size, float(np.hypot(scatter, step / np.sqrt(3.0))))


def _best_ramp(place: Array, values: Array, begins: NDArray[np.intp], ends: NDArray[np.intp]) -> tuple[float, int, int]:
    """Sum of the absolute deviations, begin and end of the ramp that leaves least."""
    best = (np.inf, 0, values.size - 1)
    for begin in begins:
        for end in ends[ends > begin]:
            ramp = np.clip((place - begin) / (end - begin), 0.0, 1.0)
            ramp -= ramp.mean()
            slope = float(ramp @ values) / float(ramp @ ramp)
            missed = values - slope * ramp
            missed = np.abs(missed - np.median(missed))
            best = min(best, (float(missed.sum()), int(begin), int(end)))
    return best


@dataclass(frozen=True)
class Changes:
    """Changes of one sensor over one duration.

    Attributes
    ----------
    before, after : (m,) last step before and first step after each change
    residual : (m,) what is left of the change by the prediction, K
    reach : steps within which two changes share samples
    least_K : resolution of the sensor
    """

    before: NDArray[np.intp]
    after: NDArray[np.intp]
    residual: Array
    reach: int
    least_K: float


@dataclass(frozen=True)
class Excursion:
    """A stretch in which a sensor changes alone: first, last and strongest step, and its size over that of the next stretch."""

    first: int
    last: int
    peak: int
    ratio: float


def lay_grid(seconds: Array, temperature: Array, drivers: Array | None) -> list[Grid] | None:
    """Lay a fine and a coarse grid, the fine one only where it is finer."""
    between = np.diff(np.unique(seconds))
    if not between.size:
        return None
    step = float(np.median(between))
    loads = np.empty((seconds.size, 0)) if drivers is None else np.nan_to_num(drivers)
    span = np.ptp(loads, axis=0)
    loads = (loads - loads.min(axis=0))[:, span > 0.0] / span[span > 0.0]
    loads = np.hstack([loads, loads**2])
    fine, coarse = (step * max(1, int(np.ceil(seconds.size / most))) for most in (FINE_BINS, BLOCKS))
    grids = [_grid(seconds, temperature, loads, fine, is_fine=True)] if fine < coarse else []
    return [*grids, _grid(seconds, temperature, loads, coarse, is_fine=False)]


def _grid(seconds: Array, temperature: Array, loads: Array, length: float, *, is_fine: bool) -> Grid:
    """Medians of the samples of each step; steps in a pause are left out, as in a record."""
    number = np.floor((seconds - seconds[0]) / length + 1e-6).astype(int)
    numbers, first, count = np.unique(number, return_index=True, return_counts=True)
    values = np.full((numbers.size, temperature.shape[1]), np.nan)
    mean = np.zeros((numbers.size, loads.shape[1]))
    for place, (start, many) in enumerate(zip(first, count, strict=True)):
        part = temperature[start : start + many]
        values[place] = part[0] if many == 1 else _column_medians(part)
        mean[place] = loads[start : start + many].mean(axis=0)
    known = np.isfinite(values)
    middle = (numbers + 0.5) * length + seconds[0] - 0.5 * float(np.median(np.diff(seconds)))
    for k in range(values.shape[1]):
        here = known[:, k]
        values[:, k] = np.interp(middle, middle[here], values[here, k]) if here.any() else 0.0
    return Grid(middle, length, values, known, mean, is_fine)


def _column_medians(part: Array) -> Array:
    missing = np.isnan(part)
    if not missing.any():
        return np.asarray(np.median(part, axis=0))
    return np.array(
        [np.median(column[np.isfinite(column)]) if np.isfinite(column).any() else np.nan for column in part.T]
    )


def _differences(values: Array, duration: int) -> tuple[Array, int]:
    """Median after less median before a change of a duration, for every place (m, columns), and the length of the medians."""
    length = max(_LEAST_MEDIAN, duration)
    level = np.median(np.lib.stride_tricks.sliding_window_view(values, length, axis=0), axis=-1)
    away = length - 1 + duration
    return np.asarray(level[away:] - level[:-away]), length


def predicted_changes(grid: Grid, sensor: int, others: list[int], duration: int) -> Changes:
    """Predict the changes of a sensor from those of the others, of the loads, and from all changes just before."""
    columns = np.hstack([grid.temperature[:, [sensor, *others]], grid.drivers])
    differences, length = _differences(columns, duration)
    earlier = length + duration
    now, past = differences[earlier:], differences[:-earlier]
    own, regressors = now[:, 0], np.hstack([now[:, 1:], past])
    most = max(1.0, differences.shape[0] / earlier / _CHANGES_PER_COEFFICIENT)
    coefficients = _robust_ridge(own, regressors, most)
    residual = own - (regressors - np.median(regressors, axis=0)) @ coefficients
    before = np.arange(own.size) + earlier + length - 1
    known = grid.known[:, sensor]
    residual = np.where(known[before] & known[before + duration], residual, 0.0)
    return Changes(before, before + duration, residual, duration + 2 * length, float(grid.resolution[sensor]))


def _robust_ridge(own: Array, regressors: Array, most: float) -> Array:
    """Coefficients of the centred regressors, by ridge regression with Huber's weights and `most` effective ones at most."""
    centred = regressors - np.median(regressors, axis=0)
    spread = centred.std(axis=0)
    standard = centred / np.where(spread > 0.0, spread, np.inf)
    moments = standard.T @ standard / own.size
    values = np.maximum(np.linalg.eigvalsh(moments), 0.0)
    penalties = np.geomspace(1e-6, 1e4, 101)
    used = (values / (values + penalties[:, None])).sum(axis=1)
    penalty = np.diag(np.full(values.size, float(penalties[np.argmax(used <= most)])))
    weights, coefficients = np.ones(own.size), np.zeros(values.size)
    for _ in range(_ITERATIONS):
        weighted = standard * weights[:, None]
        coefficients = np.linalg.solve(weighted.T @ standard / own.size + penalty, weighted.T @ own / own.size)
        missed = np.abs(own - standard @ coefficients)
        scale = max(1.4826 * float(np.median(missed)), 1e-9)
        weights = 1.0 / np.maximum(1.0, missed / (_HUBER * scale))
    return np.asarray(coefficients / np.where(spread > 0.0, spread, np.inf))


def largest_excursion(changes: Changes) -> Excursion | None:
    """The largest excursion of a sensor, with its size over that of the next, which shares no sample with it."""
    size = np.abs(changes.residual)
    peak = int(size.argmax())
    same = (np.sign(changes.residual) == np.sign(changes.residual[peak])) & (size >= 0.5 * size[peak])
    apart = np.flatnonzero(~same)
    low = int(apart[apart < peak].max(initial=-1)) + 1
    high = int(apart[apart > peak].min(initial=size.size)) - 1
    rest = np.r_[size[: max(0, low - changes.reach)], size[high + changes.reach + 1 :]]
    if rest.size == 0:
        return None
    ratio = float(size[peak] / max(float(rest.max()), changes.least_K))
    margin = changes.reach // 2
    first, last = int(changes.before[low]) - margin, int(changes.after[high]) + margin
    final = int(changes.after[-1])
    return Excursion(max(0, first), min(final, last), int(changes.before[peak]), ratio)


def level_beyond_prediction(grid: Grid, sensor: int, others: list[int]) -> Array:
    """What a sensor shows beyond its prediction from the levels of the others, K; the coefficients are those of the longest changes."""
    own = grid.temperature[:, sensor]
    if not others:
        return own
    duration = grid.durations()[-1]
    differences, length = _differences(grid.temperature[:, [sensor, *others]], duration)
    most = max(1.0, differences.shape[0] / (length + duration) / _CHANGES_PER_COEFFICIENT)
    coefficients = _robust_ridge(differences[:, 0], differences[:, 1:], most)
    return np.asarray(own - grid.temperature[:, others] @ coefficients)


#: Power with which the distribution of a sound sensor's largest excursions falls at the slowest: Student's t with 4 degrees of freedom.
TAIL_INDEX = 4.0
#: Readings outside are none, degC: colder than any shop, hotter than a motor winding of class H may be (180 degC, IEC 60085).
PLAUSIBLE_DEGC = (-40.0, 200.0)
#: Implausible readings in a row that are no single error of transmission.
_LEAST_IMPLAUSIBLE = 3
#: A signal ends where the last share of the record is missing.
_ENDED_SHARE = 0.02
#: Equal readings in a row from which a sensor may stick.
_LEAST_REPEATED = 20
#: So many equal readings, and so many times the next longest run, are enough alone: with the tail of ratios above, one chance in 1e8.
_FAR_LONGER = 100
#: The others then pass through this share of their range: before a test is begun everything may stand still.
_LEAST_MOVED = 0.1
#: A sensor finer than its noise repeats a reading this often in a row at most.
_ORDINARY_RUN = 3
#: The others move where the sensor's prediction moves by so many times what the prediction misses otherwise (95 %).
_MOVES = 3.0
#: Share of what past and loads leave of a sensor's changes that the others predict: below, what it does alone may be true.
_PREDICTABLE = 0.5
#: Excursion of another sensor over its next largest that counts as its response to a source near the suspected sensor.
_RESPONSE = 2.0
#: A switching is no excuse for what exceeds the response to so many others.
_LEAST_SWITCHINGS = 3
#: A change within two samples that are at most so far apart is faster than any part of a machine warms, s.
_FAST_S = 60.0
#: Windows in which the noise of a sensor is compared, and fewest on either side of its change.
_NOISE_WINDOWS, _LEAST_NOISE_WINDOWS = 24, 3
#: Fewest samples of such a window.
_NOISE_SAMPLES = 20
#: Quietest window after over noisiest window before that makes a sensor suspected.
_NOISIER = 3.0
#: Fewest blocks from which anything is concluded.
_LEAST_BLOCKS = 60
#: Difference from the running median of a glitch, over the 90 % quantile of all or the resolution, whichever is larger: noise as heavy as
#: Student's t with 4 degrees of freedom exceeds it twice in a million readings.
_GLITCH = 20.0
#: Readings of the shortest stretch that is looked for, and the longest as a share of the record; the median is over twice as many.
_GLITCH_READINGS, _GLITCH_SHARE = 5, 0.02
#: It leaves the course, and comes back, by this share of its size from one reading to the next; what is smooth may be true.
_ABRUPT = 0.5
#: A driver that is switched at so large a share of the readings explains no single excursion.
_OFTEN = 0.1


class Kind(StrEnum):
    """What a sensor does."""

    NO_SIGNAL = "no signal"
    STUCK = "stuck"
    JUMP = "jump"
    RAMP = "ramp"
    NOISE = "noise"
    GLITCH = "glitch"
    CLIPPED = "clipped"
    COMPUTED = "computed"


@dataclass(frozen=True)
class SensorFault:
    """What is wrong with a sensor, or may be.

    Attributes
    ----------
    sensor : place among the sensors, or among the displacements
    kind : what it does
    is_clear : whether nothing that a machine does looks like it; else the sensor is suspected
    onset_s, onset_u_s : when it began, since the first sample, and the standard uncertainty of that, s
    size : change beyond the prediction, K; of noise its ratio, 1; of glitches the largest, um; nan of a signal that is none
    ratio, limit : excursion over the next largest of the sensor, and the limit; nan where none is compared
    reason : why it is only suspected; empty where it is clear
    end_s : end of a jump or ramp, s; nan of others
    readings, stretches_s : of a displacement the number of readings at fault, and the times of the first and last of each stretch, s
    computed_with : faulty sensor that a displacement is computed with
    """

    sensor: int
    kind: Kind
    is_clear: bool
    onset_s: float
    onset_u_s: float
    size: float
    ratio: float = np.nan
    limit: float = np.nan
    reason: str = ""
    end_s: float = np.nan
    readings: int = 0
    stretches_s: tuple[tuple[float, float], ...] = ()
    computed_with: str = ""

    @property
    def words(self) -> str:
        """What the sensor does and from when on, as it follows its name."""
        return describe_fault(self)


def describe_fault(fault: SensorFault | SensorFaultPart) -> str:
    """Return what a sensor does and from when on, as it follows the sensor's name."""
    size, readings = abs(fault.size or 0.0), f"{fault.readings} reading{'' if fault.readings == 1 else 's'}"
    words = {
        Kind.NO_SIGNAL: "gives no signal",
        Kind.STUCK: "repeats one reading" + (f" ({readings})" if fault.readings else ""),
        Kind.JUMP: f"jumps by {size:.2g} K",
        Kind.RAMP: f"ramps by {size:.2g} K",
        Kind.NOISE: f"has {size:.2g} times its noise",
        Kind.GLITCH: f"leaves its course by up to {size:.4g} µm and comes back ({readings})",
        Kind.CLIPPED: f"stays at the end of its range ({readings})",
        Kind.COMPUTED: f"is computed with the faulty sensor {fault.computed_with}",
    }
    onset_h, onset_u_h = (fault.onset_s or 0.0) / 3600.0, (fault.onset_u_s or 0.0) / 3600.0
    return f"{words[Kind(fault.kind)]} from {onset_h:.2f} h on (standard uncertainty {onset_u_h:.1g} h)"


def excursion_limit(tests: int) -> float:
    """Ratio of the largest excursion to the next that a sound record exceeds with probability :data:`SENSOR_LEVEL`."""
    return float((tests / SENSOR_LEVEL) ** (1.0 / TAIL_INDEX))


def examine_sensors(seconds: Array, temperature: Array, drivers: Array | None = None) -> list[SensorFault]:
    """Examine temperature sensors."""
    if seconds.size < _LEAST_BLOCKS or temperature.shape[1] == 0:
        return []
    lost = _without_signal(seconds, temperature)
    kept = [k for k in range(temperature.shape[1]) if k not in {fault.sensor for fault in lost}]
    plausible = np.where(is_implausible(temperature), np.nan, temperature)
    kept = [k for k in kept if np.isfinite(plausible[:, k]).sum() >= _LEAST_BLOCKS]
    grids = lay_grid(seconds, plausible, drivers)
    if not kept or grids is None:
        return lost
    faults = [*lost, *_stuck(seconds, plausible, grids[-1], kept)]
    kept = [k for k in kept if k not in {fault.sensor for fault in faults}]
    faults += _changed(grids, kept)
    named = {fault.sensor for fault in faults}
    faults += [fault for fault in _noisier(seconds, plausible, grids[-1], kept) if fault.sensor not in named]
    return sorted(faults, key=lambda fault: fault.sensor)


def is_implausible(temperature: Array) -> NDArray[np.bool_]:
    """Readings that no shop and no machine has."""
    with np.errstate(invalid="ignore"):
        return (temperature < PLAUSIBLE_DEGC[0]) | (temperature > PLAUSIBLE_DEGC[1])


def _without_signal(seconds: Array, temperature: Array) -> list[SensorFault]:
    """Sensors whose readings are none for a while, or end before the record does."""
    step = float(np.median(np.diff(seconds)))
    faults = []
    for k in range(temperature.shape[1]):
        outside = is_implausible(temperature[:, k])
        readings = np.flatnonzero(np.isfinite(temperature[:, k]))
        in_a_row = np.convolve(outside[readings], np.ones(_LEAST_IMPLAUSIBLE)) >= _LEAST_IMPLAUSIBLE
        if in_a_row.any():
            # What is missing before the first of these implausible readings is no signal either; a single one before them is a glitch.
            sound = readings[: int(np.argmax(in_a_row)) - _LEAST_IMPLAUSIBLE + 1]
            first = int(sound[-1]) + 1 if sound.size else 0
            faults.append(SensorFault(k, Kind.NO_SIGNAL, True, float(seconds[first]), step, np.nan))
        elif readings.size and seconds[-1] - seconds[readings[-1]] > _ENDED_SHARE * (seconds[-1] - seconds[0]):
            faults.append(SensorFault(k, Kind.NO_SIGNAL, True, float(seconds[readings[-1]]) + step, step, np.nan))
    return faults


def _runs(values: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First places and lengths of all runs of equal values."""
    starts = np.flatnonzero(np.r_[True, values[1:] != values[:-1]])
    return starts, np.diff(np.r_[starts, values.size])


def _longest_run(values: Array) -> tuple[int, int, int]:
    """Length of the longest run of equal values, its first place, and the length of the longest run of another value."""
    starts, lengths = _runs(values)
    longest = int(lengths.argmax())
    others = lengths[values[starts] != values[starts[longest]]]
    return int(lengths[longest]), int(starts[longest]), int(others.max(initial=0))


def _stuck(seconds: Array, temperature: Array, grid: Grid, kept: Sequence[int]) -> list[SensorFault]:
    """Sensors that repeat one reading to the last digit far longer than ever before, while the others move."""
    limit = excursion_limit(len(kept))
    faults = []
    for k in kept:
        known = np.flatnonzero(np.isfinite(temperature[:, k]))
        length, first, ordinary = _longest_run(temperature[known, k])
        if length < max(_LEAST_REPEATED, limit * ordinary):
            continue
        run = known[first : first + length]
        others = [j for j in kept if j != k]
        moving = [j for j in others if np.ptp(temperature[run, j]) != 0.0]
        # A logger that stands still repeats all of them.
        if others and len(moving) <= 0.5 * len(others):
            continue
        first_s, last_s = float(seconds[run[0]]), float(seconds[run[-1]])
        inside = (grid.seconds >= first_s) & (grid.seconds <= last_s)
        far_longer = length > _FAR_LONGER * max(1, ordinary) and _passed_through(temperature[:, others], run)
        if ordinary <= _ORDINARY_RUN or far_longer or _moved_alone(grid, k, moving, inside):
            step, ratio = float(np.median(np.diff(seconds))), length / max(ordinary, 1)
            faults.append(SensorFault(k, Kind.STUCK, True, first_s, step, 0.0, ratio, limit))
    return faults


def _passed_through(temperature: Array, run: NDArray[np.intp]) -> bool:
    """Whether most columns pass through a good part of their range within a run."""
    passed, whole = (np.nanmax(part, axis=0) - np.nanmin(part, axis=0) for part in (temperature[run], temperature))
    return bool((passed > _LEAST_MOVED * whole).mean() > 0.5) if whole.size else True


def _moved_alone(grid: Grid, sensor: int, others: list[int], inside: NDArray[np.bool_]) -> bool:
    """Whether the prediction of a sensor moves while it stands still, beyond what the prediction misses elsewhere."""
    if not others:
        return False
    changes = predicted_changes(grid, sensor, others, grid.durations()[-1])
    within = inside[changes.before] & inside[changes.after]
    if not within.any() or within.all():
        return False
    missed = float(np.quantile(np.abs(changes.residual[~within]), 0.95))
    return bool(np.abs(changes.residual[within]).max() > _MOVES * missed)


@dataclass(frozen=True)
class _Suspicion:
    """The strongest excursion of a sensor: over the limit where `excess` is above 1."""

    sensor: int
    excess: float
    found: Excursion
    grid: Grid


def _changed(grids: list[Grid], kept: Sequence[int]) -> list[SensorFault]:
    """Sensors that jump or ramp away from their prediction."""
    faults: list[SensorFault] = []
    left = list(kept)
    while left:
        suspicions = [_strongest(grids, k, [j for j in left if j != k], len(kept)) for k in left]
        over = sorted((one for one in suspicions if one.excess > 1.0), key=lambda one: -one.excess)
        if not over:
            break
        # A faulty predictor disturbs the prediction of the others: each is judged without all that deviate at that time.
        together = [one for one in over if _overlap(one, over[0])]
        places = {one.sensor for one in together}
        sound = [j for j in left if j not in places]
        again = [_strongest(grids, one.sensor, sound, len(kept)) for one in together]
        survivors = [one for one in again if one.excess > 1.0 and _overlap(one, over[0])]
        named = survivors or [over[0]]
        responding = _responds(grids, named[0], sound)
        faults += [_describe(grids, one, sound, responding=responding, alone=len(survivors) == 1) for one in named]
        left = [j for j in left if j not in {one.sensor for one in named}]
    return faults


def _strongest(grids: list[Grid], sensor: int, others: list[int], sensors: int) -> _Suspicion:
    """The strongest excursion of a sensor from what others, loads and its past predict, over all durations."""
    limit = excursion_limit(sensors * sum(len(grid.durations()) for grid in grids))
    chosen = _Suspicion(sensor, 0.0, Excursion(0, 0, 0, 0.0), grids[-1])
    for grid in grids:
        for duration in grid.durations():
            found = largest_excursion(predicted_changes(grid, sensor, others, duration))
            if found is not None and found.ratio / limit > chosen.excess:
                chosen = _Suspicion(sensor, found.ratio / limit, found, grid)
    return chosen


def _overlap(one: _Suspicion, other: _Suspicion) -> bool:
    """Whether two suspicions are of the same time."""
    (first, last), (begin, end) = ((s.grid.seconds[s.found.first], s.grid.seconds[s.found.last]) for s in (one, other))
    return bool(first <= end and begin <= last)


def _responds(grids: list[Grid], suspicion: _Suspicion, others: list[int]) -> bool:
    """Whether another sensor, predicted without the suspected one, shows the largest excursion of its record at that time or soon after."""
    coarse = grids[-1]
    begin = float(suspicion.grid.seconds[suspicion.found.first])
    for duration in coarse.durations():
        end = float(suspicion.grid.seconds[suspicion.found.last]) + 2.0 * duration * coarse.step_s
        for k in others:
            found = largest_excursion(predicted_changes(coarse, k, [j for j in others if j != k], duration))
            if found is not None and found.ratio >= _RESPONSE and begin <= coarse.seconds[found.peak] <= end:
                return True
    return False


def _describe(
    grids: list[Grid], suspicion: _Suspicion, sound: list[int], *, responding: bool, alone: bool
) -> SensorFault:
    """Kind, onset and clearness of a change."""
    found, coarse = suspicion.found, grids[-1]
    ramp = _timed(grids, suspicion, sound)
    fine_s, duration_s = grids[0].step_s, ramp.end_s - ramp.begin_s
    quick = duration_s <= max(2.0 * fine_s, _FAST_S)
    kind = Kind.JUMP if quick else Kind.RAMP
    fast = quick and fine_s <= _FAST_S
    switched, otherwise = coarse.switchings(ramp.begin_s - 2.0 * coarse.step_s, ramp.end_s + 2.0 * coarse.step_s)
    reasons = {
        "another sensor deviates at the same time": not alone,
        "other sensors respond, so that it may be a source of heat": responding,
        "a load was switched then, too rarely to compare": switched and otherwise < _LEAST_SWITCHINGS,
        "the other sensors predict too little of its signal to distinguish a fault from a heat source": not (
            fast or _shared_by_others(coarse, suspicion.sensor, sound) >= _PREDICTABLE
        ),
    }
    reason = next((words for words, holds in reasons.items() if holds), "")
    limit = found.ratio / suspicion.excess
    return SensorFault(
        suspicion.sensor,
        kind,
        not reason,
        ramp.begin_s,
        ramp.begin_u_s,
        ramp.size_K,
        found.ratio,
        limit,
        reason,
        ramp.end_s,
    )


def _shared_by_others(grid: Grid, sensor: int, others: list[int]) -> float:
    """Largest share, over the durations, of what past and loads leave of a sensor's changes that the others predict (median squares)."""
    shares = [0.0]
    for duration in grid.durations():
        alone, left = (
            float(np.median(predicted_changes(grid, sensor, used, duration).residual ** 2)) for used in ([], others)
        )
        if alone > 0.0:
            shares.append(1.0 - left / alone)
    return max(shares)


def _timed(grids: list[Grid], suspicion: _Suspicion, sound: list[int]) -> Ramp:
    """Begin, end and size of a change: on the grid where it stands out, and on the fine one where it takes a block or two."""
    grid, found = suspicion.grid, suspicion.found
    level = level_beyond_prediction(grid, suspicion.sensor, sound)
    ramp = fit_ramp(grid.seconds[found.first : found.last + 1], level[found.first : found.last + 1])
    fine = grids[0]
    if fine is grid or ramp.end_s - ramp.begin_s > 3.0 * grid.step_s:
        return ramp
    inside = (fine.seconds >= ramp.begin_s - 2.0 * grid.step_s) & (fine.seconds <= ramp.end_s + 2.0 * grid.step_s)
    return fit_ramp(fine.seconds[inside], fine.temperature[inside, suspicion.sensor])


def _noisier(seconds: Array, temperature: Array, grid: Grid, kept: Sequence[int]) -> list[SensorFault]:
    """Sensors whose noise grows for good, apart from what the noise of all does."""
    size = seconds.size // _NOISE_WINDOWS
    if size < _NOISE_SAMPLES:
        return []
    scale = np.full((_NOISE_WINDOWS, len(kept)), np.nan)
    for place, k in enumerate(kept):
        digits = np.diff(np.unique(temperature[np.isfinite(temperature[:, k]), k]))
        least = float(digits.min(initial=np.inf)) / np.sqrt(12.0)
        for window in range(_NOISE_WINDOWS):
            values = temperature[window * size : (window + 1) * size, k]
            values = values[np.isfinite(values)]
            if values.size - 2 >= _NOISE_SAMPLES // 2:
                scale[window, place] = max(sample_noise(values), least)
    with np.errstate(all="ignore"):
        course = np.log(scale) - np.log(np.nanmedian(scale, axis=0))
    limit = excursion_limit(len(kept))
    faults = []
    for place, k in enumerate(kept):
        others = np.delete(course, place, axis=1)
        common = np.median(others, axis=1) if others.shape[1] else 0.0
        own = course[:, place] - common
        if not np.isfinite(own).all():
            continue
        splits = range(_LEAST_NOISE_WINDOWS, _NOISE_WINDOWS - _LEAST_NOISE_WINDOWS + 1)
        apart = np.array([np.exp(own[at:].min() - own[:at].max()) for at in splits])
        at = splits[int(apart.argmax())]
        ratio = float(np.exp(np.median(own[at:]) - np.median(own[:at])))
        if apart.max() < _NOISIER:
            continue
        onset, window_s = float(seconds[at * size]), size * float(np.median(np.diff(seconds)))
        switched, otherwise = grid.switchings(onset - window_s, onset + window_s)
        rarely = switched and otherwise < _LEAST_SWITCHINGS
        reason = "a load was switched then, too rarely to compare" if rarely else ""
        if not reason and apart.max() < limit:
            reason = "the noise of a sound sensor may grow as much near a machine that runs faster"
        held_to = _NOISIER if reason else limit
        faults.append(
            SensorFault(k, Kind.NOISE, not reason, onset, 0.5 * window_s, ratio, float(apart.max()), held_to, reason)
        )
    return faults


def examine_displacements(
    seconds: Array, displacement: Array, temperature: Array, drivers: Array | None = None
) -> list[SensorFault]:
    """Examine displacement channels: readings that repeat one value, and those that leave the course and come back."""
    every = np.column_stack([displacement, np.where(is_implausible(temperature), np.nan, temperature)])
    kept = [k for k in range(every.shape[1]) if np.isfinite(every[:, k]).sum() >= _LEAST_BLOCKS]
    grids = lay_grid(seconds, every, drivers) if seconds.size >= _LEAST_BLOCKS else None
    if grids is None:
        return []
    repeated = {fault.sensor: fault for fault in _stuck(seconds, every, grids[-1], kept)}
    faults = []
    for k, values in enumerate(displacement.T):
        at_fault = np.zeros(values.size, bool)
        if k in repeated:
            known = np.flatnonzero(np.isfinite(values))
            value = values[np.searchsorted(seconds, repeated[k].onset_s)]
            _, lengths = _runs(values[known])
            at_fault[known] = np.repeat(lengths >= _LEAST_REPEATED, lengths) & (values[known] == value)
            kind = Kind.CLIPPED if value in (values[known].min(), values[known].max()) else Kind.STUCK
            faults.append(_in_stretches(replace(repeated[k], kind=kind, size=np.nan), seconds, at_fault))
        at_fault, largest = _glitches(np.where(at_fault, np.nan, values), drivers)
        if at_fault.any():
            found = SensorFault(k, Kind.GLITCH, True, 0.0, float(np.median(np.diff(seconds))), largest)
            faults.append(_in_stretches(found, seconds, at_fault))
    return faults


def _in_stretches(fault: SensorFault, seconds: Array, at_fault: NDArray[np.bool_]) -> SensorFault:
    """The fault with its onset, the number of its readings and the times of its stretches."""
    edges = np.flatnonzero(np.diff(np.r_[False, at_fault, False]))
    stretches = tuple(zip(seconds[edges[::2]].tolist(), seconds[edges[1::2] - 1].tolist(), strict=True))
    return replace(fault, onset_s=stretches[0][0], readings=int(at_fault.sum()), stretches_s=stretches)


def _glitches(displacement: Array, drivers: Array | None) -> tuple[NDArray[np.bool_], float]:
    """Readings that leave the course of a displacement and come back within one sample, or as a burst of a few that is far from it, and the
    largest distance from it.
    """
    at_fault, largest = np.zeros(displacement.size, bool), 0.0
    loads = np.zeros((displacement.size, 1)) if drivers is None else np.nan_to_num(drivers)
    longest = max(_GLITCH_READINGS, int(_GLITCH_SHARE * displacement.size))
    for reach in np.unique(np.minimum(_GLITCH_READINGS * 4 ** np.arange(12), longest)):
        known = np.flatnonzero(np.isfinite(displacement) & ~at_fault)
        values = displacement[known]
        if values.size < _LEAST_BLOCKS or np.ptp(values) == 0.0:
            break
        off = np.abs(values - pd.Series(values).rolling(2 * reach + 1, center=True, min_periods=1).median().to_numpy())
        limit = _GLITCH * max(float(np.quantile(off, 0.9)), float(np.diff(np.unique(values)).min()))
        steepest = float(np.abs(np.diff(values[off <= limit])).max())
        steps = np.abs(np.diff(values, prepend=values[0]))
        switched = np.abs(np.diff(loads[known], axis=0, prepend=loads[known[:1]])) > _SWITCHED * np.ptp(loads, axis=0)
        switched[:, switched.mean(axis=0) > _OFTEN] = False
        edges = np.flatnonzero(np.diff(np.r_[False, off > limit, False]))
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            size = float(off[first:end].max())
            # The median itself is off beside a long stretch, so that the steps say where it begins and ends.
            borders = first + np.flatnonzero(steps[first : end + 1] > max(limit, _ABRUPT * size))
            # A burst of a few readings climbs in parts: more than a course that is steep elsewhere moves in as many.
            if 0 < first < end < values.size and end - first <= _GLITCH_READINGS:
                far = size > excursion_limit(1) * max(limit, (end - first) * steepest)
                if far and abs(values[end] - values[first - 1]) <= limit and not switched[first - 1 : end + 1].any():
                    borders = np.array([first, end])
            if borders.size == 0:
                continue
            begin, after = borders[0], borders[-1]
            if begin < after:
                returns = abs(values[after] - values[begin - 1]) <= _ABRUPT * min(steps[begin], steps[after])
            else:
                # A level that a single reading shows cannot be said to stay, unless the course is as steep elsewhere.
                alone = end - first == 1 and first in (0, values.size - 1)
                returns = alone and steps[begin] > excursion_limit(1) * max(limit, steepest)
                begin, after = first, end
            if returns and after - begin <= reach and not switched[borders].all(axis=0).any():
                at_fault[known[begin:after]] = True
                largest = max(largest, size)
    return at_fault, largest
