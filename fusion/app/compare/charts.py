"""Charts of a comparison: profiles over one another, what remains of their difference, scatter by position."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion.comparison.campaigns import ComparedCampaign, PairComparison
from fusion.report.charts.style import (
    CATEGORIES,
    DASHES,
    Chart,
    add_band,
    add_series,
    add_zero_line,
    new_figure,
    span_words,
)
from interferometry.figures import ACCENT

_MARKS = ("circle", "square", "triangle", "diamond", "inverted_triangle", "x")


def plot_profiles(campaigns: Sequence[ComparedCampaign], names: Sequence[str]) -> Chart | None:
    """Draw the profiles of all campaigns, mean of the approaches, each about its mean, with their 95 % bands.

    Parameters
    ----------
    campaigns : sequence of ComparedCampaign
        Those without readings are left out.
    names : sequence of str
        For the legend.

    Returns
    -------
    Chart or None
        None where no campaign has a profile.
    """
    drawn = new_figure(x="position / mm", y="deviation about its mean / µm", legend_columns=1)
    add_zero_line(drawn)
    columns: dict[str, np.ndarray] = {}
    told = []
    for k, (campaign, name) in enumerate(zip(campaigns, names, strict=True)):
        if campaign.drift is None:
            continue
        drift = campaign.drift.sortby("position")
        x = drift["position"].values.astype(float)
        value = drift["profile"].mean("direction").values
        value, half = value - np.nanmean(value), 2 * drift["profile_u"].mean("direction").values
        colour = CATEGORIES[k % len(CATEGORIES)]
        add_band(drawn, x, value - half, value + half, colour)
        add_series(
            drawn,
            x,
            value,
            name=name,
            colour=colour,
            dash=DASHES[k % len(DASHES)],
            marker=_MARKS[k % len(_MARKS)],
            half=half,
        )
        columns |= {f"position, {name} / mm": x, f"deviation, {name} / µm": value}
        told.append(f"{name} {span_words(value, 'µm')}")
    if not told:
        return None
    return Chart(drawn, f"Profiles about their means: {'; '.join(told)}.", columns)


def plot_remaining(pair: PairComparison) -> Chart | None:
    """Draw the difference of two profiles beyond offset, slope and bow with its 95 % interval; positions that changed are marked.

    Parameters
    ----------
    pair : PairComparison
        One campaign against the reference.

    Returns
    -------
    Chart or None
        None where the profiles cannot be compared.
    """
    if pair.profile is None:
        return None
    x, value, half = pair.profile.position_mm, pair.profile.remaining_um, 2 * pair.profile.remaining_u_um
    drawn = new_figure(x="position / mm", y="difference / µm")
    add_zero_line(drawn)
    add_series(
        drawn,
        x,
        value,
        name="after − before",
        colour=CATEGORIES[0],
        line=False,
        marker="circle",
        half=half,
        legend=False,
    )
    changed = [change.position_mm for change in pair.changes if change.group == "profile" and change.significant]
    places = sorted({place for place in changed if place is not None})
    at = np.isin(x, places)
    if at.any():
        drawn.scatter(x[at], value[at], marker="circle", size=17, fill_color=None, line_color=ACCENT, line_width=2.5)
    marked = f"changed: {', '.join(f'{place:g} mm' for place in places)}" if places else "no position changed"
    return Chart(
        drawn,
        f"Difference of the profiles beyond offset, slope and bow: {span_words(value, 'µm')}; {marked}.",
        {"position / mm": x, "difference / µm": value, "95 % interval ± / µm": half},
    )


def plot_scatters(campaigns: Sequence[ComparedCampaign], names: Sequence[str]) -> Chart | None:
    """Draw the scatter at every position of all campaigns.

    Parameters
    ----------
    campaigns : sequence of ComparedCampaign
        Those without readings are left out.
    names : sequence of str
        For the legend.

    Returns
    -------
    Chart or None
        None where no campaign has readings.
    """
    drawn = new_figure(x="position / mm", y="scatter s / µm", legend_columns=1)
    columns: dict[str, np.ndarray] = {}
    told = []
    for k, (campaign, name) in enumerate(zip(campaigns, names, strict=True)):
        if campaign.drift is None:
            continue
        drift = campaign.drift.sortby("position")
        x, value = drift["position"].values.astype(float), drift["scatter_position"].values
        freedom = drift["scatter_freedom"].sum("direction").values
        half = 2 * value / np.sqrt(2 * np.maximum(freedom, 1.0))
        add_series(
            drawn,
            x,
            value,
            name=name,
            colour=CATEGORIES[k % len(CATEGORIES)],
            line=False,
            marker=_MARKS[k % len(_MARKS)],
            half=half,
        )
        columns |= {f"position, {name} / mm": x, f"scatter, {name} / µm": value}
        told.append(f"{name} {span_words(value, 'µm')}")
    if not told:
        return None
    drawn.y_range.start = 0.0
    return Chart(drawn, f"Scatter of single readings by position: {'; '.join(told)}.", columns)
