"""The stages after the thermal one: deviations evaluated, both recordings joined, correlated, modelled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from fusion.alignment.align import align
from fusion.alignment.readings import Readings, read_fused
from fusion.campaign.inputs import Source, counted
from fusion.diagnosis.diagnose import Diagnosis, diagnose
from fusion.diagnosis.residual_tests import ResidualTests, examine_residual
from fusion.effects.candidates import Prior
from fusion.effects.library import EXPANSION_U_PPM_PER_K, Effect, library
from fusion.loop.camera_correction import FieldError, correct_fields, corrected_variables, find_field_errors
from fusion.loop.closed_loop import close_loop, on_corrected_fields, set_aside_sites
from fusion.loop.result import LoopResult
from fusion.model.fit import ModelFit, fit_model
from fusion.products import store
from fusion.products.grouped import joined
from fusion.products.progress import Report
from fusion.products.results import Notice, Outcome
from fusion.record.effects import QUASI_STATIC
from interferometry.anomalies import Anomaly, detect_anomalies
from interferometry.drift.estimate import estimate_drift

#: Largest family-wise p of an anomaly for which a cause is named.
_CAUSE_LEVEL = 0.02


def effect_names() -> tuple[str, ...]:
    """Return the names that a campaign may declare, a user's own effects included."""
    return (*library(), QUASI_STATIC)


def model_drift(
    source: Source, fields: xr.Dataset, fused: xr.Dataset, deviations: xr.Dataset, *, report: Report
) -> Outcome:
    """Close the loop, then look for positions that stand out from what the model explains, and for their cause.

    An effect that moves whole stretches of the axis makes their positions stand out too; it is taken out before positions are judged.
    Where the camera erred, the fields are put right and the model is fitted again to them.
    """
    readings = read_fused(fused)
    found = close_loop(
        readings,
        source.campaign.model.declared,
        effects=library_for(source),
        progress=lambda done, total, what: report("closed loop", done, total),
    )
    errors = find_field_errors(found, fields, fused)
    if errors:
        right = align(
            deviations,
            correct_fields(fields, errors),
            source.axis,
            environment=source.environment,
            drivers=source.drivers,
        )
        found = on_corrected_fields(
            found, read_fused(right), {one.effect for one in errors}, effects=library_for(source)
        )
    # The declared model is shown on the fields as they came, also where they were put right afterwards.
    declared = fit_model(found.before.readings, found.before.terms)
    tests = {
        name: examine_residual(model, np.random.default_rng(1))
        for name, model in (("declared", declared), ("final", found.after))
    }
    variables = loop_variables(fused, found, declared, tests)
    if errors:
        corrected = {f"{name}_corrected": right[name] for name in ("mean_rise", "axis_integral", "local_rise")}
        variables = variables.assign(corrected_variables(fields, fused, errors)).assign(corrected)
    report("anomalies", 0, 1)
    explained = variables["contribution"].sum("effect", skipna=False)
    cleaned = deviations.assign(deviation=deviations["deviation"].copy(data=(fused["deviation"] - explained).values))
    # Scatter that is only unequal, as it naturally is, makes no position a machine's anomaly; one that stands out does.
    anomalies = [one for one in detect_anomalies(estimate_drift(cleaned), cleaned) if one.stands_out]
    diagnoses = [
        temper(anomaly, found_cause)
        for anomaly, found_cause in zip(
            anomalies,
            diagnose(anomalies, fused.assign(deviation=fused["deviation"].copy(data=cleaned["deviation"].values))),
            strict=True,
        )
    ]
    found = set_aside_sites(found, sites_of(anomalies, deviations.sizes["target"]))
    report("anomalies", 1, 1)
    parts = {
        "anomalies": [anomaly_part(*pair) for pair in zip(anomalies, diagnoses, strict=True)],
        "loop": {
            **found.as_json(),
            "field_corrections": [one.as_json() for one in errors],
            "residual_tests": {name: one.as_json() for name, one in tests.items()},
        },
    }
    return Outcome(variables, parts, (*gap_notices(readings), *field_notices(errors)))


def gap_notices(readings: Readings) -> list[Notice]:
    """Return a notice for every logged series that has gaps: what follows it is a straight line there."""
    notices = []
    gaps = readings.gaps()
    for name in dict.fromkeys(gap.series for gap in gaps):
        own = [gap for gap in gaps if gap.series == name]
        minutes = sum(gap.end_s - gap.start_s for gap in own) / 60.0
        first = own[0].start_s / 60.0
        notices.append(
            Notice(
                "series_gap",
                f"{name} has {counted(len(own), 'gap')}, {minutes:.0f} min together, the first {first:.0f} min after the first reading; "
                "taken as a straight line there, so that an effect that follows it is seen too weak.",
                f"Log {name} without a break, at least once a minute.",
            )
        )
    return notices


