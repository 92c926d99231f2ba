"""Charts of a comparison: profiles over one another, what remains of their difference, scatter by position, and the trend over dates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from fusion.analysis.comparison import ComparedCampaign, PairComparison
from fusion.report.charts.style import (
    CATEGORIES,
    Chart,
    Courses,
    add_band,
    add_series,
    new_figure,
    of_rank,
    span_words,
)
from fusion.report.numbers import number
from interferometry.plots import ACCENT

_MARKS = ("circle", "square", "triangle", "diamond", "inverted_triangle", "x")
#: Values of a campaign over position, and half their 95 % intervals, from its drift in order of position.
_Values = Callable[[xr.Dataset], tuple[np.ndarray, np.ndarray]]


def plot_profiles(campaigns: Sequence[ComparedCampaign], names: Sequence[str]) -> Chart | None:
    """Draw the profiles of all campaigns, mean of the approaches, each about its mean, with their 95 % bands."""

    def profile(drift: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
        value = drift["profile"].mean("direction").values
        return value - np.nanmean(value), 2 * drift["profile_u"].mean("direction").values

    seen = "Profiles about their means"
    return _plot_campaigns(campaigns, names, profile, "deviation about its mean", seen, line=True)


def plot_scatters(campaigns: Sequence[ComparedCampaign], names: Sequence[str]) -> Chart | None:
    """Draw the scatter at every position of all campaigns."""

    def scatter(drift: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
        value, freedom = drift["scatter_position"].values, drift["scatter_freedom"].sum("direction").values
        return value, 2 * value / np.sqrt(2 * np.maximum(freedom, 1.0))

    return _plot_campaigns(campaigns, names, scatter, "scatter s", "Scatter of single readings by position", line=False)


def _plot_campaigns(
    campaigns: Sequence[ComparedCampaign],
    names: Sequence[str],
    values: _Values,
    quantity: str,
    seen: str,
    *,
    line: bool,
) -> Chart | None:
    """Draw one quantity of every campaign with readings over position: as lines with bands about zero, or as points from zero."""
    drawn = new_figure(x="position / mm", y=f"{quantity} / µm", legend_columns=1, zero=line)
    courses = Courses(drawn)
    for k, (campaign, name) in enumerate(zip(campaigns, names, strict=True)):
        if campaign.drift is None:
            continue
        drift = campaign.drift.sortby("position")
        x = drift["position"].values.astype(float)
        value, half = values(drift)
        looks = of_rank(k)
        if line:
            add_band(drawn, x, value - half, value + half, looks["colour"])
        courses.columns[f"position, {name} / mm"] = x
        heading, marker = f"{quantity.split()[0]}, {name} / µm", _MARKS[k % len(_MARKS)]
        courses.add(x, value, name, heading=heading, half=half, marker=marker, line=line, **looks)
    if not courses.told:
        return None
    if not line:
        drawn.y_range.start = 0.0
    return courses.chart(seen)


def plot_remaining(pair: PairComparison) -> Chart | None:
    """Draw the difference of two profiles beyond offset, slope and bow with its 95 % interval; positions that changed are marked."""
    if pair.profile is None:
        return None
    x, value, half = pair.profile.position_mm, pair.profile.remaining_um, 2 * pair.profile.remaining_u_um
    drawn = new_figure(x="position / mm", y="difference / µm", zero=True)
    style: dict[str, Any] = {"colour": CATEGORIES[0], "line": False, "marker": "circle", "legend": False}
    add_series(drawn, x, value, name="after − before", half=half, **style)
    changed = [change.position_mm for change in pair.changes if change.group == "profile" and change.significant]
    places = sorted({place for place in changed if place is not None})
    at = np.isin(x, places)
    if at.any():
        drawn.scatter(x[at], value[at], marker="circle", size=17, fill_color=None, line_color=ACCENT, line_width=2.5)
    marked = f"changed: {', '.join(f'{place:g} mm' for place in places)}" if places else "no position changed"
    seen = f"Difference of the profiles beyond offset, slope and bow: {span_words(value, 'µm')}; {marked}."
    return Chart(drawn, seen, {"position / mm": x, "difference / µm": value, "95 % interval ± / µm": half})


# The trend of a quantity over the dates of many tests, with the limits of a control chart of individuals.

#: Fewer tests give no limits that deserve the name: with eight, their own uncertainty is a quarter.
_LEAST_FOR_LIMITS = 8
#: Three standard deviations over the expected moving range of two values (Shewhart's d2 = 1.128).
_LIMIT_PER_RANGE = 3.0 / 1.128


class Limits(NamedTuple):
    """Middle and limits of a control chart of individuals."""

    low: float
    middle: float
    high: float


def control_limits(values: np.ndarray) -> Limits | None:
    """Return the limits of a chart of individuals with moving ranges (NIST/SEMATECH e-Handbook, 6.3.2.2); None of fewer than 8 values."""
    if values.size < _LEAST_FOR_LIMITS:
        return None
    middle, reach = float(values.mean()), _LIMIT_PER_RANGE * float(np.abs(np.diff(values)).mean())
    return Limits(middle - reach, middle, middle + reach)


def plot_trend(dates: np.ndarray, values: np.ndarray, u: np.ndarray, name: str, unit: str = "µm") -> Chart | None:
    """Draw a quantity over the dates of at least three tests with its expanded uncertainty, and from eight on its control limits."""
    known = np.isfinite(values) & ~np.isnat(dates)
    order = np.argsort(dates[known])
    when, value = dates[known][order], values[known][order]
    if value.size < 3:
        return None
    drawn = new_figure(x="date", y=f"{name} / {unit}", x_type="datetime", height=240)
    half = 2 * np.nan_to_num(u[known][order])
    add_series(drawn, when, value, name=name, colour=CATEGORIES[0], marker="circle", half=half, legend=False)
    seen = f"{name} of {value.size} tests: {span_words(value, unit)}"
    limits = control_limits(value)
    if limits is None:
        seen += f"; control limits need {_LEAST_FOR_LIMITS} tests"
    else:
        for level, dash in zip(limits, ("dashed", "solid", "dashed"), strict=True):
            drawn.hspan(level, line_color=ACCENT, line_dash=dash, line_width=1.3)
        beyond = int(((value < limits.low) | (value > limits.high)).sum())
        low, high = number(limits.low, 3), number(limits.high, 3)
        seen += f"; control limits {low} to {high} {unit}, {beyond} of {value.size} outside"
    columns = {"date": np.datetime_as_string(when, "D"), f"{name} / {unit}": value, f"± (k = 2) / {unit}": half}
    return Chart(drawn, f"{seen}.", columns)


def plot_trends(campaigns: Sequence[ComparedCampaign]) -> Mapping[str, Chart]:
    """Draw A, R and B by ISO 230-2 over the dates of campaigns."""
    tests = [(one.results.iso230, one.results.time) for one in campaigns]
    dated = [(part.settled or part, time.first[:19]) for part, time in tests if part is not None and time is not None]
    dates = np.array([first for _, first in dated], "datetime64[s]")
    charts = {}
    for name in "ARB":
        found = [getattr(part, f"{name}_um") for part, _ in dated]
        values, u = (np.array([getattr(one, key) for one in found], float) for key in ("value", "u"))
        if (chart := plot_trend(dates, values, u, name)) is not None:
            charts[f"trend_{name}"] = chart
    return charts
