"""Checks of the frames: settings that change within a series, implausible parameters, temperatures outside the calibrated range."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.align import covered_share, likely_zone_shift
from fusion.analysis.consistency.checks import Check, Severity, judge
from fusion.analysis.consistency.clocks import QUARTER_S, QUARTERS, TIMES, Evidence
from fusion.common import Array
from thermography.common import ThermographyError
from thermography.evaluation import share_outside_range, thermogram
from thermography.inspection import FileWarning, check_series
from thermography.io.frame import Frame, FrameReference
from thermography.large_arrays import median_of_pieces, piece_slices

# Checks of the times that the camera writes: order of the frames, rate of its clock, place in the motion of the axis.

#: Frames nearer to each other than this share of a cycle are one burst.
_BURST_SHARE = 0.25
#: Scatter about a straight line, in cycles, up to which bursts keep their place in the cycle: triggered by the test, not by a timer.
_LOCKED_CYCLES = 0.03
#: Fewest bursts from which a rate is estimated, and share of the cycles that must have one.
_LEAST_BURSTS, _LEAST_SHARE = 12, 0.6
#: Largest slip from one burst to the next, in cycles: a timer of another period slips more, no clock gains a fifth.
_LARGEST_STEP = 0.2
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


def check_order(frames: Sequence[FrameReference]) -> list[Check]:
    """Check that the times of frames do not go backwards from one to the next."""
    timed = [frame for frame in frames if not np.isnat(frame.time)]
    if not timed:
        return []
    ordered = sorted(timed, key=lambda frame: (_numbered(frame.path), frame.index))
    steps = [(before, after) for before, after in itertools.pairwise(ordered) if _follows(before, after)]
    back = [(before, after) for before, after in steps if after.time < before.time]
    if back and _renamed(back, len(steps), np.sort(np.array([frame.time for frame in timed]))):
        evidence = f"The names of the frames do not follow their times ({len(back)} of {len(steps)} steps go back); the times were taken."
        return [judge("camera_stamps", 0.0, 0.0, evidence)]
    named = "; ".join(
        f"{after.path.name}{f' frame {after.index}' if after.index else ''} is {(before.time - after.time) / np.timedelta64(1, 's'):.0f} s "
        f"before {before.path.name}"
        for before, after in back[:3]
    )
    return [
        judge(
            "camera_stamps",
            len(back),
            0.0,
            f"The camera's clock goes backwards {len(back)} times: {named}.",
            "Check whether the camera's clock was set during the test; leave out the frames before or after.",
            sound="The camera's clock never goes backwards.",
        )
    ]


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


def check_phase(frame_time: NDArray[np.datetime64], deviations: xr.Dataset) -> list[Check]:
    """Check the rate of the camera's clock, and whether frames of a still table are stamped while the axis stands at position 0."""
    seconds, cycle_end, reading_s, position_mm = _motion(frame_time, deviations)
    period = float(np.median(np.diff(cycle_end))) if cycle_end.size > 1 else np.nan
    locked = _lock(seconds, cycle_end, period) if cycle_end.size >= _LEAST_BURSTS else None
    limit_s_per_h = 3600.0 * _LARGEST_SLIP * period / float(np.ptp(seconds)) if np.isfinite(period) else 0.0
    if locked is None:
        evidence = "The frames have no fixed phase in the cycle: cannot be tested."
        return [judge("camera_rate", 0.0, limit_s_per_h, evidence), judge("camera_phase", 0.0, _AWAY_SHARE, evidence)]
    slip_cycles, rate = locked
    away = _away_share(seconds, reading_s, position_mm)
    return [
        judge(
            "camera_rate",
            rate,
            limit_s_per_h,
            f"The camera's clock gains {rate:+.3g} s/h on the cycles of the laser ({slip_cycles:+.2f} cycles over the test).",
            "Check the camera's clock against that of the laser at start and end; where a timer of the camera takes the frames of a table "
            "that does not move in its view, accept camera_rate.",
            passed=abs(slip_cycles) <= _LARGEST_SLIP,
        ),
        judge(
            "camera_phase",
            away,
            _AWAY_SHARE,
            f"{100.0 * away:.0f} % of the frames are stamped while the axis was away from position 0.",
            'Check clock_offset: with table = "still" every frame shows the table at axis position 0. Where the axis does not move the '
            "table in the camera's view, accept camera_phase.",
        ),
    ]


