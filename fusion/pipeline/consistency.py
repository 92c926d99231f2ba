"""The checks of a run: those before the long work, those of the fields, and those on what was fitted; what follows from them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.align import camera_on_laser_clock
from fusion.analysis.alignment.readings import ReadingsError, read_fused
from fusion.analysis.consistency import RULES
from fusion.analysis.consistency.camera import compare_phase, file_warnings
from fusion.analysis.consistency.checks import Found, Inputs, Phase, Rule
from fusion.analysis.consistency.clocks import Evidence, Recording, compare_clocks
from fusion.analysis.consistency.courses import compare_drift, compare_load, compare_material
from fusion.analysis.consistency.series import Motion, field_at, log_with_camera, thin_fields
from fusion.campaign.config import CampaignError
from fusion.campaign.inputs import CameraInputs, LaserInputs, Source, is_rotary, overridden_parameters
from fusion.campaign.inputs import Inputs as Read
from fusion.common import FusionError
from fusion.report.wording import check_words
from fusion.results.axis import RegistrationPart
from fusion.results.loop import AxisLoop
from fusion.results.parts import CheckPart, Figures, InputsPart
from fusion.results.results import Notice
from thermography.io.other_cameras import TemperatureFrame


class ContradictionError(FusionError):
    """Inputs that cannot all be true; the message names the file, the value and the remedy."""


class Check(CheckPart):
    """One check of a run; `contradicts` where it ends the run unless it is passed."""

    contradicts: bool = False


def run_checks(phase: Phase, inputs: Inputs) -> list[Check]:
    """Make the checks of a phase for which there is what they take."""
    made = ((rule, rule.make(inputs)) for rule in RULES.values() if rule.phase == phase)
    return [_worded(rule, found, inputs) for rule, found in made if found is not None]


def _worded(rule: Rule, found: Found, inputs: Inputs) -> Check:
    """What a check found, in words; a doubted environment touches the readings that it has compensated."""
    numbers = {name: getattr(found, name) for name in ("value", "limit", "passed", "verified")}
    files = {name: value for name, value in vars(inputs).items() if name.endswith("_file")}
    words = check_words(rule.code, {**files, **found.facts, **numbers})
    touched = inputs.recompensated and rule.code.startswith("environment")
    figures: tuple[Figures, ...] = ("positions", *rule.figures) if touched else rule.figures
    # What nothing contradicts and nothing confirms: sizes depend on it, no name does.
    conditional = figures if found.verified else tuple(name for name in figures if name == "field")
    return Check(code=rule.code, contradicts=found.contradicts, conditional=conditional, **numbers, **words)


def check_source(source: Read) -> list[Check]:
    """Check what was read, before anything is calculated."""
    unknown = [code for code in source.campaign.accept.doubts if code not in RULES]
    if unknown:
        raise CampaignError(
            f"{source.campaign.path}: accept.doubts = {unknown[0]!r}: no such check; there are: {', '.join(RULES)}"
        )
    motion, inputs = _motion(source), Inputs()
    if isinstance(source, LaserInputs):
        inputs = _with_readings(_logs_of(source), source)
    if isinstance(source, CameraInputs) and source.frames:
        stated, stack = set(overridden_parameters(source.thermography)), source.thermography.stack
        # Temperatures whose emissivity is not stated are taken as they are: a notice of its own, and no doubt about a stored value.
        if isinstance(source.frames[0], TemperatureFrame) and (stack is None or stack.emissivity is None):
            stated.add("emissivity")
        inputs = replace(inputs, frames=source.frames, file_warnings=file_warnings(source.frames, overridden=stated))
        if isinstance(source, Source):
            offset_s = source.thermography.clock_offset_s or 0.0
            inputs = replace(inputs, frame_time=_frame_times(source), motion=motion, offset_s=offset_s)
    return [*run_checks("source", inputs), *_check_clocks(source, compare_phase(motion))]


def _logs_of(source: Read) -> Inputs:
    """Logs with the names of their files, and whether the readings were compensated with one."""
    laser, drivers = source.campaign.interferometry, source.campaign.drivers
    return Inputs(
        environment=source.environment,
        environment_file=(None if laser is None else laser.environment) or "the environment log",
        drivers=source.drivers,
        drivers_file="the drivers' log" if drivers is None else drivers.file,
        recompensated=isinstance(source, LaserInputs) and source.interferometry.recompensates,
    )


def _with_readings(inputs: Inputs, source: LaserInputs) -> Inputs:
    """Add readings, and logs that stand beside them."""
    deviations, plan, sensors = source.deviations, source.campaign.plan, source.sensors
    inputs = replace(inputs, deviations=deviations, reading_time=deviations["time"])
    if not is_rotary(deviations) and np.isfinite(deviations["deviation"].values).any():
        inputs = replace(inputs, linear=deviations)
    if plan is not None and plan.axis is not None and plan.size_mm is not None:
        extent = (abs(part) * length for part, length in zip(plan.axis.direction, plan.size_mm, strict=True))
        inputs = replace(inputs, plan_extent_mm=sum(extent))
    if sensors is not None and not isinstance(source, CameraInputs):
        logged = sensors.temperature.to_dataset(name="temperature")
        inputs = replace(inputs, sensors=logged, sensors_file=sensors.file)
    return inputs


def _frame_times(source: CameraInputs, fields: xr.Dataset | None = None) -> NDArray[np.datetime64]:
    """Times of the frames on the laser's clock: those of the fields, before as the campaign file states."""
    if fields is not None:
        return np.asarray(fields["time"].values)
    return camera_on_laser_clock(source.frame_times, source.thermography.clock_offset_s or 0.0)


