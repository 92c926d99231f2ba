"""Checks of the camera: times and settings that its frames store, what they show over the series, their registration."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.align import both_ends, covered_share, likely_zone_shift
from fusion.analysis.consistency.checks import CAMERA, CLOCK, Found, check, judge
from fusion.analysis.consistency.clocks import QUARTER_S, QUARTERS, TIMES, Evidence
from fusion.analysis.consistency.series import Motion
from fusion.common import Array
from fusion.results.axis import RegistrationPart
from fusion.results.parts import is_determined
from thermography.common import ThermographyError
from thermography.evaluation import share_outside_range, thermogram
from thermography.fields.objects import JUMP_K
from thermography.inspection import FileWarning, check_series
from thermography.io.frame import Frame, FrameReference
from thermography.large_arrays import piece_slices

# Checks of the times that the camera writes: order of the frames, rate of its clock, place in the motion of the axis.

#: Largest slip over the test, in cycles: a tenth of a cycle is what triggering by hand or by the axis makes.
_LARGEST_SLIP = 0.1
#: A shift by whole quarter hours counts as a wrong time zone where less than this share of the readings lies within the frames.
_COVERED_NOW = 0.6
#: Share of the frames that may be stamped while the axis was away from position 0.
_AWAY_SHARE = 0.5
#: Share of the steps from name to name that may go back in time before the names tell no order: nobody sets a clock at every fifth frame.
_SET_BACK_SHARE = 0.2
#: In the order of their times frames are regular where no step is shorter or longer than these multiples of the median: a clock that was
#: set back lays its frames between or upon those before.
_REGULAR_STEPS = (0.8, 3.0)
_NUMBERED = re.compile(r"(.*?)(\d+)\D*")


@check("source", CAMERA)
def camera_stamps(frames: Sequence[FrameReference]) -> Found | None:
    """Times of frames that go backwards from one to the next, within a file and between consecutively numbered files: none; where
    `_SET_BACK_SHARE` of the steps between files do, or the frames are regular in the order of their times, the files were renamed, and
    the times are taken.
    """
    timed = [frame for frame in frames if not np.isnat(frame.time)]
    if not timed:
        return None
    ordered = sorted(timed, key=lambda frame: (_numbered(frame.path), frame.index))
    steps = [(before, after) for before, after in itertools.pairwise(ordered) if _follows(before, after)]
    back = [(before, after) for before, after in steps if after.time < before.time]
    renamed = bool(back) and _renamed(back, len(steps), np.sort(np.array([frame.time for frame in timed])))
    first = [(before, after, (before.time - after.time) / np.timedelta64(1, "s")) for before, after in back[:3]]
    value = 0.0 if renamed else len(back)
    return judge(value, 0.0, renamed=renamed, back=len(back), steps=len(steps), first=first)


def _renamed(back: Sequence[tuple[FrameReference, FrameReference]], steps: int, times: NDArray[np.datetime64]) -> bool:
    """Whether it is the names that are out of order, not the clock: of files alone, many, or regular in the order of their times."""
    if any(before.path == after.path for before, after in back):
        return False
    if len(back) >= _SET_BACK_SHARE * steps and len(back) > 1:
        return True
    seconds = np.diff(times) / np.timedelta64(1, "s")
    low, high = (multiple * float(np.median(seconds)) for multiple in _REGULAR_STEPS)
    return bool(np.all((seconds >= low) & (seconds <= high)))


def _numbered(path: Path) -> tuple[str, str, int]:
    """Folder, stem and number of a file."""
    match = _NUMBERED.fullmatch(path.stem)
    return (str(path.parent), *((match.group(1), int(match.group(2))) if match else (path.stem, 0)))


def _follows(before: FrameReference, after: FrameReference) -> bool:
    if before.path == after.path:
        return after.index > before.index
    (folder, stem, number), (next_folder, next_stem, next_number) = _numbered(before.path), _numbered(after.path)
    return (folder, stem, number + 1) == (next_folder, next_stem, next_number)


@check("source", CLOCK, waits=True)
def camera_rate(motion: Motion) -> Found:
    """Gain of the camera's clock on the cycles, where every cycle has its frames at one place: slip over the test of at most
    `_LARGEST_SLIP` cycles.
    """
    limit = (
        3600.0 * _LARGEST_SLIP * motion.period_s / float(np.ptp(motion.seconds)) if motion.cycle_end.size > 1 else 0.0
    )
    slip_cycles, rate = motion.locked or (None, 0.0)
    return judge(rate, limit, passed=slip_cycles is None or abs(slip_cycles) <= _LARGEST_SLIP, slip_cycles=slip_cycles)


@check("source", CAMERA, waits=True)
def camera_phase(motion: Motion) -> Found:
    """Share of such frames of a still table that are stamped while the axis was away from position 0: at most `_AWAY_SHARE`."""
    away = 0.0 if motion.locked is None else motion.away_share()
    return judge(away, _AWAY_SHARE, testable=motion.locked is not None)


@check("source", CLOCK, waits=True)
def frames_coverage(frame_time: NDArray[np.datetime64], deviations: xr.Dataset, offset_s: float) -> Found:
    """Share of the readings between the first and the last frame: more than 0, and not below `_COVERED_NOW` where a shift by whole
    quarter hours covers all; else a contradiction.
    """
    readings = deviations["time"].values
    readings = readings[~np.isnat(readings)]
    covered, shift_s = covered_share(readings, frame_time), likely_zone_shift(readings, frame_time)
    zones = covered < _COVERED_NOW and shift_s is not None
    facts = {
        "ends": both_ends(frame_time, readings),
        "laser": deviations.attrs.get("source", "the laser"),
        "offset_s": offset_s,
    }
    passed = covered > 0.0 and not zones
    return judge(covered, _COVERED_NOW, passed=passed, contradicts=True, shift_s=shift_s if zones else None, **facts)


def compare_phase(motion: Motion | None) -> list[Evidence]:
    """Compare the stamps of the frames with the motion of the axis: what they say of the camera's clock."""
    if motion is None or motion.locked is None:
        return []
    away = np.array([motion.away_share(QUARTER_S * k) for k in QUARTERS]) / _AWAY_SHARE
    return [Evidence("laser", "camera", away, away, TIMES, "place in the cycle")]


