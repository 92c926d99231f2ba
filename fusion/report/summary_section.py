"""What the report says beside its figures: summary, tables, uncertainty notes, glossary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from fusion.loop.axis import ENTRY_LEVEL
from fusion.products.grouped import group, has
from fusion.report import wording
from fusion.report.attribution_section import describe_correlation
from fusion.report.model_section import (
    describe_candidates,
    describe_identifiability,
    describe_model,
    describe_residual,
    evidence,
    runner_up,
    step_parameters,
)
from fusion.report.wording import duration, join, measured, moment, number
from interferometry.figures import time_span

GLOSSARY = (
    ("Deviation", "Measured minus programmed position of one reading, in µm."),
    ("Drift", "The part of the deviation that changes slowly in time, estimated at every reading from all readings."),
    ("Profile", "The deviation along the axis without drift, at the mean thermal state of the test."),
    ("Scatter s", "Standard deviation of single readings after profile and drift were taken out."),
    ("Conventional s", "Standard deviation of all cycles at a position, drift included (n − 1)."),
    (
        "Neighbour difference",
        "Difference of readings at adjacent positions of one pass; its scatter hardly contains drift.",
    ),
    ("Reversal B", "Positive minus negative approach at a position."),
    (
        "Held-out error",
        "Root mean square error on cycles that took no part in fitting: only this says whether a model predicts.",
    ),
    ("Noise floor", "What a perfect model would leave: the scatter of single readings."),
    (
        "Family-wise p",
        "Chance that data without any effect show something as strong anywhere among all that was tried.",
    ),
    ("Rise", "Temperature minus that of the first cycle, in K; errors that stay the same cancel in it."),
    ("Expanded uncertainty", "Twice the standard uncertainty (k = 2), about 95 % coverage."),
)

SECTIONS = (
    ("registration", "registration", "Registration"),
    ("fields", "hotspots", "Temperature"),
    ("drift", "drift", "Drift"),
    ("paper", "neighbours", "Paper's charts"),
    ("iso230", "iso230", "ISO 230-2"),
    ("anomalies", "anomalies", "Anomalies"),
    ("correlation", "correlation", "Correlation"),
    ("loop", "loop", "Model"),
)


def describe(
    results: Mapping[str, Any],
    provenance: Mapping[str, Any],
    datasets: Mapping[str, Any],
    joint: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """Return everything the template says in words and tables."""
    deviations, fields, fused = (datasets.get(name) for name in ("deviations", "fields", "fusion"))
    loop = results.get("loop")
    anomalies = results.get("anomalies", [])
    correlation = describe_correlation(fused, results, joint) if fused is not None else None
    present = {*results, *(["correlation"] if correlation else [])}
    return {
        "subtitle": _subtitle(provenance, deviations),
        "headline": wording.verdict_headline(loop) if loop else "Evaluated without a model of the drift.",
        "sentences": [*_sentences(results, deviations), *([correlation["headline"]] if correlation else [])],
        "numbers": _numbers(results, deviations, fields),
        "next": wording.next_steps(results)[:6],
        "contents": [
            ("data", "Data"),
            *((anchor, title) for anchor, part, title in SECTIONS if part in present),
            ("uncertainty", "Uncertainty"),
            ("glossary", "Glossary"),
            ("provenance", "Provenance"),
        ],
        "data": _data_rows(results, provenance, deviations, fields),
        "fiducials": _fiducial_rows(fields),
        "field_uncertainty": _field_uncertainty(fields),
        "positions": _position_rows(deviations),
        "neighbours_text": _neighbours_text(results),
        "comparison": _comparison_rows(deviations),
        "anomaly_advice": [wording.CAUSES[item["cause"]][1] for item in anomalies],
        "evidence": [evidence(item["evidence"]) for item in anomalies],
        "correlation": correlation,
        "joint": joint,
        "model": describe_model(loop) if loop else [],
        "loop_numbers": wording.verdict_numbers(loop) if loop else "",
        "parameters": step_parameters(loop) if loop else [],
        "runners_up": [runner_up(step["runner_up"]) for step in loop["steps"]] if loop else [],
        "candidates": describe_candidates(loop) if loop else None,
        "residual": describe_residual(loop) if loop else [],
        "identifiability": describe_identifiability(loop) if loop else [],
        "uncertainty": _uncertainty(results, fields),
        "glossary": GLOSSARY,
    }


def _subtitle(provenance: Mapping[str, Any], deviations: xr.Dataset | None) -> str:
    axis = provenance["parameters"]["campaign"].get("axis", "")
    parts = [f"{axis} axis" if axis else "", moment(time_span(deviations)[0]) if deviations is not None else ""]
    return ", ".join(part for part in parts if part)


def _sentences(results: Mapping[str, Any], deviations: xr.Dataset | None) -> list[str]:
    """What was measured, what the model says, what stands out: one sentence each."""
    sentences = []
    if deviations is not None:
        sizes = deviations.sizes
        first, last = time_span(deviations)
        position = deviations["position"].values
        sentences.append(
            f"Measured: {sizes['target']} positions over {np.ptp(position):g} mm, approached from both sides in {sizes['cycle']} cycles, "
            f"{duration(float((last - first) / np.timedelta64(1, 's')))} in all."
        )
    if results.get("loop"):
        sentences.append(wording.verdict_numbers(results["loop"]))
    if "anomalies" in results:
        named = [f"position {item['target']} ({wording.CAUSES[item['cause']][0]})" for item in results["anomalies"]]
        sentences.append(f"Standing out: {join(named)}." if named else "No position stands out from the others.")
    return sentences


def _numbers(
    results: Mapping[str, Any], deviations: xr.Dataset | None, fields: xr.Dataset | None
) -> list[dict[str, str]]:
    """The figures that a reader looks for first."""
    numbers: list[dict[str, str]] = []

    def add(name: str, value: str, note: str) -> None:
        numbers.append({"name": name, "value": value, "note": note})

    if deviations is not None and has(deviations, "drift"):
        drift = group(deviations, "drift")
        mean = drift["drift"].mean("direction")
        span = float(mean.max() - mean.min())
        add("Drift during the test", f"{number(span)} µm", "largest difference between any two times and positions")
        sigma = float(drift["sigma"])
        add("Scatter of single readings", f"{number(sigma, 2)} µm", "standard deviation, drift taken out")
    if "iso230" in results:
        iso = results["iso230"]
        add("Accuracy A", measured(**iso["A_um"], unit="µm"), iso["window"])
        add("Repeatability R", measured(**iso["R_um"], unit="µm"), iso["window"])
        add("Reversal B", measured(**iso["B_um"], unit="µm"), iso["window"])
    if fields is not None:
        rise = fields["temperature_rise"].isel(cycle=-1)
        u = float(fields["temperature_rise_u"].isel(cycle=-1).mean())
        add(
            "Rise of the table",
            measured(float(rise.mean()), u, "K"),
            f"mean of the last cycle; warmest cell {number(float(rise.max()))} K",
        )
    if results.get("loop"):
        loop = results["loop"]
        note = f"declared model {number(loop['rmse_declared_um'], 2)} µm, noise {number(loop['noise_floor_um'], 2)} µm"
        add("Held-out error", f"{number(loop['rmse_final_um'], 2)} µm", note)
    return numbers


def _data_rows(
    results: Mapping[str, Any], provenance: Mapping[str, Any], deviations: xr.Dataset | None, fields: xr.Dataset | None
) -> list[tuple[str, str]]:
    rows = []
    if deviations is not None:
        readings = int(np.isfinite(deviations["deviation"]).sum())
        rows.append(
            (
                "Readings",
                f"{readings} of {deviations['deviation'].size} possible; times {deviations['time'].attrs.get('origin', 'recorded')}",
            )
        )
        first, last = time_span(deviations)
        rows.append(("Time", f"{moment(first)} to {moment(last)}"))
    if fields is not None:
        first, last = fields["time"].values[[0, -1]]
        rows.append(("Frames", f"{fields.sizes['time']}, from {moment(first)} to {moment(last)} on the laser's clock"))
        cell = float(np.median(np.diff(fields["x"])))
        rows.append(("Plan", f"{fields.sizes['x']} × {fields.sizes['y']} cells of {cell:g} mm"))
        seen = float(np.isfinite(fields["temperature_rise"].isel(cycle=-1)).mean())
        rows.append(("Seen", f"{seen:.0%} of the plan; the rest is masked (fiducials, edges) or out of the picture"))
    offset = results.get("alignment", {}).get("clock_offset_s")
    if offset is not None:
        source = "assumed" if offset["u"] is None else "as given" if offset["u"] == 0 else "from the table's motion"
        rows.append(("Clock offset", f"{measured(offset['value'], offset['u'], 's')}, camera minus laser, {source}"))
    rows.append(("Input files", f"{len(provenance['inputs'])}, listed with their SHA-256 under Provenance"))
    return rows


def _fiducial_rows(fields: xr.Dataset | None) -> list[dict[str, Any]]:
    if fields is None:
        return []
    values = zip(
        fields["fiducial_name"].values,
        fields["fiducial_residual"].values,
        fields["fiducial_leave_one_out"].values,
        strict=True,
    )
    return [
        {"name": str(name), "residual": float(residual), "leave_one_out": float(loo)} for name, residual, loo in values
    ]


def _field_uncertainty(fields: xr.Dataset | None) -> str:
    if fields is None:
        return ""
    absolute, rise = (float(fields[name].isel(cycle=-1).mean()) for name in ("temperature_u", "temperature_rise_u"))
    return (
        f"Standard uncertainty of a cell, mean over the plan: {number(absolute, 2)} K of the temperature, {number(rise, 2)} K of the rise, "
        "in which errors that stay the same cancel."
    )


def _position_rows(deviations: xr.Dataset | None) -> list[list[str]]:
    if deviations is None:
        return []
    drift, conventional = group(deviations, "drift"), group(deviations, "conventional")
    places = {name: wording.decimals_of(float(drift[f"{name}_u"].median())) for name in ("profile", "scatter")}
    rows = []
    for target in deviations["target"].values:
        row = [str(target), f"{float(deviations['position'].sel(target=target)):g}"]
        at = [{"target": target, "direction": direction} for direction in ("positive", "negative")]
        for name, decimals in places.items():
            row += [
                measured(float(drift[name].sel(one)), float(drift[f"{name}_u"].sel(one)), decimals=decimals)
                for one in at
            ]
        row += [f"{float(conventional['standard_deviation'].sel(one)):.2f}" for one in at]
        rows.append(row)
    return rows


def _comparison_rows(deviations: xr.Dataset | None) -> list[list[str]]:
    """Conventional, differenced, their ratio and the joint estimate's own standard deviation, per position and direction."""
    if deviations is None:
        return []
    table = group(deviations, "comparison")
    return [
        [
            str(link),
            *(
                f"{float(table[name].sel(link=link, direction=direction)):.2f}"
                for direction in ("positive", "negative")
                for name in ("conventional", "differenced", "ratio", "joint")
            ),
        ]
        for link in table["link"].values
    ]


