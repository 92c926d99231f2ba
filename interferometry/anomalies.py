"""Positions that do not behave like the others: excess scatter, slow excess, step, periodic motion.

Everything is tested on the random part of the joint estimate, which belongs to one position and direction; the
differences of the paper belong to two. Null distributions come from permutations of the readings themselves, so that
heavy tails do not raise false alarms, and every p-value is corrected for all positions, directions and kinds looked at.

Two questions are kept apart: "do the positions scatter unequally?" (permutation, robust against tails) and "does one
stand out from the natural spread of the others?" (generalised extreme Studentized deviate, Rosner 1983, Technometrics
25, 165). A position with excess scatter is an anomaly of the machine only if both say so.

Which of a few numbers stand out from the natural spread of the others.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numba import njit
from numpy.typing import NDArray
from scipy import stats

from interferometry._typing import Array
from interferometry.errors import InterferometryError

#: Share of the error probability given to each kind of anomaly (Bonferroni weights; they sum to one).
WEIGHTS = {"scatter": 0.7, "slow": 0.1, "step": 0.1, "periodic": 0.1}
#: Standardised readings beyond this count as if they lay there (efficiency 0.99 under a normal distribution).
WINSOR = 3.0
BLOCK_CYCLES = 5
SHORTEST_TEST_CYCLES = 15
MOST_ANOMALIES = 4


@dataclass(frozen=True)
class Anomaly:
    """One position that does not behave like the others.

    Attributes
    ----------
    target : int
    direction : str
        "positive", "negative" or "both".
    kind : str
        "scatter", "slow", "step" or "periodic".
    p_value : float
        Corrected for all positions, directions and kinds (family-wise).
    scatter_um : float
        Random standard deviation of the position and direction.
    extra_um : float
        Standard deviation beyond that of the other positions; for a step its height, for a period its amplitude.
    stands_out : bool
        Whether it is more than the natural spread of scatter between positions (generalised ESD, 5 %). Always true of
        the other kinds, which no spread of scatter can produce.
    at_cycle : int or None
        Of a step: the first cycle after it.
    period_s : float or None
        Of a periodic motion.
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


def detect_anomalies(
    estimated: xr.Dataset, deviations: xr.Dataset, *, level: float = 0.05, permutations: int = 399, seed: int = 0
) -> list[Anomaly]:
    """Find anomalous positions.

    Parameters
    ----------
    estimated : xarray.Dataset
        What `drift.estimate_drift` returns.
    deviations : xarray.Dataset
        The deviations it was estimated from.
    level : float
        Probability of any false anomaly in a whole test.
    permutations : int
    seed : int
        Of the permutations, so that a result is repeatable.

    Returns
    -------
    list of Anomaly
        The most significant first; at most one per position and kind.

    Raises
    ------
    InterferometryError
        ``permutations`` are too few to reach ``level`` in the kind with the smallest weight.
    """
    needed = int(np.ceil(1.0 / (level * min(WEIGHTS.values()))))
    if permutations + 1 < needed:
        raise InterferometryError(f"permutations={permutations} cannot reach level={level}; use at least {needed - 1}")
    rng = np.random.default_rng(seed)
    found = _scatter_anomalies(estimated, level, permutations, rng)
    if estimated.sizes["cycle"] >= SHORTEST_TEST_CYCLES:
        found += _series_anomalies(estimated, deviations, level, permutations, rng)
    return sorted(found, key=lambda one: one.p_value)


def detectable_extra(estimated: xr.Dataset, *, level: float = 0.05, power: float = 0.8) -> float:
    """Return the extra standard deviation (um) at one position that this test would find with the given power."""
    freedom = float(np.nanmedian(np.nansum(estimated["scatter_freedom"].values, axis=0)))
    targets = estimated.sizes["target"]
    needed = stats.norm.isf(level * WEIGHTS["scatter"] / targets) + stats.norm.ppf(power)
    ratio = np.exp(2 * needed / np.sqrt(2 * freedom))
    return float(estimated["sigma"]) * float(np.sqrt(ratio - 1))


