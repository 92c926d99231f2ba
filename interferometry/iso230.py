"""Accuracy and repeatability of positioning by ISO 230-2:2014, over any window of cycles, each quantity with its uncertainty.

The acceptance test of the standard has five cycles of a warmed-up axis. In a longer test R and A contain the drift: the window that
was evaluated is part of every result.

Names are those of the standard: x_ij positioning deviation, mean unidirectional positioning deviation at a position, s_i its standard
deviation, B_i reversal error at a position, R_i repeatability at a position; of the axis: reversal error B, mean reversal error,
bidirectional repeatability R, bidirectional systematic positioning error E, mean bidirectional positioning error M, bidirectional
accuracy A.

In this order: the uncertainty budget that the caller states; the evaluation; the quantities as numbers with uncertainty.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields

import GTC
import numpy as np
import xarray as xr
from scipy.stats import norm

from interferometry.contract import check_dataset
from interferometry.deviations import DIRECTIONS
from interferometry.errors import InterferometryError

#: Quantities of the axis: reversal error, bidirectional repeatability, bidirectional systematic positioning error, mean bidirectional
#: positioning error, bidirectional accuracy.
QUANTITIES = ("B", "R", "E", "M", "A")
STANDARD_CYCLES = 5


@dataclass(frozen=True)
class Iso230Budget:
    """Contributions to the uncertainty besides the scatter of the readings (ISO 230-2:2014 Annex A, ISO/TR 230-9).

    All are standard uncertainties (k = 1) unless said otherwise. Those that scale with length act over the distance between the
    positions that decide a quantity.

    Attributes
    ----------
    device_ppm : float
        Calibration of the laser, ppm. An XL-80 with weather station is stated as 0.5 ppm at k = 2.
    misalignment_ppm : float
        Cosine error, ppm; a beam 1 mrad off reads 0.5 ppm short.
    machine_temperature_K : float
        Of the material temperature that the compensation used, K.
    expansion_coefficient_ppm_per_K : float
        Of the expansion coefficient that the compensation used, ppm/K.
    difference_from_20_degC_K : float
        Difference of the material temperature from 20 degC, K (no uncertainty: it scales the one of the coefficient).
    nominal_expansion_ppm_per_K : float
        The coefficient itself, ppm/K (no uncertainty: it scales the one of the temperature).
    environmental_variation_um : float
        From the drift test (ETVE), um: range of the drift during one evaluation, divided by sqrt 12.

    Raises
    ------
    InterferometryError
        A standard uncertainty is negative.

    Examples
    --------
    >>> Iso230Budget(device_ppm=0.25, machine_temperature_K=0.3, environmental_variation_um=0.4).misalignment_ppm
    0.0
    """

    device_ppm: float = 0.25
    misalignment_ppm: float = 0.0
    machine_temperature_K: float = 0.0
    expansion_coefficient_ppm_per_K: float = 0.0
    difference_from_20_degC_K: float = 0.0
    nominal_expansion_ppm_per_K: float = 11.7
    environmental_variation_um: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.name.split("_")[0] in ("difference", "nominal"):
                continue
            if getattr(self, field.name) < 0:
                raise InterferometryError(
                    f"{field.name}={getattr(self, field.name)} is negative; a standard uncertainty is 0 or more"
                )


def evaluate_iso230(
    deviations: xr.Dataset, *, cycles: Sequence[int] | None = None, budget: Iso230Budget | None = None
) -> xr.Dataset:
    """Evaluate a window of cycles by ISO 230-2.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um, as `build_deviations` returns them; readings may be missing. Of a rotary
        axis they are in arcsec, as the units of ``deviation`` say.
    cycles : sequence of int, optional
        Numbers of the cycles of the window; None: all.
    budget : Iso230Budget, optional
        None: the calibration of the laser alone; of a rotary axis only the scatter, as the budget is one of lengths.

    Returns
    -------
    xarray.Dataset
        In um (arcsec), each with its standard uncertainty ``<name>_u``.

        - Per direction and target: ``mean_unidirectional``, ``standard_deviation`` (s_i), ``repeatability`` (4 s_i), ``count`` (1).
        - Per target: ``mean_bidirectional``, ``reversal`` (B_i), ``repeatability_bidirectional`` (R_i).
        - Per direction: ``R_unidirectional``, ``E_unidirectional``, ``A_unidirectional``.
        - Of the axis: ``B`` reversal error; ``B_of_scatter``, what scatter alone gives in half of such tests of an axis without reversal
          error (B is the largest of noisy values; no uncertainty); ``mean_reversal`` (signed), ``R`` bidirectional repeatability, ``E``
          bidirectional systematic positioning error, ``M`` mean bidirectional positioning error, ``A`` bidirectional accuracy.

        The uncertainties of mean deviations are relative to the first position. Quantities that need both directions are NaN where
        one was not measured. ``attrs["window"]`` names the cycles, says if they are not the five of the standard, and which targets
        are left out because a direction has fewer than two readings there.

    Raises
    ------
    InterferometryError
        ``deviations`` lack a variable of ``contract.DEVIATIONS``, the window names a cycle that was not measured, no target has two
        readings in it, or a budget is given for a rotary axis.

    Notes
    -----
    ISO 230-2:2014, clause 3; docs/method/iso230.md. With mean deviations m and their standard deviations s, up and down for the
    directions: B = max |m_up - m_down|, R_i = max(2 s_up + 2 s_down + |B_i|, 4 s_up, 4 s_down), R = max R_i, E = max m - min m,
    M = range of (m_up + m_down) / 2, A = max(m + 2 s) - min(m - 2 s). Uncertainties by the law of propagation (JCGM 100:2008) with the
    contributions of Annex A.

    Examples
    --------
    >>> import numpy as np
    >>> from interferometry.deviations import build_deviations
    >>> deviation = np.array([[[0.0, 5.0], [2.0, 6.0]], [[0.0, 5.0], [2.0, 6.0]]])
    >>> time = np.full(deviation.shape, np.datetime64("NaT", "ns"))
    >>> test = build_deviations([1, 2], [1, 2], np.array([0.0, 100.0]), deviation, time)
    >>> result = evaluate_iso230(test)
    >>> {name: float(result[name]) for name in QUANTITIES}
    {'B': 2.0, 'R': 2.0, 'E': 6.0, 'M': 4.5, 'A': 6.0}
    """
    check_dataset(deviations, "deviations")
    if budget is not None and deviations["deviation"].attrs.get("units") == "arcsec":
        raise InterferometryError(
            "budget: its contributions are parts per million of a length; leave it out for a rotary axis, where only the scatter enters"
        )
    deviations = deviations.reindex(direction=list(DIRECTIONS))
    x, numbers = _select(deviations, cycles)
    count = np.isfinite(x).sum(axis=0)
    x, count, left_out = _leave_out_single_readings(deviations, x, count)
    result = xr.Dataset(
        _quantities(x, count),
        coords={"direction": deviations["direction"].values, "target": deviations["target"].values},
    )
    unit = deviations["deviation"].attrs.get("units", "um")
    uncertain = _UncertainTest(result, deviations["position"].values, budget or _default_budget(unit))
    result = result.assign(uncertain.uncertainties())
    for name in result.data_vars:
        result[name].attrs["units"] = "1" if name == "count" else unit
    result.attrs["window"] = _name_window(numbers, left_out)
    return result


def _default_budget(unit: str) -> Iso230Budget:
    return Iso230Budget() if unit == "um" else Iso230Budget(device_ppm=0.0)


def evaluate_windows(
    deviations: xr.Dataset, *, length: int = STANDARD_CYCLES, budget: Iso230Budget | None = None
) -> xr.Dataset:
    """Evaluate windows of a few cycles along a long test, and the whole test as the last window.

    Within a window of the standard's length the drift is small; between windows it shows as a change of the means, and in the last
    window as larger R and A.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.
    length : int
        Cycles of a window.
    budget : Iso230Budget, optional
        None: the calibration of the laser alone.

    Returns
    -------
    xarray.Dataset
        What `evaluate_iso230` returns for the axis and per direction, along ``window``, whose coordinate names the cycles;
        ``middle_cycle`` is the middle of each. Windows in which no target has two readings are not listed; a test shorter than one
        window is its only window.

    Raises
    ------
    InterferometryError
        No target has two readings in the whole test.
    """
    numbers = deviations["cycle"].values.tolist()
    windows = [numbers[start : start + length] for start in range(0, len(numbers) - length + 1, length)]
    windows = [window for window in windows if _can_be_evaluated(deviations.sel(cycle=window))] + [numbers]
    results = [evaluate_iso230(deviations, cycles=window, budget=budget) for window in windows]
    kept = [name for name in results[0].data_vars if "target" not in results[0][name].dims]
    joined = xr.concat([result[kept] for result in results], dim="window", coords="minimal", compat="override")
    middle = [float(np.mean(window)) for window in windows]
    names = [result.attrs["window"] for result in results]
    return joined.assign_coords(window=names, middle_cycle=("window", middle)).assign_attrs(window="several")


def budget_table(deviations: xr.Dataset, quantity: str, *, budget: Iso230Budget) -> list[tuple[str, float]]:
    """Return the contributions to the standard uncertainty of one quantity, largest first.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.
    quantity : str
        One of QUANTITIES, or "mean_reversal".
    budget : Iso230Budget

    Returns
    -------
    list of (str, float)
        Name of each contribution and its standard uncertainty in um, sensitivity included.

    Raises
    ------
    InterferometryError
        No target has two readings.
    """
    result = evaluate_iso230(deviations, budget=budget)
    value = _UncertainTest(result, deviations["position"].values, budget).axis()[quantity]
    return [(row.label, float(row.u)) for row in GTC.reporting.budget(value) if row.u > 0]


def _select(deviations: xr.Dataset, cycles: Sequence[int] | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the readings of the window as (cycle, direction, target), and the numbers of its cycles."""
    numbers = deviations["cycle"].values
    if cycles is None:
        return deviations["deviation"].values, numbers
    missing = sorted(set(cycles) - set(numbers.tolist()))
    if missing:
        raise InterferometryError(
            f"cycles {missing} of the window were not measured; the test holds {numbers.tolist()}"
        )
    chosen = np.isin(numbers, list(cycles))
    return deviations["deviation"].values[chosen], numbers[chosen]


