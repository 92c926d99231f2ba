"""The thermal map: the table on its plan, cycle by cycle, with a menu of quantities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from bokeh.models import Arrow, ColumnDataSource, HoverTool, LinearColorMapper, NormalHead
from bokeh.plotting import figure

from fusion.products.results_axis import HotspotPart
from fusion.products.results_radiometry import ContactSensorPart
from fusion.report.charts.plan import extent_of, new_plan
from fusion.report.charts.style import DIVERGING, SEQUENTIAL, Chart, add_colour_bar, add_hover, palette
from fusion.report.wording import number, place
from interferometry.figures import INK
from thermography.fields.cycle_fields import plan_unit

#: Largest number of map values in the file; above it cycles are thinned and cells are averaged, and the report says so.
_MAP_BUDGET = 3_000_000
_MISSING = -32768
#: A colour outside the scale, for values beyond its ends.
_BEYOND = "#7fe3ff"
#: Usual width of the map on a page, and largest height of a picture, CSS px.
_WIDTH, _MOST_HEIGHT = 900, 720
#: Room about the plan, as a share of its length, so that a ring at its rim is whole.
_ROOM = 0.025


class Layer(NamedTuple):
    """A quantity of the map.

    Attributes
    ----------
    variable : str
        Its name in fields.nc.
    words, unit : str
        As they are shown; "1" for a number without unit.
    decimals : int
        That are shown.
    colours : str
        Name of its scale.
    """

    variable: str
    words: str
    unit: str
    decimals: int
    colours: str


#: Quantities of the map, the first one shown first.
LAYERS = (
    Layer("temperature_rise", "rise", "K", 2, SEQUENTIAL),
    Layer("temperature", "temperature", "°C", 2, SEQUENTIAL),
    Layer("temperature_rate", "rate", "K/h", 2, DIVERGING),
    Layer("temperature_rise_u", "standard uncertainty of the rise", "K", 3, SEQUENTIAL),
    Layer("count", "frames averaged", "1", 0, SEQUENTIAL),
)


class MapControls(NamedTuple):
    """What the reader can choose of the map, and what the page says of it.

    Attributes
    ----------
    quantities : list of str
        Entries of the menu.
    cycles : list of int
        Cycles that the slider goes through.
    note : str
        What was thinned or averaged; empty where nothing was.
    """

    quantities: list[str]
    cycles: list[int]
    note: str


def plot_thermal_map(
    fields: xr.Dataset,
    hotspots: Sequence[HotspotPart] = (),
    position: xr.DataArray | None = None,
    *,
    sensors: Sequence[ContactSensorPart] = (),
) -> tuple[Chart, MapControls]:
    """Draw the plan of the table with measured line, targets and hotspots.

    Parameters
    ----------
    fields : Dataset
        Content of fields.nc; without a laser it places no targets.
    hotspots : sequence of HotspotPart
        Places that are ringed and numbered.
    position : (target,) DataArray, optional
        Target positions, mm; they give the arrow of the line its direction. None: the order of the targets.
    sensors : sequence of ContactSensorPart
        Contact sensors, drawn as squares with their names.

    Returns
    -------
    chart : Chart
        Figure with the last cycle; its tags carry the other cycles and quantities for the script of the page.
    controls : MapControls

    Notes
    -----
    Values are kept as steps of the last decimal that is shown, in 16 bits, each cycle as its difference to the one before: noise of the
    camera is some steps, so that the compressed maps of a long test stay small.
    """
    shown = [layer for layer in LAYERS if layer.variable in fields]
    kept, note = _thin(fields[[layer.variable for layer in shown]])
    unit = plan_unit(fields)
    steps = {layer.words: _in_steps(kept[layer.variable].values, layer) for layer in shown}
    scales = [scale_of(kept[layer.variable].values, layer) for layer in shown]
    last = kept[shown[0].variable].values[-1]
    drawn = draw_map(last, extent_of(kept), shown[0], scales[0], unit=unit)
    if "target_x" in fields:
        draw_line(drawn, fields, position)
    draw_hotspots(drawn, hotspots, unit)
    draw_sensors(drawn, sensors)
    flat = {name: values.reshape(len(values), -1) for name, values in steps.items()}
    more = {name: np.diff(values, axis=0, prepend=np.int16(0)).ravel() for name, values in flat.items()}
    drawn.tags = [ColumnDataSource(more), {"scales": scales, "cycles": kept["cycle"].values.tolist()}]
    cycle = int(kept["cycle"][-1])
    chart = Chart(drawn, _seen(kept, last, hotspots, cycle), _columns(kept, shown, cycle))
    return chart, MapControls([layer.words for layer in shown], kept["cycle"].values.tolist(), note)


def draw_map(
    values: np.ndarray,
    extent: tuple[float, float, float, float],
    layer: Layer,
    scale: Mapping[str, Any],
    *,
    unit: str = "mm",
) -> figure:
    """Draw one quantity in one cycle on the plan of the table.

    Parameters
    ----------
    values : (y, x) ndarray
        NaN where no cell is seen.
    extent : tuple of float
        Left, right, bottom, top of the cells, mm.
    layer : Layer
        The quantity.
    scale : mapping
        From `scale_of`.
    unit : {"mm", "px"}
        Of the plan, or of the picture that stands for it.

    Returns
    -------
    figure
        Its renderer "cells", colour mapper "scale", colour bar "bar" and hover tool "reading" may be set to other values.
    """
    left, right, bottom, top = extent
    room = _ROOM * (right - left)
    # A table is longer than wide; a picture is drawn about as high as it is on a screen.
    height = 330 if unit == "mm" else int(min(_MOST_HEIGHT, 60 + _WIDTH * values.shape[0] / values.shape[1]))
    drawn = new_plan((left - room, right + room, bottom - room, top + room), height=height, unit=unit)
    mapper = LinearColorMapper(
        palette(layer.colours), low=scale["low"], high=scale["high"], nan_color="#e1e5e7", low_color=_BEYOND, high_color=_BEYOND,
        name="scale",
    )  # fmt: skip
    cells = drawn.image(
        [values.astype(np.float32)], x=left, y=bottom, dw=right - left, dh=top - bottom, color_mapper=mapper, level="image", name="cells"
    )  # fmt: skip
    tip = (layer.words, f"@image{{0.{'0' * layer.decimals}}} {layer.unit}")
    add_hover(drawn, [("x", f"$x{{0}} {unit}"), ("y", f"$y{{0}} {unit}"), tip], [cells])
    drawn.select_one(HoverTool).name = "reading"
    add_colour_bar(drawn, mapper, f"{layer.words} / {layer.unit}")
    drawn.below[-1].name = "bar"
    return drawn


def _thin(fields: xr.Dataset) -> tuple[xr.Dataset, str]:
    """Return the fields within the budget: every n-th cycle, then averages of blocks of cells; and the sentence that says so."""
    layers, cycles = len(fields.data_vars), fields.sizes["cycle"]
    x, y = fields.sizes["x"], fields.sizes["y"]
    note = []
    block = int(np.ceil(np.sqrt(max(1.0, x * y * layers * min(cycles, 25) / _MAP_BUDGET))))
    every = int(np.ceil((x // block) * (y // block) * layers * cycles / _MAP_BUDGET))
    chosen = sorted({*range(0, cycles, every), cycles - 1})
    fields = (fields.isel(cycle=chosen) if every > 1 else fields).load()
    if block > 1:
        fields = fields.coarsen(x=block, y=block, boundary="trim").mean(keep_attrs=True)
        note.append(f"The map shows means of {block} × {block} cells")
    if every > 1:
        note.append(f"{'' if note else 'The map shows '}{len(chosen)} of {cycles} cycles")
    return fields, f"{', '.join(note)}; fields.nc holds all." if note else ""


def _in_steps(values: np.ndarray, layer: Layer) -> np.ndarray:
    """Return values as 16-bit steps of the last decimal that is shown; cells without a value hold the lowest number."""
    steps = np.round(values.astype(float) * 10.0**layer.decimals)
    return np.where(np.isfinite(steps), np.clip(steps, -32767, 32767), _MISSING).astype(np.int16)


def scale_of(values: np.ndarray, layer: Layer) -> dict[str, Any]:
    """Return how a quantity is shown: its step, its words, and one colour scale for all cycles.

    Parameters
    ----------
    values : (cycle, y, x) ndarray
        NaN where no cell is seen.
    layer : Layer
        The quantity.

    Notes
    -----
    The scale holds every value, unless a few cells are so far outside that they would hide all others; these have a colour of their own.
    """
    finite = values[np.isfinite(values)].astype(float)
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    inner_low, inner_high = np.percentile(finite, [0.1, 99.9]) if finite.size else (0.0, 1.0)
    if high - low > 3 * (inner_high - inner_low) > 0:
        low, high = float(inner_low), float(inner_high)
    if layer.colours == DIVERGING:
        low, high = -max(abs(low), abs(high)), max(abs(low), abs(high))
    unit = "" if layer.unit == "1" else layer.unit
    return {
        "name": layer.words, "unit": unit, "step": 10.0**-layer.decimals, "decimals": layer.decimals, "low": low,
        "high": high if high > low else low + 1.0, "palette": palette(layer.colours),
    }  # fmt: skip


def draw_line(drawn: figure, fields: xr.Dataset, position: xr.DataArray | None) -> None:
    """Draw the measured line with an arrow to its positive end, its targets, and the numbers of the first and the last.

    Parameters
    ----------
    drawn : figure
        From `draw_map`.
    fields : Dataset
        With ``target_x`` and ``target_y`` (target; mm).
    position : (target,) DataArray or None
        Target positions, mm; None: the order of the targets.
    """
    targets = fields["target"].values
    order = np.arange(targets.size)
    if position is not None:
        order = np.argsort(position.sel(target=targets).values, kind="stable")
    x, y = fields["target_x"].values[order], fields["target_y"].values[order]
    for colour, width in ((INK, 4), ("#ffffff", 1.6)):  # dark under light reads on every colour
        drawn.line(x, y, line_color=colour, line_width=width)
        drawn.scatter(x, y, marker="circle", size=width + 3, color=colour)
    if x.size > 1:
        head = NormalHead(size=11, fill_color="#ffffff", line_color=INK)
        along = np.array([x[-1] - x[-2], y[-1] - y[-2]])
        along *= 1.6 * _ROOM * (drawn.x_range.end - drawn.x_range.start) / (np.hypot(*along) or 1.0)
        drawn.add_layout(
            Arrow(
                x_start=x[-1], y_start=y[-1], x_end=x[-1] + along[0], y_end=y[-1] + along[1], end=head, line_color="#ffffff",
                line_width=2,
            )
        )  # fmt: skip
    ends = sorted({0, x.size - 1})
    drawn.text(
        x[ends], y[ends], [f"{targets[order[end]]}" for end in ends], y_offset=-7, text_align="center", text_color="#ffffff",
        text_font_size="12px", background_fill_color=INK, background_fill_alpha=0.75, padding=2,
    )  # fmt: skip


def draw_hotspots(drawn: figure, hotspots: Sequence[HotspotPart], unit: str) -> None:
    """Ring the peak of every hotspot and write its name.

    Parameters
    ----------
    drawn : figure
        From `draw_map`.
    hotspots : sequence of HotspotPart
        The part ``hotspots`` of the results.
    unit : {"mm", "px"}
        Of the plan, or of the picture that stands for it.
    """
    if not hotspots:
        return
    x, y = ([getattr(spot, f"{axis}_{unit}") for spot in hotspots] for axis in "xy")
    for colour, width in ((INK, 4), ("#ffffff", 2)):
        drawn.scatter(x, y, marker="circle", size=19, fill_color=None, line_color=colour, line_width=width)
    names = [spot.name or f"hotspot {place}" for place, spot in enumerate(hotspots, start=1)]
    drawn.text(
        x, y, names, y_offset=-13, text_align=["right" if at > np.mean([drawn.x_range.start, drawn.x_range.end]) else "left" for at in x],
        text_color="#ffffff", text_font_size="12px", background_fill_color=INK, background_fill_alpha=0.75, padding=2,
    )  # fmt: skip


def draw_sensors(drawn: figure, sensors: Sequence[ContactSensorPart]) -> None:
    """Mark the places of the contact sensors by squares with their names; faulty ones are crossed.

    Parameters
    ----------
    drawn : figure
        From `draw_map`.
    sensors : sequence of ContactSensorPart
        Those of the results.
    """
    for marker, used in (("square", True), ("square_x", False)):
        shown = [sensor for sensor in sensors if sensor.used is used]
        if not shown:
            continue
        x, y = [sensor.x_mm for sensor in shown], [sensor.y_mm for sensor in shown]
        for colour, width in ((INK, 4), ("#ffffff", 2)):
            drawn.scatter(x, y, marker=marker, size=11, fill_color=None, line_color=colour, line_width=width)
        drawn.text(
            x, y, [sensor.name for sensor in shown], y_offset=16, text_align="center", text_baseline="middle", text_color="#ffffff",
            text_font_size="12px", background_fill_color=INK, background_fill_alpha=0.75, padding=2,
        )  # fmt: skip


def _seen(kept: xr.Dataset, last: np.ndarray, hotspots: Sequence[HotspotPart], cycle: int) -> str:
    """Say what the map shows when the page opens."""
    if not np.isfinite(last).any():
        return f"Plan of the table in cycle {cycle}: no cell is seen."
    row, column = np.unravel_index(np.nanargmax(last), last.shape)
    count = len(hotspots)
    marked = f"; {count} {'hotspot is' if count == 1 else 'hotspots are'} ringed" if count else ""
    return (
        f"Plan of the table: in cycle {cycle} the rise is {number(float(np.nanmin(last)))} to {number(float(np.nanmax(last)))} K, largest "
        f"at {place(float(kept['x'][column]), float(kept['y'][row]), plan_unit(kept))}{marked}."
    )


def _columns(kept: xr.Dataset, shown: Sequence[Layer], cycle: int) -> dict[str, np.ndarray]:
    """Return the cells of the last cycle, one row each."""
    x, y = np.meshgrid(kept["x"].values, kept["y"].values)
    units = {layer.words: "" if layer.unit == "1" else f" / {layer.unit}" for layer in shown}
    values = {
        f"{layer.words}, cycle {cycle}{units[layer.words]}": kept[layer.variable].values[-1].ravel() for layer in shown
    }
    unit = plan_unit(kept)
    return {f"x / {unit}": x.ravel(), f"y / {unit}": y.ravel(), **values}
