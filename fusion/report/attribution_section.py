"""Drift and field in the report: verdict, what it is worth, tables, and which further test would decide."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from fusion.attribution.family_wise import LEVEL
from fusion.products.results import Results
from fusion.products.results_attribution import CorrelationPart, DutyPart, PlacePart, TestedPart
from fusion.report.charts.attribution import caption_of, rate_text
from fusion.report.conclusions.answers import place_sentence
from fusion.report.findings import randomised_causes, span_words
from fusion.report.tables import Row, Table, Words, table
from fusion.report.wording import (
    CHANNELS,
    conditional,
    duration,
    join,
    measured,
    number,
    p_cell,
    place,
    quantity,
    region_words,
)

_SHORT = {"common": "common", "proportional": "growing", "reversal": "reversal", "joint": "common and growing"}
_SENSITIVITY = "Sensitivity / (µm/K)"
_DETECTION_LIMIT = "Detection limit (80 % power) / (µm/K)"


@dataclass(frozen=True)
class PlaceTables:
    """Thermal modes or regions in the report.

    Attributes
    ----------
    title : str
        Heading.
    strongest : Table
        The part of the drift that follows each most closely.
    every : Table
        All parts of the drift.
    """

    title: str
    strongest: Table
    every: Table


def describe_correlation(
    fused: xr.DataTree, results: Results, joint: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """Return everything the section on drift and field says, as the template reads it; None where it was not tested.

    Parameters
    ----------
    fused : DataTree
        fusion.nc of the run.
    results : Results
        Results of the run.
    joint : mapping or None
        What this campaign and another one of the machine agree on, see `fusion.report.html.render_report`.
    """
    correlation = results.correlation
    if correlation is None or "correlation" not in fused.children:
        return None
    maps = fused.children["correlation"]
    channel = correlation.source.part
    captions = {"cells": caption_of(maps, channel)}
    if "modes" in maps.children:
        captions["modes"] = caption_of(maps, channel, "modes")
    sentences = [_leading(correlation), *_beside(correlation), _worth(correlation, joint)]
    places = (
        ("Mode", "Thermal modes", correlation.modes),
        ("Region", "Regions, and discs about the middles of hotspots", correlation.regions),
    )
    return {
        "headline": conditional(place_sentence(correlation), results.inputs, "attribution"),
        "sentences": [sentence for sentence in sentences if sentence],
        "tell": correlation.would_tell,
        **_leading_figure(correlation),
        "captions": captions,
        "mode_captions": {mode.name.replace(" ", "_"): _mode_caption(mode) for mode in correlation.modes},
        "cells": _cells_table(maps.to_dataset(), correlation.least_p),
        "places": [
            _place_tables(heading, title, listed, maps, correlation.least_p)
            for heading, title, listed in places
            if listed
        ],
        "region": region_words(leading_region(maps)) if "target_regions" in maps.children else "",
        "region_targets": _region_targets(maps) if "target_regions" in maps.children else "",
        "session": _session(maps),
        "duty": _duty_table(correlation.randomised_duty) if correlation.randomised_duty else None,
        "sensors": _sensors_text(maps.children["sensors"].to_dataset(), correlation.verdict),
        "sensors_table": _sensors_table(correlation),
    }


def _leading_figure(correlation: CorrelationPart) -> dict[str, str]:
    """Name and caption of the chart that shows the place which the drift follows; empty where it follows none."""
    source = correlation.source
    if correlation.verdict != "attributable" or source.kind == "region":
        return {"leading_figure": "", "leading_caption": ""}
    area = f"The area {span_words(source.area)}"
    if source.kind == "mode":
        told = f"{area} are the cells around the cross that warm by at least half as much as it does (thermal mode {source.name})."
        return {"leading_figure": f"mode_{source.name}", "leading_caption": told}
    told = f"{area} are the cells that explain the drift as well as the strongest one; coloured where they are significant."
    return {"leading_figure": "sensitivity", "leading_caption": told}


def _mode_caption(mode: PlacePart) -> str:
    """What a chart of a thermal mode shows, with its area."""
    where = span_words(mode.area) if mode.area else place(mode.x_mm, mode.y_mm)
    return f"Thermal {mode.name}, {where}: a part of the field that warms by itself, usually one heat source with its halo."


def _leading(correlation: CorrelationPart) -> str:
    """Size and lag of the leading candidate, and what cannot be told from it."""
    source = correlation.source
    attributable = correlation.verdict == "attributable"
    what = {"cell": "a cell", "mode": f"thermal mode {source.name}", "region": region_words(source.name)}[source.kind]
    behind = f"with a lag of {duration(source.lag_s)}" if source.lag_s else "without lag"
    size = quantity(source.sensitivity_um_per_K, "µm/K")
    part = CHANNELS.get(source.part, source.part)
    text = f"It is {what}; the {part} goes with its rise by {size} (k = 2), {behind}."
    if not attributable:
        text = f"Closest is {what}: {part}, {size} of its rise (k = 2), {behind}."
    if not attributable or not source.equal_places_mm:
        return text
    others = [f"the place around {place(x, y)}" for x, y in source.equal_places_mm[:4]]
    more = f" and {len(source.equal_places_mm) - 4} more" if len(source.equal_places_mm) > 4 else ""
    return f"{text} These data cannot tell it from {join(others)}{more}, which explain the drift as well."


def _passes(p: float | None) -> bool:
    return p is not None and p <= LEVEL


def _beside(correlation: CorrelationPart) -> list[str]:
    """Which other modes add to the leading one, and which pass but may only warm with it."""
    source = correlation.source
    if correlation.verdict != "attributable" or source.kind != "mode":
        return []
    adds, alike = [], []
    for mode in correlation.modes:
        if mode.name == f"mode {source.name}":
            continue
        named = f"{mode.name} ({span_words(mode.area) if mode.area else place(mode.x_mm, mode.y_mm)})"
        if any(_passes(tested.p_beside_leader) for tested in mode.parts.values()):
            adds.append(named)
        elif any(_passes(tested.p_value) for tested in mode.parts.values()):
            alike.append(named)
    sentences = []
    if adds:
        sentences.append(
            f"With it taken as given, {join(adds)} {'goes' if len(adds) == 1 else 'go'} with what is left."
        )
    if alike:
        sentences.append(
            f"By itself {alike[0]} passes too, but adds nothing to it: that place may only warm with it."
            if len(alike) == 1
            else f"By themselves {join(alike)} pass too, but add nothing to it: these places may only warm with it."
        )
    return sentences


def _worth(correlation: CorrelationPart, joint: Mapping[str, Any] | None) -> str:
    """Whether this is a cause: where two sessions agree, or where the duty was randomised."""
    causes = randomised_causes(correlation)
    if causes:
        verb = "is a cause" if len(causes) == 1 else "are causes"
        return f"Loads were switched at random, which shows that {join(causes)} {verb} of drift (below)."
    if joint is not None and joint["causes"]:
        return f"It is a cause where {joint['other']} agrees: {join(joint['causes'])} (below)."
    if correlation.verdict != "attributable":
        return ""
    if joint is not None:
        return f"Causation is not shown yet: {joint['other']} does not show the same."
    return "Causation is not shown yet: in one session two courses may agree by chance, and places that warm together cannot be told apart."


def _cells_table(maps: xr.Dataset, least_p: float | None) -> Table:
    """Return the strongest cell of every part of the drift, its detection limit, and the drift that nothing explains."""
    columns = [
        Words("Part of the drift"),
        "p",
        "x, y / mm",
        _SENSITIVITY,
        "Lag",
        _DETECTION_LIMIT,
        "Unexplained drift / µm in one hour",
    ]
    return table(columns, [_cell_row(maps, str(channel), least_p) for channel in maps["channel"].values])


def _cell_row(maps: xr.Dataset, channel: str, least_p: float | None) -> list[str]:
    chosen = maps[["p_value", "sensitivity", "sensitivity_u", "lag", "detectable_sensitivity"]].sel(channel=channel)
    flat = chosen.stack(cell=("y", "x"))
    best = flat.isel(cell=int(np.argmin(flat["p_value"].fillna(np.inf).values)))
    return [
        _SHORT.get(channel, channel),
        p_cell(float(best["p_value"]), least_p),
        f"{float(best['x']):.0f}, {float(best['y']):.0f}",
        measured(float(best["sensitivity"]), float(best["sensitivity_u"])),
        duration(float(best["lag"])),
        number(float(best["detectable_sensitivity"]), 2),
        number(float(maps["unexplained_drift"].sel(channel=channel)), 2),
    ]


def _place_tables(
    heading: str, title: str, listed: Iterable[PlacePart], maps: xr.DataTree, least_p: float | None
) -> PlaceTables:
    """Return modes or regions: the strongest part of the drift for each, and all parts."""
    modes = heading == "Mode"
    at = "Strongest at x, y / mm" if modes else "Middle x, y / mm"
    columns = [
        Words(heading),
        Words("Area"),
        at,
        Words("Part of the drift"),
        "p",
        _SENSITIVITY,
        "Lag",
        _DETECTION_LIMIT,
    ]
    if modes:
        columns.append("p given the leading mode")
    tested = maps.children["modes" if modes else "regions"].to_dataset()
    ratio = (tested["statistic"] / tested["threshold"]).fillna(0.0)
    strongest: list[Row] = []
    every: list[Row] = []
    for k, candidate in enumerate(listed):
        rows = {part: _place_row(candidate, part, found, modes, least_p) for part, found in candidate.parts.items()}
        leading = ratio.isel({heading.lower(): k})
        strongest.append(rows[str(leading["channel"].values[int(leading.values.argmax())])])
        every += rows.values()
    return PlaceTables(title, table(columns, strongest), table(columns, every))


def _place_row(candidate: PlacePart, part: str, tested: TestedPart, modes: bool, least_p: float | None) -> Row:
    x, y = ("–" if value is None else f"{value:.0f}" for value in (candidate.x_mm, candidate.y_mm))
    cells = [
        region_words(candidate.name),
        span_words(candidate.area),
        f"{x}, {y}",
        _SHORT.get(part, part),
        p_cell(tested.p_value, least_p),
        quantity(tested.sensitivity_um_per_K),
        duration(tested.lag_s),
        number(tested.detectable_um_per_K, 2),
    ]
    if modes:
        cells.append(p_cell(tested.p_beside_leader, least_p))
    return Row(cells, marked=_passes(tested.p_value))


def leading_region(maps: xr.DataTree) -> str:
    """Return the region that explains the drift best.

    Parameters
    ----------
    maps : DataTree
        Result of `fusion.attribution.attribute.correlate` with regions.
    """
    regions = maps.children["regions"].to_dataset()
    ratio = (regions["statistic"] / regions["threshold"]).fillna(0.0).max("channel")
    return str(regions["region"].values[int(ratio.values.argmax())])


def _region_targets(maps: xr.DataTree) -> str:
    """Which targets follow which region by themselves."""
    p = maps.children["target_regions"].to_dataset()["p_value"]
    named = []
    for region in map(str, p["region"].values):
        passed = [str(name) for name in p["series"].values[(p.sel(region=region) <= LEVEL).values]]
        if passed:
            more = ", …" if len(passed) > 6 else ""
            named.append(f"{region_words(region)}: {len(passed)} of {p.sizes['series']} ({join(passed[:6])}{more})")
    return "; ".join(named) or "none"


def _session(maps: xr.DataTree) -> list[tuple[str, str]]:
    """What holds for the whole test."""
    session, clusters = maps.to_dataset(), maps.children["clusters"].to_dataset()
    return [
        (
            "Rate of false alarms",
            f"{rate_text(float(session['false_alarm_rate']))} over cells, modes and regions together, in simulations without a source",
        ),
        (
            "Excitation",
            f"{maps.attrs['excitation']}; one warm-up explains {float(session['warm_up_share']):.1%} of the field's course",
        ),
        (
            "Courses of temperature",
            f"{int(clusters['cluster'].values.max())} groups of cells that warm alike; condition of the thermal modes "
            f"{number(float(clusters['condition']), 2)}",
        ),
    ]


def _duty_table(loads: Iterable[DutyPart]) -> Table:
    """Return what randomisation shows of every load."""
    columns = [Words("Load"), "p", "Drift at full duty, far end / µm", "Time constants", Words("Verdict")]
    rows = []
    for load in loads:
        first, second = load.time_constants_s
        rows.append(
            [
                load.name,
                p_cell(load.p_value),
                quantity(load.drift_at_full_duty_um),
                duration(first) + (f" behind {duration(second)}" if second else ""),
                "a cause" if load.cause else "not shown",
            ]
        )
    return table(columns, rows)


def _sensors_text(sensors: xr.Dataset, verdict: str) -> str:
    """How much of the drift the camera itself predicts, and what that says of contact sensors in its place."""
    if "sensor" not in sensors.sizes or sensors.sizes["sensor"] == 0:
        return "The field did not change enough to place sensors."
    gain, most = float(sensors["camera_gain"]), float(sensors["camera_gain_at_most"])
    if bool(sensors["camera_decided"]):
        text = (
            f"In cycles that it was not fitted to, what the camera sees lowers the error by {number(gain, 2)} µm "
            f"(upper limit {number(most, 2)} µm)."
        )
    else:
        text = (
            "Undecided: in cycles that it was not fitted to, what the camera sees is not shown to lower the error "
            f"(upper limit {number(most, 2)} µm), so a comparison of sensors with it says little."
        )
    if verdict == "not separable":
        text += " In a single warm-up many places do alike; which of them would do in another session these data cannot tell."
    within = duration(float(sensors["run_length"]))
    return f"{text} Errors are root mean squares over all positions, within runs of {within} of left-out cycles."


def _sensors_table(correlation: CorrelationPart) -> Table | None:
    """Return what each number of contact sensors loses beside the camera; None where none could be placed."""
    if not correlation.sensors.sets:
        return None
    rows = []
    least = np.inf
    for count, added in enumerate(correlation.sensors.sets, start=1):
        loss = np.inf if added.loss_um is None else added.loss_um
        verdict = "worse than the camera" if added.decided else "as good as the camera, as far as these data show"
        if loss > least:
            verdict += "; fewer sensors do as well"
        least = min(least, loss)
        where = place(added.x_mm, added.y_mm)
        rows.append([str(count), where, number(added.loss_um, 2), number(added.loss_at_most_um, 2), verdict])
    return table(
        ["Number of sensors", Words("Place of the last one"), "Error added / µm", "Upper limit / µm", Words("Verdict")],
        rows,
    )
