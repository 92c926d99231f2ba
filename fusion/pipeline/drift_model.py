"""The stage that models the drift: the closed loop, the camera's errors taken out, residual tests, positions that stand out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from fusion.alignment.align import align
from fusion.alignment.readings import Readings, read_fused
from fusion.campaign.sources import Inputs, LaserInputs, Source
from fusion.consistency.axis_line import compare_lines
from fusion.diagnosis.residual_tests import ResidualTests, examine_residual
from fusion.effects.effect import Effect, Prior
from fusion.effects.library import library
from fusion.effects.thermal import EXPANSION_U_PPM_PER_K
from fusion.loop.axis import close_loop, on_corrected_fields, set_aside_sites
from fusion.loop.camera_correction import FieldFault, correct_fields, corrected_variables, find_field_errors
from fusion.loop.result import LoopResult
from fusion.model.fit import ModelFit, fit_model
from fusion.pipeline.interferometry import utc
from fusion.pipeline.positions import judge_positions, sites_of
from fusion.pipeline.rise_scale import axis_scale_u, plan_scale_u, scale_coefficients, scale_evidence
from fusion.products import store
from fusion.products.grouped import joined
from fusion.products.notices import counted
from fusion.products.progress import Report
from fusion.products.results import Notice, Outcome

_READING = ("cycle", "direction", "target")
#: Predictions of the hold-out cycles whose errors are kept reading by reading, in words.
_PREDICTIONS = {
    "declared": "declared model",
    "final": "with the added effects",
    "last_value": "last value repeated",
}


@dataclass(frozen=True)
class CorrectedCamera:
    """Errors of the camera that the loop found, and both recordings aligned again on fields without them."""

    errors: list[FieldFault]
    fused: xr.Dataset


def model_drift(
    source: LaserInputs, fields: xr.Dataset | None, fused: xr.Dataset, deviations: xr.Dataset, *, report: Report
) -> Outcome:
    """Close the loop, then judge the positions that stand out from what the model explains.

    Where the camera erred, the fields are corrected and the model is fitted again to them.

    Parameters
    ----------
    source : the campaign as read
    fields : keeps ``thermography.contract.FIELDS``; None where there is no camera
    fused : readings with what was seen and logged, on one clock
    deviations : keeps ``interferometry.contract.DEVIATIONS``
    report : called with the stage, steps done and steps in total

    Returns
    -------
    Outcome
        Residuals, contributions and tests at every reading; the parts ``anomalies`` and ``loop`` of results.json; notices.
    """
    readings = read_fused(fused)
    effects = library_for(source)
    result = close_loop(
        readings,
        source.campaign.declared,
        effects=effects,
        progress=lambda done, total, what: report("closed loop", done, total),
    )
    corrected = None
    if isinstance(source, Source) and fields is not None:
        corrected = correct_camera(source, result, fields, fused, deviations)
    if corrected is not None:
        names = {error.effect for error in corrected.errors}
        result = on_corrected_fields(result, read_fused(corrected.fused), names, effects=effects)
    errors = [] if corrected is None else corrected.errors
    models = both_models(result)
    tests = {name: examine_residual(model, np.random.default_rng(1)) for name, model in models.items()}
    variables = loop_variables(fused, models, tests).assign(
        {**prediction_variables(fused, result), **correction_variables(corrected, fields, fused)}
    )
    report("anomalies", 0, 1)
    positions = judge_positions(fused, deviations, variables["contribution"].sum("effect", skipna=False))
    result = set_aside_sites(result, sites_of(positions, deviations.sizes["target"]))
    report("anomalies", 1, 1)
    anomalies, line = [position.as_json() for position in positions], None
    loop: dict[str, Any] = result.as_json()
    if isinstance(source, Source) and fields is not None:
        line = compare_lines(result.after, len(result.declared), correct_fields(fields, errors), source.axis)
        anomalies = [scale_evidence(one, source.axis, fields, deviations["position"]) for one in anomalies]
        axis_u = axis_scale_u(fields, source.axis, deviations["position"].values)
        loop = scale_coefficients(loop, effects, axis_u=axis_u, plan_u=plan_scale_u(fields))
    elif "axis_scale_u" in fused:
        scale_u = float(fused["axis_scale_u"])
        loop = scale_coefficients(loop, effects, axis_u=scale_u, plan_u=scale_u)
    parts = {
        "anomalies": [
            {**one, "position_mm": float(deviations["position"].sel(target=one["target"]))} for one in anomalies
        ],
        "loop": {
            **loop,
            "steps": with_event_times(loop["steps"], result, fused),
            "field_corrections": [error.as_json() for error in errors],
            "residual_tests": {name: examined.as_json() for name, examined in tests.items()},
            "axis_line": None if line is None else line.as_json(),
        },
    }
    return Outcome(variables, parts, (*gap_notices(readings), *field_notices(errors)))


def correct_camera(
    source: Source, result: LoopResult, fields: xr.Dataset, fused: xr.Dataset, deviations: xr.Dataset
) -> CorrectedCamera | None:
    """Take the camera's errors that entered the model out of the fields, and align both recordings again.

    Parameters
    ----------
    source, fields, fused, deviations : as for :func:`model_drift`
    result : of the loop on the fields as they came

    Returns
    -------
    CorrectedCamera or None
        None where the camera did not err.
    """
    errors = find_field_errors(result, fields, fused)
    if not errors:
        return None
    # Errors of reading that were left out stay out.
    used = deviations.assign(deviation=deviations["deviation"].where(fused["deviation"].notnull()))
    aligned = align(
        used,
        correct_fields(fields, errors),
        source.axis,
        environment=source.environment,
        drivers=source.drivers,
    )
    return CorrectedCamera(errors, aligned)


def both_models(result: LoopResult) -> dict[str, ModelFit]:
    """The declared and the final model, each fitted to all readings.

    The declared model is shown on the fields as they came, also where they were corrected afterwards.

    Parameters
    ----------
    result : of the loop
    """
    return {"declared": fit_model(result.before.readings, result.before.terms), "final": result.after}


def correction_variables(
    corrected: CorrectedCamera | None, fields: xr.Dataset | None, fused: xr.Dataset
) -> dict[str, xr.Variable | xr.DataArray]:
    """The correction of the fields and what it changes, for fusion.nc; empty where the camera did not err.

    Parameters
    ----------
    corrected : of :func:`correct_camera`
    fields, fused : before the correction
    """
    if corrected is None or fields is None:
        return {}
    names = ("mean_rise", "axis_integral", "local_rise")
    return {
        **corrected_variables(fields, fused, corrected.errors),
        **{f"{name}_corrected": corrected.fused[name] for name in names},
    }


def gap_notices(readings: Readings) -> list[Notice]:
    """Notices of gaps in the logged series, one for all that have the same gaps.

    Parameters
    ----------
    readings : with the series, which are interpolated linearly across gaps
    """
    notices = []
    gaps = readings.gaps()
    names_by_gaps: dict[tuple[tuple[float, float], ...], list[str]] = {}
    for name in dict.fromkeys(gap.series for gap in gaps):
        own = tuple((gap.start_s, gap.end_s) for gap in gaps if gap.series == name)
        names_by_gaps.setdefault(own, []).append(name)
    for own, names in names_by_gaps.items():
        # Columns of one log lack the same rows: one notice names them all.
        name, have = ", ".join(names), "has" if len(names) == 1 else "each have"
        minutes = sum(end_s - start_s for start_s, end_s in own) / 60.0
        first = own[0][0] / 60.0
        notices.append(
            Notice(
                "series_gap",
                f"{name} {have} {counted(len(own), 'gap')}, {minutes:.0f} min together, the first {first:.0f} min after the first reading; "
                "taken as a straight line there, so that an effect that follows it is seen too weak.",
                f"Log {name} without a break, at least once a minute.",
            )
        )
    return notices


def library_for(source: Inputs) -> dict[str, Effect]:
    """The library with what the campaign file says of the machine: the expansion coefficient that is expected, and how well it is known.

    Parameters
    ----------
    source : the campaign as read
    """
    effects, table = library(), source.campaign.interferometry
    if source.campaign.thermography is None:
        effects = {name: _without_camera(effect) if effect.errs_camera else effect for name, effect in effects.items()}
    if table is None:
        return effects
    stated_u = table.expansion_coefficient_u_ppm_per_K
    expected = Prior(table.expansion_coefficient_ppm_per_K, EXPANSION_U_PPM_PER_K if stated_u is None else stated_u)
    return {**effects, "axis_expansion": replace(effects["axis_expansion"], prior=expected)}


def _without_camera(effect: Effect) -> Effect:
    """An error of the camera where there is none: told as not available."""
    return replace(effect, needs=lambda readings: "the campaign has no camera")


def field_notices(errors: Sequence[FieldFault]) -> list[Notice]:
    """Notices of camera errors that were taken out of the fields.

    Parameters
    ----------
    errors : of :func:`fusion.loop.camera_correction.find_field_errors`
    """
    return [
        Notice(
            f"field_corrected_{one.effect}",
            f"{one.text[0].upper()}{one.text[1:]}: taken out of the frames, and the model was fitted again to the corrected fields. "
            "Maps and correlation show the fields as the camera gave them.",
            "Give the camera a reference patch, or shield it from warm bodies; the correction is loop_field_correction in fusion.nc.",
        )
        for one in errors
    ]


def join_fusion(
    fused: xr.Dataset, modelled: xr.Dataset, maps: xr.DataTree | None, loop: xr.Dataset | None
) -> xr.DataTree:
    """Everything that joins both recordings, for fusion.nc: readings and loop at the root, the attribution in its own groups.

    Parameters
    ----------
    fused : readings with what was seen and logged, on one clock
    modelled : the same at the targets that take part in attribution and loop
    maps : of the attribution; None where it was not possible
    loop : of the closed loop; None where it was not possible
    """
    root = fused if loop is None else joined(fused, loop=_over_all_targets(loop, fused, modelled))
    if maps is None:
        return xr.DataTree(root)
    groups = {path: node.to_dataset() for path, node in maps.subtree_with_keys}
    correlation = xr.DataTree.from_dict({path: _over_all_targets(one, fused, modelled) for path, one in groups.items()})
    correlation.attrs = {name: value for name, value in maps.attrs.items() if name not in store.GLOBAL_ATTRIBUTES}
    return xr.DataTree(root, children={"correlation": correlation})


def _over_all_targets(found: xr.Dataset, fused: xr.Dataset, modelled: xr.Dataset) -> xr.Dataset:
    """What was found at some of the targets, laid out over all of them; NaN at those that did not take part."""
    if "target" not in found.dims or found.sizes["target"] == fused.sizes["target"]:
        return found
    return found.assign_coords(target=modelled["target"].values).reindex(target=fused["target"].values)


def loop_variables(fused: xr.Dataset, models: Mapping[str, ModelFit], tests: Mapping[str, ResidualTests]) -> xr.Dataset:
    """Lay residuals, spectra and contributions of the effects out by cycle, direction and target.

    Parameters
    ----------
    fused : both recordings on one clock
    models : the ``declared`` and the ``final`` model
    tests : of the residual of each

    Returns
    -------
    Dataset
        Residuals and contributions in um, innovations in standard deviations; NaN where there is no reading.
    """
    final = models["final"]
    spread = partial(lay_out, fused, final.readings)
    shape = tuple(fused.sizes[name] for name in _READING)
    terms = final.terms
    names = [term.effect for term in terms]
    unique = [name if names.count(name) == 1 else f"{name} {at + 1}" for at, name in enumerate(names)]
    contribution = np.array([spread(final.series(term)[0]) for term in terms]).reshape(len(terms), *shape)
    um = {"units": "um"}
    return xr.Dataset(
        {
            **{f"residual_{name}": (_READING, spread(_centred(model)), um) for name, model in models.items()},
            "contribution": (("effect", *_READING), contribution, um),
            **{
                f"innovation_{name}": (
                    _READING,
                    spread(one.innovations),
                    {
                        "units": "1",
                        "long_name": "reading against its prediction from those before it, over its standard deviation",
                    },
                )
                for name, one in tests.items()
            },
            **{
                f"periodogram_{name}": (
                    "period",
                    one.power,
                    {
                        "units": "1",
                        "long_name": "power of the innovations over that of noise",
                        "limit": one.power_limit,
                    },
                )
                for name, one in tests.items()
            },
        },
        coords={
            "effect": unique,
            "period": ("period", tests["final"].periods_min, {"units": "min", "long_name": "period"}),
        },
    )


def with_event_times(steps: Sequence[Mapping[str, Any]], result: LoopResult, fused: xr.Dataset) -> list[dict[str, Any]]:
    """Entries of ``loop.steps`` with the time of day of every event.

    Parameters
    ----------
    steps : as in results.json
    result : of the loop, with the same steps
    fused : both recordings on one clock; the times of the loop count from its first reading
    """
    start = fused["time"].values[fused["deviation"].notnull().values].min()
    events_s = [term.candidate.event_s for term in result.state.added]
    return [
        {**step, "event_time": None if at is None else utc(start + np.timedelta64(round(1000.0 * at), "ms"))}
        for step, at in zip(steps, events_s, strict=True)
    ]


def prediction_variables(fused: xr.Dataset, result: LoopResult) -> dict[str, xr.Variable]:
    """Lay the errors that the loop reports out by cycle, direction and target: those on the hold-out cycles, and of left-out blocks.

    Parameters
    ----------
    fused : both recordings on one clock
    result : of the loop

    Returns
    -------
    dict of Variable
        Measured minus predicted, um, NaN where nothing was predicted. Of the hold-out: ``held_out_error_declared`` and ``..._final``, and
        ``..._last_value`` of repeating the last value. Of every step: ``block_error_before`` and ``block_error_after`` (step, ...), without
        it and with it. The root mean square of each is the error in results.json.
    """
    held_out = result.before.readings.subset(~result.before.used)
    variables = {
        f"held_out_error_{name}": xr.Variable(
            _READING,
            lay_out(fused, held_out, result.hold_out_errors[name]),
            {"units": "um", "long_name": f"measured minus predicted in the hold-out cycles, {words}"},
        )
        for name, words in _PREDICTIONS.items()
    }
    if not result.steps:
        return variables
    readings = result.state.model.readings
    for stage in ("before", "after"):
        errors = [getattr(step, f"cross_errors_{stage}_um") for step in result.steps]
        variables[f"block_error_{stage}"] = xr.Variable(
            ("step", *_READING),
            np.array([lay_out(fused, readings, values) for values in errors]),
            {"units": "um", "long_name": f"measured minus predicted from the other blocks of cycles, {stage} the step"},
        )
    return variables


def lay_out(fused: xr.Dataset, readings: Readings, values: np.ndarray) -> np.ndarray:
    """Lay values of readings out by cycle, direction and target.

    Parameters
    ----------
    fused : both recordings on one clock
    readings : n of its readings
    values : (n,) in any unit

    Returns
    -------
    (cycle, direction, target) ndarray
        NaN where there is none of these readings.
    """
    laid = np.full(tuple(fused.sizes[name] for name in _READING), np.nan)
    place = np.searchsorted(fused["cycle"].values, readings.cycle)
    laid[place, np.where(readings.sign > 0, 0, 1), readings.target_index] = values
    return laid


def _centred(fit: ModelFit) -> np.ndarray:
    """Return the readings minus profile and effects, the unexplained drift left in, with mean zero, (n,)."""
    residual = fit.fit.residual()
    return residual - residual.mean()
