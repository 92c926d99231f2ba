"""The screen *Run*."""

from __future__ import annotations

from pathlib import Path

import panel as pn

from fusion.app.elements import as_markup, bullets, heading, link, paragraph
from fusion.app.places import PlaceError, place_within
from fusion.app.report import report_link
from fusion.app.run.process import RUNS, RunError, RunProcess, is_begun
from fusion.app.state import State
from fusion.app.turn import in_turn
from fusion.endings import ExitCode
from fusion.products.store import finished_stages, noted_messages, read_json_object

_INTERVAL_MS = 500


class RunScreen:
    """Starts, watches and cancels the run of a campaign.

    Parameters
    ----------
    state : State
        Of the page.
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self._shown: tuple[object, ...] = ()
        self._taken: Path | None = None
        self._campaign = pn.widgets.TextInput(label="Campaign file", sizing_mode="stretch_width")
        self._results = pn.widgets.TextInput(label="Results folder", sizing_mode="stretch_width")
        self._start = pn.widgets.Button(label="Run", color="primary")
        self._cancel = pn.widgets.Button(label="Cancel", disabled=True)
        self._outcome = pn.Column(sizing_mode="stretch_width")
        self._stages = pn.pane.HTML("", sizing_mode="stretch_width")
        self._messages = pn.Column(sizing_mode="stretch_width")
        self._start.on_click(self._on_start)
        self._cancel.on_click(self._on_cancel)
        for field in (self._campaign, self._results):
            field.param.watch(lambda event: self.update(), "value")
        state.param.watch(lambda event: self._take(event.new), "campaign")
        self._take(state.campaign)

    @property
    def view(self) -> pn.viewable.Viewable:
        """The screen."""
        return pn.Column(
            heading("Run"),
            self._campaign,
            self._results,
            pn.Row(self._start, self._cancel),
            self._outcome,
            self._stages,
            self._messages,
            sizing_mode="stretch_width",
        )

    def _take(self, campaign: Path | None) -> None:
        """Show the campaign of the page, with its results beside it; the same again leaves what is typed."""
        if campaign is not None and campaign == self._taken:
            return
        self._taken = campaign
        folder = self._state.folder or self._state.root
        chosen = campaign or folder / "campaign.toml"
        run = RUNS.latest
        beside = run.results if run is not None and run.campaign == chosen else chosen.parent / "results"
        self._campaign.value, self._results.value = str(chosen), str(beside)
        self.update()

    def _places(self) -> tuple[Path, Path]:
        """Return campaign file and results folder as they are typed."""
        campaign = place_within(self._state.root, self._campaign.value)
        results = place_within(self._state.root, self._results.value)
        if not campaign.is_file():
            raise PlaceError(f"{campaign}: no such file; the screen Set up writes it")
        other = campaign_of(results)
        if other is not None and other.parent != campaign.parent:
            raise PlaceError(
                f"{results} holds the results of {other}; name another results folder, they would be replaced"
            )
        return campaign, results

    def _on_start(self, event: object) -> None:
        try:
            campaign, results = self._places()
            RUNS.start(campaign, results)
        except (PlaceError, RunError) as error:
            self._outcome[:] = [paragraph(str(error), kind="fault")]
            return
        self._taken = self._state.campaign = campaign
        self.update()

    def _on_cancel(self, event: object) -> None:
        run = self._run()
        if run is not None:
            run.cancel()

    def _run(self) -> RunProcess | None:
        """Return the latest run of the results folder, from whatever page it was started."""
        try:
            return RUNS.of(place_within(self._state.root, self._results.value))
        except PlaceError:
            return None

    def update(self) -> None:
        """Show what is new."""
        try:
            results = place_within(self._state.root, self._results.value)
            begun = is_begun(results)
        except PlaceError:
            return
        run = self._run()
        stages = finished_stages(results) if begun else []
        new = (results, begun, tuple(stages), run, run and run.version, run and run.code)
        if new == self._shown:
            return
        self._shown = new
        runs = run is not None and run.runs
        self._start.disabled, self._cancel.disabled = runs, not runs
        finished = (results / "report.html").is_file()
        self._start.label = "Run again" if finished else "Resume" if begun else "Run"
        self._stages.object = "" if run is None else stages_markup(run)
        told = [] if not begun else [f"{one['message']} {one['remedy']}".strip() for one in noted_messages(results)]
        self._messages[:] = [heading("Messages", level=3), bullets(dict.fromkeys(told))] if told else []
        self._outcome[:] = self._ended(results, run, stages)

    def _ended(self, results: Path, run: RunProcess | None, stages: list[str]) -> list[pn.viewable.Viewable]:
        """Say how the run stands, and lead to its report."""
        report = results / "report.html"
        if run is None:
            parts = (
                [paragraph(f"{results.name} keeps the finished stages {', '.join(stages)}", kind="note")]
                if stages
                else []
            )
            return [*parts, *self._report_of(results)] if report.is_file() else parts
        if run.runs:
            return [paragraph("The run is under way; this page may be closed meanwhile.", kind="note")]
        if run.code == ExitCode.DONE:
            self._state.results = results
            return [paragraph("The run is finished.", kind="done"), *self._report_of(results)]
        if run.code == ExitCode.TERMINATED:
            kept = (
                f"{results.name} keeps {', '.join(stages)}; Resume goes on from there"
                if stages
                else "no stage was finished"
            )
            return [paragraph(f"The run was cancelled: {kept}.", kind="warning")]
        return [paragraph(message, kind="fault") for message in run.messages or ["The run ended without a word."]]

    def _report_of(self, results: Path) -> list[pn.viewable.Viewable]:
        return [link("Open the report", report_link(self._state.root, results))]


def campaign_of(results: Path) -> Path | None:
    """Return the campaign file of a finished run; None where it is not noted, or is no longer there.

    Parameters
    ----------
    results : Path
        Results folder; it may be absent.
    """
    try:
        campaign = (results / read_json_object(results / "provenance.json")["campaign_file"]).resolve()
        return campaign if campaign.is_file() else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def stages_markup(run: RunProcess) -> str:
    """Return the steps of a run as a table with bars.

    Parameters
    ----------
    run : RunProcess
        Under way or ended.
    """
    rows = "".join(
        f'<tr><th scope="row">{as_markup(stage.label)}</th><td><progress aria-label="{as_markup(stage.label)}" max="1" '
        f'value="{stage.share:.3f}"></progress></td><td>{as_markup(stage.words)}</td></tr>'
        for stage in list(run.progress.stages.values())
    )
    return f"<table><caption>Progress by stage</caption><tbody>{rows}</tbody></table>" if rows else ""


def run_screen(state: State) -> pn.viewable.Viewable:
    """Build the screen *Run* for a page.

    Parameters
    ----------
    state : State
        Of the page.

    Returns
    -------
    Viewable
        Of Panel.
    """
    screen = RunScreen(state)
    pn.state.add_periodic_callback(lambda: in_turn(screen.update), _INTERVAL_MS)
    return screen.view
