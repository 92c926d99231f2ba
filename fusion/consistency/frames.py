"""Checks of the frames: settings that change within a series, implausible parameters, temperatures outside the calibrated range."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from fusion.consistency.checks import Check
from thermography.inspection import FileWarning, check_series, share_outside_range
from thermography.io.flir import FrameReference
from thermography.io.frame import FlirFormatError

#: Largest share of the pixels of a frame outside the range in which the camera is calibrated.
_OUTSIDE_SHARE = 0.01
_CHANGING = ("parameters_vary", "several_cameras")
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
        Of settings that change, of implausible parameters, and of the calibrated range (first, middle and last frame).
    """
    if not frames:
        return []
    warnings = check_series(frames, overridden=overridden)
    changing = [warning for warning in warnings if warning.code in _CHANGING]
    ranges = {(frame.limits.minimum_K, frame.limits.maximum_K) for frame in frames}
    if len(ranges) > 1:
        changing.append(FileWarning("range", f"the camera's range changes ({len(ranges)} ranges).", "Use one range."))
    implausible = [warning for warning in warnings if warning.code not in _CHANGING]
    return [
        _collected("camera_settings", changing, "The settings of the camera stay the same over the series."),
        _collected("camera_parameters", implausible, "The stored parameters of the measurement are plausible."),
        _range(frames),
    ]


def _collected(code: str, warnings: Sequence[FileWarning], sound: str) -> Check:
    """One check of several warnings of one kind."""
    evidence = " ".join(f"{warning.message[0].upper()}{warning.message[1:]}" for warning in warnings)
    remedy = " ".join(dict.fromkeys(warning.remedy for warning in warnings))
    return Check(code, float(len(warnings)), 0.0, not warnings, evidence or sound, remedy, _FIGURES)


def _range(frames: Sequence[FrameReference]) -> Check:
    """Share of pixels outside the calibrated range in the first, the middle and the last frame."""
    shares = [0.0]
    for frame in {0: frames[0], 1: frames[len(frames) // 2], 2: frames[-1]}.values():
        try:
            pixels = frame.read()
        except FlirFormatError:
            # A damaged frame is counted where the frames are reduced.
            continue
        shares.append(share_outside_range(pixels))
    outside = max(shares)
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
