"""Headers of long sequences read together, and kept, so that opening one again reads a file of some megabytes and not every header."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from hashlib import sha256
from itertools import accumulate
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import platformdirs

from thermofuse.compiled import njit
from thermography.common import Array
from thermography.io.fff_record import (
    CAMERA_RECORD,
    ENTRY_SIZE,
    FIRST_SENSOR,
    HEADER_SIZE,
    IDENTITY_BYTES,
    LIMIT_BYTES,
    MAXIMUM_CAMERA_INFO,
    PARAMETER_BYTES,
    RAW_HEADER_SIZE,
    RAW_RECORD,
    SENSOR_NAME,
    SENSOR_SIZE,
    SETTING_BYTES,
    SIGNATURES,
    TIME_BYTES,
    UNNAMED_BYTES,
    differs,
    is_fff_header,
    parse_parameters,
    parse_settings,
    select_temperatures,
    sensor_names,
)
from thermography.io.files import write_atomically
from thermography.io.frame import CameraParameters, SampleLocation
from thermography.io.sequence import FlirFrameReference, FrameTable

#: Names a folder that keeps what can be made again; left out, that of the user's cache.
CACHE_VARIABLE = "THERMOFUSE_CACHE"
#: Runs of fewer frames are scanned again: from a disk, that takes three seconds.
FEWEST_KEPT = 20_000
#: Kept files beyond this size together are removed, the oldest first, bytes.
_MOST_KEPT = 1 << 30
#: So many of the first and of the last bytes of a recording are compared.
_EDGE = 1 << 16
#: To be raised with every change of what is kept.
_VERSION = 3
_IDENTITY = "identity"

_log = logging.getLogger(__name__)


def recall(file: BinaryIO, path: Path, start: int) -> dict[str, Array] | None:
    """Return the columns kept of a run of frames; None where there are none, or none of the file as it is now."""
    kept = _place(path, start)
    try:
        opened = kept.open("rb")
    except OSError:
        # Nothing was kept, or the cache cannot be used: where that costs time, `keep` warns.
        return None
    with opened:
        identity = _identity(file)
        try:
            with np.load(opened, allow_pickle=False) as stored:
                if str(stored[_IDENTITY]) == identity:
                    return {name: stored[name] for name in stored if name != _IDENTITY}
            fault = f"{path} has changed since its headers were read"
        # The checksums of the zip file find every damage; damaged bytes raise nearly every kind of error.
        except Exception as error:
            fault = f"{kept}, which keeps the headers of {path}, is damaged ({error})"
    _log.warning("%s; they are read again", fault)
    with suppress(OSError):
        kept.unlink()
    return None


def keep(file: BinaryIO, path: Path, start: int, columns: Mapping[str, Array]) -> None:
    """Keep the columns of a run of frames; warn where the cache cannot be written to."""
    identity, place = np.array(_identity(file)), _place(path, start)
    try:
        write_atomically(place, lambda temporary: np.savez(temporary, **{_IDENTITY: identity}, **columns))  # type: ignore[arg-type]
    except OSError as error:
        remedy = f"let {CACHE_VARIABLE} name a folder that can be written to"
        _log.warning("the headers of %s cannot be kept, every opening reads them (%s); %s", path, error, remedy)
    # Another process may remove the same files meanwhile.
    with suppress(OSError):
        files = sorted(place.parent.glob("[!.]*.npz"), key=lambda each: each.stat().st_mtime_ns, reverse=True)
        for each, total in zip(files, accumulate(each.stat().st_size for each in files), strict=True):
            if total > _MOST_KEPT:
                each.unlink()


def _place(path: Path, start: int) -> Path:
    """Where a run of frames of a file is kept."""
    cache = Path(os.environ.get(CACHE_VARIABLE) or platformdirs.user_cache_dir("thermofuse"))
    # The bytes of the path, which need not be text.
    key = f"{_VERSION} {start} ".encode() + os.fsencode(path.resolve())
    return cache / "frame_index" / f"{sha256(key).hexdigest()[:32]}.npz"


def _identity(file: BinaryIO) -> str:
    """Size, time of change, first and last bytes of a file."""
    status = os.fstat(file.fileno())
    edges = sha256()
    for place in (0, max(status.st_size - _EDGE, 0)):
        file.seek(place)
        edges.update(file.read(_EDGE))
    return f"{status.st_size} {status.st_mtime_ns} {edges.hexdigest()}"


#: Frames whose headers are read and checked at once: few at first, because a run may end soon.
_FIRST_BATCH, _LARGEST_BATCH = 8, 256
#: Frames whose stored bytes are converted to columns at once.
_CHUNK = 1 << 13
#: Headers this close together are read as one piece, bytes.
_PIECE = 1 << 14
#: Start of the raw-image record that is read: its header, and by what packed samples are recognised.
_RAW_HEAD = RAW_HEADER_SIZE + 8
_NO_TIME = np.iinfo(np.int64).min


class _Layout(NamedTuple):
    """Where the headers stand in a frame, and in the row of bytes that is read of it, bytes: `template` is the row of the first frame,
    `compared` 255 where all frames share it, `copied` the places of what differs; `raw_length` is 0 for packed samples, whose length
    varies, `samples` the place of the first one in the row, and `info` that of the camera information; `altered` tells whether this one
    differs from its checksum.
    """

    big: bool
    directory: int
    slots: int
    camera: int
    camera_length: int
    raw: int
    raw_length: int
    samples: int
    info: int
    altered: bool
    template: Array
    compared: Array
    copied: Array


class _Columns(NamedTuple):
    """What differs from frame to frame, one entry per frame; `parameters` are indices of `sets`, the parameters that occur as stored."""

    length: Array
    raw_length: Array
    checksum: Array
    time: Array
    parameters: Array
    settings: Array
    sensors: Array
    sets: Array


class FlirTable(FrameTable):
    """Frames of a SEQ or CSQ file that share the layout of a first frame, which is not among them; `order` is the byte order of the camera
    information, `names` are those of the sensors inside the camera.
    """

    def __init__(self, first: FlirFrameReference, order: str, names: list[str], columns: _Columns) -> None:
        self.first, self.order, self.names, self.columns = first, order, names, columns
        self._parameters = [parse_parameters(order, row.tobytes()) for row in columns.sets]
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

    def reference(self, place: int) -> FlirFrameReference:
        """Make the reference of a frame, 0 to n - 1."""
        first, columns = self.first, self.columns
        length, raw_length = columns.length.item(place), columns.raw_length.item(place)
        values, named = columns.sensors[place].tolist(), len(self.names)
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
            altered=first.altered,
            segments=((self.ends.item(place) - length, length),),
            camera_info_place=first.camera_info_place,
            samples=samples,
        )

    def temperatures(self) -> dict[str, Array]:
        """Temperatures inside the camera by sensor, (n,) K; NaN where a frame has none."""
        values = self.columns.sensors
        changed = _changes(values)
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


def scan_table(file: BinaryIO, first: FlirFrameReference, size: int) -> FlirTable | None:
    """Read the headers of the frames that follow a frame and are laid out as it is."""
    begin, length = first.segments[0]
    (camera, camera_length), (raw, _) = first.camera_info_place, first.samples.record
    info = _bytes_at(file, begin + camera, camera_length)
    front = _bytes_at(file, begin, min(_PIECE, length))
    directory_order = "<" if 100 <= int.from_bytes(front[0x14:0x18], "little") < 200 else ">"
    directory, slots = np.frombuffer(front, directory_order + "u4", 2, 0x18).tolist()
    # Other layouts are read field by field.
    if len(info) < FIRST_SENSOR or begin + raw + _RAW_HEAD > size or directory + slots * ENTRY_SIZE > len(front):
        return None
    # Of every frame, its front with the directory is read, and the heads of the records beyond it.
    places = [(0, max(HEADER_SIZE, directory + slots * ENTRY_SIZE)), (camera, camera_length), (raw, _RAW_HEAD)]
    near = max(offset + size for offset, size in places if offset + size <= _PIECE)
    pieces = [(0, near), *((offset, size) for offset, size in places if offset + size > _PIECE)]
    covered = np.concatenate([np.arange(offset, offset + size) for offset, size in pieces])
    in_row = dict(zip(covered.tolist(), range(len(covered)), strict=True))
    names, samples = sensor_names(info), first.samples
    values = [(FIRST_SENSOR + SENSOR_SIZE * i, FIRST_SENSOR + SENSOR_SIZE * i + 4) for i in range(len(names))]
    changing = [(TIME_BYTES[0], TIME_BYTES[0] + 8), *PARAMETER_BYTES, *SETTING_BYTES, *values, UNNAMED_BYTES]
    # The entry after the last sensor is compared too: it has no name, which ends the table.
    entries = [FIRST_SENSOR + SENSOR_SIZE * i for i in range(len(names) + 1)]
    named = [(at + SENSOR_NAME[0], at + SENSOR_NAME[1]) for at in entries if at + SENSOR_SIZE <= camera_length]
    alike = [(0, 2), IDENTITY_BYTES, *LIMIT_BYTES, (TIME_BYTES[1] - 2, TIME_BYTES[1]), *named]
    compared = np.zeros(len(covered), np.uint8)
    signature = SIGNATURES.get(samples.encoding, b"")
    for first_byte, stop in [
        (0, 4),
        (0x14, 0x20),
        *((camera + start, camera + stop) for start, stop in alike),
        (raw, raw + 6),
        (raw + RAW_HEADER_SIZE, raw + RAW_HEADER_SIZE + len(signature)),
    ]:
        compared[[in_row[offset] for offset in range(first_byte, stop)]] = 255
    layout = _Layout(
        big=directory_order == ">",
        directory=directory,
        slots=slots,
        camera=camera,
        camera_length=camera_length,
        raw=raw,
        raw_length=0 if signature else samples.record[1],
        samples=in_row[raw + RAW_HEADER_SIZE],
        info=in_row[camera],
        altered=first.altered,
        template=np.frombuffer(b"".join(_bytes_at(file, begin + at, width) for at, width in pieces), np.uint8),
        compared=compared,
        copied=np.array([in_row[camera + offset] for start, stop in changing for offset in range(start, stop)]),
    )
    start, order = begin + length, "<" if info[0] else ">"
    kept = recall(file, first.path, start)
    columns = _Columns(**kept) if kept else _scan_run(file, layout, pieces, order, start, size, length)
    if columns is None:
        return None
    if kept is None and len(columns.length) >= FEWEST_KEPT:
        keep(file, first.path, start, columns._asdict())
    return FlirTable(first, order, names, columns)


def _bytes_at(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)


def _scan_run(
    file: BinaryIO, layout: _Layout, pieces: list[tuple[int, int]], order: str, start: int, size: int, length: int
) -> _Columns | None:
    """Read the headers from `start` on, of frames of about `length` bytes; None where no frame fits."""
    # Packed frames differ in length, so that only the next one stands at a known place.
    largest = _LARGEST_BATCH if layout.raw_length else 1
    rows = np.empty((largest, len(layout.template)), np.uint8)
    ends = np.cumsum([width for _, width in pieces]).tolist()
    targets = [
        [[memoryview(row)[end - width : end]] for row in rows]  # type: ignore[arg-type]
        for (_, width), end in zip(pieces, ends, strict=True)
    ]

    def seek_and_read(buffers: list[memoryview], offset: int) -> int:
        file.seek(offset)
        return file.readinto(buffers[0])  # type: ignore[attr-defined]

    # One call of the system per header, where it has one that reads from a place.
    read_at = partial(os.preadv, file.fileno()) if hasattr(os, "preadv") else seek_and_read
    convert = partial(_columns, order=order, known={})
    batch, ended = min(_FIRST_BATCH, largest), start >= size
    chunks: list[_Columns] = []
    while not ended:
        stored = np.empty((_CHUNK, len(layout.copied)), np.uint8)
        numbers = np.empty((_CHUNK, 4), np.int64)
        filled = 0
        while not ended and filled + batch <= _CHUNK:
            complete = batch
            for (offset, width), places in zip(pieces, targets, strict=True):
                for frame in range(complete):
                    if read_at(places[frame], start + frame * length + offset) < width:
                        complete = frame
                        break
            intact = _check(rows[:complete], layout, length, stored[filled:], numbers[filled:])
            infos = rows[:intact, layout.info : layout.info + layout.camera_length]
            altered = (
                differs(info, checksum) for info, checksum in zip(infos, numbers[filled:, 3].tolist(), strict=False)
            )
            intact = next((frame for frame, one in enumerate(altered) if one != layout.altered), intact)
            end = start + int(numbers[filled : filled + intact, 0].sum())
            if intact and end != size and not is_fff_header(_bytes_at(file, end, HEADER_SIZE)):
                intact -= 1
                end -= int(numbers[filled + intact, 0])
            filled, start = filled + intact, end
            ended = intact < batch or start >= size
            batch = min(4 * batch, largest)
        if filled:
            chunks.append(convert(stored[:filled], numbers[:filled]))
    if not chunks:
        return None
    *parts, _ = zip(*chunks, strict=True)
    return _Columns._make([*map(np.concatenate, parts), chunks[-1].sets])


def _columns(stored: Array, numbers: Array, *, order: str, known: dict[bytes, int]) -> _Columns:
    """Columns of some frames from their stored bytes; parameters that are not known yet are added to those that are."""
    of_parameters, of_settings = (
        sum(stop - start for start, stop in places) for places in (PARAMETER_BYTES, SETTING_BYTES)
    )
    sensors = (stored.shape[1] - 8 - of_parameters - of_settings) // 4
    kind = [("time", f"{order}u4", 2), ("parameters", "u1", of_parameters), ("settings", "u1", of_settings)]
    fields = stored.view(np.dtype([*kind, ("sensors", f"{order}f4", sensors)]))[:, 0]
    parameters = np.ascontiguousarray(fields["parameters"])
    changed = _changes(parameters)
    sets = np.array([known.setdefault(parameters[i].tobytes(), len(known)) for i in changed], np.uint32)
    seconds, milliseconds = fields["time"].astype(np.int64).T
    return _Columns(
        length=numbers[:, 0].copy(),
        raw_length=numbers[:, 1].copy(),
        checksum=numbers[:, 2].astype(np.uint32),
        time=np.where(seconds != 0, seconds * 1000 + milliseconds % 1000, _NO_TIME),
        parameters=np.repeat(sets, np.diff(np.r_[changed, len(stored)])),
        settings=np.ascontiguousarray(fields["settings"]),
        sensors=np.ascontiguousarray(fields["sensors"]),
        sets=np.frombuffer(b"".join(known), np.uint8).reshape(len(known), -1),
    )


def _changes(rows: Array) -> Array:
    """Indices of the rows, (row, byte) of a multiple of four bytes, that differ from the one before; the first is among them."""
    words = rows.view(np.uint32)
    return np.flatnonzero(np.concatenate([[True], (words[1:] != words[:-1]).any(axis=1)]))


@njit(nogil=True)
def _check(
    rows: Array, layout: _Layout, length: int, stored: Array, numbers: Array
) -> int:  # pragma: no cover - compiled
    """Check rows and store length of the frame, length and checksum of the raw image, checksum of the camera information, and what differs;
    the number of rows that fit.
    """
    for frame in range(len(rows)):
        row = rows[frame]
        differing = np.uint8(0)
        for i in range(len(row)):
            differing |= (row[i] ^ layout.template[i]) & layout.compared[i]
        packed = _u32(row, layout.samples, True) in (0x89504E47, 0xFFD8FFF7)
        end = layout.directory + layout.slots * ENTRY_SIZE
        camera, raw, raw_length, checksum, camera_checksum = False, False, 0, 0, 0
        fits = differing == 0 and not (packed and layout.raw_length > 0)
        for slot in range(layout.slots):
            entry = layout.directory + slot * ENTRY_SIZE
            kind = _u32(row, entry, layout.big) >> 16 if layout.big else _u32(row, entry, layout.big) & 0xFFFF
            offset, width = _u32(row, entry + 12, layout.big), _u32(row, entry + 16, layout.big)
            if kind == 0 or width == 0:
                continue
            end = max(end, offset + width)
            if kind == CAMERA_RECORD and not camera:
                camera, camera_checksum = True, _u32(row, entry + 28, layout.big)
                fits &= offset == layout.camera and min(width, MAXIMUM_CAMERA_INFO) == layout.camera_length
            elif kind == RAW_RECORD and not raw:
                raw, raw_length, checksum = True, width, _u32(row, entry + 28, layout.big)
                fits &= offset == layout.raw and width > RAW_HEADER_SIZE and layout.raw_length in (0, width)
        if not (fits and camera and raw):
            return frame
        numbers[frame, 0], numbers[frame, 1], numbers[frame, 2], numbers[frame, 3] = (
            end,
            raw_length,
            checksum,
            camera_checksum,
        )
        for k in range(len(layout.copied)):
            stored[frame, k] = row[layout.copied[k]]
        if end != length:
            # What follows stands elsewhere.
            return frame + 1
    return len(rows)


@njit(nogil=True)
def _u32(data: Array, place: int, big: bool) -> int:  # pragma: no cover - compiled
    """Unsigned 32-bit number."""
    a, b, c, d = np.int64(data[place]), np.int64(data[place + 1]), np.int64(data[place + 2]), np.int64(data[place + 3])
    return int(a << 24 | b << 16 | c << 8 | d) if big else int(d << 24 | c << 16 | b << 8 | a)
