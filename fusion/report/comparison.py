"""Campaigns of one machine side by side in words and tables: what changed, what did not, what cannot be compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from fusion.analysis.comparison import Change, ComparedCampaign, PairComparison, common_to_all
from fusion.analysis.levels import ATTRIBUTION_LEVEL, CHANGE_LEVEL
from fusion.common import versions
from fusion.report.charts.comparison import (
    Trend,
    draw_trend,
    follow_trends,
    plot_profiles,
    plot_remaining,
    plot_scatters,
)
from fusion.report.charts.style import embed
from fusion.report.findings import findings
from fusion.report.letterhead import PLAIN, Letterhead, translation
from fusion.report.page import render_page
from fusion.report.sheet import Sheet, Stated, label
from fusion.report.wording import (
    CHANNELS,
    ISO230_TERMS,
    Row,
    Table,
    Words,
    anomaly_cause,
    conditional,
    effect_words,
    iso230_values,
    quantity,
    say,
    sentences,
    table,
)
from fusion.results.loop import AxisLoop
from fusion.results.numbers import fixed, join, measured, p_cell, place, print_unit
from fusion.results.parts import Quantity
from fusion.results.store import plain

#: What is left of a difference of profiles, as a whole.
_REST = ("profile", "rest of the profile")
#: Tests beside each other in a table on paper.
_MOST_COLUMNS = 5
#: Verdict on a difference that a thermal state alone can cause.
_STATE = "differs; the thermal state of a test alone can cause that"


def compared_tests(pairs: Sequence[PairComparison]) -> list[ComparedCampaign]:
    """Return the tests of a comparison, the reference first."""
    return [pairs[0].before, *(pair.after for pair in pairs)]


def _letters(pairs: Sequence[PairComparison]) -> list[str]:
    """Return what a test is called: as found and as left where there are two, a letter where there are more."""
    if len(pairs) == 1:
        return ["as found", "as left"]
    return [chr(ord("A") + k) if k < 26 else str(k + 1) for k in range(len(pairs) + 1)]


def campaign_names(pairs: Sequence[PairComparison]) -> list[str]:
    """Return the names of the tests with their title and day."""
    return [f"{letter} ({one.name})" for letter, one in zip(_letters(pairs), compared_tests(pairs), strict=True)]


def short_names(pairs: Sequence[PairComparison]) -> list[str]:
    """Return the names of the tests for legends and columns; a letter comes with the day."""
    days = [one.results.time.day if one.results.time else "" for one in compared_tests(pairs)]
    named = zip(_letters(pairs), days, strict=True)
    return [f"{letter}, {day}" if day and len(pairs) > 1 else letter for letter, day in named]


def conclude_comparison(pair: PairComparison) -> str:
    """Return what a comparison shows."""
    machine, state = (
        [
            _change_words(change)
            for change in pair.changes
            if change.significant and change.machine is machine and not (pair.achieved and change.group == "ISO 230-2")
        ]
        for machine in (True, False)
    )
    shown = [
        f"{change_name(change)} by {fixed(change.shown_from, 2)} {print_unit(change.unit)}"
        for change in pair.changes
        if pair.before.record is not None and change.shown_from is not None and not change.significant
    ]
    text = say("comparison_outcome", bool(pair.changes), machine, state, pair.table, shown)
    for campaign in (pair.before, pair.after) if pair.changes else ():
        text = conditional(text, campaign.results.inputs, "positions")
    return text


def conclude_table(pair: PairComparison) -> list[str]:
    """Return whether a table that was loaded did what was predicted of it; nothing where none was named."""
    missed = [one.quantity for one in pair.achieved if not one.as_predicted]
    blind = [one.quantity for one in pair.achieved if one.as_predicted and not one.told]
    kept = [one.quantity for one in pair.achieved if one.as_predicted and one.told]
    elsewhere = any(one.predicted == one.stated for one in pair.achieved)
    return sentences("table_outcome", pair.table, kept, missed, blind, elsewhere)


def achieved_table(pair: PairComparison) -> Table:
    """Return the values before a table, as predicted with it and as achieved."""
    rows = []
    for one in pair.achieved:
        values = [quantity(value) for value in (one.before, one.stated, one.predicted, one.achieved, one.difference)]
        within = "within the uncertainty" if one.told else "not told: the uncertainty covers the value as found, too"
        verdict = within if one.as_predicted else "beyond the uncertainty"
        rows.append(Row([ISO230_TERMS[one.quantity], *values, verdict], marked=not one.as_predicted))
    heads = (
        "as found / µm",
        "stated with the table / µm",
        "in this thermal state / µm",
        "achieved / µm",
        "achieved less that / µm",
    )
    return table([Words("Quantity (k = 2)"), *heads, Words("Verdict")], rows)


def comparison_notes(pairs: Sequence[PairComparison]) -> list[str]:
    """Return what holds for all comparisons with the reference: level, what was presumed, common errors, and what cannot be compared."""
    tests = max(pair.tests for pair in pairs)
    standard = max((one.family for pair in pairs for one in pair.changes if one.group == "ISO 230-2"), default=0)
    notes = sentences("comparison_level", CHANGE_LEVEL, tests, standard, pairs[0].before.record is not None)
    names = _letters(pairs)[1:]
    common = [(pair.common, name) for pair, name in zip(pairs, names, strict=True) if pair.common]
    lacks = [(lack, name) for pair, name in zip(pairs, names, strict=True) for lack in lacks_in_words(pair)]
    for inputs, whose in _shared(common):
        notes.append(say("common_to_tests", inputs, whose if len(whose) < len(pairs) else []))
    for lack, whose in _shared(lacks):
        notes.append(f"Not compared{f' ({join(whose)})' if len(whose) < len(pairs) else ''}: {lack}")
    return notes


def lacks_in_words(pair: PairComparison) -> list[str]:
    """Return what cannot be compared, and why, one sentence each."""
    return [say("not_compared", lack) for lack in pair.not_compared]


def _shared(told: Sequence[tuple[Any, str]]) -> list[tuple[Any, list[str]]]:
    """Return what is told of several tests once, with their names."""
    return [(what, [name for one, name in told if one == what]) for what in dict.fromkeys(one for one, _ in told)]


def _change_words(change: Change) -> str:
    """One change with its size."""
    if change.group != "scatter":
        return f"{change_name(change)} by {_size(change)}"
    before, after = (_value(found, "um") for found in (change.before, change.after))
    return f"{change_name(change)} from {before} to {after}"


def change_name(change: Change) -> str:
    """Return what a change is a change of."""
    return say("change_name", change, effect_words(change.quantity).name)


def _size(change: Change) -> str:
    """The change with its expanded uncertainty; of a scatter the ratio."""
    if change.group == "scatter":
        return f"× {fixed(change.change.value, 2)}"
    text = measured(change.change.value, change.change.u, print_unit(change.unit))
    return f"+{text}" if text.split(" ")[0].strip("0.") and not text.startswith("−") else text


def changes_table(pairs: Sequence[PairComparison], pair: PairComparison, *, short: bool = False) -> Table:
    """Return what was compared, with both values, the change and the verdict; what differs is marked and comes first.

    A `short` table leaves out single positions that did not change, and the values by ISO 230-2, which stand elsewhere.
    """
    names, rows = short_names(pairs), []
    for change in sorted(pair.changes, key=lambda one: not one.significant):
        if short and (change.group == "ISO 230-2" or (change.group == "scatter" and not change.significant)):
            continue
        both = [_value(found, change.unit) for found in (change.before, change.after)]
        p = "> 0.99" if change.p_value > 0.99 else p_cell(change.p_value)
        cells = [change_name(change).rstrip(","), *both, _size(change), p, _verdict(change, loaded=bool(pair.achieved))]
        rows.append(Row(cells, marked=change.significant))
    figures = (names[0], names[1 + list(pairs).index(pair)], "change (k = 2)", "p (family-wise)")
    return table([Words("Quantity"), *figures, Words("Verdict")], rows)


def _value(found: Quantity | None, unit: str) -> str:
    return "–" if found is None else quantity(found, print_unit(unit))


def _verdict(change: Change, *, loaded: bool = False) -> str:
    if change.significant and loaded and change.group == "ISO 230-2":
        return "differs; held against the prediction of the table"
    if change.significant:
        return "changed" if change.machine else _STATE
    if change.change.u and abs(change.change.value or 0.0) > 2 * change.change.u:
        return f"not significant among {change.family} comparisons"
    return "within the uncertainties" if change.change.u or change.group == "scatter" else "no uncertainty: not judged"


def side_by_side(pairs: Sequence[PairComparison]) -> Table:
    """Return the main figures of all tests, a column for each."""
    columns = [_figures(one) for one in compared_tests(pairs)]
    names = list(dict.fromkeys(name for column in columns for name in column))
    rows = [[name, *(column.get(name, "–") for column in columns)] for name in names]
    return table([Words("Figure (k = 2)"), *(Words(name) for name in short_names(pairs))], rows)


def _figures(campaign: ComparedCampaign) -> dict[str, str]:
    """The main figures of a campaign by name, in the order of the report."""
    results = campaign.results
    tiles = [one.tile for one in findings(results) if one.code == "drift"]
    figures = {f"{tile.name.lower()} during the test": tile.value for tile in tiles if tile}
    if isinstance(results.loop, AxisLoop):
        for declared in results.loop.declared_coefficients:
            figures[effect_words(declared.effect).name] = measured(
                declared.value, declared.u, print_unit(declared.unit)
            )
        added = join([effect_words(step.effect).name for step in results.loop.named])
        figures["effects that were missing"] = added or "none shown"
    if results.iso230 is not None:
        figures["ISO 230-2 window"] = results.iso230.window
        figures |= {f"{symbol} by ISO 230-2": value for symbol, value in iso230_values(results.iso230).items()}
        for one in results.iso230.tolerances:
            limit = f"at most {one.limit_um:g} {print_unit(results.iso230.unit)}"
            figures[f"{one.quantity} {limit}"] = say("judged", one, results.iso230, True)
    if results.anomalies is not None:
        named = [
            f"{say('position_words', one.target, one.position_mm)}: {anomaly_cause(one)}" for one in results.anomalies
        ]
        figures["positions that stand out"] = join(named) or "none"
    return figures


# Places that the drift follows: what both tests show, and what only one shows.


def describe_places(pairs: Sequence[PairComparison], pair: PairComparison) -> dict[str, Any]:
    """Return what two tests agree on: in sentences, the places that repeat, a table of the sources, and every part of the drift.

    A row of the table is a source that either shows: its name, where it is, what either test shows there, and whether it repeats.
    """
    if pair.places is None:
        return {}
    names = campaign_names(pairs)
    tests = (names[0], names[1 + list(pairs).index(pair)])
    numbers = {(one.channel, one.x_mm, one.y_mm): f"place {k}" for k, one in enumerate(pair.places.sources, start=1)}
    rows: list[list[str]] = []
    for source, name in zip(pair.places.sources, numbers.values(), strict=True):
        near = numbers.get((source.channel, *source.agreed_near_mm[:2])) if source.agreed_near_mm else None
        of_tests = (source.sensitivity_um_per_K, source.sensitivity_interval_um_per_K, source.lag_s)
        shown = [say("source_shown", *one) for one in zip(source.p_value, pair.places.least_p, *of_tests, strict=True)]
        verdict = say("source_verdict", source, tests, near, ATTRIBUTION_LEVEL)
        where = f"{place(source.x_mm, source.y_mm)}, {CHANNELS.get(source.channel, source.channel)}"
        rows.append([name, where, *shown, verdict])
    found = list(zip(pair.places.sources, rows, strict=True))
    titles = [Words(title) for title in ("Place", "Where, and part of the drift", *tests, "Verdict")]
    return {
        "said": sentences("joint_outcome", pair.places, found, tests),
        "repeated": [row[1] for source, row in found if source.repeats],
        "table": table(titles, rows, stacked=True),
        "rows": [
            (CHANNELS.get(one.channel, one.channel), say("channel_agreement", one, ATTRIBUTION_LEVEL))
            for one in pair.places.channels
        ],
    }


def places_json(pairs: Sequence[PairComparison], pair: PairComparison) -> dict[str, Any]:
    """Return the agreement of two tests on every part of the drift and on every source in JSON's own types."""
    if pair.places is None:
        return {"sources": [], "agreement": []}
    rows = [row.cells for row in describe_places(pairs, pair)["table"].rows]
    agreement = [
        {**asdict(source), "repeats": source.repeats, "name": cells[0], "verdict": cells[-1]}
        for source, cells in zip(pair.places.sources, rows, strict=True)
    ]
    sources = [{**asdict(one), "reason": say("channel_reason", one, ATTRIBUTION_LEVEL)} for one in pair.places.channels]
    return {"sources": plain(sources), "agreement": plain(agreement)}


