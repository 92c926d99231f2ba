"""Follow a test while it runs: wait for frames and readings, and evaluate every cycle once, when it is finished."""

from __future__ import annotations

import json
import math
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

import numpy as np
import xarray as xr

from fusion.analysis.alignment.align import AlignmentError, cycle_bounds
from fusion.campaign.config import Campaign, CampaignError
from fusion.campaign.inputs import overridden_parameters, plan_grid, reader_of_deviations, stack_options
from fusion.campaign.time_zones import bring_to_utc
from fusion.common import Array
from fusion.pipeline.positioning import insufficient_for_model
from fusion.results.numbers import number
from fusion.results.progress import counted
from interferometry.common import InterferometryError
from interferometry.deviations import build_deviations
from interferometry.drift.estimate import estimate_drift
from interferometry.drift.planning import plan_cycles
from interferometry.io.readings import LongTable, check_and_assemble, find_long_table, read_deviations, read_long_table
from interferometry.io.tables import DELIMITERS, Grid, decode_text, split_lines
from interferometry.iso230 import QUANTITIES, STANDARD_CYCLES, evaluate_iso230
from thermography.common import ThermographyError
from thermography.fields.blocks import BLOCK_FRAMES, Registrations, reduce_block
from thermography.fields.moving import reduce_moving_frames
from thermography.io.fff_record import MAGIC
from thermography.io.flir import index_sequence
from thermography.io.frame import FrameReference, RejectedFrame
from thermography.io.other_cameras import StackOptions, index_recordings
from thermography.io.sequence import order_by_time
from thermography.radiometry.camera import Detector
from thermography.radiometry.planck import Overrides, calibrate
from thermography.registration.displacement import RegistrationSpan
from thermography.registration.plan import read_fiducials
from thermography.registration.projection import read_lens
from thermography.registration.register import register, register_picture

# Mean field of every finished cycle on the plan, for a first look: what `thermofuse run` does to all frames comes
# after the test.

#: First frames whose mean is registered.
_REGISTRATION_FRAMES = 5
#: From this displacement of the fiducials on the table or the camera has moved, px.
_MOVED_PX = 1.0


