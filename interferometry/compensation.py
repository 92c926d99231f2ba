"""Compensation of laser readings for air, dead path and material expansion: the applied one reversed, and done again.

A linear interferometer counts half wavelengths. Its display multiplies them by the environment factor
``lambda_vac / (2 n (1 + alpha (T - 20 degC)))``: the wavelength in air of index n, and the scale of a material of
expansion alpha brought to 20 degC. Where that factor is known, the displacement can be brought back to counts and
compensated again, with the logged air and with any temperature of the axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import ref_index

from interferometry.common import Array, InterferometryError, check_dataset, check_uncertainties

if TYPE_CHECKING:
    import xarray as xr

#: Vacuum wavelength of the stabilised HeNe laser in nm, as genuine files imply it (632.990616 .. 632.990634).
VACUUM_WAVELENGTH_NM = 632.990625
REFERENCE_TEMPERATURE_DEGC = 20.0
#: Readings farther than this from any logged condition are refused.
LONGEST_GAP_S = 900.0
#: Vacuum wavelengths in nm for which Ciddor's equation holds.
WAVELENGTHS_NM = (300.0, 1700.0)
#: Air and 40 K of steel together change a length by less than this.
LARGEST_SCALE = 1e-3


class CompensationError(InterferometryError):
    """The compensation cannot be done with these conditions; the message says what to change."""


@dataclass(frozen=True)
class SensorUncertainty:
    """Standard uncertainties (k = 1) of the inputs of the compensation; ``formula_ppm`` is that of Ciddor's equation.

    The defaults are those of an XL-80 with weather station, half its k = 2 specification. One that is negative or not finite raises
    `CompensationError`.
    """

    air_temperature_K: float = 0.1
    air_pressure_hPa: float = 0.5
    relative_humidity_percent: float = 3.0
    material_temperature_K: float = 0.05
    expansion_coefficient_ppm_per_K: float = 0.5
    formula_ppm: float = 0.02
    dead_path_mm: float = 2.0

    def __post_init__(self) -> None:
        check_uncertainties(self, error=CompensationError)


def air_index(
    air_temperature_degC: Array | float,
    air_pressure_hPa: Array | float,
    relative_humidity_percent: Array | float,
    *,
    wavelength_nm: float = VACUUM_WAVELENGTH_NM,
) -> Array:
    """Return the refractive index of air by Ciddor's equation (1996, Applied Optics 35, 1566), with 450 ppm CO2; NaN where an input is."""

    def index(temperature_degC: float, pressure_hPa: float, humidity_percent: float) -> float:
        if np.isnan(temperature_degC + pressure_hPa + humidity_percent):
            return np.nan
        return float(ref_index.ciddor(wavelength_nm, temperature_degC, pressure_hPa * 100.0, humidity_percent))

    of_each = np.vectorize(index, otypes=[float])
    return np.asarray(of_each(air_temperature_degC, air_pressure_hPa, relative_humidity_percent))


def environment_factor(
    index: Array | float,
    *,
    material_temperature_degC: Array | float = REFERENCE_TEMPERATURE_DEGC,
    expansion_coefficient_ppm_per_K: float = 0.0,
    wavelength_nm: float = VACUUM_WAVELENGTH_NM,
) -> Array:
    """Return the environment factor: displacement per count of half a wavelength, lambda / (2 n (1 + alpha (T - 20 degC)))."""
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
    """Return the dead-path error: the change of the display, with nothing moving, since the index was that of the zeroing."""
    return dead_path_mm * 1e3 * (np.asarray(index) - start_index) / np.asarray(index)