# As found and as left: the sheet to sign.


def describe_pair(pair: PairComparison, own: Letterhead = PLAIN) -> Sheet:
    """Return the sheet of two tests: whose they were, what was adjusted, A, R, E, M, B of both, their change and decisions."""
    parts = [one.results.iso230 for one in (pair.before, pair.after)]
    conditions = [() if part is None else part.conditions for part in parts]
    found, left = (dict(Stated.of(rows, "not stated").identity) for rows in conditions)
    identity = []
    for name in dict.fromkeys([*found, *left]):
        both = [one.get(name, "not stated") for one in (found, left)]
        if both[0] == both[1]:
            identity.append((name, both[0]))
        else:
            identity += [(f"{name}, {which}", text) for which, text in zip(("as found", "as left"), both, strict=True)]
    remarks = [{row.key: row.text for row in rows}.get("remarks", "") for rows in conditions]
    done = remarks[1] if remarks[1] != remarks[0] else ""
    files = {f"results.json {which}": one.sha256 for which, one in (("as found", pair.before), ("as left", pair.after))}
    return Sheet(
        title=translation(own.language)("As found, as left"),
        standard="Accuracy and repeatability of positioning by ISO 230-2:2014, two tests of one axis",
        stated=Stated(
            [*identity, ("Done between the tests", done or "not stated")],
            [],
            Stated.of(conditions[1], "").signatures,
        ),
        caption="Values by ISO 230-2, expanded uncertainties (k = 2); of the change without what both tests have in common",
        values=_values_as_left(pair),
        notes=sentences("decision_rule") if any(part is not None and part.tolerances for part in parts) else [],
        files=files,
        own=own,
    ).in_its_language()


