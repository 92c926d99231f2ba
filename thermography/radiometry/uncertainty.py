"""Evaluates the standard uncertainty of temperatures and of temperature rises, with its budget.

The common part (emissivity, reflections, air, humidity, distance, window, accuracy of the camera) is the same error in every frame of a
campaign and largely cancels in a difference; the per-frame part (noise, quantisation) does not cancel, but averages out. Uncertainties
propagate to first order through the measurement formula (JCGM 100:2008, 5.1 and 5.2); `monte_carlo_ratio` tells by how much a
propagation of distributions (JCGM 101:2008) differs. See ``docs/method/radiometry.md``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from thermography.common import Array, ThermographyError
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import (
    ZERO_CELSIUS_K,
    RadiometryError,
    air_transmission,
    black_body_signal,
    check_parameters,
    count_line,
    line_of_signals,
    override,
    path_transmission,
    signal_slope,
    temperature_of_signal,
    transmission,
)

#: Parameters of the measurement formula that may be uncertain, with their range.
_RANGES = {
    "emissivity": (1e-3, 1.0),
    "reflected_temperature_K": (100.0, 3000.0),
    "atmospheric_temperature_K": (100.0, 3000.0),
    "relative_humidity": (0.0, 1.0),
    "object_distance_m": (0.0, np.inf),
    "window_transmission": (1e-3, 1.0),
    "window_temperature_K": (100.0, 3000.0),
}
#: Least emissivity of non-metallic paints from 8 to 14 um, and standard uncertainty of one that is known: the entries of a named paint,
#: such as dull black 0.96 to 0.98 or three colours 0.92 to 0.94, lie within 0.03 (FLIR Systems, user's manual T559880, emissivity tables;
#: rectangular).
LEAST_OF_PAINTS, KNOWN_PAINT_U = 0.87, 0.02
#: Largest relative difference between first order and propagation of distributions that is left as it is: an uncertainty is stated
#: to two significant digits, so that half a unit of the last one is 5 % of the smallest such number (JCGM 101:2008, 7.9.2 and 8).
FIRST_ORDER_TOLERANCE = 0.05
#: Draws of the propagation of distributions: the half-width of a 95 % interval is then known to 1 %.
_DRAWS = 10_000
#: Coverage factor of 95 % under a normal distribution.
_NORMAL_95 = 1.959964


@dataclass(frozen=True)
class InputUncertainty:
    """Standard uncertainties (coverage factor 1) of the inputs of the measurement formula.

    The defaults apply to a painted surface in a workshop (non-metallic paints and lacquers from 8 to 14 um: 0.87 to 0.98, FLIR Systems,
    user's manual T559880, emissivity tables; rectangular) and to the data sheet of a bolometer camera: accuracy of +-2 K or +-2 % of the
    reading, both as rectangular distributions (JCGM 100:2008, 4.3.7), NETD of 50 mK at 30 degC.

    Attributes
    ----------
    emissivity, relative_humidity, window_transmission : standard uncertainties of these parameters, without unit
    reflected_temperature_K, atmospheric_temperature_K, window_temperature_K : float
        Standard uncertainties of the reflected apparent temperature, the air and the window, K.
    object_distance_m : standard uncertainty of the distance, m
    camera_offset_K : standard uncertainty of the camera's reading of a black body that is the same at all temperatures, K
    camera_scale : float
        Standard uncertainty of that reading as a share of the reading in degC ("2 % of reading" of a data sheet), without unit.
    camera_drift_K
        Standard uncertainty of the change of the camera's zero between two cycles, K; it enters rises only, because the accuracy of
        the camera holds at all times. No data sheet states it: 0 by default.
    reflected_change_K
        Standard uncertainty of the change of the reflected apparent temperature between two cycles, K; it enters rises only. By default
        +-1 K as a rectangular distribution, an assumption on a room in which nothing warm is moved.
    netd_K : noise equivalent temperature difference: standard deviation of one pixel in one frame on a black body, K
    netd_temperature_degC : temperature of this black body, degC

    Raises
    ------
    ThermographyError
        Where an uncertainty is negative or not finite.
    """

    emissivity: float = 0.03
    reflected_temperature_K: float = 1.0
    atmospheric_temperature_K: float = 1.0
    relative_humidity: float = 0.05
    object_distance_m: float = 0.05
    window_transmission: float = 0.0
    window_temperature_K: float = 0.0
    camera_offset_K: float = 2 / 3**0.5
    camera_scale: float = 0.02 / 3**0.5
    camera_drift_K: float = 0.0
    reflected_change_K: float = 1 / 3**0.5
    netd_K: float = 0.05
    netd_temperature_degC: float = 30.0

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name != "netd_temperature_degC" and not (np.isfinite(value) and value >= 0):
                raise ThermographyError(f"uncertainty of {each.name} = {value}: expected 0 or more")


@dataclass(frozen=True, eq=False)
class TemperatureBudget:
    """Uncertainty budget of temperatures or temperature rises, in arrays of their shape, K: of each input that all frames share its
    sensitivity coefficient, with its sign, times standard uncertainty; and noise and quantisation.
    """

    common: dict[str, Array]
    per_frame: dict[str, Array]

    @property
    def common_u(self) -> Array:
        """Standard uncertainty from the inputs that all frames share, K."""
        return root_sum_square(self.common)

    @property
    def per_frame_u(self) -> Array:
        """Standard uncertainty from noise and quantisation, which are independent between frames, K."""
        return root_sum_square(self.per_frame)

    @property
    def total_u(self) -> Array:
        """Combined standard uncertainty, K."""
        return np.hypot(self.common_u, self.per_frame_u)


def temperature_uncertainty(
    temperature: ArrayLike,
    parameters: CameraParameters,
    inputs: InputUncertainty | None = None,
    *,
    frames: ArrayLike = 1,
) -> TemperatureBudget:
    """Return the standard uncertainty of surface temperatures with its budget.

    Parameters
    ----------
    temperature : array, any shape
        Surface temperature from `thermography.radiometry.planck.calibrate`, degC.
    parameters : CameraParameters
        Parameters with which it was calibrated.
    inputs : InputUncertainty, optional
        Standard uncertainties of the inputs; by default those of a painted surface in a workshop and a common bolometer camera.
    frames : int or array of the same shape
        Number of frames that were averaged, from 1; 0 where there is no temperature (NaN).

    Returns
    -------
    TemperatureBudget
        Contributions, common, per-frame and combined standard uncertainty, K, of the shape of the temperature.

    Raises
    ------
    RadiometryError
        Where a parameter makes the measurement formula meaningless, or a temperature is the average of fewer than one frame.

    Notes
    -----
    Law of propagation of uncertainty for uncorrelated inputs, JCGM 100:2008, eq. (10). With counts = g S(T) + o, a change of gain g and
    offset o changes the temperature by -(S dg + do) / (g dS/dT). An error of the camera is one of its reading of a black body; it is
    larger on a surface by dS/dT at that reading over g dS/dT at the surface, about 1 / emissivity. The noise of a pixel is constant in
    counts; the quantisation to whole counts has a standard uncertainty of 1 / sqrt(12) (JCGM 100:2008, F.2.2.1).

    Examples
    --------
    >>> sc660 = CameraParameters(
    ...     0.95, 1.0, 293.15, 293.15, 293.15, 1.0, 0.0, 0.5, 21106.77, 1501.0, 1.0, -7340.0, 0.012545258,
    ...     0.006569, 0.01262, -0.002276, -0.00667, 1.9,
    ... )
    >>> budget = temperature_uncertainty([25.0, 40.0], sc660, frames=10)
    >>> budget.total_u.round(3), budget.per_frame_u.round(3), budget.common["emissivity"].round(3)
    (array([1.267, 1.422]), array([0.018, 0.015]), array([-0.154, -0.574]))
    """
    inputs = inputs or InputUncertainty()
    kelvin = np.asarray(temperature, np.float64) + ZERO_CELSIUS_K
    too_few = np.isfinite(kelvin) & ~(np.asarray(frames) >= 1)
    if too_few.any():
        raise RadiometryError(
            f"frames={np.broadcast_to(frames, too_few.shape)[too_few][0]} for a temperature; give the number of frames averaged, 1 or more"
        )
    common = common_contributions(temperature, parameters, inputs)
    gain, _ = count_line(parameters)
    # The noise of a pixel in counts does not depend on the scene.
    noise = inputs.netd_K * signal_slope(inputs.netd_temperature_degC + ZERO_CELSIUS_K, parameters)
    per_count = 1 / (signal_slope(kelvin, parameters) * gain * np.sqrt(frames))
    return TemperatureBudget(common, {"noise": per_count * noise, "quantisation": per_count / 12**0.5})


def common_contributions(
    temperature: ArrayLike, parameters: CameraParameters, inputs: InputUncertainty
) -> dict[str, Array]:
    """Return what each input that all frames share contributes to the uncertainty of temperatures."""
    kelvin = np.asarray(temperature, np.float64) + ZERO_CELSIUS_K
    signal = black_body_signal(kelvin, parameters)
    slope = signal_slope(kelvin, parameters)
    gain, _ = count_line(parameters)
    common = {}
    for name in _RANGES:
        u = getattr(inputs, name)
        if u > 0:
            # Derivatives of gain and offset of `count_line` by one parameter.
            value = getattr(parameters, name)
            lowest, highest = _RANGES[name]
            low, high = max(value - u, lowest), min(value + u, highest)
            above, below = (count_line(override(parameters, **{name: changed})) for changed in (high, low))
            gain_slope, offset_slope = (above[0] - below[0]) / (high - low), (above[1] - below[1]) / (high - low)
            common[name] = -(offset_slope + signal * gain_slope) / (gain * slope) * u
    if inputs.camera_offset_K > 0 or inputs.camera_scale > 0:
        reading, per_reading = reading_sensitivity(temperature, parameters)
        common["camera_offset_K"] = per_reading * inputs.camera_offset_K
        common["camera_scale"] = per_reading * reading * inputs.camera_scale
    return common


def reading_sensitivity(temperature: ArrayLike, parameters: CameraParameters) -> tuple[Array, Array]:
    """Return what the camera reads of a black body of the same signal, and the sensitivity of a surface temperature to that reading."""
    kelvin = np.asarray(temperature, np.float64) + ZERO_CELSIUS_K
    gain, offset = count_line(parameters)
    reading = temperature_of_signal(gain * black_body_signal(kelvin, parameters) + offset, parameters)
    return reading, signal_slope(reading + ZERO_CELSIUS_K, parameters) / (gain * signal_slope(kelvin, parameters))


def reflected_sensitivity(temperature: ArrayLike, parameters: CameraParameters) -> Array:
    """Return the sensitivity of a surface temperature to the reflected apparent temperature, about -(1 - emissivity) / emissivity."""
    none = {each.name: 0.0 for each in fields(InputUncertainty)}
    one_K = InputUncertainty(**{**none, "reflected_temperature_K": 1.0})
    return common_contributions(temperature, parameters, one_K)["reflected_temperature_K"]


def rise_scale_contributions(
    temperature: ArrayLike, parameters: CameraParameters, inputs: InputUncertainty
) -> dict[str, Array]:
    """Return what each common input contributes to the relative uncertainty of rises about a temperature."""
    middle = np.asarray(temperature, np.float64)
    parts = common_contributions(np.stack([middle - 0.5, middle + 0.5]), parameters, inputs)
    return {name: part[1] - part[0] for name, part in parts.items()}


def monte_carlo_ratio(
    temperature: ArrayLike,
    rise: tuple[float, float],
    parameters: CameraParameters,
    inputs: InputUncertainty,
    *,
    seed: int = 1,
) -> tuple[Array, float]:
    """Return how the common uncertainty by propagation of distributions compares with that of first order."""
    p = parameters
    if p.emissivity <= 2 * inputs.emissivity:
        raise RadiometryError(
            f"emissivity {p.emissivity:g} with a standard uncertainty of {inputs.emissivity:g}: a surface within two standard "
            "uncertainties emits nothing, so that its temperature has no uncertainty that could be stated; state the emissivity "
            "better (from two states of known temperature), or paint the surface"
        )
    kelvin = np.append(np.asarray(temperature, np.float64), rise) + ZERO_CELSIUS_K
    gain, offset = count_line(p)
    counts = gain * black_body_signal(kelvin, p) + offset
    rng = np.random.default_rng(seed)
    offset_error, scale_error = rng.standard_normal((2, _DRAWS, 1))
    reading = temperature_of_signal(counts, p)
    read = reading + inputs.camera_offset_K * offset_error + inputs.camera_scale * reading * scale_error
    drawn_gain, drawn_offset = _draw_lines(p, inputs, rng)
    signal = (black_body_signal(read + ZERO_CELSIUS_K, p) - drawn_offset[:, None]) / drawn_gain[:, None]
    drawn = temperature_of_signal(signal, p)
    common = common_contributions(kelvin - ZERO_CELSIUS_K, p, inputs)
    error = drawn - (kelvin - ZERO_CELSIUS_K)
    of_temperature = _half_width(error[:, :-2]) / root_sum_square({name: part[:-2] for name, part in common.items()})
    of_rise = _half_width(error[:, -1] - error[:, -2]) / root_sum_square(
        {name: part[-1] - part[-2] for name, part in common.items()}
    )
    return of_temperature, float(of_rise)


def _half_width(error: Array) -> Array:
    """Half the width of the interval about 0 that holds 95 % of every column, in standard uncertainties of a normal distribution."""
    # A draw that no temperature explains lies beyond all others.
    return np.asarray(np.quantile(np.where(np.isfinite(error), np.abs(error), np.inf), 0.95, axis=0) / _NORMAL_95)


def _draw_lines(
    parameters: CameraParameters, inputs: InputUncertainty, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Gain and offset of `count_line` for draws of its parameters, (draws,)."""
    from scipy import special  # first order does without it

    p = parameters

    def draw(name: str) -> Array:
        value, u, (low, high) = getattr(p, name), getattr(inputs, name), _RANGES[name]
        if u == 0:
            return np.full(_DRAWS, value)
        below, above = special.ndtr([(low - value) / u, (high - value) / u])
        return np.asarray(value + u * special.ndtri(rng.uniform(below, above, _DRAWS)))

    distance, humidity, air = (
        draw(name) for name in ("object_distance_m", "relative_humidity", "atmospheric_temperature_K")
    )
    # A transmission that the file stores is changed by as much as that of the formula.
    tau = transmission(p) + air_transmission(distance, humidity, air, p) - path_transmission(p)
    window_K = draw("window_temperature_K") if p.window_transmission < 1 else air
    signals = [black_body_signal(kelvin, p) for kelvin in (draw("reflected_temperature_K"), air, window_K)]
    return line_of_signals(draw("emissivity"), tau, draw("window_transmission"), *signals)


def root_sum_square(parts: dict[str, Array]) -> Array:
    """Return the root of the sum of the squares of contributions, 0 without any."""
    return np.sqrt(np.sum([part**2 for part in parts.values()], axis=0))


# Emissivity of a region from two states of known temperature.

#: Above this standard uncertainty an estimate does not distinguish surfaces.
_MAX_U = 0.1


@dataclass(frozen=True)
class KnownState:
    """Mean counts of a region at a known temperature, degC, each with its standard uncertainty (counts, K)."""

    counts: float
    counts_u: float
    temperature_degC: float
    temperature_u_K: float


@dataclass(frozen=True)
class EmissivityEstimate:
    """Emissivity of a region with its standard uncertainty."""

    emissivity: float
    emissivity_u: float

    @property
    def is_determined(self) -> bool:
        """Whether its standard uncertainty is at most 0.1, and the states do not contradict every emissivity from 0 to 1."""
        low, high = self.emissivity - 2 * self.emissivity_u, self.emissivity + 2 * self.emissivity_u
        return self.emissivity_u <= _MAX_U and low <= 1 and high > 0


def estimate_emissivity(first: KnownState, second: KnownState, parameters: CameraParameters) -> EmissivityEstimate:
    """Estimate the emissivity of a region from two states of known temperature."""
    check_parameters(parameters)
    path = parameters.window_transmission * transmission(parameters)
    kelvin = np.array([first.temperature_degC, second.temperature_degC]) + ZERO_CELSIUS_K
    signals = black_body_signal(kelvin, parameters)
    contrast = signals[1] - signals[0]
    if contrast == 0:
        raise RadiometryError(f"both states have {first.temperature_degC:g} degC: heat it between them, 10 K or more")
    emissivity = (second.counts - first.counts) / (path * contrast)
    slopes = signal_slope(kelvin, parameters)
    relative_to_temperature = emissivity * slopes / contrast
    u = float(
        np.hypot(
            np.hypot(first.counts_u, second.counts_u) / (path * abs(contrast)),
            np.linalg.norm(relative_to_temperature * [first.temperature_u_K, second.temperature_u_K]),
        )
    )
    return EmissivityEstimate(float(emissivity), u)
