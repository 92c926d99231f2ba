"""The screen *Compare*."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import panel as pn

from fusion.app import parts as ui
from fusion.campaign.values import in_order
from fusion.common import FusionError
from fusion.pipeline.compare import compare_campaigns
from fusion.pipeline.iso230 import sheet_of_run
from fusion.report.comparison import render_comparison
from fusion.results.results import read_results
from fusion.results.store import write_atomically

#: Folders below the one of the application in which results are looked for, and most results that are listed.
_DEPTH, _MOST = 4, 200


def find_results(root: Path) -> tuple[list[Path], bool]:
    """Find results folders of finished runs."""
    found: list[Path] = []
    for place, folders, files in os.walk(root):
        here = Path(place)
        if "results.json" in files and "provenance.json" in files:
            found.append(here)
            folders.clear()
        depth = len(here.relative_to(root).parts)
        folders[:] = sorted(name for name in folders if not name.startswith(".") and depth < _DEPTH)
        if len(found) > _MOST:
            break
    return in_order(found[:_MOST]), len(found) <= _MOST


def label_of(root: Path, folder: Path) -> str:
    """Return what the list shows of a results folder: its path, and the campaign with the day of its first reading."""
    name = folder.relative_to(root).as_posix()
    try:
        results = read_results(folder)
    except (FusionError, OSError):
        return f"{name} (cannot be read)"
    day = f", {results.time.day}" if results.time else ""
    return f"{name}: {results.campaign}{day}"


class CompareScreen:
    """Chooses campaigns and shows what differs between them."""

    def __init__(self, state: ui.State) -> None:
        self._state = state
        self._reference = pn.widgets.Select(
            label="Reference (before a repair, or the oldest)", options={}, sizing_mode="stretch_width"
        )
        self._others = pn.widgets.CheckBoxGroup(label="Compared with it", options={})
        look = pn.widgets.Button(label="Look for results again")
        self._compare = pn.widgets.Button(label="Compare", color="primary")
        self._told, self._found = ui.column(), ui.column()
        look.on_click(lambda event: self._list())
        self._compare.on_click(self._show)
        self._reference.param.watch(lambda event: self._offer(), "value")
        self._list()
        same = "Laser, alignment and sensors stood untouched between the tests"
        self._same = pn.widgets.CheckBoxGroup(label="Set-up", options=[same])
        choice = (
            self._reference,
            ui.paragraph("Compared with it:"),
            self._others,
            self._same,
            pn.Row(self._compare, look),
        )
        self.view = ui.column(ui.heading("Compare"), *choice, self._told, self._found)

    def _list(self) -> None:
        """List the results that there are."""
        folders, whole = find_results(self._state.root)
        self._labels = {label_of(self._state.root, folder): folder for folder in folders}
        self._reference.param.update(options=self._labels, value=next(iter(self._labels.values()), None))
        self._offer()
        self._compare.disabled = len(folders) < 2
        told = (
            [] if whole else [ui.paragraph(f"More than {_MOST} results folders: the first are listed.", kind="warning")]
        )
        if self._compare.disabled:
            count = "one results folder" if folders else "no results folder"
            told.append(
                ui.note(f"There is {count} of a finished run in {self._state.root}; a comparison needs two or more.")
            )
        self._told[:] = told

    def _offer(self) -> None:
        """Offer every folder but the reference."""
        chosen = [folder for folder in self._others.value or [] if folder != self._reference.value]
        offered = {label: folder for label, folder in self._labels.items() if folder != self._reference.value}
        # In one message: a box that is ticked between two of them would be emptied by the second.
        self._others.param.update(options=offered, value=chosen)

    async def _show(self, event: object) -> None:
        others = list(self._others.value or [])
        if not others:
            self._found[:] = ui.faults("Choose at least one campaign to compare with the reference.")
            return
        with ui.disabled_during(self._compare), ui.telling(self._found):
            folders, same = [self._reference.value, *others], bool(self._same.value)
            page = await asyncio.to_thread(lambda: write_comparison(folders, same_setup=same))
            address = ui.report_link(self._state.root, page.parent, page.name)
            link = ui.link("Open the comparison in a tab of its own", address)
            ui.schedule_parts(self._found, [link, ui.frame("Comparison", address)])


def write_comparison(folders: list[Path], *, same_setup: bool) -> Path:
    """Write the page of a comparison into the results folder of the reference, in place of the one before."""
    page = render_comparison(compare_campaigns(folders, same_setup=same_setup), own=sheet_of_run(folders[-1]))
    return write_atomically(folders[0] / "comparison.html", lambda part: part.write_text(page, encoding="utf-8"))


def compare_screen(state: ui.State) -> pn.viewable.Viewable:
    """Build the screen *Compare* for a page."""
    return CompareScreen(state).view
