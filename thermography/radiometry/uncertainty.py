"""Standard uncertainty of every temperature, with its budget, for levels and for rises.

Two parts behave differently. The common part (emissivity, reflections, air, humidity, distance, window, camera accuracy) is the
same error in every frame of a campaign and largely cancels in a difference; the per-frame part (noise, quantisation) does not, and
averages out instead. First-order propagation through the measurement formula, held to Monte Carlo in the tests.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermography.errors import ThermographyError
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import ZERO_CELSIUS_K, black_body_signal, count_line, override, signal_slope

_Array = NDArray[np.float64]
#: Parameters of the formula that may be uncertain, with their range.
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
    """Standard uncertainties of what the formula uses (coverage factor 1).

    The defaults are a painted surface in a workshop and the data sheet of a bolometer camera: accuracy +-2 K taken as a rectangular
    distribution, NETD 50 mK at 30 degC.

    Attributes
    ----------
    camera_offset_K : float
        Accuracy of the camera that is the same at all temperatures.
    camera_scale : float
        Relative accuracy of the camera's signal above zero ("2 % of reading").
    netd_K : float
        Noise of one pixel in one frame on a black body at `netd_temperature_degC`.
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
class Budget:
    """Standard uncertainty of temperatures and where it comes from.

    Attributes
    ----------
    common : dict of str to ndarray
        Signed contribution of each common input, K: sensitivity times standard uncertainty.
    per_frame : dict of str to ndarray
        Contribution of noise and quantisation, K.
    """

    common: dict[str, _Array]
    per_frame: dict[str, _Array]

    @property
    def common_u(self) -> _Array:
        """Standard uncertainty of the part that all frames share, K."""
        return _root_sum_square(self.common)

    @property
    def per_frame_u(self) -> _Array:
        """Standard uncertainty of the part that is new in each frame, K."""
        return _root_sum_square(self.per_frame)

    @property
    def total_u(self) -> _Array:
        """Combined standard uncertainty, K."""
        return np.hypot(self.common_u, self.per_frame_u)


def temperature_uncertainty(
    temperature: ArrayLike,
    parameters: CameraParameters,
    inputs: InputUncertainty | None = None,
    *,
    frames: ArrayLike = 1,
) -> Budget:
    """Return the uncertainty of surface temperatures.

    Parameters
    ----------
    temperature : array, any shape
        degC, as `calibrate` gives it.
    parameters : CameraParameters
        Those with which it was calibrated.
    inputs : InputUncertainty, optional
    frames : int, or array of the same shape
        Number of frames that were averaged.

    Returns
    -------
    Budget
        Arrays of the shape of the temperature, K.
    """
    inputs = inputs or InputUncertainty()
    kelvin = np.asarray(temperature, np.float64) + ZERO_CELSIUS_K
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
    # The noise of a pixel in counts does not depend on what it looks at.
    noise = inputs.netd_K * signal_slope(inputs.netd_temperature_degC + ZERO_CELSIUS_K, parameters)
    per_count = kelvin_per_count / (gain * np.sqrt(frames))
    return Budget(common, {"noise": per_count * noise, "quantisation": per_count / 12**0.5})


def temperature_rise_uncertainty(
    temperature: ArrayLike,
    reference: ArrayLike,
    parameters: CameraParameters,
    inputs: InputUncertainty | None = None,
    *,
    reference_parameters: CameraParameters | None = None,
    frames: ArrayLike = 1,
    reference_frames: ArrayLike = 1,
) -> Budget:
    """Return the uncertainty of the rise from `reference` to `temperature` of the same surface.

    The common contributions are subtracted before they are squared, because their errors are the same in both.

    Parameters
    ----------
    temperature, reference : arrays that broadcast together
        degC.
    parameters : CameraParameters
        Of `temperature`; also of the reference unless `reference_parameters` are given.
    inputs : InputUncertainty, optional
    frames, reference_frames : int or array
        Numbers of frames that were averaged.

    Returns
    -------
    Budget
        K.
    """
    later = temperature_uncertainty(temperature, parameters, inputs, frames=frames)
    earlier = temperature_uncertainty(reference, reference_parameters or parameters, inputs, frames=reference_frames)
    common = {name: later.common[name] - earlier.common[name] for name in later.common}
    per_frame = {name: np.hypot(later.per_frame[name], earlier.per_frame[name]) for name in later.per_frame}
    return Budget(common, per_frame)


def _root_sum_square(parts: dict[str, _Array]) -> _Array:
    return np.sqrt(np.sum([part**2 for part in parts.values()], axis=0))


def _line_slopes(parameters: CameraParameters, name: str, u: float) -> tuple[_Array, _Array]:
    """Return how gain and offset of the count line change with one parameter.

    The secant over plus and minus one standard uncertainty, inside the parameter's range, also serves where the formula bends: the
    transmission goes with the square root of the distance.
    """
    value = getattr(parameters, name)
    lowest, highest = _RANGES[name]
    low, high = max(value - u, lowest), min(value + u, highest)
    above, below = (count_line(override(parameters, **{name: changed})) for changed in (high, low))
    return (above[0] - below[0]) / (high - low), (above[1] - below[1]) / (high - low)
