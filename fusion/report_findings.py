"""L5 - What the report says of correlation and model: verdicts in words, the table of all candidates, values as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from fusion import wording
from fusion.groups import group, has
from fusion.wording import duration, join, measured, number

_CORRELATION = {
    "attributable": "Parts of the field go with the drift more closely than chance and common warm-up allow.",
    "not attributable": "No part of the field goes with the drift more closely than chance allows.",
    "not separable": "These data cannot tell: the whole session is one warm-up, in which every temperature rises like every drift.",
}
_NUISANCE = {
    "kind": "its kind",
    "common_rms_um": "common part, rms / µm",
    "stretch_rms_um": "stretch at the far end, rms / µm",
}


def describe_correlation(fused: xr.Dataset) -> dict[str, Any] | None:
    """Return what the correlation of drift and field found, in words; None where it was not tested."""
    if not has(fused, "correlation"):
        return None
    maps = group(fused, "correlation")
    rows = [(f"Drift that is {channel}", _channel(maps.sel(channel=channel))) for channel in maps["channel"].values]
    rate = float(maps["false_alarm_rate"])
    rows.append(("Chance of a false find", f"{rate:.2f}, measured on data simulated without any link"))
    rows.append(("Excitation", str(fused.attrs.get("correlation_excitation", ""))))
    verdict = str(fused.attrs.get("correlation_verdict", ""))
    return {"headline": _CORRELATION.get(verdict, verdict), "rows": rows}


def _channel(maps: xr.Dataset) -> str:
    """Return the strongest cell of one channel, what would have been found, and the drift that nothing explains."""
    flat = maps.stack(cell=("y", "x"))
    best = flat.isel(cell=int(flat["p_value"].fillna(np.inf).argmin()))
    return (
        f"smallest p {wording.p_value(float(best['p_value']))} at x {float(best['x']):.0f} mm, y {float(best['y']):.0f} mm: "
        f"{measured(float(best['sensitivity']), float(best['sensitivity_u']), 'µm/K')}, lag {duration(float(best['lag']))}; "
        f"found with 80 % power from {number(float(best['detectable_sensitivity']), 2)} µm/K on; "
        f"drift that nothing explains {number(float(maps['unexplained_drift']), 2)} µm in one hour"
    )


def describe_model(loop: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the coefficients of the declared effects, the size of the unexplained drift, and what was not tried."""
    rows = []
    for one in loop.get("declared_coefficients", []):
        rows.append((wording.effect_name(one["effect"]), measured(one["value"], one["u"], one["unit"])))
    for step in loop["steps"]:
        for one in step.get("coefficients", []):
            rows.append((wording.effect_name(step["effect"]), measured(one["value"], one["u"], one["unit"])))
    nuisance = {_NUISANCE.get(name, spaced(name)): value for name, value in loop.get("nuisance", {}).items()}
    if nuisance:
        rows.append(
            ("drift that nobody explains", "; ".join(f"{name} {in_words(value)}" for name, value in nuisance.items()))
        )
    if "rmse_persistence_um" in loop:
        rows.append(("error of repeating the last value", f"{number(loop['rmse_persistence_um'], 3)} µm"))
    for title, reasons in (("not tried", loop.get("not_tried", {})), ("blocked", loop.get("blocked", {}))):
        for name, reason in reasons.items():
            rows.append((f"{title}: {wording.effect_name(name)}", reason))
    return rows


def describe_candidates(loop: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return every candidate of every round of the search with its scores; None where nothing was searched."""
    rows = []
    for turn, scores in enumerate(loop.get("search", []), start=1):
        for score in scores:
            rows.append(
                [
                    str(turn),
                    wording.effect_name(score["effect"]),
                    parameters(score["parameters"]),
                    number(score["gain"], 3),
                    number(score["excess_gain"], 3),
                    wording.p_value(score["family_wise_p"]),
                    number(score["held_out_gain"], 3),
                    wording.p_value(score["held_out_p"]),
                ]
            )
    columns = [
        "Round",
        "Candidate",
        "Best parameters",
        "Gain",
        "Gain beyond chance",
        "p (search)",
        "Held-out gain",
        "p (held out)",
    ]
    return {"columns": columns, "rows": rows} if rows else None


def parameters(values: Mapping[str, Any]) -> str:
    """Return parameters as ``name value, name value``."""
    return ", ".join(f"{spaced(name)} {in_words(value)}" for name, value in values.items())


def spaced(name: str) -> str:
    """Return a name of a key as words."""
    return name.replace("_", " ")


def in_words(value: Any) -> str:
    """Return a value of any kind for a table cell."""
    if isinstance(value, Mapping):
        if {"value", "u"} <= set(value):
            return measured(value["value"], value["u"], str(value.get("unit", "")))
        return parameters(value)
    if isinstance(value, Sequence) and not isinstance(value, str):
        return join([in_words(item) for item in value])
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return number(float(value), 3)
    return "–" if value is None else str(value)
