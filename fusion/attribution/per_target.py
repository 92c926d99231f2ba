"""Test every cell against every target and direction, fast: whitening fixed under the null, maxima over permutations in tiles.

Where `fusion.attribution.family_wise` estimates the drift anew for every candidate, this screening whitens each series once, by the drift
that fits it best without any temperature. Series with the same drift share the whitened field, since all have the mean instants of the
cycles; one tile of the field passes through lags, series and permutations while it stays in cache. That sharing, and the degrees of
freedom of every series by itself, are why it does not use the kernel of `fusion.attribution.likelihood_ratio` with a grid of one point. It
keeps its family-wise level, at somewhat less power for lagged sources.

Source: Westfall and Young (1993), *Resampling-based multiple testing*.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion._typing import Array
from fusion.alignment.first_order_lag import lag_operators
from fusion.attribution.drift_channels import TargetSeries
from fusion.attribution.family_wise import LAGS_S, FieldSeries
from fusion.attribution.likelihood_ratio import Array32, Grid, NullBank, fit_null, whitening_grid
from fusion.attribution.warm_up import Excitation, nuisance_columns

#: Columns of one tile; its whitened temperatures and the products of a thousand permutations stay in the second-level cache.
_TILE = 512
_ROWS = 1000
#: Relative variance of a value that is missing.
_NO_WEIGHT = 1e8
#: Largest share of the squares of a series that one temperature can explain: beyond it lies the single precision of the products.
_MOST_EXPLAINED = 1.0 - 1e-6


@dataclass(frozen=True)
class Screening:
    """Result of the screening.

    Attributes
    ----------
    statistic : (series, columns) ndarray
        Likelihood ratio at the best lag.
    lag_index : (series, columns) ndarray of int
        Index of that lag.
    sensitivity, sensitivity_u : (series, columns) ndarray, um/K
        Estimate at that lag and its standard uncertainty.
    maxima : (permutations, series) ndarray
        Largest statistic of every permutation.
    p_value : (series, columns) ndarray
        Family-wise over series, columns and lags; NaN without permutations.
    """

    statistic: Array32
    lag_index: NDArray[np.int8]
    sensitivity: Array32
    sensitivity_u: Array32
    maxima: Array
    p_value: Array32


@njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz", "reassoc", "contract"})
def _largest(products: Array32, weight: Array32, largest: Array32) -> None:
    """Raise largest (rows,) to the rows' largest squared product (rows, columns) times the columns' weight."""
    rows, columns = products.shape
    for b in range(rows):
        best = largest[b]
        for j in range(columns):
            best = max(best, products[b, j] * products[b, j] * weight[j])
        largest[b] = best


@njit(cache=True, nogil=True)
def _keep_best(
    product: Array32,
    weight: Array32,
    size: np.float32,
    lag: int,
    share: Array32,
    best_lag: NDArray[np.int8],
    coefficient: Array32,
    best_weight: Array32,
) -> None:
    """Keep this lag (of one series, along the columns) where it explains more than those before it."""
    for j in range(product.size):
        explained = product[j] * product[j] * weight[j]
        if explained > share[j]:
            share[j] = explained
            best_lag[j] = lag
            coefficient[j] = product[j] * weight[j] * size
            best_weight[j] = weight[j]


@threadpool_limits.wrap(limits=1, user_api="blas")
def screen(
    targets: TargetSeries,
    field: FieldSeries,
    excitation: Excitation,
    *,
    lags_s: Sequence[float] = LAGS_S,
    permutations: int = 999,
    rng: np.random.Generator,
    progress: Callable[[float], None] | None = None,
) -> Screening:
    """Test every column of a field against every target and direction.

    Parameters
    ----------
    targets : TargetSeries
        Deviations of every target and direction at the mean instants of the cycles, um, NaN where missing.
    field : FieldSeries
        Temperatures to test.
    excitation : Excitation
        How the field was excited; decides whether a warm-up is part of every hypothesis.
    lags_s : sequence of float, s
        Time constants of the first-order lags.
    permutations : int
        Number of permutations of the whitened residuals, the same for all series so that their correlation is kept; 0 gives no p-values.
    rng : Generator
        Source of the permutations.
    progress : callable, optional
        Called with the finished share, 0 to 1.

    Returns
    -------
    Screening
    """
    seconds = targets.seconds
    nuisance = nuisance_columns(seconds, excitation)
    present = np.isfinite(targets.values)
    # A missing value gets a variance that leaves it without weight, so that all series keep the same instants.
    variance = np.where(present, 1.0, _NO_WEIGHT)
    values = np.where(present, targets.values, np.nanmean(targets.values, axis=1, keepdims=True))
    grids: dict[bytes, Grid] = {}
    banks, groups = [], dict[tuple[int, bytes], list[int]]()
    for k, row in enumerate(values):
        pattern = present[k].tobytes()
        if pattern not in grids:
            grids[pattern] = whitening_grid(seconds, variance[k], nuisance)
        banks.append(fit_null(grids[pattern], row))
        groups.setdefault((banks[k].best, pattern), []).append(k)
    orders = np.argsort(rng.random((permutations, seconds.size)), axis=1)
    operators = [targets.sampling @ operator for operator in lag_operators(field.seconds, lags_s)]
    tasks = [_Group.build(banks, rows, orders, operators) for rows in groups.values()]
    columns = field.values.shape[1]
    freedom = present.sum(axis=1) - nuisance.shape[1]
    result = _Result(freedom, columns, permutations)
    values32 = field.values.astype(np.float32, copy=False)
    for start in range(0, columns, _TILE):
        tile = slice(start, min(start + _TILE, columns))
        for task in tasks:
            task.test(np.ascontiguousarray(values32[:, tile]), tile, result)
        if progress is not None:
            progress(tile.stop / columns)
    return result.finish(tasks)


@dataclass(frozen=True)
class _Group:
    """Series that share one whitening.

    Attributes
    ----------
    rows : (k,) indices of the series
    residuals : (k, n) whitened series of length one
    permuted : (k * permutations, n) whitened permutations of length one, or empty
    operators : (lags, n, frames) from temperatures to whitened temperatures
    size : (k,) length of the whitened series, um
    """

    rows: NDArray[np.int64]
    residuals: Array32
    permuted: Array32
    operators: Array32
    size: Array

    @staticmethod
    def build(
        banks: Sequence[NullBank], rows: list[int], orders: NDArray[np.int64], operators: Sequence[Array]
    ) -> _Group:
        null = banks[rows[0]].fitted
        residuals = np.stack([null.project @ banks[k].values for k in rows])
        size = np.sqrt((residuals**2).sum(axis=1))
        # A permuted series is coloured by the drift and fitted again, as the measured one was.
        again = (null.project @ null.colour).T
        drawn = np.concatenate([row[orders] @ again for row in residuals])
        length = np.sqrt((drawn**2).sum(axis=1))
        return _Group(
            np.array(rows),
            (residuals / size[:, None]).astype(np.float32),
            (drawn / np.maximum(length, 1e-300)[:, None]).astype(np.float32),
            np.stack([null.project @ operator for operator in operators]).astype(np.float32),
            size,
        )

    def test(self, values: Array32, tile: slice, result: _Result) -> None:
        """Test one tile of temperatures (frames, columns) under all lags, for all series and permutations."""
        for lag, operator in enumerate(self.operators):
            white = operator @ values
            square = np.einsum("ij,ij->j", white, white)
            weight = np.where(square > 0, 1.0 / np.where(square > 0, square, 1.0), 0.0).astype(np.float32)
            product = self.residuals @ white
            result.enter(self.rows, tile, lag, product, weight, self.size)
            if self.permuted.size:
                for start in range(0, self.permuted.shape[0], _ROWS):
                    part = slice(start, start + _ROWS)
                    _largest(self.permuted[part] @ white, weight, result.maxima_of(self.rows)[part])


class _Result:
    """Running best lag and maxima, as squared correlations of whitened series."""

    def __init__(self, freedom: NDArray[np.int64], columns: int, permutations: int) -> None:
        series = freedom.size
        self.freedom = freedom
        self.share = np.zeros((series, columns), np.float32)
        self.lag = np.zeros((series, columns), np.int8)
        self.coefficient = np.zeros((series, columns), np.float32)
        self.weight = np.zeros((series, columns), np.float32)
        self._maxima: dict[int, Array32] = {}
        self._permutations = permutations

    def maxima_of(self, rows: NDArray[np.int64]) -> Array32:
        """Maxima (k * permutations,) of the group of series `rows` (k,)."""
        key = int(rows[0])
        if key not in self._maxima:
            self._maxima[key] = np.zeros(rows.size * self._permutations, np.float32)
        return self._maxima[key]

    def enter(
        self, rows: NDArray[np.int64], tile: slice, lag: int, product: Array32, weight: Array32, size: Array
    ) -> None:
        """Keep this lag where it explains more than those before it."""
        for row, k in enumerate(rows):
            _keep_best(
                product[row],
                weight,
                np.float32(size[row]),
                lag,
                self.share[k, tile],
                self.lag[k, tile],
                self.coefficient[k, tile],
                self.weight[k, tile],
            )

    def finish(self, groups: Sequence[_Group]) -> Screening:
        """Turn shares of explained squares into likelihood ratios, and compare them with the maxima over all series."""
        share = np.minimum(self.share, _MOST_EXPLAINED)
        statistic = _log_ratio(share, self.freedom[:, None])
        shares = np.zeros((self._permutations, self.freedom.size))
        size = np.zeros(self.freedom.size)
        for group in groups:
            size[group.rows] = group.size
            if self._permutations:
                largest = self.maxima_of(group.rows).reshape(group.rows.size, self._permutations)
                shares[:, group.rows] = largest.T
        maxima = _log_ratio(np.minimum(shares, _MOST_EXPLAINED), self.freedom[None, :])
        p_value = np.full(statistic.shape, np.nan, np.float32)
        if self._permutations:
            ordered = np.sort(maxima.max(axis=1))
            above = self._permutations - np.searchsorted(ordered, statistic, side="left")
            p_value = ((above + 1) / (self._permutations + 1)).astype(np.float32)
        spread = np.sqrt((1.0 - share) * self.weight / (self.freedom - 1)[:, None]) * size[:, None]
        return Screening(
            statistic.astype(np.float32), self.lag, self.coefficient, spread.astype(np.float32), maxima, p_value
        )


def _log_ratio(share: Array | Array32, freedom: NDArray[np.int64]) -> Array:
    """Likelihood ratios from shares of explained squares."""
    return np.asarray(-freedom * np.log1p(-share), float)
