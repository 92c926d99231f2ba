"""Summarises the content of a FLIR file and warns about everything in it that is implausible or damaged."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermofuse.resources import vocabulary
from thermography.common import ThermographyError
from thermography.evaluation import RegionTable, measures_temperature, tabulate_regions
from thermography.io.flir import FlirFrameReference, index_frames
from thermography.io.frame import CalibratedRange, CameraParameters, FlirFormatError, FrameReference, RejectedFrame
from thermography.io.other_cameras import Stack
from thermography.radiometry.planck import (
    ZERO_CELSIUS_K,
    RadiometryError,
    check_parameters,
    counts_from_temperature,
    override,
    path_transmission,
    temperature_from_counts,
)

#: Bolometer cameras with these file formats appeared after this year; an earlier date means that the clock was never set.
_OLDEST_YEAR = 2001
#: Code of a warning -> what to do about it.
_REMEDIES = vocabulary("frames")["remedies"]


@dataclass(frozen=True)
class FileWarning:
    """An implausible or damaged part of a file: a code such as "saturated", what was found, and what to do about it."""

    code: str
    message: str
    remedy: str


@dataclass(frozen=True)
class FlirInspection:
    """Content of one FLIR file: usable frames in order of time, rejected ones, maximum, minimum and mean of every frame and of the regions
    that it stores (see `thermography.evaluation.evaluate_regions`; None where the parameters give no temperature), and everything that is
    implausible or damaged.
    """

    path: Path
    frames: tuple[FrameReference, ...]
    rejected: tuple[RejectedFrame, ...]
    evaluation: RegionTable | None
    warnings: tuple[FileWarning, ...]

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """Return the content as lines of text, the warnings last."""
        first, last = self.frames[0], self.frames[-1]
        p = first.parameters
        rows, columns = first.shape
        count = f"{len(self.frames)} frames" if len(self.frames) > 1 else "1 frame"
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
            f"  {describe_camera(self.frames[:1])}",
            f"  time {times} (camera set to {zone})",
            f"  {describe_scene(p)}, window transmission {p.window_transmission:.3g}",
            f"  R1 {p.planck_r1:.9g}, B {p.planck_b:.7g}, F {p.planck_f:.7g}, O {p.planck_o:g}, R2 {p.planck_r2:.8g}",
            *(f"  {line}" for line in describe_evaluation(self.evaluation)),
        ]
        if rate_Hz := first.settings.frame_rate_Hz:
            # 0 and 0xFFFFFFFF mm stand for a distance that the camera does not know.
            focus_m = first.settings.focus_distance_m
            known = f", focus {focus_m:.3g} m" if 0.0 < focus_m < 4.29e6 else ""
            lines.append(f"  frame rate {rate_Hz:g} Hz{known}")
        if housekeeping:
            lines.append(f"  inside the camera, °C: {housekeeping}")
        lines += [f"  note: {note}" for note in dict.fromkeys(note for frame in self.frames for note in frame.notes)]
        return lines + [f"  warning: {each.message} {each.remedy}" for each in self.warnings]


def inspect_file(path: str | os.PathLike[str]) -> FlirInspection:
    """Evaluate all frames of a FLIR file, and check them for implausible or damaged content.

    Parameters
    ----------
    path : str or path-like
        Radiometric JPEG, SEQ, CSQ or FFF file.

    Returns
    -------
    FlirInspection
        Frames, camera, parameters, temperatures of the picture and of stored regions, and warnings; its method `lines` gives them as text.

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
    >>> from thermofuse.resources import resource
    >>> inspection = inspect_file(resource("samples/frame.jpg"))
    >>> float(inspection.evaluation.columns["mean"][0, 0].round(2)), inspection.warnings
    (23.55, ())
    """
    path = Path(path)
    references, rejected = index_frames([path])
    if not references:
        raise FlirFormatError(rejected[0].reason)
    evaluation = None
    try:
        check_parameters(references[0].parameters)
        evaluation = tabulate_regions(references)
        rejected += evaluation.rejected
    except RadiometryError:
        pass  # `_check_parameters` names what is wrong
    except ThermographyError as error:
        rejected.append(RejectedFrame(path, 0, str(error)))
    warnings = [
        *(_warning("frame_left_out", f"{each.reason}.") for each in rejected),
        *_check_times(references),
        *_check_parameters(references, ()),
        *_check_checksums(references),
        *(_check_pixels(evaluation) if evaluation else ()),
        *(_check_transmission(evaluation) if evaluation else ()),
    ]
    return FlirInspection(path, tuple(references), tuple(rejected), evaluation, tuple(warnings))


def describe_camera(frames: Sequence[FrameReference]) -> str:
    """Say which camera, with serial number and lenses, recorded frames."""
    camera = frames[0].camera
    lenses = " and ".join(sorted({frame.camera.lens_model for frame in frames} - {""}))
    return f"camera {camera.model or 'unknown'}{f', serial {camera.serial}' if camera.serial else ''}{f', lens {lenses}' if lenses else ''}"


def describe_scene(p: CameraParameters) -> str:
    """Say what a camera was told of the scene."""
    return (
        f"emissivity {p.emissivity:.3g}, distance {p.object_distance_m:.3g} m, reflected "
        f"{p.reflected_temperature_K - ZERO_CELSIUS_K:.2f} °C, air {p.atmospheric_temperature_K - ZERO_CELSIUS_K:.2f} °C, "
        f"relative humidity {p.relative_humidity:.0%}"
    )


def describe_range(limits: CalibratedRange) -> str:
    """Say within which readings of a black body a camera is calibrated."""
    if not limits.in_kelvin:
        return "calibrated range not stored"
    low, high = (round(kelvin - ZERO_CELSIUS_K) for kelvin in (limits.minimum_K, limits.maximum_K))
    return f"calibrated range {low} to {high} °C (readings of a black body)"


def describe_evaluation(evaluation: RegionTable | None) -> list[str]:
    """Say the calibrated range, and highest, lowest and mean temperature of every region over all frames, camera by camera."""
    if evaluation is None:
        return ["temperature cannot be determined from the stored parameters"]
    cameras = np.array(evaluation.cameras, object)
    several = list(dict.fromkeys(cameras))
    lines = []
    for camera in several:
        rows = np.flatnonzero(cameras == camera)
        first = evaluation.headers[rows[0]]
        if len(several) > 1:
            lines.append(f"{camera or 'unknown camera'}, {len(rows)} {'frame' if len(rows) == 1 else 'frames'}:")
        if not measures_temperature(first.camera):
            lines.append("no temperature is stated, because the camera is not calibrated")
            continue
        lines += dict.fromkeys(describe_range(evaluation.headers[row].limits) for row in rows)
        for place, (name, kind) in enumerate(evaluation.kinds.items()):
            shown = rows[evaluation.columns["pixels"][rows, place] > 0]
            if shown.size:
                lines.append(f"{name}: {_describe_region(evaluation, shown, place, kind)}")
    return [
        *lines,
        "places: column,row in pixels; u: standard uncertainty for a painted surface and a camera of ± 2 K or ± 2 %",
    ]


def _describe_region(evaluation: RegionTable, rows: NDArray[np.intp], place: int, kind: str) -> str:
    """Say the extremes and the mean of one region in some frames."""
    values = {name: column[rows, place] for name, column in evaluation.columns.items()}
    # Of frames whose extreme is the limit of the range, the one with most pixels beyond it.
    hottest = int(np.lexsort((-values["overrange"], -values["maximum"]))[0])
    coldest = int(np.lexsort((-values["underrange"], values["minimum"]))[0])

    def when(one: int) -> str:
        if len(rows) == 1:
            return ""
        frame = evaluation.headers[rows[one]]
        one_file = len({header.path for header in evaluation.headers}) == 1
        time = "" if np.isnat(frame.time) else f", {np.datetime_as_string(frame.time, unit='s')} UTC"
        return f" in {f'frame {frame.index}' if one_file else frame.path.name}{time}"

    def extreme(name: str, one: int, word: str, beyond: str) -> str:
        outside = int(values[beyond][one])
        u = values[f"{name}_u"][one]
        told = f"{values[name][one]:.1f} °C"
        if outside:
            told = f"{word} {told} ({outside} of {values['pixels'][one]} pixels {beyond})"
        elif np.isfinite(u):
            told += f" (u {u:.1f} K)"
        return f"{told} at {values[f'{name}_column'][one]},{values[f'{name}_row'][one]}{when(one)}"

    highest = extreme("maximum", hottest, "at least", "overrange")
    if kind == "spot" and len(rows) == 1:
        return highest
    weights = values["pixels"] - values["overrange"] - values["underrange"]
    inside = weights > 0
    mean = (
        f"{np.average(values['mean'][inside], weights=weights[inside]):.1f} °C"
        if inside.any()
        else "none within the range"
    )
    if len(rows) == 1 and inside.any():
        mean += f" (u {values['mean_u'][0]:.1f} K), standard deviation {values['standard_deviation'][0]:.1f} K"
    return f"maximum {highest}; minimum {extreme('minimum', coldest, 'at most', 'underrange')}; mean {mean}"


def describe_stack(stack: Stack) -> list[str]:
    """Return the content of a file of temperatures as lines of text, and the remarks on it."""
    contents, values = stack.contents, np.asarray(stack.first, float)
    rows, columns = contents.shape
    count = f"{contents.frames} frames" if contents.frames > 1 else "1 frame"
    finite = values[np.isfinite(values) & (values >= -ZERO_CELSIUS_K)]
    span = f"{finite.min():.6g} to {finite.max():.6g}" if finite.size else "no number"
    lines = [
        f"{stack.reader.name}, {count} of {columns} x {rows}",
        f"values of the first frame {span} {contents.unit}".rstrip(),
    ]
    if finite.size < values.size:
        lines.append(f"{values.size - finite.size} of {values.size} pixels of the first frame hold no temperature")
    lines += contents.notes
    if contents.emissivity is not None:
        lines.append(f"calculated with the emissivity {contents.emissivity:g}")
    if contents.times is not None:
        lines.append(f"{contents.times[0]} to {contents.times[-1]} {'UTC' if contents.zoned else 'without zone'}")
    missing = [] if contents.unit else ["unit"]
    if contents.times is None:
        series = "" if contents.frames > 1 else "of a series "
        missing.append(f"{series}time_in_name, times, or start and interval")
    return lines + ([f"state under [thermography.stack]: {'; '.join(missing)}"] if missing else [])


def _warning(code: str, message: str) -> FileWarning:
    return FileWarning(code, message, _REMEDIES[code])


def check_series(references: Sequence[FrameReference], *, overridden: Collection[str] = ()) -> list[FileWarning]:
    """Check the settings that the frames of one series store, without reading a pixel."""
    if not references:
        return []
    cameras = [
        each
        for each in _check_times(references)
        if each.code in ("several_cameras", "several_lenses", "not_radiometric")
    ]
    return [*cameras, *_check_parameters(references, overridden)]


def _check_times(references: Sequence[FrameReference]) -> Iterator[FileWarning]:
    """Warn about missing or implausible times, about frames of several cameras or lenses, and of cameras that do not measure."""
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
    for model in sorted({each.model for each in identities if not measures_temperature(each)}):
        yield _warning("not_radiometric", f"the {model} is not calibrated: its temperatures mean nothing.")


def _check_parameters(references: Sequence[FrameReference], overridden: Collection[str]) -> Iterator[FileWarning]:
    """Warn about implausible parameters that are not overridden."""
    p, sets = references[0].parameters, {frame.parameters for frame in references}
    stored = [each.name for each in fields(p) if each.name not in overridden]
    one_camera = len({frame.camera.serial for frame in references}) == 1
    varying = [
        name
        for name in stored
        # Each camera has its own calibration.
        if len({getattr(each, name) for each in sets}) > 1
        and (one_camera or not name.startswith(("planck", "atmosphere_")))
    ]
    if varying:
        ends = [(name, *(f"{of({getattr(each, name) for each in sets}):g}" for of in (min, max))) for name in varying]
        named = ", ".join(f"{name} ({low} to {high})" for name, low, high in ends)
        yield _warning("parameters_vary", f"parameters differ between the frames: {named}.")
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


def _check_checksums(references: Sequence[FrameReference]) -> Iterator[FileWarning]:
    """Warn about headers that differ from their checksum."""
    if altered := [str(frame.index) for frame in references if frame.altered]:
        told = f"{altered[0]} to {altered[-1]}" if len(altered) > 1 else altered[0]
        yield _warning("checksum", f"the headers of {len(altered)} frames, {told}, differ from their checksums.")


def _check_pixels(evaluation: RegionTable) -> Iterator[FileWarning]:
    """Warn about pixels outside the calibrated range, and about frames of one constant value."""
    columns = {name: column[:, 0] for name, column in evaluation.columns.items()}
    for code, side in (("overrange", "above"), ("underrange", "below")):
        if (most := int(columns[code].argmax())) >= 0 and columns[code][most]:
            frames = int(np.count_nonzero(columns[code]))
            yield _warning(
                code,
                f"in {frames} of {len(columns[code])} frames pixels are {side} the calibrated range, up to {columns[code][most]} of "
                f"{columns['pixels'][most]}; they are in no mean, and an extreme among them is the limit of the range.",
            )
    inside = columns["pixels"] - columns["overrange"] - columns["underrange"]
    if ((columns["maximum"] == columns["minimum"]) & (inside > 1)).any():
        yield _warning("no_content", "a frame has the same count in all pixels.")


def _check_transmission(evaluation: RegionTable) -> Iterator[FileWarning]:
    """Warn where the stored transmission disagrees with distance, humidity and air temperature, and quantify its effect."""
    p, stored = evaluation.headers[0].parameters, float(evaluation.columns["mean"][0, 0])
    if p.stored_transmission <= 0 or not np.isfinite(stored):
        return
    with suppress(RadiometryError):
        calculated = float(
            temperature_from_counts(counts_from_temperature(stored, p), override(p, stored_transmission=0.0))
        )
        if abs(stored - calculated) > 0.01:
            yield _warning(
                "stored_transmission",
                f"the file stores a transmission of {p.stored_transmission:.4f}, but distance and humidity give "
                f"{path_transmission(p):.4f}; the stored one is used and changes the mean by {stored - calculated:+.2f} K.",
            )