def _neighbours_text(results: Mapping[str, Any]) -> str:
    if "neighbours" not in results:
        return ""
    part = results["neighbours"]
    ratio = [value for values in part["ratio"].values() for value in values if value is not None]
    return (
        f"The conventional standard deviation is {number(min(ratio), 3)} to {number(max(ratio), 3)} times that of the "
        "differences. This ratio measures the drift, not the quality of an evaluation: it is 0.71 without drift. The chain of "
        "mean differences gives exactly the conventional mean profile; differencing cleans the standard deviation, not the "
        "mean. What the paper's equations (5) and (6) divide by n (n − 1) is the standard uncertainty of a mean; the charts "
        "here show sample standard deviations."
    )


def _uncertainty(results: Mapping[str, Any], fields: xr.Dataset | None) -> list[str]:
    sentences = []
    if "drift" in results:
        sentences.append(
            "Profile and drift come from one estimate over all readings at their own times (generalised least squares under a "
            "random drift); their uncertainty contains the noise of the readings and what the drift could have done between "
            "them. It does not contain the laser's own calibration, cosine error or expansion coefficient; those enter the "
            "ISO 230-2 values."
        )
    if fields is not None:
        sentences.append(
            "Temperatures hold for the emissivity that the campaign states. An error of the emissivity or of the reflected "
            "temperature shifts all cells alike and cancels in the rise; a surface with another emissivity (bare metal, oil) "
            "does not follow this."
        )
    if results.get("loop"):
        sentences.append(
            "The verdict says what these data can show, not what is true of the machine: an effect that moves all positions "
            "alike, slowly and unlogged, looks like drift without a cause. The errors before and after come from coefficients "
            "fitted without the held-out cycles."
        )
        sentences.extend(
            f"{wording.effect_name(step['effect']).capitalize()}: {step['confirmed']}."
            for step in results["loop"]["steps"]
            if "confirmed" in step
        )
        sentences.append(
            f"Where nothing is missing, the closed loop is set to add an effect with a chance of {100 * ENTRY_LEVEL:g} %."
        )
    sentences.append("p-values are corrected for everything that was tried (family-wise), at a level of 5 %.")
    return sentences
