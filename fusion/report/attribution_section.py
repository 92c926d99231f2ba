"""What the report says of drift and field: the verdict and what it is worth, the tables, and what would tell."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from fusion.attribution.family_wise import LEVEL
from fusion.attribution.leading_source import LeadingSource, find_source, recommend_measurement
from fusion.report.model_section import readable
from fusion.report.plots_attribution import CHANNELS, caption_of, rate_text
from fusion.report.wording import duration, join, measured, number, p_value

Row = list[str]
_SHORT = {"common": "common", "proportional": "growing", "reversal": "reversal", "joint": "common and growing"}


def describe_correlation(
    fused: xr.DataTree, results: Mapping[str, Any], joint: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """Return everything the section on drift and field says; None where it was not tested."""
    if "correlation" not in fused.children:
        return None
    maps = fused.children["correlation"]
    found = find_source(maps)
    duty = maps.children["duty"].to_dataset() if "duty" in maps.children else None
    captions = {"cells": caption_of(maps, found.channel)}
    if "modes" in maps.children:
        captions["modes"] = caption_of(maps, found.channel, "modes")
    return {
        "headline": _headline(found),
        "sentences": [*_sentences(found), *_beside(maps, found), _worth(found, joint, duty)],
        "tell": readable(recommend_measurement(maps, found)),
        "captions": captions,
        "channels": [_channel_row(maps, str(channel)) for channel in maps.coords["channel"].values],
        "modes": _candidate_rows(maps, "modes", "mode"),
        "regions": _candidate_rows(maps, "regions", "region"),
        "region": leading_region(maps) if "target_regions" in maps.children else "",
        "region_targets": _region_targets(maps) if "target_regions" in maps.children else "",
        "session": _session(maps),
        "duty": [] if duty is None else _duty_rows(duty),
        "sensors": _sensors(maps.children["sensors"].to_dataset(), found.verdict),
    }


def _headline(found: LeadingSource) -> str:
    if found.verdict == "not separable":
        return "These data cannot tell: the whole session is one warm-up, in which every temperature rises like every drift."
    if found.verdict == "not attributable":
        return f"No part of the field goes with the drift more closely than chance allows (smallest p {p_value(found.p_value)})."
    return (
        f"The drift goes with the temperature around x {found.x_mm:.0f} mm, y {found.y_mm:.0f} mm more closely than chance and common "
        f"warm-up allow (p = {p_value(found.p_value)})."
    )


def _sentences(found: LeadingSource) -> list[str]:
    """Size, lag and place of the leading candidate, and what cannot be told from it."""
    what = (
        "a cell"
        if found.kind == "cell"
        else f"{found.kind} {found.name}".replace("mode", "thermal mode").replace("region ", "")
    )
    behind = f"{duration(found.lag_s)} behind it" if found.lag_s > 0 else "without lag"
    size = measured(found.sensitivity_um_per_K, found.sensitivity_u_um_per_K, "µm/K")
    led = "Found in" if found.verdict == "attributable" else "Closest was"
    sentences = [f"{led} {what}, by {CHANNELS.get(found.channel, found.channel)}: {size} of its rise, {behind}."]
    if found.verdict == "attributable" and found.others_mm:
        places = [f"x {x:.0f} mm, y {y:.0f} mm" for x, y in found.others_mm[:4]]
        more = f" and {len(found.others_mm) - 4} more" if len(found.others_mm) > 4 else ""
        sentences.append(f"These data cannot tell it from {join(places)}{more}, which explain the drift as well.")
    return sentences


def _beside(maps: xr.DataTree, found: LeadingSource) -> list[str]:
    """Which other modes add to the leading one, and which pass but may only warm with it."""
    if found.verdict != "attributable" or found.kind != "mode":
        return []
    modes = maps.children["modes"].to_dataset()
    beside = modes["p_beside"].min("channel").fillna(1.0).values
    alone = modes["p_value"].min("channel").values
    named = [
        f"mode {mode} (x {float(x):.0f} mm, y {float(y):.0f} mm)"
        for mode, x, y in zip(modes["mode"].values, modes["at_x"].values, modes["at_y"].values, strict=True)
    ]
    others = modes["mode"].values.astype(str) != found.name
    adds, alike = others & (beside <= LEVEL), others & (beside > LEVEL) & (alone <= LEVEL)
    sentences = []
    if adds.any():
        sentences.append(
            f"With it taken as given, {join([named[k] for k in np.flatnonzero(adds)])} goes with what is left."
        )
    if alike.any():
        verb, adding = ("passes", "adds") if alike.sum() == 1 else ("pass", "add")
        sentences.append(
            f"By themselves {join([named[k] for k in np.flatnonzero(alike)])} {verb} too, but {adding} nothing to it: these places may "
            "only warm with it."
        )
    return sentences


def _worth(found: LeadingSource, joint: Mapping[str, Any] | None, duty: xr.Dataset | None) -> str:
    """Whether this is a cause: where two sessions agree, or where the duty was randomised."""
    causes = [] if duty is None else [str(name) for name in duty["source"].values[(duty["p_value"] <= LEVEL).values]]
    if causes:
        verb = "is a cause" if len(causes) == 1 else "are causes"
        return f"Loads were switched at random, which shows that {join(causes)} {verb} of drift (below)."
    if joint is not None and joint["causes"]:
        return f"It is a cause where {joint['other']} agrees: {join(joint['causes'])} (below)."
    if found.verdict != "attributable":
        return ""
    if joint is not None:
        return f"It is not a cause yet: {joint['other']} does not show the same."
    return (
        "It is not a cause yet: one session may wander alike by chance, and what warms together cannot be told apart."
    )


def _channel_row(maps: xr.DataTree, channel: str) -> Row:
    """Strongest cell of one channel, what would have been found, and the drift that nothing explains."""
    session = maps.to_dataset()
    chosen = session[["p_value", "sensitivity", "sensitivity_u", "lag", "detectable_sensitivity"]].sel(channel=channel)
    flat = chosen.stack(cell=("y", "x"))
    best = flat.isel(cell=int(np.argmin(flat["p_value"].fillna(np.inf).values)))
    return [
        _SHORT.get(channel, channel),
        p_value(float(best["p_value"])),
        f"{float(best['x']):.0f}, {float(best['y']):.0f}",
        measured(float(best["sensitivity"]), float(best["sensitivity_u"])),
        duration(float(best["lag"])),
        number(float(best["detectable_sensitivity"]), 2),
        number(float(session["unexplained_drift"].sel(channel=channel)), 2),
    ]


def _candidate_rows(maps: xr.DataTree, name: str, kind: str) -> dict[str, list[dict[str, Any]]]:
    """Modes or regions: the strongest part of the drift for each, and all parts, with p, sensitivity, lag, and what would be found."""
    if name not in maps.children:
        return {"strongest": [], "all": []}
    few = maps.children[name].to_dataset()
    ratio = (few["statistic"] / few["threshold"]).fillna(0.0)
    strongest, everything = [], []
    for at in range(few.sizes[kind]):
        one = few.isel({kind: at})
        rows = []
        for channel in map(str, few["channel"].values):
            part = one.sel(channel=channel)
            cells = [
                f"{kind} {one[kind].item()}" if kind == "mode" else str(one[kind].item()),
                f"{float(one['at_x']):.0f}, {float(one['at_y']):.0f}",
                _SHORT.get(channel, channel),
                p_value(float(part["p_value"])),
                measured(float(part["sensitivity"]), float(part["sensitivity_u"])),
                duration(float(part["lag"])),
                number(float(part["detectable_sensitivity"]), 2),
            ]
            if kind == "mode":
                cells.append(p_value(float(part["p_beside"])))
            rows.append({"cells": cells, "passed": bool(part["p_value"] <= LEVEL)})
        strongest.append(rows[int(ratio.isel({kind: at}).values.argmax())])
        everything += rows
    return {"strongest": strongest, "all": everything}


def leading_region(maps: xr.DataTree) -> str:
    """Return the region that explains the drift best."""
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
            named.append(
                f"{region}: {len(passed)} of {p.sizes['series']} ({join(passed[:6])}{', …' if len(passed) > 6 else ''})"
            )
    return "; ".join(named) or "none"


def _session(maps: xr.DataTree) -> list[tuple[str, str]]:
    """What holds for the whole test."""
    session, clusters = maps.to_dataset(), maps.children["clusters"].to_dataset()
    return [
        (
            "Chance of any false find",
            f"{rate_text(float(session['false_alarm_rate']))} over cells, modes and regions together",
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


def _duty_rows(duty: xr.Dataset) -> list[Row]:
    rows = []
    for name in map(str, duty["source"].values):
        one = duty.sel(source=name)
        first, second = float(one["time_constant"]), float(one["second_time_constant"])
        rows.append(
            [
                name,
                p_value(float(one["p_value"])),
                measured(float(one["sensitivity"]), float(one["sensitivity_u"])),
                duration(first) + (f" behind {duration(second)}" if second > 0 else ""),
                "a cause" if float(one["p_value"]) <= LEVEL else "not shown",
            ]
        )
    return rows


def _sensors(sensors: xr.Dataset, session: str) -> dict[str, Any]:
    """Contact sensors in place of the camera: how far the camera itself goes, and one row per number of sensors."""
    if "sensor" not in sensors.sizes or sensors.sizes["sensor"] == 0:
        return {"text": "The field did not change enough to place sensors.", "rows": []}
    gain, most = float(sensors["camera_gain"]), float(sensors["camera_gain_at_most"])
    within = duration(float(sensors["run_length"]))
    if bool(sensors["camera_decided"]):
        text = (
            f"Predicting cycles that it was not fitted to, the camera takes {number(gain, 2)} µm out of the drift "
            f"(at most {number(most, 2)} µm)."
        )
    else:
        text = (
            f"Undecided: on cycles that it was not fitted to, the camera itself is not shown to take anything out of the drift "
            f"(at most {number(most, 2)} µm), so a table of what sensors lose beside it says little."
        )
    if session == "not separable":
        text += " In a single warm-up many places do alike; which of them would do in another session these data cannot tell."
    rows: list[Row] = []
    least = np.inf
    for at in range(sensors.sizes["sensor"]):
        one = sensors.isel(sensor=at)
        verdict = "loses" if bool(one["decided"]) else "as good as the camera, as far as these data show"
        if float(one["loss"]) > least:
            verdict += "; no better than fewer"
        least = min(least, float(one["loss"]))
        rows.append(
            [
                str(at + 1),
                f"x {float(one['at_x']):.0f} mm, y {float(one['at_y']):.0f} mm",
                number(float(one["loss"]), 2),
                number(float(one["loss_at_most"]), 2),
                verdict,
            ]
        )
    return {
        "text": f"{text} Losses are root mean squares over all positions, within runs of {within} of left-out cycles.",
        "rows": rows,
    }
