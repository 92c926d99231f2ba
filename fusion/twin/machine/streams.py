"""The twin's random series, one named stream each, and what slow bodies make of a load."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Floats = NDArray[np.floating[Any]]


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random stream that belongs to `name`: switching one series on leaves every other series as it was."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def random_levels(
    time_s: Floats, low: float, high: float, mean_hold_min: float, rng: np.random.Generator, *, two: bool = False
) -> Floats:
    """Return a piecewise constant load: uniform levels (or `two`: low and high by turns) held for 0.4..1.6 of the mean hold."""
    level = np.empty(time_s.size)
    now, high_next = time_s[0], bool(rng.integers(2))
    while now <= time_s[-1]:
        until = now + 60.0 * mean_hold_min * rng.uniform(0.4, 1.6)
        value = (high if high_next else low) if two else rng.uniform(low, high)
        level[(time_s >= now) & (time_s < until)] = value
        now, high_next = until, not high_next
    return level


def switched_levels(
    time_s: Floats, levels: tuple[float, float], holds_s: tuple[float, float], rng: np.random.Generator
) -> Floats:
    """Return a load at two levels by turns, the first by a fair coin, each held for a least time plus an exponential one of given mean."""
    level = np.empty(time_s.size)
    now, state = time_s[0], int(rng.integers(2))
    while now <= time_s[-1]:
        until = now + holds_s[0] + rng.exponential(holds_s[1])
        level[(time_s >= now) & (time_s < until)] = levels[state]
        now, state = until, 1 - state
    return level


def first_order(drive: Floats, step_s: float, time_constant_s: float) -> Floats:
    """Return the state of a body with one time constant, starting at 0; exact for a drive that is constant over a step.

    Parameters
    ----------
    drive : (n,) array
        Drive at the start of every step, any unit; the state tends to it.
    step_s, time_constant_s : float
        Step of the series and the body's time constant, s.
    """
    decay = np.exp(-step_s / time_constant_s)
    return np.asarray(lfilter([0.0, 1.0 - decay], [1.0, -decay], drive))
