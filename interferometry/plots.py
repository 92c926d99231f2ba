"""Plots of deviations, profile, drift and scatter, figures 6, 7 and 10 to 13 of the paper among them; and the colours of all charts.

Every ``plot_*`` takes what the readers and evaluations return, plots into given axes, or into those of a new figure, and returns the axes.
Figures are numbered as in the paper "Elimination of thermal drift in measuring the positioning accuracy of a three axis milling machine".
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from interferometry.common import InterferometryError, check_dataset
from interferometry.neighbours import build_chart, evaluate_conventional, evaluate_neighbours

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


def new_axes(ax: Axes | None) -> Axes:
    """Return the given axes, or those of a new figure in the common style."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    with plt.rc_context(STYLE):
        return plt.subplots(figsize=(6.2, 3.6))[1]


def hours_since_start(deviations: xr.Dataset) -> xr.DataArray:
    """Return the time of every reading in hours since the first one."""
    start, _ = time_span(deviations)
    hours: xr.DataArray = (deviations["time"] - start) / np.timedelta64(1, "h")
    return hours


def time_span(deviations: xr.Dataset) -> tuple[np.datetime64, np.datetime64]:
    """Return the times of the first and the last reading."""
    times = deviations["time"].values
    times = times[~np.isnat(times)]
    return times.min(), times.max()


def evaluate_common_start(deviations: xr.Dataset) -> xr.Dataset:
    """Shift all cycles to a common value at the first position: their spread is drift that was not eliminated."""
    first = int(np.argmin(deviations["position"].values))
    x = deviations["deviation"]
    start = x.isel(target=first, drop=True)
    shifted = (x - start + start.mean("cycle")).transpose(*x.dims)
    return xr.Dataset({"deviation": shifted.assign_attrs(units="um"), "position": deviations["position"]})


def plot_deviations(
    deviations: xr.Dataset, ax: Axes | None = None, *, direction: str = "positive", common_start: bool = False
) -> Axes:
    """Plot the deviations over the position, a line per cycle from the first (dark) to the last: figures 6 and 13.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um, as `read_deviations` returns them.
    ax : Axes, optional
        Where to plot; a new figure by default.
    direction : {"positive", "negative"}
        Direction of approach.
    common_start : bool
        Shift all cycles to a common value at the first position (figure 13) instead of showing them as measured (figure 6).

    Returns
    -------
    Axes

    Raises
    ------
    InterferometryError
        ``deviations`` lack a variable of their contract.

    Notes
    -----
    Source: "Elimination of thermal drift in measuring the positioning accuracy of a three axis milling machine", figures 6 and 13.

    Examples
    --------
    >>> from interferometry import read_deviations
    >>> ax = plot_deviations(read_deviations("laser.csv"))  # doctest: +SKIP
    """
    deviations = check_dataset(deviations, "deviations")
    ax = new_axes(ax)
    import matplotlib as mpl

    shown = evaluate_common_start(deviations) if common_start else deviations
    order = np.argsort(shown["position"].values)
    lines = shown["deviation"].sel(direction=direction).values[:, order]
    colours = mpl.colormaps[TIME_MAP](np.linspace(0.0, 0.95, len(lines)))
    for line, colour in zip(lines, colours, strict=True):
        ax.plot(shown["position"].values[order], line, color=colour, linewidth=0.6)
    _colour_bar(ax, shown["cycle"].values[[0, -1]], "cycle")
    ax.set(xlabel="position / mm", ylabel="deviation / µm", title=ARROWS[direction])
    return ax


