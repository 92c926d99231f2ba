"""Uncertainty of the quantities of ISO 230-2: each as an uncertain number that carries its correlations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import GTC
import numpy as np
import xarray as xr
from scipy import special

from interferometry.common import Array
from interferometry.iso230.budget import CONTRIBUTIONS, Iso230Budget
from interferometry.iso230.quantities import AXIS, ONE_WAY, axis_quantities

#: Contributions to a quantity that was not measured.
_UNKNOWN = [np.nan] * len(CONTRIBUTIONS)
#: Tests that are drawn to see by how much the largest of noisy values is too large: enough to know it to a tenth of itself.
_DRAWS, _SEED = 400, 230
#: A position's own scatter replaces that of all where it exceeds it at this level.
_EXCESS_LEVEL = 1e-3


class UncertainTest:
    """The quantities of one evaluation as GTC numbers.

    A mean deviation is that of its readings, plus the errors that grow with position and are the same in every cycle and direction, which
    cancel in the reversal error and in repeatability. The scatter of a reading is that of all cells together, or a cell's own where that
    is clearly larger. A quantity by the definition of the standard holds two things that are known, not corrected, and enter its
    uncertainty (JCGM 100:2008, F.2.4.5): what the drift within the window has added, which is the quantity less that of the same
    readings without drift; and, of all but the mean reversal error, that the largest of noisy values is too large (parametric bootstrap
    after Efron and Tibshirani 1993, *An introduction to the bootstrap*, chapters 6 and 10). The axis also changes within the window: how
    far a quantity of its cycles scatters by the drift alone is a definitional uncertainty. A variation that is stated as one number has
    no course: it is taken as independent from one mean deviation to the next.
    """

    def __init__(
        self,
        result: xr.Dataset,
        without_drift: xr.Dataset,
        changes: Mapping[str, Array],
        position_mm: Array,
        budget: Iso230Budget,
    ) -> None:
        self._result, self._without_drift, self._changes = result, without_drift, changes
        self._variation = budget.environmental_variation_um or 0.0
        self._mean, self._s = result["mean_unidirectional"].values, result["standard_deviation"].values
        self._count, self._distance_mm = result["count"].values, position_mm - position_mm.min()
        self._scatter = _typical(without_drift["standard_deviation"].values, self._count - 1)
        along = np.argsort(position_mm, kind="stable")
        self._excess = _excess_of_extremes(self._mean[:, along], self._scatter[:, along], self._count[:, along])
        self._scale = 1e-3 * (
            GTC.ureal(0, budget.device_ppm, label="device")
            + GTC.ureal(0, budget.alignment_ppm, label="alignment")
            + budget.nominal_expansion_ppm_per_K
            * GTC.ureal(0, budget.material_temperature_K, label="material_temperature")
            + budget.difference_from_20_degC_K
            * GTC.ureal(0, budget.expansion_coefficient_ppm_per_K, label="expansion_coefficient")
        )
        cells = [(int(direction), int(target)) for direction, target in np.argwhere(np.isfinite(self._mean))]
        # By approach and target: each is the same correlated number wherever it enters.
        self.deviations = {cell: self._deviation(*cell) for cell in cells}
        self.sigmas = {cell: self._sigma(*cell) for cell in cells}

    def _deviation(self, direction: int, target: int) -> GTC.lib.UncertainReal:
        readings = int(self._count[direction, target])
        scatter = GTC.ureal(0, self._scatter[direction, target] / readings**0.5, readings - 1, label="sampling")
        environment = GTC.ureal(0, self._variation / readings**0.5, label="environmental_variation")
        return (
            float(self._mean[direction, target])
            + scatter
            + environment
            + float(self._distance_mm[target]) * self._scale
        )

    def _sigma(self, direction: int, target: int) -> GTC.lib.UncertainReal:
        """Return s with the scatter of an estimate, and with what a stated environmental variation has added to it."""
        readings, s = int(self._count[direction, target]), float(self._s[direction, target])
        added = s - np.sqrt(max(s**2 - self._variation**2, 0.0))
        u = self._scatter[direction, target] / (2 * (readings - 1)) ** 0.5
        return GTC.ureal(s, u, readings - 1, label="sampling") + GTC.ureal(0, added, label="environmental_variation")

    def _whole(self, name: str, value: GTC.lib.UncertainReal, *place: int) -> GTC.lib.UncertainReal:
        """Return a quantity with the excess of the largest of noisy values, and with the drift within the window."""
        excess = float(self._excess[name][place]) if name in self._excess else 0.0
        added = float(self._result[name].values[place] - self._without_drift[name].values[place])
        change = float(self._changes[name][place]) if name in self._changes else 0.0
        # Both excesses are known and add up, while the rows of a budget add as squares.
        environment = np.sqrt(max((excess + added) ** 2 - excess**2, 0.0) + change**2)
        return (
            value + GTC.ureal(0, excess, label="extremes") + GTC.ureal(0, environment, label="environmental_variation")
        )

    def reversal(self, target: int) -> GTC.lib.UncertainReal:
        """Reversal error B_i, signed."""
        return self.deviations[0, target] - self.deviations[1, target]

    def bidirectional_mean(self, target: int) -> GTC.lib.UncertainReal:
        """Mean bidirectional positioning deviation."""
        return (self.deviations[0, target] + self.deviations[1, target]) / 2

    def repeatability(self, target: int) -> GTC.lib.UncertainReal:
        """R_i by the term that decides it: both directions with the reversal error, or one of them."""
        unidirectional = 4 * self._s[:, target]
        best = int(np.argmax(unidirectional))
        if unidirectional[best] >= float(self._result["repeatability_bidirectional"][target]):
            return 4 * self.sigmas[best, target]
        return 2 * self.sigmas[0, target] + 2 * self.sigmas[1, target] + _magnitude(self.reversal(target))

    def axis(self) -> dict[str, GTC.lib.UncertainReal]:
        """Quantities of the axis by name; empty where a direction was not measured."""
        reversal = self._result["reversal"].values
        both = np.flatnonzero(np.isfinite(reversal))
        if both.size == 0:
            return {}
        middle = self._result["mean_bidirectional"].values
        top, bottom = _cell_of(np.nanargmax, self._mean), _cell_of(np.nanargmin, self._mean)
        extremes = {
            "B": _magnitude(self.reversal(int(np.nanargmax(np.abs(reversal))))),
            "R": self.repeatability(int(np.nanargmax(self._result["repeatability_bidirectional"].values))),
            "E": self.deviations[top] - self.deviations[bottom],
            "M": self.bidirectional_mean(int(np.nanargmax(middle)))
            - self.bidirectional_mean(int(np.nanargmin(middle))),
            "A": self._accuracy(range(2)),
        }
        mean_reversal = sum(self.reversal(int(target)) for target in both) / both.size
        return {name: self._whole(name, value) for name, value in {**extremes, "mean_reversal": mean_reversal}.items()}

    def of_direction(self, direction: int) -> dict[str, GTC.lib.UncertainReal]:
        """E, R and A of one direction by name; empty where it was not measured."""
        mean = self._mean[direction]
        if not np.isfinite(mean).any():
            return {}
        top, bottom, wide = int(np.nanargmax(mean)), int(np.nanargmin(mean)), int(np.nanargmax(self._s[direction]))
        extremes = {
            "R_unidirectional": 4 * self.sigmas[direction, wide],
            "E_unidirectional": self.deviations[direction, top] - self.deviations[direction, bottom],
            "A_unidirectional": self._accuracy([direction]),
        }
        return {name: self._whole(name, value, direction) for name, value in extremes.items()}

    def _accuracy(self, directions: Iterable[int]) -> GTC.lib.UncertainReal:
        rows = list(directions)
        mean, s = self._mean[rows], self._s[rows]
        high, low = _cell_of(np.nanargmax, mean + 2 * s), _cell_of(np.nanargmin, mean - 2 * s)
        high, low = (rows[high[0]], high[1]), (rows[low[0]], low[1])
        return self.deviations[high] + 2 * self.sigmas[high] - (self.deviations[low] - 2 * self.sigmas[low])

    def uncertainties(self) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
        """Standard uncertainty of every quantity in um, NaN where the quantity is, as variables ``<name>_u``, and ``contribution``."""
        directions, targets = self._mean.shape
        measured = np.isfinite(self._mean)
        both = measured.all(axis=0)

        def per_cell(name: str, values: dict[tuple[int, int], GTC.lib.UncertainReal]) -> np.ndarray:
            u = np.full(self._mean.shape, np.nan)
            for cell, value in values.items():
                u[cell] = GTC.uncertainty(self._whole(name, value, *cell))
            return u

        def per_target(
            name: str, quantity: Callable[[int], GTC.lib.UncertainReal]
        ) -> tuple[tuple[str, ...], np.ndarray]:
            u = np.full(targets, np.nan)
            for target in np.flatnonzero(both):
                u[target] = GTC.uncertainty(self._whole(name, quantity(int(target)), int(target)))
            return ("target",), u

        s_u = per_cell("standard_deviation", self.sigmas)
        variables: dict[str, tuple[tuple[str, ...], np.ndarray]] = {
            "mean_unidirectional_u": (("direction", "target"), per_cell("mean_unidirectional", self.deviations)),
            "standard_deviation_u": (("direction", "target"), s_u),
            "repeatability_u": (("direction", "target"), 4 * s_u),
            "mean_bidirectional_u": per_target("mean_bidirectional", self.bidirectional_mean),
            "reversal_u": per_target("reversal", self.reversal),
            "repeatability_bidirectional_u": per_target("repeatability_bidirectional", self.repeatability),
        }
        by_direction = [self.of_direction(direction) for direction in range(directions)]
        for name in ONE_WAY:
            u = [GTC.uncertainty(values[name]) if values else np.nan for values in by_direction]
            variables[f"{name}_u"] = (("direction",), np.array(u, dtype=float))
            shares = [_contributions(values[name]) if values else _UNKNOWN for values in by_direction]
            variables[f"{name}_contribution"] = (("direction", "contributor"), np.array(shares, dtype=float))
        axis = self.axis()
        for name in AXIS:
            variables[f"{name}_u"] = ((), np.array(GTC.uncertainty(axis[name]) if axis else np.nan, dtype=float))
        shares = [_contributions(axis[name]) if axis else _UNKNOWN for name in AXIS]
        variables["contribution"] = (("quantity", "contributor"), np.array(shares, dtype=float))
        return variables


def _contributions(value: GTC.lib.UncertainReal) -> list[float]:
    """Return the contribution of each group of inputs to the standard uncertainty, in the order of CONTRIBUTIONS."""
    squares = dict.fromkeys(CONTRIBUTIONS, 0.0)
    for part in GTC.reporting.budget(value, trim=0):
        squares[part.label] += float(part.u) ** 2
    return [float(np.sqrt(squares[name])) for name in CONTRIBUTIONS]


def _typical(s: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Return the standard deviation of all cells together, and a cell's own where it is larger at `_EXCESS_LEVEL`; NaN where it is."""
    known = np.isfinite(s)
    if not known.any():
        return s
    pooled = np.sqrt(np.average(s[known] ** 2, weights=freedom[known]))
    with np.errstate(divide="ignore", invalid="ignore"):
        own = special.chdtrc(freedom, freedom * (s / pooled) ** 2) < _EXCESS_LEVEL
    return np.where(known & ~own, pooled, s)


