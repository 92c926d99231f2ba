"""Which tables a campaign file needs: any subset of the two instruments, with the plan where temperatures have places; or a record."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fusion.campaign.messages import Place

#: Keys of ``[plan]`` without which frames cannot be brought to it.
_NEEDED_BY_FRAMES = ("cell_size", "fiducials")


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
    needed = list(_NEEDED_BY_FRAMES) if "thermography" in content else []
    frames = content.get("thermography")
    moving = isinstance(frames, dict) and frames.get("table") == "moving"
    if moving or ("interferometry" in content and ("thermography" in content or "sensors" in content)):
        needed.append("axis")
    return [
        f"{place(('plan',))}: [plan] lacks {name}; add it, see the campaign file in the README"
        for name in needed
        if name not in plan
    ]


def _check_window(content: Mapping[str, Any], place: Place) -> list[str]:
    """Return the fault of a window of frames beside readings, whose cycles take its place."""
    frames = content.get("thermography")
    if isinstance(frames, dict) and "window" in frames and "interferometry" in content:
        return [
            f"{place(('thermography', 'window'))}: thermography.window divides the frames where no laser gives cycles; "
            "here [interferometry] does: remove the key"
        ]
    return []
