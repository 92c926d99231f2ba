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
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import sample_noise
from fusion.analysis.levels import SENSOR_LEVEL
from fusion.common import Array
from fusion.results.loop import SensorFaultPart
from thermography.common import MAD_TO_SIGMA

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
    """Medians of the samples in equal steps of time, s at their middle: temperatures (n, sensors), interpolated where nothing was read,
    degC; `known` where something was; loads (n, k) as shares of their range, and their squares.
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

    def switched_rarely(self, begin_s: float, end_s: float) -> bool:
        """Whether a load was switched between two times, and loads too rarely at all other times to compare."""
        if self.drivers.shape[1] == 0:
            return False
        switched = np.max(np.abs(np.diff(self.drivers, axis=0)), axis=1) > _SWITCHED
        # A switching spreads over two blocks.
        first = switched & ~np.r_[False, switched[:-1]]
        times = self.seconds[1:][first]
        inside = (times >= begin_s) & (times <= end_s)
        return bool(inside.any() and (~inside).sum() < _LEAST_SWITCHINGS)


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
    """Changes of one sensor over one duration: last step before and first step after each, what its prediction leaves of it, K, steps
    within which two share samples, and the resolution of the sensor.
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
    medians = pd.DataFrame(temperature).groupby(number).median()
    mean = pd.DataFrame(loads).groupby(number).mean().reindex(medians.index)
    numbers, values = medians.index.to_numpy(), np.array(medians, order="C")
    known = np.isfinite(values)
    middle = (numbers + 0.5) * length + seconds[0] - 0.5 * float(np.median(np.diff(seconds)))
    for k in range(values.shape[1]):
        here = known[:, k]
        values[:, k] = np.interp(middle, middle[here], values[here, k]) if here.any() else 0.0
    return Grid(middle, length, values, known, np.array(mean, order="C"), is_fine)


def _differences(values: Array, duration: int) -> tuple[Array, int]:
    """Median after less median before a change of a duration, for every place (m, columns), and the length of the medians."""
    length = max(_LEAST_MEDIAN, duration)
    level = np.median(np.lib.stride_tricks.sliding_window_view(values, length, axis=0), axis=-1)
    away = length - 1 + duration
    return np.asarray(level[away:] - level[:-away]), length