def _motion(source: Read, fields: xr.Dataset | None = None) -> Motion | None:
    """The frames in the motion of the axis; frames of a moving table estimate the offset of the clocks themselves."""
    if isinstance(source, Source) and source.thermography.table == "still":
        return Motion.of(_frame_times(source, fields), source.deviations)
    return None


def _check_clocks(source: Read, compared: Sequence[Evidence], fields: xr.Dataset | None = None) -> list[Check]:
    """Check the clocks of all recordings; the frames on the clock of the fields, where those are known."""
    found = compare_clocks(_recordings(source, fields), compared)
    return run_checks("clocks", replace(_logs_of(source), clocks=found))


def _recordings(source: Read, fields: xr.Dataset | None = None) -> list[Recording]:
    """All recordings of a test."""
    campaign, found = source.campaign, list[Recording]()
    laser, drivers = campaign.interferometry, campaign.drivers
    if isinstance(source, LaserInputs):
        table, times = source.interferometry, source.deviations["time"].values.ravel()
        found.append(Recording("laser", table.deviations, times, "interferometry", offset_s=table.clock_offset_s))
    if isinstance(source, CameraInputs):
        stated_s = source.thermography.clock_offset_s or 0.0
        found.append(Recording("camera", "the frames", _frame_times(source, fields), "thermography", offset_s=stated_s))
    if source.environment is not None and laser is not None and laser.environment is not None:
        times, key = source.environment["time"].values, "environment_clock_offset"
        stated_s = laser.environment_clock_offset_s
        found.append(Recording("environment", laser.environment, times, "interferometry", key, stated_s))
    if source.drivers is not None and drivers is not None:
        times = source.drivers["time"].values
        found.append(Recording("drivers", drivers.file, times, "drivers", offset_s=drivers.clock_offset_s))
    if source.sensors is not None and campaign.sensors is not None:
        times, stated_s = source.sensors.temperature["time"].values, campaign.sensors.clock_offset_s
        found.append(Recording("sensors", source.sensors.file, times, "sensors", offset_s=stated_s))
    return found


def check_fields(source: CameraInputs, fields: xr.Dataset, fused: xr.Dataset | None = None) -> list[Check]:
    """Check the fields in themselves and against logs and contact sensors; with a laser against material temperature and drift too."""
    field, on_plan = thin_fields(fields), source.sensors
    inputs = replace(_logs_of(source), fields=fields, field=field)
    compared = list[Evidence]()
    if isinstance(source, Source) and fused is not None:
        # It takes three cycles at three targets with readings among the frames.
        with suppress(ReadingsError):
            compared += compare_drift(read_fused(fused))
        place_mm = source.interferometry.material_sensor_mm
        near = field if place_mm is None else field_at(fields, place_mm)
        compared += [*compare_phase(_motion(source, fields)), *compare_material(near, source.environment)]
        inputs = replace(
            inputs,
            logged=log_with_camera(near, source.environment),
            place_stated=place_mm is not None,
            frame_time=fields["time"].values,
            reading_time=source.deviations["time"],
        )
    if on_plan is not None:
        inputs = replace(
            inputs,
            sensor_temperature=on_plan.temperature,
            sensor_u_K=on_plan.u_K,
            sensor_x_mm=on_plan.x_mm,
            sensor_y_mm=on_plan.y_mm,
        )
    clocks = _check_clocks(source, [*compared, *compare_load(field, source.drivers)], fields)
    return [*clocks, *_together(run_checks("fields", inputs))]


