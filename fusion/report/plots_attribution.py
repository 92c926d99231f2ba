"""Maps and charts of the correlation: sensitivity and significance of cells, thermal modes, clusters, regions by target."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from fusion.attribution.family_wise import CHECKS, LEVEL
from fusion.report.wording import duration, number, p_value
from interferometry.figures import ARROWS, COLOURS, INK, MARKERS, MUTED, STYLE, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Parts of the drift as the correlation names them, in plain words.
CHANNELS = {
    "common": "drift common to all positions",
    "proportional": "drift that grows with position",
    "reversal": "drift of the reversal",
    "joint": "common and growing drift together",
}


def _extent_of(maps: xr.Dataset) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of the plan's cells in mm."""
    x, y = maps["x"].values, maps["y"].values
    half = float(np.median(np.diff(x))) / 2
    return float(x[0] - half), float(x[-1] + half), float(y[0] - half), float(y[-1] + half)


def plot_cells(maps: xr.Dataset, name: str, channel: str, *, label: str, ax: Axes | None = None) -> Axes:
    """Draw a map over the plan cells of one channel; cells with a family-wise p up to 0.05 are outlined.

    A sensitivity is shown in full colour, with its scale, in those cells; elsewhere it is mostly noise and pale.

    Parameters
    ----------
    maps : Dataset
        Group ``correlation`` of fusion.nc.
    name : str
        Variable (channel, y, x) to draw.
    channel : str
        Part of the drift.
    label : str
        Label of the colour scale, with unit.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax, height=2.55)
    chosen = maps.sel(channel=channel)
    values, p = chosen[name].values, chosen["p_value"].fillna(1.0).values
    passed = p <= LEVEL
    if name == "p_value":
        colours: dict[str, Any] = {"cmap": "viridis_r", "vmin": 0.0, "vmax": 1.0}
    else:
        limit = (
            float(np.nanmax(np.abs(values[passed]))) if passed.any() else float(np.nanpercentile(np.abs(values), 90))
        )
        colours = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    if passed.any() and name != "p_value":
        colours["alpha"] = np.where(passed, 1.0, 0.25)
    picture = ax.imshow(values, origin="lower", extent=_extent_of(maps), interpolation="nearest", **colours)
    ax.figure.colorbar(picture, ax=ax, label=label, orientation="horizontal", aspect=40).outline.set_visible(False)
    if passed.any():
        ax.contour(maps["x"], maps["y"], passed.astype(float), levels=[0.5], colors=[INK], linewidths=1.2)
    ax.set(xlabel="x / mm", ylabel="y / mm", title=CHANNELS.get(channel, channel))
    ax.grid(visible=False)
    return ax


def plot_modes(modes: xr.Dataset, channel: str) -> Axes:
    """Draw the pattern of every thermal mode with its p value and lag in one channel; significant ones have a bold frame.

    Parameters
    ----------
    modes : Dataset
        Group ``correlation/modes`` of fusion.nc.
    channel : str
        Part of the drift whose p-values and lags are written.
    """
    import matplotlib.pyplot as plt

    numbers = modes["mode"].values
    columns = min(2, numbers.size)
    rows = -(-numbers.size // columns)
    left, right, bottom, top = _extent_of(modes)
    height = 0.5 + 5.2 / columns * min((top - bottom) / (right - left), 1.2)
    with plt.rc_context(STYLE):
        _, axes = plt.subplots(rows, columns, figsize=(5.2, rows * height), squeeze=False, sharex=True, sharey=True)
    for ax in axes.ravel()[numbers.size :]:
        ax.set_visible(False)
    for ax, mode in zip(axes.ravel(), numbers, strict=False):
        selected = {"mode": mode, "channel": channel}
        p = float(modes["p_value"].sel(selected))
        ax.imshow(
            modes["pattern"].sel(mode=mode), origin="lower", extent=_extent_of(modes), interpolation="nearest",
            cmap="PuOr_r", vmin=-1.0, vmax=1.0,
        )  # fmt: skip
        ax.plot(float(modes["at_x"].sel(mode=mode)), float(modes["at_y"].sel(mode=mode)), "+", color="white")
        text = f"mode {mode}: p {p_value(p)}, lag {duration(float(modes['lag'].sel(selected)))}"
        ax.set_title(text, fontsize=8.5, fontweight="bold" if p <= LEVEL else "normal")
        ax.grid(visible=False)
        for spine in ax.spines.values():
            spine.set(visible=True, linewidth=1.8 if p <= LEVEL else 0.5, color=INK if p <= LEVEL else MUTED)
    first: Axes = axes[0, 0]
    return first


def plot_clusters(clusters: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Draw groups of cells with one course of temperature; inside a group no analysis of this session can separate places.

    Parameters
    ----------
    clusters : Dataset
        Group ``correlation/clusters`` of fusion.nc.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    import matplotlib as mpl

    ax = new_axes(ax, height=2.2)
    cluster = clusters["cluster"].values
    count = int(cluster.max())
    shown = np.ma.masked_equal(cluster, 0)
    ax.imshow(
        shown,
        origin="lower",
        extent=_extent_of(clusters),
        interpolation="nearest",
        cmap=mpl.colormaps["tab20"],
        vmin=0.5,
        vmax=20.5,
    )
    for label in range(1, count + 1):
        row, column = np.nonzero(cluster == label)
        middle = np.argmin((row - row.mean()) ** 2 + (column - column.mean()) ** 2)
        x, y = float(clusters["x"][column[middle]]), float(clusters["y"][row[middle]])
        ax.text(x, y, str(label), ha="center", va="center", fontsize=8, color=INK)
    ax.set(xlabel="x / mm", ylabel="y / mm")
    ax.grid(visible=False)
    return ax


def plot_region_targets(targets: xr.Dataset, region: str, position: xr.DataArray, *, ax: Axes | None = None) -> Axes:
    """Plot the sensitivity of every target and direction to one region, each by itself, with 95 % interval; filled where p <= 0.05.

    Parameters
    ----------
    targets : Dataset
        Group ``correlation/target_regions`` of fusion.nc.
    region : str
        Name of the region.
    position : (target,) DataArray
        Target positions, mm.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    selected = targets.sel(region=region)
    sides, targets_of = selected["series_direction"].values, selected["series_target"].values
    place = {int(target): float(mm) for target, mm in zip(position["target"].values, position.values, strict=True)}
    step = float(np.median(np.diff(np.sort(position.values)))) if position.size > 1 else 1.0
    for shift, direction in ((-0.1, "positive"), (0.1, "negative")):
        rows = np.flatnonzero(sides == direction)
        if not rows.size:
            continue
        x = np.array([place[int(number)] for number in targets_of[rows]]) + shift * step
        value, u = selected["sensitivity"].values[rows], selected["sensitivity_u"].values[rows]
        passed = selected["p_value"].values[rows] <= LEVEL
        colour = COLOURS[direction]
        ax.errorbar(x, value, 2 * u, fmt="none", ecolor=colour, capsize=2, linewidth=0.9)
        ax.plot(x, value, MARKERS[direction], color=colour, markerfacecolor="white", label=ARROWS[direction])
        ax.plot(x[passed], value[passed], MARKERS[direction], color=colour)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="position / mm", ylabel="sensitivity / (µm/K)", title=region)
    ax.legend()
    return ax


