"""The stage that models the drift: the closed loop, the camera's errors taken out, residual tests, positions that stand out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import xarray as xr

from fusion.analysis.alignment.align import AxisGeometry, MeasuredLine, align
from fusion.analysis.alignment.readings import Readings, read_fused
from fusion.analysis.consistency.camera import mean_rise, reflected_share, zero_share
from fusion.analysis.consistency.model import compare_lines, with_line, withhold_names
from fusion.analysis.diagnosis.residual import ResidualTests, examine_residual
from fusion.analysis.drift_model import axis as axis_loop
from fusion.analysis.drift_model.model import ModelFit, fit_model
from fusion.analysis.effects.effect import Effect, Prior
from fusion.analysis.effects.library import library
from fusion.analysis.effects.thermal import EXPANSION_U_PPM_PER_K
from fusion.campaign.inputs import Inputs, LaserInputs, Source
from fusion.campaign.time_zones import utc
from fusion.pipeline.positioning import diagnose_positions, sites_of
from fusion.results.axis import AnomalyPart
from fusion.results.loop import (
    AxisLoop,
    AxisStep,
    Coefficient,
    DeclaredCoefficient,
    Parameter,
    ResidualDrift,
    ResidualTestsPart,
)
from fusion.results.numbers import upper_first
from fusion.results.parts import Sensitivity, determined
from fusion.results.progress import Report, counted
from fusion.results.results import Notice, Outcome, Parts
from fusion.results.store import GLOBAL_ATTRIBUTES, joined
from thermography.fields.cycle_fields import cycles_with_field

# The scale of the rise in what is fitted to it: an error of the rise by one percent is one of every coefficient per
# kelvin.


def axis_scale_u(fields: xr.Dataset, axis: AxisGeometry, position_mm: np.ndarray) -> float:
    """Return the relative standard uncertainty of the rise along the measured line."""
    along = MeasuredLine(fields, axis, position_mm).sample(np.stack(_last_rise(fields)))
    return _with_camera(_weighted(along[0], along[1]), fields)


def plan_scale_u(fields: xr.Dataset) -> float:
    """Return the relative standard uncertainty of the mean rise of the plan, as `axis_scale_u`."""
    return _with_camera(_weighted(*_last_rise(fields)), fields)


def _with_camera(scale_u: float, fields: xr.Dataset) -> float:
    """Return the uncertainty of a scale with those of the camera's zero and of a change of what is reflected."""
    return float(np.linalg.norm([scale_u, zero_share(fields), reflected_share(fields)]))


def place_scale_u(fields: xr.Dataset, x_mm: float, y_mm: float) -> float:
    """Return the relative standard uncertainty of the rise at a place of the plan, the mean of the plan where it is not seen there."""
    if np.isfinite([x_mm, y_mm]).all():
        share = float(fields["rise_scale_u"].sel(x=x_mm, y=y_mm, method="nearest"))
        if np.isfinite(share):
            return share
    return plan_scale_u(fields)


PerKelvin = TypeVar("PerKelvin", bound=Sensitivity)
OfEffect = TypeVar("OfEffect", bound=Coefficient)


def scaled(entry: PerKelvin, scale_u: float, by_zero: float = 0.0) -> PerKelvin:
    """Return a quantity per kelvin of the rise with both parts of its uncertainty; `by_zero` is what the camera's zero may hide of it."""
    u_fit = determined(entry.u)
    u_scale = float(np.hypot((determined(entry.value) - entry.expected) * scale_u, by_zero))
    return entry.model_copy(update={"u": float(np.hypot(u_fit, u_scale)), "u_fit": u_fit, "u_scale": u_scale})


def hidden_by_zero(drift: ResidualDrift, fields: xr.Dataset, position_mm: np.ndarray) -> dict[str, float]:
    """Return by unit how much of a coefficient per kelvin an unknown zero of the camera may hide.

    A zero that swings as the table warms makes the rise another course, so that a coefficient is too small and what it lacks is left as
    drift: at most that drift per kelvin, in the share that the zero has of the rise.
    """
    swing_K = max(float(np.nanstd(mean_rise(fields))), 1e-3)
    metres = 1e-3 * max(float(np.sqrt(np.mean(position_mm**2))), 1.0)
    share = zero_share(fields)
    return {
        "um/K": share * determined(drift.common_rms_um) / swing_K,
        "ppm/K": share * determined(drift.stretch_rms_um) / (metres * swing_K),
    }


