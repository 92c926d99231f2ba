"""The quantities of ISO 230-2:2014, clause 3, from mean deviations and their standard deviations; their uncertainty, and its budget.

The uncertainty is that by the law of propagation: each quantity is a linear combination of means and standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
import xarray as xr

from interferometry.common import Array, check_uncertainties

#: Quantities of the axis: reversal error, bidirectional repeatability, bidirectional systematic positioning error, mean bidirectional
#: positioning error, bidirectional accuracy.
QUANTITIES = ("B", "R", "E", "M", "A")
#: What has an uncertainty: these, the signed mean of the reversal errors, and quantities of one direction.
AXIS = (*QUANTITIES, "mean_reversal")
ONE_WAY = ("R_unidirectional", "E_unidirectional", "A_unidirectional")


def target_quantities(mean: Array, s: Array) -> tuple[Array, Array, Array]:
    """Return mean bidirectional deviation, reversal error B_i and bidirectional repeatability R_i of every position."""
    positive, negative = mean[..., 0, :], mean[..., 1, :]
    s_positive, s_negative = s[..., 0, :], s[..., 1, :]
    reversal = positive - negative
    wide = np.fmax(2 * s_positive + 2 * s_negative + np.abs(reversal), np.fmax(4 * s_positive, 4 * s_negative))
    return (positive + negative) / 2, reversal, np.where(np.isnan(reversal), np.nan, wide)


def axis_quantities(mean: Array, s: Array) -> dict[str, Array]:
    """Return the quantities of the axis: B, R, E, M and A of both directions, and R, E and A of each."""
    both, reversal, repeatability = target_quantities(mean, s)
    bidirectional = np.isfinite(reversal).any(axis=-1)
    upper, lower = mean + 2 * s, mean - 2 * s
    cells = (-2, -1)
    return {
        "B": _largest(np.abs(reversal)),
        "R": _largest(repeatability),
        "E": np.where(bidirectional, _largest(mean, cells) + _largest(-mean, cells), np.nan),
        "M": _largest(both) + _largest(-both),
        "A": np.where(bidirectional, _largest(upper, cells) + _largest(-lower, cells), np.nan),
        "R_unidirectional": _largest(4 * s),
        "E_unidirectional": _largest(mean) + _largest(-mean),
        "A_unidirectional": _largest(upper) + _largest(-lower),
    }


def _largest(values: Array, axes: int | tuple[int, ...] = -1) -> Array:
    """Return the largest finite value along axes, NaN where there is none."""
    return np.asarray(np.fmax.reduce(values, axis=axes), dtype=float)


#: Inputs of lengths, whose errors are one and the same in all readings of a test: the field of `Iso230Budget` that holds each, its unit.
LENGTHS = {
    "device": ("device_ppm", "ppm"),
    "alignment": ("alignment_ppm", "ppm"),
    "material_temperature": ("material_temperature_K", "K"),
    "expansion_coefficient": ("expansion_coefficient_ppm_per_K", "ppm/K"),
}
#: The sampling, by which a few cycles stand for the axis: scatter of the readings, and that the largest of noisy values is too large.
SAMPLING = ("sampling", "extremes")
#: Contributions to the uncertainty, in the order of the budget.
CONTRIBUTIONS = (*LENGTHS, "environmental_variation", *SAMPLING)


@dataclass(frozen=True)
class Iso230Budget:
    """Contributions to the uncertainty besides the scatter of the readings (ISO 230-2:2014 Annex A, ISO/TR 230-9).

    All are standard uncertainties (k = 1). Those that scale with length act over the distance between the positions that decide a
    quantity. The defaults are assumptions for a workshop; a laboratory that knows better states its own.

    Attributes
    ----------
    device_ppm : float
        Laser with its compensation for the air, ppm. Assumed: 0.25 ppm, a laser with weather station that is stated as 0.5 ppm at k = 2.
    alignment_ppm : float
        Cosine error, ppm; a beam 1 mrad off reads 0.5 ppm short. Assumed: 0.3 ppm, limits of 1 mrad with a rectangular distribution.
    material_temperature_K : float
        Of the temperature that the compensation took for that of the measured length, K: accuracy of the probe and of its place.
        Assumed: 0.3 K.
    expansion_coefficient_ppm_per_K : float
        Of the expansion coefficient that the compensation used, ppm/K. Assumed: 1.2 ppm/K, limits of 2 ppm/K on either side with a
        rectangular distribution, between which steels and cast irons of unknown grade lie (JCGM 100:2008, 4.3.7).
    difference_from_20_degC_K : float
        Difference of the material temperature from 20 degC, K (no uncertainty: it scales that of the coefficient). Assumed: 10 K,
        an axis that has warmed in a workshop of 15 to 25 degC: what is not measured must not make the uncertainty smaller.
    nominal_expansion_ppm_per_K : float
        The coefficient itself, ppm/K (no uncertainty: it scales that of the temperature). Assumed: 11.7 ppm/K, steel.
    environmental_variation_um : float or None
        Environmental variation error (EVE) during one evaluation, um; that of a drift test of range E is E / sqrt 12. One number has no
        course, and counts as independent from one mean deviation to the next. None: what the drift of the joint estimate, where there
        is one, does to each quantity.

    Raises
    ------
    InterferometryError
        A value is not finite, or a standard uncertainty negative.

    Notes
    -----
    docs/method/iso230.md derives the assumptions and states how often the intervals cover the truth.

    Examples
    --------
    >>> Iso230Budget(device_ppm=0.1, environmental_variation_um=0.4).material_temperature_K
    0.3
    """

    device_ppm: float = 0.25
    alignment_ppm: float = 0.3
    material_temperature_K: float = 0.3
    expansion_coefficient_ppm_per_K: float = 1.2
    difference_from_20_degC_K: float = 10.0
    nominal_expansion_ppm_per_K: float = 11.7
    environmental_variation_um: float | None = None

    def __post_init__(self) -> None:
        check_uncertainties(self, signed=("difference_from_20_degC_K", "nominal_expansion_ppm_per_K"))

    @property
    def is_scatter_alone(self) -> bool:
        """Whether instrument, alignment and material contribute nothing."""
        return not any(getattr(self, field) for field, _ in LENGTHS.values())


#: No error of instrument, alignment or material, as for a rotary axis: the budget is one of lengths.
SCATTER_ALONE = Iso230Budget(**{field: 0.0 for field, _ in LENGTHS.values()})

#: Tests that are drawn to see by how much the largest of noisy values is too large: enough to know it to a tenth of itself.
_DRAWS, _SEED = 400, 230
#: A position's own scatter replaces that of all where it exceeds it at this level.
_EXCESS_LEVEL = 1e-3
_ENVIRONMENT, _SAMPLING, _EXTREMES = map(CONTRIBUTIONS.index, ("environmental_variation", "sampling", "extremes"))

#: Names of dimensions, and values.
Variable = tuple[tuple[str, ...], Array]


def uncertainties(
    result: xr.Dataset,
    without_drift: xr.Dataset,
    changes: Mapping[str, Array],
    position_mm: Array,
    budget: Iso230Budget,
) -> dict[str, Variable]:
    """Return the standard uncertainty of every quantity in um, NaN where the quantity is, as ``<name>_u``, and their contributions.

    A mean deviation is that of its readings, plus the errors that grow with position and are the same in every cycle and direction, which
    cancel in the reversal error and in repeatability. The scatter of a reading is that of all cells together, or a cell's own where that
    is clearly larger. A quantity by the definition of the standard holds two things that are known, not corrected, and enter its
    uncertainty (JCGM 100:2008, F.2.4.5): what the drift within the window has added, which is the quantity less that of the same
    readings without drift; and, of all but the mean reversal error, that the largest of noisy values is too large (parametric bootstrap
    after Efron and Tibshirani 1993, *An introduction to the bootstrap*, chapters 6 and 10). The axis also changes within the window: how
    far a quantity of its cycles scatters by the drift alone is a definitional uncertainty. A variation that is stated as one number has
    no course: it is taken as independent from one mean deviation to the next.
    """
    mean, s, count = (result[name].values for name in ("mean_unidirectional", "standard_deviation", "count"))
    scatter = _typical(without_drift["standard_deviation"].values, count - 1)
    along = np.argsort(position_mm, kind="stable")
    excesses = _excess_of_extremes(mean[:, along], scatter[:, along], count[:, along])
    inputs = _inputs(s, scatter, count, position_mm, budget.environmental_variation_um or 0.0)

    def squares(name: str, inputs: Array, of_mean: Array, of_s: Array) -> Array:
        """Squared contributions to a quantity by the sensitivities of its cells."""
        found = _propagate(inputs, budget, of_mean, of_s)
        # The excess of the largest of noisy values and the drift within the window are both known and add up.
        excess, added = excesses.get(name, 0.0), result[name].values - without_drift[name].values
        found[..., _EXTREMES] = np.square(excess)
        found[..., _ENVIRONMENT] += np.maximum((excess + added) ** 2 - np.square(excess), 0.0)
        found[..., _ENVIRONMENT] += np.square(changes.get(name, 0.0))
        return np.where(np.isfinite(result[name].values)[..., None], found, np.nan)

    one, none = np.ones((*mean.shape, 1)), np.zeros((*mean.shape, 1))
    s_squares = squares("standard_deviation", inputs[..., None], none, one)
    by_name: dict[str, Variable] = {
        "mean_unidirectional": (("direction", "target"), squares("mean_unidirectional", inputs[..., None], one, none)),
        "standard_deviation": (("direction", "target"), s_squares),
        "repeatability": (("direction", "target"), 16.0 * s_squares),
    }
    for dims, cells, sensitivities in (
        (("target",), inputs.transpose(0, 2, 1), _of_targets(result)),
        (("direction",), inputs, _of_directions(result)),
        ((), inputs.reshape(len(inputs), -1), _of_axis(result)),
    ):
        by_name.update({name: (dims, squares(name, cells, *of)) for name, of in sensitivities.items()})
    variables = {f"{name}_u": (dims, np.sqrt(parts.sum(axis=-1))) for name, (dims, parts) in by_name.items()}
    for name in ONE_WAY:
        variables[f"{name}_contribution"] = (("direction", "contributor"), np.sqrt(by_name[name][1]))
    shares = np.sqrt(np.stack([by_name[name][1] for name in AXIS]))
    return {**variables, "contribution": (("quantity", "contributor"), shares)}


def _inputs(s: Array, scatter: Array, count: Array, position_mm: Array, variation: float) -> Array:
    """Standard uncertainties, um, of the mean by its readings and by a stated environmental variation, of the standard deviation by the
    same, and the distance from the first position, mm: (5, direction, target); 0 without readings, which decide no quantity.
    """
    readings = np.where(count > 1, count, np.nan)
    # What a stated environmental variation has added to the standard deviation.
    added = s - np.sqrt(np.maximum(s**2 - variation**2, 0.0))
    distance = np.broadcast_to(position_mm - position_mm.min(), s.shape)
    parts = (scatter / np.sqrt(readings), variation / np.sqrt(readings), scatter / np.sqrt(2 * (readings - 1)), added)
    return np.nan_to_num(np.stack([*parts, distance]))


def _propagate(inputs: Array, budget: Iso230Budget, of_mean: Array, of_s: Array) -> Array:
    """Squared contributions (..., contributor) to quantities whose sensitivities to means and standard deviations are (..., cells)."""
    mean_sampling, mean_environment, s_sampling, s_environment, distance_mm = inputs
    per_mm = 1e-3 * np.array(
        [
            budget.device_ppm,
            budget.alignment_ppm,
            budget.nominal_expansion_ppm_per_K * budget.material_temperature_K,
            budget.difference_from_20_degC_K * budget.expansion_coefficient_ppm_per_K,
        ]
    )
    found = np.zeros((*of_mean.shape[:-1], len(CONTRIBUTIONS)))
    found[..., : per_mm.size] = np.square((of_mean * distance_mm).sum(axis=-1)[..., None] * per_mm)
    found[..., _ENVIRONMENT] = ((of_mean * mean_environment) ** 2 + (of_s * s_environment) ** 2).sum(axis=-1)
    found[..., _SAMPLING] = ((of_mean * mean_sampling) ** 2 + (of_s * s_sampling) ** 2).sum(axis=-1)
    return found


#: Sensitivities of quantities to the means and to the standard deviations of cells.
Sensitivities = tuple[Array, Array]


def _of_targets(result: xr.Dataset) -> dict[str, Sensitivities]:
    """Sensitivities (target, direction) of the quantities of every target."""
    s, reversal = result["standard_deviation"].values.T, result["reversal"].values[:, None]
    none, difference = np.zeros(s.shape), np.broadcast_to([1.0, -1.0], s.shape)
    # The term that decides R_i: both directions with the reversal error, or one of them.
    wider = s == np.fmax.reduce(s, axis=1, keepdims=True)
    wider[:, 1] &= ~wider[:, 0]
    one_way = 4 * np.fmax.reduce(s, axis=1) >= result["repeatability_bidirectional"].values
    magnitude = np.where(reversal >= 0, difference, -difference)
    return {
        "mean_bidirectional": (none + 0.5, none),
        "reversal": (difference, none),
        "repeatability_bidirectional": (
            np.where(one_way[:, None], 0.0, magnitude),
            np.where(one_way[:, None], 4.0 * wider, 2.0),
        ),
    }


def _of_axis(result: xr.Dataset) -> dict[str, Sensitivities]:
    """Sensitivities (direction and target,) of the quantities of the axis, by the cells that decide them."""
    mean, s, reversal = (result[name].values for name in ("mean_unidirectional", "standard_deviation", "reversal"))
    both, of_targets = np.isfinite(reversal), _of_targets(result)
    found = {name: np.zeros((2, *mean.shape)) for name in AXIS}
    if both.any():
        found["E"], found["A"] = _of_range(mean, s, 0.0), _of_range(mean, s, 2.0)
        middle = result["mean_bidirectional"].values
        found["M"][0, :, np.nanargmax(middle)] += 0.5
        found["M"][0, :, np.nanargmin(middle)] -= 0.5
        for name, wider in (("E", "M"), ("A", "E")):
            # Where both extremes lie at one target, what distorts the axis between targets widens the range all the same.
            found[name][0] += found[wider][0] if not found[name][0].sum(axis=0).any() else 0.0
        wide = result["repeatability_bidirectional"].values
        for name, values, quantity in (("B", np.abs(reversal), "reversal"), ("R", wide, "repeatability_bidirectional")):
            place = np.nanargmax(values)
            found[name][:, :, place] = [by_target[place] for by_target in of_targets[quantity]]
        found["mean_reversal"][0] = np.outer([1.0, -1.0], both / both.sum())
    return {name: (of_mean.ravel(), of_s.ravel()) for name, (of_mean, of_s) in found.items()}


def _of_directions(result: xr.Dataset) -> dict[str, Sensitivities]:
    """Sensitivities (direction, target) of the quantities of each direction, by the targets that decide them."""
    mean, s = (result[name].values for name in ("mean_unidirectional", "standard_deviation"))
    found = {name: np.zeros((2, *mean.shape)) for name in ONE_WAY}
    for direction in np.flatnonzero(np.isfinite(mean).any(axis=1)):
        own = mean[direction], s[direction]
        found["R_unidirectional"][1, direction, np.nanargmax(own[1])] = 4.0
        for name, width in (("E_unidirectional", 0.0), ("A_unidirectional", 2.0)):
            found[name][:, direction] = _of_range(*own, width)
    return {name: (of_mean, of_s) for name, (of_mean, of_s) in found.items()}


def _of_range(mean: Array, s: Array, width: float) -> Array:
    """Sensitivities (2, ...) of the range of mean deviations, so many standard deviations wide, to both."""
    found = np.zeros((2, *mean.shape))
    high, low = (
        np.unravel_index(place, s.shape) for place in (np.nanargmax(mean + width * s), np.nanargmin(mean - width * s))
    )
    for place, sign in ((high, 1.0), (low, -1.0)):
        found[0][place] += sign
        found[1][place] += width
    return found


def _typical(s: Array, freedom: Array) -> Array:
    """Return the standard deviation of all cells together, and a cell's own where it is larger at `_EXCESS_LEVEL`; NaN where it is."""
    known = np.isfinite(s)
    if not known.any():
        return s
    pooled = np.sqrt(np.average(s[known] ** 2, weights=freedom[known]))
    with np.errstate(divide="ignore", invalid="ignore"):
        own = scipy.special.chdtrc(freedom, freedom * (s / pooled) ** 2) < _EXCESS_LEVEL
    return np.where(known & ~own, pooled, s)


