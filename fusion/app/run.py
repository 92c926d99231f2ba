"""The screen *Run*."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import panel as pn

from fusion.app import parts as ui
from fusion.app.runs import RUNS, RunError, RunProcess, is_begun
from fusion.common import CAMPAIGN_FILE
from fusion.common.messages import ExitCode
from fusion.pipeline.resume import noted_campaign
from fusion.results.store import finished_stages, noted_messages

_INTERVAL_MS = 500


class RunScreen:
    """Starts, watches and cancels the run of a campaign."""

    def __init__(self, state: ui.State) -> None:
        self._state = state
        self._shown: tuple[object, ...] = ()
        self._taken: Path | None = None
        self._campaign, self._results = ui.text_field("Campaign file"), ui.text_field("Results folder")
        self._start = pn.widgets.Button(label="Run", color="primary")
        self._cancel = pn.widgets.Button(label="Cancel", disabled=True)
        self._outcome, self._stages, self._messages = ui.column(), ui.markup(""), ui.column()
        self._start.on_click(self._on_start)
        self._cancel.on_click(self._on_cancel)
        for field in (self._campaign, self._results):
            field.param.watch(lambda event: self.update(), "value")
        state.param.watch(lambda event: self._take(event.new), "campaign")
        self._take(state.campaign)
        told = (self._outcome, self._stages, self._messages)
        buttons = pn.Row(self._start, self._cancel)
        self.view = ui.column(ui.heading("Run"), self._campaign, self._results, buttons, *told)

    def _take(self, campaign: Path | None) -> None:
        """Show the campaign of the page, with its results beside it; the same again leaves what is typed."""
        if campaign is not None and campaign == self._taken:
            return
        self._taken = campaign
        chosen = campaign or (self._state.folder or self._state.root) / CAMPAIGN_FILE
        run = RUNS.latest
        results = run.results if run is not None and run.campaign == chosen else chosen.parent / "results"
        self._campaign.value, self._results.value = str(chosen), str(results)
        self.update()

    def _typed_paths(self) -> tuple[Path, Path]:
        """Return campaign file and results folder as they are typed."""
        campaign = ui.allowed_path(self._state.root, self._campaign.value)
        results = ui.allowed_path(self._state.root, self._results.value)
        if not campaign.is_file():
            raise ui.PathError(f"{campaign}: no such file; the screen Set up writes it")
        other = noted_campaign(results)
        if other is not None and other.parent != campaign.parent:
            raise ui.PathError(
                f"{results} holds the results of {other}; name another results folder, they would be replaced"
            )
        return campaign, results

    def _on_start(self, event: object) -> None:
        try:
            campaign, results = self._typed_paths()
            RUNS.start(campaign, results)
        except (ui.PathError, RunError) as error:
            self._outcome[:] = [ui.paragraph(str(error), kind="fault")]
            return
        self._taken = self._state.campaign = campaign
        self.update()

    def _on_cancel(self, event: object) -> None:
        with suppress(ui.PathError):
            run = RUNS.of(ui.allowed_path(self._state.root, self._results.value))
            if run is not None:
                run.cancel()

    def update(self) -> None:
        """Show what is new of the latest run of the results folder, from whatever page it was started."""
        try:
            results = ui.allowed_path(self._state.root, self._results.value)
            begun = is_begun(results)
        except ui.PathError:
            return
        run = RUNS.of(results)
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
        messages = [f"{one['message']} {one['remedy']}".strip() for one in noted_messages(results)] if begun else []
        self._messages[:] = [ui.heading("Messages", level=3), ui.bullets(dict.fromkeys(messages))] if messages else []
        self._outcome[:] = self._ended(results, run, stages)

    def _ended(self, results: Path, run: RunProcess | None, stages: list[str]) -> ui.Parts:
        """Say how the run stands, and lead to its report."""
        report = ui.link("Open the report", ui.report_link(self._state.root, results))
        if run is None:
            parts = [ui.note(f"{results.name} keeps the finished stages {', '.join(stages)}")] if stages else []
            return [*parts, report] if (results / "report.html").is_file() else parts
        if run.runs:
            return [ui.note("The run is under way; this page may be closed meanwhile.")]
        if run.code == ExitCode.DONE:
            self._state.results = results
            return [ui.paragraph("The run is finished.", kind="done"), report]
        if run.code == ExitCode.TERMINATED:
            kept = f"{results.name} keeps {', '.join(stages)}; Resume goes on from there"
            return [
                ui.paragraph(f"The run was cancelled: {kept if stages else 'no stage was finished'}.", kind="warning")
            ]
        return failed(run)


def failed(run: RunProcess) -> ui.Parts:
    """Return what a run that ended with a fault said."""
    return ui.faults("\n".join(run.messages) or "The run ended without a word.")


def stages_markup(run: RunProcess) -> str:
    """Return the steps of a run as a table with bars."""
    rows = "".join(
        f'<tr><th scope="row">{ui.as_markup(stage.label)}</th><td><progress aria-label="{ui.as_markup(stage.label)}" max="1" '
        f'value="{stage.share:.3f}"></progress></td><td>{ui.as_markup(stage.words)}</td></tr>'
        for stage in list(run.progress.stages.values())
    )
    return f"<table><caption>Progress by stage</caption><tbody>{rows}</tbody></table>" if rows else ""


def run_screen(state: ui.State) -> pn.viewable.Viewable:
    """Build the screen *Run* for a page."""
    screen = RunScreen(state)
    pn.state.add_periodic_callback(lambda: ui.schedule_update(screen.update), _INTERVAL_MS)
    return screen.view
