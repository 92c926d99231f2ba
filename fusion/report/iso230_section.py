"""The evaluation by ISO 230-2 in the report: axis values of the settled and of the first window, uncertainty budget, what it contains."""

from __future__ import annotations

from typing import Any

from fusion.products.results_axis import Iso230Contribution, Iso230Part, Iso230Window
from fusion.report.findings import ISO230_TERMS, reversal_note
from fusion.report.tables import Row, Table, Words, table
from fusion.report.wording import join, measured, number, quantity

_CONTRIBUTORS = {
    "device": "laser with its air compensation",
    "alignment": "alignment (cosine error)",
    "material_temperature": "temperature of the material",
    "expansion_coefficient": "expansion coefficient",
    "environmental_variation": "environmental variation error (EVE)",
    "sampling": "scatter of the readings",
    "extremes": "largest of noisy values",
}
#: Columns of the budget.
_BUDGETED = ("A", "R", "E", "M", "B", "mean_reversal")
#: Values of each direction, in the terms of the standard.
_ONE_WAY = {
    "A": "Unidirectional positioning accuracy A",
    "R": "Unidirectional positioning repeatability R",
    "E": "Unidirectional systematic positioning error E",
}
_ARROWS = {"positive": "↑", "negative": "↓"}


def describe_iso230(part: Iso230Part) -> dict[str, Any]:
    """Return the section on ISO 230-2, as the template reads it.

    Parameters
    ----------
    part : Iso230Part
        The part ``iso230`` of the results.

    Returns
    -------
    dict
        ``axis`` and ``budget`` (Table or None), ``window``, ``first_window``, ``rule``, ``contained`` and ``reversal`` (text).
    """
    shown = part.settled
    if shown is None:
        rows = [[term, quantity(getattr(part, f"{symbol}_um"), "µm")] for symbol, term in ISO230_TERMS.items()]
        values = table([Words("Quantity of the axis"), f"{part.window} (k = 2)"], rows)
        return {
            "axis": values,
            "budget": None,
            "window": part.window,
            "first_window": part.window,
            "rule": "",
            "contained": "",
            "reversal": reversal_note(part),
        }
    return {
        "axis": _values_table(part, shown),
        "budget": _budget_table(shown),
        "window": shown.window,
        "first_window": part.window,
        "rule": part.settled_rule,
        "contained": contained_sentence(shown),
        "reversal": reversal_note(shown),
    }


def _values_table(part: Iso230Part, shown: Iso230Window) -> Table:
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
            rows.append(Row([f"{_ONE_WAY[symbol]}{arrow}", of_shown, *([of_first, ""] if several else [])]))
    mean = [quantity(shown.mean_reversal_um), *([quantity(part.mean_reversal_um), ""] if several else [])]
    rows.append(Row(["Mean reversal error, with its sign", *mean]))
    columns = [f"{shown.window} / µm"]
    if several:
        columns += [f"First window, {part.window} / µm", "Range over the windows / µm"]
    return table([Words("Quantity of the axis (± U, k = 2)"), *columns], rows)


def _budget_table(shown: Iso230Window) -> Table:
    """Return the budget: every input with its contributions, and the expanded uncertainty without and with the sampling."""
    rows: list[Row] = [
        Row(
            [
                _CONTRIBUTORS.get(entry.contributor, entry.contributor),
                "–" if entry.u is None else f"{number(entry.u, 2)} {entry.unit.replace('um', 'µm')}",
                entry.origin,
                *(number(getattr(entry, f"{symbol}_um"), 2) for symbol in _BUDGETED),
            ]
        )
        for entry in shown.contributions
    ]
    without = [shown.u_without_sampling_um.get(symbol) for symbol in _BUDGETED]
    with_it = [getattr(shown, f"{symbol}_um").u for symbol in _BUDGETED]
    for name, sums in (("U (k = 2) without the sampling of the cycles", without), ("U (k = 2)", with_it)):
        cells = (number(None if u is None else 2 * u, 2) for u in sums)
        rows.append(Row([name, "", "", *cells], marked=True))
    columns = [f"{symbol.replace('_', ' ')} / µm" for symbol in _BUDGETED]
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
    u = measured(entry.u, None, entry.unit.replace("um", "µm")) if entry.u else f"0 {entry.unit.replace('um', 'µm')}"
    return f"{_CONTRIBUTORS[entry.contributor]} {u} ({entry.origin})"
