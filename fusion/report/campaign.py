"""The report of a campaign: the facts that its templates state."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import rich.table
import xarray as xr

from fusion.analysis import levels
from fusion.analysis.alignment.sensor_health import describe_fault
from fusion.report.findings import Tile, findings, first_screen, headline, next_steps, sharpen
from fusion.report.letterhead import translation
from fusion.report.wording import (
    ARROWS,
    CONTRIBUTORS,
    EVIDENCE,
    ISO230_TERMS,
    ONE_WAY_TERMS,
    Row,
    Table,
    Words,
    anomaly_cause,
    anomaly_place,
    assumption,
    baseline_words,
    conditional,
    effect_words,
    figures_of,
    in_words,
    model_errors,
    parameters,
    print_table,
    quantity,
    randomised_causes,
    say,
    sentences,
    table,
    untouched,
    with_values,
)
from fusion.results.axis import AnomalyPart, CorrelationPart, Iso230Direction, Iso230Part, Iso230Window, PlacePart
from fusion.results.loop import AxisLoop, AxisStep, Coefficient, Loop, Nothing, RecordLoop, RunnerUp, StepPart
from fusion.results.numbers import (
    alike,
    decimals_of,
    duration,
    exact,
    fixed,
    gain,
    join,
    measured,
    moment,
    number,
    p_cell,
    p_words,
    print_unit,
    small,
    upper_first,
)
from fusion.results.parts import Figures, PicturePlace, Quantity, TemperatureRegionPart, ThermalDistortion, ThermalTest
from fusion.results.progress import counted
from fusion.results.results import Results
from fusion.results.store import by_approach, group, has
from interferometry.deviations import REGISTRY
from interferometry.io.tables import DATED
from interferometry.plots import time_span
from thermofuse.resources import vocabulary

if TYPE_CHECKING:
    from fusion.analysis.drift_model.verification import ChannelVerdict


# Drift and field in the report: the facts that its templates state.


class _NearestHotspot(NamedTuple):
    """The hotspot nearest to the middle of the place that the drift follows, and whether it may be that place."""

    name: str
    distance_mm: float
    u_mm: float
    same: bool


def _nearest_hotspot(results: Results) -> _NearestHotspot | None:
    """Relate the place that the drift follows to the hotspots; an area holds its source anywhere, with the same probability."""
    if results.correlation is None or not results.hotspots:
        return None
    source = results.correlation.source
    area = source.area
    if area is None:
        middle, place_u = np.array([source.x_mm, source.y_mm], float), np.zeros(2)
    else:
        edges = np.array([[area.x_low_mm, area.x_high_mm], [area.y_low_mm, area.y_high_mm]])
        middle, place_u = edges.mean(axis=1), np.diff(edges).ravel() / np.sqrt(12.0)
    related = []
    for spot in results.hotspots:
        apart = np.array([spot.x_mm, spot.y_mm], float) - middle
        u = np.hypot(place_u, np.nan_to_num(np.array([spot.x_u_mm, spot.y_u_mm], float)))
        distance = float(np.hypot(*apart))
        along = apart / distance if distance else np.full(2, np.sqrt(0.5))
        related.append(
            _NearestHotspot(spot.name, distance, float(np.hypot(*(along * u))), bool((np.abs(apart) <= 2 * u).all()))
        )
    return min(related, key=lambda one: (not one.same, one.distance_mm))


def describe_correlation(
    fused: xr.DataTree, results: Results, joint: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """Return the facts of the section on drift and field; None where it was not tested."""
    correlation = results.correlation
    if correlation is None or "correlation" not in fused.children:
        return None
    maps = fused.children["correlation"]
    source = correlation.source
    attributable = correlation.verdict == "attributable"
    adding, collinear = _other_modes(correlation) if attributable and source.kind == "mode" else ([], [])
    # What each number of contact sensors loses against the camera; whether fewer do as well.
    losses = [np.inf if added.loss_um is None else added.loss_um for added in correlation.sensors.sets]
    return {
        "headline": conditional(say("place_sentence", correlation), results.inputs, "attribution"),
        "attributable": attributable,
        "nearest_hotspot": _nearest_hotspot(results),
        "causes": randomised_causes(correlation),
        "repeated": None if joint is None else joint["repeated"],
        "adding": adding,
        "collinear": collinear,
        "figure": {"mode": f"mode_{source.name}", "cell": "sensitivity"}.get(source.kind, "") if attributable else "",
        "maps": [_map_facts(maps, name, source.part) for name in ("", "modes") if not name or name in maps.children],
        "cells": [_strongest_cell(maps.to_dataset(), str(channel)) for channel in maps.to_dataset()["channel"].values],
        "places": [
            (kind, [(place, _strongest_part(maps, kind, k)) for k, place in enumerate(listed)])
            for kind, listed in (("modes", correlation.modes), ("regions", correlation.regions))
            if listed
        ],
        "region": leading_region(maps) if "target_regions" in maps.children else "",
        "region_targets": _region_targets(maps) if "target_regions" in maps.children else None,
        "false_alarms": rate_text(float(maps["false_alarm_rate"])),
        "excitation": maps.attrs["excitation"],
        "warm_up_share": float(maps["warm_up_share"]),
        "courses": int(maps.children["clusters"]["cluster"].max()),
        "condition": float(maps.children["clusters"]["condition"]),
        "level": levels.ATTRIBUTION_LEVEL,
        "camera": _camera_prediction(maps.children["sensors"].to_dataset()),
        "sensors": [
            (added, losses[at] > min(losses[:at], default=np.inf)) for at, added in enumerate(correlation.sensors.sets)
        ],
    }


def passes(p: float | None) -> bool:
    """Return whether a family-wise p-value is significant."""
    return p is not None and p <= levels.ATTRIBUTION_LEVEL


class _OtherMode(NamedTuple):
    """A mode beside the leading one, with the part of the drift for which it is most significant."""

    mode: PlacePart
    part: str
    p_value: float


def _other_modes(correlation: CorrelationPart) -> tuple[list[_OtherMode], list[_OtherMode]]:
    """Return the modes that are significant given the leading one, and those that are so only on their own."""

    def significant(p_of: str, modes: Sequence[PlacePart]) -> list[_OtherMode]:
        best = [
            min(
                (_OtherMode(mode, name, p) for name, part in mode.parts.items() if passes(p := getattr(part, p_of))),
                key=lambda one: one.p_value,
                default=None,
            )
            for mode in modes
        ]
        return [one for one in best if one is not None]

    others = [mode for mode in correlation.modes if mode.name != f"mode {correlation.source.name}"]
    adding = significant("p_given_leading_mode", others)
    return adding, significant("p_value", [mode for mode in others if mode not in [one.mode for one in adding]])


def _map_facts(maps: xr.DataTree, name: str, channel: str) -> dict[str, Any]:
    """Return what the maps of cells, or of modes, can show: rate of false alarms, random drift allowed for (µm in 1 h), limit (µm/K)."""
    tested = maps.children[name].to_dataset() if name else maps.to_dataset()
    limit = tested["detectable_sensitivity"].sel(channel=channel)
    return {
        "name": name or "cells",
        "false_alarms": rate_text(float(tested["false_alarm_rate" if name else "cells_false_alarm_rate"])),
        "random_um": float(maps["unexplained_drift"].sel(channel=channel)),
        "limit_um_per_K": float(limit.where(np.isfinite(limit)).median()),
    }


def _strongest_cell(maps: xr.Dataset, channel: str) -> dict[str, Any]:
    """Return the cell that one part of the drift follows most closely."""
    flat = maps.sel(channel=channel).stack(cell=("y", "x"))
    best = flat.isel(cell=int(np.argmin(flat["p_value"].fillna(np.inf).values)))
    values = {name: float(best[name]) for name in ("p_value", "sensitivity", "lag", "detectable_sensitivity", "x", "y")}
    # Maps that an older program made have no limits.
    limits = float(best.get("sensitivity_low", np.nan)), float(best.get("sensitivity_high", np.nan))
    random_um = float(maps["unexplained_drift"].sel(channel=channel))
    return {"channel": channel, "random_um": random_um, "limits": limits, **values}


def _strength(maps: xr.DataTree, kind: str) -> xr.DataArray:
    """Return the statistic of modes or regions as a multiple of its threshold."""
    tested = maps.children[kind].to_dataset()
    return (tested["statistic"] / tested["threshold"]).fillna(0.0)


def _strongest_part(maps: xr.DataTree, kind: str, k: int) -> str:
    """Return the part of the drift that follows a mode or a region most closely."""
    of_place = _strength(maps, kind).isel({kind.removesuffix("s"): k})
    return str(of_place["channel"].values[int(of_place.values.argmax())])


def leading_region(maps: xr.DataTree) -> str:
    """Return the region that explains the drift best."""
    ratio = _strength(maps, "regions").max("channel")
    return str(ratio["region"].values[int(ratio.values.argmax())])


def _region_targets(maps: xr.DataTree) -> list[tuple[str, list[str], int]]:
    """Return the regions that single targets follow: name, those targets, and the number of targets tested."""
    p = maps.children["target_regions"].to_dataset()["p_value"]
    passed = {
        str(region): p["series"].values[(p.sel(region=region) <= levels.ATTRIBUTION_LEVEL).values]
        for region in p["region"].values
    }
    return [(region, [*map(str, names)], p.sizes["series"]) for region, names in passed.items() if names.size]


def _camera_prediction(sensors: xr.Dataset) -> dict[str, Any] | None:
    """Return by how much the camera lowers the error in cycles left out, µm; None where the field did not change enough."""
    if "sensor" not in sensors.sizes or sensors.sizes["sensor"] == 0:
        return None
    return {
        "gain": float(sensors["camera_gain"]),
        "at_most": float(sensors["camera_gain_at_most"]),
        "decided": bool(sensors["camera_decided"]),
        "within_s": float(sensors["run_length"]),
    }


# The test by ISO 230-2 in the report: values of the axis and of every target, budget, tolerances, conditions, other
# standards.

#: Columns of the budget, of a test from both sides.
_BUDGETED = ("A", "R", "E", "M", "B", "mean_reversal")
#: Missing readings that are listed one by one.
_NAMED = 8


def describe_iso230(part: Iso230Part, dataset: xr.Dataset | None = None) -> dict[str, Any]:
    """Return the tables of the section on ISO 230-2, as page and terminal show them."""
    unit = print_unit(part.unit)
    targets = None if dataset is None or not has(dataset, "quoted") else group(dataset, "quoted")
    return {
        "positions": None
        if dataset is None or targets is None
        else _iso230_positions_table(targets, dataset["position"], unit),
        "axis": _values_table(part, unit),
        "notes": sentences("decided_how", part),
        # Of one cycle nothing is known of the uncertainty.
        "budget": _budget_table(part, unit) if len(part.cycles) > 1 else None,
        "sharper": sharpen(part),
        "scatter_um": _scatter_um(part, dataset),
        "missing": "" if dataset is None or not part.cycles else missing_sentence(dataset, part.cycles),
    }


def _scatter_um(part: Iso230Part, dataset: xr.Dataset | None) -> float | None:
    """Return the median scatter of the readings without drift, of a test whose first window stands beside the quoted one."""
    if dataset is None or not has(dataset, "estimate") or _other_first(part) is None:
        return None
    return float(group(dataset, "estimate")["scatter"].median())


def _other_first(part: Iso230Part) -> Iso230Window | None:
    """Return the first window where it is another than the quoted one."""
    return part.first if part.first is not None and part.first.window != part.window else None


def _iso230_positions_table(quoted: xr.Dataset, position: xr.DataArray, unit: str) -> Table:
    """Return the values of every target in the order of the axis; decimals by the uncertainty of a mean deviation."""
    spread = quoted["standard_deviation"].values / np.sqrt(np.where(quoted["count"] > 0, quoted["count"], np.nan))
    known = spread[np.isfinite(spread)]
    places = decimals_of(float(np.median(known)) if known.size else np.nan)
    along = _along(position)
    of_both = ("mean_bidirectional", "reversal", "repeatability_bidirectional")
    of_each = ("mean_unidirectional", "standard_deviation", "repeatability")
    one_way = [by_approach(quoted[name], target=along) for name in of_each]
    values = np.hstack([*one_way, *(quoted[name].sel(target=along).values[:, None] for name in of_both)])
    places_mm, counted = position.sel(target=along).values, by_approach(quoted["count"], target=along)
    rows = [
        [
            str(target),
            exact(place),
            *(fixed(value, places) for value in row),
            ", ".join(str(int(count)) for count in counts),
        ]
        for target, place, row, counts in zip(along, places_mm, values, counted, strict=True)
    ]
    titles = [f"{symbol}{arrow} / {unit}" for symbol in ("x̄", "s", "R") for arrow in ARROWS.values()]
    unit_along = str(position.attrs.get("units", "mm"))
    columns = ["Target", f"Position / {unit_along}", *titles, f"x̄ / {unit}", f"Bᵢ / {unit}", f"Rᵢ / {unit}", "n↑, n↓"]
    return with_values(table(columns, rows))


def _along(position: xr.DataArray) -> np.ndarray:
    """Return the numbers of the targets in the order of the axis."""
    return position["target"].values[np.argsort(position.values, kind="stable")]


def missing_sentence(dataset: xr.Dataset, cycles: Sequence[int]) -> str:
    """Return which readings of a window are missing, and why."""
    within = dataset[["deviation", "quality_flag"]].sel(cycle=list(cycles))
    read = within["deviation"].notnull().any(("cycle", "target"))
    within = within.isel(direction=np.flatnonzero(read.values))
    side = (
        ""
        if read.all()
        else f"Approached from one side only ({', '.join(ARROWS[str(one)] for one in within['direction'].values)}). "
    )
    missing = np.argwhere(np.isnan(within["deviation"].transpose("cycle", "direction", "target").values))
    if missing.size == 0:
        return f"{side}No reading of the window is missing."
    named = []
    for cycle, direction, target in missing[:_NAMED]:
        bits = int(within["quality_flag"].values[cycle, direction, target])
        why = join([flag.name.replace("_", " ") for flag in REGISTRY if bits & flag.mask]) or "missing"
        approach = ARROWS[str(within["direction"].values[direction])]
        named.append(
            f"cycle {within['cycle'].values[cycle]}, target {within['target'].values[target]}{approach} ({why})"
        )
    more = len(missing) - len(named)
    rest = f" and {more} more" if more else ""
    return f"{side}{len(missing)} of {within['deviation'].size} readings of the window are missing: {'; '.join(named)}{rest}."


def values_to_sign(part: Iso230Part) -> Table:
    """Return the axis values of the quoted window, and of each direction what has a tolerance, with their decisions."""
    unit = print_unit(part.unit)
    judged = {one.quantity: one for one in part.tolerances}
    one_way = part.approach is not None
    found: list[tuple[str, str, Iso230Window | Iso230Direction]] = [
        *((term, symbol, part) for symbol, term in ISO230_TERMS.items()),
        *(
            (f"{term}{arrow}", f"{symbol}{arrow}", getattr(part, direction))
            for symbol, term in ONE_WAY_TERMS.items()
            for direction, arrow in ARROWS.items()
            if one_way or f"{symbol}{arrow}" in judged
        ),
    ]
    rows = []
    for term, symbol, values in found:
        value = getattr(values, f"{symbol[0]}_um")
        if value.value is not None:
            stated = judged.get(symbol)
            verdict = (
                ["–", "no tolerance stated"]
                if stated is None
                else [f"{stated.limit_um:g}", say("judged", stated, part)]
            )
            cells = [term, quantity(value), *(verdict if judged else [])]
            rows.append(Row(cells, stated is not None and stated.decision != "pass"))
    titles = [f"Tolerance / {unit}", Words("Decision (ISO 14253-1)")] if judged else []
    value = "Value ± U (k = 2)" if any("±" in row.cells[1] for row in rows) else "Value"
    return table([Words("Quantity of the axis"), f"{value} / {unit}", *titles], rows)


def _values_table(part: Iso230Part, unit: str) -> Table:
    """Return the axis values of the quoted window with their decisions, those of the first one and their range over the windows."""
    first = _other_first(part)
    judged = {one.quantity: (f"{one.limit_um:g}", say("judged", one, part)) for one in part.tolerances}
    rows = []

    def add(title: str, symbol: str, *cells: str, marked: bool = False) -> None:
        if any(cell != "–" for cell in cells) or symbol in judged:
            rows.append(Row([title, cells[0], *(judged.get(symbol, ("–", "–")) if judged else ()), *cells[1:]], marked))

    for symbol, term in ISO230_TERMS.items():
        found = part.range_um.get(symbol)
        spread = "–" if found is None else f"{number(found.lowest)} to {number(found.highest)}"
        beside = [quantity(getattr(first, f"{symbol}_um")), spread] if first else []
        add(term, symbol, quantity(getattr(part, f"{symbol}_um")), *beside, marked=True)
        for direction, arrow in ARROWS.items():
            if symbol not in ONE_WAY_TERMS:
                continue
            beside = [quantity(getattr(getattr(first, direction), f"{symbol}_um")), "–"] if first else []
            value = quantity(getattr(getattr(part, direction), f"{symbol}_um"))
            add(f"{ONE_WAY_TERMS[symbol]}{arrow}", f"{symbol}{arrow}", value, *beside)
    beside = [quantity(first.mean_reversal_um), "–"] if first else []
    add("Mean reversal error, with its sign", "", quantity(part.mean_reversal_um), *beside)
    columns = [f"{part.window} / {unit}", *([f"Tolerance / {unit}", Words("Decision")] if judged else [])]
    if first:
        columns += [f"First window, {first.window} / {unit}", f"Range over the windows / {unit}"]
    return table([Words("Quantity of the axis (± U, k = 2)"), *columns], rows)


def _budget_table(shown: Iso230Window, unit: str) -> Table:
    """Return the budget: every input with its contributions, and the expanded uncertainty without and with the sampling."""
    side = shown.approach
    names: tuple[str, ...] = _BUDGETED
    titles = [name.replace("_", " ") for name in _BUDGETED]
    if side:
        names = tuple(f"{symbol}_{side}" for symbol in ONE_WAY_TERMS)
        titles = [f"{symbol}{ARROWS[side]}" for symbol in ONE_WAY_TERMS]
    rows: list[Row] = []
    without = [shown.u_without_sampling_um.get(name) for name in names]
    values = [getattr(getattr(shown, side), f"{symbol}_um") for symbol in ONE_WAY_TERMS] if side else []
    with_it = [value.u for value in values or (getattr(shown, f"{symbol}_um") for symbol in _BUDGETED)]
    # A thousandth of the largest uncertainty changes none of its digits.
    largest = max((u for u in with_it if u), default=0.0)
    least = 10.0 ** (math.floor(math.log10(largest)) - 3) if largest else 0.0
    for entry in shown.contributions:
        of_length = entry.unit == "um"
        u = (
            "–"
            if entry.u is None
            else f"{number(entry.u, 2, least=least * of_length)} {unit if of_length else entry.unit}"
        )
        found = (entry.unidirectional_um.get(name) if side else getattr(entry, f"{name}_um") for name in names)
        cause = CONTRIBUTORS.get(entry.contributor, entry.contributor)
        rows.append(Row([cause, u, entry.origin, *(number(value, 2, least=least) for value in found)]))
    for name, sums in (("U (k = 2) without the sampling of the cycles", without), ("U (k = 2)", with_it)):
        expanded = (number(None if u is None else 2 * u, 2) for u in sums)
        rows.append(Row([name, "", "", *expanded], marked=True))
    columns = [f"{title} / {unit}" for title in titles]
    return table([Words("Contribution"), "Standard uncertainty u", Words("u is"), *columns], rows)


# Model and anomalies in the report: steps, coefficients, errors, candidates, evidence, for the page and the
# application alike.

#: What the hold-out is for, and what it is not.
DECIDED_BEFORE = (
    "What enters is decided on the training part alone. The hold-out is opened once: it bears an effect out, contradicts it, or cannot "
    "tell, either statement being false with a probability of 0.05. What it contradicts leaves headline and forecast."
)


def errors_table(loop: Loop) -> Table:
    """Return the errors on the hold-out: of the model before and after, with what it expects of them, and of plain predictions."""
    named = [*model_errors(loop).items()]
    plain = [(words, getattr(loop.baselines, name)) for name, words in baseline_words(loop).items()]
    errors = alike([one.rmse_um for _, one in (*named, *plain)], distinct=False)
    expected = [say("expected_cell", one) or "–" for _, one in named] + ["–"] * len(plain)
    rows = [
        Row([name, error, told], marked=at < len(named))
        for at, ((name, _), error, told) in enumerate(zip((*named, *plain), errors, expected, strict=True))
    ]
    return table([Words("Prediction of what was held out"), "Error / µm", "Expected by the model / µm"], rows)


def steps_table(loop: Loop) -> Table:
    """Return the declared model and every effect that was added, with the errors before and after: held out, and blocks left out."""
    declared = join([effect_words(name).name for name in loop.declared]) or "nothing"
    errors = [error for step in loop.steps for error in (step.rmse_before_um, step.rmse_after_um)]
    numbers = alike([loop.rmse_declared_um, *errors])
    rows = [Row(["0", f"declared: {declared}", "–", numbers[0], "–", "", ""])]
    for turn, step in enumerate(loop.steps, start=1):
        held_out = " → ".join(numbers[2 * turn - 1 : 2 * turn + 1])
        rows.append(Row([str(turn), *_step_cells(step, held_out)], marked=True))
    titles = ("p", "Held out / µm", "Blocks / µm", Words("Borne out"), Words("Next best effect"))
    return table(["Step", Words("Effect"), *titles], rows)


def _step_cells(step: StepPart, held_out: str) -> list[str]:
    text = ", ".join(part for part in (say("height", step), parameters(step.parameters, step.parameter_ranges)) if part)
    return [
        f"{say('names', step)}{f': {text}' if text else ''}{f'; without a name: {step.withheld}' if step.withheld else ''}",
        p_cell(step.p_value),
        held_out,
        " → ".join(alike((step.cross_rmse_before_um, step.cross_rmse_after_um))),
        say("doubt", step) if step.doubt else "yes",
        _runner_up(step.runner_up),
    ]


def _runner_up(other: RunnerUp | Nothing) -> str:
    """Return the second best effect of a step and how far behind it is."""
    if isinstance(other, Nothing) or other.gain_deficit is None:
        return "none"
    name, size = effect_words(other.effect).name, number(abs(other.gain_deficit), 2)
    if other.gain_deficit < 0:
        return f"{name} (log-likelihood higher by {size}, but not confirmed)"
    return f"{name} (log-likelihood lower by {size})"


def describe_model(loop: AxisLoop) -> list[tuple[str, str]]:
    """Return the model in numbers: coefficients, unexplained drift, simplest prediction, and what was not tried."""
    on_condition = {name: say("warm_up_condition") for name in loop.warm_up_only}
    rows = [
        (effect_words(one.effect).name, _coefficient(one) + on_condition.get(one.effect, ""))
        for one in loop.declared_coefficients
    ]
    for step in loop.steps:
        name = effect_words(step.effect).name
        named = zip(coefficient_names(step), step.coefficients, strict=True)
        rows += [(f"{name}: {what}" if what else name, _coefficient(coefficient)) for what, coefficient in named]
    left = loop.residual_drift
    common, stretch = small(left.common_rms_um), small(left.stretch_rms_um)
    size = f"{common} µm rms common to all positions, {stretch} µm rms of stretch along the axis"
    if loop.wandering_um is not None:
        size += f"; together {small(loop.wandering_um)} µm rms at its far end"
    rows.append(("random drift beside the effects", f"{left.kind}: {size}"))
    return rows + refused_effects(loop)


def coefficient_names(step: AxisStep) -> list[str]:
    """Return what each coefficient of an added effect is the size of, empty for one that stands alone."""
    count = len(step.coefficients)
    shape = str(step.parameters.get("shape", ""))
    stretch = "stretch at the far end"
    shapes = {"flat": ["shift"], "flat and linear": ["shift", stretch]}.get(shape, [stretch])
    if step.effect == "unseen_heat_source" and count in (len(shapes), 2 * len(shapes)):
        start = [f"remainder of the time before the start, {name}" for name in shapes] if count > len(shapes) else []
        return [f"{name} at full load" for name in shapes] + start
    if step.effect == "periodic_disturbance" and count == 2:
        return ["sine part", "cosine part"]
    if count == len(shapes) and count > 1:
        return shapes
    return [""] if count == 1 else [f"coefficient {k}" for k in range(1, count + 1)]


def refused_effects(loop: Loop) -> list[tuple[str, str]]:
    """Return the effects that were not tried or not admitted, with the reason."""
    titled = (("not tried", loop.not_tried), ("not admitted", loop.not_admitted))
    rows = [(title, name, reason) for title, reasons in titled for name, reason in reasons.items()]
    unnamed = {name: f"{p_words(p)}; " for name, p in loop.unconfirmed_effects.items()}
    return [(f"{title}: {effect_words(name).name}", unnamed.get(name, "") + reason) for title, name, reason in rows]


def _coefficient(coefficient: Coefficient) -> str:
    unit = print_unit(coefficient.unit)
    text = measured(coefficient.value, coefficient.u, unit)
    if coefficient.u_scale is not None:
        fit, scale = number(2 * (coefficient.u_fit or 0.0), 2), number(2 * coefficient.u_scale, 2)
        text += f", of which the fit ± {fit} and the scale of the rise ± {scale}"
    if coefficient.u_line is not None:
        text += f", the choice of the line on the plan ± {number(2 * coefficient.u_line, 2)}"
    if coefficient.prior is not None:
        text += f" (prior {measured(coefficient.prior, coefficient.prior_u, unit)})"
    return text


def describe_candidates(loop: AxisLoop) -> Table:
    """Return the best candidate of every effect in every round of the search with its scores."""
    rows = []
    for turn, score in ((turn, score) for turn, scores in enumerate(loop.search, start=1) for score in scores):
        of_search = (gain(score.gain), gain(score.excess_gain), p_cell(score.family_wise_p))
        held_out = (gain(score.held_out_gain), p_cell(score.held_out_p))
        rows.append([str(turn), effect_words(score.effect).name, parameters(score.parameters), *of_search, *held_out])
    titles = ("Gain", "Gain beyond chance", "p (search)", "Held-out gain", "p (held out)")
    return table(["Round", Words("Effect"), Words("Best parameters"), *titles], rows)


def describe_anomaly(anomaly: AnomalyPart) -> dict[str, Any]:
    """Return what a position that stands out shows: size, sentences for and against, what to inspect, and all numbers."""
    evidence = anomaly.evidence
    return {
        "title": f"{upper_first(anomaly_place(anomaly))}: {anomaly_cause(anomaly)}",
        "kind": evidence.kind,
        "sentence": say("anomaly_sentence", anomaly),
        "stands_out": say("stands_out", evidence),
        "support": evidence.support,
        "against": evidence.against,
        "check": evidence.check,
        "numbers": [
            (EVIDENCE[name], "excluded" if value is None and name.startswith("probability") else in_words(value))
            for name, value in evidence.numbers().items()
        ],
    }


class Section(NamedTuple):
    """A section of the report: its anchor, title in the contents, template, the fact without which it is absent, and what it rests on.

    One of the appendix opens on a click on the line `opens`.
    """

    at: str
    title: str
    template: str
    there: str = ""
    rests_on: Figures | None = None
    opens: str = ""


#: First what a reader acts on, then in the appendix what it rests on.
SECTIONS = (
    Section("next", "What to do", "next.j2"),
    Section("pictures", "Pictures", "thermograms.j2", "thermograms"),
    Section("record", "Record", "record.j2", "record"),
    Section("iso230", "ISO 230-2", "iso230.j2", "iso230", "positions"),
    Section("iso230-3", "ISO 230-3", "iso230_3.j2", "thermal_tests", "positions"),
    Section("drift", "Drift", "drift.j2", "positions", "positions"),
    Section("anomalies", "Positions", "anomalies.j2", "anomalies", "positions"),
    Section("fields", "Heat", "fields.j2", "camera", "field"),
    Section("sensors", "Contact sensors", "sensors.j2", "sensors"),
    Section("cause", "Cause", "cause.j2", "loop", "causes"),
    Section("loop", "Cause", "record_loop.j2", "record", "causes"),
    Section("chained", "Forward chaining", "record_chained.j2", "record"),
    Section("place", "Place", "place.j2", "correlation", "attribution"),
    Section("data", "Data", "data.j2"),
    Section("uncertainty", "Uncertainty", "uncertainty.j2", opens="Uncertainty: what every ± and p rests on"),
    Section("paper", "Neighbour differences", "neighbours.j2", "comparison", "positions", opens="Neighbour differences"),
    Section(
        "correlation", "Drift and field", "correlation.j2", "correlation", "attribution",
        opens="Drift and field: modes, regions, maps of cells, contact sensors",
    ),
    Section(
        "loop", "Model", "loop.j2", "loop", "causes", opens="Model: tests of the residual, detection limits, every candidate"
    ),
    Section(
        "registration", "Registration", "registration.j2", "registration", opens="Registration of the thermograms to the table"
    ),
    Section("glossary", "Glossary", "glossary.j2", opens="Glossary"),
    Section("provenance", "Provenance", "provenance.j2"),
)  # fmt: skip
_SIGNS = {"positive": "+", "negative": "−"}
#: Largest number of channels of a record with charts; all of them are in fusion.nc.
_MOST_CHANNELS = 6
_ERRORS = ("rmse_persistence_um", "rmse_declared_um", "rmse_final_um")
#: Actions in the summary; all remedies stand with what was left out.
MOST_STEPS = 6


def _in_language(language: str, first: Mapping[str, Any], tiles: Sequence[Tile]) -> dict[str, Any]:
    """Return the first screen in a language, with what translates its headings."""
    tell = translation(language)
    words = {
        "open": tell(first["open"]),
        "answers": {tell(name): tell(text) for name, text in first["answers"].items()},
        "next": [*map(tell, first["next"])],
    }
    shown = [Tile(*map(tell, one)) for one in tiles]
    return {"language": language, "tell": tell, "first_screen": {**first, **words}, "tiles": shown}


def describe_campaign(
    results: Results, provenance: Mapping[str, Any], datasets: Mapping[str, Any], joint: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return the facts of a campaign or a record that the templates of its report state."""
    deviations, fields, fused = (datasets.get(name) for name in ("deviations", "fields", "fusion"))
    figures = figures_of(results)
    doubts = results.inputs.doubts if results.inputs else ()
    stated = provenance["parameters"]
    axis = stated["campaign"].get("axis", "") if deviations is not None else ""
    zone = results.time.zone if results.time else None
    parts = {
        "laser": None if deviations is None else _laser(deviations),
        "camera": None if fields is None else _camera(fields),
        "record": _record(results, datasets["record"]) if "record" in datasets else None,
    }
    begun = [part["first"] for part in parts.values() if part and part["first"] is not None]
    begun += [one.first for one in (results.thermograms.cameras if results.thermograms else ()) if one.first]
    facts = {
        **parts,
        "zone": zone,
        "figures": figures,
        "verdict": results.loop.verdict if results.loop else "",
        "headline": headline(results),
        # What a camera that measures alone shows beyond its range is counted with its temperatures.
        "doubts": [one for one in doubts if results.thermograms is None or one.code != "camera_range"],
        "unverified": results.inputs.unverified if results.inputs else (),
        "untouched": untouched(results.inputs, figures),
        "assumptions": {one.at: assumption(results.inputs, one.rests_on) for one in SECTIONS if one.rests_on},
        **_in_language(
            (stated.get("sheet") or {}).get("language", "en"),
            first_screen(results, stated.get("report", {}), axis, moment(begun[0], zone) if begun else ""),
            [one.tile for one in findings(results) if one.tile],
        ),
        "next": next_steps(results)[:MOST_STEPS],
        "thermograms": describe_thermograms(results, datasets["thermograms"]) if "thermograms" in datasets else None,
        "drift_stated": (stated.get("thermography") or {}).get("camera_drift_u_K") is not None,
        "field_of": "cycle" if "positions" in figures else "window",
        "positions": None if results.drift is None or deviations is None else _positions_table(deviations),
        "comparison": None if results.neighbours is None or deviations is None else _comparison_table(deviations),
        "iso230": None if results.iso230 is None else describe_iso230(results.iso230, deviations),
        "thermal_tests": describe_thermal_tests(results.iso230_3) if results.iso230_3 else None,
        "anomalies": None if results.anomalies is None else [describe_anomaly(one) for one in results.anomalies],
        "sensors": results.sensors or None,
        "registration": results.registration,
        "correlation": None if fused is None else describe_correlation(fused, results, joint),
        "joint": joint,
        # The tables on the model that the application shows too.
        "loop": {
            "steps": steps_table(results.loop),
            "errors": errors_table(results.loop),
            "model": describe_model(results.loop),
            "candidates": describe_candidates(results.loop),
        }
        if isinstance(results.loop, AxisLoop)
        else None,
        "decided_before": DECIDED_BEFORE,
        "levels": levels,
    }
    return {**facts, "sections": [one for one in SECTIONS if not one.there or facts[one.there] is not None]}


