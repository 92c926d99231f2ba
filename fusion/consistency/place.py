"""Checks of what the frames show over the series: the place of the camera, frames left out, and parts of the table that change abruptly."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.consistency.checks import Check
from thermography.fields.cycle_fields import plan_unit
from thermography.fields.tasks.pieces import median_of_pieces, piece_slices

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
    "frames_obstructed": "with something before the table",
    "frames_shaken": "displaced alone",
    "frames_unplaced": "in which the moving table is not located",
}
_FIGURES = "temperature fields, hotspots, and every cause that follows the field"


def check_place(fields: xr.Dataset) -> list[Check]:
    """Check whether the frames show the table, where it is registered, over the whole series.

    Parameters
    ----------
    fields : Dataset
        Fields of the table with the frame stack and the lists of frames with remarks, from the thermal stage.

    Returns
    -------
    list of Check
        ``camera_place``, ``frames_left_out``, ``frames_repeated``, and ``scene_change`` for a table that stands still.
    """
    if "frames_repeated" not in fields.attrs:
        return []
    left_out = {name: json.loads(fields.attrs.get(name, "[]")) for name in _LEFT_OUT}
    total = int(fields["frame_count"].sum()) + sum(len(names) for names in left_out.values())
    common = [_left_out(left_out, total), _repeated(fields, total)]
    if "table_across" in fields:
        return [_across(fields), *common]
    if plan_unit(fields) == "px":
        # `fusion.consistency.registration.check_picture` says whether the picture stayed; what is in it is not known to change slowly.
        return common
    return [_unchecked(fields, total), *common, _jump(fields)]


def find_gaps(frame_time: NDArray[np.datetime64]) -> list[tuple[np.datetime64, np.datetime64]]:
    """Find the gaps in the times of frames.

    Parameters
    ----------
    frame_time : (n,) ndarray of datetime64
        Sorted.

    Returns
    -------
    list of (datetime64, datetime64)
        Last frame before and first frame after every gap.
    """
    if frame_time.size < 2:
        return []
    seconds = np.diff(frame_time) / np.timedelta64(1, "s")
    longest = max(_GAP_S, _GAP_STEPS * float(np.median(seconds)))
    return [(frame_time[k], frame_time[k + 1]) for k in np.flatnonzero(seconds > longest)]


def in_gaps(readings: xr.DataArray, gaps: Sequence[tuple[np.datetime64, np.datetime64]]) -> xr.DataArray:
    """Tell which readings lie in gaps between frames.

    Parameters
    ----------
    readings : DataArray
        Times; NaT where a reading has none.
    gaps : sequence of (datetime64, datetime64)
        Of `find_gaps`.

    Returns
    -------
    DataArray of bool
    """
    inside = xr.zeros_like(readings, dtype=bool)
    for start, end in gaps:
        inside |= (readings > start) & (readings < end)
    return inside


def check_gaps(frame_time: NDArray[np.datetime64], readings: xr.DataArray) -> list[Check]:
    """Check that the readings lie between frames that show their field.

    Parameters
    ----------
    frame_time : (n,) ndarray of datetime64
        Times of the frames that are used, on the laser's clock, sorted.
    readings : DataArray
        Times of the readings along ``cycle`` and other dimensions; NaT where one has none.

    Returns
    -------
    list of Check
        ``frames_gaps``.
    """
    gaps = find_gaps(frame_time)
    count, total = int(in_gaps(readings, gaps).sum()), max(int(readings.notnull().sum()), 1)
    passed = count <= _GAP_SHARE * total
    longest = max(gaps, key=lambda gap: gap[1] - gap[0], default=None)
    where = "" if longest is None else f", the longest of {gap_words(longest)}"
    return [
        Check(
            "frames_gaps",
            count / total,
            _GAP_SHARE,
            passed,
            f"{100.0 * count / total:.0f} % of the readings lie in {len(gaps)} gaps between frames{where}.",
            "" if passed else "Give all frames of the test, or leave out the cycles that have none.",
            "fields and rises at these readings, which are interpolated across the gap, and every cause that follows the field",
        )
    ]


def gap_words(gap: tuple[np.datetime64, np.datetime64]) -> str:
    """Return length, start and end of a gap as words.

    Parameters
    ----------
    gap : (datetime64, datetime64)
        Of `find_gaps`.
    """
    minutes = (gap[1] - gap[0]) / np.timedelta64(60, "s")
    start, end = (np.datetime_as_string(time, unit="s") for time in gap)
    return f"{minutes:.0f} min from {start}Z to {end}Z"


def _unchecked(fields: xr.Dataset, total: int) -> Check:
    """Share of frames in stretches after which no frame shows that the registration held."""
    stretches = json.loads(fields.attrs["unchecked_stretches"])
    knocks = json.loads(fields.attrs["knocks"])
    share = sum(stretch["frames"] for stretch in stretches) / total
    passed = share <= _UNCHECKED_SHARE
    named = "; ".join(f"{one['first']} to {one['last']} ({one['frames']} frames)" for one in stretches)
    followed = f"The registration was followed through {len(knocks)} displacements of camera or table."
    evidence = f"Neither fiducials nor the table's outline show whether camera or table moved: {named}."
    return Check(
        "camera_place",
        share,
        _UNCHECKED_SHARE,
        passed,
        evidence if stretches else followed,
        ""
        if passed
        else "Fasten camera and table, and use fiducials that stay visible: low emissivity, warm or cold surroundings.",
        _FIGURES,
    )


def _across(fields: xr.Dataset) -> Check:
    """Largest lasting change of the place of a moving table across its axis: the axis cannot move it so, but a knock can."""
    across = fields["table_across"].dropna("frame_time")
    place, times = across.values, across["frame_time"].values
    parts = np.arange(_ACROSS_FRAMES, len(place) - _ACROSS_FRAMES + 1)
    change, at = 0.0, 0
    if parts.size:
        # The division into two means that leaves the smallest squares.
        before = np.cumsum(place)[parts - 1] / parts
        after = (place.sum() - parts * before) / (len(place) - parts)
        at = int(parts[np.argmax((after - before) ** 2 * parts * (len(place) - parts))])
        change = float(np.median(place[at:]) - np.median(place[:at]))
    passed = abs(change) <= _ACROSS_MM
    when = "" if passed else f", from {np.datetime_as_string(times[at], unit='s')}Z on"
    return Check(
        "camera_place",
        abs(change),
        _ACROSS_MM,
        passed,
        f"The table in the frames is displaced across its axis by {change:+.2f} mm{when}{'' if passed else ': camera or table moved'}.",
        "" if passed else "Fasten camera and table; give the frames before and after as two campaigns.",
        _FIGURES,
    )


def _left_out(left_out: dict[str, list[str]], total: int) -> Check:
    """Share of the frames that were left out because they do not show the table."""
    share = sum(len(names) for names in left_out.values()) / total
    passed = share <= _LEFT_OUT_SHARE
    named = ", ".join(f"{len(names)} {_LEFT_OUT[name]}" for name, names in left_out.items() if names)
    return Check(
        "frames_left_out",
        share,
        _LEFT_OUT_SHARE,
        passed,
        f"{100 * share:.0f} % of {total} frames were left out{f': {named}' if named else ''}.",
        ""
        if passed
        else "Keep the view of the table free and the camera fixed and running; record these cycles again.",
        _FIGURES,
    )


def _repeated(fields: xr.Dataset, total: int) -> Check:
    """Share of the frames that hold the image of the frame before."""
    repeated = json.loads(fields.attrs["frames_repeated"])
    share = len(repeated) / total
    passed = share <= _REPEATED_SHARE
    span = f", {repeated[0]} to {repeated[-1]}" if repeated else ""
    return Check(
        "frames_repeated",
        share,
        _REPEATED_SHARE,
        passed,
        f"{len(repeated)} of {total} frames hold the image of the frame before{span}{'' if passed else ': the camera was frozen'}.",
        "" if passed else "Leave these frames out, and check that the camera ran and that no file was copied.",
        _FIGURES,
    )


def _jump(fields: xr.Dataset) -> Check:
    """Largest jump that a part of the table makes between two frames while the rest does not."""
    frames, times = fields["frame_temperature"], fields["time"].values
    seconds = np.diff(times) / np.timedelta64(1, "s")
    least_K = _least_jump(frames)
    share = _jump_shares(frames, seconds, least_K)
    at = int(np.argmax(share)) if share.size else 0
    passed = not share.size or float(share[at]) <= _JUMP_SHARE
    value = float(share[at]) if share.size else 0.0
    if passed:
        evidence = "No part of the table changes from one frame to the next by more than its changes before and after."
    else:
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
    return Check(
        "scene_change",
        value,
        _JUMP_SHARE,
        passed,
        evidence,
        ""
        if passed
        else "Shield the table from sun and lamps, keep it free of objects and liquids, or leave these frames out.",
        _FIGURES,
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


def _jump_shares(frames: xr.DataArray, seconds: Array, least_K: float) -> Array:
    """Share of the cells that jump in every change but the first and the last one."""
    shares = [np.empty(0)]
    for some in piece_slices((max(len(frames) - 3, 0), *frames.shape[1:])):
        excess = _excess(frames, seconds, some, least_K)
        seen = np.isfinite(excess)
        shares.append(((excess > 0) & seen).sum(axis=(1, 2)) / np.maximum(seen.sum(axis=(1, 2)), 1))
    return np.concatenate(shares)
