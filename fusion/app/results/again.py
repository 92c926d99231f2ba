"""Change emissivity or the declared effects, and run again from the stage that changes, into a folder of its own."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import panel as pn
import tomlkit

from fusion.analysis.effects.library import library
from fusion.app import parts as ui
from fusion.app.results.data import Products
from fusion.app.run import campaign_of, failed, stages_markup
from fusion.app.runs import RUNS, RunProcess
from fusion.app.setup.campaign import Key, read_campaign
from fusion.campaign.config import load_campaign
from fusion.common import FusionError
from fusion.messages import ExitCode
from fusion.results.folder import branch_results
from fusion.results.store import file_sha256, is_file_list, write_text

# A campaign file in which emissivity or the declared effects were changed, beside the one that it came from.


def stages_again(*, emissivity: bool, declared: bool) -> str:
    """Return which stages of a run are computed again after a change, in words."""
    if emissivity:
        return "thermal fields, correlation, anomalies and closed loop are computed again; the deviations are kept"
    if declared:
        return "anomalies and closed loop are computed again; thermal fields, deviations and correlation are kept"
    return "nothing was changed"


def write_changed(campaign: Path, *, emissivity: float | None = None, declared: Sequence[str] | None = None) -> Path:
    """Write a campaign file with other values beside the one that it came from, which stays as it is."""
    before = read_campaign(campaign)
    values: dict[Key, Any] = {}
    if emissivity is not None:
        key = ("thermography", "emissivity")
        values[key], stated = emissivity, before.value(*key)
        if isinstance(stated, str) and re.search(r"\+-|±", stated):
            # With the uncertainty that was stated for the former one.
            values[key] = re.sub(r"^[^+±]*", f"{emissivity:g} ", stated)
    if declared is not None:
        values["model", "declared"] = list(declared)
    document = tomlkit.parse(before.with_values(values).text)
    for table, name in values:
        if (former := before.value(table, name)) is not None:
            item = document[table][name]
            item.comment(f"changed from {json.dumps(former, ensure_ascii=False)} {item.trivia.comment}".strip())
    changed = write_text(free_name(campaign), tomlkit.dumps(document))
    try:
        load_campaign(changed)
    except Exception:
        changed.unlink()
        raise
    return changed


def free_name(path: Path) -> Path:
    """Return the first of ``NAME_2``, ``NAME_3`` ... beside a file or folder that does not exist."""
    stem = re.sub(r"_\d+$", "", path.stem)
    number = 2
    while (chosen := path.with_name(f"{stem}_{number}{path.suffix}")).exists():
        number += 1
    return chosen


_INTERVAL_MS = 500
#: Effects that a form offers; no library has so many.
_MOST_EFFECTS = 100


def _stated(products: Products) -> tuple[float | None, list[str]]:
    """Return emissivity and declared effects of a run as its provenance states them, where that is what a run writes."""
    given = []
    for part, key in (("thermography", "emissivity"), ("model", "declared")):
        try:
            given.append(products.provenance["parameters"][part][key])
        except (KeyError, TypeError):
            given.append(None)
    value, names = given
    emissivity = float(value) if isinstance(value, int | float) and 0.0 < value <= 1.0 else None
    listed = names if isinstance(names, list) else []
    return emissivity, [name for name in listed if isinstance(name, str) and name.isidentifier()][:_MOST_EFFECTS]


class RunAgain:
    """The form of a changed run, and how the run goes."""

    def __init__(self, state: ui.State, products: Products) -> None:
        self._state, self._products = state, products
        self._before = _stated(products)
        self._emissivity = pn.widgets.FloatInput(
            label="Emissivity of the table", value=self._before[0], start=0.01, end=1.0, step=0.01, width=200
        )
        options, declared = self._effects(), self._before[1]
        self._declared = pn.widgets.CheckBoxGroup(label="Declared effects", options=options, value=declared)
        self._go = pn.widgets.Button(label="Run again", color="primary")
        self._told, self._progress = ui.column(), ui.markup("")
        for widget in (self._emissivity, self._declared):
            widget.param.watch(lambda event: self._tell(), "value")
        self._go.on_click(self._start)
        self._tell()

    @property
    def view(self) -> pn.viewable.Viewable:
        """The form."""
        campaign, title = self._campaign(), ui.heading("Change and run again", level=3)
        if campaign is None:
            lacks = "The campaign file of this run is not in the folder of the application: it cannot be changed here."
            return ui.column(title, ui.note(lacks))
        kept = (
            f"{campaign.name} and these results stay as they are: a changed copy of the file and a results folder of its own are "
            "written beside them."
        )
        camera = [self._emissivity] if self._products.fields is not None else []
        effects = (ui.paragraph("Declared effects:"), self._declared)
        return ui.column(title, ui.note(kept), *camera, *effects, self._told, self._go, self._progress)

    def _effects(self) -> list[str]:
        seen = self._products.fields is not None
        declarable = [one.name for one in library().values() if one.declarable and (seen or not one.follows_field)]
        return list(dict.fromkeys([*declarable, *self._before[1]]))

    def _campaign(self) -> Path | None:
        """Return the campaign file of the run, as far as it lies in the folder of the application."""
        folder, inputs = self._products.folder, self._products.provenance.get("inputs")
        noted = campaign_of(folder)
        read = {one["sha256"] for one in inputs.values()} if is_file_list(inputs) else set()
        for candidate in (noted, self._state.campaign, folder.parent / "campaign.toml"):
            with suppress(ui.PathError):
                found = None if candidate is None else ui.allowed_path(self._state.root, candidate)
                # Results that were moved no longer say where their file is: then it is the one with the content that was read.
                if found is not None and found.is_file() and (candidate == noted or file_sha256(found) in read):
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
        self._told[:] = [ui.note(f"{told[:1].upper()}{told[1:]}.")]

    def _start(self, event: object) -> None:
        campaign = self._campaign()
        if campaign is None:
            return
        emissivity, declared = self._changes()
        try:
            changed = write_changed(campaign, emissivity=emissivity, declared=declared)
            folder = free_name(self._products.folder)
            branch_results(self._products.folder, folder)
            run = RUNS.start(changed, folder)
        except FusionError as error:
            self._told[:] = ui.faults(error)
            return
        self._go.disabled = True
        self._told[:] = [ui.paragraph(f"{changed.name} was written; its results go to {folder.name}.", kind="done")]
        update = partial(ui.schedule_update, partial(self._update, run))
        self._watch = pn.state.add_periodic_callback(update, period=_INTERVAL_MS)

    def _update(self, run: RunProcess) -> None:
        """Show how the run goes, and its results when it is done."""
        self._progress.object = stages_markup(run)
        if run.runs:
            return
        self._watch.stop()
        if run.code == ExitCode.DONE:
            self._state.campaign = run.campaign
            self._state.results = run.results
        else:
            self._told[:] = failed(run)
