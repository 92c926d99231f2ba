"""L3 - ISO 230-2: accuracy and repeatability of positioning, over any window of cycles, with uncertainty.

The acceptance test of the standard has five cycles. A long test is not one: its R and A contain the drift, so the
window that was evaluated is part of every result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import GTC
import numpy as np
import xarray as xr

from interferometry.deviations import DIRECTIONS

#: Quantities of the axis that carry an uncertainty.
QUANTITIES = ("B", "R", "E", "M", "A")
STANDARD_CYCLES = 5

_UncertainAt = Callable[[int, int], GTC.lib.UncertainReal]


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
        E_unidirectional, A_unidirectional. Of the axis: B, mean_reversal, R, E, M, A, each of QUANTITIES with its
        standard uncertainty ``<name>_u``. Quantities that need both directions are NaN where one was not measured.
        ``attrs["window"]`` names the cycles, says when they are not the five of the standard, and which targets are
        left out because a direction read them fewer than twice.

    Raises
    ------
    ValueError
        The window names a cycle that was not measured, or no target has two readings in it.
    """
    deviations = deviations.reindex(direction=list(DIRECTIONS))
    x, numbers = _select(deviations, cycles)
    count = np.isfinite(x).sum(axis=0)
    x, count, few = _leave_out_single_readings(deviations, x, count)
    mean, s = _mean_and_s(x, count)
    reversal, both = mean[0] - mean[1], (mean[0] + mean[1]) / 2
    repeatability = np.fmax(2 * s[0] + 2 * s[1] + np.abs(reversal), np.fmax(4 * s[0], 4 * s[1]))
    repeatability[np.isnan(reversal)] = np.nan
    upper, lower = mean + 2 * s, mean - 2 * s
    bidirectional = np.isfinite(reversal).any()
    axis = {
        "B": _largest(np.abs(reversal)),
        "mean_reversal": float(np.mean(reversal[np.isfinite(reversal)])) if bidirectional else np.nan,
        "R": _largest(repeatability),
        "E": _largest(mean) + _largest(-mean) if bidirectional else np.nan,
        "M": _largest(both) + _largest(-both),
        "A": _largest(upper) + _largest(-lower) if bidirectional else np.nan,
    }
    result = xr.Dataset(
        {
            "mean_unidirectional": (("direction", "target"), mean),
            "standard_deviation": (("direction", "target"), s),
            "repeatability": (("direction", "target"), 4 * s),
            "count": (("direction", "target"), count),
            "mean_bidirectional": (("target",), both),
            "reversal": (("target",), reversal),
            "repeatability_bidirectional": (("target",), repeatability),
            "R_unidirectional": (("direction",), [_largest(4 * one) for one in s]),
            "E_unidirectional": (("direction",), [_largest(one) + _largest(-one) for one in mean]),
            "A_unidirectional": (
                ("direction",),
                [_largest(one) + _largest(-other) for one, other in zip(upper, lower, strict=True)],
            ),
            **{name: ((), value) for name, value in axis.items()},
        },
        coords={"direction": deviations["direction"].values, "target": deviations["target"].values},
    )
    result = result.assign(_uncertainties(result, deviations["position"].values, budget or Iso230Budget()))
    for name in result.data_vars:
        result[name].attrs["units"] = "1" if name == "count" else "um"
    result.attrs["window"] = _name_window(numbers, few)
    return result


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
    ValueError
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
        One of QUANTITIES.
    budget : Iso230Budget

    Returns
    -------
    list of (str, float)
        Name of the contribution and its standard uncertainty in um.
    """
    result = evaluate(deviations, budget=budget)
    value = _model(result, deviations["position"].values, budget)[quantity]
    return [(row.label, float(row.u)) for row in GTC.reporting.budget(value) if row.u > 0]


def _select(deviations: xr.Dataset, cycles: Sequence[int] | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the readings of the window as (cycle, direction, target), and the numbers of its cycles."""
    numbers = deviations["cycle"].values
    if cycles is None:
        return deviations["deviation"].values, numbers
    absent = sorted(set(cycles) - set(numbers.tolist()))
    if absent:
        raise ValueError(f"cycles {absent} of the window were not measured; the test holds {numbers.tolist()}")
    chosen = np.isin(numbers, list(cycles))
    return deviations["deviation"].values[chosen], numbers[chosen]


