"""Readers of thermal files of any camera: the protocol that each keeps, plug-ins by entry point, and the frames of many files.

A plug-in is a class that keeps `FrameReader`, named in the entry-point group ``thermofuse.frame_readers`` of its package::

    [project.entry-points."thermofuse.frame_readers"]
    irb = "my_package:IrbReader"

One that can only give temperatures subclasses `thermography.io.temperature_frames.TemperatureReader` instead. Plug-ins are asked before the
readers of this package.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol, runtime_checkable

from thermography.errors import ThermographyError
from thermography.io.flir import FlirReader
from thermography.io.frame import FrameReference, RejectedFrame
from thermography.io.frame_index.by_threads import call_by_threads, opening_threads
from thermography.io.frame_index.frame_list import FrameList, FrameTable, order_by_time
from thermography.io.temperature_frames import StackError, StackOptions
from thermography.io.text_frames import TextReader

ENTRY_POINT_GROUP = "thermofuse.frame_readers"
#: A reader sees this number of bytes when it is asked whether it recognises a file.
START_BYTES = 512


@runtime_checkable
class FrameReader(Protocol):
    """What a reader of thermal files does.

    One object reads all files of its kind, and up to eight threads call its methods at once, each for another file: what a call needs stays
    in the call or is guarded by a lock.

    Attributes
    ----------
    name : str
        Kind of file, for messages.
    """

    name: str

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is of this kind, by its content; `start` holds its first 512 bytes, none of a folder."""
        ...

    def index(self, path: Path, options: StackOptions) -> Iterator[FrameReference | FrameTable | RejectedFrame]:
        """Yield the frames of a file in its order without reading pixels, damaged ones as `RejectedFrame`.

        Frames of a long file may be yielded together as a `FrameTable`, which makes their references on access.

        Raise a ThermographyError or OSError where nothing in the file can be used.
        """
        ...


class FrameReaderError(ThermographyError):
    """A plug-in that cannot be used; the message names it and the remedy."""


@cache
def plug_ins() -> tuple[FrameReader, ...]:
    """Return the readers that other installed distributions add.

    Raises
    ------
    FrameReaderError
        A plug-in cannot be imported or does not keep the protocol.
    """
    found: list[FrameReader] = []
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        try:
            reader = entry.load()()
        except Exception as error:
            raise FrameReaderError(
                f"the plug-in {entry.name} = {entry.value} cannot be loaded ({error}); update its package or remove it"
            ) from error
        if not isinstance(reader, FrameReader):
            raise FrameReaderError(
                f"the plug-in {entry.name} = {entry.value} lacks name, recognises or index; it must keep FrameReader"
            )
        found.append(reader)
    return tuple(found)


@cache
def readers() -> tuple[FrameReader, ...]:
    """Return all readers, plug-ins first.

    Raises
    ------
    FrameReaderError
        A plug-in cannot be used.
    """
    from thermography.io.array_frames import NetcdfReader, NumpyReader, TiffReader  # FLIR files are read without them

    return (*plug_ins(), FlirReader(), TiffReader(), NumpyReader(), NetcdfReader(), TextReader())


def find_reader(path: Path) -> FrameReader | None:
    """Return the reader of a file, None where no reader recognises it.

    Parameters
    ----------
    path : Path
        An existing file, or a folder of Zarr.

    Raises
    ------
    OSError
        The file cannot be opened.
    FrameReaderError
        A plug-in cannot be used.
    """
    start = b""
    if not path.is_dir():
        with path.open("rb") as file:
            start = file.read(START_BYTES)
    return next((reader for reader in readers() if reader.recognises(path, start)), None)


def index_recordings(
    paths: Iterable[str | os.PathLike[str]], options: StackOptions | None = None
) -> tuple[FrameList, list[RejectedFrame]]:
    """List all frames of many thermal files of one camera without reading a pixel.

    Parameters
    ----------
    paths : iterable of str or path-like
        Files that some reader recognises, in any order.
    options : StackOptions, optional
        What files of temperatures do not hold themselves; FLIR files need none.

    Returns
    -------
    frames : FrameList
        Sequence of `FrameReference`, sorted by time (UTC), frames without a time last; no time occurs twice.
    rejected : list of RejectedFrame
        Everything that is not in `frames`, with the reason.

    Raises
    ------
    StackError
        Temperatures without a unit, or frames without any time, of a whole file: `options` must say more.
    FrameReaderError
        A plug-in cannot be used.

    See Also
    --------
    thermography.io.flir.index_frames : The same for FLIR files alone.

    Notes
    -----
    docs/formats.md lists the kinds of files.

    Examples
    --------
    >>> index_recordings(["does_not_exist.tif"])[1][0].reason
    "[Errno 2] No such file or directory: 'does_not_exist.tif'"
    """
    options = options or StackOptions()
    frames: list[FrameReference | FrameTable] = []
    rejected: list[RejectedFrame] = []
    files = list(map(Path, paths))
    readers()  # Loaded here once: threads that ask first would each load the plug-ins.
    for results in call_by_threads(partial(_index_file, options=options), files, opening_threads(files)):
        for result in results:
            (rejected if isinstance(result, RejectedFrame) else frames).append(result)  # type: ignore[arg-type]
    kept, repeated = order_by_time(frames)
    return kept, rejected + repeated


def _index_file(path: Path, options: StackOptions) -> list[FrameReference | FrameTable | RejectedFrame]:
    """List the frames of one file in its order; the fault of a whole file is its last entry."""
    found: list[FrameReference | FrameTable | RejectedFrame] = []
    try:
        reader = find_reader(path)
        if reader is None:
            return [RejectedFrame(path, 0, f"{path}: no thermal file that is read; docs/formats.md lists them")]
        found.extend(reader.index(path, options))
    except StackError:
        raise
    except (OSError, ThermographyError) as error:
        found.append(RejectedFrame(path, 0, str(error)))
    return found