def predicted_changes(
    grid: Grid, sensor: int, others: list[int], duration: int, apart_from: NDArray[np.bool_] | None = None
) -> Changes:
    """Predict the changes of a sensor from those of the others, of the loads, and from all changes just before, as learnt `apart_from`
    some steps.
    """
    columns = np.hstack([grid.temperature[:, [sensor, *others]], grid.drivers])
    differences, length = _differences(columns, duration)
    earlier = length + duration
    now, past = differences[earlier:], differences[:-earlier]
    own, regressors = now[:, 0], np.hstack([now[:, 1:], past])
    before = np.arange(own.size) + earlier + length - 1
    learnt = np.ones(own.size, bool)
    if apart_from is not None and (rest := ~(apart_from[before] | apart_from[before + duration])).any():
        learnt = rest
    most = max(1.0, learnt.sum() / earlier / _CHANGES_PER_COEFFICIENT)
    coefficients = _robust_ridge(own[learnt], regressors[learnt], most)
    residual = own - (regressors - np.median(regressors[learnt], axis=0)) @ coefficients
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
        scale = max(MAD_TO_SIGMA * float(np.median(missed)), 1e-9)
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
#: What a thermometer can read, degC: absolute zero, and hotter than thermocouples endure.
MEASURABLE_DEGC = (-273.15, 3000.0)
#: An open, shorted or saturated input repeats one number that lies so far from all other readings, K, and their whole range away from them.
_RAIL_K = 10.0
#: Numbers that converters of thermocouples, Pt100 and digital sensors are documented to give then, degC: a single one is enough.
_RAILS_DEGC = (-270.0, -250.0, -242.0, -200.0, -180.0, -127.0, 850.0, 999.0, 1370.0, 1372.0, 1768.0, 1820.0, 2320.0)
#: Something is heated, and no fault, that holds a level for half the time in which it is so much warmer than most others and than itself
#: at its coldest, K.
_HEATED_K = 15.0
#: A set point, in whole halves of a degree, is this high at most, degC.
_HEATED_DEGC = 500.0
#: A signal ends where the last share of the record is missing.
_ENDED_SHARE = 0.02
#: Equal readings in a row from which a sensor may stick.
_LEAST_REPEATED = 20
#: A sensor whose digits are finer than its changes repeats a reading this often in a row at most.
_ORDINARY_RUN = 3
#: Noise moves so large a share of the readings, and turns round as often; white noise does so two times of three.
_NOISE_STEPS, _NOISE_TURNS = 0.1, 0.4
#: The others move where the sensor's prediction moves by so many times what the prediction misses otherwise (95 %), or its digits.
_MOVES = 3.0
#: A jump is made by this share of it from one reading to the next, whatever the time between two readings; warming takes several.
_AT_ONCE = 0.9
#: Share of what past and loads leave of a sensor's changes that the others predict: below, what it does alone may be true.
_PREDICTABLE = 0.5
#: Excursion of another sensor over its next largest that counts as its response to a source near the suspected sensor.
_RESPONSE = 2.0
#: A switching is no excuse for what exceeds the response to so many others.
_LEAST_SWITCHINGS = 3
_SWITCHED_RARELY = "a load was switched then, too rarely to compare"
#: A change from one sample to the next, at most so far apart, is faster than any part of a machine warms, s.
_FAST_S = 60.0
#: A heater takes longer than this to reach its level, s: only a change from one sample to the next, that close, is none of a heater.
_HEATER_S = 10.0
#: Windows in which the noise of a sensor is compared, and fewest on either side of its change.
_NOISE_WINDOWS, _LEAST_NOISE_WINDOWS = 24, 3
#: Fewest samples of such a window.
_NOISE_SAMPLES = 20
#: Quietest window after over noisiest window before that makes a sensor suspected.
_NOISIER = 3.0
#: Set points are held exactly and changed at so small a share of the samples, by steps that are whole halves of a degree.
_SET_SHARE, _SET_STEP_K = 0.02, 0.5
#: What is regulated comes to its set point within this, K or share of its rise, in the second half of a time in which it is held.
_REGULATED_K, _REGULATED_SHARE = 2.0, 0.03
#: Fewest samples of such a time.
_LEAST_HELD = 10
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
#: An erratic time: a wild step exceeds the 75 % quantile of all steps, or the resolution, by this factor; so many wild steps turn round
#: within two readings; wild steps so many readings apart belong together; and all such times together are this share of the record at most.
_WILD, _LEAST_TURNS, _CALM_READINGS, _ERRATIC_SHARE = 30.0, 4, 10, 0.2
#: It is over where a reading lies within this share of a wild step of the median of the next ones.
_BACK = 0.2


class Kind(StrEnum):
    """What a sensor does."""

    NO_SIGNAL = "no signal"
    STUCK = "stuck"
    JUMP = "jump"
    RAMP = "ramp"
    NOISE = "noise"
    GLITCH = "glitch"
    CLIPPED = "clipped"
    ERRATIC = "erratic"
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
    size : change beyond the prediction, K; of noise its ratio, 1; of readings at fault the largest, K or um; nan of a signal that is none
    ratio, limit : excursion over the next largest of the sensor, and the limit; nan where none is compared
    reason : why it is only suspected; empty where it is clear
    end_s : end of a jump or ramp, s; nan of others
    readings, stretches_s : where readings alone are at fault, their number, and the times of the first and last of each stretch, s
    computed_with : faulty sensor that a displacement is computed with
    quantity : whether it is one of a temperature or of a displacement
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
    quantity: Literal["temperature", "displacement"] = "temperature"

    @property
    def words(self) -> str:
        """What the sensor does and from when on, as it follows its name."""
        return describe_fault(self)


