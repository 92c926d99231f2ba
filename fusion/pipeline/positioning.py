"""The stage that evaluates the readings, and the alignment of both recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr

from fusion.analysis.alignment.align import AxisGeometry, add_sensor_line, align, align_logs
from fusion.analysis.consistency.camera import find_gaps, gap_words, in_gaps
from fusion.analysis.consistency.deviations import find_gross_readings
from fusion.analysis.diagnosis.diagnose import Diagnosis, diagnose, diagnose_link
from fusion.analysis.levels import POSITION_LEVEL
from fusion.campaign.inputs import LaserInputs, Source, lacks_course
from fusion.campaign.time_zones import shown_zone, utc
from fusion.pipeline.iso230 import estimate_joint, evaluate_standard
from fusion.results.axis import AnomalyPart, DriftPart, Evidence, NeighboursPart
from fusion.results.numbers import moment
from fusion.results.parts import ByDirection, TimePart
from fusion.results.progress import Report, counted, listed, silent
from fusion.results.results import Notice, Outcome, Parts
from fusion.results.store import group, joined
from interferometry import neighbours
from interferometry.anomalies import Anomaly, detect_anomalies, without_jumps
from interferometry.deviations import OUTLIER
from interferometry.drift.estimate import estimate_drift, flag_outliers
from thermography.fields.cycle_fields import cycles_with_field

#: Share of the readings that may lie outside the frames' time before the next test should be filmed otherwise.
_OUTSIDE_SHARE = 0.05


def evaluate_interferometry(source: LaserInputs, *, report: Report = silent) -> Outcome:
    """Evaluate the readings conventionally, by the paper's differences, by ISO 230-2 and by the joint estimate."""
    report("deviations", 0, 1)
    deviations = source.deviations
    times = deviations["time"].values[np.isfinite(deviations["deviation"].values)]
    drift, digits = estimate_joint(deviations)
    deviations = deviations if drift is None else flag_outliers(deviations, drift)
    windows, quoted, standard = evaluate_standard(
        deviations, source.iso_budget, drift=drift, environment=source.environment, cycles=source.iso_cycles
    )
    groups, parts = {"iso": windows, "quoted": quoted}, Parts(iso230=standard)
    if not lacks_course(deviations):
        comparison = neighbours.compare(deviations, drift)
        groups |= {
            "conventional": neighbours.evaluate_conventional(deviations),
            "neighbours": neighbours.evaluate_neighbours(deviations),
            "comparison": comparison,
            "chart": neighbours.build_chart(deviations),
        }
        parts.neighbours = NeighboursPart(
            conventional_s_um=by_direction(comparison["conventional"]),
            pair_s_um=by_direction(comparison["differenced"]),
            ratio=by_direction(comparison["ratio"]),
        )
    groups |= {} if drift is None else {"estimate": drift}
    dataset = joined(deviations, **groups)
    zone = shown_zone(deviations, source.campaign.zone_of("interferometry"))
    if not np.isnat(times).all():
        parts.time = TimePart(first=utc(times.min()), last=utc(times.max()), zone=zone)
    if drift is not None:
        course = drift["drift"].mean("direction")
        # No estimate knows the change from one half of the test to the other better than the means of the readings in both: a drift
        # whose variance is estimated as zero has no uncertainty of its own.
        least_u = 2.0 * drift["sigma"] / np.sqrt(deviations["deviation"].notnull().sum(("cycle", "direction")))
        range_u = np.maximum(drift["drift_u"].mean("direction").max("cycle") * np.sqrt(2.0), least_u)
        parts.drift = DriftPart(
            profile_um=by_direction(drift["profile"]),
            profile_u_um=by_direction(drift["profile_u"]),
            scatter_um=by_direction(drift["scatter"]),
            position_mm=deviations["position"].values.tolist(),
            # Of the mean of both approaches.
            range_um=(course.max("cycle") - course.min("cycle")).values.tolist(),
            range_u_um=range_u.values.tolist(),
        )
    report("deviations", 1, 1)
    return Outcome(dataset, parts, (*digits, *_scatter_notices(drift), *_reading_notices(deviations, drift, zone)))