def plot_position(
    deviations: xr.Dataset, estimated: xr.Dataset | None = None, ax: Axes | None = None, *, target: int = 4
) -> Axes:
    """Plot the deviation of one position over time, or over cycles where no reading has a time: figure 7.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um, as `read_deviations` returns them.
    estimated : xarray.Dataset, optional
        What `estimate_drift` returns for them: the expected reading, profile plus drift, is plotted with its 95 % band.
    ax : Axes, optional
        Where to plot; a new figure by default.
    target : int
        Number of the target.

    Returns
    -------
    Axes

    Raises
    ------
    InterferometryError
        There is no such target, or a Dataset lacks a variable of its contract.

    Notes
    -----
    Source: "Elimination of thermal drift in measuring the positioning accuracy of a three axis milling machine", figure 7.

    Examples
    --------
    >>> ax = plot_position(deviations, estimate_drift(deviations), target=3)  # doctest: +SKIP
    """
    deviations = check_dataset(deviations, "deviations")
    if target not in deviations["target"].values:
        raise InterferometryError(f"target={target} is not one of {deviations['target'].values.tolist()}")
    ax = new_axes(ax)
    history = deviations[["deviation", "time", "position"]].sel(target=target)
    along, label = _along_time(history)
    for direction in map(str, history["direction"].values):
        style: dict[str, Any] = {"color": COLOURS[direction]}
        x, read = along.sel(direction=direction), history["deviation"].sel(direction=direction)
        ax.plot(x, read, MARKERS[direction], markersize=2.6, label=ARROWS[direction], **style)
        if estimated is not None:
            here = estimated.sel(direction=direction, target=target)
            value, band = read - here["noise"], 2 * here["drift_u"]
            ax.plot(x, value, linewidth=1.0, **style)
            ax.fill_between(x, value - band, value + band, alpha=0.18, linewidth=0, **style)
    ax.set(xlabel=label, ylabel="deviation / µm", title=f"position {target} ({float(history['position']):g} mm)")
    ax.legend()
    return ax


