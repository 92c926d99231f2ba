"""Charts of a record: measured and predicted displacements, residuals, contributions, temperatures and drivers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from interferometry.figures import ACCENT, INK, MUTED, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BEFORE, _AFTER = "#9aa7ad", "#0f5c6e"


def plot_prediction(record: xr.Dataset, channel: str, *, ax: Axes | None = None) -> Axes:
    """Plot one channel as measured and as predicted by the declared and by the final model; the hold-out is shaded.

    Parameters
    ----------
    record : Dataset
        fusion.nc of a record.
    channel : str
        Name of the channel.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    hours, selected = _hours(record), record.sel(channel=channel)
    _shade_hold_out(record, ax)
    ax.plot(hours, selected["predicted_declared"], color=_BEFORE, label="declared model")
    band = 2 * float(selected["predicted_u"])
    ax.fill_between(
        hours,
        selected["predicted_final"] - band,
        selected["predicted_final"] + band,
        color=_AFTER,
        alpha=0.15,
        linewidth=0,
    )
    ax.plot(hours, selected["predicted_final"], color=_AFTER, label="final model, 95 % band")
    ax.plot(hours, selected["displacement"], color=INK, linewidth=0.9, label="measured")
    ax.set(xlabel="time since start / h", ylabel="displacement / µm", title=channel)
    ax.legend()
    return ax


def plot_residuals(record: xr.Dataset, channel: str, *, ax: Axes | None = None) -> Axes:
    """Plot the residuals of both models in one channel over time.

    Parameters
    ----------
    record : Dataset
        fusion.nc of a record.
    channel : str
        Name of the channel.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    hours, selected = _hours(record), record.sel(channel=channel)
    _shade_hold_out(record, ax)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.plot(hours, selected["displacement"] - selected["predicted_declared"], color=_BEFORE, label="declared model")
    ax.plot(hours, selected["displacement"] - selected["predicted_final"], color=_AFTER, label="final model")
    ax.set(xlabel="time since start / h", ylabel="measured − predicted / µm", title=channel)
    ax.legend()
    return ax


def plot_temperatures(record: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the rise of every sensor since the first block.

    Parameters
    ----------
    record : Dataset
        fusion.nc of a record.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
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
    """Plot every driver as a share of its largest size.

    Parameters
    ----------
    record : Dataset
        fusion.nc of a record.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    for k, name in enumerate(str(driver) for driver in record["driver_name"].values):
        ax.plot(_hours(record), record["driver"].values[:, k], linewidth=1.0, label=name)
    ax.set(xlabel="time since start / h", ylabel="share of the largest value")
    ax.legend()
    return ax


def plot_contributions(record: xr.Dataset, channel: str, *, ax: Axes | None = None) -> Axes:
    """Plot what each term of the final model contributes to one channel, about its mean.

    Parameters
    ----------
    record : Dataset
        fusion.nc of a record.
    channel : str
        Name of the channel.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    _shade_hold_out(record, ax)
    for k, name in enumerate(str(effect) for effect in record["effect"].values):
        values = record["contribution"].sel(channel=channel).isel(effect=k)
        ax.plot(_hours(record), values, linewidth=1.1, label=name.replace("_", " "))
    ax.set(xlabel="time since start / h", ylabel="contribution / µm", title=channel)
    if record.sizes["effect"]:
        ax.legend()
    return ax


def _shade_hold_out(record: xr.Dataset, ax: Axes) -> None:
    """Shade the hold-out, every run that is held out by itself."""
    hours, sealed = _hours(record), record["sealed"].values
    run = record["run"].values if "run" in record else np.zeros(hours.size, int)
    for number in np.unique(run[sealed]):
        here = hours[sealed & (run == number)]
        ax.axvspan(float(here[0]), float(here[-1]), color=ACCENT, alpha=0.07, linewidth=0)


def _hours(record: xr.Dataset) -> np.ndarray:
    """Return the time of every block since the start of the record in hours; of several runs, the time between them left out."""
    if "elapsed" in record:
        return np.asarray(record["elapsed"].values / 3600.0)
    time = record["time"].values
    return np.asarray((time - time[0]) / np.timedelta64(1, "h"), float)
