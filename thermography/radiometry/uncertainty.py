"""Evaluates the standard uncertainty of temperatures and of temperature rises, with its budget.

The common part (emissivity, reflections, air, humidity, distance, window, accuracy of the camera) is the same error in every frame of a
campaign and largely cancels in a difference; the per-frame part (noise, quantisation) does not cancel, but averages out. Uncertainties
propagate to first order through the measurement formula (JCGM 100:2008, 5.1 and 5.2); the tests compare them with Monte Carlo
simulations. See ``docs/method/radiometry.md``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import (
    ZERO_CELSIUS_K,
    RadiometryError,
    black_body_signal,
    count_line,
    override,
    signal_slope,
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


@dataclass(frozen=True)
class InputUncertainty:
    """Standard uncertainties (coverage factor 1) of the inputs of the measurement formula.

    The defaults apply to a painted surface in a workshop and to the data sheet of a bolometer camera: accuracy of +-2 K as a rectangular
    distribution (JCGM 100:2008, 4.3.7), NETD of 50 mK at 30 degC.

    Attributes
    ----------
    emissivity, relative_humidity, window_transmission : float
        Standard uncertainties of these parameters, without unit.
    reflected_temperature_K, atmospheric_temperature_K, window_temperature_K : float
        Standard uncertainties of the reflected apparent temperature, the air and the window, K.
    object_distance_m : float
        Standard uncertainty of the distance, m.
    camera_offset_K : float
        Standard uncertainty of the camera that is the same at all temperatures, K.
    camera_scale : float
        Relative standard uncertainty of the signal of the camera above zero (for an accuracy of "2 % of reading"), without unit.
    netd_K : float
        Noise equivalent temperature difference: standard deviation of one pixel in one frame on a black body, K.
    netd_temperature_degC : float
        Temperature of this black body, degC.

    Raises
    ------
    ThermographyError
        Where an uncertainty is negative or not finite.
    """

    emissivity: float = 0.01
    reflected_temperature_K: float = 1.0
    atmospheric_temperature_K: float = 1.0
    relative_humidity: float = 0.05
    object_distance_m: float = 0.05
    window_transmission: float = 0.0
    window_temperature_K: float = 0.0
    camera_offset_K: float = 2 / 3**0.5
    camera_scale: float = 0.0
    netd_K: float = 0.05
    netd_temperature_degC: float = 30.0

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name != "netd_temperature_degC" and not (np.isfinite(value) and value >= 0):
                raise ThermographyError(f"uncertainty of {each.name} = {value}: expected 0 or more")


@dataclass(frozen=True, eq=False)
class TemperatureBudget:
    """Uncertainty budget of temperatures or temperature rises; all arrays have their shape.

    Attributes
    ----------
    common : dict of str to ndarray
        Contribution of each input that all frames share, K: sensitivity coefficient, with its sign, times standard uncertainty.
    per_frame : dict of str to ndarray
        Contributions of noise and quantisation, K.
    """

    common: dict[str, Array]
    per_frame: dict[str, Array]

    @property
    def common_u(self) -> Array:
        """Standard uncertainty from the inputs that all frames share, K."""
        return _root_sum_square(self.common)

    @property
    def per_frame_u(self) -> Array:
        """Standard uncertainty from noise and quantisation, which are independent between frames, K."""
        return _root_sum_square(self.per_frame)

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
    offset o changes the temperature by -(S dg + do) / (g dS/dT). The noise of a pixel is constant in counts; the quantisation to whole
    counts has a standard uncertainty of 1 / sqrt(12) (JCGM 100:2008, F.2.2.1).

    Examples
    --------
    >>> sc660 = CameraParameters(
    ...     0.95, 1.0, 293.15, 293.15, 293.15, 1.0, 0.0, 0.5, 21106.77, 1501.0, 1.0, -7340.0, 0.012545258,
    ...     0.006569, 0.01262, -0.002276, -0.00667, 1.9,
    ... )
    >>> budget = temperature_uncertainty([25.0, 40.0], sc660, frames=10)
    >>> budget.total_u.round(3), budget.per_frame_u.round(3), budget.common["emissivity"].round(3)
    (array([1.157, 1.171]), array([0.018, 0.015]), array([-0.051, -0.191]))
    """
    inputs = inputs or InputUncertainty()
    kelvin = np.asarray(temperature, np.float64) + ZERO_CELSIUS_K
    too_few = np.isfinite(kelvin) & ~(np.asarray(frames) >= 1)
    if too_few.any():
        raise RadiometryError(
            f"frames={np.broadcast_to(frames, too_few.shape)[too_few][0]} for a temperature; give the number of frames that "
            "were averaged, 1 or more"
        )
    signal = black_body_signal(kelvin, parameters)
    kelvin_per_count = 1 / signal_slope(kelvin, parameters)
    gain, _ = count_line(parameters)
    common = {}
    for name in _RANGES:
        u = getattr(inputs, name)
        if u > 0:
            gain_slope, offset_slope = _line_slopes(parameters, name, u)
            common[name] = -kelvin_per_count * (offset_slope + signal * gain_slope) / gain * u
    if inputs.camera_offset_K > 0:
        common["camera_offset"] = np.full(kelvin.shape, inputs.camera_offset_K)
    if inputs.camera_scale > 0:
        common["camera_scale"] = kelvin_per_count * (signal + parameters.planck_o) * inputs.camera_scale
    # The noise of a pixel in counts does not depend on the scene.
    noise = inputs.netd_K * signal_slope(inputs.netd_temperature_degC + ZERO_CELSIUS_K, parameters)
    per_count = kelvin_per_count / (gain * np.sqrt(frames))
    return TemperatureBudget(common, {"noise": per_count * noise, "quantisation": per_count / 12**0.5})


