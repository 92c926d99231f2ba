"""What a test of an axis shows by ISO 230-2 whose profile, drift and scatter are known: as with a compensation table."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr
from scipy import special

from fusion.common import Array
from fusion.results.parts import Quantity
from interferometry.iso230.quantities import axis_quantities

#: Order of the approaches along the first axis of every array.
APPROACHES = ("positive", "negative")
_DRAWS, _SEED = 400, 20260309


def in_order(test: xr.Dataset) -> xr.Dataset:
    """Return a test with its targets in the order of their positions, by the positive and the negative approach."""
    rows, order = (test[name].values for name in ("direction", "position"))
    sides = [list(rows).index(side) for side in APPROACHES if side in rows]
    at = {"direction": sides, "other_direction": sides, "target": np.argsort(order), "other_target": np.argsort(order)}
    return test.isel(at).transpose(..., "direction", "target", "other_direction", "other_target")


def scatter_and_drift(drift: xr.Dataset) -> tuple[Array, Array, float]:
    """Return the standard deviation of a reading (2, n) and the drift (cycles, 2, n), um, of a test `in_order`, and the degrees of freedom
    of the former.

    Variances are drawn towards their mean as far as they differ by no more than chance (empirical Bayes: Smyth 2004, 3.3).
    """
    scatter = drift["scatter"].fillna(drift["scatter_position"]).transpose("direction", "target").values.astype(float)
    freedom = np.nan_to_num(drift["scatter_freedom"].transpose("direction", "target").values.astype(float))
    variance, known = scatter**2, (scatter > 0.0) & (freedom > 0.0)
    if known.any():
        common = float(np.average(variance[known], weights=freedom[known]))
        excess = float(np.var(np.log(variance[known])) - np.mean(special.polygamma(1, freedom[known] / 2.0)))
        # The inverse of the trigamma function, 1/x + 1/(2 x²), at half the degrees of freedom of the common variance.
        prior = (1.0 + math.sqrt(1.0 + 2.0 * excess)) / excess if excess > 0.0 else math.inf
        own = np.where(known, freedom / (freedom + prior), 0.0)
        scatter = np.sqrt(own * np.where(known, variance, 0.0) + (1.0 - own) * common)
    # Where a reading is missing, the drift went on.
    course = drift["drift"].interpolate_na("cycle", fill_value="extrapolate").transpose("cycle", "direction", "target")
    total = float(freedom[known].sum()) or np.inf
    return scatter, course.values.astype(float), total


def predict_values(
    profile_um: Array,
    covariance_um2: Array,
    scatter_um: Array,
    courses_um: Sequence[Array],
    freedom: float = np.inf,
    *,
    cycles: int,
    one_table: bool,
) -> dict[str, Quantity]:
    """Predict A, E, M and B of a test of so many cycles: median over tests, each with its own readings and one of the courses of the drift.

    `profile_um` (2, n) is what the table leaves, with the covariance (2, n, 2, n) of its errors, up to a constant; `scatter_um` (2, n) the
    standard deviation of a reading, known with this freedom; a course (cycles, 2, n) the drift, which no table corrects.
    """
    if not (np.isfinite(scatter_um).all() and all(np.isfinite(one).all() for one in courses_um)):
        return {}
    rng, left = np.random.default_rng(_SEED), profile_um
    errors = rng.multivariate_normal(
        np.zeros(left.size), covariance_um2.reshape(left.size, left.size), _DRAWS, method="eigh"
    ).reshape(_DRAWS, *left.shape)
    if one_table:
        left, errors = _with_likely_reversal(left, errors)
    if np.isfinite(freedom):
        scatter_um = scatter_um * np.sqrt(freedom / rng.chisquare(freedom, _DRAWS))[:, None, None]
    mean = left - errors + scatter_um / cycles**0.5 * rng.standard_normal((_DRAWS, *left.shape))
    states = [courses_um[number] for number in rng.integers(0, len(courses_um), _DRAWS)]
    mean = mean + [state.mean(axis=0) for state in states]
    drifted = np.array([state.var(axis=0, ddof=1 if len(state) > 1 else 0) for state in states])
    # Readings that drift and scatter about their mean: squares of normal values that are not about zero.
    variance = np.broadcast_to(np.maximum(scatter_um**2, 1e-12), mean.shape) / (cycles - 1)
    spread = 2.0 * np.sqrt(variance * rng.noncentral_chisquare(cycles - 1, drifted / variance))
    drawn = axis_quantities(mean, spread / 2.0)
    return {name: Quantity(value=np.median(drawn[name]), u=drawn[name].std(ddof=1)) for name in ("A", "E", "M", "B")}


def _with_likely_reversal(left: Array, errors: Array) -> tuple[Array, Array]:
    """Return what one table leaves (2, n) and the errors of the profile (draws, 2, n) with the variation of the reversal that is likely.

    That variation is left as measured, errors included: of its variance only what exceeds theirs is the axis (Wiener's share).
    """
    seen, wrong = (one[..., 0, :] - one[..., 1, :] for one in (left, errors))
    wrong = wrong - wrong.mean(axis=-1, keepdims=True)
    share = max(0.0, 1.0 - float(np.mean(wrong**2)) / max(float(np.mean(seen**2)), 1e-12))
    halves = np.array([[0.5], [-0.5]])
    return left - (1.0 - share) * halves * seen, errors - (1.0 - share**0.5) * halves * wrong[:, None]
