"""The report of a campaign with both instruments: summary, data, tables per position, uncertainty, glossary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from fusion.attribution.family_wise import LEVEL as ATTRIBUTION_LEVEL
from fusion.diagnosis.remainder import LEVEL as REMAINDER_LEVEL
from fusion.loop.axis import ENTRY_LEVEL, SEARCH_LEVEL, SECOND_LEVEL
from fusion.products.grouped import by_approach, group, has
from fusion.products.results import Results
from fusion.products.results_axis import NeighboursPart
from fusion.products.results_inputs import Figures
from fusion.products.results_loop import AxisLoop, Loop
from fusion.products.results_part import Quantity
from fusion.products.results_radiometry import ContactSensorPart, RadiometryPart
from fusion.report.attribution_section import describe_correlation
from fusion.report.conclusions.actions import next_steps
from fusion.report.conclusions.answers import conclude, describe_anomaly, headline, prediction_sentence, reconcile
from fusion.report.findings import (
    ISO230_TERMS,
    anomaly_cause,
    anomaly_place,
    drift_u_note,
    figures_of,
    quoted_values,
    quoted_window,
    spot_places,
)
from fusion.report.iso230_section import contained_sentence, describe_iso230
from fusion.report.model_section import (
    DECIDED_BEFORE,
    describe_candidates,
    describe_evidence,
    describe_identifiability,
    describe_model,
    describe_residual,
    errors_table,
    steps_table,
)
from fusion.report.tables import Table, Words, table
from fusion.report.wording import (
    INPUT_NAMES,
    alike,
    condition,
    decimals_of,
    duration,
    effect_words,
    measured,
    moment,
    number,
    p_cell,
    place,
    premise,
    quantity,
    untouched,
)
from interferometry.figures import time_span
from thermography.fields.cycle_fields import plan_unit

_GLOSSARY = (
    ("Positioning deviation", "Measured minus target position of one reading, in µm."),
    ("Drift", "The part of the deviation that changes slowly in time, estimated at every reading from all readings."),
    ("Profile", "The deviation along the axis without drift, at the mean thermal state of the test."),
    ("Scatter s", "Standard deviation of single readings after profile and drift were subtracted."),
    ("Conventional s", "Standard deviation over all cycles at a position, drift included (n − 1)."),
    (
        "Neighbour difference",
        "Difference of readings at adjacent positions of one pass; its scatter contains hardly any drift.",
    ),
    (
        "Reversal error B_i and B",
        "B_i: difference of the mean deviations of both approaches at a position, positive minus negative. B: the largest |B_i|.",
    ),
    (
        "Prediction error",
        "Root mean square of measured minus predicted on cycles that took no part in the fit (held out): only this says whether a model "
        "predicts.",
    ),
    (
        "Blocks of cycles predicted from the others",
        "Prediction errors when blocks of cycles are left out in turn and predicted from those before and after: for an event before the "
        "held-out cycles only these can tell.",
    ),
    ("Noise", "What a perfect model would leave: the scatter of single readings."),
    ("Thermal mode", "A part of the temperature field that warms by itself, usually one heat source with its halo."),
    ("Lag", "Time constant by which the drift follows a temperature."),
    (
        "Family-wise p",
        "Probability that data without any effect show something as strong anywhere among all that was tested. Where it comes from a "
        "number of simulations and none of them was as strong, it is written as an upper limit, p ≤.",
    ),
    (
        "Rise",
        "Temperature minus that of the first cycle, in K; a constant error of the camera cancels in it, an error of the emissivity or of "
        "the camera's scale does not.",
    ),
    ("Expanded uncertainty", "Twice the standard uncertainty (k = 2), about 95 % coverage."),
)
#: Section of the report, the part of the results without which it is absent, and its title in the contents: first what a reader acts on ...
_SECTIONS = (
    ("iso230", "iso230", "ISO 230-2"),
    ("drift", "drift", "Drift"),
    ("anomalies", "anomalies", "Positions"),
    ("fields", "hotspots", "Heat"),
    ("sensors", "sensors", "Contact sensors"),
    ("cause", "loop", "Cause"),
    ("place", "correlation", "Place"),
)
#: ... then, in the appendix, what it rests on.
_APPENDIX = (
    ("paper", "neighbours", "Neighbour differences"),
    ("correlation", "correlation", "Drift and field"),
    ("loop", "loop", "Model"),
    ("registration", "registration", "Registration"),
)
#: Section of the report -> what its figures rest on.
_RESTS_ON: dict[str, tuple[Figures, ...]] = {
    "fields": ("field",),
    "drift": ("positions",),
    "paper": ("positions",),
    "iso230": ("positions",),
    "anomalies": ("positions",),
    "place": ("attribution",),
    "correlation": ("attribution",),
    "cause": ("causes",),
    "loop": ("causes",),
}
_SIGNS = {"positive": "+", "negative": "−"}
#: Actions in the summary; all remedies stand with what was left out.
_MOST_STEPS = 6


def describe_campaign(
    results: Results,
    provenance: Mapping[str, Any],
    datasets: Mapping[str, Any],
    joint: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """Return everything the report says in words and tables, as the template reads it.

    Parameters
    ----------
    results : Results
        Results of the run.
    provenance, datasets, joint
        See `fusion.report.html.render_report`.
    """
    deviations, fields, fused = (datasets.get(name) for name in ("deviations", "fields", "fusion"))
    correlation = None if fused is None else describe_correlation(fused, results, joint)
    zone = results.time.zone if results.time else None
    return {
        "subtitle": _subtitle(provenance, deviations, zone),
        "zone": zone or "UTC",
        "verdict": results.loop.verdict if results.loop else "",
        "headline": headline(results),
        "doubts": results.inputs.doubts if results.inputs else (),
        "untouched": untouched(results.inputs, figures_of(results)),
        "premises": {section: premise(results.inputs, *figures) for section, figures in _RESTS_ON.items()},
        "measured": _measured(deviations, fields),
        "answers": conclude(results),
        "numbers": _numbers(results, deviations, fields),
        "next": next_steps(results)[:_MOST_STEPS],
        "contents": [
            *_titles(results, _SECTIONS),
            ("data", "Data"),
            ("uncertainty", "Uncertainty"),
            *_titles(results, _APPENDIX),
            ("glossary", "Glossary"),
            ("provenance", "Provenance"),
        ],
        "data": _data_rows(results, provenance, deviations, fields),
        "fiducials": _fiducials_table(fields) if fields is not None and "fiducial" in fields.sizes else None,
        "field_uncertainty": "" if results.radiometry is None else _field_uncertainty(results.radiometry),
        "budget": None if results.radiometry is None else _budget_table(results.radiometry),
        "sensors": _sensors_table(results.sensors) if results.sensors else None,
        "surfaces": _surfaces_table(results.radiometry)
        if results.radiometry and results.radiometry.edge_cells
        else None,
        "hotspots": _hotspots_table(results) if results.hotspots else None,
        "positions": None if results.drift is None or deviations is None else _positions_table(deviations),
        "drift_u_note": drift_u_note(results.iso230),
        "neighbours": "" if results.neighbours is None else _neighbours_text(results.neighbours),
        "comparison": None if deviations is None else _comparison_table(deviations),
        "iso230": None if results.iso230 is None else describe_iso230(results.iso230, deviations),
        "anomalies": _anomalies(results),
        "correlation": correlation,
        "reconciled": reconcile(results),
        "joint": joint,
        "loop": None if results.loop is None else _describe_loop(results.loop),
        "uncertainty": _uncertainty(results, fields),
        "glossary": _glossary(results),
        **_camera_words(results),
    }


def _glossary(results: Results) -> list[tuple[str, str]]:
    """The terms of what was measured."""
    there = figures_of(results)
    left_out = set() if "field" in there else {"Thermal mode", "Rise"}
    if "positions" not in there:
        left_out = {term for term, _ in _GLOSSARY} - {"Rise", "Expanded uncertainty"}
    return [(term, text) for term, text in _GLOSSARY if term not in left_out]


def _camera_words(results: Results) -> dict[str, str]:
    """What the frames show, and what one field stands for."""
    in_picture = results.registration is not None and results.registration.is_picture
    windows = "positions" not in figures_of(results)
    return {
        "seen": "picture" if in_picture else "table",
        "field_of": "window" if windows else "cycle",
        "grey": "no value." if in_picture else "not visible, or covered by a fiducial.",
    }


def _titles(results: Results, sections: tuple[tuple[str, str, str], ...]) -> list[tuple[str, str]]:
    """Anchor and title of the sections that the results have."""
    return [(anchor, title) for anchor, part, title in sections if getattr(results, part) is not None]


def _subtitle(provenance: Mapping[str, Any], deviations: xr.Dataset | None, zone: str | None) -> str:
    axis = provenance["parameters"]["campaign"].get("axis", "") if deviations is not None else ""
    start = ""
    if deviations is not None and has(deviations, "drift"):
        start = moment(time_span(deviations)[0], zone)
    parts = [f"{axis} axis" if axis else "", start]
    return ", ".join(part for part in parts if part)


def _measured(deviations: xr.Dataset | None, fields: xr.Dataset | None) -> str:
    """What was measured, in one sentence."""
    if deviations is not None:
        sizes = deviations.sizes
        lasted = "of unknown duration"
        if has(deviations, "drift"):
            first, last = time_span(deviations)
            lasted = f"{duration(float((last - first) / np.timedelta64(1, 's')))} in all"
        return (
            f"Measured: {sizes['target']} positions over {np.ptp(deviations['position'].values):g} mm, approached "
            f"{_approaches(deviations)} in {sizes['cycle']} cycles, {lasted}."
        )
    if fields is None:
        return ""
    first, last = fields["time"].values[[0, -1]]
    return (
        f"Measured: {_frames(fields)} frames over {duration(float((last - first) / np.timedelta64(1, 's')))}, reduced to "
        f"{fields.sizes['cycle']} fields; no laser was used, so nothing is said of the positioning."
    )


def _frames(fields: xr.Dataset) -> int:
    """Number of frames that the fields are made from."""
    return int(fields["frame_count"].sum()) if "frame_count" in fields else fields.sizes["time"]


def _approaches(deviations: xr.Dataset) -> str:
    """From which sides the positions were approached, in words."""
    read = deviations["deviation"].notnull().any(("cycle", "target"))
    sides = [str(name) for name in read["direction"].values[read.values]]
    return "from both sides" if len(sides) == 2 else f"in the {sides[0]} direction only"


def _numbers(results: Results, deviations: xr.Dataset | None, fields: xr.Dataset | None) -> list[dict[str, str]]:
    """Return the key figures: name, value, and a note."""
    numbers: list[dict[str, str]] = []

    def add(name: str, value: str, note: str) -> None:
        numbers.append({"name": name, "value": value, "note": note})

    if results.drift is not None and results.drift.range_um:
        at = int(np.nanargmax(np.array(results.drift.range_um, float)))
        add(
            "Largest drift",
            measured(results.drift.range_um[at], results.drift.range_u_um[at], "µm"),
            f"at position {at + 1} ({results.drift.position_mm[at]:g} mm), during the test; {drift_u_note(results.iso230)}",
        )
    if results.iso230 is not None:
        quoted = quoted_window(results.iso230)
        symbol, value = next(iter(quoted_values(quoted).items()))
        term = ISO230_TERMS.get(symbol, f"Unidirectional positioning accuracy {symbol}")
        add(term, value, f"{quoted.window} {condition(results.inputs, 'positions')}".rstrip())
    if fields is not None:
        rise = fields["temperature_rise"].isel(cycle=-1)
        # The noise of single cells averages out over the plan; what all share does not.
        u = None if results.radiometry is None else results.radiometry.rise_u.common_K
        add(
            f"Rise of the {_camera_words(results)['seen']}",
            measured(float(rise.mean()), u, "K"),
            f"mean of the last {_camera_words(results)['field_of']}; {_warmest(results, rise)} "
            f"{condition(results.inputs, 'field')}".rstrip(),
        )
    if results.loop is not None:
        loop = results.loop
        final, declared, last = alike((loop.rmse_final_um, loop.rmse_declared_um, loop.rmse_persistence_um))
        add(
            f"Prediction error, {loop.held_out.split(' held out')[0]}",
            f"{final} µm",
            f"not used for the fit; declared model {declared} µm, last cycle repeated {last} µm",
        )
    return numbers


def _warmest(results: Results, rise: xr.DataArray) -> str:
    """The largest rise in the last cycle: that of the hottest spot as the table of hotspots has it, or of a cell."""
    spots = [spot for spot in results.hotspots or () if spot.peak_rise_K is not None]
    if not spots:
        return f"warmest cell {number(float(rise.max()))} K"
    hottest = max(spots, key=lambda spot: spot.peak_rise_K or 0.0)
    return f"{hottest.name or 'hottest spot'} {measured(hottest.peak_rise_K, hottest.peak_rise_u_K, 'K')}"


def _data_rows(
    results: Results, provenance: Mapping[str, Any], deviations: xr.Dataset | None, fields: xr.Dataset | None
) -> list[tuple[str, str]]:
    """Return what was recorded, by name."""
    rows = []
    if deviations is not None:
        readings = int(np.isfinite(deviations["deviation"]).sum())
        origin = deviations["time"].attrs.get("origin", "recorded")
        rows.append(("Readings", f"{readings} of {deviations['deviation'].size} possible; times {origin}"))
        if has(deviations, "drift"):
            rows.append(("Time", _span(*time_span(deviations), results)))
    if fields is not None:
        first, last = fields["time"].values[[0, -1]]
        clock = ", on the laser's clock" if results.alignment is not None else ""
        rows.append(("Frames", f"{_frames(fields)}, {_span(first, last, results)}{clock}"))
        cell = float(np.median(np.diff(fields["x"])))
        unit = plan_unit(fields)
        of = ", the whole picture: nothing is known in mm" if unit == "px" else ""
        rows.append(("Plan", f"{fields.sizes['x']} × {fields.sizes['y']} cells of {cell:g} {unit}{of}"))
        visible = float(np.isfinite(fields["temperature_rise"].isel(cycle=-1)).mean())
        rest = "pixels without a value" if unit == "px" else "masked (fiducials, edges) or outside the frame"
        rows.append(("Visible", f"{visible:.0%} of the plan" + (f"; the rest is {rest}" if visible < 1.0 else "")))
    if results.alignment is not None:
        rows.append(("Clock offset", _clock_offset(results.alignment.clock_offset_s)))
    rows.append(("Input files", f"{len(provenance['inputs'])}, listed with their SHA-256 under Provenance"))
    return rows


def _span(first: np.datetime64, last: np.datetime64, results: Results) -> str:
    """From when to when, in local time and UTC where the campaign states a zone."""
    zone = results.time.zone if results.time else None
    local = f"{moment(first, zone)} to {moment(last, zone)}"
    return local if zone in (None, "UTC") else f"{local} ({moment(first)} to {moment(last)})"


def _clock_offset(offset: Quantity) -> str:
    source = "assumed" if offset.u is None else "as given" if offset.u == 0 else "from the table's motion"
    return f"{quantity(offset, 's')}, camera minus laser, {source}"


def _fiducials_table(fields: xr.Dataset) -> Table:
    """Return the registration residual and the leave-one-out error of every fiducial."""
    rows = [
        [str(fields["fiducial_name"].values[k])]
        + [number(float(fields[name].values[k]), 2) for name in ("fiducial_residual", "fiducial_leave_one_out")]
        for k in range(fields.sizes["fiducial"])
    ]
    return table([Words("Fiducial"), "Residual / mm", "Leave-one-out / mm"], rows)


def _field_uncertainty(part: RadiometryPart) -> str:
    """Return both parts of the uncertainty of temperature and rise as sentences."""
    temperature, rise = part.temperature_u, part.rise_u
    assumed = any(entry.source == "assumed" for entry in part.budget)
    drift = next((entry.u for entry in part.budget if entry.input == "camera_drift_K"), None)
    sentences = [
        "Standard uncertainty of a cell, root mean square over the plan in the last cycle: temperature "
        f"{number(temperature.total_K, 2)} K, of which {number(temperature.noise_K, 2)} K differ from cell to cell (noise, registration) "
        f"and {number(temperature.common_K, 2)} K are common to all; rise {number(rise.total_K, 2)} K, of which "
        f"{number(rise.noise_K, 2)} K noise and registration, and {number(rise.common_K, 2)} K common.",
    ]
    if part.rise_scale_u is not None:
        sentences.append(
            f"Emissivity, reflections, air and scale of the camera make every rise uncertain by {100 * part.rise_scale_u:.2g} % of itself."
        )
    sentences.append(
        f"The camera's zero makes rises uncertain by up to {number(drift, 2)} K, which is contained."
        if drift
        else "A drift of the camera's zero is not part of these figures: it was neither examined nor stated."
    )
    if assumed:
        sentences.append("Inputs without a stated uncertainty have an assumed one, see the budget below.")
    return " ".join(sentences)


def _budget_table(part: RadiometryPart) -> Table:
    """Return every input that all frames share with its contributions to temperature and rise."""
    rows = [
        [
            INPUT_NAMES.get(entry.input, entry.input),
            "–" if entry.value is None else f"{entry.value:.5g}",
            number(entry.u, 2),
            entry.source,
            number(entry.temperature_u_K, 2),
            number(entry.rise_u_percent, 2),
        ]
        for entry in part.budget
    ]
    titles = ("Value", "Standard uncertainty u", Words("u is"), "In the temperature / K", "In a rise / % of it")
    return table([Words("Input common to all frames"), *titles], rows)


def _surfaces_table(part: RadiometryPart) -> Table:
    """Return the surfaces of different emissivity."""
    rows = [
        [
            surface.name or "rest of the table",
            measured(surface.emissivity.value, surface.emissivity.u),
            surface.source,
            str(surface.cells),
            "–" if surface.rise_scale_u is None else f"{100 * surface.rise_scale_u:.2g}",
            number(surface.monte_carlo_ratio, 3),
        ]
        for surface in part.surfaces
    ]
    titles = (
        "Emissivity (k = 2)",
        Words("from"),
        "Cells",
        "Scale of the rise, u / %",
        "Monte Carlo over first order",
    )
    return table([Words("Surface"), *titles], rows)


def _sensors_table(sensors: Sequence[ContactSensorPart]) -> Table:
    """Return name, place and rise of every contact sensor, the camera's rise there, and whether it is used."""
    seen = any(sensor.camera_rise_K is not None for sensor in sensors)
    rows = [
        [
            sensor.name,
            place(sensor.x_mm, sensor.y_mm),
            number(sensor.rise_K, 3),
            *([number(sensor.camera_rise_K, 3)] if seen else ()),
            "used" if sensor.used else f"left out: {sensor.fault}",
        ]
        for sensor in sensors
    ]
    titles = ["Rise / K", *(["Camera at its place / K"] if seen else []), Words("State")]
    return table([Words("Sensor"), Words("Place"), *titles], rows)


