"""L5 - The paper's charts: deviations over positions and cycles, neighbour differences, deviation charts, ISO 230-2 windows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: One colour per approach, also told apart by marker, dark enough for print.
COLOURS = {"positive": "#0f5c6e", "negative": "#b4501e"}
MARKERS = {"positive": ">", "negative": "<"}
ARROWS = {"positive": "positive approach", "negative": "negative approach"}
INK, MUTED, GRID, ACCENT = "#1f2a30", "#5c6b73", "#d9dfe2", "#8a1c4a"
TIME_MAP = "cividis"
STYLE: Any = {
    "font.size": 9.5, "axes.titlesize": 10.0, "axes.titleweight": "bold", "axes.titlelocation": "left", "axes.labelsize": 9.5,
    "xtick.labelsize": 8.5, "ytick.labelsize": 8.5, "legend.fontsize": 8.5, "legend.frameon": False,
    "axes.edgecolor": MUTED, "axes.labelcolor": INK, "text.color": INK, "xtick.color": MUTED, "ytick.color": MUTED,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.color": GRID, "grid.linewidth": 0.6,
    "axes.axisbelow": True, "lines.linewidth": 1.3, "lines.markersize": 4.0, "svg.fonttype": "none", "svg.hashsalt": "thermofuse",
    "figure.constrained_layout.use": True, "savefig.transparent": True,
}  # fmt: skip


def new_axes(ax: Axes | None, *, height: float = 3.4) -> Axes:
    """Return `ax`, or the axes of a new figure in the house style, `height` inches high."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    with plt.rc_context(STYLE):
        return plt.subplots(figsize=(5.2, height))[1]


def plot_deviations(
    deviations: xr.Dataset, direction: str, *, common_start: bool = False, ax: Axes | None = None
) -> Axes:
    """Plot the deviation of every cycle over position, one line per cycle from first (dark) to last (light).

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.
    direction : {"positive", "negative"}
    common_start : bool
        Shift every cycle to its own reading at position 1 (fig. 13 of the paper); else as measured (fig. 6).
    """
    import matplotlib as mpl

    ax = new_axes(ax)
    order = np.argsort(deviations["position"].values)
    position = deviations["position"].values[order]
    lines = deviations["deviation"].sel(direction=direction).values[:, order]
    if common_start:
        lines = lines - lines[:, :1]
    colours = mpl.colormaps[TIME_MAP](np.linspace(0.0, 0.95, len(lines)))
    for line, colour in zip(lines, colours, strict=True):
        ax.plot(position, line, color=colour, linewidth=0.6)
    scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(*deviations["cycle"].values[[0, -1]]), TIME_MAP)
    ax.figure.colorbar(scale, ax=ax, label="cycle", pad=0.02, aspect=30).outline.set_visible(False)
    ax.set(xlabel="position / mm", ylabel="deviation / µm", title=ARROWS[direction])
    return ax


def plot_position_history(
    deviations: xr.Dataset, target: int, *, drift: xr.Dataset | None = None, ax: Axes | None = None
) -> Axes:
    """Plot the readings at one target over time, with the estimated drift and its 95 % band where given (fig. 7)."""
    ax = new_axes(ax)
    hours = hours_since_start(deviations)
    for direction in deviations["direction"].values:
        at = {"direction": direction, "target": target}
        ax.plot(
            hours.sel(at), deviations["deviation"].sel(at), MARKERS[direction], color=COLOURS[direction], markersize=2.6,
            label=ARROWS[direction],
        )  # fmt: skip
        if drift is not None:
            value, band = (deviations["deviation"] - drift["noise"]).sel(at), 2 * drift["drift_u"].sel(at)
            ax.plot(hours.sel(at), value, color=COLOURS[direction], linewidth=1.0)
            ax.fill_between(
                hours.sel(at), value - band, value + band, color=COLOURS[direction], alpha=0.18, linewidth=0
            )
    position = float(deviations["position"].sel(target=target))
    ax.set(xlabel="time since first reading / h", ylabel="deviation / µm", title=f"position {target} ({position:g} mm)")
    ax.legend()
    return ax


