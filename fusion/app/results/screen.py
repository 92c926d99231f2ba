"""The screen *Results*."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import panel as pn

from fusion.app.elements import heading, link, paragraph
from fusion.app.places import PlaceError, folder_within
from fusion.app.report import report_link
from fusion.app.results.again import RunAgain
from fusion.app.results.charts import laser_charts, reading_hours
from fusion.app.results.closed_loop import loop_steps
from fusion.app.results.positions import anomaly_cards
from fusion.app.results.products import Products
from fusion.app.results.selection import Linker, Selection
from fusion.app.results.thermal import ThermalView
from fusion.app.state import State
from fusion.errors import FusionError
from fusion.report.conclusions.answers import headline, position_words

#: Parts of the screen, each built when it is first opened.
_PARTS = ("Map", "Laser", "Positions", "Loop", "Run again")


class ResultsScreen:
    """Shows the results of the page, and changes when these do.

    Parameters
    ----------
    state : State
        Of the page.
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self._folder = pn.widgets.TextInput(
            label="Results folder", value=str(state.results or state.root / "results"), sizing_mode="stretch_width"
        )
        open_button = pn.widgets.Button(label="Open", color="primary", align="end")
        self._content = pn.Column(sizing_mode="stretch_width")
        open_button.on_click(lambda event: self._open())
        state.param.watch(lambda event: self._take(event.new), "results")
        self.view = pn.Column(
            heading("Results"),
            pn.Row(self._folder, open_button, sizing_mode="stretch_width"),
            self._content,
            sizing_mode="stretch_width",
        )
        self._show(state.results)

    def _open(self) -> None:
        """Take the folder that was typed."""
        try:
            folder = folder_within(self._state.root, self._folder.value)
        except PlaceError as error:
            self._content[:] = [paragraph(str(error), kind="fault")]
            return
        if folder == self._state.results:
            self._show(folder)
        else:
            self._state.results = folder

    def _take(self, results: Path | None) -> None:
        if results is not None:
            self._folder.value = str(results)
        self._show(results)

    def _show(self, folder: Path | None) -> None:
        if folder is None:
            self._content[:] = [
                paragraph("No results are chosen: finish a run, or name the results folder of one.", kind="note")
            ]
            return
        try:
            self._content[:] = self._parts(Products(folder))
        except FusionError as error:
            self._content[:] = [paragraph(str(error), kind="fault")]

    def _parts(self, products: Products) -> list[pn.viewable.Viewable]:
        """The title, what is chosen, and the parts of the screen."""
        targets, cycles = products.targets, products.cycles
        flagged = [anomaly.target for anomaly in products.results.anomalies or ()]
        selection = Selection(
            cycle=int(cycles[-1]) if cycles.size else 0,
            target=flagged[0] if flagged else targets[len(targets) // 2][0] if targets else None,
        )
        hours = reading_hours(products)
        linker = Linker(
            selection, targets, cycles, hours if hours is not None or products.fields is None else products.field_hours
        )
        builders = {
            _PARTS[0]: lambda: _thermal(products, selection, linker),
            _PARTS[1]: lambda: laser_charts(products, selection, linker),
            _PARTS[2]: lambda: anomaly_cards(products, selection),
            _PARTS[3]: lambda: loop_steps(products, linker),
            _PARTS[4]: lambda: [RunAgain(self._state, products).view],
        }
        built: dict[str, pn.viewable.Viewable] = {}
        part = pn.Column(sizing_mode="stretch_width")
        chooser = pn.widgets.RadioButtonGroup(
            label="Part", options=list(_PARTS), sizing_mode="stretch_width", css_classes=["bar"]
        )

        def choose(name: str) -> None:
            if name not in built:
                built[name] = pn.Column(*_or_fault(builders[name]), sizing_mode="stretch_width")
                part.append(built[name])
            # A chart that is taken out of a page no longer hears clicks when it comes back: the other parts are hidden.
            for other, column in built.items():
                column.visible = other == name

        first = (
            _PARTS[0] if products.fields is not None else _PARTS[1] if products.deviations is not None else _PARTS[3]
        )
        chooser.value = first
        choose(first)
        chooser.param.watch(lambda event: choose(event.new), "value")
        lead = [paragraph(products.results.campaign), paragraph(headline(products.results))]
        if (products.folder / "report.html").is_file():
            lead.append(link("Open the report", report_link(self._state.root, products.folder)))
        return [*lead, *_chosen(selection, targets), chooser, part]


def _or_fault(build: Callable[[], list[pn.viewable.Viewable]]) -> list[pn.viewable.Viewable]:
    """Return a part of the screen; where its product is damaged, the reason: the other parts are shown all the same."""
    try:
        return build()
    except FusionError as error:
        return [paragraph(str(error), kind="fault")]


def _chosen(selection: Selection, targets: list[tuple[int, float]]) -> list[pn.viewable.Viewable]:
    """The menu of the position that is shown everywhere."""
    if not targets:
        return []
    names = {position_words(number, place): number for number, place in targets}
    words = {number: name for name, number in names.items()}
    menu = pn.widgets.Select(
        label="Position shown everywhere", options=list(names), value=words.get(selection.target or 0), width=280
    )
    menu.param.watch(lambda event: selection.param.update(target=names[event.new]), "value")
    selection.param.watch(lambda event: menu.param.update(value=words[event.new]), "target")
    return [menu]


def _thermal(products: Products, selection: Selection, linker: Linker) -> list[pn.viewable.Viewable]:
    if products.fields is None:
        return [paragraph("This run has no camera: there is no thermal map.", kind="note")]
    return [ThermalView(products, selection, linker).view]


def results_screen(state: State) -> pn.viewable.Viewable:
    """Build the screen *Results* for a page.

    Parameters
    ----------
    state : State
        Of the page.

    Returns
    -------
    Viewable
        Of Panel.
    """
    return ResultsScreen(state).view
