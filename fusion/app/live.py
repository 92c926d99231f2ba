"""The screen *Live*."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import panel as pn

from fusion.app import parts as ui
from fusion.app.drawings import shown_if
from fusion.campaign.config import load_campaign
from fusion.common import CAMPAIGN_FILE, FusionError
from fusion.common.messages import reported
from fusion.pipeline.watch import Enough, FinishedCycle, LiveState, follow
from fusion.report.charts.plan import LAYERS, draw_map, extent_of
from fusion.report.charts.style import CATEGORIES, Chart, Courses, new_figure, span_words
from fusion.results.numbers import number
from fusion.results.progress import counted
from interferometry.plots import ACCENT, INK, MUTED

# A running test, followed beside the page in a thread of its own.

#: Most warnings that are kept, the latest ones.
_MOST_WARNINGS = 30


@dataclass
class Course:
    """What a test has shown so far: every finished cycle, of the fields only the latest, and values by ISO 230-2 by cycle, um."""

    cycles: list[FinishedCycle] = field(default_factory=list)
    iso230_um: dict[int, Mapping[str, float]] = field(default_factory=dict)
    window: str = ""
    with_field: FinishedCycle | None = None
    field_range_degC: tuple[float, float] = (np.inf, -np.inf)
    enough: Enough | None = None
    frames: int = 0
    readings: int = 0
    warnings: list[str] = field(default_factory=list)

    def take(self, state: LiveState) -> None:
        """Add what is new."""
        self.frames, self.readings = state.frames, state.readings
        self.warnings = [*self.warnings, *state.warnings][-_MOST_WARNINGS:]
        self.enough = state.enough or self.enough
        cycle = state.cycle
        if cycle is None:
            return
        self.cycles.append(replace(cycle, field=None))
        if state.iso230_um:
            self.iso230_um[cycle.number], self.window = state.iso230_um, state.iso230_window
        if cycle.field is not None and cycle.field_range_degC is not None:
            self.with_field = cycle
            (low, high), (new_low, new_high) = self.field_range_degC, cycle.field_range_degC
            self.field_range_degC = (min(low, new_low), max(high, new_high))


class LiveSession:
    """Follows one campaign, whose files may still be growing, until it is ended.

    ``version`` grows with everything that is new; ``fault`` says why it ended by itself, empty while it runs and after `end`.
    """

    def __init__(self, campaign: Path, *, wanted_u_um: float, poll_s: float = 1.0) -> None:
        self._campaign = load_campaign(campaign)
        self._wanted_u_um, self._poll_s = wanted_u_um, poll_s
        self.course, self.version, self.fault = Course(), 0, ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="live", daemon=True)
        self._thread.start()

    @property
    def runs(self) -> bool:
        """Whether the test is still followed."""
        return self._thread.is_alive()

    def end(self, timeout_s: float | None = None) -> None:
        """Tell it to end."""
        self._stop.set()
        if timeout_s is not None:
            self._thread.join(timeout_s)

    def _follow(self) -> None:
        try:
            for state in follow(self._campaign, poll_s=self._poll_s, wanted_u_um=self._wanted_u_um, stop=self._stop):
                self.course.take(state)
                self.version += 1
        except Exception as error:  # the page must say that nothing is followed any more, whatever the reason
            self.fault = reported(error)
        self.version += 1


# Charts of a running test: latest field, drift and rise over the cycles, values by ISO 230-2.


def plot_field(course: Course) -> Chart | None:
    """Draw the latest field, on the scale of all fields so far."""
    if course.with_field is None or course.with_field.field is None:
        return None
    number, shown = course.with_field.number, course.with_field.field
    low, high = course.field_range_degC
    scale = {"low": low, "high": max(high, low + 0.1)}
    drawn = draw_map(shown.values, extent_of(shown.to_dataset(name="temperature")), LAYERS[1], scale)
    seen = f"Temperature of the table in cycle {number}: {span_words(shown, '°C')}."
    return Chart(drawn, seen, {})


def plot_course(course: Course) -> Chart | None:
    """Draw the drift over the cycles."""
    series = {
        "mean of the targets": ([one.mean_drift_um for one in course.cycles], CATEGORIES[0], "circle"),
        "at the last target": ([one.last_drift_um for one in course.cycles], CATEGORIES[1], "square"),
    }
    return _since_first(course, "drift", "µm", series)


def plot_rise(course: Course) -> Chart | None:
    """Draw the rise of the table over the cycles."""
    return _since_first(
        course, "rise of the table", "K", {"mean": ([one.rise_K for one in course.cycles], ACCENT, "triangle")}
    )


def _since_first(
    course: Course, quantity: str, unit: str, series: Mapping[str, tuple[Sequence[float], str, str]]
) -> Chart | None:
    """Draw lines of one quantity since the first cycle; None where no value is known."""
    cycle = np.array([one.number for one in course.cycles], float)
    drawn = new_figure(x="cycle", y=f"{quantity} / {unit}", legend_columns=1, zero=True)
    courses = Courses(drawn, {"cycle": cycle})
    for name, (values, colour, marker) in series.items():
        line = np.array(values, float)
        if np.isfinite(line).any():
            looks = {"seen": span_words(line, unit), "colour": colour, "marker": marker}
            courses.add(cycle, line, name, column=f"{quantity}, {name} / {unit}", **looks)
    told = f"{counted(cycle.size, 'cycle')}, {quantity}"
    return courses.chart(told) if len(courses.columns) > 1 else None


def plot_standard(course: Course) -> Chart | None:
    """Draw accuracy A, repeatability R and reversal B of the last five cycles, after every cycle."""
    if not course.iso230_um:
        return None
    cycle = np.array([*course.iso230_um], float)
    courses = Courses(new_figure(x="cycle", y="A, R, B / µm"), {"cycle": cycle})
    marks = (("A", INK, "circle"), ("R", ACCENT, "square"), ("B", MUTED, "diamond"))
    for symbol, colour, marker in marks:
        values = np.array([found.get(symbol, np.nan) for found in course.iso230_um.values()])
        if np.isfinite(values).any():
            latest = f"{span_words(values[-1:], 'µm').partition(' to ')[0]} µm"
            courses.add(cycle, values, symbol, seen=latest, colour=colour, marker=marker)
    return courses.chart(f"By ISO 230-2, {course.window}")


def example_course() -> Course:
    """Return the course of a test that was never made, to show what the screen draws: a warm-up of exponential form."""
    course, never = Course(window="cycles 26 to 30"), np.datetime64("NaT", "ns")
    for cycle in range(1, 31):
        warm = 1.0 - np.exp(-cycle / 12.0)
        drift_um = np.array([-1.0, 9.0]) * warm
        course.cycles.append(FinishedCycle(cycle, never, never, 0, None, None, 3.0 * warm, drift_um))
        if cycle >= 5:
            course.iso230_um[cycle] = {"A": 9.0 + 6.0 * warm, "R": 3.0, "B": 1.2}
    return course


_INTERVAL_MS = 1000
_DRIFTS = "Drift of the readings since the first cycle."
_RISE = "Rise of the table since the first cycle."
_STANDARD = "By ISO 230-2, the last five cycles after every cycle."


class LiveScreen:
    """Follows a running test and shows what it has shown so far."""

    def __init__(self, state: ui.State) -> None:
        self._state = state
        self._session: LiveSession | None = None
        self._seen = -1
        beginning = state.campaign or (state.folder or state.root) / CAMPAIGN_FILE
        self._campaign = ui.text_field("Campaign file of the running test", beginning)
        wanted = {"label": "Wanted standard uncertainty of a position / µm", "value": 0.1, "start": 0.001, "step": 0.01}
        self._wanted = pn.widgets.FloatInput(**wanted, width=330)
        self._start = pn.widgets.Button(label="Follow", color="primary")
        self._end = pn.widgets.Button(label="Stop following", disabled=True)
        example = example_course()
        told = "Example, not measured: the charts that are drawn here while a test runs, with the latest field of the camera above them."
        drawn = ((plot_course(example), _DRIFTS), (plot_rise(example), _RISE), (plot_standard(example), _STANDARD))
        charts = [part for chart, caption in drawn for part in shown_if(chart, caption)]
        self._told, self._charts = ui.markup(""), ui.column(ui.paragraph(told, kind="warning"), *charts)
        self._start.on_click(self._on_start)
        self._end.on_click(lambda event: self.end())
        state.param.watch(lambda event: event.new and self._campaign.param.update(value=str(event.new)), "campaign")
        what = (
            "Follows a test while camera and laser write their files. Readings are shown as they were written; the results of the test "
            "are those of Run."
        )
        buttons = pn.Row(self._start, self._end)
        self.view = ui.column(
            ui.heading("Live"), ui.note(what), self._campaign, self._wanted, buttons, self._told, self._charts
        )

    def end(self) -> None:
        """Stop following: the page is closed, or the user asked for it."""
        if self._session is not None:
            self._session.end()

    def _on_start(self, event: object) -> None:
        try:
            campaign = ui.allowed_path(self._state.root, self._campaign.value)
            self._session = LiveSession(campaign, wanted_u_um=self._wanted.value or 0.1)
        except FusionError as error:
            self._session = None
            self._charts[:] = ui.faults(error)
            return
        self._seen = -1
        self._charts[:] = []
        self.update()

    def update(self) -> None:
        """Show what is new."""
        session = self._session
        runs = session is not None and session.runs
        self._start.disabled, self._end.disabled = runs, not runs
        if session is None or session.version == self._seen:
            return
        self._seen = session.version
        course = session.course
        self._told.object = standing(course, self._wanted.value or 0.1, runs=runs)
        drawn = [
            *([ui.paragraph(session.fault, kind="fault")] if session.fault else []),
            *shown_if(plot_field(course), "Latest field, on the scale of all fields so far."),
            *shown_if(plot_course(course), _DRIFTS),
            *shown_if(plot_rise(course), _RISE),
            *shown_if(plot_standard(course), _STANDARD),
        ]
        if course.warnings:
            drawn += [ui.heading("Noticed", level=3), ui.bullets(dict.fromkeys(course.warnings))]
        self._charts[:] = drawn


def standing(course: Course, wanted_u_um: float, *, runs: bool) -> str:
    """Return how the test stands, as markup that is read aloud when it changes."""
    seen = ((len(course.cycles), "finished cycle"), (course.frames, "frame"), (course.readings, "reading"))
    verb = "Following" if runs else "No longer followed"
    head = f"{verb}: {', '.join(counted(count, noun) for count, noun in seen)}."
    if course.iso230_um:
        latest = [*course.iso230_um.values()][-1]
        values = ", ".join(f"{name} = {number(latest[name], 3)} µm" for name in sorted(latest, key="AREMB".find))
        head += f" By ISO 230-2, {course.window}: {values}."
    return f'<p role="status">{ui.as_markup(head)} {ui.as_markup(enough_words(course, wanted_u_um))}</p>'


def enough_words(course: Course, wanted_u_um: float) -> str:
    """Return whether the cycles are enough, in words."""
    enough = course.enough
    if enough is None:
        return "Whether the cycles are enough cannot be told yet."
    lacks = f" {enough.lacks[:1].upper()}{enough.lacks[1:]}." if enough.lacks else ""
    verdict = "The cycles are enough" if enough.is_enough else "The cycles are not enough yet"
    return (
        f"{verdict}: after {enough.cycles} of them the standard uncertainty of a position against the first one is "
        f"{number(enough.u_um, 2)} µm, and {enough.cycles_for_wanted} cycles reach {wanted_u_um:g} µm.{lacks}"
    )


def live_screen(state: ui.State) -> pn.viewable.Viewable:
    """Build the screen *Live* for a page."""
    screen = LiveScreen(state)
    pn.state.add_periodic_callback(lambda: ui.schedule_update(screen.update), _INTERVAL_MS)
    pn.state.on_session_destroyed(lambda context: screen.end())
    return screen.view
