"""Follow a test while it runs: wait for frames and readings, and evaluate every cycle once, when it is finished."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import xarray as xr

from fusion.alignment.align import AlignmentError, cycle_bounds
from fusion.campaign.config import Campaign, CampaignError
from fusion.campaign.frame_stacks import stack_options
from fusion.campaign.time_zones import bring_to_utc
from fusion.pipeline.watch.fields import FieldsOfCycles
from fusion.pipeline.watch.frames import ArrivingFrames
from fusion.pipeline.watch.readings import ArrivingReadings
from fusion.pipeline.watch.series import CycleSeries
from fusion.pipeline.watch.state import FinishedCycle, LiveState
from interferometry.io.readers import read_deviations
from thermography.io.frame import FrameReference, RejectedFrame

#: Length of the windows that stand for cycles where no laser gives them and the campaign file states none, s.
_WINDOW_S = 60.0
#: So long a finished cycle waits for the camera's frames, s.
_CAMERA_PATIENCE_S = 30.0
#: Most frames that wait for the readings of their cycle: beyond them the oldest are left to the full run.
_MOST_WAITING = 20_000
#: Most warnings of one state that are told singly.
_MOST_WARNINGS = 20


def follow(
    campaign: Campaign,
    *,
    poll_s: float = 1.0,
    until_idle_s: float | None = None,
    wanted_u_um: float = 0.1,
    stop: threading.Event | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[LiveState]:
    """Yield what is known of a running test, whenever a cycle has been finished or something has come.

    Files are looked at again and again; a line or a frame that is half written waits. Each finished cycle is read and reduced once, so
    that time and memory do not grow with the length of the test.

    Parameters
    ----------
    campaign : Campaign
        A campaign with an instrument; the files that it names may still be growing.
    poll_s : float, s
        Time between two looks at the files.
    until_idle_s : float or None, s
        The test is over when nothing has come for so long; None: it is over when `stop` says so.
    wanted_u_um : float, um
        Standard uncertainty of a position that the test is to reach.
    stop : threading.Event or None
        Ends the test when it is set, also from another thread.
    clock : callable
        Returns seconds that never go back, whatever is done to the clock of the machine.

    Yields
    ------
    LiveState
        One for every finished cycle, the last one included, and one for every look at which only frames or readings had come.

    Raises
    ------
    CampaignError
        If the campaign is a record, which is one table and cannot be followed.

    Notes
    -----
    Readings are shown as they were written, temperatures without the corrections of the camera that the whole recording gives: the
    results of the test are those of `fusion.pipeline.run.run_campaign`.
    """
    if campaign.record is not None:
        raise CampaignError(f"{campaign.path}: a [record] cannot be followed; run it when it is finished")
    test = _RunningTest(campaign, wanted_u_um, clock)
    stop = stop or threading.Event()
    last_news = clock()
    while not stop.is_set():
        states = test.look()
        yield from states
        if states:
            last_news = clock()
        elif until_idle_s is not None and clock() - last_news >= until_idle_s:
            break
        stop.wait(poll_s)
    yield from test.look(final=True)


class _RunningTest:
    """Everything that has come of a test and has not been evaluated yet."""

    def __init__(self, campaign: Campaign, wanted_u_um: float, clock: Callable[[], float]) -> None:
        thermography, laser = campaign.thermography, campaign.interferometry
        self._campaign, self._clock = campaign, clock
        offset_s = None if thermography is None else thermography.clock_offset_s
        window_s = None if thermography is None else thermography.window_s
        self._offset = _nanoseconds(offset_s or 0.0)
        self._window = _nanoseconds(window_s or _WINDOW_S)
        self._length = _nanoseconds(0.0)
        self._frames_seen = self._readings_seen = self._cycles = self._windows = self._left = 0
        self._waiting: deque[FrameReference] = deque()
        self._due: deque[tuple[int, np.datetime64, np.datetime64, xr.Dataset | None, float]] = deque()
        self._first_mean = np.nan
        self._newest: np.datetime64 = np.datetime64("NaT", "ns")
        self._camera: ArrivingFrames | None = None
        self._laser: ArrivingReadings | None = None
        self._series = CycleSeries(wanted_u_um)
        self._first_frame: np.datetime64 = self._newest
        self._warnings: list[str] = []
        if thermography is not None:
            self._camera = ArrivingFrames(campaign.frame_paths, stack_options(campaign))
            self._fields = FieldsOfCycles(campaign)
            if offset_s is None and laser is not None:
                self._warnings.append("the clock offset is not given: 0 s is taken while the test runs")
        if laser is not None:
            read = partial(
                read_deviations, feed_mm_per_min=laser.feed_mm_per_min, dwell_s=laser.dwell_s, sheet=laser.sheet
            )
            self._laser = ArrivingReadings(campaign.resolve(laser.deviations), read, clock)
            if laser.compensation == "redo" or laser.dead_path_mm or laser.material_temperature == "camera":
                self._warnings.append("readings are shown as they were written; the full run compensates them")

    def look(self, *, final: bool = False) -> list[LiveState]:
        """Look at the files once and return what is new; `final`: the test is over, and its last cycle is finished."""
        before = self._frames_seen, self._readings_seen
        self._look_at_frames()
        if final:
            self._look_at_frames()  # a file that has just appeared is read when its size was the same twice
        if self._laser is not None:
            self._look_at_readings(self._laser, final=final)
        else:
            self._cut_windows(final=final)
        states = []
        while self._due and (final or self._frames_are_there()):
            states.append(self._finish(last=len(self._due) == 1))
        if not states and (before != (self._frames_seen, self._readings_seen) or self._warnings):
            states.append(self._state(None, evaluate=False))
        return states

    def _look_at_frames(self) -> None:
        if self._camera is None:
            return
        frames, rejected = self._camera.poll()
        self._frames_seen += len(frames)
        self._warnings += [_reason(one) for one in rejected]
        if frames:
            newest = self._on_laser_clock(frames[-1])
            late = not np.isnat(self._newest) and self._on_laser_clock(frames[0]) <= self._newest
            self._waiting.extend(frames)
            if late:
                self._waiting = deque(sorted(self._waiting, key=lambda frame: frame.time))
            self._newest = newest if np.isnat(self._newest) else max(self._newest, newest)
            if np.isnat(self._first_frame):
                self._first_frame = self._on_laser_clock(self._waiting[0])
        if (excess := len(self._waiting) - _MOST_WAITING) > 0:
            if not self._left:
                self._warnings.append("frames without readings of their time are left to the full run")
            self._left += excess
            for _ in range(excess):
                self._waiting.popleft()

    def _look_at_readings(self, laser: ArrivingReadings, *, final: bool) -> None:
        """Put the cycles that the laser has finished into the queue."""
        arrived = laser.poll(final=final)
        self._readings_seen += arrived.readings
        self._warnings += arrived.faults
        if arrived.cycles is None:
            return
        table = self._campaign.interferometry
        assert table is not None
        try:
            cycles = bring_to_utc(arrived.cycles, self._campaign.zone_of("interferometry"), file=table.deviations)
        except CampaignError as error:
            self._warnings.append(str(error))
            cycles = arrived.cycles
        try:
            bounds = cycle_bounds(cycles)
        except AlignmentError:
            bounds = np.full((cycles.sizes["cycle"], 2), np.datetime64("NaT", "ns"))
        if final:
            # Nothing follows the last cycle: it is as long as the one before.
            bounds[-1, 1] = max(bounds[-1, 1], bounds[-1, 0] + self._length)
        for index in range(cycles.sizes["cycle"] - (0 if final else 1)):
            one = cycles.isel(cycle=index)
            self._due.append((int(one["cycle"]), *bounds[index], one, self._clock()))
            self._length = bounds[index, 1] - bounds[index, 0]

    def _cut_windows(self, *, final: bool) -> None:
        """Put windows of the camera's time into the queue: they stand for cycles where there is no laser."""
        while True:
            start = self._first_frame + self._windows * self._window
            following = next((at for frame in self._waiting if (at := self._on_laser_clock(frame)) >= start), None)
            if following is None:
                return
            number = int((following - self._first_frame) // self._window)
            start = self._first_frame + number * self._window
            if not final and self._newest < start + self._window:
                return
            self._windows = number + 1
            self._due.append((self._windows, start, start + self._window, None, self._clock()))

    def _frames_are_there(self) -> bool:
        """Whether the camera has gone past the end of the cycle that is due, or nothing is to be waited for any longer."""
        _, _, end, _, since = self._due[0]
        return bool(
            self._camera is None or np.isnat(end) or self._newest >= end or self._clock() - since > _CAMERA_PATIENCE_S
        )

    def _finish(self, *, last: bool) -> LiveState:
        """Evaluate the cycle that is due; what all cycles show together is evaluated for the last of several."""
        number, start, end, readings, _ = self._due.popleft()
        field, frames = None, 0
        if self._camera is not None and not np.isnat(end):
            inside = self._take(start, end)
            frames = len(inside)
            field, warnings = self._fields.reduce(inside)
            self._warnings += [f"cycle {number}: {warning}" for warning in warnings]
        drift = np.zeros(0) if readings is None else self._series.add(readings)
        mean = np.nan if field is None else float(np.nanmean(field.values))
        if np.isnan(self._first_mean):
            self._first_mean = mean
        extent = None if field is None else (float(np.nanmin(field.values)), float(np.nanmax(field.values)))
        cycle = FinishedCycle(number, start, end, frames, field, extent, mean - self._first_mean, drift)
        self._cycles += 1
        return self._state(cycle, evaluate=last and readings is not None)

    def _take(self, start: np.datetime64, end: np.datetime64) -> list[FrameReference]:
        """Take the frames of a cycle; those before it belong to none."""
        inside = []
        while self._waiting and self._on_laser_clock(self._waiting[0]) < end:
            frame = self._waiting.popleft()
            if self._on_laser_clock(frame) >= start:
                inside.append(frame)
        return inside

    def _on_laser_clock(self, frame: FrameReference) -> np.datetime64:
        return frame.time.astype("datetime64[ns]") - self._offset

    def _state(self, cycle: FinishedCycle | None, *, evaluate: bool) -> LiveState:
        values, window = self._series.iso230() if evaluate else ({}, "")
        enough = self._series.enough() if evaluate else None
        told = self._warnings[:_MOST_WARNINGS]
        more = len(self._warnings) - len(told)
        warnings = (*told, *([f"{more} more warnings"] if more else []))
        self._warnings = []
        return LiveState(self._frames_seen, self._readings_seen, self._cycles, cycle, values, window, enough, warnings)


def _reason(rejected: RejectedFrame) -> str:
    """Return why a frame is left out, beginning with its file."""
    return rejected.reason if str(rejected.path) in rejected.reason else f"{rejected.path}: {rejected.reason}"


def _nanoseconds(seconds: float) -> np.timedelta64:
    return np.timedelta64(round(1e9 * seconds), "ns")