def _record(results: Results, record: xr.Dataset) -> dict[str, Any]:
    """What a record holds and how its model predicts it; `first` is None where the campaign file does not state the beginning."""
    loop = results.loop
    assert isinstance(loop, RecordLoop)
    first, last = record["time"].values[[0, -1]]
    block_s = float(record.attrs["block_s"])
    span = duration(float((last - first) / np.timedelta64(1, "s")) + block_s)
    start = first if first >= DATED else None
    begun = "start not stated" if start is None else moment(start, results.time.zone if results.time else None)
    channels, drivers = (join([str(name) for name in record[dim].values]) for dim in ("channel", "driver_name"))
    shown = shown_channels(record)
    tested = results.iso230_3[0].distortions if results.iso230_3 else ()
    return {
        "first": start,
        "measured": (
            f"{counted(record.sizes['channel'], 'displacement')} and {counted(record.sizes['sensor'], 'temperature')} over "
            f"{_measured_time(loop, span)}" + (f", with {drivers} as driver" if drivers else "")
        ),
        "data": [
            ("Channels", channels),
            ("Sensors", join([str(name) for name in record["sensor"].values])),
            ("Time", f"{begun}, {span}; averaged over {record.sizes['time']} blocks of {duration(block_s)}"),
        ],
        "shown": list(enumerate(shown)),
        "moved": max(
            (one for one in tested if one.name in shown), key=lambda one: one.whole.value or 0.0, default=None
        ),
        "omitted": record.sizes["channel"] - len(shown),
        "faults": [(one, describe_fault(one)) for one in loop.sensor_faults],
        "steps": steps_table(loop),
        "errors": errors_table(loop),
        "refused": refused_effects(loop),
        "chained_means": [_mean_chained(loop, name) for name in _ERRORS],
    }