def with_spread(entry: DeclaredCoefficient) -> DeclaredCoefficient:
    """Return a declared coefficient whose uncertainty is no smaller than what it moves when a target or a part of the test is left out."""
    if not np.isfinite(entry.moved_u):
        return entry
    # What was expected beforehand does not move.
    moved = max(0.0, 1.0 - entry.expected_share) * entry.moved_u
    return entry.model_copy(
        update={"u": float(np.sqrt(determined(entry.u) ** 2 + max(0.0, moved**2 - entry.fitted_u**2)))}
    )


def scale_coefficients(
    loop: AxisLoop,
    effects: Mapping[str, Effect],
    *,
    axis_u: float,
    plan_u: float,
    by_zero: Mapping[str, float] | None = None,
) -> AxisLoop:
    """Return the closed loop with the scale of the rise in every coefficient per kelvin of it."""
    hidden = by_zero or {}

    def completed(entry: OfEffect, effect: str, parameters: Mapping[str, Parameter]) -> OfEffect:
        of_rise = parameters.get("follows") == "mean_rise" or (effect in effects and effects[effect].follows_field)
        if not of_rise:
            return entry
        return scaled(entry, axis_u if entry.unit == "ppm/K" else plan_u, hidden.get(entry.unit, 0.0))

    declared = tuple(completed(entry, entry.effect, {}) for entry in loop.declared_coefficients)
    steps = []
    for step in loop.steps:
        coefficients = tuple(completed(entry, step.effect, step.parameters) for entry in step.coefficients)
        steps.append(step.model_copy(update={"coefficients": coefficients}))
    return loop.model_copy(update={"declared_coefficients": declared, "steps": tuple(steps)})


def scale_evidence(
    anomaly: AnomalyPart, axis: AxisGeometry, fields: xr.Dataset, position_mm: xr.DataArray
) -> AnomalyPart:
    """Return an anomaly with the scale of the rise in its displacement per local rise."""
    evidence = anomaly.evidence
    if not np.isfinite(determined(evidence.temperature_um_per_K)):
        return anomaly
    x, y = axis.points(position_mm.sel(target=[anomaly.target]).values)
    of_rise = Sensitivity(value=evidence.temperature_um_per_K, u=evidence.temperature_u_um_per_K)
    both = scaled(of_rise, place_scale_u(fields, float(x[0]), float(y[0])))
    numbers = {"temperature_u_um_per_K": both.u, "temperature_scale_u_um_per_K": both.u_scale}
    return anomaly.model_copy(update={"evidence": evidence.model_copy(update=numbers)})


