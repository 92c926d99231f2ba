"""Files of temperatures of other cameras in a campaign: what ``[thermography.stack]`` says of them, and what it leaves open."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fusion.campaign.config import Campaign, CampaignError, StackTable, ThermographyTable
from fusion.products.results import Notice
from interferometry.io.dates import DateOrder, parse_time
from interferometry.io.delimited import read_table
from interferometry.io.faults import BadReading
from thermography.io.frame import FrameReference
from thermography.io.temperature_frames import StackOptions, TemperatureFrame, to_utc

_ZERO_CELSIUS_K = 273.15


def stack_options(campaign: Campaign) -> StackOptions:
    """Return what a campaign file says of files of temperatures.

    Parameters
    ----------
    campaign : Campaign
        With or without ``[thermography.stack]``.

    Returns
    -------
    StackOptions

    Raises
    ------
    CampaignError
        ``start`` is no time, or the table of times cannot be used.
    """
    table = None if campaign.thermography is None else campaign.thermography.stack
    if table is None:
        return StackOptions()
    reflected = table.reflected_temperature_degC
    return StackOptions(
        unit=table.unit or "",
        scale=table.scale,
        offset=table.offset,
        variable=table.variable,
        time_in_name=table.time_in_name,
        times=None if table.times is None else _read_times(campaign.resolve(table.times), table),
        start=None if table.start is None else _instant(campaign.path, table.start, table.time_zone),
        interval_s=table.interval_s,
        time_zone=table.time_zone,
        emissivity=1.0 if table.emissivity is None else table.emissivity,
        reflected_temperature_K=(20.0 if reflected is None else reflected) + _ZERO_CELSIUS_K,
    )


def _instant(path: Path, text: str, zone: str, order: DateOrder | None = None) -> np.datetime64:
    try:
        time, given = parse_time(text, order)
    except BadReading as fault:
        raise CampaignError(f"{path}: the time {text!r} of a frame {fault.reason}") from None
    return time if given else to_utc(path, time.astype("datetime64[us]").item(), zone)


def _read_times(path: Path, table: StackTable) -> dict[tuple[str, int], np.datetime64]:
    """Return UTC by file name and frame from a table with the columns file, time and, for files of several frames, frame (from 0)."""
    read = read_table(path, ("file", "time"))
    rows = [(line, fields) for line, fields in read.records() if fields is not None]
    order = DateOrder.of(path, [(line, fields["time"]) for line, fields in rows])
    times: dict[tuple[str, int], np.datetime64] = {}
    for line, fields in rows:
        index = fields.get("frame", "0") or "0"
        if not index.isdecimal():
            raise CampaignError(
                f"{path}, line {line}: frame {index!r} is no whole number; frames of a file are counted from 0"
            )
        times[Path(fields["file"]).name, int(index)] = _instant(path, fields["time"], table.time_zone, order)
    return times


def camera_accuracy_notices(table: ThermographyTable, frames: Sequence[FrameReference]) -> list[Notice]:
    """Return notices of what was assumed of a camera whose files hold temperatures.

    Parameters
    ----------
    table : ThermographyTable
        ``[thermography]`` of the campaign.
    frames : sequence of FrameReference
        Of the campaign.

    Returns
    -------
    list of Notice
        Empty for cameras whose files hold counts, and where the accuracy is stated.
    """
    if not any(isinstance(frame, TemperatureFrame) for frame in frames):
        return []
    notices = []
    if table.camera_offset_u_K is None:
        notices.append(
            Notice(
                "camera_accuracy_assumed",
                "The files hold temperatures and not what camera took them: the accuracy of an uncooled camera was assumed.",
                'Write the accuracy of its data sheet under [thermography], for example camera_offset_u = "1 K" and camera_scale_u = 0.01.',
            )
        )
    if table.stack is None or table.stack.emissivity is None:
        notices.append(
            Notice(
                "stack_emissivity_unknown",
                "The emissivity with which the camera's program calculated the temperatures is not stated; they are taken as they are.",
                "Write emissivity and reflected_temperature under [thermography.stack] as they were set in the camera.",
            )
        )
    return notices
