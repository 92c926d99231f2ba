"""Frames of temperatures from any camera: what is stated about them outside the file, and how they enter calculations that work on counts.

All further steps work on counts of 16 bits and camera parameters, because averaging counts is fast and exact. Temperatures are therefore
written as counts of a black-body scale: Planck's law with the constant of a long-wave camera (B = 1500 K), from absolute zero to 160 degC
in 65,000 steps, 5 mK apart at 20 degC (1.4 mK standard deviation of rounding). With the emissivity and the reflected temperature that the
camera's program used, another emissivity can be calculated exactly as for counts of such a camera.
"""

from __future__ import annotations

import codecs
import os
import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from itertools import takewhile
from math import prod
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray as xr

from thermography.common import ZERO_CELSIUS_K, ThermographyError
from thermography.io.flir import FlirReader, index_files
from thermography.io.frame import CalibratedRange, CameraParameters, FrameReference, RejectedFrame
from thermography.io.hdf5 import MOST_OBJECTS, hdf5_fault
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
    emissivity, reflected_temperature_K : with which the temperatures were calculated, where the file says it
    """

    frames: int
    shape: tuple[int, int]
    unit: str = ""
    times: tuple[np.datetime64, ...] | None = None
    zoned: bool = False
    emissivity: float | None = None
    reflected_temperature_K: float | None = None


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
        for index, time in enumerate(_times(path, contents, options)):
            yield TemperatureFrame(
                parameters=options.parameters,
                time=time.astype("datetime64[ms]"),
                limits=CalibratedRange(raw_minimum=1, raw_maximum=65_534),
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
        """Read the temperatures, (row, column) degC; raise a ThermographyError where the frame has another size than the first."""
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.asarray(self.reader.read_values(self.path, self.index, self.options), np.float64)
        if values.shape != self.size:
            raise ThermographyError(
                f"{self.path}: frame {self.index} has {values.shape[::-1]} pixels and not {self.size[::-1]}; the file is damaged"
            )
        # A damaged value may be beyond any temperature, or none; its counts say so.
        with np.errstate(over="ignore", invalid="ignore"):
            return values * self.options.scale + self.options.offset - (ZERO_CELSIUS_K if self.unit == "K" else 0.0)

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
        """Return what a file holds."""
        import tifffile

        with _refused(f"{path}: damaged TIFF", "export it again"), tifffile.TiffFile(path) as file:
            first: Any = file.pages[0]
            shape, kind = first.shape, first.dtype
            count = len(file.pages)
            stamp = str(first.tags["DateTime"].value) if "DateTime" in first.tags else ""
        if len(shape) != 2 or not all(isinstance(side, int) for side in shape):
            raise ThermographyError(f"{path}: pixels of shape {shape} hold no temperatures; export radiometric TIFF")
        if kind is None or kind.kind not in _NUMBERS:
            raise ThermographyError(f"{path}: values of type {kind} are not temperatures; export real numbers")
        _require_scale(path, kind, options)
        return StackContents(count, (shape[0], shape[1]), times=_stamp(stamp) if count == 1 else None)

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a page, (row, column)."""
        import tifffile

        with _refused(f"{path}: page {index} is damaged", "export it again"), tifffile.TiffFile(path) as file:
            page: Any = file.pages[index]
            # Read as they are, a million strips that the file does not hold take the memory of a million strips.
            if page.dtype is None or page.dtype.kind not in _NUMBERS or prod(page.chunked) != len(page.dataoffsets):
                raise ValueError("its size, its kind of values and its list of strips contradict one another")
            return np.asarray(page.asarray())


class NumpyReader(TemperatureReader):
    """Reader of .npy: one frame (row, column), or frames (frame, row, column)."""

    name = "NumPy array"
    starts = (b"\x93NUMPY",)

    def _open(self, path: Path) -> NDArray[np.floating]:
        # The header is text that NumPy parses as Python: a damaged one raises errors of many kinds.
        with _refused(f"{path}: damaged NumPy file", "save it again with numpy.save"):
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        if array.ndim not in (2, 3) or array.dtype.kind not in _NUMBERS:
            raise ThermographyError(
                f"{path}: an array of shape {array.shape} and type {array.dtype}; save numbers as (row, column) or (frame, row, column)"
            )
        return array if array.ndim == 3 else array[np.newaxis]

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds."""
        array = self._open(path)
        _require_scale(path, array.dtype, options)
        return StackContents(array.shape[0], (array.shape[1], array.shape[2]))

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a frame, (row, column)."""
        return np.array(self._open(path)[index])