def _approach_notices(deviations: xr.Dataset) -> Iterator[Notice]:
    """Return the notice that a test of one approach has no bidirectional values."""
    read = deviations["deviation"].notnull().any(("cycle", "target"))
    sides = [str(name) for name in read["direction"].values[read.values]]
    if len(sides) == 1:
        yield Notice.of("one_approach", side=sides[0])


def _scatter_notices(drift: xr.Dataset | None) -> Iterator[Notice]:
    """Return the notices that the digits of the readings, or the drift between them, hide their noise."""
    if drift is None:
        return
    sigma, step = float(drift["sigma"]), float(drift["resolution"])
    if sigma < step:
        yield Notice.of("coarse_digits", step=step, sigma=sigma)
    if not drift.attrs["scatter_undetermined"]:
        return
    yield Notice.of("scatter_undetermined", sigma=sigma)


def _reading_notices(deviations: xr.Dataset, drift: xr.Dataset | None, zone: str | None) -> Iterator[Notice]:
    """Return notices for missing readings, with what they cost the profile, and for readings that were given little weight."""
    yield from _approach_notices(deviations)
    approached = deviations["deviation"].notnull().any(("cycle", "target")).values
    gaps = np.isnan(deviations["deviation"].values) & approached[:, None]
    if gaps.any():
        cycles = [str(cycle) for cycle in deviations["cycle"].values[gaps.any(axis=(1, 2))]]
        of_all = f"{counted(int(gaps.sum()), 'reading')} of {gaps[:, approached].size} missing"
        missing = f"{of_all}, in {counted(len(cycles), 'cycle')}: {listed(cycles)}."
        if drift is None:
            yield Notice.of("readings_missing", missing=missing)
        else:
            share = np.sqrt(1.0 - gaps.mean(axis=0))
            wider = float(np.nanmax(drift["profile_u"].values * (1.0 - share)))
            yield Notice.of("readings_missing_jointly", code="readings_missing", effect_um=wider, missing=missing)
    outliers = (deviations["quality_flag"] & OUTLIER.mask) > 0
    if outliers.any():
        named = _names(outliers, deviations, zone)
        yield Notice.of(
            "outliers", outliers=counted(len(named), "outlier"), named=listed(named), file=_file(deviations)
        )


def by_direction(values: xr.DataArray) -> ByDirection:
    """Return an array over direction and target as one value per target for each direction."""
    return ByDirection(**{str(one): values.sel(direction=one).values.tolist() for one in values["direction"].values})


def align_recordings(source: Source, fields: xr.Dataset, deviations: xr.Dataset) -> tuple[xr.Dataset, list[Notice]]:
    """Give every reading the field, the environment and the drivers at its own time; note readings outside the frames' time."""
    used, notices = _without_gross(deviations, shown_zone(deviations, source.campaign.zone_of("interferometry")))
    fused = align(used, fields, source.axis, environment=source.environment, drivers=source.drivers)
    return fused, [*notices, *_outside_notices(fused), *_gap_notices(fields, deviations)]


def align_with_logs(source: LaserInputs, deviations: xr.Dataset) -> tuple[xr.Dataset, list[Notice]]:
    """Give every reading the environment and the drivers at its own time, where there are no frames."""
    used, notices = _without_gross(deviations, shown_zone(deviations, source.campaign.zone_of("interferometry")))
    fused = align_logs(used, environment=source.environment, drivers=source.drivers)
    sensors, plan = source.sensors, source.campaign.plan
    if sensors is not None and plan is not None and plan.axis is not None:
        axis = AxisGeometry(plan.axis.origin_mm, plan.axis.direction)
        fused = add_sensor_line(fused, sensors.temperature, sensors.x_mm, sensors.y_mm, axis, file=sensors.file)
    return fused, [*_sensor_notices(fused), *notices]


def _sensor_notices(fused: xr.Dataset) -> Iterator[Notice]:
    """Return the notice that contact sensors replace the camera, with what the line between them misses."""
    if "interpolation_u" in fused:
        missed, share = float(fused["interpolation_u"]), float(fused["axis_scale_u"])
        yield Notice.of("sensors_for_the_camera", missed=missed, share=share)


