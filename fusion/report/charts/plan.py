"""Charts of the table: frame and fiducials, maps on the plan, rise over time and along the axis, drift against temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import xarray as xr

from fusion.report.charts.embedded import Figure, MapControls, Model, source
from fusion.report.charts.style import (
    CATEGORIES,
    DIVERGING,
    SEQUENTIAL,
    Chart,
    Tips,
    add_band,
    add_colour_bar,
    add_hover,
    add_ordered_lines,
    add_series,
    draw,
    mapper,
    new_figure,
    palette,
    span_words,
)
from fusion.results.axis import HotspotPart
from fusion.results.numbers import join, number, place
from fusion.results.parts import AreaPart, ContactSensorPart
from interferometry.plots import ACCENT, INK
from thermography.large_arrays import in_pieces
from thermography.plots import SHEET_COLUMNS, cycles_on_sheet

#: Temperatures of a picture are rounded to 1/32 K, far below its noise, so that it is small when it is compressed.
_STEP_PER_K = 32
#: A colour outside the scale, for values beyond its ends.
BEYOND = "#7fe3ff"
#: Room about a plan or a picture, as a share of its length, so that a mark at its rim is whole.
_ROOM = 0.025
#: Length of a recording from which its time is drawn in hours.
_LEAST_HOURS = 0.1


#: Left, right, bottom and top of a plan, mm or px.
Extent: TypeAlias = tuple[float, float, float, float]


def extent_of(cells: xr.Dataset) -> Extent:
    """Return left, right, bottom and top of the cells of the plan, mm."""
    x, y = cells["x"].values, cells["y"].values
    half = float(np.median(np.diff(x))) / 2
    return float(x[0] - half), float(x[-1] + half), float(y[0] - half), float(y[-1] + half)


def new_plan(extent: Extent, *, title: str = "") -> Figure:
    """Return an empty plan view of the table as the camera sees it: x to the right, y downwards from its origin, which is marked.

    ``templates/charts.js`` keeps a millimetre as long in both directions in whatever width the page has.
    """
    left, right, bottom, top = extent
    ranges: dict[str, Any] = {"x_range": (left, right), "y_range": (top, bottom)}
    # The height for a common width, of which scale and colour bar take their part.
    height = round(min(420.0, 560 * (top - bottom) / (right - left))) + 110
    drawn = new_figure(x="x / mm", y="y / mm", title=title, height=height, **ranges)
    drawn.name = "plan"
    drawn.set_grid(grid_line_color=None)
    if left <= 0 <= right and bottom <= 0 <= top:
        add_marks(drawn, [0], [0], "cross", 16)
        add_names(drawn, [0], [0], ["origin"], x_offset=6, y_offset=16).name = ASIDE
    return drawn


def add_cells(
    drawn: Figure, values: np.ndarray, extent: Extent, colours: Model, tips: Tips, **layers: np.ndarray
) -> Model:
    """Draw values on the plan; NaN show what is below."""
    left, right, bottom, top = extent
    held = source({name: [each.astype(np.float32)] for name, each in {"image": values, **layers}.items()})
    place: dict[str, Any] = {"x": left, "y": bottom, "dw": right - left, "dh": top - bottom}
    cells = draw(drawn, "Image", image="image", **place, color_mapper=colours, columns=held, level="image")
    add_hover(drawn, [("x", "$x{0} mm"), ("y", "$y{0} mm"), *tips], [cells])
    return cells


#: Looks of a name on a map, light on dark, which reads on every colour.
NAME: dict[str, Any] = {
    "text_color": "#ffffff", "text_font_size": "12px", "background_fill_color": INK, "background_fill_alpha": 0.75, "padding": 2,
}  # fmt: skip


#: Name of what a map on a narrow screen has no room for.
ASIDE = "aside"


def add_names(drawn: Figure, x: Any, y: Any, names: Any, **options: Any) -> Model:
    """Write names on a map."""
    return draw(drawn, "Text", x=x, y=y, text=names, **NAME, **options)


def draw_picture(
    values: np.ndarray,
    low: float,
    high: float,
    label: str,
    *,
    colours: str = SEQUENTIAL,
    block: int = 1,
    marked: bool = False,
) -> Figure:
    """Draw a picture, each value of a block of pixels, row 0 at the top, with the scale of its values; NaN stay grey.

    Where `marked`, what lies beyond the ends of the scale has a colour of its own.
    """
    rows, columns = (block * size for size in values.shape)
    beyond = {"low_color": BEYOND, "high_color": BEYOND} if marked else {}
    scale = mapper(palette(colours), low, high, nan_color="#e1e5e7", **beyond)
    room = _ROOM * columns
    ranges: dict[str, Any] = {
        "x_range": (-0.5 - room, columns - 0.5 + room),
        "y_range": (rows - 0.5 + room, -0.5 - room),
    }
    # The width that axis and scale take beside the picture, and the height of the axis below it.
    width, beside, below = 520, 120, 55
    drawn = new_figure(x="column / px", y="row / px", height=round((width - beside) * rows / columns) + below, **ranges)
    drawn.update(width=width, sizing_mode="scale_width")
    drawn.set_grid(grid_line_color=None)
    rounded = np.round(values * _STEP_PER_K) / _STEP_PER_K
    place = {"x": -0.5, "y": -0.5, "dw": columns, "dh": rows}
    picture = draw(drawn, "Image", image=[rounded.astype(np.float32)], **place, color_mapper=scale, level="image")
    name, _, unit = label.partition(" / ")
    add_hover(drawn, [("column", "$x{0}"), ("row", "$y{0}"), (name, f"@image{{0.00}} {unit}")], [picture])
    add_colour_bar(drawn, scale, label, place="right")
    return drawn


def plot_registration(
    fields: xr.Dataset, hotspots: Sequence[HotspotPart] = (), followed: AreaPart | None = None
) -> Chart:
    """Draw the reference frame, in sensor pixels, with every located fiducial and the places that matter on the plan."""
    frame = fields["reference_frame"].values
    rows, columns = frame.shape
    low, high = np.nanpercentile(frame[_on_plan(fields, frame.shape)], [1, 99])
    drawn = draw_picture(frame, float(low), float(high), "temperature / °C")
    names = [str(name) for name in fields["fiducial_name"].values]
    column, row = fields["fiducial_column"].values, fields["fiducial_row"].values
    residual = fields["fiducial_residual"].values
    held = source({"column": column, "row": row, "name": names, "residual": residual})
    looks: dict[str, Any] = {"marker": "circle", "size": 13, "fill_alpha": 0.0, "line_color": "#7fe3ff"}
    rings = draw(drawn, "Scatter", x="column", y="row", columns=held, line_width=2, **looks)
    add_names(drawn, "column", "row", "name", columns=held, x_offset=9, y_offset=-4)
    if "target_x" in fields:
        draw_both(drawn, *_to_frame(fields, fields["target_x"].values, fields["target_y"].values))
    if followed is not None:
        draw_both(drawn, *_to_frame(fields, *_rim(followed)))
    for spot in hotspots:
        at = _to_frame(fields, np.array([spot.x_mm]), np.array([spot.y_mm]))
        add_marks(drawn, *at, "circle", 19)
        add_names(
            drawn, *at, [spot.name + _span(spot)], y_offset=-13, text_align="right" if at[0] > columns / 2 else "left"
        )
    add_hover(drawn, [("fiducial", "@name"), ("residual", "@residual{0.000} mm")], [rings])
    seen = (
        f"Frame of {columns} by {rows} pixels with {len(names)} located fiducials; their residuals are up to "
        f"{number(float(np.nanmax(residual)), 2)} mm."
    )
    return Chart(drawn, seen, {"fiducial": names, "column / px": column, "row / px": row, "residual / mm": residual})


def _to_frame(fields: xr.Dataset, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return column and row of plan points; the lens distortion is one radial term through the fiducials, as drawing needs it."""
    to_sensor, half = np.linalg.inv(fields["homography"].values), np.array(fields["reference_frame"].shape[::-1]) / 2

    def ideal(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        column, row, scale = to_sensor @ np.stack([x, y, np.ones_like(x)]).astype(float)
        return np.stack([column / scale, row / scale], axis=-1) - half

    seen = np.stack([fields["fiducial_column"].values, fields["fiducial_row"].values], axis=-1) - half
    plain = ideal(fields["fiducial_x"].values, fields["fiducial_y"].values)
    radial, known = plain * (plain**2).sum(-1, keepdims=True), np.isfinite(seen).all(-1)
    share = float((radial * (seen - plain))[known].sum() / ((radial**2)[known].sum() or 1.0))
    found = ideal(x, y)
    found = found * (1 + share * (found**2).sum(-1, keepdims=True)) + half
    return found[:, 0], found[:, 1]


def _rim(area: AreaPart) -> tuple[np.ndarray, np.ndarray]:
    """Return points around a rectangle on the plan, mm."""
    x = np.array([area.x_low_mm, area.x_high_mm, area.x_high_mm, area.x_low_mm, area.x_low_mm])
    y = np.array([area.y_low_mm, area.y_low_mm, area.y_high_mm, area.y_high_mm, area.y_low_mm])
    share, corners = np.linspace(0, 4, 81), np.arange(5)
    return np.interp(share, corners, x), np.interp(share, corners, y)


def draw_both(drawn: Figure, x: np.ndarray, y: np.ndarray) -> None:
    """Draw a line dark under light, which reads on every colour."""
    for colour, width in ((INK, 4), ("#ffffff", 1.6)):
        draw(drawn, "Line", x=x, y=y, line_color=colour, line_width=width)


def _on_plan(fields: xr.Dataset, shape: tuple[int, ...]) -> np.ndarray:
    """Return which pixels of a frame show the plan, (row, column) bool; without lens distortion, as it only sets a colour scale."""
    row, column = np.indices(shape)
    x, y, scale = np.einsum("ij,jrc->irc", fields["homography"].values, np.stack([column, row, np.ones(shape)]))
    left, right, bottom, top = extent_of(fields)
    return (x / scale > left) & (x / scale < right) & (y / scale > bottom) & (y / scale < top)


def plot_rise_history(fields: xr.Dataset) -> Chart:
    """Draw the rise of the table over the test: mean over the plan, with its coolest and hottest tenth; a cycle
    without a field is a gap.
    """
    rise = fields["temperature_rise"]
    hours = _hours_since(fields["cycle_time"].values, fields["cycle_time"].values[0])
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
    drawn = new_figure(x=f"time since first cycle / {unit}", y="rise / K", zero=True)
    add_band(drawn, hours, low, high, ACCENT, "middle 80 % of the cells")
    add_series(drawn, hours, mean, name="mean of the table", colour=ACCENT)
    add_series(drawn, hours, most, name="warmest cell", colour=INK, dash="dashed")
    seen = (
        f"Rise of the table over {number(float(hours[-1]), 2)} {unit}: the mean of its cells is {span_words(mean, 'K')}, the warmest "
        f"cell reaches {number(float(np.nanmax(most)))} K."
    )
    columns = {
        "cycle": fields["cycle"].values, f"time since first cycle / {unit}": hours, "mean rise / K": mean,
        "10 % of the cells below / K": low, "90 % of the cells below / K": high, "warmest cell / K": most,
    }  # fmt: skip
    return Chart(drawn, seen, columns)


#: Cells in a row of a map of the contact sheet.
_SHEET_CELLS = 80


def plot_contact_sheet(fields: xr.Dataset) -> Chart:
    """Draw the rise of the table in cycles spread over the test beside each other, on one scale: what paper shows of the map."""
    count = fields.sizes["cycle"]
    chosen = cycles_on_sheet(fields)
    block = max(1, -(-fields.sizes["x"] // _SHEET_CELLS))
    rise = fields["temperature_rise"].isel(cycle=chosen).load()
    rise = rise.coarsen(x=block, y=block, boundary="trim").mean() if block < min(rise.shape[1:]) else rise
    left, right, bottom, top = extent_of(fields)
    width, height, cycles = right - left, top - bottom, rise["cycle"].values.tolist()
    down, across = np.divmod(np.arange(chosen.size), SHEET_COLUMNS)
    label = 0.13 * width  # a name of 11 px above a map, on a narrow screen too
    x, y = across * 1.06 * width, down * (height + label) + label
    rows = int(down[-1]) + 1
    sheet = (-0.01 * width, 1.06 * width * SHEET_COLUMNS, rows * (height + label), 0.0)
    scale = scale_of(rise.values, LAYERS[0])
    pixels = round(min(640.0, 520 * sheet[2] / sheet[1])) + 70
    drawn = new_figure(x="", y="", height=pixels, x_range=sheet[:2], y_range=sheet[2:])
    drawn.name = "plan"
    drawn.set_grid(visible=False)
    drawn.xaxis.visible = drawn.yaxis.visible = False
    colours = mapper(palette(SEQUENTIAL), scale["low"], scale["high"], nan_color="#e1e5e7")
    names = [f"cycle {cycle}" for cycle in cycles]
    held = source({"image": list(rise.values.astype(np.float32)), "x": x, "y": y, "cycle": names})
    place: dict[str, Any] = {"x": "x", "y": "y", "dw": width, "dh": height}
    maps = draw(drawn, "Image", image="image", **place, color_mapper=colours, columns=held, level="image")
    add_hover(drawn, [("", "@cycle"), LAYERS[0].tip], [maps])
    draw(drawn, "Text", x=x, y=y - 0.01 * width, text=names, text_font_size="11px", text_color=INK)
    add_colour_bar(drawn, colours, "rise / K")
    seen = f"Rise of the table in {len(cycles)} of {count} cycles on one scale: {span_words(rise.values, 'K')}."
    cells = rise.stack(cell=("cycle", "y", "x"))
    columns = {"cycle": cells["cycle"].values, "x / mm": cells["x"].values, "y / mm": cells["y"].values}
    return Chart(drawn, seen, {**columns, "rise / K": cells.values})


def plot_axis_temperature(fused: xr.Dataset) -> Chart:
    """Draw the rise of the table along the measured line, one line for every cycle."""
    order = np.argsort(fused["position"].values, kind="stable")
    place = fused["position"].values[order].astype(float)
    rise = fused["local_rise"].mean("direction").transpose("cycle", "target").values[:, order]
    shown = np.isfinite(rise).any(axis=1)
    cycle = fused["cycle"].values[shown]
    drawn = new_figure(x="position / mm", y="rise / K", zero=True)
    add_ordered_lines(drawn, [place] * int(shown.sum()), list(rise[shown]), cycle, "cycle")
    last = rise[shown][-1]
    seen = (
        f"Rise of the table under the measured line in {cycle.size} cycles: {span_words(rise, 'K')}; in the last cycle it is largest at "
        f"{place[int(np.nanargmax(last))]:g} mm ({number(float(np.nanmax(last)))} K)."
    )
    columns = {"cycle": np.repeat(cycle, place.size), "position / mm": np.tile(place, cycle.size)}
    return Chart(drawn, seen, {**columns, "rise / K": rise[shown].ravel()})


def plot_drift_temperature(fused: xr.Dataset, drift: xr.Dataset) -> Chart:
    """Draw the drift of every position against the rise of the table below it, one line for each position in the order of the cycles."""
    order = np.argsort(fused["position"].values, kind="stable")
    place = fused["position"].values[order].astype(float)
    rise = fused["local_rise"].mean("direction").transpose("target", "cycle").values[order]
    moved = drift["drift_since_first"].mean("direction").transpose("target", "cycle").values[order]
    drawn = new_figure(x="rise at the position / K", y="drift / µm", height=360, zero=True)
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


# Contact sensors over time, and the camera at the same places.


def plot_sensors(sensors: xr.Dataset) -> Chart:
    """Draw the rise of every contact sensor, and that of the camera at its place where there is one."""
    start = sensors["time"].values[0]
    if "camera_time" in sensors:
        start = min(start, sensors["camera_time"].values[0])
    drawn = new_figure(x="time since the first temperature / h", y="rise / K", height=340, legend_columns=5, zero=True)
    rows: list[tuple[str, str, np.ndarray, np.ndarray]] = []
    said = []
    for k, name in enumerate(sensors["sensor"].values):
        one, colour = sensors.sel(sensor=name), CATEGORIES[k % len(CATEGORIES)]
        hours = _hours_since(sensors["time"].values, start)
        sound = (sensors["time"].values < one["fault_time"].values) | (not bool(one["is_faulty"]))
        add_series(drawn, hours[sound], one["rise"].values[sound], name=str(name), colour=colour)
        if not sound.all():
            label = f"{name} after its fault (not used)"
            looks: dict[str, Any] = {"colour": colour, "dash": "dotted", "width": 1.0}
            add_series(drawn, hours[~sound], one["rise"].values[~sound], name=label, **looks)
        said.append(f"{name} {number(float(one['rise'].values[sound][-1]), 2)} K")
        rows.append((str(name), "contact sensor", hours, one["rise"].values))
        if "camera_rise" in sensors and bool(one["camera_rise"].notnull().any()):
            at = _hours_since(sensors["camera_time"].values, start)
            looks = {"colour": colour, "dash": "dashed", "width": 1.2}
            add_series(drawn, at, one["camera_rise"].values, name=f"camera at {name}", **looks)
            rows.append((str(name), "camera", at, one["camera_rise"].values))
    every = sensors["rise"].where(sensors["time"] < sensors["fault_time"].fillna(np.datetime64("2262-01-01", "ns")))
    seen = f"Rise of {len(said)} contact sensors: {span_words(every, 'K')}; at the end of its use {join(said)}."
    headings = ("sensor", "source", "time / h", "rise / K")
    columns = zip(*(np.broadcast_arrays(*row) for row in rows), strict=True)
    return Chart(drawn, seen, {name: np.concatenate(parts) for name, parts in zip(headings, columns, strict=True)})


def _hours_since(times: np.ndarray, start: np.datetime64) -> np.ndarray:
    return np.asarray((times - start) / np.timedelta64(1, "h"), float)


# The thermal map: the table on its plan, cycle by cycle, with a menu of quantities.

#: Largest number of map values in the file; above it cycles are thinned and cells are averaged, and the report says so.
_MAP_BUDGET = 3_000_000
_MISSING = -32768


class Layer(NamedTuple):
    """A quantity of the map: its variable in fields.nc, words, unit ("1" for none) and decimals as they are shown, and the name of its
    scale.
    """

    variable: str
    words: str
    unit: str
    decimals: int
    colours: str

    @property
    def printed_unit(self) -> str:
        """Its unit as it stands behind a number; empty for a number without unit."""
        return "" if self.unit == "1" else self.unit

    @property
    def tip(self) -> tuple[str, str]:
        """What is shown of it under the pointer."""
        return self.words, f"@image{{0.{'0' * self.decimals}}} {self.printed_unit}"


#: Quantities of the map, the first one shown first.
LAYERS = (
    Layer("temperature_rise", "rise", "K", 2, SEQUENTIAL),
    Layer("temperature", "temperature", "°C", 2, SEQUENTIAL),
    Layer("temperature_rate", "rate", "K/h", 2, DIVERGING),
    Layer("temperature_rise_u", "standard uncertainty of the rise", "K", 3, SEQUENTIAL),
    Layer("count", "frames averaged", "1", 0, SEQUENTIAL),
)


def plot_thermal_map(
    fields: xr.Dataset,
    hotspots: Sequence[HotspotPart] = (),
    position: xr.DataArray | None = None,
    *,
    sensors: Sequence[ContactSensorPart] = (),
    followed: AreaPart | None = None,
    standing_out: Set[int] = frozenset(),
) -> tuple[Chart, MapControls]:
    """Draw the plan of the table with measured line, targets, those that stand out, hotspots and the area that the drift follows."""
    shown = [layer for layer in LAYERS if layer.variable in fields]
    kept, note = _thin(fields[[layer.variable for layer in shown]])
    steps = {layer.words: _in_steps(kept[layer.variable].values, layer) for layer in shown}
    scales = [scale_of(kept[layer.variable].values, layer) for layer in shown]
    last = kept[shown[0].variable].values[-1]
    drawn = draw_map(last, extent_of(kept), shown[0], scales[0])
    draw_places(drawn, fields, position, hotspots, sensors)
    _ring_targets(drawn, fields, standing_out)
    if followed is not None:
        draw_followed(drawn, followed)
    flat = {name: values.reshape(len(values), -1) for name, values in steps.items()}
    more = {name: np.diff(values, axis=0, prepend=np.int16(0)).ravel() for name, values in flat.items()}
    drawn.tags = [source(more), {"scales": scales, "cycles": kept["cycle"].values.tolist()}]
    cycle = int(kept["cycle"][-1])
    chart = Chart(drawn, _seen(kept, last, hotspots, cycle, standing_out), _columns(kept, shown, cycle))
    return chart, MapControls([layer.words for layer in shown], kept["cycle"].values.tolist(), note)


def draw_followed(drawn: Figure, area: AreaPart) -> None:
    """Draw the area whose temperature the drift follows."""
    draw_both(drawn, *_rim(area))
    middle, bottom = (area.x_low_mm + area.x_high_mm) / 2, drawn.y_range.start
    # Below the area where there is room, which is counted downwards.
    below = bottom - area.y_high_mm > 0.12 * (bottom - drawn.y_range.end)
    place: dict[str, Any] = {"y_offset": 2 if below else -3, "text_baseline": "top" if below else "bottom"}
    add_names(drawn, [middle], [area.y_high_mm], ["the drift follows this"], text_align="center", **place).name = ASIDE


def draw_map(values: np.ndarray, extent: Extent, layer: Layer, scale: Mapping[str, Any]) -> Figure:
    """Draw one quantity in one cycle on the plan of the table."""
    left, right, bottom, top = extent
    room = _ROOM * (right - left)
    drawn = new_plan((left - room, right + room, bottom - room, top + room))
    ends: dict[str, Any] = {"low_color": BEYOND, "high_color": BEYOND}
    colours = mapper(palette(layer.colours), scale["low"], scale["high"], nan_color="#e1e5e7", name="scale", **ends)
    place: dict[str, Any] = {"x": left, "y": bottom, "dw": right - left, "dh": top - bottom}
    cells = draw(drawn, "Image", image=[values.astype(np.float32)], **place, color_mapper=colours, level="image")
    cells.name = "cells"
    add_hover(drawn, [("x", "$x{0} mm"), ("y", "$y{0} mm"), layer.tip], [cells]).name = "reading"
    add_colour_bar(drawn, colours, f"{layer.words} / {layer.unit}").name = "bar"
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
    """Return how a quantity is shown: its step, its words, and one colour scale for all cycles."""
    finite = values[np.isfinite(values)].astype(float)
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    inner_low, inner_high = np.percentile(finite, [0.1, 99.9]) if finite.size else (0.0, 1.0)
    if high - low > 3 * (inner_high - inner_low) > 0:
        low, high = float(inner_low), float(inner_high)
    if layer.colours == DIVERGING:
        low, high = -max(abs(low), abs(high)), max(abs(low), abs(high))
    return {
        "name": layer.words, "unit": layer.printed_unit, "step": 10.0**-layer.decimals, "decimals": layer.decimals, "low": low,
        "high": high if high > low else low + 1.0, "palette": palette(layer.colours),
    }  # fmt: skip


def draw_places(
    drawn: Figure,
    fields: xr.Dataset,
    position: xr.DataArray | None,
    hotspots: Sequence[HotspotPart],
    sensors: Sequence[ContactSensorPart],
) -> None:
    """Draw the measured line where it is known, the hotspots and the contact sensors over a map."""
    if "target_x" in fields:
        _draw_line(drawn, fields, position)
    _draw_hotspots(drawn, hotspots)
    _draw_sensors(drawn, sensors)


def _draw_line(drawn: Figure, fields: xr.Dataset, position: xr.DataArray | None) -> None:
    """Draw the measured line with an arrow to its positive end, its targets, and the numbers of the first and the last."""
    targets = fields["target"].values
    order = np.arange(targets.size)
    if position is not None:
        order = np.argsort(position.sel(target=targets).values, kind="stable")
    x, y = fields["target_x"].values[order], fields["target_y"].values[order]
    draw_both(drawn, x, y)
    for colour, size in ((INK, 7), ("#ffffff", 4.6)):
        draw(drawn, "Scatter", x=x, y=y, marker="circle", size=size, line_color=colour, fill_color=colour)
    if x.size > 1:
        head = Model("NormalHead", size=11, fill_color="#ffffff", line_color=INK)
        along = np.array([x[-1] - x[-2], y[-1] - y[-2]])
        along *= 1.6 * _ROOM * (drawn.x_range.end - drawn.x_range.start) / (np.hypot(*along) or 1.0)
        ends = {"x_start": x[-1], "y_start": y[-1], "x_end": x[-1] + along[0], "y_end": y[-1] + along[1]}
        drawn.add(Model("Arrow", **ends, end=head, line_color="#ffffff", line_width=2))
    named = sorted({0, x.size - 1})
    add_names(drawn, x[named], y[named], [f"{targets[order[k]]}" for k in named], y_offset=-7, text_align="center")


def _ring_targets(drawn: Figure, fields: xr.Dataset, targets: Set[int]) -> None:
    """Ring the targets that stand out and name them, below the line whose ends are numbered above it."""
    shown = [target for target in sorted(targets) if "target_x" in fields and target in fields["target"].values]
    if not shown:
        return
    x, y = (fields[f"target_{axis}"].sel(target=shown).values for axis in "xy")
    add_marks(drawn, x, y, "circle", 17)
    names = [f"position {target}" for target in shown]
    add_names(drawn, x, y, names, y_offset=12, text_align="center", text_baseline="top")


def _span(spot: HotspotPart) -> str:
    """The cycles of a hotspot that has ended, which a map of a later one does not show."""
    return "" if spot.end_cycle is None else f" (cycle {spot.onset_cycle} to {spot.end_cycle})"


def _draw_hotspots(drawn: Figure, hotspots: Sequence[HotspotPart]) -> None:
    """Ring the peak of every hotspot and write its name."""
    if not hotspots:
        return
    x, y = ([getattr(spot, f"{axis}_mm") for spot in hotspots] for axis in "xy")
    add_marks(drawn, x, y, "circle", 19)
    names = [(spot.name or f"hotspot {place}") + _span(spot) for place, spot in enumerate(hotspots, start=1)]
    middle = np.mean([drawn.x_range.start, drawn.x_range.end])
    add_names(drawn, x, y, names, y_offset=-13, text_align=["right" if at > middle else "left" for at in x])


def _draw_sensors(drawn: Figure, sensors: Sequence[ContactSensorPart]) -> None:
    """Mark the places of the contact sensors by squares with their names; faulty ones are crossed."""
    for marker, used in (("square", True), ("square_x", False)):
        shown = [sensor for sensor in sensors if sensor.used is used]
        if not shown:
            continue
        x, y = [sensor.x_mm for sensor in shown], [sensor.y_mm for sensor in shown]
        add_marks(drawn, x, y, marker, 11)
        names = [sensor.name for sensor in shown]
        add_names(drawn, x, y, names, y_offset=16, text_align="center", text_baseline="middle")


def add_marks(drawn: Figure, x: Any, y: Any, marker: str, size: int, **options: Any) -> None:
    """Draw hollow marks, light on dark, which reads on every colour."""
    for colour, width in ((INK, 4), ("#ffffff", 2)):
        looks = {"fill_color": None, "line_color": colour, "line_width": width, **options}
        draw(drawn, "Scatter", x=x, y=y, marker=marker, size=size, **looks)


def _seen(
    kept: xr.Dataset, last: np.ndarray, hotspots: Sequence[HotspotPart], cycle: int, standing_out: Set[int]
) -> str:
    """Say what the map shows when the page opens."""
    if not np.isfinite(last).any():
        return f"Plan of the table in cycle {cycle}: no cell is seen."
    row, column = np.unravel_index(np.nanargmax(last), last.shape)
    count = len(hotspots)
    marked = f"; {count} {'hotspot is' if count == 1 else 'hotspots are'} ringed" if count else ""
    ended = sum(spot.end_cycle is not None for spot in hotspots)
    marked += f", {ended} of which ended in an earlier cycle" if ended else ""
    marked += "".join(f"; position {target} is ringed" for target in sorted(standing_out))
    return (
        f"Plan of the table: in cycle {cycle} the rise is {number(float(np.nanmin(last)))} to {number(float(np.nanmax(last)))} K, largest "
        f"at {place(float(kept['x'][column]), float(kept['y'][row]))}{marked}."
    )


def _columns(kept: xr.Dataset, shown: Sequence[Layer], cycle: int) -> dict[str, np.ndarray]:
    """Return the cells of the last cycle, one row each."""
    x, y = np.meshgrid(kept["x"].values, kept["y"].values)
    units = {layer.words: "" if layer.unit == "1" else f" / {layer.unit}" for layer in shown}
    values = {
        f"{layer.words}, cycle {cycle}{units[layer.words]}": kept[layer.variable].values[-1].ravel() for layer in shown
    }
    return {"x / mm": x.ravel(), "y / mm": y.ravel(), **values}
