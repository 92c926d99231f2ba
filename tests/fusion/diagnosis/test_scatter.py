"""Likelihoods of scatter: the densities are those of scipy, and each kind of scatter is recognised."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from fusion.diagnosis.explanations import Residual
from fusion.diagnosis.scatter import _one_sided, fit_scatter

CYCLES = 100
TYPICAL_UM = 0.4


def residual_of(values: np.ndarray) -> Residual:
    return Residual(3, 252.0 * np.arange(CYCLES), values, np.arange(1, CYCLES + 1), TYPICAL_UM, None)


def test_one_sided_amounts_have_the_density_of_the_exponentially_modified_gaussian():
    amounts, sigma, mean = np.linspace(-2.0, 4.0, 50), np.array([0.3, 1.0]), np.array([0.8, 0.5])
    expected = [stats.exponnorm(K=m / s, scale=s).logpdf(amounts) for s, m in zip(sigma, mean, strict=True)]
    np.testing.assert_allclose(_one_sided(amounts, sigma, mean), expected, rtol=1e-9)


def test_scatter_of_both_directions_needs_no_approach(rng):
    fit = fit_scatter(residual_of(1.0 * rng.standard_normal((2, CYCLES))))
    assert fit.both > fit.one_direction
    assert fit.both > fit.along_approach - 3.0


@pytest.mark.parametrize("side", [0, 1])
def test_scatter_of_one_direction_is_recognised(rng, side):
    values = TYPICAL_UM * rng.standard_normal((2, CYCLES))
    values[side] *= 2.5
    fit = fit_scatter(residual_of(values))
    assert fit.one_direction > fit.both + 4.0
    assert fit.one_direction > fit.along_approach


@pytest.mark.parametrize("short", [1.0, -1.0])
def test_amounts_along_the_motion_are_recognised_short_of_the_target_and_beyond(rng, short):
    amounts = 1.2 * rng.exponential(1.0, (2, CYCLES)) * np.array([[-1.0], [1.0]]) * short
    fit = fit_scatter(residual_of(amounts + 0.3 * rng.standard_normal((2, CYCLES))))
    assert fit.along_approach > fit.both + 4.0


def test_typical_scatter_is_explained_by_the_smallest_excess(rng):
    values = TYPICAL_UM * rng.standard_normal((2, CYCLES))
    plain = sum(stats.norm(scale=TYPICAL_UM).logpdf(row - row.mean()).sum() for row in values)
    # two free scales: their likelihood ratio exceeds 2.3 nats once in ten samples
    assert plain - 1.0 < fit_scatter(residual_of(values)).both < plain + 4.0


def test_missing_readings_are_left_out(rng):
    values = rng.standard_normal((2, CYCLES))
    values[0, ::3] = np.nan
    fit = fit_scatter(residual_of(values))
    assert np.isfinite([fit.both, fit.one_direction, fit.along_approach]).all()


def test_likelihoods_are_the_largest_over_the_grid_of_the_method():
    """Plain loops, densities of scipy: ordinary scatter within 20 % of the typical one, excess of 0.1 to 4 times it, one in five rare."""
    values = np.array([[0.1, -0.9, 0.4, 1.7, np.nan], [-0.2, 0.3, -2.0, 0.1, 0.6]])
    rows = [row[np.isfinite(row)] - np.nanmean(row) for row in values]
    along = np.concatenate([rows[0], -rows[1]])
    best = dict.fromkeys(("both", "one_direction", "along_approach"), -np.inf)
    for spread in np.linspace(-2.0, 2.0, 9):
        prior, sigma = -0.5 * spread**2, TYPICAL_UM * np.exp(0.1 * spread)
        usual = stats.norm(scale=sigma)
        for extra in TYPICAL_UM * np.geomspace(0.1, 4.0, 25):
            wide, rare = (stats.norm(scale=np.hypot(sigma, one)) for one in (extra, extra / np.sqrt(0.2)))
            steady = sum(wide.logpdf(row).sum() for row in rows)
            bursts = sum(np.log(0.8 * usual.pdf(row) + 0.2 * rare.pdf(row)).sum() for row in rows)
            sides = [wide.logpdf(one).sum() + usual.logpdf(other).sum() for one, other in (rows, rows[::-1])]
            amount = extra / np.sqrt(0.4)
            sticking = []
            for sign in (-1.0, 1.0):
                always = stats.exponnorm(K=extra / sigma, scale=sigma).logpdf(sign * along + extra).sum()
                centred = sign * along + 0.2 * amount
                sometimes = 0.8 * usual.pdf(centred) + 0.2 * stats.exponnorm(K=amount / sigma, scale=sigma).pdf(centred)
                sticking += [always, np.log(sometimes).sum()]
            for name, found in (("both", (steady, bursts)), ("one_direction", sides), ("along_approach", sticking)):
                best[name] = max(best[name], prior + max(found))
    fit = fit_scatter(Residual(3, np.arange(5.0), values, np.arange(1, 6), TYPICAL_UM, None))
    assert {name: getattr(fit, name) for name in best} == pytest.approx(best, rel=1e-6)
