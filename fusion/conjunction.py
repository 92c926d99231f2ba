"""L4 - Two campaigns of one machine: a source is called a cause only where both agree.

One session may be fooled by two series that happen to wander alike; two independent sessions are fooled at the same place, with the
same sign and size, far more rarely (a hundredth of the cases instead of a tenth; for two warm-ups nearly never).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

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
    separable = any(one.attrs["excitation"] != "warm-up only" for one in (first, second))
    maps, verdicts, found = [], [], []
    for channel in channels:
        sessions = [one.sel(channel=channel) for one in (first, second)]
        places = [_strongest_nearby(one, reach) for one in sessions]
        joint_p = np.maximum(places[0]["p_value"], places[1]["p_value"])
        verdict = np.where((joint_p <= LEVEL) & _consistent(*places), ATTRIBUTABLE, NOT_ATTRIBUTABLE)
        maps.append(joint_p)
        verdicts.append(verdict if separable else np.full_like(verdict, NOT_SEPARABLE))
        limits = (float(sessions[0]["threshold"]), float(sessions[1]["threshold"]))
        found.append(_conclude(channel, first, places, limits, separable))
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


def _strongest_nearby(session: xr.Dataset, reach: int) -> dict[str, Array]:
    """Quantities of the strongest place within reach (cells) of every cell: p value, statistic, sensitivity, u, lag, each (y, x)."""
    names = ("statistic", "p_value", "sensitivity", "sensitivity_u", "lag")
    blank = (-1.0, 1.0, 0.0, np.inf, 0.0)
    values = {name: np.nan_to_num(session[name].values, nan=none) for name, none in zip(names, blank, strict=True)}
    rows, columns = values["statistic"].shape
    padded = {name: np.pad(values[name], reach, constant_values=none) for name, none in zip(names, blank, strict=True)}
    best = {name: field.copy() for name, field in values.items()}
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            if np.hypot(down, right) > reach:
                continue
            part = (slice(reach + down, reach + down + rows), slice(reach + right, reach + right + columns))
            stronger = padded["statistic"][part] > best["statistic"]
            for name in names:
                best[name] = np.where(stronger, padded[name][part], best[name])
    return best


def _consistent(first: dict[str, Array], second: dict[str, Array]) -> Mask:
    """Where both sessions' strongest places nearby have sensitivities of one sign that agree within their uncertainty, (y, x)."""
    a, b = first["sensitivity"], second["sensitivity"]
    u = np.hypot(first["sensitivity_u"], second["sensitivity_u"])
    return np.asarray((a * b > 0) & (np.abs(a - b) <= _DISAGREEMENT * u), bool)


def _conclude(
    channel: str,
    attribution: xr.Dataset,
    places: list[dict[str, Array]],
    thresholds: tuple[float, float],
    separable: bool,
) -> Common:
    """Verdict on one channel from the strongest places (per session) near every cell."""
    joint_p = np.maximum(places[0]["p_value"], places[1]["p_value"])
    consistent = _consistent(*places)
    weaker = np.minimum(*[one["statistic"] / limit for one, limit in zip(places, thresholds, strict=True)])
    candidates = (joint_p <= LEVEL) & consistent
    row, column = np.unravel_index(int(np.where(candidates, weaker + 1e6, weaker).argmax()), weaker.shape)
    p_value = float(joint_p[row, column])
    sensitivity = (float(places[0]["sensitivity"][row, column]), float(places[1]["sensitivity"][row, column]))
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
        x_mm=float(attribution["x"][column]),
        y_mm=float(attribution["y"][row]),
        p_value=p_value,
        sensitivity_um_per_K=sensitivity,
        lag_s=(float(places[0]["lag"][row, column]), float(places[1]["lag"][row, column])),
        reason=reason,
    )
