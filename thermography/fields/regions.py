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
        series.append(_reduce_region(values, seen, noise, shares, name))
        if common_u is not None:
            common = _weighted_mean(common_u.values.astype(float), seen, shares)
            series[-1]["mean_u"] = np.hypot(series[-1]["mean_noise_u"], common)
    units = {key: stack.attrs[key] for key in ("units", "units_metadata") if key in stack.attrs}
    difference = {"units": "K", "units_metadata": "temperature: difference"}
    attributes = {
        "mean": units,
        "mean_noise_u": difference,
        "median": units,
        "min": units,
        "max": units,
        "n": {"units": "1"},
    }
    if common_u is not None:
        attributes["mean_u"] = difference
    return xr.Dataset(
        {
            name: (("region", along), np.stack([region[name] for region in series]), attrs)
            for name, attrs in attributes.items()
        },
        coords={"region": list(regions), along: stack[along]},
    )


def common_part(fields: xr.Dataset, name: str) -> xr.DataArray:
    """Return the standard uncertainty of a field that all its cells share.

    Parameters
    ----------
    fields : Dataset
        Keeps `thermography.contract.FIELDS`.
    name : str
        ``temperature`` or ``temperature_rise``.

    Returns
    -------
    (cycle, y, x) DataArray, K
        What the total has beside noise and registration.
    """
    total, noise = (fields[f"{name}{end}"] for end in ("_u", "_noise_u"))
    variance = total.values.astype(float) ** 2 - noise.values.astype(float) ** 2
    return total.copy(data=np.sqrt(np.maximum(variance, 0.0)))


def _reduce_region(values: Array, seen: Array, noise: Array, shares: Array, name: str) -> dict[str, Array]:
    """Statistics of one region, each (time,), from values and mask (time, y, x), noise (time,) and shares (y, x)."""
    weight = np.where(seen, shares, 0.0)
    total = weight.sum(axis=(1, 2))
    if not total.any():
        raise PolygonError(f"{name}: all its cells are masked or out of view; move it away from fiducials and edges")
    mean = _weighted_mean(values, seen, shares)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_noise_u = noise * np.sqrt((weight**2).sum(axis=(1, 2))) / total
    cells = values[:, shares > min(_INSIDE, 0.999 * float(shares.max()))]
    empty = np.asarray(~np.isfinite(cells).any(axis=1))
    filled = np.where(empty[:, None], 0.0, cells)
    order = {key: np.where(empty, np.nan, reduce(filled, axis=1)) for key, reduce in _ORDER_STATISTICS.items()}
    return {"mean": mean, "mean_noise_u": mean_noise_u, "n": total, **order}


def _weighted_mean(values: Array, seen: Array, shares: Array) -> Array:
    """Mean of the seen cells weighted by their share, (time,); NaN where none is seen."""
    weight = np.where(seen, shares, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(seen, weight * values, 0.0).sum(axis=(1, 2)) / weight.sum(axis=(1, 2))