def _hotspots_table(results: Results) -> Table:
    """Return name, area, peak, rise, and the positions whose drift goes with every hotspot."""
    tested = results.drift is not None
    columns = [
        Words("Hotspot"),
        Words("Area"),
        Words("Peak at"),
        Words("Middle of the area"),
        "Peak rise / K (k = 2)",
        *((Words("Positions whose drift goes with it"), "p (family-wise)", "Lag") if tested else ()),
    ]
    least = results.correlation.least_p if results.correlation else None
    rows = [
        [
            spot.name,
            *spot_places(spot),
            measured(spot.peak_rise_K, spot.peak_rise_u_K),
            *(
                (
                    ", ".join(map(str, spot.targets)) or "none shown by these data",
                    p_cell(spot.p_value, least),
                    duration(spot.lag_s),
                )
                if tested
                else ()
            ),
        ]
        for spot in results.hotspots or ()
    ]
    return table(columns, rows)


def _positions_table(deviations: xr.Dataset) -> Table:
    """Return profile, scatter and conventional standard deviation of every position and approach."""
    drift, conventional = group(deviations, "drift"), group(deviations, "conventional")
    decimals = {name: decimals_of(float(drift[f"{name}_u"].median())) for name in ("profile", "scatter")}
    targets = deviations["target"].values
    laid = {name: by_approach(drift[name], target=targets) for key in decimals for name in (key, f"{key}_u")}
    s = by_approach(conventional["standard_deviation"], target=targets)
    rows = []
    for at, (target, position_mm) in enumerate(zip(targets, deviations["position"].values, strict=True)):
        row = [str(target), f"{position_mm:g}"]
        for name, places in decimals.items():
            both = zip(laid[name][at], laid[f"{name}_u"][at], strict=True)
            row += [measured(float(value), float(u), decimals=places) for value, u in both]
        rows.append([*row, *(f"{value:.2f}" for value in s[at])])
    quantities = ("Profile", "Scatter s", "Conventional s")
    return table(["Position", "mm", *(f"{name} {sign} / µm" for name in quantities for sign in _SIGNS.values())], rows)


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
    rows = [
        [str(link), *(f"{value:.2f}" for value in of_link.ravel())] for link, of_link in zip(links, values, strict=True)
    ]
    return table(["Position", *(headings[name].format(sign) for sign in _SIGNS.values() for name in columns)], rows)


