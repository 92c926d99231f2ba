"""What the model has to beat on the hold-out set: the last value, the mean, and plain regressions on everything that was logged.

Every error has an interval from a circular block bootstrap over the hold-out set, because errors that follow one another are alike. It is
too narrow where they stay alike for longer than a block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.readings import Readings

#: Penalties of a ridge regression, as shares of a standardised column's variance.
_PENALTIES = tuple(10.0**exponent for exponent in np.arange(-5.0, 1.6, 0.5).tolist())
#: Parts of the training cycles; those of the later half choose the penalty, each predicted from the parts before it.
_PARTS = 4
#: Time constants of the lagged copies of a series, min: a factor of four apart.
LAGS_MIN = (5.0, 20.0, 80.0)
_RESAMPLES = 1000
_PERCENT = (2.5, 97.5)


@dataclass(frozen=True)
class ErrorInterval:
    """A root mean square error with its 95 % interval.

    Attributes
    ----------
    rmse_um, low_um, high_um : um
    """

    rmse_um: float
    low_um: float
    high_um: float


def error_interval(errors: Array, unit: NDArray[np.int64], rng: np.random.Generator) -> ErrorInterval:
    """Root mean square error, mean over channels, and its interval from a circular block bootstrap.

    Parameters
    ----------
    errors : (n,) or (n, channels) um; NaN where there is none
    unit : (n,) what is resampled as a whole (a cycle, a block of time), in the order of time
    rng : source of random numbers

    Returns
    -------
    ErrorInterval
        From 1000 resamples; a block is as many units as the square root of their number.

    References
    ----------
    Politis D.N., Romano J.P. (1992), A circular block-resampling procedure for stationary data, in Exploring the Limits of Bootstrap,
    Wiley, 263.
    """
    errors = errors[:, None] if errors.ndim == 1 else errors
    place = np.unique(unit, return_inverse=True)[1]
    known = np.isfinite(errors)
    squares, number = (
        np.column_stack([np.bincount(place, column) for column in values.T])
        for values in (np.where(known, errors, 0.0) ** 2, known.astype(float))
    )
    units = squares.shape[0]
    length = max(1, round(units**0.5))
    starts = rng.integers(0, units, (_RESAMPLES, -(-units // length)))
    rows = (starts[:, :, None] + np.arange(length)).reshape(_RESAMPLES, -1)[:, :units] % units
    resampled = _rmse(squares[rows].sum(axis=1), number[rows].sum(axis=1))
    low, high = np.nanpercentile(resampled, _PERCENT)
    return ErrorInterval(float(_rmse(squares.sum(axis=0), number.sum(axis=0))), float(low), float(high))


def _rmse(squares: Array, number: Array) -> Array:
    """Root mean square over the last axis' channels, mean over those with a value."""
    known = number > 0.0
    each = np.sqrt(np.where(known, squares / np.maximum(number, 1.0), 0.0))
    channels = known.sum(axis=-1)
    return np.asarray(np.where(channels > 0, each.sum(axis=-1) / np.maximum(channels, 1), np.nan))


def plain_errors(readings: Readings, used: NDArray[np.bool_]) -> dict[str, Array]:
    """Errors of plain predictions of the hold-out readings.

    Parameters
    ----------
    readings : n readings
    used : (n,) True for the training part

    Returns
    -------
    dict of (n_unused,) ndarray
        um, NaN at a site that was not read before: ``last_value`` and ``mean`` of every site; ``least_squares`` and ``ridge`` on every
        series that was logged, common and along the axis; ``ridge_with_lags`` on lagged copies of them too.

    References
    ----------
    Hoerl A.E., Kennard R.W. (1970), Technometrics 12, 55 (ridge regression).
    """
    static = _by_site(readings, used)
    now, late = _standardised(readings, used, ()), _standardised(readings, used, LAGS_MIN)
    predicted: Mapping[str, Array] = {
        "last_value": static["last"],
        "mean": static["mean"],
        "least_squares": _regressed(readings, used, static["mean"], now, (0.0,)),
        "ridge": _regressed(readings, used, static["mean"], now, _PENALTIES),
        "ridge_with_lags": _regressed(readings, used, static["mean"], late, _PENALTIES),
    }
    return {name: (readings.response - values)[~used] for name, values in predicted.items()}


def _by_site(readings: Readings, used: NDArray[np.bool_]) -> dict[str, Array]:
    """Last value and mean of every site's training readings, at every reading (n,); NaN at a site without any."""
    site = readings.site
    last, mean = (np.full(site.max() + 1, np.nan) for _ in range(2))
    for number in np.unique(site[used]):
        own = readings.response[used & (site == number)]
        last[number], mean[number] = own[-1], own.mean()
    return {"last": last[site], "mean": mean[site]}


def _standardised(readings: Readings, used: NDArray[np.bool_], lags_min: tuple[float, ...]) -> Array:
    """Every series and its lagged copies, common and along the axis, freed of each site's mean, of unit variance in training (n, k)."""
    columns = []
    for series in readings.series.values():
        for minutes in (0.0, *lags_min):
            column = readings.at(series.lagged(60.0 * minutes))
            columns += [column] if series.values.ndim == 2 else [column, column * readings.share]
    if not columns:
        return np.empty((readings.seconds.size, 0))
    site = readings.site
    laid = np.column_stack(columns)
    for number in np.unique(site):
        here = site == number
        laid[here] -= laid[here & used].mean(axis=0) if (here & used).any() else np.nan
    scale = laid[used].std(axis=0)
    moves = scale > 1e-12
    return laid[:, moves] / scale[moves]


def _regressed(
    readings: Readings, used: NDArray[np.bool_], mean: Array, columns: Array, penalties: Sequence[float]
) -> Array:
    """Prediction by a regression beside every site's mean, (n,), under the penalty that chained best."""
    y = readings.response - mean
    if len(penalties) == 1:
        return np.asarray(mean + columns @ _ridge(columns[used], y[used], penalties[0]))
    cycles = np.unique(readings.cycle[used])
    part = np.searchsorted(cycles, readings.cycle) * _PARTS // cycles.size
    errors = np.zeros(len(penalties))
    for number in range(_PARTS // 2, _PARTS):
        before, asked = used & (part < number), used & (part == number)
        for k, penalty in enumerate(penalties):
            predicted = columns[asked] @ _ridge(columns[before], y[before], penalty)
            errors[k] += float(((y[asked] - predicted) ** 2).mean())
    return np.asarray(mean + columns @ _ridge(columns[used], y[used], penalties[int(np.argmin(errors))]))


def _ridge(x: Array, y: Array, penalty: float) -> Array:
    """Coefficients of a ridge regression; without a penalty those of smallest norm."""
    normal = x.T @ x / max(1, y.size) + penalty * np.eye(x.shape[1])
    return np.asarray(np.linalg.lstsq(normal, x.T @ y / max(1, y.size), rcond=None)[0])