def describe_fault(fault: SensorFault | SensorFaultPart) -> str:
    """Return what a sensor does and from when on, as it follows the sensor's name."""
    size, readings = abs(fault.size or 0.0), f"{fault.readings} reading{'' if fault.readings == 1 else 's'}"
    unit = "µm" if fault.quantity == "displacement" else "K"
    words = {
        Kind.NO_SIGNAL: "gives no signal" + (f" ({readings})" if fault.readings else ""),
        Kind.STUCK: "repeats one reading" + (f" ({readings})" if fault.readings else ""),
        Kind.JUMP: f"jumps by {size:.2g} K",
        Kind.RAMP: f"ramps by {size:.2g} K",
        Kind.NOISE: f"has {size:.2g} times its noise",
        Kind.GLITCH: f"leaves its course by up to {size:.4g} {unit} and comes back ({readings})",
        Kind.CLIPPED: f"stays at the end of its range ({readings})",
        Kind.ERRATIC: f"is erratic, by up to {size:.4g} {unit} ({readings})",
        Kind.COMPUTED: f"is computed with the faulty sensor {fault.computed_with}",
    }
    onset_h, onset_u_h = (fault.onset_s or 0.0) / 3600.0, (fault.onset_u_s or 0.0) / 3600.0
    return f"{words[Kind(fault.kind)]} from {onset_h:.2f} h on (standard uncertainty {onset_u_h:.1g} h)"


def excursion_limit(tests: int) -> float:
    """Ratio of the largest excursion to the next that a sound record exceeds with probability :data:`SENSOR_LEVEL`."""
    return float((tests / SENSOR_LEVEL) ** (1.0 / TAIL_INDEX))


def find_set_points(values: Array) -> dict[int, int]:
    """Find the columns (n, columns), degC, that hold set points, each with the column that is regulated by it."""
    changes = np.array([np.sum(np.diff(one[np.isfinite(one)]) != 0.0) for one in values.T])
    is_set = np.array(
        [
            0 < number <= _SET_SHARE * len(one) and not np.any(np.round(one[np.isfinite(one)] / _SET_STEP_K, 6) % 1.0)
            for number, one in zip(changes, values.T, strict=True)
        ],
        bool,
    )
    found = {}
    for place in np.flatnonzero(is_set):
        misses = {k: _missed_set_point(values[:, place], values[:, k]) for k in np.flatnonzero(~is_set)}
        best = min(misses, key=lambda k: misses[k], default=-1)
        if misses and misses[best] <= 1.0:
            found[int(place)] = int(best)
    return found


