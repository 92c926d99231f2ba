"""Series from fields: regions (polygons) and line segments of the plan over time, and the field at any time."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from skimage.measure import points_in_poly

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.fields.cycle_fields import pixel_noise

#: Points per cell and side by which a region's share of a cell is counted.
PARTS = 10
#: Cells of which more than this share lies in a region count for its median, minimum and maximum.
INSIDE = 0.5


class RegionError(ThermographyError):
    """A region or line does not lie on the seen plan; the message names it and its place."""


def region_series(stack: xr.DataArray, regions: Mapping[str, ArrayLike]) -> xr.Dataset:
    """Reduce a stack of fields to mean, median, minimum and maximum per region.

    Parameters
    ----------
    stack
        (time or cycle, y, x) in degC or K, coordinates in mm; NaN cells take no part.
    regions
        By name, the corners of a polygon, (n, 2) mm (x, y).

    Returns
    -------
    xr.Dataset
        Dims (region, time or cycle): ``mean`` (weighted by the cells' share in the region), ``median``, ``min``, ``max``, ``n``
        (cells, as the sum of their shares) and ``mean_u``, the standard uncertainty of the mean from the noise between
        neighbouring cells of the field; what all cells share is not in it.

    Raises
    ------
    RegionError
        A polygon has fewer than three corners or holds no seen cell.
    """
    return _reduce(stack, {name: region_share(stack, corners, name=name) for name, corners in regions.items()})


def segment_series(stack: xr.DataArray, start_mm: ArrayLike, end_mm: ArrayLike, *, width_mm: float) -> xr.Dataset:
    """Reduce a stack of fields to one straight line: as `region_series` without the region, further ``integral`` in K mm.

    The integral along the line is its mean over the strip of `width_mm` times its length.
    """
    start, end = np.asarray(start_mm, float), np.asarray(end_mm, float)
    series = _reduce(stack, {"segment": segment_share(stack, start, end, width_mm=width_mm)}).isel(region=0, drop=True)
    length = float(np.hypot(*(end - start)))
    units = {"units": f"{stack.attrs.get('units', 'K')} mm"}
    return series.assign(
        integral=(series["mean"] * length).assign_attrs(units),
        integral_u=(series["mean_u"] * length).assign_attrs(units),
    )


def region_share(stack: xr.DataArray, corners_mm: ArrayLike, *, name: str = "region") -> xr.DataArray:
    """Share of every cell, (y, x) 0..1, that lies in a polygon with corners (n, 2) mm.

    Raises
    ------
    RegionError
        Fewer than three corners, or no cell of the plan is touched.
    """
    corners = np.asarray(corners_mm, float)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise RegionError(f"{name}: corners have shape {corners.shape}; a polygon needs at least three (x, y) in mm")
    x, y = stack["x"].values, stack["y"].values
    cell = float(x[1] - x[0])
    steps = ((np.arange(PARTS) + 0.5) / PARTS - 0.5) * cell
    share = np.zeros((len(y), len(x)))
    columns = np.flatnonzero((x + cell / 2 > corners[:, 0].min()) & (x - cell / 2 < corners[:, 0].max()))
    rows = np.flatnonzero((y + cell / 2 > corners[:, 1].min()) & (y - cell / 2 < corners[:, 1].max()))
    if rows.size and columns.size:
        fine_x, fine_y = np.meshgrid((x[columns, None] + steps).ravel(), (y[rows, None] + steps).ravel())
        inside = points_in_poly(np.column_stack([fine_x.ravel(), fine_y.ravel()]), corners)
        parts = inside.reshape(len(rows), PARTS, len(columns), PARTS)
        share[np.ix_(rows, columns)] = parts.mean(axis=(1, 3))
    if not share.any():
        span = (
            f"x {corners[:, 0].min():g}..{corners[:, 0].max():g}, y {corners[:, 1].min():g}..{corners[:, 1].max():g} mm"
        )
        raise RegionError(f"{name}: ({span}) holds no part of the plan; give its corners in plan mm")
    return xr.DataArray(share, dims=("y", "x"), coords={"y": y, "x": x}, attrs={"units": "1"})


def segment_share(stack: xr.DataArray, start_mm: ArrayLike, end_mm: ArrayLike, *, width_mm: float) -> xr.DataArray:
    """Share of every cell, (y, x) 0..1, that a straight strip of `width_mm` from start to end (x, y) mm covers.

    Raises
    ------
    RegionError
        The segment has no length or no width, or lies off the plan.
    """
    start, end = np.asarray(start_mm, float), np.asarray(end_mm, float)
    length = np.hypot(*(end - start))
    if not (length > 0 and width_mm > 0):
        raise RegionError(f"segment from {start.tolist()} to {end.tolist()} mm of width {width_mm} mm covers nothing")
    across = np.array([start[1] - end[1], end[0] - start[0]]) / length * width_mm / 2
    return region_share(stack, [start - across, end - across, end + across, start + across], name="segment")


def fields_at(stack: xr.DataArray, times: ArrayLike) -> xr.DataArray:
    """Fields at given times, (time, y, x), linear between the frames of a stack (time, y, x); NaN outside their time."""
    wanted = np.asarray(times, "datetime64[ns]")
    known = stack["time"].values.astype("datetime64[ns]").astype(np.int64)
    at = wanted.astype(np.int64)
    after = np.clip(np.searchsorted(known, at), 1, max(len(known) - 1, 1))
    if len(known) < 2:
        part, after = np.zeros(len(at)), np.zeros(len(at), int)
    else:
        part = (at - known[after - 1]) / (known[after] - known[after - 1])
    values = stack.values
    before = np.maximum(after - 1, 0)
    weight = part[:, None, None]
    # A frame whose weight is zero must not spread its NaN.
    mixed = np.where(
        weight == 0,
        values[before],
        np.where(weight == 1, values[after], (1 - weight) * values[before] + weight * values[after]),
    )
    mixed[(at < known[0]) | (at > known[-1])] = np.nan
    return xr.DataArray(
        mixed, dims=("time", "y", "x"), coords={"time": wanted, "y": stack["y"], "x": stack["x"]}, attrs=stack.attrs
    )


def _reduce(stack: xr.DataArray, shares: Mapping[str, xr.DataArray]) -> xr.Dataset:
    along = stack.dims[0]
    values = stack.values.astype(float)
    known = np.isfinite(values)
    noise = np.array([pixel_noise(field, seen) for field, seen in zip(values, known, strict=True)])
    series = [_one(values, known, noise, share.values, name) for name, share in shares.items()]
    units = {key: stack.attrs[key] for key in ("units", "units_metadata") if key in stack.attrs}
    difference = {"units": "K", "units_metadata": "temperature: difference"}
    names = {"mean": units, "mean_u": difference, "median": units, "min": units, "max": units, "n": {"units": "1"}}
    return xr.Dataset(
        {name: (("region", along), np.stack([one[name] for one in series]), attrs) for name, attrs in names.items()},
        coords={"region": list(shares), along: stack[along]},
    )


def _one(values: Array, known: Array, noise: Array, share: Array, name: str) -> dict[str, Array]:
    weight = np.where(known, share, 0.0)
    total = weight.sum(axis=(1, 2))
    if not total.any():
        raise RegionError(f"{name}: all its cells are masked or out of view; move it away from fiducials and edges")
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(known, weight * values, 0.0).sum(axis=(1, 2)) / total
        mean_u = noise * np.sqrt((weight**2).sum(axis=(1, 2))) / total
    inner = share > min(INSIDE, 0.999 * float(share.max()))
    cells = values[:, inner]
    empty = np.asarray(~np.isfinite(cells).any(axis=1))
    safe = np.where(empty[:, None], 0.0, cells)
    extremes = {key: np.where(empty, np.nan, reduce(safe, axis=1)) for key, reduce in REDUCTIONS.items()}
    return {"mean": mean, "mean_u": mean_u, "n": total, **extremes}


REDUCTIONS: dict[str, Callable[..., Array]] = {"median": np.nanmedian, "min": np.nanmin, "max": np.nanmax}
