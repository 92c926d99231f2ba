"""Likelihood ratios of many regressors against one drift series, with the drift's size estimated anew under each.

A series with n values is explained by fixed nuisance columns, a drift of unknown size and kind (none, random walk, integrated random
walk) and white noise. The drifts form a grid; for each of them the series and the regressors are whitened and freed of the nuisance
columns once, so that one regressor costs one product per grid point, and a thousand resampled series cost one matrix product. With
``c_g`` the determinant term of grid point g, the statistic of a regressor with whitened unit vector z_g is::

    (n - k) * log( min_g c_g |e_g|^2  /  min_g c_g (|e_g|^2 - (z_g' e_g)^2) )

which is the profile likelihood ratio (restricted for the nuisance columns). A grid of one point is the usual whitened regression.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fusion._typing import Array
from interferometry.drift.state_space import Order, drift_system

Array32 = NDArray[np.float32]

#: Drift over one hour in units of one value's noise: below the first nobody sees it, above the last it hides everything.
_WALK_PER_HOUR = 0.1 * 3.0 ** np.arange(8)
_INTEGRATED_PER_HOUR = 0.1 * 3.0 ** np.arange(10)
#: Columns of one tile: with a thousand resampled series the products of a tile stay in the second-level cache.
TILE = 512
#: A whitened regressor that keeps less than this share of its size beside the nuisance columns carries no information.
_VANISHING = 1e-5


@dataclass(frozen=True)
class Whitening:
    """One grid point: a drift of known kind and size.

    Attributes
    ----------
    order : 0 no drift, 1 random walk, 2 integrated random walk
    per_hour : standard deviation of the drift's increment over one hour, in units of one value's noise
    project, project32 : (n, n) whitens and removes the nuisance columns, in double and single precision
    colour : (n, n) inverse of the whitening
    basis : (n, k) orthonormal columns that the whitened nuisance columns span
    log_penalty : log-determinant terms of the restricted likelihood divided by the degrees of freedom
    """

    order: int
    per_hour: float
    project: Array
    project32: Array32
    colour: Array
    basis: Array
    log_penalty: float


@dataclass(frozen=True)
class NullBank:
    """All grid points for one series.

    Attributes
    ----------
    freedom : number of values minus nuisance columns
    values : (n,) the series
    best : grid point with the highest restricted likelihood without any regressor
    sigma : noise of one value at that point (values of relative variance 1)
    log_likelihood : (grid,) restricted log-likelihood of the null at every grid point
    """

    whitenings: tuple[Whitening, ...]
    freedom: int
    values: Array
    best: int
    sigma: float
    log_likelihood: Array

    @property
    def fitted(self) -> Whitening:
        """The null model with the highest likelihood."""
        return self.whitenings[self.best]

    @property
    def drift_per_hour(self) -> float:
        """Fitted drift over one hour in the unit of the series."""
        return self.fitted.per_hour * self.sigma


def _grid(integrated: bool) -> list[tuple[int, float]]:
    walks = [(0, 0.0), *[(1, float(rate)) for rate in _WALK_PER_HOUR]]
    return [*walks, *[(2, float(rate)) for rate in _INTEGRATED_PER_HOUR]] if integrated else walks


@njit(cache=True, nogil=True)
def _invert_lower(lower: Array) -> Array:
    """Inverse of a lower triangular matrix; threaded BLAS is slower at this size."""
    n = lower.shape[0]
    inverse = np.zeros((n, n))
    for j in range(n):
        inverse[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total += lower[i, k] * inverse[k, j]
            inverse[i, j] = -total / lower[i, i]
    return inverse


@dataclass(frozen=True)
class Grid:
    """Whitenings under every drift of the grid, for all series that share instants, variances and nuisance columns.

    Attributes
    ----------
    freedom : number of values minus nuisance columns
    scale : variance of an ordinary value
    """

    whitenings: tuple[Whitening, ...]
    freedom: int
    scale: float


def whitening_grid(seconds: Array, variance: Array, nuisance: Array, *, integrated: bool = True) -> Grid:
    """Whiten under every drift of the grid, with or without integrated walks.

    Parameters
    ----------
    seconds, variance : (n,) times in s (increasing), relative variances
    nuisance : (n, k) columns that every hypothesis contains
    """
    n = seconds.size
    scale = float(np.median(variance))
    freedom = n - nuisance.shape[1]
    whitenings = []
    for order, per_hour in _grid(integrated):
        ratio = scale * per_hour**2 / 3600.0 if order < 2 else scale * per_hour**2 * 3.0 / 3600.0**3
        kind: Order = 2 if order == 2 else 1
        system = drift_system(seconds, np.ones((n, 1)), order=kind, ratios=np.array([ratio]), variance=variance)
        white, log_determinant = system.whiten(np.eye(n))
        basis, triangle = np.linalg.qr(white @ nuisance)
        project = white - basis @ (basis.T @ white)
        log_normal = 2.0 * float(np.log(np.abs(np.diag(triangle))).sum())
        penalty = float(log_determinant + log_normal) / freedom
        whitenings.append(
            Whitening(order, per_hour, project, project.astype(np.float32), _invert_lower(white), basis, penalty)
        )
    return Grid(tuple(whitenings), freedom, scale)


def fit_null(grid: Grid, values: Array) -> NullBank:
    """Fit the null to a series (n,): the grid point of highest restricted likelihood."""
    rss = np.array([((point.project @ values) ** 2).sum() for point in grid.whitenings])
    score = np.log(np.maximum(rss, 1e-300)) + np.array([point.log_penalty for point in grid.whitenings])
    best = int(np.argmin(score))
    sigma = float(np.sqrt(grid.scale * rss[best] / grid.freedom))
    return NullBank(grid.whitenings, grid.freedom, values, best, sigma, -0.5 * grid.freedom * score)


def null_bank(values: Array, seconds: Array, variance: Array, nuisance: Array, *, integrated: bool = True) -> NullBank:
    """Whiten one series (n,) under every drift of the grid and fit the null; see :func:`whitening_grid`."""
    return fit_null(whitening_grid(seconds, variance, nuisance, integrated=integrated), values)


def resample(bank: NullBank, orders: NDArray[np.int64], rng: np.random.Generator, *, gaussian: bool = False) -> Array:
    """Draw series (draws, n) from the null: drift sizes by their likelihood, whitened residuals put into other orders.

    Parameters
    ----------
    orders : (draws, n) one order of the residuals per draw; the same orders for several series keep what they share
    rng : generator for the drift sizes (and for the innovations if gaussian)
    gaussian : Gaussian innovations instead of the residuals' own
    """
    weight = np.exp(bank.log_likelihood - bank.log_likelihood.max())
    chosen = rng.choice(weight.size, size=orders.shape[0], p=weight / weight.sum())
    series = np.empty(orders.shape)
    for g in np.unique(chosen):
        null = bank.whitenings[g]
        rows = np.flatnonzero(chosen == g)
        residual = null.project @ bank.values
        spread = float(np.sqrt(residual @ residual / bank.freedom))
        if gaussian:
            innovations = spread * rng.standard_normal((rows.size, residual.size))
        else:
            # What the nuisance columns took out of the residuals is put back at random: without it, orders that keep runs together
            # would lack slow parts, and their maxima would be too small.
            taken = spread * rng.standard_normal((rows.size, null.basis.shape[1])) @ null.basis.T
            innovations = np.take_along_axis(residual + taken, orders[rows], axis=1)
        series[rows] = innovations @ null.colour.T
    return series


@dataclass(frozen=True)
class Whitened:
    """Series ready for the products: per grid point the whitened series (draws, n), their squares and penalties."""

    series: Array32
    penalised: Array32
    penalty: Array32
    null_score: Array32
    freedom: int


def whiten_series(bank: NullBank, series: Array) -> Whitened:
    """Whiten series (draws, n) at every grid point of the bank."""
    projected = np.stack([series @ point.project.T for point in bank.whitenings])
    log_penalty = np.array([point.log_penalty for point in bank.whitenings])
    squares = (projected**2).sum(axis=2)
    # Only ratios of scores count; a common factor keeps single precision away from its limits.
    reference = np.log(squares[:, 0]) + log_penalty
    penalty = np.exp(log_penalty - reference.min())
    penalised = squares * penalty[:, None]
    return Whitened(
        np.ascontiguousarray(projected, np.float32),
        penalised.astype(np.float32),
        penalty.astype(np.float32),
        penalised.min(axis=0).astype(np.float32),
        bank.freedom,
    )


def unit_regressors(project: Array32, regressors: Array32) -> tuple[Array32, Array32]:
    """Whitened regressors (n, columns) of length one, and their lengths (columns,); those without information are zero."""
    moved = project @ regressors
    length = np.sqrt(np.einsum("ij,ij->j", moved, moved))
    size = np.sqrt(np.einsum("ij,ij->j", regressors, regressors))
    useful = length > _VANISHING * np.maximum(size, np.float32(1e-30)) * np.abs(project).max()
    moved *= np.where(useful, 1.0 / np.where(useful, length, 1.0), 0.0).astype(np.float32)
    return moved, np.where(useful, length, np.float32(0.0))


@njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz"})
def _take_best(products: Array32, penalised: Array32, penalty: np.float32, best: Array32) -> None:
    """Lower best (draws, columns) to this grid point's penalised residual squares where they are smaller."""
    draws, columns = products.shape
    for b in range(draws):
        whole = penalised[b]
        for j in range(columns):
            best[b, j] = min(best[b, j], whole - penalty * products[b, j] * products[b, j])


@njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz"})
def _log_ratio(null_score: Array32, best: Array32, freedom: float) -> None:
    """Turn best (draws, columns) into likelihood ratios in place; a regressor can only help, so the ratio is at least 0."""
    draws, columns = best.shape
    for b in range(draws):
        whole = null_score[b]
        for j in range(columns):
            best[b, j] = freedom * np.log(whole / max(best[b, j], np.float32(1e-6) * whole))


def likelihood_ratios(bank: NullBank, whitened: Whitened, regressors: Array32) -> Array32:
    """Profile likelihood ratios (draws, columns) of regressors (n, columns) for every series."""
    draws = whitened.series.shape[1]
    best = np.empty((draws, regressors.shape[1]), np.float32)
    best[:] = whitened.null_score[:, None]
    for g, point in enumerate(bank.whitenings):
        unit, _ = unit_regressors(point.project32, regressors)
        products = whitened.series[g] @ unit
        _take_best(products, whitened.penalised[g], whitened.penalty[g], best)
    _log_ratio(whitened.null_score, best, float(whitened.freedom))
    return best


@dataclass(frozen=True)
class Estimate:
    """Effect of each regressor at the grid point where its likelihood is highest, (columns,) each."""

    coefficient: Array
    coefficient_u: Array
    #: Standard uncertainty that the coefficient would have at the fitted null, used for the smallest effect that would be found.
    null_u: Array