def hours_since_start(deviations: xr.Dataset) -> xr.DataArray:
    """Return the time of every reading in hours since the first one, NaN where there is none."""
    start, _ = time_span(deviations)
    hours: xr.DataArray = (deviations["time"] - start) / np.timedelta64(1, "h")
    return hours


def time_span(deviations: xr.Dataset) -> tuple[np.datetime64, np.datetime64]:
    """Return the times of the first and the last reading."""
    known = deviations["time"].values
    known = known[~np.isnat(known)]
    return known.min(), known.max()


def plot_scatter(comparison: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the standard deviation of neighbour differences beside the conventional one, per position (fig. 10)."""
    ax = new_axes(ax)
    for direction in comparison["direction"].values:
        row = comparison.sel(direction=direction)
        style: dict[str, Any] = {"color": COLOURS[direction], "marker": MARKERS[direction]}
        ax.plot(row["link"], row["differenced"], label=f"differences, {ARROWS[direction]}", **style)
        ax.plot(
            row["link"],
            row["conventional"],
            linestyle=":",
            alpha=0.7,
            label=f"conventional, {ARROWS[direction]}",
            **style,
        )
    ax.set(xlabel="position i", ylabel="standard deviation / µm", yscale="log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("{x:g}")
    ax.tick_params(axis="y", which="minor", labelsize=7.5)
    ax.legend(fontsize=7.5)
    return ax


def plot_mean_differences(neighbours: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the mean difference of neighbouring positions with its 95 % interval (fig. 11)."""
    ax = new_axes(ax)
    for shift, direction in zip((-0.12, 0.12), neighbours["direction"].values, strict=False):
        row = neighbours.sel(direction=direction)
        ax.errorbar(
            row["link"] + shift, row["mean_difference"], 2 * row["mean_difference_u"], fmt=MARKERS[direction],
            color=COLOURS[direction], capsize=2, linewidth=1.0, label=ARROWS[direction],
        )  # fmt: skip
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="position i", ylabel="mean difference to position i - 1 / µm")
    ax.legend()
    return ax


def plot_chart(chart: xr.Dataset, position: xr.DataArray, *, ax: Axes | None = None) -> Axes:
    """Plot the deviation chart from the reference at position 1 with its borders of two standard deviations (fig. 12)."""
    ax = new_axes(ax)
    place = position.sel(target=chart["target"])
    for direction in chart["direction"].values:
        row = chart.sel(direction=direction)
        ax.plot(
            place, row["chart"], MARKERS[direction], linestyle="-", color=COLOURS[direction], label=ARROWS[direction]
        )
        for sign in (-1, 1):
            ax.plot(place, row["chart"] + sign * row["border_s"], "--", color=COLOURS[direction], linewidth=0.8)
    ax.set(xlabel="position / mm", ylabel="deviation / µm")
    ax.legend(title="dashed: ±2 s of the differences", title_fontsize=8)
    return ax


def plot_windows(windows: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot accuracy A and repeatability R of five-cycle windows along the test; the last entry is the whole test."""
    ax = new_axes(ax)
    short, whole = windows.isel(window=slice(None, -1)), windows.isel(window=-1)
    for name, colour, text in (("A", INK, "accuracy A"), ("R", ACCENT, "repeatability R"), ("B", MUTED, "reversal B")):
        ax.errorbar(
            short["middle_cycle"], short[name], 2 * short[f"{name}_u"], fmt="o-", color=colour, markersize=3, capsize=1.5,
            linewidth=1.0, label=f"{text}, windows",
        )  # fmt: skip
        ax.axhline(float(whole[name]), color=colour, linestyle=":", linewidth=1.0)
    ax.set(xlabel="middle cycle of the window", ylabel="µm", ylim=(0, None))
    ax.legend(title="dotted: all cycles as one window", title_fontsize=8)
    return ax