def _excess_of_extremes(mean: Array, s: Array, count: Array) -> dict[str, Array]:
    """Return by how much the quantities of tests of an axis exceed those of the axis itself, on average, um; targets in its order."""
    readings = np.where(np.isfinite(mean), count, 2)
    u = s / np.sqrt(readings)
    axis = _without_scatter(mean, u)
    squares, normal = _draw(tuple(map(tuple, (readings - 1).tolist())))
    drawn_s = s * np.sqrt(squares / (readings - 1))
    drawn, own = axis_quantities(axis + u * normal, drawn_s), axis_quantities(axis, s)
    return {name: np.fmax(values.mean(axis=0) - own[name], 0.0) for name, values in drawn.items()}


@lru_cache(maxsize=4)
def _draw(degrees: tuple[tuple[float, ...], ...]) -> tuple[Array, Array]:
    """Return chi-square numbers of these degrees of freedom (direction, target), and normal ones, as (draw, direction, target); the windows
    of a test ask for the same ones.

    The second half is the first as seen from the other end of the axis, which turns approach and sign: neither end is preferred.
    """
    freedom = np.array(degrees)
    squares, normal = np.empty((2, _DRAWS, *freedom.shape))
    half = _DRAWS // 2
    for cell in np.ndindex(freedom.shape):
        opposite = tuple(size - 1 - at for size, at in zip(freedom.shape, cell, strict=True))
        for part, place, sign in ((slice(half), cell, 1.0), (slice(half, None), opposite, -1.0)):
            rng = np.random.default_rng((_SEED, *place))
            squares[(part, *cell)] = rng.chisquare(freedom[cell], half)
            normal[(part, *cell)] = sign * rng.standard_normal(half)
    return squares, normal


def _without_scatter(mean: Array, u: Array) -> Array:
    """Return mean deviations whose bidirectional means and reversal errors differ between positions by no more than the axis makes them."""
    if not np.isfinite(mean).all(axis=0).any():
        return _drawn_together(mean, u)
    noise = np.sqrt((u**2).sum(axis=0))
    both, reversal = _drawn_together(mean.mean(axis=0), noise / 2), _drawn_together(mean[0] - mean[1], noise)
    together = np.stack([both + reversal / 2, both - reversal / 2])
    return np.where(np.isfinite(together), together, mean)


def _drawn_together(values: Array, u: Array) -> Array:
    """Return values (..., target) drawn towards their mean until the variance that u explains, up to its 95 % limit, is gone."""
    known = np.isfinite(values)
    if known.sum() < 2:
        return values
    centre, spread = values[known].mean(), values[known].var(ddof=1)
    freedom = known.sum() - 1
    by_scatter = float((u[known] ** 2).mean() * scipy.special.chdtri(freedom, 0.05) / freedom)
    share = max(1.0 - by_scatter / spread, 0.0) if spread > 0 else 0.0
    return centre + np.sqrt(share) * (values - centre)
