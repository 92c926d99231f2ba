"""Frames of temperatures from any camera: what is said of them beside the file, and how they enter calculations that work on counts.

All further steps work on counts of 16 bits and camera parameters, because averaging counts is fast and exact. Temperatures are therefore
written as counts of a black-body scale: Planck's law with the constant of a long-wave camera (B = 1500 K), from absolute zero to 160 degC
in 65,000 steps, 5 mK apart at 20 degC (1.4 mK standard deviation of rounding). With the emissivity and the reflected temperature that the
camera's program used, another emissivity can be calculated exactly as for counts of such a camera.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from thermography.errors import ThermographyError
from thermography.io.frame import CalibratedRange, CameraParameters, FrameReference, RejectedFrame

_ZERO_CELSIUS_K = 273.15
#: Planck's constant B of a camera for 7.5 to 13 um, K.
_PLANCK_B = 1500.0
#: Highest temperature of the scale, degC, and its count.
_HIGHEST_DEGC, _HIGHEST_COUNT = 160.0, 65_000.0
_PLANCK_R1 = _HIGHEST_COUNT * (np.exp(_PLANCK_B / (_HIGHEST_DEGC + _ZERO_CELSIUS_K)) - 1.0)
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
    times : mapping of (str, int) to datetime64, or None
        UTC by name of the file and index of the frame in it, from 0.
    start : datetime64 or None
        UTC of the first frame of every file; with `interval_s`.
    interval_s : float or None
        From one frame of a file to the next, s.
    time_zone : str
        IANA name of the zone of times in names and in files that give none.
    emissivity : float
        With which the camera's program calculated the temperatures; 1 where it is not known.
    reflected_temperature_K : float
        Likewise, K.

    Notes
    -----
    docs/formats.md lists the kinds of files, and the same keys of the campaign file.

    Examples
    --------
    >>> StackOptions(unit="K", scale=0.04, time_in_name="%Y%m%d_%H%M%S").emissivity
    1.0
    """

    unit: str = ""
    scale: float = 1.0
    offset: float = 0.0
    variable: str | None = None
    time_in_name: str | None = None
    times: Mapping[tuple[str, int], np.datetime64] | None = None
    start: np.datetime64 | None = None
    interval_s: float | None = None
    time_zone: str = "UTC"
    emissivity: float = 1.0
    reflected_temperature_K: float = 293.15

    @property
    def parameters(self) -> CameraParameters:
        """Camera parameters of the scale of counts."""
        # A stored transmission of 1: the camera's program has corrected the path already.
        return CameraParameters(
            emissivity=self.emissivity, object_distance_m=1.0, reflected_temperature_K=self.reflected_temperature_K,
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
    frames : int
        Number of frames.
    shape : tuple of int
        (rows, columns) of each.
    unit : str
        "degC" or "K" where the file says it, else "".
    times : sequence of datetime64, or None
        UTC or, without `zoned`, in the zone that `StackOptions` names; None where the file holds none.
    zoned : bool
        Whether the file gives its times in UTC.
    """

    frames: int
    shape: tuple[int, int]
    unit: str = ""
    times: tuple[np.datetime64, ...] | None = None
    zoned: bool = False


class TemperatureReader(ABC):
    """Base of readers of files that hold temperatures: `contents` and `read_values` are left to each kind of file."""

    name: str

    @abstractmethod
    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is of this kind, by its content."""

    @abstractmethod
    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds, without reading its pixels where that is possible."""

    @abstractmethod
    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a frame as stored, (row, column)."""

    def frame_contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds, see `contents`, where it can be frames: what a few bytes state may be any number.

        Parameters
        ----------
        path : Path
        options : StackOptions

        Raises
        ------
        ThermographyError
            The file is damaged, its frames have no pixel or more than 16.8 million, or there are none or more than a million.
        """
        contents = self.contents(path, options)
        if contents.shape[0] * contents.shape[1] > _MOST_PIXELS or 0 in contents.shape:
            raise ThermographyError(f"{path}: {contents.shape[1]} x {contents.shape[0]} pixels are no thermal frame")
        if not 0 < contents.frames <= _MOST_FRAMES:
            raise ThermographyError(
                f"{path}: {contents.frames:,} frames, 1 to {_MOST_FRAMES:,} in a file can be read; export them in parts"
            )
        return contents

    def index(self, path: Path, options: StackOptions) -> Iterator[FrameReference | RejectedFrame]:
        """Yield the frames of a file in its order.

        Parameters
        ----------
        path : Path
        options : StackOptions

        Raises
        ------
        StackError
            Unit or times are not known.
        ThermographyError
            The file is damaged.
        """
        contents = self.frame_contents(path, options)
        unit = options.unit or contents.unit
        if unit not in ("degC", "K"):
            raise StackError(
                f'{path}: nothing says whether its values are degC or K; write unit = "degC" or unit = "K"'
            )
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
    """A frame of temperatures in a file; further attributes are those of `FrameReference`.

    Attributes
    ----------
    size : tuple of int
        (rows, columns).
    unit : {"degC", "K"}
        Of the values.
    reader : TemperatureReader
        Of the file.
    options : StackOptions
        What is said of the file.
    """

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
            return values * self.options.scale + self.options.offset - (_ZERO_CELSIUS_K if self.unit == "K" else 0.0)

    def read_counts(self) -> NDArray[np.uint16]:
        """Read the temperatures as counts of the black-body scale, (row, column) uint16; 0 where there is none."""
        return encode(self.read_temperature(), self.parameters)


def encode(temperature_degC: NDArray[np.floating], parameters: CameraParameters) -> NDArray[np.uint16]:
    """Write temperatures as counts of a black-body scale: the inverse of `thermography.radiometry.planck.calibrate`.

    Parameters
    ----------
    temperature_degC : ndarray, degC
        NaN where there is no temperature.
    parameters : CameraParameters
        Of `StackOptions.parameters`.

    Returns
    -------
    ndarray of uint16
        Rounded; 0 for NaN and below the scale, 65535 above it.

    Examples
    --------
    >>> from thermography.radiometry.planck import calibrate
    >>> counts = encode(np.array([[20.0, np.nan]]), StackOptions().parameters)
    >>> calibrate(counts, StackOptions().parameters).round(2)
    array([[20., nan]], dtype=float32)
    """
    p = parameters

    def signal(kelvin: NDArray[np.floating] | float) -> NDArray[np.floating]:
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            return p.planck_r1 / np.expm1(p.planck_b / np.asarray(kelvin, np.float64))

    kelvin = np.asarray(temperature_degC, np.float64) + _ZERO_CELSIUS_K
    counts = p.emissivity * signal(kelvin) + (1.0 - p.emissivity) * signal(p.reflected_temperature_K)
    counts = np.where(kelvin > 0.0, np.nan_to_num(counts, nan=0.0), 0.0)
    encoded: NDArray[np.uint16] = np.clip(np.rint(counts), 0, 65_535).astype(np.uint16)
    return encoded


def _times(path: Path, contents: StackContents, options: StackOptions) -> list[np.datetime64]:
    """Return the time of every frame of a file, UTC, from what is stated; else from the file itself."""
    count = contents.frames
    if options.times is not None:
        times = [options.times.get((path.name, index), np.datetime64("NaT", "ns")) for index in range(count)]
        if all(np.isnat(time) for time in times):
            raise StackError(
                f"{path}: the table of times has no line for {path.name}; add one per frame: file,frame,time"
            )
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
    raise StackError(
        f'{path}: the file holds no times; write time_in_name = "..." (as "%Y%m%d_%H%M%S" in the name of the file), times = "times.csv" '
        '(file,frame,time), or start = "2026-03-09T06:30:00Z" and interval = "10 s"'
    )


def _spaced(path: Path, first: np.datetime64, count: int, options: StackOptions) -> list[np.datetime64]:
    if options.interval_s is None:
        raise StackError(
            f'{path}: {count} frames and one time; write interval = "10 s", the time from one frame to the next'
        )
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
    """Return a time of a zone as UTC.

    Parameters
    ----------
    path : Path
        For the message.
    stamp : datetime
        Without zone.
    zone : str
        IANA name.

    Raises
    ------
    StackError
        The time occurs twice or not at all, because clocks are changed for summer.
    """
    placed = stamp.replace(tzinfo=ZoneInfo(zone))
    if placed.utcoffset() != placed.replace(fold=1).utcoffset():
        raise StackError(
            f"{path}: {stamp} occurs twice or not at all in {zone}, where clocks are changed for summer; give the times in UTC"
        )
    return np.datetime64(placed.astimezone(UTC).replace(tzinfo=None), "ns")
