"""A frame: camera parameters, camera identity, calibrated range, header and counts; and where a frame is stored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thermography.common import ThermographyError

Encoding = Literal["raw", "png", "jpegls"]
Segments = tuple[tuple[int, int], ...]


class FlirFormatError(ThermographyError):
    """A FLIR file violates its format; the message names the file, the offset, what was expected and what was found."""


@dataclass(frozen=True)
class CameraParameters:
    """Parameters of the measurement formula, in the units in which the file stores them.

    Attributes
    ----------
    emissivity : float
        Emissivity of the surface, above 0 and up to 1.
    object_distance_m : float
        Length of the air path from object to camera, m.
    reflected_temperature_K : float
        Reflected apparent temperature, K.
    atmospheric_temperature_K : float
        Temperature of the air path, K.
    window_temperature_K, window_transmission : float
        Temperature (K) and transmission (0 to 1) of an external infrared window; transmission 1 means that there is none.
    stored_transmission : float
        Atmospheric transmission (0 to 1) as written by the camera or another program; 0 means that none is stored.
    relative_humidity : float
        Relative humidity of the air path, 0 to 1.
    planck_r1, planck_b, planck_f, planck_o, planck_r2 : float
        Calibration constants of the camera in S(T) = R1 / (R2 (exp(B / T) - F)) - O: B in K, R1 / R2 and O in counts, F without unit.
    atmosphere_alpha1, atmosphere_alpha2, atmosphere_beta1, atmosphere_beta2 : float
        Attenuation constants of the two exponentials of the atmospheric transmission, m^-1/2 (beta per square root of the water
        content, g/m3).
    atmosphere_x : float
        Weight of the first exponential.

    Notes
    -----
    The formula is in `thermography.radiometry.planck` and in ``docs/method/radiometry.md``.

    Examples
    --------
    A surface of emissivity 0.95 at a distance of 1 m, seen by an SC660 without a window:

    >>> parameters = CameraParameters(
    ...     emissivity=0.95, object_distance_m=1.0, reflected_temperature_K=293.15, atmospheric_temperature_K=293.15,
    ...     window_temperature_K=293.15, window_transmission=1.0, stored_transmission=0.0, relative_humidity=0.5,
    ...     planck_r1=21106.77, planck_b=1501.0, planck_f=1.0, planck_o=-7340.0, planck_r2=0.012545258,
    ...     atmosphere_alpha1=0.006569, atmosphere_alpha2=0.01262,
    ...     atmosphere_beta1=-0.002276, atmosphere_beta2=-0.00667, atmosphere_x=1.9,
    ... )
    """

    emissivity: float
    object_distance_m: float
    reflected_temperature_K: float
    atmospheric_temperature_K: float
    window_temperature_K: float
    window_transmission: float
    stored_transmission: float
    relative_humidity: float
    planck_r1: float
    planck_b: float
    planck_f: float
    planck_o: float
    planck_r2: float
    atmosphere_alpha1: float
    atmosphere_alpha2: float
    atmosphere_beta1: float
    atmosphere_beta2: float
    atmosphere_x: float


@dataclass(frozen=True)
class CameraIdentity:
    """Camera and lens that recorded a frame, each with name, part and serial number, firmware version and horizontal field of view
    (degrees); empty or 0 where the file does not name them.
    """

    model: str = ""
    part: str = ""
    serial: str = ""
    software: str = ""
    lens_model: str = ""
    lens_part: str = ""
    lens_serial: str = ""
    field_of_view_deg: float = 0.0


@dataclass(frozen=True)
class CalibratedRange:
    """Range in which the camera is calibrated, K (both 0 where the file does not store it) and counts."""

    minimum_K: float = 0.0
    maximum_K: float = 0.0
    raw_minimum: int = 0
    raw_maximum: int = 65535

    @property
    def in_kelvin(self) -> bool:
        """Whether the file stores limits in temperature that a camera can have."""
        return 0 < self.minimum_K < self.maximum_K < 10_000


@dataclass(frozen=True)
class CameraSettings:
    """Settings of the camera at the time of the frame; 0 where the file does not store them.

    Attributes
    ----------
    focus_distance_m : distance to which the lens is focused, m
    frame_rate_Hz : frame rate, Hz
    clip_maximum_K, clip_minimum_K, warn_maximum_K, warn_minimum_K, saturated_maximum_K, saturated_minimum_K : float
        Temperatures (K) at which the display of the camera clips, warns and shows saturation.
    raw_median, raw_range : centre and width of the displayed range, counts
    """

    focus_distance_m: float = 0.0
    frame_rate_Hz: float = 0.0
    clip_maximum_K: float = 0.0
    clip_minimum_K: float = 0.0
    warn_maximum_K: float = 0.0
    warn_minimum_K: float = 0.0
    saturated_maximum_K: float = 0.0
    saturated_minimum_K: float = 0.0
    raw_median: int = 0
    raw_range: int = 0


@dataclass(frozen=True)
class SampleLocation:
    """Location and packing of the pixels in one FFF record: first byte and number of bytes, (rows, columns), place (offset, length) of the
    raw-image record with its header, and its CRC-32, 0 where none is stored.
    """

    encoding: Encoding
    offset: int
    length: int
    little_endian: bool
    shape: tuple[int, int]
    record: tuple[int, int]
    checksum: int


@dataclass(frozen=True, kw_only=True)
class FrameHeader:
    """A frame without its pixels.

    Attributes
    ----------
    parameters : parameters of the measurement formula as stored
    time : UTC; NaT where the file stores none
    utc_offset_minutes : local time minus UTC as set in the camera, minutes
    camera : camera and lens
    limits : range in which the camera is calibrated
    settings : focus, frame rate and display settings
    housekeeping
        Temperatures measured inside the camera by sensor name, K (lens, shutter, aperture, capsule, detector); "sensor 1" to "sensor
        4" in files that do not name them
    notes : corrections and assumptions that the reader made
    """

    parameters: CameraParameters
    time: np.datetime64
    utc_offset_minutes: int = 0
    camera: CameraIdentity = CameraIdentity()
    limits: CalibratedRange = CalibratedRange()
    settings: CameraSettings = CameraSettings()
    housekeeping: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame(FrameHeader):
    """A frame with its pixels; two frames are equal if their headers are.

    Attributes
    ----------
    counts : (row, column), signal of the detector, counts
    source : path of the file
    index : index of the frame in the file, from 0
    camera_info : the camera-information record as stored in the file
    """

    counts: NDArray[np.uint16]
    source: str = ""
    index: int = 0
    camera_info: bytes = b""


@dataclass(frozen=True)
class PlainSamples:
    """Place of pixels that stand in a file as they are: 16 bits each, row by row, from `offset` bytes on."""

    offset: int
    little_endian: bool


@dataclass(frozen=True, kw_only=True)
class FrameReference(FrameHeader, ABC):
    """A frame in a file: its header, and how its pixels are read; `altered` where the header differs from the checksum that the file holds
    of it; further attributes are those of `FrameHeader`.
    """

    path: Path
    index: int
    altered: bool = False

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""

    @abstractmethod
    def read_counts(self) -> NDArray[np.uint16]:
        """Read the pixels, (row, column) uint16; raise a ThermographyError or OSError where they cannot be read."""

    @property
    def plain_samples(self) -> PlainSamples | None:
        """Where the pixels stand as they are, so that a part of them can be read; None where they must be read as a whole."""
        return None

    def read(self) -> Frame:
        """Read the frame with its pixels; raise as `read_counts` does."""
        header = {each.name: getattr(self, each.name) for each in fields(FrameHeader)}
        return Frame(**header, counts=self.read_counts(), source=str(self.path), index=self.index)


@dataclass(frozen=True)
class RejectedFrame:
    """A frame, by its index, or with 0 a whole file that was not used, and why, with file and offset."""

    path: Path
    index: int
    reason: str
