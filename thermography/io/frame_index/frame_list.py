"""The frames of many files in the order of time, as one sequence whose references may be made on access."""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.io.frame import CameraParameters, FrameReference, RejectedFrame


class FrameTable(Sequence[FrameReference]):
    """Consecutive frames of one file that share size, camera and layout; a reference is made when its frame is asked for.

    Attributes
    ----------
    path : Path
        Of the file.
    first_index : int
        Index of the first frame in the file.
    shape : tuple of int
        Number of rows and columns.
    times : (n,) ndarray of datetime64[ms]
        UTC; NaT where the file stores none.
    parameter_sets : list of CameraParameters
        Those that occur.
    parameter_set : (n,) ndarray of int
        Which of them every frame has.
    """

    path: Path
    first_index: int
    shape: tuple[int, int]
    times: Array
    parameter_sets: list[CameraParameters]
    parameter_set: NDArray[np.integer[Any]]

    @abstractmethod
    def temperatures(self) -> dict[str, Array]:
        """Temperatures inside the camera by sensor, (n,) K; NaN where a frame has none."""

    @abstractmethod
    def noted(self) -> list[int]:
        """Places of the frames that carry notes."""

    @overload
    def __getitem__(self, place: int) -> FrameReference: ...

    @overload
    def __getitem__(self, place: slice) -> list[FrameReference]: ...

    def __getitem__(self, place: int | slice) -> FrameReference | list[FrameReference]:
        """Return a frame, or those of a slice as a list."""
        if isinstance(place, slice):
            return [self.reference(i) for i in range(*place.indices(len(self)))]
        return self.reference(place if place >= 0 else len(self) + place)

    @abstractmethod
    def reference(self, place: int) -> FrameReference:
        """Make the reference of a frame, 0 to n - 1."""


