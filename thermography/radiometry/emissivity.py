"""Estimates the emissivity of a region from two states of known temperature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import (
    ZERO_CELSIUS_K,
    RadiometryError,
    black_body_signal,
    check_parameters,
    signal_slope,
    temperature_of_signal,
    transmission,
)

#: Below this emissivity the reflected radiation exceeds that of the surface.
_MIN_EMISSIVITY = 0.5
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
    """Emissivity of a region with its standard uncertainty, and the reflected apparent temperature, degC, that agrees with the first state.

    "too_reflective": the emissivity may be below 0.5. "undetermined": its standard uncertainty exceeds 0.1, or the states contradict every
    emissivity from 0 to 1.
    """

    emissivity: float
    emissivity_u: float
    reflected_temperature_degC: float
    quality: Literal["usable", "too_reflective", "undetermined"]


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
    reflected = _reflected(first, emissivity, float(signals[0]), parameters)
    return EmissivityEstimate(float(emissivity), u, reflected, _quality(float(emissivity), u))


def _quality(emissivity: float, u: float) -> Literal["usable", "too_reflective", "undetermined"]:
    """Classify an estimate by its interval of plus and minus two standard uncertainties."""
    if u > _MAX_U or emissivity - 2 * u > 1 or emissivity + 2 * u <= 0:
        return "undetermined"
    return "too_reflective" if emissivity - 2 * u < _MIN_EMISSIVITY else "usable"


def _reflected(state: KnownState, emissivity: float, signal: float, parameters: CameraParameters) -> float:
    """Return the reflected apparent temperature (degC) that agrees with a state; NaN where the surface hardly reflects."""
    if not 0 < emissivity < 0.99:
        return float("nan")
    p, tau = parameters, transmission(parameters)
    scene = state.counts
    if p.window_transmission < 1:
        scene -= float((1 - p.window_transmission) * black_body_signal(p.window_temperature_K, p))
    scene = scene / p.window_transmission - (1 - tau) * float(black_body_signal(p.atmospheric_temperature_K, p))
    return float(temperature_of_signal((scene / tau - emissivity * signal) / (1 - emissivity), p))
