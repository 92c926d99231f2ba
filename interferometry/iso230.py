"""L3 - ISO 230-2: accuracy and repeatability of positioning, over any window of cycles, with uncertainty.

The acceptance test of the standard has five cycles. A long test is not one: its R and A contain the drift, so the
window that was evaluated is part of every result.
"""

from __future__ import annotations

from collections.abc import Sequence

import GTC
import numpy as np
import xarray as xr

from interferometry.deviations import DIRECTIONS
from interferometry.iso230_budget import Iso230Budget, UncertainTest

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
    ValueError
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
        held = "one cycle" if x.shape[0] == 1 else f"{x.shape[0]} cycles"
        raise ValueError(
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
