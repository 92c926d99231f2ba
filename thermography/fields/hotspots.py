"""Hotspots on the table plan: peaks of a temperature field that stand out from their surroundings and from its noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from thermofuse.compiled import njit
from thermography.common import MAD_TO_SIGMA, Array, ThermographyError
from thermography.fields.cycle_fields import pixel_noise
from thermography.registration.plan import Polygon, PolygonError

#: Standard deviation of the Gaussian that smooths the field before peaks are searched, cells.
_SMOOTHING_CELLS = 1.0
#: The prominence of a peak must exceed this many standard deviations of the noise of the smoothed field.
_LEAST_SIGNIFICANCE = 6.0
#: A source is followed through cycles in which its peak has at least this share of the prominence that it needs to be named.
_FOLLOWED = 0.5
#: Rises that differ by less than this many standard deviations of the smoothed noise count as equally large.
_EQUAL_RISE = 3.0
#: Radii of the discs of cells to which the shape of a peak is fitted, cells.
_RADII = (2, 3, 5, 8, 12)
#: A fit holds where its mean square exceeds that of the noise by at most this many of its standard deviations.
_LARGEST_MISFIT = 2.0
#: Multiple of that up to which the smallest disc is believed, with the uncertainty that its misfit asks for: nothing smaller tells.
_ALONE = 1.25
#: Mean square of the distance of the points of a cell from its centre along one axis, cells2: what averaging over it widens a peak by.
_OF_CELL = 1.0 / 12.0


@dataclass(frozen=True)
class Hotspot:
    """A source of heat: a peak of the temperature rise, in the cycle of its largest rise, and the zone around it.

    Attributes
    ----------
    x_mm, y_mm, x_u_mm, y_u_mm : mm, position of the peak on the plan and its standard uncertainty from noise and shape
    peak_rise_K, peak_rise_u_K : K, rise at the peak and its standard uncertainty from noise and shape
    prominence_K : float, K
        Height of the peak above the highest level at which it is connected to a higher peak, or above the lowest rise on the plan.
    area_mm2, centroid_x_mm, centroid_y_mm, mean_rise_K : mm2, mm, mm and K, of the connected zone above half the prominence
    extent_mm : mm, smallest and largest x, smallest and largest y of that zone: edges of its outermost cells
    at_edge : the zone reaches the edge of the seen plan: the true peak may lie outside
    masked : the peak lies on or beside cells that are not seen: its place and rise are what the shape around them shows
    cycle, onset_cycle : int
        Position along the stack of the cycle of the largest rise (of several that the noise does not tell apart the last of the stack, or
        else the middle one) and of the first one in which the source stands out; 0 for one field.
    end_cycle : the last one in which it stands out, None where that is the last of the stack
    """

    x_mm: float
    y_mm: float
    x_u_mm: float
    y_u_mm: float
    peak_rise_K: float
    peak_rise_u_K: float
    prominence_K: float
    area_mm2: float
    centroid_x_mm: float
    centroid_y_mm: float
    mean_rise_K: float
    extent_mm: tuple[float, float, float, float]
    at_edge: bool
    masked: bool
    cycle: int = 0
    onset_cycle: int = 0
    end_cycle: int | None = None


@dataclass(frozen=True)
class _Peak:
    """A maximum of the smoothed field of one cycle; `zone` holds the cells (y, x) in which its source may lie."""

    cycle: int
    place: tuple[int, int]
    rise_K: float
    prominence_K: float
    stands_out: bool
    noise_K: float
    zone: NDArray[np.bool_]


def detect_hotspots(
    rise: xr.DataArray, *, noise_u: xr.DataArray | None = None, least_prominence_K: float = 0.1, limit: int = 20
) -> list[Hotspot]:
    """Detect the sources whose peaks stand out from their surroundings and from the noise, in one field or in any of a stack.

    Parameters
    ----------
    rise : (y, x) or (cycle, y, x) DataArray, K
        Temperature rise with coordinates in mm; NaN where the plan is not seen. Such cells are no low ones: they make no peak.
    noise_u : DataArray of the shape of `rise`, K, or None
        Standard uncertainty of every cell by noise, where it differs from place to place; never less than what the field itself shows.
    least_prominence_K : float, K
        Smallest prominence of a hotspot, and its smallest rise; six standard deviations of the noise are required of both in any case.
    limit : int
        Largest number of hotspots to return.

    Returns
    -------
    list of Hotspot
        Most prominent first; one for each source, however many cycles show it.

    Raises
    ------
    ThermographyError
        The field has other dims than these, or fewer than 3 x 3 cells.

    Notes
    -----
    Extended maxima by h-maxima transform (P. Soille, Morphological Image Analysis, 2nd ed. (2003), ch. 6) of the smoothed field. Place and
    rise are those of a Gaussian on a level or sloping background, averaged over the cells as the field is, fitted by least squares to
    discs of several sizes about the maximum. The uncertainty holds the noise and the scatter of all fits that the noise admits.

    Examples
    --------
    >>> x, y = np.arange(2.5, 300, 5), np.arange(2.5, 150, 5)
    >>> peak = 2.0 * np.exp(-((x - 150) ** 2 + (y[:, None] - 70) ** 2) / (2 * 30**2))
    >>> (spot,) = detect_hotspots(xr.DataArray(peak, dims=("y", "x"), coords={"y": y, "x": x}))
    >>> round(spot.x_mm), round(spot.y_mm), round(spot.peak_rise_K, 1)
    (150, 70, 2.0)
    """
    if not isinstance(rise, xr.DataArray):
        raise ThermographyError(
            f"rise is of type {type(rise).__name__}; give a DataArray, as temperature_rise of what reduce_frames returns"
        )
    if rise.dims[-2:] != ("y", "x") or rise.ndim not in (2, 3) or min(rise.shape[-2:]) < 3:
        raise ThermographyError(
            f"rise has dims {rise.dims} and shape {rise.shape}; give (y, x) or (cycle, y, x) of 3 x 3 cells or more"
        )
    stack = rise.values.astype(float).reshape(-1, *rise.shape[-2:])
    noises = (
        np.zeros(stack.shape) if noise_u is None else np.nan_to_num(noise_u.values.astype(float)).reshape(stack.shape)
    )
    found = [
        peak
        for cycle, (values, noise) in enumerate(zip(stack, noises, strict=True))
        for peak in _peaks(values, noise, cycle, least_prominence_K)
    ]
    sources = _sources(sorted(found, key=lambda peak: -peak.prominence_K))
    seen = np.flatnonzero(np.isfinite(stack).any(axis=(1, 2)))
    last = int(seen[-1]) if seen.size else 0
    return [_hotspot(rise, stack, source, last) for source in sources[:limit]]


def _peaks(values: Array, noise: Array, cycle: int, least_prominence_K: float) -> list[_Peak]:
    """The peaks of one field with a noise of its own in each cell, both (y, x), that may belong to a source."""
    seen = np.isfinite(values)
    if not seen.any():
        return []
    smooth, weight = _smooth_seen(values, _SMOOTHING_CELLS)
    # An empty cell is as warm as the nearest seen one, less a hair: it neither cuts a zone off nor counts as the lowest or the highest.
    field = smooth
    if not seen.all():
        nearest = scipy.ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True)
        field = np.where(seen, smooth, np.nextafter(smooth[tuple(nearest)], -np.inf))
    # A Gaussian of width s leaves 1 / (4 pi s^2) of the variance of white noise; what it takes away shows how large that is: a cell's own
    # weight in its mean is twice that, so that three such parts are missing. Where a part of its weight falls on no cell it leaves as
    # much more.
    left = 1 / (4 * np.pi * _SMOOTHING_CELLS**2)
    noise_K = MAD_TO_SIGMA * float(np.median(np.abs((values - smooth)[seen]))) / np.sqrt(1 - 3 * left)
    cells_K = np.maximum(noise, noise_K)
    smoothed_K = cells_K * np.sqrt(left / np.maximum(weight, left))
    least = np.maximum(least_prominence_K, _LEAST_SIGNIFICANCE * smoothed_K)
    prominences = _prominences(field, np.argsort(field, axis=None)[::-1])
    floor, middle = float(field.min()), float(np.median(smooth[seen]))
    peaks = []
    for at in zip(*np.nonzero(seen & (prominences >= _FOLLOWED * least) & (field >= _FOLLOWED * least)), strict=True):
        place = (int(at[0]), int(at[1]))
        top, prominence = float(field[place]), float(prominences[place])
        # The lowest of many cells is low by noise alone: the highest one must stand out from the middle one.
        stands_out = min(top, top - middle if prominence == top - floor else prominence) >= least[place]
        level = top - max(prominence / 2, _LEAST_SIGNIFICANCE * smoothed_K[place])
        zones, _ = scipy.ndimage.label(field >= level)
        peaks.append(_Peak(cycle, place, top, prominence, stands_out, float(cells_K[place]), zones == zones[place]))
    return peaks


def _sources(peaks: Sequence[_Peak]) -> list[list[_Peak]]:
    """The peaks, most prominent first, of every source: of each cycle the one that lies in the zone of its most prominent and it in its."""
    sources: list[dict[int, _Peak]] = []
    firsts: list[_Peak] = []
    for peak in peaks:
        homes = [
            (float(np.hypot(first.place[0] - peak.place[0], first.place[1] - peak.place[1])), k)
            for k, first in enumerate(firsts)
            if first.zone[peak.place] and peak.zone[first.place] and peak.cycle not in sources[k]
        ]
        if homes:
            sources[min(homes)[1]][peak.cycle] = peak
        elif peak.stands_out:
            sources.append({peak.cycle: peak})
            firsts.append(peak)
    return [list(source.values()) for source in sources]


def _smooth_seen(values: Array, width_cells: float) -> tuple[Array, Array]:
    """Gaussian mean over seen cells, (y, x), and the share of the weight on them; NaN cells remain NaN (normalised convolution)."""
    seen = np.isfinite(values)
    total = scipy.ndimage.gaussian_filter(np.where(seen, values, 0.0), width_cells, mode="constant")
    weight = scipy.ndimage.gaussian_filter(seen.astype(float), width_cells, mode="constant")
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(seen, total / weight, np.nan), weight


def _hotspot(rise: xr.DataArray, stack: Array, source: Sequence[_Peak], last: int) -> Hotspot:
    """The hotspot of the peaks of one source."""
    course = sorted(source, key=lambda peak: peak.cycle)
    top = max(course, key=lambda peak: peak.rise_K)
    equal = [peak for peak in course if top.rise_K - peak.rise_K <= _EQUAL_RISE * peak.noise_K / 2]
    peak = equal[-1] if equal[-1].cycle == last else equal[len(equal) // 2]
    values, seen = stack[peak.cycle], np.isfinite(stack[peak.cycle])
    x, y = rise["x"].values, rise["y"].values
    cell = float(x[1] - x[0])
    field = np.where(seen, _smooth_seen(values, _SMOOTHING_CELLS)[0], -np.inf)
    zone = peak.zone & (field >= peak.rise_K - peak.prominence_K / 2)
    rows, columns = np.nonzero(zone)
    whole = scipy.ndimage.binary_fill_holes(seen)
    outside = ~scipy.ndimage.binary_erosion(np.pad(whole, 1), np.ones((3, 3)))[1:-1, 1:-1]
    column, row, height, u, radius = _vertex(values, peak)
    # On a plateau, where no shape is known of all that noise does not tell from the peak, the peak may lie anywhere.
    alike = zone & (field >= peak.rise_K - _EQUAL_RISE * peak.noise_K / 2)
    spread = np.std(np.nonzero(alike), axis=1)[::-1]
    if np.sqrt(3.0) * spread.max() > radius:
        u[:2] = np.hypot(u[:2], spread)
    # Where noise does not tell the edge of the seen plan from the peak, the peak may lie there.
    rim = np.argwhere(alike & outside)
    if len(rim):
        u[:2] = np.hypot(u[:2], np.abs(rim - (row, column)).max(axis=0)[::-1] / np.sqrt(3.0))
    at = (min(max(round(row), 0), len(y) - 1), min(max(round(column), 0), len(x) - 1))
    left, lower = float(x[columns].min() - cell / 2), float(y[rows].min() - cell / 2)
    right, upper = float(x[columns].max() + cell / 2), float(y[rows].max() + cell / 2)
    return Hotspot(
        x_mm=float(x[0] + column * cell),
        y_mm=float(y[0] + row * cell),
        x_u_mm=float(u[0] * cell),
        y_u_mm=float(u[1] * cell),
        peak_rise_K=height,
        peak_rise_u_K=float(u[2]),
        prominence_K=peak.prominence_K,
        area_mm2=float(len(rows) * cell**2),
        centroid_x_mm=float(x[columns].mean()),
        centroid_y_mm=float(y[rows].mean()),
        mean_rise_K=float(values[zone].mean()),
        extent_mm=(left, right, lower, upper),
        at_edge=bool((zone & outside).any()),
        masked=bool(scipy.ndimage.binary_dilation(whole & ~seen, np.ones((3, 3)))[at]),
        cycle=peak.cycle,
        onset_cycle=course[0].cycle,
        end_cycle=None if course[-1].cycle == last else course[-1].cycle,
    )


@njit()
def _prominences(field: Array, order: NDArray[np.int64]) -> Array:
    """Height of every maximum of (y, x) above the highest level at which it is connected to a higher one, or above the lowest cell; 0
    elsewhere: zones grow in the order of the cells, highest first, and the lower of two that meet ends.
    """
    rows, columns = field.shape
    values = field.copy().ravel()
    above, prominence = np.full(values.size, -1), np.zeros(values.size)
    for cell in order:
        above[cell] = cell
        for row in range(max(cell // columns - 1, 0), min(cell // columns + 2, rows)):
            for column in range(max(cell % columns - 1, 0), min(cell % columns + 2, columns)):
                low, high = cell, row * columns + column
                if above[high] < 0:
                    continue
                while above[high] != high:
                    high = above[high]
                while above[low] != low:
                    low = above[low]
                if values[low] > values[high]:
                    low, high = high, low
                if low != high:
                    prominence[low] = values[low] - values[cell]
                    above[low] = high
        # Later searches start at the top.
        top = cell
        while above[top] != top:
            top = above[top]
        above[cell] = top
    prominence[order[0]] = values[order[0]] - values[order[-1]]
    return prominence.reshape(rows, columns)


def _vertex(values: Array, peak: _Peak) -> tuple[float, float, float, Array, float]:
    """Column, row and rise of the top of the shape around a peak, their standard uncertainties, cells and K, and the radius of the largest
    disc that shows that shape; infinite where none does, as the uncertainty is that of all cells then.
    """
    row, column = peak.place
    tops, us, beyond, models, radii, misfits = [], [], [], [], [], np.zeros((2, 3))
    least, most = np.array([-column, -row]) - 0.5, np.array([values.shape[1] - column, values.shape[0] - row]) - 0.5
    for sloping in (False, True):
        smaller = None
        for radius in _RADII:
            fitted = _fit_shape(values, peak, radius, sloping)
            if fitted is None:
                continue
            top, u, misfit = fitted
            at = np.clip(top[:2], least, most)
            if misfit > (_ALONE if smaller is None else 1.0):
                if smaller is not None:
                    # What the next larger disc says beyond its noise, carried on to a disc of no size: the top depends on the shape.
                    change = (top - tops[-1]) ** 2 - np.maximum(us[-1] ** 2 - u**2, 0.0)
                    misfits[int(sloping)] = np.maximum(change, 0.0) * (smaller / (radius - smaller)) ** 2
                break
            if (at != top[:2]).any():
                beyond.append(at)
            else:
                tops.append(top)
                us.append(u)
                models.append(int(sloping))
                radii.append(radius)
                smaller = radius
    if not tops:
        # No shape: the cells that the noise does not tell from the warmest.
        rows, columns = np.nonzero(peak.zone)
        u = np.maximum([columns.std(), rows.std()], np.sqrt(_OF_CELL))
        height_u = np.hypot(peak.noise_K, peak.prominence_K / 4)
        return float(column), float(row), peak.rise_K, np.array([*u, height_u]), np.inf
    top, each_u = np.array(tops), np.array(us)
    best = int(np.argmin(each_u.prod(axis=1)))
    weight = 1.0 / each_u**2
    # Scatter beyond that of the noise, where it exceeds the standard deviation that noise gives it: the smaller disc is a part of the
    # larger one, and differences from the best fit go together.
    by_noise = np.maximum(each_u**2 - each_u[best] ** 2, 0.0)
    excess = (weight * ((top - top[best]) ** 2 - by_noise)).sum(axis=0) / weight.sum(axis=0)
    scatter = np.where(excess > np.sqrt(2.0) * (weight * by_noise).sum(axis=0) / weight.sum(axis=0), excess, 0.0)
    beside = misfits[models[best]]
    for at in beyond:  # the place is known to the edge
        beside[:2] = np.maximum(beside[:2], (at - top[best, :2]) ** 2)
    x, y, height = top[best].tolist()
    return column + x, row + y, height, np.sqrt(each_u[best] ** 2 + scatter + beside), float(max(radii))


def _fit_shape(values: Array, peak: _Peak, radius: int, sloping: bool) -> tuple[Array, Array, float] | None:
    """Top (column, row, rise) of a Gaussian fitted to the cells within a radius of a peak, counted from it, its standard uncertainties,
    and its misfit over the largest one that the noise admits; None where the cells show no such peak.
    """
    v, u = np.nonzero(np.isfinite(values))
    v, u = v - peak.place[0], u - peak.place[1]
    near = np.hypot(u, v) <= radius + 0.5
    v, u = v[near].astype(float), u[near].astype(float)
    z = values[np.isfinite(values)][near]
    count = 9 if sloping else 7
    if len(z) < count + 4:
        return None
    # A field without noise is known to the digits of its numbers.
    noise_K = max(peak.noise_K, 1e-6 * (1.0 + np.abs(z).max()))

    def shape(p: Array) -> tuple[Array, Array]:
        du, dv = u - p[0], v - p[1]
        g = np.exp(np.clip(-0.5 * (p[2] * du**2 + 2 * p[3] * du * dv + p[4] * dv**2), -50.0, 50.0))
        a = p[5] * g
        slopes = [
            a * (p[2] * du + p[3] * dv),
            a * (p[3] * du + p[4] * dv),
            -a * du**2 / 2,
            -a * du * dv,
            -a * dv**2 / 2,
            g,
            np.ones_like(u),
        ]
        return a + p[6] + (p[7] * u + p[8] * v if sloping else 0.0), np.stack(
            slopes + ([u, v] if sloping else []), axis=1
        )

    height = max(float(np.ptp(z)), 4 * noise_K)
    start = [0.0, 0.0, 1.0 / radius**2, 0.0, 1.0 / radius**2, height, float(z.min()), 0.0, 0.0][:count]
    found = scipy.optimize.least_squares(
        lambda p: (shape(p)[0] - z) / noise_K, start, jac=lambda p: shape(p)[1] / noise_K, method="lm", max_nfev=40
    )
    top = _top_of(found.x)
    freedom = len(z) - count
    if top is None or np.abs(top[:2]).max() > radius:
        return None
    # Derivatives of the top by the parameters.
    by = np.empty((3, count))
    for k in range(count):
        step = 1e-4 * max(abs(found.x[k]), 1e-3)
        moved = _top_of(found.x + step * (np.arange(count) == k))
        if moved is None:
            return None
        by[:, k] = (moved - top) / step
    misfit = 2 * found.cost / freedom
    covariance = by @ np.linalg.pinv(found.jac.T @ found.jac, rcond=1e-12) @ by.T
    variance = np.maximum(np.diag(covariance), 1e-18) * max(misfit, 1.0)
    return top, np.sqrt(variance), misfit / (1.0 + _LARGEST_MISFIT * np.sqrt(2.0 / freedom))


def _top_of(p: Array) -> Array | None:
    """Column, row and height of the top of a Gaussian on its background as it is before it is averaged over cells; None without one."""
    inverse = np.array([[p[2], p[3]], [p[3], p[4]]])
    if p[5] <= 0 or np.linalg.eigvalsh(inverse)[0] <= 1e-9:
        return None
    wide = np.linalg.inv(inverse)
    narrow = wide - _OF_CELL * np.eye(2)
    if np.linalg.eigvalsh(narrow)[0] < 2 * _OF_CELL:
        return None
    height = p[5] * np.sqrt(np.linalg.det(wide) / np.linalg.det(narrow))
    slope, shift = (p[7:9] if len(p) > 7 else np.zeros(2)), np.zeros(2)
    # Where the slopes of Gaussian and background cancel: a fixed point that is stable inside the point of inflexion.
    for _ in range(30):
        g = height * np.exp(-0.5 * shift @ np.linalg.solve(narrow, shift))
        before, shift = shift, narrow @ slope / g
        if shift @ np.linalg.solve(narrow, shift) > 0.9:
            return None
        if np.abs(shift - before).max() < 1e-7:
            break
    at = p[:2] + shift
    return np.array([*at, p[6] + slope @ at + height * np.exp(-0.5 * shift @ np.linalg.solve(narrow, shift))])


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
