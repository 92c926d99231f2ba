"""Converts counts to surface temperature by the measurement formula of the vendor.

The formula is that of FLIR's user manuals, U_tot = e tau U_obj + (1 - e) tau U_refl + (1 - tau) U_atm, extended by a window:

    n = tau_w (tau e S(T_obj) + tau (1 - e) S(T_refl) + (1 - tau) S(T_atm)) + (1 - tau_w) S(T_w),
    S(T) = R1 / (R2 (exp(B / T) - F)) - O,

with the counts n, the emissivity e, the transmissions tau of the air and tau_w of the window, and the signal S of a black body. The
transmission is that of the whole path, tau(d); readers that split the path into two halves, tau(d/2)^2, deviate by up to 0.1 K at 5 m.
For the E40bx frame in the tests the result agrees with the vendor's export to half of the last printed digit.

See ``docs/method/radiometry.md`` and W. Minkina and S. Dudzik, Infrared Thermography: Errors and Uncertainties (Wiley, 2009).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermography.common import ZERO_CELSIUS_K, Array, ThermographyError
from thermography.io.frame import CameraParameters, FrameHeader

#: FLIR's model of the air may exceed 1 a little where its constants were fitted to another path.
_MOST_TRANSMISSION = 1.01


class RadiometryError(ThermographyError):
    """Temperatures cannot be calculated from these inputs; the message names the input, its value and the remedy."""


def calibrate(counts: NDArray[np.uint16], parameters: CameraParameters) -> NDArray[np.float32]:
    """Convert the counts of a frame to surface temperature.

    Parameters
    ----------
    counts : ndarray of uint16, any shape
        Signal of the detector, counts.
    parameters : CameraParameters
        Parameters of the measurement formula; change those of a file with `override`.

    Returns
    -------
    ndarray of float32, same shape
        Surface temperature, degC; NaN where the count is below that of any temperature with these parameters.

    Raises
    ------
    RadiometryError
        Where the counts are not uint16, or a parameter makes the formula meaningless.

    See Also
    --------
    temperature_from_counts : The same for averaged counts, in double precision, also with an emissivity for each pixel.
    thermography.radiometry.uncertainty.temperature_uncertainty : Standard uncertainty of the result.

    Notes
    -----
    Measurement formula of FLIR's user manuals; see the module docstring. The formula is evaluated once per count between the lowest and
    the highest that occur; frames with the same parameters share these values.

    Examples
    --------
    >>> sc660 = CameraParameters(
    ...     0.95, 1.0, 293.15, 293.15, 293.15, 1.0, 0.0, 0.5, 21106.77, 1501.0, 1.0, -7340.0, 0.012545258,
    ...     0.006569, 0.01262, -0.002276, -0.00667, 1.9,
    ... )
    >>> calibrate(np.array([[18000, 18500]], np.uint16), sc660).round(2)
    array([[23.21, 26.05]], dtype=float32)
    """
    counts = np.asarray(counts)
    if counts.dtype != np.uint16:
        raise RadiometryError(f"counts: expected uint16, got {counts.dtype}; for means use temperature_from_counts")
    if counts.size == 0:
        return np.empty(counts.shape, np.float32)
    table = _table(parameters).covering(int(counts.min()), int(counts.max()))
    temperature: NDArray[np.float32] = np.asarray(cv2.LUT(np.ascontiguousarray(counts).reshape(-1), table), np.float32)
    return temperature.reshape(counts.shape)


class _Table:
    """Temperatures of counts with one set of parameters, computed for the counts that occur; threads may share it.

    Parameters
    ----------
    parameters : CameraParameters
    """

    def __init__(self, parameters: CameraParameters) -> None:
        self.parameters = parameters
        self.temperature = np.empty(1 << 16, np.float32)
        # From the first one on, up to but without the second. Two threads may compute the same values twice, never leave one out.
        self.known = (0, 0)

    def covering(self, low: int, high: int) -> NDArray[np.float32]:
        """Return temperatures by count, (65536,) degC, of which those from `low` to `high` are computed."""
        start, stop = self.known
        if start <= low <= high < stop:
            return self.temperature
        if start == stop:
            start = stop = low
        whole = min(start, low), max(stop, high + 1)
        for first, end in ((whole[0], start), (stop, whole[1])):
            if first < end:
                counts = np.arange(first, end, dtype=np.float64)
                self.temperature[first:end] = temperature_from_counts(counts, self.parameters)
        self.known = whole
        return self.temperature


#: 256 kB each: the parameters of the last frames, which seldom differ.
_table = lru_cache(maxsize=16)(_Table)


def temperature_from_counts(
    counts: ArrayLike, parameters: CameraParameters, *, emissivity: ArrayLike | None = None
) -> NDArray[np.float64]:
    """Convert counts that need not be whole numbers to surface temperature."""
    gain, offset = _stored_line(parameters) if emissivity is None else count_line(parameters, emissivity)
    return temperature_of_signal((np.asarray(counts, np.float64) - offset) / gain, parameters)


def temperature_of_signal(signal: ArrayLike, parameters: CameraParameters) -> NDArray[np.float64]:
    """Return the temperature of a black body with a given signal: the inverse of `black_body_signal`."""
    p = parameters
    above_zero = np.asarray(signal, np.float64) + p.planck_o
    with np.errstate(invalid="ignore", divide="ignore"):
        argument = p.planck_r1 / (p.planck_r2 * above_zero) + p.planck_f
        temperature = p.planck_b / np.log(argument) - ZERO_CELSIUS_K
    return np.where((above_zero > 0) & (argument > 1), temperature, np.nan)


def counts_from_temperature(
    temperature: ArrayLike, parameters: CameraParameters, *, emissivity: ArrayLike | None = None
) -> NDArray[np.float64]:
    """Return the counts that a surface of a given temperature produces: the inverse of `temperature_from_counts`."""
    gain, offset = count_line(parameters, emissivity)
    return gain * black_body_signal(np.asarray(temperature, np.float64) + ZERO_CELSIUS_K, parameters) + offset


def black_body_signal(temperature_K: ArrayLike, parameters: CameraParameters) -> NDArray[np.float64]:
    """Return the signal of a black body directly in front of the lens."""
    p = parameters
    exponential = np.exp(p.planck_b / np.asarray(temperature_K, np.float64))
    return p.planck_r1 / (p.planck_r2 * (exponential - p.planck_f)) - p.planck_o


def signal_slope(temperature_K: ArrayLike, parameters: CameraParameters) -> NDArray[np.float64]:
    """Return the derivative of the signal of a black body by its temperature."""
    p, kelvin = parameters, np.asarray(temperature_K, np.float64)
    exponential = np.exp(p.planck_b / kelvin)
    return p.planck_r1 / p.planck_r2 * exponential * p.planck_b / (kelvin * (exponential - p.planck_f)) ** 2


def count_line(
    parameters: CameraParameters, emissivity: ArrayLike | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return gain and offset of the straight line counts = gain * S(T_object) + offset."""
    check_parameters(parameters)
    p = parameters
    e = np.asarray(p.emissivity if emissivity is None else emissivity, np.float64)
    if not np.all((e > 0) & (e <= 1)):
        raise RadiometryError(f"emissivity from {e.min():g} to {e.max():g}: expected fractions above 0 and up to 1")
    reflected, air, window = (
        black_body_signal(kelvin, p)
        for kelvin in (
            p.reflected_temperature_K,
            p.atmospheric_temperature_K,
            # Without a window its temperature has no meaning, and cameras store 0.
            p.window_temperature_K if p.window_transmission < 1 else p.atmospheric_temperature_K,
        )
    )
    return line_of_signals(e, transmission(p), p.window_transmission, reflected, air, window)


