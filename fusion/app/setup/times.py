"""Time bars of all recordings of a folder on one axis, with the offset of the camera's clock as a slider."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import panel as pn
from bokeh.models import ColumnDataSource

from fusion.app.drawings import figure_of, shown_drawing
from fusion.app.parts import column, heading, markup, paragraph_markup
from fusion.app.setup.plan import TEAL
from fusion.campaign.inspect import Recording
from fusion.campaign.recordings import FRAMES, coverage, estimate, shifted
from fusion.report.charts.style import new_figure
from interferometry.plots import ACCENT

#: A slider reaches this far to both sides at least, s: clocks that nobody set differ by minutes.
_REACH_S = 600.0


class TimesView:
    """What was recorded when; `on_offset` takes a chosen clock offset, s."""

    def __init__(self, on_offset: Callable[[float], None]) -> None:
        self._recordings: Sequence[Recording] = ()
        self._on_offset = on_offset
        self._filling = False
        self._bars = ColumnDataSource({"name": [], "start": [], "end": [], "colour": []})
        self._slider = pn.widgets.FloatSlider(
            label="Camera clock minus laser clock (s)", start=-_REACH_S, end=_REACH_S, step=1.0, sizing_mode="stretch_width"
        )  # fmt: skip
        self._take = pn.widgets.Button(label="Take the estimate", visible=False)
        self._told, self._picture = markup(""), column()
        self._slider.param.watch(lambda event: self._chosen(event.new), "value")
        self._take.on_click(lambda event: self._chosen(estimate(self._recordings) or 0.0))
        title = heading("Recordings on one clock", level=3)
        self.view = column(title, self._picture, self._slider, self._told, self._take)

    def show(self, recordings: Sequence[Recording], clock_offset_s: float) -> None:
        """Show recordings."""
        self._recordings = recordings
        names = list(dict.fromkeys(one.name for one in recordings))
        self.view.visible = bool(names)
        self._slider.visible = FRAMES in names and len(names) > 1
        if not names:
            return
        empty = new_figure(x="UTC", y="", x_type="datetime", y_range=names[::-1], height=70 + 34 * len(names))
        drawn = figure_of(empty)
        drawn.hbar(y="name", left="start", right="end", height=0.5, source=self._bars, color="colour")
        drawn.ygrid.grid_line_color = None
        self.move(clock_offset_s)
        self._picture[:] = [shown_drawing(drawn)]

    def move(self, clock_offset_s: float) -> None:
        """Show the recordings with another offset."""
        self._filling = True
        reach = max(_REACH_S, 1.5 * abs(clock_offset_s))
        self._slider.param.update(start=-reach, end=reach, value=clock_offset_s)
        self._filling = False
        bars = shifted(self._recordings, clock_offset_s)
        columns = {name: [getattr(bar, name) for bar in bars] for name in ("name", "start", "end")}
        self._bars.data = columns | {"colour": [ACCENT if bar.name == FRAMES else TEAL for bar in bars]}
        likely = estimate(self._recordings)
        self._take.visible = likely is not None and likely != clock_offset_s
        told = coverage(self._recordings, clock_offset_s)
        if self._take.visible:
            told += f" The clocks look as in two time zones: estimated offset {likely:g} s."
        self._told.object = paragraph_markup(told.strip(), kind="warning" if self._take.visible else "note")

    def _chosen(self, clock_offset_s: float) -> None:
        if not self._filling:
            self.move(clock_offset_s)
            self._on_offset(clock_offset_s)