def plot_profile(deviations: xr.Dataset, estimated: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Plot the profile of the axis, free of drift, with expanded uncertainties (k = 2).

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um, as `read_deviations` returns them.
    estimated : xarray.Dataset
        What `estimate_drift` returns for them.
    ax : Axes, optional
        Where to plot; a new figure by default.

    Returns
    -------
    Axes

    Raises
    ------
    InterferometryError
        A Dataset lacks a variable of its contract.

    Notes
    -----
    The joint estimate: docs/method/drift-estimation.md.

    Examples
    --------
    >>> ax = plot_profile(deviations, estimate_drift(deviations))  # doctest: +SKIP
    """
    deviations = check_dataset(deviations, "deviations")
    estimated = check_dataset(estimated, "estimated")
    ax = new_axes(ax)
    ordered = estimated.assign(position=deviations["position"]).sortby("position")
    for direction in map(str, ordered["direction"].values):
        row = ordered.sel(direction=direction)
        ax.errorbar(
            row["position"], row["profile"], 2 * row["profile_u"], fmt=f"{MARKERS[direction]}-", capsize=2,
            color=COLOURS[direction], label=ARROWS[direction],
        )  # fmt: skip
    ax.set(xlabel="position / mm", ylabel="profile / µm")
    ax.legend()
    return ax


def plot_drift(
    deviations: xr.Dataset, estimated: xr.Dataset, ax: Axes | None = None, *, direction: str = "positive"
) -> Axes:
    """Plot the drift of every position since the first cycle over time, from the first position (dark) to the last.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um, as `read_deviations` returns them.
    estimated : xarray.Dataset
        What `estimate_drift` returns for them.
    ax : Axes, optional
        Where to plot; a new figure by default.
    direction : {"positive", "negative"}
        Direction of approach.

    Returns
    -------
    Axes
        The 95 % band is drawn around the drift of the first and of the last position.

    Raises
    ------
    InterferometryError
        A Dataset lacks a variable of its contract.

    Notes
    -----
    The joint estimate: docs/method/drift-estimation.md.

    Examples
    --------
    >>> ax = plot_drift(deviations, estimate_drift(deviations))  # doctest: +SKIP
    """
    deviations = check_dataset(deviations, "deviations")
    estimated = check_dataset(estimated, "estimated")
    ax = new_axes(ax)
    import matplotlib as mpl

    ordered = estimated.assign(position=deviations["position"], time=deviations["time"]).sortby("position")
    along, label = _along_time(ordered)
    colours = mpl.colormaps[TIME_MAP](np.linspace(0.0, 0.95, ordered.sizes["target"]))
    ends = (0, ordered.sizes["target"] - 1)
    for k, colour in enumerate(colours):
        here = ordered.sel(direction=direction).isel(target=k)
        x = along.sel(direction=direction).isel(target=k)
        drift, band = here["drift_since_first"], 2 * here["drift_since_first_u"]
        ax.plot(x, drift, color=colour, linewidth=1.0)
        if k in ends:
            ax.fill_between(x, drift - band, drift + band, color=colour, alpha=0.18, linewidth=0)
    _colour_bar(ax, ordered["position"].values[[0, -1]], "position / mm")
    ax.set(xlabel=label, ylabel="drift / µm", title=ARROWS[direction])
    return ax


def plot_iso230(quoted: xr.Dataset, position: xr.DataArray, ax: Axes | None = None) -> Axes:
    """Plot the chart of ISO 230-2: mean deviation of each approach with its 2 s, um (arcsec), over the positions, mm (deg)."""
    axes, order = new_axes(ax), np.argsort(position.values, kind="stable")
    for direction in quoted["direction"].values:
        one = quoted.sel(direction=direction).isel(target=order)
        mean, spread = one["mean_unidirectional"].values, 2 * one["standard_deviation"].values
        if np.isfinite(mean).any():
            label = f"mean {ARROWS[direction]}{' ± 2 s' if np.isfinite(spread).any() else ''}"
            axes.errorbar(position.values[order], mean, spread, color=COLOURS[direction], capsize=3, label=label)
    unit = str(quoted["A"].attrs.get("units", "um")).replace("um", "µm")
    axes.set(xlabel=f"position / {position.attrs.get('units', 'mm')}", ylabel=f"deviation / {unit}")
    axes.legend(frameon=False)
    return axes


def plot_scatter(deviations: xr.Dataset, estimated: xr.Dataset | None = None, ax: Axes | None = None) -> Axes:
    """Plot the standard deviation of every position: conventional, of the differences of neighbours (figure 10), and free of drift.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um, as `read_deviations` returns them.
    estimated : xarray.Dataset, optional
        What `estimate_drift` returns for them: adds the scatter of the joint estimate.
    ax : Axes, optional
        Where to plot; a new figure by default.

    Returns
    -------
    Axes
        Root mean square of both directions. A difference belongs to two positions and stands between them, divided by sqrt 2.

    Raises
    ------
    InterferometryError
        A Dataset lacks a variable of its contract, or there are fewer than two targets.

    Notes
    -----
    Source: "Elimination of thermal drift in measuring the positioning accuracy of a three axis milling machine", figure 10.

    Examples
    --------
    >>> ax = plot_scatter(deviations, estimate_drift(deviations))  # doctest: +SKIP
    """
    links = evaluate_neighbours(deviations)
    ax = new_axes(ax)
    conventional = evaluate_conventional(deviations)["standard_deviation"]
    position = deviations["position"]
    along = np.sort(position.values)

    def rms(values: xr.DataArray) -> xr.DataArray:
        mean: xr.DataArray = (values**2).mean("direction") ** 0.5
        return mean

    ax.plot(along, rms(conventional.sortby(position)), "o-", color=MUTED, label="conventional, over all cycles")
    between = (along[1:] + along[:-1]) / 2
    differenced = rms(links["position_standard_deviation"])
    ax.plot(between, differenced, "s-", color=COLOURS["negative"], label="neighbour differences, divided by √2")
    if estimated is not None:
        estimated = check_dataset(estimated, "estimated")
        free = estimated["scatter_position"].sortby(position)
        ax.plot(along, free, "d-", color=COLOURS["positive"], label="joint estimate, free of drift")
    ax.set(xlabel="position / mm", ylabel="standard deviation / µm", ylim=(0, None))
    ax.legend()
    return ax


def plot_differences(deviations: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Plot the mean differences of neighbouring positions with 95 % intervals: figure 11.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um, as `read_deviations` returns them.
    ax : Axes, optional
        Where to plot; a new figure by default.

    Returns
    -------
    Axes

    Raises
    ------
    InterferometryError
        ``deviations`` lack a variable of their contract, or hold fewer than two targets.

    Notes
    -----
    Source: "Elimination of thermal drift in measuring the positioning accuracy of a three axis milling machine", figure 11.

    Examples
    --------
    >>> ax = plot_differences(read_deviations("laser.csv"))  # doctest: +SKIP
    """
    links = evaluate_neighbours(deviations)
    ax = new_axes(ax)
    for shift, direction in zip((-0.12, 0.12), map(str, links["direction"].values), strict=False):
        row = links.sel(direction=direction)
        ax.errorbar(
            row["link"] + shift, row["mean_difference"], 2 * row["mean_difference_u"], fmt=MARKERS[direction],
            color=COLOURS[direction], capsize=2, linewidth=1.0, label=ARROWS[direction],
        )  # fmt: skip
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="position i", ylabel="mean difference to position i - 1 / µm")
    ax.legend()
    return ax


