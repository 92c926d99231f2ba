"""The checks of a run: those before the long work, those of the fields, and those on what was fitted."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.align import camera_on_laser_clock
from fusion.analysis.alignment.readings import ReadingsError, read_fused
from fusion.analysis.consistency.camera import (
    check_coverage,
    check_frames,
    check_gaps,
    check_order,
    check_phase,
    check_picture,
    check_place,
    check_registration,
    compare_phase,
)
from fusion.analysis.consistency.checks import CODES, Check
from fusion.analysis.consistency.clocks import Evidence, Recording, check_clocks
from fusion.analysis.consistency.courses import (
    check_load_course,
    check_load_kind,
    check_load_scale,
    compare_drift,
    compare_load,
    compare_material,
)
from fusion.analysis.consistency.field_series import field_at, thin_fields
from fusion.analysis.consistency.logs import (
    check_contact_sensors,
    check_log,
    check_material,
    compare_sensors,
)
from fusion.analysis.consistency.model import check_coefficients
from fusion.analysis.consistency.readings import check_readings, check_signs
from fusion.campaign.config import Campaign, CampaignError
from fusion.campaign.inputs import CameraInputs, Inputs, LaserInputs, Source, is_rotary, overridden_parameters
from thermography.io.other_cameras import TemperatureFrame


def check_source(source: Inputs) -> list[Check]:
    """Check what was read, before anything is calculated."""
    unknown = [code for code in source.campaign.accept.doubts if code not in CODES]
    if unknown:
        raise CampaignError(
            f"{source.campaign.path}: accept.doubts = {unknown[0]!r}: no such check; there are: {', '.join(CODES)}"
        )
    checks: list[Check] = []
    if isinstance(source, LaserInputs):
        checks += _check_readings_and_logs(source)
    if isinstance(source, CameraInputs) and source.frames:
        checks += check_order(source.frames)
        if isinstance(source, Source) and source.thermography.table == "still":
            # Frames of a moving table estimate the offset of the clocks themselves.
            checks += check_phase(_frame_times(source), source.deviations)
        if isinstance(source, Source):
            offset_s = source.thermography.clock_offset_s or 0.0
            checks += check_coverage(_frame_times(source), source.deviations, offset_s=offset_s)
        stated, stack = set(overridden_parameters(source.thermography)), source.thermography.stack
        # Temperatures whose emissivity is not stated are taken as they are: a notice of its own, and no doubt about a stored value.
        if isinstance(source.frames[0], TemperatureFrame) and (stack is None or stack.emissivity is None):
            stated.add("emissivity")
        checks += check_frames(source.frames, overridden=stated)
    return [*checks, *check_clocks(_recordings(source), _of_stamps(source))]


def _frame_times(source: CameraInputs, fields: xr.Dataset | None = None) -> NDArray[np.datetime64]:
    """Times of the frames on the laser's clock: those of the fields, before as the campaign file states."""
    if fields is not None:
        return np.asarray(fields["time"].values)
    return camera_on_laser_clock(source.frame_times, source.thermography.clock_offset_s or 0.0)


def _of_stamps(source: Inputs, fields: xr.Dataset | None = None) -> list[Evidence]:
    """What the stamps of the frames of a still table say of the camera's clock."""
    if isinstance(source, Source) and source.thermography.table == "still":
        return compare_phase(_frame_times(source, fields), source.deviations)
    return []


def _recordings(source: Inputs, fields: xr.Dataset | None = None) -> list[Recording]:
    """All recordings of a test; the frames on the clock of the fields, where those are known."""
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


def _log_files(campaign: Campaign) -> tuple[str, str]:
    """Names of the files of environment and drivers."""
    laser, drivers = campaign.interferometry, campaign.drivers
    environment = None if laser is None else laser.environment
    return environment or "the environment log", "the drivers' log" if drivers is None else drivers.file


def _check_readings_and_logs(source: LaserInputs) -> list[Check]:
    """Checks of the readings in themselves, and of the logs."""
    times, plan = source.deviations["time"].values.ravel(), source.campaign.plan
    environment_file, drivers_file = _log_files(source.campaign)
    extent_mm = None
    if plan is not None and plan.axis is not None and plan.size_mm is not None:
        extent_mm = sum(abs(part) * length for part, length in zip(plan.axis.direction, plan.size_mm, strict=True))
    checks = [
        *([] if is_rotary(source.deviations) else check_readings(source.deviations, plan_extent_mm=extent_mm)),
        *check_signs(source.deviations),
        *check_log(source.environment, times, name="environment", file=environment_file),
        *check_log(source.drivers, times, name="drivers", file=drivers_file),
        *check_load_kind(source.drivers, file=drivers_file),
    ]
    if source.sensors is not None and not isinstance(source, CameraInputs):
        # They stand for the camera.
        logged = source.sensors.temperature.to_dataset(name="temperature")
        checks += check_log(logged, times, name="sensors", file=source.sensors.file)
    return [*checks, *check_contact_sensors(source.environment, source.drivers, file=environment_file)]


def check_fields(source: CameraInputs, fields: xr.Dataset, fused: xr.Dataset | None = None) -> list[Check]:
    """Check the fields in themselves and against logs and contact sensors; with a laser against material temperature and drift too."""
    field, (environment_file, drivers_file) = thin_fields(fields), _log_files(source.campaign)
    compared, material, gaps = list[Evidence](), list[Check](), list[Check]()
    if isinstance(source, Source) and fused is not None:
        # It takes three cycles at three targets with readings among the frames.
        with suppress(ReadingsError):
            compared += compare_drift(read_fused(fused))
        place_mm = source.interferometry.material_sensor_mm
        near = field if place_mm is None else field_at(fields, place_mm)
        compared += [*_of_stamps(source, fields), *compare_material(near, source.environment)]
        material = check_material(near, source.environment, stated=place_mm is not None, file=environment_file)
        gaps = check_gaps(fields["time"].values, source.deviations["time"])
    sensors, on_plan = list[Check](), source.sensors
    if on_plan is not None:
        sensors = compare_sensors(fields, on_plan.temperature, on_plan.x_mm, on_plan.y_mm, u_K=on_plan.u_K)
    if sensors:
        # Contact sensors on the plan have shown the scale, or contradict it.
        material = [check if check.verified else replace(check, verified=True, remedy="") for check in material]
    return [
        *check_clocks(_recordings(source, fields), [*compared, *compare_load(field, source.drivers)]),
        *check_load_scale(field, source.drivers, file=drivers_file),
        *check_load_course(field, source.drivers, file=drivers_file, environment=source.environment),
        *material,
        *sensors,
        *check_place(fields),
        *check_picture(fields),
        *gaps,
    ]


def check_plan(source: CameraInputs, registration: Mapping[str, Any]) -> list[Check]:
    """Check what the registration found."""
    return check_registration(registration, file=source.fiducials_file)


def check_loop(loop: Mapping[str, Any], source: LaserInputs) -> list[Check]:
    """Check what the closed loop fitted against physics."""
    return check_coefficients(loop, travel_mm=float(np.abs(source.deviations["position"]).max()))
