"""L4 - Which places of the field carry the evidence, and which of them these data cannot tell apart.

Two places that warm alike explain the drift alike. A place whose best likelihood is within the reach of chance of the leading one
belongs to the same cluster, whatever its distance; and the condition number of the leading thermal modes says how many sources the
session can tell apart at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from fusion.attribution import LEVEL
from fusion.channels import Array
from fusion.excitation import thermal_modes

#: A place explains the drift as well as the leading one if its likelihood ratio is lower by no more than this (chi-square, 1
#: degree of freedom, 0.95).
EQUAL_RATIO = 3.84
#: Courses that share at least this much of their variance count as one source.
_SHARED_VARIANCE = 0.98


@dataclass(frozen=True)
class Evidence:
    """The region that carries a channel's evidence.

    Attributes
    ----------
    x_mm, y_mm : place of the highest likelihood
    area_mm2 : area of all cells that explain the drift as well
    parts : separate pieces of that area; more than one means that these data cannot tell places apart
    width_mm : largest distance of such a cell from the leading one
    """

    channel: str
    x_mm: float
    y_mm: float
    p_value: float
    sensitivity_um_per_K: float
    sensitivity_u_um_per_K: float
    lag_s: float
    area_mm2: float
    parts: int
    width_mm: float

    def sentence(self) -> str:
        """The finding in words, with what would sharpen it where places cannot be told apart."""
        found = (
            f"{self.channel}: {self.sensitivity_um_per_K:+.2f} +- {self.sensitivity_u_um_per_K:.2f} um/K at x = {self.x_mm:.0f} mm, "
            f"y = {self.y_mm:.0f} mm, lag {self.lag_s / 60:.0f} min, p = {self.p_value:.3f}"
        )
        if self.p_value > LEVEL:
            return f"{found}: not attributable"
        if self.parts > 1:
            return f"{found}; {self.parts} places explain it equally well: switch their heat sources separately to tell them apart"
        return f"{found}, within {self.width_mm:.0f} mm"


def carry_evidence(attribution: xr.Dataset, channel: str = "joint") -> Evidence:
    """Return the leading place of a channel of :func:`fusion.correlation.correlate`, and the region that explains it as well."""
    chosen = attribution.sel(channel=channel)
    statistic = np.nan_to_num(chosen["statistic"].values, nan=-np.inf)
    row, column = np.unravel_index(int(statistic.argmax()), statistic.shape)
    equal = statistic >= statistic[row, column] - EQUAL_RATIO
    x, y = chosen["x"].values, chosen["y"].values
    rows, columns = np.nonzero(equal)
    cell = float(np.median(np.diff(x)) * np.median(np.diff(y)))
    at = {"x": column, "y": row}
    return Evidence(
        channel=channel,
        x_mm=float(x[column]),
        y_mm=float(y[row]),
        p_value=float(chosen["p_value"][at]),
        sensitivity_um_per_K=float(chosen["sensitivity"][at]),
        sensitivity_u_um_per_K=float(chosen["sensitivity_u"][at]),
        lag_s=float(chosen["lag"][at]),
        area_mm2=float(equal.sum() * cell),
        parts=int(ndimage.label(equal, np.ones((3, 3)))[1]),
        width_mm=float(np.hypot(x[columns] - x[column], y[rows] - y[row]).max()),
    )


def evidence_at(attribution: xr.Dataset, x_mm: float, y_mm: float) -> dict[str, float | str]:
    """Return the strongest channel at the cell nearest to a plan point: channel, p value, sensitivity (um/K) with u, lag (s)."""
    cell = attribution.sel(x=x_mm, y=y_mm, method="nearest")
    p_value = np.nan_to_num(cell["p_value"].values, nan=1.0)
    # Equal p values (the resolution of the draws) are told apart by the statistic against its own threshold.
    order = np.lexsort((-np.nan_to_num((cell["statistic"] / cell["threshold"]).values), p_value))
    best = cell.isel(channel=int(order[0]))
    return {
        "channel": str(best["channel"].values),
        "p_value": float(p_value[order[0]]),
        "sensitivity_um_per_K": float(best["sensitivity"]),
        "sensitivity_u_um_per_K": float(best["sensitivity_u"]),
        "lag_s": float(best["lag"]),
    }


def cluster_cells(field: xr.DataArray, *, shared_variance: float = _SHARED_VARIANCE, limit: int = 12) -> xr.Dataset:
    """Group cells whose temperature takes one course, and give the condition number of the field's thermal modes.

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
        ``cluster`` (y, x): 0 none, 1 the largest course, ...; ``mode_size`` (mode) in K rms; ``condition``: first over last mode.
    """
    values = field.values.reshape(field.sizes["time"], -1).astype(float)
    seen = np.isfinite(values).all(axis=0)
    centred = values[:, seen] - values[:, seen].mean(axis=0)
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
                ("mode",),
                mode_size,
                {"units": "K", "long_name": "rms of each thermal mode over time and cells"},
            ),
            "condition": ((), condition, {"units": "1"}),
        },
        coords={"y": field["y"], "x": field["x"], "mode": np.arange(1, mode_size.size + 1)},
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
