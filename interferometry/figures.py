"""Figures 1, 2, 6, 7 and 10 to 13 of the paper, and the style that all charts share.

Every ``evaluate_*`` returns the numbers of a figure as a Dataset; every ``plot_*`` draws such a Dataset into given axes, or into those
of a new figure, and returns the axes. Figures and equations are numbered as in the paper "Elimination of thermal drift in measuring
the positioning accuracy of a three axis milling machine".
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from interferometry.errors import InterferometryError
from interferometry.neighbours import build_chart, evaluate_neighbours, simulate_derived_sequence

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
    """Return the given axes, or those of a new figure in the common style.

    Parameters
    ----------
    ax : matplotlib.axes.Axes or None
    height : float
        Of a new figure, inches.

    Returns
    -------
    matplotlib.axes.Axes
    """
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    with plt.rc_context(STYLE):
        return plt.subplots(figsize=(5.2, height))[1]


def hours_since_start(deviations: xr.Dataset) -> xr.DataArray:
    """Return the time of every reading in hours since the first one.

    Parameters
    ----------
    deviations : xarray.Dataset
        With ``time`` (UTC).

    Returns
    -------
    xarray.DataArray
        h, with the dims of ``time``; NaN where there is none.
    """
    start, _ = time_span(deviations)
    hours: xr.DataArray = (deviations["time"] - start) / np.timedelta64(1, "h")
    return hours


def time_span(deviations: xr.Dataset) -> tuple[np.datetime64, np.datetime64]:
    """Return the times of the first and the last reading.

    Parameters
    ----------
    deviations : xarray.Dataset
        With ``time`` (UTC).

    Returns
    -------
    (numpy.datetime64, numpy.datetime64)
        UTC.
    """
    times = deviations["time"].values
    times = times[~np.isnat(times)]
    return times.min(), times.max()


def evaluate_distributions(*, samples: int = 1000, bins: int = 30, seed: int = 0) -> xr.Dataset:
    """Figure 1: densities of a normal sequence and of the differences of its successive values.

    Parameters
    ----------
    samples : int
        Length of the sequence.
    bins : int
        Of the histogram, from -5 to 5.
    seed : int
        Of the random generator.

    Returns
    -------
    xarray.Dataset
        ``source`` and ``derived`` density over ``value``, in units of the standard deviation of the source; ``ratio`` of the standard
        deviations (1).
    """
    sequence = simulate_derived_sequence(samples, np.random.default_rng(seed))
    edges = np.linspace(-5, 5, bins + 1)
    source, _ = np.histogram(sequence["source"].values, edges, density=True)
    derived, _ = np.histogram(sequence["derived"].values, edges, density=True)
    return xr.Dataset(
        {"source": (("value",), source), "derived": (("value",), derived), "ratio": sequence["ratio"]},
        coords={"value": (edges[1:] + edges[:-1]) / 2},
    )


def plot_distributions(densities: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw figure 1.

    Parameters
    ----------
    densities : xarray.Dataset
        What `evaluate_distributions` returns.
    ax : matplotlib.axes.Axes, optional
        None: those of a new figure.

    Returns
    -------
    matplotlib.axes.Axes
    """
    ax = new_axes(ax)
    for name, label in (("source", "source sequence a"), ("derived", "derived sequence b = a(n) - a(n+1)")):
        ax.step(densities["value"].values, densities[name].values, where="mid", label=label)
    ax.set(xlabel="value / standard deviation of a", ylabel="density")
    ax.set_title(f"ratio of standard deviations {float(densities['ratio']):.4f} (sqrt 2 = 1.4142)")
    ax.legend()
    return ax


