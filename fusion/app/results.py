"""The screen *Results*: the products of a run, linked: a cycle or a position that is chosen anywhere is shown everywhere."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import panel as pn
import param
import xarray as xr
from bokeh.events import Tap
from bokeh.models import ColorBar, ColumnDataSource, HoverTool, LinearColorMapper
from bokeh.plotting import figure

from fusion.app import parts as ui
from fusion.app.drawings import figure_of, shown, shown_chart, shown_drawing, to_scale
from fusion.app.parts import schedule_update
from fusion.common import FusionError
from fusion.pipeline.iso230 import read_test
from fusion.pipeline.iso230_3 import read_thermal_tests
from fusion.report.charts import readings
from fusion.report.charts.plan import LAYERS, Layer, draw_followed, draw_map, draw_places, extent_of, scale_of
from fusion.report.charts.style import CATEGORIES, add_series, new_figure, of_rank, palette
from fusion.report.page import ProductsError, print_pdf, report_of
from fusion.report.sheet import describe_sheet, write_iso230, write_thermal_tests
from fusion.report.wording import caption, say
from fusion.results.numbers import moment, number, place
from fusion.results.results import Results, read_results
from fusion.results.store import group, has, open_in_file, read_product, require_kind, require_own, write_atomically

# What the screen reads of a results folder: small tables at once, the fields of the camera one cycle or one place at a time.

#: Cycles from which the one colour scale of all cycles is taken; of a longer test evenly spaced ones.
_SCALE_CYCLES = 60
#: A fields.nc of up to so many bytes is compared with the hash of its run; reading a larger one takes longer than a screen may wait.
_HASHED_BYTES = 100_000_000


class Products:
    """The products of a finished run by its results folder, as a screen shows them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.results: Results = read_results(folder)
        self._scales: dict[str, tuple[dict[str, Any], bool]] = {}

    def __del__(self) -> None:
        """Close fields.nc where it was opened."""
        if "fields" in self.__dict__ and self.fields is not None:
            self.fields.close()

    @cached_property
    def fields(self) -> xr.Dataset | None:
        """fields.nc, opened and not read; None without a camera."""
        path = self.folder / "fields.nc"
        if not path.is_file():
            return None
        if path.stat().st_size <= _HASHED_BYTES:
            require_own(self.folder, [path.name])
        return require_kind(open_in_file(path), "fields", path)

    @cached_property
    def deviations(self) -> xr.Dataset | None:
        """Content of deviations.nc; None without a laser."""
        return read_product(self.folder, "deviations") if (self.folder / "deviations.nc").is_file() else None

    @cached_property
    def drift(self) -> xr.Dataset | None:
        """The joint estimate of profile and drift; None where the readings have no times, or there are none."""
        read = self.deviations
        return group(read, "estimate") if read is not None and has(read, "estimate") else None

    @property
    def layers(self) -> list[Layer]:
        """The quantities of the map."""
        return [] if self.fields is None else [layer for layer in LAYERS if layer.variable in self.fields]

    @property
    def cycles(self) -> np.ndarray:
        """Numbers of the cycles, of the camera or else of the laser."""
        for product in (self.fields, self.deviations):
            if product is not None:
                return np.asarray(product["cycle"].values, int)
        return np.array([], int)

    @property
    def camera(self) -> xr.Dataset:
        """fields.nc of a run that has a camera."""
        assert self.fields is not None
        return self.fields

    def map_of(self, layer: Layer, cycle: int) -> np.ndarray:
        """Return one quantity in one cycle, (y, x)."""
        return np.asarray(self.camera[layer.variable].sel(cycle=cycle).values)

    def scale(self, layer: Layer) -> tuple[dict[str, Any], bool]:
        """Return the one colour scale of a quantity, and whether all cycles entered it; the maps are read one at a time."""
        if layer.words not in self._scales:
            count = self.camera.sizes["cycle"]
            chosen = np.unique(np.linspace(0, count - 1, min(count, _SCALE_CYCLES)).astype(int))
            maps = [self.camera[layer.variable].isel(cycle=int(at)).values for at in chosen]
            self._scales[layer.words] = scale_of(np.stack(maps), layer), chosen.size == count
        return self._scales[layer.words]

    def place_over_time(self, layer: Layer, x_mm: float, y_mm: float, size_mm: float) -> tuple[np.ndarray, int]:
        """Return the mean of one quantity over a square of the plan in every cycle, (cycle,), and how many cells it has."""
        columns, rows = (_within(self.camera[axis].values, at, size_mm) for axis, at in (("x", x_mm), ("y", y_mm)))
        chosen = self.camera[layer.variable].isel(x=columns, y=rows)
        return chosen.mean(["x", "y"]).values, chosen[0].size

    @cached_property
    def field_hours(self) -> np.ndarray:
        """Mean time of the frames of every cycle, h since the first reading of the laser, or since the first cycle."""
        times = self.camera["cycle_time"].values
        read = times[:1] if self.deviations is None else self.deviations["time"].values
        known = read[~np.isnat(read)]
        return np.asarray((times - (known.min() if known.size else times[0])) / np.timedelta64(1, "h"), float)


