"""The thermal map with its cycles, and the temperature of chosen places over time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import Tap
from bokeh.models import ColorBar, ColumnDataSource, DataRange1d, GlyphRenderer, HoverTool, LinearColorMapper
from bokeh.plotting import figure

from fusion.app.elements import paragraph, paragraph_markup
from fusion.app.results.products import Products
from fusion.app.results.selection import HOURS, Linker, Place, Selection
from fusion.app.turn import in_turn
from fusion.report.charts.plan import extent_of
from fusion.report.charts.style import CATEGORIES, DASHES, add_series, new_figure, palette
from fusion.report.charts.thermal_map import Layer, draw_hotspots, draw_line, draw_map, draw_sensors
from fusion.report.wording import moment, number, place
from interferometry.figures import INK
from thermography.fields.cycle_fields import plan_unit

#: Milliseconds from cycle to cycle while it plays.
_PLAY_MS = 400
#: Most places whose temperature is shown over time.
_MOST_PLACES = 8


class ThermalView:
    """The map, and the places over time below it.

    Parameters
    ----------
    products : Products
        Of a run with a camera.
    selection : Selection
        Of the page.
    linker : Linker
        Links the chart of the places.
    """

    def __init__(self, products: Products, selection: Selection, linker: Linker) -> None:
        self._products, self._selection, self._linker = products, selection, linker
        assert products.fields is not None
        self._unit = plan_unit(products.fields)
        self._layers = {layer.words: layer for layer in products.layers}
        self._scales: dict[str, dict[str, Any]] = {}
        self._beyond: dict[str, bool] = {}
        cycles = products.cycles
        self._quantity = pn.widgets.Select(label="Quantity", options=list(self._layers), width=240)
        self._player = pn.widgets.Player(
            label="Cycle", start=int(cycles[0]), end=int(cycles[-1]), value=selection.cycle, interval=_PLAY_MS, loop_policy="once",
            show_loop_controls=False, sizing_mode="stretch_width", visible_buttons=["first", "previous", "pause", "play", "next", "last"],
        )  # fmt: skip
        self._cycle = pn.widgets.IntInput(
            label="Go to cycle", start=int(cycles[0]), end=int(cycles[-1]), value=selection.cycle, width=110
        )
        self._told = pn.pane.HTML("", sizing_mode="stretch_width")
        self._map = self._draw()
        self._marks = ColumnDataSource({"x": [], "y": [], "name": [], "colour": []})
        self._chosen = ColumnDataSource({"x": [], "y": []})
        self._draw_marks()
        self._history = pn.Column(sizing_mode="stretch_width")
        self._unlink: Callable[[], None] = lambda: None
        self._size = pn.widgets.FloatInput(
            label=f"square of / {self._unit} (0: a cell)", value=0.0, start=0.0, width=200
        )
        self._x = pn.widgets.FloatInput(label=f"x / {self._unit}", value=_middle(products, "x"), width=110)
        self._y = pn.widgets.FloatInput(label=f"y / {self._unit}", value=_middle(products, "y"), width=110)
        self._add = pn.widgets.Button(label="Add place", align="end")
        self._places = pn.widgets.MultiChoice(label="Places over time", options=[], sizing_mode="stretch_width")
        self._connect()
        self._show_cycle()
        self._show_places()

    @property
    def view(self) -> pn.viewable.Viewable:
        """The map, its cycle, and the places over time."""
        return pn.Column(
            pn.FlexBox(self._quantity, self._cycle),
            self._player,
            self._told,
            pn.pane.Bokeh(self._map, sizing_mode="stretch_width"),
            paragraph(
                "A click on the map adds a place to the chart below. White line: the measured axis; ring: the chosen position; one colour "
                "scale for all cycles.",
                kind="note",
            ),
            pn.FlexBox(self._x, self._y, self._size, self._add),
            self._places,
            self._history,
            sizing_mode="stretch_width",
        )

    def _connect(self) -> None:
        """Let widgets, map and selection follow each other."""
        self._quantity.param.watch(lambda event: in_turn(self._show_layer), "value")
        self._player.param.watch(lambda event: self._choose(event.new), "value")
        self._cycle.param.watch(lambda event: self._choose(event.new), "value")
        self._add.on_click(lambda event: self._add_place(self._x.value, self._y.value))
        self._places.param.watch(lambda event: self._keep(event.new), "value")
        self._selection.watch(self._show_cycle, "cycle")
        self._selection.watch(self._show_target, "target")
        self._selection.watch(self._show_places, "places")
        self._map.on_event(Tap, lambda event: self._add_place(event.x, event.y))

    @property
    def _layer(self) -> Layer:
        return self._layers[self._quantity.value]

    def _scale(self) -> dict[str, Any]:
        """Return the one colour scale of the quantity."""
        words = self._layer.words
        if words not in self._scales:
            self._scales[words], whole = self._products.scale(self._layer)
            self._beyond[words] = not whole
        return self._scales[words]

    def _draw(self) -> figure:
        """Draw the map of the chosen cycle with the measured line and the hotspots."""
        fields, results = self._products.fields, self._products.results
        assert fields is not None
        values = self._products.map_of(self._layer, self._selection.cycle)
        drawn = draw_map(values, extent_of(fields), self._layer, self._scale(), unit=self._unit)
        if "target_x" in fields:
            read = self._products.deviations
            draw_line(drawn, fields, None if read is None else read["position"])
        draw_hotspots(drawn, results.hotspots or (), self._unit)
        draw_sensors(drawn, results.sensors or ())
        to_scale(drawn, drawn.select_one("cells"), downwards=self._unit == "px")
        return drawn

    def _draw_marks(self) -> None:
        """Draw the chosen position, and the places."""
        for colour, width in ((INK, 5), ("#ffffff", 2.5)):
            self._map.scatter(
                "x",
                "y",
                source=self._chosen,
                marker="circle",
                size=15,
                fill_color=None,
                line_color=colour,
                line_width=width,
            )
        self._map.scatter(
            "x",
            "y",
            source=self._marks,
            marker="square",
            size=11,
            fill_color="colour",
            line_color="#ffffff",
            line_width=1.5,
        )
        self._show_target()

    def _choose(self, cycle: int | None) -> None:
        """Choose the cycle with a number, or the nearest that there is."""
        if cycle is not None:
            cycles = self._products.cycles
            self._selection.cycle = int(cycles[int(np.argmin(np.abs(cycles - cycle)))])

    def _show_cycle(self) -> None:
        """Show the chosen cycle."""
        cycle = self._selection.cycle
        self._player.value = self._cycle.value = cycle
        values = self._products.map_of(self._layer, cycle)
        self._map.select_one("cells").data_source.data = {"image": [values.astype(np.float32)]}
        self._told.object = paragraph_markup(self._words(values), kind="note")

    def _words(self, values: np.ndarray) -> str:
        """Say what the map shows, for readers who do not see it."""
        fields, layer = self._products.fields, self._layer
        assert fields is not None
        when = moment(fields["cycle_time"].sel(cycle=[self._selection.cycle]).values[0], self._zone())
        head = f"Cycle {self._selection.cycle} ({when}), {layer.words}: "
        if not np.isfinite(values).any():
            return head + "no cell is seen."
        row, column = np.unravel_index(np.nanargmax(values), values.shape)
        unit = "" if layer.unit == "1" else f" {layer.unit}"
        beyond = (
            " The colour scale is that of evenly spaced cycles; a value beyond it is light blue."
            if self._beyond[layer.words]
            else ""
        )
        return (
            f"{head}{number(float(np.nanmin(values)))} to {number(float(np.nanmax(values)))}{unit}, largest at "
            f"{place(float(fields['x'][column]), float(fields['y'][row]), self._unit)}.{beyond}"
        )

    def _zone(self) -> str | None:
        time = self._products.results.time
        return time.zone if time else None

    def _show_layer(self) -> None:
        """Show another quantity on its own scale."""
        layer, scale = self._layer, self._scale()
        mapper = self._map.select_one(LinearColorMapper)
        mapper.update(palette=palette(layer.colours), low=scale["low"], high=scale["high"])
        unit = "1" if layer.unit == "1" else layer.unit
        self._map.select_one(ColorBar).title = f"{layer.words} / {unit}"
        tip = (layer.words, f"@image{{0.{'0' * layer.decimals}}} {'' if unit == '1' else unit}")
        self._map.select_one({"type": HoverTool, "name": "reading"}).tooltips = [
            ("x", f"$x{{0}} {self._unit}"),
            ("y", f"$y{{0}} {self._unit}"),
            tip,
        ]
        self._show_cycle()
        self._show_places()

    def _show_target(self) -> None:
        """Ring the chosen position."""
        fields, target = self._products.fields, self._selection.target
        assert fields is not None
        if target is None or "target_x" not in fields or target not in fields["target"].values:
            self._chosen.data = {"x": [], "y": []}
            return
        here = fields[["target_x", "target_y"]].sel(target=target)
        self._chosen.data = {"x": [float(here["target_x"])], "y": [float(here["target_y"])]}

    def _add_place(self, x_mm: float | None, y_mm: float | None) -> None:
        """Add a place inside the plan, as far as there are colours left."""
        if x_mm is None or y_mm is None or len(self._selection.places) >= _MOST_PLACES:
            return
        fields = self._products.fields
        assert fields is not None
        left, right, bottom, top = extent_of(fields)
        if left <= x_mm <= right and bottom <= y_mm <= top:
            self._selection.add(
                Place(round(float(x_mm), 1), round(float(y_mm), 1), float(self._size.value or 0.0), self._unit)
            )

    def _keep(self, words: list[str]) -> None:
        """Remove the places that were removed from the list."""
        kept = [place for place in self._selection.places if place.words in words]
        if kept != self._selection.places:
            self._selection.places = kept

    def _show_places(self) -> None:
        """Draw the chosen quantity at the places over time."""
        places = self._selection.places
        names = [place.words for place in places]
        self._places.param.update(options=names, value=names)
        colours = [CATEGORIES[k % len(CATEGORIES)] for k in range(len(places))]
        self._marks.data = {
            "x": [place.x_mm for place in places], "y": [place.y_mm for place in places], "name": names, "colour": colours,
        }  # fmt: skip
        if not places:
            self._history[:] = [paragraph("No place is chosen: click on the map, or type x and y.", kind="note")]
            return
        unit = "1" if self._layer.unit == "1" else self._layer.unit
        drawn = new_figure(x="time / h", y=f"{self._layer.words} / {unit}", height=300)
        told = []
        for k, one in enumerate(places):
            values, cells = self._products.place_over_time(self._layer, *one[:3])
            add_series(
                drawn,
                self._products.field_hours,
                values,
                name=one.words,
                colour=colours[k],
                dash=DASHES[k % len(DASHES)],
            )
            known = values[np.isfinite(values)]
            span = f"{number(float(known.min()))} to {number(float(known.max()))}" if known.size else "no value"
            told.append(f"{one.words} (mean of {cells} cells): {span}" if cells > 1 else f"{one.words}: {span}")
        self._unlink()
        self._unlink = self._linker.link(drawn, x=HOURS)
        self._history[:] = [
            pn.pane.Bokeh(drawn, sizing_mode="stretch_width"),
            paragraph(f"{self._layer.words.capitalize()} / {unit} over time. {'; '.join(told)}.", kind="note"),
        ]


def to_scale(drawn: figure, cells: GlyphRenderer, *, downwards: bool = False) -> None:
    """Show a millimetre of the plan as long in both directions, whatever the width of the screen.

    Parameters
    ----------
    drawn : figure
        A plan.
    cells : GlyphRenderer
        What has to be seen of it.
    downwards : bool
        Whether y grows downwards, as in a picture.
    """
    drawn.x_range = DataRange1d(renderers=[cells], range_padding=0.03)
    drawn.y_range = DataRange1d(renderers=[cells], range_padding=0.03, flipped=downwards)


def _middle(products: Products, axis: str) -> float:
    """Return the middle of the plan along an axis, mm."""
    assert products.fields is not None
    return round(float(products.fields[axis].values.mean()), 1)