def shown_channels(record: xr.Dataset) -> list[str]:
    """Return the channels that get charts."""
    return [str(name) for name in record["channel"].values[:_MOST_CHANNELS]]


def _mean_chained(loop: RecordLoop, name: str) -> float | None:
    """Return an error, mean over the forward-chained parts, um."""
    values = [getattr(part, name) for part in loop.chained if getattr(part, name) is not None]
    return float(np.mean(values)) if values else None


def _measured_time(loop: RecordLoop, span: str) -> str:
    """Return how long was measured; of several runs without the time between them."""
    hours = [run.duration_h for run in loop.runs if run.duration_h is not None]
    if not hours or len(hours) < len(loop.runs):
        return span
    return f"{duration(3600.0 * sum(hours))} in {counted(len(hours), 'run')}"


def _laser(deviations: xr.Dataset) -> dict[str, Any]:
    """What the laser measured; first and last are None where the readings have no times."""
    read = deviations["deviation"].notnull().any(("cycle", "target"))
    first, last = (None, None) if np.isnat(deviations["time"].values).all() else time_span(deviations)
    return {
        "readings": int(np.isfinite(deviations["deviation"]).sum()),
        "possible": deviations["deviation"].size,
        "origin": deviations["time"].attrs.get("origin", "recorded"),
        "positions": deviations.sizes["target"],
        "travel": float(np.ptp(deviations["position"].values)),
        "unit": print_unit(str(deviations["position"].attrs["units"])),
        "cycles": deviations.sizes["cycle"],
        "approaches": [str(name) for name in read["direction"].values[read.values]],
        "first": first,
        "last": last,
        "duration_s": None if first is None else float((last - first) / np.timedelta64(1, "s")),
    }


