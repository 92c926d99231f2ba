"""Shifts by whole quarter hours under which a recording covers the readings: two time zones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_QUARTER_HOUR_S = 900.0
_DAY_S = 86_400.0
#: Share of the readings that the right shift covers.
_COVERED_SHIFTED = 0.95


def covered_share(readings: NDArray[np.datetime64], recorded: NDArray[np.datetime64], *, late_s: float = 0.0) -> float:
    """Return the share of readings between the first and the last sample of a recording.

    Parameters
    ----------
    readings : (n,) ndarray of datetime64
    recorded : (m,) ndarray of datetime64
        Sorted.
    late_s : float, s
        By how much the clock of the recording is taken to be late; the recording is moved back by it.
    """
    late = np.timedelta64(round(late_s * 1e9), "ns")
    return float(np.mean((readings >= recorded[0] - late) & (readings <= recorded[-1] - late)))


def likely_zone_shift(readings: NDArray[np.datetime64], recorded: NDArray[np.datetime64]) -> float | None:
    """Return the smallest shift by whole quarter hours within a day that brings a recording over the readings.

    Parameters
    ----------
    readings : (n,) ndarray of datetime64
    recorded : (m,) ndarray of datetime64
        Sorted.

    Returns
    -------
    float or None, s
        By how much the recording is late; None unless a shift covers 95 % of the readings and more than no shift does.
    """
    shifts = np.arange(-_DAY_S, _DAY_S + 1, _QUARTER_HOUR_S)
    shares = np.array([covered_share(readings, recorded, late_s=float(shift)) for shift in shifts])
    best = np.flatnonzero(shares == shares.max())
    nearest = best[np.argmin(np.abs(shifts[best]))]
    return float(shifts[nearest]) if shares[nearest] >= _COVERED_SHIFTED and shifts[nearest] != 0 else None
