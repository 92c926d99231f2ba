"""Runs of the application: each in a process of its own, one per results folder, seen by every page."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from threading import Lock, Thread
from typing import IO

from fusion.app.run.progress import Progress
from fusion.beside import same_python
from fusion.errors import FusionError

#: Seconds that a run has to end when the application does.
_GRACE_S = 5.0


class RunError(FusionError):
    """A run that cannot be started; the message says why and what to do."""


class RunProcess:
    """One run.

    Parameters
    ----------
    campaign : Path
        The campaign file.
    results : Path
        Results folder; a run that is in it is continued.

    Attributes
    ----------
    campaign, results : Path
        As given.
    resumed : bool
        Whether something was in the results folder.
    progress : Progress
        Its steps so far.
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
        python, environment = same_python()
        command = [*python, "-m", "fusion.app.run.child", str(campaign), str(results)]
        self._process = subprocess.Popen(
            [*command, "--resume"] if self.resumed else command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
        )
        assert self._process.stdout is not None and self._process.stderr is not None
        self._threads = [
            Thread(target=self._read_progress, args=(self._process.stdout,), daemon=True),
            Thread(target=self._read_messages, args=(self._process.stderr,), daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def code(self) -> int | None:
        """Exit code, None while it runs or is still read."""
        if any(thread.is_alive() for thread in self._threads):
            return None
        return self._process.poll()

    @property
    def runs(self) -> bool:
        """Whether it is under way."""
        return self.code is None

    def cancel(self) -> None:
        """Tell it to stop; finished stages stay."""
        if self._process.poll() is None:
            with suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGTERM)

    def wait(self, timeout_s: float) -> int | None:
        """Wait for its end.

        Parameters
        ----------
        timeout_s : float, s
            Longest time.

        Returns
        -------
        int or None
            Exit code; None where it still runs.
        """
        end = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(end - time.monotonic(), 0.0))
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(max(end - time.monotonic(), 0.0))
        return self.code

    def end(self) -> None:
        """Cancel it, and end it if it does not."""
        self.cancel()
        if self.wait(_GRACE_S) is None:
            self._process.kill()
            self._process.wait()

    def _read_progress(self, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                with suppress(ValueError, KeyError, TypeError):
                    told = json.loads(line)
                    self.progress.take(told["label"], told["done"], told["total"], time.monotonic())
                    self.version += 1

    def _read_messages(self, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                self.messages.append(line.strip().removeprefix("thermofuse: "))
                self.version += 1


class Runs:
    """All runs of one application, the latest per results folder."""

    def __init__(self) -> None:
        self._runs: dict[Path, RunProcess] = {}
        self._lock = Lock()

    def of(self, results: Path) -> RunProcess | None:
        """Return the latest run of a results folder, None where there was none.

        Parameters
        ----------
        results : Path
            Results folder.
        """
        return self._runs.get(results)

    @property
    def latest(self) -> RunProcess | None:
        """The run that was started last, None before the first: a page that opens shows it."""
        return next(reversed(self._runs.values()), None)

    def start(self, campaign: Path, results: Path) -> RunProcess:
        """Start a run, or continue the one that is in the folder.

        Parameters
        ----------
        campaign : Path
            The campaign file.
        results : Path
            Results folder.

        Raises
        ------
        RunError
            If the folder is in use by a run of this application, from whatever page.
        """
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
    """Tell whether a results folder holds anything that a run would continue.

    Parameters
    ----------
    results : Path
        Results folder; it may be absent.
    """
    return results.is_dir() and any(results.iterdir())