def _neighbours_text(part: NeighboursPart) -> str:
    ratio = part.ratio.values()
    return (
        f"The conventional standard deviation is {min(ratio):.2f} to {max(ratio):.2f} times that of the differences. This ratio measures "
        "the drift, not the quality of an evaluation: it is 0.71 without drift. The chain of "
        "mean differences gives exactly the conventional mean profile: differencing removes the drift from the standard deviation, not "
        "from the mean. What the paper's equations (5) and (6) divide by n (n − 1) is the standard uncertainty of a mean; the charts "
        "here show sample standard deviations."
    )


def _anomalies(results: Results) -> list[dict[str, Any]]:
    """Return every position that stands out, with its evidence."""
    described = []
    for anomaly in results.anomalies or ():
        where = anomaly_place(anomaly)
        described.append(
            {
                "title": f"{where[0].upper()}{where[1:]}: {anomaly_cause(anomaly)}",
                "sentence": describe_anomaly(anomaly),
                **describe_evidence(anomaly.evidence),
            }
        )
    return described


def _describe_loop(loop: Loop) -> dict[str, Any]:
    """Return the section on the model."""
    assert isinstance(loop, AxisLoop)
    return {
        "numbers": prediction_sentence(loop),
        "steps": steps_table(loop),
        "step_names": [effect_words(step.effect).name for step in loop.steps],
        "errors": errors_table(loop),
        "held_out": loop.held_out,
        "noise": f"{number(loop.noise_floor_um, 2)} µm",
        "shape": loop.unexplained.shape,
        "shape_rms": f"{number(loop.unexplained.rms_um, 2)} µm",
        "residual": describe_residual(loop.residual_tests.declared, loop.residual_tests.final),
        "model": describe_model(loop),
        "identifiability": describe_identifiability(loop),
        "candidates": describe_candidates(loop),
    }


