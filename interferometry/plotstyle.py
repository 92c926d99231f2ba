"""L5 - What all charts have in common: colours and markers of the two approaches, fonts, the clock of the horizontal axis."""

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