#: Largest share of the pixels of a frame outside the range in which the camera is calibrated.
_OUTSIDE_SHARE = 0.01
#: The parameters of Planck's law that belong to a range of the camera.
_PLANCK = ("planck_r1", "planck_b", "planck_f", "planck_o", "planck_r2")
#: Share of the pixels that may jump where the camera switches its range by itself.
_SWITCHED_SHARE = 0.02
_CHANGING = ("parameters_vary", "several_cameras", "several_lenses", "range")


def file_warnings(frames: Sequence[FrameReference], *, overridden: Collection[str]) -> list[FileWarning]:
    """What is conspicuous in what the frames store of their measurement."""
    ranges = [(frame.limits.minimum_K, frame.limits.maximum_K) for frame in frames]
    switched = [place for place in range(1, len(frames)) if ranges[place] != ranges[place - 1]]
    continued = len(switched) == 1 and _continued(frames, switched[0])
    warnings = check_series(frames, overridden={*overridden, *(_PLANCK if continued else ())})
    if switched and not continued:
        warnings.append(
            FileWarning("range", f"the camera's range changes ({len({*ranges})} ranges).", "Use one range.")
        )
    return warnings


@check("source", CAMERA)
def camera_settings(file_warnings: Sequence[FileWarning]) -> Found:
    """Parameters, range, serial number and lens over the series, those stated in the campaign file left out: no change; one switch of the
    range is none where either range has its own parameters of Planck's law and the temperatures go on across it (`scene_change`).
    """
    return _collected([warning for warning in file_warnings if warning.code in _CHANGING])