class NetcdfReader(TemperatureReader):
    """Reader of a variable (time, row, column) of a NetCDF 4 or Zarr store; its units and times are those of the CF conventions."""

    name = "NetCDF or Zarr"
    starts = (b"\x89HDF",)

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is HDF5, or a folder of Zarr or its metadata."""
        zarr = path.name in _ZARR_METADATA or (path.is_dir() and any((path / name).exists() for name in _ZARR_METADATA))
        return zarr or super().recognises(path, start)

    @contextmanager
    def _variable(self, path: Path, options: StackOptions) -> Iterator[xr.DataArray]:
        """Open the store for as long as its variable is read."""
        import xarray as xr  # the libraries of other files load with the first of them: a FLIR file is read without

        store = path.parent if path.name in _ZARR_METADATA else path
        zarr = store.is_dir()
        if zarr and not find_spec("zarr"):
            raise ThermographyError(
                f"{path}: a Zarr store needs the package zarr: install it beside thermofuse (pip install zarr)"
            )
        with _refused(f"{path}: cannot be opened", "write it again"):
            # Each array of a store costs the library milliseconds whenever it is opened.
            if zarr and sum(entry.is_dir() for entry in store.iterdir()) > MOST_OBJECTS:
                raise ValueError(f"it holds more than {MOST_OBJECTS} arrays and groups")
            if not zarr and (fault := hdf5_fault(store)):
                raise ValueError(fault)
            dataset = (
                xr.open_zarr(store, consolidated=False, chunks=None)
                if zarr
                else xr.open_dataset(store, engine="h5netcdf", phony_dims="access")
            )
        with dataset:
            stacks = [name for name, values in dataset.data_vars.items() if values.ndim == 3]
            name = options.variable if options.variable is not None else stacks[0] if len(stacks) == 1 else None
            if name not in dataset.data_vars or dataset[name].ndim != 3:
                names = shorten(", ".join(map(str, stacks)) or "none", _MOST_LETTERS)
                raise StackError(
                    f'{path}: holds the variables {names} over three dimensions; write variable = "..." for the one with the temperatures'
                )
            kind = dataset[name].dtype
            if kind.kind not in _NUMBERS:
                raise ThermographyError(f"{path}: values of type {kind} are not temperatures; write real numbers")
            yield dataset[name]

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a store holds."""
        with self._variable(path, options) as values:
            first = values.dims[0]
            stamps = values[first].values if first in values.coords else np.empty(0)
            times = tuple(stamps.astype("datetime64[ns]")) if stamps.dtype.kind == "M" else None
            unit = _UNITS.get(str(values.attrs.get("units", "")), "")
            return StackContents(values.shape[0], (values.shape[1], values.shape[2]), unit, times, zoned=True)

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a time, (row, column)."""
        with self._variable(path, options) as values, _refused(f"{path}: frame {index} is damaged", "write it again"):
            return np.asarray(values[index].values)


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


class TextReader(TemperatureReader):
    """Reader of one frame per file as CSV or TSV: the longest block of lines with equally many numbers; lines around it are passed over."""

    name = "text with one temperature per pixel"

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is text."""
        marked = start.startswith(_UTF16)
        return bool(start) and (marked or not set(start) & (set(range(32)) - {9, 10, 12, 13, 27}))

    def begins_a_frame(self, text: str) -> bool:
        """Return whether the first lines of a text are rows of a picture, without a line above them that names as many columns."""
        lines = text.splitlines()[:_LOOKED_AT]
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
        if shape := _plain_shape(path.read_bytes()):
            return StackContents(1, shape)
        rows, columns = self.read_values(path, 0, options).shape
        head = _heading(path)
        own, emissivity, reflected = (pattern.search(head) for pattern in (_OWN_EXPORT, _EMISSIVITY, _REFLECTED))
        return StackContents(
            1,
            (rows, columns),
            unit="degC" if own else "",
            times=(np.datetime64(own[1], "ns"),) if own else None,
            zoned=True,
            emissivity=float(emissivity[1].replace(",", ".")) if emissivity else None,
            reflected_temperature_K=_kelvin(*reflected.groups()) if reflected else None,
        )

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the numbers of a file, (row, column); NaN where a field is no number."""
        if path.stat().st_size > _MOST_BYTES:
            raise ThermographyError(f"{path}: {path.stat().st_size} bytes exceed a frame of text; export one per file")
        content = path.read_bytes()
        utf16 = content.startswith(_UTF16)
        lines = content.decode("utf-16" if utf16 else "utf-8-sig", errors="replace").splitlines()
        for delimiter in _DELIMITERS if len(lines) <= _MOST_LINES else ():
            block = _longest_block(lines, delimiter)
            if _is_a_frame(block):
                return _without_numbers_of_lines(np.array(block))
        raise ThermographyError(
            f"{path}: no block of at least {_FEWEST} x {_FEWEST} numbers in the proportions of a sensor; export it as CSV, a line per row"
        )


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


def _plain_shape(content: bytes) -> tuple[int, int] | None:
    """Return rows and columns of a text of numbers alone, of which every line holds as many; None of another one."""
    lines = content.removeprefix(codecs.BOM_UTF8).splitlines()
    if len(lines) > _MOST_LINES or content.removeprefix(codecs.BOM_UTF8).translate(None, _PLAIN):
        return None
    for delimiter in (mark.encode() for mark in _DELIMITERS[:3]):
        columns = {line.rstrip().removesuffix(delimiter).count(delimiter) + 1 for line in lines}
        if len(columns) == 1 and _has_proportions(len(lines), width := columns.pop()):
            corner = np.array([[_number(text.decode()) for text in line.split(delimiter)[:4]] for line in lines[:4]])
            return (
                None
                if np.isnan(corner).any() or _counts_alone(corner) or _counts_alone(corner.T)
                else (len(lines), width)
            )
    return None


def _has_proportions(rows: int, columns: int) -> bool:
    """Whether a block of numbers has the sides of a sensor."""
    return min(rows, columns) >= _FEWEST and max(rows, columns) <= _LONGEST * min(rows, columns)


def _is_a_frame(block: list[list[float]]) -> bool:
    rows, columns = len(block), len(block[0]) if block else 0
    return _has_proportions(rows, columns) and bool(np.isnan(block).mean() <= _MOST_MISSING)


def _without_numbers_of_lines(block: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return a frame without a first column of names, and without a first row or column that counts, as pandas and R write them."""
    if np.isnan(block[:, 0]).all():
        block = block[:, 1:]
    if _counts_alone(block) or (np.isnan(block[0, 0]) and _counts_alone(block[:, 1:])):
        block = block[1:]
    return block[:, 1:] if _counts_alone(block.T) else block


