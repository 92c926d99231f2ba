"""Frames that arrive while a test runs: files that appear, and sequences that grow; each frame is given once, when it is whole."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermography.errors import ThermographyError
from thermography.io.fff_record import MAGIC
from thermography.io.flir import index_sequence
from thermography.io.frame import FrameReference, RejectedFrame
from thermography.io.frame_index.frame_list import order_by_time
from thermography.io.frame_readers import index_recordings
from thermography.io.temperature_frames import StackOptions


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

    Parameters
    ----------
    list_files : callable
        Returns the files that there are.
    options : StackOptions
        What files of temperatures do not hold themselves.
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
        rejected += [
            RejectedFrame(one.path, one.index, f"{one.path}: the frame has no time")
            for one in frames
            if np.isnat(one.time)
        ]
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
