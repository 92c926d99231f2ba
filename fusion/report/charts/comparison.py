"""Charts of a comparison and of a fleet: profiles over one another, what remains of their difference, scatter, and trends over dates."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from fusion.analysis.comparison import ComparedCampaign, PairComparison, common_to_all, contributions
from fusion.report.charts import style
from fusion.results.numbers import number, print_unit
from interferometry.drift.estimate import scatter_limits
from interferometry.plots import ACCENT, INK

#: Height of a line of a legend, px.
_LEGEND_LINE_PX = 28
_MARKS = ("circle", "square", "triangle", "diamond", "inverted_triangle", "x")
#: Ring around a value that stands out.
_RING: dict[str, Any] = {"marker": "circle", "size": 17, "fill_color": None, "line_color": ACCENT, "line_width": 2.5}
#: Values of a campaign over position, and half their 95 % intervals (n,) or (2, n), from its drift in order of position.
_Values = Callable[[xr.Dataset], tuple[np.ndarray, np.ndarray]]


def plot_profiles(campaigns: Sequence[ComparedCampaign], names: Sequence[str]) -> style.Chart | None:
    """Draw the profiles of all campaigns, mean of the approaches, each about its mean, with their 95 % bands."""

    def profile(drift: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
        value = drift["profile"].mean("direction").values
        return value - np.nanmean(value), 2 * drift["profile_u"].mean("direction").values

    seen = "Profiles about their means"
    return _plot_campaigns(campaigns, names, profile, "deviation about its mean", seen, line=True)


def plot_scatters(campaigns: Sequence[ComparedCampaign], names: Sequence[str]) -> style.Chart | None:
    """Draw the scatter at every position of all campaigns."""

    def scatter(drift: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
        value, freedom = drift["scatter_position"].values, drift["scatter_freedom"].sum("direction").values
        low, high = scatter_limits(value, freedom, float(drift["sigma"]))
        return value, np.stack([value - low, high - value])

    return _plot_campaigns(campaigns, names, scatter, "scatter s", "Scatter of single readings by position", line=False)


def _plot_campaigns(
    campaigns: Sequence[ComparedCampaign],
    names: Sequence[str],
    values: _Values,
    quantity: str,
    seen: str,
    *,
    line: bool,
) -> style.Chart | None:
    """Draw one quantity of every campaign with readings over position: as lines with bands about zero, or as points from zero."""
    columns = 2 if len(names) <= 6 else 3
    height = 300 + math.ceil(len(names) / columns) * _LEGEND_LINE_PX
    drawn = style.new_figure(x="position / mm", y=f"{quantity} / µm", height=height, legend_columns=columns, zero=line)
    courses = style.Courses(drawn)
    for k, (campaign, name) in enumerate(zip(campaigns, names, strict=True)):
        if campaign.drift is None:
            continue
        drift = campaign.drift.sortby("position")
        x = drift["position"].values.astype(float)
        value, half = values(drift)
        looks = style.of_rank(k)
        if line:
            style.add_band(drawn, x, value - half, value + half, looks["colour"])
        courses.columns[f"position, {name} / mm"] = x
        heading, marker = f"{quantity.split()[0]}, {name} / µm", _MARKS[k % len(_MARKS)]
        courses.add(x, value, name, column=heading, half=half, marker=marker, line=line, **looks)
    if not courses.told:
        return None
    if not line:
        drawn.y_range.start = 0.0
    return courses.chart(seen)


def plot_remaining(pair: PairComparison) -> style.Chart | None:
    """Draw the difference of two profiles beyond offset, slope and bow with its 95 % interval; what changed is ringed or shaded."""
    if pair.profile is None:
        return None
    x, value, half = pair.profile.position_mm, pair.profile.remaining_um, 2 * pair.profile.remaining_u_um
    drawn = style.new_figure(x="position / mm", y="difference / µm", zero=True)
    looks: dict[str, Any] = {"colour": style.CATEGORIES[0], "line": False, "marker": "circle", "legend": False}
    style.add_series(drawn, x, value, name="after − before", half=half, **looks)
    changed = [change for change in pair.changes if change.group == "profile" and change.significant]
    places = sorted({one.position_mm for one in changed if one.position_mm is not None and one.quantity not in _RUNS})
    at = np.isin(x, places)
    if at.any():
        style.draw(drawn, "Scatter", x=x[at], y=value[at], **_RING)
    told = [f"{place:g} mm" for place in places]
    for one in changed:
        if one.quantity in _RUNS:
            assert one.position_mm is not None
            style.shade(drawn, one.position_mm, one.until_mm, 0.08)
            told.append(f"from {one.position_mm:g} mm " + ("on" if one.until_mm is None else f"to {one.until_mm:g} mm"))
    marked = f"changed: {', '.join(told)}" if told else "no position changed"
    seen = f"Difference of the profiles beyond offset, slope and bow: {style.span_words(value, 'µm')}; {marked}."
    return style.Chart(drawn, seen, {"position / mm": x, "difference / µm": value, "95 % interval ± / µm": half})


#: Changes of the profile over several positions.
_RUNS = ("step", "block")


# The trend of a quantity over the dates of many tests, with the limits of a control chart of individuals.

#: Fewer tests before the last give no limits that deserve the name: with seven, their own uncertainty is a quarter.
_LEAST_FOR_LIMITS = 7
#: Three standard deviations over the expected moving range of two values (Shewhart's d2 = 1.128).
_LIMIT_PER_RANGE = 3.0 / 1.128


class Limits(NamedTuple):
    """Middle and limits of a control chart of individuals."""

    low: float
    middle: float
    high: float


def control_limits(values: np.ndarray) -> Limits | None:
    """Return the limits of a chart of individuals with moving ranges (NIST/SEMATECH e-Handbook, 6.3.2.2); None of fewer than 7 values."""
    if values.size < _LEAST_FOR_LIMITS:
        return None
    middle, reach = float(values.mean()), _LIMIT_PER_RANGE * float(np.abs(np.diff(values)).mean())
    return Limits(middle - reach, middle, middle + reach)


@dataclass(frozen=True)
class Trend:
    """A quantity over the dates of tests, in their order, with half the length of its error bars; control limits that the tests before the
    last give, None of fewer than eight, and the upper limit that the last test states.
    """

    name: str
    unit: str
    when: np.ndarray
    value: np.ndarray
    half: np.ndarray
    limits: Limits | None
    tolerance: float | None

    @property
    def outside(self) -> np.ndarray:
        """Whether each value lies outside the control limits."""
        if self.limits is None:
            return np.zeros(self.value.size, bool)
        return (self.value < self.limits.low) | (self.value > self.limits.high)


def follow(
    dates: np.ndarray, values: np.ndarray, u: np.ndarray, name: str, unit: str = "µm", tolerance: float | None = None
) -> Trend | None:
    """Return a quantity over the dates of at least three tests; None of fewer."""
    known = np.isfinite(values) & ~np.isnat(dates)
    order = np.argsort(dates[known], kind="stable")
    value, half = values[known][order], 2 * np.nan_to_num(u[known][order])
    if value.size < 3:
        return None
    return Trend(name, unit, dates[known][order], value, half, control_limits(value[:-1]), tolerance)


def draw_trend(trend: Trend) -> style.Chart:
    """Draw a quantity over dates with its error bars, its control limits and its tolerance; values outside the limits are ringed."""
    name, unit, when, value, half, limits = trend.name, trend.unit, trend.when, trend.value, trend.half, trend.limits
    drawn = style.new_figure(x="date", y=f"{name} / {unit}", x_type="datetime", height=240)
    style.add_series(
        drawn, when, value, name=name, colour=style.CATEGORIES[0], marker="circle", half=half, legend=False
    )
    seen = f"{name} of {value.size} tests: {style.span_words(value, unit)}"
    drawn_um = [value - half, value + half]
    if limits is None:
        seen += f"; control limits need {_LEAST_FOR_LIMITS + 1} tests"
    else:
        for level, dash in zip(limits, ("dashed", "solid", "dashed"), strict=True):
            style.draw(drawn, "HSpan", y=level, line_color=ACCENT, line_dash=dash, line_width=1.3)
        drawn_um.append(np.array(limits))
        at = trend.outside
        if at.any():
            style.draw(drawn, "Scatter", x=when[at], y=value[at], **_RING)
        low, high = number(limits.low, 3), number(limits.high, 3)
        seen += f"; control limits {low} to {high} {unit}, {int(at.sum())} of {value.size} outside"
    if trend.tolerance is not None:
        style.draw(drawn, "HSpan", y=trend.tolerance, line_color=INK, line_dash="dotted", line_width=1.6)
        style.add_label(drawn, when[0], trend.tolerance, "tolerance", offset=(0, 3), size="11px")
        drawn_um.append(np.array([trend.tolerance]))
        seen += f"; tolerance {trend.tolerance:g} {unit}"
    style.fix_range(drawn, *style.shared_range(*drawn_um))
    columns = {"date": np.datetime_as_string(when, "D"), f"{name} / {unit}": value, f"± (k = 2) / {unit}": half}
    return style.Chart(drawn, f"{seen}.", columns)


def follow_trends(pairs: Sequence[PairComparison]) -> list[Trend]:
    """Return A, R and B by ISO 230-2 over the dates of tests; their error bars leave out what all tests have in common."""
    tests = [pairs[0].before, *(pair.after for pair in pairs if pair.changes)]
    dated = [
        (one.results.iso230, one.results.time.day)
        for one in tests
        if one.results.iso230 is not None and one.results.time is not None
    ]
    parts, dates = [part for part, _ in dated], np.array([first for _, first in dated], "datetime64[s]")
    trends = []
    for name in "ARB":
        found = [getattr(part, f"{name}_um") for part in parts]
        values, u = (np.array([getattr(one, key) for one in found], float) for key in ("value", "u"))
        shares = [np.array(contributions(parts, one, name)) for one in common_to_all(pairs)]
        own = u**2 - sum(2.0 * share * share.mean() - share.mean() ** 2 for share in shares)
        stated = {one.quantity: one.limit_um for one in parts[int(np.argmax(dates))].tolerances} if parts else {}
        unit = print_unit(parts[0].unit) if parts else ""
        trend = follow(dates, values, np.sqrt(np.maximum(own, 0.0)), name, unit, stated.get(name))
        trends += [] if trend is None else [trend]
    return trends


# A fleet: what the tests of one axis of one machine found over their dates.


def plot_history(dates: np.ndarray, found: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> style.Chart:
    """Draw quantities over the dates of tests with their expanded uncertainties, and from eight tests on their control limits.

    Each is values and standard uncertainties, um, by its symbol.
    """
    order = np.argsort(dates, kind="stable")
    drawn = style.new_figure(x="date", y=f"{', '.join(found)} / µm", x_type="datetime", height=240)
    courses = style.Courses(drawn, {"date": np.datetime_as_string(dates[order], "D")})
    for (name, (values, u)), colour, marker in zip(found.items(), style.CATEGORIES, _MARKS, strict=False):
        value, half = values[order], 2 * np.nan_to_num(u[order])
        limits = control_limits(value[np.isfinite(value)])
        told = style.span_words(value, "µm")
        if limits is not None:
            for level, dash in zip(limits, ("dashed", "dotted", "dashed"), strict=True):
                style.draw(drawn, "HSpan", y=level, line_color=colour, line_dash=dash, line_width=1.1)
            beyond = int(((value < limits.low) | (value > limits.high)).sum())
            told += f", control limits {number(limits.low)} to {number(limits.high)} µm, {beyond} outside"
        looks = {"half": half, "colour": colour, "marker": marker}
        courses.add(dates[order], value, name, "", f"U({name}) (k = 2) / µm", seen=told, **looks)
    return courses.chart(f"{dates.size} tests")
