"""What the report has no room for: the readings of every position, and every cycle of the thermal map with places over time."""

from __future__ import annotations

import numpy as np
import panel as pn
import xarray as xr
from bokeh.events import Tap
from bokeh.models import ColorBar, ColumnDataSource, HoverTool, LinearColorMapper
from bokeh.plotting import figure

from fusion.app import parts as ui
from fusion.app.drawings import figure_of, shown_chart, shown_drawing, to_scale
from fusion.app.results.data import Place, Products, Selection
from fusion.report.charts import readings
from fusion.report.charts.plan import Layer, draw_followed, draw_map, draw_places, extent_of
from fusion.report.charts.style import CATEGORIES, Chart, add_series, new_figure, of_rank, palette
from fusion.report.wording import caption, say
from fusion.results.numbers import moment, number, place


def shown(chart: Chart, caption: str) -> pn.viewable.Viewable:
    """Return a chart of the report with its caption and what is seen, in words."""
    return ui.column(ui.paragraph(caption), shown_chart(chart.figure), ui.note(chart.seen))


def shown_if(chart: Chart | None, caption: str) -> ui.Parts:
    """Return a chart with its caption where there is one."""
    return [] if chart is None else [shown(chart, caption)]


def position_readings(read: xr.Dataset, joint: xr.Dataset, first: int) -> ui.Parts:
    """Return the readings over time of the position that a menu chooses, with the estimated drift through them."""
    view = ui.column()
    pairs = zip(read["target"].values.tolist(), read["position"].values.tolist(), strict=True)
    names = {say("position_words", target, place): target for target, place in sorted(pairs, key=lambda one: one[1])}
    menu = pn.widgets.Select(label="Position", options=names, value=first, width=280)

    def show(target: int) -> None:
        view[:] = [shown(readings.plot_history(read, joint, target), caption("history"))]

    menu.param.watch(lambda event: show(event.new), "value")
    show(first)
    return [menu, view]


# The thermal map with its cycles, and the temperature of chosen places over time.

#: Milliseconds from cycle to cycle while it plays.
_PLAY_MS = 400
#: Most places whose temperature is shown over time.
_MOST_PLACES = 8