def _camera(fields: xr.Dataset) -> dict[str, Any]:
    """What the camera measured; rises are those of the last cycle, K."""
    first, last = fields["time"].values[[0, -1]]
    rise = fields["temperature_rise"].isel(cycle=-1)
    names = ("name", "residual", "leave_one_out")
    return {
        "frames": int(fields["frame_count"].sum()) if "frame_count" in fields else fields.sizes["time"],
        "fields": fields.sizes["cycle"],
        "first": first,
        "last": last,
        "duration_s": float((last - first) / np.timedelta64(1, "s")),
        "cells": (fields.sizes["x"], fields.sizes["y"]),
        "cell_size": float(np.median(np.diff(fields["x"]))),
        "visible": float(np.isfinite(rise).mean()),
        "fiducials": list(zip(*(fields[f"fiducial_{name}"].values.tolist() for name in names), strict=True)),
    }


def _positions_table(deviations: xr.Dataset) -> Table:
    """Return profile, scatter and conventional standard deviation of every position and approach."""
    drift, conventional = group(deviations, "estimate"), group(deviations, "conventional")
    decimals = {name: decimals_of(float(drift[f"{name}_u"].median())) for name in ("profile", "scatter")}
    targets = deviations["target"].values
    laid = {name: by_approach(drift[name], target=targets) for key in decimals for name in (key, f"{key}_u")}
    s = by_approach(conventional["standard_deviation"], target=targets)
    rows = []
    for at, (target, position_mm) in enumerate(zip(targets, deviations["position"].values, strict=True)):
        row = [str(target), exact(position_mm)]
        for name, places in decimals.items():
            both = zip(laid[name][at], laid[f"{name}_u"][at], strict=True)
            row += [measured(float(value), float(u), decimals=places) for value, u in both]
        rows.append([*row, *(fixed(value, decimals["scatter"]) for value in s[at])])
    quantities = ("Profile", "Scatter s", "Conventional s")
    return table(
        ["Target", "Position / mm", *(f"{name} {sign} / µm" for name in quantities for sign in _SIGNS.values())], rows
    )


