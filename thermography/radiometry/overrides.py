"""What a campaign knows better than the camera: parameters for all frames, over time, and per region."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.measure import points_in_poly

from thermography.io.frame import CameraParameters, FrameHeader
from thermography.radiometry.planck import RadiometryError, override


@dataclass(frozen=True, eq=False)
class Series:
    """A parameter that was logged: `times` (n,) datetime64, increasing, and `values` (n,) in the parameter's unit."""

    times: NDArray[np.datetime64]
    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        times, values = np.asarray(self.times), np.asarray(self.values, np.float64)
        if times.shape != values.shape or times.ndim != 1 or times.size == 0:
            raise RadiometryError(f"series: expected as many times as values, got {times.shape} and {values.shape}")
        if not (np.diff(times) > np.timedelta64(0)).all() or not np.isfinite(values).all():
            raise RadiometryError("series: expected increasing times and finite values; sort the log and remove gaps")

    def at(self, time: np.datetime64) -> float:
        """Interpolate linearly to a time.

        Raises
        ------
        RadiometryError
            Where the log does not reach: ambient conditions are not extrapolated.
        """
        times = np.asarray(self.times).astype("datetime64[ms]")
        if np.isnat(time) or not times[0] <= time <= times[-1]:
            raise RadiometryError(f"frame at {time}: the log reaches from {times[0]} to {times[-1]} only; extend it")
        milliseconds = (times - times[0]).astype(np.int64)
        return float(np.interp((time - times[0]).astype("timedelta64[ms]").astype(np.int64), milliseconds, self.values))


@dataclass(frozen=True)
class Overrides:
    """Parameters of each frame: those of the file, replaced by constants and by what was logged at the frame's time.

    Attributes
    ----------
    constants : mapping of parameter name to value
    series : mapping of parameter name to Series
        Logged values win over constants.

    Examples
    --------
    >>> at_22_degC = Overrides(constants={"reflected_temperature_K": 295.15})
    """

    constants: Mapping[str, float] = field(default_factory=dict)
    series: Mapping[str, Series] = field(default_factory=dict)

    def __call__(self, frame: FrameHeader) -> CameraParameters:
        """Return the parameters to calibrate a frame with."""
        logged = {name: series.at(frame.time) for name, series in self.series.items()}
        changes = {**self.constants, **logged}
        return override(frame.parameters, **changes) if changes else frame.parameters


@dataclass(frozen=True)
class Region:
    """A surface of its own emissivity: a polygon of (x, y) plan points in mm."""

    name: str
    polygon_mm: tuple[tuple[float, float], ...]
    emissivity: float


def emissivity_map(
    x_mm: ArrayLike, y_mm: ArrayLike, regions: Sequence[Region], *, default: float
) -> NDArray[np.float64]:
    """Return the emissivity of points of the table plan.

    Parameters
    ----------
    x_mm, y_mm : arrays that broadcast together
        Plan coordinates: of the cells of a grid, or of each sensor pixel by the registration.
    regions : sequence of Region
        A later region lies on top of an earlier one.
    default : float
        Emissivity outside every region.

    Returns
    -------
    ndarray of float64, the broadcast shape

    Raises
    ------
    RadiometryError
        Where an emissivity is no fraction or a polygon has fewer than three corners.
    """
    x, y = np.broadcast_arrays(np.asarray(x_mm, np.float64), np.asarray(y_mm, np.float64))
    points = np.column_stack((x.ravel(), y.ravel()))
    result = np.full(len(points), default, np.float64)
    for name, emissivity in (("default", default), *((region.name, region.emissivity) for region in regions)):
        if not 0 < emissivity <= 1:
            raise RadiometryError(f"emissivity of {name}: {emissivity:g} is no fraction above 0 and up to 1")
    for region in regions:
        if len(region.polygon_mm) < 3:
            raise RadiometryError(f"region {region.name}: expected at least 3 corners, got {len(region.polygon_mm)}")
        result[points_in_poly(points, np.asarray(region.polygon_mm, np.float64))] = region.emissivity
    return result.reshape(x.shape)
