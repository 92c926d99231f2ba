"""Runs of the application: each in a process of its own, one per results folder, seen by every page."""

from __future__ import annotations

import json
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from fusion.common import FusionError
from fusion.pipeline.workers import start_run
from fusion.results.numbers import duration
from fusion.results.progress import time_left_s

# How far a run is, stage by stage, and how long the present one still takes.


@dataclass(frozen=True)
class Stage:
    """One step of a run: finished parts `done` of `total`; times in s, of any clock that only advances; `first` parts and when they were
    finished.
    """

    label: str
    done: int
    total: int
    started_s: float
    now_s: float
    first: tuple[int, float] | None = None

    @property
    def share(self) -> float:
        """Finished share, 0 to 1."""
        return min(self.done / self.total, 1.0) if self.total else 1.0

    @property
    def words(self) -> str:
        """How far it is: the time that it took, or the time that is left at the speed so far."""
        elapsed = self.now_s - self.started_s
        if self.share >= 1.0:
            return f"done in {duration(elapsed)}" if elapsed >= 1.0 else "done"
        if self.done == 0:
            return "under way"
        left = None if self.first is None else time_left_s(self.first, self.done, self.total, self.now_s)
        return f"{self.done} of {self.total}" + ("" if left is None else f", about {duration(max(left, 1.0))} left")


@dataclass
class Progress:
    """All steps of a run by name, in the order in which they began."""

    stages: dict[str, Stage] = field(default_factory=dict)

    def take(self, label: str, done: int, total: int, now_s: float) -> None:
        """Note that a step is so far."""
        known = self.stages.get(label)
        if known is None or done < known.done:
            known = Stage(label, 0, total, now_s, now_s)
        first = known.first or ((done, now_s) if done else None)
        self.stages[label] = Stage(label, done, total, known.started_s, now_s, first)


#: Seconds that a run has to end when the application does.
_GRACE_S = 5.0


class RunError(FusionError):
    """A run that cannot be started; the message says why and what to do."""


class RunProcess:
    """One run of a campaign; a run that is in the results folder is continued.

    Attributes
    ----------
    resumed : bool
        Whether something was in the results folder.
    messages : list of str
        What it said, without the name of the program.
    version : int
        Grows with everything that is new.
    """

    def __init__(self, campaign: Path, results: Path) -> None:
        self.campaign, self.results = campaign, results
        self.resumed = is_begun(results)
        self.progress = Progress()
        self.messages: list[str] = []
        self.version = 0
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "encoding": "utf-8"}
        options = ("--quiet", "--json-progress")
        self._process = start_run(campaign, results, *options, resume=self.resumed, errors="replace", **pipes)
        self._thread = Thread(target=self._read, daemon=True)
        self._thread.start()

    @property
    def code(self) -> int | None:
        """Exit code, None while it runs or is still read."""
        return None if self._thread.is_alive() else self._process.poll()

    @property
    def runs(self) -> bool:
        """Whether it is under way."""
        return self.code is None

    def cancel(self) -> None:
        """Tell it to stop; finished stages stay."""
        self._process.terminate()

    def wait(self, timeout_s: float) -> int | None:
        """Wait for its end."""
        end = time.monotonic() + timeout_s
        self._thread.join(timeout_s)
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(max(end - time.monotonic(), 0.0))
        return self.code

    def end(self) -> None:
        """Cancel it, and end it if it does not."""
        self.cancel()
        if self.wait(_GRACE_S) is None:
            self._process.kill()
            self._process.wait()

    def _read(self) -> None:
        """Take in its progress, and what else it says."""
        assert self._process.stdout is not None
        with self._process.stdout as stream:
            for line in stream:
                try:
                    told = json.loads(line)
                    self.progress.take(told["label"], told["done"], told["total"], time.monotonic())
                except (ValueError, KeyError, TypeError):
                    self.messages.append(line.strip().removeprefix("thermofuse: "))
                self.version += 1


class Runs:
    """All runs of one application, the latest per results folder."""

    def __init__(self) -> None:
        self._runs: dict[Path, RunProcess] = {}
        self._lock = Lock()

    def of(self, results: Path) -> RunProcess | None:
        """Return the latest run of a results folder, None where there was none."""
        return self._runs.get(results)

    @property
    def latest(self) -> RunProcess | None:
        """The run that was started last, None before the first: a page that opens shows it."""
        return next(reversed(self._runs.values()), None)

    def start(self, campaign: Path, results: Path) -> RunProcess:
        """Start a run, or continue the one that is in the folder."""
        with self._lock:
            known = self._runs.get(results)
            if known is not None and known.runs:
                raise RunError(f"{results} is in use by a run of another page; wait until it ends, or cancel it")
            self._runs.pop(results, None)
            self._runs[results] = RunProcess(campaign, results)
            return self._runs[results]

    def end(self) -> None:
        """End all of them: the application ends."""
        with self._lock:
            # All are told before one is waited for: the application itself may be given a second only.
            for run in self._runs.values():
                run.cancel()
            for run in self._runs.values():
                run.end()


#: Of this process.
RUNS = Runs()


def is_begun(results: Path) -> bool:
    """Tell whether a results folder holds anything that a run would continue."""
    return results.is_dir() and any(results.iterdir())
