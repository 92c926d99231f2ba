"""Runs a fleet: one process per campaign, as many at a time as processors and memory allow; one that fails does not stop the others."""

from __future__ import annotations

import os
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import psutil

from fusion.campaign.config import load_campaign
from fusion.campaign.values import in_order
from fusion.common import CAMPAIGN_FILE, FusionError
from fusion.pipeline.resume import kept_results
from fusion.pipeline.workers import start_run
from fusion.report.fleet import SUMMARY, Row, as_csv, as_json, read_rows, render_fleet, with_findings, write_book
from fusion.results.folder import MANIFEST, claim, open_folder, own_place
from fusion.results.progress import Report, silent
from fusion.results.store import write_atomically, write_json, write_text
from thermography.common import usable_processors

# Campaigns of a fleet: found in folders, each with a name of its own; and whether the results of one are still those
# of its files.

#: Names in the folder of a fleet that are its own, in lower case: not every file system tells case apart.
RESERVED = frozenset({"logs", "fleet.json", "fleet.csv", "fleet.xlsx", "fleet.html", MANIFEST, ".stages"})


class FleetError(FusionError):
    """A fleet without campaigns, or with campaigns that cannot be distinguished; the message says what to do."""


@dataclass(frozen=True)
class Member:
    """One campaign of a fleet: its file, and a name for it that is unique in the fleet, with ``/`` between folders."""

    name: str
    campaign: Path