class FieldsOfCycles:
    """Reduces the frames of one cycle after the other, of a campaign with ``[thermography]`` and ``[plan]``."""

    def __init__(self, campaign: Campaign) -> None:
        thermography, plan = campaign.thermography, campaign.plan
        assert thermography is not None and plan is not None
        self._plan = plan
        self._moving = thermography.table == "moving"
        self._direction = (1.0, 0.0) if plan.axis is None else plan.axis.direction
        self._override = Overrides(overridden_parameters(thermography))
        self._fiducials = [] if plan.fiducials is None else read_fiducials(campaign.resolve(plan.fiducials))
        self._lens = None if thermography.lens is None else read_lens(campaign.resolve(thermography.lens))
        self._registered: Registrations | None = None
        self._tried, self._wait = 0, 1

    def reduce(self, frames: Sequence[FrameReference]) -> tuple[xr.DataArray | None, tuple[str, ...]]:
        """Return the mean temperature of a cycle's frames on the plan."""
        if not frames:
            return None, ("no frame in this cycle",)
        try:
            registered = self._register(frames)
            if registered is None:
                return None, ()
            usable = [frame for frame in frames if frame.shape == registered.spans[0].registration.shape]
            if not usable:
                return None, ("the frames of this cycle have another size than the first ones",)
            reduce = self._reduce_moving if self._moving else self._reduce_still
            values, warnings = reduce(usable, registered)
        except (ThermographyError, OSError) as error:
            return None, (str(error),)
        attributes = {"units": "degC", "units_metadata": "temperature: on_scale"}
        places = {"y": registered.grid.y_mm, "x": registered.grid.x_mm}
        return xr.DataArray(values, dims=("y", "x"), coords=places, attrs=attributes), warnings

    def _register(self, frames: Sequence[FrameReference]) -> Registrations | None:
        """Register the plan on the first frames; where that fails it is tried again in ever fewer cycles, because it takes long."""
        if self._registered is not None:
            return self._registered
        self._tried += 1
        if self._tried < self._wait:
            return None
        self._wait = 2 * self._tried
        first = [frame for frame in frames if frame.shape == frames[0].shape][
            : 1 if self._moving else _REGISTRATION_FRAMES
        ]
        reference = np.mean([calibrate(frame.read_counts(), self._override(frame)) for frame in first], axis=0)
        grid = plan_grid(self._plan, reference.shape)
        if self._plan.in_pixels:
            registration = register_picture(reference.shape)
        else:
            registration = register(reference, self._fiducials, grid=grid, lens=self._lens)
        self._registered = Registrations([RegistrationSpan(0, registration)], grid, Detector.sound(registration.shape))
        return self._registered

    def _reduce_still(
        self, frames: Sequence[FrameReference], registered: Registrations
    ) -> tuple[Array, tuple[str, ...]]:
        total, moved = np.zeros(()), 0.0
        for parameters, group in groupby(frames, key=self._override):
            alike = list(group)
            for start in range(0, len(alike), BLOCK_FRAMES):
                block = alike[start : start + BLOCK_FRAMES]
                result = reduce_block(block, parameters, registered.sensors[0])
                total = total + len(block) * result.cells
                shifts = np.hypot(*result.displacement_px[:, :2].T)
                moved = max(moved, float(np.nanmedian(shifts)) if np.isfinite(shifts).any() else 0.0)
        warnings = (f"table or camera has moved by {moved:.1f} px since the first frames",) if moved > _MOVED_PX else ()
        return total / len(frames), warnings

    def _reduce_moving(
        self, frames: Sequence[FrameReference], registered: Registrations
    ) -> tuple[Array, tuple[str, ...]]:
        bounds = np.array([[frames[0].time, frames[-1].time + np.timedelta64(1, "ms")]], "datetime64[ns]")
        where = (registered.spans[0].registration, registered.grid, bounds)
        fields = reduce_moving_frames(frames, *where, direction=self._direction, override=self._override)
        return fields["temperature"].values[0], ()


# Frames that arrive while a test runs: files that appear, and sequences that grow; each frame is given once, when it
# is whole.


@dataclass
class _Sequence:
    """A FLIR sequence that may grow: how far it was read, the size that was seen last, and whether it was at rest then."""

    following: int = 0
    index: int = 0
    size: int = -1
    rested: bool = False


class ArrivingFrames:
    """Frames of the files of a running test.

    A file is read when its size was the same twice, because it may still be being copied. A FLIR sequence (SEQ, CSQ) is read on from
    where it was read before; its last frame waits until another one follows or the file rests. Only sizes are compared, no times of
    files: the clock of the machine may be set during the test. No file is kept open.
    """

    def __init__(self, list_files: Callable[[], Iterable[Path]], options: StackOptions) -> None:
        self._list_files = list_files
        self._options = options
        self._sizes: dict[Path, int] = {}
        self._read: set[Path] = set()
        self._sequences: dict[Path, _Sequence] = {}

    def poll(self) -> tuple[list[FrameReference], list[RejectedFrame]]:
        """Return the frames that have become whole since the last call, by time, and those that cannot be used."""
        frames: list[FrameReference] = []
        rejected: list[RejectedFrame] = []
        for path in self._list_files():
            if path in self._read:
                continue
            new, damaged = self._poll_file(path)
            frames += new
            rejected += damaged
        timed = [frame for frame in frames if not np.isnat(frame.time)]
        without = [frame for frame in frames if np.isnat(frame.time)]
        rejected += [RejectedFrame(one.path, one.index, f"{one.path}: the frame has no time") for one in without]
        kept, repeated = order_by_time(timed)
        return list(kept), rejected + repeated

    def _poll_file(self, path: Path) -> tuple[list[FrameReference], list[RejectedFrame]]:
        sequence = self._sequences.get(path)
        try:
            size = path.stat().st_size
            if sequence is not None:
                return self._go_on(path, sequence, size), []
            if path not in self._sizes and size >= len(MAGIC) and _starts_as_sequence(path):
                sequence = self._sequences[path] = _Sequence()
                return self._go_on(path, sequence, size), []
            if size < len(MAGIC) or self._sizes.get(path) != size:
                self._sizes |= {path: size} if size >= len(MAGIC) else {}
                return [], []
            found, rejected = index_recordings([path], self._options)
            frames = list(found)
        except (OSError, ThermographyError) as error:
            frames, rejected = [], [RejectedFrame(path, 0, str(error))]
        self._sizes.pop(path, None)
        self._read.add(path)
        return frames, rejected

    def _go_on(self, path: Path, sequence: _Sequence, size: int) -> list[FrameReference]:
        """Return the frames of a sequence that are new; damaged ones are named by the run that follows."""
        rests = size == sequence.size
        if rests and sequence.rested:
            return []
        sequence.size, sequence.rested = size, rests
        frames, rejected, sequence.following = index_sequence(
            path, start=sequence.following, index=sequence.index, growing=not rests
        )
        sequence.index += len(frames) + (0 if rests else len(rejected))
        return frames


