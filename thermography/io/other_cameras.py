"""Frames of temperatures from any camera: what is stated about them outside the file, and how they enter calculations that work on counts.

All further steps work on counts of 16 bits and camera parameters, because averaging counts is fast and exact. Temperatures are therefore
written as counts of a black-body scale: Planck's law with the constant of a long-wave camera (B = 1500 K), from absolute zero to 160 degC
in 65,000 steps, 5 mK apart at 20 degC (1.4 mK standard deviation of rounding). With the emissivity and the reflected temperature that the
camera's program used, another emissivity can be calculated exactly as for counts of such a camera.
"""

from __future__ import annotations

import codecs
import csv
import os
import re
import struct
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache, lru_cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from itertools import pairwise, takewhile
from math import prod
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray as xr

from thermofuse.resources import vocabulary
from thermography.common import ZERO_CELSIUS_K, ThermographyError
from thermography.io.files import MOST_OBJECTS, hdf5_fault
from thermography.io.flir import FlirReader, index_files
from thermography.io.frame import CalibratedRange, CameraParameters, FrameReference, RejectedFrame
from thermography.io.sequence import FrameList, FrameTable

#: Planck's constant B of a camera for 7.5 to 13 um, K.
_PLANCK_B = 1500.0
#: Highest temperature of the scale, degC, and its count.
_HIGHEST_DEGC, _HIGHEST_COUNT = 160.0, 65_000.0
_PLANCK_R1 = _HIGHEST_COUNT * (np.exp(_PLANCK_B / (_HIGHEST_DEGC + ZERO_CELSIUS_K)) - 1.0)
#: Parts of a time in the name of a file: directive of strptime -> digits.
_DIGITS = {"Y": 4, "m": 2, "d": 2, "H": 2, "M": 2, "S": 2, "j": 3}
#: Most pixels of a frame; a damaged header may claim more.
_MOST_PIXELS = 1 << 24
#: Nine hours at 30 Hz.
_MOST_FRAMES = 1_000_000
#: Between these are usual values of pictures of machines, degC; others are in another unit.
_RANGE_DEGC = (-100.0, 200.0)


class StackError(ThermographyError):
    """What is said of files of temperatures does not suffice; the message names file, key and remedy."""


@dataclass(frozen=True)
class StackOptions:
    """What files of temperatures do not hold themselves.

    Attributes
    ----------
    unit : {"", "degC", "K"}
        Of the values after `scale` and `offset`; "" where the file says it.
    scale, offset : float
        value * scale + offset is the temperature. A camera that stores 0.04 K per count has the scale 0.04 and the unit "K".
    variable : str or None
        Name of the variable of a NetCDF or Zarr file; None for the only one with three dimensions.
    time_in_name : str or None
        Pattern of the time in the names of the files, with the directives %Y %m %d %H %M %S %f %j of strptime.
    times : mapping of (Path, int) to datetime64, or None
        UTC by path of the file, as it is read, and index of the frame in it, from 0.
    start : datetime64 or None
        UTC of the first frame of every file; with `interval_s`.
    interval_s : float or None
        From one frame of a file to the next, s.
    time_zone : str
        IANA name of the zone of times in names and in files that give none.
    emissivity : float or None
        With which the camera's program calculated the temperatures; None: as the file says, 1 where it does not.
    reflected_temperature_K : float or None
        Likewise, K; 293.15 K where the file does not say it.
    axes : {None, "frame, row, column", "row, column, frame"}
        Of an array of three dimensions without names; None where its shape tells it.
    needs_time : bool
        Whether a file of one frame without a time is refused; a picture that stands alone needs none.

    Notes
    -----
    docs/formats.md lists the kinds of files, and the same keys of the campaign file.

    Examples
    --------
    >>> StackOptions(unit="K", scale=0.04, time_in_name="%Y%m%d_%H%M%S").parameters.emissivity
    1.0
    """

    unit: str = ""
    scale: float = 1.0
    offset: float = 0.0
    variable: str | None = None
    time_in_name: str | None = None
    times: Mapping[tuple[Path, int], np.datetime64] | None = None
    start: np.datetime64 | None = None
    interval_s: float | None = None
    time_zone: str = "UTC"
    emissivity: float | None = None
    reflected_temperature_K: float | None = None
    axes: str | None = None
    needs_time: bool = True

    @property
    def parameters(self) -> CameraParameters:
        """Camera parameters of the scale of counts."""
        # A stored transmission of 1: the camera's program has corrected the path already.
        reflected_K = 293.15 if self.reflected_temperature_K is None else self.reflected_temperature_K
        return CameraParameters(
            emissivity=self.emissivity or 1.0, object_distance_m=1.0, reflected_temperature_K=reflected_K,
            atmospheric_temperature_K=293.15, window_temperature_K=293.15, window_transmission=1.0, stored_transmission=1.0,
            relative_humidity=0.5, planck_r1=float(_PLANCK_R1), planck_b=_PLANCK_B, planck_f=1.0, planck_o=0.0, planck_r2=1.0,
            atmosphere_alpha1=0.006569, atmosphere_alpha2=0.01262, atmosphere_beta1=-0.002276, atmosphere_beta2=-0.00667,
            atmosphere_x=1.9,
        )  # fmt: skip


@dataclass(frozen=True)
class StackContents:
    """What a file of temperatures holds.

    Attributes
    ----------
    unit : "degC" or "K" where the file says it, else ""
    times : UTC or, without `zoned`, in the zone that `StackOptions` names; None where the file holds none
    elapsed : times since a start that the file does not state, None where it holds none
    emissivity, reflected_temperature_K : with which the temperatures were calculated, where the file says it
    notes : what of the file was passed over
    middle : a usual value of a text, NaN of other files
    """

    frames: int
    shape: tuple[int, int]
    unit: str = ""
    times: tuple[np.datetime64, ...] | None = None
    elapsed: NDArray[np.timedelta64] | None = None
    zoned: bool = False
    emissivity: float | None = None
    reflected_temperature_K: float | None = None
    notes: tuple[str, ...] = ()
    middle: float = float("nan")


