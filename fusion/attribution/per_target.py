"""Every pixel against every target and direction, fast: whitening fixed under the null, maxima over permutations in tiles.

Where :mod:`fusion.attribution.family_wise` estimates the drift anew for every candidate, this screen whitens each series once,
by the drift that fits it best without any temperature. Series with the same drift share the whitened film, all of them the cycle's mean
instant; one tile of the film goes through lags, series and permutations while it stays in cache. It keeps its family-wise level, at
somewhat less power for lagged sources; Westfall and Young (1993), *Resampling-based multiple testing*.
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
from fusion.attribution.family_wise import LAGS_S, FieldSeries, nuisance_columns
from fusion.attribution.likelihood_ratio import Array32, Grid, NullBank, fit_null, whitening_grid
from fusion.attribution.warm_up import Excitation

#: Columns of one tile; its whitened films and the products of a thousand permutations stay in the second-level cache.
_TILE = 512
_ROWS = 1000
#: Relative variance of a value that is missing.
_NO_WEIGHT = 1e8


@dataclass(frozen=True)
class Screening:
    """Findings of the screen.

    Attributes
    ----------
    statistic : (series, columns) likelihood ratio at the best lag
    lag_index : (series, columns)
    sensitivity, sensitivity_u : (series, columns) um/K at that lag
    maxima : (permutations, series) largest statistic of every permutation
    p_value : (series, columns) family-wise over series, columns and lags; NaN without permutations
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
    values: Array,
    seconds: Array,
    sampling: Array,
    film: FieldSeries,
    excitation: Excitation,
    *,
    lags_s: Sequence[float] = LAGS_S,
    permutations: int = 999,
    rng: np.random.Generator,
    progress: Callable[[float], None] | None = None,
) -> Screening:
    """Test every column of the film against every series.

    Parameters
    ----------
    values : (series, n) um, NaN where missing
    seconds : (n,) instants that all series share, s
    sampling : (n, frames) weights that turn the film into the temperatures at these instants
    film, excitation, lags_s, progress : as for :func:`fusion.attribution.family_wise.evaluate_film`
    permutations : int
        Orders of the whitened residuals, the same for all series so that what they share is kept; 0 gives no p values.
    """
    nuisance = nuisance_columns(seconds, excitation)
    seen = np.isfinite(values)
    # A missing value gets a variance that leaves it without weight, so that all series keep the same instants.
    variance = np.where(seen, 1.0, _NO_WEIGHT)
    values = np.where(seen, values, np.nanmean(values, axis=1, keepdims=True))
    grids: dict[bytes, Grid] = {}
    banks, groups = [], dict[tuple[int, bytes], list[int]]()
    for k, row in enumerate(values):
        pattern = seen[k].tobytes()
        if pattern not in grids:
            grids[pattern] = whitening_grid(seconds, variance[k], nuisance)
        banks.append(fit_null(grids[pattern], row))
        groups.setdefault((banks[k].best, pattern), []).append(k)
    orders = np.argsort(rng.random((permutations, seconds.size)), axis=1)
    operators = [sampling @ operator for operator in lag_operators(film.seconds, lags_s)]
    tasks = [_Group.build(banks, members, orders, operators) for members in groups.values()]
    columns = film.values.shape[1]
    freedom = seen.sum(axis=1) - nuisance.shape[1]
    result = _Result(freedom, columns, permutations)
    film32 = film.values.astype(np.float32, copy=False)
    for start in range(0, columns, _TILE):
        tile = slice(start, min(start + _TILE, columns))
        for task in tasks:
            task.test(np.ascontiguousarray(film32[:, tile]), tile, result)
        if progress is not None:
            progress(tile.stop / columns)
    return result.finish(tasks)


@dataclass(frozen=True)
class _Group:
    """Series that share one whitening.

    Attributes
    ----------
    members : places of the series
    residuals : (members, n) whitened series of length one
    permuted : (members * permutations, n) whitened permutations of length one, or empty
    operators : (lags, n, frames) from the film to whitened temperatures
    size : (members,) length of the whitened series
    """

    members: NDArray[np.int64]
    residuals: Array32
    permuted: Array32
    operators: Array32
    size: Array

    @staticmethod
    def build(
        banks: Sequence[NullBank], members: list[int], orders: NDArray[np.int64], operators: Sequence[Array]
    ) -> _Group:
        null = banks[members[0]].fitted
        residuals = np.stack([null.project @ banks[k].values for k in members])
        size = np.sqrt((residuals**2).sum(axis=1))
        # A permuted series is put back into the drift's colour and fitted again, as the measured one was.
        again = (null.project @ null.colour).T
        drawn = np.concatenate([row[orders] @ again for row in residuals])
        length = np.sqrt((drawn**2).sum(axis=1))
        return _Group(
            np.array(members),
            (residuals / size[:, None]).astype(np.float32),
            (drawn / np.maximum(length, 1e-300)[:, None]).astype(np.float32),
            np.stack([null.project @ operator for operator in operators]).astype(np.float32),
            size,
        )

    def test(self, film32: Array32, tile: slice, result: _Result) -> None:
        """Put one tile of the film (frames, columns) through all lags, series and permutations."""
        for lag, operator in enumerate(self.operators):
            white = operator @ film32
            square = np.einsum("ij,ij->j", white, white)
            weight = np.where(square > 0, 1.0 / np.where(square > 0, square, 1.0), 0.0).astype(np.float32)
            product = self.residuals @ white
            result.enter(self.members, tile, lag, product, weight, self.size)
            if self.permuted.size:
                for start in range(0, self.permuted.shape[0], _ROWS):
                    rows = slice(start, start + _ROWS)
                    _largest(self.permuted[rows] @ white, weight, result.maxima_of(self.members)[rows])


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

    def maxima_of(self, members: NDArray[np.int64]) -> Array32:
        """Maxima (members * permutations,) of one group, kept under its first member."""
        key = int(members[0])
        if key not in self._maxima:
            self._maxima[key] = np.zeros(members.size * self._permutations, np.float32)
        return self._maxima[key]

    def enter(
        self, members: NDArray[np.int64], tile: slice, lag: int, product: Array32, weight: Array32, size: Array
    ) -> None:
        """Keep this lag where it explains more than those before it."""
        for row, k in enumerate(members):
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
        """Turn shares into likelihood ratios, and compare with the maxima over all series."""
        statistic = _log_ratio(self.share, self.freedom[:, None])
        shares = np.zeros((self._permutations, self.freedom.size))
        size = np.zeros(self.freedom.size)
        for group in groups:
            size[group.members] = group.size
            if self._permutations:
                largest = self.maxima_of(group.members).reshape(group.members.size, self._permutations)
                shares[:, group.members] = largest.T
        maxima = _log_ratio(shares, self.freedom[None, :])
        p_value = np.full(statistic.shape, np.nan, np.float32)
        if self._permutations:
            ordered = np.sort(maxima.max(axis=1))
            above = self._permutations - np.searchsorted(ordered, statistic, side="left")
            p_value = ((above + 1) / (self._permutations + 1)).astype(np.float32)
        left = np.sqrt((1.0 - self.share) * self.weight / (self.freedom - 1)[:, None]) * size[:, None]
        return Screening(
            statistic.astype(np.float32), self.lag, self.coefficient, left.astype(np.float32), maxima, p_value
        )


def _log_ratio(share: Array | Array32, freedom: NDArray[np.int64]) -> Array:
    """Likelihood ratios of shares of explained squares; a share of 1 is held below by the products' precision."""
    return np.asarray(-freedom * np.log1p(-np.minimum(share, 1.0 - 1e-6)), float)
