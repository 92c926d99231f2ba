"""L4 - Which places of the field these data cannot tell apart, whatever the drift does.

Two places that warm alike explain the drift alike. Cells that take one course form one cluster, whatever their distance; and the
condition number of the leading thermal modes says how many sources the session can tell apart at all.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.attribution import nuisance_columns
from fusion.channels import Array
from fusion.excitation import describe_excitation, thermal_modes

#: Courses that share at least this much of their variance count as one source.
_SHARED_VARIANCE = 0.98


def cluster_cells(field: xr.DataArray, *, shared_variance: float = _SHARED_VARIANCE, limit: int = 12) -> xr.Dataset:
    """Group cells whose temperature takes one course, and give the condition number of the field's thermal modes.

    Courses are compared as the test of the drift sees them: without trend and, where a warm-up dominates, without its exponentials.

    Parameters
    ----------
    field : DataArray
        Temperature, dims time, y, x.
    shared_variance : float
        Squared correlation from which two courses count as one.
    limit : int
        Most clusters; the rest is 0.

    Returns
    -------
    Dataset
        ``cluster`` (y, x): 0 none, 1 the largest course, ...; ``mode_size`` (eigenmode) in K rms; ``condition``: first over last mode.
    """
    values = field.values.reshape(field.sizes["time"], -1).astype(float)
    seen = np.isfinite(values).all(axis=0)
    centred = values[:, seen] - values[:, seen].mean(axis=0)
    # What the test of the drift leaves of a course is what places can be told apart by: no trend, and no warm-up where one dominates.
    seconds = (field["time"].values - field["time"].values[0]) / np.timedelta64(1, "s")
    nuisance = nuisance_columns(seconds, describe_excitation(seconds, centred))
    centred = centred - nuisance @ np.linalg.lstsq(nuisance, centred, rcond=None)[0]
    courses, patterns = thermal_modes(centred, limit=limit)
    # Courses are compared free of noise, in the space of the modes that stand above it.
    weights = np.sqrt((courses**2).sum(axis=0))
    scores = patterns * weights[:, None]
    size = np.sqrt((scores**2).sum(axis=0))
    label = _lead(scores, size, shared_variance, limit)
    cluster = np.zeros(values.shape[1], np.int16)
    cluster[seen] = label
    mode_size = weights / np.sqrt(values.shape[0])
    condition = float(mode_size[0] / mode_size[-1]) if mode_size.size else float("nan")
    return xr.Dataset(
        {
            "cluster": (("y", "x"), cluster.reshape(field.shape[1:]), {"units": "1"}),
            "mode_size": (
                ("eigenmode",),
                mode_size,
                {"units": "K", "long_name": "rms of each thermal mode over time and cells"},
            ),
            "condition": ((), condition, {"units": "1"}),
        },
        coords={"y": field["y"], "x": field["x"], "eigenmode": np.arange(1, mode_size.size + 1)},
    )


def _lead(scores: Array, size: Array, shared_variance: float, limit: int) -> NDArray[np.int16]:
    """Label cells (columns of scores) by the strongest cell whose course they share, at most `limit` labels."""
    label = np.zeros(size.size, np.int16)
    unit = scores / np.where(size > 0, size, 1.0)
    left = size > 0
    for number in range(1, limit + 1):
        if not left.any():
            break
        leader = int(np.argmax(np.where(left, size, -1.0)))
        alike = left & ((unit[:, leader] @ unit) ** 2 >= shared_variance)
        label[alike] = number
        left &= ~alike
    return label
