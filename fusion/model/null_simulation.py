"""Campaigns in which nothing is missing, simulated from a model's own drift and noise, and what chance makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion._typing import Array
from interferometry.drift.gls import DriftFit, fit_fixed_effects
from interferometry.drift.state_space import DriftSystem

DRAWS = 200
#: log10 factors on a drift variance among which the plausible ones are drawn.
_PLAUSIBLE = np.array([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0])


def tail_probability(value: float, null: Array) -> float:
    """Chance of a null gain at least as large: counted, and beyond the upper tenth of the draws with an exponential tail.

    The mean excess of a log-likelihood gain is at least 1 (chi-squared tail), which keeps few draws from making a bold claim.
    """
    threshold = float(np.quantile(null, 0.9))
    if value <= threshold:
        return float((1 + (null >= value).sum()) / (1 + null.size))
    return float(0.1 * np.exp(-(value - threshold) / _mean_excess(null, threshold)))


def critical_gain(p_value: float, null: Array) -> float:
    """The gain whose chance is ``p_value`` (at most 0.1): the inverse of :func:`tail_probability`."""
    threshold = float(np.quantile(null, 0.9))
    return threshold + _mean_excess(null, threshold) * float(np.log(0.1 / min(p_value, 0.1)))


def sidak(p_value: float, tried: int) -> float:
    """Chance that the best of so many effects does as well as one alone with this p-value (Sidak), exact for tiny ones."""
    return float(-np.expm1(tried * np.log1p(-min(p_value, 1.0 - 1e-12))))


def sidak_level(level: float, tried: int) -> float:
    """The p-value that one of so many effects must reach for a level over all of them: the inverse of :func:`sidak`."""
    return float(-np.expm1(np.log1p(-level) / tried))


def _mean_excess(null: Array, threshold: float) -> float:
    """Mean excess of the upper draws over a threshold, at least 1; draws that are all alike have none."""
    upper = null[null > threshold]
    return max(1.0, float((upper - threshold).mean())) if upper.size else 1.0


def family_wise(observed: Array, null: Array) -> tuple[Array, float, int]:
    """Chance of each statistic alone (k,), of the most unusual of all, and which one that is.

    ``observed`` (k,) are statistics that grow with structure, ``null`` (draws, k) the same where there is none; each is referred to the
    mean and spread of its null, so that no statistic outweighs the others by its scale.
    """
    centre, spread = null.mean(axis=0), np.maximum(null.std(axis=0), 1e-12)
    values = (observed - centre) / spread
    largest = ((null - centre) / spread).max(axis=1)
    each = (1 + (null >= observed).sum(axis=0)) / (1 + null.shape[0])
    return each, float((1 + (largest >= values.max()).sum()) / (1 + null.shape[0])), int(np.argmax(values))


def plausible_ratios(fit: DriftFit, rng: np.random.Generator, *, draws: int) -> Array:
    """Drift variance ratios (draws, components) that the readings leave possible, drawn by their restricted likelihood.

    A drift that was estimated as zero may well be there; simulating none would make every slow chance look like a find.
    """
    centre = np.maximum(fit.system.ratios, least_ratio(fit.system))
    components = centre.size
    exponents = np.stack(np.meshgrid(*[_PLAUSIBLE] * components, indexing="ij"), axis=-1).reshape(-1, components)
    candidates = centre * 10.0**exponents
    likelihood = np.array(
        [
            fit_fixed_effects(replace(fit.system, ratios=ratios), fit.response, fit.design).log_likelihood
            for ratios in candidates
        ]
    )
    weight = np.exp(likelihood - likelihood.max())
    return candidates[rng.choice(weight.size, size=draws, p=weight / weight.sum())]


def least_ratio(system: DriftSystem) -> float:
    """Variance ratio of a drift that ends a quarter of one reading's noise away: less can hardly be told from none."""
    span = float(system.seconds[-1] - system.seconds[0])
    return 0.0625 / span if system.order == 1 else 3.0 * 0.0625 / span**3


def simulate_null(
    fit: DriftFit, rng: np.random.Generator, *, draws: int = DRAWS, over: DriftSystem | None = None
) -> Array:
    """Responses (n, draws) in which only the model's drift and noise act; the noise is drawn from the fit's residuals.

    Fixed effects are left out, because every score is the same whatever they are. ``over`` names other readings than the fit's own.
    """
    noise, share = fit.noise()
    system = fit.system if over is None else over
    relative = noise / np.sqrt(np.maximum(share, 1e-12))
    drawn = rng.choice(relative, size=(system.seconds.size, draws)) * np.sqrt(system.variance)[:, None]
    steps = np.diff(system.seconds, prepend=system.seconds[0])
    ratios = plausible_ratios(fit, rng, draws=draws)
    for ratio, loading in zip(ratios.T, system.loadings.T, strict=True):
        shocks = rng.standard_normal(drawn.shape) * np.sqrt(steps)[:, None]
        if system.order == 1:
            drift = np.cumsum(shocks, axis=0)
        else:
            rate = np.cumsum(shocks, axis=0)
            before = np.vstack([np.zeros(draws), rate[:-1]])
            own = 0.5 * shocks + rng.standard_normal(shocks.shape) * np.sqrt(steps / 12.0)[:, None]
            drift = np.cumsum((before + own) * steps[:, None], axis=0)
        drawn += fit.sigma * np.sqrt(ratio) * drift * loading[:, None]
    return drawn
