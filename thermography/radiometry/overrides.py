"""Replaces stored camera parameters by those of the campaign: constants and logged series."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thermography.io.frame import CameraParameters, FrameHeader
from thermography.radiometry.planck import RadiometryError, override


@dataclass(frozen=True, eq=False)
class ParameterLog:
    """A camera parameter that was logged over time.

    Attributes
    ----------
    times : (n,) ndarray of datetime64
        UTC, increasing.
    values : (n,) ndarray of float64
        Values in the unit of the parameter, finite.

    Raises
    ------
    RadiometryError
        Where times and values differ in number, times do not increase, or a value is not finite.
    """

    times: NDArray[np.datetime64]
    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        times, values = np.asarray(self.times), np.asarray(self.values, np.float64)
        if times.shape != values.shape or times.ndim != 1 or times.size == 0:
            raise RadiometryError(
                f"log of a parameter: expected as many times as values, got {times.shape} and {values.shape}"
            )
        if not (np.diff(times) > np.timedelta64(0)).all() or not np.isfinite(values).all():
            raise RadiometryError(
                "log of a parameter: expected increasing times and finite values; sort the log and remove gaps"
            )

    def interpolate(self, time: np.datetime64) -> float:
        """Interpolate linearly to a time.

        Parameters
        ----------
        time : datetime64
            UTC.

        Returns
        -------
        float
            Value in the unit of the parameter.

        Raises
        ------
        RadiometryError
            Where the time is NaT or outside the log; ambient conditions are not extrapolated.
        """
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
    constants : mapping of str to float
        Values by name of the parameter, in its unit.
    logs : mapping of str to ParameterLog
        Logs by name of the parameter; they take precedence over constants.

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