def _together(checks: Sequence[Check]) -> Iterator[Check]:
    """The checks of the camera's temperature, with what contact sensors on the plan and exchanged columns say of them."""
    exchanged = any(check.code == "environment_columns" and not check.passed for check in checks)
    with_sensors = any(check.code == "sensors_rise" for check in checks)
    for check in checks:
        changed: dict[str, Any] = {}
        if check.code.startswith("material") and exchanged and not check.passed:
            changed["remedy"] = (
                f"See environment_columns first: with both columns exchanged, camera and log agree. {check.remedy}"
            )
        if check.code.startswith("material") and with_sensors and not check.verified:
            # They have shown the scale, or contradict it.
            changed = {"verified": True, "remedy": "", "conditional": RULES[check.code].figures}
        yield check.model_copy(update=changed)


def check_plan(source: CameraInputs, registration: RegistrationPart | None) -> list[Check]:
    """Check what the registration found."""
    return run_checks("plan", Inputs(registration=registration, fiducials_file=source.fiducials_file))


def check_loop(loop: AxisLoop, source: LaserInputs) -> list[Check]:
    """Check what the closed loop fitted against physics."""
    return run_checks("loop", Inputs(loop=loop, travel_mm=float(np.abs(source.deviations["position"]).max())))


def without_consequences(checks: Sequence[Check], accepted: Collection[str] = ()) -> list[Check]:
    """Leave out what cannot be judged until a doubted clock is right; a refusal among it is that of the clock."""
    latest = list({check.code: check for check in checks}.values())
    doubted = [check for check in latest if is_doubted_clock(check) and check.code not in accepted]
    waiting = [check for check in latest if doubted and RULES[check.code].waits and not check.passed]
    if waiting:
        codes = f" To be judged when the clocks are right: {', '.join(check.code for check in waiting)}."
        refused = any(check.contradicts for check in waiting)
        latest = [
            one.model_copy(update={"contradicts": refused, "evidence": one.evidence + codes}) if one in doubted else one
            for one in latest
        ]
    return [check for check in latest if check not in waiting]


def is_doubted_clock(check: Check) -> bool:
    """Whether a check says that a clock is wrong."""
    return RULES[check.code].phase == "clocks" and not check.passed


def refuse_contradictions(checks: Sequence[Check]) -> None:
    """Refuse inputs that cannot all be true."""
    faults = [check for check in checks if not check.passed and check.contradicts]
    if faults:
        raise ContradictionError("\n".join(f"{check.evidence} {check.remedy}" for check in faults))


def open_doubts(checks: Sequence[Check], accepted: Collection[str]) -> list[Check]:
    """Checks that are not passed and that the campaign file does not accept."""
    return [check for check in checks if not check.passed and check.code not in accepted]


def inputs_part(checks: Sequence[Check], accepted: Collection[str], *, corrected: bool = False) -> InputsPart:
    """Whether the inputs agree."""
    sound = "corrected" if corrected else "sound"
    return InputsPart(
        state="doubted" if open_doubts(checks, accepted) else sound,
        accepted=sorted(accepted),
        checks=[check.model_dump(exclude={"contradicts"}) for check in checks],
    )


def doubt_notices(checks: Sequence[Check], accepted: Collection[str]) -> list[Notice]:
    """One warning for every check that is not passed."""
    notices = []
    for check in checks:
        if check.passed:
            continue
        known = check.code in accepted
        message = f"{check.evidence} {'Accepted in the campaign file.' if known else f'Endangered: {check.endangers}.'}"
        notices.append(Notice(f"doubt_{check.code}", message, "" if known else check.remedy))
    return notices