def evaluate_best_estimate(deviations: xr.Dataset, *, link: int = 2) -> xr.Dataset:
    """Figure 2: best estimate of a position, the first cycle's deviation of its neighbour minus the mean difference of the two.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.
    link : int
        Number of the target of the pair that lies further along the axis.

    Returns
    -------
    xarray.Dataset
        In um: ``nearer`` and ``further`` deviations of the pair and their ``difference`` (cycle, direction); ``mean_difference`` and
        ``estimate`` (direction).

    Raises
    ------
    InterferometryError
        There is no such target, or none before it.
    """
    links = evaluate_neighbours(deviations)
    numbers = links["link"].values.tolist()
    if link not in numbers:
        raise InterferometryError(f"link={link} is not one of {numbers}")
    along = deviations["target"].values[np.argsort(deviations["position"].values, kind="stable")].tolist()
    near = deviations["deviation"].sel(target=along[along.index(link) - 1]).drop_vars("target")
    far = deviations["deviation"].sel(target=link).drop_vars("target")
    mean = links["mean_difference"].sel(link=link).drop_vars("link")
    estimate = near.isel(cycle=0).drop_vars("cycle") - mean
    return xr.Dataset(
        {"nearer": near, "further": far, "difference": near - far, "mean_difference": mean, "estimate": estimate}
    )


def plot_best_estimate(pair: xr.Dataset, ax: Axes | None = None, *, direction: str = "positive") -> Axes:
    """Draw figure 2 for one direction.

    Parameters
    ----------
    pair : xarray.Dataset
        What `evaluate_best_estimate` returns.
    ax : matplotlib.axes.Axes, optional
        None: those of a new figure.
    direction : {"positive", "negative"}

    Returns
    -------
    matplotlib.axes.Axes
    """
    ax = new_axes(ax)
    pair = pair.sel(direction=direction)
    ax.plot(pair["cycle"], pair["nearer"], ".-", label="nearer position")
    ax.plot(pair["cycle"], pair["further"], ".-", label="further position")
    ax.axhline(float(pair["estimate"]), color="k", ls="--", label="best estimate for the first cycle")
    ax.set(xlabel="cycle", ylabel="deviation / µm", title=ARROWS[direction])
    ax.legend()
    return ax


def evaluate_deviation_chart(deviations: xr.Dataset) -> xr.Dataset:
    """Figure 6: deviations of every cycle over position, as measured.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.

    Returns
    -------
    xarray.Dataset
        ``deviation`` (um; cycle, direction, target) and ``position`` (mm; target).
    """
    return deviations[["deviation", "position"]]


def plot_deviation_chart(chart: xr.Dataset, ax: Axes | None = None, *, direction: str = "positive") -> Axes:
    """Draw figure 6 or figure 13 for one direction: one line per cycle, from the first (dark) to the last (light).

    Parameters
    ----------
    chart : xarray.Dataset
        What `evaluate_deviation_chart` or `evaluate_common_start` returns.
    ax : matplotlib.axes.Axes, optional
        None: those of a new figure.
    direction : {"positive", "negative"}

    Returns
    -------
    matplotlib.axes.Axes
    """
    import matplotlib as mpl

    ax = new_axes(ax)
    order = np.argsort(chart["position"].values)
    lines = chart["deviation"].sel(direction=direction).values[:, order]
    colours = mpl.colormaps[TIME_MAP](np.linspace(0.0, 0.95, len(lines)))
    for line, colour in zip(lines, colours, strict=True):
        ax.plot(chart["position"].values[order], line, color=colour, linewidth=0.6)
    scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(*chart["cycle"].values[[0, -1]]), TIME_MAP)
    ax.figure.colorbar(scale, ax=ax, label="cycle", pad=0.02, aspect=30).outline.set_visible(False)
    ax.set(xlabel="position / mm", ylabel="deviation / µm", title=ARROWS[direction])
    return ax


def evaluate_position_history(deviations: xr.Dataset, *, target: int = 4) -> xr.Dataset:
    """Figure 7: the deviation of one position over all cycles.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.
    target : int
        Number of the position.

    Returns
    -------
    xarray.Dataset
        ``deviation`` (um) and ``time`` (UTC) (cycle, direction); ``position`` (mm).

    Raises
    ------
    InterferometryError
        There is no such target.
    """
    if target not in deviations["target"].values:
        raise InterferometryError(f"target={target} is not one of {deviations['target'].values.tolist()}")
    return deviations[["deviation", "time", "position"]].sel(target=target)


