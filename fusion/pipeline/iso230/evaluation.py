"""Evaluation of a test by ISO 230-2: windows of cycles, and the most settled of them with its budget."""

from __future__ import annotations

from typing import Any, NamedTuple

import xarray as xr

from fusion.campaign.iso_budget import StatedBudget
from interferometry.iso230 import (
    CONTRIBUTIONS,
    QUANTITIES,
    SAMPLING,
    STANDARD_CYCLES,
    evaluate_iso230,
    evaluate_windows,
    settled_window,
)

_RULE = f"of the windows of {STANDARD_CYCLES} cycles in the second half of the test, the one with the least drift by the joint estimate"
_RULE_WITHOUT_DRIFT = f"the last window of {STANDARD_CYCLES} cycles, as no drift could be estimated"
_RULE_ONE = "the only window of the test"
_AXIS = (*QUANTITIES, "mean_reversal")
#: Unit of each input, and the field of `interferometry.iso230.Iso230Budget` that holds it.
_INPUTS = {
    "device": ("device_ppm", "ppm"),
    "alignment": ("alignment_ppm", "ppm"),
    "material_temperature": ("material_temperature_K", "K"),
    "expansion_coefficient": ("expansion_coefficient_ppm_per_K", "ppm/K"),
}


class _Measured(NamedTuple):
    """What was measured beside the readings: the drift, and the temperature of the material."""

    drift: bool
    material: bool


def evaluate_standard(
    deviations: xr.Dataset,
    budget: StatedBudget,
    *,
    drift: xr.DataArray | None,
    material_degC: xr.DataArray | None,
    cycles: list[int] | None = None,
) -> tuple[xr.Dataset, xr.Dataset, dict[str, Any]]:
    """Evaluate windows of a test by ISO 230-2, and say which of them shows the warmed-up axis.

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.
    budget : StatedBudget
        Inputs of the uncertainty, and where they come from.
    drift : (cycle, direction, target) DataArray or None
        Drift of the joint estimate, um; None where there is none.
    material_degC : (cycle) DataArray or None
        Temperature of the material; None where it was not logged.
    cycles : list of int, optional
        Window to quote; None: the most settled one.

    Returns
    -------
    windows : Dataset
        See `interferometry.iso230.evaluation.evaluate_windows`.
    settled : Dataset
        See `interferometry.iso230.evaluation.evaluate_iso230`: the most settled window, with values per target.
    part : dict
        Part ``iso230`` of results.json.
    """
    windows = evaluate_windows(deviations, budget=budget.budget, drift=drift, material_degC=material_degC)
    numbers = deviations["cycle"].values
    blocks = [
        numbers[(numbers >= first) & (numbers <= last)].tolist()
        for first, last in zip(windows["first_cycle"].values, windows["last_cycle"].values, strict=True)
    ]
    quoted = blocks[settled_window(windows)] if cycles is None else cycles
    measured = _Measured(drift is not None, material_degC is not None)
    first, settled = (
        evaluate_iso230(deviations, cycles=window, budget=budget.budget, drift=drift, material_degC=material_degC)
        for window in (blocks[0], quoted)
    )
    several = windows.sizes["window"] > 1
    of_standard = windows.isel(window=slice(0, -1)) if several else windows
    if cycles is not None:
        rule = ""
    elif of_standard.sizes["window"] == 1:
        rule = _RULE_ONE
    else:
        rule = _RULE_WITHOUT_DRIFT if drift is None else _RULE
    values = {f"{name}_um": _quantity(first, name) for name in _AXIS}
    part = {
        "window": first.attrs["window"],
        **values,
        "B_of_scatter_um": float(first["B_of_scatter"]),
        "settled": _window_part(settled, quoted, budget, measured),
        "settled_rule": rule,
        "first": _window_part(first, blocks[0], budget, measured),
        "range_um": {
            name: {"lowest": float(of_standard[name].min()), "highest": float(of_standard[name].max())}
            for name in QUANTITIES
        },
    }
    return windows, settled, part


def _quantity(result: xr.Dataset, name: str, **where: str) -> dict[str, float]:
    """Return value and standard uncertainty of a quantity."""
    return {"value": float(result[name].sel(where)), "u": float(result[f"{name}_u"].sel(where))}


def _window_part(result: xr.Dataset, cycles: list[int], budget: StatedBudget, measured: _Measured) -> dict[str, Any]:
    """Return the values of one window with its budget, as in results.json."""
    by_direction = {
        direction: {f"{name}_um": _quantity(result, f"{name}_unidirectional", direction=direction) for name in "ARE"}
        for direction in ("positive", "negative")
    }
    other = [name for name in CONTRIBUTIONS if name not in SAMPLING]
    without = (result["contribution"].sel(contributor=other) ** 2).sum("contributor", skipna=False) ** 0.5
    one_way = {
        name: float((found.sel(contributor=other) ** 2).sum() ** 0.5) for name, found in _one_way_shares(result).items()
    }
    return {
        "window": result.attrs["window"],
        "cycles": cycles,
        **{f"{name}_um": _quantity(result, name) for name in _AXIS},
        "B_of_scatter_um": float(result["B_of_scatter"]),
        **by_direction,
        "u_without_sampling_um": {name: float(without.sel(quantity=name)) for name in _AXIS} | one_way,
        "contributions": [_contribution(result, name, budget, measured) for name in CONTRIBUTIONS],
    }


def _one_way_shares(result: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the contributions to A, R and E of every direction that was measured."""
    shares = {
        f"{name}_{direction}": result[f"{name}_unidirectional_contribution"].sel(direction=direction)
        for direction in ("positive", "negative")
        for name in "ARE"
    }
    return {name: found for name, found in shares.items() if found.notnull().all()}


def _contribution(result: xr.Dataset, name: str, budget: StatedBudget, measured: _Measured) -> dict[str, Any]:
    """Return one row of the budget."""
    parts = {f"{symbol}_um": float(result["contribution"].sel(quantity=symbol, contributor=name)) for symbol in _AXIS}
    u: float | None = None
    unit, origin = "um", "from the readings"
    if name in _INPUTS:
        field, unit = _INPUTS[name]
        u, origin = getattr(budget.budget, field), budget.origins[name]
        if name == "expansion_coefficient" and not budget.budget.is_scatter_alone:
            logged = "" if measured.material else "an assumed "
            origin += f"; material at {logged}{float(result['temperature_difference']):.2g} K from 20 °C"
    elif name == "environmental_variation":
        u = float(result["environmental_variation"])
        found = "standard deviation of the drift within the window" if measured.drift else "not known, not contained"
        origin = budget.origins.get(name, found)
    elif name == "extremes":
        origin = "mean excess of tests drawn like this one"
    one_way = {key: float(found.sel(contributor=name)) for key, found in _one_way_shares(result).items()}
    return {"contributor": name, "u": u, "unit": unit, "origin": origin, **parts, "one_way_um": one_way}
