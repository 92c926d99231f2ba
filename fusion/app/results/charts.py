"""Charts of the report, linked: profile, drift, ISO 230-2, and the readings of the chosen position."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource

from fusion.app.elements import heading, paragraph
from fusion.app.results.products import Products
from fusion.app.results.selection import CYCLE, HOURS, POSITION, Linker, Selection
from fusion.products.grouped import group, has
from fusion.report.charts import drift, iso230, readings
from fusion.report.charts.style import Chart
from fusion.report.findings import drift_u_note, iso230_values, quoted_window
from interferometry.figures import ACCENT, hours_since_start


def shown(chart: Chart, caption: str) -> pn.viewable.Viewable:
    """Return a chart of the report with its caption and what is seen, in words.

    Parameters
    ----------
    chart : Chart
        Of `fusion.report.charts`.
    caption : str
        What it shows.
    """
    return pn.Column(
        paragraph(caption),
        pn.pane.Bokeh(chart.figure, sizing_mode="stretch_width"),
        paragraph(chart.seen, kind="note"),
        sizing_mode="stretch_width",
    )


def reading_hours(products: Products) -> np.ndarray | None:
    """Return the mean time of the readings of every cycle, h since the first reading; None without times.

    Parameters
    ----------
    products : Products
        Of a run.
    """
    read = products.deviations
    if read is None or np.isnat(read["time"].values).all():
        return None
    return np.asarray(hours_since_start(read).mean(["direction", "target"]).values, float)


def laser_charts(products: Products, selection: Selection, linker: Linker) -> list[pn.viewable.Viewable]:
    """Return the charts of the readings, and say which are missing.

    Parameters
    ----------
    products : Products
        Of a run.
    selection : Selection
        Of the page.
    linker : Linker
        Links every chart to the selection.
    """
    read, joint = products.deviations, products.drift
    if read is None:
        return [
            paragraph(
                "This run has no readings of a laser: there is no profile, no drift and no ISO 230-2 value.",
                kind="note",
            )
        ]
    parts: list[pn.viewable.Viewable] = []
    if joint is None:
        parts.append(
            paragraph(
                "The readings have no times: profile and drift cannot be told apart and are not shown.", kind="note"
            )
        )
    else:
        parts += _drift_charts(products, selection, linker)
    return [*parts, *_standard_charts(products, linker)]


def _drift_charts(products: Products, selection: Selection, linker: Linker) -> list[pn.viewable.Viewable]:
    """Profile, drift over time, drift as a map, and the readings of the chosen position."""
    read, joint = products.deviations, products.drift
    assert read is not None and joint is not None
    profile, course, field = (
        drift.plot_profile(joint, read["position"]),
        drift.plot_drift(joint, read),
        drift.plot_drift_map(joint, read["position"]),
    )
    linker.link(profile.figure, x=POSITION)
    linker.link(course.figure, x=HOURS)
    linker.link(field.figure, x=CYCLE, y=POSITION)
    _highlight(products, selection, course)
    note = drift_u_note(products.results.iso230)
    return [
        heading("Profile and drift", level=3),
        shown(
            profile,
            f"Deviation along the axis without drift, with its 95 % band ({note}). A click chooses the position.",
        ),
        shown(course, "Drift of every position over time; thick: the chosen position. A click chooses the cycle."),
        shown(field, "Drift over cycle and position. A click chooses both."),
        PositionHistory(products, selection, linker).view,
    ]


def _highlight(products: Products, selection: Selection, course: Chart) -> None:
    """Draw the drift of the chosen position over the others."""
    read, joint = products.deviations, products.drift
    assert read is not None and joint is not None
    hours, lines = hours_since_start(read).mean("direction"), joint["drift"].mean("direction")

    def data() -> dict[str, np.ndarray]:
        if selection.target is None:
            return {"x": np.array([]), "y": np.array([])}
        chosen = {"target": selection.target}
        return {"x": hours.sel(chosen).values, "y": lines.sel(chosen).values}

    source = ColumnDataSource(data())
    course.figure.line("x", "y", source=source, line_color=ACCENT, line_width=3)
    selection.watch(lambda: source.update(data=data()), "target")


class PositionHistory:
    """The readings of the chosen position over time.

    Parameters
    ----------
    products : Products
        Of a run with readings that have times.
    selection : Selection
        Of the page.
    linker : Linker
        Links the chart.
    """

    def __init__(self, products: Products, selection: Selection, linker: Linker) -> None:
        self._products, self._selection, self._linker = products, selection, linker
        self._unlink: Callable[[], None] = lambda: None
        self.view = pn.Column(sizing_mode="stretch_width")
        selection.watch(self._show, "target")
        self._show()

    def _show(self) -> None:
        read, joint, target = self._products.deviations, self._products.drift, self._selection.target
        if read is None or joint is None or target is None:
            self.view[:] = []
            return
        chart = readings.plot_history(read, joint, target)
        self._unlink()
        self._unlink = self._linker.link(chart.figure, x=HOURS)
        self.view[:] = [shown(chart, "Readings of the chosen position, with profile and drift through them.")]


def _standard_charts(products: Products, linker: Linker) -> list[pn.viewable.Viewable]:
    """The test by ISO 230-2, and its values along the test."""
    read, part = products.deviations, products.results.iso230
    assert read is not None
    if part is None:
        return []
    window = quoted_window(part)
    values = ", ".join(f"{symbol} = {value}" for symbol, value in iso230_values(window).items())
    parts: list[pn.viewable.Viewable] = [
        heading("ISO 230-2", level=3),
        paragraph(f"{window.window[:1].upper()}{window.window[1:]}: {values} (k = 2)."),
    ]
    if has(read, "settled"):
        chart = iso230.plot_test(group(read, "settled"), read["position"])
        linker.link(chart.figure, x=POSITION)
        parts.append(shown(chart, f"Means ± 2 s of both approaches, {window.window}."))
    windows = group(read, "iso")
    both = read["deviation"].notnull().any(("cycle", "target")).values.all()
    if both and windows.sizes.get("window", 0) > 1 and np.isfinite(windows["A"].values).any():
        chart = readings.plot_windows(windows)
        linker.link(chart.figure, x=CYCLE)
        parts.append(shown(chart, "A, R and B of windows of five cycles along the test. A click chooses the cycle."))
    return parts
