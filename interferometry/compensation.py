"""Index of air, dead path and material expansion: what a laser's compensation did, undone and done again.

A linear interferometer counts half wavelengths. Its display multiplies them by the environment factor
``lambda_vac / (2 n (1 + alpha (T - 20 degC)))``: the wavelength in air of index n, and the scale of a material of
expansion alpha brought to 20 degC. Where that factor is known, the displacement can be brought back to counts and
compensated again, with the logged air and with any temperature of the axis.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import ref_index
import xarray as xr

from interferometry._typing import Array
from interferometry.errors import InterferometryError

#: Vacuum wavelength of the stabilised HeNe laser in nm, as genuine files imply it (632.990616 .. 632.990634).
VACUUM_WAVELENGTH_NM = 632.990625
REFERENCE_TEMPERATURE_DEGC = 20.0
#: Readings farther than this from any logged condition are refused.
LONGEST_GAP_S = 900.0
#: Air and 40 K of steel together change a length by less than this.
LARGEST_SCALE = 1e-3


class CompensationError(InterferometryError):
    """The compensation cannot be done with these conditions; the message says what to change."""


@dataclass(frozen=True)
class SensorUncertainty:
    """Standard uncertainties of what the compensation uses (defaults: an XL-80 with weather station, half its k = 2 figures).

    Attributes
    ----------
    air_temperature_K, air_pressure_hPa, relative_humidity_percent : float
    material_temperature_K : float
    expansion_coefficient_ppm_per_K : float
    formula_ppm : float
        Of the equation for the index itself.
    dead_path_mm : float
    """

    air_temperature_K: float = 0.1
    air_pressure_hPa: float = 0.5
    relative_humidity_percent: float = 3.0
    material_temperature_K: float = 0.05
    expansion_coefficient_ppm_per_K: float = 0.5
    formula_ppm: float = 0.02
    dead_path_mm: float = 2.0

    def __post_init__(self) -> None:
        for one in fields(self):
            if getattr(self, one.name) < 0:
                raise CompensationError(f"{one.name}={getattr(self, one.name)} is negative; give 0 or more")


def air_index(
    air_temperature_degC: Array | float,
    air_pressure_hPa: Array | float,
    relative_humidity_percent: Array | float,
    *,
    wavelength_nm: float = VACUUM_WAVELENGTH_NM,
) -> Array:
    """Return the refractive index of air by Ciddor's equation.

    Parameters
    ----------
    air_temperature_degC, air_pressure_hPa, relative_humidity_percent : array_like
        Broadcast against each other.
    wavelength_nm : float
        In vacuum, 300 .. 1700.

    Notes
    -----
    Ciddor (1996), Applied Optics 35, 1566, in the form of the NIST Engineering Metrology Toolbox, with 450 ppm CO2.
    """
    one = np.vectorize(lambda t, p, h: ref_index.ciddor(wavelength_nm, t, p * 100.0, h), otypes=[float])
    return np.asarray(one(air_temperature_degC, air_pressure_hPa, relative_humidity_percent))


def environment_factor(
    index: Array | float,
    *,
    material_temperature_degC: Array | float = REFERENCE_TEMPERATURE_DEGC,
    expansion_coefficient_ppm_per_K: float = 0.0,
    wavelength_nm: float = VACUUM_WAVELENGTH_NM,
) -> Array:
    """Return the micrometres that one count stands for."""
    stretch = _stretch(material_temperature_degC, expansion_coefficient_ppm_per_K)
    return wavelength_nm * 1e-3 / (2.0 * np.asarray(index) * stretch)


def _stretch(material_temperature_degC: Array | float, expansion_coefficient_ppm_per_K: float) -> Array:
    """Return the length of the material over its length at 20 degC."""
    warmer = np.asarray(material_temperature_degC) - REFERENCE_TEMPERATURE_DEGC
    return np.asarray(1.0 + expansion_coefficient_ppm_per_K * 1e-6 * warmer)


def implied_wavelength_nm(
    factor_um: Array | float,
    index: Array | float,
    *,
    material_temperature_degC: Array | float,
    expansion_coefficient_ppm_per_K: float,
) -> Array:
    """Return the vacuum wavelength that an instrument's environment factor implies: a check of file and sensors."""
    unit = environment_factor(
        index,
        material_temperature_degC=material_temperature_degC,
        expansion_coefficient_ppm_per_K=expansion_coefficient_ppm_per_K,
        wavelength_nm=1.0,
    )
    return np.asarray(factor_um) / unit


def dead_path_error_um(index: Array, start_index: float, *, dead_path_mm: float) -> Array:
    """Return what a display gains in um, with nothing moving, when the index leaves its value at the zeroing."""
    return dead_path_mm * 1e3 * (np.asarray(index) - start_index) / np.asarray(index)