def check_coverage(frame_time: NDArray[np.datetime64], deviations: xr.Dataset, *, offset_s: float) -> list[Check]:
    """Check that frames and readings were taken at the same time; `offset_s` is what the campaign file states of the camera's clock."""
    readings = deviations["time"].values
    readings = readings[~np.isnat(readings)]
    covered, shift = covered_share(readings, frame_time), likely_zone_shift(readings, frame_time)
    first, last, start, end = (
        f"{np.datetime_as_string(time, unit='s')}Z" for time in (*frame_time[[0, -1]], readings.min(), readings.max())
    )
    laser = f"readings of {deviations.attrs.get('source', 'the laser')}"
    span = f"frames {first} to {last}, {laser} {start} to {end}"
    zones = covered < _COVERED_NOW and shift is not None
    evidence = f"{100.0 * covered:.0f} % of the readings lie between the first and the last frame ({span})"
    remedy = "Set thermography.clock_offset (camera clock minus laser clock), or check that both folders belong to the same test."
    if zones and shift is not None:
        evidence += f": the clocks look {abs(shift) / 3600:g} h apart, as in two time zones"
        remedy = (
            f'Write thermography.clock_offset = "{offset_s + shift:g} s" (camera clock minus laser clock) if the camera\'s is wrong, or '
            "give the times of both with their zone."
        )
    return [
        judge(
            "frames_coverage",
            covered,
            _COVERED_NOW,
            f"{evidence}.",
            remedy,
            passed=covered > 0.0 and not zones,
            severity=Severity.CONTRADICTION,
        )
    ]


def compare_phase(frame_time: NDArray[np.datetime64], deviations: xr.Dataset) -> list[Evidence]:
    """Compare the stamps of the frames of a still table with the motion of the axis: what they say of the camera's clock."""
    seconds, cycle_end, reading_s, position_mm = _motion(frame_time, deviations)
    if cycle_end.size < _LEAST_BURSTS or _lock(seconds, cycle_end, float(np.median(np.diff(cycle_end)))) is None:
        return []
    away = np.array([_away_share(seconds - QUARTER_S * k, reading_s, position_mm) for k in QUARTERS]) / _AWAY_SHARE
    return [Evidence("laser", "camera", away, away, TIMES, "place in the cycle")]


def _motion(frame_time: NDArray[np.datetime64], deviations: xr.Dataset) -> tuple[Array, Array, Array, Array]:
    """Frames, ends of the cycles and readings in s since the first frame, and the axis positions of the readings, mm."""
    time = deviations["time"].values.astype("datetime64[ns]")
    position = np.broadcast_to(deviations["position"].values, time.shape)
    since = (time - frame_time[0].astype("datetime64[ns]")) / np.timedelta64(1, "s")
    timed = ~np.isnat(time)
    order = np.argsort(since[timed])
    ends = np.array([row[known].max() for row, known in zip(since, timed, strict=True) if known.any()])
    frames = (frame_time - frame_time[0]) / np.timedelta64(1, "s")
    return np.asarray(frames, float), ends, since[timed][order], position[timed][order]


