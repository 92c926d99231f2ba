"""Charts of the table: frame and fiducials, maps on the plan, rise over time and along the axis, drift against temperature."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from bokeh.models import ColorMapper, GlyphRenderer, LinearColorMapper
from bokeh.plotting import figure

from fusion.report.charts.style import (
    Chart,
    add_band,
    add_colour_bar,
    add_hover,
    add_ordered_lines,
    add_series,
    add_zero_line,
    new_figure,
    palette,
    span_words,
)
from fusion.report.wording import number
from interferometry.figures import ACCENT, INK
from thermography.fields.cycle_fields import plan_unit
from thermography.fields.tasks.pieces import in_pieces

#: Temperatures of a picture are rounded to 1/32 K, far below its noise, so that it is small when it is compressed.
_STEP_PER_K = 32
#: Length of a recording from which its time is drawn in hours.
_LEAST_HOURS = 0.1


def extent_of(cells: xr.Dataset) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of the cells of the plan, mm.

    Parameters
    ----------
    cells : Dataset
        With ``x`` and ``y``, the middles of the cells (mm).
    """
    x, y = cells["x"].values, cells["y"].values
    half = float(np.median(np.diff(x))) / 2
    return float(x[0] - half), float(x[-1] + half), float(y[0] - half), float(y[-1] + half)


def new_plan(
    extent: tuple[float, float, float, float], *, title: str = "", height: int = 260, unit: str = "mm"
) -> figure:
    """Return an empty plan view of the table with x to the right and y upwards, one mm as long in both; of a picture, y downwards.

    Parameters
    ----------
    extent : tuple of float
        Left, right, bottom, top, mm.
    title : str
        Above the legend.
    height : int
        CSS px.
    unit : str
        Of the plan: mm, or px where the picture is the plan.
    """
    left, right, bottom, top = extent
    y_range = (top, bottom) if unit == "px" else (bottom, top)
    drawn = new_figure(
        x=f"x / {unit}", y=f"y / {unit}", title=title, height=height, x_range=(left, right), y_range=y_range
    )
    drawn.match_aspect = True
    drawn.grid.grid_line_color = None
    return drawn


def add_cells(
    drawn: figure,
    values: np.ndarray,
    extent: tuple[float, float, float, float],
    mapper: ColorMapper,
    tips: Sequence[tuple[str, str]],
    **layers: np.ndarray,
) -> GlyphRenderer:
    """Draw values on the plan; NaN show what is below.

    Parameters
    ----------
    drawn : figure
        From `new_plan`.
    values : (y, x) ndarray
        As coloured by `mapper`.
    extent : tuple of float
        Left, right, bottom, top, mm.
    mapper : ColorMapper
        Its colours.
    tips : sequence of (str, str)
        Name and Bokeh format; ``@image`` is the value, further ones are the names of `layers`.
    **layers : (y, x) ndarray
        Further values under the pointer.
    """
    left, right, bottom, top = extent
    source = {
        "image": [values.astype(np.float32)],
        **{name: [more.astype(np.float32)] for name, more in layers.items()},
    }
    cells = drawn.image(
        "image", x=left, y=bottom, dw=right - left, dh=top - bottom, color_mapper=mapper, source=source, level="image"
    )
    add_hover(drawn, [("x", "$x{0} mm"), ("y", "$y{0} mm"), *tips], [cells])
    return cells