def _values_as_left(pair: PairComparison) -> Table:
    """Return A, R, E, M, B of two tests, the change of each, and the decisions against the tolerances that are stated."""
    parts = [one.results.iso230 for one in (pair.before, pair.after)]
    changes = {one.quantity: one for one in pair.changes if one.group == "ISO 230-2"}
    judged = [{} if part is None else {one.quantity: one for one in part.tolerances} for part in parts]
    any_judged = bool(judged[0] or judged[1])
    rows = []
    for symbol, term in ISO230_TERMS.items():
        both = ["–" if part is None else quantity(getattr(part, f"{symbol}_um")) for part in parts]
        change = changes.get(symbol)
        cells = [
            term,
            *both,
            *(
                ["–", "not compared"]
                if change is None
                else [_size(change).removesuffix(f" {print_unit(change.unit)}"), _differs(change)]
            ),
        ]
        stated = [one.get(symbol) for one in judged]
        if any_judged:
            limits = dict.fromkeys(f"{one.limit_um:g}" for one in stated if one is not None)
            told = [
                "–" if one is None or part is None else say("judged", one, part, True)
                for one, part in zip(stated, parts, strict=True)
            ]
            cells += [" / ".join(limits) or "–", *told]
        rows.append(Row(cells, marked=change is not None and change.significant))
    unit = print_unit(next((part.unit for part in parts if part is not None), "um"))
    decided = (
        [f"tolerance / {unit}", Words("as found (ISO 14253-1)"), Words("as left (ISO 14253-1)")] if any_judged else []
    )
    heads = [Words("Quantity"), f"as found / {unit}", f"as left / {unit}", f"change / {unit}", Words("Change")]
    return table([*heads, *decided], rows)