def _last_rise(fields: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Rise of the last cycle with a field, and the relative uncertainty of its scale, (y, x)."""
    rise = fields["temperature_rise"]
    last = int(np.flatnonzero(cycles_with_field(rise))[-1])
    return rise[last].values.astype(float), fields["rise_scale_u"].values.astype(float)


def _weighted(rise: np.ndarray, share: np.ndarray) -> float:
    """Mean share, weighted by the size of the rise; plain where nothing rose."""
    seen = np.isfinite(share) & np.isfinite(rise)
    weight = np.abs(rise[seen])
    return float(np.average(share[seen], weights=weight if weight.sum() > 0 else None))


_READING = ("cycle", "direction", "target")
#: Predictions of the hold-out cycles whose errors are kept reading by reading, in words.
_PREDICTIONS = {"declared": "declared model", "final": "with the added effects", "last_value": "last value repeated"}


@dataclass(frozen=True)
class CorrectedCamera:
    """Errors of the camera that the loop found, and both recordings aligned again on fields without them."""

    errors: list[axis_loop.FieldFault]
    fused: xr.Dataset


def model_drift(
    source: LaserInputs, fields: xr.Dataset | None, fused: xr.Dataset, deviations: xr.Dataset, *, report: Report
) -> Outcome:
    """Close the loop, then judge the positions that stand out from what the model explains."""
    readings = read_fused(fused)
    effects = library_for(source)
    result = axis_loop.close_axis(
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
        result = axis_loop.on_corrected_fields(result, read_fused(corrected.fused), names, effects=effects)
    errors = [] if corrected is None else corrected.errors
    models = both_models(result)
    tests = {name: examine_residual(model, np.random.default_rng(1)) for name, model in models.items()}
    variables = loop_variables(fused, models, tests).assign(
        {**prediction_variables(fused, result), **correction_variables(corrected, fields, fused)}
    )
    report("anomalies", 0, 1)
    positions = diagnose_positions(fused, deviations, variables["contribution"].sum("effect", skipna=False))
    result = axis_loop.set_aside_sites(result, sites_of(positions, deviations.sizes["target"]))
    report("anomalies", 1, 1)
    line = None
    if isinstance(source, Source) and fields is not None:
        line = compare_lines(result.after, len(result.declared), axis_loop.correct_fields(fields, errors), source.axis)
    loop = result.described(ResidualTestsPart(**tests), field_corrections=errors, axis_line=line)
    if isinstance(source, Source) and fields is not None:
        positions = [scale_evidence(one, source.axis, fields, deviations["position"]) for one in positions]
        position_mm = deviations["position"].values
        axis_u = axis_scale_u(fields, source.axis, position_mm)
        hidden = hidden_by_zero(loop.residual_drift, fields, position_mm)
        loop = scale_coefficients(loop, effects, axis_u=axis_u, plan_u=plan_scale_u(fields), by_zero=hidden)
    elif "axis_scale_u" in fused:
        scale_u = float(fused["axis_scale_u"])
        loop = scale_coefficients(loop, effects, axis_u=scale_u, plan_u=scale_u)
    loop = withhold_names(with_line(loop), effects)
    declared = tuple(with_spread(entry) for entry in loop.declared_coefficients)
    steps = with_event_times(loop.steps, result, fused)
    loop = loop.model_copy(update={"declared_coefficients": declared, "steps": steps})
    parts = Parts(anomalies=positions, loop=loop)
    return Outcome(variables, parts, (*gap_notices(readings), *field_notices(errors)))


def correct_camera(
    source: Source, result: axis_loop.AxisResult, fields: xr.Dataset, fused: xr.Dataset, deviations: xr.Dataset
) -> CorrectedCamera | None:
    """Take the camera's errors that entered the model out of the fields, and align both recordings again."""
    errors = axis_loop.find_field_errors(result, fields, fused)
    if not errors:
        return None
    # Errors of reading that were left out stay out.
    used = deviations.assign(deviation=deviations["deviation"].where(fused["deviation"].notnull()))
    corrected = axis_loop.correct_fields(fields, errors)
    aligned = align(used, corrected, source.axis, environment=source.environment, drivers=source.drivers)
    return CorrectedCamera(errors, aligned)


def both_models(result: axis_loop.AxisResult) -> dict[str, ModelFit]:
    """The declared and the final model, each fitted to all readings."""
    return {"declared": fit_model(result.before.readings, result.before.terms), "final": result.after}


def correction_variables(
    corrected: CorrectedCamera | None, fields: xr.Dataset | None, fused: xr.Dataset
) -> dict[str, xr.Variable | xr.DataArray]:
    """The correction of the fields and what it changes, for fusion.nc; empty where the camera did not err."""
    if corrected is None or fields is None:
        return {}
    names = ("mean_rise", "axis_integral", "local_rise")
    return {
        **axis_loop.corrected_variables(fields, fused, corrected.errors),
        **{f"{name}_corrected": corrected.fused[name] for name in names},
    }


def gap_notices(readings: Readings) -> Iterator[Notice]:
    """Notices of gaps in the logged series, one for all that have the same gaps."""
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
        yield Notice.of("series_gap", name=name, have=have, gaps=counted(len(own), "gap"), minutes=minutes, first=first)


def library_for(source: Inputs) -> dict[str, Effect]:
    """The library with what the campaign file says of the machine: the expansion coefficient that is expected, and how well it is known."""
    effects, table = library(), source.campaign.interferometry
    if source.campaign.thermography is None:
        for name, effect in effects.items():
            if effect.errs_camera:
                effects = {**effects, name: replace(effect, needs=lambda readings: "the campaign has no camera")}
    if table is None:
        return effects
    stated_u = table.expansion_coefficient_u_ppm_per_K
    expected = Prior(table.expansion_coefficient_ppm_per_K, EXPANSION_U_PPM_PER_K if stated_u is None else stated_u)
    return {**effects, "axis_expansion": replace(effects["axis_expansion"], prior=expected)}


def field_notices(errors: Sequence[axis_loop.FieldFault]) -> Iterator[Notice]:
    """Notices of camera errors that were taken out of the fields."""
    for one in errors:
        yield Notice.of("field_corrected", code=f"field_corrected_{one.effect}", text=upper_first(one.text))


def join_fusion(
    fused: xr.Dataset, modelled: xr.Dataset | None, maps: xr.DataTree | None, loop: xr.Dataset | None
) -> xr.DataTree:
    """Everything that joins both recordings, for fusion.nc: readings and loop at the root, the attribution in its own groups."""
    root = fused if loop is None else joined(fused, loop=_over_all_targets(loop, fused, modelled))
    if maps is None:
        return xr.DataTree(root)
    groups = {path: node.to_dataset() for path, node in maps.subtree_with_keys}
    correlation = xr.DataTree.from_dict({path: _over_all_targets(one, fused, modelled) for path, one in groups.items()})
    correlation.attrs = {name: value for name, value in maps.attrs.items() if name not in GLOBAL_ATTRIBUTES}
    return xr.DataTree(root, children={"correlation": correlation})


def _over_all_targets(found: xr.Dataset, fused: xr.Dataset, modelled: xr.Dataset | None) -> xr.Dataset:
    """What was found at some of the targets, laid out over all of them; NaN at those that did not take part."""
    if modelled is None or "target" not in found.dims or found.sizes["target"] == fused.sizes["target"]:
        return found
    return found.assign_coords(target=modelled["target"].values).reindex(target=fused["target"].values)


def loop_variables(fused: xr.Dataset, models: Mapping[str, ModelFit], tests: Mapping[str, ResidualTests]) -> xr.Dataset:
    """Lay residuals, spectra and contributions of the effects out by cycle, direction and target."""
    final = models["final"]
    spread = partial(lay_out, fused, final.readings)
    shape = tuple(fused.sizes[name] for name in _READING)
    terms = final.terms
    names = [term.effect for term in terms]
    unique = [name if names.count(name) == 1 else f"{name} {at + 1}" for at, name in enumerate(names)]
    contribution = np.array([spread(final.series(term)[0]) for term in terms]).reshape(len(terms), *shape)
    um, pure = {"units": "um"}, {"units": "1"}
    against = {**pure, "long_name": "reading against its prediction from those before it, over its standard deviation"}
    power = {**pure, "long_name": "power of the innovations over that of noise"}
    variables: dict[str, Any] = {"contribution": (("effect", *_READING), contribution, um)}
    for name, model in models.items():
        residual = model.fit.residual()
        # Profile and effects taken out, the unexplained drift left in, with mean zero.
        variables[f"residual_{name}"] = (_READING, spread(residual - residual.mean()), um)
    for name, one in tests.items():
        variables[f"innovation_{name}"] = (_READING, spread(one.innovations), against)
        variables[f"periodogram_{name}"] = ("period", one.power, {**power, "limit": one.power_limit})
    period = ("period", tests["final"].periods_min, {"units": "min", "long_name": "period"})
    return xr.Dataset(variables, coords={"effect": unique, "period": period})


def with_event_times(
    steps: Sequence[AxisStep], result: axis_loop.AxisResult, fused: xr.Dataset
) -> tuple[AxisStep, ...]:
    """The steps of the loop with the time of day of every event."""
    start = fused["time"].values[fused["deviation"].notnull().values].min()
    events_s = [term.candidate.event_s for term in result.state.added]
    times = [None if at is None else utc(start + np.timedelta64(round(1000.0 * at), "ms")) for at in events_s]
    return tuple(step.model_copy(update={"event_time": at}) for step, at in zip(steps, times, strict=True))


def prediction_variables(fused: xr.Dataset, result: axis_loop.AxisResult) -> dict[str, xr.Variable]:
    """Lay the errors that the loop reports out by cycle, direction and target: those on the hold-out cycles, and of left-out blocks."""
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
    """Lay values of readings out by cycle, direction and target."""
    laid = np.full(tuple(fused.sizes[name] for name in _READING), np.nan)
    place = np.searchsorted(fused["cycle"].values, readings.cycle)
    laid[place, np.where(readings.sign > 0, 0, 1), readings.target_index] = values
    return laid
