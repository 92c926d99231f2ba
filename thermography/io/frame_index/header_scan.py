"""Reads the headers of a long sequence by the hundred, compiled, and keeps what differs from frame to frame as columns.

The first frame of a run is read field by field (`thermography.io.flir`). As long as the following ones are laid out as it is, their headers
stand at predicted places. Every one of them is read and checked as the first one was before its frame is listed: magic, version,
directory, byte orders, lengths and places of the records, size and packing of the samples, that the frame is not truncated, and
that a header or the end of the file follows. Camera, lens, calibrated range, time zone and names of sensors are compared with those of
the first frame. The first frame that differs in any of these ends the run and is read field by field, which also finds what is wrong.
What was found of a long run is kept for the next time (`thermography.io.frame_index.kept_columns`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import BinaryIO, NamedTuple

import numba
import numpy as np

from thermography._typing import Array
from thermography.io.fff_record import (
    CAMERA_RECORD,
    ENTRY_SIZE,
    FIRST_SENSOR,
    HEADER_SIZE,
    IDENTITY_BYTES,
    LIMIT_BYTES,
    MAX_SLOTS,
    MAXIMUM_CAMERA_INFO,
    PARAMETER_BYTES,
    PNG_SIGNATURE,
    RAW_HEADER_SIZE,
    RAW_RECORD,
    SENSOR_NAME,
    SENSOR_SIZE,
    SETTING_BYTES,
    TIME_BYTES,
    UNNAMED_BYTES,
    is_fff_header,
    parse_parameters,
    parse_settings,
    select_temperatures,
    sensor_names,
)
from thermography.io.frame import CameraParameters, SampleLocation
from thermography.io.frame_index.flir_frame import FlirFrameReference
from thermography.io.frame_index.frame_list import FrameTable
from thermography.io.frame_index.kept_columns import FEWEST_KEPT, keep, recall

#: Frames whose headers are read and checked at once: few at first, because a run may end soon.
_FIRST_BATCH, _LARGEST_BATCH = 8, 256
#: Headers this close together are read as one piece, bytes.
_PIECE = 1 << 14
#: Start of the raw-image record that is read: its header, and by what packed samples are recognised.
_RAW_HEAD = RAW_HEADER_SIZE + len(PNG_SIGNATURE)
#: Rows as `_raw_fits` compares them: the samples of PNG and JPEG-LS begin so.
_PNG_START = np.frombuffer(bytes(RAW_HEADER_SIZE) + PNG_SIGNATURE, np.uint8)
_JPEGLS_START = np.frombuffer(bytes(RAW_HEADER_SIZE) + b"\xff\xd8\xff\xf7", np.uint8)
#: Name under which the parameters that occur are kept.
_SETS = "parameter_sets"
#: Numbers of sets of parameters are of this type.
_NUMBERS = np.empty(0, np.uint32)
_NO_TIME = np.iinfo(np.int64).min


class _Expected(NamedTuple):
    """What the headers of a run have in common with its first frame; offsets and lengths in bytes from the start of a frame."""

    big: bool
    info_big: bool
    raw_big: bool
    directory: int
    slots: int
    camera: int
    camera_length: int
    raw: int
    raw_length: int
    samples: int
    encoding: int
    sensors: int
    front_bytes: Array
    info_bytes: Array
    raw_bytes: Array


class _Columns(NamedTuple):
    """What differs from frame to frame: one entry per frame, bytes as stored."""

    length: Array
    raw_length: Array
    checksum: Array
    time: Array
    parameters: Array
    settings: Array
    sensors: Array

    @classmethod
    def empty(cls, frames: int, sensors: int) -> _Columns:
        """Columns to be filled."""
        size = [sum(stop - start for start, stop in places) for places in (PARAMETER_BYTES, SETTING_BYTES)]
        return cls(
            np.empty(frames, np.int64),
            np.empty(frames, np.int64),
            np.empty(frames, np.uint32),
            np.empty(frames, np.int64),
            np.empty((frames, size[0]), np.uint8),
            np.empty((frames, size[1]), np.uint8),
            np.empty((frames, 4 * (sensors + 4)), np.uint8),
        )


@dataclass(frozen=True)
class _Run:
    """What a scan found, and what is kept of it.

    Attributes
    ----------
    columns : _Columns
        The parameters as indices, (n,), of `parameter_bytes`.
    parameter_bytes : list of bytes
        Those that occur, as stored.
    """

    columns: _Columns
    parameter_bytes: list[bytes]

    def arrays(self) -> dict[str, Array]:
        """Arrays to be kept, by name."""
        return {**self.columns._asdict(), _SETS: np.array([list(data) for data in self.parameter_bytes], np.uint8)}

    @classmethod
    def from_arrays(cls, stored: Mapping[str, Array], sensors: int, room: int) -> _Run:
        """The run of arrays that were kept, of frames with so many sensors that take at most `room` bytes.

        Raises a ValueError or KeyError where they are not those of such a run.
        """
        columns, sets = _Columns(*(stored[name] for name in _Columns._fields)), stored[_SETS]
        empty = _Columns.empty(0, sensors)
        pairs = [*zip(columns, empty._replace(parameters=_NUMBERS), strict=True), (sets, empty.parameters)]
        fits = (
            all((array.dtype, array.shape[1:]) == (like.dtype, like.shape[1:]) for array, like in pairs)
            and len({len(column) for column in columns}) == 1
            and len(columns.length) > 0
            and min(columns.length.min(), columns.raw_length.min()) > 0
            and columns.length.sum() <= room
            and columns.parameters.max() < len(sets)
        )
        if not fits:
            raise ValueError("its arrays are not those of one run of frames")
        return cls(columns, [row.tobytes() for row in sets])


class FlirTable(FrameTable):
    """Frames of a SEQ or CSQ file that share the layout of a first frame, which is not among them.

    Parameters
    ----------
    first : FlirFrameReference
        The frame before.
    order : {"<", ">"}
        Byte order of the camera information.
    names : list of str
        Of the sensors inside the camera.
    run : _Run
        The frames.
    """

    def __init__(self, first: FlirFrameReference, order: str, names: list[str], run: _Run) -> None:
        columns = run.columns
        self.first, self.order, self.names, self.columns = first, order, names, columns
        self._parameters = [parse_parameters(order, data) for data in run.parameter_bytes]
        self.path, self.first_index, self.shape = first.path, first.index + 1, first.shape
        self.parameter_set = columns.parameters
        self.parameter_sets: list[CameraParameters] = [parameters for parameters, _ in self._parameters]
        self.times = columns.time.view("datetime64[ms]")
        start, length = first.segments[0]
        self.ends = start + length + np.cumsum(columns.length)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.columns.length)

    @property
    def end(self) -> int:
        """Where the last frame ends in the file, bytes."""
        return int(self.ends[-1])

    @cached_property
    def _sensor_values(self) -> Array:
        """Values of the sensors with names and of four without, (n, sensors + 4)."""
        return self.columns.sensors.view(self.order + "f4")

    def reference(self, place: int) -> FlirFrameReference:
        """Make the reference of a frame, 0 to n - 1."""
        first, columns = self.first, self.columns
        length, raw_length = columns.length.item(place), columns.raw_length.item(place)
        values, named = self._sensor_values[place].tolist(), len(self.names)
        parameters, notes = self._parameters[self.parameter_set[place]]
        alike = first.samples
        samples = SampleLocation(
            encoding=alike.encoding,
            offset=alike.offset,
            length=alike.length if alike.encoding == "raw" else raw_length - RAW_HEADER_SIZE,
            little_endian=alike.little_endian,
            shape=alike.shape,
            record=(alike.record[0], raw_length),
            checksum=columns.checksum.item(place),
        )
        return FlirFrameReference(
            parameters=parameters,
            time=self.times[place],
            utc_offset_minutes=first.utc_offset_minutes,
            camera=first.camera,
            limits=first.limits,
            settings=parse_settings(self.order, columns.settings[place].tobytes()),
            housekeeping=select_temperatures(self.names, values[:named], values[named:]),
            notes=notes,
            path=first.path,
            index=self.first_index + place,
            segments=((self.ends.item(place) - length, length),),
            camera_info_place=first.camera_info_place,
            samples=samples,
        )

    def temperatures(self) -> dict[str, Array]:
        """Temperatures inside the camera by sensor, (n,) K; NaN where a frame has none."""
        values = self._sensor_values
        changed = _changes(self.columns.sensors)
        named = len(self.names)
        readings = [select_temperatures(self.names, row[:named], row[named:]) for row in values[changed].tolist()]
        stretch = np.diff(np.r_[changed, len(self)])
        return {
            name: np.repeat([each.get(name, np.nan) for each in readings], stretch)
            for name in dict.fromkeys(name for each in readings for name in each)
        }

    def noted(self) -> list[int]:
        """Places of the frames that carry notes."""
        noted = [bool(notes) for _, notes in self._parameters]
        return [int(i) for i in np.flatnonzero(np.array(noted)[self.parameter_set])]


@dataclass(frozen=True)
class _Layout:
    """Where the headers of a run stand, and what is expected there.

    Attributes
    ----------
    expected : _Expected
    pieces : tuple of (offset, length)
        What is read of every frame, bytes from its start: the front with the directory, and the records' heads beyond it.
    order : {"<", ">"}
        Byte order of the camera information.
    names : list of str
        Of the sensors inside the camera.
    """

    expected: _Expected
    pieces: tuple[tuple[int, int], ...]
    order: str
    names: list[str]


def scan_table(file: BinaryIO, first: FlirFrameReference, size: int) -> FlirTable | None:
    """Read the headers of the frames that follow a frame and are laid out as it is.

    Parameters
    ----------
    file : binary file
        Opened unbuffered.
    first : FlirFrameReference
        A frame whose record ends where the next one begins.
    size : int
        Length of the file, bytes.

    Returns
    -------
    FlirTable or None
    """
    start = sum(first.segments[0])
    layout = _layout(file, first)
    if layout is None:
        return None
    take = partial(_Run.from_arrays, sensors=layout.expected.sensors, room=size - start)
    run = recall(file, first.path, start, take)
    if run is None:
        run = _scan_run(file, layout, first.segments[0][1], start, size)
        if run is not None and len(run.columns.length) >= FEWEST_KEPT:
            keep(file, first.path, start, run.arrays())
    return FlirTable(first, layout.order, layout.names, run) if run is not None else None


def _scan_run(file: BinaryIO, layout: _Layout, length: int, start: int, size: int) -> _Run | None:
    """Read the headers from `start` on, of frames of about `length` bytes; None where no frame fits."""
    largest = _LARGEST_BATCH if layout.expected.encoding == 0 else 1
    batch = min(_FIRST_BATCH, largest)
    reader = _HeaderReader(file, layout, length, largest)
    gathered = _Gathered(layout.expected.sensors)
    known: dict[bytes, int] = {}
    while start < size:
        frames, start = reader.read(start, batch, size)
        if frames:
            gathered.add(_numbered(reader.columns, frames, known))
        if frames < batch:
            break
        batch = min(4 * batch, largest)
    if not gathered.frames:
        return None
    return _Run(gathered.columns(), list(known))


def _layout(file: BinaryIO, first: FlirFrameReference) -> _Layout | None:
    """Take the layout from the first frame of a run; None where it is one that only reading field by field covers."""
    start, length = first.segments[0]
    front = _bytes_at(file, start, min(_PIECE, length))
    info = _bytes_at(file, start + first.camera_info_place[0], first.camera_info_place[1])
    raw = _bytes_at(file, start + first.samples.record[0], _RAW_HEAD)
    order = "<" if 100 <= int.from_bytes(front[0x14:0x18], "little") < 200 else ">"
    directory, slots = np.frombuffer(front, order + "u4", 2, 0x18).tolist()
    if len(info) < FIRST_SENSOR or len(raw) < _RAW_HEAD or directory + slots * ENTRY_SIZE > len(front):
        return None
    names = sensor_names(info)
    expected = _Expected(
        big=order == ">",
        info_big=info[0] == 0,
        raw_big=raw[0] == 0,
        directory=directory,
        slots=slots,
        camera=first.camera_info_place[0],
        camera_length=len(info),
        raw=first.samples.record[0],
        raw_length=first.samples.record[1],
        samples=first.samples.shape[0] * first.samples.shape[1],
        encoding=("raw", "png", "jpegls").index(first.samples.encoding),
        sensors=len(names),
        front_bytes=np.frombuffer(front, np.uint8),
        info_bytes=np.frombuffer(info, np.uint8),
        raw_bytes=np.frombuffer(raw, np.uint8),
    )
    places = [
        (0, max(HEADER_SIZE, directory + slots * ENTRY_SIZE)),
        (expected.camera, expected.camera_length),
        (expected.raw, _RAW_HEAD),
    ]
    near = max(offset + size for offset, size in places if offset + size <= _PIECE)
    pieces = ((0, near), *((offset, size) for offset, size in places if offset + size > _PIECE))
    return _Layout(expected, pieces, "<" if info[0] else ">", names)


def _bytes_at(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)


class _HeaderReader:
    """Reads and checks the headers of several frames at predicted places."""

    def __init__(self, file: BinaryIO, layout: _Layout, length: int, largest: int) -> None:
        self.file, self.layout, self.length = file, layout, length
        self.buffers = [np.empty((largest, size), np.uint8) for _, size in layout.pieces]
        self.rows = [[[memoryview(row)] for row in buffer] for buffer in self.buffers]  # type: ignore[arg-type]
        # One call of the system per header, where it has one that reads from a place.
        self.read_at = partial(os.preadv, file.fileno()) if hasattr(os, "preadv") else self._seek_and_read
        expected = layout.expected
        info, raw = (
            self._part(*place) for place in ((expected.camera, expected.camera_length), (expected.raw, _RAW_HEAD))
        )
        self.parts = (self.buffers[0], *info, *raw)
        self.columns = _Columns.empty(largest, expected.sensors)

    def _part(self, offset: int, length: int) -> tuple[Array, int]:
        """The buffer that holds a place in the frames, and where it begins there."""
        if offset + length <= self.layout.pieces[0][1]:
            return self.buffers[0], offset
        return self.buffers[self.layout.pieces.index((offset, length))], 0

    def read(self, start: int, frames: int, size: int) -> tuple[int, int]:
        """Read headers from `start` on and fill the columns: the number of intact frames, and the end of the last of them."""
        complete = self._fill(start, frames)
        intact = _check(self.parts, complete, self.layout.expected, self.length, self.columns)
        lengths = self.columns.length
        end = start + int(lengths[:intact].sum())
        if intact and end != size and not is_fff_header(_bytes_at(self.file, end, HEADER_SIZE)):
            intact, end = intact - 1, end - int(lengths[intact - 1])
        return intact, end

    def _fill(self, start: int, frames: int) -> int:
        """Read the pieces of every frame; the number of frames of which all are there."""
        complete = frames
        for (offset, length), rows in zip(self.layout.pieces, self.rows, strict=True):
            for frame in range(complete):
                if self.read_at(rows[frame], start + frame * self.length + offset) < length:
                    complete = frame
                    break
        return complete

    def _seek_and_read(self, buffers: list[memoryview], offset: int) -> int:
        self.file.seek(offset)
        return self.file.readinto(buffers[0])  # type: ignore[attr-defined]


class _Gathered:
    """Columns that grow batch by batch, gathered into arrays of some thousand frames."""

    _ROWS = 1 << 13

    def __init__(self, sensors: int) -> None:
        self.sensors = sensors
        self.frames = 0
        self.full: list[_Columns] = []

    def add(self, columns: _Columns) -> None:
        """Add the columns of a batch."""
        done = 0
        while done < len(columns.length):
            place = self.frames % self._ROWS
            if place == 0:
                fresh = _Columns.empty(self._ROWS, self.sensors)
                self.full.append(fresh._replace(parameters=np.empty(self._ROWS, _NUMBERS.dtype)))
            number = min(len(columns.length) - done, self._ROWS - place)
            for target, source in zip(self.full[-1], columns, strict=True):
                target[place : place + number] = source[done : done + number]
            done, self.frames = done + number, self.frames + number

    def columns(self) -> _Columns:
        """All of them."""
        return _Columns(*(np.concatenate(parts)[: self.frames] for parts in zip(*self.full, strict=True)))


def _numbered(columns: _Columns, frames: int, known: dict[bytes, int]) -> _Columns:
    """Columns of the first frames with the parameters as numbers of those known, to which new ones are added."""
    of_frames = _Columns(*(column[:frames] for column in columns))
    changed = _changes(of_frames.parameters)
    numbers = [known.setdefault(of_frames.parameters[i].tobytes(), len(known)) for i in changed]
    return of_frames._replace(parameters=np.repeat(numbers, np.diff(np.r_[changed, frames])))


def _changes(rows: Array) -> Array:
    """Indices of the rows, (row, byte) of a multiple of four bytes, that differ from the one before; the first is among them."""
    words = rows.view(np.uint32)
    return np.flatnonzero(np.concatenate([[True], (words[1:] != words[:-1]).any(axis=1)]))


@numba.njit(cache=True, nogil=True)
def _check(
    parts: tuple[Array, Array, int, Array, int], frames: int, expected: _Expected, length: int, columns: _Columns
) -> int:  # pragma: no cover - compiled
    """Check the headers of frames and fill their columns; the number of frames up to the first that differs.

    `parts` holds bytes (frame, byte) of the front, of the camera information and where it begins there, and of the raw image's head and
    where it begins. After every frame but the last one checked a header must follow, which is expected `length` bytes after its own.
    """
    fronts, infos, info_start, raws, raw_start = parts
    for frame in range(frames):
        front, raw = fronts[frame], raws[frame, raw_start : raw_start + _RAW_HEAD]
        info = infos[frame, info_start : info_start + expected.camera_length]
        if not (
            _header_fits(front, expected)
            and _records_fit(front, expected, frame, columns)
            and _info_fits(info, expected)
            and _raw_fits(raw, expected, columns.raw_length[frame])
        ):
            return frame
        _keep(info, expected, frame, columns)
        if columns.length[frame] != length:
            # What follows stands elsewhere.
            return frame + 1
        if frame + 1 < frames and not _is_header(fronts[frame + 1]):
            return frame
    return frames


@numba.njit(cache=True, nogil=True)
def _u32(data: Array, place: int, big: bool) -> int:  # pragma: no cover - compiled
    """Unsigned 32-bit number."""
    a, b, c, d = np.int64(data[place]), np.int64(data[place + 1]), np.int64(data[place + 2]), np.int64(data[place + 3])
    return int(a << 24 | b << 16 | c << 8 | d) if big else int(d << 24 | c << 16 | b << 8 | a)


@numba.njit(cache=True, nogil=True)
def _equal(a: Array, b: Array, start: int, stop: int) -> bool:  # pragma: no cover - compiled
    """Whether two rows of bytes are equal from `start` to `stop`."""
    differing = np.uint8(0)
    for i in range(start, stop):
        differing |= a[i] ^ b[i]
    return differing == 0


@numba.njit(cache=True, nogil=True)
def _header_fits(front: Array, expected: _Expected) -> bool:  # pragma: no cover - compiled
    """Whether magic, version and place of the directory are those expected."""
    return _equal(front, expected.front_bytes, 0, 4) and _equal(front, expected.front_bytes, 0x14, 0x20)


@numba.njit(cache=True, nogil=True)
def _is_header(front: Array) -> bool:  # pragma: no cover - compiled
    """`thermography.io.fff_record.is_fff_header`."""
    if front[0] != 0x46 or front[1] != 0x46 or front[2] != 0x46 or front[3] != 0:
        return False
    big = not 100 <= _u32(front, 0x14, False) < 200
    if big and not 100 <= _u32(front, 0x14, True) < 200:
        return False
    return _u32(front, 0x18, big) >= HEADER_SIZE and 0 < _u32(front, 0x1C, big) <= MAX_SLOTS


@numba.njit(cache=True, nogil=True)
def _records_fit(
    front: Array, expected: _Expected, frame: int, columns: _Columns
) -> bool:  # pragma: no cover - compiled
    """Whether camera information and raw image stand where expected; fills length of frame and raw image, and its checksum."""
    end = expected.directory + expected.slots * ENTRY_SIZE
    camera, raw = False, False
    for slot in range(expected.slots):
        entry = expected.directory + slot * ENTRY_SIZE
        kind = (front[entry] << 8 | front[entry + 1]) if expected.big else (front[entry + 1] << 8 | front[entry])
        offset, length = _u32(front, entry + 12, expected.big), _u32(front, entry + 16, expected.big)
        if kind == 0 or length == 0:
            continue
        end = max(end, offset + length)
        if kind == CAMERA_RECORD and not camera:
            camera = True
            if offset != expected.camera or min(length, MAXIMUM_CAMERA_INFO) != expected.camera_length:
                return False
        elif kind == RAW_RECORD and not raw:
            raw = True
            columns.raw_length[frame] = length
            columns.checksum[frame] = _u32(front, entry + 28, expected.big)
            if offset != expected.raw:
                return False
    columns.length[frame] = end
    return camera and raw


@numba.njit(cache=True, nogil=True)
def _info_fits(info: Array, expected: _Expected) -> bool:  # pragma: no cover - compiled
    """Whether byte order, camera, lens, calibrated range, time zone and names of sensors are those expected."""
    fits = _equal(info, expected.info_bytes, 0, 2)
    fits &= _equal(info, expected.info_bytes, IDENTITY_BYTES[0], IDENTITY_BYTES[1])
    for start, stop in LIMIT_BYTES:
        fits &= _equal(info, expected.info_bytes, start, stop)
    fits &= _equal(info, expected.info_bytes, TIME_BYTES[1] - 2, TIME_BYTES[1])
    # The entry after the last name is compared too: it has none, which ends the table.
    for sensor in range(expected.sensors + 1):
        entry = FIRST_SENSOR + SENSOR_SIZE * sensor
        if entry + SENSOR_SIZE <= len(info):
            fits &= _equal(info, expected.info_bytes, entry + SENSOR_NAME[0], entry + SENSOR_NAME[1])
    return fits


@numba.njit(cache=True, nogil=True)
def _raw_fits(raw: Array, expected: _Expected, length: int) -> bool:  # pragma: no cover - compiled
    """Whether byte order, size and packing of the samples are those expected, and all plain samples are there."""
    encoding = 0
    if _equal(raw, _PNG_START, RAW_HEADER_SIZE, RAW_HEADER_SIZE + 8):
        encoding = 1
    elif _equal(raw, _JPEGLS_START, RAW_HEADER_SIZE, RAW_HEADER_SIZE + 4):
        encoding = 2
    if encoding == 0 and length != expected.raw_length:
        return False
    return encoding == expected.encoding and length > RAW_HEADER_SIZE and _equal(raw, expected.raw_bytes, 0, 6)


@numba.njit(cache=True, nogil=True)
def _keep(info: Array, expected: _Expected, frame: int, columns: _Columns) -> None:  # pragma: no cover - compiled
    """Copy what differs from frame to frame."""
    seconds = _u32(info, TIME_BYTES[0], expected.info_big)
    milliseconds = _u32(info, TIME_BYTES[0] + 4, expected.info_big)
    columns.time[frame] = seconds * 1000 + milliseconds % 1000 if seconds else _NO_TIME
    to = 0
    for start, stop in PARAMETER_BYTES:
        for i in range(start, stop):
            columns.parameters[frame, to] = info[i]
            to += 1
    to = 0
    for start, stop in SETTING_BYTES:
        for i in range(start, stop):
            columns.settings[frame, to] = info[i]
            to += 1
    to = 0
    for sensor in range(expected.sensors):
        entry = FIRST_SENSOR + SENSOR_SIZE * sensor
        for i in range(4):
            columns.sensors[frame, to] = info[entry + i]
            to += 1
    for i in range(UNNAMED_BYTES[0], UNNAMED_BYTES[1]):
        columns.sensors[frame, to] = info[i]
        to += 1