def _comparison_table(deviations: xr.Dataset) -> Table:
    """Return conventional, differenced, their ratio and the joint estimate's own standard deviation, per position and approach."""
    comparison = group(deviations, "comparison")
    headings = {
        "conventional": "Conventional s {} / µm",
        "differenced": "Of differences s {} / µm",
        "ratio": "Ratio {}",
        "joint": "Joint estimate s {} / µm",
    }
    columns = [name for name in headings if name in comparison]
    links = comparison["link"].values
    values = np.stack([by_approach(comparison[name], link=links) for name in columns], axis=-1)
    # Two digits of a typical standard deviation, and two decimals at least.
    places = max(2, decimals_of(float(comparison["conventional"].median()) / 2.0))
    shown = [2 if name == "ratio" else places for name in columns]
    rows = [[str(link), *map(fixed, of_link.ravel(), 2 * shown)] for link, of_link in zip(links, values, strict=True)]
    return table(["Target", *(headings[name].format(sign) for sign in _SIGNS.values() for name in columns)], rows)


def rate_text(rate: float) -> str:
    """Return a measured rate of false alarms in per cent with its expanded uncertainty (k = 2)."""
    u = np.sqrt(max(rate, 1.0 / levels.CHECKS) * (1.0 - rate) / levels.CHECKS)
    return f"{100 * rate:.1f} ± {200 * u:.1f} %"