def _lock(seconds: Array, cycle_end: Array, period: float) -> tuple[float, float] | None:
    """Steady slip of the bursts of frames on the cycles, in cycles over the test and in s/h; None where they keep no place."""
    starts = seconds[np.concatenate([[True], np.diff(seconds) > _BURST_SHARE * period])]
    number = np.interp(starts, cycle_end, np.arange(cycle_end.size))
    before, after = starts < cycle_end[0], starts > cycle_end[-1]
    number[before] = (starts[before] - cycle_end[0]) / period
    number[after] = cycle_end.size - 1 + (starts[after] - cycle_end[-1]) / period
    place = np.unwrap(number - np.round(number), period=1.0)
    if starts.size < max(_LEAST_BURSTS, _LEAST_SHARE * cycle_end.size):
        return None
    line = np.polyfit(starts, place, 1)
    scatter = float(np.std(place - np.polyval(line, starts)))
    step = abs(float(line[0] * np.median(np.diff(starts))))
    if scatter > _LOCKED_CYCLES or step > _LARGEST_STEP:
        return None
    return float(line[0] * np.ptp(starts)), 3600.0 * float(line[0] * period)


def _away_share(seconds: Array, reading_s: Array, position_mm: Array) -> float:
    """Share of the frames, of those between first and last reading, with readings of one cycle away from axis position 0 on both sides."""
    steps = np.diff(np.unique(np.abs(position_mm)))
    near_mm = 0.5 * float(steps.min()) if steps.size else 0.0
    typical = 3.0 * float(np.median(np.diff(reading_s)))
    after = np.searchsorted(reading_s, seconds)
    inside = (after > 0) & (after < reading_s.size)
    at = np.clip(after, 1, reading_s.size - 1)
    moving = (reading_s[at] - reading_s[at - 1] <= typical) & (
        np.minimum(np.abs(position_mm[at]), np.abs(position_mm[at - 1])) > near_mm
    )
    return float(np.mean(moving[inside])) if inside.any() else 0.0


#: Largest share of the pixels of a frame outside the range in which the camera is calibrated.
_OUTSIDE_SHARE = 0.01
#: The parameters of Planck's law that belong to a range of the camera.
_PLANCK = ("planck_r1", "planck_b", "planck_f", "planck_o", "planck_r2")
_CHANGING = ("parameters_vary", "several_cameras", "several_lenses")


def check_frames(frames: Sequence[FrameReference], *, overridden: Collection[str]) -> list[Check]:
    """Check what the frames store of their measurement."""
    if not frames:
        return []
    ranges = [(frame.limits.minimum_K, frame.limits.maximum_K) for frame in frames]
    switched = [place for place in range(1, len(frames)) if ranges[place] != ranges[place - 1]]
    continued = len(switched) == 1 and _continued(frames, switched[0])
    warnings = check_series(frames, overridden={*overridden, *(_PLANCK if continued else ())})
    changing = [warning for warning in warnings if warning.code in _CHANGING]
    if switched and not continued:
        changing.append(
            FileWarning("range", f"the camera's range changes ({len({*ranges})} ranges).", "Use one range.")
        )
    implausible = [warning for warning in warnings if warning.code not in _CHANGING]
    return [
        _collected("camera_settings", changing, "The settings of the camera stay the same over the series."),
        _collected("camera_parameters", implausible, "The stored parameters of the measurement are plausible."),
        _range(_spread(frames)),
    ]


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
    return float(np.mean(change > np.maximum(before, after) + _JUMP_K)) <= _JUMP_SHARE


def _collected(code: str, warnings: Sequence[FileWarning], sound: str) -> Check:
    """One check of several warnings of one kind."""
    evidence = " ".join(f"{warning.message[0].upper()}{warning.message[1:]}" for warning in warnings)
    remedy = " ".join(dict.fromkeys(warning.remedy for warning in warnings))
    return judge(code, len(warnings), 0.0, evidence, remedy, sound=sound)


