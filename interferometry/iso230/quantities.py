"""The quantities of ISO 230-2:2014, clause 3, from mean deviations and their standard deviations."""

from __future__ import annotations

import numpy as np

from interferometry.common import Array

#: Quantities of the axis: reversal error, bidirectional repeatability, bidirectional systematic positioning error, mean bidirectional
#: positioning error, bidirectional accuracy.
QUANTITIES = ("B", "R", "E", "M", "A")
#: What has an uncertainty: these, the signed mean of the reversal errors, and quantities of one direction.
AXIS = (*QUANTITIES, "mean_reversal")
ONE_WAY = ("R_unidirectional", "E_unidirectional", "A_unidirectional")


def target_quantities(mean: Array, s: Array) -> tuple[Array, Array, Array]:
    """Return mean bidirectional deviation, reversal error B_i and bidirectional repeatability R_i of every position."""
    positive, negative = mean[..., 0, :], mean[..., 1, :]
    s_positive, s_negative = s[..., 0, :], s[..., 1, :]
    reversal = positive - negative
    wide = np.fmax(2 * s_positive + 2 * s_negative + np.abs(reversal), np.fmax(4 * s_positive, 4 * s_negative))
    return (positive + negative) / 2, reversal, np.where(np.isnan(reversal), np.nan, wide)


def axis_quantities(mean: Array, s: Array) -> dict[str, Array]:
    """Return the quantities of the axis: B, R, E, M and A of both directions, and R, E and A of each."""
    both, reversal, repeatability = target_quantities(mean, s)
    bidirectional = np.isfinite(reversal).any(axis=-1)
    upper, lower = mean + 2 * s, mean - 2 * s
    cells = (-2, -1)
    return {
        "B": _largest(np.abs(reversal)),
        "R": _largest(repeatability),
        "E": np.where(bidirectional, _largest(mean, cells) + _largest(-mean, cells), np.nan),
        "M": _largest(both) + _largest(-both),
        "A": np.where(bidirectional, _largest(upper, cells) + _largest(-lower, cells), np.nan),
        "R_unidirectional": _largest(4 * s),
        "E_unidirectional": _largest(mean) + _largest(-mean),
        "A_unidirectional": _largest(upper) + _largest(-lower),
    }


def _largest(values: Array, axes: int | tuple[int, ...] = -1) -> Array:
    """Return the largest finite value along axes, NaN where there is none."""
    return np.asarray(np.fmax.reduce(values, axis=axes), dtype=float)
