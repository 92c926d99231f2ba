"""Predicting hours ahead: coefficients shrunk together, how strongly decided by forward chaining inside the training part.

Nothing is learnt from the predicted part: no level, no drift, no re-zeroing. Ridge regression on standardised columns (Hoerl and
Kennard 1970); its penalty is the one that predicts best when each chronological block of the training part is predicted from those
before it. One penalty serves all channels, which keeps few blocks from deciding too much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.record.blocks import Record

#: Shares of a column's variance that are added to it: from ordinary least squares to hardly any coefficient at all.
PENALTIES = 10.0 ** np.arange(-5.0, 1.6, 0.5)
#: Times that runs are left out at most; of more runs several are left out together.
MOST_LEFT_OUT = 8
#: Share of the training blocks that must lie before a part for its prediction to be counted.
_LATER = 0.5


@dataclass(frozen=True)
class Prediction:
    """A prediction of all blocks of a record from some of them.

    Attributes
    ----------
    predicted : (blocks, channels) um
    coefficients : (p, channels) of the columns, um per unit of each
    centre : (p,) values of the columns at which the prediction is the channel's mean
    penalty : the shrinkage that forward chaining chose
    chained_rmse : error of the forward-chained training blocks under it, mean over channels, um; NaN where there is none
    """

    predicted: Array
    coefficients: Array
    centre: Array
    penalty: float
    chained_rmse: float


def predict(record: Record, columns: Array, train: NDArray[np.bool_]) -> Prediction:
    """Predict every block of a record from the training blocks alone.

    Parameters
    ----------
    record : the record
    columns : (blocks, p) of the model, known for all blocks
    train : (blocks,) those whose displacements may be used
    """
    asked = folds(record, train)
    errors = np.full((len(asked), PENALTIES.size), np.nan)
    for place, (before, part) in enumerate(asked):
        for k, (predicted, _, _) in enumerate(_paths(record, columns, before)):
            errors[place, k] = rmse(record, predicted, part)
    mean = known_mean(errors, axis=0)
    best = int(np.argmin(mean)) if np.isfinite(mean).all() else PENALTIES.size // 2
    return Prediction(*_paths(record, columns, train)[best], float(PENALTIES[best]), float(mean[best]))


def folds(record: Record, train: NDArray[np.bool_]) -> list[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Blocks that are predicted for the choice of the penalty, and those that they are predicted from.

    Runs are predicted from the other runs, at most `MOST_LEFT_OUT` times; parts of a single run from those before them.

    Parameters
    ----------
    record : on its blocks
    train : (blocks,) True for the training part

    Returns
    -------
    list of (used, predicted)
        (blocks,) each, True for blocks of the training part.
    """
    runs = np.unique(record.run[train])
    if runs.size > 1:
        left_out = [np.isin(record.run, some) for some in np.array_split(runs, min(runs.size, MOST_LEFT_OUT))]
        return [(train & ~some, train & some) for some in left_out]
    return [(train & (record.chained < one), train & (record.chained == one)) for one in chained_parts(record, train)]


def last_values(record: Record, train: NDArray[np.bool_]) -> Array:
    """Last training value of every channel in every run; in a run without any, its zero.

    Parameters
    ----------
    record : on its blocks
    train : (blocks,) True for the training part

    Returns
    -------
    (blocks, channels) ndarray, um
    """
    last = np.zeros(record.displacement.shape)
    for run in range(len(record.first)):
        here = record.run == run
        for channel, column in enumerate(record.displacement.T):
            values = column[train & here & np.isfinite(column)]
            last[here, channel] = values[-1] if values.size else 0.0
    return last


def persistence_rmse(record: Record, train: NDArray[np.bool_], where: NDArray[np.bool_]) -> Array:
    """Error of repeating the last training value of every channel.

    Parameters
    ----------
    record : on its blocks
    train : (blocks,) True for the training part
    where : (blocks,) True for the blocks that are predicted

    Returns
    -------
    (channels,) ndarray, um
    """
    return channel_rmse(record, last_values(record, train), where)


