"""Counts to surface temperature by the measurement formula that reproduces the vendor's own programs.

The formula is that of FLIR's user manuals, U_tot = e tau U_obj + (1 - e) tau U_refl + (1 - tau) U_atm, extended by a window.
The transmission belongs to the whole path, tau(d); public readers that split the path in two halves, tau(d/2)^2, are off by up
to 0.1 K at 5 m.
"""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermography.errors import ThermographyError
from thermography.io.frame import CameraParameters

ZERO_CELSIUS_K = 273.15


class RadiometryError(ThermographyError):
    """Parameters with which no temperature can be calculated; the message names the parameter, its value and the remedy."""


def calibrate(counts: NDArray[np.uint16], parameters: CameraParameters) -> NDArray[np.float32]:
    """Return the surface temperature of every pixel.

    Parameters
    ----------
    counts : ndarray of uint16, any shape
    parameters : CameraParameters

    Returns
    -------
    ndarray of float32, same shape
        Temperature, degC; NaN where the count is below what any temperature gives with these parameters.

    Raises
    ------
    RadiometryError
        Where a parameter makes the formula meaningless.
    """
    counts = np.asarray(counts)
    if counts.dtype != np.uint16:
        raise RadiometryError(
            f"counts: expected uint16, got {counts.dtype}; use temperature_from_counts for averaged counts"
        )
    if counts.size == 0:
        return np.empty(counts.shape, np.float32)
    low, high = int(counts.min()), int(counts.max())
    table = np.empty(1 << 16, np.float32)
    table[low : high + 1] = temperature_from_counts(np.arange(low, high + 1, dtype=np.float64), parameters)
    temperature: NDArray[np.float32] = np.asarray(cv2.LUT(np.ascontiguousarray(counts).reshape(-1), table), np.float32)
    return temperature.reshape(counts.shape)


def temperature_from_counts(
    counts: ArrayLike, parameters: CameraParameters, *, emissivity: ArrayLike | None = None
) -> NDArray[np.float64]:
    """Return the surface temperature of counts that need not be whole numbers.

    Parameters
    ----------
    counts : array, any shape
    parameters : CameraParameters
    emissivity : array that broadcasts with counts, optional
        Emissivity of each pixel, instead of the one of the parameters.

    Returns
    -------
    ndarray of float64
        Temperature, degC; NaN where no temperature gives these counts.

    Raises
    ------
    RadiometryError
        Where a parameter makes the formula meaningless.
    """
    gain, offset = count_line(parameters, emissivity)
    return temperature_of_signal((np.asarray(counts, np.float64) - offset) / gain, parameters)


def temperature_of_signal(signal: ArrayLike, parameters: CameraParameters) -> NDArray[np.float64]:
    """Return the temperature (degC) of a black body that gives `signal` counts in front of the lens: the inverse of S(T)."""
    p = parameters
    above_zero = np.asarray(signal, np.float64) + p.planck_o
    with np.errstate(invalid="ignore", divide="ignore"):
        argument = p.planck_r1 / (p.planck_r2 * above_zero) + p.planck_f
        temperature = p.planck_b / np.log(argument) - ZERO_CELSIUS_K
    return np.where((above_zero > 0) & (argument > 1), temperature, np.nan)


def counts_from_temperature(
    temperature: ArrayLike, parameters: CameraParameters, *, emissivity: ArrayLike | None = None
) -> NDArray[np.float64]:
    """Return the counts (float64, not rounded) that a surface of a temperature (degC) gives: the inverse of `calibrate`."""
    gain, offset = count_line(parameters, emissivity)
    return gain * black_body_signal(np.asarray(temperature, np.float64) + ZERO_CELSIUS_K, parameters) + offset


def black_body_signal(temperature_K: ArrayLike, parameters: CameraParameters) -> NDArray[np.float64]:
    """Return the counts of a black body (K) in front of the lens, S(T) = R1 / (R2 (exp(B/T) - F)) - O."""
    p = parameters
    exponential = np.exp(p.planck_b / np.asarray(temperature_K, np.float64))
    return p.planck_r1 / (p.planck_r2 * (exponential - p.planck_f)) - p.planck_o


def signal_slope(temperature_K: ArrayLike, parameters: CameraParameters) -> NDArray[np.float64]:
    """Return dS/dT of a black body, counts per kelvin."""
    p, kelvin = parameters, np.asarray(temperature_K, np.float64)
    exponential = np.exp(p.planck_b / kelvin)
    return p.planck_r1 / p.planck_r2 * exponential * p.planck_b / (kelvin * (exponential - p.planck_f)) ** 2


