"""Positions that stand out, as cards with the field of the camera around each."""

from __future__ import annotations

import numpy as np
import panel as pn
from bokeh.models import LinearColorMapper

from fusion.app.elements import bullets, heading, paragraph
from fusion.app.results.products import Products
from fusion.app.results.selection import Selection
from fusion.app.results.thermal import to_scale
from fusion.products.results_axis import AnomalyPart
from fusion.report.charts.plan import add_cells, extent_of, new_plan
from fusion.report.charts.style import add_colour_bar, palette
from fusion.report.conclusions.answers import describe_anomaly
from fusion.report.findings import anomaly_cause, anomaly_figures, anomaly_place
from fusion.report.model_section import describe_evidence
from fusion.report.wording import conditional, number
from interferometry.figures import INK

#: Half the side of the part of the field that a card shows, mm.
_AROUND_MM = 60.0


def anomaly_cards(products: Products, selection: Selection) -> list[pn.viewable.Viewable]:
    """Return one card for each position that stands out, or say that there is none.

    Parameters
    ----------
    products : Products
        Of a run.
    selection : Selection
        Of the page.
    """
    anomalies = products.results.anomalies
    if anomalies is None:
        return [
            paragraph(
                "Whether a position stands out was not examined: that needs readings with times, of several positions and cycles.",
                kind="note",
            )
        ]
    if not anomalies:
        return [paragraph("No position stands out from the others, at a family-wise error of 5 %.")]
    return [_card(products, selection, anomaly) for anomaly in anomalies]


def _card(products: Products, selection: Selection, anomaly: AnomalyPart) -> pn.viewable.Viewable:
    """Return what stands out, what it rests on, what to inspect, and the field around it."""
    evidence = describe_evidence(anomaly.evidence)
    sentence = conditional(describe_anomaly(anomaly), products.results.inputs, *anomaly_figures(anomaly))
    place = anomaly_place(anomaly)
    show = pn.widgets.Button(label=f"Show position {anomaly.target} everywhere")
    show.on_click(lambda event: selection.param.update(target=anomaly.target))
    parts = [
        heading(f"{place[:1].upper()}{place[1:]}: {anomaly_cause(anomaly)}", level=3),
        paragraph(f"{sentence} It stands out by {evidence['stands_out']}."),
        *([paragraph("For:"), bullets(evidence["support"])] if evidence["support"] else []),
        *([paragraph("Against:"), bullets(evidence["against"])] if evidence["against"] else []),
        paragraph(f"What to inspect: {evidence['check']}"),
        show,
    ]
    around = _field_around(products, selection, anomaly.target)
    return pn.FlexBox(
        pn.Column(*parts, min_width=300, styles={"flex": "3 1 340px"}),
        pn.Column(*around, min_width=280, styles={"flex": "2 1 300px"}),
        css_classes=["card-of-position"],
    )


def _field_around(products: Products, selection: Selection, target: int) -> list[pn.viewable.Viewable]:
    """Return the rise about a position in the chosen cycle, on one scale for all cycles."""
    fields = products.fields
    if fields is None or "target_x" not in fields or target not in fields["target"].values:
        return [paragraph("The camera did not see this position.", kind="note")]
    here = fields[["target_x", "target_y"]].sel(target=target)
    x, y = float(here["target_x"]), float(here["target_y"])
    about = fields["temperature_rise"].sel(
        x=slice(x - _AROUND_MM, x + _AROUND_MM), y=slice(y - _AROUND_MM, y + _AROUND_MM)
    )
    if min(about.sizes["x"], about.sizes["y"]) < 2:
        return [paragraph("The camera did not see this position.", kind="note")]
    layer = next(layer for layer in products.layers if layer.variable == "temperature_rise")
    scale, _ = products.scale(layer)
    mapper = LinearColorMapper(palette(layer.colours), low=scale["low"], high=scale["high"], nan_color="#e1e5e7")
    extent = extent_of(about.to_dataset(name="rise"))
    drawn = new_plan(extent, height=300)
    blank = np.full((about.sizes["y"], about.sizes["x"]), np.nan)
    cells = add_cells(drawn, blank, extent, mapper, [("rise", "@image{0.00} K")])
    to_scale(drawn, cells)
    for colour, width in ((INK, 5), ("#ffffff", 2.5)):
        drawn.scatter([x], [y], marker="circle", size=15, fill_color=None, line_color=colour, line_width=width)
    add_colour_bar(drawn, mapper, "rise / K")
    told = pn.pane.HTML("", sizing_mode="stretch_width")

    def show() -> None:
        values = about.sel(cycle=selection.cycle).values
        cells.data_source.data = {"image": [values.astype(np.float32)]}
        span = (
            f"{number(float(np.nanmin(values)))} to {number(float(np.nanmax(values)))} K"
            if np.isfinite(values).any()
            else "not seen"
        )
        told.object = (
            f'<p class="note">Rise within {_AROUND_MM:.0f} mm of the position in cycle {selection.cycle}: {span}.</p>'
        )

    selection.watch(show, "cycle")
    show()
    return [pn.pane.Bokeh(drawn, sizing_mode="stretch_width"), told]