def followed_factor_um(
    deviations: xr.Dataset,
    environment: xr.Dataset,
    *,
    expansion_coefficient_ppm_per_K: float,
) -> Array:
    """Return the environment factor of an instrument that followed the logged air and the logged probe."""
    air, _ = _conditions_at(deviations, environment)
    return environment_factor(
        _index_of(air, VACUUM_WAVELENGTH_NM),
        material_temperature_degC=air["material_temperature"],
        expansion_coefficient_ppm_per_K=expansion_coefficient_ppm_per_K,
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
    """Reverse the instrument's compensation where its factor is known, and compensate with the logged conditions.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``, with times.
    environment : xarray.Dataset
        What `read_environment` returns.
    applied_factor_um : (float, float) or (cycle, direction, target) ndarray, optional
        Environment factor, um per count: at the start and the end of the test, as a .rtl holds it, interpolated linearly in time; or of
        every reading, as `followed_factor_um` returns it. None: only the dead path is corrected.
    expansion_coefficient_ppm_per_K : float
        Of the axis or workpiece whose length is brought to 20 degC, ppm/K; 0: it is left as it is.
    material_temperature_degC : (cycle, direction, target) xarray.DataArray, optional
        Temperature of the measured length at each reading, degC, for instance seen by a camera. None: the logged probe.
    dead_path_mm : float
        Distance from the interferometer to the reflector where the display was set to zero, mm.
    zero_mm : float
        Axis position of that place, mm.
    away : bool
        Whether the reflector moves away from the interferometer as the position grows.
    wavelength_nm : float
        Vacuum wavelength of the laser, nm.
    uncertainty : SensorUncertainty, optional
        None: its defaults.

    Returns
    -------
    xarray.Dataset
        The compensated deviations and, at every reading in um, ``correction_scale`` and ``correction_dead_path`` (both already added);
        ``air_u``, ``material_u`` and ``dead_path_u``, standard uncertainties, and ``compensation_u``, their root sum of squares;
        ``air_index`` (1). ``attrs["outside_environment"]`` counts readings before or after the log, which take its first or last
        condition; ``attrs["without_time"]`` those without a time, whose conditions nobody knows: they are NaN and flagged as unreadable.

    Raises
    ------
    CompensationError
        No reading has a time, one lies more than 15 minutes from any logged condition, or the applied factor differs by more than
        1000 ppm from the one of these conditions; or a number is not finite, the dead path negative, or the wavelength outside
        300 nm .. 1700 nm.
    InterferometryError
        ``deviations`` or ``environment`` lack a variable of ``contract.DEVIATIONS`` or ``contract.ENVIRONMENT``.

    Notes
    -----
    A displayed length L is counts times the environment factor f = lambda / (2 n (1 + alpha (T - 20 degC))): the correction of scale is
    L (f_now / f_applied - 1). Index of air: Ciddor (1996), Applied Optics 35, 1566. A change of index since the zeroing changes the
    display by D (n - n_0) / n over a dead path D.

    Examples
    --------
    An instrument that used an index of air of 1.00027 throughout, on a reading at 1 m:

    >>> import numpy as np
    >>> import xarray as xr
    >>> from interferometry.deviations import build_deviations
    >>> time = np.array([[["2026-03-09T06:30"], ["2026-03-09T06:31"]]], "datetime64[ns]")
    >>> test = build_deviations([1], [1], np.array([1000.0]), np.zeros((1, 2, 1)), time)
    >>> air = {"air_temperature": 20.0, "air_pressure": 1013.25, "relative_humidity": 50.0, "material_temperature": 20.0}
    >>> log = xr.Dataset({k: ("time", [v]) for k, v in air.items()}, {"time": time[0, 0]})
    >>> factor = float(environment_factor(1.00027))
    >>> redone = compensate(test, log, applied_factor_um=(factor, factor))
    >>> redone["correction_scale"].values.round(2).tolist()
    [[[-1.37], [-1.37]]]
    """
    deviations = check_dataset(deviations, "deviations")
    environment = check_dataset(environment, "environment")
    _check_numbers(
        expansion_coefficient_ppm_per_K=expansion_coefficient_ppm_per_K,
        dead_path_mm=dead_path_mm,
        zero_mm=zero_mm,
        wavelength_nm=wavelength_nm,
    )
    air, outside = _conditions_at(deviations, environment)
    if material_temperature_degC is not None:
        air["material_temperature"] = material_temperature_degC.transpose(*deviations["deviation"].dims).values
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
    without_time = np.isfinite(deviations["deviation"].values) & np.isnat(deviations["time"].values)
    corrected = _corrected(deviations, added, u, index)
    if without_time.any():
        from interferometry.deviations import UNREADABLE, set_flag  # loads xarray, which a finished run does without

        corrected = set_flag(corrected, UNREADABLE, without_time)
    return corrected.assign_attrs(outside_environment=outside, without_time=int(without_time.sum()))


def _check_numbers(**numbers: float) -> None:
    """Refuse numbers that are not finite, a negative dead path, and a wavelength beyond the equation for the index."""
    for name, value in numbers.items():
        if not np.isfinite(value):
            raise CompensationError(f"{name}={value} is not finite; give a number")
    if numbers["dead_path_mm"] < 0:
        raise CompensationError(f"dead_path_mm={numbers['dead_path_mm']} is negative; give the distance, 0 or more")
    if not WAVELENGTHS_NM[0] <= numbers["wavelength_nm"] <= WAVELENGTHS_NM[1]:
        raise CompensationError(
            f"wavelength_nm={numbers['wavelength_nm']} is outside {WAVELENGTHS_NM[0]:g} .. {WAVELENGTHS_NM[1]:g}; "
            f"a HeNe laser has {VACUUM_WAVELENGTH_NM} nm in vacuum"
        )


def _corrected(deviations: xr.Dataset, added: dict[str, Array], u: dict[str, Array], index: Array) -> xr.Dataset:
    """Return the corrected deviations with the parts of the correction and their standard uncertainties."""
    dims, total = deviations["deviation"].dims, sum(added.values())
    corrected = deviations.assign(
        deviation=(dims, deviations["deviation"].values + total, deviations["deviation"].attrs),
        air_index=(dims, index, {"units": "1"}),
    )
    together = np.sqrt(sum(np.square(part) for part in u.values()))
    for name, values in {**added, **u, "compensation_u": together}.items():
        corrected[name] = (dims, np.broadcast_to(values, index.shape), {"units": "um"})
    return corrected


def _index_of(air: dict[str, Array], wavelength_nm: float) -> Array:
    return air_index(air["air_temperature"], air["air_pressure"], air["relative_humidity"], wavelength_nm=wavelength_nm)


def _scale(deviations: xr.Dataset, wanted_um: Array, applied_um: tuple[float, float] | Array | None) -> Array:
    """Return the relative correction of a displayed length (1), (cycle, direction, target)."""
    if applied_um is None:
        return np.zeros(wanted_um.shape)
    applied = applied_um
    if isinstance(applied_um, tuple):
        seconds = _seconds(deviations)
        length = max(float(np.nanmax(seconds)), 1e-9)
        applied = applied_um[0] + (applied_um[1] - applied_um[0]) * seconds / length
    scale = wanted_um / applied - 1.0
    if np.nanmax(np.abs(scale)) > LARGEST_SCALE:
        raise CompensationError(
            f"the environment factor {float(np.nanmean(applied)):.6g} um differs by {np.nanmax(np.abs(scale)) * 1e6:.0f} ppm from "
            f"the {float(np.nanmean(wanted_um)):.6f} um that these conditions require; give the factor in um of the file of this test"
        )
    return scale


def _seconds(deviations: xr.Dataset) -> Array:
    time = deviations["time"].values.astype("datetime64[ns]")
    has_time = ~np.isnat(time)
    if not has_time.any():
        raise CompensationError(
            f"{deviations.attrs.get('source', 'the deviations')}: no reading has a time; a compensation needs the conditions at each "
            "reading: leave compensation and dead path as recorded, or export the readings with their times"
        )
    return np.where(has_time, (time - time[has_time].min()).astype("f8") * 1e-9, np.nan)


def _conditions_at(deviations: xr.Dataset, environment: xr.Dataset) -> tuple[dict[str, Array], int]:
    """Return logged conditions at every reading (linear in time), and how many readings lie outside the log."""
    _seconds(deviations)
    time = deviations["time"].values.astype("datetime64[ns]")
    has_time = ~np.isnat(time)
    logged = environment["time"].values.astype("datetime64[ns]")
    instant, log = time.astype("i8").astype("f8"), logged.astype("i8").astype("f8")
    timed = instant[has_time]
    after = np.clip(np.searchsorted(log, timed), 1, log.size - 1) if log.size > 1 else np.zeros(timed.size, int)
    nearest = np.minimum(np.abs(timed - log[after]), np.abs(timed - log[np.maximum(after - 1, 0)])) * 1e-9
    if nearest.max() > LONGEST_GAP_S:
        worst = time[has_time][int(np.argmax(nearest))]
        raise CompensationError(
            f"the reading at {worst} lies {nearest.max() / 60:.0f} min from any logged condition ({logged[0]} .. {logged[-1]}); "
            "give the environment log of this test"
        )
    outside = int(np.count_nonzero((timed < log[0]) | (timed > log[-1])))
    names = ("air_temperature", "air_pressure", "relative_humidity", "material_temperature")
    return {
        name: np.where(has_time, np.interp(instant, log, environment[name].values), np.nan) for name in names
    }, outside


def _air_ppm(air: dict[str, Array], sensors: SensorUncertainty, wavelength_nm: float) -> float:
    """Return the standard uncertainty of the index in ppm, by central differences at the mean conditions."""
    typical = [float(np.nanmean(air[name])) for name in ("air_temperature", "air_pressure", "relative_humidity")]
    squares = sensors.formula_ppm**2
    inputs = (sensors.air_temperature_K, sensors.air_pressure_hPa, sensors.relative_humidity_percent)
    for i, u in enumerate(inputs):
        high, low = list(typical), list(typical)
        high[i] += u / 2
        low[i] -= u / 2
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
