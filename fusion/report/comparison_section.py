"""Campaigns of one machine side by side in words and tables: what changed, what did not, what cannot be compared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fusion.comparison.campaigns import LEVEL, Change, ComparedCampaign, PairComparison
from fusion.products.results_loop import AxisLoop
from fusion.products.results_part import Quantity
from fusion.products.store import plain
from fusion.report.conclusions.answers import position_words
from fusion.report.findings import anomaly_cause, iso230_values, quoted_window
from fusion.report.tables import Row, Table, Words, table
from fusion.report.wording import (
    conditional,
    effect_words,
    join,
    measured,
    number,
    p_cell,
    print_unit,
    quantity,
)

#: Quantities of a comparison in words; others are effects.
_WORDS = {
    "slope": "slope over the travel",
    "bow": "bow over the travel",
    "mean reversal": "mean reversal error",
    "position": "deviation",
    "reversal at a position": "reversal error",
    "scatter": "scatter",
}
#: What stands beside a difference that a thermal state alone can make.
_STATE = "differs; the thermal state of a test alone can do that"


def campaign_names(pairs: Sequence[PairComparison]) -> list[str]:
    """Return the names of the campaigns: a letter, the title and the day; the reference is A.

    Parameters
    ----------
    pairs : sequence of PairComparison
        Of one reference.
    """
    campaigns = [pairs[0].before, *(pair.after for pair in pairs)]
    return [f"{_letter(k)} ({one.name})" for k, one in enumerate(campaigns)]


def _letter(place: int) -> str:
    """A to Z, then numbers."""
    return chr(ord("A") + place) if place < 26 else str(place + 1)


def conclude_comparison(pair: PairComparison) -> list[str]:
    """Return what a comparison shows, in sentences.

    Parameters
    ----------
    pair : PairComparison
        One campaign against the reference.

    Returns
    -------
    list of str
        What changed on the machine, what differs as a thermal state can, what stayed within the uncertainties.
    """
    if not pair.changes:
        return ["Nothing can be compared."]
    machine = [_told(change) for change in pair.changes if change.significant and change.machine]
    state = [_told(change) for change in pair.changes if change.significant and not change.machine]
    sentences = [
        f"Changed by more than the uncertainties: {join(machine)}."
        if machine
        else "No change of the machine is shown: what no thermal state gives stayed within its uncertainties."
    ]
    if state:
        sentences.append(f"Also different, as another thermal state of the test alone can make it: {join(state)}.")
    told = " ".join(sentences)
    for campaign in (pair.before, pair.after):
        told = conditional(told, campaign.results.inputs, "positions")
    return [
        told,
        f"Each counts at {100 * LEVEL:.0f} % over all {pair.tests} tests together. Positions are compared beyond offset, slope and bow of "
        "the profile; that presumes that the laser measured along the same line.",
    ]


def _told(change: Change) -> str:
    """One change with its size."""
    return (
        f"{change_name(change)} by {_size(change)}"
        if change.group != "scatter"
        else (
            f"{change_name(change)} from {quantity(_known(change.before), 'µm')} to {quantity(_known(change.after), 'µm')}"
        )
    )


def _known(found: Quantity | None) -> Quantity:
    return found or Quantity(value=None, u=None)


def change_name(change: Change) -> str:
    """Return what a change is a change of.

    Parameters
    ----------
    change : Change
        One quantity in two campaigns.
    """
    if change.group == "ISO 230-2":
        return f"{change.quantity} by ISO 230-2"
    words = _WORDS.get(change.quantity) or effect_words(change.quantity).name
    return words if change.position_mm is None else f"{words} at {change.position_mm:g} mm"


def _size(change: Change) -> str:
    """The change with its expanded uncertainty; of a scatter the ratio."""
    if change.group == "scatter":
        return f"× {number(change.change.value, 2)}"
    told = measured(change.change.value, change.change.u, print_unit(change.unit))
    return told if told.startswith("−") else f"+{told}"


def changes_table(pair: PairComparison) -> Table:
    """Return everything that was compared, with both values, the change and the verdict; what differs is marked and comes first.

    Parameters
    ----------
    pair : PairComparison
        One campaign against the reference.
    """
    rows = [
        Row(
            [
                change_name(change),
                *(_value(found, change.unit) for found in (change.before, change.after)),
                _size(change),
                p_cell(change.p_value),
                _verdict(change),
            ],
            marked=change.significant,
        )
        for change in sorted(pair.changes, key=lambda one: not one.significant)
    ]
    headings = [
        Words("Quantity"),
        "before (k = 2)",
        "after (k = 2)",
        "Change (k = 2)",
        "p (family-wise)",
        Words("Verdict"),
    ]
    return table(headings, rows)


def _value(found: Quantity | None, unit: str) -> str:
    return "–" if found is None else quantity(found, print_unit(unit))


def _verdict(change: Change) -> str:
    if not change.significant:
        return (
            "within the uncertainties" if change.change.u or change.group == "scatter" else "no uncertainty: not judged"
        )
    return "changed" if change.machine else _STATE


def side_by_side(pairs: Sequence[PairComparison]) -> Table:
    """Return the main figures of all campaigns, a column for each.

    Parameters
    ----------
    pairs : sequence of PairComparison
        Of one reference.
    """
    campaigns = [pairs[0].before, *(pair.after for pair in pairs)]
    columns = [_figures(one) for one in campaigns]
    names = list(dict.fromkeys(name for column in columns for name in column))
    rows = [[name, *(column.get(name, "–") for column in columns)] for name in names]
    return table([Words("Figure (k = 2)"), *(Words(name) for name in campaign_names(pairs))], rows)


def _figures(campaign: ComparedCampaign) -> dict[str, str]:
    """The main figures of a campaign by name, in the order of the report."""
    results, told = campaign.results, {}
    if results.drift is not None and results.drift.range_um:
        known = [
            (value, u)
            for value, u in zip(results.drift.range_um, results.drift.range_u_um, strict=True)
            if value is not None
        ]
        if known:
            told["largest drift during the test"] = measured(*max(known, key=lambda one: one[0] or 0.0), "µm")
    if isinstance(results.loop, AxisLoop):
        for declared in results.loop.declared_coefficients:
            told[effect_words(declared.effect).name] = measured(declared.value, declared.u, print_unit(declared.unit))
        added = join([effect_words(step.effect).name for step in results.loop.steps if step.confirmed])
        told["effects that were missing"] = added or "none shown"
    if results.iso230 is not None:
        window = quoted_window(results.iso230)
        told["ISO 230-2 window"] = window.window
        told |= {f"{symbol} by ISO 230-2": value for symbol, value in iso230_values(window).items()}
    if results.anomalies is not None:
        told["positions that stand out"] = (
            join([f"{position_words(one.target, one.position_mm)}: {anomaly_cause(one)}" for one in results.anomalies])
            or "none"
        )
    return told


def comparison_json(pairs: Sequence[PairComparison]) -> dict[str, Any]:
    """Return a comparison in JSON's own types.

    Parameters
    ----------
    pairs : sequence of PairComparison
        Of one reference.
    """
    return {
        "reference": pairs[0].before.name,
        "compared": [
            {
                "campaign": pair.after.name,
                "tests": pair.tests,
                "conclusions": conclude_comparison(pair),
                "changes": [_change_json(change) for change in pair.changes],
                "not_compared": list(pair.not_compared),
            }
            for pair in pairs
        ],
    }


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
