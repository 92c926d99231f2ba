"""Charts of a running test: latest field, drift and rise over the cycles, values by ISO 230-2."""

from __future__ import annotations

import numpy as np
from bokeh.models import LinearColorMapper

from fusion.app.live.session import Course
from fusion.app.results.thermal import to_scale
from fusion.report.charts.plan import add_cells, extent_of, new_plan
from fusion.report.charts.style import (
    CATEGORIES,
    Chart,
    add_colour_bar,
    add_series,
    add_zero_line,
    new_figure,
    palette,
    span_words,
)
from interferometry.figures import ACCENT, INK, MUTED


def plot_field(course: Course) -> Chart | None:
    """Draw the latest field, on the scale of all fields so far.

    Parameters
    ----------
    course : Course
        Of a test.

    Returns
    -------
    Chart or None
        None where there is no field yet.
    """
    if course.latest_field is None or course.field_range_degC is None:
        return None
    low, high = course.field_range_degC
    mapper = LinearColorMapper(palette(), low=low, high=max(high, low + 0.1), nan_color="#e1e5e7")
    extent = extent_of(course.latest_field.to_dataset(name="temperature"))
    drawn = new_plan(extent, height=320)
    cells = add_cells(drawn, course.latest_field.values, extent, mapper, [("temperature", "@image{0.00} °C")])
    to_scale(drawn, cells)
    add_colour_bar(drawn, mapper, "temperature / °C")
    seen = f"Temperature of the table in cycle {course.field_cycle}: {span_words(course.latest_field, '°C')}."
    return Chart(drawn, seen, {})


def plot_course(course: Course) -> Chart | None:
    """Draw drift and rise over the cycles.

    Parameters
    ----------
    course : Course
        Of a test.

    Returns
    -------
    Chart or None
        None before a cycle is finished.
    """
    if not course.cycle:
        return None
    cycle, told = np.array(course.cycle, float), []
    series = (
        ("drift, mean of the targets / µm", course.mean_drift_um, CATEGORIES[0], "circle"),
        ("drift at the last target / µm", course.far_drift_um, CATEGORIES[1], "square"),
        ("rise of the table / K", course.rise_K, ACCENT, "triangle"),
    )
    drawn = new_figure(x="cycle", y="since the first cycle / µm or K", legend_columns=1)
    add_zero_line(drawn)
    columns: dict[str, np.ndarray] = {"cycle": cycle}
    for name, values, colour, marker in series:
        line = np.array(values, float)
        if np.isfinite(line).any():
            add_series(drawn, cycle, line, name=name, colour=colour, marker=marker)
            columns[name] = line
            told.append(f"{name.partition(' /')[0]} {span_words(line, name.rpartition('/ ')[2])}")
    return Chart(drawn, f"{len(course.cycle)} cycles: {'; '.join(told) or 'no value yet'}.", columns)


def plot_standard(course: Course) -> Chart | None:
    """Draw accuracy A, repeatability R and reversal B of the last five cycles, after every cycle.

    Parameters
    ----------
    course : Course
        Of a test.

    Returns
    -------
    Chart or None
        None before they can be told.
    """
    if not course.iso230_cycle:
        return None
    cycle = np.array(course.iso230_cycle, float)
    drawn = new_figure(x="cycle", y="A, R, B / µm")
    columns: dict[str, np.ndarray] = {"cycle": cycle}
    told = []
    marks = (("A", INK, "circle"), ("R", ACCENT, "square"), ("B", MUTED, "diamond"))
    for symbol, colour, marker in marks:
        values = course.values(symbol)
        if np.isfinite(values).any():
            add_series(drawn, cycle, values, name=symbol, colour=colour, marker=marker)
            columns[f"{symbol} / µm"] = values
            told.append(f"{symbol} {span_words(values[-1:], 'µm').partition(' to ')[0]} µm")
    return Chart(drawn, f"By ISO 230-2, {course.window}: {', '.join(told)}.", columns)
