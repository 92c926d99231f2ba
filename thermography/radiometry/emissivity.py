"""Emissivity of a region from two states of known temperature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import (
    ZERO_CELSIUS_K,
    RadiometryError,
    black_body_signal,
    check,
    signal_slope,
    temperature_of_signal,
    transmission,
)

#: Below this the camera sees more of the surroundings than of the surface.
_MORE_REFLECTION_THAN_SURFACE = 0.5
#: A standard uncertainty above this says nothing about a surface.
_LARGEST_USEFUL_U = 0.1


@dataclass(frozen=True)
class KnownState:
    """Mean counts of a region while its temperature was known, each with its standard uncertainty."""

    counts: float
    counts_u: float
    temperature_degC: float
    temperature_u_K: float


@dataclass(frozen=True)
class EmissivityEstimate:
    """Emissivity of a region with its standard uncertainty.

    Attributes
    ----------
    emissivity, emissivity_u : float
    reflected_temperature_degC : float
        What the region reflects by the same two states; NaN where it reflects too little to tell.
    quality : {"usable", "too_reflective", "undetermined"}
        "too_reflective": the camera sees more of the surroundings than of the surface. "undetermined": the two states are too
        alike, or they disagree with any emissivity.
    """

    emissivity: float
    emissivity_u: float
    reflected_temperature_degC: float
    quality: Literal["usable", "too_reflective", "undetermined"]


def estimate_emissivity(first: KnownState, second: KnownState, parameters: CameraParameters) -> EmissivityEstimate:
    """Estimate the emissivity of a region from two states.

    What the surface reflects is the same in both states and drops out of the difference of the counts,
    ``N2 - N1 = tau_window tau e (S(T2) - S(T1))``, so it need not be known; it must only not change between them.

    Parameters
    ----------
    first, second : KnownState
        From a contact sensor, or from a region of known emissivity at the same temperature.
    parameters : CameraParameters
        Everything but the emissivity and the reflected temperature is used.

    Returns
    -------
    EmissivityEstimate

    Raises
    ------
    RadiometryError
        Where both states have the same temperature.
    """
    check(parameters)
    path = parameters.window_transmission * transmission(parameters)
    kelvin = np.array([first.temperature_degC, second.temperature_degC]) + ZERO_CELSIUS_K
    signals = black_body_signal(kelvin, parameters)
    contrast = signals[1] - signals[0]
    if contrast == 0:
        raise RadiometryError(
            f"both states have {first.temperature_degC:g} degC: heat the surface between them, 10 K or more"
        )
    emissivity = (second.counts - first.counts) / (path * contrast)
    slopes = signal_slope(kelvin, parameters)
    relative_to_temperature = emissivity * slopes / contrast
    u = float(
        np.hypot(
            np.hypot(first.counts_u, second.counts_u) / (path * abs(contrast)),
            np.linalg.norm(relative_to_temperature * [first.temperature_u_K, second.temperature_u_K]),
        )
    )
    reflected = _reflected(first, emissivity, float(signals[0]), parameters)
    return EmissivityEstimate(float(emissivity), u, reflected, _quality(float(emissivity), u))


def _quality(emissivity: float, u: float) -> Literal["usable", "too_reflective", "undetermined"]:
    """Class an estimate; two standard uncertainties decide."""
    if u > _LARGEST_USEFUL_U or emissivity - 2 * u > 1 or emissivity + 2 * u <= 0:
        return "undetermined"
    return "too_reflective" if emissivity - 2 * u < _MORE_REFLECTION_THAN_SURFACE else "usable"


def _reflected(state: KnownState, emissivity: float, signal: float, parameters: CameraParameters) -> float:
    """Return the reflected temperature (degC) that explains the first state."""
    if not 0 < emissivity < 0.99:
        return float("nan")
    p, tau = parameters, transmission(parameters)
    scene = state.counts
    if p.window_transmission < 1:
        scene -= float((1 - p.window_transmission) * black_body_signal(p.window_temperature_K, p))
    scene = scene / p.window_transmission - (1 - tau) * float(black_body_signal(p.atmospheric_temperature_K, p))
    return float(temperature_of_signal((scene / tau - emissivity * signal) / (1 - emissivity), p))