# A test by ISO 230-3 as report, page and terminal show it.

_PERIODS = ("first_hour", "whole", "last_hour", "change")
_TITLES = ("first 60 min", "whole test", "last 60 min", "last − first")
_KINDS = vocabulary("names")["thermal_tests"]

#: Curves of one chart of a test; the others are in the table.
DRAWN = 8


def describe_thermal_tests(tests: Sequence[ThermalTest]) -> list[dict[str, Any]]:
    """Return what the templates state of every test."""
    return [
        {
            "title": f"{_KINDS[test.kind]}{', run ' + test.run if test.run else ''}, {number(test.duration_h)} h",
            "distortions": _distortions(test.distortions, "Displacement or tilt"),
            "temperatures": _distortions(test.temperatures, "Temperature") if test.temperatures else None,
            "budget": _budget(test),
            "remarks": test.remarks,
            "drawn": DRAWN,
        }
        for test in tests
    ]


def _budget(test: ThermalTest) -> Table:
    units = {one.name: print_unit(one.unit) for one in test.distortions}
    rows = [
        [
            one.name,
            one.source,
            "–" if one.u is None else f"{small(one.u)} {units.get(one.name, '')}".strip(),
            one.origin,
        ]
        for one in test.contributions
    ]
    return table([Words("Quantity"), Words("Source"), "u (k = 1)", Words("Origin")], rows)


