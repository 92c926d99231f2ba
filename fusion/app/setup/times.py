"""Time bars of all recordings of a folder on one axis, with the offset of the camera's clock as a slider."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource

from fusion.analysis.alignment.align import camera_on_laser_clock, covered_share, likely_zone_shift
from fusion.app.drawings import figure_of, shown_drawing
from fusion.app.parts import column, heading, markup, paragraph_markup
from fusion.app.setup.plan import TEAL
from fusion.campaign.inspect import FolderContent, Kind, Recording
from fusion.common import FusionError
from fusion.report.charts.style import new_figure
from interferometry.common import InterferometryError
from interferometry.plots import ACCENT
from thermography.io.other_cameras import index_recordings

# Recordings of a folder on the clock of the laser, and what an offset of the camera's clock does to them.

FRAMES, READINGS = "frames", "readings"


class Bar(NamedTuple):
    """A stretch of a recording without a gap, UTC on the laser's clock."""

    name: str
    start: np.datetime64
    end: np.datetime64


def recordings_of(content: FolderContent) -> list[Recording]:
    """Return what was recorded when, each by its own clock; files without times or with faults are left out, as the table names them."""
    found = []
    if content.frames and not content.of_temperatures:
        frames, _ = index_recordings(content.frame_files)
        found.append(Recording(FRAMES, np.array([frame.time for frame in frames], "datetime64[ns]")))
    for name, kind in ((READINGS, Kind.DEVIATIONS), ("environment", Kind.ENVIRONMENT), ("drivers", Kind.DRIVERS)):
        for one in content.of(kind)[:1]:
            with suppress(FusionError, InterferometryError):
                found.append(Recording(name, one.content["time"].values.astype("datetime64[ns]").ravel()))
    return [one for one in found if one.stretches()]


def shifted(recordings: Sequence[Recording], clock_offset_s: float) -> list[Bar]:
    """Return the recordings as bars on the laser's clock."""
    bars = []
    for one in recordings:
        times = camera_on_laser_clock(one.times, clock_offset_s) if one.name == FRAMES else one.times
        bars += [Bar(one.name, start, end) for start, end in Recording(one.name, times).stretches()]
    return bars


def coverage(recordings: Sequence[Recording], clock_offset_s: float) -> str:
    """Say how much of the readings lies between the frames."""
    both = _frames_and_readings(recordings)
    if both is None:
        return ""
    frames, readings = both
    share = covered_share(readings, camera_on_laser_clock(frames, clock_offset_s))
    return f"{share:.0%} of the readings lie between the first and the last frame."


def estimate(recordings: Sequence[Recording]) -> float | None:
    """Return the clock offset by whole quarter hours that two time zones would explain, s."""
    both = _frames_and_readings(recordings)
    return None if both is None else likely_zone_shift(both[1], both[0])


def _frames_and_readings(recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray] | None:
    named = {one.name: np.sort(one.times[~np.isnat(one.times)]) for one in recordings}
    return (named[FRAMES], named[READINGS]) if FRAMES in named and READINGS in named else None


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
