"""Charts of a fleet: what the tests of one axis of one machine found over their dates."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fusion.report.charts.comparison import control_limits
from fusion.report.charts.style import CATEGORIES, Chart, Courses, draw, new_figure, span_words
from fusion.results.numbers import number

_MARKS = ("circle", "square")


def plot_history(dates: np.ndarray, found: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Chart:
    """Draw quantities over the dates of tests with their expanded uncertainties, and from eight tests on their control limits.

    Each is values and standard uncertainties, um, by its symbol.
    """
    order = np.argsort(dates, kind="stable")
    drawn = new_figure(x="date", y=f"{', '.join(found)} / µm", x_type="datetime", height=240)
    courses = Courses(drawn, {"date": np.datetime_as_string(dates[order], "D")})
    for (name, (values, u)), colour, marker in zip(found.items(), CATEGORIES, _MARKS, strict=False):
        value, half = values[order], 2 * np.nan_to_num(u[order])
        limits = control_limits(value[np.isfinite(value)])
        told = span_words(value, "µm")
        if limits is not None:
            for level, dash in zip(limits, ("dashed", "dotted", "dashed"), strict=True):
                draw(drawn, "HSpan", y=level, line_color=colour, line_dash=dash, line_width=1.1)
            beyond = int(((value < limits.low) | (value > limits.high)).sum())
            told += f", control limits {number(limits.low)} to {number(limits.high)} µm, {beyond} outside"
        looks = {"half": half, "colour": colour, "marker": marker}
        courses.add(dates[order], value, name, "", f"U({name}) (k = 2) / µm", seen=told, **looks)
    return courses.chart(f"{dates.size} tests")
