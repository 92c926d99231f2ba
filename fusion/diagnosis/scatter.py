"""Explanations of one position's scatter that need no order in time: plain scatter, one direction, amounts along the motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from fusion._typing import Array
from fusion.diagnosis.explanations import Residual

#: Natural spread of the targets' scatter around their typical value (standard deviation of its logarithm).
_SIGMA_SPREAD = 0.1
#: Share of readings that a scatter with rare large values disturbs.
_RARE_SHARE = 0.2


@dataclass(frozen=True)
class Memoryless:
    """Log-likelihoods (nats, highest over their one parameter) of scatter without memory, the other targets' scatter given.

    Attributes
    ----------
    both : more scatter, equal in both directions (Gaussian, or with rare large values)
    one_direction : more scatter in one direction only
    along_approach : one-sided amounts that follow the sense of motion (exponential), as a carriage that sticks short of its target
    side : direction with the larger scatter, 0 positive, 1 negative
    short : whether the amounts fall short of the target
    """

    both: float
    one_direction: float
    along_approach: float
    side: int
    short: bool


def memoryless_likelihoods(residual: Residual) -> Memoryless:
    """Compare explanations that treat every reading alike, without order in time."""
    rows = [row[np.isfinite(row)] for row in residual.values]
    rows = [row - row.mean() if row.size else row for row in rows]
    usual = residual.typical_um
    spread = np.exp(np.linspace(-2.0, 2.0, 9) * _SIGMA_SPREAD)
    prior = -0.5 * np.linspace(-2.0, 2.0, 9)[:, None] ** 2
    sigma = usual * spread[:, None]
    # Explanations live on the grid (usual scatter of this target, extra scatter), both in um.
    extra = usual * np.geomspace(0.1, 4.0, 25)[None, :]
    wide = np.hypot(sigma, extra)
    rare = np.hypot(sigma, extra / np.sqrt(_RARE_SHARE))
    steady = sum((_gaussian(row, wide) for row in rows), np.zeros_like(wide))
    bursts = sum((_mixture(_normal(row, sigma), _normal(row, rare)) for row in rows), np.zeros_like(wide))
    both = float((prior + np.maximum(steady, bursts)).max())
    sides = [float((prior + _gaussian(rows[k], wide) + _gaussian(rows[1 - k], sigma)).max()) for k in (0, 1)]
    along = [
        float((prior + _sticking(np.concatenate([sign * rows[0], -sign * rows[1]]), sigma, extra)).max())
        for sign in (-1.0, 1.0)
    ]
    return Memoryless(both, max(sides), max(along), int(np.argmax(sides)), along[0] > along[1])


def _normal(row: Array, sigma: Array) -> Array:
    """Log-density of every reading under every sigma, (..., n)."""
    scaled = row / sigma[..., None]
    return -0.5 * (scaled**2 + np.log(2.0 * np.pi)) - np.log(sigma)[..., None]


def _gaussian(row: Array, sigma: Array) -> Array:
    return _normal(row, sigma).sum(axis=-1)


def _mixture(usual: Array, disturbed: Array) -> Array:
    """Log-likelihood where a small share of the readings is disturbed."""
    return np.logaddexp(np.log(1 - _RARE_SHARE) + usual, np.log(_RARE_SHARE) + disturbed).sum(axis=-1)


def _one_sided(amounts: Array, sigma: Array, mean: Array) -> Array:
    """Log-density of normal noise plus an exponential amount (Grushka 1972, Anal. Chem. 44, 1733)."""
    rate = sigma / mean
    scaled = amounts / sigma[..., None]
    return (
        -np.log(mean)[..., None]
        + 0.5 * rate[..., None] ** 2
        - scaled * rate[..., None]
        + special.log_ndtr(scaled - rate[..., None])
    )


def _sticking(along: Array, sigma: Array, extra: Array) -> Array:
    """Readings along the motion, centred: an exponential amount at every approach, or at a small share of them."""
    sigma, extra = np.broadcast_arrays(sigma, extra)
    always = _one_sided(along + extra[..., None], sigma, extra).sum(axis=-1)
    amount = extra / np.sqrt(2.0 * _RARE_SHARE)
    centred = along + _RARE_SHARE * amount[..., None]
    return np.maximum(always, _mixture(_normal(centred, sigma), _one_sided(centred, sigma, amount)))
