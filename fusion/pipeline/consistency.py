"""The checks of a run: those before the long work, those of the fields, and those on what was fitted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from fusion.alignment.align import camera_on_laser_clock
from fusion.alignment.readings import ReadingsError, read_fused
from fusion.campaign.config import Campaign, CampaignError
from fusion.campaign.sources import CameraInputs, Inputs, LaserInputs, Source
from fusion.consistency.camera_stamps import check_order, check_phase
from fusion.consistency.checks import CODES, Check
from fusion.consistency.clocks import check_camera_clock, check_load_clock, check_load_scale, check_material_clock
from fusion.consistency.coefficients import check_coefficients
from fusion.consistency.field_series import field_at, thin_fields
from fusion.consistency.frames import check_frames
from fusion.consistency.logs import check_contact_sensors, check_log
from fusion.consistency.place import check_gaps, check_place
from fusion.consistency.plan_sensors import check_sensors, compare_sensors
from fusion.consistency.readings import check_readings
from fusion.consistency.registration import check_picture, check_registration
from fusion.consistency.signs import check_signs
from fusion.consistency.temperature import check_material
from fusion.pipeline.radiometry import overridden_parameters
from thermography.io.temperature_frames import TemperatureFrame


def check_source(source: Inputs) -> list[Check]:
    """Check what was read, before anything is calculated.

    Parameters
    ----------
    source : LaserInputs, CameraInputs or Source
        Inputs of the campaign.

    Returns
    -------
    list of Check
        Of the readings with their logs, and of the frames, as far as the campaign has them.

    Raises
    ------
    CampaignError
        If ``[accept] doubts`` names a check that does not exist.
    """
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
    if isinstance(source, CameraInputs):
        checks += check_order(source.frames)
        checks += _phase(source) if isinstance(source, Source) else []
        stated, stack = set(overridden_parameters(source.thermography)), source.thermography.stack
        # Temperatures whose emissivity is not stated are taken as they are: a notice of its own, and no doubt about a stored value.
        if isinstance(source.frames[0], TemperatureFrame) and (stack is None or stack.emissivity is None):
            stated.add("emissivity")
        checks += check_frames(source.frames, overridden=stated)
    return checks


def _check_readings_and_logs(source: LaserInputs) -> list[Check]:
    """Checks of the readings in themselves, and of the logs beside them."""
    times = source.deviations["time"].values.ravel()
    interferometry, drivers = source.campaign.interferometry, source.campaign.drivers
    environment_file = interferometry.environment if interferometry is not None else None
    return [
        *check_readings(source.deviations, plan_extent_mm=_extent_along_axis(source.campaign)),
        *check_signs(source.deviations),
        *check_log(
            source.environment,
            times,
            name="environment",
            file=environment_file or "the environment log",
            endangers="index of air, dead path and material compensation",
        ),
        *check_log(
            source.drivers,
            times,
            name="drivers",
            file=drivers.file if drivers is not None else "the drivers' log",
            endangers="every effect that follows a load, and the verdict that none is missing",
        ),
        *_check_coverage_of_sensors(source),
        *check_contact_sensors(source.environment, source.drivers, file=environment_file or "the environment log"),
    ]


def _check_coverage_of_sensors(source: LaserInputs) -> list[Check]:
    """Whether the contact sensors cover the readings, where they stand for the camera."""
    if source.sensors is None or isinstance(source, CameraInputs):
        return []
    return check_log(
        source.sensors.temperature.to_dataset(name="temperature"),
        source.deviations["time"].values.ravel(),
        name="sensors",
        file=source.sensors.file,
        endangers="every effect that follows the temperature of the table",
    )


def _compare_sensors(source: CameraInputs, fields: xr.Dataset) -> list[Check]:
    """The camera's rise against that of contact sensors, where there are any."""
    sensors = source.sensors
    if sensors is None:
        return []
    return compare_sensors(fields, sensors.temperature, sensors.x_mm, sensors.y_mm, u_K=sensors.u_K)


def _extent_along_axis(campaign: Campaign) -> float | None:
    """Extent of the plan along the axis, mm; None where the campaign does not place the axis on a plan."""
    plan = campaign.plan
    if plan is None or plan.axis is None or plan.size_mm is None:
        return None
    x, y = plan.axis.direction
    width_mm, height_mm = plan.size_mm
    return abs(x) * width_mm + abs(y) * height_mm


def _phase(source: Source) -> list[Check]:
    """Frames of a still table against the motion of the axis; those of a moving table estimate the offset of the clocks themselves."""
    if source.thermography.table == "moving":
        return []
    stated_s = source.thermography.clock_offset_s or 0.0
    return check_phase(camera_on_laser_clock(source.frame_times, stated_s), source.deviations)


def check_fields(source: Source, fields: xr.Dataset, fused: xr.Dataset) -> list[Check]:
    """Check the fields in themselves, and against logs and drift.

    Parameters
    ----------
    source : Source
        Inputs of the campaign.
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``, on the laser's clock.
    fused : Dataset
        Both recordings on one clock.

    Returns
    -------
    list of Check
        Of the clocks, of rise and level of the camera's temperature, and of what the frames show over the series.
    """
    field, place_mm = thin_fields(fields), source.interferometry.material_sensor_mm
    near = field if place_mm is None else field_at(fields, place_mm)
    interferometry, drivers = source.campaign.interferometry, source.campaign.drivers
    environment_file = (interferometry.environment if interferometry is not None else None) or "the environment log"
    drivers_file = drivers.file if drivers is not None else "the drivers' log"
    return [
        *_check_camera_clock(fused),
        *check_material_clock(near, source.environment, file=environment_file),
        *check_load_clock(field, source.drivers, file=drivers_file),
        *check_load_scale(field, source.drivers, file=drivers_file),
        *check_material(near, source.environment, stated=place_mm is not None, file=environment_file),
        *_compare_sensors(source, fields),
        *check_place(fields),
        *check_gaps(fields["time"].values, source.deviations["time"]),
    ]


def _check_camera_clock(fused: xr.Dataset) -> list[Check]:
    """Check the clocks by the drift, which takes three cycles at three targets with readings among the frames."""
    try:
        return check_camera_clock(read_fused(fused))
    except ReadingsError:
        return []


def check_fields_alone(source: CameraInputs, fields: xr.Dataset) -> list[Check]:
    """Check the fields in themselves, and against the logged loads, where there is no laser.

    Parameters
    ----------
    source : CameraInputs
        Inputs of the campaign.
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``.
    """
    field, drivers = thin_fields(fields), source.campaign.drivers
    drivers_file = drivers.file if drivers is not None else "the drivers' log"
    return [
        *check_load_clock(field, source.drivers, file=drivers_file),
        *check_load_scale(field, source.drivers, file=drivers_file),
        *_compare_sensors(source, fields),
        *check_place(fields),
    ]


def check_plan(source: CameraInputs, registration: Mapping[str, Any]) -> list[Check]:
    """Check what the registration found.

    Parameters
    ----------
    source : CameraInputs
        Inputs of the campaign.
    registration : mapping
        Part ``registration`` of results.json.
    """
    if source.plan.in_pixels:
        return check_picture(source.frames)
    return check_registration(registration, file=source.fiducials_file)


def check_loop(loop: Mapping[str, Any], source: LaserInputs) -> list[Check]:
    """Check what the closed loop fitted against physics.

    Parameters
    ----------
    loop : mapping
        Part ``loop`` of results.json.
    source : LaserInputs
        Inputs of the campaign.
    """
    return check_coefficients(loop, travel_mm=float(np.abs(source.deviations["position"]).max()))