def followed_factor_um(
    deviations: xr.Dataset,
    environment: xr.Dataset,
    *,
    expansion_coefficient_ppm_per_K: float,
    wavelength_nm: float = VACUUM_WAVELENGTH_NM,
) -> Array:
    """Return the factor (cycle, direction, target) of an instrument that followed the logged air and the logged probe."""
    air, _ = _conditions_at(deviations, environment)
    return environment_factor(
        _index_of(air, wavelength_nm),
        material_temperature_degC=air["material_temperature"],
        expansion_coefficient_ppm_per_K=expansion_coefficient_ppm_per_K,
        wavelength_nm=wavelength_nm,
    )


def compensate(
    deviations: xr.Dataset,
    environment: xr.Dataset,
    *,
    applied_factor_um: tuple[float, float] | Array | None = None,
    expansion_coefficient_ppm_per_K: float = 11.7,
    material_temperature_degC: xr.DataArray | None = None,
    dead_path_mm: float = 0.0,
    zero_mm: float = 0.0,
    away: bool = True,
    wavelength_nm: float = VACUUM_WAVELENGTH_NM,
    uncertainty: SensorUncertainty | None = None,
) -> xr.Dataset:
    """Undo the instrument's compensation where its factor is known, and compensate with the logged conditions.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``; every reading needs a time.
    environment : xarray.Dataset
        What `readers.read_environment` returns.
    applied_factor_um : (float, float) or (cycle, direction, target) ndarray, optional
        Environment factor at the start and end of the test, as a .rtl holds it, between them taken as linear in time; or
        that of every reading, as `followed_factor_um` returns it. Left out: only the dead path remains to be corrected.
    expansion_coefficient_ppm_per_K : float
        Of the axis or workpiece that is brought to 20 degC; 0 leaves the material as it is.
    material_temperature_degC : xarray.DataArray, optional
        (cycle, direction, target): temperature of the measured length at each reading, for instance seen by a camera.
        Left out: the logged probe.
    dead_path_mm, zero_mm : float
        Distance from the interferometer to the reflector where the display was zeroed, and the axis position of that place.
    away : bool
        Whether the reflector moves away from the interferometer as the position grows.
    wavelength_nm : float
    uncertainty : SensorUncertainty, optional

    Returns
    -------
    xarray.Dataset
        The deviations compensated, and beside them, in um at every reading: correction_scale and correction_dead_path
        (both already added); air_u, material_u and dead_path_u, and compensation_u, their root sum of squares; air_index (1).
        ``attrs["outside_environment"]`` counts readings beyond the log, which take its first or last condition.

    Raises
    ------
    CompensationError
        Readings have no time, or lie more than 15 minutes from any logged condition; or the factor is none of a laser in air.
    """
    air, outside = _conditions_at(deviations, environment)
    if material_temperature_degC is not None:
        air["material_temperature"] = material_temperature_degC.values
    index, travel_mm = _index_of(air, wavelength_nm), deviations["position"].values - zero_mm
    stretch = _stretch(air["material_temperature"], expansion_coefficient_ppm_per_K)
    change = index - float(index.ravel()[int(np.nanargmin(_seconds(deviations)))])
    lengthened = dead_path_mm * 1e3 * change / index
    added = {
        "correction_scale": (travel_mm * 1e3 + deviations["deviation"].values)
        * _scale(deviations, wavelength_nm * 1e-3 / (2.0 * index * stretch), applied_factor_um),
        "correction_dead_path": -lengthened if away else lengthened,
    }
    sensors, length_m = uncertainty or SensorUncertainty(), np.abs(travel_mm) * 1e-3
    u = {
        "air_u": length_m * _air_ppm(air, sensors, wavelength_nm),
        "material_u": length_m * _material_ppm(air["material_temperature"], expansion_coefficient_ppm_per_K, sensors),
        "dead_path_u": sensors.dead_path_mm * 1e3 * np.abs(change) * (dead_path_mm != 0),
    }
    return _corrected(deviations, added, u, index).assign_attrs(outside_environment=outside)


def _corrected(deviations: xr.Dataset, added: dict[str, Array], u: dict[str, Array], index: Array) -> xr.Dataset:
    """Return the deviations with what is added to them, and beside them its parts and their uncertainties."""
    dims, total = deviations["deviation"].dims, sum(added.values())
    corrected = deviations.assign(
        deviation=(dims, deviations["deviation"].values + total, deviations["deviation"].attrs),
        air_index=(dims, index, {"units": "1"}),
    )
    together = np.sqrt(sum(np.square(one) for one in u.values()))
    for name, values in {**added, **u, "compensation_u": together}.items():
        corrected[name] = (dims, np.broadcast_to(values, index.shape), {"units": "um"})
    return corrected


