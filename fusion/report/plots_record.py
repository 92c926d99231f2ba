"""Charts of a record: what was measured, what the model predicts of the part it has not seen, what is left."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from interferometry.figures import ACCENT, INK, MUTED, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BEFORE, AFTER = "#9aa7ad", "#0f5c6e"


def plot_prediction(record: xr.Dataset, channel: str, *, ax: Axes | None = None) -> Axes:
    """Plot one channel as measured and as predicted by the declared and by the final model; the sealed part is shaded."""
    ax = new_axes(ax)
    hours, one = _hours(record), record.sel(channel=channel)
    shade_sealed(record, ax)
    ax.plot(hours, one["predicted_declared"], color=BEFORE, label="declared model")
    band = 2 * float(one["predicted_u"])
    ax.fill_between(
        hours, one["predicted_final"] - band, one["predicted_final"] + band, color=AFTER, alpha=0.15, linewidth=0
    )
    ax.plot(hours, one["predicted_final"], color=AFTER, label="final model, 95 % band")
    ax.plot(hours, one["displacement"], color=INK, linewidth=0.9, label="measured")
    ax.set(xlabel="time since start / h", ylabel="displacement / µm", title=channel)
    ax.legend()
    return ax


def plot_residuals(record: xr.Dataset, channel: str, *, ax: Axes | None = None) -> Axes:
    """Plot what both models leave of one channel over time."""
    ax = new_axes(ax)
    hours, one = _hours(record), record.sel(channel=channel)
    shade_sealed(record, ax)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.plot(hours, one["displacement"] - one["predicted_declared"], color=BEFORE, label="declared model")
    ax.plot(hours, one["displacement"] - one["predicted_final"], color=AFTER, label="final model")
    ax.set(xlabel="time since start / h", ylabel="measured − predicted / µm", title=channel)
    ax.legend()
    return ax


def plot_temperatures(record: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the rise of every sensor since the first block."""
    import matplotlib as mpl

    ax = new_axes(ax)
    rise = record["temperature"] - record["temperature"].isel(time=0)
    names = [str(name) for name in record["sensor"].values]
    order = np.argsort(-np.ptp(rise.values, axis=0))
    colours = mpl.colormaps["cividis"](np.linspace(0.0, 0.95, len(names)))
    for colour, k in zip(colours, order, strict=True):
        # Only the sensors that move most are named: a legend of dozens hides the chart.
        label = names[k] if np.flatnonzero(order == k)[0] < 4 else None
        ax.plot(_hours(record), rise.values[:, k], color=colour, linewidth=0.8, label=label)
    ax.set(xlabel="time since start / h", ylabel="rise / K")
    ax.legend()
    return ax


def plot_drivers(record: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot every driver as a share of its largest size."""
    ax = new_axes(ax)
    for k, name in enumerate(str(one) for one in record["driver_name"].values):
        ax.plot(_hours(record), record["driver"].values[:, k], linewidth=1.0, label=name)
    ax.set(xlabel="time since start / h", ylabel="share of the largest value")
    ax.legend()
    return ax


def plot_contributions(record: xr.Dataset, channel: str, *, ax: Axes | None = None) -> Axes:
    """Plot what each term of the final model contributes to one channel, about its mean."""
    ax = new_axes(ax)
    shade_sealed(record, ax)
    for k, name in enumerate(str(one) for one in record["effect"].values):
        values = record["contribution"].sel(channel=channel).isel(effect=k)
        ax.plot(_hours(record), values, linewidth=1.1, label=name.replace("_", " "))
    ax.set(xlabel="time since start / h", ylabel="contribution / µm", title=channel)
    if record.sizes["effect"]:
        ax.legend()
    return ax


def shade_sealed(record: xr.Dataset, ax: Axes) -> None:
    """Shade the part of the time that the model has not seen."""
    sealed = _hours(record)[record["sealed"].values]
    if sealed.size:
        ax.axvspan(float(sealed[0]), float(sealed[-1]), color=ACCENT, alpha=0.07, linewidth=0)


def _hours(record: xr.Dataset) -> np.ndarray:
    """Return the time of every block since the start of the record in hours."""
    time = record["time"].values
    return np.asarray((time - time[0]) / np.timedelta64(1, "h"), float)
