"""ISO 230-2: accuracy and repeatability of positioning, over any window of cycles, with uncertainty.

The acceptance test of the standard has five cycles. A long test is not one: its R and A contain the drift, so the
window that was evaluated is part of every result.

Uncertainty of the ISO 230-2 quantities: a budget per quantity, with degrees of freedom (ISO 230-2 Annex A, ISO/TR 230-9).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import GTC
import numpy as np
import xarray as xr

from interferometry.deviations import DIRECTIONS
from interferometry.errors import InterferometryError

__all__ = ["QUANTITIES", "STANDARD_CYCLES", "Iso230Budget", "budget_table", "evaluate", "evaluate_windows"]

#: Quantities of the axis.
QUANTITIES = ("B", "R", "E", "M", "A")
STANDARD_CYCLES = 5


def evaluate(
    deviations: xr.Dataset, *, cycles: Sequence[int] | None = None, budget: Iso230Budget | None = None
) -> xr.Dataset:
    """Evaluate a window of cycles.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.
    cycles : sequence of int, optional
        Numbers of the cycles of the window; left out: all.
    budget : Iso230Budget, optional
        Left out: the laser's calibration alone.

    Returns
    -------
    xarray.Dataset
        In um. Per direction and target: mean_unidirectional, standard_deviation, repeatability (4 s). Per target:
        mean_bidirectional, reversal (B_i), repeatability_bidirectional (R_i). Per direction: R_unidirectional,
        E_unidirectional, A_unidirectional. Of the axis: B, mean_reversal, R, E, M, A. Each with its standard uncertainty
        ``<name>_u``; those of the mean deviations count from the first position. Quantities that need both directions are
        NaN where one was not measured.
        ``attrs["window"]`` names the cycles, says when they are not the five of the standard, and which targets are
        left out because a direction read them fewer than twice.

    Raises
    ------
    InterferometryError
        The window names a cycle that was not measured, or no target has two readings in it.
    """
    deviations = deviations.reindex(direction=list(DIRECTIONS))
    x, numbers = _select(deviations, cycles)
    count = np.isfinite(x).sum(axis=0)
    x, count, few = _leave_out_single_readings(deviations, x, count)
    result = xr.Dataset(
        _quantities(x, count),
        coords={"direction": deviations["direction"].values, "target": deviations["target"].values},
    )
    uncertain = UncertainTest(result, deviations["position"].values, budget or Iso230Budget())
    result = result.assign(uncertain.uncertainties())
    for name in result.data_vars:
        result[name].attrs["units"] = "1" if name == "count" else "um"
    result.attrs["window"] = _name_window(numbers, few)
    return result


def _quantities(x: np.ndarray, count: np.ndarray) -> dict[str, tuple[tuple[str, ...], object]]:
    """Return the quantities of the standard as variables from readings (cycle, direction, target)."""
    mean, s = _mean_and_s(x, count)
    reversal, both = mean[0] - mean[1], (mean[0] + mean[1]) / 2
    repeatability = np.fmax(2 * s[0] + 2 * s[1] + np.abs(reversal), np.fmax(4 * s[0], 4 * s[1]))
    repeatability[np.isnan(reversal)] = np.nan
    upper, lower = mean + 2 * s, mean - 2 * s
    bidirectional = np.isfinite(reversal).any()
    one_way = {
        "R_unidirectional": [_largest(4 * one) for one in s],
        "E_unidirectional": [_largest(one) + _largest(-one) for one in mean],
        "A_unidirectional": [_largest(one) + _largest(-other) for one, other in zip(upper, lower, strict=True)],
    }
    axis = {
        "B": _largest(np.abs(reversal)),
        "mean_reversal": float(np.mean(reversal[np.isfinite(reversal)])) if bidirectional else np.nan,
        "R": _largest(repeatability),
        "E": _largest(mean) + _largest(-mean) if bidirectional else np.nan,
        "M": _largest(both) + _largest(-both),
        "A": _largest(upper) + _largest(-lower) if bidirectional else np.nan,
    }
    return {
        "mean_unidirectional": (("direction", "target"), mean),
        "standard_deviation": (("direction", "target"), s),
        "repeatability": (("direction", "target"), 4 * s),
        "count": (("direction", "target"), count),
        "mean_bidirectional": (("target",), both),
        "reversal": (("target",), reversal),
        "repeatability_bidirectional": (("target",), repeatability),
        **{name: (("direction",), values) for name, values in one_way.items()},
        **{name: ((), value) for name, value in axis.items()},
    }


def evaluate_windows(
    deviations: xr.Dataset, *, length: int = STANDARD_CYCLES, budget: Iso230Budget | None = None
) -> xr.Dataset:
    """Evaluate windows of a few cycles along a long test, and the whole test as the last window.

    A test shorter than one window has the whole as its only window; windows without two readings of any target are not
    listed. Within a window of the standard's length the drift is small; between windows it shows as the walk of the means, and
    in the last entry as the growth of R and A.

    Returns
    -------
    xarray.Dataset
        Dim ``window``, whose coordinate names the cycles: what `evaluate` returns for the axis and per direction.

    Raises
    ------
    InterferometryError
        No target has two readings in the whole test.
    """
    numbers = deviations["cycle"].values.tolist()
    windows = [numbers[at : at + length] for at in range(0, len(numbers) - length + 1, length)]
    windows = [window for window in windows if _can_be_evaluated(deviations.sel(cycle=window))] + [numbers]
    evaluated = [evaluate(deviations, cycles=window, budget=budget) for window in windows]
    names = [one.attrs["window"] for one in evaluated]
    kept = [name for name in evaluated[0].data_vars if "target" not in evaluated[0][name].dims]
    joined = xr.concat([one[kept] for one in evaluated], dim="window", coords="minimal", compat="override")
    middle = [float(np.mean(window)) for window in windows]
    return joined.assign_coords(window=names, middle_cycle=("window", middle)).assign_attrs(window="several")


def _can_be_evaluated(deviations: xr.Dataset) -> bool:
    return bool((deviations["deviation"].count("cycle") >= 2).any())


def budget_table(deviations: xr.Dataset, quantity: str, *, budget: Iso230Budget) -> list[tuple[str, float]]:
    """Return the contributions to one quantity's standard uncertainty, largest first.

    Parameters
    ----------
    deviations : xarray.Dataset
    quantity : str
        One of QUANTITIES, or mean_reversal.
    budget : Iso230Budget

    Returns
    -------
    list of (str, float)
        Name of the contribution and its standard uncertainty in um.
    """
    result = evaluate(deviations, budget=budget)
    value = UncertainTest(result, deviations["position"].values, budget).axis()[quantity]
    return [(row.label, float(row.u)) for row in GTC.reporting.budget(value) if row.u > 0]


def _select(deviations: xr.Dataset, cycles: Sequence[int] | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the readings of the window as (cycle, direction, target), and the numbers of its cycles."""
    numbers = deviations["cycle"].values
    if cycles is None:
        return deviations["deviation"].values, numbers
    absent = sorted(set(cycles) - set(numbers.tolist()))
    if absent:
        raise InterferometryError(f"cycles {absent} of the window were not measured; the test holds {numbers.tolist()}")
    chosen = np.isin(numbers, list(cycles))
    return deviations["deviation"].values[chosen], numbers[chosen]