def _within(cells: np.ndarray, at: float, size: float) -> slice:
    """Return the cells whose middle lies within half a size of a place, at least the nearest one."""
    inside = np.flatnonzero(np.abs(cells - at) <= size / 2)
    if inside.size == 0:
        inside = np.array([int(np.argmin(np.abs(cells - at)))])
    return slice(int(inside[0]), int(inside[-1]) + 1)


# What is chosen on the screen *Results*: a cycle and places on the plan.


class Place(NamedTuple):
    """Middle and side of a square of the plan whose mean temperature is shown over time, mm; side 0 is one cell."""

    x_mm: float
    y_mm: float
    size_mm: float

    @property
    def words(self) -> str:
        """The place as a legend names it."""
        size = f", {self.size_mm:g} mm square" if self.size_mm else ""
        return f"x {self.x_mm:.0f} mm, y {self.y_mm:.0f} mm{size}"


class Selection(param.Parameterized):
    """The choice of one page; places in the order in which they were added."""

    cycle: int = param.Integer()
    places: list[Place] = param.List(item_type=Place)

    def watch(self, update: Callable[[], None], name: str) -> param.parameterized.Watcher:
        """Let a chart follow one of the choices."""
        return self.param.watch(lambda event: schedule_update(update), name)

    def add(self, place: Place) -> None:
        """Add a place, once."""
        if place not in self.places:
            self.places = [*self.places, place]


# What the report has no room for: the readings of every position, and every cycle of the thermal map with places over time.


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


# The screen.


def results_screen(state: ui.State) -> pn.viewable.Viewable:
    """Build the screen *Results* for a page: the results of the page, which change when these do."""
    field = ui.text_field("Results folder", state.results or state.root / "results")
    open_button = pn.widgets.Button(label="Open", color="primary", align="end")
    content = ui.column()
    stands: list[int | None] = []

    def show(folder: Path | None) -> None:
        stands[:] = [None if folder is None else _written(folder)]
        if folder is None:
            content[:] = [ui.note("No results are chosen: finish a run, or name the results folder of one.")]
            return
        field.value = str(folder)
        content[:] = _or_fault(lambda: _parts(state, Products(folder)))

    def open_typed(event: object) -> None:
        try:
            folder = ui.allowed_folder(state.root, field.value)
        except ui.PathError as error:
            content[:] = ui.faults(error)
            return
        if folder != state.results:
            state.results = folder
        elif stands != [_written(folder)]:
            # What stands is not built anew: a click on it that is under way would be lost.
            show(folder)

    open_button.on_click(open_typed)
    state.param.watch(lambda event: show(event.new), "results")
    show(state.results)
    return ui.column(ui.heading("Results"), pn.Row(field, open_button, sizing_mode="stretch_width"), content)


def _written(folder: Path) -> int | None:
    """Return when the results of a folder were written, in ns of the system's clock; None where there are none."""
    found = folder / "results.json"
    return found.stat().st_mtime_ns if found.is_file() else None