@check("source", CAMERA)
def camera_parameters(file_warnings: Sequence[FileWarning]) -> Found:
    """Implausible stored parameters, those stated in the campaign file left out: none."""
    return _collected([warning for warning in file_warnings if warning.code not in _CHANGING])


def _continued(frames: Sequence[FrameReference], place: int) -> bool:
    """Whether each of two ranges has parameters of its own, by which the temperatures go on across the switch as before and after it."""
    of_range = [
        {tuple(getattr(one.parameters, name) for name in _PLANCK) for one in some}
        for some in (frames[:place], frames[place:])
    ]
    if [len(each) for each in of_range] != [1, 1] or of_range[0] == of_range[1] or not 2 <= place < len(frames) - 1:
        return False
    try:
        seen = [thermogram(frame)["temperature"].values for frame in frames[place - 2 : place + 2]]
        before, change, after = np.abs(np.diff(seen, axis=0))
    except (ThermographyError, ValueError):
        return False
    return float(np.mean(change > np.maximum(before, after) + JUMP_K)) <= _SWITCHED_SHARE


def _collected(warnings: Sequence[FileWarning]) -> Found:
    """One check of several warnings of one kind."""
    return judge(len(warnings), 0.0, warnings=warnings, remedies=dict.fromkeys(one.remedy for one in warnings))


@check("source", CAMERA)
def camera_range(frames: Sequence[FrameReference]) -> Found:
    """Pixels outside the calibrated range in the first, middle and last frame: at most `_OUTSIDE_SHARE`."""
    return judge(max([0.0, *(share_outside_range(frame) for frame in _spread(frames))]), _OUTSIDE_SHARE)