def plot_position_history(history: xr.Dataset, ax: Axes | None = None, *, drift: xr.Dataset | None = None) -> Axes:
    """Draw figure 7 over time, or over cycles where no reading has a time, with the estimated drift and its 95 % band.

    Parameters
    ----------
    history : xarray.Dataset
        What `evaluate_position_history` returns.
    ax : matplotlib.axes.Axes, optional
        None: those of a new figure.
    drift : xarray.Dataset, optional
        What `estimate_drift` returns for all targets; None: readings only.

    Returns
    -------
    matplotlib.axes.Axes
    """
    ax = new_axes(ax)
    timed = bool(history["time"].notnull().any())
    along = hours_since_start(history) if timed else history["cycle"].broadcast_like(history["deviation"])
    for direction in history["direction"].values:
        style: dict[str, Any] = {"color": COLOURS[str(direction)]}
        x, read = along.sel(direction=direction), history["deviation"].sel(direction=direction)
        ax.plot(x, read, MARKERS[str(direction)], markersize=2.6, label=ARROWS[str(direction)], **style)
        if drift is not None:
            estimated = drift.sel(direction=direction, target=int(history["target"]))
            value, band = read - estimated["noise"], 2 * estimated["drift_u"]
            ax.plot(x, value, linewidth=1.0, **style)
            ax.fill_between(x, value - band, value + band, alpha=0.18, linewidth=0, **style)
    ax.set(
        xlabel="time since first reading / h" if timed else "cycle",
        ylabel="deviation / µm",
        title=f"position {int(history['target'])} ({float(history['position']):g} mm)",
    )
    ax.legend()
    return ax


def evaluate_pair_scatter(deviations: xr.Dataset) -> xr.Dataset:
    """Figure 10: scatter of neighbour differences, as equation (6) divides it and as a sample standard deviation.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.

    Returns
    -------
    xarray.Dataset
        ``mean_difference_u`` and ``standard_deviation`` (um), ``count`` (1) (direction, link).
    """
    return evaluate_neighbours(deviations)[["mean_difference_u", "standard_deviation", "count"]]


def plot_pair_scatter(scatter: xr.Dataset, ax: Axes | None = None, *, quantity: str = "mean_difference_u") -> Axes:
    """Draw figure 10; the axis names the quantity.

    Parameters
    ----------
    scatter : xarray.Dataset
        What `evaluate_pair_scatter` returns.
    ax : matplotlib.axes.Axes, optional
        None: those of a new figure.
    quantity : {"mean_difference_u", "standard_deviation"}

    Returns
    -------
    matplotlib.axes.Axes
    """
    ax = new_axes(ax)
    label = {
        "mean_difference_u": "u of the mean difference,\nequation (6) / µm",
        "standard_deviation": "sample standard deviation\nof the difference / µm",
    }[quantity]
    for direction in scatter["direction"].values:
        row = scatter[quantity].sel(direction=direction)
        ax.plot(row["link"], row, MARKERS[direction], ls="-", color=COLOURS[direction], label=ARROWS[direction])
    ax.set(xlabel="position i (pair with the one before)", ylabel=label, ylim=(0, None))
    ax.legend()
    return ax


