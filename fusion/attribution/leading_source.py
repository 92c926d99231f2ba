"""Name the leading source of a session: which candidate goes with the drift, where it is, and which places explain the drift as well.

Thermal modes are asked first: they have the power that single cells lack, and a mode is one place. Where no mode passes, the strongest
cell or region leads. All candidates were tested under one family-wise error probability, so that the order costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from fusion._typing import Array
from fusion.attribution.areas import IN_MODE, Area, area_of
from fusion.attribution.family_wise import LEVEL

#: A place explains the drift as well as the leading one if its likelihood ratio is lower by no more than this (chi-square, 1
#: degree of freedom, 0.95).
_EQUAL_RATIO = 3.84
#: Separate pieces of a mode that reach this share of its peak are places of their own.
_PEAK = 0.7
_QUANTITIES = ("p_value", "statistic", "sensitivity", "sensitivity_u", "lag", "detectable_sensitivity", "threshold")
#: Sets of candidates in the order in which they are asked, and the kind of each.
_SETS = (("modes", "mode"), ("cells", "cell"), ("regions", "region"))


@dataclass(frozen=True)
class LeadingSource:
    """The leading candidate of a session, whether it passes or not.

    Attributes
    ----------
    verdict : {"attributable", "not attributable", "not separable"}
        Verdict of the session.
    kind : {"mode", "cell", "region"}
        What the candidate is.
    name : str
        Number of the mode, name of the region, empty for a cell.
    channel : str
        Part of the drift that it goes with.
    x_mm, y_mm : float, mm
        Place on the plan.
    p_value : float
        Family-wise over everything that was tested.
    sensitivity_um_per_K, sensitivity_u_um_per_K : float, um/K
        Drift per temperature rise and its standard uncertainty; for common and growing drift together at the far end of travel.
    lag_s : float, s
        Time constant between temperature and drift.
    detectable_um_per_K : float, um/K
        Detection limit here, with 80 % power.
    width_mm : float, mm
        Largest distance of a cell of the leading place from (x, y).
    area : Area or None
        The leading place: cells of a mode with at least half of its strength, cells that explain the drift as well as the strongest one;
        None for a region, which has an outline of its own.
    others_mm : tuple of (float, float), mm
        Other places (x, y) that explain the drift as well: these data cannot tell them from the leading one.
    """

    verdict: str
    kind: str
    name: str
    channel: str
    x_mm: float
    y_mm: float
    p_value: float
    sensitivity_um_per_K: float
    sensitivity_u_um_per_K: float
    lag_s: float
    detectable_um_per_K: float
    width_mm: float
    area: Area | None
    others_mm: tuple[tuple[float, float], ...]


def find_source(maps: xr.DataTree) -> LeadingSource:
    """Return the leading candidate of a session.

    Parameters
    ----------
    maps : DataTree
        Result of `fusion.attribution.attribute.correlate`.

    Returns
    -------
    LeadingSource
        The first of modes, cells and regions that passes, by its smallest p-value; where none passes, the candidate of smallest p-value
        of all.
    """
    sets = {name: kind for name, kind in _SETS if name == "cells" or name in maps.children}
    leaders = {name: _leader(maps, name) for name in sets}
    smallest = {name: float(leader["p_value"]) for name, leader in leaders.items()}
    passed = [name for name, p in smallest.items() if p <= LEVEL]
    chosen = passed[0] if passed else min(smallest, key=lambda name: smallest[name])
    best, kind = leaders[chosen], sets[chosen]
    x_mm, y_mm = float(best["x"]), float(best["y"])
    inside, others = _surroundings(maps, chosen, best)
    plan = maps.to_dataset()
    y, x = np.meshgrid(plan["y"].values, plan["x"].values, indexing="ij")
    return LeadingSource(
        verdict=str(maps.attrs["verdict"]),
        kind=kind,
        name="" if kind == "cell" else str(best[kind].values),
        channel=str(best["channel"].values),
        x_mm=x_mm,
        y_mm=y_mm,
        p_value=float(best["p_value"]),
        sensitivity_um_per_K=float(best["sensitivity"]),
        sensitivity_u_um_per_K=float(best["sensitivity_u"]),
        lag_s=float(best["lag"]),
        detectable_um_per_K=float(best["detectable_sensitivity"]),
        width_mm=float(np.hypot(x[inside] - x_mm, y[inside] - y_mm).max(initial=0.0)),
        area=area_of(inside, plan),
        others_mm=tuple(others),
    )


def _columns(maps: xr.DataTree, name: str) -> xr.Dataset:
    """Results of one set over channel and candidate, with the places of the candidates as x and y."""
    if name == "cells":
        return maps.to_dataset()[list(_QUANTITIES)].stack(candidate=("y", "x"))
    columns = maps.children[name].to_dataset()
    return columns[list(_QUANTITIES)].assign_coords(x=columns["at_x"], y=columns["at_y"])


def _leader(maps: xr.DataTree, name: str) -> xr.Dataset:
    """The candidate of smallest p-value; equal ones (the resolution of the draws) are ordered by statistic over threshold."""
    columns = _columns(maps, name)
    p_value = columns["p_value"].fillna(1.0).values
    ratio = (columns["statistic"] / columns["threshold"]).transpose(*columns["p_value"].dims).fillna(0.0).values
    place = np.lexsort((-ratio.ravel(), p_value.ravel()))[0]
    channel, column = np.unravel_index(int(place), p_value.shape)
    return columns.isel({"channel": channel, columns["p_value"].dims[1]: column})


def _surroundings(
    maps: xr.DataTree, name: str, best: xr.Dataset
) -> tuple[NDArray[np.bool_], list[tuple[float, float]]]:
    """Cells (y, x) of the leading place, and the other places (x, y in mm) that explain the drift as well."""
    channel, plan = best["channel"].values, maps.to_dataset()
    if name == "cells":
        statistic = np.nan_to_num(plan["statistic"].sel(channel=channel).values, nan=-np.inf)
        return _split(statistic, statistic >= statistic.max() - _EQUAL_RATIO, plan)
    columns = _columns(maps, name).sel(channel=channel)
    kind = dict(_SETS)[name]
    alike = (columns["statistic"] >= best["statistic"] - _EQUAL_RATIO).values & (columns[kind] != best[kind]).values
    others = [(float(x), float(y)) for x, y in zip(columns["x"].values[alike], columns["y"].values[alike], strict=True)]
    if name == "regions":
        return np.zeros((plan.sizes["y"], plan.sizes["x"]), bool), others
    modes = maps.children["modes"].to_dataset()
    pattern = np.abs(np.nan_to_num(modes["pattern"].sel(mode=int(best["mode"])).values))
    _, elsewhere = _split(pattern, pattern >= _PEAK, plan)
    inside, _ = _split(pattern, pattern >= IN_MODE, plan)
    return inside, [*elsewhere, *others]


def _split(
    strength: Array, equal: NDArray[np.bool_], plan: xr.Dataset
) -> tuple[NDArray[np.bool_], list[tuple[float, float]]]:
    """The connected piece of equal cells with the strongest one, and the strongest cell (x, y in mm) of every other piece."""
    labels, count = ndimage.label(equal, np.ones((3, 3)))
    row, column = np.unravel_index(int(strength.argmax()), strength.shape)
    leading = int(labels[row, column])
    others = []
    for label in range(1, count + 1):
        if label == leading:
            continue
        place = np.unravel_index(int(np.where(labels == label, strength, -np.inf).argmax()), strength.shape)
        others.append((float(plan["x"][place[1]]), float(plan["y"][place[0]])))
    return labels == leading, others


def recommend_measurement(maps: xr.DataTree, source: LeadingSource) -> str:
    """Say which measurement would decide what these data leave open.

    Parameters
    ----------
    maps : DataTree
        Result of `fusion.attribution.attribute.correlate`.
    source : LeadingSource
        Its leading candidate.

    Returns
    -------
    str
        Sentences with the detection limit, noise and drift of this session. Even an attributable source leaves open whether it is a
        cause, so that there is always a recommendation.
    """
    session = maps.to_dataset()
    common = session.sel(channel="common") if "common" in session["channel"].values else session.isel(channel=0)
    plan = (
        f"thermofuse plan --source NAME=TIME proposes when to switch each heat source at random; give it the noise and drift of this "
        f'session: --noise "{float(common["noise"]):.2g} um" --drift "{max(float(common["unexplained_drift"]), 0.01):.2g} um"'
    )
    if source.verdict == "not separable":
        return f"Switch the heat sources at random times instead of letting all of them warm up once. {plan}."
    if source.verdict == "not attributable":
        return (
            f"From {source.detectable_um_per_K:.2g} µm/K on, a source at the best place would have been found in four sessions of five. "
            f"For less: more cycles, or loads that switch more often. {plan}."
        )
    if source.others_mm:
        places = "; ".join(f"x {x:.0f} mm, y {y:.0f} mm" for x, y in source.others_mm[:4])
        return f"Other places explain the drift as well ({places}): switch the heat sources there separately. {plan}."
    return f"A second session that finds the same place, or randomised duty, would establish causation. {plan}."
