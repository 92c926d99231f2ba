"""Time series of polygonal regions of the plan from stacks of temperature fields."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from thermography._typing import Array
from thermography.fields.cycle_fields import pixel_noise
from thermography.registration.polygon import Polygon, PolygonError

#: Cells of which more than this share lies in a region are included in its median, minimum and maximum.
_INSIDE = 0.5
_ORDER_STATISTICS: dict[str, Callable[..., Array]] = {"median": np.nanmedian, "min": np.nanmin, "max": np.nanmax}


def region_series(stack: xr.DataArray, regions: Mapping[str, ArrayLike]) -> xr.Dataset:
    """Reduce a stack of fields to mean, median, minimum and maximum per region.

    Parameters
    ----------
    stack : (time, y, x) or (cycle, y, x) DataArray, degC or K
        Coordinates in mm; NaN cells are excluded.
    regions : mapping of str to (n, 2) array, mm
        Corners (x, y) of a polygon by name.

    Returns
    -------
    xr.Dataset
        Dimensions (region, time or cycle), in the unit of `stack`: ``mean``, weighted by the share of each cell in the region;
        ``mean_u``, its standard uncertainty from the noise between neighbouring cells (errors common to all cells are not
        included); ``median``, ``min``, ``max`` over the cells of which more than half lies in the region; ``n``, the sum of the
        shares of the seen cells.

    Raises
    ------
    PolygonError
        A polygon has fewer than three corners or contains no seen cell.

    Notes
    -----
    With shares w and the noise s of a cell, ``mean = sum(w T) / sum(w)`` and ``mean_u = s sqrt(sum(w^2)) / sum(w)`` (JCGM 100:2008,
    5.1.2, for independent cells); s as in `thermography.fields.cycle_fields.pixel_noise`.

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
        series.append(_reduce_region(values, seen, noise, shares, name))
    units = {key: stack.attrs[key] for key in ("units", "units_metadata") if key in stack.attrs}
    difference = {"units": "K", "units_metadata": "temperature: difference"}
    attributes = {"mean": units, "mean_u": difference, "median": units, "min": units, "max": units, "n": {"units": "1"}}
    return xr.Dataset(
        {
            name: (("region", along), np.stack([region[name] for region in series]), attrs)
            for name, attrs in attributes.items()
        },
        coords={"region": list(regions), along: stack[along]},
    )


def _reduce_region(values: Array, seen: Array, noise: Array, shares: Array, name: str) -> dict[str, Array]:
    """Statistics of one region, each (time,), from values and mask (time, y, x), noise (time,) and shares (y, x)."""
    weight = np.where(seen, shares, 0.0)
    total = weight.sum(axis=(1, 2))
    if not total.any():
        raise PolygonError(f"{name}: all its cells are masked or out of view; move it away from fiducials and edges")
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(seen, weight * values, 0.0).sum(axis=(1, 2)) / total
        mean_u = noise * np.sqrt((weight**2).sum(axis=(1, 2))) / total
    cells = values[:, shares > min(_INSIDE, 0.999 * float(shares.max()))]
    empty = np.asarray(~np.isfinite(cells).any(axis=1))
    filled = np.where(empty[:, None], 0.0, cells)
    order = {key: np.where(empty, np.nan, reduce(filled, axis=1)) for key, reduce in _ORDER_STATISTICS.items()}
    return {"mean": mean, "mean_u": mean_u, "n": total, **order}
