"""Errors of predicting blocks of a test from the others, before and after an effect was added: what tells of every kind of effect."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.report.charts.style import BEFORE, Chart, add_series, fix_range, new_figure
from fusion.report.wording import alike
from interferometry.figures import COLOURS


def plot_block_errors(errors: xr.Dataset, hours: np.ndarray, along: str) -> Chart:
    """Draw the errors of predicting blocks from the others over time, without an effect and with it.

    Parameters
    ----------
    errors : Dataset
        ``before`` and ``after``, measured minus predicted, um; NaN where nothing was left out.
    hours : (n,) ndarray
        Time along the dimension, h.
    along : str
        Dimension of time, ``cycle`` or ``time``; the root mean square is taken over all others.

    Returns
    -------
    Chart
        The root mean squares of all its errors are those that the results quote for this effect along an axis; of a record they are
        means over the channels.
    """
    others = [name for name in errors.dims if name != along]
    x = "time since first reading / h" if along == "cycle" else "time since start / h"
    drawn = new_figure(x=x, y="prediction error, rms / µm", height=300)
    columns: dict[str, np.ndarray] = {along: errors[along].values, x: hours} if along == "cycle" else {x: hours}
    stages = (("before", "without the effect", BEFORE, "dashed"), ("after", "with it", COLOURS["positive"], "solid"))
    for name, text, colour, dash in stages:
        size = np.sqrt((errors[name] ** 2).mean(others).values)
        add_series(
            drawn, hours, size, name=text, colour=colour, dash=dash, marker="circle" if along == "cycle" else None
        )
        columns[f"{text} / µm"] = size
    highest = np.nanmax([columns["without the effect / µm"], columns["with it / µm"]])
    fix_range(drawn, 0.0, 1.05 * float(highest))
    before, after = alike([float(np.sqrt((errors[name] ** 2).mean())) for name in ("before", "after")])
    counted = int(np.isfinite(columns["with it / µm"]).sum())
    unit = "cycles" if along == "cycle" else "blocks of time"
    seen = (
        f"Errors in {counted} {unit} that were left out and predicted from the others: {before} µm rms without the effect, {after} µm "
        "with it."
    )
    return Chart(drawn, seen, columns)