def _differs(change: Change) -> str:
    """The verdict on a value by ISO 230-2 in short."""
    return "differs" if change.significant else _verdict(change)


def trend_caption(trend: Trend) -> str:
    """Return which values of a trend lie outside its control limits."""
    return say("trend_outside", trend, [str(day) for day in trend.when[trend.outside].astype("datetime64[D]")])


def trend_sentences(trends: Sequence[Trend]) -> list[str]:
    """Return what of several trends lies outside its control limits."""
    return [said for said in map(trend_caption, trends) if said]


def trend_notes(pairs: Sequence[PairComparison], trends: Sequence[Trend]) -> str:
    """Return how trends are drawn."""
    return say("trend_notes", common_to_all(pairs), trends)


def changes_of_all(pairs: Sequence[PairComparison]) -> Table:
    """Return the change of every quantity from the reference to each test; what differs is marked."""
    rows: dict[str, list[Change | None]] = {}
    for k, pair in enumerate(pairs):
        for change in pair.changes:
            name = "rest of the profile, largest" if change.quantity in _REST else change_name(change)
            rows.setdefault(name, [None] * len(pairs))[k] = change
    shown = [
        Row(
            [name, *("–" if one is None else f"{_size(one)}{' *' if one.significant else ''}" for one in found)],
            marked=any(one is not None and one.significant for one in found),
        )
        for name, found in rows.items()
    ]
    shown.sort(key=lambda row: not row.marked)
    return table([Words("Quantity"), *short_names(pairs)[1:]], shown)