def _range(frames: Sequence[Frame]) -> Check:
    """Share of pixels outside the calibrated range in the first, the middle and the last frame."""
    outside = max([0.0, *(share_outside_range(frame) for frame in frames)])
    return judge(
        "camera_range",
        outside,
        _OUTSIDE_SHARE,
        f"Up to {100.0 * outside:.3g} % of the pixels of a frame are outside the range in which the camera is calibrated.",
        "Select the range of the camera that holds these temperatures.",
    )


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
#: A cell jumps if its change from one frame to the next exceeds its changes before and after by more than this, K, ...
_JUMP_K = 0.3
#: ... and by more than this many standard deviations of its noise.
_JUMP_SIGMAS = 8.0
#: Share of the cells that must jump together.
_JUMP_SHARE = 0.02
#: A gap between frames is longer than this, s, half the time constant of an ordinary source of heat, ...
_GAP_S = 600.0
#: ... and than this multiple of the usual step.
_GAP_STEPS = 3.0
#: Largest share of the readings that may lie in gaps.
_GAP_SHARE = 0.1
_LEFT_OUT = {
    "frames_damaged": "damaged, or unlike those before and after them",
    "frames_obstructed": "with an object in front of the table",
    "frames_shaken": "displaced singly",
    "frames_unplaced": "in which the moving table is not located",
}


def check_place(fields: xr.Dataset) -> list[Check]:
    """Check whether the frames show the table, where it is registered, over the whole series."""
    if "frames_repeated" not in fields.attrs:
        return []
    left_out = {name: json.loads(fields.attrs.get(name, "[]")) for name in _LEFT_OUT}
    total = int(fields["frame_count"].sum()) + sum(len(names) for names in left_out.values())
    common = [_left_out(left_out, total), _repeated(fields, total)]
    if "table_across" in fields:
        return [_across(fields), *common]
    return [_unchecked(fields, total), *common, _jump(fields)]


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


def check_gaps(frame_time: NDArray[np.datetime64], readings: xr.DataArray) -> list[Check]:
    """Check that the readings lie between frames that show their field."""
    gaps = find_gaps(frame_time)
    count, total = int(in_gaps(readings, gaps).sum()), max(int(readings.notnull().sum()), 1)
    longest = max(gaps, key=lambda gap: gap[1] - gap[0], default=None)
    where = "" if longest is None else f", the longest of {gap_words(longest)}"
    return [
        judge(
            "frames_gaps",
            count / total,
            _GAP_SHARE,
            f"{100.0 * count / total:.0f} % of the readings fall into {len(gaps)} gaps between frames{where}.",
            "Give all frames of the test, or leave out the cycles that have none.",
            passed=count <= _GAP_SHARE * total,
        )
    ]


def gap_words(gap: tuple[np.datetime64, np.datetime64]) -> str:
    """Return length, start and end of a gap as words."""
    minutes = (gap[1] - gap[0]) / np.timedelta64(60, "s")
    start, end = (np.datetime_as_string(time, unit="s") for time in gap)
    return f"{minutes:.0f} min from {start}Z to {end}Z"


def _unchecked(fields: xr.Dataset, total: int) -> Check:
    """Share of frames in stretches after which no frame shows that the registration held."""
    stretches = json.loads(fields.attrs["unchecked_stretches"])
    knocks = json.loads(fields.attrs["knocks"])
    named = "; ".join(f"{one['first']} to {one['last']} ({one['frames']} frames)" for one in stretches)
    return judge(
        "camera_place",
        sum(stretch["frames"] for stretch in stretches) / total,
        _UNCHECKED_SHARE,
        f"Neither fiducials nor the table's outline show whether camera or table moved: {named}."
        if stretches
        else f"The registration was followed through {len(knocks)} displacements of camera or table.",
        "Fasten camera and table, and use fiducials that stay visible: low emissivity, warm or cold surroundings.",
    )