def library_for(source: Source) -> dict[str, Effect]:
    """Return the library with what the campaign file says of the machine: the expansion coefficient that is expected."""
    effects, table = library(), source.campaign.interferometry
    if table is None:
        return effects
    expected = Prior(table.expansion_coefficient_ppm_per_K, EXPANSION_U_PPM_PER_K)
    return {**effects, "axis_expansion": replace(effects["axis_expansion"], prior=expected)}


def field_notices(errors: Sequence[FieldError]) -> list[Notice]:
    """Return a notice for every error of the camera that was taken out of the fields."""
    return [
        Notice(
            f"field_corrected_{one.effect}",
            f"{one.text[0].upper()}{one.text[1:]}: taken out of the frames, and the model was fitted again to the corrected fields. "
            "Maps and correlation show the fields as the camera gave them.",
            "Give the camera a reference patch, or shield it from warm bodies; the correction is loop_field_correction in fusion.nc.",
        )
        for one in errors
    ]


def join_fusion(fused: xr.Dataset, maps: xr.Dataset, loop: xr.Dataset) -> xr.Dataset:
    """Return everything that joins both recordings in one Dataset, for fusion.nc."""
    dataset = joined(fused, correlation=maps, loop=loop)
    own = {name: value for name, value in maps.attrs.items() if name not in store.GLOBAL_ATTRIBUTES}
    return dataset.assign_attrs({f"correlation_{name}": value for name, value in own.items()})


def temper(anomaly: Anomaly, diagnosis: Diagnosis) -> Diagnosis:
    """Name no cause for a position that is itself flagged only at the limit: two doubts make no verdict."""
    if diagnosis.cause == "undetermined" or anomaly.p_value <= _CAUSE_LEVEL:
        return diagnosis
    doubt = f"the position itself is flagged only at the limit (p = {anomaly.p_value:.2g}); before a cause, it needs more cycles"
    return replace(diagnosis, cause="undetermined", against_it=(doubt, *diagnosis.against_it))


def sites_of(anomalies: Sequence[Anomaly], targets: int) -> list[tuple[int, str]]:
    """Return the sites (target, direction) that are reported as anomalies, with a cause or without one, and not by the loop again.

    Where more than a quarter of the targets stands out, that is no matter of single positions, and none is set aside.
    """
    if 4 * len({one.target for one in anomalies}) > targets:
        return []
    return [(one.target, name) for one in anomalies for name in directions_of(one.direction)]


def directions_of(direction: str) -> tuple[str, ...]:
    """Return the approaches that an anomaly concerns."""
    return ("positive", "negative") if direction == "both" else (direction,)


def anomaly_part(anomaly: Anomaly, diagnosis: Diagnosis) -> dict[str, Any]:
    """Return one entry of ``anomalies`` in results.json: what was flagged, its cause, and the evidence for and against it."""
    return {
        "target": anomaly.target,
        "direction": anomaly.direction,
        "p_value": anomaly.p_value,
        "scatter_um": anomaly.scatter_um,
        "cause": diagnosis.cause,
        "evidence": {
            "kind": anomaly.kind,
            "extra_um": anomaly.extra_um,
            "probability": diagnosis.probability,
            "for": list(diagnosis.for_it),
            "against": list(diagnosis.against_it),
            "check": diagnosis.check,
            **diagnosis.evidence,
        },
    }


def loop_variables(
    fused: xr.Dataset, found: LoopResult, declared: ModelFit, tests: Mapping[str, ResidualTests]
) -> xr.Dataset:
    """Return the residuals before and after with their spectra, and what each effect contributes, at every reading."""
    readings = found.after.readings
    dims = ("cycle", "direction", "target")
    shape = tuple(fused.sizes[name] for name in dims)
    place = (
        np.searchsorted(fused["cycle"].values, readings.cycle),
        np.where(readings.sign > 0, 0, 1),
        readings.target_index,
    )

    def spread(values: np.ndarray) -> np.ndarray:
        laid = np.full(shape, np.nan)
        laid[place] = values
        return laid

    terms = found.after.terms
    names = [term.effect for term in terms]
    unique = [name if names.count(name) == 1 else f"{name} {at + 1}" for at, name in enumerate(names)]
    contribution = np.array([spread(found.after.series(term)[0]) for term in terms]).reshape(len(terms), *shape)
    um = {"units": "um"}
    return xr.Dataset(
        {
            "residual_declared": (dims, spread(centred(declared)), um),
            "residual_final": (dims, spread(centred(found.after)), um),
            "contribution": (("effect", *dims), contribution, um),
            **{
                f"innovation_{name}": (
                    dims,
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


def centred(fit: ModelFit) -> np.ndarray:
    """Return the readings minus profile and effects, the unexplained drift left in, with mean zero, (n,)."""
    residual = fit.fit.residual()
    return residual - residual.mean()
