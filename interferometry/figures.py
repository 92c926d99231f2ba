"""L3 - The paper's figures 1, 2, 6, 7, 10 to 13: each returns its numbers, and draws them into an axes.

Every ``evaluate_*`` returns a Dataset; every ``plot_*`` takes that Dataset and ``ax=None`` and returns the axes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from interferometry.neighbours import build_chart, evaluate_neighbours, simulate_derived_sequence

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {"positive": "#0072B2", "negative": "#D55E00"}
_ARROWS = {"positive": "approach in positive direction", "negative": "approach in negative direction"}


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=(7, 4), layout="constrained")[1]


def evaluate_distributions(*, samples: int = 1000, bins: int = 30, seed: int = 0) -> xr.Dataset:
    """Figure 1: densities of a normal sequence and of the differences of its successive values.

    Returns
    -------
    xarray.Dataset
        source and derived density per unit standard deviation over ``value``, and their ratio of standard deviations.
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
    """Draw figure 1."""
    ax = _axes(ax)
    for name, label in (("source", "source sequence a"), ("derived", "derived sequence b = a(n) - a(n+1)")):
        ax.step(densities["value"].values, densities[name].values, where="mid", label=label)
    ax.set(xlabel="value / standard deviation of a", ylabel="density")
    ax.set_title(f"ratio of standard deviations {float(densities['ratio']):.4f} (sqrt 2 = 1.4142)")
    ax.legend()
    return ax


def evaluate_best_estimate(deviations: xr.Dataset, *, link: int = 2) -> xr.Dataset:
    """Figure 2: the best estimate of a position is the first cycle's neighbour less the mean mutual deviation.

    Parameters
    ----------
    deviations : xarray.Dataset
    link : int
        Further target of the pair.

    Returns
    -------
    xarray.Dataset
        Per cycle and direction: nearer and further deviations of the pair (um) and their difference; mean_difference
        and estimate per direction.

    Raises
    ------
    ValueError
        The link names no target that has a neighbour before it.
    """
    links = evaluate_neighbours(deviations)
    numbers = links["link"].values.tolist()
    if link not in numbers:
        raise ValueError(f"link={link} is not one of {numbers}")
    along = deviations["target"].values[np.argsort(deviations["position"].values, kind="stable")].tolist()
    near = deviations["deviation"].sel(target=along[along.index(link) - 1]).drop_vars("target")
    far = deviations["deviation"].sel(target=link).drop_vars("target")
    mean = links["mean_difference"].sel(link=link).drop_vars("link")
    estimate = near.isel(cycle=0).drop_vars("cycle") - mean
    return xr.Dataset(
        {"nearer": near, "further": far, "difference": near - far, "mean_difference": mean, "estimate": estimate}
    )


def plot_best_estimate(pair: xr.Dataset, ax: Axes | None = None, *, direction: str = "positive") -> Axes:
    """Draw figure 2 for one direction."""
    ax = _axes(ax)
    one = pair.sel(direction=direction)
    ax.plot(one["cycle"], one["nearer"], ".-", label="nearer position")
    ax.plot(one["cycle"], one["further"], ".-", label="further position")
    ax.axhline(float(one["estimate"]), color="k", ls="--", label="best estimate for the first cycle")
    ax.set(xlabel="cycle", ylabel="deviation [um]")
    ax.legend()
    return ax


def evaluate_deviation_chart(deviations: xr.Dataset) -> xr.Dataset:
    """Figure 6: every cycle's deviations over position, as measured."""
    return deviations[["deviation", "position"]]


