"""Profile likelihood ratios of many regressors against one drift series, with the drift variance estimated anew under each.

A series with n values is explained by k nuisance regressors, a drift of unknown variance and order (none, random walk, integrated random
walk) and white noise. The drifts form a grid. For every grid point the series and the regressors are whitened and freed of the nuisance
regressors once, so that one regressor costs one product per grid point, and a thousand simulated series cost one matrix product. With
``c_g`` the determinant term of grid point g, ``e_g`` the whitened series and ``z_g`` the whitened regressor of unit length, the statistic
is::

    (n - k) * log( min_g c_g |e_g|^2  /  min_g c_g (|e_g|^2 - (z_g' e_g)^2) )

Source: restricted likelihood, Patterson and Thompson (1971), Biometrika 58, 545; docs/method/attribution.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fusion._typing import Array
from interferometry.drift.state_space import DriftSystem, Order, drift_system
from thermography.fields.tasks.spool import empty_array, give_back

Array32 = NDArray[np.float32]

#: Drift over one hour in units of the noise of one value: below the first it has no effect, above the last it hides every source.
_WALK_PER_HOUR = 0.1 * 3.0 ** np.arange(8)
_INTEGRATED_PER_HOUR = 0.1 * 3.0 ** np.arange(10)
#: Columns of one tile: with a thousand simulated series the products of a tile stay in the second-level cache.
_TILE = 512
#: A whitened regressor that keeps less than this share of its length beside the nuisance regressors carries no information.
_VANISHING = 1e-5


@dataclass(frozen=True)
class Whitening:
    """One grid point: a drift of given order and variance.

    Attributes
    ----------
    order : int
        0 no drift, 1 random walk, 2 integrated random walk.
    per_hour : float
        Standard deviation of the increment of the drift over one hour, over the noise of one value.
    system : DriftSystem
        The drift and the noise of the values.
    basis : (n, k) ndarray
        Orthonormal basis of the whitened nuisance regressors.
    log_penalty : float
        Log-determinant terms of the restricted likelihood over the degrees of freedom.
    """

    order: int
    per_hour: float
    system: DriftSystem
    basis: Array
    log_penalty: float

    @property
    def project(self) -> Array:
        """Whitens and removes the nuisance regressors, (n, n); made when it is asked for, as all of a long test fill the memory."""
        white, _ = self.system.whiten(np.eye(self.system.seconds.size))
        return np.asarray(white - self.basis @ (self.basis.T @ white))

    @property
    def colour(self) -> Array:
        """Inverse of the whitening, (n, n); made when it is asked for, as few grid points are asked."""
        white, _ = self.system.whiten(np.eye(self.system.seconds.size))
        return np.asarray(_invert_lower(white))


@dataclass(frozen=True)
class NullBank:
    """The null models of one series at all grid points.

    Attributes
    ----------
    whitenings : tuple of Whitening
        The grid points.
    freedom : int
        Degrees of freedom: number of values minus nuisance regressors.
    values : (n,) ndarray, um
        The series.
    whitened : tuple of (n,) ndarray
        The series whitened at every grid point, without the nuisance regressors.
    best : int
        Index of the grid point of highest restricted likelihood without any regressor.
    sigma : float, um
        Noise of a value of relative variance 1 at that point.
    log_likelihood : (grid,) ndarray
        Restricted log-likelihood of the null model at every grid point.
    """

    whitenings: tuple[Whitening, ...]
    freedom: int
    values: Array
    whitened: tuple[Array, ...]
    best: int
    sigma: float
    log_likelihood: Array

    @property
    def fitted(self) -> Whitening:
        """The null model of highest restricted likelihood."""
        return self.whitenings[self.best]

    @property
    def drift_per_hour(self) -> float:
        """Standard deviation of the fitted drift over one hour, um."""
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
    """Whitenings at every grid point, for all series that share instants, variances and nuisance regressors.

    Attributes
    ----------
    whitenings : tuple of Whitening
        The grid points.
    freedom : int
        Degrees of freedom: number of values minus nuisance regressors.
    scale : float
        Median relative variance of the values.
    """

    whitenings: tuple[Whitening, ...]
    freedom: int
    scale: float


def whitening_grid(seconds: Array, variance: Array, nuisance: Array, *, integrated: bool = True) -> Grid:
    """Compute the whitening at every grid point.

    Parameters
    ----------
    seconds : (n,) ndarray, s
        Times of the values, increasing.
    variance : (n,) ndarray
        Relative variances of the values; the noise of one value is that of relative variance 1.
    nuisance : (n, k) ndarray
        Regressors that every hypothesis contains.
    integrated : bool
        Whether the grid contains integrated random walks besides random walks.

    Returns
    -------
    Grid
        19 grid points, or 9 without integrated random walks.
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
        log_normal = 2.0 * float(np.log(np.abs(np.diag(triangle))).sum())
        penalty = float(log_determinant + log_normal) / freedom
        whitenings.append(Whitening(order, per_hour, system, basis, penalty))
    return Grid(tuple(whitenings), freedom, scale)