class ThermalView:
    """The map of a run with a camera, and the places over time below it."""

    def __init__(self, products: Products, selection: Selection) -> None:
        self._products, self._selection = products, selection
        self._fields = products.camera
        self._layers = {layer.words: layer for layer in products.layers}
        limits = {"start": int(products.cycles[0]), "end": int(products.cycles[-1]), "value": selection.cycle}
        self._quantity = pn.widgets.Select(label="Quantity", options=list(self._layers), width=240)
        self._player = pn.widgets.Player(
            label="Cycle", interval=_PLAY_MS, loop_policy="once", show_loop_controls=False, sizing_mode="stretch_width",
            visible_buttons=["first", "previous", "pause", "play", "next", "last"], **limits,
        )  # fmt: skip
        self._cycle = pn.widgets.IntInput(label="Go to cycle", width=110, **limits)
        self._told = ui.markup("")
        self._marks = ColumnDataSource({"x": [], "y": [], "name": [], "colour": []})
        self._map = self._draw()
        self._history = ui.column()
        self._size = pn.widgets.FloatInput(label="square of / mm (0: a cell)", value=0.0, start=0.0, width=200)
        middles = {axis: round(float(self._fields[axis].values.mean()), 1) for axis in "xy"}
        self._x, self._y = (
            pn.widgets.FloatInput(label=f"{axis} / mm", value=middle, width=110) for axis, middle in middles.items()
        )
        self._add = pn.widgets.Button(label="Add place", align="end")
        self._places = pn.widgets.MultiChoice(label="Places over time", options=[], sizing_mode="stretch_width")
        self._connect()
        self._show_cycle()
        self._show_places()

    @property
    def view(self) -> pn.viewable.Viewable:
        """The map, its cycle, and the places over time."""
        legend = (
            "A click on the map adds a place to the chart below. White line: the measured axis; white frame: the "
            "area that the drift follows, where there is one; one colour scale for all cycles."
        )
        chart = shown_drawing(self._map)
        controls = ui.beside(self._x, self._y, self._size, self._add)
        quantity = ui.beside(self._quantity, self._cycle)
        return ui.column(
            quantity, self._player, self._told, chart, ui.note(legend), controls, self._places, self._history
        )

    def _connect(self) -> None:
        """Let widgets, map and selection follow each other."""
        self._quantity.param.watch(lambda event: ui.schedule_update(self._show_layer), "value")
        self._player.param.watch(lambda event: self._choose(event.new), "value")
        self._cycle.param.watch(lambda event: self._choose(event.new), "value")
        self._add.on_click(lambda event: self._add_place(self._x.value, self._y.value))
        self._places.param.watch(lambda event: self._keep(event.new), "value")
        self._selection.watch(self._show_cycle, "cycle")
        self._selection.watch(self._show_places, "places")
        self._map.on_event(Tap, lambda event: self._add_place(event.x, event.y))

    @property
    def _layer(self) -> Layer:
        return self._layers[self._quantity.value]

    def _draw(self) -> figure:
        """Draw the map of the chosen cycle with the measured line, the hotspots, the chosen position and the places."""
        fields, results = self._fields, self._products.results
        values = self._products.map_of(self._layer, self._selection.cycle)
        scale, _ = self._products.scale(self._layer)
        drawn = draw_map(values, extent_of(fields), self._layer, scale)
        read = self._products.deviations
        position = None if read is None else read["position"]
        draw_places(drawn, fields, position, results.hotspots or (), results.sensors or ())
        correlation = results.correlation
        if correlation is not None and correlation.verdict == "attributable" and correlation.source.area is not None:
            draw_followed(drawn, correlation.source.area)
        drawing = to_scale(figure_of(drawn))
        square = {"marker": "square", "size": 11, "fill_color": "colour", "line_color": "#ffffff", "line_width": 1.5}
        drawing.scatter("x", "y", source=self._marks, **square)
        return drawing

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
        self._told.object = ui.paragraph_markup(self._words(values), kind="note")

    def _words(self, values: np.ndarray) -> str:
        """Say what the map shows, for readers who do not see it."""
        fields, layer, time = self._fields, self._layer, self._products.results.time
        when = moment(fields["cycle_time"].sel(cycle=[self._selection.cycle]).values[0], time.zone if time else None)
        head = f"Cycle {self._selection.cycle} ({when}), {layer.words}: "
        if not np.isfinite(values).any():
            return head + "no cell is seen."
        at_row, at_column = np.unravel_index(np.nanargmax(values), values.shape)
        _, whole = self._products.scale(layer)
        beyond = " The colour scale is that of evenly spaced cycles; a value beyond it is light blue."
        low, high = number(float(np.nanmin(values))), number(float(np.nanmax(values)))
        at = place(float(fields["x"][at_column]), float(fields["y"][at_row]))
        return f"{head}{f'{low} to {high} {layer.printed_unit}'.rstrip()}, largest at {at}.{'' if whole else beyond}"

    def _show_layer(self) -> None:
        """Show another quantity on its own scale."""
        layer, (scale, _) = self._layer, self._products.scale(self._layer)
        mapper = self._map.select_one(LinearColorMapper)
        mapper.update(palette=palette(layer.colours), low=scale["low"], high=scale["high"])
        self._map.select_one(ColorBar).title = f"{layer.words} / {layer.unit}"
        hover = self._map.select_one({"type": HoverTool, "name": "reading"})
        hover.tooltips = [*hover.tooltips[:2], layer.tip]
        self._show_cycle()
        self._show_places()

    def _add_place(self, x_mm: float | None, y_mm: float | None) -> None:
        """Add a place inside the plan, as far as there are colours left."""
        if x_mm is None or y_mm is None or len(self._selection.places) >= _MOST_PLACES:
            return
        left, right, bottom, top = extent_of(self._fields)
        if left <= x_mm <= right and bottom <= y_mm <= top:
            size = float(self._size.value or 0.0)
            self._selection.add(Place(round(float(x_mm), 1), round(float(y_mm), 1), size))

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
        x, y = [place.x_mm for place in places], [place.y_mm for place in places]
        self._marks.data = {"x": x, "y": y, "name": names, "colour": colours}
        if not places:
            self._history[:] = [ui.note("No place is chosen: click on the map, or type x and y.")]
            return
        quantity = f"{self._layer.words} / {self._layer.unit}"
        drawn = new_figure(x="time / h", y=quantity, height=300)
        told = []
        for k, one in enumerate(places):
            values, cells = self._products.place_over_time(self._layer, *one[:3])
            add_series(drawn, self._products.field_hours, values, name=one.words, **of_rank(k))
            known = values[np.isfinite(values)]
            span = f"{number(float(known.min()))} to {number(float(known.max()))}" if known.size else "no value"
            told.append(f"{one.words} (mean of {cells} cells): {span}" if cells > 1 else f"{one.words}: {span}")
        seen = ui.note(f"{quantity[:1].upper()}{quantity[1:]} over time. {'; '.join(told)}.")
        self._history[:] = [shown_chart(drawn), seen]
