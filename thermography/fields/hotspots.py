"""Hotspots on the table plan: where a field rises above what surrounds it, followed over the cycles; isotherms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage
from skimage import measure, morphology

from thermography._typing import Array
from thermography.errors import ThermographyError

#: Smoothing before peaks are looked for, cells: single cells are noise.
SMOOTHING_CELLS = 1.0
#: A peak must stand out by this many times the noise of the smoothed field.
LEAST_SIGNIFICANCE = 6.0


@dataclass(frozen=True)
class Hotspot:
    """A peak of the temperature rise and the zone around it.

    Attributes
    ----------
    x_mm, y_mm
        The peak on the plan.
    peak_rise_K
        Rise at the peak.
    prominence_K
        How far the peak stands above the highest level at which it joins a higher peak, or above the plan's lowest rise.
    area_mm2, centroid_x_mm, centroid_y_mm, mean_rise_K
        Of the connected zone above half the prominence.
    at_edge
        The zone reaches the edge of what is seen: its peak may lie outside.
    """

    x_mm: float
    y_mm: float
    peak_rise_K: float
    prominence_K: float
    area_mm2: float
    centroid_x_mm: float
    centroid_y_mm: float
    mean_rise_K: float
    at_edge: bool


def detect_hotspots(rise: xr.DataArray, *, least_prominence_K: float = 0.1, limit: int = 20) -> list[Hotspot]:
    """Find the peaks of one field that stand out from their surroundings and from its noise.

    Parameters
    ----------
    rise
        Temperature rise (y, x) in K with coordinates in mm; NaN where nothing is seen.
    least_prominence_K
        Peaks that stand out by less are not hotspots.
    limit
        Most hotspots to return.

    Returns
    -------
    list[Hotspot]
        Most prominent first.

    Raises
    ------
    ThermographyError
        The field is not (y, x) with at least 3 x 3 cells.
    """
    if rise.dims != ("y", "x") or min(rise.shape) < 3:
        raise ThermographyError(
            f"rise has dims {rise.dims} and shape {rise.shape}; give one field (y, x) of at least 3 x 3 cells"
        )
    values = rise.values.astype(float)
    seen = np.isfinite(values)
    if not seen.any():
        return []
    smooth = smooth_seen(values, SMOOTHING_CELLS)
    floor = float(smooth[seen].min())
    field = np.where(seen, smooth, floor)
    least = max(least_prominence_K, LEAST_SIGNIFICANCE * _noise(values - smooth, seen))
    if field.max() - floor < least:
        return []
    peaks = measure.label(morphology.h_maxima(field, least), connectivity=2)
    found = []
    for label in range(1, peaks.max() + 1):
        own = peaks == label
        place = np.unravel_index(int(np.argmax(np.where(own & seen, field, -np.inf))), field.shape)
        found.append(_hotspot(rise, values, field, seen, place, floor))
    return sorted(found, key=lambda spot: -spot.prominence_K)[:limit]


def follow_hotspots(rise: xr.DataArray, *, least_prominence_K: float = 0.1, reach_mm: float = 40.0) -> xr.Dataset:
    """Follow hotspots over the cycles: a peak is the same one as long as it moves less than `reach_mm` between cycles.

    Parameters
    ----------
    rise
        (cycle, y, x) in K.
    least_prominence_K
        As in `detect_hotspots`.
    reach_mm
        How far a peak may move from one appearance to the next.

    Returns
    -------
    xr.Dataset
        Dims (hotspot, cycle): x, y (mm), peak_rise, prominence (K), area (mm2); NaN in cycles in which a hotspot is not found.
        Hotspots count from 1 in the order of their largest prominence.
    """
    names = {"x": "x_mm", "y": "y_mm", "peak_rise": "peak_rise_K", "prominence": "prominence_K", "area": "area_mm2"}
    tracks: list[dict[int, Hotspot]] = []
    for cycle in range(rise.sizes["cycle"]):
        spots = detect_hotspots(rise.isel(cycle=cycle), least_prominence_K=least_prominence_K)
        free = [track for track in tracks if cycle not in track]
        pairs = sorted(
            (np.hypot(spot.x_mm - track[max(track)].x_mm, spot.y_mm - track[max(track)].y_mm), i, j)
            for i, spot in enumerate(spots)
            for j, track in enumerate(free)
        )
        taken_spots: set[int] = set()
        taken_tracks: set[int] = set()
        for distance, i, j in pairs:
            if distance <= reach_mm and i not in taken_spots and j not in taken_tracks:
                free[j][cycle] = spots[i]
                taken_spots.add(i)
                taken_tracks.add(j)
        tracks.extend({cycle: spot} for i, spot in enumerate(spots) if i not in taken_spots)
    tracks.sort(key=lambda track: -max(spot.prominence_K for spot in track.values()))
    data = np.full((len(names), len(tracks), rise.sizes["cycle"]), np.nan)
    for number, track in enumerate(tracks):
        for cycle, spot in track.items():
            data[:, number, cycle] = [getattr(spot, attribute) for attribute in names.values()]
    units = {"x": "mm", "y": "mm", "peak_rise": "K", "prominence": "K", "area": "mm2"}
    return xr.Dataset(
        {name: (("hotspot", "cycle"), data[i], {"units": units[name]}) for i, name in enumerate(names)},
        coords={"hotspot": np.arange(1, len(tracks) + 1), "cycle": rise["cycle"].values},
    )


def isotherms(field: xr.DataArray, levels: Sequence[float]) -> dict[float, list[Array]]:
    """Lines of equal temperature on the plan: by level, a list of lines, each (n, 2) mm (x, y)."""
    y, x = field["y"].values, field["x"].values
    lines: dict[float, list[Array]] = {}
    for level in levels:
        contours = measure.find_contours(field.values.astype(float), level, mask=np.isfinite(field.values))
        lines[level] = [
            np.column_stack([np.interp(c[:, 1], np.arange(len(x)), x), np.interp(c[:, 0], np.arange(len(y)), y)])
            for c in contours
        ]
    return lines


def smooth_seen(values: Array, width_cells: float) -> Array:
    """Gaussian mean over seen cells, shape (y, x); NaN cells have no weight and stay NaN."""
    seen = np.isfinite(values)
    total = ndimage.gaussian_filter(np.where(seen, values, 0.0), width_cells, mode="constant")
    weight = ndimage.gaussian_filter(seen.astype(float), width_cells, mode="constant")
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(seen, total / weight, np.nan)


def _noise(residual: Array, seen: NDArray[np.bool_]) -> float:
    """Noise of the smoothed field from what the smoothing took away."""
    # White noise keeps 1 / (4 pi s^2) of its variance under a Gaussian of width s.
    kept = 1 / (4 * np.pi * SMOOTHING_CELLS**2)
    return 1.4826 * float(np.median(np.abs(residual[seen]))) * np.sqrt(kept / (1 - kept))


def _hotspot(
    rise: xr.DataArray, values: Array, field: Array, seen: NDArray[np.bool_], place: tuple[Any, ...], floor: float
) -> Hotspot:
    x, y = rise["x"].values, rise["y"].values
    cell = float(x[1] - x[0])
    prominence = field[place] - _saddle(field, place, floor)
    zones = measure.label((field >= field[place] - prominence / 2) & seen, connectivity=1)
    zone = zones == zones[place]
    rows, columns = np.nonzero(zone)
    outside = ~ndimage.binary_erosion(np.pad(ndimage.binary_fill_holes(seen), 1), np.ones((3, 3)))[1:-1, 1:-1]
    column, row, peak = _vertex(values, field, place)
    return Hotspot(
        x_mm=float(x[0] + column * cell),
        y_mm=float(y[0] + row * cell),
        peak_rise_K=peak,
        prominence_K=float(prominence),
        area_mm2=float(len(rows) * cell**2),
        centroid_x_mm=float(x[columns].mean()),
        centroid_y_mm=float(y[rows].mean()),
        mean_rise_K=float(values[zone].mean()),
        at_edge=bool((zone & outside).any()),
    )


def _saddle(field: Array, place: tuple[Any, ...], floor: float) -> float:
    """Highest level at which the peak is connected to a higher one; the floor for the highest peak."""
    top = float(field[place])
    levels = np.unique(field[field < top])
    low, high = -1, len(levels) - 1
    # The peak joins something higher at levels[low] and below, nowhere above: bisection.
    while low < high:
        middle = (low + high + 1) // 2
        zones = measure.label(field >= levels[middle], connectivity=2)
        if field[zones == zones[place]].max() > top:
            low = middle
        else:
            high = middle - 1
    return float(levels[low]) if low >= 0 else floor


def _vertex(values: Array, field: Array, place: tuple[Any, ...]) -> tuple[float, float, float]:
    """Column, row and height of the paraboloid through the 5 x 5 cells around a peak; the cell itself where it has no vertex near."""
    row, column = int(place[0]), int(place[1])
    rows, columns = np.mgrid[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
    inside = (rows < field.shape[0]) & (columns < field.shape[1])
    rows, columns = rows[inside], columns[inside]
    known = np.isfinite(values[rows, columns])
    rows, columns = rows[known], columns[known]
    if len(rows) >= 15:
        u, v = columns - column, rows - row
        basis = np.column_stack([np.ones(len(u)), u, v, u * u, u * v, v * v]).astype(float)
        c = np.linalg.lstsq(basis, values[rows, columns], rcond=None)[0]
        hessian = np.array([[2 * c[3], c[4]], [c[4], 2 * c[5]]])
        if np.linalg.eigvalsh(hessian)[1] < 0:
            step = -np.linalg.solve(hessian, c[1:3])
            if np.abs(step).max() <= 2:
                return column + step[0], row + step[1], float(c[0] + 0.5 * c[1:3] @ step)
    return float(column), float(row), float(field[place])