def caption_of(maps: xr.DataTree, channel: str, name: str = "") -> str:
    """Return the caption of a map: rate of false alarms, unexplained drift, detection limit, groups of collinear cells.

    Parameters
    ----------
    maps : DataTree
        Result of `fusion.attribution.attribute.correlate`.
    channel : str
        Part of the drift.
    name : str
        ``modes`` or ``regions``; empty for the map of cells.
    """
    session = maps.to_dataset()
    tested = maps.children[name].to_dataset() if name else session
    rate = float(tested["false_alarm_rate" if name else "cells_false_alarm_rate"])
    detectable = tested["detectable_sensitivity"].sel(channel=channel)
    smallest = float(detectable.where(np.isfinite(detectable)).median())
    courses = int(maps.children["clusters"].to_dataset()["cluster"].max())
    drift = float(session["unexplained_drift"].sel(channel=channel))
    return (
        f"False alarms of this map, in simulations without a source: {rate_text(rate)}. Unexplained drift: "
        f"{number(drift, 2)} µm in one hour. Detection limit at 80 % power: {number(smallest, 2)} µm/K (median over the map). "
        f"The field shows {courses} courses of temperature; places that share one cannot be told apart."
    )


def rate_text(rate: float, checks: int = CHECKS) -> str:
    """Return a measured rate of false alarms in per cent with its expanded uncertainty (k = 2).

    Parameters
    ----------
    rate : float
        Share of simulations with a false alarm, 0 to 1.
    checks : int
        Number of simulations; the uncertainty is that of a binomial share.
    """
    u = np.sqrt(max(rate, 1.0 / checks) * (1.0 - rate) / checks)
    return f"{100 * rate:.1f} ± {200 * u:.1f} %"