def predict_left_out(record: Record, columns: Array, penalty: float) -> Array:
    """Predict every part of a record, or every run of several, from all others, earlier and later ones.

    Parameters
    ----------
    record : on its blocks
    columns : (blocks, p) of the model
    penalty : one of :data:`PENALTIES`

    Returns
    -------
    (blocks, channels) ndarray, um
    """
    predicted = np.full(record.displacement.shape, np.nan)
    place = int(np.flatnonzero(penalty == PENALTIES)[0])
    numbers = record.run if record.runs else record.chained
    for number in np.unique(numbers):
        part = numbers == number
        predicted[part] = _paths(record, columns, ~part)[place][0][part]
    return predicted


def chained_parts(record: Record, train: NDArray[np.bool_]) -> list[int]:
    """Parts of the training blocks that are predicted from those before them: those of the later half.

    Before that, a load that has been switched only a few times leaves the coefficients undetermined.

    Parameters
    ----------
    record : on its blocks
    train : (blocks,) True for the training part

    Returns
    -------
    list of int
        Numbers as in ``record.chained``.
    """
    numbers, counts = np.unique(record.chained[train], return_counts=True)
    before = np.cumsum(counts) - counts
    return [int(number) for number, rows in zip(numbers, before, strict=True) if rows >= _LATER * counts.sum()]


def rmse(record: Record, predicted: Array, where: NDArray[np.bool_]) -> float:
    """Root mean square error over some blocks, mean over the channels that were measured there.

    Parameters
    ----------
    record : on its blocks
    predicted : (blocks, channels) um
    where : (blocks,) True for the blocks that count

    Returns
    -------
    float
        um
    """
    return float(known_mean(channel_rmse(record, predicted, where)))


def known_mean(values: Array, axis: int | None = None) -> Array:
    """Mean over the values that are known, NaN where there is none.

    Parameters
    ----------
    values : in any unit, NaN where one is missing
    axis : over which the mean is taken; all of them by default
    """
    known = np.isfinite(values)
    number = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.asarray(np.where(number > 0, total / np.maximum(number, 1), np.nan))


def channel_rmse(record: Record, predicted: Array, where: NDArray[np.bool_]) -> Array:
    """Root mean square error of every channel over some blocks.

    Parameters
    ----------
    record : on its blocks
    predicted : (blocks, channels) um
    where : (blocks,) True for the blocks that count

    Returns
    -------
    (channels,) ndarray, um
        NaN for a channel that was not measured there.
    """
    squares = (record.displacement - predicted)[where] ** 2
    number = np.isfinite(squares).sum(axis=0)
    return np.asarray(np.sqrt(np.where(number > 0, np.nansum(squares, axis=0) / np.maximum(number, 1), np.nan)))


def _paths(record: Record, columns: Array, train: NDArray[np.bool_]) -> list[tuple[Array, Array, Array]]:
    """Predictions (blocks, channels), coefficients (p, channels) and centre (p,) under every penalty."""
    centre, scale = columns[train].mean(axis=0), columns[train].std(axis=0)
    scale = np.where(scale > 0.0, scale, np.inf)
    standard = (columns - centre) / scale
    coefficients = np.zeros((PENALTIES.size, columns.shape[1], len(record.channels)))
    levels = np.zeros((PENALTIES.size, len(record.channels)))
    for channel in range(len(record.channels)):
        here = train & np.isfinite(record.displacement[:, channel])
        x, y = standard[here], record.displacement[here, channel]
        # A channel that misses blocks has its mean where the columns of the others have theirs.
        offset, middle = x.mean(axis=0), float(y.mean())
        values, vectors = np.linalg.eigh((x - offset).T @ (x - offset) / here.sum())
        projected = vectors.T @ ((x - offset).T @ (y - middle) / here.sum())
        coefficients[:, :, channel] = (projected / (np.maximum(values, 0.0) + PENALTIES[:, None])) @ vectors.T
        levels[:, channel] = middle - coefficients[:, :, channel] @ offset
    return [(standard @ one + levels[k], one / scale[:, None], centre) for k, one in enumerate(coefficients)]
