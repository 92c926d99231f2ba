"""Compensation of the laser in a campaign: as recorded, or repeated with the logged air and the temperature of the axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import xarray as xr

from fusion.analysis.alignment.align import AxisGeometry, MeasuredLine, interpolate_series
from fusion.campaign.config import CampaignError, InterferometryTable
from fusion.results.results import Notice
from interferometry.compensation import SensorUncertainty, air_index, compensate, dead_path_error_um, followed_factor_um
from interferometry.io.readings import AIR_AND_MATERIAL
from interferometry.iso230 import Iso230Budget
from interferometry.iso230.quantities import LENGTHS, SCATTER_ALONE

# The uncertainty budget of a campaign's ISO 230-2 values: what is stated, what was measured, what is assumed.

Origin = Literal["stated", "assumed", "from the camera", "not of a rotary axis"]


@dataclass(frozen=True)
class StatedBudget:
    """A budget of standard uncertainties and the origin of each of its entries."""

    budget: Iso230Budget
    origins: Mapping[str, Origin]


ROTARY_BUDGET = StatedBudget(SCATTER_ALONE, dict.fromkeys(LENGTHS, "not of a rotary axis"))


def state_budget(table: InterferometryTable, *, camera_u_K: float | None = None) -> StatedBudget:
    """Return the budget of a campaign, the same for readings as recorded and for those that are compensated again."""
    stated = table.uncertainty
    given = {name: getattr(stated, field) for name, (field, _) in LENGTHS.items()}
    if given["expansion_coefficient"] is None:
        given["expansion_coefficient"] = table.expansion_coefficient_u_ppm_per_K
    origins: dict[str, Origin] = {name: "assumed" if value is None else "stated" for name, value in given.items()}
    known = {LENGTHS[name][0]: value for name, value in given.items() if value is not None}
    if camera_u_K is not None and stated.material_temperature_K is None:
        known["material_temperature_K"] = camera_u_K
        origins["material_temperature"] = "from the camera"
    if stated.environmental_variation_um is not None:
        known["environmental_variation_um"] = stated.environmental_variation_um
        origins["environmental_variation"] = "stated"
    nominal = table.expansion_coefficient_ppm_per_K
    return StatedBudget(Iso230Budget(**known, nominal_expansion_ppm_per_K=nominal), origins)


def material_by_cycle(deviations: xr.Dataset, environment: xr.Dataset | None) -> xr.DataArray | None:
    """Return the logged temperature of the material in the middle of each cycle, degC."""
    numbers = deviations["cycle"].values
    if environment is not None:
        log = environment[["material_temperature"]].dropna("time")
        time = deviations["time"].values.astype("datetime64[ns]")
        if log.sizes["time"] == 0 or np.isnat(time).all():
            return None
        start = log["time"].values[0]
        log_s = (log["time"].values - start) / np.timedelta64(1, "s")
        readings_s = np.where(np.isnat(time), np.nan, (time - start) / np.timedelta64(1, "s"))
        timed = np.isfinite(readings_s).any(axis=(1, 2))
        middle_s = np.nanmean(readings_s[timed], axis=(1, 2))
        values = np.full(numbers.size, np.nan)
        values[timed] = np.interp(middle_s, log_s, log["material_temperature"].values)
    elif "material_temperature" in deviations and np.isfinite(deviations["material_temperature"]).any():
        values = np.full(numbers.size, float(deviations["material_temperature"].mean()))
    else:
        return None
    return xr.DataArray(values, dims="cycle", coords={"cycle": numbers})


class RecompensationError(CampaignError):
    """The compensation cannot be repeated with the data of the campaign; the message says what is missing."""


@dataclass(frozen=True)
class Compensated:
    """Readings as they are to be evaluated, their uncertainty contributions, and what was done or could not be done."""

    deviations: xr.Dataset
    budget: StatedBudget
    notices: list[Notice] = field(default_factory=list)


@dataclass(frozen=True)
class SeenMaterial:
    """Temperature from the camera between axis position 0 and the target (cycle, direction, target), degC; standard uncertainty, K."""

    temperature: xr.DataArray
    u_K: float


def compensate_readings(
    deviations: xr.Dataset,
    environment: xr.Dataset | None,
    table: InterferometryTable,
    *,
    material: SeenMaterial | None = None,
) -> Compensated:
    """Leave the readings as the instrument compensated them, apart from a stated dead path; or compensate them again. Angles stay."""
    if deviations["deviation"].attrs["units"] == "arcsec":
        return Compensated(deviations, ROTARY_BUDGET)
    if table.compensation == "as recorded":
        corrected, notices = _correct_dead_path(deviations, environment, table.dead_path_mm)
        return Compensated(corrected, state_budget(table), notices)
    if environment is None:
        raise RecompensationError(
            '[interferometry] compensation = "redo" needs the air: log air temperature, pressure and humidity, and name the file as '
            "[interferometry] environment"
        )
    log, coefficient = environment.dropna("time", subset=AIR_AND_MATERIAL), table.expansion_coefficient_ppm_per_K
    stated = _stated_factor_um(deviations, table)
    applied = stated or followed_factor_um(deviations, log, expansion_coefficient_ppm_per_K=coefficient)
    stated_budget = state_budget(table, camera_u_K=None if material is None else material.u_K)
    sensors = SensorUncertainty(
        material_temperature_K=stated_budget.budget.material_temperature_K,
        expansion_coefficient_ppm_per_K=stated_budget.budget.expansion_coefficient_ppm_per_K,
    )
    redone = compensate(
        deviations,
        log,
        applied_factor_um=applied,
        expansion_coefficient_ppm_per_K=coefficient,
        material_temperature_degC=None if material is None else material.temperature,
        dead_path_mm=abs(table.dead_path_mm),
        away=table.dead_path_mm >= 0,
        uncertainty=sensors,
    )
    return Compensated(redone, stated_budget, [_redone(redone, stated is not None, material)])


def _stated_factor_um(deviations: xr.Dataset, table: InterferometryTable) -> tuple[float, float] | None:
    """Return the environment factors at the start and the end of the test in um, None where neither campaign nor file states them."""
    if table.environment_factor_mm is not None:
        start, end = table.environment_factor_mm
        return 1e3 * start, 1e3 * end
    if "environment_factor" not in deviations:
        return None
    start, end = deviations["environment_factor"].values
    return (float(start), float(end)) if np.isfinite([start, end]).all() else None


def _redone(redone: xr.Dataset, stated: bool, material: SeenMaterial | None) -> Notice:
    """Return the notice that says what the new compensation replaced, and by how much it moved the readings."""
    added = redone["correction_scale"] + redone["correction_dead_path"]
    undone, probe = "a compensation that followed the logged air and the logged probe", "the logged probe"
    if stated:
        undone = "the environment factor that the instrument applied"
    if material is not None:
        probe = f"the temperature that the camera measured along the axis (u {material.u_K:.2g} K)"
    u = float(redone["compensation_u"].max())
    return Notice.of(
        "compensation_redone",
        effect_um=float(np.abs(added).max()),
        undone=undone,
        probe=probe,
        least=float(added.min()),
        most=float(added.max()),
        u=u,
    )


def see_material(fields: xr.Dataset, axis: AxisGeometry, deviations: xr.Dataset) -> SeenMaterial:
    """Return the mean temperature that the camera measured between axis position 0 and each target, at the time of each reading."""
    position = deviations["position"].values
    line = MeasuredLine(fields, axis, position)
    samples = line.sample(fields["frame_temperature"])
    at_target = samples[:, line.nearest]
    length = np.where(position == 0.0, 1.0, position)
    mean = np.where(position == 0.0, at_target, line.integrate(samples) / length)
    at_readings = interpolate_series(deviations["time"].values, fields["time"].values.astype("datetime64[ns]"), mean)
    u = line.sample(fields["temperature_u"])
    u_K = float(np.nanmean(u))
    return SeenMaterial(deviations["deviation"].copy(data=at_readings), u_K)


def _correct_dead_path(
    deviations: xr.Dataset, environment: xr.Dataset | None, dead_path_mm: float
) -> tuple[xr.Dataset, list[Notice]]:
    """Subtract the error of the air in a known dead path, for a reflector that moves away from the laser."""
    if dead_path_mm == 0.0:
        return deviations, []
    if environment is None:
        return deviations, [Notice.of("dead_path_uncorrected", dead_path_mm=dead_path_mm)]
    log = environment.dropna("time", subset=AIR_AND_MATERIAL)
    start = log["time"].values[0]
    readings_s, log_s = (
        (times.astype("datetime64[ns]") - start) / np.timedelta64(1, "s")
        for times in (deviations["time"].values, log["time"].values)
    )
    names = ("air_temperature", "air_pressure", "relative_humidity")
    index = air_index(*(np.interp(readings_s, log_s, log[name].values) for name in names))
    first = float(index.ravel()[np.nanargmin(readings_s)])
    error = dead_path_error_um(index, first, dead_path_mm=dead_path_mm)
    size = float(np.nanmax(error) - np.nanmin(error))
    corrected = deviations.assign(deviation=deviations["deviation"] - error)
    corrected["deviation"].attrs.update(deviations["deviation"].attrs)
    return corrected, [Notice.of("dead_path_corrected", effect_um=size, dead_path_mm=dead_path_mm, size=size)]
