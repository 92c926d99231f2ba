"""The checks of a run: those before the long work, those of the fields, and those on what was fitted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from fusion.analysis.alignment.align import camera_on_laser_clock
from fusion.analysis.alignment.readings import ReadingsError, read_fused
from fusion.analysis.consistency.camera import (
    check_frames,
    check_gaps,
    check_order,
    check_phase,
    check_place,
    check_registration,
)
from fusion.analysis.consistency.checks import CODES, Check
from fusion.analysis.consistency.clocks import (
    check_camera_clock,
    check_load_clock,
    check_load_scale,
    check_material_clock,
)
from fusion.analysis.consistency.field_series import field_at, thin_fields
from fusion.analysis.consistency.logs import (
    check_contact_sensors,
    check_log,
    check_material,
    check_sensors,
    compare_sensors,
)
from fusion.analysis.consistency.model import check_coefficients
from fusion.analysis.consistency.readings import check_readings, check_signs
from fusion.campaign.config import Campaign, CampaignError
from fusion.campaign.inputs import CameraInputs, Inputs, LaserInputs, Source
from fusion.pipeline.thermal import overridden_parameters
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
    if source.sensors is not None:
        sensors = source.sensors
        left_out = [f"{sensors.logged['sensor'].values[fault.sensor]} {fault.words}" for fault in sensors.faults]
        checks += check_sensors(sensors.temperature, file=sensors.file, left_out=left_out)
    if isinstance(source, CameraInputs) and source.frames:
        checks += check_order(source.frames)
        if isinstance(source, Source) and source.thermography.table == "still":
            # Frames of a moving table estimate the offset of the clocks themselves.
            times = camera_on_laser_clock(source.frame_times, source.thermography.clock_offset_s or 0.0)
            checks += check_phase(times, source.deviations)
        stated, stack = set(overridden_parameters(source.thermography)), source.thermography.stack
        # Temperatures whose emissivity is not stated are taken as they are: a notice of its own, and no doubt about a stored value.
        if isinstance(source.frames[0], TemperatureFrame) and (stack is None or stack.emissivity is None):
            stated.add("emissivity")
        checks += check_frames(source.frames, overridden=stated)
    return checks


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
        *check_readings(source.deviations, plan_extent_mm=extent_mm),
        *check_signs(source.deviations),
        *check_log(source.environment, times, name="environment", file=environment_file),
        *check_log(source.drivers, times, name="drivers", file=drivers_file),
    ]
    if source.sensors is not None and not isinstance(source, CameraInputs):
        # They stand for the camera.
        logged = source.sensors.temperature.to_dataset(name="temperature")
        checks += check_log(logged, times, name="sensors", file=source.sensors.file)
    return [*checks, *check_contact_sensors(source.environment, source.drivers, file=environment_file)]


def _compare_sensors(source: CameraInputs, fields: xr.Dataset) -> list[Check]:
    """The camera's rise against that of contact sensors, where there are any."""
    sensors = source.sensors
    if sensors is None:
        return []
    return compare_sensors(fields, sensors.temperature, sensors.x_mm, sensors.y_mm, u_K=sensors.u_K)


def check_fields(source: Source, fields: xr.Dataset, fused: xr.Dataset) -> list[Check]:
    """Check the fields in themselves, and against logs and drift."""
    try:
        clock = check_camera_clock(read_fused(fused))
    except ReadingsError:
        # It takes three cycles at three targets with readings among the frames.
        clock = []
    field, place_mm = thin_fields(fields), source.interferometry.material_sensor_mm
    near = field if place_mm is None else field_at(fields, place_mm)
    environment_file, drivers_file = _log_files(source.campaign)
    return [
        *clock,
        *check_material_clock(near, source.environment, file=environment_file),
        *check_load_clock(field, source.drivers, file=drivers_file),
        *check_load_scale(field, source.drivers, file=drivers_file),
        *check_material(near, source.environment, stated=place_mm is not None, file=environment_file),
        *_compare_sensors(source, fields),
        *check_place(fields),
        *check_gaps(fields["time"].values, source.deviations["time"]),
    ]


def check_fields_alone(source: CameraInputs, fields: xr.Dataset) -> list[Check]:
    """Check the fields in themselves, and against the logged loads, where there is no laser."""
    field, (_, drivers_file) = thin_fields(fields), _log_files(source.campaign)
    return [
        *check_load_clock(field, source.drivers, file=drivers_file),
        *check_load_scale(field, source.drivers, file=drivers_file),
        *_compare_sensors(source, fields),
        *check_place(fields),
    ]


def check_plan(source: CameraInputs, registration: Mapping[str, Any]) -> list[Check]:
    """Check what the registration found."""
    return [] if source.plan.in_pixels else check_registration(registration, file=source.fiducials_file)


def check_loop(loop: Mapping[str, Any], source: LaserInputs) -> list[Check]:
    """Check what the closed loop fitted against physics."""
    return check_coefficients(loop, travel_mm=float(np.abs(source.deviations["position"]).max()))