def find_members(paths: Sequence[Path]) -> list[Member]:
    """Return the campaigns of a fleet, sorted by name."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            found = in_order(path.rglob(CAMPAIGN_FILE))
            if not found:
                raise FleetError(
                    f"{path}: holds no {CAMPAIGN_FILE}; thermofuse init {path} writes one, of several laser tests one for each; or "
                    "name the campaign files, or the folder above theirs"
                )
            files += found
        elif path.is_file():
            files.append(path)
        else:
            raise FleetError(f"{path}: is not there; name campaign files, or folders that hold them")
    absolute = list(dict.fromkeys(path.resolve() for path in files))
    in_folder = Counter(path.parent for path in absolute)
    common = Path(os.path.commonpath([path.parent for path in absolute]))
    members = []
    for path in absolute:
        place = path.parent.relative_to(common)
        if in_folder[path.parent] > 1 or place == Path():
            place = place / (path.stem if in_folder[path.parent] > 1 else path.parent.name)
        if place.parts[0].lower() in RESERVED:
            raise FleetError(
                f"{path}: its results would be written to the folder {place.parts[0]}, which is reserved for the fleet; rename the folder "
                "of this campaign, or name another one above it"
            )
        members.append(Member(place.as_posix(), path))
    names = {member.name: member for member in members}
    if len(names) < len(members):
        twice = next(name for name, count in Counter(member.name for member in members).items() if count > 1)
        raise FleetError(f"two campaigns would have the results folder {twice}; rename one of their files")
    for name, member in names.items():
        outer = next((str(above) for above in map(Path.as_posix, Path(name).parents) if above in names), None)
        if outer is not None:
            raise FleetError(
                f"{member.campaign}: is in the folder of {names[outer].campaign}, so their results would too; move one of them"
            )
    return [names[place.as_posix()] for place in in_order(map(Path, names))]


def is_unchanged(member: Member, folder: Path) -> bool:
    """Return whether a folder holds the whole results of a campaign as it is now, as ``thermofuse run --resume`` judges it."""
    try:
        return kept_results(load_campaign(member.campaign), folder) is not None
    except (FusionError, OSError):
        return False


#: Memory that a run is taken to need until one has been seen, bytes.
_USUAL_BYTES = 1e9
_POLL_S = 0.1
#: Time for runs that were asked to stop, s: a run ends within a second of itself.
_STOP_S = 0.7
#: Beside its own threads, libraries start one per processor in every process unless these say otherwise.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_PAGE, _TABLE, _BOOK, _LOGS = "fleet.html", "fleet.csv", "fleet.xlsx", "logs"


@dataclass
class _Running:
    """The process of a campaign, the monotonic time at which it began, s, and the largest memory seen so far, bytes."""

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
    """Run campaigns at the same time, each in a process of its own, and write one summary."""
    started = _now()
    campaigns = {member.name: member for member in members}
    rows = {member.name: Row(member.name) for member in members}
    jobs = jobs or usable_processors()

    def write_summary() -> None:
        write_json(out / SUMMARY, as_json([*rows.values()], started=started, finished=_now()))
        report("campaigns", sum(row.state not in ("waiting", "stopped") for row in rows.values()), len(rows))

    others = psutil.Process().children()
    with open_folder(out, resume=resume):
        for name in campaigns:
            own_place(out, name)
        claim(out, SUMMARY, _TABLE, _BOOK, _PAGE, *map(_log_of, campaigns))
        for name, row in read_rows(out).items() if resume else ():
            # Rows of finished campaigns whose files and products are as an earlier fleet left them.
            if name in campaigns and row.is_whole and is_unchanged(campaigns[name], out / name):
                kept = with_findings(replace(row, state="kept"), out / name)
                rows |= {name: kept} if kept.is_whole else {}
        waiting = [name for name, row in rows.items() if row.state == "waiting"]
        running: dict[str, _Running] = {}
        largest = 0.0
        write_summary()
        try:
            while waiting or running:
                while waiting and has_room([*running.values()], jobs, largest or _USUAL_BYTES):
                    name = waiting.pop(0)
                    # Until it ends it is one that was stopped: a signal may come at any time.
                    rows[name] = replace(rows[name], state="stopped", log=_log_of(name))
                    running[name] = _start(campaigns[name], out, rows[name].log, jobs=jobs, resume=resume)
                for name, one in list(running.items()):
                    one.measure()
                    if one.process.poll() is not None:
                        del running[name]
                        largest = max(largest, one.peak)
                        rows[name] = _ended(rows[name], one, campaigns[name], out)
                        write_summary()
                        say(rows[name])
                time.sleep(_POLL_S)
        finally:
            _stop(others)
            for name, one in running.items():
                rows[name] = replace(rows[name], seconds=round(time.monotonic() - one.begun, 1))
            write_summary()
            write_text(out / _TABLE, as_csv([*rows.values()]))
            write_atomically(out / _BOOK, lambda path: write_book(path, [*rows.values()]))
            write_text(out / _PAGE, render_fleet([*rows.values()], started=started))
    return list(rows.values())


def has_room(running: Sequence[_Running], jobs: int, largest: float) -> bool:
    """Whether another run may start: a processor is free, and `largest` bytes for it in addition to what those that run may still take."""
    if not running or len(running) >= jobs:
        return not running
    to_come = sum(max(largest - one.measure(), 0.0) for one in running)
    return float(psutil.virtual_memory().available) - to_come > largest


def _log_of(name: str) -> str:
    """Return the log of a campaign within the folder of its fleet."""
    return f"{_LOGS}/{name}.log"


def _start(member: Member, out: Path, log: str, *, jobs: int, resume: bool) -> _Running:
    """Start the run of a campaign; everything that it says goes to its log."""
    folder, threads = out / member.name, str(max(usable_processors() // jobs, 1))
    usual = dict.fromkeys(_THREAD_VARIABLES, threads) | {"PYTHONUNBUFFERED": "1"}
    (out / log).parent.mkdir(parents=True, exist_ok=True)
    # A new file: what has the name may be a pipe, or another name of a file that is no log.
    (out / log).unlink(missing_ok=True)
    with (out / log).open("xb") as stream:
        # A session of its own: a Ctrl-C at the terminal is for the fleet, which tells its runs to stop.
        streams = {"stdout": stream, "stderr": stream, "start_new_session": True}
        resumed, options = resume and folder.is_dir(), ("--processes", "1")
        process = start_run(member.campaign, folder, *options, resume=resumed, usual=usual, **streams)
    return _Running(process, time.monotonic())


def _ended(row: Row, one: _Running, member: Member, out: Path) -> Row:
    """Return the row of a run that has ended."""
    code: int = one.process.returncode
    # A process that a signal ended has a negative code; shells, and the command itself, say 128 and its number.
    exit_code = 128 - code if code < 0 else code
    seconds = round(time.monotonic() - one.begun, 1)
    row = replace(row, exit_code=exit_code, seconds=seconds, peak_MB=round(one.peak / 1e6))
    if code == 0:
        return with_findings(replace(row, state="finished"), out / row.name)
    # The row names the campaign: its folder need not be repeated, nor leave the machine with the summary.
    message = _last_message(out / row.log).replace(f"{member.campaign.parent}{os.sep}", "")
    if code == -9:
        message = "ended by the system, usually because memory ran out; run fewer at a time with --jobs"
    return replace(row, state="failed", message=message or f"ended with exit code {exit_code}; see {row.log}")


def _stop(others: Sequence[psutil.Process]) -> None:
    """Tell runs that are left to stop, also one that was being started; they keep their finished stages. Other children stay."""
    left = [process for process in psutil.Process().children() if process not in others]
    for process in left:
        with suppress(psutil.Error):
            process.terminate()
    psutil.wait_procs(left, timeout=_STOP_S)


def _last_message(log: Path) -> str:
    """Return the last thing that a run said of itself, without the name of the program."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    said = [line.removeprefix("thermofuse: ") for line in lines if line.startswith("thermofuse: ")]
    return said[-1] if said else next((line.strip() for line in reversed(lines) if line.strip()), "")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
