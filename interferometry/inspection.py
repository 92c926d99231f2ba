"""Summary of a positioning test in lines of text: missing readings, times, environment, and a check of the environment factor."""

from __future__ import annotations

import json

import numpy as np
import xarray as xr

from interferometry.compensation import VACUUM_WAVELENGTH_NM, air_index, implied_wavelength_nm

#: Tolerance of the implied wavelength, ppm: it covers the laser and the rounding of the file; beyond, a sensor or a setting is wrong.
_WAVELENGTH_PPM = 0.3


def describe_test(deviations: xr.Dataset) -> list[str]:
    """Describe a positioning test as it was read."""
    lines = [*_missing(deviations), *describe_notes(deviations)]
    if "time_u" in deviations:
        u_s = float(deviations["time_u"])
        lines.append(f"standard uncertainty of a reconstructed time {u_s:.1f} s; feed and dwell lower it")
    return [*lines, *_environment(deviations), *_wavelength(deviations)]


def _missing(deviations: xr.Dataset) -> list[str]:
    present = np.isfinite(deviations["deviation"].values)
    lines = []
    for i, direction in enumerate(deviations["direction"].values):
        missing = int((~present[:, i]).sum())
        if not present[:, i].any():
            lines.append(f"warning: no reading in the {direction} direction")
        elif missing:
            lines.append(f"warning: {missing} of {present[:, i].size} readings missing in the {direction} direction")
    empty = json.loads(deviations.attrs.get("runs_empty", "[]"))
    if empty:
        lines.append(f"runs without a reading: {', '.join(str(run) for run in empty)}")
    return lines


def describe_notes(deviations: xr.Dataset) -> list[str]:
    """Return what the reader assumed, and which columns it did not read."""
    ignored = json.loads(deviations.attrs.get("columns_ignored", "[]"))
    columns = [f"columns that were not read: {', '.join(ignored)}"] if ignored else []
    return json.loads(deviations.attrs.get("notes", "[]")) + columns


def _environment(deviations: xr.Dataset) -> list[str]:
    parts = []
    for name, label in (
        ("air_temperature", "air"),
        ("air_pressure", "pressure"),
        ("relative_humidity", "humidity"),
        ("material_temperature", "material"),
        ("expansion_coefficient", "expansion"),
    ):
        if name in deviations and np.isfinite(deviations[name]).any():
            values, unit = deviations[name].values, deviations[name].attrs["units"].replace("percent", "%")
            low, high = float(np.nanmin(values)), float(np.nanmax(values))
            parts.append(f"{label} {low:g} {unit}" if low == high else f"{label} {low:g} to {high:g} {unit}")
    return ["start and end: " + ", ".join(parts)] if parts else []


def _wavelength(deviations: xr.Dataset) -> list[str]:
    """Return the vacuum wavelength that factor, air and material imply: independent sensors, so that one checks the others."""
    needed = ("environment_factor", "air_temperature", "air_pressure", "relative_humidity", "material_temperature")
    if not all(name in deviations for name in needed) or "expansion_coefficient" not in deviations:
        return []
    connected = np.isfinite(deviations["material_temperature"].values).all(axis=1)
    if not connected.any():
        return []
    index = air_index(*(deviations[name].values for name in needed[1:4]))
    material = deviations["material_temperature"].values[connected].mean(axis=0)
    implied = implied_wavelength_nm(
        deviations["environment_factor"].values,
        index,
        material_temperature_degC=material,
        expansion_coefficient_ppm_per_K=float(deviations["expansion_coefficient"].values[0]),
    )
    factor = deviations["environment_factor"].values
    difference_ppm = (float(np.mean(implied)) / VACUUM_WAVELENGTH_NM - 1.0) * 1e6
    line = (
        f"environment factor {factor[0]:.9g} to {factor[1]:.9g} um: with this air and material a vacuum wavelength of "
        f"{float(np.mean(implied)):.5f} nm, {difference_ppm:+.3f} ppm from a stabilised HeNe laser's"
    )
    if np.isfinite(difference_ppm) and abs(difference_ppm) <= _WAVELENGTH_PPM:
        return [line]
    return [f"warning: {line}; the instrument used other air, another material temperature or another coefficient"]
