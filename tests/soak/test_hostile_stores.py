"""Hostile NetCDF and Zarr stores as frames of a campaign: quoted in docs/measured.csv.

Each is read in a process of its own: as a user's `inspect` does, and frame by frame as a run does. The contract: frames, or one message;
no other exception, no ended process, and nothing of a file outside the folder.
"""

from __future__ import annotations

import os
import resource
import signal
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.inspect import inspect_paths
from tests.soak.fuzz.harness import REFUSALS, _place
from tests.soak.fuzz.stores import SECRET, hostile_stores, write_secret
from thermography.io.other_cameras import StackOptions, index_recordings

#: Memory that a process may take beyond that of the imports, bytes, and processor time, s: above both it is ended, which is a breach.
MOST_BYTES, MOST_SECONDS = 4_000_000_000, 60
#: Longest message that a terminal shows at once, characters.
MOST_WORDS = 4_000
STATED = StackOptions(unit="degC", start=np.datetime64("2026-03-09T06:30", "ns"), interval_s=1.0)


def read(path: Path) -> str:
    """Read a store in every way; "read", "refused", or the breach of the contract."""
    place = path / "zarr.json" if (path / "zarr.json").exists() else path / ".zgroup" if path.is_dir() else path
    outcome = "refused"
    for options in (StackOptions(), STATED):
        frames, rejected = index_recordings([place], options)
        if not frames and not all(one.reason.strip() and len(one.reason) < MOST_WORDS for one in rejected):
            return f"a message of {[len(one.reason) for one in rejected]} characters"
        for frame in list(frames)[:3]:
            try:
                values = frame.read_temperature()
            except REFUSALS as error:
                if not str(error).strip() or len(str(error)) > MOST_WORDS:
                    return "a message without words, or with too many"
                continue
            outcome = "read"
            if (np.abs(values - SECRET) < 1e-3).any():
                return "shows a file outside"
    for one in inspect_paths([path]):
        if any(str(SECRET) in line for line in one.lines):
            return "tells of a file outside"
    return outcome


def outcome_of(path: Path) -> str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read(path)
    except REFUSALS as error:
        return "refused" if 0 < len(str(error)) < MOST_WORDS else "a message without words, or with too many"
    except BaseException as error:
        return f"foreign: {type(error).__name__} ({str(error)[:100]}) in {_place(error)}"


def in_a_process(work: Callable[[], str]) -> tuple[str, float, int]:
    """Return what a process of its own says, its processor time, s, and the memory that it took beyond that of its start, bytes."""
    told, tell = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(told)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + MOST_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CPU, (MOST_SECONDS, MOST_SECONDS))
        before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
        outcome = work()
        taken = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
        os.write(tell, f"{time.process_time() - started} {taken} {outcome}".encode()[:4000])
        os._exit(0)
    os.close(tell)
    with os.fdopen(told, encoding="utf-8", errors="replace") as lines:
        said = lines.read()
    _, status = os.waitpid(child, 0)
    if not said:
        ended = signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else str(status)
        return f"ended: {ended}", 0.0, 0
    seconds, taken_text, outcome = said.split(" ", 2)
    return outcome, float(seconds), int(taken_text)


@pytest.mark.slow
def test_hostile_stores_end_in_frames_or_in_one_message(tmp_path: Path) -> None:
    secret = tmp_path / "outside" / "secret.nc"
    secret.parent.mkdir()
    write_secret(secret)
    wanted = os.environ.get("THERMOFUSE_STORES", "")
    folder, counts, breaches = tmp_path / "stores", Counter[str](), []
    folder.mkdir()
    slowest, largest = (0.0, ""), (0, "")
    for number, (name, write) in enumerate(hostile_stores(secret)):
        if wanted not in name:
            continue
        path = folder / (f"{number}" if name.startswith("zarr") else f"{number}.nc")
        try:
            write(path)
        except (TypeError, ValueError, OSError, RuntimeError, NotImplementedError) as error:
            print(f"{name}: not written by the library ({type(error).__name__}: {str(error)[:80]})", flush=True)
            counts["not written"] += 1
            continue
        outcome, seconds, taken = in_a_process(lambda path=path: outcome_of(path))  # type: ignore[misc]
        counts[outcome if outcome in ("read", "refused") else "breach"] += 1
        slowest, largest = max(slowest, (seconds, name)), max(largest, (taken, name))
        if outcome not in ("read", "refused") or seconds > 2.0 or taken > 200_000_000:
            print(f"{name}: {outcome}, {seconds:.2f} s, {taken / 1e6:.0f} MB", flush=True)
        if outcome not in ("read", "refused"):
            breaches.append(f"{name}: {outcome}")
        if name.endswith("sound"):
            assert outcome == "read", f"{name}: {outcome}"
    print(
        f"{dict(counts)}; slowest {slowest[0]:.2f} s ({slowest[1]}), most memory {largest[0] / 1e6:.0f} MB ({largest[1]})"
    )
    assert not breaches