def _spread(frames: Sequence[FrameReference]) -> list[Frame]:
    """The first, the middle and the last frame with their pixels, as far as they are different frames and not damaged."""
    read = []
    for index in sorted({0, len(frames) // 2, len(frames) - 1}):
        try:
            read.append(frames[index].read())
        except ThermographyError:
            # A damaged frame is counted where the frames are reduced.
            continue
    return read


# Checks of what the frames show over the series: the place of the camera, frames left out, and parts of the table
# that change abruptly.

#: Largest share of the frames over which the registration may stay unchecked up to the end of the series or up to a knock.
_UNCHECKED_SHARE = 0.05
#: Largest lasting change of a moving table's place across its axis, mm: guideways err by hundredths.
_ACROSS_MM = 0.25
#: Fewest frames before and after such a change.
_ACROSS_FRAMES = 5
#: Largest share of the frames that may be left out: beyond it, most fields lie next to one that is missing.
_LEFT_OUT_SHARE = 1 / 3
#: Largest share of the frames that may hold the image of the frame before: single copies do little harm, a frozen camera does.
_REPEATED_SHARE = 0.05
#: A gap between frames is longer than this, s, half the time constant of an ordinary source of heat, ...
_GAP_S = 600.0
#: ... and than this multiple of the usual step.
_GAP_STEPS = 3.0
#: Largest share of the readings that may lie in gaps.
_GAP_SHARE = 0.1
_LEFT_OUT = ("frames_damaged", "frames_obstructed", "frames_shaken", "frames_unplaced")


@check("fields", CAMERA)
def camera_place(fields: xr.Dataset) -> Found | None:
    """Share of the frames in stretches after which nothing shows that the registration held ([registration.md](registration.md)): at most
    `_UNCHECKED_SHARE`; of a moving table, its lasting displacement across the axis: at most `_ACROSS_MM` mm.
    """
    if "frames_repeated" not in fields.attrs:
        return None
    if "table_across" in fields:
        return _across(fields)
    stretches, knocks = json.loads(fields.attrs["unchecked_stretches"]), json.loads(fields.attrs["knocks"])
    share = sum(stretch["frames"] for stretch in stretches) / _total(fields)
    return judge(share, _UNCHECKED_SHARE, stretches=stretches, knocks=len(knocks), across_mm=None)


@check("fields", CAMERA)
def frames_left_out(fields: xr.Dataset) -> Found | None:
    """Share of the frames that are damaged, displaced alone, do not show where a moving table is, or have something before it
    ([fields.md](fields.md)): at most a third.
    """
    if "frames_repeated" not in fields.attrs:
        return None
    counts, total = _counts(fields), _total(fields)
    return judge(sum(counts.values()) / total, _LEFT_OUT_SHARE, counts=counts, total=total)


@check("fields", CAMERA)
def frames_repeated(fields: xr.Dataset) -> Found | None:
    """Share of the frames that hold the image of the frame before: at most `_REPEATED_SHARE`."""
    if "frames_repeated" not in fields.attrs:
        return None
    repeated, total = json.loads(fields.attrs["frames_repeated"]), _total(fields)
    return judge(len(repeated) / total, _REPEATED_SHARE, repeated=repeated, total=total)


def _counts(fields: xr.Dataset) -> dict[str, int]:
    """How many frames were left out, by why."""
    return {name: len(json.loads(fields.attrs.get(name, "[]"))) for name in _LEFT_OUT}


def _total(fields: xr.Dataset) -> int:
    """All frames of a series, also those left out."""
    return int(fields["frame_count"].sum()) + sum(_counts(fields).values())


def find_gaps(frame_time: NDArray[np.datetime64]) -> list[tuple[np.datetime64, np.datetime64]]:
    """Find the gaps in the times of frames."""
    if frame_time.size < 2:
        return []
    seconds = np.diff(frame_time) / np.timedelta64(1, "s")
    longest = max(_GAP_S, _GAP_STEPS * float(np.median(seconds)))
    return [(frame_time[k], frame_time[k + 1]) for k in np.flatnonzero(seconds > longest)]


def in_gaps(readings: xr.DataArray, gaps: Sequence[tuple[np.datetime64, np.datetime64]]) -> xr.DataArray:
    """Tell which readings lie in gaps between frames."""
    inside = xr.zeros_like(readings, dtype=bool)
    for start, end in gaps:
        inside |= (readings > start) & (readings < end)
    return inside


def gap_words(gap: tuple[np.datetime64, np.datetime64]) -> str:
    """Return length, start and end of a gap as words."""
    minutes = (gap[1] - gap[0]) / np.timedelta64(60, "s")
    start, end = (np.datetime_as_string(time, unit="s") for time in gap)
    return f"{minutes:.0f} min from {start}Z to {end}Z"


def _across(fields: xr.Dataset) -> Found:
    """Largest lasting change of the place of a moving table across its axis: the axis cannot move it so, but a knock can."""
    across = fields["table_across"].dropna("frame_time")
    place, times = across.values, across["frame_time"].values
    parts = np.arange(_ACROSS_FRAMES, len(place) - _ACROSS_FRAMES + 1)
    change, since = 0.0, None
    if parts.size:
        # The division into two means that leaves the smallest squares.
        before = np.cumsum(place)[parts - 1] / parts
        after = (place.sum() - parts * before) / (len(place) - parts)
        at = int(parts[np.argmax((after - before) ** 2 * parts * (len(place) - parts))])
        change = float(np.median(place[at:]) - np.median(place[:at]))
        since = np.datetime_as_string(times[at], unit="s")
    return judge(abs(change), _ACROSS_MM, across_mm=change, since=since)


@check("fields", CAMERA)
def scene_change(fields: xr.Dataset) -> Found | None:
    """Largest share of the table in connected cells whose change from one frame to the next, apart from a change that all share, exceeds
    those before and after by 0.3 K and 8 standard deviations: none with an edge within 10 mm (an object), 2 % without one (a reflection).
    """
    if "abrupt_parts" not in fields.attrs:
        return None
    parts = json.loads(fields.attrs["abrupt_parts"])
    return judge(max((part["share"] for part in parts), default=0.0), 0.0, parts=parts)


@check("fields", CAMERA)
def unnamed_surface(fields: xr.Dataset) -> Found | None:
    """Largest step of connected cells of a still table against those around them in the first cycle, from 0.3 K and 12 standard deviations
    on, most of it within 10 mm round most of their edge: none; in steel heat has no such edge, another emissivity or an object has.
    """
    if "unnamed_surfaces" not in fields.attrs:
        return None
    surfaces = json.loads(fields.attrs["unnamed_surfaces"])
    return judge(max((abs(one["step_K"]) for one in surfaces), default=0.0), 0.0, surfaces=surfaces)


#: Change of the picture that only some discs show, and of its level that all show, beyond which it is named, K: as large as the steps of
#: many cameras. Discs of 20 pixels show them to 0.01 K.
_PICTURE_K = 0.1
#: Share of the mean rise that an unknown zero may be: beyond it a coefficient per kelvin is known to no better than half of its value,
#: and the propagation of its uncertainty to first order ends.
_ZERO_SHARE = 0.33
#: Share of the table's warming by which discs may differ on top: what the blur mixes of the table into a disc is known to some per cent.
_RIM_SHARE = 0.01


@check("fields", CAMERA)
def camera_picture(fields: xr.Dataset) -> Found | None:
    """Largest change of a disc that the table around it shares, and other discs do not ([radiometry.md](radiometry.md)): at most
    `_PICTURE_K` K and `_RIM_SHARE` of the largest change of the table at a disc; not verified where the table moves in view, camera or
    table was displaced, or fewer than five discs of low emissivity are in view.
    """
    shown = json.loads(fields.attrs.get("discs", "{}"))
    if not shown:
        return None
    if "untested" in shown:
        return judge(0.0, _PICTURE_K, verified=False, untested=shown["untested"])
    limit_K = _PICTURE_K + _RIM_SHARE * shown["warming_K"]
    return judge(shown["pattern_K"], limit_K, untested=None, disc=shown["disc"])


@check("fields", CAMERA)
def camera_zero(fields: xr.Dataset) -> Found | None:
    """Change that all discs share with the table around them, after the correction of the camera, with the room and apart from it: more
    than `_PICTURE_K` K of both is not verified, and doubted where the uncertainty of the zero may be more than `_ZERO_SHARE` of the mean
    rise.
    """
    shown = json.loads(fields.attrs.get("discs", "{}"))
    if not shown or "untested" in shown:
        return None
    zero_K = shown["zero_K"]
    moved, share = zero_K > _PICTURE_K, zero_share(fields)
    return judge(
        zero_K, _PICTURE_K, passed=not moved or share <= _ZERO_SHARE, verified=not moved, moved=moved, share=share
    )


@check("fields", CLOCK, waits=True)
def frames_gaps(frame_time: NDArray[np.datetime64], reading_time: xr.DataArray) -> Found:
    """Share of the readings in gaps between frames, longer than `_GAP_S` s and `_GAP_STEPS` usual steps: at most `_GAP_SHARE`; a gap with
    readings is always named, with the cycles that have no frame.
    """
    gaps = find_gaps(frame_time)
    count, total = int(in_gaps(reading_time, gaps).sum()), max(int(reading_time.notnull().sum()), 1)
    longest = max(gaps, key=lambda gap: gap[1] - gap[0], default=None)
    named = "" if longest is None else gap_words(longest)
    return judge(count / total, _GAP_SHARE, passed=count <= _GAP_SHARE * total, gaps=len(gaps), longest=named)


def mean_rise(fields: xr.Dataset) -> Array:
    """Mean rise of the cells that each cycle shows, (cycle,), K; of a long test not all fields are in memory at once."""
    rise = fields["temperature_rise"]
    return np.concatenate([rise[some].mean(("y", "x")).values for some in piece_slices(rise.shape)])


def zero_share(fields: xr.Dataset) -> float:
    """Uncertainty of the camera's zero, which changes as slowly as the table warms, as a share of the mean rise; over all cycles."""
    if "camera_correction_u" not in fields:
        return 0.0
    rise, zero_u = _known(fields, "camera_correction_u")
    return float(np.sqrt((zero_u**2).sum() / max((rise**2).sum(), np.finfo(float).tiny)))


def reflected_share(fields: xr.Dataset) -> float:
    """Uncertainty of a coefficient per kelvin from a change of what the table reflects, which lasts, as a share of it; over all cycles."""
    if "rise_reflected_u" not in fields:
        return 0.0
    rise, reflected_u = _known(fields, "rise_reflected_u")
    return float((np.abs(rise) * reflected_u).sum() / max((rise**2).sum(), np.finfo(float).tiny))


def _known(fields: xr.Dataset, name: str) -> tuple[Array, Array]:
    """Mean rise and an uncertainty, K, of the cycles that have both."""
    rise, u = mean_rise(fields), fields[name].values.astype(float)
    known = np.isfinite(rise) & np.isfinite(u)
    return rise[known], u[known]


# Checks of the registration: fiducials that are missing or unchecked, hints that contradict, a plan of another size
# or mirrored.

#: Least share of the listed fiducials that must agree: of a list of this table, most are in view.
_LEAST_FOUND = 0.5
#: Largest share of the fiducials in use that may lie far from their hints: hints are read off a screen, and single ones go wrong.
_LARGEST_CONTRADICTED = 0.5
#: Ratio of imaged to listed area of the discs beyond which scale and diameters disagree: five times what noise and a sharp lens do to it,
#: 2.5 % of the scale of the plan.
_LARGEST_AREA_RATIO = 1.05
#: Least share of the plan that the fiducials span; beyond them the registration is extrapolated. Discs around a measured line span two
#: thirds of its table; a plan twice as long and wide as the table leaves a quarter of that.
_LEAST_SPAN = 0.25


@check("plan", CAMERA)
def fiducials_found(registration: RegistrationPart) -> Found:
    """Share of the listed fiducials that are in view and agree: at least `_LEAST_FOUND`."""
    used, listed = len(registration.leave_one_out_mm), registration.fiducials_listed
    found = used / listed
    return judge(found, _LEAST_FOUND, passed=found >= _LEAST_FOUND, used=used, listed=listed)


@check("plan", CAMERA)
def fiducials_unchecked(registration: RegistrationPart) -> Found:
    """Fiducials that the others predict to no better than a quarter of a diameter, all of four: none."""
    return judge(len(registration.unchecked), 0.0, unchecked=registration.unchecked)


@check("plan", CAMERA)
def fiducial_hints(registration: RegistrationPart) -> Found:
    """Share of the fiducials in use that lie more than 25 px from their approximate pixel position: at most
    `_LARGEST_CONTRADICTED`; hints that all lie by the same shift from their discs, and most not on another one, were read in another view
    and agree (named, not counted).
    """
    hints, used = len(registration.contradicted_hints), len(registration.leave_one_out_mm)
    return judge(hints / used, _LARGEST_CONTRADICTED, hints=hints, used=used)


@check("plan", CAMERA)
def fiducial_diameters(registration: RegistrationPart) -> Found:
    """Median ratio of the imaged to the listed area of the discs, at the scale of their places: at most `_LARGEST_AREA_RATIO`, and its
    inverse.
    """
    # Points without a disc have no area.
    area = registration.area_ratio
    ratio = area if is_determined(area) else 1.0
    passed = bool(abs(np.log(ratio)) <= np.log(_LARGEST_AREA_RATIO))
    return judge(ratio, _LARGEST_AREA_RATIO, passed=passed)


@check("plan", CAMERA)
def fiducials_span(registration: RegistrationPart) -> Found:
    """Share of the plan's area that the fiducials in use span: at least `_LEAST_SPAN`."""
    span = registration.span or 0.0
    return judge(span, _LEAST_SPAN, passed=span >= _LEAST_SPAN)


@check("plan", CAMERA)
def plan_mirrored(registration: RegistrationPart) -> Found:
    """Sense in which the plan turns in the frame: the same; a plan drawn with y upwards appears mirrored and is accepted once."""
    return judge(registration.mirrored, 0.0)
