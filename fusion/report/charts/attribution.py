"""Maps and charts of the correlation: sensitivity and significance of cells, thermal modes, clusters, regions by target."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.models import FixedTicker, LinearColorMapper
from bokeh.plotting import figure
from scipy import ndimage

from fusion.attribution.family_wise import CHECKS, LEVEL
from fusion.report.charts.plan import add_cells, extent_of, new_plan
from fusion.report.charts.style import (
    DIVERGING,
    MARKERS,
    Chart,
    add_colour_bar,
    add_series,
    add_zero_line,
    new_figure,
    palette,
    span_words,
)
from fusion.report.wording import CHANNELS, duration, number, p_cell, p_words, region_words
from interferometry.figures import COLOURS, INK

#: Upper ends of the steps in which a p-value is shown, their colours, and their names; above the last one a cell is left blank.
_P_STEPS = (0.01, 0.05, 0.1)
#: Largest p-value that a map shows.
LEAST_SHOWN = _P_STEPS[-1]
_P_COLOURS = ("#3b0f70", "#b63679", "#fbb18b")
_P_NAMES = {0.5: "≤ 0.01", 1.5: "≤ 0.05", 2.5: "≤ 0.1"}
#: Colours of groups of cells: light enough for a dark number on each.
_GROUPS = (
    "#a6cee3",
    "#fdbf6f",
    "#b2df8a",
    "#cab2d6",
    "#ffff99",
    "#fb9a99",
    "#8dd3c7",
    "#d9d9d9",
    "#e5c494",
    "#bebada",
    "#ccebc5",
    "#fccde5",
)
#: Numbers of groups that are nearer than this would be written over each other.
_LEAST_MM = 22.0


def _add_blank(drawn: figure, extent: tuple[float, float, float, float], name: str) -> None:
    """Hatch the plan, which shows wherever no cell is coloured."""
    left, right, bottom, top = extent
    drawn.quad(
        left=left, right=right, bottom=bottom, top=top, fill_color="#ffffff", line_color=None, hatch_pattern="right_diagonal_line",
        hatch_color="#9aa7ad", hatch_scale=7, hatch_weight=0.6, level="image", legend_label=name,
    )  # fmt: skip


def _cell_columns(maps: xr.Dataset, **layers: np.ndarray) -> dict[str, np.ndarray]:
    """Return the cells of the plan with values, one row each."""
    x, y = np.meshgrid(maps["x"].values, maps["y"].values)
    return {"x / mm": x.ravel(), "y / mm": y.ravel(), **{name: values.ravel() for name, values in layers.items()}}


def plot_sensitivity(maps: xr.Dataset, channel: str) -> Chart:
    """Draw the sensitivity of one part of the drift to every cell; cells whose family-wise p is above 0.05 are hatched.

    Parameters
    ----------
    maps : Dataset
        Group ``correlation`` of fusion.nc.
    channel : str
        Part of the drift.

    Returns
    -------
    Chart
    """
    chosen, extent = maps.sel(channel=channel), extent_of(maps)
    values, p = chosen["sensitivity"].values, chosen["p_value"].fillna(1.0).values
    passed = p <= LEVEL
    limit = float(np.nanmax(np.abs(values[passed]))) if passed.any() else 1.0
    mapper = LinearColorMapper(palette(DIVERGING), low=-limit, high=limit, nan_color="rgba(0, 0, 0, 0)")
    drawn = new_plan(extent, title=CHANNELS.get(channel, channel), height=300)
    _add_blank(drawn, extent, "not significant (p > 0.05)")
    tips = [("sensitivity", "@own{0.00} µm/K"), ("family-wise p", "@p{0.000}")]
    add_cells(drawn, np.where(passed, values, np.nan), extent, mapper, tips, own=values, p=p)
    add_colour_bar(drawn, mapper, "sensitivity / (µm/K)")
    return Chart(
        drawn,
        _where(maps, passed, p, f"sensitivity {span_words(values[passed], 'µm/K')}" if passed.any() else ""),
        _cell_columns(maps, **{"sensitivity / (µm/K)": values, "family-wise p": p}),
    )


def plot_significance(maps: xr.Dataset, channel: str) -> Chart:
    """Draw the family-wise p-value of every cell in steps; cells above 0.1 are hatched.

    Parameters
    ----------
    maps : Dataset
        Group ``correlation`` of fusion.nc.
    channel : str
        Part of the drift.

    Returns
    -------
    Chart
    """
    extent, p = extent_of(maps), maps["p_value"].sel(channel=channel).fillna(1.0).values
    step = np.digitize(p, _P_STEPS, right=True).astype(float)
    mapper = LinearColorMapper(list(_P_COLOURS), low=0.0, high=float(len(_P_STEPS)), nan_color="rgba(0, 0, 0, 0)")
    drawn = new_plan(extent, title=CHANNELS.get(channel, channel), height=300)
    _add_blank(drawn, extent, "p > 0.1")
    blank = step == len(_P_STEPS)
    add_cells(drawn, np.where(blank, np.nan, step + 0.5), extent, mapper, [("family-wise p", "@p{0.000}")], p=p)
    _add_steps(drawn, mapper, "family-wise p", _P_NAMES)
    return Chart(drawn, _where(maps, p <= LEVEL, p, ""), _cell_columns(maps, **{"family-wise p": p}))


def _add_steps(drawn: figure, mapper: LinearColorMapper, label: str, names: dict[float, str]) -> None:
    """Put a colour bar with names instead of numbers beside a map."""
    add_colour_bar(drawn, mapper, label)
    (bar,) = (part for part in drawn.below if getattr(part, "color_mapper", None) is mapper)
    bar.ticker, bar.major_label_overrides = FixedTicker(ticks=list(names)), dict(names)


def _where(maps: xr.Dataset, passed: np.ndarray, p: np.ndarray, more: str) -> str:
    """Say how many cells are significant and where the strongest is."""
    row, column = np.unravel_index(np.argmin(p), p.shape)
    place = f"x {float(maps['x'][column]):.0f} mm, y {float(maps['y'][row]):.0f} mm (p {p_cell(float(p.min()))})"
    if not passed.any():
        return f"No cell of {p.size} is significant at 0.05; the closest is at {place}."
    return f"{int(passed.sum())} of {p.size} cells are significant at 0.05{', ' + more if more else ''}; the strongest is at {place}."


def plot_mode(modes: xr.Dataset, mode: int, channel: str, least_p: float | None = None) -> Chart:
    """Draw the pattern of a thermal mode, relative to the cell marked by a cross, with its p-value and lag in one part of the drift.

    Parameters
    ----------
    modes : Dataset
        Group ``correlation/modes`` of fusion.nc.
    mode : int
        Its number.
    channel : str
        Part of the drift whose p-value and lag are written.
    least_p : float, optional
        Smallest p-value that the number of simulations can show: one equal to it is written as an upper limit.

    Returns
    -------
    Chart
    """
    one, extent = modes.sel(mode=mode), extent_of(modes)
    p, lag = (float(one[name].sel(channel=channel)) for name in ("p_value", "lag"))
    significant = p <= LEVEL
    title = f"mode {mode}: {'significant, ' if significant else ''}p {p_cell(p, least_p)}, lag {duration(lag)}"
    drawn = new_plan(extent, title=title, height=250)
    mapper = LinearColorMapper(palette("PuOr_r"), low=-1.0, high=1.0, nan_color="#e1e5e7")
    pattern = one["pattern"].values
    add_cells(drawn, pattern, extent, mapper, [("warming relative to the cross", "@image{0.00}")])
    x, y = float(one["at_x"]), float(one["at_y"])
    for colour, width in (("#ffffff", 5), (INK, 2)):
        drawn.scatter([x], [y], marker="cross", size=14, line_color=colour, line_width=width)
    add_colour_bar(drawn, mapper, "warming relative to the cross")
    seen = (
        f"Thermal mode {mode}, strongest at x {x:.0f} mm, y {y:.0f} mm; it {'goes' if significant else 'does not go'} with the "
        f"{CHANNELS.get(channel, channel)} ({p_words(p, least_p)})."
    )
    return Chart(drawn, seen, _cell_columns(modes, **{"warming relative to the cross": pattern}))


def plot_clusters(clusters: xr.Dataset) -> Chart:
    """Draw groups of cells with one course of temperature; inside a group no analysis of this session can separate places.

    Parameters
    ----------
    clusters : Dataset
        Group ``correlation/clusters`` of fusion.nc.

    Returns
    -------
    Chart
    """
    group, extent = clusters["cluster"].values, extent_of(clusters)
    count = int(group.max())
    colours = [_GROUPS[at % len(_GROUPS)] for at in range(max(count, 1))]
    mapper = LinearColorMapper(colours, low=0.5, high=max(count, 1) + 0.5, nan_color="#ffffff")
    drawn = new_plan(extent, height=300)
    add_cells(drawn, np.where(group == 0, np.nan, group), extent, mapper, [("group", "@image{0}")])
    places = _label_places(clusters, count)
    drawn.text(
        [x for _, x, _ in places], [y for *_, y in places], [str(number) for number, *_ in places], text_align="center",
        text_baseline="middle", text_color=INK, text_font_size="12px",
    )  # fmt: skip
    _add_steps(drawn, mapper, "group", {float(number): str(number) for number in range(1, count + 1)})
    sizes = np.bincount(group.ravel(), minlength=count + 1)[1:]
    seen = (
        f"{count} groups of cells that take one course of temperature each; the largest covers "
        f"{100 * sizes.max(initial=0) / group.size:.0f} % of the table."
    )
    return Chart(drawn, seen, _cell_columns(clusters, group=group))


def _label_places(clusters: xr.Dataset, count: int) -> list[tuple[int, float, float]]:
    """Return number and place (mm) of the groups that have room for their number: in their thickest part, none over another."""
    group, x, y = clusters["cluster"].values, clusters["x"].values, clusters["y"].values
    found: list[tuple[int, float, float]] = []
    sizes = np.bincount(group.ravel(), minlength=count + 1)
    for one in sorted(range(1, count + 1), key=lambda number: -sizes[number]):
        depth = ndimage.distance_transform_edt(np.pad(group == one, 1))[1:-1, 1:-1]
        row, column = np.unravel_index(np.argmax(depth), depth.shape)
        place = (float(x[column]), float(y[row]))
        if all(np.hypot(place[0] - other[1], place[1] - other[2]) >= _LEAST_MM for other in found):
            found.append((one, *place))
    return found


def plot_region_targets(targets: xr.Dataset, region: str, position: xr.DataArray) -> Chart:
    """Draw the sensitivity of every target and direction to one region, each by itself, with 95 % interval; filled where p <= 0.05.

    Parameters
    ----------
    targets : Dataset
        Group ``correlation/target_regions`` of fusion.nc.
    region : str
        Name of the region.
    position : (target,) DataArray
        Target positions, mm.

    Returns
    -------
    Chart
    """
    chosen = targets.sel(region=region)
    step = float(np.median(np.diff(np.sort(position.values)))) if position.size > 1 else 1.0
    drawn = new_figure(x="position / mm", y="sensitivity / (µm/K)", title=region_words(region))
    add_zero_line(drawn)
    place = position.sel(target=chosen["series_target"].values).values.astype(float)
    value, half = chosen["sensitivity"].values, 2 * chosen["sensitivity_u"].values
    side, passed = chosen["series_direction"].values, chosen["p_value"].values <= LEVEL
    for shift, direction in ((-0.1, "positive"), (0.1, "negative")):
        for rows, words in ((passed, "p ≤ 0.05"), (~passed, "p > 0.05")):
            here = rows & (side == direction)
            if not here.any():
                continue
            add_series(
                drawn, place[here] + shift * step, value[here], name=f"{direction}, {words}", colour=COLOURS[direction],
                line=False, marker=MARKERS[direction], half=half[here],
            )  # fmt: skip
            if words == "p > 0.05":
                drawn.renderers[-1].glyph.fill_color = "#ffffff"
    seen = (
        f"Sensitivity of {value.size} series to {region_words(region)}: {span_words(value, 'µm/K')}; {int(passed.sum())} of them are "
        "significant by themselves."
    )
    columns = {
        "position / mm": place, "approach": side, "sensitivity / (µm/K)": value, "95 % interval ± / (µm/K)": half,
        "family-wise p": chosen["p_value"].values,
    }  # fmt: skip
    return Chart(drawn, seen, columns)


def caption_of(maps: xr.DataTree, channel: str, name: str = "") -> str:
    """Return the caption of a map: rate of false alarms, unexplained drift, detection limit, groups of collinear cells.

    Parameters
    ----------
    maps : DataTree
        Result of `fusion.attribution.attribute.correlate`.
    channel : str
        Part of the drift.
    name : str
        ``modes`` or ``regions``; empty for the map of cells.
    """
    session = maps.to_dataset()
    tested = maps.children[name].to_dataset() if name else session
    rate = float(tested["false_alarm_rate" if name else "cells_false_alarm_rate"])
    detectable = tested["detectable_sensitivity"].sel(channel=channel)
    smallest = float(detectable.where(np.isfinite(detectable)).median())
    courses = int(maps.children["clusters"].to_dataset()["cluster"].max())
    drift = float(session["unexplained_drift"].sel(channel=channel))
    return (
        f"False alarms of this map, in simulations without a source: {rate_text(rate)}. Unexplained drift: "
        f"{number(drift, 2)} µm in one hour. Detection limit at 80 % power: {number(smallest, 2)} µm/K (median over the map). "
        f"The field shows {courses} courses of temperature; places that share one cannot be told apart."
    )


def rate_text(rate: float, checks: int = CHECKS) -> str:
    """Return a measured rate of false alarms in per cent with its expanded uncertainty (k = 2).

    Parameters
    ----------
    rate : float
        Share of simulations with a false alarm, 0 to 1.
    checks : int
        Number of simulations; the uncertainty is that of a binomial share.
    """
    u = np.sqrt(max(rate, 1.0 / checks) * (1.0 - rate) / checks)
    return f"{100 * rate:.1f} ± {200 * u:.1f} %"
