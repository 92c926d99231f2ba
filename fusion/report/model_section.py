"""What the report says of model and anomalies: the table of all candidates, evidence, values as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fusion.report import wording
from fusion.report.wording import duration, join, measured, number


def describe_model(loop: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the coefficients of the declared effects, the size of the unexplained drift, and what was not tried."""
    rows = []
    for one in loop.get("declared_coefficients", []):
        text = measured(one["value"], one["u"], print_unit(one["unit"]))
        if "prior" in one:
            text += f" (expected beforehand {measured(one['prior'], one['prior_u'], print_unit(one['unit']))})"
        rows.append((wording.effect_name(one["effect"]), text))
    for step in loop["steps"]:
        for one in step.get("coefficients", []):
            rows.append(
                (wording.effect_name(step["effect"]), measured(one["value"], one["u"], print_unit(one["unit"])))
            )
    if "nuisance" in loop:
        left = loop["nuisance"]
        text = (
            f"{left['kind']}; rms {_small(left['common_rms_um'])} µm common to all positions, "
            f"{_small(left['stretch_rms_um'])} µm of stretch along the axis"
        )
        rows.append(("drift that nobody explains", text))
    if "rmse_persistence_um" in loop:
        rows.append(("error of repeating the last value", f"{number(loop['rmse_persistence_um'], 3)} µm"))
    if loop.get("sealed_question"):
        rows.append(("asked of the sealed cycles", _question(loop["sealed_question"])))
    for title, reasons in (("not tried", loop.get("not_tried", {})), ("blocked", loop.get("blocked", {}))):
        for name, reason in reasons.items():
            rows.append((f"{title}: {wording.effect_name(name)}", reason))
    return rows


def _question(asked: Mapping[str, Any]) -> str:
    """The one question to the sealed cycles and its answer."""
    answer = "it entered" if asked["entered"] else "it did not enter"
    return (
        f"{wording.effect_name(asked['effect'])}: error {number(asked['rmse_before_um'], 3)} µm without it and "
        f"{number(asked['rmse_after_um'], 3)} µm with it, predicted from before the seal; p {wording.p_value(asked['p_value'])}; {answer}"
    )


def describe_identifiability(loop: Mapping[str, Any]) -> list[list[str]]:
    """Return one row per effect: how large it must be to be found, how much of it is visible, what it looks like."""
    rows = []
    for one in loop.get("identifiability", []):
        found = one["detectable_um"] is not None
        alike = join([wording.effect_name(name) for name in one["looks_like"]]) or "–"
        rows.append(
            [
                wording.effect_name(one["effect"]),
                number(one["detectable_um"], 2) if found else "never",
                f"{number(one['best_um'], 2)} to {number(one['worst_um'], 2)}" if found else "–",
                f"{100 * one['visible_share']:.0f} %",
                alike,
                one["note"],
            ]
        )
    return rows


def _small(value: float) -> str:
    """Return a size in um, values below a nanometre as such."""
    return "below 0.001" if value < 1e-3 else number(value, 2)


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
                    f"{score['gain']:.1f}".replace("-", "−"),
                    f"{score['excess_gain']:.1f}".replace("-", "−"),
                    wording.p_value(score["family_wise_p"]),
                    f"{score['held_out_gain']:.1f}".replace("-", "−"),
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


#: Shapes of a residual in the order they are told: key in results.json, words, and what says where it is.
_SHAPES = (
    ("memory", "memory from reading to reading"),
    ("event", "a shift at one instant"),
    ("rhythm", "a rhythm"),
    ("curvature", "curvature along the axis"),
    ("one place", "one position by itself"),
    ("direction", "difference of the approaches"),
    ("direction along the axis", "difference of the approaches that grows along the axis"),
    ("pattern", "any pattern of positions"),
    ("slow pattern", "any slow pattern of positions"),
)