def _index_of(air: dict[str, Array], wavelength_nm: float) -> Array:
    return air_index(air["air_temperature"], air["air_pressure"], air["relative_humidity"], wavelength_nm=wavelength_nm)


def _scale(deviations: xr.Dataset, wanted_um: Array, applied_um: tuple[float, float] | Array | None) -> Array:
    """Return by which share a displayed length has to grow, (cycle, direction, target)."""
    if applied_um is None:
        return np.zeros(wanted_um.shape)
    applied = _interpolate_factor(deviations, applied_um) if isinstance(applied_um, tuple) else applied_um
    scale = wanted_um / applied - 1.0
    if np.nanmax(np.abs(scale)) > LARGEST_SCALE:
        raise CompensationError(
            f"the environment factor {float(np.nanmean(applied)):.6g} um differs by {np.nanmax(np.abs(scale)) * 1e6:.0f} ppm from "
            f"the {float(np.nanmean(wanted_um)):.6f} um that these conditions ask for; give the factor in um of the file of this test"
        )
    return scale


def _seconds(deviations: xr.Dataset) -> Array:
    time = deviations["time"].values.astype("datetime64[ns]")
    known = ~np.isnat(time)
    if not known.any():
        raise CompensationError("no reading has a time; compensation needs the conditions at each reading")
    return np.where(known, (time - time[known].min()).astype("f8") * 1e-9, np.nan)


def _conditions_at(deviations: xr.Dataset, environment: xr.Dataset) -> tuple[dict[str, Array], int]:
    """Return logged conditions at every reading (linear in time), and how many readings lie outside the log."""
    _seconds(deviations)
    time = deviations["time"].values.astype("datetime64[ns]")
    known = ~np.isnat(time)
    logged = environment["time"].values.astype("datetime64[ns]")
    at, log = time.astype("i8").astype("f8"), logged.astype("i8").astype("f8")
    after = np.clip(np.searchsorted(log, at[known]), 1, log.size - 1) if log.size > 1 else np.zeros(at[known].size, int)
    nearest = np.minimum(np.abs(at[known] - log[after]), np.abs(at[known] - log[np.maximum(after - 1, 0)])) * 1e-9
    if nearest.max() > LONGEST_GAP_S:
        worst = time[known][int(np.argmax(nearest))]
        raise CompensationError(
            f"the reading at {worst} lies {nearest.max() / 60:.0f} min from any logged condition ({logged[0]} .. {logged[-1]}); "
            "give the environment log of this test"
        )
    outside = int(np.count_nonzero((at[known] < log[0]) | (at[known] > log[-1])))
    names = ("air_temperature", "air_pressure", "relative_humidity", "material_temperature")
    return {name: np.where(known, np.interp(at, log, environment[name].values), np.nan) for name in names}, outside


def _interpolate_factor(deviations: xr.Dataset, applied_factor_um: tuple[float, float]) -> Array:
    seconds = _seconds(deviations)
    length = max(float(np.nanmax(seconds)), 1e-9)
    return applied_factor_um[0] + (applied_factor_um[1] - applied_factor_um[0]) * seconds / length


def _air_ppm(air: dict[str, Array], sensors: SensorUncertainty, wavelength_nm: float) -> float:
    """Return the standard uncertainty of the index in ppm, by central differences at the mean conditions."""
    typical = [float(np.nanmean(air[name])) for name in ("air_temperature", "air_pressure", "relative_humidity")]
    squares = sensors.formula_ppm**2
    inputs = (sensors.air_temperature_K, sensors.air_pressure_hPa, sensors.relative_humidity_percent)
    for at, u in enumerate(inputs):
        high, low = list(typical), list(typical)
        high[at] += u / 2
        low[at] -= u / 2
        difference = air_index(*high, wavelength_nm=wavelength_nm) - air_index(*low, wavelength_nm=wavelength_nm)
        squares += float(difference * 1e6) ** 2
    return float(np.sqrt(squares))


def _material_ppm(material_degC: Array, expansion_ppm_per_K: float, sensors: SensorUncertainty) -> Array:
    """Return the standard uncertainty of the material's scale in ppm; none where no material is compensated."""
    if expansion_ppm_per_K == 0:
        return np.zeros(material_degC.shape)
    from_reference = material_degC - REFERENCE_TEMPERATURE_DEGC
    return np.hypot(
        expansion_ppm_per_K * sensors.material_temperature_K, sensors.expansion_coefficient_ppm_per_K * from_reference
    )
