"""The screen *Compare*."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import panel as pn

from fusion.app.compare.charts import plot_profiles, plot_remaining, plot_scatters
from fusion.app.elements import bullets, heading, paragraph
from fusion.app.results.charts import shown
from fusion.app.results.closed_loop import table_of
from fusion.app.state import State
from fusion.app.turn import in_turn
from fusion.comparison.campaigns import PairComparison, compare_campaigns
from fusion.errors import FusionError
from fusion.products.results import read_results
from fusion.report.comparison_section import campaign_names, changes_table, conclude_comparison, side_by_side

#: Folders below the one of the application in which results are looked for, and most results that are listed.
_DEPTH, _MOST = 4, 200


def find_results(root: Path) -> tuple[list[Path], bool]:
    """Find results folders of finished runs.

    Parameters
    ----------
    root : Path
        Folder that is searched, four folders deep, without hidden ones and symbolic links.

    Returns
    -------
    folders : list of Path
        Oldest first by their names in the folder.
    all_listed : bool
        Whether none was left out.
    """
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
    return sorted(found[:_MOST]), len(found) <= _MOST


def label_of(root: Path, folder: Path) -> str:
    """Return what the list shows of a results folder: its path, and the campaign with the day of its first reading.

    Parameters
    ----------
    root : Path
        Folder of the application.
    folder : Path
        Results folder.
    """
    name = folder.relative_to(root).as_posix()
    try:
        results = read_results(folder)
    except (FusionError, OSError):
        return f"{name} (cannot be read)"
    day = f", {results.time.first[:10]}" if results.time else ""
    return f"{name}: {results.campaign}{day}"


class CompareScreen:
    """Chooses campaigns and shows what differs between them.

    Parameters
    ----------
    state : State
        Of the page.
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self._reference = pn.widgets.Select(
            label="Reference (before a repair, or the oldest)", options={}, sizing_mode="stretch_width"
        )
        self._others = pn.widgets.CheckBoxGroup(label="Compared with it", options={})
        self._look = pn.widgets.Button(label="Look for results again")
        self._compare = pn.widgets.Button(label="Compare", color="primary")
        self._told = pn.Column(sizing_mode="stretch_width")
        self._found = pn.Column(sizing_mode="stretch_width")
        self._look.on_click(lambda event: self._list())
        self._compare.on_click(self._show)
        self._reference.param.watch(lambda event: self._offer(), "value")
        self._list()

    @property
    def view(self) -> pn.viewable.Viewable:
        """The screen."""
        return pn.Column(
            heading("Compare"),
            self._reference,
            paragraph("Compared with it:"),
            self._others,
            pn.Row(self._compare, self._look),
            self._told,
            self._found,
            sizing_mode="stretch_width",
        )

    def _list(self) -> None:
        """List the results that there are."""
        folders, whole = find_results(self._state.root)
        self._labels = {label_of(self._state.root, folder): folder for folder in folders}
        self._reference.options = dict(self._labels)
        self._offer()
        told = [] if whole else [paragraph(f"More than {_MOST} results folders: the first are listed.", kind="warning")]
        if len(folders) < 2:
            count = "one results folder" if folders else "no results folder"
            told.append(
                paragraph(
                    f"There is {count} of a finished run in {self._state.root}; a comparison needs two or more.",
                    kind="note",
                )
            )
        self._told[:] = told
        self._compare.disabled = len(folders) < 2

    def _offer(self) -> None:
        """Offer every folder but the reference."""
        chosen = [folder for folder in self._others.value or [] if folder != self._reference.value]
        offered = {label: folder for label, folder in self._labels.items() if folder != self._reference.value}
        # In one message: a box that is ticked between two of them would be emptied by the second.
        self._others.param.update(options=offered, value=chosen)

    async def _show(self, event: object) -> None:
        others = list(self._others.value or [])
        if not others:
            self._found[:] = [paragraph("Choose at least one campaign to compare with the reference.", kind="fault")]
            return
        self._compare.disabled = True
        try:
            pairs = await asyncio.to_thread(compare_campaigns, [self._reference.value, *others])
            parts = comparison_parts(pairs)
            in_turn(lambda: self._tell(parts))
        except (FusionError, OSError) as error:
            fault = paragraph(str(error), kind="fault")
            in_turn(lambda: self._tell([fault]))
        finally:
            in_turn(self._end)

    def _tell(self, parts: list[pn.viewable.Viewable]) -> None:
        """Show a comparison, or why there is none."""
        self._found[:] = parts

    def _end(self) -> None:
        self._compare.disabled = False


def comparison_parts(pairs: list[PairComparison]) -> list[pn.viewable.Viewable]:
    """Return a comparison as parts of a screen: what changed first, then the figures side by side, charts, and every quantity.

    Parameters
    ----------
    pairs : list of PairComparison
        Of one reference.
    """
    names = campaign_names(pairs)
    campaigns = [pairs[0].before, *(pair.after for pair in pairs)]
    parts: list[pn.viewable.Viewable] = []
    for name, pair in zip(names[1:], pairs, strict=True):
        parts.append(heading(f"From {names[0]} to {name}", level=3))
        parts += [paragraph(sentence) for sentence in conclude_comparison(pair)]
        if pair.not_compared:
            parts += [paragraph("Not compared:"), bullets(pair.not_compared)]
    parts += [
        heading("Side by side", level=3),
        table_of(side_by_side(pairs), "Figures of every campaign, expanded uncertainties (k = 2)"),
    ]
    captions = (
        (
            plot_profiles(campaigns, names),
            "Drift-free profiles, mean of both approaches, each about its mean, with 95 % bands.",
        ),
        (plot_scatters(campaigns, names), "Scatter of single readings with 95 % intervals."),
    )
    parts += [shown(chart, caption) for chart, caption in captions if chart is not None]
    for name, pair in zip(names[1:], pairs, strict=True):
        chart = plot_remaining(pair)
        if chart is not None:
            parts.append(
                shown(
                    chart,
                    f"{name} minus {names[0]}, beyond offset, slope and bow, with 95 % intervals; ringed: changed.",
                )
            )
        if pair.changes:
            parts.append(
                table_of(changes_table(pair), f"Everything that was compared, {names[0]} before and {name} after")
            )
    return parts


def compare_screen(state: State) -> pn.viewable.Viewable:
    """Build the screen *Compare* for a page.

    Parameters
    ----------
    state : State
        Of the page.

    Returns
    -------
    Viewable
        Of Panel.
    """
    return CompareScreen(state).view
