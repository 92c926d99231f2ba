"""Uncertainty budget of a rise from one temperature to another, cell by cell: what the tabulated one of the fields is held against."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from thermography.io.frame import CameraParameters
from thermography.radiometry.uncertainty import (
    InputUncertainty,
    TemperatureBudget,
    reading_sensitivity,
    reflected_sensitivity,
    temperature_uncertainty,
)


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
    """Return the standard uncertainty of the rise of a surface from one temperature to another, with its budget."""
    later = temperature_uncertainty(temperature, parameters, inputs, frames=frames)
    earlier = temperature_uncertainty(reference, reference_parameters or parameters, inputs, frames=reference_frames)
    common = {name: later.common[name] - earlier.common[name] for name in later.common}
    inputs = inputs or InputUncertainty()
    if inputs.camera_drift_K > 0:
        common["camera_drift_K"] = inputs.camera_drift_K * reading_sensitivity(temperature, parameters)[1]
    if inputs.reflected_change_K > 0:
        # A rise from a temperature to itself is that of the reference cycle.
        later_K = np.where(np.equal(temperature, reference), 0.0, inputs.reflected_change_K)
        common["reflected_change_K"] = later_K * reflected_sensitivity(temperature, parameters)
    per_frame = {name: np.hypot(later.per_frame[name], earlier.per_frame[name]) for name in later.per_frame}
    return TemperatureBudget(common, per_frame)
