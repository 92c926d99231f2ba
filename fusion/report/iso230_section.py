"""The test by ISO 230-2 in the report: values of the axis and of every target, budget, tolerances, conditions, other standards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from fusion.products.grouped import by_approach, group, has
from fusion.products.results_axis import Iso230Contribution, Iso230Part, Iso230Window
from fusion.report.findings import ISO230_TERMS, approach_of, reversal_note
from fusion.report.tables import Row, Table, Words, table
from fusion.report.wording import decimals_of, join, measured, number, print_unit, quantity
from interferometry.deviations import REGISTRY

_CONTRIBUTORS = {
    "device": "laser with its air compensation",
    "alignment": "alignment (cosine error)",
    "material_temperature": "temperature of the material",
    "expansion_coefficient": "expansion coefficient",
    "environmental_variation": "environmental variation error (EVE)",
    "sampling": "scatter of the readings",
    "extremes": "largest of noisy values",
}
#: Columns of the budget, of a test from both sides.
_BUDGETED = ("A", "R", "E", "M", "B", "mean_reversal")
#: Values of each direction, in the terms of the standard.
_ONE_WAY = {
    "A": "Unidirectional positioning accuracy A",
    "R": "Unidirectional positioning repeatability R",
    "E": "Unidirectional systematic positioning error E",
}
_ARROWS = {"positive": "↑", "negative": "↓"}
#: Missing readings that are listed one by one.
_NAMED = 8


def describe_iso230(part: Iso230Part, dataset: xr.Dataset | None = None, *, unit: str = "µm") -> dict[str, Any]:
    """Return the section on ISO 230-2, as the template reads it.

    Parameters
    ----------
    part : Iso230Part
        The part ``iso230`` of the results.
    dataset : Dataset, optional
        Readings with the group ``settled``; None: the section has no table of the targets.
    unit : str
        Of deviations, as it is printed.

    Returns
    -------
    dict
        ``axis``, ``positions``, ``budget``, ``tolerances``, ``checks`` and ``others`` (Table or None), ``conditions`` (rows of name and
        text), ``window``, ``rule``, ``contained``, ``missing`` and ``reversal`` (text).
    """
    shown = part.settled
    told: dict[str, Any] = dict.fromkeys(("positions", "budget", "tolerances", "checks", "others", "conditions"))
    if shown is None:
        rows = [[term, quantity(getattr(part, f"{symbol}_um"), unit)] for symbol, term in ISO230_TERMS.items()]
        axis = table([Words("Quantity of the axis"), f"{part.window} (k = 2)"], rows)
        words = {"window": part.window, "rule": "", "contained": "", "missing": "", "reversal": reversal_note(part)}
        return {**told, **words, "axis": axis}
    if dataset is not None and has(dataset, "settled"):
        told["positions"] = _positions_table(group(dataset, "settled"), dataset["position"], unit)
    return {
        **told,
        "axis": _values_table(part, shown, unit),
        "budget": _budget_table(shown, unit),
        "tolerances": _tolerances_table(part, unit) if part.tolerances else None,
        "checks": _checks_table(part) if part.checks else None,
        "others": _others_table(part, unit) if part.other_standards else None,
        "conditions": [(row.name, row.text or "not stated") for row in part.conditions],
        "window": shown.window,
        "rule": part.settled_rule,
        "contained": contained_sentence(shown),
        "missing": "" if dataset is None else missing_sentence(dataset, shown.cycles),
        "reversal": reversal_note(shown),
    }


def _positions_table(settled: xr.Dataset, position: xr.DataArray, unit: str) -> Table:
    """Return the values of every target in the order of the axis; decimals by the uncertainty of a mean deviation."""
    spread = settled["standard_deviation"].values / np.sqrt(np.where(settled["count"] > 0, settled["count"], np.nan))
    places = decimals_of(float(np.nanmedian(spread)))

    def shown(value: float) -> str:
        return f"{value:.{places}f}".replace("-", "−") if np.isfinite(value) else "–"

    along = _along(position)
    of_both = ("mean_bidirectional", "reversal", "repeatability_bidirectional")
    values = np.hstack(
        [
            *(
                by_approach(settled[name], target=along)
                for name in ("mean_unidirectional", "standard_deviation", "repeatability")
            ),
            *(settled[name].sel(target=along).values[:, None] for name in of_both),
        ]
    )
    rows = [
        [str(target), f"{place:g}", *(shown(value) for value in row), ", ".join(str(int(count)) for count in counts)]
        for target, place, row, counts in zip(
            along, position.sel(target=along).values, values, by_approach(settled["count"], target=along), strict=True
        )
    ]
    titles = [f"{symbol}{arrow} / {unit}" for symbol in ("x̄", "s", "R") for arrow in _ARROWS.values()]
    unit_along = str(position.attrs.get("units", "mm"))
    return table(
        ["Target", f"Position / {unit_along}", *titles, f"x̄ / {unit}", f"B_i / {unit}", f"R_i / {unit}", "n↑, n↓"], rows
    )


def _along(position: xr.DataArray) -> np.ndarray:
    """Return the numbers of the targets in the order of the axis."""
    return position["target"].values[np.argsort(position.values, kind="stable")]


def missing_sentence(dataset: xr.Dataset, cycles: Sequence[int]) -> str:
    """Return which readings of a window are missing, and why.

    Parameters
    ----------
    dataset : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.
    cycles : sequence of int
        Cycles of the window.
    """
    within = dataset[["deviation", "quality_flag"]].sel(cycle=list(cycles))
    missing = np.argwhere(np.isnan(within["deviation"].values))
    if missing.size == 0:
        return "No reading of the window is missing."
    named = []
    for cycle, direction, target in missing[:_NAMED]:
        bits = int(within["quality_flag"].values[cycle, direction, target])
        why = join([flag.name.replace("_", " ") for flag in REGISTRY if bits & flag.mask]) or "missing"
        approach = _ARROWS[str(within["direction"].values[direction])]
        named.append(
            f"cycle {within['cycle'].values[cycle]}, target {within['target'].values[target]}{approach} ({why})"
        )
    more = len(missing) - len(named)
    rest = f" and {more} more" if more else ""
    return f"{len(missing)} of {within['deviation'].size} readings of the window are missing: {'; '.join(named)}{rest}."


def single_run_table(dataset: xr.Dataset) -> Table:
    """Return the deviations of a test of one cycle.

    Parameters
    ----------
    dataset : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``; its first cycle is shown.
    """
    unit, place = (print_unit(str(dataset[name].attrs["units"])) for name in ("deviation", "position"))
    along = _along(dataset["position"])
    places, values = (
        dataset["position"].sel(target=along).values,
        by_approach(dataset["deviation"].isel(cycle=0), target=along),
    )
    rows = []
    for target, at, readings in zip(along, places, values, strict=True):
        cells = [f"{value:.2f}".replace("-", "−") if np.isfinite(value) else "–" for value in readings]
        rows.append([str(target), f"{at:g}", *cells])
    return table(["Target", place, *(f"deviation{arrow} / {unit}" for arrow in _ARROWS.values())], rows)


def _tolerances_table(part: Iso230Part, unit: str) -> Table:
    """Return every quantity that was judged."""
    rows = [
        Row(
            [
                row.quantity,
                measured(row.value_um, None if row.expanded_u_um is None else row.expanded_u_um / 2),
                f"{row.limit_um:g}",
                row.decision,
            ],
            marked=row.decision != "pass",
        )
        for row in part.tolerances
    ]
    return table([Words("Quantity"), f"Value ± U / {unit}", f"Tolerance / {unit}", Words("Decision")], rows)


def _checks_table(part: Iso230Part) -> Table:
    """Return every condition of the standard, those that are not met marked."""
    words = {True: "yes", False: "no", None: "not known"}
    rows = [Row([row.name, words[row.met], row.evidence], marked=row.met is False) for row in part.checks]
    return table([Words("Asked for"), Words("Met"), Words("Found")], rows, stacked=True)


def _others_table(part: Iso230Part, unit: str) -> Table:
    """Return the quantities of other standards with their definitions."""
    rows = [[row.standard, row.name, number(row.value_um), row.definition] for row in part.other_standards]
    return table([Words("Standard"), Words("Quantity"), f"Value / {unit}", Words("Definition")], rows)


def _values_table(part: Iso230Part, shown: Iso230Window, unit: str) -> Table:
    """Return the axis values of the settled window beside those of the first one and their range over the windows."""
    several = part.first is not None and part.first.window != shown.window
    rows = []
    for symbol, term in ISO230_TERMS.items():
        found = part.range_um.get(symbol)
        first = quantity(getattr(part, f"{symbol}_um"))
        spread = "–" if found is None else f"{number(found.lowest)} to {number(found.highest)}"
        values = [quantity(getattr(shown, f"{symbol}_um"))]
        rows.append(Row([term, *values, *([first, spread] if several else [])], marked=True))
        for direction, arrow in _ARROWS.items():
            if symbol not in _ONE_WAY:
                continue
            of_shown = quantity(getattr(getattr(shown, direction), f"{symbol}_um"))
            of_first = quantity(getattr(getattr(part.first, direction), f"{symbol}_um")) if part.first else "–"
            rows.append(Row([f"{_ONE_WAY[symbol]}{arrow}", of_shown, *([of_first, "–"] if several else [])]))
    mean = [quantity(shown.mean_reversal_um), *([quantity(part.mean_reversal_um), "–"] if several else [])]
    rows.append(Row(["Mean reversal error, with its sign", *mean]))
    columns = [f"{shown.window} / {unit}"]
    if several:
        columns += [f"First window, {part.window} / {unit}", f"Range over windows without overlap / {unit}"]
    return table([Words("Quantity of the axis (± U, k = 2)"), *columns], rows)


def _budget_table(shown: Iso230Window, unit: str) -> Table:
    """Return the budget: every input with its contributions, and the expanded uncertainty without and with the sampling.

    Of a test from one side the columns are the quantities of that approach.
    """
    side = approach_of(shown)
    titles = (
        [f"{symbol}{_ARROWS[side]}" for symbol in _ONE_WAY] if side else [name.replace("_", " ") for name in _BUDGETED]
    )
    names = [f"{symbol}_{side}" for symbol in _ONE_WAY] if side else _BUDGETED
    rows: list[Row] = [
        Row(
            [
                _CONTRIBUTORS.get(entry.contributor, entry.contributor),
                "–" if entry.u is None else f"{number(entry.u, 2)} {unit if entry.unit == 'um' else entry.unit}",
                entry.origin,
                *(number(entry.one_way_um.get(name) if side else getattr(entry, f"{name}_um"), 2) for name in names),
            ]
        )
        for entry in shown.contributions
    ]
    without = [shown.u_without_sampling_um.get(name) for name in names]
    values = [getattr(getattr(shown, side), f"{symbol}_um") for symbol in _ONE_WAY] if side else []
    with_it = [value.u for value in values or (getattr(shown, f"{symbol}_um") for symbol in _BUDGETED)]
    for name, sums in (("U (k = 2) without the sampling of the cycles", without), ("U (k = 2)", with_it)):
        cells = (number(None if u is None else 2 * u, 2) for u in sums)
        rows.append(Row([name, "", "", *cells], marked=True))
    columns = [f"{title} / {unit}" for title in titles]
    return table([Words("Contribution"), "Standard uncertainty u", Words("u is"), *columns], rows)


def contained_sentence(shown: Iso230Window) -> str:
    """Return what the uncertainty of a run's ISO 230-2 values contains, and what not.

    Parameters
    ----------
    shown : Iso230Window
        Window with its budget.
    """
    unknown = [
        entry for entry in shown.contributions if entry.contributor == "environmental_variation" and entry.u is None
    ]
    named = [_input_words(entry) for entry in shown.contributions if entry.u is not None]
    sentence = (
        f"U contains, as standard uncertainties, {join(named)}; and, from the readings, their scatter and that the largest of noisy values "
        "is too large on average."
    )
    if unknown:
        sentence += " It does not contain the environmental variation, which is not stated and cannot be estimated from these readings."
    if any(entry.origin.startswith("assumed") for entry in shown.contributions):
        sentence += " What is assumed can be stated under [interferometry.uncertainty] of the campaign file."
    return sentence


def _input_words(entry: Iso230Contribution) -> str:
    return f"{_CONTRIBUTORS[entry.contributor]} {number(entry.u, 2)} {print_unit(entry.unit)} ({entry.origin})"
