"""The stage that evaluates the readings, and the alignment of both recordings."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from fusion.alignment.align import AxisGeometry, align, align_logs
from fusion.alignment.sensor_line import add_sensor_line
from fusion.campaign.iso_budget import material_by_cycle
from fusion.campaign.sources import LaserInputs, Source
from fusion.consistency.place import find_gaps, gap_words, in_gaps
from fusion.consistency.readings import find_gross_readings
from fusion.pipeline.iso230.evaluation import evaluate_standard
from fusion.pipeline.stages import LABELS
from fusion.products.grouped import group, joined
from fusion.products.notices import counted, listed
from fusion.products.progress import Report, silent
from fusion.products.results import Notice, Outcome
from fusion.report.wording import moment
from interferometry import neighbours
from interferometry.deviations import OUTLIER
from interferometry.drift.estimate import estimate_drift, flag_outliers
from thermography.fields.cycle_fields import cycles_with_field

#: Share of the readings that may lie outside the frames' time before the next test should be filmed otherwise.
_OUTSIDE_SHARE = 0.05


def evaluate_interferometry(source: LaserInputs, *, report: Report = silent) -> Outcome:
    """Evaluate the readings conventionally, by the paper's differences, by ISO 230-2 and by the joint estimate.

    Parameters
    ----------
    source : LaserInputs
        Inputs of the campaign; its readings are compensated.
    report : callable
        ``report(label, done, total)``, for progress.

    Returns
    -------
    Outcome
        Content of deviations.nc; parts ``iso230``, ``neighbours`` and ``drift``.
    """
    report(LABELS["deviations"], 0, 1)
    deviations = source.deviations
    times = deviations["time"].values[np.isfinite(deviations["deviation"].values)]
    drift = None if np.isnat(times).all() else estimate_drift(deviations)
    deviations = deviations if drift is None else flag_outliers(deviations, drift)
    comparison = neighbours.compare(deviations, drift)
    windows, settled, standard = evaluate_standard(
        deviations,
        source.iso_budget,
        drift=None if drift is None else drift["drift"],
        material_degC=material_by_cycle(deviations, source.environment),
    )
    dataset = joined(
        deviations,
        conventional=neighbours.evaluate_conventional(deviations),
        neighbours=neighbours.evaluate_neighbours(deviations),
        comparison=comparison,
        chart=neighbours.build_chart(deviations),
        iso=windows,
        settled=settled,
        **({} if drift is None else {"drift": drift}),
    )
    zone = source.campaign.zone_of("interferometry")
    parts: dict[str, Any] = {
        "iso230": standard,
        "neighbours": {
            "conventional_s_um": by_direction(comparison["conventional"]),
            "pair_s_um": by_direction(comparison["differenced"]),
            "ratio": by_direction(comparison["ratio"]),
        },
    }
    if drift is not None:
        parts["time"] = {"first": utc(times.min()), "last": utc(times.max()), "zone": zone}
        parts["drift"] = _drift_part(deviations, drift)
    report(LABELS["deviations"], 1, 1)
    return Outcome(dataset, parts, (*_scatter_notices(drift), *_reading_notices(deviations, drift, zone)))


def utc(time: np.datetime64) -> str:
    """Return a time as results.json writes it, ISO 8601 in UTC to the second.

    Parameters
    ----------
    time : datetime64
        UTC.
    """
    return f"{np.datetime_as_string(time, unit='s')}Z"


def _drift_part(deviations: xr.Dataset, drift: xr.Dataset) -> dict[str, Any]:
    """Return the part ``drift`` of results.json."""
    return {
        "profile_um": by_direction(drift["profile"]),
        "profile_u_um": by_direction(drift["profile_u"]),
        "scatter_um": by_direction(drift["scatter"]),
        "position_mm": deviations["position"].values.tolist(),
        **_drift_ranges(drift),
    }


def _drift_ranges(drift: xr.Dataset) -> dict[str, list[float]]:
    """Return the range of every target's drift, mean of both approaches, with its standard uncertainty, um."""
    course = drift["drift"].mean("direction")
    u = drift["drift_u"].mean("direction").max("cycle") * np.sqrt(2.0)
    ranges = course.max("cycle") - course.min("cycle")
    return {"range_um": ranges.values.tolist(), "range_u_um": u.values.tolist()}


def _approach_notices(deviations: xr.Dataset) -> list[Notice]:
    """Return the notice that a test of one approach has no bidirectional values."""
    read = deviations["deviation"].notnull().any(("cycle", "target"))
    sides = [str(name) for name in read["direction"].values[read.values]]
    if len(sides) == 2:
        return []
    return [
        Notice(
            "one_approach",
            f"Positions were approached in the {sides[0]} direction only: unidirectional values are given; reversal error, bidirectional "
            "values and the drift of the reversal need both.",
            "Approach every position from both sides.",
        )
    ]


