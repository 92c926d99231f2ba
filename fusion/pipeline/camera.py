"""The camera before the fields are made: damaged frames are left out, steps and drift of its zero are taken out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from fusion._typing import Array
from fusion.alignment.align import camera_on_laser_clock
from fusion.campaign.config import relative_name
from fusion.campaign.inputs import SourceError, frames_notices
from fusion.campaign.sources import CameraInputs
from fusion.products.notices import counted, listed
from fusion.products.progress import Report
from fusion.products.results import Notice
from thermography.errors import ThermographyError
from thermography.fields.survey import LEAST_BESIDE, Blocks, Survey, disturbed_frames, locate_blocks, survey_frames
from thermography.io.frame import FrameReference, RejectedFrame
from thermography.radiometry.camera_artefacts import find_repeats
from thermography.radiometry.camera_correction import (
    CameraCorrection,
    LevelSeries,
    estimate_correction,
    hold_constant,
    room_temperatures,
)
from thermography.radiometry.overrides import Overrides
from thermography.radiometry.planck import ZERO_CELSIUS_K, signal_slope
from thermography.registration.register import Registration

#: Uncertainty of the camera's zero from which it is named, K: as large as the steps that many cameras make.
_NAMED_U_K = 0.1
#: Largest number of positions at which a moving table is laid out.
_POSITIONS = 21


@dataclass(frozen=True, eq=False)
class CameraState:
    """What the frames of a campaign show of their camera.

    Attributes
    ----------
    source : CameraInputs
        Inputs with the usable frames only.
    correction_K : (frames,) ndarray, K, or None
        To be added to the temperature of every usable frame; None where nothing is corrected.
    u_K : (frames,) ndarray, K
        Standard uncertainty of the camera's zero since the first frame, common to the whole frame; 0 where only the table is in view.
    part : dict
        Part ``camera`` of results.json.
    notices : list of Notice
        What was left out, corrected, or cannot be told apart.
    """

    source: CameraInputs
    correction_K: Array | None
    u_K: Array
    part: dict[str, Any]
    notices: list[Notice]

    def per_cycle(self, bounds: Array) -> xr.Dataset:
        """Mean correction and uncertainty of every cycle, its bounds (cycles, 2) on the camera's clock.

        Returns
        -------
        Dataset
            ``camera_correction`` and ``camera_correction_u``, (cycle,), K; NaN for a cycle without a frame.
        """
        times = self.source.frame_times
        correction = np.zeros(len(times)) if self.correction_K is None else self.correction_K
        values = np.full((2, len(bounds)), np.nan)
        for cycle, (start, end) in enumerate(bounds):
            inside = (times >= start) & (times < end)
            if inside.any():
                values[:, cycle] = correction[inside].mean(), np.sqrt(np.mean(self.u_K[inside] ** 2))
        kelvin = {"units": "K", "units_metadata": "temperature: difference"}
        return xr.Dataset(
            {
                "camera_correction": (
                    "cycle",
                    values[0],
                    {
                        "long_name": "correction of the camera's zero since the first frame, contained in the temperatures",
                        "ancillary_variables": "camera_correction_u",
                        **kelvin,
                    },
                ),
                "camera_correction_u": (
                    "cycle",
                    values[1],
                    {
                        "long_name": "standard uncertainty of the camera's zero since the first frame after the correction",
                        "comment": "common to all cells of a frame",
                        **kelvin,
                    },
                ),
            }
        )


def survey_campaign(source: CameraInputs, override: Overrides, *, report: Report) -> Survey:
    """Read all frames of a campaign once.

    Parameters
    ----------
    source : CameraInputs
        Inputs of the campaign.
    override : Overrides
        Camera parameters that the campaign states.
    report : callable
        ``report(label, done, total)``, for progress.

    Returns
    -------
    Survey

    Raises
    ------
    ThermographyError
        If the pixels of no frame are intact.
    """
    total, done = len(source.frames), 0

    def count(more: int) -> None:
        nonlocal done
        done += more
        report("camera check", done, total)

    report("camera check", 0, total)
    patch = source.thermography.reference_patch_px
    survey = survey_frames(
        source.frames,
        override,
        still=source.thermography.table == "still",
        patch=None if patch is None else (slice(patch[1], patch[1] + patch[3]), slice(patch[0], patch[0] + patch[2])),
        progress=count,
    )
    if not survey.frames:
        raise ThermographyError(
            f"the pixels of all {total} frames are damaged ({survey.damaged[0].reason}); copy the files again from the camera"
        )
    return survey


def clear_frames(survey: Survey, most: int) -> list[FrameReference]:
    """First frames that nothing tells from those before and after them.

    Parameters
    ----------
    survey : Survey
    most : int
        Largest number of frames.
    """
    clear = [frame for index, frame in enumerate(survey.frames) if index not in survey.off]
    return (clear or survey.frames)[:most]


def examine_camera(source: CameraInputs, survey: Survey, registration: Registration) -> CameraState:
    """Leave damaged frames out, and estimate what the camera adds to all pixels alike.

    Parameters
    ----------
    source : CameraInputs
        Inputs of the campaign.
    survey : Survey
        Of its frames.
    registration : Registration
        Of the table at rest.

    Returns
    -------
    CameraState

    Raises
    ------
    SourceError
        The reference patch shows a part of the plan, whose warming it would take out.
    """
    blocks = locate_blocks(survey, registration, source.grid, _travel_shifts(source))
    _refuse_patch_on_plan(source, blocks)
    # What changes fast in a picture of which nothing is known may be what was to be seen: only a table is known to change slowly.
    disturbed = (
        {} if registration.is_picture else disturbed_frames(survey, blocks, still=source.thermography.table == "still")
    )
    left_out = [
        *survey.damaged,
        *(RejectedFrame(survey.frames[i].path, survey.frames[i].index, reason) for i, reason in disturbed.items()),
    ]
    kept = np.array([index not in disturbed for index in range(len(survey.frames))])
    frames = [frame for frame, keep in zip(survey.frames, kept, strict=True) if keep]
    rejected = [_as_json(item, source.campaign.folder) for item in left_out]
    usable = replace(source, frames=frames, frames_rejected=[*source.frames_rejected, *rejected])
    notices = [*frames_notices(rejected, "frames_damaged"), *_repeat_notices(survey)]
    levels = _levels(survey, blocks, kept)
    if levels is None:
        part = {"frames_checked": len(source.frames), "frames_damaged": rejected, "steps": ()}
        part |= {"drift_K": 0.0, "largest_correction_K": 0.0, "largest_u_K": None}
        beside = _NOTHING_BESIDE_A_PICTURE if registration.is_picture else _NOTHING_BESIDE
        return CameraState(usable, None, np.zeros(len(frames)), part, [*notices, beside])
    background, table, spread = levels
    if survey.patch is not None:
        background = survey.patch[kept]
        correction = hold_constant(background)
    else:
        correction = estimate_correction(_series(usable, background, table))
    # The camera errs in counts: by less kelvin where the table is warmer than what lies beside it.
    parameters = frames[0].parameters
    at_table = signal_slope(table + ZERO_CELSIUS_K, parameters)
    share = signal_slope(background + ZERO_CELSIUS_K, parameters) / at_table
    uneven = np.abs(signal_slope(table + spread + ZERO_CELSIUS_K, parameters) / at_table - 1.0)
    u_K = share * np.hypot(correction.u_K, uneven * correction.correction_K)
    part = {
        "frames_checked": len(source.frames),
        "frames_damaged": rejected,
        "steps": [
            {"time": _time(frames[step.index]), "step_K": {"value": step.value_K, "u": step.u_K}}
            for step in correction.steps
        ],
        "drift_K": float(np.ptp(correction.drift_K)),
        "largest_correction_K": float(np.abs(share * correction.correction_K).max()),
        "largest_u_K": float(u_K.max()),
    }
    return CameraState(
        usable,
        share * correction.correction_K if correction.corrects else None,
        u_K,
        part,
        [*notices, *_correction_notices(correction, frames, float(u_K.max()))],
    )


def _travel_shifts(source: CameraInputs) -> Array:
    """Places between which a moving table travels, (positions, 2) mm on the plan; none of a table at rest."""
    if source.thermography.table != "moving":
        return np.zeros((0, 2))
    travel = source.travel_mm
    return np.asarray(np.linspace(-travel, travel, _POSITIONS)[:, None] * np.array(source.direction))


def camera_corrected(part: Mapping[str, Any]) -> bool:
    """Whether thermograms were left out or corrected.

    Parameters
    ----------
    part : mapping
        Part ``camera`` of results.json.
    """
    return bool(part["frames_damaged"] or part["steps"] or part["drift_K"])


def _refuse_patch_on_plan(source: CameraInputs, blocks: Blocks) -> None:
    """Refuse a reference patch that shows the plan: what warms there is the table, not the camera."""
    patch = source.thermography.reference_patch_px
    if patch is None:
        return
    column, row, columns, rows = patch
    share = float(blocks.plan_px[row : row + rows, column : column + columns].mean())
    if share > 0.0:
        raise SourceError(
            f"{source.campaign.path}: thermography.reference_patch = {list(patch)}: {100.0 * share:.0f} % of its pixels show the plan in "
            "some frame, so that the warming of the table would be taken for a drift of the camera; choose a surface of constant "
            "temperature beside the plan, or leave the key out"
        )


def _as_json(item: RejectedFrame, folder: Path) -> dict[str, Any]:
    """A frame that was left out as it stands in results.json."""
    reason = item.reason.replace(f"{folder}/", "")
    return {"file": relative_name(item.path, folder), "index": item.index, "reason": reason}


def _levels(survey: Survey, blocks: Blocks, kept: Array) -> tuple[Array, Array, Array] | None:
    """Level of what lies beside the table, mean and spread of the table, (frames,) degC and K; None where nothing lies beside it."""
    beside = survey.levels[kept][:, blocks.beside].astype(float)
    beside = beside[:, np.isfinite(beside).all(axis=0)]
    if beside.shape[1] < LEAST_BESIDE:
        return None
    middle = np.median(beside, axis=0)
    # People and warm parts move in some of the blocks; the quieter half shows the room and the camera.
    restless = np.median(np.abs(beside - middle), axis=0)
    quiet = restless <= np.median(restless)
    background = np.median(beside[:, quiet] - middle[quiet], axis=1) + float(np.median(middle[quiet]))
    chosen = blocks.table if blocks.table.any() else ~blocks.beside
    table = survey.levels[kept][:, chosen].astype(float)
    return background, np.nanmean(table, axis=1), np.nanstd(table, axis=1)


def _series(source: CameraInputs, background: Array, table: Array) -> LevelSeries:
    """The levels with the temperatures inside the camera and of the room."""
    frames, times = source.frames, source.frame_times
    seconds = (times - times[0]) / np.timedelta64(1, "s")
    sensors = [name for name in frames[0].housekeeping if all(name in frame.housekeeping for frame in frames)]
    housing = np.array([[frame.housekeeping[name] for name in sensors] for frame in frames], float)
    room = np.zeros((len(frames), 0))
    if source.environment is not None and "air_temperature" in source.environment:
        log = source.environment
        # The log is on the laser's clock; the room changes too slowly for a clock that is still to be found to matter.
        on_laser = camera_on_laser_clock(times, source.thermography.clock_offset_s or 0.0)
        logged = (log["time"].values - on_laser[0]) / np.timedelta64(1, "s")
        air = log["air_temperature"].values
        room = room_temperatures((on_laser - on_laser[0]) / np.timedelta64(1, "s"), logged, air)
    return LevelSeries(seconds, background, table, housing.reshape(len(frames), -1), room)


def _repeat_notices(survey: Survey) -> list[Notice]:
    """Return one notice for frames that the camera wrote twice."""
    flags = find_repeats(survey.repeated, np.array([frame.time for frame in survey.frames], "datetime64[ms]"))
    if not flags:
        return []
    named = [f"{np.datetime_as_string(flag.time, unit='s')}Z: {flag.message}" for flag in flags]
    return [
        Notice(
            "frames_repeated",
            f"The camera wrote frames more than once: {listed(named)}.",
            "Compare the times of the frames with the camera's own list; a frozen output shows no change of temperature.",
        )
    ]


_NOTHING_BESIDE = Notice(
    "camera_unchecked",
    "Nothing but the table is in view, so that steps and drift of the camera's zero cannot be told from its warming.",
    "Leave a margin around the table in view.",
)


_NOTHING_BESIDE_A_PICTURE = Notice(
    "camera_unchecked",
    "The whole picture is the plan, so that nothing beside it shows steps and drift of the camera's zero, which look like a rise of all "
    "that is in the picture.",
    'State the drift as thermography.camera_drift_u = "0.2 K", or give a plan in mm that leaves a margin of the picture.',
)


def _correction_notices(correction: CameraCorrection, frames: Sequence[FrameReference], u_K: float) -> list[Notice]:
    """Return one notice each for steps, for a drift, and for what cannot be told apart."""
    notices = []
    if correction.steps:
        named = [f"{step.value_K:+.2f} K at {_time(frames[step.index])}" for step in correction.steps]
        notices.append(
            Notice(
                "camera_steps_corrected",
                f"{counted(len(correction.steps), 'step')} of the camera's zero (flat-field correction, FFC) taken out of all frames that "
                f"follow: {listed(named)}. The correction is uncertain by up to {u_K:.2g} K.",
                "Let the camera warm up before the test, and make its flat-field corrections between the cycles.",
            )
        )
    if correction.drift_K.any():
        notices.append(
            Notice(
                "camera_drift_corrected",
                f"A drift of the camera's zero of {np.ptp(correction.drift_K):.2f} K, as the reference patch or the temperature of the "
                "housing shows it, was taken out.",
                "Switch the camera on an hour before the test.",
            )
        )
    unexplained = float(np.abs(correction.unexplained_K).max())
    if u_K > _NAMED_U_K:
        notices.append(
            Notice(
                "camera_drift_undetermined",
                f"What lies beside the table changed by {unexplained:.2f} K for which neither a logged air temperature nor "
                "the camera accounts. A drift of the camera of this size cannot be told from warming; rises are uncertain by up to "
                f"{u_K:.2g} K.",
                "Log the air temperature, and keep a surface of constant temperature in view.",
            )
        )
    return notices


def _time(frame: FrameReference) -> str:
    """Time of a frame to the second, UTC."""
    return f"{np.datetime_as_string(frame.time, unit='s')}Z"
