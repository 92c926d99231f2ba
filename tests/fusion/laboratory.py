"""A laboratory that measures while it is watched: whenever the watcher waits, the next piece of the files is written."""

from __future__ import annotations

import itertools
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np


class Laboratory(threading.Event):
    """Stands for the event that ends a watch: writes a piece whenever it is waited for, and is set when all have been written.

    Parameters
    ----------
    *writers : iterator
        Each writes a piece of its files at every step.
    idle : int
        How often nothing comes before the event is set.

    Attributes
    ----------
    seconds : float
        Time that the watcher has waited.
    """

    def __init__(self, *writers: Iterator[object], idle: int = 3) -> None:
        super().__init__()
        self._writers, self._idle, self.seconds = list(writers), idle, 0.0

    def wait(self, timeout: float | None = None) -> bool:
        self.seconds += timeout or 0.0
        self._writers = [writer for writer in self._writers if next(writer, self) is not self]
        self._idle -= not self._writers
        if self._idle < 0:
            self.set()
        return self.is_set()

    def clock(self) -> float:
        """Return the time that the watcher has waited, s."""
        return self.seconds


def begin(source: Path, folder: Path, *, readings: int = 400) -> Path:
    """Copy a campaign with the first bytes of its readings and its first frame only."""
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("*.jpg", "laser.csv"))
    (folder / "laser.csv").write_bytes((source / "laser.csv").read_bytes()[:readings])
    shutil.copy(sorted((source / "thermal").glob("*.jpg"))[0], folder / "thermal")
    return folder


def copy_frames(source: Path, folder: Path) -> Iterator[None]:
    """Copy the frames one by one, each in two halves."""
    for path in sorted((source / "thermal").glob("*.jpg"))[1:]:
        content = path.read_bytes()
        (folder / "thermal" / path.name).write_bytes(content[: len(content) // 2])
        yield
        (folder / "thermal" / path.name).write_bytes(content)
        yield


def append(source: Path, target: Path, *, pieces: int) -> Iterator[None]:
    """Append what a file lacks of another, in pieces that end anywhere in a line or record."""
    content, begun = source.read_bytes(), target.stat().st_size
    ends = np.linspace(begun, len(content), pieces + 1).astype(int).tolist()
    for start, end in itertools.pairwise(ends):
        with target.open("ab") as file:
            file.write(content[start:end])
        yield
