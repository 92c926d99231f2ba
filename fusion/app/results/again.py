"""Change emissivity or the declared effects, and run again from the stage that changes, into a folder of its own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import panel as pn

from fusion.app.elements import heading, paragraph
from fusion.app.places import PlaceError, place_within
from fusion.app.results.changed import free_name, stages_again, write_changed
from fusion.app.results.products import Products
from fusion.app.run.process import RUNS, RunProcess
from fusion.app.run.screen import stages_markup
from fusion.app.state import State
from fusion.app.turn import in_turn
from fusion.effects.library import library
from fusion.endings import ExitCode
from fusion.errors import FusionError
from fusion.products.branch import branch_results

_INTERVAL_MS = 500
#: Effects that a form offers; no library has so many.
_MOST_EFFECTS = 100


def _stated(provenance: Mapping[str, Any], part: str, key: str) -> Any:
    """Return a parameter of a run as its provenance states it; None where that is not what a run writes."""
    level: Any = provenance
    for name in ("parameters", part, key):
        level = level.get(name) if isinstance(level, Mapping) else None
    return level


def _stated_emissivity(provenance: Mapping[str, Any]) -> float | None:
    value = _stated(provenance, "thermography", "emissivity")
    return float(value) if isinstance(value, int | float) and 0.0 < value <= 1.0 else None


def _stated_effects(provenance: Mapping[str, Any]) -> list[str]:
    names = _stated(provenance, "model", "declared")
    effects = (
        [name for name in names if isinstance(name, str) and name.isidentifier()] if isinstance(names, list) else []
    )
    return effects[:_MOST_EFFECTS]


class RunAgain:
    """The form of a changed run, and how the run goes.

    Parameters
    ----------
    state : State
        Of the page.
    products : Products
        Of the run that is shown.
    """

    def __init__(self, state: State, products: Products) -> None:
        self._state, self._products = state, products
        self._before = (_stated_emissivity(products.provenance), _stated_effects(products.provenance))
        self._emissivity = pn.widgets.FloatInput(
            label="Emissivity of the table", value=self._before[0], start=0.01, end=1.0, step=0.01, width=200
        )
        self._declared = pn.widgets.CheckBoxGroup(
            label="Declared effects", options=self._effects(), value=self._before[1]
        )
        self._go = pn.widgets.Button(label="Run again", color="primary")
        self._told = pn.Column(sizing_mode="stretch_width")
        self._progress = pn.pane.HTML("", sizing_mode="stretch_width")
        self._run: RunProcess | None = None
        for widget in (self._emissivity, self._declared):
            widget.param.watch(lambda event: self._tell(), "value")
        self._go.on_click(self._start)
        self._tell()

    @property
    def view(self) -> pn.viewable.Viewable:
        """The form."""
        campaign = self._campaign()
        if campaign is None:
            return pn.Column(
                heading("Change and run again", level=3),
                paragraph(
                    "The campaign file of this run is not in the folder of the application: it cannot be changed here.",
                    kind="note",
                ),
            )
        camera = [self._emissivity] if self._products.fields is not None else []
        return pn.Column(
            heading("Change and run again", level=3),
            paragraph(
                f"{campaign.name} and these results stay as they are: a changed copy of the file and a results folder of its own are "
                "written beside them.",
                kind="note",
            ),
            *camera,
            paragraph("Declared effects:"),
            self._declared,
            self._told,
            self._go,
            self._progress,
            sizing_mode="stretch_width",
        )

    def _effects(self) -> list[str]:
        seen = self._products.fields is not None
        declarable = [one.name for one in library().values() if one.declarable and (seen or not one.follows_field)]
        return list(dict.fromkeys([*declarable, *self._before[1]]))

    def _campaign(self) -> Path | None:
        """Return the campaign file of the run, as far as it lies in the folder of the application."""
        noted = self._products.provenance.get("campaign_file")
        candidates = [self._products.folder / noted] if isinstance(noted, str) else []
        candidates += [self._state.campaign] if self._state.campaign else []
        for candidate in candidates:
            try:
                found = place_within(self._state.root, candidate)
            except PlaceError:
                continue
            if found.is_file():
                return found
        return None

    def _changes(self) -> tuple[float | None, list[str] | None]:
        """Return what differs from the run that is shown."""
        emissivity = self._emissivity.value if self._emissivity.value != self._before[0] else None
        declared = self._declared.value if set(self._declared.value) != set(self._before[1]) else None
        return emissivity, declared

    def _tell(self) -> None:
        """Say what a run would compute again."""
        emissivity, declared = self._changes()
        self._go.disabled = emissivity is None and declared is None
        told = stages_again(emissivity=emissivity is not None, declared=declared is not None)
        self._told[:] = [paragraph(f"{told[:1].upper()}{told[1:]}.", kind="note")]

    def _start(self, event: object) -> None:
        campaign = self._campaign()
        if campaign is None:
            return
        emissivity, declared = self._changes()
        try:
            changed = write_changed(campaign, emissivity=emissivity, declared=declared)
            folder = free_name(self._products.folder)
            branch_results(self._products.folder, folder)
            self._run = RUNS.start(changed, folder)
        except FusionError as error:
            self._told[:] = [paragraph(line, kind="fault") for line in str(error).splitlines()]
            return
        self._go.disabled = True
        self._told[:] = [paragraph(f"{changed.name} was written; its results go to {folder.name}.", kind="done")]
        self._watch = pn.state.add_periodic_callback(lambda: in_turn(self._update), _INTERVAL_MS)

    def _update(self) -> None:
        """Show how the run goes, and its results when it is done."""
        run = self._run
        if run is None:
            return
        self._progress.object = stages_markup(run)
        if run.runs:
            return
        self._watch.stop()
        if run.code == ExitCode.DONE:
            self._state.campaign = run.campaign
            self._state.results = run.results
            return
        self._told[:] = [paragraph(line, kind="fault") for line in run.messages or ["The run ended without a word."]]
