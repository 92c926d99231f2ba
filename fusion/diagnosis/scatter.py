"""Explanations of one target's residual by scatter alone, without order in time: in both directions, in one, or along the motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from fusion._typing import Array
from fusion.diagnosis.explanations import Residual

#: Natural spread of the targets' scatter about its typical value (standard deviation of its logarithm).
_SIGMA_SPREAD = 0.1
#: Share of the readings that are disturbed where large values are rare.
_RARE_SHARE = 0.2


@dataclass(frozen=True)
class ScatterFit:
    """Maximum log-likelihoods (nats) of three kinds of excess scatter, given the typical scatter of the other targets.

    Attributes
    ----------
    both : float
        Excess scatter equal in both directions, Gaussian or with rare large values.
    one_direction : float
        Excess scatter in one direction only.
    along_approach : float
        One-sided, exponentially distributed amounts along the direction of motion, short of the target (as of a carriage that sticks)
        or beyond it.
    """

    both: float
    one_direction: float
    along_approach: float


def fit_scatter(residual: Residual) -> ScatterFit:
    """Fit explanations by scatter, which treat the readings of a target as exchangeable.

    Parameters
    ----------
    residual : Residual

    Returns
    -------
    ScatterFit
        Maxima over a grid of the target's ordinary scatter (log-normal prior about the typical one, standard deviation 10 %) and of the
        excess (0.1 to 4 times the typical scatter).

    Notes
    -----
    Exponentially modified Gaussian: Grushka (1972), Anal. Chem. 44, 1733.
    """
    rows = [row[np.isfinite(row)] for row in residual.values]
    rows = [row - row.mean() if row.size else row for row in rows]
    spread = np.linspace(-2.0, 2.0, 9)[:, None]
    prior = -0.5 * spread**2
    # The grid (ordinary scatter of this target, excess), both in um.
    sigma = residual.typical_um * np.exp(spread * _SIGMA_SPREAD)
    extra = residual.typical_um * np.geomspace(0.1, 4.0, 25)[None, :]
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
    return ScatterFit(both, max(sides), max(along))


def _normal(row: Array, sigma: Array) -> Array:
    """Return the log-density of every reading (n,) under every sigma (...,), (..., n)."""
    scaled = row / sigma[..., None]
    return -0.5 * (scaled**2 + np.log(2.0 * np.pi)) - np.log(sigma)[..., None]


def _gaussian(row: Array, sigma: Array) -> Array:
    """Return the log-likelihood of the readings under every sigma, (...,)."""
    return _normal(row, sigma).sum(axis=-1)


def _mixture(usual: Array, disturbed: Array) -> Array:
    """Return the log-likelihood (...,) where a small share of the readings is disturbed, from both log-densities (..., n)."""
    return np.logaddexp(np.log(1 - _RARE_SHARE) + usual, np.log(_RARE_SHARE) + disturbed).sum(axis=-1)


def _one_sided(amounts: Array, sigma: Array, mean: Array) -> Array:
    """Return the log-density of Gaussian noise plus an exponential amount of the given mean (Grushka 1972), (..., n)."""
    rate = sigma / mean
    scaled = amounts / sigma[..., None]
    return (
        -np.log(mean)[..., None]
        + 0.5 * rate[..., None] ** 2
        - scaled * rate[..., None]
        + special.log_ndtr(scaled - rate[..., None])
    )


def _sticking(along: Array, sigma: Array, extra: Array) -> Array:
    """Return the log-likelihood (...,) of centred readings with an exponential amount at every approach, or at a small share of them."""
    sigma, extra = np.broadcast_arrays(sigma, extra)
    always = _one_sided(along + extra[..., None], sigma, extra).sum(axis=-1)
    amount = extra / np.sqrt(2.0 * _RARE_SHARE)
    centred = along + _RARE_SHARE * amount[..., None]
    return np.maximum(always, _mixture(_normal(centred, sigma), _one_sided(centred, sigma, amount)))
