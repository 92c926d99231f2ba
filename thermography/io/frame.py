"""What a FLIR frame is: parameters, camera, limits, header and counts; and the error of a file that is none."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thermography.errors import ThermographyError

Encoding = Literal["raw", "png", "jpegls"]
Segments = tuple[tuple[int, int], ...]


class FlirFormatError(ThermographyError):
    """A FLIR file breaks a promise of its format; the message names file, offset, what was expected and what was found."""


@dataclass(frozen=True)
class CameraParameters:
    """What the vendor's formula needs, as the file stores it.

    Temperatures are kelvin, the distance is metres, humidity, emissivity and transmissions are fractions (0..1).
    `stored_transmission` is the atmospheric transmission that a camera or program wrote; 0 means none.
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
    """Which camera and lens made a frame."""

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
    """The temperatures (K) and counts between which the camera is calibrated; counts 0 and 65535 where it does not say."""

    minimum_K: float = 0.0
    maximum_K: float = 0.0
    raw_minimum: int = 0
    raw_maximum: int = 65535


@dataclass(frozen=True)
class CameraSettings:
    """How the camera was set: focus, frame rate, the temperatures (K) and counts between which it showed its picture.

    0 where the file does not say.
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
class Samples:
    """Where the pixels of one record are: `offset` and `length` in bytes from the start of the FFF record."""

    encoding: Encoding
    offset: int
    length: int
    little_endian: bool
    shape: tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class FrameHeader:
    """Everything about a frame but its pixels.

    Attributes
    ----------
    parameters : CameraParameters
    time : datetime64[ms]
        UTC; NaT where the file stores none.
    utc_offset_minutes : int
        Local time minus UTC as set in the camera, minutes.
    camera : CameraIdentity
    limits : CalibratedRange
    settings : CameraSettings
    housekeeping : dict of str to float
        The camera's own temperatures by name, K (lens, shutter, aperture, capsule, detector); "sensor 1" to "sensor 4" in files
        that do not name them.
    notes : tuple of str
        What the reader had to mend or assume.
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
    """One frame with its pixels.

    Attributes
    ----------
    counts : ndarray of uint16, shape (row, column)
    source : str
        Path of the file.
    index : int
        Place of the frame in the file, from 0.
    camera_info : bytes
        The camera-info record as it stands in the file.
    """

    counts: NDArray[np.uint16]
    source: str = ""
    index: int = 0
    camera_info: bytes = b""