def _missed_set_point(wanted: Array, measured: Array) -> float:
    """Median distance of what is measured from what is wanted, over that of a regulated part, in most times at which it is heated."""
    known = np.flatnonzero(np.isfinite(wanted) & np.isfinite(measured))
    if known.size < _LEAST_BLOCKS:
        return np.inf
    wanted, measured = wanted[known], measured[known]
    starts, lengths = _runs(wanted)
    missed = []
    for first, length in zip(starts, lengths, strict=True):
        rise = wanted[first] - float(measured.min())
        if length >= _LEAST_HELD and rise > 2.0 * _REGULATED_K:
            settled = measured[first + length // 2 : first + length]
            off = float(np.median(np.abs(settled - wanted[first])))
            missed.append(off / max(_REGULATED_K, _REGULATED_SHARE * rise))
    return float(np.median(missed)) if missed else np.inf


def examine_sensors(
    seconds: Array, temperature: Array, drivers: Array | None = None, *, regulated: Sequence[int] = ()
) -> list[SensorFault]:
    """Examine temperature sensors; what those do that are `regulated` by a set point is the controller's doing."""
    if seconds.size < _LEAST_BLOCKS or temperature.shape[1] == 0:
        return []
    faults, sound = examine_readings(seconds, temperature, drivers, quantity="temperature", regulated=regulated)
    ended = _ended(seconds, sound)
    faults = [*ended, *(fault for fault in faults if fault.sensor not in {one.sensor for one in ended})]
    kept = [k for k in range(temperature.shape[1]) if k not in {fault.sensor for fault in ended}]
    kept = [k for k in kept if np.isfinite(sound[:, k]).sum() >= _LEAST_BLOCKS]
    grids = lay_grid(seconds, sound, drivers)
    if not kept or grids is None:
        return faults
    free = [k for k in kept if k not in regulated]
    stuck = _stuck(seconds, sound, grids[-1], kept, free)
    kept, free = ([k for k in some if k not in {fault.sensor for fault in stuck}] for some in (kept, free))
    changed = _changed(grids, kept, free)
    named = {fault.sensor for fault in changed}
    noisier = [fault for fault in _noisier(seconds, sound, grids[-1], kept) if fault.sensor in {*free} - named]
    return sorted([*faults, *stuck, *changed, *noisier], key=lambda fault: fault.sensor)


def examine_readings(
    seconds: Array,
    values: Array,
    drivers: Array | None,
    *,
    quantity: Literal["temperature", "displacement"],
    regulated: Sequence[int] = (),
) -> tuple[list[SensorFault], Array]:
    """Find readings (n, channels) that are none: of a dead input, of an erratic time, and those that leave the course and come back.

    Returns them, and the readings with NaN in their place.
    """
    faults, sound = [], values.copy()
    step = float(np.median(np.diff(seconds)))
    for k in range(values.shape[1]):
        none = no_readings(values[:, k]) if quantity == "temperature" else np.zeros(seconds.size, bool)
        sound[none, k] = np.nan
        if quantity == "temperature" and (k in regulated or is_heated(sound[:, k], np.delete(sound, k, axis=1)).any()):
            erratic, off, glitches, largest = none & False, 0.0, none & False, 0.0
        else:
            erratic, off = _erratic(sound[:, k], drivers)
            sound[erratic, k] = np.nan
            glitches, largest = _glitches(sound[:, k], drivers)
        sound[glitches, k] = np.nan
        for kind, at_fault, size in (
            (Kind.NO_SIGNAL, none, np.nan),
            (Kind.ERRATIC, erratic, off),
            (Kind.GLITCH, glitches, largest),
        ):
            if at_fault.any():
                fault = SensorFault(k, kind, True, 0.0, step, size, quantity=quantity)
                faults.append(_in_stretches(fault, seconds, at_fault))
    return faults, sound


def no_readings(values: Array) -> NDArray[np.bool_]:
    """Numbers (n,) of a temperature sensor that are none of a temperature: beyond what can be measured, or at the rail of an input.

    A rail is one number that lies far from all other readings, documented, or repeated to the last digit far longer than any of them; above
    all others it may as well be the level at which a heater is held, between two readings that are far apart.
    """
    with np.errstate(invalid="ignore"):
        none = ~((values >= MEASURABLE_DEGC[0]) & (values <= MEASURABLE_DEGC[1])) & np.isfinite(values)
    documented = np.abs(values[:, None] - np.array(_RAILS_DEGC)).min(axis=1) < 0.1
    course = values[np.isfinite(values) & ~none & ~documented]
    if course.size == 0:
        return none
    low, high = float(course.min()), float(course.max())
    away = np.fmax(low - values, values - high) > max(_RAIL_K, high - low)
    none |= documented & away
    # Of other numbers one says it by being repeated alone.
    known = values[np.isfinite(values) & ~none]
    length, first, ordinary = _longest_run(known)
    rest = known[known != known[first]]
    if rest.size and length > excursion_limit(1) * max(ordinary, _LEAST_REPEATED / _MOVES):
        away_K = float(np.abs(rest - known[first]).min())
        is_level = rest.max() < known[first] <= _HEATED_DEGC and np.round(known[first] / _SET_STEP_K, 6) % 1.0 == 0.0
        # What is constant otherwise too, as a set point that nothing follows, is no course that a rail could lie away from.
        moves = np.count_nonzero(np.diff(rest)) >= _LEAST_HELD
        if moves and away_K > max(_RAIL_K, float(np.ptp(rest))) and not is_level:
            none |= values == known[first]
    return none


def is_heated(values: Array, others: Array) -> NDArray[np.bool_]:
    """Readings (n,) at the level of a heater: held for half the time in which a sensor is far above most others (n, k); else none."""
    level = np.zeros(values.size, bool)
    known = values[np.isfinite(values)]
    if known.size < _LEAST_BLOCKS or others.shape[1] == 0:
        return level
    coldest = float(known.min())
    beside = np.median(np.nan_to_num(others, nan=coldest), axis=1)
    with np.errstate(invalid="ignore"):
        hot = np.sort(values[values > np.maximum(beside, coldest) + _HEATED_K])
    if hot.size < _LEAST_HELD:
        return level
    half = hot.size // 2
    place = int((hot[half:] - hot[: hot.size - half]).argmin())
    low, high = float(hot[place]), float(hot[place + half])
    if high - low > 2.0 * max(_REGULATED_K, _REGULATED_SHARE * (low - coldest)):
        return level
    return np.asarray((values >= low) & (values <= high))


def _ended(seconds: Array, sound: Array) -> list[SensorFault]:
    """Sensors that give no signal for most of the record, or at its end."""
    step = float(np.median(np.diff(seconds)))
    faults = []
    for k, values in enumerate(sound.T):
        readings = np.flatnonzero(np.isfinite(values))
        last_s = float(seconds[readings[-1]]) + step if readings.size else float(seconds[0])
        if seconds[-1] - last_s > _ENDED_SHARE * (seconds[-1] - seconds[0]) - step:
            faults.append(SensorFault(k, Kind.NO_SIGNAL, True, last_s, step, np.nan))
        elif readings.size < 0.5 * seconds.size:
            first_s = float(seconds[np.argmax(~np.isfinite(values))])
            faults.append(SensorFault(k, Kind.NO_SIGNAL, True, first_s, step, np.nan))
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


def _stuck(
    seconds: Array, temperature: Array, grid: Grid, kept: Sequence[int], suspects: Sequence[int]
) -> list[SensorFault]:
    """Channels that repeat one reading to the last digit far longer than ever before, though their noise or the others say they moved."""
    limit = excursion_limit(len(kept))
    faults = []
    for k in suspects:
        known = np.flatnonzero(np.isfinite(temperature[:, k]))
        values = temperature[known, k]
        length, first, ordinary = _longest_run(values)
        rest = np.delete(values, slice(first, first + length))
        # What holds from the first reading on and moves later was at rest: no fault is seen to begin.
        rests = first == 0 and length < values.size
        if rests or length < max(_LEAST_REPEATED, limit * max(ordinary, _by_chance(rest == values[first]))):
            continue
        run = known[first : first + length]
        others = [j for j in kept if j != k]
        moving = [j for j in others if np.ptp(temperature[run, j]) != 0.0]
        # A logger that stands still repeats all of them, and what is heated holds its level.
        if (others and len(moving) <= 0.5 * len(others)) or is_heated(temperature[:, k], temperature[:, others])[
            run
        ].all():
            continue
        first_s, last_s = float(seconds[run[0]]), float(seconds[run[-1]])
        inside = (grid.seconds >= first_s) & (grid.seconds <= last_s)
        restless = ordinary <= _ORDINARY_RUN and _is_fine(rest)
        if restless or _has_noise(rest) or _moved_alone(grid, k, moving, inside):
            step, ratio = float(np.median(np.diff(seconds))), length / max(ordinary, 1)
            faults.append(SensorFault(k, Kind.STUCK, True, first_s, step, 0.0, ratio, limit))
    return faults


def _by_chance(is_value: NDArray[np.bool_]) -> float:
    """Longest run of a value that readings repeat by chance as often as these do, as rounded noise does (Erdos and Renyi 1970)."""
    often = float(np.clip(is_value.mean() if is_value.size else 0.0, 1e-9, 1.0 - 1e-9))
    return float(np.log(max(is_value.size * (1.0 - often), 1.0)) / -np.log(often))


def _is_fine(values: Array) -> bool:
    """Whether half of all changes are several digits."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > 0.0]
    return bool(steps.size and np.median(steps) >= _MOVES * float(np.diff(np.unique(values)).min()))


def _has_noise(values: Array) -> bool:
    """Whether readings go up and down from one to the next, as noise beyond their digits does."""
    steps = np.diff(values)
    moved = np.sign(steps[steps != 0.0])
    often = moved.size >= max(_LEAST_REPEATED, _NOISE_STEPS * steps.size)
    return bool(often and np.mean(moved[1:] != moved[:-1]) >= _NOISE_TURNS)


def _moved_alone(grid: Grid, sensor: int, others: list[int], inside: NDArray[np.bool_]) -> bool:
    """Whether the prediction of a sensor, as learnt elsewhere, moves while it stands still, beyond what the prediction misses elsewhere."""
    if not others:
        return False
    # The longest changes are few, so that their prediction is learnt worst: the duration at which it is good is not known before.
    for duration in grid.durations():
        changes = predicted_changes(grid, sensor, others, duration, apart_from=inside)
        within = inside[changes.before] & inside[changes.after]
        elsewhere = ~(inside[changes.before] | inside[changes.after])
        if within.any() and elsewhere.sum() >= _LEAST_REPEATED:
            missed = max(float(np.quantile(np.abs(changes.residual[elsewhere]), 0.95)), changes.least_K)
            if np.abs(changes.residual[within]).max() > _MOVES * missed:
                return True
    return False


@dataclass(frozen=True)
class _Suspicion:
    """The strongest excursion of a sensor: over the limit where `excess` is above 1."""

    sensor: int
    excess: float
    found: Excursion
    grid: Grid


def _changed(grids: list[Grid], kept: Sequence[int], suspects: Sequence[int]) -> list[SensorFault]:
    """Sensors that jump or ramp away from their prediction."""
    faults: list[SensorFault] = []
    left = list(kept)
    while left:
        suspicions = [_strongest(grids, k, [j for j in left if j != k], len(kept)) for k in left if k in suspects]
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
        told = [_describe(grids, one, sound, responding=responding, alone=len(survivors) == 1) for one in named]
        faults += [
            fault
            for fault in told
            if (fault.kind is Kind.JUMP and grids[0].step_s <= _HEATER_S)
            or not _is_regulated(grids[-1], fault.sensor, [j for j in kept if j != fault.sensor])
        ]
        left = [j for j in left if j not in {one.sensor for one in named}]
    return faults


def _is_regulated(grid: Grid, sensor: int, others: list[int]) -> bool:
    """Whether a sensor is at a heater: while it is warm it holds its level, whatever the others do."""
    values = grid.temperature[:, sensor]
    level = is_heated(values, grid.temperature[:, others])
    if not level.any():
        return False
    beyond = level_beyond_prediction(grid, sensor, others)
    return float(np.std(values[level])) <= float(np.std(beyond[level]))


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
    fine = grids[0]
    near = (fine.seconds >= ramp.begin_s - 2.0 * fine.step_s) & (fine.seconds <= ramp.end_s + 2.0 * fine.step_s)
    largest = float(np.abs(np.diff(fine.temperature[near, suspicion.sensor])).max(initial=0.0))
    at_once = largest >= _AT_ONCE * abs(ramp.size_K)
    kind = Kind.JUMP if at_once else Kind.RAMP
    fast = at_once and fine.step_s <= _FAST_S
    near_s = ramp.begin_s - 2.0 * coarse.step_s, ramp.end_s + 2.0 * coarse.step_s
    reasons = {
        "another sensor deviates at the same time": not alone,
        "other sensors respond, so that it may be a source of heat": responding,
        _SWITCHED_RARELY: coarse.switched_rarely(*near_s),
        "the other sensors predict too little of its signal to distinguish a fault from a heat source": not (
            fast or _shared_by_others(coarse, suspicion.sensor, sound) >= _PREDICTABLE
        ),
    }
    reason = next((words for words, holds in reasons.items() if holds), "")
    return SensorFault(
        suspicion.sensor,
        kind,
        is_clear=not reason,
        onset_s=ramp.begin_s,
        onset_u_s=ramp.begin_u_s,
        size=ramp.size_K,
        ratio=found.ratio,
        limit=found.ratio / suspicion.excess,
        reason=reason,
        end_s=ramp.end_s,
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
    for place, column in enumerate(temperature[:, kept].T):
        digits = np.diff(np.unique(column[np.isfinite(column)]))
        least = float(digits.min(initial=np.inf)) / np.sqrt(12.0)
        for window, some in enumerate(column[: _NOISE_WINDOWS * size].reshape(_NOISE_WINDOWS, size)):
            if np.isfinite(some).sum() - 2 >= _NOISE_SAMPLES // 2:
                scale[window, place] = max(sample_noise(some[np.isfinite(some)]), least)
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
        reason = _SWITCHED_RARELY if grid.switched_rarely(onset - window_s, onset + window_s) else ""
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
    channels = range(displacement.shape[1])
    every = np.column_stack([displacement, *(np.where(no_readings(one), np.nan, one) for one in temperature.T)])
    kept = [k for k in range(every.shape[1]) if np.isfinite(every[:, k]).sum() >= _LEAST_BLOCKS]
    grids = lay_grid(seconds, every, drivers) if seconds.size >= _LEAST_BLOCKS else None
    if grids is None:
        return []
    faults, moving = [], displacement.copy()
    for fault in _stuck(seconds, every, grids[-1], kept, [k for k in channels if k in kept]):
        values, at_fault = displacement[:, fault.sensor], np.zeros(seconds.size, bool)
        known = np.flatnonzero(np.isfinite(values))
        value = values[np.searchsorted(seconds, fault.onset_s)]
        _, lengths = _runs(values[known])
        at_fault[known] = np.repeat(lengths >= _LEAST_REPEATED, lengths) & (values[known] == value)
        kind = Kind.CLIPPED if value in (values[known].min(), values[known].max()) else Kind.STUCK
        moving[at_fault, fault.sensor] = np.nan
        told = replace(fault, kind=kind, size=np.nan, quantity="displacement")
        faults.append(_in_stretches(told, seconds, at_fault))
    return [*faults, *examine_readings(seconds, moving, drivers, quantity="displacement")[0]]


def _erratic(values: Array, drivers: Array | None) -> tuple[NDArray[np.bool_], float]:
    """Readings from the first to the last of every erratic time, in which a channel goes wildly up and down, and the largest step in it."""
    at_fault, largest = np.zeros(values.size, bool), 0.0
    known = np.flatnonzero(np.isfinite(values))
    if known.size < _LEAST_BLOCKS or np.ptp(values[known]) == 0.0:
        return at_fault, largest
    steps = np.diff(values[known])
    limit = _WILD * max(float(np.quantile(np.abs(steps), 0.75)), float(np.diff(np.unique(values[known])).min()))
    wild = np.flatnonzero(np.abs(steps) > limit)
    for together in np.split(wild, np.flatnonzero(np.diff(wild) > _CALM_READINGS) + 1):
        turns = (np.diff(together) <= 2) & (np.diff(np.sign(steps[together])) != 0.0)
        # A glitch turns once for two wild steps, as the reading after it is on the course again.
        if turns.sum() >= _LEAST_TURNS and not _switched_at(drivers, known[together]):
            first, last = int(together[0]) + 1, int(together[-1])
            # It begins and ends where the channel is back on its course.
            before = float(np.median(values[known[max(0, first - _GLITCH_READINGS) : first]]))
            after = float(np.median(values[known[last + 1 : last + 1 + _GLITCH_READINGS]]))
            while first > 1 and abs(values[known[first - 1]] - before) > _BACK * limit:
                first -= 1
            while last < known.size - 2 and abs(values[known[last + 1]] - after) > _BACK * limit:
                last += 1
            at_fault[known[first] : known[last] + 1] = True
            largest = max(largest, float(np.abs(steps[together]).max()))
    return (at_fault, largest) if at_fault.mean() <= _ERRATIC_SHARE else (np.zeros(values.size, bool), 0.0)


def _switched_at(drivers: Array | None, places: NDArray[np.intp]) -> bool:
    """Whether a load is switched at most of these steps from one sample to the next."""
    if drivers is None or drivers.shape[1] == 0:
        return False
    loads = np.nan_to_num(drivers)
    switched = (np.abs(np.diff(loads, axis=0)) > _SWITCHED * np.ptp(loads, axis=0)).any(axis=1)
    return bool(np.mean(switched[np.minimum(places, switched.size - 1)]) > 0.5)


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
        # A smooth course leaves nothing about its running median but where it turns, by a few of its steps.
        usual = max(float(np.quantile(off, 0.9)), 0.5 * float(np.quantile(np.abs(np.diff(values)), 0.9)))
        limit = _GLITCH * max(usual, float(np.diff(np.unique(values)).min()))
        course = values[off <= limit]
        steepest = float(np.abs(np.diff(course)).max())
        steps = np.abs(np.diff(values, prepend=values[0]))
        switched = np.abs(np.diff(loads[known], axis=0, prepend=loads[known[:1]])) > _SWITCHED * np.ptp(loads, axis=0)
        switched[:, switched.mean(axis=0) > _OFTEN] = False
        edges = np.flatnonzero(np.diff(np.r_[False, off > limit, False]))
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            size = float(off[first:end].max())
            # The median itself is off beside a long stretch, so that the steps say where it begins and ends.
            borders = first + np.flatnonzero(steps[first : end + 1] > max(limit, _ABRUPT * size))
            # A burst of a few readings climbs in parts: more than the rest of the course ever moves in as many.
            if 0 < first < end < values.size and end - first <= _GLITCH_READINGS:
                moves = np.abs(course[end - first :] - course[: first - end]).max(initial=0.0)
                far = size > excursion_limit(1) * max(limit, float(moves))
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
