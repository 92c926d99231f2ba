"""L3 - Uncertainty of the ISO 230-2 quantities: a budget per quantity, with degrees of freedom (ISO 230-2 Annex A, ISO/TR 230-9)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import GTC
import numpy as np
import xarray as xr


@dataclass(frozen=True)
class Iso230Budget:
    """What makes a perfect evaluation uncertain, besides the scatter of the readings (ISO 230-2 Annex A).

    All are standard uncertainties. Those in ppm act over the distance between the positions that decide a quantity.

    Attributes
    ----------
    device_ppm : float
        Calibration of the laser. An XL-80 with weather station is stated as 0.5 ppm at k = 2.
    misalignment_ppm : float
        Cosine error; a beam 1 mrad off reads 0.5 ppm short.
    machine_temperature_K : float
        Of the material temperature that the compensation used.
    expansion_coefficient_ppm_per_K : float
        Of the coefficient that the compensation used.
    difference_from_20_degC_K : float
        How far the material was from 20 degC (not an uncertainty: it scales the one of the coefficient).
    nominal_expansion_ppm_per_K : float
        The coefficient itself (it scales the uncertainty of temperature).
    environmental_variation_um : float
        Standard uncertainty from the drift test (range of the drift during one evaluation, divided by sqrt 12).
    """

    device_ppm: float = 0.25
    misalignment_ppm: float = 0.0
    machine_temperature_K: float = 0.0
    expansion_coefficient_ppm_per_K: float = 0.0
    difference_from_20_degC_K: float = 0.0
    nominal_expansion_ppm_per_K: float = 11.7
    environmental_variation_um: float = 0.0

    def __post_init__(self) -> None:
        for one in fields(self):
            if one.name.split("_")[0] in ("difference", "nominal"):
                continue
            if getattr(self, one.name) < 0:
                raise ValueError(
                    f"{one.name}={getattr(self, one.name)} is negative; a standard uncertainty is 0 or more"
                )


class UncertainTest:
    """The quantities of one evaluation as GTC numbers.

    A deviation is the mean of its readings, plus the environment's variation during them, plus the errors that grow with position and
    are the same in every cycle and direction. Those cancel in the reversal and in repeatability.

    Parameters
    ----------
    result : xarray.Dataset
        Means, standard deviations, counts and what `iso230.evaluate` makes of them.
    position_mm : (target,) ndarray
    budget : Iso230Budget
    """

    def __init__(self, result: xr.Dataset, position_mm: np.ndarray, budget: Iso230Budget) -> None:
        self._result, self._budget = result, budget
        self._mean, self._s = result["mean_unidirectional"].values, result["standard_deviation"].values
        self._count, self._at_mm = result["count"].values, position_mm - position_mm.min()
        self._deviations: dict[tuple[int, int], GTC.lib.UncertainReal] = {}
        self._sigmas: dict[tuple[int, int], GTC.lib.UncertainReal] = {}
        self._scale = 1e-3 * (
            GTC.ureal(0, budget.device_ppm, label="device")
            + GTC.ureal(0, budget.misalignment_ppm, label="misalignment")
            + budget.nominal_expansion_ppm_per_K
            * GTC.ureal(0, budget.machine_temperature_K, label="machine temperature")
            + budget.difference_from_20_degC_K
            * GTC.ureal(0, budget.expansion_coefficient_ppm_per_K, label="expansion coefficient")
        )

    def _name(self, direction: int, target: int) -> str:
        return f"{self._result['direction'].values[direction]} {self._result['target'].values[target]}"

    def _make_deviation(self, direction: int, target: int) -> GTC.lib.UncertainReal:
        readings, label = int(self._count[direction, target]), self._name(direction, target)
        own = self._s[direction, target] / readings**0.5
        scatter = GTC.ureal(0, own, readings - 1, label=f"mean at {label}")
        variation = self._budget.environmental_variation_um / readings**0.5
        environment = GTC.ureal(0, variation, label=f"environmental variation at {label}")
        return float(self._mean[direction, target]) + scatter + environment + float(self._at_mm[target]) * self._scale

    def _make_sigma(self, direction: int, target: int) -> GTC.lib.UncertainReal:
        readings, label = int(self._count[direction, target]), self._name(direction, target)
        s = float(self._s[direction, target])
        variation = np.hypot(s, self._budget.environmental_variation_um) - s
        own = GTC.ureal(s, s / (2 * (readings - 1)) ** 0.5, readings - 1, label=f"s at {label}")
        return own + GTC.ureal(0, variation, label=f"environmental variation of s at {label}")

    def deviation(self, direction: int, target: int) -> GTC.lib.UncertainReal:
        """Mean deviation of one approach to one target: one and the same number wherever it enters."""
        at = direction, target
        if at not in self._deviations:
            self._deviations[at] = self._make_deviation(*at)
        return self._deviations[at]

    def sigma(self, direction: int, target: int) -> GTC.lib.UncertainReal:
        """Standard deviation of one approach to one target, likewise."""
        at = direction, target
        if at not in self._sigmas:
            self._sigmas[at] = self._make_sigma(*at)
        return self._sigmas[at]

    def reversal(self, target: int) -> GTC.lib.UncertainReal:
        """Return B_i, signed."""
        return self.deviation(0, target) - self.deviation(1, target)

    def middle(self, target: int) -> GTC.lib.UncertainReal:
        """Return the mean of both directions."""
        return (self.deviation(0, target) + self.deviation(1, target)) / 2

    def repeatability(self, target: int) -> GTC.lib.UncertainReal:
        """Return R_i by what decides it: both directions with the reversal, or one of them."""
        one_way = 4 * self._s[:, target]
        best = int(np.argmax(one_way))
        if one_way[best] >= float(self._result["repeatability_bidirectional"][target]):
            return 4 * self.sigma(best, target)
        return 2 * self.sigma(0, target) + 2 * self.sigma(1, target) + _magnitude(self.reversal(target))

    def axis(self) -> dict[str, GTC.lib.UncertainReal]:
        """Return the quantities of the axis by name; none where one direction was not measured."""
        reversal = self._result["reversal"].values
        both = np.flatnonzero(np.isfinite(reversal))
        if both.size == 0:
            return {}
        middle = self._result["mean_bidirectional"].values
        top, bottom = _place(np.nanargmax, self._mean), _place(np.nanargmin, self._mean)
        return {
            "B": _magnitude(self.reversal(int(np.nanargmax(np.abs(reversal))))),
            "R": self.repeatability(int(np.nanargmax(self._result["repeatability_bidirectional"].values))),
            "E": self.deviation(*top) - self.deviation(*bottom),
            "M": self.middle(int(np.nanargmax(middle))) - self.middle(int(np.nanargmin(middle))),
            "A": self._accuracy(range(2)),
            "mean_reversal": sum(self.reversal(int(target)) for target in both) / both.size,
        }

    def of_direction(self, direction: int) -> dict[str, GTC.lib.UncertainReal]:
        """Return E, R and A of one direction; none where it was not measured."""
        mean = self._mean[direction]
        if not np.isfinite(mean).any():
            return {}
        top, bottom, wide = int(np.nanargmax(mean)), int(np.nanargmin(mean)), int(np.nanargmax(self._s[direction]))
        return {
            "R_unidirectional": 4 * self.sigma(direction, wide),
            "E_unidirectional": self.deviation(direction, top) - self.deviation(direction, bottom),
            "A_unidirectional": self._accuracy([direction]),
        }

    def _accuracy(self, directions: range | list[int]) -> GTC.lib.UncertainReal:
        rows = list(directions)
        mean, s = self._mean[rows], self._s[rows]
        high, low = _place(np.nanargmax, mean + 2 * s), _place(np.nanargmin, mean - 2 * s)
        high, low = (rows[high[0]], high[1]), (rows[low[0]], low[1])
        return self.deviation(*high) + 2 * self.sigma(*high) - (self.deviation(*low) - 2 * self.sigma(*low))

    def uncertainties(self) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
        """Return the standard uncertainty of every quantity, NaN where it is not known, as variables ``<name>_u``."""
        directions, targets = self._mean.shape
        measured = np.isfinite(self._mean)
        both = measured.all(axis=0)

        def per_cell(quantity: Callable[[int, int], GTC.lib.UncertainReal]) -> np.ndarray:
            u = np.full(self._mean.shape, np.nan)
            for direction, target in np.argwhere(measured):
                u[direction, target] = GTC.uncertainty(quantity(int(direction), int(target)))
            return u

        def per_target(quantity: Callable[[int], GTC.lib.UncertainReal]) -> np.ndarray:
            found = [GTC.uncertainty(quantity(int(target))) if both[target] else np.nan for target in range(targets)]
            return np.array(found, dtype=float)

        s_u = per_cell(self.sigma)
        found: dict[str, tuple[tuple[str, ...], np.ndarray]] = {
            "mean_unidirectional_u": (("direction", "target"), per_cell(self.deviation)),
            "standard_deviation_u": (("direction", "target"), s_u),
            "repeatability_u": (("direction", "target"), 4 * s_u),
            "mean_bidirectional_u": (("target",), per_target(self.middle)),
            "reversal_u": (("target",), per_target(self.reversal)),
            "repeatability_bidirectional_u": (("target",), per_target(self.repeatability)),
        }
        by_direction = [self.of_direction(direction) for direction in range(directions)]
        for name in ("R_unidirectional", "E_unidirectional", "A_unidirectional"):
            u = [GTC.uncertainty(one[name]) if one else np.nan for one in by_direction]
            found[f"{name}_u"] = (("direction",), np.array(u, dtype=float))
        axis = self.axis()
        for name in ("B", "mean_reversal", "R", "E", "M", "A"):
            found[f"{name}_u"] = ((), np.array(GTC.uncertainty(axis[name]) if axis else np.nan, dtype=float))
        return found


def _magnitude(value: GTC.lib.UncertainReal) -> GTC.lib.UncertainReal:
    return value if GTC.value(value) >= 0 else -value


def _place(extreme: Callable[[np.ndarray], np.intp], values: np.ndarray) -> tuple[int, int]:
    direction, target = np.unravel_index(int(extreme(values)), values.shape)
    return int(direction), int(target)