@lru_cache(maxsize=256)
def _stored_line(parameters: CameraParameters) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`count_line` with the emissivity of the parameters; cached because the frames of a recording share them."""
    return count_line(parameters)


def line_of_signals(
    emissivity: Array | float,
    tau: Array | float,
    tau_window: Array | float,
    reflected: Array,
    air: Array,
    window: Array,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return gain and offset of the measurement formula from fractions and signals."""
    offset = tau_window * (tau * (1 - emissivity) * reflected + (1 - tau) * air) + (1 - tau_window) * window
    return np.asarray(tau_window * tau * emissivity), np.asarray(offset)


def transmission(parameters: CameraParameters) -> float:
    """Return the transmission of the air between object and camera that the measurement formula uses."""
    p = parameters
    if p.stored_transmission > 0:
        return p.stored_transmission
    return path_transmission(p)


def path_transmission(parameters: CameraParameters) -> float:
    """Return the transmission of the air from distance, humidity and air temperature."""
    p = parameters
    return float(air_transmission(p.object_distance_m, p.relative_humidity, p.atmospheric_temperature_K, p))


def air_transmission(
    object_distance_m: Array | float,
    relative_humidity: Array | float,
    atmospheric_temperature_K: Array | float,
    parameters: CameraParameters,
) -> NDArray[np.float64]:
    """Return the transmission of the air for several distances and conditions; see `path_transmission`."""
    p = parameters
    celsius = atmospheric_temperature_K - ZERO_CELSIUS_K
    # Damaged constants may lead anywhere; `check_parameters` judges the transmission that they give.
    with np.errstate(over="ignore", invalid="ignore"):
        water = relative_humidity * np.exp(1.5587 + 0.06939 * celsius - 2.7816e-4 * celsius**2 + 6.8455e-7 * celsius**3)
        root_distance, root_water = np.sqrt(object_distance_m), np.sqrt(water)
        first = np.exp(-root_distance * (p.atmosphere_alpha1 + p.atmosphere_beta1 * root_water))
        second = np.exp(-root_distance * (p.atmosphere_alpha2 + p.atmosphere_beta2 * root_water))
        return np.asarray(p.atmosphere_x * first + (1 - p.atmosphere_x) * second)