def _leave_out_single_readings(
    deviations: xr.Dataset, x: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Leave out, by name, positions with fewer than two readings in a measured direction: they have no standard deviation."""
    measured = count.any(axis=1, keepdims=True)
    single = (count < 2) & measured
    if not ((count >= 2) & measured).any():
        window = "one cycle" if x.shape[0] == 1 else f"{x.shape[0]} cycles"
        raise InterferometryError(
            f"no target has two readings from one side in a window of {window}; ISO 230-2 asks for {STANDARD_CYCLES} cycles, and "
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
    name = f"cycles {cycles[0]} to {cycles[-1]}" if cycles.size > 1 else f"cycle {cycles[0]}"
    if cycles.size != STANDARD_CYCLES:
        name += f" ({cycles.size} cycles, not the {STANDARD_CYCLES} of the standard's acceptance test)"
    return name + (f"; without targets {', '.join(left_out)} (fewer than two readings)" if left_out else "")


def _quantities(x: np.ndarray, count: np.ndarray) -> dict[str, tuple[tuple[str, ...], object]]:
    """Return the quantities of the standard from deviations x and their numbers (cycle, direction, target), as variables."""
    mean, s = _mean_and_s(x, count)
    reversal, both = mean[0] - mean[1], (mean[0] + mean[1]) / 2
    repeatability = np.fmax(2 * s[0] + 2 * s[1] + np.abs(reversal), np.fmax(4 * s[0], 4 * s[1]))
    repeatability[np.isnan(reversal)] = np.nan
    upper, lower = mean + 2 * s, mean - 2 * s
    bidirectional = np.isfinite(reversal).any()
    unidirectional = {
        "R_unidirectional": [_largest(4 * row) for row in s],
        "E_unidirectional": [_largest(row) + _largest(-row) for row in mean],
        "A_unidirectional": [_largest(high) + _largest(-low) for high, low in zip(upper, lower, strict=True)],
    }
    axis = {
        "B": _largest(np.abs(reversal)),
        "B_of_scatter": _reversal_of_scatter(s, count),
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
        **{name: (("direction",), values) for name, values in unidirectional.items()},
        **{name: ((), value) for name, value in axis.items()},
    }


def _reversal_of_scatter(s: np.ndarray, count: np.ndarray) -> float:
    """Return the B that scatter alone gives in half of such tests, um.

    The median q of max |z| over m targets solves (2 Phi(q) - 1)^m = 1/2.
    """
    variance = (s**2 / np.fmax(count, 1)).sum(axis=0)
    both = variance[np.isfinite(variance)]
    return float(norm.ppf((1.0 + 0.5 ** (1.0 / both.size)) / 2.0) * np.sqrt(both.mean())) if both.size else np.nan


def _can_be_evaluated(deviations: xr.Dataset) -> bool:
    return bool((deviations["deviation"].count("cycle") >= 2).any())


class _UncertainTest:
    """The quantities of one evaluation as GTC numbers.

    A mean deviation is that of its readings, plus the environmental variation during them, plus the errors that grow with position and
    are the same in every cycle and direction. The latter cancel in the reversal error and in repeatability.
    """

    def __init__(self, result: xr.Dataset, position_mm: np.ndarray, budget: Iso230Budget) -> None:
        self._result, self._budget = result, budget
        self._mean, self._s = result["mean_unidirectional"].values, result["standard_deviation"].values
        self._count, self._distance_mm = result["count"].values, position_mm - position_mm.min()
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
        mean_u = self._s[direction, target] / readings**0.5
        scatter = GTC.ureal(0, mean_u, readings - 1, label=f"mean at {label}")
        variation = self._budget.environmental_variation_um / readings**0.5
        environment = GTC.ureal(0, variation, label=f"environmental variation at {label}")
        return (
            float(self._mean[direction, target])
            + scatter
            + environment
            + float(self._distance_mm[target]) * self._scale
        )

    def _make_sigma(self, direction: int, target: int) -> GTC.lib.UncertainReal:
        readings, label = int(self._count[direction, target]), self._name(direction, target)
        s = float(self._s[direction, target])
        variation = np.hypot(s, self._budget.environmental_variation_um) - s
        scatter = GTC.ureal(s, s / (2 * (readings - 1)) ** 0.5, readings - 1, label=f"s at {label}")
        return scatter + GTC.ureal(0, variation, label=f"environmental variation of s at {label}")

    def deviation(self, direction: int, target: int) -> GTC.lib.UncertainReal:
        """Mean deviation of one approach to one target: the same correlated number wherever it enters."""
        cell = direction, target
        if cell not in self._deviations:
            self._deviations[cell] = self._make_deviation(*cell)
        return self._deviations[cell]

    def sigma(self, direction: int, target: int) -> GTC.lib.UncertainReal:
        """Standard deviation of one approach to one target, likewise."""
        cell = direction, target
        if cell not in self._sigmas:
            self._sigmas[cell] = self._make_sigma(*cell)
        return self._sigmas[cell]

    def reversal(self, target: int) -> GTC.lib.UncertainReal:
        """Reversal error B_i, signed."""
        return self.deviation(0, target) - self.deviation(1, target)

    def bidirectional_mean(self, target: int) -> GTC.lib.UncertainReal:
        """Mean bidirectional positioning deviation."""
        return (self.deviation(0, target) + self.deviation(1, target)) / 2

    def repeatability(self, target: int) -> GTC.lib.UncertainReal:
        """R_i by the term that decides it: both directions with the reversal error, or one of them."""
        unidirectional = 4 * self._s[:, target]
        best = int(np.argmax(unidirectional))
        if unidirectional[best] >= float(self._result["repeatability_bidirectional"][target]):
            return 4 * self.sigma(best, target)
        return 2 * self.sigma(0, target) + 2 * self.sigma(1, target) + _magnitude(self.reversal(target))

    def axis(self) -> dict[str, GTC.lib.UncertainReal]:
        """Quantities of the axis by name; empty where a direction was not measured."""
        reversal = self._result["reversal"].values
        both = np.flatnonzero(np.isfinite(reversal))
        if both.size == 0:
            return {}
        middle = self._result["mean_bidirectional"].values
        top, bottom = _cell_of(np.nanargmax, self._mean), _cell_of(np.nanargmin, self._mean)
        return {
            "B": _magnitude(self.reversal(int(np.nanargmax(np.abs(reversal))))),
            "R": self.repeatability(int(np.nanargmax(self._result["repeatability_bidirectional"].values))),
            "E": self.deviation(*top) - self.deviation(*bottom),
            "M": self.bidirectional_mean(int(np.nanargmax(middle)))
            - self.bidirectional_mean(int(np.nanargmin(middle))),
            "A": self._accuracy(range(2)),
            "mean_reversal": sum(self.reversal(int(target)) for target in both) / both.size,
        }

    def of_direction(self, direction: int) -> dict[str, GTC.lib.UncertainReal]:
        """E, R and A of one direction by name; empty where it was not measured."""
        mean = self._mean[direction]
        if not np.isfinite(mean).any():
            return {}
        top, bottom, wide = int(np.nanargmax(mean)), int(np.nanargmin(mean)), int(np.nanargmax(self._s[direction]))
        return {
            "R_unidirectional": 4 * self.sigma(direction, wide),
            "E_unidirectional": self.deviation(direction, top) - self.deviation(direction, bottom),
            "A_unidirectional": self._accuracy([direction]),
        }

    def _accuracy(self, directions: Iterable[int]) -> GTC.lib.UncertainReal:
        rows = list(directions)
        mean, s = self._mean[rows], self._s[rows]
        high, low = _cell_of(np.nanargmax, mean + 2 * s), _cell_of(np.nanargmin, mean - 2 * s)
        high, low = (rows[high[0]], high[1]), (rows[low[0]], low[1])
        return self.deviation(*high) + 2 * self.sigma(*high) - (self.deviation(*low) - 2 * self.sigma(*low))

    def uncertainties(self) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
        """Standard uncertainty of every quantity in um, NaN where the quantity is, as variables ``<name>_u``."""
        directions, targets = self._mean.shape
        measured = np.isfinite(self._mean)
        both = measured.all(axis=0)

        def per_cell(quantity: Callable[[int, int], GTC.lib.UncertainReal]) -> np.ndarray:
            u = np.full(self._mean.shape, np.nan)
            for direction, target in np.argwhere(measured):
                u[direction, target] = GTC.uncertainty(quantity(int(direction), int(target)))
            return u

        def per_target(quantity: Callable[[int], GTC.lib.UncertainReal]) -> np.ndarray:
            u = [GTC.uncertainty(quantity(int(target))) if both[target] else np.nan for target in range(targets)]
            return np.array(u, dtype=float)

        s_u = per_cell(self.sigma)
        variables: dict[str, tuple[tuple[str, ...], np.ndarray]] = {
            "mean_unidirectional_u": (("direction", "target"), per_cell(self.deviation)),
            "standard_deviation_u": (("direction", "target"), s_u),
            "repeatability_u": (("direction", "target"), 4 * s_u),
            "mean_bidirectional_u": (("target",), per_target(self.bidirectional_mean)),
            "reversal_u": (("target",), per_target(self.reversal)),
            "repeatability_bidirectional_u": (("target",), per_target(self.repeatability)),
        }
        by_direction = [self.of_direction(direction) for direction in range(directions)]
        for name in ("R_unidirectional", "E_unidirectional", "A_unidirectional"):
            u = [GTC.uncertainty(values[name]) if values else np.nan for values in by_direction]
            variables[f"{name}_u"] = (("direction",), np.array(u, dtype=float))
        axis = self.axis()
        for name in ("B", "mean_reversal", "R", "E", "M", "A"):
            variables[f"{name}_u"] = ((), np.array(GTC.uncertainty(axis[name]) if axis else np.nan, dtype=float))
        return variables


def _magnitude(value: GTC.lib.UncertainReal) -> GTC.lib.UncertainReal:
    return value if GTC.value(value) >= 0 else -value


def _cell_of(extreme: Callable[[np.ndarray], np.intp], values: np.ndarray) -> tuple[int, int]:
    direction, target = np.unravel_index(int(extreme(values)), values.shape)
    return int(direction), int(target)