def _across(fields: xr.Dataset) -> Check:
    """Largest lasting change of the place of a moving table across its axis: the axis cannot move it so, but a knock can."""
    across = fields["table_across"].dropna("frame_time")
    place, times = across.values, across["frame_time"].values
    parts = np.arange(_ACROSS_FRAMES, len(place) - _ACROSS_FRAMES + 1)
    change, since = 0.0, ""
    if parts.size:
        # The division into two means that leaves the smallest squares.
        before = np.cumsum(place)[parts - 1] / parts
        after = (place.sum() - parts * before) / (len(place) - parts)
        at = int(parts[np.argmax((after - before) ** 2 * parts * (len(place) - parts))])
        change = float(np.median(place[at:]) - np.median(place[:at]))
        since = f", from {np.datetime_as_string(times[at], unit='s')}Z on"
    displaced = f"The table in the frames is displaced across its axis by {change:+.2f} mm"
    return judge(
        "camera_place",
        abs(change),
        _ACROSS_MM,
        f"{displaced}{since}: camera or table moved.",
        "Fasten camera and table; give the frames before and after as two campaigns.",
        sound=f"{displaced}.",
    )


def _left_out(left_out: dict[str, list[str]], total: int) -> Check:
    """Share of the frames that were left out because they do not show the table."""
    share = sum(len(names) for names in left_out.values()) / total
    named = ", ".join(f"{len(names)} {_LEFT_OUT[name]}" for name, names in left_out.items() if names)
    return judge(
        "frames_left_out",
        share,
        _LEFT_OUT_SHARE,
        f"{100 * share:.0f} % of {total} frames were left out{f': {named}' if named else ''}.",
        "Keep the view of the table free and the camera fixed and running; record these cycles again.",
    )


def _repeated(fields: xr.Dataset, total: int) -> Check:
    """Share of the frames that hold the image of the frame before."""
    repeated = json.loads(fields.attrs["frames_repeated"])
    held = f"{len(repeated)} of {total} frames hold the image of the frame before"
    held += f", {repeated[0]} to {repeated[-1]}" if repeated else ""
    return judge(
        "frames_repeated",
        len(repeated) / total,
        _REPEATED_SHARE,
        f"{held}: the camera was frozen.",
        "Leave these frames out, and check that the camera ran and that no file was copied.",
        sound=f"{held}.",
    )


def _jump(fields: xr.Dataset) -> Check:
    """Largest jump that a part of the table makes between two frames while the rest does not."""
    frames, times = fields["frame_temperature"], fields["time"].values
    seconds = np.diff(times) / np.timedelta64(1, "s")
    least_K = _least_jump(frames)
    # Share of the cells that jump in every change but the first and the last one.
    shares = [np.empty(0)]
    for some in piece_slices((max(len(frames) - 3, 0), *frames.shape[1:])):
        excess = _excess(frames, seconds, some, least_K)
        seen = np.isfinite(excess)
        shares.append(((excess > 0) & seen).sum(axis=(1, 2)) / np.maximum(seen.sum(axis=(1, 2)), 1))
    share = np.concatenate(shares)
    at = int(np.argmax(share)) if share.size else 0
    value = float(share[at]) if share.size else 0.0
    evidence = "No part of the table changes from one frame to the next by more than its changes before and after."
    if value > _JUMP_SHARE:
        cells = _excess(frames, seconds, slice(at, at + 1), least_K)[0] > 0
        y, x = (float(fields[axis].values[np.nonzero(cells)[k]].mean()) for k, axis in enumerate(("y", "x")))
        before, after = frames[at + 1 : at + 3].values.astype(float)
        size = float(np.median((after - before)[cells]) - np.nanmedian(after - before))
        instants = np.datetime_as_string(times[np.flatnonzero(share > _JUMP_SHARE) + 2], unit="s")
        strongest = instants[np.argmax(share[share > _JUMP_SHARE])]
        evidence = (
            f"{100 * value:.0f} % of the table around x = {x:.0f} mm, y = {y:.0f} mm jumps by {size:+.1f} K against the rest from one "
            f"frame to the next, at {strongest}Z: a reflection, an object on the table or a blurred view, but no warming"
            + (f" ({len(instants)} jumps in all)." if len(instants) > 1 else ".")
        )
    return judge(
        "scene_change",
        value,
        _JUMP_SHARE,
        evidence,
        "Shield the table from sun and lamps, keep it free of objects and liquids, or leave these frames out.",
    )