def count_line(
    parameters: CameraParameters, emissivity: ArrayLike | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return gain and offset of counts = gain * S(T_object) + offset.

    Everything but the object itself (reflections, air, window) is in these two, which have the shape of the emissivity.

    Raises
    ------
    RadiometryError
        Where a parameter makes the formula meaningless.
    """
    check(parameters)
    p = parameters
    e = np.asarray(p.emissivity if emissivity is None else emissivity, np.float64)
    if not np.all((e > 0) & (e <= 1)):
        raise RadiometryError(f"emissivity from {e.min():g} to {e.max():g}: expected fractions above 0 and up to 1")
    tau, tau_window = transmission(p), p.window_transmission
    reflected = black_body_signal(p.reflected_temperature_K, p)
    air = black_body_signal(p.atmospheric_temperature_K, p)
    offset = tau_window * (tau * (1 - e) * reflected + (1 - tau) * air)
    if tau_window < 1:
        offset = offset + (1 - tau_window) * black_body_signal(p.window_temperature_K, p)
    return tau_window * tau * e, offset


def transmission(parameters: CameraParameters) -> float:
    """Return the transmission of the air between object and camera, 0..1.

    What the file stores is used where it stores one; `override` clears it when distance, humidity or air temperature change.
    """
    p = parameters
    if p.stored_transmission > 0:
        return p.stored_transmission
    return path_transmission(p)


def path_transmission(parameters: CameraParameters) -> float:
    """Return the transmission that distance, humidity and air temperature give by the vendor's formula."""
    p = parameters
    celsius = p.atmospheric_temperature_K - ZERO_CELSIUS_K
    water = p.relative_humidity * np.exp(
        1.5587 + 0.06939 * celsius - 0.00027816 * celsius**2 + 0.00000068455 * celsius**3
    )
    root_distance, root_water = np.sqrt(p.object_distance_m), np.sqrt(water)
    first = np.exp(-root_distance * (p.atmosphere_alpha1 + p.atmosphere_beta1 * root_water))
    second = np.exp(-root_distance * (p.atmosphere_alpha2 + p.atmosphere_beta2 * root_water))
    return float(p.atmosphere_x * first + (1 - p.atmosphere_x) * second)


def override(parameters: CameraParameters, **changes: float) -> CameraParameters:
    """Return the parameters with some of them replaced.

    A stored transmission belongs to the stored distance, humidity and air temperature: where one of these changes and no
    transmission is given, it is cleared.

    Raises
    ------
    RadiometryError
        Where a name is not a parameter.
    """
    known = [field.name for field in fields(CameraParameters)]
    for name in changes:
        if name not in known:
            raise RadiometryError(f"parameter {name!r} is not known; use one of {', '.join(known)}")
    if {"object_distance_m", "relative_humidity", "atmospheric_temperature_K"} & changes.keys():
        changes.setdefault("stored_transmission", 0.0)
    return replace(parameters, **changes)


def check(parameters: CameraParameters) -> None:
    """Raise a RadiometryError that lists every parameter with which no temperature can be calculated."""
    if faults := _faults(parameters):
        raise RadiometryError("; ".join(faults) + "; override what the file has wrong")


@lru_cache(maxsize=256)
def _faults(parameters: CameraParameters) -> tuple[str, ...]:
    """Return what is wrong with each parameter, as text."""
    values = asdict(parameters)
    ranges = {
        "emissivity": (1e-6, 1, "a fraction above 0 and up to 1"),
        "window_transmission": (1e-6, 1, "a fraction above 0 and up to 1"),
        "stored_transmission": (0, 1, "a fraction from 0 to 1"),
        "relative_humidity": (0, 1, "a fraction from 0 to 1"),
        "object_distance_m": (0, np.inf, "0 m or more"),
        "reflected_temperature_K": (100, 3000, "kelvin between 100 and 3000"),
        "atmospheric_temperature_K": (100, 3000, "kelvin between 100 and 3000"),
        "window_temperature_K": (100, 3000, "kelvin between 100 and 3000"),
        "planck_r1": (1e-9, np.inf, "a positive number (the file is not calibrated)"),
        "planck_b": (1e-9, np.inf, "a positive number (the file is not calibrated)"),
        "planck_r2": (1e-9, np.inf, "a positive number (the file is not calibrated)"),
    }
    if parameters.window_transmission == 1:
        # Without a window its temperature means nothing, and cameras leave it at 0.
        del values["window_temperature_K"]
    faults = []
    for name, value in values.items():
        low, high, expected = ranges.get(name, (-np.inf, np.inf, "a finite number"))
        if not (np.isfinite(value) and low <= value <= high):
            faults.append(f"{name} = {value:g}: expected {expected}")
    return tuple(faults)