def _parts(state: ui.State, products: Products) -> ui.Parts:
    """The title, what is chosen, and the parts of the screen."""
    cycles, report = products.cycles, products.folder / "report.html"
    selection = Selection(cycle=int(cycles[-1]) if cycles.size else 0)
    builders: dict[str, tuple[bool, Callable[[], ui.Parts]]] = {
        "Report": (report.is_file(), lambda: [ui.frame("Report", ui.report_link(state.root, products.folder))]),
        "Map": (products.fields is not None, lambda: [ThermalView(products, selection).view]),
        "Readings": (products.drift is not None, lambda: _readings(products)),
    }
    shown = {name: build for name, (there, build) in builders.items() if there}
    if not shown:
        return [ui.paragraph(products.results.campaign), ui.note(f"{report} is missing: run the campaign again.")]
    parts = {name: partial(lambda build: ui.column(*_or_fault(build)), build) for name, build in shown.items()}
    chooser, part = ui.switched("Part", parts, next(iter(parts)))
    lead = [ui.paragraph(products.results.campaign)]
    if report.is_file():
        lead.append(ui.link("Open the report in a tab of its own", ui.report_link(state.root, products.folder)))
    return [*lead, _printing(state, products), chooser, part]


def _printing(state: ui.State, products: Products) -> pn.viewable.Viewable:
    """Buttons that write the test sheet, which is signed, and print the report; then a link to the file."""
    told, folder = ui.column(), products.folder

    def button(label: str, name: str, write: Callable[[Path], object]) -> pn.widgets.Button:
        made = pn.widgets.Button(label=label)

        async def make(event: object) -> None:
            with ui.disabled_during(made), ui.telling(told):
                ui.schedule_parts(told, [ui.note(f"Writing {name}, a PDF in half a minute ...")])
                await asyncio.to_thread(_put, folder / name, write)
                ui.schedule_parts(told, [ui.link(f"Save {name}", ui.report_link(state.root, folder, name))])

        made.on_click(make)
        return made

    report = button("Report as PDF", "report.pdf", lambda out: print_pdf(report_of(folder), out))
    results = products.results
    write = _write_sheet if results.iso230 is not None else _write_thermal_sheet if results.iso230_3 else None
    made = []
    if write is not None:
        sheets = {"PDF": "sheet.pdf", "Word": "sheet.docx"}
        made = [button(f"Test sheet to sign ({kind})", name, partial(write, folder)) for kind, name in sheets.items()]
    return ui.column(ui.beside(*made, report), told)


def _put(out: Path, write: Callable[[Path], object]) -> None:
    """Write a file in place of the one that is there, once it is whole."""
    with tempfile.TemporaryDirectory() as apart:
        whole = Path(apart) / out.name
        write(whole)
        write_atomically(out, lambda part: part.write_bytes(whole.read_bytes()))


def _write_sheet(results: Path, out: Path) -> None:
    """Write the test sheet of a run by ISO 230-2."""
    test = read_test(results, None)
    sheet = describe_sheet(test.title, test.part, files=test.files, own=test.sheet)
    write_iso230(out, sheet, test.part, test.dataset, remarks=test.remarks)


def _write_thermal_sheet(results: Path, out: Path) -> None:
    """Write the sheets of a test by ISO 230-3."""
    title, tests, files, own = read_thermal_tests(results)
    if not all(one.conditions for one in tests):
        told = "these results are of an earlier version and do not say whose test it was; run the campaign again"
        raise ProductsError(f"{results}: {told}, finished stages are kept")
    write_thermal_tests(out, title, tests, files=files, own=own)


def _or_fault(build: Callable[[], ui.Parts]) -> ui.Parts:
    """Return a part of the screen; where its product is damaged, the reason: the other parts are shown all the same."""
    try:
        return build()
    except FusionError as error:
        return [ui.paragraph(str(error), kind="fault")]


def _readings(products: Products) -> ui.Parts:
    """The readings of every position, first those of one that stands out."""
    assert products.deviations is not None and products.drift is not None
    flagged = [anomaly.target for anomaly in products.results.anomalies or ()]
    first = flagged[0] if flagged else int(products.deviations["target"].values[0])
    return position_readings(products.deviations, products.drift, first)
