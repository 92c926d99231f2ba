"""Hotspots on the table plan: peaks of a temperature field that stand out from their surroundings and from its noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from skimage import measure, morphology

from thermography.common import MAD_TO_SIGMA, Array, ThermographyError
from thermography.fields.cycle_fields import pixel_noise
from thermography.registration.plan import Polygon, PolygonError

#: Standard deviation of the Gaussian that smooths the field before peaks are searched, cells.
_SMOOTHING_CELLS = 1.0
#: The prominence of a peak must exceed this many standard deviations of the noise of the smoothed field.
_LEAST_SIGNIFICANCE = 6.0


@dataclass(frozen=True)
class Hotspot:
    """A peak of the temperature rise and the zone around it.

    Attributes
    ----------
    x_mm, y_mm : mm, position of the peak on the plan
    peak_rise_K : K, rise at the peak
    prominence_K : float, K
        Height of the peak above the highest level at which it is connected to a higher peak, or above the lowest rise on the plan.
    area_mm2, centroid_x_mm, centroid_y_mm, mean_rise_K : mm2, mm, mm and K, of the connected zone above half the prominence
    extent_mm : mm, smallest and largest x, smallest and largest y of that zone: edges of its outermost cells
    at_edge : the zone reaches the edge of the seen plan: the true peak may lie outside
    """

    x_mm: float
    y_mm: float
    peak_rise_K: float
    prominence_K: float
    area_mm2: float
    centroid_x_mm: float
    centroid_y_mm: float
    mean_rise_K: float
    extent_mm: tuple[float, float, float, float]
    at_edge: bool


def detect_hotspots(rise: xr.DataArray, *, least_prominence_K: float = 0.1, limit: int = 20) -> list[Hotspot]:
    """Detect the peaks of one field that stand out from their surroundings and from its noise.

    Parameters
    ----------
    rise : (y, x) DataArray, K
        Temperature rise with coordinates in mm; NaN where the plan is not seen.
    least_prominence_K : float, K
        Smallest prominence of a hotspot; six standard deviations of the noise are required in any case.
    limit : int
        Largest number of hotspots to return.

    Returns
    -------
    list of Hotspot
        Most prominent first.

    Raises
    ------
    ThermographyError
        The field has other dims than (y, x), or fewer than 3 x 3 cells.

    Notes
    -----
    Extended maxima by h-maxima transform (P. Soille, Morphological Image Analysis, 2nd ed. (2003), ch. 6) of the smoothed field; the
    position is the vertex of a paraboloid fitted to the 5 x 5 cells around the maximum.

    Examples
    --------
    >>> x, y = np.arange(2.5, 300, 5), np.arange(2.5, 150, 5)
    >>> peak = 2.0 * np.exp(-((x - 150) ** 2 + (y[:, None] - 70) ** 2) / (2 * 30**2))
    >>> (spot,) = detect_hotspots(xr.DataArray(peak, dims=("y", "x"), coords={"y": y, "x": x}))
    >>> round(spot.x_mm), round(spot.y_mm), round(spot.peak_rise_K, 1)
    (150, 70, 2.0)
    """
    if rise.dims != ("y", "x") or min(rise.shape) < 3:
        raise ThermographyError(f"rise has dims {rise.dims} and shape {rise.shape}; give (y, x) of 3 x 3 cells or more")
    values = rise.values.astype(float)
    seen = np.isfinite(values)
    if not seen.any():
        return []
    smooth = _smooth_seen(values, _SMOOTHING_CELLS)
    floor = float(smooth[seen].min())
    field = np.where(seen, smooth, floor)
    # A Gaussian of width s leaves 1 / (4 pi s^2) of the variance of white noise; what it takes away shows how large that is.
    left = 1 / (4 * np.pi * _SMOOTHING_CELLS**2)
    noise_K = MAD_TO_SIGMA * float(np.median(np.abs((values - smooth)[seen]))) * np.sqrt(left / (1 - left))
    least = max(least_prominence_K, _LEAST_SIGNIFICANCE * noise_K)
    if field.max() - floor < least:
        return []
    peaks = measure.label(morphology.h_maxima(field, least), connectivity=2)
    spots = []
    for label in range(1, peaks.max() + 1):
        peak = np.where((peaks == label) & seen, field, -np.inf)
        place = np.unravel_index(int(np.argmax(peak)), field.shape)
        spots.append(_hotspot(rise, values, field, seen, place, floor))
    return sorted(spots, key=lambda spot: -spot.prominence_K)[:limit]


def _smooth_seen(values: Array, width_cells: float) -> Array:
    """Gaussian mean over seen cells, (y, x); NaN cells have no weight and remain NaN (normalised convolution)."""
    seen = np.isfinite(values)
    total = scipy.ndimage.gaussian_filter(np.where(seen, values, 0.0), width_cells, mode="constant")
    weight = scipy.ndimage.gaussian_filter(seen.astype(float), width_cells, mode="constant")
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(seen, total / weight, np.nan)


def _hotspot(
    rise: xr.DataArray, values: Array, field: Array, seen: NDArray[np.bool_], place: tuple[Any, ...], floor: float
) -> Hotspot:
    """The hotspot of a maximum of the smoothed field at a cell (row, column)."""
    x, y = rise["x"].values, rise["y"].values
    cell = float(x[1] - x[0])
    prominence = field[place] - _saddle(field, place, floor)
    zones = measure.label((field >= field[place] - prominence / 2) & seen, connectivity=1)
    zone = zones == zones[place]
    rows, columns = np.nonzero(zone)
    filled = np.pad(scipy.ndimage.binary_fill_holes(seen), 1)
    outside = ~scipy.ndimage.binary_erosion(filled, np.ones((3, 3)))[1:-1, 1:-1]
    column, row, peak = _vertex(values, field, place)
    left, lower = float(x[columns].min() - cell / 2), float(y[rows].min() - cell / 2)
    right, upper = float(x[columns].max() + cell / 2), float(y[rows].max() + cell / 2)
    return Hotspot(
        x_mm=float(x[0] + column * cell),
        y_mm=float(y[0] + row * cell),
        peak_rise_K=peak,
        prominence_K=float(prominence),
        area_mm2=float(len(rows) * cell**2),
        centroid_x_mm=float(x[columns].mean()),
        centroid_y_mm=float(y[rows].mean()),
        mean_rise_K=float(values[zone].mean()),
        extent_mm=(left, right, lower, upper),
        at_edge=bool((zone & outside).any()),
    )


def _saddle(field: Array, place: tuple[Any, ...], floor: float) -> float:
    """Highest level at which a peak is connected to a higher one, by bisection; the floor for the highest peak."""
    top = float(field[place])
    levels = np.unique(field[field < top])
    low, high = -1, len(levels) - 1
    # The peak is connected to a higher one at levels[low] and below, and not above.
    while low < high:
        middle = (low + high + 1) // 2
        zones = measure.label(field >= levels[middle], connectivity=2)
        if field[zones == zones[place]].max() > top:
            low = middle
        else:
            high = middle - 1
    return float(levels[low]) if low >= 0 else floor


def _vertex(values: Array, field: Array, place: tuple[Any, ...]) -> tuple[float, float, float]:
    """Column, row and height of the vertex of a paraboloid fitted to the 5 x 5 cells around a peak; the cell itself without one."""
    row, column = int(place[0]), int(place[1])
    rows, columns = np.mgrid[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
    inside = (rows < field.shape[0]) & (columns < field.shape[1])
    rows, columns = rows[inside], columns[inside]
    seen = np.isfinite(values[rows, columns])
    rows, columns = rows[seen], columns[seen]
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


# Time series of polygonal regions of the plan from stacks of temperature fields.

#: Cells of which more than this share lies in a region are included in its median, minimum and maximum.
_INSIDE = 0.5
_ORDER_STATISTICS: dict[str, Callable[..., Array]] = {"median": np.nanmedian, "min": np.nanmin, "max": np.nanmax}


def region_series(
    stack: xr.DataArray, regions: Mapping[str, ArrayLike], *, common_u: xr.DataArray | None = None
) -> xr.Dataset:
    """Reduce a stack of fields to mean, median, minimum and maximum per region.

    Parameters
    ----------
    stack : (time, y, x) or (cycle, y, x) DataArray, degC or K
        Coordinates in mm; NaN cells are excluded.
    regions : mapping of str to (n, 2) array, mm
        Corners (x, y) of a polygon by name.
    common_u : DataArray of the shape of `stack`, K, or None
        Standard uncertainty that all cells share, from `common_part`; None for a stack without one.

    Returns
    -------
    xr.Dataset
        Dimensions (region, time or cycle), in the unit of `stack`: ``mean``, weighted by the share of each cell in the region;
        ``mean_noise_u``, its standard uncertainty from the noise between neighbouring cells; where `common_u` is given, ``mean_u``,
        its standard uncertainty with what all cells share; ``median``, ``min``, ``max`` over the cells of which more than half lies in
        the region; ``n``, the sum of the shares of the seen cells.

    Raises
    ------
    PolygonError
        A polygon has fewer than three corners or contains no seen cell.

    Notes
    -----
    With shares w and the noise s of a cell, ``mean = sum(w T) / sum(w)`` and ``mean_noise_u = s sqrt(sum(w^2)) / sum(w)`` (JCGM 100:2008,
    5.1.2, for independent cells); s as in `thermography.fields.cycle_fields.pixel_noise`. What all cells share is fully correlated
    (5.2.2, note 1), so that its part of ``mean_u`` is the weighted mean of `common_u`.

    Examples
    --------
    >>> x, y = np.arange(2.5, 100, 5), np.arange(2.5, 50, 5)
    >>> ramp = np.broadcast_to(x / 100, (1, len(y), len(x)))
    >>> stack = xr.DataArray(ramp, dims=("cycle", "y", "x"), coords={"cycle": [1], "y": y, "x": x})
    >>> series = region_series(stack, {"left half": [(0, 0), (50, 0), (50, 50), (0, 50)]})
    >>> round(float(series["mean"][0, 0]), 3)
    0.25
    """
    along = stack.dims[0]
    values = stack.values.astype(float)
    seen = np.isfinite(values)
    noise = np.array([pixel_noise(field, cells) for field, cells in zip(values, seen, strict=True)])
    x_mm, y_mm = stack["x"].values, stack["y"].values
    series = []
    for name, corners in regions.items():
        shares = Polygon(name, np.asarray(corners, float)).cell_shares(x_mm, y_mm)
        # Statistics of one region, each (time,), from values and mask (time, y, x), noise (time,) and shares (y, x).
        weight = np.where(seen, shares, 0.0)
        total = weight.sum(axis=(1, 2))
        if not total.any():
            raise PolygonError(f"{name}: all its cells are masked or out of view; move it off fiducials and edges")
        mean = _weighted_mean(values, seen, shares)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean_noise_u = noise * np.sqrt((weight**2).sum(axis=(1, 2))) / total
        cells = values[:, shares > min(_INSIDE, 0.999 * float(shares.max()))]
        empty = np.asarray(~np.isfinite(cells).any(axis=1))
        filled = np.where(empty[:, None], 0.0, cells)
        order = {key: np.where(empty, np.nan, reduce(filled, axis=1)) for key, reduce in _ORDER_STATISTICS.items()}
        series.append({"mean": mean, "mean_noise_u": mean_noise_u, **order, "n": total})
        if common_u is not None:
            common = _weighted_mean(common_u.values.astype(float), seen, shares)
            series[-1]["mean_u"] = np.hypot(series[-1]["mean_noise_u"], common)
    units = {key: stack.attrs[key] for key in ("units", "units_metadata") if key in stack.attrs}
    difference = {"units": "K", "units_metadata": "temperature: difference"}
    attributes = {"n": {"units": "1"}, "mean_noise_u": difference, "mean_u": difference}
    return xr.Dataset(
        {
            name: (("region", along), np.stack([region[name] for region in series]), attributes.get(name, units))
            for name in series[0]
        },
        coords={"region": list(regions), along: stack[along]},
    )


def common_part(fields: xr.Dataset, name: str) -> xr.DataArray:
    """Return the standard uncertainty of a field that all its cells share."""
    total, noise = (fields[f"{name}{end}"] for end in ("_u", "_noise_u"))
    variance = total.values.astype(float) ** 2 - noise.values.astype(float) ** 2
    return total.copy(data=np.sqrt(np.maximum(variance, 0.0)))


def _weighted_mean(values: Array, seen: Array, shares: Array) -> Array:
    """Mean of the seen cells weighted by their share, (time,); NaN where none is seen."""
    weight = np.where(seen, shares, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(seen, weight * values, 0.0).sum(axis=(1, 2)) / weight.sum(axis=(1, 2))