def plot_registration(fields: xr.Dataset) -> Chart:
    """Draw the reference frame, in sensor pixels, with every located fiducial.

    Parameters
    ----------
    fields : Dataset
        Content of fields.nc.

    Returns
    -------
    Chart
    """
    frame = fields["reference_frame"].values
    rows, columns = frame.shape
    low, high = np.nanpercentile(frame[_on_plan(fields, frame.shape)], [1, 99])
    mapper = LinearColorMapper(palette(), low=float(low), high=float(high))
    drawn = new_figure(x="column / px", y="row / px", height=380, x_range=(0, columns), y_range=(rows, 0))
    drawn.match_aspect = True
    drawn.grid.grid_line_color = None
    rounded = np.round(frame * _STEP_PER_K) / _STEP_PER_K
    picture = drawn.image(
        [rounded.astype(np.float32)],
        x=-0.5,
        y=-0.5,
        dw=columns,
        dh=rows,
        color_mapper=mapper,
        level="image",
    )
    add_hover(drawn, [("column", "$x{0}"), ("row", "$y{0}"), ("temperature", "@image{0.00} °C")], [picture])
    names = [str(name) for name in fields["fiducial_name"].values]
    column, row = fields["fiducial_column"].values, fields["fiducial_row"].values
    source = {"column": column, "row": row, "name": names, "residual": fields["fiducial_residual"].values}
    rings = drawn.scatter(
        "column", "row", source=source, marker="circle", size=13, fill_alpha=0.0, line_color="#7fe3ff", line_width=2
    )
    drawn.text(
        "column", "row", "name", source=source, x_offset=9, y_offset=-4, text_color="#ffffff", text_font_size="11px",
        background_fill_color=INK, background_fill_alpha=0.75, padding=2,
    )  # fmt: skip
    add_hover(drawn, [("fiducial", "@name"), ("residual", "@residual{0.000} mm")], [rings])
    add_colour_bar(drawn, mapper, "temperature / °C", place="right")
    residual = fields["fiducial_residual"].values
    seen = (
        f"Frame of {columns} by {rows} pixels with {len(names)} located fiducials; their residuals are up to "
        f"{number(float(np.nanmax(residual)), 2)} mm."
    )
    data: dict[str, Sequence[str] | np.ndarray] = {
        "fiducial": names,
        "column / px": column,
        "row / px": row,
        "residual / mm": residual,
    }
    return Chart(drawn, seen, data)


def _on_plan(fields: xr.Dataset, shape: tuple[int, ...]) -> np.ndarray:
    """Return which pixels of a frame show the plan, (row, column) bool; without lens distortion, as it only sets a colour scale."""
    row, column = np.indices(shape)
    x, y, scale = np.einsum("ij,jrc->irc", fields["homography"].values, np.stack([column, row, np.ones(shape)]))
    left, right, bottom, top = extent_of(fields)
    return (x / scale > left) & (x / scale < right) & (y / scale > bottom) & (y / scale < top)


def _hours(fields: xr.Dataset) -> np.ndarray:
    """Return the mean time of the frames of every cycle in hours since the first."""
    return np.asarray((fields["cycle_time"] - fields["cycle_time"][0]) / np.timedelta64(1, "h"), float)


def plot_rise_history(fields: xr.Dataset) -> Chart:
    """Draw the rise of the table over the test: mean over the plan, with its coolest and hottest tenth; a cycle without a field is a gap.

    Parameters
    ----------
    fields : Dataset
        Content of fields.nc.

    Returns
    -------
    Chart
    """
    rise = fields["temperature_rise"]
    hours = _hours(fields)
    low, high, mean, most = np.full((4, rise.sizes["cycle"]), np.nan)
    for some, piece in in_pieces(rise):
        flat = piece.reshape(len(piece), -1)
        shown = np.isfinite(flat).any(axis=1)
        if not shown.any():
            continue
        low[some][shown], high[some][shown] = np.nanpercentile(flat[shown], [10, 90], axis=1)
        mean[some][shown], most[some][shown] = np.nanmean(flat[shown], axis=1), np.nanmax(flat[shown], axis=1)
    unit, scale = ("h", 1.0) if hours[-1] >= _LEAST_HOURS else ("s", 3600.0)
    hours = scale * hours
    drawn = new_figure(x=f"time since first cycle / {unit}", y="rise / K")
    add_zero_line(drawn)
    add_band(drawn, hours, low, high, ACCENT, legend_label="middle 80 % of the cells")
    seen_part = "picture" if plan_unit(fields) == "px" else "table"
    add_series(drawn, hours, mean, name=f"mean of the {seen_part}", colour=ACCENT)
    add_series(drawn, hours, most, name="warmest cell", colour=INK, dash="dashed")
    seen = (
        f"Rise of the {seen_part} over {number(float(hours[-1]), 2)} {unit}: the mean of its cells is {span_words(mean, 'K')}, the warmest "
        f"cell reaches {number(float(np.nanmax(most)))} K."
    )
    columns = {
        "cycle": fields["cycle"].values, f"time since first cycle / {unit}": hours, "mean rise / K": mean,
        "10 % of the cells below / K": low, "90 % of the cells below / K": high, "warmest cell / K": most,
    }  # fmt: skip
    return Chart(drawn, seen, columns)


