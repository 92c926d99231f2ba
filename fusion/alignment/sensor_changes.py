"""Changes of a temperature sensor over some time, and what others, loads and its own past leave of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array

#: Blocks of the coarse grid, and bins of the fine one that shows what happens within a sample or two.
BLOCKS, FINE_BINS = 600, 12_000
#: Durations of a change on the fine grid, bins.
_FINE_DURATIONS = (1, 2)
#: The longest duration leaves room for ten changes that do not overlap: fewer say nothing of the largest.
_LEAST_CHANGES = 30
#: Fewest blocks whose median stands for the level before or after a change: single spikes do not count.
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
    seconds : (n,) ndarray, s
        Middle of each step.
    step_s : float, s
        Length of a step.
    temperature : (n, sensors) ndarray, degC
        Interpolated where nothing was read.
    known : (n, sensors) ndarray of bool
        Where something was read.
    drivers : (n, k) ndarray
        Loads as shares of their range, and their squares.
    is_fine : bool
        Whether it is the fine grid.
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
    """Fit level, ramp, level by least absolute deviations.

    Parameters
    ----------
    seconds : (n,) ndarray, s
        At least four.
    values : (n,) ndarray, K
        What a sensor shows beyond its prediction.

    Notes
    -----
    The begin is where two lines meet: scatter about them over the slope of the ramp is its uncertainty, beside that of one step.
    """
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
    before, after : (m,) ndarray of int
        Last step before and first step after each change.
    residual : (m,) ndarray, K
        What is left of the change by the prediction.
    reach : int
        Steps within which two changes share samples.
    least_K : float
        Resolution of the sensor.
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
    """Lay a fine and a coarse grid, the fine one only where it is finer.

    Parameters
    ----------
    seconds : (n,) ndarray, s
        Increasing.
    temperature : (n, sensors) ndarray, degC
        NaN where nothing was read.
    drivers : (n, k) ndarray or None
        Loads.

    Returns
    -------
    list of Grid or None
        The coarse one last; None where the times do not increase.
    """
    step = float(np.median(np.diff(seconds)))
    if step <= 0.0:
        return None
    loads = np.empty((seconds.size, 0)) if drivers is None else np.nan_to_num(drivers)
    span = np.ptp(loads, axis=0)
    loads = (loads - loads.min(axis=0))[:, span > 0.0] / span[span > 0.0]
    loads = np.hstack([loads, loads**2])
    lengths = [step * max(1, int(np.ceil(seconds.size / most))) for most in (FINE_BINS, BLOCKS)]
    grids = [_grid(seconds, temperature, loads, length, is_fine=False) for length in lengths[1:]]
    if lengths[0] < lengths[1]:
        grids.insert(0, _grid(seconds, temperature, loads, lengths[0], is_fine=True))
    return grids


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
    """Predict the changes of a sensor from those of the others, of the loads, and from all changes just before.

    Parameters
    ----------
    grid : Grid
        Medians of the samples.
    sensor : int
        The sensor.
    others : list of int
        Those that predict it.
    duration : int
        Of the changes, steps of the grid.

    Notes
    -----
    Ridge regression (Hoerl and Kennard 1970) whose effective number of coefficients is a fifth of the changes that do not overlap, with
    Huber's weights, so that the change in question does not enter its own prediction.
    """
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
    """The largest excursion of a sensor, with its size over that of the next, which shares no sample with it.

    Parameters
    ----------
    changes : Changes
        Of one duration.

    Returns
    -------
    Excursion or None
        None where nothing is left to compare.
    """
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
    """What a sensor shows beyond its prediction from the levels of the others, K; the coefficients are those of the longest changes.

    Parameters
    ----------
    grid : Grid
        Medians of the samples.
    sensor : int
        The sensor.
    others : list of int
        Those that predict it; none leaves the sensor as it is.
    """
    own = grid.temperature[:, sensor]
    if not others:
        return own
    duration = grid.durations()[-1]
    differences, length = _differences(grid.temperature[:, [sensor, *others]], duration)
    most = max(1.0, differences.shape[0] / (length + duration) / _CHANGES_PER_COEFFICIENT)
    coefficients = _robust_ridge(differences[:, 0], differences[:, 1:], most)
    return np.asarray(own - grid.temperature[:, others] @ coefficients)