def _uncertainty(results: Results, fields: xr.Dataset | None) -> list[str]:
    """Return what the numbers are worth, sentence by sentence."""
    sentences = []
    if results.drift is not None:
        sentences.append(
            "Profile and drift come from one estimate over all readings at their own times (generalised least squares under a "
            "random drift); their uncertainty contains the noise of the readings and what the drift could have done between "
            "them. It does not contain errors of the laser, its alignment, the temperature of the material or the expansion coefficient."
        )
    if results.iso230 is not None and results.iso230.settled is not None:
        sentences.append(f"ISO 230-2 values: {contained_sentence(results.iso230.settled)}")
    if fields is not None:
        sentences.append(
            "Temperatures hold for the emissivity with which they were calculated: of the campaign file, else of the camera. A constant "
            "error of the camera cancels in the rise; an error of the emissivity by 1 % is one of every rise by about 1 %, and of every "
            "coefficient per kelvin, whose uncertainty contains it. A surface with another emissivity (bare metal, oil) is right only "
            "where the campaign names it as a region."
        )
    if results.loop is not None:
        sentences.append(
            "The verdict says what these data can show, not what is true of the machine: an effect that moves all positions "
            "alike, slowly and unlogged, looks like drift without a cause. The errors before and after come from coefficients "
            "fitted without the held-out cycles."
        )
        sentences.append(DECIDED_BEFORE)
        for step in results.loop.steps:
            name = effect_words(step.effect).name
            sentences.append(f"{name[0].upper()}{name[1:]}: {step.confirmed_by}.")
    return [*sentences, *_levels(results)]


