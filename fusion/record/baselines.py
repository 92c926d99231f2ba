"""Plain predictions of a record's hold-out set, which the model has to beat: last value, mean, and regressions on all that was logged."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.loop.baselines import LAGS_MIN
from fusion.record.blocks import Record
from fusion.record.prediction import known_mean, last_values, predict


def plain_predictions(record: Record, train: NDArray[np.bool_]) -> dict[str, Array]:
    """Predict every block of a record without a model of the machine.

    Parameters
    ----------
    record : on its blocks
    train : (blocks,) True for those whose displacements may be used

    Returns
    -------
    dict of (blocks, channels) ndarray
        um: ``last_value`` (of a run that is held out as a whole, its zero) and ``mean`` of every channel; ``least_squares`` and ``ridge``
        on temperatures and drivers (and their squares); ``ridge_with_lags`` on lagged copies of them too.
    """
    now = np.column_stack([record.rise, *(values for powers in record.drivers.values() for values in powers.values())])
    late = [record.series(now, "1").lagged(60.0 * minutes).values for minutes in LAGS_MIN]
    return {
        "last_value": last_values(record, train),
        "mean": np.broadcast_to(known_mean(record.displacement[train], axis=0), record.displacement.shape),
        "least_squares": _least_squares(record, now, train),
        "ridge": predict(record, now, train).predicted,
        "ridge_with_lags": predict(record, np.column_stack([now, *late]), train).predicted,
    }


def _least_squares(record: Record, columns: Array, train: NDArray[np.bool_]) -> Array:
    """Ordinary least squares of every channel on the columns and a constant, of smallest norm where they depend on each other."""
    design = np.column_stack([np.ones(train.size), columns])
    predicted = np.empty(record.displacement.shape)
    for channel, response in enumerate(record.displacement.T):
        here = train & np.isfinite(response)
        predicted[:, channel] = design @ np.linalg.lstsq(design[here], response[here], rcond=None)[0]
    return predicted
