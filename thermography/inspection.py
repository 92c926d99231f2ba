"""What a FLIR file holds, in facts and in lines, with a warning for everything that looks wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np

from thermography.io.flir import FrameReference, Rejected, index_frames, read_frame
from thermography.io.frame import CameraParameters, FlirFormatError, Frame
from thermography.radiometry.planck import (
    ZERO_CELSIUS_K,
    RadiometryError,
    calibrate,
    override,
    path_transmission,
    temperature_from_counts,
)

#: Frames whose pixels are read, spread over the file; a day of video must not take a day to inspect.
_FRAMES_LOOKED_AT = 32
#: Bolometer cameras with these files appeared after this year; an older date is a clock that was never set.
_OLDEST_YEAR = 2001
_THUMBNAIL_WIDTH = 320


@dataclass(frozen=True)
class Warned:
    """Something that looks wrong: a code, what was seen, and what to do."""

    code: str
    message: str
    remedy: str


@dataclass(frozen=True)
class Inspection:
    """Facts about one FLIR file.

    Attributes
    ----------
    path : Path
    frames : tuple of FrameReference
        In time order.
    rejected : tuple of Rejected
    lowest_degC, highest_degC, mean_degC : float
        Over the frames that were looked at; NaN where the parameters give no temperature.
    looked_at : int
        Number of frames whose pixels were read.
    warnings : tuple of Warned
    """

    path: Path
    frames: tuple[FrameReference, ...]
    rejected: tuple[Rejected, ...]
    lowest_degC: float
    highest_degC: float
    mean_degC: float
    looked_at: int
    warnings: tuple[Warned, ...]

    def lines(self) -> list[str]:
        """Return the facts as lines for a terminal."""
        first, last = self.frames[0], self.frames[-1]
        camera, p = first.camera, first.parameters
        rows, columns = first.shape
        count = f"{len(self.frames)} frames" if len(self.frames) > 1 else "1 frame"
        lens = f", lens {camera.lens_model}" if camera.lens_model else ""
        serial = f", serial {camera.serial}" if camera.serial else ""
        times = f"{first.time} UTC" if len(self.frames) == 1 else f"{first.time} to {last.time} UTC"
        zone = f"{first.utc_offset_minutes / 60:+g} h" if first.utc_offset_minutes else "UTC"
        inside = ", ".join(
            f"{name} {value - ZERO_CELSIUS_K:.1f}"
            for name, value in first.housekeeping.items()
            if abs(value - ZERO_CELSIUS_K) > 1e-3
        )
        lines = [
            f"{self.path}: FLIR, {count} of {columns} x {rows}, samples {first.samples.encoding}",
            f"  camera {camera.model or 'not named'}{serial}{lens}",
            f"  time {times} (camera set to {zone})",
            f"  emissivity {p.emissivity:.3g}, distance {p.object_distance_m:.3g} m, reflected "
            f"{p.reflected_temperature_K - ZERO_CELSIUS_K:.2f} degC, air {p.atmospheric_temperature_K - ZERO_CELSIUS_K:.2f} degC, "
            f"relative humidity {p.relative_humidity:.0%}, window transmission {p.window_transmission:.3g}",
            f"  R1 {p.planck_r1:.9g}, B {p.planck_b:.7g}, F {p.planck_f:.7g}, O {p.planck_o:g}, R2 {p.planck_r2:.8g}",
            f"  temperature {self.lowest_degC:.2f} to {self.highest_degC:.2f} degC, mean {self.mean_degC:.2f} degC "
            f"({self.looked_at} of {len(self.frames)} frames read)",
        ]
        if first.settings.frame_rate_Hz:
            lines.append(
                f"  frame rate {first.settings.frame_rate_Hz:g} Hz, focus {first.settings.focus_distance_m:.3g} m"
            )
        if inside:
            lines.append(f"  inside the camera, degC: {inside}")
        lines += [f"  note: {note}" for note in dict.fromkeys(note for frame in self.frames for note in frame.notes)]
        return lines + [f"  warning: {each.message} {each.remedy}" for each in self.warnings]


def is_flir_file(path: Path) -> bool:
    """Whether a file starts like a JPEG or an FFF record."""
    with Path(path).open("rb") as file:
        start = file.read(4)
    return start[:2] == b"\xff\xd8" or start == b"FFF\0"


def inspect_file(path: Path) -> list[str]:
    """Return what a FLIR file holds, as lines; see `inspect`."""
    return inspect(path).lines()


def inspect(path: Path) -> Inspection:
    """Read the headers of a FLIR file and the pixels of some of its frames, and look for what is wrong.

    Parameters
    ----------
    path : path of an R-JPEG, SEQ, CSQ or FFF file

    Returns
    -------
    Inspection

    Raises
    ------
    FlirFormatError
        Where no frame can be read.
    """
    path = Path(path)
    references, rejected = index_frames([path])
    if not references:
        raise FlirFormatError(rejected[0].reason)
    chosen = np.unique(np.linspace(0, len(references) - 1, _FRAMES_LOOKED_AT).round().astype(int))
    frames = []
    for index in chosen:
        try:
            frames.append(references[index].read())
        except FlirFormatError as error:
            rejected.append(Rejected(path, references[index].index, str(error)))
    lowest, highest, mean = _temperature_range(frames)
    warnings = [
        *(_warned_rejected(rejected)),
        *(_warned_times(references)),
        *(_warned_parameters(references[0].parameters, references)),
        *(_warned_damage([references[index] for index in chosen])),
        *(_warned_pixels(frames)),
        *(_warned_transmission(frames[:1])),
    ]
    return Inspection(path, tuple(references), tuple(rejected), lowest, highest, mean, len(frames), tuple(warnings))


def thumbnail(path: Path) -> bytes:
    """Return a small PNG of the first frame, stretched from its 1st to its 99th percentile; dark is cold."""
    counts = read_frame(path).counts.astype(np.float32)
    low, high = np.percentile(counts, (1, 99))
    grey = np.clip((counts - low) * (255 / max(high - low, 1)), 0, 255).astype(np.uint8)
    scale = min(1.0, _THUMBNAIL_WIDTH / grey.shape[1])
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    encoded: bytes = cv2.imencode(".png", cv2.applyColorMap(small, cv2.COLORMAP_INFERNO))[1].tobytes()
    return encoded


def _temperature_range(frames: Sequence[Frame]) -> tuple[float, float, float]:
    """Return lowest, highest and mean temperature, degC."""
    ranges = []
    for frame in frames:
        try:
            temperature = calibrate(frame.counts, frame.parameters)
        except RadiometryError:
            continue
        valid = temperature[np.isfinite(temperature)]
        if valid.size:
            ranges.append((valid.min(), valid.max(), valid.mean(dtype=np.float64)))
    if not ranges:
        return (float("nan"),) * 3
    low, high, mean = np.transpose(ranges)
    return float(low.min()), float(high.max()), float(mean.mean())


def _warned_rejected(rejected: Sequence[Rejected]) -> Iterator[Warned]:
    for each in rejected:
        yield Warned("frame_left_out", f"{each.reason}.", "Copy the file from the camera again if the frame matters.")


def _warned_times(references: Sequence[FrameReference]) -> Iterator[Warned]:
    without = sum(bool(np.isnat(frame.time)) for frame in references)
    if without:
        yield Warned("no_time", f"{without} frames have no time.", "They cannot be matched with laser readings.")
    first = references[0].time
    if not np.isnat(first) and first < np.datetime64(f"{_OLDEST_YEAR}-01-01"):
        yield Warned(
            "clock_not_set",
            f"the camera's clock says {first}.",
            "Set it, or give thermography.clock_offset in the campaign.",
        )
    cameras = {(frame.camera.model, frame.camera.serial) for frame in references}
    if len(cameras) > 1:
        yield Warned(
            "several_cameras", f"frames of {len(cameras)} cameras.", "Keep each camera's frames in its own file."
        )


def _warned_parameters(p: CameraParameters, references: Sequence[FrameReference]) -> Iterator[Warned]:
    """Warn of parameters that no one can have meant."""
    varying = [
        each.name for each in fields(p) if len({getattr(frame.parameters, each.name) for frame in references}) > 1
    ]
    if varying:
        yield Warned(
            "parameters_vary",
            f"not the same in all frames: {', '.join(varying)}.",
            "Override them if the scene did not change.",
        )
    for name in ("reflected_temperature_K", "atmospheric_temperature_K"):
        value, what = getattr(p, name), name.removesuffix("_K").replace("_", " ")
        if not value > 150:
            yield Warned(
                "celsius_as_kelvin",
                f"{what} {value:g} K looks like degC stored as K.",
                f"Give {what.replace(' ', '_')}.",
            )
        elif value - ZERO_CELSIUS_K > 150:
            yield Warned(
                "kelvin_as_celsius",
                f"{what} {value - ZERO_CELSIUS_K:.0f} degC looks like K stored as degC.",
                f"Give {what.replace(' ', '_')}.",
            )
    if not 0 < p.emissivity < 1:
        yield Warned("emissivity", f"emissivity {p.emissivity:g} is no real surface's.", "Give emissivity.")
    if p.object_distance_m <= 0:
        yield Warned(
            "distance_zero", f"distance {p.object_distance_m:g} m: no air is corrected.", "Give object_distance."
        )
    if not 0 < p.relative_humidity <= 1:
        yield Warned("humidity", f"relative humidity {p.relative_humidity:g}.", "Give relative_humidity as a fraction.")
    if references[0].notes and any("percent" in note for note in references[0].notes):
        yield Warned("humidity_percent", "relative humidity was stored in percent.", "It was divided by 100.")
    if min(p.planck_r1, p.planck_b, p.planck_r2) <= 0:
        yield Warned("not_calibrated", "the Planck constants are not positive.", "Only counts can be used.")


def _warned_damage(references: Sequence[FrameReference]) -> Iterator[Warned]:
    """Warn of records that differ from their checksum."""
    for frame in references:
        if kinds := frame.damaged_records():
            names = ", ".join(f"0x{kind:02X}" for kind in kinds)
            yield Warned(
                "checksum",
                f"frame {frame.index}: records {names} differ from their checksum.",
                "Something changed the file after the camera wrote it; compare it with the original.",
            )


def _warned_pixels(frames: Sequence[Frame]) -> Iterator[Warned]:
    """Warn of counts outside the calibrated range, and of pictures without content."""
    for code, label in (("saturated", "at or above"), ("under_range", "at or below")):
        shares = []
        for frame in frames:
            limits = frame.limits
            limit = limits.raw_maximum if code == "saturated" else limits.raw_minimum
            outside = frame.counts >= (limit or 65535) if code == "saturated" else frame.counts <= limit
            shares.append(outside.mean())
        if max(shares, default=0) > 0:
            share = f"{max(shares):.2%}" if max(shares) >= 1e-4 else f"{max(shares):.1e}"
            yield Warned(
                code,
                f"up to {share} of the pixels lie {label} the calibrated range of the camera.",
                "Choose another range.",
            )
    outside_degC = max((_share_outside(frame) for frame in frames), default=0.0)
    if outside_degC > 0:
        limits = frames[0].limits
        yield Warned(
            "outside_range",
            f"up to {outside_degC:.2%} of the pixels lie outside the camera's range of "
            f"{limits.minimum_K - ZERO_CELSIUS_K:.0f} to {limits.maximum_K - ZERO_CELSIUS_K:.0f} degC.",
            "Their temperatures are not calibrated.",
        )
    if any(frame.counts.min() == frame.counts.max() for frame in frames):
        yield Warned(
            "no_content", "a frame has the same count everywhere.", "The shutter was closed, or the frame is broken."
        )


def _share_outside(frame: Frame) -> float:
    """Return the share of pixels outside the temperatures for which the camera is calibrated."""
    limits = frame.limits
    if not limits.maximum_K > limits.minimum_K > 0:
        return 0.0
    try:
        kelvin = calibrate(frame.counts, frame.parameters) + ZERO_CELSIUS_K
    except RadiometryError:
        return 0.0
    return float(np.mean(~((kelvin >= limits.minimum_K) & (kelvin <= limits.maximum_K))))


def _warned_transmission(frames: Sequence[Frame]) -> Iterator[Warned]:
    """Warn where the stored transmission is not what distance and humidity give, with its effect on the mean."""
    for frame in frames:
        p = frame.parameters
        if p.stored_transmission <= 0:
            continue
        mean = frame.counts.mean()
        try:
            stored = float(temperature_from_counts(mean, p))
            calculated = float(temperature_from_counts(mean, override(p, stored_transmission=0.0)))
        except RadiometryError:
            continue
        if abs(stored - calculated) > 0.01:
            yield Warned(
                "stored_transmission",
                f"the file stores a transmission of {p.stored_transmission:.4f} where distance and humidity give "
                f"{path_transmission(p):.4f}; the stored one is used and changes the mean by {stored - calculated:+.2f} K.",
                "Give object_distance to calculate it instead.",
            )
