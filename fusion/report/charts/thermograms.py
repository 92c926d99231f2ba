"""Charts of a camera that measures alone: the hottest picture, temperatures over time, and what changed from first to last."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from fusion.common import own_name
from fusion.report.charts.models import Figure
from fusion.report.charts.plan import add_marks, add_names, draw_both, draw_picture
from fusion.report.charts.style import DIVERGING, Chart, Courses, add_series, draw, new_figure, of_rank, span_words
from fusion.results.numbers import fixed
from interferometry.plots import ACCENT
from thermography.evaluation import count_temperatures, read_profile
from thermography.io.region import Region

#: Regions that are drawn over time: more lines cannot be told apart.
MOST_LINES = 8
#: Share of the pixels that lie beyond the colour scale of a picture at either end, so that single ones do not set it.
_BEYOND = 0.1
#: Most pixels of a picture that is drawn, and of one whose values the reader can download; larger ones are averaged in blocks.
_DRAWN, _DOWNLOADED = 400_000, 40_000
#: Classes of a histogram.
_CLASSES = 60
#: Units of a time axis: from how many seconds, unit, seconds.
_TIMES = ((7200.0, "h", 3600.0), (120.0, "min", 60.0), (0.0, "s", 1.0))


def draw_thermograms(thermograms: xr.Dataset, series: str) -> dict[str, Chart]:
    """Draw what the pictures show."""
    picture = thermograms[["thermogram", "flag"]].rename(thermogram="temperature")
    regions = [Region(one["name"], one["kind"], one["points"]) for one in json.loads(thermograms.attrs["outlines"])]
    rows, columns = picture["temperature"].shape
    lines = [one for one in regions if one.kind == "line" and not one.is_cut((rows, columns))]
    charts = {"thermogram": plot_thermogram(thermograms), "histogram": plot_histogram(picture)}
    if lines:
        charts["profile"] = plot_profiles(picture, lines[:MOST_LINES])
    of_series = thermograms.isel(time=np.flatnonzero(thermograms["camera"].values == series))
    if np.unique(of_series["time"].values).size > 1:
        charts["region_history"] = plot_regions(of_series)
    if "difference" in thermograms:
        charts["difference"] = plot_difference(thermograms["difference"].values)
    return charts


def plot_thermogram(thermograms: xr.Dataset) -> Chart:
    """Draw the hottest picture with its regions and the places of its extremes."""
    values, flag = thermograms["thermogram"].values, thermograms["flag"].values
    calibrated = values[(flag == 0) & np.isfinite(values)]
    # Where pixels are beyond the calibrated range, the scale ends with it.
    marked = bool(calibrated.size and flag.any())
    ends = (calibrated.min(), calibrated.max()) if marked else np.nanpercentile(values, (_BEYOND, 100.0 - _BEYOND))
    low, high = (float(value) for value in ends)
    drawn = _draw(values, low, high if high > low else low + 1.0, "temperature / °C", marked=marked)
    for outline in json.loads(thermograms.attrs["outlines"]):
        _draw_outline(drawn, outline)
    places = {}
    for name, marker, at in (
        ("highest", "triangle", np.nanargmax(values)),
        ("lowest", "inverted_triangle", np.nanargmin(values)),
    ):
        row, column = np.unravel_index(int(at), values.shape)
        places[name] = f"{fixed(float(values[row, column]), 1)} °C at column {column}, row {row}"
        add_marks(drawn, [float(column)], [float(row)], marker, 9)
    beyond = int(np.count_nonzero(flag))
    seen = (
        f"Thermogram {thermograms.attrs['hottest']} of {values.shape[1]} by {values.shape[0]} pixels: highest {places['highest']}, lowest "
        f"{places['lowest']}; {beyond} pixels outside the calibrated range."
    )
    return Chart(drawn, seen, _columns(values, "temperature / °C"))


def _draw(values: np.ndarray, low: float, high: float, label: str, **looks: Any) -> Figure:
    """Draw a picture of any size with its places in pixels of the sensor."""
    means, block = _averaged(values, _DRAWN)
    return draw_picture(means, low, high, label, block=block, **looks)


def _averaged(values: np.ndarray, most: int) -> tuple[np.ndarray, int]:
    """Return a picture of so many pixels at most, each the mean of a block, and the side of a block."""
    block = int(np.ceil(np.sqrt(values.size / most)))
    rows, columns = (size // block for size in values.shape)
    whole = values[: rows * block, : columns * block]
    return whole.reshape(rows, block, columns, block).mean(axis=(1, 3)), block


def _columns(values: np.ndarray, label: str) -> dict[str, np.ndarray]:
    """Return what the reader can download of a picture, one row per pixel or block."""
    means, block = _averaged(values, _DOWNLOADED)
    row, column = block * np.indices(means.shape) + (block - 1) / 2
    return {"column / px": column.ravel(), "row / px": row.ravel(), label: means.ravel()}


def _draw_outline(drawn: Figure, outline: dict[str, Any]) -> None:
    """Draw a region with its name."""
    points = np.array(outline["points"], float)
    (left, top), (right, bottom) = points.min(axis=0), points.max(axis=0)
    if outline["kind"] == "spot":
        add_marks(drawn, [left], [top], "cross", 13)
    elif outline["kind"] == "ellipse":
        turn = np.linspace(0.0, 2.0 * np.pi, 61)
        points = np.column_stack(
            [(left + right + (right - left) * np.cos(turn)) / 2, (top + bottom + (bottom - top) * np.sin(turn)) / 2]
        )
    elif outline["kind"] == "box":
        points = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
    if outline["kind"] in ("box", "polygon"):
        points = np.vstack([points, points[:1]])
    if len(points) > 1:
        draw_both(drawn, *points.T)
    inside = right < 0.85 * drawn.x_range.end
    offset, align = (6, "left") if inside else (-6, "right")
    add_names(drawn, [right], [top], [outline["name"]], x_offset=offset, y_offset=-4, text_align=align)


def plot_regions(thermograms: xr.Dataset) -> Chart:
    """Draw maximum and mean of the whole picture and the mean of every region over time."""
    seconds = (thermograms["time"].values - thermograms["time"].values[0]) / np.timedelta64(1, "s")
    unit, scale = next((unit, scale) for least, unit, scale in _TIMES if seconds[-1] >= least)
    drawn = new_figure(x=f"time since the first picture / {unit}", y="temperature / °C", height=380, legend_columns=3)
    whole, *regions = thermograms["region"].values[: MOST_LINES - 1]
    highest, above = thermograms["maximum"], thermograms["overrange"] > 0
    lines = [
        ("highest of the picture", highest.sel(region=whole), above.sel(region=whole)),
        ("mean of the picture", thermograms["mean"].sel(region=whole), xr.zeros_like(above.sel(region=whole))),
        *((str(name), highest.sel(region=name), above.sel(region=name)) for name in regions),
    ]
    columns: dict[str, Any] = {f"time / {unit}": seconds / scale}
    told = []
    for rank, (name, values, beyond) in enumerate(lines):
        looks = of_rank(rank)
        marker = "circle" if seconds.size <= 100 else None
        add_series(drawn, seconds / scale, values.where(~beyond).values, name=name, marker=marker, size=4.0, **looks)
        if beyond.any():
            # The limit of the range is no temperature that was measured: what was there lies above it.
            times, limits = (each[beyond.values] for each in (seconds / scale, values.values))
            looks = {"colour": looks["colour"], "line": False, "marker": "triangle"}
            add_series(drawn, times, limits, name="above the calibrated range", **looks)
        columns[own_name(f"{name} / °C", columns)] = values.values
        told.append(f"{name} {span_words(values, '°C')}{' and above' if beyond.any() else ''}")
    return Chart(drawn, f"Temperatures in {seconds.size} pictures: {'; '.join(told)}.", columns)


def plot_profiles(picture: xr.Dataset, lines: Sequence[Region]) -> Chart:
    """Draw the temperatures along lines."""
    drawn = new_figure(x="distance along the line / px", y="temperature / °C", legend_columns=3)
    courses = Courses(drawn, unit="°C")
    for rank, line in enumerate(lines):
        along = read_profile(picture, line)
        courses.columns[own_name(f"{line.name}, distance / px", courses.columns)] = along["distance"].values
        courses.add(along["distance"].values, along.values, line.name, **of_rank(rank))
    longest = max(len(values) for values in courses.columns.values())
    for name, values in courses.columns.items():
        courses.columns[name] = np.pad(values, (0, longest - len(values)), constant_values=np.nan)
    return courses.chart("Temperatures along lines")


def plot_histogram(picture: xr.Dataset) -> Chart:
    """Draw how many pixels have which temperature; the columns to download say how many are warmer (isotherm)."""
    counts = count_temperatures(picture, bins=_CLASSES)
    values, width = counts["temperature"].values, float(counts["temperature"].diff("temperature").mean())
    most = float(values[counts.values.argmax()])
    drawn = new_figure(x="temperature / °C", y="pixels", y_type="log", height=300)
    some = counts.values > 0
    left, right = (values - width / 2)[some], (values + width / 2)[some]
    looks: dict[str, Any] = {"fill_color": ACCENT, "line_color": "#ffffff"}
    draw(drawn, "Quad", left=left, right=right, top=counts.values[some], bottom=0.5, **looks)
    seen = f"Histogram of {int(counts.sum())} pixels within the calibrated range, most at {fixed(most, 1)} °C."
    warmer = counts.values[::-1].cumsum()[::-1]
    return Chart(
        drawn, seen, {"temperature / °C": values, "pixels": counts.values, "pixels from this class up": warmer}
    )


def plot_difference(values: np.ndarray) -> Chart:
    """Draw the last picture minus the first."""
    most = float(np.nanpercentile(np.abs(values), 100.0 - _BEYOND)) or 1.0
    drawn = _draw(values, -most, most, "change / K", colours=DIVERGING)
    seen = f"Change of every pixel from the first picture to the last: {span_words(values, 'K')}."
    return Chart(drawn, seen, _columns(values, "change / K"))