class TemperatureReader(ABC):
    """Base of readers of files that hold temperatures: `contents` and `read_values` are left to each kind of file."""

    name: str
    #: First bytes of a file of this kind.
    starts: tuple[bytes, ...] = ()

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is of this kind, by its content."""
        return start.startswith(self.starts)

    @abstractmethod
    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds, without reading its pixels where that is possible."""

    @abstractmethod
    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a frame as stored, (row, column)."""

    def frame_contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds, see `contents`, where it can be frames: what a few bytes state may be any number."""
        contents = self.contents(path, options)
        if contents.shape[0] * contents.shape[1] > _MOST_PIXELS or 0 in contents.shape:
            raise ThermographyError(f"{path}: {contents.shape[1]} x {contents.shape[0]} pixels are not a thermal frame")
        if not 0 < contents.frames <= _MOST_FRAMES:
            raise ThermographyError(f"{path}: {contents.frames:,} frames; export parts of 1 to {_MOST_FRAMES:,}")
        return contents

    def index(self, path: Path, options: StackOptions) -> Iterator[FrameReference | RejectedFrame]:
        """Yield the frames of a file in its order."""
        contents = self.frame_contents(path, options)
        stated = ("emissivity", "reflected_temperature_K")
        options = replace(
            options, **{name: getattr(contents, name) for name in stated if getattr(options, name) is None}
        )
        unit = options.unit or contents.unit
        if unit not in ("degC", "K"):
            raise StackError(f'{path}: nothing says whether values are degC or K; write unit = "degC" or unit = "K"')
        degC = contents.middle * options.scale + options.offset - (ZERO_CELSIUS_K if unit == "K" else 0.0)
        if not (np.isnan(degC) or _RANGE_DEGC[0] < degC < _RANGE_DEGC[1]):
            raise ThermographyError(
                f"{path}: values as {contents.middle:g} are not in {unit}; export all frames in one unit"
            )
        for index, time in enumerate(_times(path, contents, options)):
            yield TemperatureFrame(
                parameters=options.parameters,
                time=time.astype("datetime64[ms]"),
                limits=CalibratedRange(raw_minimum=1, raw_maximum=65_534),
                notes=contents.notes,
                path=path,
                index=index,
                size=contents.shape,
                unit=unit,
                reader=self,
                options=options,
            )