def plot_comparison(comparison: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw figure 10 beside the conventional standard deviation of each position.

    Parameters
    ----------
    comparison : xarray.Dataset
        What `compare` returns.
    ax : matplotlib.axes.Axes, optional
        None: those of a new figure.

    Returns
    -------
    matplotlib.axes.Axes
    """
    ax = new_axes(ax)
    for direction in comparison["direction"].values:
        row = comparison.sel(direction=direction)
        style: dict[str, Any] = {"color": COLOURS[direction], "marker": MARKERS[direction]}
        ax.plot(row["link"], row["differenced"], label=f"differences, {ARROWS[direction]}", **style)
        label = f"conventional, {ARROWS[direction]}"
        ax.plot(row["link"], row["conventional"], linestyle=":", alpha=0.7, label=label, **style)
    ax.set(xlabel="position i", ylabel="standard deviation / µm", yscale="log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("{x:g}")
    ax.tick_params(axis="y", which="minor", labelsize=7.5)
    ax.legend(fontsize=7.5)
    return ax


def evaluate_mutual_deviations(deviations: xr.Dataset) -> xr.Dataset:
    """Figure 11: mean difference of neighbouring positions, equation (4).

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.

    Returns
    -------
    xarray.Dataset
        ``mean_difference`` and ``mean_difference_u`` (um) (direction, link).
    """
    return evaluate_neighbours(deviations)[["mean_difference", "mean_difference_u"]]


def plot_mutual_deviations(mutual: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw figure 11 with 95 % intervals.

    Parameters
    ----------
    mutual : xarray.Dataset
        What `evaluate_mutual_deviations` returns.
    ax : matplotlib.axes.Axes, optional
        None: those of a new figure.

    Returns
    -------
    matplotlib.axes.Axes
    """
    ax = new_axes(ax)
    for shift, direction in zip((-0.12, 0.12), mutual["direction"].values, strict=False):
        row = mutual.sel(direction=direction)
        ax.errorbar(
            row["link"] + shift, row["mean_difference"], 2 * row["mean_difference_u"], fmt=MARKERS[direction],
            color=COLOURS[direction], capsize=2, linewidth=1.0, label=ARROWS[direction],
        )  # fmt: skip
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="position i", ylabel="mean difference to position i - 1 / µm")
    ax.legend()
    return ax


def evaluate_reference_chart(deviations: xr.Dataset, *, reference: str = "time") -> xr.Dataset:
    """Figure 12: the deviation chart from the reference value at position 1, with borders.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.
    reference : {"time", "first_cycle"}
        Cycle of the reference value, as in `build_chart`.

    Returns
    -------
    xarray.Dataset
        What `build_chart` returns, with ``position`` (mm; target).
    """
    chart = build_chart(deviations, reference=reference)
    return chart.assign(position=deviations["position"].sel(target=chart["target"]))


def plot_reference_chart(chart: xr.Dataset, ax: Axes | None = None, *, border: str = "border_s") -> Axes:
    """Draw figure 12.

    Parameters
    ----------
    chart : xarray.Dataset
        What `evaluate_reference_chart` returns.
    ax : matplotlib.axes.Axes, optional
        None: those of a new figure.
    border : {"border_s", "border_u"}
        Borders by the sample standard deviation of the differences, or by equation (6).

    Returns
    -------
    matplotlib.axes.Axes
    """
    ax = new_axes(ax)
    what = {"border_u": "±2 u of the mean difference, equation (6)", "border_s": "±2 s of the differences"}[border]
    for direction in chart["direction"].values:
        row, colour = chart.sel(direction=direction), COLOURS[str(direction)]
        ax.plot(
            row["position"], row["chart"], MARKERS[str(direction)], ls="-", color=colour, label=ARROWS[str(direction)]
        )
        for sign in (-1, 1):
            ax.plot(row["position"], row["chart"] + sign * row[border], "--", color=colour, linewidth=0.8)
    ax.set(xlabel="position / mm", ylabel="deviation / µm")
    ax.legend(title=f"dashed: {what}", title_fontsize=8)
    return ax


def evaluate_common_start(deviations: xr.Dataset) -> xr.Dataset:
    """Figure 13: all cycles shifted to a common value at position 1; their spread is drift that was not eliminated.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.

    Returns
    -------
    xarray.Dataset
        ``deviation`` (um; cycle, direction, target), whose mean over the cycles is that of the readings; ``position`` (mm; target).
    """
    first = int(np.argmin(deviations["position"].values))
    x = deviations["deviation"]
    start = x.isel(target=first, drop=True)
    shifted = (x - start + start.mean("cycle")).transpose(*x.dims)
    return xr.Dataset({"deviation": shifted.assign_attrs(units="um"), "position": deviations["position"]})
