"""L3 - Which of a few numbers stand out from the natural spread of the others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]


def generalised_esd(values: Array, *, most: int, level: float = 0.05, high_only: bool = False) -> NDArray[np.bool_]:
    """Mark outliers by the generalised extreme Studentized deviate test (Rosner 1983).

    Parameters
    ----------
    values : (n,) ndarray
    most : int
        Largest number of outliers looked for.
    level : float
    high_only : bool
        Look for values that are too large only, and give the whole error probability to that side.

    Returns
    -------
    (n,) bool ndarray
    """
    n = values.size
    left = np.ones(n, dtype=bool)
    order: list[int] = []
    outliers = 0
    for i in range(1, min(most, n - 2) + 1):
        centre, spread = values[left].mean(), values[left].std(ddof=1)
        if spread == 0:
            break
        deviation = np.where(
            left, (values - centre) / spread if high_only else np.abs(values - centre) / spread, -np.inf
        )
        at = int(np.argmax(deviation))
        p = 1 - level / ((1 if high_only else 2) * (n - i + 1))
        t = stats.t.ppf(p, n - i - 1)
        if deviation[at] > (n - i) * t / np.sqrt((n - i - 1 + t**2) * (n - i + 1)):
            outliers = i
        order.append(at)
        left[at] = False
    marked = np.zeros(n, dtype=bool)
    marked[order[:outliers]] = True
    return marked
