"""Summarises the content of a FLIR file and warns about everything in it that is implausible or damaged."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np

from thermography.common import ThermographyError
from thermography.evaluation import share_outside_range
from thermography.io.flir import FlirFrameReference, FlirReader, index_frames, read_frame
from thermography.io.frame import FlirFormatError, Frame, FrameReference, RejectedFrame
from thermography.io.other_cameras import START_BYTES, StackOptions, TemperatureReader, find_reader, plug_ins
from thermography.radiometry.planck import (
    ZERO_CELSIUS_K,
    RadiometryError,
    calibrate,
    override,
    path_transmission,
    temperature_from_counts,
)

#: Maximum number of frames whose pixels are read, spread evenly over the file, so that long recordings are inspected quickly.
_FRAMES_READ = 32
#: Pixels that are read in all: 32 frames of the largest usual camera, 1024 x 1024.
_PIXELS_READ = _FRAMES_READ << 20
#: Bolometer cameras with these file formats appeared after this year; an earlier date means that the clock was never set.
_OLDEST_YEAR = 2001
_THUMBNAIL_WIDTH = 320
#: Code of a warning -> what to do about it.
_REMEDIES = {
    "frame_left_out": "Copy the file from the camera again if the frame matters.",
    "no_time": "They cannot be matched with laser readings.",
    "clock_not_set": "Set it, or give thermography.clock_offset in the campaign.",
    "several_cameras": "Store the frames of each camera in a separate file.",
    "several_lenses": "Use one lens: another one shows the table elsewhere and at another scale.",
    "parameters_vary": "Override them if the scene did not change.",
    "emissivity": "Give emissivity.",
    "distance_zero": "Give object_distance.",
    "humidity": "Give relative_humidity as a fraction.",
    "humidity_percent": "It was divided by 100.",
    "not_calibrated": "Only the counts can be used.",
    "checksum": "The file was changed after the camera wrote it; compare it with the original.",
    "saturated": "Select another range in the camera.",
    "under_range": "Select another range in the camera.",
    "outside_range": "Their temperatures are not calibrated.",
    "no_content": "The shutter was closed, or the frame is damaged.",
    "stored_transmission": "Give object_distance to calculate it instead.",
}


@dataclass(frozen=True)
class FileWarning:
    """An implausible or damaged part of a file: a code such as "saturated", what was found, and what to do about it."""

    code: str
    message: str
    remedy: str


@dataclass(frozen=True)
class FlirInspection:
    """Content of one FLIR file.

    Attributes
    ----------
    frames : tuple of FrameReference
        Usable frames in order of time.
    rejected : tuple of RejectedFrame
        Frames that cannot be used, and why.
    lowest_degC, highest_degC, mean_degC : float
        Surface temperature over the frames that were read, degC; NaN where the parameters give no temperature.
    frames_read : int
        Number of frames whose pixels were read.
    warnings : tuple of FileWarning
        Everything that is implausible or damaged.
    """

    path: Path
    frames: tuple[FrameReference, ...]
    rejected: tuple[RejectedFrame, ...]
    lowest_degC: float
    highest_degC: float
    mean_degC: float
    frames_read: int
    warnings: tuple[FileWarning, ...]

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """Return the content as lines of text, the warnings last."""
        first, last = self.frames[0], self.frames[-1]
        camera, p = first.camera, first.parameters
        rows, columns = first.shape
        count = f"{len(self.frames)} frames" if len(self.frames) > 1 else "1 frame"
        lens = f", lens {camera.lens_model}" if camera.lens_model else ""
        serial = f", serial {camera.serial}" if camera.serial else ""
        times = f"{first.time} UTC" if len(self.frames) == 1 else f"{first.time} to {last.time} UTC"
        zone = f"{first.utc_offset_minutes / 60:+g} h" if first.utc_offset_minutes else "UTC"
        housekeeping = ", ".join(
            f"{name} {value - ZERO_CELSIUS_K:.1f}"
            for name, value in first.housekeeping.items()
            if abs(value - ZERO_CELSIUS_K) > 1e-3
        )
        packing = f", samples {first.samples.encoding}" if isinstance(first, FlirFrameReference) else ""
        lines = [
            f"{self.path}: FLIR, {count} of {columns} x {rows}{packing}",
            f"  camera {camera.model or 'unknown'}{serial}{lens}",
            f"  time {times} (camera set to {zone})",
            f"  emissivity {p.emissivity:.3g}, distance {p.object_distance_m:.3g} m, reflected "
            f"{p.reflected_temperature_K - ZERO_CELSIUS_K:.2f} degC, air {p.atmospheric_temperature_K - ZERO_CELSIUS_K:.2f} degC, "
            f"relative humidity {p.relative_humidity:.0%}, window transmission {p.window_transmission:.3g}",
            f"  R1 {p.planck_r1:.9g}, B {p.planck_b:.7g}, F {p.planck_f:.7g}, O {p.planck_o:g}, R2 {p.planck_r2:.8g}",
            f"  temperature {self.lowest_degC:.2f} to {self.highest_degC:.2f} degC, mean {self.mean_degC:.2f} degC "
            f"({self.frames_read} of {len(self.frames)} frames read)",
        ]
        if rate_Hz := first.settings.frame_rate_Hz:
            lines.append(f"  frame rate {rate_Hz:g} Hz, focus {first.settings.focus_distance_m:.3g} m")
        if housekeeping:
            lines.append(f"  inside the camera, degC: {housekeeping}")
        lines += [f"  note: {note}" for note in dict.fromkeys(note for frame in self.frames for note in frame.notes)]
        return lines + [f"  warning: {each.message} {each.remedy}" for each in self.warnings]


def is_flir_file(path: Path) -> bool:
    """Return whether a run reads a file as one of FLIR: it starts as a JPEG or an FFF record, and no plug-in recognises it."""
    with Path(path).open("rb") as file:
        start = file.read(START_BYTES)
    return FlirReader().recognises(path, start) and not any(reader.recognises(path, start) for reader in plug_ins())


def inspect_file(path: str | os.PathLike[str]) -> FlirInspection:
    """Read the headers of a FLIR file and the pixels of up to 32 frames, and check them for implausible or damaged content.

    Parameters
    ----------
    path : str or path-like
        Radiometric JPEG, SEQ, CSQ or FFF file.

    Returns
    -------
    FlirInspection
        Frames, camera, parameters, temperature range (degC) and warnings; its method `lines` gives them as text.

    Raises
    ------
    FlirFormatError
        Where no frame can be read.

    Notes
    -----
    Checked are the time, the camera, the camera parameters (zero or swapped units, values outside their range, values that vary), the
    checksums of the records, counts outside the calibrated range, and a stored atmospheric transmission that disagrees with distance,
    humidity and air temperature.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from thermography.io.flir_writer import write_jpeg
    >>> from thermography.io.frame import CameraParameters
    >>> sc660 = CameraParameters(
    ...     0.95, 0.0, 293.15, 293.15, 293.15, 1.0, 0.0, 0.5, 21106.77, 1501.0, 1.0, -7340.0, 0.012545258,
    ...     0.006569, 0.01262, -0.002276, -0.00667, 1.9,
    ... )
    >>> with TemporaryDirectory() as folder:
    ...     write_jpeg(Path(folder, "a.jpg"), np.array([[18000, 18500]], np.uint16), sc660, "2026-03-09T06:33:47")
    ...     inspection = inspect_file(Path(folder, "a.jpg"))
    >>> round(inspection.mean_degC, 2), inspection.warnings[0].message
    (24.6, 'distance 0 m: the atmosphere is not corrected.')
    """
    path = Path(path)
    references, rejected = index_frames([path])
    if not references:
        raise FlirFormatError(rejected[0].reason)
    count = max(1, min(_FRAMES_READ, _PIXELS_READ // int(references.shapes().prod(axis=1).max())))
    chosen = np.unique(np.linspace(0, len(references) - 1, count).round().astype(int))
    frames: list[Frame] = []
    warnings: list[FileWarning] = []
    for index in chosen:
        try:
            frames.append(references[index].read())
            warnings += _check_checksums(references[index])
        except FlirFormatError as error:
            rejected.append(RejectedFrame(path, references[index].index, str(error)))
    warnings = [
        *(_warning("frame_left_out", f"{each.reason}.") for each in rejected),
        *_check_times(references),
        *_check_parameters(references, ()),
        *warnings,
        *_check_pixels(frames),
        *(_check_transmission(frames[0]) if frames else ()),
    ]
    return FlirInspection(path, tuple(references), tuple(rejected), *_range_degC(frames), len(frames), tuple(warnings))


def describe_stack(path: Path) -> list[str]:
    """Return the content of a file of temperatures as lines of text, and the remarks on it."""
    reader = find_reader(path)
    if not isinstance(reader, TemperatureReader):
        raise ThermographyError(f"{path}: not a known file of temperatures; docs/formats.md lists them")
    # A scale of one and an offset of nothing would be asked for; the values are shown as they are stored.
    stored = StackOptions(scale=np.nextafter(1.0, 2.0))
    contents = reader.frame_contents(path, stored)
    rows, columns = contents.shape
    count = f"{contents.frames} frames" if contents.frames > 1 else "1 frame"
    values = np.asarray(reader.read_values(path, 0, stored), float)
    finite = values[np.isfinite(values)]
    span = f"{finite.min():.6g} to {finite.max():.6g}" if finite.size else "no number"
    lines = [
        f"{path}: {reader.name}, {count} of {columns} x {rows}",
        f"  values of the first frame {span} {contents.unit}".rstrip(),
    ]
    if finite.size < values.size:
        lines.append(f"  {values.size - finite.size} of {values.size} pixels of the first frame are not numbers")
    if contents.times is not None:
        lines.append(f"  {contents.times[0]} to {contents.times[-1]} {'UTC' if contents.zoned else 'without zone'}")
    missing = [] if contents.unit else ["unit"]
    missing += [] if contents.times is not None else ["time_in_name, times, or start and interval"]
    return lines + ([f"  state under [thermography.stack]: {'; '.join(missing)}"] if missing else [])


def thumbnail(path: Path) -> bytes:
    """Return a small picture of the first frame."""
    counts = read_frame(path).counts.astype(np.float32)
    low, high = np.percentile(counts, (1, 99))
    grey = np.clip((counts - low) * (255 / max(high - low, 1)), 0, 255).astype(np.uint8)
    scale = min(1.0, _THUMBNAIL_WIDTH / grey.shape[1])
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".png", cv2.applyColorMap(small, cv2.COLORMAP_INFERNO))[1].tobytes()


def _range_degC(frames: Sequence[Frame]) -> tuple[float, float, float]:
    """Return lowest, highest and mean temperature, degC; NaN where no frame gives a temperature."""
    ranges = []
    for frame in frames:
        with suppress(RadiometryError):
            temperature = calibrate(frame.counts, frame.parameters)
            valid = temperature[np.isfinite(temperature)]
            if valid.size:
                ranges.append((valid.min(), valid.max(), valid.mean(dtype=np.float64)))
    if not ranges:
        return (float("nan"),) * 3
    low, high, mean = np.transpose(ranges)
    return float(low.min()), float(high.max()), float(mean.mean())


def _warning(code: str, message: str) -> FileWarning:
    return FileWarning(code, message, _REMEDIES[code])


def check_series(references: Sequence[FrameReference], *, overridden: Collection[str] = ()) -> list[FileWarning]:
    """Check the settings that the frames of one series store, without reading a pixel."""
    if not references:
        return []
    cameras = [each for each in _check_times(references) if each.code in ("several_cameras", "several_lenses")]
    return [*cameras, *_check_parameters(references, overridden)]


def _check_times(references: Sequence[FrameReference]) -> Iterator[FileWarning]:
    """Warn about missing or implausible times, and about frames of several cameras or lenses."""
    without = sum(bool(np.isnat(frame.time)) for frame in references)
    if without:
        yield _warning("no_time", f"{without} frames have no time.")
    first = references[0].time
    if not np.isnat(first) and first < np.datetime64(f"{_OLDEST_YEAR}-01-01"):
        yield _warning("clock_not_set", f"the clock of the camera was at {first}.")
    identities = {frame.camera for frame in references}
    cameras = {(each.model, each.serial) for each in identities}
    lenses = {(each.lens_model, each.lens_part, each.lens_serial, each.field_of_view_deg) for each in identities}
    if len(cameras) > 1:
        yield _warning("several_cameras", f"the file holds frames of {len(cameras)} cameras.")
    elif len(lenses) > 1:
        yield _warning("several_lenses", f"the frames were taken through {len(lenses)} lenses.")


def _check_parameters(references: Sequence[FrameReference], overridden: Collection[str]) -> Iterator[FileWarning]:
    """Warn about implausible parameters that are not overridden."""
    p, sets = references[0].parameters, {frame.parameters for frame in references}
    stored = [each.name for each in fields(p) if each.name not in overridden]
    varying = [name for name in stored if len({getattr(each, name) for each in sets}) > 1]
    if varying:
        yield _warning("parameters_vary", f"parameters differ between the frames: {', '.join(varying)}.")
    for name in ("reflected_temperature_K", "atmospheric_temperature_K"):
        value, key = getattr(p, name), name.removesuffix("_K")
        quantity, celsius = key.replace("_", " "), value - ZERO_CELSIUS_K
        if name in overridden:
            continue
        if not value > 150:
            message = f"{quantity} {value:g} K: probably degC stored as K."
            yield FileWarning("celsius_as_kelvin", message, f"Give {key}.")
        elif celsius > 150:
            message = f"{quantity} {celsius:.0f} degC: probably K stored as degC."
            yield FileWarning("kelvin_as_celsius", message, f"Give {key}.")
    if "emissivity" in stored and not 0 < p.emissivity < 1:
        yield _warning("emissivity", f"emissivity {p.emissivity:g} is not physical.")
    if "object_distance_m" in stored and p.object_distance_m <= 0:
        yield _warning("distance_zero", f"distance {p.object_distance_m:g} m: the atmosphere is not corrected.")
    if "relative_humidity" in stored and not 0 < p.relative_humidity <= 1:
        yield _warning("humidity", f"relative humidity {p.relative_humidity:g}.")
    if any("percent" in note for note in references[0].notes):
        yield _warning("humidity_percent", "relative humidity was stored in percent.")
    if min(p.planck_r1, p.planck_b, p.planck_r2) <= 0:
        yield _warning("not_calibrated", "the Planck constants are not positive.")


def _check_checksums(frame: FrameReference) -> Iterator[FileWarning]:
    """Warn about records that differ from their checksum."""
    if kinds := frame.damaged_records():
        names = ", ".join(f"0x{kind:02X}" for kind in kinds)
        yield _warning("checksum", f"frame {frame.index}: records {names} differ from their checksum.")


def _check_pixels(frames: Sequence[Frame]) -> Iterator[FileWarning]:
    """Warn about counts outside the calibrated range, and about frames of one constant value."""
    above = [np.mean(frame.counts >= (frame.limits.raw_maximum or 65535)) for frame in frames]
    below = [np.mean(frame.counts <= frame.limits.raw_minimum) for frame in frames]
    for code, limit, shares in (
        ("saturated", "at or above the upper", above),
        ("under_range", "at or below the lower", below),
    ):
        if (most := max(shares, default=0)) > 0:
            share = f"{most:.2%}" if most >= 1e-4 else f"{most:.1e}"
            yield _warning(
                code, f"up to {share} of the pixels of a frame are {limit} limit of the calibrated range of the camera."
            )
    outside_share = max((share_outside_range(frame) for frame in frames), default=0.0)
    if outside_share > 0:
        low, high = (limit - ZERO_CELSIUS_K for limit in (frames[0].limits.minimum_K, frames[0].limits.maximum_K))
        of_pixels = f"up to {outside_share:.2%} of the pixels of a frame are outside the calibrated range of "
        yield _warning("outside_range", f"{of_pixels}{low:.0f} to {high:.0f} degC.")
    if any(frame.counts.min() == frame.counts.max() for frame in frames):
        yield _warning("no_content", "a frame has the same count in all pixels.")


def _check_transmission(frame: Frame) -> Iterator[FileWarning]:
    """Warn where the stored transmission disagrees with distance, humidity and air temperature, and quantify its effect."""
    p, mean = frame.parameters, frame.counts.mean()
    if p.stored_transmission <= 0:
        return
    with suppress(RadiometryError):
        stored = float(temperature_from_counts(mean, p))
        calculated = float(temperature_from_counts(mean, override(p, stored_transmission=0.0)))
        if abs(stored - calculated) > 0.01:
            yield _warning(
                "stored_transmission",
                f"the file stores a transmission of {p.stored_transmission:.4f}, but distance and humidity give "
                f"{path_transmission(p):.4f}; the stored one is used and changes the mean by {stored - calculated:+.2f} K.",
            )