def _levels(results: Results) -> list[str]:
    """Return at which level each p-value is judged, and what it is corrected for."""
    sentences = []
    if results.loop is not None:
        sentences.append(
            f"Closed loop: p is family-wise over all candidates of a round. An effect enters at p up to {_percent(SEARCH_LEVEL)} in the "
            f"search before the hold-out, and at p up to {_percent(SECOND_LEVEL)} in the search over all cycles that follows: "
            f"{_percent(ENTRY_LEVEL)} together where nothing is missing. A pattern of positions is reported as left at p up to "
            f"{_percent(REMAINDER_LEVEL)}, family-wise over its shapes."
        )
        sentences.append(
            "Table of the residual: every shape is tested by itself, its p-value is not corrected for the number of shapes."
        )
    if results.anomalies is not None:
        # The level of `interferometry.anomalies.detect_anomalies`, and the stricter one of a cause.
        sentences.append(
            "Anomalies: p is family-wise over all positions and approaches, at a level of 5 %; a cause is named at p up to 2 % only."
        )
    if results.correlation is not None:
        sentences.append(
            "Drift and field: p is family-wise over cells, modes and regions together, at a level of "
            f"{_percent(ATTRIBUTION_LEVEL)}; the p-values of single positions and of switched loads have a family of their own."
        )
    return sentences


def _percent(level: float) -> str:
    return f"{100 * level:g} %"