def _leave_out_single_readings(
    deviations: xr.Dataset, x: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Take out, by name, positions that a measured direction read fewer than twice: they have no standard deviation."""
    measured = count.any(axis=1, keepdims=True)
    single = (count < 2) & measured
    if not ((count >= 2) & measured).any():
        raise ValueError("no target has two readings in the window; widen it")
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


def _uncertainties(
    result: xr.Dataset, position_mm: np.ndarray, budget: Iso230Budget
) -> dict[str, tuple[tuple[()], float]]:
    values = _model(result, position_mm, budget)
    return {
        f"{name}_u": ((), float(GTC.uncertainty(values[name])) if name in values else np.nan) for name in QUANTITIES
    }


def _model(result: xr.Dataset, position_mm: np.ndarray, budget: Iso230Budget) -> dict[str, GTC.lib.UncertainReal]:
    """Return the axis quantities as GTC numbers: the positions that decide each, with everything that acts on them.

    A deviation is the mean of its readings, plus the environment's variation during them, plus the errors that grow
    with position and are the same in every cycle and direction. Those cancel in B and R.
    """
    if not np.isfinite(float(result["B"])):
        return {}
    n, at = result["count"].values, position_mm - position_mm.min()
    scale = 1e-3 * (
        GTC.ureal(0, budget.device_ppm, label="device")
        + GTC.ureal(0, budget.misalignment_ppm, label="misalignment")
        + budget.nominal_expansion_ppm_per_K * GTC.ureal(0, budget.machine_temperature_K, label="machine temperature")
        + budget.difference_from_20_degC_K
        * GTC.ureal(0, budget.expansion_coefficient_ppm_per_K, label="expansion coefficient")
    )
    mean, spread = result["mean_unidirectional"].values, result["standard_deviation"].values

    def deviation(direction: int, target: int) -> GTC.lib.UncertainReal:
        readings = int(n[direction, target])
        label = f"{result['direction'].values[direction]} {result['target'].values[target]}"
        scatter = GTC.ureal(0, spread[direction, target] / readings**0.5, readings - 1, label=f"mean at {label}")
        variation = budget.environmental_variation_um / readings**0.5
        environment = GTC.ureal(0, variation, label=f"environmental variation at {label}")
        return float(mean[direction, target]) + scatter + environment + float(at[target]) * scale

    def sigma(direction: int, target: int) -> GTC.lib.UncertainReal:
        readings = int(n[direction, target])
        label = f"{result['direction'].values[direction]} {result['target'].values[target]}"
        s = float(spread[direction, target])
        variation = np.hypot(s, budget.environmental_variation_um) - s
        own = GTC.ureal(s, s / (2 * (readings - 1)) ** 0.5, readings - 1, label=f"s at {label}")
        return own + GTC.ureal(0, variation, label=f"environmental variation of s at {label}")

    reversal = int(np.nanargmax(np.abs(result["reversal"].values)))
    top, bottom = _place(np.nanargmax(mean), mean), _place(np.nanargmin(mean), mean)
    high, low = _place(np.nanargmax(mean + 2 * spread), mean), _place(np.nanargmin(mean - 2 * spread), mean)
    both = result["mean_bidirectional"].values
    middle_top, middle_bottom = int(np.nanargmax(both)), int(np.nanargmin(both))
    b = deviation(0, reversal) - deviation(1, reversal)
    return {
        "B": b if float(result["reversal"][reversal]) >= 0 else -b,
        "R": _repeatability(result, deviation, sigma),
        "E": deviation(*top) - deviation(*bottom),
        "M": sum(deviation(d, middle_top) - deviation(d, middle_bottom) for d in (0, 1)) / 2,
        "A": deviation(*high) + 2 * sigma(*high) - (deviation(*low) - 2 * sigma(*low)),
    }


def _place(flat: np.integer, values: np.ndarray) -> tuple[int, int]:
    direction, target = np.unravel_index(int(flat), values.shape)
    return int(direction), int(target)


def _repeatability(result: xr.Dataset, deviation: _UncertainAt, sigma: _UncertainAt) -> GTC.lib.UncertainReal:
    """Return R by the position that decides it, two-sided or in one direction."""
    target = int(np.nanargmax(result["repeatability_bidirectional"].values))
    one_way = result["repeatability"].values[:, target]
    best = int(np.argmax(one_way))
    if one_way[best] >= float(result["repeatability_bidirectional"][target]):
        return 4 * sigma(best, target)
    b = deviation(0, target) - deviation(1, target)
    signed = b if float(result["reversal"][target]) >= 0 else -b
    return 2 * sigma(0, target) + 2 * sigma(1, target) + signed