def _starts_as_sequence(path: str | os.PathLike[str]) -> bool:
    with Path(path).open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


# Readings that arrive while a test runs: each cycle is given once, when the next one has begun.

Rows = list[tuple[int, list[str]]]
#: First cycles that stay with every later one: they settle numbering, positions, directions, and the order of day and month.
_CONTEXT_CYCLES = 2
#: Beginnings of files that have no lines of bytes: spreadsheets, UTF-16.
_NO_LINES = (b"PK", b"\xd0\xcf", b"\xff\xfe", b"\xfe\xff")
#: End of what was read, by which a file that was restarted is recognised, bytes.
_COMPARED_BYTES = 4096
#: A file that can only be read as a whole is read during at most this share of the time.
_READING_SHARE = 0.1
#: What is reported of a file that does not go on from what was read of it.
_SHORTER = "has become shorter; restart the watch if the test was restarted"
_ANEW = "its first cycle has changed, so the file was restarted; restart the watch"


@dataclass(frozen=True, eq=False)
class Arrived:
    """What has come since the last look: number of new readings; the finished cycles that were not given before with the one being measured
    last, None where none has been finished; lines that cannot be used, or why the file cannot be read.
    """

    readings: int = 0
    cycles: xr.Dataset | None = None
    faults: tuple[str, ...] = ()