def plot_deviation_chart(chart: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw figure 6 or figure 13: one line per cycle and direction."""
    ax = _axes(ax)
    order = np.argsort(chart["position"].values)
    for direction in chart["direction"].values:
        lines = chart["deviation"].sel(direction=direction).values[:, order]
        ax.plot(chart["position"].values[order], lines.T, color=_COLOURS[str(direction)], lw=0.5, alpha=0.6)
        ax.plot([], [], color=_COLOURS[str(direction)], label=_ARROWS[str(direction)])
    ax.set(xlabel="position [mm]", ylabel="deviation [um]")
    ax.legend()
    return ax


def evaluate_position_history(deviations: xr.Dataset, *, target: int = 4) -> xr.Dataset:
    """Figure 7: the deviation of one position over all cycles.

    Raises
    ------
    ValueError
        There is no such target.
    """
    if target not in deviations["target"].values:
        raise ValueError(f"target={target} is not one of {deviations['target'].values.tolist()}")
    return deviations[["deviation", "time"]].sel(target=target)


def plot_position_history(history: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw figure 7."""
    ax = _axes(ax)
    for direction in history["direction"].values:
        one = history["deviation"].sel(direction=direction)
        ax.plot(one["cycle"], one, ".-", ms=3, color=_COLOURS[str(direction)], label=_ARROWS[str(direction)])
    ax.set(xlabel="cycle", ylabel="deviation [um]", title=f"position {int(history['target'])}")
    ax.legend()
    return ax


def evaluate_pair_scatter(deviations: xr.Dataset) -> xr.Dataset:
    """Figure 10: scatter of neighbour differences, as equation (6) divides it and as a sample standard deviation."""
    return evaluate_neighbours(deviations)[["mean_difference_u", "standard_deviation", "count"]]


def plot_pair_scatter(scatter: xr.Dataset, ax: Axes | None = None, *, quantity: str = "mean_difference_u") -> Axes:
    """Draw figure 10; ``quantity`` says which of the two is shown, and the axis names it."""
    ax = _axes(ax)
    label = {
        "mean_difference_u": "u of the mean difference,\nequation (6) [um]",
        "standard_deviation": "sample standard deviation\nof the difference [um]",
    }[quantity]
    return _bars(ax, scatter[quantity], label)


def evaluate_mutual_deviations(deviations: xr.Dataset) -> xr.Dataset:
    """Figure 11: mean mutual deviation of neighbouring positions, equation (4)."""
    return evaluate_neighbours(deviations)[["mean_difference", "mean_difference_u"]]


def plot_mutual_deviations(mutual: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw figure 11."""
    return _bars(_axes(ax), mutual["mean_difference"], "mean mutual deviation [um]")


def _bars(ax: Axes, values: xr.DataArray, label: str) -> Axes:
    for shift, direction in ((-0.2, "positive"), (0.2, "negative")):
        one = values.sel(direction=direction)
        ax.bar(one["link"].values + shift, one.values, 0.4, color=_COLOURS[direction], label=_ARROWS[direction])
    ax.set(xlabel="position (pair with the one before)", ylabel=label)
    ax.margins(y=0.25)
    ax.legend(ncols=2)
    return ax


def evaluate_reference_chart(deviations: xr.Dataset, *, reference: str = "time") -> xr.Dataset:
    """Figure 12: the deviation chart from the reference value at position 1, with borders."""
    chart = build_chart(deviations, reference=reference)
    return chart.assign(position=deviations["position"].sel(target=chart["target"]))


def plot_reference_chart(chart: xr.Dataset, ax: Axes | None = None, *, border: str = "border_u") -> Axes:
    """Draw figure 12; ``border`` is border_u (equation (6)) or border_s (sample standard deviation)."""
    ax = _axes(ax)
    for direction in chart["direction"].values:
        one = chart.sel(direction=direction)
        colour = _COLOURS[str(direction)]
        ax.plot(one["position"], one["chart"], "o-", ms=3, color=colour, label=_ARROWS[str(direction)])
        for sign in (-1, 1):
            ax.plot(one["position"], one["chart"] + sign * one[border], "--", lw=0.8, color=colour)
    what = {"border_u": "2 u of the mean difference, equation (6)", "border_s": "2 s of the difference"}[border]
    ax.set(xlabel="position [mm]", ylabel="deviation [um]", title=f"borders: {what}")
    ax.legend()
    return ax


def evaluate_common_start(deviations: xr.Dataset) -> xr.Dataset:
    """Figure 13: all cycles shifted to a common value at position 1; their spread is drift that was not eliminated."""
    first = int(np.argmin(deviations["position"].values))
    x = deviations["deviation"]
    start = x.isel(target=first, drop=True)
    shifted = (x - start + start.mean("cycle")).transpose(*x.dims)
    return xr.Dataset({"deviation": shifted.assign_attrs(units="um"), "position": deviations["position"]})


def plot_common_start(chart: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw figure 13."""
    return plot_deviation_chart(chart, ax)
