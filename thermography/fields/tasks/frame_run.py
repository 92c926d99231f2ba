"""Frames on their way to another process: of video, only where the pixels stand, some bytes per frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from thermography.io.frame import PlainSamples, StoredPixels


@dataclass(frozen=True)
class PlainFrame:
    """A frame whose pixels stand in a file as they are.

    Attributes
    ----------
    path : Path
    index : int
    shape : (int, int)
    plain_samples : PlainSamples
        As of `thermography.io.frame.FrameReference`.
    """

    path: Path
    index: int
    shape: tuple[int, int]
    plain_samples: PlainSamples

    def read_counts(self) -> NDArray[np.uint16]:
        """Read the pixels, (row, column) uint16; raise an OSError where the file is shorter."""
        kind = np.dtype("<u2" if self.plain_samples.little_endian else ">u2")
        rows, columns = self.shape
        counts = np.fromfile(self.path, kind, rows * columns, offset=self.plain_samples.offset)
        if counts.size < rows * columns:
            raise OSError(
                f"{self.path}: frame {self.index} ends early; the file has become shorter since it was indexed"
            )
        return counts.astype(np.uint16).reshape(self.shape)


class FrameRun(Sequence[StoredPixels]):
    """Some frames in order; sent to another process, frames of plain samples in one file become a table of their places.

    Parameters
    ----------
    frames : sequence of StoredPixels
        For example `thermography.io.frame.FrameReference`.
    """

    def __init__(self, frames: Sequence[StoredPixels]) -> None:
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[StoredPixels]:
        return iter(self._frames)

    @overload
    def __getitem__(self, place: int) -> StoredPixels: ...

    @overload
    def __getitem__(self, place: slice) -> Sequence[StoredPixels]: ...

    def __getitem__(self, place: int | slice) -> StoredPixels | Sequence[StoredPixels]:
        return self._frames[place]

    def __reduce__(self) -> tuple[Any, ...]:
        first = self._frames[0] if self._frames else None
        samples = [frame.plain_samples for frame in self._frames]
        plain = [place for place in samples if place is not None]
        if (
            first is None
            or len(plain) < len(samples)
            or any(frame.path != first.path or frame.shape != first.shape for frame in self._frames)
            or len({place.little_endian for place in plain}) > 1
        ):
            return FrameRun, (list(self._frames),)
        offsets = np.array([place.offset for place in plain], np.int64)
        indices = np.array([frame.index for frame in self._frames], np.int64)
        return _restore, (first.path, first.shape, plain[0].little_endian, indices, offsets)


def _restore(
    path: Path, shape: tuple[int, int], little_endian: bool, indices: NDArray[np.int64], offsets: NDArray[np.int64]
) -> FrameRun:
    """Return the frames of a table of places."""
    places = zip(indices.tolist(), offsets.tolist(), strict=True)
    return FrameRun([PlainFrame(path, index, shape, PlainSamples(offset, little_endian)) for index, offset in places])
