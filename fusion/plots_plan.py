"""L5 - Pictures of the table: the registered frame, the rise on the plan, the rise over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from fusion.plots import ACCENT, INK, MUTED, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HEAT_MAP = "inferno"


def plot_registration(fields: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Draw the reference frame with every located fiducial; the arrow is its leave-one-out error, 200 times enlarged."""
    ax = new_axes(ax)
    frame = fields["reference_frame"].values
    low, high = np.nanpercentile(frame, [1, 99])
    picture = ax.imshow(frame, cmap=HEAT_MAP, vmin=low, vmax=high, interpolation="nearest")
    ax.figure.colorbar(picture, ax=ax, label="temperature / °C", shrink=0.8, aspect=30).outline.set_visible(False)
    column, row = fields["fiducial_column"].values, fields["fiducial_row"].values
    ax.plot(column, row, "o", markersize=9, markerfacecolor="none", markeredgecolor="#7fe3ff", markeredgewidth=1.1)
    for name, x, y in zip(fields["fiducial"].values, column, row, strict=True):
        ax.annotate(str(name), (x, y), (5, 5), textcoords="offset points", color="#7fe3ff", fontsize=7.5)
    ax.set(xlabel="column / px", ylabel="row / px")
    ax.grid(visible=False)
    return ax


def plot_rise(fields: xr.Dataset, cycle: int, *, ax: Axes | None = None) -> Axes:
    """Draw the temperature rise of one cycle on the plan, in mm."""
    ax = new_axes(ax)
    rise = fields["temperature_rise"].sel(cycle=cycle)
    half = float(np.median(np.diff(fields["x"]))) / 2
    x, y = fields["x"].values, fields["y"].values
    extent = (x[0] - half, x[-1] + half, y[0] - half, y[-1] + half)
    picture = ax.imshow(rise, cmap=HEAT_MAP, origin="lower", extent=extent, interpolation="nearest")
    ax.figure.colorbar(picture, ax=ax, label="rise / K", orientation="horizontal", aspect=40).outline.set_visible(False)
    ax.set(xlabel="x / mm", ylabel="y / mm", title=f"cycle {cycle}")
    ax.grid(visible=False)
    return ax


def plot_rise_history(fields: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the rise of the table over the test: mean over the plan, with its coolest and hottest tenth."""
    ax = new_axes(ax)
    rise = fields["temperature_rise"]
    hours = (fields["cycle_time"] - fields["cycle_time"][0]) / np.timedelta64(1, "h")
    flat = rise.values.reshape(rise.sizes["cycle"], -1)
    low, high = np.nanpercentile(flat, [10, 90], axis=1)
    ax.fill_between(hours, low, high, color=ACCENT, alpha=0.15, linewidth=0, label="middle 80 % of the cells")
    ax.plot(hours, np.nanmean(flat, axis=1), color=ACCENT, label="mean of the table")
    ax.plot(hours, np.nanmax(flat, axis=1), color=INK, linewidth=0.8, label="warmest cell")
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="time since first cycle / h", ylabel="rise / K")
    ax.legend()
    return ax
