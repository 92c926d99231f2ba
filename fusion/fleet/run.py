"""Runs a fleet: one process per campaign, as many at a time as processors and memory allow; one that fails does not stop the others."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import psutil

from fusion.beside import same_python
from fusion.fleet.members import Member, is_unchanged
from fusion.fleet.page import render_fleet
from fusion.fleet.summary import SUMMARY, Row, as_csv, as_json, read_rows, with_findings
from fusion.products.folder import claim, open_folder
from fusion.products.progress import Report, silent
from fusion.products.store import write_json, write_text
from thermography._processors import usable_processors

#: Memory that a run is taken to need until one has been seen, bytes.
_USUAL_BYTES = 1e9
_POLL_S = 0.1
#: Time for runs that were told to stop, s: a run ends within a second of itself.
_STOP_S = 0.7
#: Beside its own threads, libraries start one per processor in every process unless these say otherwise.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_PAGE, _TABLE, _LOGS = "fleet.html", "fleet.csv", "logs"


@dataclass
class _Running:
    """A campaign that is being run.

    Attributes
    ----------
    row : Row
    process : Popen
    begun : float
        Monotonic time, s.
    peak : float
        Largest memory seen so far, bytes.
    """

    row: Row
    process: subprocess.Popen[bytes]
    begun: float
    peak: float = 0.0

    def measure(self) -> float:
        """Return the memory of the process now, bytes, and keep the largest."""
        now = 0.0
        with suppress(psutil.Error):
            now = float(psutil.Process(self.process.pid).memory_info().rss)
        self.peak = max(self.peak, now)
        return now


def run_fleet(
    members: Sequence[Member],
    out: Path,
    *,
    jobs: int | None = None,
    resume: bool = False,
    report: Report = silent,
    say: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Run campaigns beside each other, each in a process of its own, and write one summary.

    Parameters
    ----------
    members : sequence of Member
        From `find_members`.
    out : Path
        Folder for the summary and, under its name, the results of every campaign; must be empty or absent unless `resume`.
    jobs : int, optional
        Most runs at a time; left out: one per processor that this process may use. Fewer are started while memory is short.
    resume : bool
        Keep campaigns that are finished and have not changed, and continue the others.
    report : callable
        ``report(label, done, total)``, for progress.
    say : callable
        Called with the row of every campaign when it ends.

    Returns
    -------
    list of Row
        In the order of the members.

    Raises
    ------
    OutputError
        If the folder cannot be used.

    Notes
    -----
    ``fleet.json`` is written whenever a campaign ends, ``fleet.csv`` and ``fleet.html`` at the end, also where the fleet is stopped: its
    runs are then told to stop, keep their finished stages, and go on with `resume`.
    """
    with open_folder(out, resume=resume):
        claim(out, SUMMARY, _TABLE, _PAGE)
        return _Fleet(members, out, jobs or usable_processors(), resume, report, say).run()


