"""The laser's compensation in a campaign: left as recorded, or undone and done again with logged air and the axis' own temperature."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from fusion.alignment.align import AxisGeometry, MeasuredLine, interpolate_series
from fusion.campaign.config import CampaignError, InterferometryTable
from fusion.products.results import Notice
from interferometry.compensation import (
    REFERENCE_TEMPERATURE_DEGC,
    SensorUncertainty,
    air_index,
    compensate,
    dead_path_error_um,
    followed_factor_um,
)
from interferometry.iso230 import Iso230Budget
from thermography.radiometry.uncertainty import InputUncertainty

_NO_LOG = "log air temperature, pressure and humidity, and name the file as [interferometry] environment"


class RecompensationError(CampaignError):
    """The compensation cannot be done again with what the campaign holds; the message says what is missing."""


@dataclass(frozen=True)
class Compensated:
    """Readings as they are to be evaluated, what their evaluation by ISO 230-2 has to allow for, and what the user should know."""

    deviations: xr.Dataset
    budget: Iso230Budget | None = None
    notices: list[Notice] = field(default_factory=list)


@dataclass(frozen=True)
class SeenMaterial:
    """Temperature of the measured length as the camera saw it, (cycle, direction, target) in degC, and its standard uncertainty in K."""

    temperature: xr.DataArray
    u_K: float


def compensate_readings(
    deviations: xr.Dataset,
    environment: xr.Dataset | None,
    table: InterferometryTable,
    *,
    seen: SeenMaterial | None = None,
) -> Compensated:
    """Leave the readings as the instrument compensated them, but for a dead path; or compensate them again.

    Parameters
    ----------
    deviations : Dataset keeping ``interferometry.contract.DEVIATIONS``
    environment : Dataset along ``time``, or None where none was logged
    table : ``[interferometry]`` of the campaign
    seen : what takes the place of the logged probe

    Raises
    ------
    RecompensationError, CompensationError
        No air was logged, or not at the times of the readings; the factor that the file states is impossible; keys contradict
        each other.
    """
    if table.compensation == "as recorded":
        if table.material_temperature == "camera" or table.environment_factor_mm is not None:
            raise RecompensationError(
                'material_temperature = "camera" and environment_factor under [interferometry] belong to compensation = "redo"; '
                "add it, or leave them out"
            )
        corrected, notices = correct_dead_path(deviations, environment, table.dead_path_mm)
        return Compensated(corrected, None, notices)
    if environment is None:
        raise RecompensationError(f'[interferometry] compensation = "redo" needs the air: {_NO_LOG}')
    log, coefficient = environment.dropna("time"), table.expansion_coefficient_ppm_per_K
    stated = stated_factor_um(deviations, table)
    applied = stated or followed_factor_um(deviations, log, expansion_coefficient_ppm_per_K=coefficient)
    sensors = SensorUncertainty() if seen is None else SensorUncertainty(material_temperature_K=seen.u_K)
    redone = compensate(
        deviations,
        log,
        applied_factor_um=applied,
        expansion_coefficient_ppm_per_K=coefficient,
        material_temperature_degC=None if seen is None else seen.temperature,
        dead_path_mm=abs(table.dead_path_mm),
        away=table.dead_path_mm >= 0,
        uncertainty=sensors,
    )
    material = log["material_temperature"] if seen is None else seen.temperature
    budget = Iso230Budget(
        machine_temperature_K=sensors.material_temperature_K,
        expansion_coefficient_ppm_per_K=sensors.expansion_coefficient_ppm_per_K,
        difference_from_20_degC_K=abs(float(material.mean()) - REFERENCE_TEMPERATURE_DEGC),
        nominal_expansion_ppm_per_K=coefficient,
    )
    return Compensated(redone, budget, [_redone(redone, stated is not None, seen)])


def stated_factor_um(deviations: xr.Dataset, table: InterferometryTable) -> tuple[float, float] | None:
    """Return the environment factors at the start and the end of the test in um, None where neither campaign nor file states them."""
    if table.environment_factor_mm is not None:
        start, end = table.environment_factor_mm
        return 1e3 * start, 1e3 * end
    if "environment_factor" not in deviations:
        return None
    start, end = deviations["environment_factor"].values
    return (float(start), float(end)) if np.isfinite([start, end]).all() else None


def _redone(redone: xr.Dataset, stated: bool, seen: SeenMaterial | None) -> Notice:
    added = redone["correction_scale"] + redone["correction_dead_path"]
    undone = (
        "the environment factor that the instrument applied"
        if stated
        else "a compensation that followed the logged air and the logged probe"
    )
    material = (
        "the logged probe"
        if seen is None
        else f"the temperature that the camera saw along the axis (u {seen.u_K:.2g} K)"
    )
    u = float(redone["compensation_u"].max())
    return Notice(
        "compensation_redone",
        f"The laser's compensation was done again: {undone} was taken out, the logged air and {material} put in. This moved the "
        f"readings by {float(added.min()):+.2f} to {float(added.max()):+.2f} um; standard uncertainty up to {u:.2f} um.",
        'nothing; compensation = "as recorded" under [interferometry] leaves the readings as they are',
        float(np.abs(added).max()),
    )


def see_material(fields: xr.Dataset, axis: AxisGeometry, deviations: xr.Dataset) -> SeenMaterial:
    """Return the mean temperature that the camera saw between axis position 0 and each target, at each reading's time.

    Readings before the first or after the last frame take that frame. The camera's accuracy (the data sheet's +-2 K) is the same
    error in every frame and place: it does not average out along the axis, but it makes no drift.
    """
    position = deviations["position"].values
    line = MeasuredLine(fields, axis, position)
    samples = line.sample(fields["frame_temperature"].values.astype(float))
    at_target = samples[:, line.nearest]
    length = np.where(position == 0.0, 1.0, position)
    mean = np.where(position == 0.0, at_target, line.integrate(samples) / length)
    at_readings = interpolate_series(deviations["time"].values, fields["time"].values.astype("datetime64[ns]"), mean)
    u = line.sample(fields["temperature_u"].values.astype(float))
    u_K = float(np.hypot(np.nanmean(u), InputUncertainty().camera_offset_K))
    return SeenMaterial(deviations["deviation"].copy(data=at_readings), u_K)


def correct_dead_path(
    deviations: xr.Dataset, environment: xr.Dataset | None, dead_path_mm: float
) -> tuple[xr.Dataset, list[Notice]]:
    """Take out what the air of a known dead path adds to the readings, for a reflector that moves away from the laser.

    The readings' own path is left as the instrument compensated it.
    """
    if dead_path_mm == 0.0:
        return deviations, []
    if environment is None:
        message = f"The dead path of {dead_path_mm:g} mm is not corrected: the air was not logged."
        return deviations, [Notice("dead_path_uncorrected", message, _NO_LOG)]
    log = environment.dropna("time")
    start = log["time"].values[0]
    at, known = (
        (times.astype("datetime64[ns]") - start) / np.timedelta64(1, "s")
        for times in (deviations["time"].values, log["time"].values)
    )
    names = ("air_temperature", "air_pressure", "relative_humidity")
    index = air_index(*(np.interp(at, known, log[name].values) for name in names))
    first = float(index.ravel()[np.nanargmin(at)])
    error = dead_path_error_um(index, first, dead_path_mm=dead_path_mm)
    size = float(np.nanmax(error) - np.nanmin(error))
    message = f"The dead path of {dead_path_mm:g} mm is corrected for the logged air: {size:.2f} um from least to most."
    corrected = deviations.assign(deviation=deviations["deviation"] - error)
    corrected["deviation"].attrs.update(deviations["deviation"].attrs)
    remedy = "nothing, unless the reflector moves towards the laser: then give the dead path a minus sign"
    return corrected, [Notice("dead_path_corrected", message, remedy, size)]