def _distortions(found: Sequence[ThermalDistortion], title: str) -> Table:
    rows = [
        [
            one.name,
            print_unit(one.unit),
            *(quantity(getattr(one, period)) for period in _PERIODS),
            "–" if one.settling_min is None else number(one.settling_min, 3),
        ]
        for one in found
    ]
    return table([Words(title), Words("Unit"), *_TITLES, "settled after / min"], rows)


def thermal_test_tables(tests: Sequence[ThermalTest], *, title: str) -> list[rich.table.Table]:
    """Return the tables of tests for the terminal."""
    return [
        print_table(shown, f"{title}, {described['title']}" if name == "distortions" else name)
        for described in describe_thermal_tests(tests)
        for name in ("distortions", "temperatures", "budget")
        if (shown := described[name]) is not None
    ]


def verification_table(verdicts: Sequence[ChannelVerdict]) -> Table:
    """Return what was predicted and achieved."""
    rows = [
        [
            one.name,
            "–" if one.before_um is None else number(one.before_um),
            f"{number(one.predicted_um)} [{number(one.predicted_low_um)} to {number(one.predicted_high_um)}]",
            number(one.achieved_um),
            measured(one.gain, one.gain_u),
            one.fault or "as predicted",
        ]
        for one in verdicts
    ]
    titles = ["without / µm", "predicted [95 %] / µm", "achieved / µm", "gain (k = 2)"]
    return table([Words("Displacement"), *titles, Words("Verdict")], rows)