def _excess_of_extremes(mean: np.ndarray, s: np.ndarray, count: np.ndarray) -> dict[str, np.ndarray]:
    """Return by how much the quantities of tests of an axis exceed those of the axis itself, on average, um; targets in its order."""
    readings = np.where(np.isfinite(mean), count, 2)
    u = s / np.sqrt(readings)
    axis = _without_scatter(mean, u)
    squares, normal = _draw(readings - 1)
    drawn_s = s * np.sqrt(squares / (readings - 1))
    drawn, own = axis_quantities(axis + u * normal, drawn_s), axis_quantities(axis, s)
    return {name: np.fmax(values.mean(axis=0) - own[name], 0.0) for name, values in drawn.items()}


def _draw(freedom: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return chi-square numbers of these degrees of freedom (direction, target), and normal ones, as (draw, direction, target).

    The second half is the first as seen from the other end of the axis, which turns approach and sign: neither end is preferred.
    """
    squares, normal = np.empty((2, _DRAWS, *freedom.shape))
    half = _DRAWS // 2
    for cell in np.ndindex(freedom.shape):
        opposite = tuple(size - 1 - at for size, at in zip(freedom.shape, cell, strict=True))
        for part, place, sign in ((slice(half), cell, 1.0), (slice(half, None), opposite, -1.0)):
            rng = np.random.default_rng((_SEED, *place))
            squares[(part, *cell)] = rng.chisquare(freedom[cell], half)
            normal[(part, *cell)] = sign * rng.standard_normal(half)
    return squares, normal


def _without_scatter(mean: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return mean deviations whose bidirectional means and reversal errors differ between positions by no more than the axis makes them."""
    if not np.isfinite(mean).all(axis=0).any():
        return _drawn_together(mean, u)
    noise = np.sqrt((u**2).sum(axis=0))
    both, reversal = _drawn_together(mean.mean(axis=0), noise / 2), _drawn_together(mean[0] - mean[1], noise)
    together = np.stack([both + reversal / 2, both - reversal / 2])
    return np.where(np.isfinite(together), together, mean)


def _drawn_together(values: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return values (..., target) drawn towards their mean until the variance that u explains, up to its 95 % limit, is gone."""
    known = np.isfinite(values)
    if known.sum() < 2:
        return values
    centre, spread = values[known].mean(), values[known].var(ddof=1)
    freedom = known.sum() - 1
    by_scatter = float((u[known] ** 2).mean() * special.chdtri(freedom, 0.05) / freedom)
    share = max(1.0 - by_scatter / spread, 0.0) if spread > 0 else 0.0
    return centre + np.sqrt(share) * (values - centre)


def _magnitude(value: GTC.lib.UncertainReal) -> GTC.lib.UncertainReal:
    return value if GTC.value(value) >= 0 else -value


def _cell_of(extreme: Callable[[np.ndarray], np.intp], values: np.ndarray) -> tuple[int, int]:
    direction, target = np.unravel_index(int(extreme(values)), values.shape)
    return int(direction), int(target)