def fit_null(grid: Grid, values: Array) -> NullBank:
    """Fit the null model to a series: the grid point of highest restricted likelihood.

    Parameters
    ----------
    grid : Grid
        Whitenings for the instants of the series.
    values : (n,) ndarray, um
        The series.

    Returns
    -------
    NullBank
    """
    whitened = tuple(point.project @ values for point in grid.whitenings)
    rss = np.array([(white**2).sum() for white in whitened])
    score = np.log(np.maximum(rss, 1e-300)) + np.array([point.log_penalty for point in grid.whitenings])
    best = int(np.argmin(score))
    sigma = float(np.sqrt(grid.scale * rss[best] / grid.freedom))
    return NullBank(grid.whitenings, grid.freedom, values, whitened, best, sigma, -0.5 * grid.freedom * score)


def null_bank(values: Array, seconds: Array, variance: Array, nuisance: Array, *, integrated: bool = True) -> NullBank:
    """Compute the whitenings for one series and fit the null model to it; see `whitening_grid` and `fit_null`.

    Parameters
    ----------
    values : (n,) ndarray, um
        The series.
    seconds : (n,) ndarray, s
        Times of the values, increasing.
    variance : (n,) ndarray
        Relative variances of the values.
    nuisance : (n, k) ndarray
        Regressors that every hypothesis contains.
    integrated : bool
        Whether the grid contains integrated random walks besides random walks.

    Returns
    -------
    NullBank
    """
    return fit_null(whitening_grid(seconds, variance, nuisance, integrated=integrated), values)


def resample(bank: NullBank, orders: NDArray[np.int64], *, rng: np.random.Generator, gaussian: bool = False) -> Array:
    """Simulate series under the null hypothesis: drift variances drawn by their likelihood, whitened residuals permuted.

    Parameters
    ----------
    bank : NullBank
        Null models of the measured series.
    orders : (draws, n) ndarray of int
        One permutation of the residuals per simulated series; the same permutations for several series keep their correlation.
    rng : Generator
        Source of the drift variances (and of the innovations if `gaussian`).
    gaussian : bool
        Gaussian innovations instead of the residuals.

    Returns
    -------
    (draws, n) ndarray, um
    """
    weight = np.exp(bank.log_likelihood - bank.log_likelihood.max())
    chosen = rng.choice(weight.size, size=orders.shape[0], p=weight / weight.sum())
    series = np.empty(orders.shape)
    for g in np.unique(chosen):
        null = bank.whitenings[g]
        rows = np.flatnonzero(chosen == g)
        residual = bank.whitened[g]
        spread = float(np.sqrt(residual @ residual / bank.freedom))
        if gaussian:
            innovations = spread * rng.standard_normal((rows.size, residual.size))
        else:
            # What the nuisance regressors removed from the residuals is put back at random: without it, block permutations would
            # lack slow variation, and their maxima would be too small.
            removed = spread * rng.standard_normal((rows.size, null.basis.shape[1])) @ null.basis.T
            innovations = np.take_along_axis(residual + removed, orders[rows], axis=1)
        series[rows] = innovations @ null.colour.T
    return series


@dataclass(frozen=True)
class Whitened:
    """Series whitened at every grid point; the measured series is the first of the draws.

    Attributes
    ----------
    projects : (grid, n, n) ndarray
        `Whitening.project` of every grid point, in single precision; in a temporary file where the series is long.
    series : (grid, draws, n) ndarray
        Whitened series, likewise.
    penalised : (grid, draws) ndarray
        Sums of squares times the penalty.
    penalty : (grid,) ndarray
        Determinant terms, ``exp(log_penalty)`` up to a common factor.
    null_score : (draws,) ndarray
        Smallest `penalised` over the grid.
    freedom : int
        Degrees of freedom.
    """

    projects: Array32
    series: Array32
    penalised: Array32
    penalty: Array32
    null_score: Array32
    freedom: int