def _without_gross(deviations: xr.Dataset, zone: str | None) -> tuple[xr.Dataset, list[Notice]]:
    """Return the readings without those that are errors of reading, and a notice of these."""
    gross = find_gross_readings(group(deviations, "estimate")["standardised"])
    if not gross.any():
        return deviations, []
    deviation, named = deviations["deviation"], _names(gross, deviations, zone)
    largest = float(np.abs(deviation.where(gross) - deviation.median("cycle")).max())
    notice = Notice.of(
        "gross_readings",
        readings=counted(int(gross.sum()), "reading"),
        largest=largest,
        named=listed(named),
        file=_file(deviations),
    )
    return deviations.assign(deviation=deviation.where(~gross)), [notice]


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


def _gap_notices(fields: xr.Dataset, deviations: xr.Dataset) -> Iterator[Notice]:
    """Return a notice for gaps between the frames in which readings were taken, with the cycles that have no frame."""
    gaps = find_gaps(fields["time"].values)
    inside = in_gaps(deviations["time"], gaps)
    if not inside.any():
        return
    empty = fields["cycle"].values[~cycles_with_field(fields["temperature"])]
    without = f"; cycles without a frame: {listed(str(cycle) for cycle in empty)}" if empty.size else ""
    yield Notice.of(
        "frames_gaps",
        gaps=counted(len(gaps), "gap"),
        named=listed(gap_words(gap) for gap in gaps),
        without=without,
        readings=counted(int(inside.sum()), "reading"),
    )


def _outside_notices(fused: xr.Dataset) -> Iterator[Notice]:
    """Return a notice for readings that lie outside the frames' time."""
    outside = (fused["deviation"].notnull() & ~fused["inside_frames"]).values
    if not outside.any():
        return
    cycles = [str(cycle) for cycle in fused["cycle"].values[outside.any(axis=(1, 2))]]
    many = outside.sum() > _OUTSIDE_SHARE * fused["deviation"].notnull().values.sum()
    yield Notice(
        "readings_outside_frames",
        f"{counted(int(outside.sum()), 'reading')} outside the frames' time, in {counted(len(cycles), 'cycle')} ({listed(cycles)}); "
        "evaluated, but not used where drift and field are compared.",
        "Start the camera before the first cycle and stop it after the last one." if many else "",
    )


# Positions that stand out from what the model explains, and their cause.

#: A rare kind reaches the level with so many permutations.
_PERMUTATIONS = 999


def diagnose_positions(fused: xr.Dataset, deviations: xr.Dataset, explained: xr.DataArray) -> list[AnomalyPart]:
    """Detect positions that stand out given the named effects, and diagnose them."""
    left = (fused["deviation"] - explained).values
    cleaned = deviations.assign(deviation=deviations["deviation"].copy(data=left))
    # Scatter that is only unequal, as it naturally is, makes no position an anomaly; one that stands out does.
    found = detect_anomalies(cleaned, estimate_drift(cleaned), level=POSITION_LEVEL, permutations=_PERMUTATIONS)
    anomalies = [anomaly for anomaly in found if anomaly.stands_out]
    links = [anomaly for anomaly in anomalies if anomaly.kind == "link"]
    sites = [anomaly for anomaly in anomalies if anomaly.kind != "link"]
    remaining = fused.assign(deviation=fused["deviation"].copy(data=left))
    diagnoses = []
    for link in links:
        diagnoses.append(diagnose_link(remaining, link))
        remaining = without_jumps(remaining, [link])
    diagnoses += diagnose(remaining, sites)
    position_mm = deviations["position"]
    parts = [
        diagnosed(anomaly, diagnosis, position_mm=float(position_mm.sel(target=anomaly.target)))
        for anomaly, diagnosis in zip(links + sites, diagnoses, strict=True)
    ]
    return sorted(parts, key=lambda part: part.p_value or 0.0)


def diagnosed(anomaly: Anomaly, diagnosis: Diagnosis, *, position_mm: float) -> AnomalyPart:
    """Return what was flagged, its cause, and the evidence for and against it."""
    stated = {"for": diagnosis.for_it, "against": diagnosis.against_it, "check": diagnosis.check}
    found = {"kind": anomaly.kind, "extra_um": anomaly.extra_um, "probability": diagnosis.probability}
    return AnomalyPart(
        target=anomaly.target,
        position_mm=position_mm,
        direction=anomaly.direction,
        p_value=anomaly.p_value,
        p_resolution=anomaly.least_p_value,
        scatter_um=anomaly.scatter_um,
        cause=diagnosis.cause,
        evidence=Evidence(**found, **stated, **diagnosis.evidence),
    )


