"""Random streams by name, piecewise constant loads, and the exact response of a first-order lag."""

from __future__ import annotations

import zlib

import numpy as np
from scipy.signal import lfilter

from fusion._typing import Array


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random generator that belongs to a name, so that adding one random series changes no other series.

    Parameters
    ----------
    seed : int
        Seed of the campaign, at least 0.
    name : str
        Name of the random series; equal seeds and names give equal numbers.

    Returns
    -------
    numpy.random.Generator
    """
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def random_levels(
    time_s: Array, low: float, high: float, mean_hold_min: float, rng: np.random.Generator, *, alternate: bool = False
) -> Array:
    """Return a piecewise constant load whose level changes at random times.

    Parameters
    ----------
    time_s : (n,) ndarray, s
        Increasing times.
    low, high : float
        Range of the levels, in the unit of the load (0..1 for a duty).
    mean_hold_min : float, min
        Mean time for which a level is held; each hold is uniform between 0.4 and 1.6 times the mean.
    rng : numpy.random.Generator
    alternate : bool
        Alternate between `low` and `high`, beginning with one of the two at random; False draws every level uniformly between them.

    Returns
    -------
    (n,) ndarray
        Level at each time, in the unit of `low` and `high`.
    """
    level = np.empty(time_s.size)
    now, high_next = time_s[0], bool(rng.integers(2))
    while now <= time_s[-1]:
        until = now + 60.0 * mean_hold_min * rng.uniform(0.4, 1.6)
        value = (high if high_next else low) if alternate else rng.uniform(low, high)
        level[(time_s >= now) & (time_s < until)] = value
        now, high_next = until, not high_next
    return level


def switched_levels(
    time_s: Array, levels: tuple[float, float], holds_s: tuple[float, float], rng: np.random.Generator
) -> Array:
    """Return a load that alternates between two levels with a minimum hold plus an exponentially distributed one.

    Parameters
    ----------
    time_s : (n,) ndarray, s
        Increasing times.
    levels : tuple of two floats
        The two levels; the first one held is drawn with equal probability.
    holds_s : tuple of two floats, s
        Minimum hold, and mean of the exponential time added to it.
    rng : numpy.random.Generator

    Returns
    -------
    (n,) ndarray
        Level at each time, in the unit of `levels`.
    """
    level = np.empty(time_s.size)
    now, state = time_s[0], int(rng.integers(2))
    while now <= time_s[-1]:
        until = now + holds_s[0] + rng.exponential(holds_s[1])
        level[(time_s >= now) & (time_s < until)] = levels[state]
        now, state = until, 1 - state
    return level


def first_order(drive: Array, step_s: float, time_constant_s: float) -> Array:
    """Return the response of a body with one time constant, tau dx/dt = drive - x, to a sampled drive.

    Parameters
    ----------
    drive : (n,) ndarray, any unit
        Value towards which the state tends over the step that begins at each sample.
    step_s : float, s
        Step of the series.
    time_constant_s : float, s
        Time constant tau of the body.

    Returns
    -------
    (n,) ndarray, unit of `drive`
        State at each sample, exact for a drive that is constant over each step: ``x[0] = 0`` and
        ``x[k+1] = a x[k] + (1 - a) drive[k]`` with ``a = exp(-step_s / tau)``.
    """
    decay = np.exp(-step_s / time_constant_s)
    return np.asarray(lfilter([0.0, 1.0 - decay], [1.0, -decay], drive))
