"""Anomalous positions: excess scatter, slow local motion, a step, or a periodic motion of one position; a jump before it that lasts.

A jump from pass to pass between two targets (:mod:`interferometry.links`) is sought first, and taken out. Everything else is tested on the
random part of the joint estimate, which belongs to one position and direction; differences of neighbouring positions would belong to two.
Null distributions come from permutations of the readings themselves, so that heavy tails do not raise false alarms, and every p-value is
family-wise: corrected for all positions, directions and kinds of anomaly.

Two questions are kept apart: "do the positions behave unequally?" (scatter: permutation test, robust against tails; motion: permutation of
the cycles) and "does one stand out from the natural spread of the others?" (generalised extreme Studentized deviate test). A position is an
anomaly of the machine only if both say so: scatter differs from position to position, and a drift whose shape the model does not hold moves
all positions a little.

In this order: the public test; links; excess scatter; motions over the cycles; the generalised extreme Studentized deviate test.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from interferometry.common import Array, InterferometryError, check_dataset
from interferometry.deviations import ROUNDING
from interferometry.drift.estimate import estimate_drift
from interferometry.drift.gls import memory_of_each, typical_memory, von_neumann_p_value
from interferometry.links import Jumps, find_link, fit_jumps

#: Share of the error probability given to each kind of anomaly (Bonferroni weights; they sum to one).
WEIGHTS = {"scatter": 0.6, "link": 0.1, "slow": 0.1, "step": 0.1, "periodic": 0.1}
#: Standardised readings are winsorised at this many standard deviations (efficiency 0.99 under a normal distribution).
WINSOR = 3.0
#: Cycles over which sums are taken for slow motion, and which a step needs before and after it.
BLOCK_CYCLES = 5
#: Shortest test and shortest series that are examined for motion over the cycles.
SHORTEST_TEST_CYCLES = 15
MOST_ANOMALIES = 4
#: Frequencies of a periodogram that are looked at together.
_WAVES_AT_ONCE = 128
#: Permuted values that are made at a time.
_PERMUTED_VALUES = 1 << 18
#: Levels of the tests whether a target stands out from the others: by its scatter, both directions together and either alone, and by its
#: motion over the cycles. Scatter that differs naturally is significant by permutation, so that the first two must share 0.05.
ESD_LEVELS = {"together": 0.035, "single": 0.01, "motion": 0.02}
#: Standard deviations within which values are equal.
_ARITHMETIC = 1e-6
#: Level at which the remainder of a step is still called slow.
SLOW_REMAINDER_LEVEL = 0.01


@dataclass(frozen=True)
class Anomaly:
    """One position that behaves unlike the others.

    Attributes
    ----------
    direction : "positive", "negative" or "both"
    kind : "scatter", "link", "slow", "step" or "periodic"; of a link the target is the first that its jumps carry
    p_value : family-wise: corrected for all positions, directions and kinds
    scatter_um : random standard deviation of the position and direction, um
    extra_um : standard deviation beyond that of the other positions, um; that of the jumps of a link, the height of a step, the amplitude
        of a period
    stands_out
        Whether the scatter, or the strength of the motion, exceeds its natural spread between positions (generalised extreme
        Studentized deviate test at `ESD_LEVELS`); True of a link, which is tested with the scatter of every target as it is
    at_cycle : number of the first cycle after a step
    period_s : period of a periodic motion, s
    least_p_value : smallest p-value that the number of permutations can show; 0 of a periodic motion, whose p-value is calculated
    """

    target: int
    direction: str
    kind: str
    p_value: float
    scatter_um: float
    extra_um: float
    stands_out: bool
    at_cycle: int | None = None
    period_s: float | None = None
    least_p_value: float = 0.0


def detect_anomalies(
    deviations: xr.Dataset, estimated: xr.Dataset, *, level: float = 0.05, permutations: int = 399, seed: int = 0
) -> list[Anomaly]:
    """Find positions that behave unlike the others.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um (keeps ``contract.DEVIATIONS``).
    estimated : xarray.Dataset
        What `estimate_drift` returns for them.
    level : float
        Probability of any false anomaly in a whole test, between 0 and 1 (both excluded).
    permutations : int
        Number of permutations; at least 199 for a level of 0.05.
    seed : int
        Of the random generator, so that a result is repeatable.

    Returns
    -------
    list of Anomaly
        The most significant first; at most one per position and kind. Motions over the cycles are sought in tests of at least
        15 cycles.

    Raises
    ------
    InterferometryError
        A Dataset lacks a variable, ``level`` is not a probability between 0 and 1, or ``permutations`` are too few to reach it in the kind
        with the smallest weight.

    Notes
    -----
    docs/method/anomalies.md. Links: readings are permuted between the positions of a pass; the jumps of one that is found are taken out
    and the drift is estimated again with the default arguments. Scatter: readings are permuted alike, the largest excess of a position is
    compared with its permutation distribution, step down. Slow motion and steps: cycles are permuted, all positions alike (Westfall and
    Young 1993, *Resampling-based multiple testing*). Periods: largest normalised power over all frequencies and series (Scargle 1982,
    Astrophys. J. 263, 835), Bonferroni. Standing out: Rosner (1983), Technometrics 25, 165.

    Examples
    --------
    Sixteen positions, of which the third scatters three times as much as the others:

    >>> import numpy as np
    >>> from interferometry.deviations import build_deviations
    >>> from interferometry.drift.estimate import estimate_drift
    >>> rng = np.random.default_rng(0)
    >>> deviation = rng.normal(0, 0.3, (14, 2, 16))
    >>> deviation[:, :, 2] *= 3
    >>> time = np.datetime64("2026-03-09T06:30") + 8 * np.arange(deviation.size).reshape(deviation.shape) * np.timedelta64(1, "s")
    >>> test = build_deviations(range(1, 15), range(1, 17), 20.0 * np.arange(16), deviation, time)
    >>> [(a.target, a.direction, a.kind, a.stands_out) for a in detect_anomalies(test, estimate_drift(test))]
    [(3, 'both', 'scatter', True)]
    """
    deviations = check_dataset(deviations, "deviations")
    estimated = check_dataset(estimated, "estimated")
    if not 0 < level < 1:
        raise InterferometryError(f"level={level} is not a probability between 0 and 1; 0.05 is usual")
    needed = int(np.ceil(1.0 / (level * min(WEIGHTS.values()))))
    if permutations + 1 < needed:
        raise InterferometryError(f"permutations={permutations} cannot reach level={level}; use at least {needed - 1}")
    # Courses are those over the cycles as they were measured.
    deviations, estimated = (one.sortby("cycle") for one in (deviations, estimated))
    rng = np.random.default_rng(seed)
    links, deviations, estimated = _links(deviations, estimated, level, permutations, rng)
    # The jump of a pass is known with its noise, which at a turn nothing tells from a reading's own.
    position = deviations["position"].values
    ends = [int(position.argmin()), int(position.argmax())] if links else []
    anomalies = links + _scatter_anomalies(estimated, level, permutations, rng, ends)
    if estimated.sizes["cycle"] >= SHORTEST_TEST_CYCLES:
        anomalies += _series_anomalies(estimated, deviations, level, permutations, rng)
    return sorted(anomalies, key=lambda anomaly: anomaly.p_value)


def _links(
    deviations: xr.Dataset, estimated: xr.Dataset, level: float, permutations: int, rng: np.random.Generator
) -> tuple[list[Anomaly], xr.Dataset, xr.Dataset]:
    """Return the links that jump, one after the other, and deviations and their estimate without the jumps."""
    anomalies: list[Anomaly] = []
    while len(anomalies) < MOST_ANOMALIES:
        share = level * WEIGHTS["link"]
        link = find_link(deviations, estimated, level=share, permutations=permutations, rng=rng)
        # Jumps that follow one another by chance pass for a bend or a shape of the drift, which hides them and is gone without them.
        plain = estimated.sel(component=estimated["component"].isin(["shift", "stretch"]))
        hidden = link is None and plain.sizes["component"] < estimated.sizes["component"]
        if hidden:
            link = find_link(deviations, plain, level=share, permutations=permutations, rng=rng)
        if link is None:
            break
        jumps = fit_jumps(deviations, link.target, link.direction)
        less = _less(deviations, jumps)
        left = estimate_drift(less)
        still_bent = hidden and left.sizes["component"] >= estimated.sizes["component"]
        if still_bent or jumps.size_um <= float(estimated["resolution"]):
            break
        anomalies.append(
            Anomaly(
                target=int(deviations["target"].values[link.target]),
                direction=link.direction,
                kind="link",
                p_value=min(1.0, link.p_value / WEIGHTS["link"]),
                scatter_um=_scatter_of(estimated, link.target, link.direction),
                extra_um=jumps.size_um,
                stands_out=True,
                least_p_value=_least_p_value("link", permutations),
            )
        )
        deviations, estimated = less, left
    return anomalies, deviations, estimated


def without_jumps(deviations: xr.Dataset, anomalies: Iterable[Anomaly]) -> xr.Dataset:
    """Return deviations less the jumps of the links among anomalies, one after the other."""
    for one in anomalies:
        if one.kind == "link":
            target = int(np.flatnonzero(deviations["target"].values == one.target)[0])
            deviations = _less(deviations, fit_jumps(deviations, target, one.direction))
    return deviations


def _less(deviations: xr.Dataset, jumps: Jumps) -> xr.Dataset:
    """Return deviations less the jumps of one link."""
    values = deviations["deviation"].transpose("cycle", "direction", "target")
    return deviations.assign(deviation=values - jumps.readings_um)


def _scatter_anomalies(
    estimated: xr.Dataset, level: float, permutations: int, rng: np.random.Generator, untested: Sequence[int] = ()
) -> list[Anomaly]:
    """Return positions with excess scatter, step down: each leaves the pool before the others are tested again."""
    z = _without_memory(estimated["standardised"].values)
    scatter, digit_um = estimated["scatter_position"].values, float(estimated["resolution"])
    usable = np.setdiff1d(np.flatnonzero(np.isfinite(scatter) & (scatter > 0)), np.array(untested, int))
    stands_out = _stands_out(estimated, usable)
    anomalies: list[Anomaly] = []
    pool = usable
    while pool.size > 3 and len(anomalies) < MOST_ANOMALIES:
        excess, largest = _scatter_test(z[:, :, pool], permutations, rng)
        worst = int(np.argmax(excess))
        p = float(1 + np.count_nonzero(largest >= excess[worst])) / (permutations + 1)
        if p > level * WEIGHTS["scatter"]:
            break
        target = int(pool[worst])
        others = np.delete(pool, worst)
        direction = _scatter_direction(estimated, target, others)
        scatter_um = _scatter_of(estimated, target, direction)
        typical = float(np.median(scatter[others]))
        extra_um = float(np.sqrt(max(scatter_um**2 - typical**2, 0.0)))
        pool = others
        if extra_um <= digit_um:
            continue
        anomalies.append(
            Anomaly(
                target=int(estimated["target"].values[target]),
                direction=direction,
                kind="scatter",
                p_value=min(1.0, p / WEIGHTS["scatter"]),
                scatter_um=scatter_um,
                extra_um=extra_um,
                stands_out=bool(stands_out[target] and scatter[target] > typical),
                least_p_value=_least_p_value("scatter", permutations),
            )
        )
    return anomalies


def _without_memory(z: Array) -> Array:
    """Standardised residuals (cycle, direction, target) whose noise has no memory over the cycles: the scatter of fewer independent values
    differs more between positions.
    """
    series = z.reshape(z.shape[0], -1).T
    # The noise of a cell without scatter is no number either.
    known = np.where(np.isfinite(series), series, 0.0)
    memory = memory_of_each(known)
    white = memory.innovations(known) / np.sqrt(memory.innovation_share)
    return np.where(np.isfinite(z), white.T.reshape(z.shape), np.nan)


def _stands_out(estimated: xr.Dataset, usable: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mark targets whose scatter exceeds the natural spread of the others, both directions together or one direction alone."""
    marked = np.zeros(estimated.sizes["target"], dtype=bool)
    together = np.log(estimated["scatter_position"].values[usable])
    marked[usable] = generalised_esd(together, most=MOST_ANOMALIES, level=ESD_LEVELS["together"], high_only=True)
    single = estimated["scatter"].values[:, usable]
    if single.shape[0] == 2 and usable.size and (single > 0).all():
        logarithm = np.log(single)
        relative = logarithm - np.median(logarithm, axis=1, keepdims=True)
        outlier = generalised_esd(relative.ravel(), most=MOST_ANOMALIES, level=ESD_LEVELS["single"], high_only=True)
        marked[usable] |= outlier.reshape(single.shape).any(axis=0)
    return marked