def sites_of(anomalies: Sequence[AnomalyPart], targets: int) -> list[tuple[int, str]]:
    """Sites that are reported as anomalies, so that the loop does not report them again as a remainder."""
    sides = {"both": ("positive", "negative")}
    alone = [anomaly for anomaly in anomalies if anomaly.evidence.kind != "link"]
    if 4 * len({anomaly.target for anomaly in alone}) > targets:
        return []
    return [(anomaly.target, name) for anomaly in alone for name in sides.get(anomaly.direction, (anomaly.direction,))]


# How much a campaign must hold for each analysis, and the notice that names what a small one would need.

#: Smallest test whose drift can be modelled and attributed: below, no cycle can be held out and no course be distinguished from chance.
LEAST_CYCLES, LEAST_TARGETS, LEAST_FRAMES = 12, 3, 12
#: So many targets take part in the model of the drift at most: they share their drift, and the work grows with the cube of their number.
MOST_TARGETS = 64
#: So many values over the cycles are correlated with the field at most: memory and work grow with the square of their number and faster.
MOST_CYCLES = 500


def insufficient_for_model(deviations: xr.Dataset) -> Iterator[Notice]:
    """Return the notice that a test is too small for positions that stand out and for the closed loop; empty where it is not."""
    cycles, targets = deviations.sizes["cycle"], deviations.sizes["target"]
    if cycles < LEAST_CYCLES or targets < LEAST_TARGETS:
        yield Notice.of(
            "too_small_for_model",
            cycles=counted(cycles, "cycle"),
            targets=counted(targets, "target"),
            least_cycles=LEAST_CYCLES,
            least_targets=LEAST_TARGETS,
        )


def choose_targets(deviations: xr.Dataset) -> tuple[xr.Dataset, list[Notice]]:
    """Return the readings that take part in the model of the drift: all, or those at some of very many targets, evenly chosen."""
    count = deviations.sizes["target"]
    if count <= MOST_TARGETS:
        return deviations, []
    order = np.argsort(deviations["position"].values, kind="stable")
    chosen = np.sort(order[np.round(np.linspace(0, count - 1, MOST_TARGETS)).astype(int)])
    notice = Notice.of("targets_chosen", most_targets=MOST_TARGETS, count=count)
    return deviations.isel(target=chosen), [notice]


def average_cycles(fused: xr.Dataset, field: xr.DataArray) -> tuple[xr.Dataset, xr.DataArray, list[Notice]]:
    """Return readings and field as they are correlated: as they are, or means of successive cycles and frames of a very long test."""
    cycles, frames = fused.sizes["cycle"], field.sizes["time"]
    together = int(np.ceil(cycles / MOST_CYCLES))
    if together == 1:
        return fused, field, []
    start = field["time"].values[0]
    present = fused["deviation"].notnull() & fused["time"].notnull()
    seconds = ((fused["time"] - start) / np.timedelta64(1, "s")).where(present)
    means = xr.Dataset({"deviation": fused["deviation"].where(present), "seconds": seconds})
    means = means.coarsen(cycle=together, boundary="trim").mean()
    milliseconds = (1000.0 * means["seconds"]).round().fillna(0.0)
    time = (start + milliseconds.astype(np.int64).astype("timedelta64[ms]")).where(means["seconds"].notnull())
    averaged = means.drop_vars("seconds").assign(time=time.astype("datetime64[ns]"), position=fused["position"])
    averaged["deviation"].attrs = fused["deviation"].attrs
    at_once = max(1, frames * together // cycles)
    of_frames = field if at_once == 1 else field.coarsen(time=at_once, boundary="trim").mean()
    notice = Notice.of("cycles_averaged", together=together, cycle=averaged.sizes["cycle"], cycles=cycles)
    return averaged.assign_coords(cycle=averaged["cycle"].astype(int)), of_frames, [notice]


def insufficient_for_correlation(fields: xr.Dataset) -> Iterator[Notice]:
    """Return the notice that a test is too small for drift and field to be compared; empty where it is not."""
    frames = fields.sizes["time"]
    if frames < LEAST_FRAMES:
        yield Notice.of("too_few_frames", frames=counted(frames, "frame"), least_frames=LEAST_FRAMES)
