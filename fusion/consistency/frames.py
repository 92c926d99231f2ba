"""Checks of the frames: settings that change within a series, implausible parameters, temperatures outside the calibrated range."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from fusion.consistency.checks import Check, Severity
from thermography.errors import ThermographyError
from thermography.inspection import FileWarning, check_series, share_outside_range
from thermography.io.frame import Frame, FrameReference

#: Largest share of the pixels of a frame outside the range in which the camera is calibrated.
_OUTSIDE_SHARE = 0.01
_CHANGING = ("parameters_vary", "several_cameras", "several_lenses")
_FIGURES = "temperatures, rises, and every cause that follows the field"


def check_frames(frames: Sequence[FrameReference], *, overridden: Collection[str]) -> list[Check]:
    """Check what the frames store of their measurement.

    Parameters
    ----------
    frames : sequence of FrameReference
        Usable frames of the campaign, sorted by time.
    overridden : collection of str
        Names of the `CameraParameters` that the campaign file states.

    Returns
    -------
    list of Check
        Of settings that change, of implausible parameters, of the calibrated range, and whether the images differ (both on the first,
        the middle and the last frame).
    """
    if not frames:
        return []
    warnings = check_series(frames, overridden=overridden)
    changing = [warning for warning in warnings if warning.code in _CHANGING]
    ranges = {(frame.limits.minimum_K, frame.limits.maximum_K) for frame in frames}
    if len(ranges) > 1:
        changing.append(FileWarning("range", f"the camera's range changes ({len(ranges)} ranges).", "Use one range."))
    pixels = _spread(frames)
    implausible = [warning for warning in warnings if warning.code not in _CHANGING]
    return [
        _collected("camera_settings", changing, "The settings of the camera stay the same over the series."),
        _collected("camera_parameters", implausible, "The stored parameters of the measurement are plausible."),
        _range(pixels),
        *_frozen(pixels),
    ]


def _collected(code: str, warnings: Sequence[FileWarning], sound: str) -> Check:
    """One check of several warnings of one kind."""
    evidence = " ".join(f"{warning.message[0].upper()}{warning.message[1:]}" for warning in warnings)
    remedy = " ".join(dict.fromkeys(warning.remedy for warning in warnings))
    return Check(code, float(len(warnings)), 0.0, not warnings, evidence or sound, remedy, _FIGURES)


def _range(frames: Sequence[Frame]) -> Check:
    """Share of pixels outside the calibrated range in the first, the middle and the last frame."""
    outside = max([0.0, *(share_outside_range(frame) for frame in frames)])
    passed = outside <= _OUTSIDE_SHARE
    return Check(
        "camera_range",
        outside,
        _OUTSIDE_SHARE,
        passed,
        f"Up to {100.0 * outside:.0f} % of the pixels of a frame lie outside the range in which the camera is calibrated.",
        "" if passed else "Select the range of the camera that holds the temperatures of the table.",
        _FIGURES,
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


def _frozen(frames: Sequence[Frame]) -> list[Check]:
    """Whether the first, the middle and the last frame are the same image: the noise of a detector never repeats one."""
    if len(frames) < 3:
        return []
    frozen = all(np.array_equal(frames[0].counts, frame.counts) for frame in frames[1:])
    evidence = f"The frames of {frames[0].time}Z, {frames[1].time}Z and {frames[2].time}Z "
    return [
        Check(
            "frozen_camera",
            float(frozen),
            0.0,
            not frozen,
            f"{evidence}{'hold the same image, count for count: the camera was frozen' if frozen else 'are different images'}.",
            "Give the frames of the test; one image, stored again and again, holds no change of temperature."
            if frozen
            else "",
            _FIGURES,
            Severity.CONTRADICTION,
        )
    ]
