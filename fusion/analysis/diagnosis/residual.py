"""Permutation tests for structure in the residual, and a description of it in words a metrologist can check.

The noise that the fit estimates for every reading is laid out as a matrix of cycles and sites (target and direction). Where the
model is complete, cycles are exchangeable within a site; permuting them gives every statistic its null, whatever the tails or the
scatter of the single site. The shape is described from the readings minus the fixed effects, freed of offset and stretch per cycle,
not from the whitened noise: the drift swallows a part of slow patterns (docs/method/closed-loop.md).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import Readings
from fusion.analysis.drift_model.model import ModelFit, unexplained_drift
from fusion.analysis.drift_model.null_simulation import family_wise, rank_p_value
from fusion.analysis.effects.events import off_the_cycle
from fusion.analysis.levels import REMAINDER_LEVEL
from fusion.common import Array
from fusion.results.loop import ResidualPart
from interferometry.drift.gls import NO_MEMORY, Autoregression, DriftFit
from thermofuse.resources import sentence
from thermography.large_arrays import empty_arrays, one_by_one

_PERMUTATIONS = 400
_BLOCK = 5
#: An unexplained drift counts as a remainder from this share of a reading's noise on.
DRIFT_SHARE = 0.5
#: Return a sentence on what is left of the readings.
say = partial(sentence, "diagnosis", "remainder")


@dataclass(frozen=True)
class PermutationTest:
    """Several statistics of a residual against their permutation distribution: family-wise p-value, that of each alone, and the most
    unusual one.
    """

    p_value: float
    p_values: dict[str, float]
    strongest: str


def permutation_test(
    residual: Array,
    statistics: Callable[[Array], Array],
    permute: Callable[[Array], Array],
    *,
    names: Sequence[str],
) -> PermutationTest:
    """Test a residual for structure."""
    null = np.array([statistics(permute(residual)) for _ in range(_PERMUTATIONS)])
    each, p_value, strongest = family_wise(statistics(residual), null)
    return PermutationTest(p_value, dict(zip(names, each.tolist(), strict=True)), names[strongest])


@dataclass(frozen=True)
class ResidualStructure:
    """Structure that a model leaves in its residual.

    Attributes
    ----------
    p_value : probability of so much structure where nothing is missing, family-wise over all statistics
    p_values : the same for each statistic alone
    shape : in words, empty where nothing remains
    rms_um : root mean square of the described shape over the readings; 0 where its size is that of the hold-out error beside the noise
    """

    p_value: float
    p_values: dict[str, float]
    shape: str
    rms_um: float

    @property
    def is_tested(self) -> bool:
        """Whether a permutation test shows the shape; a drift counts by its size alone."""
        return bool(self.shape) and self.p_value < REMAINDER_LEVEL


@dataclass(frozen=True)
class Remainder(ResidualStructure):
    """What a model leaves along an axis.

    Attributes
    ----------
    along_time, along_sites : the leading pattern (cycles,) in um and its weight per site, at most 1
    series : what is left at every reading (n,), um
    free : takes from columns (n, q) what could not have been left
    """

    cycles: NDArray[np.int64]
    along_time: Array
    sites: list[tuple[int, str]]
    along_sites: Array
    series: Array
    free: Callable[[Array], Array]

    def share_of(self, columns: Array) -> float:
        """Share of the remainder's variance that columns (n, q) explain beside what the model has already."""
        beside = self.free(columns)
        left = self.series - beside @ np.linalg.lstsq(beside, self.series, rcond=None)[0]
        return float(1.0 - left @ left / max(float(self.series @ self.series), 1e-300))