def _scatter_notices(drift: xr.Dataset | None) -> list[Notice]:
    """Return the notice that the drift between readings hides their noise."""
    if drift is None or not drift.attrs["scatter_undetermined"]:
        return []
    sigma = float(drift["sigma"])
    return [
        Notice(
            "scatter_undetermined",
            "The drift from one reading to the next is so large that the noise of the readings vanishes beside it: the search for the "
            f"variances ended at its limit. The scatter of {sigma:.2g} µm is that limit, not a measured value, and the true one may be "
            "far smaller; uncertainties, outliers and positions that stand out rest on it.",
            "Let the machine come to rest before the test, or read the positions in quicker succession; check whether the readings were "
            "averaged or smoothed before they were written.",
        )
    ]


def _reading_notices(deviations: xr.Dataset, drift: xr.Dataset | None, zone: str | None) -> list[Notice]:
    """Return notices for missing readings, with what they cost the profile, and for readings that were given little weight."""
    notices = _approach_notices(deviations)
    approached = deviations["deviation"].notnull().any(("cycle", "target")).values
    gaps = np.isnan(deviations["deviation"].values) & approached[:, None]
    if gaps.any():
        cycles = [str(cycle) for cycle in deviations["cycle"].values[gaps.any(axis=(1, 2))]]
        missing = (
            f"{counted(int(gaps.sum()), 'reading')} of {gaps[:, approached].size} missing, in {counted(len(cycles), 'cycle')}: "
            f"{listed(cycles)}."
        )
        if drift is None:
            notices.append(Notice("readings_missing", f"{missing} The values use the remaining readings.", remedy=""))
        else:
            share = np.sqrt(1.0 - gaps.mean(axis=0))
            wider = float(np.nanmax(drift["profile_u"].values * (1.0 - share)))
            effect = f"This widens the profile's standard uncertainty by up to {wider:.3f} µm."
            remaining = "The joint estimate allows for gaps; conventional values use the remaining readings."
            notices.append(Notice("readings_missing", f"{missing} {effect} {remaining}", remedy="", effect_um=wider))
    outliers = (deviations["quality_flag"] & OUTLIER.mask) > 0
    if outliers.any():
        named = _names(outliers, deviations, zone)
        notices.append(
            Notice(
                "outliers",
                f"{counted(len(named), 'outlier')} down-weighted in the joint estimate: {listed(named)}. Conventional values "
                "contain them.",
                f"Compare {_file(deviations)} with the logs of machine and laser: {listed(named)}.",
            )
        )
    return notices


def by_direction(values: xr.DataArray) -> dict[str, list[float]]:
    """Return an array over direction and target as lists per direction.

    Parameters
    ----------
    values : (direction, target) DataArray
        One number per target and direction of approach.
    """
    return {str(name): np.asarray(values.sel(direction=name), float).tolist() for name in values["direction"].values}


def align_recordings(source: Source, fields: xr.Dataset, deviations: xr.Dataset) -> tuple[xr.Dataset, list[Notice]]:
    """Give every reading the field, the environment and the drivers at its own time; note readings outside the frames' time.

    Parameters
    ----------
    source : Source
        Inputs of the campaign.
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``, on the laser's clock.
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.

    Returns
    -------
    Dataset
        Result of `fusion.alignment.align.align`, without the readings that are errors of reading.
    list of Notice
        Readings that were left out, or lie outside the frames.
    """
    used, gross = _without_gross(deviations)
    fused = align(used, fields, source.axis, environment=source.environment, drivers=source.drivers)
    return fused, [
        *_gross_notices(deviations, gross, source.campaign.zone_of("interferometry")),
        *_outside_notices(fused),
        *_gap_notices(fields, deviations),
    ]


def align_with_logs(source: LaserInputs, deviations: xr.Dataset) -> tuple[xr.Dataset, list[Notice]]:
    """Give every reading the environment and the drivers at its own time, where there are no frames.

    Parameters
    ----------
    source : LaserInputs
        Inputs of the campaign.
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.

    Returns
    -------
    Dataset
        Result of `fusion.alignment.align.align_logs`, without the readings that are errors of reading.
    list of Notice
        Readings that were left out.
    """
    used, gross = _without_gross(deviations)
    fused = align_logs(used, environment=source.environment, drivers=source.drivers)
    sensors, plan = source.sensors, source.campaign.plan
    if sensors is not None and plan is not None and plan.axis is not None:
        axis = AxisGeometry(plan.axis.origin_mm, plan.axis.direction)
        fused = add_sensor_line(fused, sensors.temperature, sensors.x_mm, sensors.y_mm, axis, file=sensors.file)
    return fused, [
        *_sensor_notices(fused),
        *_gross_notices(deviations, gross, source.campaign.zone_of("interferometry")),
    ]