def describe_residual(loop: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return every shape of the residual with its p-value, or its size, for the declared and the final model."""
    tests = loop.get("residual_tests")
    if not tests:
        return []
    declared, final = tests["declared"], tests["final"]
    rows = [(words, _chance(declared, name), _chance(final, name)) for name, words in _SHAPES]
    for name, words in (("drift_common_um", "shift of all positions"), ("drift_stretch_um", "stretch of the axis")):
        rows.append((words, f"{_small(declared[name])} µm rms", f"{_small(final[name])} µm rms"))
    return rows


def _chance(tests: Mapping[str, Any], name: str) -> str:
    """Return p, and where the shape is: the instant of an event, the period of a rhythm."""
    whose = " (that of the cycles)" if tests["period_is_cycle"] else ""
    place = {
        "event": f", {duration(tests['event_s'])} from the start",
        "rhythm": f", {number(tests['period_min'], 2)} min{whose}",
    }
    return f"p {wording.p_value(tests['p_values'][name])}{place.get(name, '')}"


def runner_up(found: Mapping[str, Any]) -> str:
    """Return the second best effect of a step and how far behind it is."""
    if not found:
        return "none"
    name, behind = wording.effect_name(found["effect"]), float(found["behind_by"])
    if behind < 0:
        return f"{name}, {number(-behind, 2)} more in log-likelihood but not confirmed"
    return f"{name}, {number(behind, 2)} less in log-likelihood"


def print_unit(unit: str) -> str:
    """Return a unit as it is printed."""
    return unit.replace("um", "µm")


def parameters(values: Mapping[str, Any]) -> str:
    """Return parameters as ``name value, name value``."""
    return ", ".join(f"{spaced(name)} {in_words(value)}" for name, value in values.items())


def step_parameters(loop: Mapping[str, Any]) -> list[str]:
    """Return the parameters of every step of the loop, each with what fits as well."""
    return [parameters_with_ranges(step["parameters"], step.get("parameter_ranges", {})) for step in loop["steps"]]


def parameters_with_ranges(values: Mapping[str, Any], ranges: Mapping[str, Any]) -> str:
    """Return parameters, each with what fits as well: ``time constant / min 39.6 (29 to 56), follows duty (or warm up)``."""
    return ", ".join(
        f"{spaced(name)} {in_words(value)}{_as_well(ranges[name]) if name in ranges else ''}"
        for name, value in values.items()
    )


def _as_well(found: Sequence[Any]) -> str:
    if all(isinstance(word, str) for word in found):
        return f" (or {join([readable(word) for word in found])})"
    low, high = (None if value is None else number(float(value), 3) for value in found)
    if low is None and high is None:
        return " (not determined)"
    return f" (at most {high})" if low is None else f" (at least {low})" if high is None else f" ({low} to {high})"


_UNITS = {
    "_um_per_K": " / (µm/K)",
    "_um": " / µm",
    "_nats": " / nats",
    "_min": " / min",
    "_mm": " / mm",
    "_s": " / s",
    "_K": " / K",
}


def spaced(name: str) -> str:
    """Return the name of a key as words, a unit at its end set off: ``"time_constant_min"`` -> ``"time constant / min"``."""
    for ending, unit in _UNITS.items():
        if name.endswith(ending):
            return name.removesuffix(ending).replace("_", " ") + unit
    return name.replace("_", " ")


#: Kind of an anomaly -> what `extra_um` is the size of.
_KINDS = {
    "scatter": "extra scatter",
    "slow": "slow motion beyond the other positions",
    "step": "a step",
    "periodic": "a periodic motion",
}


def evidence(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the evidence of an anomaly as sentences for and against, what to check, and the numbers behind them."""
    numbers = {name: value for name, value in found.items() if name not in {"for", "against", "check"}}
    return {
        "stands_out": f"{_KINDS.get(str(found.get('kind')), 'excess')} of {number(found.get('extra_um'), 2)} µm",
        "for": [readable(text) for text in found.get("for", [])],
        "against": [readable(text) for text in found.get("against", [])],
        "check": readable(found.get("check", "")),
        "numbers": [(spaced(name), in_words(value)) for name, value in numbers.items()],
    }


def readable(text: str) -> str:
    """Return a plain sentence with the signs of print: ± and µm, effect names without underscores."""
    return text.replace("+-", "±").replace(" um", " µm").replace("_", " ")


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
    return "–" if value is None else readable(str(value))
