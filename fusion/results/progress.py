"""Progress of a long step: bars on a terminal, plain lines elsewhere, nothing in a library."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from threading import Event, Thread
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich import progress as bars
from rich.console import Console

if TYPE_CHECKING:
    import xarray as xr

    from fusion.results.results import Notice


# What was left out of a file, counted and named.

#: Maximum number of omitted items listed in a message; the products hold all of them.
_NAMED = 5


def left_out_notices(dataset: xr.Dataset, code: str) -> list[Notice]:
    """Return notices for each file that count its rejected lines and its cells without a reading, and list the first of them."""
    return [
        _notice(
            "lines_left_out", code=code, left_out=counted(len(named), noun), path=path, named=listed(named), noun=noun
        )
        for name, noun in (("left_out", "line"), ("marks", "reading"))
        for path, named in _lines_by_file(dataset, name)
    ]


def clock_notices(dataset: xr.Dataset) -> list[Notice]:
    """Return one notice for each file whose clock goes back, with the first lines at which it does."""
    return [
        _notice("clock_goes_back", path=path, times=counted(len(named), "time"), named=listed(named))
        for path, named in _lines_by_file(dataset, "clock")
    ]


def _notice(words: str, **facts: Any) -> Notice:
    from fusion.results.results import Notice  # loads the models of results, which few files need

    return Notice.of(words, **facts)


def _lines_by_file(dataset: xr.Dataset, name: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the name of every file and its lines in words, from the list of lines that an attribute holds."""
    lines = json.loads(dataset.attrs.get(name, "[]"))
    for path in dict.fromkeys(item["path"] for item in lines):
        yield (
            path,
            [f"line {item['line']} ({item['value']!r} {item['reason']})" for item in lines if item["path"] == path],
        )


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, plural unless the number is 1."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def listed(names: Iterable[str]) -> str:
    """Return the first names, and how many more there are."""
    names = list(names)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return "; ".join(names[:_NAMED]) + more


#: ``report(label, done, total)``; called first with done = 0 and last with done = total.
Report = Callable[[str, int, int], None]

_SECONDS_BETWEEN_LINES = 10.0
#: Share of the parts of a step after which its speed is known.
_PACED = 0.05


def time_left_s(first: tuple[int, float], done: int, total: int, now_s: float) -> float | None:
    """Return the time that is left at the speed since the first parts, ``(parts, s)``, were reported, which wait for all that a step has to
    start; None where too few followed.
    """
    parts, since_s = first
    followed = done - parts
    return (now_s - since_s) / followed * (total - done) if followed >= max(1, _PACED * total) else None


#: A step is overdue after this multiple of its forecast, of one without parts: of what the run took before it; and after a minute.
_OVERDUE, _LEAST_OVERDUE_S = 10.0, 60.0
_BY_PARTS, _BY_RUN = "{:.0f} s were expected from its first parts", "the whole run before it took {:.0f} s"


def silent(label: str, done: int, total: int) -> None:
    """Report nothing."""


def write_lines(label: str, done: int, total: int) -> None:
    """Report by one JSON object per line."""
    # In one piece: two processes may tell their progress at a time.
    sys.stdout.write(json.dumps({"label": label, "done": done, "total": total}) + "\n")
    sys.stdout.flush()


class Reporter(AbstractContextManager["Reporter"]):
    """Shows the progress of a run on a console: bars on a terminal, otherwise one line at each start, end and every ten seconds."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bars: bars.Progress | None = None
        self._tasks: dict[str, object] = {}
        self._started: dict[str, float] = {}
        self._spoken: dict[str, float] = {}
        self._first: dict[str, tuple[int, float]] = {}
        self._finished: set[str] = set()
        self._running: dict[str, tuple[float, float, str]] = {}
        self._begun = time.monotonic()
        self._ended = Event()
        self._watching = Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Reporter:
        if self._console.is_terminal:
            columns = (
                bars.SpinnerColumn(),
                bars.TextColumn("{task.description:<34}"),
                bars.BarColumn(),
                bars.MofNCompleteColumn(),
                bars.TimeElapsedColumn(),
                bars.TimeRemainingColumn(compact=True),
            )
            self._bars = bars.Progress(*columns, console=self._console)
            self._bars.start()
        # A step that hangs reports nothing.
        self._watching.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._watching.join()
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, label: str, done: int, total: int) -> None:
        """Show that `done` of `total` parts of the step `label` are finished."""
        now = time.monotonic()
        running = self._running.pop(label, (now, now - self._begun, _BY_RUN))
        if done < total:
            started, forecast_s, known = running
            if done and known != _BY_PARTS:
                forecast_s, known = (now - started) / done * total, _BY_PARTS
            self._running[label] = started, forecast_s, known
        if self._bars is None:
            self._write(label, done, total, now)
            return
        if label not in self._tasks:
            self._tasks[label] = self._bars.add_task(label, total=max(total, 1))
        self._bars.update(self._tasks[label], completed=done if total else 1, total=max(total, 1))  # type: ignore[arg-type]

    def _watch(self) -> None:
        while not self._ended.wait(_SECONDS_BETWEEN_LINES):
            self._say_overdue(time.monotonic())

    def _say_overdue(self, now: float) -> None:
        """Say once of every step that takes ten times what its first parts, or the run before it, let expect."""
        for label, (started, forecast_s, known) in list(self._running.items()):
            if forecast_s > 0.0 and now - started > max(_OVERDUE * forecast_s, _LEAST_OVERDUE_S):
                self._console.print(
                    f"{label}: {now - started:.0f} s so far, {known.format(forecast_s)}; Ctrl-C stops the run, and --resume "
                    "goes on from its finished stages",
                    highlight=False,
                )
                self._running[label] = started, float("inf"), known

    def _write(self, label: str, done: int, total: int, now: float) -> None:
        if label in self._finished:
            if done >= total:
                return
            self._finished.remove(label)
            del self._started[label], self._first[label]
        if label not in self._started:
            self._started[label] = self._spoken[label] = now
            if done < total:
                self._console.print(f"{label} ...", highlight=False)
                return
        if done:
            self._first.setdefault(label, (done, now))
        if done >= total:
            self._finished.add(label)
            self._first.setdefault(label, (done, now))
            self._console.print(f"{label}: done in {now - self._started[label]:.1f} s", highlight=False)
        elif now - self._spoken[label] > _SECONDS_BETWEEN_LINES:
            self._spoken[label] = now
            left_s = time_left_s(self._first[label], done, total, now) if done else None
            left = "" if left_s is None else f", about {left_s:.0f} s left"
            self._console.print(f"{label}: {done} of {total}{left}", highlight=False)
