"""Readings that arrive while a test runs: each cycle is given once, when the next one has begun.

A table with one reading per line is read on from where it was read before. Any other file of readings is read again as a whole when it
has changed, but never for more than a small share of the time. What cannot be read may just be being written, and is told when it stands
still.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr

from interferometry.errors import InterferometryError
from interferometry.io.delimited import DELIMITERS, Grid, split_lines
from interferometry.io.encodings import decode_text
from interferometry.io.headings import CHINESE_WORDS
from interferometry.io.long_table import LongTable, find_long_table, read_long_table
from interferometry.io.readers import read_deviations
from interferometry.io.readings import check_and_assemble

Rows = list[tuple[int, list[str]]]
#: First cycles that stay beside every later one: they settle numbering, positions, directions, and the order of day and month.
_CONTEXT_CYCLES = 2
#: Beginnings of files that have no lines of bytes: spreadsheets, UTF-16.
_NO_LINES = (b"PK", b"\xd0\xcf", b"\xff\xfe", b"\xfe\xff")
#: End of what was read, by which a file that was begun anew is recognised, bytes.
_COMPARED_BYTES = 4096
#: A file that can only be read as a whole is read during at most this share of the time.
_READING_SHARE = 0.1
#: What is told of a file that does not go on from what was read of it.
_SHORTER = "has become shorter; watch the test anew if it was begun anew"
_ANEW = "its first cycle is another one, it was begun anew; watch the test anew"


@dataclass(frozen=True, eq=False)
class Arrived:
    """What has come since the last look.

    Attributes
    ----------
    readings : int
        Number of new readings, in finished and unfinished cycles.
    cycles : Dataset or None
        Cycles that were not given before, the one that is still being measured last; keeps ``interferometry.contract.DEVIATIONS``. None
        where no cycle has been finished.
    faults : tuple of str
        Lines that cannot be used, or why the file cannot be read.
    """

    readings: int = 0
    cycles: xr.Dataset | None = None
    faults: tuple[str, ...] = ()


@dataclass
class ArrivingReadings:
    """Readings of the file of a running test.

    Parameters
    ----------
    path : Path
        File of the deviations.
    read_whole : callable
        Reads a file as `interferometry.io.readers.read_deviations` does.
    clock : callable
        Returns seconds that never go back.
    """

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
    _told: set[str] = field(default_factory=set)

    def poll(self, *, final: bool = False) -> Arrived:
        """Return what has come since the last call.

        Parameters
        ----------
        final : bool
            Whether the test is over: the last line need not have an end, and the last cycle is finished too.
        """
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
            return Arrived(
                faults=self._new(
                    [f"{self.path}: lines that were read stand there no more, it was begun anew; watch the test anew"]
                )
            )
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
        if table is None or "cycle" not in table.columns:
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
        lines = _lines(decode_text(self.path, content, chinese_words=CHINESE_WORDS))
        for delimiter in sorted(DELIMITERS, key=lambda mark: -sum(line.count(mark) for line in lines)):
            table = find_long_table(Grid(self.path, "", split_lines(self.path, lines, delimiter)))
            if table is not None:
                self._delimiter = delimiter
                return table
        return None

    def _rows(self, content: bytes) -> Rows:
        text = decode_text(self.path, self._head + content, chinese_words=CHINESE_WORDS)
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
        """Note that the file goes on from what was read of it: should it become shorter or begin anew after that, it is told again."""
        self._shorter = False
        self._told -= {f"{self.path}: {_SHORTER}", f"{self.path}: {_ANEW}"}

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
        """Return the faults that were not told before."""
        new = tuple(dict.fromkeys(fault for fault in faults if fault not in self._told))
        self._told.update(new)
        return new


def _lines(text: str) -> list[str]:
    """Return the lines of a text, comments empty."""
    return ["" if line.startswith("#") else line for line in text.replace("\r\n", "\n").split("\n")]