def plot_reference_chart(
    deviations: xr.Dataset, ax: Axes | None = None, *, reference: str = "time", border: str = "border_s"
) -> Axes:
    """Plot the deviation chart from a reference value at position 1, with borders: figure 12.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um, as `read_deviations` returns them.
    ax : Axes, optional
        Where to plot; a new figure by default.
    reference : {"time", "first_cycle"}
        Cycle whose reading at position 1 the chart starts from: the first one after two hours, or the first of all.
    border : {"border_s", "border_u"}
        Two standard deviations of the differences, or two standard uncertainties of their means.

    Returns
    -------
    Axes

    Raises
    ------
    InterferometryError
        ``deviations`` lack a variable of their contract, or ``reference`` is unknown.

    Notes
    -----
    Source: "Elimination of thermal drift in measuring the positioning accuracy of a three axis milling machine", figure 12.

    Examples
    --------
    >>> ax = plot_reference_chart(read_deviations("laser.csv"))  # doctest: +SKIP
    """
    chart = build_chart(deviations, reference=reference)
    chart = chart.assign(position=deviations["position"].sel(target=chart["target"]))
    ax = new_axes(ax)
    what = {"border_u": "±2 u of the mean difference, equation (6)", "border_s": "±2 s of the differences"}[border]
    for direction in map(str, chart["direction"].values):
        row, colour = chart.sel(direction=direction), COLOURS[direction]
        ax.plot(row["position"], row["chart"], MARKERS[direction], ls="-", color=colour, label=ARROWS[direction])
        for sign in (-1, 1):
            ax.plot(row["position"], row["chart"] + sign * row[border], "--", color=colour, linewidth=0.8)
    ax.set(xlabel="position / mm", ylabel="deviation / µm")
    ax.legend(title=f"dashed: {what}", title_fontsize=8)
    return ax


def _along_time(dataset: xr.Dataset) -> tuple[xr.DataArray, str]:
    """Return the hours since the first reading with their label, or the cycles where no reading has a time."""
    if bool(dataset["time"].notnull().any()):
        return hours_since_start(dataset), "time since first reading / h"
    return dataset["cycle"].broadcast_like(dataset["time"]), "cycle"


def _colour_bar(ax: Axes, limits: NDArray[Any], label: str) -> None:
    """Add the scale of lines that are coloured from dark to light."""
    import matplotlib as mpl

    scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(*limits), TIME_MAP)
    ax.figure.colorbar(scale, ax=ax, label=label, pad=0.02, aspect=30).outline.set_visible(False)
