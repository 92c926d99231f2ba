"""Rates over simulated campaigns: how many campaigns to run, and the interval that goes with every rate."""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np
from statsmodels.stats.proportion import proportion_confint


def campaigns(default: int) -> int:
    """Number of campaigns per case: THERMOFUSE_RUNS where it is set, else the number behind the documented figures."""
    return int(os.environ.get("THERMOFUSE_RUNS", str(default)))


def first_seed(default: int) -> int:
    """Seed of the first campaign: THERMOFUSE_FIRST_SEED where it is set; the others follow it."""
    return int(os.environ.get("THERMOFUSE_FIRST_SEED", str(default)))


def wilson(count: int, of: int) -> tuple[float, float]:
    """95 % interval of a rate (Wilson 1927, J. Am. Stat. Assoc. 22, 209)."""
    low, high = proportion_confint(count, of, method="wilson")
    return float(low), float(high)


def rate(count: int, of: int, *, digits: int = 3) -> str:
    """A rate with its interval and the number of campaigns, as the documentation quotes it."""
    low, high = wilson(count, of)
    return f"{count / of:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}] of {of}"


def within_and_ratio(error: np.ndarray, u: np.ndarray) -> tuple[float, float]:
    """Share of errors within 2 u, and rms of the errors over that of u."""
    return float(np.mean(np.abs(error) <= 2.0 * u)), float(np.sqrt(np.mean(error**2) / np.mean(u**2)))


def coverage_line(title: str, found: Mapping[str, tuple[float, float]]) -> str:
    """What `within_and_ratio` found of several quantities, on a line of its own."""
    return f"\n{title}: " + ", ".join(f"{name} {share:.3f} ({ratio:.2f})" for name, (share, ratio) in found.items())
