"""Which tables a campaign file needs: any subset of the two instruments, with the plan where temperatures have places; or a record."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fusion.campaign.messages import Place

#: Keys of ``[plan]`` without which frames cannot be brought to it.
_NEEDED_BY_FRAMES = ("cell_size", "fiducials")
#: Keys of ``[plan]`` in millimetres, which a plan of pixels does not have, and why not.
_IN_MILLIMETRES = {
    "size": "the plan is the whole picture",
    "cell_size": 'cells are in pixels: write cell_px = "4 px"',
    "fiducials": "fiducials bring a plan to millimetres",
    "regions": "its corners are in millimetres",
    "axis": "the measured line is in millimetres",
}


def check_tables(content: Mapping[str, Any], place: Place) -> list[str]:
    """Return the faults of a campaign that holds neither an instrument nor a record, or tables that lack those they build on.

    Parameters
    ----------
    content : mapping
        The campaign file as TOML reads it.
    place : callable
        From the path of a key to file and line.

    Returns
    -------
    list of str
        One sentence per fault.
    """
    if "path" in content:
        return [f"{place(('path',))}: unknown key path; remove it"]
    if "record" in content:
        beside = [name for name in ("thermography", "plan", "interferometry", "sensors") if name in content]
        if beside:
            return [
                f"{place(('record',))}: [record] stands instead of [{'], ['.join(beside)}]; "
                "remove one or the other, a record is analysed on its own"
            ]
        return []
    if "thermography" not in content and "interferometry" not in content:
        return [
            f"{place(())}: there is no instrument; a campaign needs [interferometry], or [thermography] with [plan], or all three; "
            "or a [record] instead"
        ]
    faults = []
    placed = next((name for name in ("thermography", "sensors") if name in content), None)
    if placed is not None and "plan" not in content:
        faults.append(
            f"{place((placed,))}: [{placed}] needs the table [plan], on which its temperatures are placed; add it"
        )
    return [*faults, *_check_plan(content, place), *_check_window(content, place)]


def _check_plan(content: Mapping[str, Any], place: Place) -> list[str]:
    """Return what the plan lacks for the instruments that are there."""
    plan = content.get("plan")
    if not isinstance(plan, dict):
        return []
    if plan.get("registration") == "pixels":
        return _check_plan_of_pixels(content, plan, place)
    needed = ["size", *(_NEEDED_BY_FRAMES if "thermography" in content else ())]
    if "cell_px" in plan:
        return [
            f'{place(("plan", "cell_px"))}: cell_px belongs to a plan of pixels; write registration = "pixels", or cell_size in mm'
        ]
    frames = content.get("thermography")
    moving = isinstance(frames, dict) and frames.get("table") == "moving"
    if moving or ("interferometry" in content and ("thermography" in content or "sensors" in content)):
        needed.append("axis")
    return [
        f"{place(('plan',))}: [plan] lacks {name}; add it, see the campaign file in the README"
        for name in needed
        if name not in plan
    ]


def _check_plan_of_pixels(content: Mapping[str, Any], plan: Mapping[str, Any], place: Place) -> list[str]:
    """Return the faults of a plan that is the picture itself: what is in millimetres has no place on it."""
    faults = [
        f'{place(("plan", name))}: plan.{name} beside plan.registration = "pixels": {why}; remove one of them'
        for name, why in _IN_MILLIMETRES.items()
        if name in plan
    ]
    frames = content.get("thermography")
    if not isinstance(frames, dict):
        return [
            *faults,
            f'{place(("plan", "registration"))}: registration = "pixels" makes the picture of a camera the plan, and there is no '
            "[thermography]; write size and axis in mm instead",
        ]
    remedy = 'write registration = "fiducials" with at least four places on the table that are known in mm'
    needing = {
        "interferometry": "[interferometry] needs the measured line on the plan, in mm",
        "sensors": "[sensors] needs the places of the sensors on the plan, in mm",
    }
    faults += [
        f'{place((name,))}: plan.registration = "pixels", but {why}; {remedy}'
        for name, why in needing.items()
        if name in content
    ]
    in_millimetres = {
        "lens": "the calibration of a lens serves to bring a picture to millimetres",
        "region": "the corners of a region are in mm",
    }
    faults += [
        f'{place(("thermography", name))}: plan.registration = "pixels", but {why}; {remedy}, or remove the key'
        for name, why in in_millimetres.items()
        if name in frames
    ]
    if frames.get("table") == "moving":
        faults.append(
            f'{place(("thermography", "table"))}: plan.registration = "pixels" holds for a table at rest, but table = "moving"; '
            f"{remedy}, or frames of the table at rest"
        )
    return faults


def _check_window(content: Mapping[str, Any], place: Place) -> list[str]:
    """Return the fault of a window of frames beside readings, whose cycles take its place."""
    frames = content.get("thermography")
    if isinstance(frames, dict) and "window" in frames and "interferometry" in content:
        return [
            f"{place(('thermography', 'window'))}: thermography.window divides the frames where no laser gives cycles; "
            "here [interferometry] does: remove the key"
        ]
    return []
