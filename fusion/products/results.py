"""results.json: one document with every finding of a run, and the JSON Schema that describes it.

What one stage of the main job hands on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Generic

from fusion.products.store import Product

SCHEMA_VERSION = 1
CAUSES = ("structural", "local_temperature", "stick_slip", "step", "undetermined")
ATTRIBUTIONS = ("attributable", "not attributable", "not separable")
VERDICTS = ("complete", "explained", "partial", "unexplained")


@dataclass(frozen=True)
class Notice:
    """Something left out or doubtful: what, by how much it may move the result, and what to do about it.

    Parameters
    ----------
    code : str
        Short name, for programs.
    message : str
        One sentence with counts and names, for people.
    effect_um : float or None
        Size of the effect on the drift in um, None where it cannot be said.
    remedy : str
        What would remove the warning.
    """

    code: str
    message: str
    remedy: str
    effect_um: float | None = None


#: Parts of results.json that a run may add, besides schema, campaign and warnings.
PARTS = ("registration", "alignment", "iso230", "neighbours", "drift", "anomalies", "hotspots", "correlation", "loop")


def assemble(title: str, parts: Mapping[str, Any], warnings: Sequence[Notice]) -> dict[str, Any]:
    """Return the results document from what the stages found, in the order of the schema."""
    document: dict[str, Any] = {
        "schema": SCHEMA_VERSION,
        "campaign": title,
        "warnings": [asdict(item) for item in warnings],
    }
    document.update({name: parts[name] for name in PARTS if name in parts})
    return document


def _of(**properties: Any) -> dict[str, Any]:
    """An object whose properties are all required and that holds no others."""
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


def _at_least(**properties: Any) -> dict[str, Any]:
    """An object whose properties are all required and that may tell more."""
    return {"type": "object", "properties": properties, "required": list(properties)}


def _list(items: Any) -> dict[str, Any]:
    return {"type": "array", "items": items}


def _map(values: Any) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": values}


#: Most values of results.json; a number is null where the data do not determine it.
_TEXT: dict[str, Any] = {"type": "string"}
_NUMBER: dict[str, Any] = {"type": ["number", "null"]}


def _correlation_schema() -> dict[str, Any]:
    return _at_least(
        verdict={"enum": list(ATTRIBUTIONS)},
        excitation=_TEXT,
        false_alarm_rate=_NUMBER,
        source=_map({}),
        would_tell=_TEXT,
        unexplained_drift_um_per_h=_map(_NUMBER),
        modes=_list(_at_least(name=_TEXT, x_mm=_NUMBER, y_mm=_NUMBER, parts=_map({}))),
        regions=_list(_at_least(name=_TEXT, x_mm=_NUMBER, y_mm=_NUMBER, parts=_map({}))),
        sensors=_map({}),
        randomised_duty={
            "type": ["array", "null"],
            "items": _at_least(name=_TEXT, cause={"type": "boolean"}, p_value=_NUMBER),
        },
    )


def _loop_schema() -> dict[str, Any]:
    step = _at_least(
        effect=_TEXT,
        parameters=_map({}),
        p_value=_NUMBER,
        rmse_before_um=_NUMBER,
        rmse_after_um=_NUMBER,
        runner_up=_map({}),
    )
    return _at_least(
        declared=_list(_TEXT),
        held_out=_TEXT,
        noise_floor_um=_NUMBER,
        rmse_declared_um=_NUMBER,
        rmse_final_um=_NUMBER,
        steps=_list(step),
        verdict={"enum": list(VERDICTS)},
        unexplained=_at_least(shape=_TEXT, rms_um=_NUMBER),
    )


def results_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of results.json. A number is null where the data do not determine it."""
    text, number = _TEXT, _NUMBER
    measured = _of(value=number, u=number)
    by_direction = {
        "type": "object",
        "properties": {"positive": _list(number), "negative": _list(number)},
        "additionalProperties": False,
    }
    properties = {
        "schema": {"const": SCHEMA_VERSION},
        "campaign": text,
        "warnings": _list(_of(code=text, message=text, remedy=text, effect_um=number)),
        "registration": _of(rms_mm=number, leave_one_out_mm=_map(number), frames_rejected=_list(_map({}))),
        "alignment": _of(clock_offset_s=measured),
        "iso230": _of(window=text, B_um=measured, R_um=measured, E_um=measured, M_um=measured, A_um=measured),
        "neighbours": _of(conventional_s_um=by_direction, pair_s_um=by_direction, ratio=by_direction),
        "drift": _of(profile_um=by_direction, profile_u_um=by_direction, scatter_um=by_direction),
        "anomalies": _list(
            _of(
                target={"type": "integer", "minimum": 1},
                direction={"enum": ["positive", "negative", "both"]},
                p_value=number,
                scatter_um=number,
                cause={"enum": list(CAUSES)},
                evidence=_map({}),
            )
        ),
        "hotspots": _list(
            _of(
                x_mm=number,
                y_mm=number,
                peak_rise_K=number,
                targets=_list({"type": "integer"}),
                p_value=number,
                lag_s=number,
            )
        ),
        "correlation": _correlation_schema(),
        "loop": _loop_schema(),
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "thermofuse results",
        "type": "object",
        "properties": properties,
        "required": ["schema", "campaign", "warnings"],
        "additionalProperties": False,
    }


@dataclass(frozen=True)
class Outcome(Generic[Product]):
    """Result of a stage.

    Attributes
    ----------
    dataset : Dataset or DataTree
        What the stage writes as its product.
    parts : dict
        Its shares of results.json, by name.
    notices : tuple of Notice
        What it left out or doubts.
    """

    dataset: Product
    parts: dict[str, Any]
    notices: tuple[Notice, ...] = ()
