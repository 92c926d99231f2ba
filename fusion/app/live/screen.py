"""The screen *Live*."""

from __future__ import annotations

import panel as pn

from fusion.app.elements import as_markup, bullets, heading, paragraph
from fusion.app.live.charts import plot_course, plot_field, plot_standard
from fusion.app.live.session import Course, LiveSession
from fusion.app.places import PlaceError, place_within
from fusion.app.results.charts import shown
from fusion.app.state import State
from fusion.app.turn import in_turn
from fusion.errors import FusionError
from fusion.products.notices import counted
from fusion.report.wording import number

_INTERVAL_MS = 1000


class LiveScreen:
    """Follows a running test and shows what it has shown so far.

    Parameters
    ----------
    state : State
        Of the page.
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self._session: LiveSession | None = None
        self._seen = -1
        folder = state.folder or state.root
        self._campaign = pn.widgets.TextInput(
            label="Campaign file of the running test", value=str(state.campaign or folder / "campaign.toml"), sizing_mode="stretch_width"
        )  # fmt: skip
        self._wanted = pn.widgets.FloatInput(
            label="Wanted standard uncertainty of a position / µm", value=0.1, start=0.001, step=0.01, width=330
        )
        self._start = pn.widgets.Button(label="Follow", color="primary")
        self._end = pn.widgets.Button(label="Stop following", disabled=True)
        self._told = pn.pane.HTML("", sizing_mode="stretch_width")
        self._charts = pn.Column(sizing_mode="stretch_width")
        self._start.on_click(self._on_start)
        self._end.on_click(lambda event: self.end())
        state.param.watch(
            lambda event: self._campaign.param.update(value=str(event.new)) if event.new else None, "campaign"
        )

    @property
    def view(self) -> pn.viewable.Viewable:
        """The screen."""
        return pn.Column(
            heading("Live"),
            paragraph(
                "Follows a test while camera and laser write their files. Readings are shown as they were written; the results of the test "
                "are those of Run.",
                kind="note",
            ),
            self._campaign,
            self._wanted,
            pn.Row(self._start, self._end),
            self._told,
            self._charts,
            sizing_mode="stretch_width",
        )

    def end(self) -> None:
        """Stop following: the page is closed, or the user asked for it."""
        if self._session is not None:
            self._session.end()

    def _on_start(self, event: object) -> None:
        try:
            campaign = place_within(self._state.root, self._campaign.value)
            self._session = LiveSession(campaign, wanted_u_um=self._wanted.value or 0.1)
        except (PlaceError, FusionError) as error:
            self._session = None
            self._charts[:] = [paragraph(line, kind="fault") for line in str(error).splitlines()]
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
        parts = [
            (plot_field(course), "Latest field, on the scale of all fields so far."),
            (plot_course(course), "Drift of the readings and rise of the table since the first cycle."),
            (plot_standard(course), "By ISO 230-2, the last five cycles after every cycle."),
        ]
        drawn = [shown(chart, caption) for chart, caption in parts if chart is not None]
        if course.warnings:
            drawn += [heading("Noticed", level=3), bullets(dict.fromkeys(course.warnings))]
        fault = [paragraph(session.fault, kind="fault")] if session.fault else []
        self._charts[:] = [*fault, *drawn]


def standing(course: Course, wanted_u_um: float, *, runs: bool) -> str:
    """Return how the test stands, as markup that is read aloud when it changes.

    Parameters
    ----------
    course : Course
        Of the test.
    wanted_u_um : float
        Standard uncertainty of a position that it is to reach, um.
    runs : bool
        Whether it is still followed.
    """
    seen = ((len(course.cycle), "finished cycle"), (course.frames, "frame"), (course.readings, "reading"))
    head = (
        f"{'Following' if runs else 'No longer followed'}: {', '.join(counted(count, noun) for count, noun in seen)}."
    )
    return f'<p role="status">{as_markup(head)} {as_markup(enough_words(course, wanted_u_um))}</p>'


def enough_words(course: Course, wanted_u_um: float) -> str:
    """Return whether the cycles are enough, in words.

    Parameters
    ----------
    course : Course
        Of the test.
    wanted_u_um : float
        Standard uncertainty of a position that it is to reach, um.
    """
    enough = course.enough
    if enough is None:
        return "Whether the cycles are enough cannot be told yet."
    lacks = f" {enough.lacks[:1].upper()}{enough.lacks[1:]}." if enough.lacks else ""
    verdict = "The cycles are enough" if enough.is_enough else "The cycles are not enough yet"
    return (
        f"{verdict}: after {enough.cycles} of them the standard uncertainty of a position against the first one is "
        f"{number(enough.u_um, 2)} µm, and {enough.cycles_for_wanted} cycles reach {wanted_u_um:g} µm.{lacks}"
    )


def live_screen(state: State) -> pn.viewable.Viewable:
    """Build the screen *Live* for a page.

    Parameters
    ----------
    state : State
        Of the page.

    Returns
    -------
    Viewable
        Of Panel.
    """
    screen = LiveScreen(state)
    pn.state.add_periodic_callback(lambda: in_turn(screen.update), _INTERVAL_MS)
    pn.state.on_session_destroyed(lambda context: screen.end())
    return screen.view