@dataclass(frozen=True, kw_only=True)
class TemperatureFrame(FrameReference):
    """A frame of temperatures, degC or K, of (rows, columns) in a file; further attributes are those of `FrameReference`."""

    size: tuple[int, int]
    unit: str
    reader: TemperatureReader
    options: StackOptions = field(repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.size

    def read_temperature(self) -> NDArray[np.float64]:
        """Read the temperatures, (row, column) degC, NaN for none; raise a ThermographyError where the size differs from the first one."""
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.asarray(self.reader.read_values(self.path, self.index, self.options), np.float64)
        if values.shape != self.size:
            raise ThermographyError(
                f"{self.path}: frame {self.index} has {values.shape[::-1]} pixels and not {self.size[::-1]}; the file is damaged"
            )
        # A damaged value may be beyond any temperature, or none; its counts say so.
        with np.errstate(over="ignore", invalid="ignore"):
            values = values * self.options.scale + self.options.offset - (ZERO_CELSIUS_K if self.unit == "K" else 0.0)
            # Marks for no temperature, as -9999.
            return np.where(values < -ZERO_CELSIUS_K, np.nan, values)

    def read_counts(self) -> NDArray[np.uint16]:
        """Read the temperatures as counts of the black-body scale, (row, column) uint16; 0 where there is none."""
        return encode(self.read_temperature(), self.parameters)


def encode(temperature_degC: NDArray[np.floating], parameters: CameraParameters) -> NDArray[np.uint16]:
    """Write temperatures, degC (NaN: none), as counts of a black-body scale: the inverse of `thermography.radiometry.planck.calibrate`.

    Rounded; 0 for NaN and below the scale, 65535 above it.
    """
    p = parameters

    def signal(kelvin: NDArray[np.floating] | float) -> NDArray[np.floating]:
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            return p.planck_r1 / np.expm1(p.planck_b / np.asarray(kelvin, np.float64))

    kelvin = np.asarray(temperature_degC, np.float64) + ZERO_CELSIUS_K
    counts = p.emissivity * signal(kelvin) + (1.0 - p.emissivity) * signal(p.reflected_temperature_K)
    counts = np.where(kelvin > 0.0, np.nan_to_num(counts, nan=0.0), 0.0)
    return np.clip(np.rint(counts), 0, 65_535).astype(np.uint16)


def _times(path: Path, contents: StackContents, options: StackOptions) -> list[np.datetime64]:
    """Return the time of every frame of a file, UTC, from what is stated; else from the file itself."""
    count = contents.frames
    if options.times is not None:
        times = [options.times.get((path, index), np.datetime64("NaT", "ns")) for index in range(count)]
        if all(np.isnat(time) for time in times):
            raise StackError(f"{path}: the table of times has no line for it; add one per frame: file,frame,time")
        return times
    if options.time_in_name is not None:
        first = _time_in_name(path, options)
        return [first] if count == 1 else _spaced(path, first, count, options)
    if options.start is not None and contents.elapsed is not None:
        return list(options.start + contents.elapsed.astype("m8[ns]"))
    if options.start is not None:
        return [options.start] if count == 1 else _spaced(path, options.start, count, options)
    if contents.times is not None:
        zone = "UTC" if contents.zoned else options.time_zone
        return [
            time if np.isnat(time) else to_utc(path, time.astype("datetime64[us]").item(), zone)
            for time in contents.times
        ]
    if count == 1 and not options.needs_time:
        return [np.datetime64("NaT", "ns")]
    raise StackError(
        f'{path}: the file holds no times; write time_in_name = "..." (as "%Y%m%d_%H%M%S" in the name of the file), times = "times.csv" '
        '(file,frame,time), or start = "2026-03-09T06:30:00Z" and interval = "10 s"'
    )


def _spaced(path: Path, first: np.datetime64, count: int, options: StackOptions) -> list[np.datetime64]:
    if options.interval_s is None:
        raise StackError(f'{path}: {count} frames and one time; write interval = "10 s", from frame to frame')
    return [first + np.timedelta64(round(index * options.interval_s * 1e9), "ns") for index in range(count)]


def _time_in_name(path: Path, options: StackOptions) -> np.datetime64:
    pattern = options.time_in_name or ""
    expression = re.sub(
        r"%(.)|([^%])",
        lambda part: (
            re.escape(part[2]) if part[2] else r"\d{1,6}" if part[1] == "f" else rf"\d{{{_DIGITS.get(part[1], 1)}}}"
        ),
        pattern,
    )
    found = re.search(expression, path.name)
    try:
        if found is None:
            raise ValueError
        stamp = datetime.strptime(found[0], pattern)
    except ValueError:
        raise StackError(
            f"{path}: the name {path.name!r} holds no time of the form {pattern!r}; correct time_in_name, for example "
            '"%Y%m%d_%H%M%S" for IR_20260309_063000.csv'
        ) from None
    return to_utc(path, stamp, options.time_zone)


def to_utc(path: Path, stamp: datetime, zone: str) -> np.datetime64:
    """Return a time of a zone as UTC."""
    placed = stamp.replace(tzinfo=ZoneInfo(zone))
    if placed.utcoffset() != placed.replace(fold=1).utcoffset():
        raise StackError(f"{path}: {stamp} occurs twice or not at all in {zone} (summer time); give times in UTC")
    return np.datetime64(placed.astimezone(UTC).replace(tzinfo=None), "ns")


# Frames of temperatures as arrays: TIFF, NumPy, NetCDF and Zarr.

_WORDS = vocabulary("frames")
#: Name of a dimension -> what runs along it.
_ALONG = {name: role for role, names in _WORDS["dimensions"].items() for name in names}
#: Units of temperature as CF and common programs write them.
_UNITS = {
    **dict.fromkeys(("degC", "deg_C", "celsius", "Celsius", "degree_Celsius", "degrees_Celsius", "degrees_C", "°C", "C"), "degC"),
    **dict.fromkeys(("K", "kelvin", "Kelvin", "degK"), "K"),
}  # fmt: skip
#: Kinds of NumPy's types that can be temperatures: floating point and whole numbers.
_NUMBERS = "fiu"
#: Most characters that a message repeats of a store, whose attributes and names may be of any length.
_MOST_LETTERS = 500
#: Files that a Zarr store of version 3 or 2 begins with; each stands for the whole store.
_ZARR_METADATA = ("zarr.json", ".zgroup")


@contextmanager
def _refused(fault: str, remedy: str) -> Iterator[None]:
    """Give what a library raises on a file, errors of any kind, as one that names the fault and the remedy."""
    try:
        yield
    except ThermographyError:
        raise
    except Exception as error:
        raise ThermographyError(f"{fault} ({shorten(str(error), _MOST_LETTERS)}); {remedy}") from None


class TiffReader(TemperatureReader):
    """Reader of TIFF with one grey value per pixel and one page per frame: float temperatures, or 16 bits with a stated scale."""

    name = "TIFF of temperatures"
    #: Of TIFF, and of BigTIFF.
    starts = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds; pages of other sizes, as those of a pyramid, and of colours are passed over by name."""
        _, kind, contents = _tiff_pages(path, *_state(path))
        _require_scale(path, kind, options)
        return contents

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a page, (row, column); NaN where they are what the file marks as no data."""
        import tifffile

        chosen, *_ = _tiff_pages(path, *_state(path))
        with _refused(f"{path}: page {index} is damaged", "export it again"), tifffile.TiffFile(path) as file:
            page: Any = file.pages[chosen[index]]
            # Read as they are, a million strips that the file does not hold take the memory of a million strips.
            if page.dtype is None or page.dtype.kind not in _NUMBERS or prod(page.chunked) != len(page.dataoffsets):
                raise ValueError("its size, its kind of values and its list of strips contradict one another")
            values = np.asarray(page.asarray())
            return np.where(values == page.nodata, np.nan, values) if "GDAL_NODATA" in page.tags else values


class PngReader(TemperatureReader):
    """Reader of PNG with one grey value of 16 bits per pixel, with a stated scale; of 8 bits or colours it is a photo or a chart."""

    name = "PNG of 16 bits"
    starts = (b"\x89PNG\r\n\x1a\n",)

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether the header states 16 bits of grey."""
        return super().recognises(path, start) and start[24:26] == b"\x10\0"

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return size of the picture, as its header states it."""
        width, height = struct.unpack(">II", path.read_bytes()[16:24])
        _require_scale(path, np.dtype("u2"), options)
        return StackContents(1, (height, width))

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the counts, (row, column)."""
        from PIL import Image

        self.frame_contents(path, options)
        with _refused(f"{path}: damaged PNG", "export it again"), Image.open(path) as picture:
            return np.asarray(picture)


def _state(path: Path) -> tuple[int, int]:
    """Return size and time of change of a file: what was kept of it holds as long as they are the same."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns


@lru_cache(maxsize=64)
def _tiff_pages(path: Path, size: int, changed_ns: int) -> tuple[list[int], np.dtype[Any], StackContents]:
    """Return the pages of a TIFF that are frames, those like its largest page of grey values, their kind of values and what they hold."""
    import tifffile

    with _refused(f"{path}: damaged TIFF", "export it again"), tifffile.TiffFile(path) as file:
        pages: list[Any] = list(file.pages)
        looks = [(page.shape, page.dtype, page.photometric, page.is_reduced) for page in pages]
        if not looks or not all(isinstance(side, int) for shape, *_ in looks for side in shape):
            raise ValueError("no page, or one without a size")
        stamps = [str(page.tags["DateTime"].value) if "DateTime" in page.tags else "" for page in pages]
        # Programs for microscopes state many frames and write one page.
        stated = prod(file.series[0].shape[:-2]) if len(pages) == 1 and len(looks[0][0]) == 2 else 1
    if stated > 1:
        raise ThermographyError(f"{path}: one page that states {stated} frames; save it with one page per frame")
    grey = (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.MINISWHITE)
    frames = [
        number
        for number, (shape, kind, colours, reduced) in enumerate(looks)
        if len(shape) == 2 and kind is not None and kind.kind in _NUMBERS and colours in grey and not reduced
    ]
    if not frames:
        shape, kind, colours, _ = looks[0]
        what = f"values of type {kind}" if colours in grey and len(shape) == 2 else "colours"
        raise ThermographyError(f"{path}: {what} are not temperatures; export radiometric TIFF")
    shape, kind, *_ = max((looks[number] for number in frames), key=lambda look: (look[1].itemsize > 1, prod(look[0])))
    chosen = [number for number in frames if looks[number][:2] == (shape, kind)]
    others = Counter(
        " x ".join(map(str, looks[number][0][1::-1])) for number in sorted({*range(len(looks))} - {*chosen})
    )
    notes = tuple(f"pages passed over, reduced or of colours: {count} of {size}" for size, count in others.items())
    times = _stamp(stamps[chosen[0]]) if len(chosen) == 1 else None
    return chosen, kind, StackContents(len(chosen), shape, times=times, notes=notes)


class NumpyReader(TemperatureReader):
    """Reader of .npy: one frame (row, column), or frames (frame, row, column)."""

    name = "NumPy array"
    starts = (b"\x93NUMPY",)

    def _open(self, path: Path, options: StackOptions) -> NDArray[np.floating]:
        # The header is text that NumPy parses as Python: a damaged one raises errors of many kinds.
        with _refused(f"{path}: damaged NumPy file", "save it again with numpy.save"):
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        if array.ndim not in (2, 3) or array.dtype.kind not in _NUMBERS:
            raise ThermographyError(
                f"{path}: an array of shape {array.shape} and type {array.dtype}; save numbers as (row, column) or (frame, row, column)"
            )
        if array.ndim == 2:
            return array[np.newaxis]
        if not (axes := options.axes or axes_of(array.shape)):
            raise StackError(
                f"{path}: nothing says which axis of the shape {array.shape} counts the frames; write axes = {AXES[0]!r} or {AXES[1]!r}"
            )
        return array if axes == AXES[0] else np.moveaxis(array, -1, 0)

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds."""
        array = self._open(path, options)
        _require_scale(path, array.dtype, options)
        return StackContents(array.shape[0], (array.shape[1], array.shape[2]))

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a frame, (row, column)."""
        return np.array(self._open(path, options)[index])


#: Orders of the axes of an array without names.
AXES = ("frame, row, column", "row, column, frame")


def axes_of(shape: tuple[int, ...]) -> str:
    """Return the order of three axes where only one of both makes pictures, or pictures of a common sensor; empty where both do."""
    pictures = (shape[1:], shape[:2])
    for fits in ([_has_proportions(*each) for each in pictures], [[*each] in _WORDS["sensors"] for each in pictures]):
        if fits[0] != fits[1]:
            return AXES[fits[1]]
    return "" if _has_proportions(*shape[:2]) else AXES[0]


class _Pictures(NamedTuple):
    """Values of a store, and their dimensions along frames, None of a single one, rows and columns."""

    values: xr.DataArray
    frame: Hashable | None
    row: Hashable
    column: Hashable


def _pictures(values: xr.DataArray) -> _Pictures | None:
    """Return values with their dimensions by names and coordinates, or else by their order; None where they are no pictures."""
    along: dict[str, Hashable] = {}
    for dimension in values.dims:
        coordinate = values.coords.get(dimension)
        axis, kind = ("", "") if coordinate is None else (coordinate.attrs.get("axis", ""), coordinate.dtype.kind)
        known = (_ALONG.get(str(name).lower()) for name in ("time" if kind == "M" else "", dimension, axis))
        along.setdefault(next(filter(None, known), ""), dimension)
    named = [each for role, each in along.items() if role]
    # A band, or another dimension with one step, is none.
    single = [each for each in values.dims if values.sizes[each] == 1 and each not in named]
    values = values.isel(dict.fromkeys(single[: max(values.ndim - 3, 0)], 0))
    unnamed = iter(each for each in values.dims if each not in named)
    roles = ("frame", "row", "column")[3 - values.ndim :]
    found = [along.get(role) or next(unnamed, None) for role in roles]
    if values.ndim not in (2, 3) or {*found} != {*values.dims}:
        return None
    return _Pictures(values, *[None] * (3 - values.ndim), *found)


class NetcdfReader(TemperatureReader):
    """Reader of a variable over time, row and column of NetCDF or Zarr; its units and times are those of the CF conventions."""

    name = "NetCDF or Zarr"
    #: Of NetCDF 4, and of NetCDF 3 with 32 and with 64 bits.
    starts = (b"\x89HDF", b"CDF\1", b"CDF\2")

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is NetCDF, or a folder of Zarr or its metadata."""
        zarr = path.name in _ZARR_METADATA or (path.is_dir() and any((path / name).exists() for name in _ZARR_METADATA))
        return zarr or super().recognises(path, start)

    def _open(self, path: Path) -> Mapping[str, xr.Dataset]:
        """Open a store: its datasets by the names of their groups."""
        import xarray as xr  # the libraries of other files load with the first of them: a FLIR file is read without

        store = path.parent if path.name in _ZARR_METADATA else path
        if store.is_dir():
            # Each array of a store costs the library milliseconds whenever it is opened.
            if sum(entry.is_dir() for entry in store.iterdir()) > MOST_OBJECTS:
                raise ValueError(f"it holds more than {MOST_OBJECTS} arrays and groups")
            return {"/": xr.open_zarr(store, consolidated=False, chunks=None, decode_timedelta=True)}
        with store.open("rb") as file:
            if file.read(3) == b"CDF":
                return {"/": xr.open_dataset(store, engine="scipy", decode_timedelta=True)}
        if fault := hdf5_fault(store):
            raise ValueError(fault)
        return xr.open_groups(store, engine="h5netcdf", phony_dims="access", decode_timedelta=True)

    @contextmanager
    def _variable(self, path: Path, options: StackOptions) -> Iterator[_Pictures]:
        """Open the store for as long as its variable is read."""
        if (path.name in _ZARR_METADATA or path.is_dir()) and not find_spec("zarr"):
            raise ThermographyError(
                f"{path}: a Zarr store needs the package zarr: install it beside thermofuse (pip install zarr)"
            )
        with ExitStack() as opened:
            with _refused(f"{path}: cannot be opened", "write it again"):
                groups = self._open(path)
                for dataset in groups.values():
                    opened.enter_context(dataset)
            found = {
                f"{group}/{name}".lstrip("/"): pictures
                for group, dataset in groups.items()
                for name, values in dataset.data_vars.items()
                if (pictures := _pictures(values)) is not None
            }
            # One picture is meant where nothing lies over three dimensions.
            stacks = [name for name, each in found.items() if each.frame is not None] or list(found)
            name = options.variable if options.variable is not None else stacks[0] if len(stacks) == 1 else None
            if name not in found:
                names = shorten(", ".join(stacks) or "none", _MOST_LETTERS)
                raise StackError(
                    f'{path}: holds the variables {names} over three dimensions; write variable = "..." for the one with the temperatures'
                )
            kind = found[name].values.dtype
            if kind.kind not in _NUMBERS:
                raise ThermographyError(f"{path}: values of type {kind} are not temperatures; write real numbers")
            yield found[name]

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a store holds."""
        with self._variable(path, options) as (values, frame, row, column):
            of_frames = {
                each.dtype.kind: each.values.reshape(-1)
                for each in values.coords.values()
                if each.dims == (() if frame is None else (frame,))
            }
            times = tuple(of_frames["M"].astype("datetime64[ns]")) if "M" in of_frames else None
            stated = str(values.attrs.get("units", ""))
            if stated and stated not in _UNITS and not options.unit:
                raise StackError(
                    f"{path}: {values.name} is in {stated!r}; write it in degC or K, or state unit, scale and offset"
                )
            frames = 1 if frame is None else values.sizes[frame]
            shape = (values.sizes[row], values.sizes[column])
            return StackContents(frames, shape, _UNITS.get(stated, ""), times, zoned=True, elapsed=of_frames.get("m"))

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a time, (row, column)."""
        with (
            self._variable(path, options) as (values, frame, row, column),
            _refused(f"{path}: frame {index} is damaged", "write it again"),
        ):
            picture = values if frame is None else values.isel({frame: index})
            return np.asarray(picture.transpose(row, column).values)


class FpfReader(TemperatureReader):
    """Reader of the FLIR Public Format, the one frame per file that ThermaCAM Researcher exports (layout: FLIR's header fpfimg.h)."""

    name = "FLIR Public Format"
    starts = (b"FPF Public Image Format\0",)

    def _header(self, path: Path) -> tuple[int, np.dtype[Any], tuple[int, int], Sequence[int]]:
        """Return first byte and type of the pixels, rows and columns, and the time as seven numbers."""
        with path.open("rb") as file:
            head = file.read(_FPF_HEADER)
        if len(head) < _FPF_HEADER:
            raise ThermographyError(
                f"{path}: {len(head)} bytes, shorter than the header of {_FPF_HEADER}; export it again"
            )
        offset, quantity, kind, columns, rows = struct.unpack_from("<I4H", head, 0x24)
        if quantity != 0 or kind >= len(_FPF_KINDS):
            raise ThermographyError(
                f"{path}: image type {quantity} in format {kind} is no temperature; export temperatures"
            )
        return offset, np.dtype(_FPF_KINDS[kind]), (rows, columns), struct.unpack_from("<7i", head, 0x248)

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds; the unit is that which the program showed, and is not stored."""
        _, kind, shape, (year, month, day, hour, minute, second, ms) = self._header(path)
        _require_scale(path, kind, options)
        stamp = f"{year:04d}:{month:02d}:{day:02d} {hour:02d}:{minute:02d}:{second:02d}"
        times = _stamp(stamp)
        return StackContents(1, shape, times=times and (times[0] + np.timedelta64(ms, "ms"),))

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of the file, (row, column)."""
        offset, kind, (rows, columns), _ = self._header(path)
        values = np.fromfile(path, kind, rows * columns, offset=offset)
        if values.size < rows * columns:
            raise ThermographyError(f"{path}: {values.size} of {columns} x {rows} pixels; export it again")
        return values.reshape(rows, columns)


#: Header of the FLIR Public Format, bytes, and its kinds of pixels.
_FPF_HEADER, _FPF_KINDS = 892, ("<i2", "<i4", "<f4", "<f8")


def _require_scale(path: Path, kind: np.dtype[Any], options: StackOptions) -> None:
    if kind.kind in "iu" and options.scale == 1.0 and options.offset == 0.0:
        raise StackError(
            f"{path}: its values are whole numbers of {kind.itemsize * 8} bits; write the scale of a count and the offset, for example "
            'scale = 0.04 and unit = "K" (scale = 0.1, offset = -273.15, unit = "degC")'
        )


def _stamp(text: str) -> tuple[np.datetime64, ...] | None:
    """Return the time of the tag DateTime of a TIFF, None where it holds none."""
    try:
        return (np.datetime64(datetime.strptime(text, "%Y:%m:%d %H:%M:%S"), "ns"),)
    except ValueError:
        return None


# Frames of temperatures as text: one number per pixel, one line per row, as the programs of most cameras export them.

_DELIMITERS = (";", "\t", ",", " ")
#: Fewest rows and columns of a frame: a table with a few columns is none.
_FEWEST = 8
#: Largest share of the pixels of a frame that hold no number: with more it is a table with words.
_MOST_MISSING = 0.25
#: Largest ratio of the sides of a frame: a log of a few columns over many lines is none.
_LONGEST = 4
#: Lines that tell a frame from a table, and fewest of them and of their columns that do: a log names as many columns above its numbers.
_LOOKED_AT, _FEWEST_ALIKE, _FEWEST_WIDE = 20, 10, 32
#: Characters of a text of numbers alone.
_PLAIN = b"0123456789.,;+-eE \t\r\n"
#: A text frame of a large camera has about 10 MB.
_MOST_BYTES = 1 << 28
#: No sensor has more columns, or with the lines around its numbers more lines: a longer table is no frame, and is not read to see that.
_MOST_COLUMNS, _MOST_LINES = 16_384, 131_072


#: Bytes that are searched for what stands above the numbers.
_MOST_HEADING = 8192
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
#: What headings of exports say: of FLIR's programs emissivity and reflected temperature, of this one unit and time.
_EMISSIVITY = re.compile(r"\bemissivity\W{1,4}([01][.,]?\d*)\b", re.IGNORECASE)
_REFLECTED = re.compile(r"\brefl\w*\W+(?:\w+\W+)?temp\w*[^\w-]{1,4}(-?\d+(?:[.,]\d+)?)\W*([CFK])\b", re.IGNORECASE)
_OWN_EXPORT = re.compile(r"surface temperature / degC; ([\dT:.-]+) UTC")
#: A unit of the temperatures in a heading, as "Temperature [K]" or "TempUnit=°C", and the time that InfraTec's programs write there.
_UNIT_ABOVE = re.compile(
    r"^\W*(?:temp(?:erature?s?)?|temp ?unit|unit|einheit)\W{1,4}([CFK])\b", re.IGNORECASE | re.MULTILINE
)
_RECORDED = re.compile(r"RecDate=(\d\d)\.(\d\d)\.(\d{4})\s+RecTime=([\d:]{8})")
#: A unit behind a number.
_UNIT_BEHIND = re.compile(r"(?<=[\d.])[ \u00a0]?(?:[°º˚] ?)?([CFK])(?=[\"\s;,]|$)", re.MULTILINE)
#: Frames joined without a line between them are higher than wide by more than that; no sensor is, whichever way it is turned.
_HIGHEST = 1.35
#: Joined frames repeat one scene: they differ by less than that share of its contrast; where that is a slope, the level falls back between
#: them by more than so many usual steps.
_ALIKE, _JUMP = 0.5, 3.0
#: Ratio of the steps along a row between every second column and the others that no picture has; largest share of lines that count.
_UNALIKE, _MOST_COUNTING = 2.0, 0.5
#: Lines whose numbers differ from those of a frame by so many are a part of it; least share of fractions beside whole numbers of frames.
_NEARLY, _LEAST_FRACTIONS = 2, 0.2


class TextReader(TemperatureReader):
    """Reader of CSV or TSV: blocks of lines with equally many numbers are frames, lines around them are passed over."""

    name = "text with one temperature per pixel"

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is text."""
        marked = start.startswith(_UTF16)
        return bool(start) and (marked or not set(start) & (set(range(32)) - {9, 10, 12, 13, 27})) and not _mark(start)

    def begins_a_frame(self, text: str) -> bool:
        """Return whether the first lines of a text are rows of a picture, without a line above them that names as many columns."""
        lines = _plain_lines(text)[0][:_LOOKED_AT]
        for delimiter in _DELIMITERS:
            rows = [_numbers(line, delimiter) for line in lines]
            widths = [len(row) for row in rows if row is not None]
            if len(widths) >= _FEWEST_ALIKE and len(set(widths)) == 1 and widths[0] >= _FEWEST_WIDE:
                above = lines[: next(k for k, row in enumerate(rows) if row is not None)]
                return all(line.count(delimiter) < widths[0] - 1 for line in above)
        return False

    def holds_a_frame(self, path: Path) -> bool:
        """Return whether a text file holds a block of numbers."""
        try:
            self.contents(path, StackOptions())
        except ThermographyError:
            return False
        return True

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds; the pixels of numbers alone are counted and not read."""
        if plain := _plain_shape(_content(path)):
            return StackContents(1, plain[0], middle=plain[1])
        frames, unit = _text_frames(path, *_state(path))
        head = _heading(path)
        own, emissivity, reflected = (pattern.search(head) for pattern in (_OWN_EXPORT, _EMISSIVITY, _REFLECTED))
        time = own[1] if own else _RECORDED.sub(r"\3-\2-\1T\4", one[0]) if (one := _RECORDED.search(head)) else ""
        return StackContents(
            len(frames),
            (frames.shape[1], frames.shape[2]),
            unit="degC" if own else unit,
            times=(np.datetime64(time, "ns"),) if time and len(frames) == 1 else None,
            zoned=own is not None,
            emissivity=float(emissivity[1].replace(",", ".")) if emissivity else None,
            reflected_temperature_K=_kelvin(*reflected.groups()) if reflected else None,
            middle=float(np.nanmedian(frames)),
        )

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the numbers of a frame, (row, column); NaN where a field is no number."""
        return _text_frames(path, *_state(path))[0][index]


def _content(path: Path) -> bytes:
    if path.stat().st_size > _MOST_BYTES:
        raise ThermographyError(f"{path}: {path.stat().st_size} bytes exceed a frame of text; export one per file")
    return path.read_bytes()


# The frames of a file are asked for one after the other.
@lru_cache(maxsize=1)
def _text_frames(path: Path, size: int, changed_ns: int) -> tuple[NDArray[np.floating], str]:
    """Return the frames of a text, (frame, row, column), and the unit behind its numbers, "" where there is none."""
    content = _content(path)
    lines, unit = _plain_lines(content.decode("utf-16" if content[:2] in _UTF16 else "utf-8-sig", errors="replace"))
    above = {one.upper() for one in _UNIT_ABOVE.findall(_heading(path))}
    unit = unit or ("".join(above) if len(above) == 1 else "")
    for delimiter in _DELIMITERS if len(lines) <= _MOST_LINES else ():
        parts = [part for block in _blocks(lines, delimiter) for part in _parted(block, lines, delimiter)]
        longest = max(parts, key=lambda part: len(part.values), default=_Block(0, np.empty((0, 0)))).values
        if not _is_a_frame(longest):
            continue
        if fault := "°F; export °C or K" if unit == "F" else _fault_of_frames(parts, lines, delimiter):
            raise ThermographyError(f"{path}: {fault}")
        frames = [part for part in parts if part.values.shape[1] == longest.shape[1]]
        return np.stack([frame.values for frame in frames]), {"C": "degC"}.get(unit, unit)
    raise ThermographyError(
        f"{path}: no block of at least {_FEWEST} x {_FEWEST} numbers in the proportions of a sensor; export it as CSV, a line per row, "
        "with an empty line between frames"
    )


class _Block(NamedTuple):
    """Consecutive lines with equally many numbers, (line, column), from a first line on."""

    first: int
    values: NDArray[np.floating]


def _fault_of_frames(parts: list[_Block], lines: list[str], delimiter: str) -> str:
    """Return why blocks of numbers are not read as frames, although they could be; empty where they are."""
    longest = max(parts, key=lambda part: len(part.values)).values
    width = longest.shape[1]
    frames = [part for part in parts if part.values.shape[1] == width]
    for first, values in parts:
        other = values.shape[1]
        if other != width and (abs(other - width) <= _NEARLY or _is_a_frame(values)):
            return f"line {first + 1} holds {other} numbers, others {width}; export it again, one frame per file"
    for first, values in frames:
        below = _fields(lines[end], delimiter) if (end := first + len(values)) < len(lines) else []
        if 2 * sum(np.isfinite(_number(field)) for field in below) > len(below) > 1 and len(below) < _FEWEST:
            return f"line {end + 1} holds {len(below)} numbers, those above it {width}: it was cut; export it again"
    if delimiter == "," and _splits_numbers(longest, lines[frames[0].first :][: len(longest)]):
        return "the comma stands in numbers and between them; export it with semicolons, or with points in the numbers"
    heights = sorted({len(frame.values) for frame in frames})
    if len(heights) > 1:
        return (
            f"blocks of {heights[-2]} and of {heights[-1]} lines with {width} numbers; rows are lacking, or these are frames of several "
            "cameras: export one frame per file"
        )
    if len(frames) == 1 and (count := _joined(longest)):
        return f"{width} x {len(longest)} numbers repeat one scene {count} times; put an empty line between its frames"
    return ""


def _plain_lines(text: str) -> tuple[list[str], str]:
    """Return the lines of a text with the minus of a keyboard and without units behind numbers, and the unit of a frame of them."""
    text = text.replace("\N{MINUS SIGN}", "-")
    unit = max("CFK", key=text.count)
    if text.count(unit) < _FEWEST**2 or _UNIT_BEHIND.findall(text).count(unit) < _FEWEST**2:
        return text.splitlines(), ""
    return _UNIT_BEHIND.sub("", text).splitlines(), unit


def _blocks(lines: list[str], delimiter: str) -> list[_Block]:
    """Return the runs of lines that hold the same number of numbers."""
    blocks: list[tuple[int, list[list[float]]]] = []
    width = 0
    for number, line in enumerate(lines):
        row = _numbers(line, delimiter)
        if row is not None and len(row) == width:
            blocks[-1][1].append(row)
        elif row is not None:
            blocks.append((number, [row]))
        width = len(row or ())
    # No frame has so few lines; of a log every line may be a block.
    low = all(len(rows) < _FEWEST for _, rows in blocks)
    return [] if low else [_Block(first, np.array(rows)) for first, rows in blocks]


def _parted(block: _Block, lines: list[str], delimiter: str) -> list[_Block]:
    """Return the frames of a block: without lines that count, as pandas writes them above each, and without columns that name or number."""
    counting = np.flatnonzero(_count(block.values))
    if len(block.values) == 1 or len(counting) > _MOST_COUNTING * len(block.values):
        counting = counting[:0]
    bounds = [-1, *counting.tolist(), len(block.values)]
    parts = [
        _Block(block.first + start + 1, block.values[start + 1 : stop])
        for start, stop in pairwise(bounds)
        if stop > start + 1
    ]
    named = [frame for part in parts for frame in _without_names(part, lines, delimiter)]
    # A column for frames, another for rows.
    return [last for part in named for frame in _without_numbers(part) for last in _without_numbers(frame)]


def _split(block: _Block, begins: NDArray[np.bool_]) -> list[_Block]:
    """Return the frames that begin in some lines of a block, without its first column."""
    starts = np.unique([0, *np.flatnonzero(begins)])
    return [
        _Block(block.first + int(k), part[:, 1:])
        for k, part in zip(starts, np.split(block.values, starts[1:]), strict=True)
    ]


def _without_names(block: _Block, lines: list[str], delimiter: str) -> list[_Block]:
    """Return a block without a first column of names: of rows, or of frames, as "Frame 2" in their first line or in each."""
    if not np.isnan(block.values[:, 0]).all():
        return [block]
    names = [line.split(delimiter)[0].strip(' "') for line in lines[block.first :][: len(block.values)]]
    begins = np.array([bool(name) and name != before for before, name in pairwise(["", *names])])
    return _split(block, begins & ~begins.all())


def _without_numbers(block: _Block) -> list[_Block]:
    """Return a block without a first column that numbers rows or frames: whole numbers beside fractions, or from 0 or 1 on."""
    first, others = block.values[:, 0], block.values[:, 1:]
    steps = np.diff(first)
    repeated = bool((steps == 0.0).any())
    counts = first[0] in (0.0, 1.0) and bool((steps <= 1.0).all() and (steps > 0.0).any())
    beside = repeated and first[0] > 0.0 and np.mean(others % 1.0 != 0.0) > _LEAST_FRACTIONS
    if (first % 1.0 != 0.0).any() or others.shape[1] < _FEWEST or not (counts or beside):
        return [block]
    return _split(block, np.r_[False, steps != 0.0 if repeated else steps < 0.0])


def _splits_numbers(values: NDArray[np.floating], lines: list[str]) -> bool:
    """Whether the comma between whole numbers is also the one in numbers: 20,05,20,1 is 20.05 and 20.1; every second column is rough."""
    if np.nanmax(values % 1.0) > 0.0:
        return False
    rough = [np.nanmean(np.abs(np.diff(values[:, side::2], axis=1))) for side in (0, 1)]
    return max(rough) > _UNALIKE * min(rough) or any(re.search(r"(?:^|,)-?0\d", line) for line in lines)


def _joined(frame: NDArray[np.floating]) -> int:
    """Return how many frames of one scene stand below one another without a line between them; 0 where it is one."""
    rows, columns = frame.shape
    if rows <= _HIGHEST * columns:
        return 0
    steps = np.nanmedian(np.abs(np.diff(frame, axis=0)), axis=1)
    usual = np.nanmedian(steps)
    for count in range(2, rows // _FEWEST + 1):
        if rows % count == 0:
            height = rows // count
            parts = frame.reshape(count, height, columns)
            slopes = np.diff(parts, axis=1)
            bends = np.nanstd(slopes[0] - np.nanmean(slopes[0], axis=0))
            repeated = np.nanstd(np.diff(slopes, axis=0)) < _ALIKE * bends
            # A steady slope is alike above and below in one picture too, but does not fall back.
            change = np.nanstd(np.diff(parts - np.nanmean(parts, axis=(1, 2), keepdims=True), axis=0))
            falls = steps[height - 1 :: height].min() > _JUMP * usual
            if repeated or (falls and change < max(_ALIKE * np.nanstd(parts[0]), 2.0 * usual)):
                return count
    return 0


def _heading(path: Path) -> str:
    """Return the lines above the numbers of a text."""
    with path.open("rb") as file:
        start = file.read(_MOST_HEADING)
    text = start.decode("utf-16" if start[:2] in _UTF16 else "utf-8-sig", errors="replace")
    above = takewhile(lambda line: all(_numbers(line, mark) is None for mark in _DELIMITERS), text.splitlines())
    return "\n".join(above)


def _kelvin(value: str, unit: str) -> float:
    """Return a temperature of a heading, in C, F or K, in K."""
    number = float(value.replace(",", "."))
    return {"K": number, "C": number + ZERO_CELSIUS_K, "F": (number - 32.0) / 1.8 + ZERO_CELSIUS_K}[unit.upper()]


def _plain_shape(content: bytes) -> tuple[tuple[int, int], float] | None:
    """Return rows and columns of a text of numbers alone, of which every line holds as many, and a usual one; None of another one."""
    lines = content.removeprefix(codecs.BOM_UTF8).splitlines()
    if len(lines) > _MOST_LINES or content.removeprefix(codecs.BOM_UTF8).translate(None, _PLAIN):
        return None
    for delimiter in (mark.encode() for mark in _DELIMITERS[:3]):
        columns = {line.rstrip().removesuffix(delimiter).count(delimiter) + 1 for line in lines}
        if len(columns) == 1 and _has_proportions(len(lines), width := columns.pop()):
            corner = np.array([[_number(text.decode()) for text in line.split(delimiter)[:4]] for line in lines[:4]])
            numbered = (corner[0] % 1.0 == 0.0).all() or (corner[:, 0] % 1.0 == 0.0).all()
            bad = numbered or np.isnan(corner).any() or len(lines) > _HIGHEST * width
            return None if bad else ((len(lines), width), float(np.median(corner)))
    return None


def _has_proportions(rows: int, columns: int) -> bool:
    """Whether a block of numbers has the sides of a sensor."""
    return min(rows, columns) >= _FEWEST and max(rows, columns) <= _LONGEST * min(rows, columns)


def _is_a_frame(block: NDArray[np.floating]) -> bool:
    return _has_proportions(*block.shape) and bool(np.isnan(block).mean() <= _MOST_MISSING)


def _count(rows: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether each row counts in steps of one from 0 or 1 on, behind a first field."""
    with np.errstate(invalid="ignore"):
        return (np.diff(rows[:, 1:]) == 1.0).all(axis=1) & np.isin(rows[:, 1], (0.0, 1.0, 2.0))


def _fields(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line, numbers with a decimal point."""
    if delimiter == " ":
        fields = line.replace('"', "").split()
    else:
        text = line.rstrip().removesuffix(delimiter)
        try:
            fields = next(csv.reader([text], delimiter=delimiter), []) if '"' in text else text.split(delimiter)
        except csv.Error:  # a return within the line, or a field of 128 kB: no row of numbers
            return []
    return [field.replace(",", ".") for field in fields] if "," in line else fields


def _numbers(line: str, delimiter: str) -> list[float] | None:
    """Return the numbers of a line, NaN for a field that is empty or a word for none; None where the line is no row of a frame."""
    fields = _fields(line, delimiter)
    if not _FEWEST <= len(fields) <= _MOST_COLUMNS:
        return None
    try:
        return [float(field) for field in fields]
    except ValueError:
        values = [_number(field) for field in fields]
        # A row may lack single pixels; a heading lacks most.
        return values if 2 * np.isnan(values).sum() < len(values) else None


def _number(field: str) -> float:
    try:
        return float(field) if "_" not in field else np.nan
    except ValueError:
        return float("nan")


# Readers of thermal files of any camera: the protocol that each keeps, plug-ins by entry point, and the frames of
# many files.

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
    name : kind of file, for messages
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
    """Return the readers that other installed distributions add."""
    found: list[FrameReader] = []
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        try:
            reader = entry.load()()
        except Exception as error:
            raise FrameReaderError(
                f"the plug-in {entry.name} = {entry.value} cannot be loaded ({error}); update its package or remove it"
            ) from error
        if not isinstance(reader, FrameReader):
            raise FrameReaderError(f"the plug-in {entry.name} = {entry.value} lacks name, recognises or index; add it")
        found.append(reader)
    return tuple(found)


@cache
def readers() -> tuple[FrameReader, ...]:
    """Return all readers, plug-ins first."""
    return (
        *plug_ins(),
        FlirReader(),
        FpfReader(),
        TiffReader(),
        PngReader(),
        NumpyReader(),
        NetcdfReader(),
        TextReader(),
    )


def find_reader(path: Path) -> FrameReader | None:
    """Return the reader of an existing file or folder of Zarr, None where no reader recognises it."""
    start = b""
    if not path.is_dir():
        with path.open("rb") as file:
            start = file.read(START_BYTES)
    return next((reader for reader in readers() if reader.recognises(path, start)), None)


def is_of_flir(reader: FrameReader | None) -> bool:
    """Return whether files that a reader recognises hold counts of a FLIR camera, and no plug-in reads them."""
    return isinstance(reader, FlirReader) and reader not in plug_ins()


class Stack(NamedTuple):
    """A file of temperatures as it is stored: what it holds, and the values of its first frame (row, column)."""

    reader: TemperatureReader
    contents: StackContents
    first: NDArray[np.floating]


def read_stack(path: Path, axes: str | None = None) -> Stack:
    """Read what a file of temperatures holds, before anything but the order of its axes is stated of it."""
    reader = find_reader(path)
    if not isinstance(reader, TemperatureReader):
        raise ThermographyError(f"{path}: not a known file of temperatures; docs/formats.md lists them")
    # A scale of one and an offset of nothing would be asked for; the values are shown as they are stored.
    stored = StackOptions(scale=np.nextafter(1.0, 2.0), axes=axes)
    return Stack(reader, reader.frame_contents(path, stored), reader.read_values(path, 0, stored))


def _mark(start: bytes) -> str:
    """Say what a file that is not read is by its first bytes."""
    marks = ((bytes.fromhex(mark), one) for one in _WORDS["unread"] for mark in one.get("starts", ()))
    return next((str(one["words"]) for mark, one in marks if start[one.get("at", 0) :].startswith(mark)), "")


def name_unread(path: Path) -> str:
    """Say what a known file is that is not read, and what to do instead; empty for all others."""
    with path.open("rb") as file:
        start = file.read(START_BYTES)
    ending = path.suffix.lower()
    return _mark(start) or next((one["words"] for one in _WORDS["unread"] if ending in one.get("endings", ())), "")


def index_recordings(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], options: StackOptions | None = None
) -> tuple[FrameList, list[RejectedFrame]]:
    """List all frames of many thermal files of one camera without reading a pixel.

    Parameters
    ----------
    paths : str, path-like or iterable of them
        Files that some reader recognises, in any order; or one such file.
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
    readers()  # Loaded here once: threads that ask first would each load the plug-ins.

    def walk(path: Path) -> Iterator[FrameReference | FrameTable | RejectedFrame]:
        reader = find_reader(path)
        if reader is None:
            raise ThermographyError(
                f"{path}: {name_unread(path) or 'not a known thermal file; docs/formats.md lists them'}"
            )
        yield from reader.index(path, options)

    files = [paths] if isinstance(paths, str | os.PathLike) else paths
    return index_files(files, walk, fatal=(StackError,))
