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
#: Quantities of a candidate, and what stands where there is none.
_BLANK = {"statistic": -1.0, "p_value": 1.0, "sensitivity": 0.0, "sensitivity_u": np.inf, "lag": 0.0}
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
    x_mm, y_mm : where the weaker of the two statistics is strongest, midway between both sessions' places
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
        places = [_strongest_nearby(_candidates(one, channel), reach) for one in (first, second)]
        joint_p = np.maximum(places[0]["p_value"], places[1]["p_value"])
        verdict = np.where((joint_p <= LEVEL) & _consistent(*places), ATTRIBUTABLE, NOT_ATTRIBUTABLE)
        maps.append(joint_p)
        verdicts.append(verdict if separable else np.full_like(verdict, NOT_SEPARABLE))
        found.append(_conclude(channel, places, separable))
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


def _candidates(session: xr.Dataset, channel: str) -> dict[str, Array]:
    """Strongest candidate at every place, (y, x) each: the cell itself, or the thermal mode that has its height there.

    The statistic is divided by its threshold, so that cells and modes compare.
    """
    chosen = session.sel(channel=channel)
    strongest = {name: np.nan_to_num(chosen[name].values, nan=none) for name, none in _BLANK.items()}
    strongest["statistic"] = strongest["statistic"] / float(chosen["threshold"])
    for mode in session["mode"].values if "modes_p_value" in session else ():
        one = chosen.sel(mode=mode)
        at = (int(np.argmin(np.abs(chosen["y"].values - float(one["modes_at_y"])))),
              int(np.argmin(np.abs(chosen["x"].values - float(one["modes_at_x"])))))  # fmt: skip
        ratio = float(one["modes_statistic"]) / float(one["modes_threshold"])
        if ratio > strongest["statistic"][at]:
            for name in _BLANK:
                strongest[name][at] = ratio if name == "statistic" else float(one[f"modes_{name}"])
    y, x = np.meshgrid(chosen["y"].values, chosen["x"].values, indexing="ij")
    return strongest | {"x": x, "y": y}


def _strongest_nearby(values: dict[str, Array], reach: int) -> dict[str, Array]:
    """Quantities of the strongest place within reach (cells) of every cell, its own place included, (y, x) each."""
    rows, columns = values["statistic"].shape
    padded = {name: np.pad(array, reach, constant_values=_BLANK.get(name, 0.0)) for name, array in values.items()}
    best = {name: array.copy() for name, array in values.items()}
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            if np.hypot(down, right) > reach:
                continue
            part = (slice(reach + down, reach + down + rows), slice(reach + right, reach + right + columns))
            stronger = padded["statistic"][part] > best["statistic"]
            for name, array in padded.items():
                best[name] = np.where(stronger, array[part], best[name])
    return best


def _consistent(first: dict[str, Array], second: dict[str, Array]) -> Mask:
    """Where both sessions' strongest places nearby are one place, with sensitivities of one sign that agree within u, (y, x)."""
    a, b = first["sensitivity"], second["sensitivity"]
    u = np.hypot(first["sensitivity_u"], second["sensitivity_u"])
    apart = np.hypot(first["x"] - second["x"], first["y"] - second["y"])
    return np.asarray((a * b > 0) & (np.abs(a - b) <= _DISAGREEMENT * u) & (apart <= SAME_PLACE_MM), bool)


def _conclude(
    channel: str,
    places: list[dict[str, Array]],
    separable: bool,
) -> Common:
    """Verdict on one channel from the strongest places (per session) near every cell."""
    joint_p = np.maximum(places[0]["p_value"], places[1]["p_value"])
    consistent = _consistent(*places)
    weaker = np.minimum(*[one["statistic"] for one in places])
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
        sizes = f"{sensitivity[0]:+.2f} and {sensitivity[1]:+.2f} um/K"
        reason = f"both sessions find something near here, but not at one place with one size: {sizes}"
    else:
        verdict, reason = "not attributable", "no place is found by both sessions"
    return Common(
        channel=channel,
        verdict=verdict,
        x_mm=float(np.mean([one["x"][row, column] for one in places])),
        y_mm=float(np.mean([one["y"][row, column] for one in places])),
        p_value=p_value,
        sensitivity_um_per_K=sensitivity,
        lag_s=(float(places[0]["lag"][row, column]), float(places[1]["lag"][row, column])),
        reason=reason,
    )