def estimate_effects(bank: NullBank, regressors: Array32) -> Estimate:
    """Coefficients of regressors (n, columns) with uncertainty, drift size profiled."""
    columns = regressors.shape[1]
    best = np.full(columns, np.inf)
    coefficient = np.zeros(columns)
    uncertainty = np.full(columns, np.inf)
    null_u = np.full(columns, np.inf)
    for g, point in enumerate(bank.whitenings):
        unit, length = unit_regressors(point.project32, regressors)
        series = point.project @ bank.values
        product = (series.astype(np.float32) @ unit).astype(float)
        rss = float(series @ series) - product**2
        informative = length > 0
        safe = np.where(informative, length, 1.0)
        score = np.where(informative, np.log(np.maximum(rss, 1e-300)) + point.log_penalty, np.inf)
        better = score < best
        best = np.where(better, score, best)
        coefficient = np.where(better, product / safe, coefficient)
        spread = np.sqrt(np.maximum(rss, 0.0) / (bank.freedom - 1)) / safe
        uncertainty = np.where(better, spread, uncertainty)
        if g == bank.best:
            null_u = np.where(informative, np.sqrt(float(series @ series) / bank.freedom) / safe, np.inf)
    return Estimate(coefficient, uncertainty, null_u)


def tiles(columns: int, group: int) -> Sequence[slice]:
    """Slices of whole groups of columns, about :data:`TILE` wide."""
    step = max(TILE // group, 1) * group
    return [slice(start, min(start + step, columns)) for start in range(0, columns, step)]