@dataclass
class ArrivingReadings:
    """Readings of the file of a running test; `clock` returns seconds that never go back."""

    path: Path
    read_whole: Callable[[Path], xr.Dataset] = read_deviations
    clock: Callable[[], float] = time.monotonic
    _offset: int = 0
    _lines: int = 0
    _delimiter: str = ""
    _head: bytes = b""
    _before: bytes = b""
    _header: Rows = field(default_factory=list)
    _context: Rows = field(default_factory=list)
    _context_cycles: set[int] = field(default_factory=set)
    _pending: Rows = field(default_factory=list)
    _size: int = -1
    _changed: int = -1
    _failed: tuple[int, int] = (-1, -1)
    _next_whole: float = -np.inf
    _last: int = 0
    _counted: int = 0
    _first: list[float] = field(default_factory=list)
    _shorter: bool = False
    _reported: set[str] = field(default_factory=set)

    def poll(self, *, final: bool = False) -> Arrived:
        """Return what has come since the last call."""
        try:
            now = self.path.stat()
            if (now.st_size, now.st_mtime_ns) == (self._size, self._changed) and not final:
                return Arrived()
            self._size, self._changed = now.st_size, now.st_mtime_ns
            return self._poll_whole(final=final) if self._last and not self._header else self._poll_lines(final=final)
        except InterferometryError as error:
            return self._wait_until_still(error, final=final)
        except OSError as error:
            return Arrived(faults=self._new([str(error)]))

    def _poll_lines(self, *, final: bool) -> Arrived:
        """Read the lines that are new."""
        if self._size < self._offset:
            return self._wait_or_tell(final=final)
        with self.path.open("rb") as file:
            file.seek(self._offset - len(self._before))
            before, content = file.read(len(self._before)), file.read()
        if before != self._before:
            fault = f"{self.path}: lines that were read earlier are gone, so the file was restarted; restart the watch"
            return Arrived(faults=self._new([fault]))
        self._go_on()
        end = len(content) if final else content.rfind(b"\n") + 1
        if not self._header:
            return self._begin(content[:end], final=final)
        self._pending += self._rows(content[:end])
        self._offset += end
        self._before = (self._before + content[:end])[-_COMPARED_BYTES:]
        return self._evaluate(final=final)

    def _begin(self, content: bytes, *, final: bool) -> Arrived:
        """Look for the header; a file that is no table of one reading per line is read as a whole."""
        if not content.strip():
            return Arrived()
        table = None if content.startswith(_NO_LINES) else self._find_table(content)
        if table is None or not {"cycle", "direction"} <= table.columns.keys():
            return self._poll_whole(final=final)
        if not table.rows:
            return Arrived()
        rows = table.grid.rows
        self._header = [row for row in rows if row[0] < table.rows[0][0]]
        self._pending = [row for row in rows if row[0] >= table.rows[0][0]]
        # Marks of the encoding stand at the beginning.
        self._head = content[: content.find(b"\n") + 1]
        self._lines, self._offset = content.count(b"\n"), len(content)
        self._before = content[-_COMPARED_BYTES:]
        return self._evaluate(final=final)

    def _find_table(self, content: bytes) -> LongTable | None:
        lines = _lines(decode_text(self.path, content))
        for delimiter in sorted(DELIMITERS, key=lambda mark: -sum(line.count(mark) for line in lines)):
            table = find_long_table(Grid(self.path, "", split_lines(self.path, lines, delimiter)))
            if table is not None:
                self._delimiter = delimiter
                return table
        return None

    def _rows(self, content: bytes) -> Rows:
        text = decode_text(self.path, self._head + content)
        rows = split_lines(self.path, _lines(text)[1:], self._delimiter)
        first, self._lines = self._lines, self._lines + content.count(b"\n")
        return [(first + line, fields) for line, fields in rows]

    def _evaluate(self, *, final: bool) -> Arrived:
        """Give the cycles of the pending rows, and keep those of the last one."""
        if not self._pending:
            return Arrived()
        grid = Grid(self.path, "", [*self._header, *self._context, *self._pending])
        table = find_long_table(grid)
        assert table is not None  # the header has been found before
        readings = read_long_table(table)
        begun = {row[0] for row in self._pending}
        lines = {one.line: one.cycle for one in readings.readings if one.line in begun}
        deviations = check_and_assemble(readings)
        arrived = self._give(deviations, final=final)
        if arrived.cycles is not None:
            opened = min((line for line, cycle in lines.items() if cycle > self._last), default=max(begun) + 1)
            done = [row for row in self._pending if row[0] < opened]
            self._context += [row for row in done if self._belongs_to_context(lines.get(row[0]))]
            self._pending = [row for row in self._pending if row[0] >= opened]
        return arrived

    def _belongs_to_context(self, cycle: int | None) -> bool:
        """Whether the rows of a finished cycle are kept."""
        if cycle is not None and len(self._context_cycles) < _CONTEXT_CYCLES:
            self._context_cycles.add(cycle)
        return cycle in self._context_cycles

    def _poll_whole(self, *, final: bool) -> Arrived:
        """Read the file again, unless that was done just now."""
        now = self.clock()
        if now < self._next_whole and not final:
            self._size = -1
            return Arrived()
        try:
            deviations = self.read_whole(self.path)
        finally:
            self._next_whole = self.clock() + (self.clock() - now) / _READING_SHARE
        first = np.sort(deviations["deviation"].values[0], axis=None)
        values = first[np.isfinite(first)].tolist()
        if self._first and Counter(values) - Counter(self._first):
            return Arrived(faults=self._new([f"{self.path}: {_ANEW}"]))
        if len(values) < len(self._first) or deviations["cycle"].values[-1] < self._last:
            return self._wait_or_tell(final=final)
        self._go_on()
        arrived = self._give(deviations, final=final)
        self._first = values if self._last else []
        return arrived

    def _wait_or_tell(self, *, final: bool) -> Arrived:
        """Wait for one more look at a file that has become shorter, which may just be being written; tell it where it stays so."""
        if self._shorter or final:
            return Arrived(faults=self._new([f"{self.path}: {_SHORTER}"]))
        self._shorter, self._size = True, -1
        return Arrived()

    def _wait_until_still(self, error: InterferometryError, *, final: bool) -> Arrived:
        """Look once more at a file that cannot be read; tell why where it has not changed since."""
        found = self._size, self._changed
        if found == self._failed or final:
            return Arrived(faults=self._new([str(error)]))
        self._failed, self._size = found, -1
        return Arrived()

    def _go_on(self) -> None:
        """The file goes on from what was read of it: if it becomes shorter or is restarted later, that is reported again."""
        self._shorter = False
        self._reported -= {f"{self.path}: {_SHORTER}", f"{self.path}: {_ANEW}"}

    def _give(self, deviations: xr.Dataset, *, final: bool) -> Arrived:
        """Return the finished cycles that were not given before, with the open one, and note that they were."""
        new = deviations.isel(cycle=deviations["cycle"].values > self._last)
        count = int(np.isfinite(new["deviation"].values).sum())
        faults = self._new(
            f"{self.path.name}, line {item['line']}: {item['value']!r} {item['reason']}"
            for item in json.loads(deviations.attrs.get("left_out", "[]"))
        )
        least = 1 if final else 2
        if new.sizes["cycle"] < least:
            fresh, self._counted = max(count - self._counted, 0), count
            return Arrived(fresh, None, faults)
        fresh = max(count - self._counted, 0)
        self._last = int(new["cycle"].values[-least])
        self._counted = 0 if final else int(np.isfinite(new["deviation"].values[-1]).sum())
        return Arrived(fresh, new, faults)

    def _new(self, faults: Iterable[str]) -> tuple[str, ...]:
        """Return the faults that were not reported before."""
        new = tuple(dict.fromkeys(fault for fault in faults if fault not in self._reported))
        self._reported.update(new)
        return new


