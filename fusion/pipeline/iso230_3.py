"""Evaluation of a test by ISO 230-3: a record of displacements and temperatures, or a positioning test of a linear axis."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.ndimage import uniform_filter1d

from fusion.analysis.alignment.sensor_health import describe_fault
from fusion.analysis.drift_model.record import SensorHealth, examine_record
from fusion.analysis.effects.thermal import QUASI_STATIC
from fusion.campaign.config import Campaign, CampaignError, ThermalTestTable, load_campaign
from fusion.campaign.inputs import read_laser, read_record
from fusion.campaign.schema import keys_of
from fusion.campaign.time_zones import shown_zone
from fusion.common import Array
from fusion.pipeline import iso230
from fusion.report.letterhead import PLAIN, Letterhead
from fusion.results.parts import Quantity, TestKind, ThermalContribution, ThermalCourse, ThermalDistortion, ThermalTest
from fusion.results.results import read_results
from fusion.results.store import group, has
from interferometry.deviations import ROUNDING, resolution
from interferometry.iso230 import thermal

#: Standard uncertainty of the sensitivity of a displacement sensor where none is stated: one percent of the reading.
ASSUMED_CALIBRATION = 0.01
_NEEDS = "a [record], or readings of a linear axis with their times in two cycles or more"
#: Name of the row of the budget by which noise widens a range.
_EXTREMES = "bias of the largest of scattered values"
#: Courses that are drawn to see by how much, about one that is smoothed over so many values.
_DRAWS, _SEED, _SMOOTHED = 50, 230, 11
#: Values of a course that are kept for its chart.
_KEPT = 120
DEFINITIONS = (
    "ISO 230-3:2020 names four tests in its open scope; its text is not open. Stated here is what is computed.",
    "A distortion is the largest less the smallest value, as in the manual of a spindle analyser that refers to ISO 230-3 (Lion Precision "
    "M017-7500, total drift per axis); the periods (first 60 min, whole test, last 60 min) follow no open text.",
    "Settled: the time after which a displacement stays within a tenth of its range about its mean of the last 60 min, for two "
    "hours at least; no open text.",
    "Uncertainties follow the GUM with the sources of the budget, each with its origin; ISO/TR 230-9 is not open, and its list of sources "
    "was not compared.",
)


@dataclass(frozen=True)
class _Course:
    """A quantity over the test: values (n,), sources of the uncertainty of one value, and of its sensitivity (share), with origins."""

    name: str
    unit: str
    values: Array
    absolute: Mapping[str, tuple[float | None, str]]
    share: tuple[float, str]
    #: Standard deviation of the independent noise of the values, which widens a range.
    noise: float = 0.0


def evaluate_record_test(table: xr.Dataset, stated: ThermalTestTable) -> list[ThermalTest]:
    """Evaluate every run of a record."""
    runs = json.loads(table.attrs.get("runs", '[""]'))
    number = table["run"].values if "run" in table.coords else np.zeros(table.sizes["time"], int)
    return [_of_run(table.isel(time=np.flatnonzero(number == k)), name, stated) for k, name in enumerate(runs)]


def _of_run(table: xr.Dataset, name: str, stated: ThermalTestTable) -> ThermalTest:
    time = table["time"].values.astype("datetime64[ns]")
    elapsed = np.asarray((time - time[0]) / np.timedelta64(1, "s"), float)
    remarks = ["Readings are averaged over one minute first, so that a range is not that of the noise."]
    remarks += [] if stated.kind else ["The kind of test is not stated; write kind under [thermal_test]."]
    channels = [str(one) for one in table["channel"].values]
    raw = table["displacement"].values
    # A clock that was set back gives readings of one time.
    between = np.diff(np.unique(elapsed))
    per_piece = max(1.0, thermal.AVERAGED_S / float(np.median(between))) if between.size else 1.0
    seconds, displacement = thermal.with_ends(*thermal.average(elapsed, raw), elapsed[-1])
    temperature = thermal.with_ends(*thermal.average(elapsed, table["temperature"].values), elapsed[-1])[1]
    share = (
        (ASSUMED_CALIBRATION, "assumed, 1 % of the reading")
        if stated.sensor_calibration is None
        else (stated.sensor_calibration, "stated")
    )
    courses = []
    for k, channel in enumerate(channels):
        noise = thermal.scatter(raw[:, k]) / np.sqrt(per_piece)
        digit = ROUNDING * resolution(raw[:, k])
        sources: dict[str, tuple[float | None, str]] = {
            "noise": (noise, "from the second differences of the readings, mean of one minute"),
            "resolution": (digit, "from the digits of the readings"),
            "mounting": _mounting(stated, temperature),
        }
        courses.append(_Course(channel, "um", displacement[:, k], sources, share, noise))
    missing = [one for tilted in stated.tilts.values() for one in tilted.channels if one not in channels]
    if missing:
        raise CampaignError(
            f"[thermal_test.tilts] names {', '.join(missing)}; the displacements of the record are {', '.join(channels)}"
        )
    courses += list(_tilts(courses, stated))
    if not stated.tilts:
        remarks.append(
            'No tilt: write [thermal_test.tilts], for example A = {channels = ["Y1", "Y2"], distance = "150 mm"}.'
        )
    sensors = [
        _Course(str(name), "K", course, {"noise": (noise, "")}, (0.0, ""), noise)
        for name, course in zip(table["sensor"].values, temperature.T, strict=True)
        for noise in [thermal.scatter(course)]
    ]
    return _test(stated.kind or "not stated", name, seconds, courses, sensors, remarks)


def _mounting(stated: ThermalTestTable, temperature: Array) -> tuple[float | None, str]:
    """Return the standard uncertainty of one value by the expansion of what holds sensors and target."""
    if stated.mounting_length_mm is None:
        return None, "not known, not contained; write mounting_length under [thermal_test]"
    swing = float(np.nanmin(np.nanmax(temperature, axis=0) - np.nanmin(temperature, axis=0)))
    u = stated.mounting_expansion_ppm_per_K * stated.mounting_length_mm * 1e-3 * swing / np.sqrt(12.0)
    return u, (
        f"{stated.mounting_expansion_ppm_per_K:g} ppm/K over {stated.mounting_length_mm:g} mm, rectangular over the {swing:.2g} K of the "
        "sensor that moves least"
    )


def _tilts(courses: Sequence[_Course], stated: ThermalTestTable) -> Iterator[_Course]:
    """Yield the tilts that two displacements show."""
    by_name = {one.name: one for one in courses}
    for name, tilted in stated.tilts.items():
        first, second = (by_name[one] for one in tilted.channels)
        per_um = 1e3 / tilted.distance_mm
        sources = {
            source: (None if u is None or other is None else float(np.hypot(u, other)) * per_um, origin)
            for (source, (u, origin)), (other, _) in zip(first.absolute.items(), second.absolute.values(), strict=True)
        }
        # What holds both sensors moves both alike.
        sources["mounting"] = (None, "not known, not contained: only the difference of both sensors' mountings tilts")
        values = thermal.tilt(first.values, second.values, distance_mm=tilted.distance_mm)
        noise = float(np.hypot(first.noise, second.noise)) * per_um
        yield _Course(f"{name} ({first.name}, {second.name})", "um/m", values, sources, first.share, noise)


def evaluate_axis_test(deviations: xr.Dataset, drift: xr.Dataset | None, stated: ThermalTestTable) -> list[ThermalTest]:
    """Evaluate the drift of zero and scale of a linear axis, that of the joint estimate where there is one: ranges of readings are those
    of their scatter, too. None without times, or of fewer than two cycles or targets.
    """
    timed = ~np.isnat(deviations["time"].values)
    few = deviations.sizes["cycle"] < 2 or np.unique(deviations["position"].values).size < 2
    if not timed.any() or few or deviations["deviation"].attrs["units"] != "um":
        return []
    seconds, values, line_u = thermal.axis_courses(deviations)
    u = {key: float(np.nanmedian(one)) for key, one in line_u.items()}
    origin = "scatter of all targets about the straight line"
    if drift is not None:
        _, values, _ = thermal.axis_courses(deviations.assign(deviation=drift["drift"]))
        first, last = (
            drift["drift_u"]
            .mean("direction")
            .isel(target=np.argsort(deviations["position"].values)[[0, -1]])
            .max("cycle")
            .values
        )
        metres = np.ptp(deviations["position"].values) * 1e-3
        found = {"zero": first, "end": last, "scale": drift["drift_stretch_u"].max() / metres}
        # No estimate knows the change from one half of the test to the other better than the means of both halves.
        u = {key: max(float(found[key]), one * np.sqrt(2.0 / len(seconds))) for key, one in u.items()}
        origin = "of the joint estimate, at the cycle where it is largest"
    known = np.isfinite(seconds)
    first_mm, last_mm = np.sort(deviations["position"].values)[[0, -1]]
    names = {"zero": f"zero, at {first_mm:g} mm", "end": f"end, at {last_mm:g} mm", "scale": "scale"}
    courses = [
        _Course(
            names[key],
            "um/m" if key == "scale" else "um",
            values[key][known],
            {
                "noise": (u[key], origin),
                "compensation of the laser": (None, "not contained: drift of its sensors during the test"),
            },
            (0.0, ""),
        )
        for key in names
    ]
    remarks = [
        f"Zero and scale are those of a straight line through the drift of all {deviations.sizes['target']} targets, mean of both "
        "approaches; the standard's test needs the end positions only.",
        "The drift is that of the joint estimate, from which the scatter of the readings is removed."
        if drift is not None
        else "No drift could be estimated beside the scatter: the straight lines are those of the readings.",
    ]
    return [_test(stated.kind or "linear axis", "", seconds[known], courses, [], remarks)]


def _test(
    kind: TestKind,
    run: str,
    seconds: Array,
    courses: Sequence[_Course],
    sensors: Sequence[_Course],
    remarks: Sequence[str],
) -> ThermalTest:
    """Return a test from its courses."""
    every = max(1, -(-seconds.size // _KEPT))
    ranges = [thermal.evaluate_distortion(seconds, one.values) for one in (*courses, *sensors)]
    excess = [_excess_of_ranges(one, seconds) for one in (*courses, *sensors)]
    found = [*map(_distortion, (*courses, *sensors), ranges, excess)]
    return ThermalTest(
        run=run,
        kind=kind,
        duration_h=float((seconds[-1] - seconds[0]) / 3600.0),
        distortions=tuple(found[: len(courses)]),
        temperatures=tuple(found[len(courses) :]),
        contributions=tuple(
            ThermalContribution(name=one.name, source=source, u=u, origin=origin)
            for one, own, widened in zip(courses, ranges, excess, strict=False)
            for source, u, origin in _budget(one, own.whole, widened.whole)
        ),
        courses=tuple(
            ThermalCourse(
                name=one.name,
                unit="degC" if one.unit == "K" else one.unit,
                hours=tuple(np.round((seconds[::every] - seconds[0]) / 3600.0, 4).tolist()),
                values=tuple(None if np.isnan(value) else round(value, 4) for value in shown[::every].tolist()),
            )
            for one in (*courses, *sensors)
            for shown in [one.values if one.unit == "K" else one.values - _first(one.values)]
        ),
        remarks=(*remarks, *DEFINITIONS),
    )


def _first(values: Array) -> float:
    """Return the first value that is known."""
    return float(next(iter(values[np.isfinite(values)]), np.nan))


def _budget(course: _Course, size: float, excess: float) -> list[tuple[str, float | None, str]]:
    """Return the sources of the uncertainty of a range: a difference of two values, by how much noise widens it, and the sensitivity of
    the sensor.
    """
    sources: list[tuple[str, float | None, str]] = [
        (source, None if u is None else u * np.sqrt(2.0), origin) for source, (u, origin) in course.absolute.items()
    ]
    if course.noise > 0.0:
        sources.append((_EXTREMES, excess, "mean excess of simulated courses like this one"))
    share, origin = course.share
    return [*sources, ("calibration", share * abs(size), origin)] if origin else sources


def _excess_of_ranges(course: _Course, seconds: Array) -> thermal.Distortion:
    """Return by how much noise widens the ranges of a course on average, in its unit (ISO 230-2 has the same row in its budget)."""
    rng, known = np.random.default_rng(_SEED), np.isfinite(course.values)
    if not course.noise > 0.0 or not known.any():
        return thermal.Distortion(0.0, 0.0, 0.0, 0.0, np.nan)
    smooth = np.full(course.values.shape, np.nan)
    smooth[known] = uniform_filter1d(course.values[known], _SMOOTHED, mode="nearest")
    still = thermal.evaluate_distortion(seconds, smooth)
    drawn = [
        thermal.evaluate_distortion(seconds, smooth + course.noise * rng.standard_normal(smooth.size))
        for _ in range(_DRAWS)
    ]
    first, whole, last = (
        max(0.0, float(np.mean([getattr(one, name) for one in drawn])) - getattr(still, name))
        for name in ("first_hour", "whole", "last_hour")
    )
    return thermal.Distortion(first, whole, last, 0.0, np.nan)


def _distortion(course: _Course, found: thermal.Distortion, excess: thermal.Distortion) -> ThermalDistortion:
    """Return the ranges of a course with their uncertainties."""

    def quantity(name: str) -> Quantity:
        value = getattr(found, name)
        if not np.isfinite(value):
            return Quantity(value=None, u=None)
        known = [u for _, u, _ in _budget(course, value, getattr(excess, name)) if u is not None and np.isfinite(u)]
        return Quantity(value=value, u=float(np.sqrt(np.sum(np.square(known)))))

    return ThermalDistortion(
        name=course.name,
        unit=course.unit,
        first_hour=quantity("first_hour"),
        whole=quantity("whole"),
        last_hour=quantity("last_hour"),
        change=quantity("change"),
        settling_min=None if np.isnan(found.settling_s) else found.settling_s / 60.0,
    )


def thermal_tests(campaign: Campaign, measured: SensorHealth | xr.Dataset) -> tuple[ThermalTest, ...]:
    """Evaluate the tests of a campaign from its record, without what is faulty or doubted, or from its readings, with whose they were and
    the conditions that its file states.
    """
    stated_test = campaign.thermal_test
    if isinstance(measured, SensorHealth):
        table = measured.undoubted
        remarks = [
            f"{one.sensor}{f' of {one.run}' if one.run else ''} {describe_fault(one)}: "
            f"{'these readings are' if one.readings else 'it is'} in no range."
            for one in measured.findings
        ]
        tests = [
            one.model_copy(update={"remarks": (*remarks, *one.remarks)})
            for one in (evaluate_record_test(table, stated_test) if table.sizes["channel"] else [])
        ]
    else:
        table = measured
        drift = group(table, "estimate") if has(table, "estimate") else iso230.estimate_joint(table)[0]
        tests = evaluate_axis_test(table, drift, stated_test)
    zone = shown_zone(table, campaign.zone_of("interferometry" if campaign.record is None else "record"))
    date, keys = iso230.date_of(table["time"].values, zone), keys_of("report", of="record")
    stated = iso230.state_conditions(keys, campaign.report.model_dump(by_alias=True), date, campaign.campaign.axis, {})
    return tuple(one.model_copy(update={"conditions": stated}) for one in tests)


class StatedTests(NamedTuple):
    """Tests by ISO 230-3: their title, they themselves, the SHA-256 of the files that they were read from, by name, and what makes their
    sheets a laboratory's own.
    """

    title: str
    tests: tuple[ThermalTest, ...]
    files: dict[str, str]
    sheet: Letterhead = PLAIN


def read_thermal_tests(path: Path) -> StatedTests:
    """Return the tests of a campaign file or of a results folder."""
    if path.is_dir():
        results = read_results(path)
        if not results.iso230_3:
            raise CampaignError(f"{path}: these results hold no test by ISO 230-3, which needs {_NEEDS}")
        return StatedTests(results.campaign, results.iso230_3, iso230.files_of_run(path), iso230.sheet_of_run(path))
    if path.suffix != ".toml":
        raise CampaignError(
            f"{path}: name a campaign file or a results folder; thermofuse init writes a campaign file for a table"
        )
    campaign = load_campaign(path)
    found: tuple[ThermalTest, ...] = ()
    of = "interferometry" if campaign.record is None else "record"
    if campaign.record is not None:
        found = thermal_tests(campaign, examine_record(read_record(campaign), [QUASI_STATIC]))
    elif campaign.interferometry is not None:
        found = thermal_tests(campaign, read_laser(campaign)["deviations"])
    if not found:
        raise CampaignError(f"{path}: a test by ISO 230-3 needs {_NEEDS}")
    read = {path.name: path, **campaign.files_of(of)}
    return StatedTests(
        campaign.campaign.title, found, iso230.hashed(read), iso230.sheet_files(campaign.sheet, campaign.folder)
    )
