"""Checks of the registration: fiducials that are missing or unchecked, hints that contradict, a plan of another size or mirrored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fusion.consistency.checks import Check
from thermography.io.frame import FrameReference
from thermography.radiometry.planck import calibrate
from thermography.registration.displacement import image_displacement
from thermography.registration.picture import picture_grid, register_picture

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
#: Largest shift of a picture that is its own plan, px: a part that warms shifts the best match of two pictures by up to one.
_LARGEST_SHIFT_PX = 2.0
#: Number of frames, spread over the series, that are compared.
_COMPARED = 8
_FIGURES = (
    "the place of every temperature on the plan, rises along the measured line, and every cause that follows the field"
)


def check_registration(registration: Mapping[str, Any], *, file: str) -> list[Check]:
    """Check what the registration found.

    Parameters
    ----------
    registration : mapping
        Part ``registration`` of results.json.
    file : str
        The list of fiducials, as the campaign names it.

    Returns
    -------
    list of Check
        Of the share that agrees, of fiducials that the others do not check, of hints, of diameters against the scale of the places, of
        the plan's size, and of a plan seen as in a mirror.
    """
    used, listed = list(registration["leave_one_out_mm"]), int(registration["fiducials_listed"])
    unchecked, hints = list(registration["unchecked"]), list(registration["contradicted_hints"])
    share, against = len(used) / listed, len(hints) / len(used)
    return [
        Check(
            "fiducials_found",
            share,
            _LEAST_FOUND,
            share >= _LEAST_FOUND,
            f"{len(used)} of the {listed} fiducials of {file} are in view and agree.",
            ""
            if share >= _LEAST_FOUND
            else f"Check that {file} belongs to this table, and clean or repaint the discs.",
            _FIGURES,
        ),
        Check(
            "fiducials_unchecked",
            float(len(unchecked)),
            0.0,
            not unchecked,
            f"If {', '.join(unchecked)} stood elsewhere than {file} says, the other fiducials would not show it."
            if unchecked
            else "Every fiducial is checked by the others.",
            f"Measure the places of {', '.join(unchecked)} again, and paint and list more discs: six or more, over the whole plan."
            if unchecked
            else "",
            _FIGURES,
        ),
        Check(
            "fiducial_hints",
            against,
            _LARGEST_CONTRADICTED,
            against <= _LARGEST_CONTRADICTED,
            f"{len(hints)} of {len(used)} fiducials lie more than 25 px from their column_px, row_px in {file}.",
            ""
            if against <= _LARGEST_CONTRADICTED
            else f"Read column_px, row_px of {file} off a frame of this series, or remove them; check that the names belong to the places.",
            _FIGURES,
        ),
        _diameters(registration["area_ratio"], file),
        _span(registration["span"], file),
        _mirrored(bool(registration["mirrored"]), file),
    ]


def _mirrored(mirrored: bool, file: str) -> Check:
    """Sense in which the plan turns in the frames."""
    return Check(
        "plan_mirrored",
        float(mirrored),
        0.0,
        not mirrored,
        f"The plan of {file} appears mirrored in the frames."
        if mirrored
        else "The plan turns in the frames as it is drawn.",
        "Check the signs of x_mm and y_mm, and [plan.axis]; if the plan is drawn with y upwards, accept this doubt."
        if mirrored
        else "",
        "place and direction of the measured line on the plan, and every cause that follows the field",
    )


def _span(span: float, file: str) -> Check:
    """Size of the plan against the area that the fiducials span."""
    wide = span >= _LEAST_SPAN
    return Check(
        "fiducials_span",
        span,
        _LEAST_SPAN,
        wide,
        f"The fiducials in use span {100 * span:.0f} % of the plan.",
        ""
        if wide
        else f"Check size under [plan], and that {file} belongs to this table; else paint discs over the whole plan.",
        _FIGURES,
    )


def check_picture(frames: Sequence[FrameReference]) -> list[Check]:
    """Check that the picture stays where it is, where the picture itself is the plan.

    Parameters
    ----------
    frames : sequence of FrameReference
        Usable frames, at least one, sorted by time.

    Returns
    -------
    list of Check
        ``camera_place``: the largest shift of the picture against the first frame, in some frames over the series.
    """
    chosen = np.unique(np.linspace(0, len(frames) - 1, _COMPARED).round().astype(int))
    first, *later = (calibrate(frames[k].read_counts(), frames[k].parameters) for k in chosen)
    registration, grid = register_picture(first.shape), picture_grid(first.shape)
    shifts_px = [float(np.linalg.norm(image_displacement(first, frame, registration, grid))) for frame in later]
    measured = [shift for shift in shifts_px if np.isfinite(shift)]
    largest, blind = max(measured, default=0.0), len(shifts_px) - len(measured)
    # Pictures of little contrast, or of what warms a lot, have little in common without a shift; where all are so, nothing is shown.
    passed = bool(measured) and largest <= _LARGEST_SHIFT_PX
    compared = f"{len(later)} of {len(frames) - 1} later frames were compared with the first"
    unlike = f"; in {blind} of them too little is as in the first to tell" if blind else ""
    return [
        Check(
            "camera_place",
            largest,
            _LARGEST_SHIFT_PX,
            passed,
            f"The picture shifts by up to {largest:.1f} px ({compared}{unlike})."
            if measured
            else f"Whether the picture stays is not shown: {compared}, and in none of them is enough as in the first (too little contrast, "
            "or another scene).",
            ""
            if passed
            else "Fasten camera and table: without fiducials a cell is a place in the picture, and shows something else when that moves.",
            "what a cell shows, its rise, and the hotspots",
        )
    ]


def _diameters(area_ratio: float | None, file: str) -> Check:
    """Diameters of the discs against the scale of their places; points without a disc pass."""
    ratio = 1.0 if area_ratio is None or not np.isfinite(area_ratio) else float(area_ratio)
    agree = abs(np.log(ratio)) <= np.log(_LARGEST_AREA_RATIO)
    return Check(
        "fiducial_diameters",
        ratio,
        _LARGEST_AREA_RATIO,
        bool(agree),
        f"By the scale of x_mm, y_mm the discs in view have {ratio:.3f} times the area that diameter_mm of {file} says.",
        "" if agree else f"Measure a disc and a distance between two of them, and correct {file}; focus the camera.",
        _FIGURES,
    )