class _Fleet:
    """State of a fleet that is being run."""

    def __init__(
        self,
        members: Sequence[Member],
        out: Path,
        jobs: int,
        resume: bool,
        report: Report,
        say: Callable[[Row], None],
    ) -> None:
        self.out, self.jobs, self.report, self.say = out, jobs, report, say
        self.resume = resume
        self.campaigns = {member.name: member for member in members}
        self.rows = {member.name: Row(member.name) for member in members}
        self.running: dict[str, _Running] = {}
        self.largest = _USUAL_BYTES
        self.seen_largest = 0.0
        self.started = _now()
        # Signals reach the main thread alone: a run that is being started when the fleet is stopped is known, and told to stop too.
        self.starter = ThreadPoolExecutor(1, "start")
        # A signal may also come while the thread itself is being started, which nothing waits for then.
        self.starting, self.stopped = threading.Lock(), False

    def run(self) -> list[Row]:
        """Run what is not kept, and write the summary whatever happens."""
        waiting = self._keep_unchanged() if self.resume else list(self.campaigns)
        self._tell()
        try:
            while waiting or self.running:
                while waiting and self._has_room():
                    self.starter.submit(self._start, waiting.pop(0)).result()
                self._collect()
                time.sleep(_POLL_S)
        finally:
            self._stop()
            self._write(whole=True)
        return list(self.rows.values())

    def _keep_unchanged(self) -> list[str]:
        """Take over the rows of finished campaigns whose files and products are as they were; return the names of the others."""
        waiting = []
        earlier = read_rows(self.out)
        for name, member in self.campaigns.items():
            row = earlier.get(name)
            if row is not None and row.is_whole and is_unchanged(member, self.out / name):
                kept = with_findings(replace(row, state="kept"), self.out / name)
                if kept.is_whole:
                    self.rows[name] = kept
                    continue
            waiting.append(name)
        return waiting

    def _has_room(self) -> bool:
        """Whether another run may start: a processor is free, and memory for it beside what those that run may still take."""
        if not self.running:
            return True
        if len(self.running) >= self.jobs:
            return False
        to_come = sum(max(self.largest - one.measure(), 0.0) for one in self.running.values())
        return float(psutil.virtual_memory().available) - to_come > self.largest

    def _start(self, name: str) -> None:
        """Start the run of a campaign, unless the fleet is stopped; everything that it says goes to its log."""
        member, folder = self.campaigns[name], self.out / name
        log = f"{_LOGS}/{name}.log"
        (self.out / log).parent.mkdir(parents=True, exist_ok=True)
        row = replace(self.rows[name], log=log)
        python, inherited = same_python()
        command = [*python, "-m", "fusion.cli", "run", str(member.campaign), "--out", str(folder)]
        command += ["--processes", "1"]
        if self.resume and folder.is_dir():
            command.append("--resume")
        threads = str(max(usable_processors() // self.jobs, 1))
        environment = dict.fromkeys(_THREAD_VARIABLES, threads) | inherited | {"PYTHONUNBUFFERED": "1"}
        with self.starting:
            if self.stopped:
                return
            with (self.out / log).open("wb") as stream:
                # A session of its own: a Ctrl-C at the terminal is for the fleet, which tells its runs to stop.
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=stream,
                    stderr=stream,
                    env=environment,
                    start_new_session=True,
                )
            self.running[name] = _Running(row, process, time.monotonic())

    def _collect(self) -> None:
        """Take over the results of the runs that have ended."""
        for name, one in list(self.running.items()):
            one.measure()
            code = one.process.poll()
            if code is None:
                continue
            del self.running[name]
            self.rows[name] = row = self._ended(one, code)
            self.seen_largest = max(self.seen_largest, one.peak)
            self.largest = self.seen_largest or _USUAL_BYTES
            self._write(whole=False)
            self.say(row)
            self._tell()

    def _ended(self, one: _Running, code: int) -> Row:
        """Return the row of a run that has ended."""
        # A process that a signal ended has a negative code; shells, and the command itself, say 128 and its number.
        exit_code = 128 - code if code < 0 else code
        row = replace(
            one.row, exit_code=exit_code, seconds=round(time.monotonic() - one.begun, 1), peak_MB=round(one.peak / 1e6)
        )
        if code == 0:
            return with_findings(replace(row, state="finished"), self.out / row.name)
        # The row names the campaign: its folder need not be told again, nor leave the machine with the summary.
        message = _last_message(self.out / row.log).replace(f"{self.campaigns[row.name].campaign.parent}{os.sep}", "")
        if code == -9:
            message = "ended by the system, most often for want of memory; run fewer at a time with --jobs"
        return replace(row, state="failed", message=message or f"ended with exit code {exit_code}; see {row.log}")

    def _tell(self) -> None:
        """Report how many campaigns are done."""
        done = sum(row.state not in ("waiting", "stopped") for row in self.rows.values())
        self.report("campaigns", done, len(self.rows))

    def _stop(self) -> None:
        """Tell runs that are left to stop, as when the fleet is; they keep their finished stages."""
        with self.starting:
            self.stopped = True
        self.starter.shutdown()
        for name, one in self.running.items():
            one.process.terminate()
            seconds = round(time.monotonic() - one.begun, 1)
            self.rows[name] = replace(one.row, state="stopped", seconds=seconds)
        end = time.monotonic() + _STOP_S
        for one in self.running.values():
            with suppress(subprocess.TimeoutExpired):
                one.process.wait(max(end - time.monotonic(), 0.0))

    def _write(self, *, whole: bool) -> None:
        """Write the summary; the tables for people only where it is `whole`."""
        rows = list(self.rows.values())
        write_json(self.out / SUMMARY, as_json(rows, started=self.started, finished=_now()))
        if whole:
            write_text(self.out / _TABLE, as_csv(rows))
            write_text(self.out / _PAGE, render_fleet(rows, started=self.started))


def _last_message(log: Path) -> str:
    """Return the last thing that a run said of itself, without the name of the program."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    said = [line.removeprefix("thermofuse: ") for line in lines if line.startswith("thermofuse: ")]
    return said[-1] if said else next((line.strip() for line in reversed(lines) if line.strip()), "")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
