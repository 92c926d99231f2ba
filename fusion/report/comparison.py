"""Campaigns of one machine side by side in words and tables: what changed, what did not, what cannot be compared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fusion.analysis.comparison import LEVEL, Change, ComparedCampaign, PairComparison
from fusion.common import versions
from fusion.report.charts.comparison import plot_profiles, plot_remaining, plot_scatters, plot_trends
from fusion.report.charts.style import embed
from fusion.report.numbers import join, measured, number, p_cell, print_unit
from fusion.report.page import render_page
from fusion.report.wording import (
    Row,
    Table,
    Words,
    anomaly_cause,
    conditional,
    effect_words,
    iso230_values,
    quantity,
    quoted_window,
    say,
    table,
)
from fusion.results.loop import AxisLoop
from fusion.results.parts import Quantity
from fusion.results.store import plain

#: Quantities of a comparison in words; others are effects.
_WORDS = {
    "slope": "slope over the travel",
    "bow": "bow over the travel",
    "mean reversal": "mean reversal error",
    "position": "deviation",
    "reversal at a position": "reversal error",
    "scatter": "scatter",
}
#: Inputs of the budget of ISO 230-2 that two tests may have in common.
_INPUTS = {
    "expansion_coefficient": "the error of the expansion coefficient (material on the same side of 20 °C in both)",
    "device": "that of the laser",
    "alignment": "that of its alignment",
    "material_temperature": "that of the material sensor",
}
#: Verdict on a difference that a thermal state alone can cause.
_STATE = "differs; the thermal state of a test alone can cause that"


def campaign_names(pairs: Sequence[PairComparison]) -> list[str]:
    """Return the names of the campaigns: a letter, the title and the day; the reference is A."""
    campaigns = [pairs[0].before, *(pair.after for pair in pairs)]
    letters = (chr(ord("A") + k) if k < 26 else str(k + 1) for k in range(len(campaigns)))
    return [f"{letter} ({one.name})" for letter, one in zip(letters, campaigns, strict=True)]


def conclude_comparison(pair: PairComparison) -> list[str]:
    """Return what a comparison shows, in sentences."""
    if not pair.changes:
        return ["Nothing can be compared."]
    machine = [_change_words(change) for change in pair.changes if change.significant and change.machine]
    state = [_change_words(change) for change in pair.changes if change.significant and not change.machine]
    unchanged = "what no thermal state can cause stayed within its uncertainties"
    if machine:
        text = f"Changed by more than the uncertainties: {join(machine)}."
        if state:
            text += f" Also different, which another thermal state of the test alone can cause: {join(state)}."
    elif state:
        text = f"Different by more than the uncertainties: {join(state)}. These tests do not show whether the machine changed or only the "
        text += f"thermal state in which it was measured: {unchanged}."
    else:
        text = f"No change of the machine is shown: {unchanged}."
    for campaign in (pair.before, pair.after):
        text = conditional(text, campaign.results.inputs, "positions")
    shared = [_INPUTS[name] for name in pair.common]
    return [
        text,
        *(
            [f"Common to both tests, and therefore not counted twice in the differences by ISO 230-2: {join(shared)}."]
            if shared
            else []
        ),
        f"Each counts at {100 * LEVEL:.0f} % over all {pair.tests} tests together. Positions are compared beyond offset, slope and bow of "
        "the profile; that presumes that the laser measured along the same line.",
    ]


def _change_words(change: Change) -> str:
    """One change with its size."""
    if change.group != "scatter":
        return f"{change_name(change)} by {_size(change)}"
    before, after = (_value(found, "um") for found in (change.before, change.after))
    return f"{change_name(change)} from {before} to {after}"


def change_name(change: Change) -> str:
    """Return what a change is a change of."""
    if change.group == "ISO 230-2":
        return f"{change.quantity} by ISO 230-2"
    words = _WORDS.get(change.quantity) or effect_words(change.quantity).name
    return words if change.position_mm is None else f"{words} at {change.position_mm:g} mm"


def _size(change: Change) -> str:
    """The change with its expanded uncertainty; of a scatter the ratio."""
    if change.group == "scatter":
        return f"× {number(change.change.value, 2)}"
    text = measured(change.change.value, change.change.u, print_unit(change.unit))
    return text if text.startswith("−") else f"+{text}"


def changes_table(pair: PairComparison) -> Table:
    """Return everything that was compared, with both values, the change and the verdict; what differs is marked and comes first."""
    rows = []
    for change in sorted(pair.changes, key=lambda one: not one.significant):
        both = [_value(found, change.unit) for found in (change.before, change.after)]
        cells = [change_name(change), *both, _size(change), p_cell(change.p_value), _verdict(change)]
        rows.append(Row(cells, marked=change.significant))
    figures = ("before (k = 2)", "after (k = 2)", "Change (k = 2)", "p (family-wise)")
    return table([Words("Quantity"), *figures, Words("Verdict")], rows)


def _value(found: Quantity | None, unit: str) -> str:
    return "–" if found is None else quantity(found, print_unit(unit))


def _verdict(change: Change) -> str:
    if change.significant:
        return "changed" if change.machine else _STATE
    return "within the uncertainties" if change.change.u or change.group == "scatter" else "no uncertainty: not judged"


def side_by_side(pairs: Sequence[PairComparison]) -> Table:
    """Return the main figures of all campaigns, a column for each."""
    campaigns = [pairs[0].before, *(pair.after for pair in pairs)]
    columns = [_figures(one) for one in campaigns]
    names = list(dict.fromkeys(name for column in columns for name in column))
    rows = [[name, *(column.get(name, "–") for column in columns)] for name in names]
    return table([Words("Figure (k = 2)"), *(Words(name) for name in campaign_names(pairs))], rows)


def _figures(campaign: ComparedCampaign) -> dict[str, str]:
    """The main figures of a campaign by name, in the order of the report."""
    results, figures = campaign.results, {}
    if results.drift is not None and results.drift.range_um:
        ranges = zip(results.drift.range_um, results.drift.range_u_um, strict=True)
        if known := [(value, u) for value, u in ranges if value is not None]:
            figures["largest drift during the test"] = measured(*max(known, key=lambda one: one[0] or 0.0), "µm")
    if isinstance(results.loop, AxisLoop):
        for declared in results.loop.declared_coefficients:
            figures[effect_words(declared.effect).name] = measured(
                declared.value, declared.u, print_unit(declared.unit)
            )
        added = join([effect_words(step.effect).name for step in results.loop.named])
        figures["effects that were missing"] = added or "none shown"
    if results.iso230 is not None:
        window = quoted_window(results.iso230)
        figures["ISO 230-2 window"] = window.window
        figures |= {f"{symbol} by ISO 230-2": value for symbol, value in iso230_values(window).items()}
        for one in results.iso230.tolerances:
            limit = f"at most {number(one.limit_um)} {print_unit(results.iso230.unit)}"
            figures[f"{one.quantity} {limit}"] = one.decision
    if results.anomalies is not None:
        named = [
            f"{say('position_words', one.target, one.position_mm)}: {anomaly_cause(one)}" for one in results.anomalies
        ]
        figures["positions that stand out"] = join(named) or "none"
    return figures


def render_comparison(pairs: Sequence[PairComparison]) -> str:
    """Return a comparison as a document: what changed and the figures first, then charts, trend and everything that was compared."""
    names, campaigns = campaign_names(pairs), [pairs[0].before, *(pair.after for pair in pairs)]
    trends = plot_trends(campaigns)
    remaining = {f"remaining_{k}": plot_remaining(pair) for k, pair in enumerate(pairs, start=1)}
    charts = {
        "profiles": plot_profiles(campaigns, names),
        "scatters": plot_scatters(campaigns, names),
        **remaining,
        **trends,
    }
    compared = [
        (name, conclude_comparison(pair), pair.not_compared, changes_table(pair))
        for name, pair in zip(names[1:], pairs, strict=True)
    ]
    return render_page(
        "comparison.html.j2",
        embed({name: chart for name, chart in charts.items() if chart is not None}),
        names=names,
        compared=compared,
        figures_table=side_by_side(pairs),
        trends=list(trends),
        versions=versions(),
        summary={"assumptions": {}},
    )


def comparison_json(pairs: Sequence[PairComparison]) -> dict[str, Any]:
    """Return a comparison in JSON's own types."""
    compared = []
    for pair in pairs:
        found = {"conclusions": conclude_comparison(pair), "changes": [_change_json(change) for change in pair.changes]}
        about = {"campaign": pair.after.name, "tests": pair.tests}
        compared.append({**about, **found, "not_compared": list(pair.not_compared)})
    return {"reference": pairs[0].before.name, "compared": compared}


def _change_json(change: Change) -> dict[str, Any]:
    values = {
        name: None if found is None else {"value": found.value, "u": found.u}
        for name, found in (("before", change.before), ("after", change.after), ("change", change.change))
    }
    return plain(
        {
            "quantity": change.quantity, "group": change.group, "position_mm": change.position_mm, "unit": change.unit, **values,
            "p_value": change.p_value, "significant": change.significant, "machine": change.machine,
        }
    )  # fmt: skip