def examine(
    readings: Readings,
    fit: DriftFit,
    rng: np.random.Generator,
    *,
    memory: Autoregression = NO_MEMORY,
    set_aside: Collection[tuple[int, str]] = (),
) -> Remainder:
    """Test what the fit leaves for structure and describe the largest of it; ``memory`` is that of each site's noise over the cycles."""
    # Where the noise has a memory, it is taken out below: what the model expects of a reading depends on the scatter of its neighbours.
    noise = (
        fit.whole_noise()[0] / (fit.sigma * np.sqrt(fit.system.variance)) if fit.system.memory else fit.white_noise()
    )
    cycles, numbers, matrix = readings.by_site(np.clip(noise, -4.0, 4.0))
    sites = [(int(readings.targets[k // 2]), "negative" if k % 2 else "positive") for k in numbers]
    kept = [k for k, site in enumerate(sites) if site not in set(set_aside)]
    if fit.system.memory is not None:
        matrix = _without_the_one_before(matrix, readings.by_site(readings.seconds)[2], fit.system.memory.time_s)
    tested = matrix[:, kept]
    tested = (tested - np.nanmean(tested, axis=0)) / np.maximum(np.nanstd(tested, axis=0), 1e-9)
    # Permuted cycles have no memory: noise that has one would pass for a pattern.
    tested = memory.innovations(np.nan_to_num(tested).T).T if memory.weights.size else tested
    signs = np.array([1.0 if sites[k][1] == "positive" else -1.0 for k in kept])
    share_of = readings.positions_mm / readings.span_mm
    place = np.array([share_of[np.flatnonzero(readings.targets == sites[k][0])[0]] for k in kept])

    shapes = _shapes(signs, place)
    # Cycles are shuffled within each site; missing readings move along.
    test = permutation_test(
        tested,
        lambda matrix: _statistics(matrix, shapes),
        lambda matrix: rng.permuted(matrix, axis=0),
        names=("pattern", "slow_pattern", "single_target", "direction", "direction_along_axis", "curvature"),
    )
    unwhitened = _freed(readings, fit.residual()[:, None])[:, 0]
    _, _, residual = readings.by_site(unwhitened)
    along_time, along_sites, rms = _leading(residual[:, kept])
    named_sites = [sites[k] for k in kept]
    shape = ""
    if test.p_value < REMAINDER_LEVEL:
        shape = f"{_time_words(cycles, along_time, readings)}; {_place_words(named_sites, along_sites)}"
    free = partial(_freed, readings)
    # The leading pattern at every reading; zero at sites that were set aside.
    by_site = dict(zip(named_sites, along_sites, strict=True))
    direction = np.where(readings.sign > 0, "positive", "negative")
    weight = [by_site.get((int(t), str(d)), 0.0) for t, d in zip(readings.target, direction, strict=True)]
    pattern = np.asarray(along_time[np.searchsorted(cycles, readings.cycle)] * np.array(weight))
    series = free(pattern[:, None])[:, 0]
    rms = rms if shape else 0.0
    return Remainder(
        test.p_value, test.p_values, shape, rms, cycles, along_time, named_sites, along_sites, series, free
    )


def with_drift(remainder: Remainder, fit: DriftFit) -> Remainder:
    """Count a common drift or a stretch as a remainder where it is larger than half the noise of a reading."""
    drift, basis = unexplained_drift(fit)
    sizes = np.sqrt(np.mean(drift**2, axis=0))
    largest = int(np.argmax(sizes))
    if sizes[largest] <= DRIFT_SHARE * fit.sigma:
        return remainder
    course = "smooth" if fit.system.order == 2 else "irregular"
    where = say("alike" if largest == 0 else "growing") if sizes.size == 2 else f"channel {largest + 1}"
    return replace(
        remainder,
        shape=say("slow", course=course, where=where),
        rms_um=float(sizes[largest]),
        series=drift[:, largest],
        free=lambda columns: columns - basis @ (basis.T @ columns),
    )


def _without_the_one_before(matrix: Array, seconds: Array, memory_s: float) -> Array:
    """Take from every reading (cycles, sites) its share of the one before in time, as permuted sites have none of it."""
    order = np.argsort(np.nanmean(seconds - np.nanmin(seconds, axis=1, keepdims=True), axis=0))
    relative = matrix / np.maximum(np.nanstd(matrix, axis=0), 1e-9)
    series, at = relative[:, order].ravel(), seconds[:, order].ravel()
    before, between = np.nan_to_num(series[:-1]), np.diff(at)
    # From one pass or cycle to the next it takes longer.
    before *= np.nan_to_num(np.minimum(np.exp((np.nanmedian(between) - between) / memory_s), 1.0))
    share = float(np.clip(np.nansum(series[1:] * before) / (before @ before), 0.0, 0.9))
    white = np.empty(relative.shape)
    white[:, order] = np.r_[series[:1], series[1:] - share * before].reshape(relative.shape)
    return white


def _shapes(signs: Array, place: Array) -> tuple[Array, ...]:
    """Weights of the sites (sites,) in a reversal, a reversal that grows along the axis, and a curvature."""
    basis, curved = np.column_stack([np.ones_like(place), place]), (place - place.mean()) ** 2
    return signs, signs * (place - place.mean()), curved - basis @ np.linalg.lstsq(basis, curved, rcond=None)[0]


def _statistics(matrix: Array, shapes: Sequence[Array]) -> Array:
    """Six statistics that grow with structure: two of rank one, one of a single place, three of given shapes (sites,) over time."""
    filled = np.nan_to_num(matrix)
    blocks = filled[: filled.shape[0] // _BLOCK * _BLOCK].reshape(-1, _BLOCK, filled.shape[1]).mean(axis=1)
    return np.array(
        [
            _largest(filled),
            _largest(blocks) if blocks.shape[0] > 1 else 0.0,
            (blocks**2).sum(axis=0).max() if blocks.shape[0] > 1 else 0.0,
            *(_slowness(filled @ shape) for shape in shapes),
        ]
    )


def _largest(matrix: Array) -> float:
    """Largest singular value, from the products of its columns or of its rows, whichever are fewer."""
    narrow = matrix if matrix.shape[1] <= matrix.shape[0] else matrix.T
    return float(np.sqrt(np.linalg.eigvalsh(narrow.T @ narrow)[-1]))


def _slowness(series: Array) -> float:
    """Share of a series' variance that its first differences lack (von Neumann): 0 for white, 1 for very slow."""
    centred = series - series.mean()
    total = float(centred @ centred)
    if total <= 0.0 or series.size < 4:
        return 0.0
    return 1.0 - 0.5 * float(np.diff(series) @ np.diff(series)) / total * series.size / (series.size - 1)


def _freed(readings: Readings, columns: Array) -> Array:
    """Columns (n, q) freed of an offset and a stretch per cycle, which the drift would take."""
    _, cycle = np.unique(readings.cycle, return_inverse=True)
    number = np.bincount(cycle)

    def mean(values: Array) -> Array:
        """Mean over each cycle, at every reading."""
        return np.asarray((np.bincount(cycle, values) / number)[cycle])

    place = readings.share - mean(readings.share)
    # A cycle of a single target has no stretch.
    square = np.maximum(mean(place**2), 1e-12)
    free = [column - mean(column) - place * mean(place * column) / square for column in columns.T]
    return np.column_stack(free)


def _leading(matrix: Array) -> tuple[Array, Array, float]:
    """Leading pattern over time (um) and sites (largest weight 1) of a matrix with gaps, and its rms (um)."""
    filled = np.nan_to_num(matrix - np.nanmean(matrix, axis=0))
    # Runs of three cycles are averaged, so that a pattern is preferred that lasts over a single outlier.
    kernel = np.ones(3) / 3.0
    smooth = np.apply_along_axis(lambda column: np.convolve(column, kernel, mode="same"), 0, filled)
    u, s, vt = np.linalg.svd(smooth, full_matrices=False)
    weight = np.abs(vt[0]).max()
    sign = np.sign(vt[0][np.argmax(np.abs(vt[0]))])
    along_sites = vt[0] / weight * sign
    along_time = u[:, 0] * s[0] * weight * sign
    return along_time, along_sites, float(np.sqrt(np.mean(np.outer(along_time, along_sites) ** 2)))


def _time_words(cycles: NDArray[np.int64], series: Array, readings: Readings) -> str:
    """Course in time: one step, a rhythm, switching, or slow growth, whichever explains most of the series."""
    centred = series - series.mean()
    total = float(centred @ centred)
    if total <= 0.0 or series.size < 8:
        return say("no_course")
    steps = [
        (k * (series.size - k) / series.size) * (series[k:].mean() - series[:k].mean()) ** 2
        for k in range(2, series.size - 1)
    ]
    at = int(np.argmax(steps)) + 2
    spectrum = np.abs(np.fft.rfft(centred)) ** 2
    line = int(np.argmax(spectrum[1:])) + 1
    around = spectrum[max(1, line - 1) : line + 2].sum() / spectrum[1:].sum()
    ramp = np.corrcoef(np.arange(series.size), series)[0, 1] ** 2
    period = (readings.seconds[-1] - readings.seconds[0]) / 60.0 / line
    candidates = {
        say("step", cycle=cycles[at]): max(steps) / total,
        say("rhythm", minutes=period): float(around) if line > 2 else 0.0,
        say("growth"): float(ramp),
    }
    best = max(candidates, key=lambda words: candidates[words])
    if candidates[best] > 0.6:
        return best
    high = centred > 0
    changes = int((np.diff(high.astype(int)) != 0).sum())
    return say("irregular", changes=changes, cycles=series.size)


def _place_words(sites: list[tuple[int, str]], weights: Array) -> str:
    """Where along the axis and in which direction of approach the pattern acts."""
    strong = [site for site, weight in zip(sites, weights, strict=True) if abs(weight) > 0.5]
    targets = sorted({target for target, _ in strong})
    directions = {direction for _, direction in strong}
    signs = {np.sign(weight) for weight in weights if abs(weight) > 0.5}
    by_site = dict(zip(sites, weights, strict=True))
    pairs = [
        (by_site[(t, "positive")], by_site[(t, "negative")])
        for t, d in sites
        if d == "positive" and (t, "negative") in by_site
    ]
    even = sum((a + b) ** 2 for a, b in pairs)
    odd = sum((a - b) ** 2 for a, b in pairs)
    where = f"target {targets[0]}" if len(targets) == 1 else f"targets {_runs(targets)}"
    if len(directions) == 1:
        return say("one_way", where=where, direction=next(iter(directions)))
    if odd > 4 * even:
        return say("opposite", where=where)
    return say("opposed" if len(signs) == 2 else "both_ways", where=where)


def _runs(numbers: list[int]) -> str:
    """Numbers as ranges: 1-3, 7."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts)


# Tests of a model's residual for structure along time, at one instant, in frequency, along the axis and by direction.

#: Number of autocorrelations tested, in readings; a cycle has some thirty readings.
_LAGS = 12
#: Shortest period tested, min; maximum number of periods, spaced by half the resolution of the record; oscillations of the longest period.
_SHORTEST_MIN = 3.0
_MOST_PERIODS = 300
_FEWEST_OSCILLATIONS = 2.0
#: Innovations are clipped at this number of standard deviations.
_CLIP = 4.0
#: Quantile of the largest power under the null hypothesis that is given as its limit.
_LIMIT = 0.95
#: Permutations that are evaluated at once at most, and values of them, 8 MB.
_BATCH, _VALUES_AT_ONCE = 50, 2**20
#: Values of waves that lie together, 16 MB.
_WAVES_AT_ONCE = 2**22


class ResidualTests(ResidualPart):
    """Structure in the residual of one model, with what the tests rest on.

    The tests are "autocorrelation", "event", "periodicity", and those of :mod:`fusion.analysis.diagnosis.residual`.
    """

    innovations: Array
    """(n,) prediction error of each reading from those before it, in standard deviations."""
    periods_min: Array
    """(m,) periods, longest first, min."""
    power: Array
    """(m,) power of the innovations, 1; noise has mean power 1."""
    power_limit: float
    """The power that the largest one exceeds under the null hypothesis in 5 % of campaigns."""


def examine_residual(model: ModelFit, rng: np.random.Generator) -> ResidualTests:
    """Test the residual of a model for structure."""
    readings, fit = model.readings.subset(model.used), model.fit
    innovations = fit.innovations()
    clipped = np.clip(innovations, -_CLIP, _CLIP)
    window = max(2, round(readings.seconds.size / np.unique(readings.cycle).size))
    periods = _periods_min(readings.seconds)
    waves = _waves(readings.seconds, periods)
    memory, shift, power = _time_statistics(clipped[None, :], window, waves)
    null = []
    # Some permutations at a time; of each the memory, the largest shift and the largest power.
    at_once = min(_BATCH, max(1, _VALUES_AT_ONCE // clipped.size))
    for start in range(0, _PERMUTATIONS, at_once):
        permuted = rng.permuted(np.tile(clipped, (min(at_once, _PERMUTATIONS - start), 1)), axis=1)
        memories, shifts, powers = _time_statistics(permuted, window, waves)
        null.append((memories, shifts.max(axis=1), powers.max(axis=1)))
    memories, shifts, strongest = (np.concatenate(largest) for largest in zip(*null, strict=True))
    p_values = {
        "autocorrelation": rank_p_value(memory[0], memories),
        "event": rank_p_value(shift[0].max(), shifts),
        "periodicity": rank_p_value(power[0].max(), strongest),
        **examine(readings, fit, rng, memory=model.memory).p_values,
    }
    drift, _ = unexplained_drift(fit)
    sizes = np.sqrt(np.mean(drift**2, axis=0))
    return ResidualTests(
        p_values=p_values,
        drift_common_um=float(sizes[0]),
        drift_stretch_um=float(sizes[1]) if sizes.size > 1 else 0.0,
        event_s=float(readings.seconds[int(np.argmax(shift[0]))]),
        period_min=float(periods[np.argmax(power[0])]),
        innovations=innovations,
        periods_min=periods,
        power=power[0],
        power_limit=float(np.quantile(strongest, _LIMIT)),
        period_is_cycle=not off_the_cycle(readings, 1.0 / periods[[np.argmax(power[0])]]).size,
    )


def _periods_min(seconds: Array) -> Array:
    """Return the periods that are tested, min, longest first; of a test of some minutes the longest alone."""
    span = float(seconds[-1] - seconds[0]) / 60.0
    lowest, step = _FEWEST_OSCILLATIONS / span, 0.5 / span
    highest = min(max(1.0 / _SHORTEST_MIN, lowest + 0.5 * step), lowest + (_MOST_PERIODS - 0.5) * step)
    return np.asarray(1.0 / np.arange(lowest, highest, step, dtype=np.float64))


def _waves(seconds: Array, periods_min: Array) -> list[NDArray[np.float32]]:
    """Return cosines and sines of some periods each, (n, 2 some), all sines after all cosines; those of a long test on disk."""
    parts = np.array_split(periods_min, 1 + 2 * periods_min.size * seconds.size // _WAVES_AT_ONCE)
    waves = empty_arrays([(seconds.size, 2 * some.size) for some in parts], np.float32)
    for some, of_some in zip(parts, one_by_one(waves), strict=True):
        for k, period in enumerate(some):
            phase = 2 * np.pi * seconds / (60.0 * period)
            of_some[:, k], of_some[:, some.size + k] = np.cos(phase), np.sin(phase)
    return waves


def _time_statistics(series: Array, window: int, waves: Sequence[NDArray[np.float32]]) -> tuple[Array, Array, Array]:
    """Return statistics of series (r, n): memory (r,), size of a shift from each reading on (r, n - window + 1), and power (r, m)."""
    centred = series - series.mean(axis=1, keepdims=True)
    variance = np.maximum((centred**2).mean(axis=1), 1e-300)
    lagged = [(centred[:, k:] * centred[:, :-k]).mean(axis=1) / variance for k in range(1, _LAGS + 1)]
    total = np.cumsum(np.pad(centred, ((0, 0), (1, 0))), axis=1)
    shift = np.abs(total[:, window:] - total[:, :-window]) / np.sqrt(window)
    single, powers = centred.astype(np.float32), []
    for some in one_by_one(waves):
        projected = np.asarray(single @ some, np.float64) ** 2
        half = some.shape[1] // 2
        powers.append((projected[:, :half] + projected[:, half:]) / (series.shape[1] * variance[:, None]))
    return np.asarray(np.sum(np.square(lagged), axis=0)), shift, np.hstack(powers)