def _counts_alone(rows: NDArray[np.floating]) -> bool:
    """Whether the numbers of the first row, and not those of the second, count from 0 or from 1."""
    steps = np.diff(rows[:2]) == 1.0
    return bool(rows[0, 0] in (0.0, 1.0) and steps[0].all() and not steps[1].all())


def _longest_block(lines: list[str], delimiter: str) -> list[list[float]]:
    """Return the longest run of lines that hold the same number of numbers."""
    best: list[list[float]] = []
    block: list[list[float]] = []
    for line in lines:
        row = _numbers(line, delimiter)
        if block and (row is None or len(row) != len(block[0])):
            best, block = max(best, block, key=len), []
        if row is not None:
            block.append(row)
    return max(best, block, key=len)


def _numbers(line: str, delimiter: str) -> list[float] | None:
    """Return the numbers of a line, NaN for a field that is empty or a word for none; None where the line is no row of a frame."""
    fields = line.split() if delimiter == " " else line.rstrip().removesuffix(delimiter).split(delimiter)
    if not _FEWEST <= len(fields) <= _MOST_COLUMNS:
        return None
    if delimiter != ",":
        fields = [field.replace(",", ".") for field in fields]
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
    return (*plug_ins(), FlirReader(), FpfReader(), TiffReader(), NumpyReader(), NetcdfReader(), TextReader())


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


def read_stack(path: Path) -> Stack:
    """Read what a file of temperatures holds, before anything is stated of it."""
    reader = find_reader(path)
    if not isinstance(reader, TemperatureReader):
        raise ThermographyError(f"{path}: not a known file of temperatures; docs/formats.md lists them")
    # A scale of one and an offset of nothing would be asked for; the values are shown as they are stored.
    stored = StackOptions(scale=np.nextafter(1.0, 2.0))
    return Stack(reader, reader.frame_contents(path, stored), reader.read_values(path, 0, stored))


#: First byte and bytes, or ending, of files of thermal cameras that are not read -> what they are and what to do instead.
_VIDEO = "a video of colours (MP4, MOV or AVI) without temperatures; record radiometric video (.seq, .csq), or take single pictures"
_EXPORT = "export it as CSV or TIFF of temperatures in the program that reads it"
_NOT_READ: dict[tuple[int, bytes] | str, str] = {
    (4, b"ftyp"): _VIDEO,
    (0, b"RIFF"): _VIDEO,
    (0, b"AFF\0"): f"an AFF sequence of a cooled FLIR camera, whose layout is not public; {_EXPORT}",
    ".ats": f"an ATS recording of FLIR ResearchIR or Research Studio, whose layout is not public; export it as SEQ there, or {_EXPORT}",
    ".irb": f"a recording of InfraTec, whose layout is not public; {_EXPORT}",
    ".bmt": f"a picture of Testo, whose layout is not public; {_EXPORT}",
    ".is2": f"a picture of Fluke, whose layout is not public; {_EXPORT}",
}


def name_unread(path: Path) -> str:
    """Say what a file of a thermal camera is that is not read, and what to do instead; empty for all others."""
    with path.open("rb") as file:
        start = file.read(START_BYTES)
    known = (
        why for mark, why in _NOT_READ.items() if not isinstance(mark, str) and start[mark[0] :].startswith(mark[1])
    )
    return next(known, _NOT_READ.get(path.suffix.lower(), ""))


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