def _sensor_notices(fused: xr.Dataset) -> list[Notice]:
    """Return the notice that contact sensors stand for the camera, with what the line between them misses."""
    if "interpolation_u" not in fused:
        return []
    missed, share = float(fused["interpolation_u"]), float(fused["axis_scale_u"])
    return [
        Notice(
            "sensors_for_the_camera",
            "The rise along the axis comes from contact sensors, on a straight line from one to the next. A sensor is missed by the "
            f"line through the others by {missed:.2g} K ({share:.0%} of the rise), which enters the uncertainty of every coefficient "
            "per kelvin; a warm spot between the sensors is not seen.",
            "Place sensors where the table warms most, evenly along the axis.",
        )
    ]


def _without_gross(deviations: xr.Dataset) -> tuple[xr.Dataset, xr.DataArray]:
    """Return the readings without those that are errors of reading, and which these are."""
    gross = find_gross_readings(group(deviations, "drift")["standardised"])
    return deviations.assign(deviation=deviations["deviation"].where(~gross)), gross


def _gross_notices(deviations: xr.Dataset, gross: xr.DataArray, zone: str | None) -> list[Notice]:
    """Return a notice for the readings that are errors of reading."""
    if not gross.any():
        return []
    deviation, named = deviations["deviation"], _names(gross, deviations, zone)
    largest = float(np.abs(deviation.where(gross) - deviation.median("cycle")).max())
    return [
        Notice(
            "gross_readings",
            f"{counted(int(gross.sum()), 'reading')} more than ten standard deviations of their position off, by up to {largest:.3g} µm: "
            f"{listed(named)}; left out where drift and field are compared and modelled.",
            f"Check {listed(named)} (beam, unit, typing error), and correct or remove these readings in {_file(deviations)}.",
        )
    ]


def _names(marked: xr.DataArray, deviations: xr.Dataset, zone: str | None) -> list[str]:
    """Return cycle, position, approach and time of every reading that is marked (cycle, direction, target)."""
    cycle, direction, target = (marked[name].values for name in marked.dims)
    time, position = deviations["time"].values, deviations["position"].values
    return [
        f"cycle {cycle[c]}, position {target[t]} ({position[t]:g} mm), {direction[d]} approach, {moment(time[c, d, t], zone)}"
        for c, d, t in np.argwhere(marked.values)
    ]


def _file(deviations: xr.Dataset) -> str:
    """Return the name of the file of the readings."""
    return str(deviations.attrs.get("source", "the file of the readings"))


def _gap_notices(fields: xr.Dataset, deviations: xr.Dataset) -> list[Notice]:
    """Return a notice for gaps between the frames in which readings were taken, with the cycles that have no frame."""
    gaps = find_gaps(fields["time"].values)
    inside = in_gaps(deviations["time"], gaps)
    if not inside.any():
        return []
    empty = fields["cycle"].values[~cycles_with_field(fields["temperature"])]
    without = f"; cycles without a frame: {listed(str(cycle) for cycle in empty)}" if empty.size else ""
    return [
        Notice(
            "frames_gaps",
            f"{counted(len(gaps), 'gap')} between the frames: {listed(gap_words(gap) for gap in gaps)}{without}. The field of "
            f"{counted(int(inside.sum()), 'reading')} in them is interpolated.",
            "Give all frames of the test.",
        )
    ]


def _outside_notices(fused: xr.Dataset) -> list[Notice]:
    """Return a notice for readings that lie outside the frames' time."""
    outside = (fused["deviation"].notnull() & ~fused["inside_frames"]).values
    if not outside.any():
        return []
    cycles = [str(cycle) for cycle in fused["cycle"].values[outside.any(axis=(1, 2))]]
    many = outside.sum() > _OUTSIDE_SHARE * fused["deviation"].notnull().values.sum()
    return [
        Notice(
            "readings_outside_frames",
            f"{counted(int(outside.sum()), 'reading')} outside the frames' time, in {counted(len(cycles), 'cycle')} ({listed(cycles)}); "
            "evaluated, but not used where drift and field are compared.",
            "Start the camera before the first cycle and stop it after the last one." if many else "",
        )
    ]