def _lines(text: str) -> list[str]:
    """Return the lines of a text, comments empty."""
    return ["" if line.startswith("#") else line for line in text.replace("\r\n", "\n").split("\n")]


# What is known of a test while it runs.


@dataclass(frozen=True, eq=False)
class FinishedCycle:
    """A cycle after which the next one has begun.

    Attributes
    ----------
    number : as the readings number it, or of the window of time where there is no laser
    start, end : first instant of the cycle and of the next one, on the laser's clock; NaT where the readings have no times
    field : (y, x), mean temperature of the table in the cycle, degC; None where no frame of it can be used
    rise_K : mean rise of the table since the first cycle that has a field, K; NaN where it is not known
    drift_um
        (target,), change of the deviation at every target since the first cycle, mean of the directions, um; NaN where a reading is
        missing. Empty without a laser.
    """

    number: int
    start: np.datetime64
    end: np.datetime64
    frames: int
    field: xr.DataArray | None
    field_range_degC: tuple[float, float] | None
    rise_K: float
    drift_um: np.ndarray

    @property
    def mean_drift_um(self) -> float:
        """Mean of `drift_um` over the targets, um; NaN where no target has one."""
        known = self.drift_um[np.isfinite(self.drift_um)]
        return float(known.mean()) if known.size else float("nan")

    @property
    def last_drift_um(self) -> float:
        """`drift_um` of the last target, um; NaN without a laser."""
        return float(self.drift_um[-1]) if self.drift_um.size else float("nan")