def whiten_series(bank: NullBank, series: Array) -> Whitened:
    """Whiten series at every grid point.

    Parameters
    ----------
    bank : NullBank
        Null models of the measured series.
    series : (draws, n) ndarray, um
        The measured series and simulated ones.

    Returns
    -------
    Whitened
    """
    count, n = len(bank.whitenings), series.shape[1]
    projects = empty_array((count, n, n), np.float32)
    projected = empty_array((count, *series.shape), np.float32)
    squares = np.empty(projected.shape[:2])
    for g, point in enumerate(bank.whitenings):
        project = point.project
        white = series @ project.T
        projects[g], projected[g], squares[g] = project, white, (white**2).sum(axis=1)
        give_back(projects, projected)
    log_penalty = np.array([point.log_penalty for point in bank.whitenings])
    # Only ratios of scores count; a common factor keeps single precision away from its limits.
    reference = np.log(squares[:, 0]) + log_penalty
    penalty = np.exp(log_penalty - reference.min())
    penalised = squares * penalty[:, None]
    return Whitened(
        projects,
        projected,
        penalised.astype(np.float32),
        penalty.astype(np.float32),
        penalised.min(axis=0).astype(np.float32),
        bank.freedom,
    )


def _unit_regressors(project: Array32, regressors: Array32) -> tuple[Array32, Array32]:
    """Whitened regressors (n, columns) of length one, and their lengths (columns,); those without information are zero."""
    white = project @ regressors
    length = np.sqrt(np.einsum("ij,ij->j", white, white))
    size = np.sqrt(np.einsum("ij,ij->j", regressors, regressors))
    useful = length > _VANISHING * np.maximum(size, np.float32(1e-30)) * np.abs(project).max()
    white *= np.where(useful, 1.0 / np.where(useful, length, 1.0), 0.0).astype(np.float32)
    return white, np.where(useful, length, np.float32(0.0))


@njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz"})
def _take_best(products: Array32, penalised: Array32, penalty: np.float32, best: Array32) -> None:
    """Lower best (draws, columns) to the penalised residual squares of this grid point where they are smaller."""
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
    """Return the profile likelihood ratio of every regressor for every series.

    Parameters
    ----------
    bank : NullBank
        Null models of the measured series.
    whitened : Whitened
        The measured series and simulated ones.
    regressors : (n, columns) ndarray of float32, K
        Temperatures at the instants of the series.

    Returns
    -------
    (draws, columns) ndarray of float32
        Twice the gain in restricted log-likelihood, 0 for a regressor without information.
    """
    draws = whitened.series.shape[1]
    best = np.empty((draws, regressors.shape[1]), np.float32)
    best[:] = whitened.null_score[:, None]
    for g in range(len(bank.whitenings)):
        unit, _ = _unit_regressors(whitened.projects[g], regressors)
        products = whitened.series[g] @ unit
        _take_best(products, whitened.penalised[g], whitened.penalty[g], best)
        give_back(whitened.projects, whitened.series)
    _log_ratio(whitened.null_score, best, float(whitened.freedom))
    return best


@dataclass(frozen=True)
class Estimate:
    """Effect of each regressor at the grid point where its likelihood is highest.

    Attributes
    ----------
    coefficient, coefficient_u : (columns,) ndarray, um/K
        Estimate and its standard uncertainty.
    null_u : (columns,) ndarray, um/K
        Standard uncertainty at the fitted null model, from which the detection limit follows.
    """

    coefficient: Array
    coefficient_u: Array
    null_u: Array


def estimate_effects(bank: NullBank, regressors: Array32, *, whitened: Whitened | None = None) -> Estimate:
    """Estimate the coefficient of every regressor, with the drift variance profiled.

    Parameters
    ----------
    bank : NullBank
        Null models of the measured series.
    regressors : (n, columns) ndarray of float32, K
        Temperatures at the instants of the series.
    whitened : Whitened, optional
        Has the whitenings of these null models, which are otherwise made again.

    Returns
    -------
    Estimate
        The uncertainty is infinite for a regressor without information.
    """
    columns = regressors.shape[1]
    best = np.full(columns, np.inf)
    coefficient = np.zeros(columns)
    uncertainty = np.full(columns, np.inf)
    null_u = np.full(columns, np.inf)
    for g, point in enumerate(bank.whitenings):
        project = point.project.astype(np.float32) if whitened is None else whitened.projects[g]
        unit, length = _unit_regressors(project, regressors)
        series = bank.whitened[g]
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
        give_back(project)
    return Estimate(coefficient, uncertainty, null_u)


def tiles(columns: int, group: int) -> Sequence[slice]:
    """Return slices of whole groups of columns, about 512 wide.

    Parameters
    ----------
    columns : int
        Number of columns.
    group : int
        Number of neighbouring columns that stay together (the lags of one cell).

    Returns
    -------
    sequence of slice
    """
    step = max(_TILE // group, 1) * group
    return [slice(start, min(start + step, columns)) for start in range(0, columns, step)]
