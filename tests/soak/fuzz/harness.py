"""Damaged inputs in batches: a process for each batch, watched from outside, so that a crash or a hang costs one input and not the run.

Input `index` of a kind depends on the seed and its index alone: a finding is repeated from these numbers, and kept as a file as well.
"""

from __future__ import annotations

import faulthandler
import mmap
import os
import resource
import signal
import struct
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fusion.common import FusionError
from interferometry.common import InterferometryError
from thermography.common import ThermographyError

#: What a reader may raise of a damaged file.
REFUSALS = (FusionError, ThermographyError, InterferometryError)
#: Time of the processor in which one input must be done, s, and what it may allocate beyond four times its size, bytes.
MOST_SECONDS = 2.0
MOST_BYTES = 200_000_000
#: A process that has been alive for so many inputs is replaced: what a library keeps does not add up.
BATCH = 2_000
_STATE = struct.Struct("<qqq")


@dataclass(frozen=True)
class Kind:
    """A kind of input.

    Attributes
    ----------
    name : str
        Ends like the file's name.
    seeds : list of bytes
        Intact files.
    mutate : callable
        Returns a damaged copy, from a file and a generator of random numbers.
    read : callable
        Reads the file at a path as a user's file is read.
    weight : float
        Share of the inputs, relative to other kinds.
    """

    name: str
    seeds: list[bytes]
    mutate: Callable[[bytes, np.random.Generator], bytes]
    read: Callable[[Path], object]
    weight: float = 1.0

    def make(self, seed: int, index: int) -> bytes:
        """Return an input by its number."""
        rng = np.random.default_rng([seed, index])
        return self.mutate(self.seeds[index % len(self.seeds)], rng)


@dataclass
class Tally:
    """Outcomes of the inputs of a kind.

    Attributes
    ----------
    inputs, read, refused : int
    findings : Counter
        Breaches of the contract by what happened and where: "foreign", "ended", "hang", "memory".
    examples : dict of str to int
        Index of the first input of each finding.
    slowest_s : float
        Longest time of the processor for one input.
    """

    inputs: int = 0
    read: int = 0
    refused: int = 0
    findings: Counter[str] = field(default_factory=Counter)
    examples: dict[str, int] = field(default_factory=dict)
    slowest_s: float = 0.0

    def add(self, finding: str, index: int) -> None:
        """Count a breach."""
        self.findings[finding] += 1
        self.examples.setdefault(finding, index)


def fuzz(kind: Kind, folder: Path, *, inputs: int, seed: int, first: int = 0) -> Tally:
    """Read damaged inputs of a kind and count what happens.

    Parameters
    ----------
    kind : Kind
    folder : Path
        For the inputs; those of findings stay there.
    inputs, seed, first : int
        How many, seed of the damage, and number of the first.

    Returns
    -------
    Tally
    """
    tally, index = Tally(), first
    while index < first + inputs:
        index = _batch(kind, folder, tally, seed, index, min(index + BATCH, first + inputs))
    tally.inputs = inputs
    for finding, at in tally.examples.items():
        name = f"{''.join(c if c.isalnum() else '_' for c in finding)[:60]}-{seed}-{at}-{kind.name}"
        (folder / name).write_bytes(kind.make(seed, at))
    return tally


def _batch(kind: Kind, folder: Path, tally: Tally, seed: int, first: int, stop: int) -> int:
    """Read a batch in a process of its own; return the number of the next input."""
    shared = mmap.mmap(-1, 4096)
    told, tell = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(told)
        _read_inputs(kind, folder, shared, tell, seed, first, stop)
    os.close(tell)
    hung = _watch(child, shared)
    with os.fdopen(told, encoding="utf-8", errors="replace") as lines:
        for line in lines:
            index, text = line.rstrip("\n").split(" ", 1)
            tally.add(text, int(index))
    _, status = os.waitpid(child, 0)
    done, read, refused = _STATE.unpack_from(shared)
    tally.read, tally.refused = tally.read + read, tally.refused + refused
    tally.slowest_s = max(tally.slowest_s, struct.unpack_from("<d", shared, 64)[0])
    if status == 0:
        return stop
    if hung:
        tally.add(f"hang: above {MOST_SECONDS:g} s", done)
    else:
        tally.add(f"ended: {signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else status}", done)
    return done + 1


def _watch(child: int, shared: mmap.mmap) -> bool:
    """Wait for a process; end it where one input takes too long. The time is the processor's: the machine may be loaded."""
    known, since = -1, 0.0
    while True:
        if os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            return False
        used, done = _seconds(child), _STATE.unpack_from(shared)[0]
        if done != known:
            known, since = done, used
        elif used - since > 1.5 * MOST_SECONDS:
            os.kill(child, signal.SIGKILL)
            return True
        time.sleep(0.05)


def _seconds(pid: int) -> float:
    """Time of the processor that a process has used, s."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _read_inputs(kind: Kind, folder: Path, shared: mmap.mmap, tell: int, seed: int, first: int, stop: int) -> None:
    """Read inputs in the process of a batch, which ends here."""
    path = folder / f"{os.getpid()}-{kind.name}"
    read = refused = 0
    slowest = 0.0
    faulthandler.disable()
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, 2)
    for index in range(first, stop):
        _STATE.pack_into(shared, 0, index, read, refused)
        content = kind.make(seed, index)
        path.write_bytes(content)
        before = time.process_time()
        with _limited(len(content)):
            outcome = _outcome(kind, path)
        taken = time.process_time() - before
        if taken > slowest:
            slowest = taken
            struct.pack_into("<d", shared, 64, slowest)
        if taken > MOST_SECONDS:
            outcome = f"hang: above {MOST_SECONDS:g} s"
        read += outcome == "read"
        refused += outcome == "refused"
        if outcome not in ("read", "refused"):
            os.write(tell, f"{index} {outcome}\n".encode())
    _STATE.pack_into(shared, 0, stop, read, refused)
    path.unlink(missing_ok=True)
    os._exit(0)


class _limited:
    """Limits what may be allocated while an input is read: further memory is refused, which shows as a MemoryError."""

    def __init__(self, size: int) -> None:
        self._most = 4 * size + MOST_BYTES

    def __enter__(self) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + self._most, resource.RLIM_INFINITY))

    def __exit__(self, *exception: object) -> None:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def _outcome(kind: Kind, path: Path) -> str:
    """Read a file: "read", "refused", or what a user must not see."""
    try:
        kind.read(path)
    except REFUSALS as error:
        return "refused" if str(error).strip() else f"foreign: {type(error).__name__} without a message"
    except MemoryError as error:
        return f"memory: {_place(error)}"
    except BaseException as error:
        return f"foreign: {type(error).__name__} in {_place(error)}"
    return "read"


def _place(error: BaseException) -> str:
    """Return the last place in the packages, and the last of all."""
    stack = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in stack if "site-packages" not in frame.filename and "/tests/" not in frame.filename]
    named = [own[-1], stack[-1]] if own else [stack[-1]]
    return ", ".join(dict.fromkeys(f"{Path(frame.filename).name}:{frame.lineno}" for frame in named))


def shares(kinds: list[Kind], inputs: int) -> Iterator[tuple[Kind, int]]:
    """Divide a number of inputs among the kinds by their weights."""
    total = sum(kind.weight for kind in kinds)
    for kind in kinds:
        yield kind, max(round(inputs * kind.weight / total), 1)