def plot_axis_temperature(fused: xr.Dataset) -> Chart:
    """Draw the rise of the table along the measured line, one line for every cycle.

    Parameters
    ----------
    fused : Dataset
        Content of fusion.nc, with ``local_rise`` (K; cycle, direction, target) and ``position`` (mm; target).

    Returns
    -------
    Chart
    """
    order = np.argsort(fused["position"].values, kind="stable")
    place = fused["position"].values[order].astype(float)
    rise = fused["local_rise"].mean("direction").transpose("cycle", "target").values[:, order]
    shown = np.isfinite(rise).any(axis=1)
    cycle = fused["cycle"].values[shown]
    drawn = new_figure(x="position / mm", y="rise / K")
    add_zero_line(drawn)
    add_ordered_lines(drawn, [place] * int(shown.sum()), list(rise[shown]), cycle, "cycle")
    last = rise[shown][-1]
    seen = (
        f"Rise of the table under the measured line in {cycle.size} cycles: {span_words(rise, 'K')}; in the last cycle it is largest at "
        f"{place[int(np.nanargmax(last))]:g} mm ({number(float(np.nanmax(last)))} K)."
    )
    columns = {
        "cycle": np.repeat(cycle, place.size),
        "position / mm": np.tile(place, cycle.size),
        "rise / K": rise[shown].ravel(),
    }
    return Chart(drawn, seen, columns)


def plot_drift_temperature(fused: xr.Dataset, drift: xr.Dataset) -> Chart:
    """Draw the drift of every position against the rise of the table below it, one line for each position in the order of the cycles.

    A loop instead of a line means that temperature and drift do not move together: a lag, or heat from elsewhere.

    Parameters
    ----------
    fused : Dataset
        Content of fusion.nc, with ``local_rise`` (K; cycle, direction, target) and ``position`` (mm; target).
    drift : Dataset
        Group ``drift`` of deviations.nc.

    Returns
    -------
    Chart
    """
    order = np.argsort(fused["position"].values, kind="stable")
    place = fused["position"].values[order].astype(float)
    rise = fused["local_rise"].mean("direction").transpose("target", "cycle").values[order]
    moved = drift["drift"].mean("direction").transpose("target", "cycle").values[order]
    drawn = new_figure(x="rise at the position / K", y="drift / µm", height=360)
    add_zero_line(drawn)
    add_ordered_lines(drawn, list(rise), list(moved), place, "position / mm")
    valid = np.isfinite(rise) & np.isfinite(moved)
    related = float(np.corrcoef(rise[valid], moved[valid])[0, 1]) if valid.sum() > 2 else float("nan")
    seen = (
        f"Drift ({span_words(moved, 'µm')}) against the rise at the same position ({span_words(rise, 'K')}); their plain correlation over "
        f"all positions is {number(related, 2)}, which is no proof, as two quantities that both rise always correlate."
    )
    columns = {
        "cycle": np.tile(fused["cycle"].values, place.size),
        "position / mm": np.repeat(place, rise.shape[1]),
        "rise / K": rise.ravel(),
        "drift / µm": moved.ravel(),
    }
    return Chart(drawn, seen, columns)
