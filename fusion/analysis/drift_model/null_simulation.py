"""Null hypothesis "the model is complete": parametric bootstrap from its drift and noise, and p-values from the simulated statistics."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from copy import deepcopy

import numpy as np
from numpy.typing import NDArray

from fusion.analysis.drift_model.model import plausible_ratios
from fusion.common import Array
from interferometry.drift.gls import NO_MEMORY, Autoregression, DriftFit
from interferometry.drift.kalman import DriftSystem
from thermography.large_arrays import empty_array, give_back, one_by_one

DRAWS = 200
#: Readings that are simulated together, 0.4 MB of random numbers, which stay in the cache of a processor.
_READINGS_AT_ONCE = 256


def simulate_null(
    fit: DriftFit,
    rng: np.random.Generator,
    *,
    draws: int = DRAWS,
    memory: Autoregression = NO_MEMORY,
    site: NDArray[np.int64] | None = None,
    over: DriftSystem | None = None,
    noise: Array | None = None,
) -> Array:
    """Simulate responses in which only the model's drift and noise act; the noise is resampled from the fit's residuals.

    ``memory`` is that of the noise of every site over the cycles, ``site`` (n,) that of every simulated reading; ``over`` are the readings
    that are simulated, by default those of the fit; ``noise`` (any,) is what is resampled, by default the fit's own, in its deviations.
    """
    system = over or fit.system
    relative = (fit.white_noise() if noise is None else noise) * fit.sigma
    # Some readings at a time, and those of a long test on disk: these are its largest numbers.
    drawn, scale = empty_array((system.seconds.size, draws), float), np.sqrt(system.independent)[:, None]
    blocks = _blocks(system.seconds.size)

    def parts() -> Iterator[tuple[slice, Array]]:
        return zip(blocks, one_by_one(drawn[rows] for rows in blocks), strict=True)

    for rows, some in parts():
        some[:] = rng.choice(relative, size=some.shape) * scale[rows]
    if memory.weights.size and site is not None:
        for number in np.unique(site):
            drawn[site == number] = memory.with_memory(drawn[site == number])
            give_back(drawn)
    if system.memory is not None:
        kept = np.exp(-np.diff(system.seconds, prepend=-np.inf) / system.memory.time_s)[:, None]
        shared = np.zeros((1, draws))
        for rows, some in parts():
            for share, of_reading in zip(kept[rows], some, strict=True):
                shared = share * shared + np.sqrt(1.0 - share**2) * rng.standard_normal((1, draws))
                of_reading += fit.sigma * np.sqrt(system.memory.share) * shared[0]
    ratios = plausible_ratios(fit, rng, draws=draws)
    for ratio, loading in zip(ratios.T, system.loadings.T, strict=True):
        walks = random_walk(system, _normal_numbers(system, draws, rng))
        for walk, (rows, some) in zip(walks, parts(), strict=True):
            some += walk * (fit.sigma * np.sqrt(ratio)) * loading[rows, None]
    return drawn


def _blocks(readings: int) -> list[slice]:
    """Successive readings, some at a time."""
    starts = range(0, readings, _READINGS_AT_ONCE)
    return [slice(start, min(start + _READINGS_AT_ONCE, readings)) for start in starts]


def _normal_numbers(system: DriftSystem, draws: int, rng: np.random.Generator) -> Iterator[tuple[Array, Array]]:
    """Standard normal numbers of a walk at successive readings; in order 2, all first ones are drawn before all second ones."""
    shapes = [(rows.stop - rows.start, draws) for rows in _blocks(system.seconds.size)]
    firsts = rng
    if system.order == 2:
        firsts = deepcopy(rng)
        for shape in shapes:
            rng.standard_normal(shape)
    for shape in shapes:
        first = firsts.standard_normal(shape)
        yield first, rng.standard_normal(shape) if system.order == 2 else first


def random_walk(system: DriftSystem, numbers: Iterable[tuple[Array, Array]]) -> Iterator[Array]:
    """Random walk (order 1) or integrated random walk (order 2) of unit variance rate at the readings' own times."""
    steps = np.diff(system.seconds, prepend=system.seconds[0])[:, None]
    rate = level = np.zeros(1)  # At the reading before.
    start = 0
    for first, second in numbers:
        own = steps[start : start + len(first)]
        start += len(first)
        moved = first * np.sqrt(own)
        if system.order == 2:
            shocks = moved
            moved = second * np.sqrt(own / 12.0) + 0.5 * shocks
            shocks[0] += rate
            rates = np.cumsum(shocks, axis=0)
            moved[0] += rate
            moved[1:] += rates[:-1]
            moved *= own
            rate = rates[-1]
        moved[0] += level
        walk = np.cumsum(moved, axis=0)
        level = walk[-1]
        yield walk


def rank_p_value(value: float, null: Array) -> float:
    """p-value of a statistic among simulated or permuted ones, never 0 (Phipson and Smyth 2010, Stat. Appl. Genet. Mol. Biol. 9, 39)."""
    return float((1 + (null >= value).sum()) / (1 + null.size))


def tail_probability(value: float, null: Array) -> float:
    """Probability under the null hypothesis of a statistic at least as large."""
    threshold = float(np.quantile(null, 0.9))
    if value <= threshold:
        return rank_p_value(value, null)
    return float(0.1 * np.exp(-(value - threshold) / _mean_excess(null, threshold)))


def critical_gain(p_value: float, null: Array) -> float:
    """Statistic whose p-value is ``p_value`` (at most 0.1): the inverse of :func:`tail_probability`."""
    threshold = float(np.quantile(null, 0.9))
    return threshold + _mean_excess(null, threshold) * float(np.log(0.1 / min(p_value, 0.1)))


def sidak(p_value: float, tried: int) -> float:
    """Family-wise p-value of the smallest of several independent ones (Sidak 1967), exact for tiny ones."""
    return float(-np.expm1(tried * np.log1p(-min(p_value, 1.0 - 1e-12))))


def sidak_level(level: float, tried: int) -> float:
    """p-value that one of several tests must reach for a family-wise level: the inverse of :func:`sidak`."""
    return float(-np.expm1(np.log1p(-level) / tried))


def _mean_excess(null: Array, threshold: float) -> float:
    """Mean excess of the upper draws over a threshold, at least 1; identical draws have no excess."""
    upper = null[null > threshold]
    return max(1.0, float((upper - threshold).mean())) if upper.size else 1.0


def family_wise(observed: Array, null: Array) -> tuple[Array, float, int]:
    """p-values of several statistics, each alone and family-wise for the most unusual."""
    centre, spread = null.mean(axis=0), np.maximum(null.std(axis=0), 1e-12)
    values = (observed - centre) / spread
    largest = ((null - centre) / spread).max(axis=1)
    each = (1 + (null >= observed).sum(axis=0)) / (1 + null.shape[0])
    return each, rank_p_value(values.max(), largest), int(np.argmax(values))