def _scatter_anomalies(
    estimated: xr.Dataset, level: float, permutations: int, rng: np.random.Generator
) -> list[Anomaly]:
    """Excess scatter, step-down: a position that is found leaves the pool before the others are tested again."""
    z = estimated["standardised"].values
    scatter = estimated["scatter_position"].values
    usable = np.flatnonzero(np.isfinite(scatter) & (scatter > 0))
    stands_out = np.zeros(scatter.size, dtype=bool)
    stands_out[usable] = generalised_esd(np.log(scatter[usable]), most=MOST_ANOMALIES, high_only=True)
    found: list[Anomaly] = []
    remaining = usable
    while remaining.size > 3 and len(found) < MOST_ANOMALIES:
        observed, largest = _scatter_test(z[:, :, remaining], permutations, rng)
        at = int(np.argmax(observed))
        p = float(1 + np.count_nonzero(largest >= observed[at])) / (permutations + 1)
        if p > level * WEIGHTS["scatter"]:
            break
        target = int(remaining[at])
        others = np.delete(remaining, at)
        direction = _scatter_direction(estimated, target, others)
        own = _own_scatter(estimated, target, direction)
        usual = float(np.median(scatter[others]))
        found.append(
            Anomaly(
                target=int(estimated["target"].values[target]),
                direction=direction,
                kind="scatter",
                p_value=min(1.0, p / WEIGHTS["scatter"]),
                scatter_um=own,
                extra_um=float(np.sqrt(max(own**2 - usual**2, 0.0))),
                stands_out=bool(stands_out[target] and scatter[target] > usual),
            )
        )
        remaining = others
    return found