class FrameList(Sequence[FrameReference]):
    """Frames in the order of time.

    Behaves as a list of references that cannot be changed; a slice is a list. A frame of a long sequence costs some hundred bytes
    instead of the two kilobytes of its reference.

    Parameters
    ----------
    parts : sequence of FrameTable and of lists of FrameReference
        In any order.
    order : (n,) ndarray of int, optional
        Places in the concatenated parts; their own order by default.
    """

    def __init__(
        self, parts: Sequence[FrameTable | list[FrameReference]], order: NDArray[np.integer[Any]] | None = None
    ) -> None:
        self._parts = [part for part in parts if len(part)]
        self._starts = [0, *accumulate(len(part) for part in self._parts)]
        self._order = order

    def __len__(self) -> int:
        """Return the number of frames."""
        return self._starts[-1] if self._order is None else len(self._order)

    @overload
    def __getitem__(self, place: int) -> FrameReference: ...

    @overload
    def __getitem__(self, place: slice) -> list[FrameReference]: ...

    def __getitem__(self, place: int | slice) -> FrameReference | list[FrameReference]:
        """Return a frame, or those of a slice as a list."""
        if isinstance(place, slice):
            return [self._stored(i) for i in self._places[place]]
        return self._stored(self._places[place])

    def __iter__(self) -> Iterator[FrameReference]:
        """Make the references one after the other."""
        return map(self._stored, self._places)

    @property
    def _places(self) -> Sequence[int]:
        """Places of the frames in the concatenated parts."""
        return range(self._starts[-1]) if self._order is None else self._order  # type: ignore[return-value]

    def _stored(self, place: int) -> FrameReference:
        """The frame at a place in the concatenated parts."""
        part = bisect_right(self._starts, place) - 1
        return self._parts[part][int(place) - self._starts[part]]

    def __eq__(self, other: object) -> bool:
        """Compare with any sequence, frame by frame."""
        if not isinstance(other, Sequence):
            return NotImplemented
        return len(self) == len(other) and all(a == b for a, b in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        """Return the representation of a list of the frames; of many, their number."""
        return repr(list(self)) if len(self) <= 3 else f"<{len(self)} frames, the first {self[0]!r}>"

    @cached_property
    def times(self) -> Array:
        """Times (UTC), (n,) datetime64[ms]."""
        return self.column(lambda table: table.times, lambda frame: frame.time, "datetime64[ms]")

    def column(
        self, of_table: Callable[[FrameTable], Array], of_frame: Callable[[FrameReference], Any], kind: str | type
    ) -> Array:
        """One value per frame.

        Parameters
        ----------
        of_table : callable
            From a table to the values of its frames, (n,).
        of_frame : callable
            From a single reference to its value.
        kind : str or type
            Type of the array.

        Returns
        -------
        (n,) ndarray
        """
        values = np.empty(self._starts[-1], kind)
        for part, start in zip(self._parts, self._starts, strict=False):
            of_part = of_table(part) if isinstance(part, FrameTable) else list(map(of_frame, part))
            for_all = values[start : start + len(part)]
            for_all[...] = of_part if isinstance(of_part, np.ndarray) else np.array(of_part, kind)
        return values if self._order is None else values[self._order]

    def files(self) -> Array:
        """Names of the files, (n,) of str objects."""
        return self.column(
            lambda table: np.full(len(table), str(table.path), object), lambda frame: str(frame.path), "object"
        )

    def numbers(self) -> NDArray[np.int64]:
        """Indices of the frames in their files, (n,)."""
        return self.column(lambda table: table.first_index + np.arange(len(table)), lambda frame: frame.index, "int64")

    def shapes(self) -> NDArray[np.int64]:
        """Rows and columns of the frames, (n, 2)."""
        rows = self.column(lambda table: np.full(len(table), table.shape[0]), lambda frame: frame.shape[0], "int64")
        columns = self.column(lambda table: np.full(len(table), table.shape[1]), lambda frame: frame.shape[1], "int64")
        return np.stack([rows, columns], axis=-1)

    def parameter_sets(self) -> tuple[list[CameraParameters], NDArray[np.int64]]:
        """Return the camera parameters that occur, and which of them every frame has, (n,)."""
        known: dict[CameraParameters, int] = {}

        def number(parameters: CameraParameters) -> int:
            return known.setdefault(parameters, len(known))

        which = self.column(
            lambda table: np.array([number(each) for each in table.parameter_sets])[table.parameter_set],
            lambda frame: number(frame.parameters),
            "int64",
        )
        return list(known), which

    def temperatures(self) -> dict[str, Array]:
        """Temperatures inside the camera by sensor, (n,) K; NaN where a frame has none."""
        of_tables = {id(part): part.temperatures() for part in self._parts if isinstance(part, FrameTable)}
        names = dict.fromkeys(
            name
            for part in self._parts
            for readings in ([of_tables[id(part)]] if isinstance(part, FrameTable) else [f.housekeeping for f in part])
            for name in readings
        )
        return {name: self._temperature(name, of_tables) for name in names}

    def _temperature(self, name: str, of_tables: dict[int, dict[str, Array]]) -> Array:
        return self.column(
            lambda table: of_tables[id(table)].get(name, np.full(len(table), np.nan)),
            lambda frame: frame.housekeeping.get(name, np.nan),
            "float64",
        )

    def noted(self) -> list[FrameReference]:
        """Frames that carry notes, in order."""

        def flags(table: FrameTable) -> Array:
            noted = np.zeros(len(table), bool)
            noted[table.noted()] = True
            return noted

        return [self[int(i)] for i in np.flatnonzero(self.column(flags, lambda frame: bool(frame.notes), "bool"))]

    def choose(self, chosen: Array) -> FrameList:
        """Return the frames where `chosen`, (n,) of bool, is True."""
        return FrameList(self._parts, np.flatnonzero(chosen) if self._order is None else self._order[chosen])


def order_by_time(found: Iterable[FrameReference | FrameTable]) -> tuple[FrameList, list[RejectedFrame]]:
    """Sort frames by time, and take out those whose time occurs twice.

    Parameters
    ----------
    found : iterable of FrameReference and FrameTable

    Returns
    -------
    kept : FrameList
        By time (UTC), frames without a time last.
    repeated : list of RejectedFrame
        Every second frame of one time.
    """
    parts: list[FrameTable | list[FrameReference]] = []
    for each in found:
        if isinstance(each, FrameTable):
            parts.append(each)
        elif parts and isinstance(parts[-1], list):
            parts[-1].append(each)
        else:
            parts.append([each])
    stored = FrameList(parts)
    times = stored.times
    if not np.isnat(times).any() and (np.diff(times) > np.timedelta64(0)).all():
        return stored, []
    by_name = np.unique(stored.files().astype(str), return_inverse=True)[1]
    order = np.lexsort((stored.numbers(), by_name, times))
    second = np.concatenate([[False], times[order][1:] == times[order][:-1]])
    kept = FrameList(parts, order[~second])
    earlier = np.cumsum(~second) - 1
    return kept, [_repeated(stored[int(order[i])], kept[int(earlier[i])]) for i in np.flatnonzero(second)]


def _repeated(frame: FrameReference, kept: FrameReference) -> RejectedFrame:
    reason = f"{frame.path}: frame {frame.index} has the same time {frame.time} as frame {kept.index} of {kept.path}"
    return RejectedFrame(frame.path, frame.index, reason)


def frame_times(frames: Sequence[FrameReference]) -> Array:
    """Return the times (UTC) of frames, (n,) datetime64[ns]; NaT where a file stores none.

    Parameters
    ----------
    frames : sequence of FrameReference
    """
    if isinstance(frames, FrameList):
        return frames.times.astype("datetime64[ns]")
    return np.array([frame.time for frame in frames], "datetime64[ns]")


def frame_shapes(frames: Sequence[FrameReference]) -> NDArray[np.int64]:
    """Return rows and columns of frames, (n, 2).

    Parameters
    ----------
    frames : sequence of FrameReference
    """
    return frames.shapes() if isinstance(frames, FrameList) else np.array([frame.shape for frame in frames], np.int64)
