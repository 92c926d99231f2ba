"""Gain in profile log-likelihood of many candidates over one model, for many responses at once.

The noise variance, the coefficients and the drift variances are those that suit each candidate best, and those that suit the model
without it best. The same kernel serves the readings along an axis and the channels of a record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.model.least_squares import PriorRows
from fusion.model.products import Group, Products, beside_design, reductions, sum_products
from interferometry.drift.state_space import DriftSystem

#: The residual sum of squares beside a candidate is at least this share of the model's.
_LEAST_LEFT = 1e-12


@dataclass(frozen=True)
class ProfileGains:
    """Gains of candidates over a model.

    Attributes
    ----------
    gain : (candidates, responses) gain in log-likelihood, no penalty for further coefficients taken off
    drift_place : (candidates,) which of the systems suits the first response best with the candidate
    separable : (candidates,) whether the candidate is independent of the model under any of the systems
    """

    gain: Array
    drift_place: NDArray[np.int64]
    separable: NDArray[np.bool_]


def profile_gains(
    systems: Sequence[DriftSystem],
    responses: Array,
    design: Array,
    groups: Sequence[Group],
    *,
    priors: PriorRows | None = None,
) -> ProfileGains:
    """Compute the gain of every candidate for every response.

    Parameters
    ----------
    systems : the drift with every set of variances over which the likelihood is maximised
    responses : (n, responses) um; the measured one first, then simulated ones
    design : (n, p) columns of the model
    groups : the candidates' columns at the same readings, grouped by width
    priors : what is known beforehand of the model's coefficients

    Returns
    -------
    ProfileGains
        Candidates in the order in which the groups number them. Columns of a candidate that may be present without the effect
        (``beside`` of :class:`fusion.effects.effect.Candidate`) are part of the model it is held against, at the price of one unit of
        log-likelihood each.
    """
    return gains_by_products(sum_products(systems, [responses], design, groups), priors)


def gains_by_products(sums: Sequence[Products], priors: PriorRows | None = None) -> ProfileGains:
    """Compute the gain of every candidate for every response from products over the readings.

    Parameters
    ----------
    sums : products under every set of variances over which the likelihood is maximised
    priors : what is known beforehand of the model's coefficients
    """
    groups, count = sums[0].groups, sums[0].squares.size
    size = sum(group.places.size for group in groups)
    beside = np.zeros(size, int)
    for group in groups:
        beside[group.places] = group.beside
    started = np.flatnonzero(beside)
    without, best = np.full(count, -np.inf), np.full((count, size), -np.inf)
    best_started = np.full((count, started.size), -np.inf)
    drift_place, separable = np.zeros(size, int), np.zeros(size, bool)
    for place, products in enumerate(held.of_candidates() for held in sums):
        n, log_determinant = products.readings, products.log_spread
        freed = beside_design(products, priors)
        reduced, given, separate = reductions(products, freed)
        likelihood = _likelihood(freed.squares, reduced, n, log_determinant)
        without = np.maximum(without, -0.5 * (n * np.log(freed.squares) + log_determinant))
        best_started = np.maximum(best_started, _likelihood(freed.squares, given[:, started], n, log_determinant))
        better = likelihood[0] > best[0]
        drift_place[better] = place
        np.maximum(best, likelihood, out=best)
        separable |= separate
    against = np.repeat(without[:, None], size, axis=1)
    against[:, started] = np.maximum(against[:, started], best_started - beside[started])
    return ProfileGains((best - against).T, drift_place, separable)


def _likelihood(squares: Array, reduced: Array, readings: int, log_determinant: float) -> Array:
    """Log-likelihood (responses, candidates) with ``reduced`` taken from the sums of squares (responses,); overwrites ``reduced``."""
    # In place: these matrices are large, and fetching memory for new ones takes as long as the sums.
    likelihood = np.subtract(squares[:, None], reduced, out=reduced)
    np.log(np.maximum(likelihood, _LEAST_LEFT * squares[:, None], out=likelihood), out=likelihood)
    likelihood *= -0.5 * readings
    likelihood -= 0.5 * log_determinant
    return likelihood