def _changes(frames: xr.DataArray, first: int, stop: int) -> Array:
    """Changes from frame to frame, those from `first` up to `stop`, beyond the one that most of the table makes, (changes, y, x) K."""
    change = np.diff(frames[first : stop + 1].values.astype(float), axis=0)
    return np.asarray(change - np.nanmedian(change, axis=(1, 2), keepdims=True))


def _least_jump(frames: xr.DataArray) -> float:
    """Excess of a change beyond which it is a jump, K: large against the noise of the changes."""
    pairs = (max(len(frames) - 2, 0), *frames.shape[1:])

    def differences() -> Iterator[Array]:
        return (np.abs(np.diff(_changes(frames, some.start, some.stop + 1), axis=0)) for some in piece_slices(pairs))

    noise_K = 1.4826 * median_of_pieces(differences) / np.sqrt(6.0)
    return max(_JUMP_K, _JUMP_SIGMAS * noise_K)


def _excess(frames: xr.DataArray, seconds: Array, some: slice, least_K: float) -> Array:
    """Excess of changes over what those before and after them allow, (changes, y, x) K; place 0 is the second change."""
    change, lasted = _changes(frames, some.start, some.stop + 2), seconds[some.start : some.stop + 2, None, None]
    rate = np.abs(change) / lasted
    # A source that is switched on bends the temperature, so that the change exceeds only the one before, or only the one after.
    excess = np.abs(change[1:-1]) - lasted[1:-1] * np.maximum(rate[:-2], rate[2:])
    return np.asarray(excess - least_K)


#: Change of the picture that only some discs show, and of its level that all show, beyond which it is named, K: as large as the steps of
#: many cameras. Discs of 20 pixels show them to 0.01 K.
_PICTURE_K = 0.1
#: Share of the mean rise that an unknown zero may be: beyond it a coefficient per kelvin is known to no better than half of its value,
#: and the propagation of its uncertainty to first order ends.
_ZERO_SHARE = 0.33
#: Share of the table's warming by which discs may differ on top: the blur of the lens mixes some of the table into small discs.
_RIM_SHARE = 0.03


def check_picture(fields: xr.Dataset) -> list[Check]:
    """Check that discs of low emissivity and the table around them warm as surfaces of one temperature."""
    shown = json.loads(fields.attrs.get("discs", "{}"))
    if not shown:
        return []
    if "untested" in shown:
        words = f"Picture not verified: whether a pattern of the camera or a reflection grew in it cannot be tested ({shown['untested']})."
        remedy = "Take frames of the table at rest, with five or more discs of low emissivity over the whole plan."
        return [judge("camera_picture", 0.0, _PICTURE_K, words, unverified=remedy)]
    pattern_K, zero_K = shown["pattern_K"], shown["zero_K"]
    moved, share = zero_K > _PICTURE_K, zero_share(fields)
    known = not moved or share <= _ZERO_SHARE
    of_rise = "The uncertainty of the rise contains it." if known else f"It may be {100.0 * share:.0f} % of the rise."
    keep_in_view = "Keep a surface of constant temperature in view (reference_patch under [thermography])."
    return [
        judge(
            "camera_picture",
            pattern_K,
            _PICTURE_K + _RIM_SHARE * shown["warming_K"],
            f"Discs and the table around them change alike by up to {pattern_K:.2g} K against other places (most at {shown['disc']}); no "
            "temperature of the table does that: a pattern grows in the picture (narcissus, a warm lens, a dirty window), or a reflection.",
            "Let the camera warm up, clean or remove the window, tilt the camera by some degrees, and shield the table from sun and lamps.",
            sound=f"Discs and the table around them show no pattern that grows in the picture (largest {pattern_K:.2g} K).",
        ),
        judge(
            "camera_zero",
            zero_K,
            _PICTURE_K,
            f"Zero not verified: discs of low emissivity change by {zero_K:.2g} K with the table around them and not with the logged room: "
            f"the camera's zero, a window, or what the discs reflect. {of_rise}",
            keep_in_view,
            passed=known,
            unverified=keep_in_view if moved else "",
            sound="" if moved else f"The discs show no change of the camera's zero (largest {zero_K:.2g} K).",
        ),
    ]


