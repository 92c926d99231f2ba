"""Long tests by formula with the laser alone: three targets, both approaches, 0.25 um of noise, and a drift that nobody declares."""

from __future__ import annotations

import numpy as np

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.alignment.readings import Readings
from fusion.common import Array

TARGETS, NOISE_UM, WARM_UP_S = 3, 0.25, 5400.0
#: Drifts without a cause that the library could name: how the shift, um, and the stretch follow the time.
DRIFTS = ("walk", "warm-up", "warm-up and walk", "shifts")


def long_test(drift: str, cycles: int, seed: int, *, period_s: float = 256.0, step_um: float = 0.0) -> Readings:
    """Readings of a long test.

    Parameters
    ----------
    drift : one of :data:`DRIFTS`: a random walk of 0.15 (shift) and 0.10 um/sqrt(h) (stretch); a warm-up by 2 um and 6 um with a time
        constant of 1.5 h; both; or two runs of the machine with the same time constant, switched at random instants
    cycles : number of cycles
    seed : of noise, drift and instants
    period_s : from cycle to cycle
    step_um : size of a sudden step of all readings, at an instant between 0.15 and 0.7 of the test

    Returns
    -------
    Readings
    """
    rng = np.random.default_rng([seed, cycles])
    there = np.arange(TARGETS)
    way = np.concatenate([there, there[::-1]])
    within_s = np.concatenate([4.0 * there, 4.0 * (TARGETS + there) + 20.0])
    seconds = (period_s * np.arange(cycles)[:, None] + within_s).ravel()
    target = np.tile(way, cycles)
    share = target / (TARGETS - 1)
    response = rng.normal(0.0, 0.6, TARGETS)[target] + rng.normal(0.0, NOISE_UM, seconds.size)
    response += _drift(drift, seconds, share, rng)
    response += step_um * (seconds >= seconds[-1] * rng.uniform(0.15, 0.7))
    return Readings(
        seconds=seconds,
        response=np.round(response, 3),
        cycle=np.repeat(np.arange(1, cycles + 1), way.size),
        target=target + 1,
        position_mm=150.0 * target,
        sign=np.tile(np.repeat([1.0, -1.0], TARGETS), cycles),
        targets=there + 1,
        positions_mm=150.0 * there,
        series={},
        drivers=(),
        left_out={},
    )


def _drift(drift: str, seconds: Array, share: Array, rng: np.random.Generator) -> Array:
    """Drift of every reading, um."""
    total = np.zeros(seconds.size)
    if "walk" in drift:
        steps = np.sqrt(np.diff(seconds, prepend=seconds[0]) / 3600.0)
        for size, loading in ((0.15, 1.0), (0.10, share)):
            total += size * loading * np.cumsum(steps * rng.standard_normal(seconds.size))
    if "warm-up" in drift:
        total += (2.0 + 6.0 * share) * -np.expm1(-seconds / WARM_UP_S)
    if drift == "shifts":
        load = np.searchsorted(np.sort(rng.uniform(0.0, seconds[-1], 4)), seconds) % 2.0
        state = respond(load[:, None], seconds, time_constant_s=WARM_UP_S, start=np.zeros(1))[:, 0]
        total += (2.0 + 6.0 * share) * state
    return total