@dataclass(frozen=True)
class Enough:
    """Whether the cycles so far are enough: the largest standard uncertainty of a position against the first one that they reach, um, how
    many reach the wanted one, and what an analysis still lacks, in words.
    """

    cycles: int
    u_um: float
    cycles_for_wanted: int
    lacks: str

    @property
    def is_enough(self) -> bool:
        """Whether the test may end."""
        return not self.lacks and self.cycles >= self.cycles_for_wanted


@dataclass(frozen=True, eq=False)
class LiveState:
    """A test so far: frames and readings seen, cycles finished.

    Attributes
    ----------
    cycle : the cycle that has just been finished; None where only frames or readings have come
    iso230_um : quantities of ISO 230-2 (B, R, E, M, A) of the last five cycles, `iso230_window`, um; empty before there are two
    enough : whether the cycles are enough; None before it can be determined
    warnings : what has been noticed since the last state
    """

    frames: int
    readings: int
    cycles: int
    cycle: FinishedCycle | None
    iso230_um: Mapping[str, float]
    iso230_window: str
    enough: Enough | None
    warnings: tuple[str, ...]


def live_line(state: LiveState) -> str:
    """Return a finished cycle and what is known after it as one line.

    >>> nat = np.datetime64("NaT", "ns")
    >>> cycle = FinishedCycle(7, nat, nat, 3, None, (23.1, 25.64), 0.8, np.array([1.0, 1.5]))
    >>> live_line(LiveState(21, 140, 7, cycle, {"A": 4.21}, "cycles 3 to 7", Enough(7, 0.31, 68, ""), ()))
    'cycle 7: 3 frames, 23.10 to 25.64 degC, rise 0.80 K; drift 1.25 µm; A 4.21 µm (cycles 3 to 7); u 0.31 µm, wanted after 68 cycles'
    """
    cycle = state.cycle
    assert cycle is not None
    parts = []
    if cycle.field_range_degC is not None:
        low, high = cycle.field_range_degC
        parts.append(f"{counted(cycle.frames, 'frame')}, {low:.2f} to {high:.2f} degC, rise {cycle.rise_K:.2f} K")
    elif cycle.frames:
        parts.append(f"{counted(cycle.frames, 'frame')}, no field")
    if math.isfinite(cycle.mean_drift_um):
        parts.append(f"drift {cycle.mean_drift_um:.2f} µm")
    if state.iso230_um:
        values = ", ".join(f"{name} {number(value, 3)} µm" for name, value in state.iso230_um.items())
        parts.append(f"{values} ({state.iso230_window})")
    if state.enough is not None:
        parts.append(_enough_words(state.enough))
    return f"cycle {cycle.number}: {'; '.join(parts) or 'no usable data'}"


def _enough_words(enough: Enough) -> str:
    """Return whether the cycles are enough, in words."""
    reached = f"u {number(enough.u_um, 2)} µm" if math.isfinite(enough.u_um) else ""
    wanted = "enough" if enough.is_enough else f"wanted after {enough.cycles_for_wanted} cycles" if reached else ""
    return ", ".join(text for text in (reached, wanted, enough.lacks) if text)


# Readings of the finished cycles: drift since the first one, ISO 230-2 of the last five, and whether the cycles are
# enough.

#: Cycles that the joint estimate of the drift takes into account: the latest of a long test, so that time and memory stay bounded.
_LATEST = 200
#: The estimate is made again when the cycles have grown by this share.
_GROWTH = 0.1


