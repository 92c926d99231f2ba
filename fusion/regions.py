"""L4 - Hotspots, regions and thermal modes as sources of the drift: fewer, quieter candidates than cells.

A region's temperature is the mean of its cells. Thermal modes are the film's leading spatial patterns, rotated until each lives in one
place (varimax), so that a mode usually is one heat source with its halo; that finds weak sources where single cells do not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.attribution import LAGS_S, Film, evaluate_film
from fusion.channels import Array, ClockedReadings, read_clock, reduce_channels
from fusion.correlation import CorrelationError, describe, describe_session, read_film
from fusion.excitation import describe_excitation, thermal_modes

#: Rotation stops when the varimax criterion grows by less than this share.
_ROTATION_TOLERANCE = 1e-6
_ROTATION_ROUNDS = 200


@dataclass(frozen=True)
class Disc:
    """A round region on the plan, mm."""

    x_mm: float
    y_mm: float
    radius_mm: float


def correlate_regions(
    fused_readings: xr.Dataset,
    field: xr.DataArray,
    regions: Mapping[str, Disc],
    *,
    lags_s: Sequence[float] = LAGS_S,
    draws: int = 499,
    seed: int = 0,
) -> xr.Dataset:
    """Test the mean temperature of named regions as sources of the drift.

    Parameters
    ----------
    fused_readings, field : as for :func:`fusion.correlation.correlate`
    regions : mapping
        Name to disc; for a hotspot its centroid and the radius of a disc of its area.

    Returns
    -------
    Dataset
        The quantities of :func:`fusion.correlation.correlate` over channel and region.

    Raises
    ------
    CorrelationError
        if a region holds no seen cell.
    """
    readings = read_clock(fused_readings, field["time"].values.astype("datetime64[ns]"))
    film, seen = read_film(field, readings.frame_seconds)
    y, x = np.meshgrid(field["y"].values, field["x"].values, indexing="ij")
    columns = []
    for name, disc in regions.items():
        inside = (np.hypot(x - disc.x_mm, y - disc.y_mm) <= disc.radius_mm).ravel()[seen]
        if not inside.any():
            raise CorrelationError(
                f"region {name!r} at x = {disc.x_mm:g} mm, y = {disc.y_mm:g} mm holds no seen cell; move it or make it larger"
            )
        columns.append(film.values[:, inside].mean(axis=1))
    return _test(readings, film, np.column_stack(columns), list(regions), lags_s, draws, seed)


def correlate_modes(
    fused_readings: xr.Dataset,
    field: xr.DataArray,
    *,
    lags_s: Sequence[float] = LAGS_S,
    draws: int = 499,
    limit: int = 6,
    seed: int = 0,
) -> xr.Dataset:
    """Test the film's localised thermal modes as sources of the drift.

    Returns
    -------
    Dataset
        As :func:`correlate_regions` (regions "mode 1"..), with ``pattern`` (region, y, x; 1 at its strongest cell) and its place
        ``peak_x``, ``peak_y`` (mm). Sensitivities count per K at the strongest cell.
    """
    readings = read_clock(fused_readings, field["time"].values.astype("datetime64[ns]"))
    film, seen = read_film(field, readings.frame_seconds)
    courses, patterns = thermal_modes(film.values, limit=limit)
    if courses.shape[1] == 0:
        raise CorrelationError("no thermal mode stands above the film's noise; the field did not change enough")
    rotation = varimax(patterns.T)
    courses, patterns = courses @ rotation, rotation.T @ patterns
    place = np.abs(patterns).argmax(axis=1)
    peak = np.take_along_axis(patterns, place[:, None], axis=1)
    courses, patterns = courses * peak.T, patterns / peak
    names = [f"mode {k + 1}" for k in range(courses.shape[1])]
    dataset = _test(readings, film, courses, names, lags_s, draws, seed)
    maps = np.full((len(names), seen.size), np.nan)
    maps[:, seen] = patterns
    cell = np.flatnonzero(seen)[place]
    row, column = np.divmod(cell, field.sizes["x"])
    dataset["pattern"] = (("region", "y", "x"), maps.reshape(len(names), *field.shape[1:]), {"units": "1"})
    dataset["peak_x"] = (("region",), field["x"].values[column], {"units": "mm"})
    dataset["peak_y"] = (("region",), field["y"].values[row], {"units": "mm"})
    return dataset.assign_coords(y=field["y"], x=field["x"])


def varimax(loadings: Array) -> NDArray[np.float64]:
    """Rotation (k, k) that concentrates each column of loadings (n, k) on few rows (Kaiser 1958, Psychometrika 23, 187)."""
    k = loadings.shape[1]
    rotation = np.eye(k)
    criterion = 0.0
    for _ in range(_ROTATION_ROUNDS):
        rotated = loadings @ rotation
        gradient = loadings.T @ (rotated**3 - rotated * (rotated**2).mean(axis=0))
        left, size, right = np.linalg.svd(gradient)
        rotation = left @ right
        if size.sum() < criterion * (1.0 + _ROTATION_TOLERANCE):
            break
        criterion = float(size.sum())
    return rotation


def _test(
    readings: ClockedReadings,
    film: Film,
    columns: Array,
    names: list[str],
    lags_s: Sequence[float],
    draws: int,
    seed: int,
) -> xr.Dataset:
    series = reduce_channels(readings)
    excitation = describe_excitation(film.seconds, film.values)
    few = Film(film.seconds, columns - columns.mean(axis=0))
    tested = evaluate_film(series, few, excitation, lags_s=lags_s, draws=draws, rng=np.random.default_rng(seed))
    dataset = describe_session(tested, excitation).assign_coords(region=names)
    for name, (values, attrs) in describe(tested, series, few, lags_s, excitation).items():
        finite = values if values.dtype.kind == "i" else np.where(np.isfinite(values), values, np.nan)
        dataset[name] = (("channel", "region"), finite, attrs)
    return dataset