def _leave_out_single_readings(
    deviations: xr.Dataset, x: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Take out, by name, positions that a measured direction read fewer than twice: they have no standard deviation."""
    measured = count.any(axis=1, keepdims=True)
    single = (count < 2) & measured
    if not ((count >= 2) & measured).any():
        held = "one cycle" if x.shape[0] == 1 else f"{x.shape[0]} cycles"
        raise InterferometryError(
            f"no target has two readings from one side in a window of {held}; ISO 230-2 asks for {STANDARD_CYCLES} cycles, and "
            "scatter needs two: measure more, or widen the window"
        )
    names = [
        f"{deviations['target'].values[target]} {deviations['direction'].values[direction]}"
        for direction, target in np.argwhere(single)
    ]
    return np.where(single, np.nan, x), np.where(single, 0, count), names


def _mean_and_s(x: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and sample standard deviation over cycles; NaN where a direction was not measured."""
    filled = np.where(np.isfinite(x), x, 0.0)
    mean = filled.sum(axis=0) / np.where(count > 0, count, np.nan)
    squares = np.where(np.isfinite(x), (x - mean) ** 2, 0.0).sum(axis=0)
    return mean, np.sqrt(squares / np.where(count > 1, count - 1, np.nan))


def _largest(values: np.ndarray) -> float:
    """Return the largest finite value, NaN if there is none."""
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else np.nan


def _name_window(cycles: np.ndarray, left_out: Sequence[str]) -> str:
    name = f"cycles {cycles[0]}..{cycles[-1]}" if cycles.size > 1 else f"cycle {cycles[0]}"
    if cycles.size != STANDARD_CYCLES:
        name += f" ({cycles.size} cycles, not the {STANDARD_CYCLES} of the standard's acceptance test)"
    return name + (f"; without targets {', '.join(left_out)} (fewer than two readings)" if left_out else "")


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
                raise InterferometryError(
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
