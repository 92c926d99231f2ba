"""Charts in a page: the scripts once, each chart with its caption, its text alternative and its data."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import bokeh
import numpy as np
from bokeh.document import Document
from bokeh.models import ColumnDataSource, GlyphRenderer, Plot
from markupsafe import Markup

from fusion.report.charts.style import Chart


@dataclass(frozen=True)
class EmbeddedChart:
    """A chart as the macro ``draw`` of ``templates/charts.html.j2`` reads it.

    Attributes
    ----------
    name : str
        Unique in its page; a word of letters, digits and underscores.
    seen : str
        Text alternative.
    height : int
        CSS px that are kept free until it is drawn.
    item : Markup
        Bokeh's document as JSON that may stand in a ``<script>``.
    """

    name: str
    seen: str
    height: int
    item: Markup


def embed(charts: Mapping[str, Chart]) -> dict[str, EmbeddedChart]:
    """Return charts ready for a template.

    Parameters
    ----------
    charts : mapping of str to Chart
        By name; a name is unique in its page.

    Returns
    -------
    dict of str to EmbeddedChart
        For the variable ``figures`` of a template, which puts each in its place with ``{{ draw(name, caption) }}`` of
        ``charts.html.j2``; `chart_scripts` end the page.

    Notes
    -----
    The columns for download travel in the Bokeh document, as the first tag of the figure, compressed like every array in it; text in
    them is protected against being read as a formula when the file is written.
    """
    for chart in charts.values():
        _prepare(chart)
    return {
        name: EmbeddedChart(name, chart.seen, _height(chart), _in_script(json.dumps(item, separators=(",", ":")), "</"))
        for (name, chart), item in zip(charts.items(), _items(charts), strict=True)
    }


def _prepare(chart: Chart) -> None:
    """Take from a chart what no page needs, and add what it lets the reader download."""
    for renderer in (renderer for plot in _plots(chart) for renderer in plot.renderers):
        if isinstance(renderer, GlyphRenderer):
            # Looks of what is not selected or muted, which Bokeh adds to every mark: a page has no tool that selects or mutes.
            renderer.update(nonselection_glyph=None, muted_glyph=None)
    columns = {heading: _compact(np.asarray(values)) for heading, values in chart.columns.items()}
    chart.figure.tags = [ColumnDataSource(columns), *chart.figure.tags]


def _items(charts: Mapping[str, Chart]) -> list[dict[str, object]]:
    """Return what `bokeh.embed.json_item` returns of every chart; it also looks for mistakes in every drawing, for most of the time."""
    document = Document(title="")
    with document.models.freeze():
        for chart in charts.values():
            document.add_root(chart.figure)
    content = document.to_json(deferred=False)
    return [
        {
            "target_id": f"drawing-{name}",
            "root_id": chart.figure.id,
            "doc": {**content, "roots": [root]},
            "version": bokeh.__version__,
        }
        for (name, chart), root in zip(charts.items(), content["roots"], strict=True)
    ]


def _compact(values: np.ndarray) -> np.ndarray:
    """Return a column as it travels: numbers in single precision (seven digits), everything else as text."""
    if values.dtype.kind in "fiub":
        return values.astype(np.float32 if values.dtype.kind == "f" else np.int32)
    return values.astype(str).astype(object)


def _plots(chart: Chart) -> list[Plot]:
    """Return the figure of a chart, or those of a layout."""
    return [chart.figure] if isinstance(chart.figure, Plot) else list(chart.figure.select({"type": Plot}))


def _height(chart: Chart) -> int:
    """Return the height of a chart in CSS px: its own, or the sum of what a column of charts holds."""
    own = chart.figure.height
    return int(own) if own is not None else sum(int(plot.height or 0) for plot in _plots(chart))


@cache
def chart_scripts() -> tuple[Markup, ...]:
    """Return BokehJS and what draws the charts, as texts for script elements; once per page, after the last chart.

    Notes
    -----
    BokehJS is the copy that the installed Bokeh brings (BSD-3-Clause), without its widgets and tables.
    """
    library = (Path(bokeh.__file__).parent / "server" / "static" / "js" / "bokeh.min.js").read_text(encoding="utf-8")
    own = (resources.files("fusion.report") / "templates" / "charts.js").read_text(encoding="utf-8")
    return tuple(_in_script(text, "</script") for text in (library, own))


def _in_script(text: str, closing: str) -> Markup:
    """Return a text that may stand in a script element: nothing in its strings closes the element."""
    return Markup(text.replace(closing, closing.replace("</", "<\\/")))
