"""Charts of the table: the registered frame with its fiducials, and the rise over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from interferometry.figures import ACCENT, INK, MUTED, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HEAT_MAP = "inferno"


def _on_plan(fields: xr.Dataset, shape: tuple[int, int]) -> np.ndarray:
    """Return which pixels of a frame show the plan, (row, column) bool; without lens distortion, as it only sets a colour scale."""
    row, column = np.indices(shape)
    x, y, scale = np.einsum("ij,jrc->irc", fields["homography"].values, np.stack([column, row, np.ones(shape)]))
    half = float(np.median(np.diff(fields["x"]))) / 2
    (left, right), (bottom, top) = (
        (fields[name].values[0] - half, fields[name].values[-1] + half) for name in ("x", "y")
    )
    return (x / scale > left) & (x / scale < right) & (y / scale > bottom) & (y / scale < top)


def plot_registration(fields: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Draw the reference frame, in sensor pixels, with every located fiducial.

    Parameters
    ----------
    fields : Dataset
        Content of fields.nc.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    frame = fields["reference_frame"].values
    low, high = np.nanpercentile(frame[_on_plan(fields, frame.shape)], [1, 99])
    picture = ax.imshow(frame, cmap=HEAT_MAP, vmin=low, vmax=high, interpolation="nearest")
    ax.figure.colorbar(picture, ax=ax, label="temperature / °C", shrink=0.8, aspect=30).outline.set_visible(False)
    column, row = fields["fiducial_column"].values, fields["fiducial_row"].values
    ax.plot(column, row, "o", markersize=9, markerfacecolor="none", markeredgecolor="#7fe3ff", markeredgewidth=1.1)
    label = {"boxstyle": "round,pad=0.15", "facecolor": INK, "edgecolor": "none", "alpha": 0.75}
    for name, x, y in zip(fields["fiducial_name"].values, column, row, strict=True):
        ax.annotate(str(name), (x, y), (7, 4), textcoords="offset points", color="white", fontsize=7, bbox=label)
    ax.set(xlabel="column / px", ylabel="row / px")
    ax.grid(visible=False)
    return ax


def plot_rise_history(fields: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the rise of the table over the test: mean over the plan, with its coolest and hottest tenth; a cycle without a field is a gap.

    Parameters
    ----------
    fields : Dataset
        Content of fields.nc.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    rise = fields["temperature_rise"]
    hours = (fields["cycle_time"] - fields["cycle_time"][0]) / np.timedelta64(1, "h")
    flat = rise.values.reshape(rise.sizes["cycle"], -1)
    low, high, mean, most = np.full((4, len(flat)), np.nan)
    shown = np.isfinite(flat).any(axis=1)
    low[shown], high[shown] = np.nanpercentile(flat[shown], [10, 90], axis=1)
    mean[shown], most[shown] = np.nanmean(flat[shown], axis=1), np.nanmax(flat[shown], axis=1)
    ax.fill_between(hours, low, high, color=ACCENT, alpha=0.15, linewidth=0, label="middle 80 % of the cells")
    ax.plot(hours, mean, color=ACCENT, label="mean of the table")
    ax.plot(hours, most, color=INK, linewidth=0.8, label="warmest cell")
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="time since first cycle / h", ylabel="rise / K")
    ax.legend()
    return ax