class CycleSeries:
    """The latest cycles of a test, and the first as reference; `wanted_u_um` is the standard uncertainty that it is to reach, um."""

    def __init__(self, wanted_u_um: float) -> None:
        self._wanted_u_um = wanted_u_um
        self._latest: deque[tuple[int, Array, Array]] = deque(maxlen=_LATEST)
        self._targets: list[int] = []
        self._position_mm: Array = np.zeros(0)
        self._first_um: Array | None = None
        self._estimated = 0
        self._enough: Enough | None = None
        self.count = 0

    def add(self, cycle: xr.Dataset) -> Array:
        """Add a finished cycle, a Dataset (direction, target) of one cycle, and return the drift of its targets, (target,) um."""
        if self._first_um is None:
            self._targets = cycle["target"].values.tolist()
            self._position_mm = cycle["position"].values
        aligned = cycle.reindex(target=self._targets)
        deviation, times = aligned["deviation"].values, aligned["time"].values
        if self._first_um is None:
            self._first_um = deviation
        self._latest.append((int(cycle["cycle"]), deviation, times))
        self.count += 1
        # A reading that the first cycle lacks refers to the first one that there is.
        self._first_um = np.where(np.isnan(self._first_um), deviation, self._first_um)
        change = deviation - self._first_um
        known = np.isfinite(change).sum(axis=0)
        return np.asarray(np.where(known, np.nansum(change, axis=0) / np.maximum(known, 1), np.nan))

    def iso230(self) -> tuple[Mapping[str, float], str]:
        """Return the quantities of ISO 230-2 of the last five cycles, um, and the name of this window; empty where it has no scatter."""
        if self.count < 2:
            return {}, ""
        try:
            found = evaluate_iso230(self._deviations(STANDARD_CYCLES))
        except InterferometryError:
            return {}, ""
        values = {name: float(found[name]) for name in QUANTITIES}
        return {name: value for name, value in values.items() if math.isfinite(value)}, str(found.attrs["window"])

    def enough(self) -> Enough | None:
        """Return whether the cycles are enough; None where it cannot be determined."""
        if self.count < max(math.ceil(self._estimated * (1.0 + _GROWTH)), 3):
            return self._enough
        self._estimated = self.count
        deviations = self._deviations(_LATEST)
        lacks = " ".join(notice.remedy for notice in insufficient_for_model(deviations))
        try:
            plan = plan_cycles(deviations, estimate_drift(deviations), wanted_u_um=self._wanted_u_um)
        except InterferometryError as error:
            self._enough = Enough(self.count, math.nan, 0, lacks or str(error))
            return self._enough
        reached = plan.u_um * math.sqrt(plan.cycles / self.count)
        self._enough = Enough(self.count, reached, plan.cycles, lacks)
        return self._enough

    def _deviations(self, most: int) -> xr.Dataset:
        """Return the latest cycles, at most `most`."""
        numbers, deviation, times = zip(*list(self._latest)[-most:], strict=True)
        return build_deviations(numbers, self._targets, self._position_mm, np.array(deviation), np.array(times))


#: Length of the windows that serve as cycles where no laser gives them and the campaign file states none, s.
_WINDOW_S = 60.0
#: So long a finished cycle waits for the camera's frames, s.
_CAMERA_PATIENCE_S = 30.0
#: Most frames that wait for the readings of their cycle: beyond them the oldest are left to the full run.
_MOST_WAITING = 20_000
#: Most warnings of one state that are listed singly.
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
    """Yield what is known of a running test, whenever a cycle has been finished or something has come."""
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
            self._laser = ArrivingReadings(campaign.resolve(laser.deviations), reader_of_deviations(campaign), clock)
            if laser.recompensates:
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
        for one in rejected:
            self._warnings.append(one.reason if str(one.path) in one.reason else f"{one.path}: {one.reason}")
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
            zone = self._campaign.zone_of("interferometry")
            cycles = bring_to_utc(arrived.cycles, zone, file=table.deviations, late_s=table.clock_offset_s)
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
        """Put windows of the camera's time into the queue: they serve as cycles where there is no laser."""
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
        warnings, more = tuple(self._warnings[:_MOST_WARNINGS]), len(self._warnings) - _MOST_WARNINGS
        warnings += (f"{more} more warnings",) if more > 0 else ()
        self._warnings = []
        return LiveState(self._frames_seen, self._readings_seen, self._cycles, cycle, values, window, enough, warnings)


def _nanoseconds(seconds: float) -> np.timedelta64:
    return np.timedelta64(round(1e9 * seconds), "ns")
