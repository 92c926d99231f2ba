"""L5 - ISO 230-2 windows along the test; the house style of every chart, which the paper's figures share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import xarray as xr

from interferometry.plotstyle import (
    ACCENT,
    ARROWS,
    COLOURS,
    GRID,
    INK,
    MARKERS,
    MUTED,
    STYLE,
    TIME_MAP,
    hours_since_start,
    new_axes,
    time_span,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "ACCENT",
    "ARROWS",
    "COLOURS",
    "GRID",
    "INK",
    "MARKERS",
    "MUTED",
    "STYLE",
    "TIME_MAP",
    "hours_since_start",
    "new_axes",
    "plot_windows",
    "time_span",
]


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