# A camera that measures alone: tables of regions, cameras and pictures, and the visible-light picture.

#: Pictures that a table lists, and regions that it has columns for; thermograms.csv holds all.
_MOST_PICTURES, _MOST_REGIONS = 200, 6
_WHOLE = "whole picture"


def describe_thermograms(results: Results, thermograms: xr.Dataset) -> dict[str, Any]:
    """Return the facts on the pictures that the templates state."""
    part, regions = results.thermograms, results.regions or ()
    zone = results.time.zone if results.time else None
    shown = {
        "part": part,
        "lines": sum(one.kind == "line" for one in regions),
        "pictures": _table_of_pictures(thermograms, zone),
        "count": thermograms.sizes["time"],
        "hottest": thermograms.attrs["hottest"],
        "marked": bool(thermograms["flag"].any()),
    }
    if part is None:
        return {**shown, "of_series": table_of_regions(regions), "every": None, "visible": ""}
    beyond = [one for one in regions if one.name == _WHOLE and (one.overrange_pictures or one.underrange_pictures)]
    own = [one for one in regions if one.camera == part.series]
    return {
        **shown,
        "of_series": table_of_regions(own) if part.series else table_of_cameras(results),
        "every": None if part.series and len(part.cameras) == 1 else table_of_regions(regions, with_camera=True),
        "beyond": [say("beyond_range", one, part) for one in beyond],
        "visible": _jpeg(thermograms["visible"].values) if "visible" in thermograms else "",
        "seconds": _seconds(thermograms, part.series),
    }


def table_of_regions(regions: Sequence[TemperatureRegionPart], *, with_camera: bool = False) -> Table:
    """Return highest, lowest and mean temperature of regions."""
    titles = [Words("Region"), "Highest / °C", Words("at"), "Lowest / °C", Words("at"), "Mean / °C"]
    rows = [
        Row(
            [
                *([one.camera] if with_camera else []),
                one.name,
                _bounded(one.maximum_degC, ">" if one.overrange_pictures else ""),
                _where(one.maximum_at),
                _bounded(one.minimum_degC, "<" if one.underrange_pictures else ""),
                _where(one.minimum_at),
                _quantity(one.mean_degC),
            ],
            marked=one.name == _WHOLE,
        )
        for one in regions
    ]
    return table([*([Words("Camera")] if with_camera else []), *titles], rows)


def table_of_cameras(results: Results) -> Table:
    """Return what each camera of a mixed folder took."""
    assert results.thermograms is not None
    whole = {one.camera: one for one in results.regions or () if one.name == _WHOLE}
    rows = []
    for camera in results.thermograms.cameras:
        one = whole[camera.name]
        days = list(dict.fromkeys(time[:10] for time in (camera.first, camera.last) if time))
        highest = _bounded(one.maximum_degC, ">" if one.overrange_pictures else "")
        lowest = _bounded(one.minimum_degC, "<" if one.underrange_pictures else "")
        rows.append(
            [camera.name, str(camera.pictures), " to ".join(days) or "–", highest, lowest, _quantity(one.mean_degC)]
        )
    return table([Words("Camera"), "Pictures", Words("Taken"), "Highest / °C", "Lowest / °C", "Mean / °C"], rows)


def _quantity(found: Quantity) -> str:
    return measured(found.value, found.u)


def _bounded(found: Quantity, sign: str) -> str:
    return f"{sign} {fixed(found.value, 1)}" if sign else _quantity(found)


def _where(at: PicturePlace) -> str:
    frame = f" #{at.frame}" if at.frame else ""
    return f"{at.column_px}, {at.row_px} px in {at.file}{frame}"


def _table_of_pictures(thermograms: xr.Dataset, zone: str | None) -> Table:
    """Return maximum, minimum and mean of the whole picture, and the maximum of every region, picture by picture."""
    count = thermograms.sizes["time"]
    chosen = np.unique(np.linspace(0, count - 1, _MOST_PICTURES).round().astype(int))
    shown = thermograms.isel(time=chosen)
    whole, regions = shown.sel(region=_WHOLE), [str(name) for name in shown["region"].values[1 : 1 + _MOST_REGIONS]]
    columns = [whole[name].values for name in ("maximum", "minimum", "mean")]
    columns += [shown["maximum"].sel(region=name).values for name in regions]
    over = {0: whole["overrange"].values > 0}
    over |= {at: shown["overrange"].sel(region=name).values > 0 for at, name in enumerate(regions, start=3)}
    under = whole["underrange"].values > 0
    files, frames = shown["source"].values, shown["frame"].values
    several = len(set(files)) < len(files)
    rows = []
    for at, time in enumerate(shown["time"].values):
        values = [fixed(float(values[at]), 1) for values in columns]
        for place, beyond in over.items():
            values[place] = f"> {values[place]}" if beyond[at] else values[place]
        values[1] = f"< {values[1]}" if under[at] else values[1]
        picture = f"{files[at]} #{frames[at]}" if several else str(files[at])
        rows.append([picture, moment(time, zone, seconds=True), *values])
    titles = [Words("Picture"), Words("Time"), *(f"{name} / °C" for name in ("Highest", "Lowest", "Mean", *regions))]
    return table(titles, rows)


def _jpeg(pixels: np.ndarray) -> str:
    """Return a picture as the address of an image in the page."""
    import cv2  # a report without a camera's pictures does without it

    encoded = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return f"data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def _seconds(thermograms: xr.Dataset, series: str) -> float:
    """Return the time from the first picture of the series to the last, s."""
    times = thermograms["time"].values[thermograms["camera"].values == series]
    return float((times[-1] - times[0]) / np.timedelta64(1, "s")) if times.size else float("nan")
