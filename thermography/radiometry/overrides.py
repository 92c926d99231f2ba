"""Replaces stored camera parameters by those of the campaign: constants, logged series, and emissivities of regions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.measure import points_in_poly

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


@dataclass(frozen=True)
class EmissivityRegion:
    """A part of the table with an emissivity of its own.

    Attributes
    ----------
    name : str
        Name, for messages.
    polygon_mm : tuple of (x, y)
        Corners in plan coordinates, mm; at least three.
    emissivity : float
        Above 0 and up to 1.
    """

    name: str
    polygon_mm: tuple[tuple[float, float], ...]
    emissivity: float


def emissivity_map(
    x_mm: ArrayLike, y_mm: ArrayLike, regions: Sequence[EmissivityRegion], *, default: float
) -> NDArray[np.float64]:
    """Return the emissivity of points of the table plan.

    Parameters
    ----------
    x_mm, y_mm : arrays that broadcast together
        Plan coordinates, mm: those of the cells of a grid, or of each sensor pixel from the registration.
    regions : sequence of EmissivityRegion
        A later region covers an earlier one.
    default : float
        Emissivity outside all regions, above 0 and up to 1.

    Returns
    -------
    ndarray of float64
        Emissivity of each point, of the broadcast shape; see `thermography.radiometry.planck.temperature_from_counts`.

    Raises
    ------
    RadiometryError
        Where an emissivity is not above 0 and up to 1, or a polygon has fewer than three corners.
    """
    x, y = np.broadcast_arrays(np.asarray(x_mm, np.float64), np.asarray(y_mm, np.float64))
    points = np.column_stack((x.ravel(), y.ravel()))
    result = np.full(len(points), default, np.float64)
    for name, emissivity in (("default", default), *((region.name, region.emissivity) for region in regions)):
        if not 0 < emissivity <= 1:
            raise RadiometryError(f"emissivity of {name}: {emissivity:g} is not a fraction above 0 and up to 1")
    for region in regions:
        if len(region.polygon_mm) < 3:
            raise RadiometryError(f"region {region.name}: expected at least 3 corners, got {len(region.polygon_mm)}")
        result[points_in_poly(points, np.asarray(region.polygon_mm, np.float64))] = region.emissivity
    return result.reshape(x.shape)