def override(parameters: CameraParameters, **changes: float) -> CameraParameters:
    """Return camera parameters with some of them replaced."""
    names = [field.name for field in fields(CameraParameters)]
    for name in changes:
        if name not in names:
            raise RadiometryError(f"parameter {name!r} is unknown; use one of {', '.join(names)}")
    if {"object_distance_m", "relative_humidity", "atmospheric_temperature_K"} & changes.keys():
        changes.setdefault("stored_transmission", 0.0)
    return replace(parameters, **changes)


def check_parameters(parameters: CameraParameters) -> None:
    """Raise an error if the measurement formula is meaningless with these parameters."""
    if faults := _faults(parameters):
        raise RadiometryError("; ".join(faults) + "; override the wrong values of the file")


@lru_cache(maxsize=256)
def _faults(parameters: CameraParameters) -> tuple[str, ...]:
    """Return one message for each parameter outside its range."""
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
        # The second radiation constant over the wavelength: 50,000 K is 0.3 um, beyond every infrared band.
        "planck_b": (1e-9, 50_000, "kelvin above 0 and up to 50000 (the file is not calibrated)"),
        "planck_r2": (1e-9, np.inf, "a positive number (the file is not calibrated)"),
    }
    if parameters.window_transmission == 1:
        # Without a window its temperature has no meaning, and cameras store 0.
        del values["window_temperature_K"]
    faults = []
    for name, value in values.items():
        low, high, expected = ranges.get(name, (-np.inf, np.inf, "a finite number"))
        if not (np.isfinite(value) and low <= value <= high):
            faults.append(f"{name} = {value:g}: expected {expected}")
    if (
        not faults
        and parameters.stored_transmission == 0
        and not 1e-6 <= (tau := path_transmission(parameters)) <= _MOST_TRANSMISSION
    ):
        constants = ", ".join(f"{name} = {value:g}" for name, value in values.items() if name.startswith("atmosphere_"))
        faults.append(
            f"transmission of the air = {tau:g} over object_distance_m = {parameters.object_distance_m:g} ({constants}): "
            "expected a fraction above 0 and up to 1"
        )
    return tuple(faults)


# Replaces stored camera parameters by those of the campaign: constants and logged series.


@dataclass(frozen=True, eq=False)
class ParameterLog:
    """A camera parameter logged over time: increasing times, UTC, and finite values in the unit of the parameter, both (n,)."""

    times: NDArray[np.datetime64]
    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        times, values = np.asarray(self.times), np.asarray(self.values, np.float64)
        if times.shape != values.shape or times.ndim != 1 or times.size == 0:
            raise RadiometryError(f"log: expected as many times as values, got {times.shape} and {values.shape}")
        if not (np.diff(times) > np.timedelta64(0)).all() or not np.isfinite(values).all():
            raise RadiometryError("log of a parameter: expected rising times and finite values; sort it and drop gaps")

    def interpolate(self, time: np.datetime64) -> float:
        """Interpolate linearly to a time."""
        times = np.asarray(self.times).astype("datetime64[ms]")
        if np.isnat(time) or not times[0] <= time <= times[-1]:
            raise RadiometryError(f"frame at {time}: the log reaches from {times[0]} to {times[-1]} only; extend it")
        milliseconds = (times - times[0]).astype(np.int64)
        return float(np.interp((time - times[0]).astype("timedelta64[ms]").astype(np.int64), milliseconds, self.values))


@dataclass(frozen=True)
class Overrides:
    """Camera parameters of each frame: those of the file, replaced by constants and by logged values at the time of the frame.

    Attributes
    ----------
    constants : values by name of the parameter, in its unit
    logs : logs by name of the parameter; they take precedence over constants

    Examples
    --------
    >>> at_22_degC = Overrides(constants={"reflected_temperature_K": 295.15})
    """

    constants: Mapping[str, float] = field(default_factory=dict)
    logs: Mapping[str, ParameterLog] = field(default_factory=dict)

    def __call__(self, frame: FrameHeader) -> CameraParameters:
        """Return the parameters to calibrate a frame with."""
        logged = {name: log.interpolate(frame.time) for name, log in self.logs.items()}
        changes = {**self.constants, **logged}
        return override(frame.parameters, **changes) if changes else frame.parameters