def _in_width(wide: Table, most: int) -> list[Table]:
    """Return a table as several with the same first column, of so many others at most."""
    columns = range(1, len(wide.titles), most)
    return [
        Table(
            (wide.titles[0], *wide.titles[k : k + most]),
            tuple(Row([row.cells[0], *row.cells[k : k + most]], row.marked) for row in wide.rows),
        )
        for k in columns
    ]


def render_comparison(pairs: Sequence[PairComparison], *, reports: Sequence[str] = (), own: Letterhead = PLAIN) -> str:
    """Return a comparison as a document: of two tests the sheet to sign, of more their trend; then what changed, then everything.

    `reports` are the places of their reports, to which the page links; `own` is what makes the sheet a laboratory's own.
    """
    tests, names = compared_tests(pairs), short_names(pairs)
    sheet = describe_pair(pairs[0], own) if len(pairs) == 1 and pairs[0].before.record is None else None
    trends = follow_trends(pairs)
    charts = {
        "profiles": plot_profiles(tests, [*map(sheet.tell, names)] if sheet else names),
        "scatters": plot_scatters(tests, names),
        **{f"remaining_{k}": plot_remaining(pair) for k, pair in enumerate(pairs, start=1)},
        **{f"trend_{trend.name}": draw_trend(trend) for trend in trends},
    }
    if sheet is not None and (profiles := charts["profiles"]) is not None:
        label(profiles, sheet.tell)
    return render_page(
        "comparison.html.j2",
        embed({name: chart for name, chart in charts.items() if chart is not None}),
        sheet=sheet,
        names=campaign_names(pairs),
        compared=_shared([(conclude_comparison(pair), name) for name, pair in zip(names[1:], pairs, strict=True)]),
        table_said=conclude_table(pairs[0]),
        achieved=achieved_table(pairs[0]),
        short=changes_table(pairs, pairs[0], short=True),
        every=[changes_table(pairs, pairs[0])] if len(pairs) == 1 else _in_width(changes_of_all(pairs), _MOST_COLUMNS),
        notes=comparison_notes(pairs),
        compared_places=[
            (name, describe_places(pairs, pair)) for name, pair in zip(names[1:], pairs, strict=True) if pair.places
        ],
        reports=list(zip(campaign_names(pairs), reports, strict=False)),
        figures_tables=_in_width(side_by_side(pairs), _MOST_COLUMNS + 1),
        others=names[1:],
        trends=[f"trend_{trend.name}" for trend in trends],
        trend_said=trend_sentences(trends),
        trend_notes=trend_notes(pairs, trends),
        versions=versions(),
        summary={"assumptions": {}},
    )


def comparison_json(pairs: Sequence[PairComparison]) -> dict[str, Any]:
    """Return a comparison in JSON's own types."""
    compared = []
    for pair in pairs:
        about: dict[str, Any] = {"campaign": pair.after.name, "tests": pair.tests}
        if pair.achieved:
            about["achieved"] = [
                {**asdict(one), "as_predicted": one.as_predicted, "told": one.told} for one in pair.achieved
            ]
        if pair.table is not None:
            about["table"] = {**asdict(pair.table), "is_kept": pair.is_kept}
        if pair.places is not None:
            about["places"] = places_json(pairs, pair)
        about["conclusions"] = [*conclude_table(pair), conclude_comparison(pair), *comparison_notes([pair])]
        about["changes"] = [{**asdict(change), "significant": change.significant} for change in pair.changes]
        compared.append({**about, "not_compared": lacks_in_words(pair)})
    return {"reference": pairs[0].before.name, "compared": plain(compared)}