def temperature_rise_uncertainty(
    temperature: ArrayLike,
    reference: ArrayLike,
    parameters: CameraParameters,
    inputs: InputUncertainty | None = None,
    *,
    reference_parameters: CameraParameters | None = None,
    frames: ArrayLike = 1,
    reference_frames: ArrayLike = 1,
) -> TemperatureBudget:
    """Return the standard uncertainty of the rise of a surface from one temperature to another, with its budget.

    Parameters
    ----------
    temperature, reference : arrays that broadcast together
        Temperatures after and before the rise, degC.
    parameters : CameraParameters
        Parameters with which `temperature` was calibrated.
    inputs : InputUncertainty, optional
        Standard uncertainties of the inputs; defaults as in `temperature_uncertainty`.
    reference_parameters : CameraParameters, optional
        Parameters with which `reference` was calibrated; the same by default.
    frames, reference_frames : int or array
        Numbers of frames that were averaged.

    Returns
    -------
    TemperatureBudget
        Contributions, common, per-frame and combined standard uncertainty of the rise, K, of the broadcast shape.

    Raises
    ------
    RadiometryError
        Where a parameter makes the measurement formula meaningless.

    Notes
    -----
    The errors of the common inputs are the same in both temperatures (correlation 1), so their contributions are subtracted before they
    are squared (JCGM 100:2008, 5.2.2, note 1); noise and quantisation are independent.
    """
    later = temperature_uncertainty(temperature, parameters, inputs, frames=frames)
    earlier = temperature_uncertainty(reference, reference_parameters or parameters, inputs, frames=reference_frames)
    common = {name: later.common[name] - earlier.common[name] for name in later.common}
    per_frame = {name: np.hypot(later.per_frame[name], earlier.per_frame[name]) for name in later.per_frame}
    return TemperatureBudget(common, per_frame)


def _root_sum_square(parts: dict[str, Array]) -> Array:
    return np.sqrt(np.sum([part**2 for part in parts.values()], axis=0))


def _line_slopes(parameters: CameraParameters, name: str, u: float) -> tuple[Array, Array]:
    """Return the derivatives of gain and offset of `count_line` by one parameter.

    They are secants over plus and minus one standard uncertainty inside the range of the parameter (JCGM 100:2008, 5.1.3, note 2), which
    stay finite at a distance of 0 m, where the transmission depends on the square root of the distance.
    """
    value = getattr(parameters, name)
    lowest, highest = _RANGES[name]
    low, high = max(value - u, lowest), min(value + u, highest)
    above, below = (count_line(override(parameters, **{name: changed})) for changed in (high, low))
    return (above[0] - below[0]) / (high - low), (above[1] - below[1]) / (high - low)