def _scatter_test(z: Array, permutations: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return each target's excess, and the largest one of each permutation of targets within a pass.

    Parameters
    ----------
    z : (cycle, direction, target) ndarray
        Standardised readings, NaN where missing.
    """
    present = np.isfinite(z)
    cycle, direction, target = np.nonzero(present)
    squares = np.minimum(z[present] ** 2, WINSOR**2)
    centred = (squares - squares.mean()) / squares.std()
    weight = 1.0 / np.sqrt(np.maximum(np.bincount(target, minlength=z.shape[2]), 1))
    observed = np.bincount(target, centred, minlength=z.shape[2]) * weight
    starts = np.flatnonzero(np.diff(cycle * z.shape[1] + direction, prepend=-1))
    return observed, _largest_sums(centred, target, np.append(starts, target.size), weight, permutations, rng)


@njit(cache=True)
def _largest_sums(
    values: Array,
    target: NDArray[np.int64],
    starts: NDArray[np.int64],
    weight: Array,
    permutations: int,
    rng: np.random.Generator,
) -> Array:
    """Shuffle values within each pass (Fisher and Yates) and return the largest weighted sum of a target, per permutation."""
    largest = np.empty(permutations)
    shuffled = values.copy()
    for k in range(permutations):
        sums = np.zeros(weight.size)
        for one in range(starts.size - 1):
            for at in range(starts[one + 1] - 1, starts[one], -1):
                other = rng.integers(starts[one], at + 1)
                shuffled[at], shuffled[other] = shuffled[other], shuffled[at]
        for at in range(values.size):
            sums[target[at]] += shuffled[at]
        largest[k] = (sums * weight).max()
    return largest


def _scatter_direction(estimated: xr.Dataset, target: int, others: NDArray[np.int64]) -> str:
    """Return the direction of the excess: both, unless one has none and the other differs from it."""
    variance = estimated["scatter"].values[:, target] ** 2
    freedom = estimated["scatter_freedom"].values[:, target]
    names = estimated["direction"].values
    if variance.size < 2 or not np.isfinite(variance).all():
        return str(names[int(np.isfinite(variance).argmax())])
    usual = np.nanmedian(estimated["scatter"].values[:, others] ** 2, axis=1)
    weak = int(np.argmin(variance / usual))
    strong = 1 - weak
    alone = stats.chi2.sf(variance[weak] / usual[weak] * freedom[weak], freedom[weak]) > 0.05
    ratio = (variance[strong] / usual[strong]) / (variance[weak] / usual[weak])
    differs = stats.f.sf(ratio, freedom[strong], freedom[weak]) < 0.025
    return str(names[strong]) if alone and differs else "both"


def _own_scatter(estimated: xr.Dataset, target: int, direction: str) -> float:
    if direction == "both":
        return float(estimated["scatter_position"].values[target])
    return float(estimated["scatter"].sel(direction=direction).values[target])


@dataclass(frozen=True)
class _Series:
    """Standardised residuals per cycle of one position: one direction, or both together."""

    target: int
    direction: str


def _series_anomalies(
    estimated: xr.Dataset, deviations: xr.Dataset, level: float, permutations: int, rng: np.random.Generator
) -> list[Anomaly]:
    """Slow excess, steps and periods; for the first two, cycles are permuted, all positions alike."""
    labels, values = _series(estimated)
    if not labels:
        return []
    n = values.shape[1]
    seconds = _cycle_seconds(deviations)
    orders = np.array([rng.permutation(n) for _ in range(permutations)])
    found: list[Anomaly] = []
    periodogram = _Periodogram(seconds)
    p_values = {"periodic": periodogram.p_values(values)}
    strength = {"periodic": periodogram.power(values).max(axis=-1)}
    for kind, statistic in (("slow", _slow), ("step", _step)):
        observed = statistic(values)
        shuffled = np.concatenate(
            [statistic(values[:, order].transpose(1, 0, 2)) for order in np.array_split(orders, 10)]
        )
        centre, spread = shuffled.mean(axis=0), shuffled.std(axis=0)
        largest = ((shuffled - centre) / spread).max(axis=1)
        strength[kind] = (observed - centre) / spread
        reached = np.count_nonzero(largest[:, None] >= strength[kind], axis=0)
        p_values[kind] = (1 + reached) / (permutations + 1)
    significant: dict[str, dict[int, tuple[float, int]]] = {}
    for kind, p in p_values.items():
        best: dict[int, tuple[float, int]] = {}
        for at in np.argsort(-strength[kind]):
            target = labels[at].target
            if p[at] <= level * WEIGHTS[kind] and target not in best:
                best[target] = (float(p[at]) / WEIGHTS[kind], int(at))
        significant[kind] = best
    for kind, target in _settle(significant, values):
        p_value, at = significant[kind][target]
        found.append(_describe_series(estimated, kind, labels[at], values[at], min(p_value, 1.0), seconds))
    return found


def _series(estimated: xr.Dataset) -> tuple[list[_Series], Array]:
    """Return standardised series per target for each direction and for both, gaps filled with 0, and their labels."""
    z = np.clip(estimated["standardised"].values, -WINSOR, WINSOR)
    names = [str(name) for name in estimated["direction"].values]
    labels, rows = [], []
    for target in range(z.shape[2]):
        measured = [d for d in range(z.shape[1]) if np.isfinite(z[:, d, target]).sum() >= SHORTEST_TEST_CYCLES]
        single = {d: np.nan_to_num(z[:, d, target] - np.nanmean(z[:, d, target])) for d in measured}
        for d, row in single.items():
            labels.append(_Series(target, names[d]))
            rows.append(row)
        if len(measured) == 2:
            labels.append(_Series(target, "both"))
            rows.append((single[0] + single[1]) / np.sqrt(2))
    return labels, np.array(rows)


def _cycle_seconds(deviations: xr.Dataset) -> Array:
    """Return the middle of each cycle in seconds since the first reading; a cycle without readings lies between its neighbours."""
    time = deviations["time"].values.astype("datetime64[ns]")
    first = time[~np.isnat(time)].min()
    known = ~np.isnat(time)
    measured = known.any(axis=(1, 2))
    seconds = np.where(known, (time - first).astype("f8") * 1e-9, 0.0)
    middles = seconds.sum(axis=(1, 2))[measured] / known.sum(axis=(1, 2))[measured]
    return np.interp(np.arange(measured.size), np.flatnonzero(measured), middles)


def _slow(values: Array) -> Array:
    """Energy of sums over blocks of cycles (..., series, cycle) -> (..., series): large where neighbours in time agree."""
    n = values.shape[-1] // BLOCK_CYCLES * BLOCK_CYCLES
    blocks = values[..., :n].reshape(*values.shape[:-1], -1, BLOCK_CYCLES).sum(axis=-1)
    return (blocks**2).sum(axis=-1) / (values**2).sum(axis=-1)


def _step(values: Array) -> Array:
    """Largest standardised difference of means before and after any cycle (..., series, cycle) -> (..., series)."""
    return np.abs(_step_profile(values)).max(axis=-1)


def _step_profile(values: Array) -> Array:
    n = values.shape[-1]
    before = np.arange(BLOCK_CYCLES, n - BLOCK_CYCLES + 1)
    total = values.sum(axis=-1, keepdims=True)
    head = np.cumsum(values, axis=-1)[..., before - 1]
    spread = values.std(axis=-1, keepdims=True)
    return (head / before - (total - head) / (n - before)) * np.sqrt(before * (n - before) / n) / spread


class _Periodogram:
    """Largest normalised power over periods from three cycles to a third of the test, at the cycles' own times."""

    def __init__(self, seconds: Array) -> None:
        length = float(seconds[-1] - seconds[0])
        self.frequency = np.arange(3.0, seconds.size / 3.0) / length
        phase = 2 * np.pi * np.outer(seconds, self.frequency)
        self._basis = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)

    def power(self, values: Array) -> Array:
        projected = values @ self._basis
        half = self.frequency.size
        energy = projected[..., :half] ** 2 + projected[..., half:] ** 2
        return energy * 2 / values.shape[-1] / values.var(axis=-1)[..., None]

    def p_values(self, values: Array) -> Array:
        """Return the p-value of each series' largest power, corrected for all frequencies and series (Bonferroni).

        The power of a winsorised series without period follows chi-square with two degrees of freedom: no permutation needed.
        """
        largest = self.power(values).max(axis=-1)
        return np.minimum(1.0, np.exp(-largest / 2) * self.frequency.size * values.shape[0])