def _scatter_test(z: Array, permutations: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the excess of each target (target,), and the largest one of each permutation of targets within a pass (permutation,)."""
    present = np.isfinite(z)
    squares = np.minimum(z[present] ** 2, WINSOR**2)
    centred = np.zeros(z.shape)
    centred[present] = (squares - squares.mean()) / squares.std()
    shuffled = np.zeros((permutations, *z.shape[1:]))
    for cycle, direction in np.ndindex(z.shape[:2]):
        here = present[cycle, direction]
        values = np.tile(centred[cycle, direction, here], (permutations, 1))
        shuffled[:, direction, here] += rng.permuted(values, axis=1)
    counts = present.sum(axis=0)
    return _excess(centred.sum(axis=0), counts), _excess(shuffled, counts).max(axis=-1)


def _excess(sums: Array, counts: NDArray[np.int64]) -> Array:
    """Sums of each target over the root of their number, the largest of both directions together and of either, (..., target)."""
    alone = sums / np.sqrt(np.maximum(counts, 1))
    together = sums.sum(axis=-2) / np.sqrt(np.maximum(counts.sum(axis=0), 1))
    return np.maximum(together, alone.max(axis=-2))


def _scatter_direction(estimated: xr.Dataset, target: int, others: NDArray[np.int64]) -> str:
    """Return the direction of the excess: "both", unless one direction has none and the other differs from it."""
    variance = estimated["scatter"].values[:, target] ** 2
    freedom = estimated["scatter_freedom"].values[:, target]
    names = estimated["direction"].values
    if variance.size < 2 or not np.isfinite(variance).all():
        return str(names[int(np.isfinite(variance).argmax())])
    of_others = estimated["scatter"].values[:, others] ** 2
    # There is nothing to compare a direction with where it is known here alone, or where noise with memory leaves most positions none.
    if not np.isfinite(of_others).any(axis=1).all():
        return "both"
    typical = np.nanmedian(of_others, axis=1)
    if not (typical > 0).all():
        return "both"
    weak = int(np.argmin(variance / typical))
    strong = 1 - weak
    weak_is_ordinary = special.chdtrc(freedom[weak], variance[weak] / typical[weak] * freedom[weak]) > 0.05
    # Noise with memory can leave the scatter of one direction at zero.
    ratio = (variance[strong] / typical[strong]) / (variance[weak] / typical[weak]) if variance[weak] > 0 else np.inf
    directions_differ = special.fdtrc(freedom[strong], freedom[weak], ratio) < 0.025
    return str(names[strong]) if weak_is_ordinary and directions_differ else "both"


def _scatter_of(estimated: xr.Dataset, target: int, direction: str) -> float:
    if direction == "both":
        return float(estimated["scatter_position"].values[target])
    return float(estimated["scatter"].sel(direction=direction).values[target])


class _Series(NamedTuple):
    """Which series of standardised residuals per cycle: target index, and "positive", "negative" or "both"."""

    target: int
    direction: str


def _series_anomalies(
    estimated: xr.Dataset, deviations: xr.Dataset, level: float, permutations: int, rng: np.random.Generator
) -> list[Anomaly]:
    """Return slow motions, steps and periods; for the first two, cycles are permuted, all positions alike."""
    labels, values = _series(estimated)
    if not labels:
        return []
    # Permuted cycles have no memory: noise that has one would pass for a motion of its position.
    memory = typical_memory(values[[label.direction != "both" for label in labels]])
    values = memory.innovations(values)
    moving = _permutation_tests(values, {"slow": _slowness, "step": _largest_step}, permutations, rng)
    # Middle of each cycle, s since the first reading; a cycle without readings lies between its neighbours.
    time = deviations["time"].values.astype("datetime64[ns]")
    has_time = ~np.isnat(time)
    first = time[has_time].min()
    measured = has_time.any(axis=(1, 2))
    seconds = np.where(has_time, (time - first).astype("f8") * 1e-9, 0.0)
    middles = seconds.sum(axis=(1, 2))[measured] / has_time.sum(axis=(1, 2))[measured]
    periodogram = _Periodogram(np.interp(np.arange(measured.size), np.flatnonzero(measured), middles))
    largest = periodogram.power(values).max(axis=-1)
    tests = {"periodic": (largest, periodogram.p_values(largest)), **moving}
    significant: dict[str, dict[int, tuple[float, int]]] = {}
    for kind, (strength, p) in tests.items():
        best: dict[int, tuple[float, int]] = {}
        for row in np.argsort(-strength):
            target = labels[row].target
            if p[row] <= level * WEIGHTS[kind] and target not in best:
                best[target] = (float(p[row]) / WEIGHTS[kind], int(row))
        significant[kind] = best
    apart = {kind: _moving_apart(labels, strength) for kind, (strength, _) in tests.items()}
    anomalies = []
    for kind, target in _one_kind_per_target(significant, values):
        p_value, row = significant[kind][target]
        direction = labels[row].direction
        course = _course(estimated, labels[row])
        size, at_cycle, period_s = _size_of_motion(estimated, kind, values[row], course, periodogram)
        extra_um = size * _unit_um(estimated) / float(np.sqrt(2) if direction == "both" else 1.0)
        if extra_um <= float(estimated["resolution"]):
            continue
        anomalies.append(
            Anomaly(
                target=int(estimated["target"].values[target]),
                direction=direction,
                kind=kind,
                p_value=min(p_value, 1.0),
                scatter_um=_scatter_of(estimated, target, direction),
                extra_um=extra_um,
                stands_out=target in apart[kind],
                at_cycle=at_cycle,
                period_s=period_s,
                least_p_value=_least_p_value(kind, permutations),
            )
        )
    return anomalies


def _least_p_value(kind: str, permutations: int) -> float:
    """Return the smallest p-value that permutations can show with this kind's share of the error probability."""
    return 0.0 if kind == "periodic" else 1.0 / (permutations + 1) / WEIGHTS[kind]


def _moving_apart(labels: list[_Series], strength: Array) -> set[int]:
    """Targets (indices) whose strongest series exceeds the natural spread of the other targets' strongest."""
    target = np.array([label.target for label in labels])
    targets = np.unique(target)
    strongest = np.array([strength[target == one].max() for one in targets])
    marked = generalised_esd(strongest, most=MOST_ANOMALIES, level=ESD_LEVELS["motion"], high_only=True)
    return set(targets[marked].tolist())


def _permutation_tests(
    values: Array, statistics: Mapping[str, Callable[[Array], Array]], permutations: int, rng: np.random.Generator
) -> dict[str, tuple[Array, Array]]:
    """Return each series' standardised statistic of every kind, and its p-value against the largest one of each permutation, (series,)."""
    shuffled: dict[str, list[Array]] = {kind: [] for kind in statistics}
    # Some permutations at a time: all of a long test fill the memory.
    at_once = max(1, _PERMUTED_VALUES // values.size)
    for start in range(0, permutations, at_once):
        some = range(start, min(start + at_once, permutations))
        permuted = values[:, np.array([rng.permutation(values.shape[1]) for _ in some])].transpose(1, 0, 2)
        for kind, statistic in statistics.items():
            shuffled[kind].append(statistic(permuted))
    return {
        kind: _against_permuted(statistic(values), np.concatenate(shuffled[kind]))
        for kind, statistic in statistics.items()
    }


def _against_permuted(measured: Array, shuffled: Array) -> tuple[Array, Array]:
    """Standardise a statistic (series,) by that of permuted series (permutation, series); return it with its p-values."""
    centre, spread = shuffled.mean(axis=0), shuffled.std(axis=0)
    # A statistic that no permutation changes has no strength.
    spread = np.where(spread > 0, spread, np.inf)
    largest = ((shuffled - centre) / spread).max(axis=1)
    strength = (measured - centre) / spread
    reached = np.count_nonzero(largest[:, None] >= strength, axis=0)
    return strength, (1 + reached) / (len(shuffled) + 1)


def _series(estimated: xr.Dataset) -> tuple[list[_Series], Array]:
    """Return the series of each target, per direction and for both together, and their labels."""
    z = np.clip(estimated["standardised"].values, -WINSOR, WINSOR)
    # Rounding moves a reading by half a digit at most: what ranges over no more than a digit, or over what the arithmetic rounds, is a
    # series without any course. So is one whose readings are all left out, each at the limit.
    least = max(float(estimated["resolution"]) / _unit_um(estimated), _ARITHMETIC)
    names = [str(name) for name in estimated["direction"].values]
    labels, rows = [], []
    for target in range(z.shape[2]):
        measured = [d for d in range(z.shape[1]) if np.isfinite(z[:, d, target]).sum() >= SHORTEST_TEST_CYCLES]
        centred = {d: np.nan_to_num(z[:, d, target] - np.nanmean(z[:, d, target])) for d in measured}
        single = {d: row for d, row in centred.items() if np.ptp(row) > least}
        for d, row in single.items():
            labels.append(_Series(target, names[d]))
            rows.append(row)
        both = sum(single.values()) / np.sqrt(2)
        if len(single) == 2 and np.ptp(both) > least:
            labels.append(_Series(target, "both"))
            rows.append(both)
    return labels, np.array(rows)


def _unit_um(estimated: xr.Dataset) -> float:
    """Return the standard deviation in which residuals are standardised, um."""
    return max(float(estimated["sigma"]), ROUNDING * float(estimated["resolution"]))


def _course(estimated: xr.Dataset, label: _Series) -> Array:
    """Return the standardised residuals (cycle,) of a series less their mean, 0 where a reading is missing."""
    z = estimated["standardised"].values[:, :, label.target]
    if label.direction != "both":
        z = z[:, estimated["direction"].values == label.direction]
    # A reading that is left out counts as far as one may in the tests.
    z = np.where(np.isinf(z), WINSOR, z)
    return np.asarray(np.nan_to_num(z - np.nanmean(z, axis=0)).sum(axis=1) / np.sqrt(z.shape[1]))


def _slowness(values: Array) -> Array:
    """Energy of sums over blocks of cycles (..., series, cycle) -> (..., series): large where neighbours in time agree."""
    n = values.shape[-1] // BLOCK_CYCLES * BLOCK_CYCLES
    blocks = values[..., :n].reshape(*values.shape[:-1], -1, BLOCK_CYCLES).sum(axis=-1)
    return (blocks**2).sum(axis=-1) / (values**2).sum(axis=-1)


def _largest_step(values: Array) -> Array:
    """Largest standardised difference of means before and after any cycle (..., series, cycle) -> (..., series)."""
    return np.abs(_step_profile(values)).max(axis=-1)


def _step_index(row: Array) -> int:
    """Index of the first cycle after the largest step of a series (cycle,)."""
    return int(np.argmax(np.abs(_step_profile(row)))) + BLOCK_CYCLES


def _step_profile(values: Array) -> Array:
    """Standardised difference of means before and after each cycle that leaves a block on either side."""
    n = values.shape[-1]
    before = np.arange(BLOCK_CYCLES, n - BLOCK_CYCLES + 1)
    total = values.sum(axis=-1, keepdims=True)
    head = np.cumsum(values, axis=-1)[..., before - 1]
    spread = values.std(axis=-1, keepdims=True)
    return (head / before - (total - head) / (n - before)) * np.sqrt(before * (n - before) / n) / spread


class _Periodogram:
    """Normalised power of series (series, cycle) at periods from three cycles to a third of the test, at the cycles' own times (s)."""

    def __init__(self, seconds: Array) -> None:
        self._seconds = seconds
        self.frequency = np.arange(3.0, seconds.size / 3.0) / float(seconds[-1] - seconds[0])

    def power(self, values: Array) -> Array:
        # A long test has as many waves as cycles: some are made at a time.
        energy = np.empty((*values.shape[:-1], self.frequency.size))
        for start in range(0, self.frequency.size, _WAVES_AT_ONCE):
            some = slice(start, start + _WAVES_AT_ONCE)
            phase = 2 * np.pi * np.outer(self._seconds, self.frequency[some])
            energy[..., some] = (values @ np.cos(phase)) ** 2 + (values @ np.sin(phase)) ** 2
        return np.asarray(energy * 2 / values.shape[-1] / values.var(axis=-1)[..., None])

    def p_values(self, largest: Array) -> Array:
        """Return the p-value of each series' largest power, corrected for all frequencies and series (Bonferroni)."""
        return np.minimum(1.0, np.exp(-largest / 2) * self.frequency.size * largest.size)


def _one_kind_per_target(significant: dict[str, dict[int, tuple[float, int]]], values: Array) -> list[tuple[str, int]]:
    """Give each target one kind: a step whose remainder is not slow is a step, a period is not also slow."""
    chosen = []
    for target in sorted(set(itertools.chain.from_iterable(significant.values()))):
        kinds = {kind: by_target[target] for kind, by_target in significant.items() if target in by_target}
        if "step" in kinds:
            row = values[kinds["step"][1]]
            step = _step_index(row)
            remainder = np.concatenate([row[:step] - row[:step].mean(), row[step:] - row[step:].mean()])
            is_slow = von_neumann_p_value(remainder) < SLOW_REMAINDER_LEVEL
            chosen.append(("slow" if "slow" in kinds and is_slow else "step", target))
        elif "periodic" in kinds and ("slow" not in kinds or kinds["periodic"][0] <= kinds["slow"][0]):
            chosen.append(("periodic", target))
        else:
            chosen.append(("slow", target))
    return chosen


def _size_of_motion(
    estimated: xr.Dataset, kind: str, row: Array, course: Array, periodogram: _Periodogram
) -> tuple[float, int | None, float | None]:
    """Return the size of a motion in standard deviations of a reading, the cycle after a step, and the period in s.

    From the series (cycle,) as it is tested; the height of a step from its course, which is not winsorised.
    """
    if kind == "step":
        step = _step_index(row)
        return abs(float(course[step:].mean() - course[:step].mean())), int(estimated["cycle"].values[step]), None
    if kind == "periodic":
        power = periodogram.power(row)
        period_s = float(1 / periodogram.frequency[int(np.argmax(power))])
        return float(np.sqrt(2 * power.max() * row.var() / row.size)), None, period_s
    n = row.size // BLOCK_CYCLES * BLOCK_CYCLES
    blocks = row[:n].reshape(-1, BLOCK_CYCLES).mean(axis=1)
    return float(np.sqrt(max(blocks.var() - row.var() / BLOCK_CYCLES, 0.0))), None, None


def generalised_esd(values: Array, *, most: int, level: float = 0.05, high_only: bool = False) -> NDArray[np.bool_]:
    """Mark outliers by the generalised extreme Studentized deviate test."""
    n = values.size
    remaining = np.ones(n, dtype=bool)
    removed: list[int] = []
    outliers = 0
    for i in range(1, min(most, n - 2) + 1):
        centre, spread = values[remaining].mean(), values[remaining].std(ddof=1)
        if spread == 0:
            break
        deviate = (values - centre) / spread if high_only else np.abs(values - centre) / spread
        deviate = np.where(remaining, deviate, -np.inf)
        extreme = int(np.argmax(deviate))
        p = 1 - level / ((1 if high_only else 2) * (n - i + 1))
        t = special.stdtrit(n - i - 1, p)
        if deviate[extreme] > (n - i) * t / np.sqrt((n - i - 1 + t**2) * (n - i + 1)):
            outliers = i
        removed.append(extreme)
        remaining[extreme] = False
    marked = np.zeros(n, dtype=bool)
    marked[removed[:outliers]] = True
    return marked