def mean_rise(fields: xr.Dataset) -> Array:
    """Mean rise of the cells that each cycle shows, (cycle,), K; of a long test not all fields are in memory at once."""
    rise = fields["temperature_rise"]
    return np.concatenate([rise[some].mean(("y", "x")).values for some in piece_slices(rise.shape)])


def zero_share(fields: xr.Dataset) -> float:
    """Uncertainty of the camera's zero, which changes as slowly as the table warms, as a share of the mean rise; over all cycles."""
    if "camera_correction_u" not in fields:
        return 0.0
    rise, zero_u = mean_rise(fields), fields["camera_correction_u"].values
    known = np.isfinite(rise) & np.isfinite(zero_u)
    return float(np.sqrt((zero_u[known] ** 2).sum() / max((rise[known] ** 2).sum(), np.finfo(float).tiny)))


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


def check_registration(registration: Mapping[str, Any], *, file: str) -> list[Check]:
    """Check what the registration found."""
    used, listed = list(registration["leave_one_out_mm"]), int(registration["fiducials_listed"])
    unchecked, hints = ", ".join(registration["unchecked"]), len(registration["contradicted_hints"])
    found, span, mirrored = len(used) / listed, registration["span"], bool(registration["mirrored"])
    # Points without a disc have no area.
    area = registration["area_ratio"]
    ratio = 1.0 if area is None or not np.isfinite(area) else float(area)
    return [
        judge(
            "fiducials_found",
            found,
            _LEAST_FOUND,
            f"{len(used)} of the {listed} fiducials of {file} are in view and agree.",
            f"Check that {file} belongs to this table, and clean or repaint the discs.",
            passed=found >= _LEAST_FOUND,
        ),
        judge(
            "fiducials_unchecked",
            len(registration["unchecked"]),
            0.0,
            f"If {unchecked} were elsewhere than {file} says, the other fiducials would not reveal it.",
            f"Measure the places of {unchecked} again, and paint and list more discs: six or more, over the whole plan.",
            sound="Every fiducial is checked by the others.",
        ),
        judge(
            "fiducial_hints",
            hints / len(used),
            _LARGEST_CONTRADICTED,
            f"{hints} of {len(used)} fiducials lie more than 25 px from their column_px, row_px in {file}.",
            f"Read column_px, row_px of {file} off a frame of this series, or remove them; check that the names belong to the places.",
        ),
        judge(
            "fiducial_diameters",
            ratio,
            _LARGEST_AREA_RATIO,
            f"By the scale of x_mm, y_mm the discs in view have {ratio:.3f} times the area that diameter_mm of {file} says.",
            f"Measure a disc and a distance between two of them, and correct {file}; focus the camera.",
            passed=bool(abs(np.log(ratio)) <= np.log(_LARGEST_AREA_RATIO)),
        ),
        judge(
            "fiducials_span",
            span,
            _LEAST_SPAN,
            f"The fiducials in use span {100 * span:.0f} % of the plan.",
            f"Check size under [plan], and that {file} belongs to this table; else paint discs over the whole plan.",
            passed=span >= _LEAST_SPAN,
        ),
        judge(
            "plan_mirrored",
            mirrored,
            0.0,
            f"The plan of {file} appears mirrored in the frames.",
            "Check the signs of x_mm and y_mm, and [plan.axis]; if the plan is drawn with y upwards, accept this doubt.",
            sound="The plan is not mirrored in the frames.",
        ),
    ]