def _settle(significant: dict[str, dict[int, tuple[float, int]]], values: Array) -> list[tuple[str, int]]:
    """Give each position one name: a step that leaves nothing slow behind is a step, a period is not also slow."""
    settled = []
    for target in sorted(set(itertools.chain.from_iterable(significant.values()))):
        kinds = {kind: found[target] for kind, found in significant.items() if target in found}
        if "step" in kinds:
            row = values[kinds["step"][1]]
            at = int(np.argmax(np.abs(_step_profile(row)))) + BLOCK_CYCLES
            left = np.concatenate([row[:at] - row[:at].mean(), row[at:] - row[at:].mean()])
            settled.append(("slow" if "slow" in kinds and _is_slow(left) else "step", target))
        elif "periodic" in kinds and ("slow" not in kinds or kinds["periodic"][0] <= kinds["slow"][0]):
            settled.append(("periodic", target))
        else:
            settled.append(("slow", target))
    return settled


def _is_slow(row: Array) -> bool:
    """Tell whether a series is still slow, by the von Neumann ratio at the 1 % level."""
    n = row.size
    ratio = float((np.diff(row) ** 2).sum() / (row**2).sum())
    return bool(stats.norm.cdf((ratio - 2.0) / np.sqrt(4.0 * (n - 2.0) / (n**2 - 1.0))) < 0.01)


def _describe_series(
    estimated: xr.Dataset, kind: str, label: _Series, row: Array, p_value: float, seconds: Array
) -> Anomaly:
    scatter = _own_scatter(estimated, label.target, label.direction)
    scale = scatter / (np.sqrt(2) if label.direction == "both" else 1.0)
    at_cycle, period_s = None, None
    if kind == "step":
        at = int(np.argmax(np.abs(_step_profile(row)))) + BLOCK_CYCLES
        extra = abs(float(row[at:].mean() - row[:at].mean())) * scale
        at_cycle = int(estimated["cycle"].values[at])
    elif kind == "periodic":
        periodogram = _Periodogram(seconds)
        power = periodogram.power(row)
        period_s = float(1 / periodogram.frequency[int(np.argmax(power))])
        extra = float(np.sqrt(2 * power.max() * row.var() / row.size)) * scale
    else:
        n = row.size // BLOCK_CYCLES * BLOCK_CYCLES
        blocks = row[:n].reshape(-1, BLOCK_CYCLES).mean(axis=1)
        extra = float(np.sqrt(max(blocks.var() - row.var() / BLOCK_CYCLES, 0.0))) * scale
    return Anomaly(
        target=int(estimated["target"].values[label.target]),
        direction=label.direction,
        kind=kind,
        p_value=p_value,
        scatter_um=scatter,
        extra_um=extra,
        stands_out=True,
        at_cycle=at_cycle,
        period_s=period_s,
    )


def generalised_esd(values: Array, *, most: int, level: float = 0.05, high_only: bool = False) -> NDArray[np.bool_]:
    """Mark outliers by the generalised extreme Studentized deviate test (Rosner 1983).

    Parameters
    ----------
    values : (n,) ndarray
    most : int
        Largest number of outliers looked for.
    level : float
    high_only : bool
        Look for values that are too large only, and give the whole error probability to that side.

    Returns
    -------
    (n,) bool ndarray
    """
    n = values.size
    left = np.ones(n, dtype=bool)
    order: list[int] = []
    outliers = 0
    for i in range(1, min(most, n - 2) + 1):
        centre, spread = values[left].mean(), values[left].std(ddof=1)
        if spread == 0:
            break
        deviation = np.where(
            left, (values - centre) / spread if high_only else np.abs(values - centre) / spread, -np.inf
        )
        at = int(np.argmax(deviation))
        p = 1 - level / ((1 if high_only else 2) * (n - i + 1))
        t = stats.t.ppf(p, n - i - 1)
        if deviation[at] > (n - i) * t / np.sqrt((n - i - 1 + t**2) * (n - i + 1)):
            outliers = i
        order.append(at)
        left[at] = False
    marked = np.zeros(n, dtype=bool)
    marked[order[:outliers]] = True
    return marked
