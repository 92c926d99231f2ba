"""Charts of the differences between neighbouring positions."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.report.charts.style import MARKERS, Chart, add_series, add_zero_line, new_figure, span_words
from interferometry.figures import ARROWS, COLOURS


def _links(links: xr.DataArray, position: xr.DataArray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (mm) of the further and of the nearer target of every pair."""
    along = position["target"].values[np.argsort(position.values, kind="stable")].tolist()
    nearer = [along[along.index(int(target)) - 1] for target in links.values]
    return position.sel(target=links.values).values.astype(float), position.sel(target=nearer).values.astype(float)


def plot_scatter_comparison(comparison: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the standard deviation of the differences of neighbours beside the conventional one of each position.

    Parameters
    ----------
    comparison : Dataset
        Group ``comparison`` of deviations.nc.
    position : (target,) DataArray
        Target positions, mm.

    Returns
    -------
    Chart
    """
    place, _ = _links(comparison["link"], position)
    drawn = new_figure(x="position / mm", y="standard deviation / µm", y_type="log")
    columns: dict[str, np.ndarray] = {"position / mm": place}
    for name, text, dash in (("differenced", "differences", "solid"), ("conventional", "conventional", "dashed")):
        for direction in comparison["direction"].values:
            values = comparison[name].sel(direction=direction).values
            words, colour, marker = f"{text}, {direction}", COLOURS[direction], MARKERS[direction]
            add_series(drawn, place, values, name=words, colour=colour, dash=dash, marker=marker)
            columns[f"s of the {text}, {ARROWS[direction]} / µm"] = values
    seen = (
        f"Standard deviation of {place.size} positions: of the differences {span_words(comparison['differenced'], 'µm')}, conventional "
        f"{span_words(comparison['conventional'], 'µm')}."
    )
    return Chart(drawn, seen, columns)


def plot_mean_differences(neighbours: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the mean difference of neighbouring positions, nearer minus further, with its 95 % interval.

    Parameters
    ----------
    neighbours : Dataset
        Group ``neighbours`` of deviations.nc.
    position : (target,) DataArray
        Target positions, mm.

    Returns
    -------
    Chart
    """
    further, nearer = _links(neighbours["link"], position)
    middle, step = (further + nearer) / 2, float(np.median(further - nearer))
    drawn = new_figure(x="middle of the pair / mm", y="nearer − further position, mean / µm")
    add_zero_line(drawn)
    columns: dict[str, np.ndarray] = {"nearer position / mm": nearer, "further position / mm": further}
    for shift, direction in zip((-0.1, 0.1), neighbours["direction"].values, strict=False):
        value = neighbours["mean_difference"].sel(direction=direction).values
        half = 2 * neighbours["mean_difference_u"].sel(direction=direction).values
        add_series(
            drawn, middle + shift * step, value, name=ARROWS[direction], colour=COLOURS[direction], line=False,
            marker=MARKERS[direction], half=half,
        )  # fmt: skip
        columns |= {f"nearer − further, {ARROWS[direction]} / µm": value, f"95 % ±, {ARROWS[direction]} / µm": half}
    seen = (
        f"Mean difference of {middle.size} pairs of neighbours, nearer minus further: {span_words(neighbours['mean_difference'], 'µm')}; "
        "below zero the deviation grows along the axis."
    )
    return Chart(drawn, seen, columns)


def plot_reference_chart(chart: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the deviation chart from the reference value at the first position, with borders of twice the scatter of the differences.

    Parameters
    ----------
    chart : Dataset
        Group ``chart`` of deviations.nc.
    position : (target,) DataArray
        Target positions, mm.

    Returns
    -------
    Chart
    """
    order = np.argsort(position.sel(target=chart["target"]).values, kind="stable")
    chart = chart.isel(target=order)
    place = position.sel(target=chart["target"]).values.astype(float)
    drawn = new_figure(x="position / mm", y="deviation / µm")
    add_zero_line(drawn)
    columns: dict[str, np.ndarray] = {"position / mm": place}
    for direction in chart["direction"].values:
        value, border = (chart[name].sel(direction=direction).values for name in ("chart", "border_s"))
        name, colour = ARROWS[direction], COLOURS[direction]
        add_series(drawn, place, value, name=name, colour=colour, marker=MARKERS[direction])
        for sign in (-1, 1):
            drawn.line(
                place, value + sign * border, line_color=colour, line_dash="dashed", legend_label=f"±2 s, {direction}"
            )
        columns |= {f"deviation, {name} / µm": value, f"border ±, {name} / µm": border}
    seen = f"Deviation from the reference at {place[0]:g} mm: {span_words(chart['chart'], 'µm')} over {place.size} positions."
    return Chart(drawn, seen, columns)
