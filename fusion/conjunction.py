"""L4 - Two campaigns of one machine: a source is called a cause only where both agree.

One session may be fooled by two series that happen to wander alike; two independent sessions are fooled at the same place, with the
same sign and size, far more rarely (a hundredth of the cases instead of a tenth; for two warm-ups nearly never).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from fusion.attribution import LEVEL
from fusion.channels import Array
from fusion.correlation import ATTRIBUTABLE, NOT_ATTRIBUTABLE, NOT_SEPARABLE

Mask = NDArray[np.bool_]

#: Places of the two sessions count as the same within this distance: half the width of a heat source's halo.
SAME_PLACE_MM = 50.0
#: Sensitivities disagree where they differ by more than this many standard uncertainties.
_DISAGREEMENT = 3.0


class ConjunctionError(ValueError):
    """Two campaigns cannot be compared; the message says in what they differ."""


@dataclass(frozen=True)
class Common:
    """Verdict on one channel from both sessions.

    Attributes
    ----------
    verdict : "attributable", "not attributable" or "not separable"
    x_mm, y_mm : where the weaker of the two statistics is strongest
    p_value : the larger of both sessions' family-wise p there (a conjunction needs both)
    sensitivity_um_per_K : of both sessions
    reason : why, in words
    """

    channel: str
    verdict: str
    x_mm: float
    y_mm: float
    p_value: float
    sensitivity_um_per_K: tuple[float, float]
    lag_s: tuple[float, float]
    reason: str


def agree(first: xr.Dataset, second: xr.Dataset) -> tuple[xr.Dataset, list[Common]]:
    """Join the maps of two campaigns.

    Parameters
    ----------
    first, second : Datasets of :func:`fusion.correlation.correlate` on the same plan grid, from tests of the same machine.

    Returns
    -------
    Dataset
        ``p_value`` (channel, y, x): larger of both sessions' smallest family-wise p within 50 mm; ``verdict`` as in the single maps.
    list of Common
        One verdict per channel.

    Raises
    ------
    ConjunctionError
        if the grids differ or no channel is common.
    """
    for name in ("x", "y"):
        if first.sizes[name] != second.sizes[name] or not np.allclose(first[name], second[name]):
            raise ConjunctionError(
                f"the plan grids differ along {name}; give both campaigns the same [plan] size, cell_size and fiducials"
            )
    channels = [str(name) for name in first["channel"].values if name in second["channel"].values]
    if not channels:
        raise ConjunctionError("the two campaigns share no drift channel; both need readings at several targets")
    cell = float(np.median(np.diff(first["x"].values)))
    reach = max(1, round(SAME_PLACE_MM / cell))
    disc = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= reach
    separable = [one.attrs["excitation"] != "warm-up only" for one in (first, second)]
    maps, verdicts, found = [], [], []
    for channel in channels:
        sessions = [one.sel(channel=channel) for one in (first, second)]
        joint_p = np.maximum(*[_nearby_p(one, disc) for one in sessions])
        consistent = _consistent(*sessions)
        verdict = np.where((joint_p <= LEVEL) & consistent, ATTRIBUTABLE, NOT_ATTRIBUTABLE)
        if not any(separable):
            verdict[:] = NOT_SEPARABLE
        maps.append(joint_p)
        verdicts.append(verdict)
        found.append(_conclude(channel, sessions, joint_p, consistent, any(separable)))
    dims = ("channel", "y", "x")
    joined = xr.Dataset(
        {
            "p_value": (
                dims,
                np.stack(maps),
                {"units": "1", "long_name": "larger of both sessions' family-wise p values"},
            ),
            "verdict": (dims, np.stack(verdicts).astype(np.int8), dict(first["verdict"].attrs)),
        },
        coords={"channel": channels, "y": first["y"], "x": first["x"]},
    )
    return joined, found


def _nearby_p(session: xr.Dataset, disc: Mask) -> Array:
    """Smallest family-wise p within the same place of every cell, (y, x)."""
    p_value = np.nan_to_num(session["p_value"].values, nan=1.0)
    return np.asarray(ndimage.minimum_filter(p_value, footprint=disc, mode="nearest"), float)


def _consistent(first: xr.Dataset, second: xr.Dataset) -> Mask:
    """Where both sessions' sensitivities have one sign and agree within their uncertainty, (y, x)."""
    a, b = first["sensitivity"].values, second["sensitivity"].values
    u = np.hypot(first["sensitivity_u"].values, second["sensitivity_u"].values)
    with np.errstate(invalid="ignore"):
        return np.asarray((a * b > 0) & (np.abs(a - b) <= _DISAGREEMENT * u), bool)


def _conclude(channel: str, sessions: list[xr.Dataset], joint_p: Array, consistent: Mask, separable: bool) -> Common:
    weaker = np.minimum(*[np.nan_to_num((one["statistic"] / one["threshold"]).values, nan=-1.0) for one in sessions])
    candidates = (joint_p <= LEVEL) & consistent
    row, column = np.unravel_index(int(np.where(candidates, weaker + 1e6, weaker).argmax()), weaker.shape)
    at = {"x": column, "y": row}
    p_value = float(joint_p[row, column])
    sensitivity = (float(sessions[0]["sensitivity"][at]), float(sessions[1]["sensitivity"][at]))
    if not separable:
        verdict, reason = "not separable", "both sessions are one warm-up each: switch the heat sources at random times"
    elif candidates.any():
        verdict, reason = "attributable", "both sessions find this place, with one sign and one size"
    elif p_value <= LEVEL:
        verdict = "not attributable"
        reason = f"both sessions find this place, but with {sensitivity[0]:+.2f} and {sensitivity[1]:+.2f} um/K"
    else:
        verdict, reason = "not attributable", "no place is found by both sessions"
    return Common(
        channel=channel,
        verdict=verdict,
        x_mm=float(sessions[0]["x"][column]),
        y_mm=float(sessions[0]["y"][row]),
        p_value=p_value,
        sensitivity_um_per_K=sensitivity,
        lag_s=(float(sessions[0]["lag"][at]), float(sessions[1]["lag"][at])),
        reason=reason,
    )
