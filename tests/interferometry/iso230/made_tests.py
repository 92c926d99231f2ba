"""Positioning tests of known numbers, and the quantities of the standard by hand."""

import numpy as np

from interferometry.deviations import build_deviations


def test_made(x):
    """A test from (cycle, direction, target) deviations in um."""
    time = np.full(x.shape, np.datetime64("NaT", "ns"))
    return build_deviations(range(1, len(x) + 1), range(1, x.shape[2] + 1), np.arange(x.shape[2]) * 10.0, x, time)


test_made.__test__ = False


def by_hand(x: np.ndarray) -> dict[str, float]:
    """The axis quantities straight from the standard's definitions."""
    mean, s = x.mean(axis=0), x.std(axis=0, ddof=1)
    b = mean[0] - mean[1]
    r = np.max([2 * s[0] + 2 * s[1] + abs(b), 4 * s[0], 4 * s[1]], axis=0)
    both = mean.mean(axis=0)
    return {
        "B": np.abs(b).max(),
        "R": r.max(),
        "E": mean.max() - mean.min(),
        "M": np.ptp(both),
        "A": (mean + 2 * s).max() - (mean - 2 * s).min(),
    }
