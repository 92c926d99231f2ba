"""The screen *Compare*."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import panel as pn

from fusion.analysis.comparison import PairComparison
from fusion.app import parts as ui
from fusion.app.results.charts import shown_if, table_of
from fusion.campaign.values import in_order
from fusion.common import FusionError
from fusion.pipeline.compare import compare_campaigns
from fusion.report.charts.comparison import draw_trend, follow_trends, plot_profiles, plot_remaining, plot_scatters
from fusion.report.comparison import (
    campaign_names,
    changes_table,
    compared_tests,
    comparison_notes,
    conclude_comparison,
    describe_places,
    short_names,
    side_by_side,
    trend_caption,
    trend_notes,
)
from fusion.results.results import read_results

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
            pairs = await asyncio.to_thread(lambda: compare_campaigns(folders, same_setup=same))
            ui.schedule_parts(self._found, comparison_parts(pairs))


def comparison_parts(pairs: list[PairComparison]) -> ui.Parts:
    """Return a comparison as parts of a screen: what changed first, then the figures side by side, charts, and every quantity."""
    names, short, tests = campaign_names(pairs), short_names(pairs), compared_tests(pairs)
    compared = list(zip(names[1:], pairs, strict=True))
    parts: ui.Parts = []
    for name, pair in compared:
        parts += [ui.heading(f"From {names[0]} to {name}", level=3), ui.paragraph(conclude_comparison(pair))]
    parts += [ui.paragraph(note) for note in comparison_notes(pairs)]
    figures = table_of(side_by_side(pairs), "Figures of every test, expanded uncertainties (k = 2)")
    parts += [ui.heading("Side by side", level=3), figures]
    profiles = "Drift-free profiles, mean of both approaches, each about its mean, with 95 % bands."
    parts += shown_if(plot_profiles(tests, short), profiles)
    parts += shown_if(plot_scatters(tests, short), "Scatter of single readings with 95 % limits.")
    trends = follow_trends(pairs)
    for trend in trends:
        parts += shown_if(draw_trend(trend), f"{trend_caption(trend)} {trend_notes(pairs, trends)}".strip())
    for name, pair in compared:
        left = f"{name} minus {names[0]}, beyond offset, slope and bow, with 95 % intervals; ringed or shaded: changed."
        parts += shown_if(plot_remaining(pair), left)
        if pair.places is not None:
            found = describe_places(pairs, pair)
            parts += [ui.heading("Places that the drift follows", level=3), ui.paragraph(" ".join(found["said"]))]
            if found["table"].rows:
                parts.append(table_of(found["table"], "Sources that either test shows"))
        if pair.changes:
            every = f"Everything that was compared, {names[0]} before and {name} after"
            parts.append(table_of(changes_table(pairs, pair), every))
    return parts


def compare_screen(state: ui.State) -> pn.viewable.Viewable:
    """Build the screen *Compare* for a page."""
    return CompareScreen(state).view
