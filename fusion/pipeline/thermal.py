"""Thermal stage: camera checked and corrected, plan registered, frames reduced to one field per cycle, omissions noted."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import compress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import xarray as xr

from fusion.alignment.align import camera_on_laser_clock
from fusion.campaign.sources import CameraInputs, Source
from fusion.pipeline.camera import CameraState, clear_frames, examine_camera, survey_campaign
from fusion.pipeline.radiometry import complete_fields, overridden_parameters
from fusion.products.contracts import check
from fusion.products.notices import counted, listed
from fusion.products.progress import Report
from fusion.products.results import Notice, Outcome
from fusion.products.store import write_atomically
from thermography.contract import FIELDS
from thermography.fields.cycle_fields import in_pixels, plan_unit
from thermography.fields.moving import reduce_moving_frames
from thermography.fields.still import reduce_frames
from thermography.fields.tasks.pieces import piece_slices
from thermography.io.openexr import write_maps
from thermography.radiometry.camera_artefacts import DEAD, NOISY, OFFSET, find_bad_pixels
from thermography.radiometry.overrides import Overrides
from thermography.radiometry.planck import calibrate
from thermography.registration.clock_offset import ClockOffset, estimate_clock_offset
from thermography.registration.evidence import RegistrationError
from thermography.registration.picture import register_picture
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration, register

#: Number of first frames whose mean is registered: the noise falls, and the table has hardly warmed.
_REGISTRATION_FRAMES = 5
#: Number of frames above which finished cycles are stored during the reduction; below, this costs more than it saves.
_CHECKPOINT_FRAMES = 2000
#: Number of frames examined for bad pixels: enough to identify a noisy pixel while the table hardly changes.
_PIXEL_FRAMES = 24


def reduce_thermography(source: CameraInputs, *, checkpoint: Path, scheduler: str | None, report: Report) -> Outcome:
    """Check the camera, register the plan on the first frames, and reduce all frames to one field per cycle.

    Parameters
    ----------
    source : CameraInputs
        Inputs of the campaign; a `Source` where the laser gives the cycles.
    checkpoint : Path
        Folder that keeps the finished cycles of a long recording, from which an interrupted run goes on.
    scheduler : str or None
        Address of a dask scheduler for the per-frame work.
    report : callable
        ``report(label, done, total)``, for progress.

    Returns
    -------
    Outcome
        Fields on the laser's clock that keep ``thermography.contract.FIELDS``; parts ``registration``, ``alignment``, ``camera`` and
        ``radiometry``.

    Raises
    ------
    ThermographyError
        If the plan cannot be registered or the clock offset cannot be estimated.
    ContractError
        If the fields break their contract.
    """
    override = Overrides(overridden_parameters(source.thermography))
    survey = survey_campaign(source, override, report=report)
    report("registration", 0, 1)
    # A moving table is somewhere else in the next frame, so its plan is registered on one frame alone.
    first = clear_frames(survey, 1 if source.thermography.table == "moving" else _REGISTRATION_FRAMES)
    reference = np.mean([calibrate(frame.read_counts(), override(frame)) for frame in first], axis=0)
    registration = _register(source, reference)
    report("registration", 1, 1)
    camera = examine_camera(source, survey, registration)
    source, notices = camera.source, camera.notices
    if source.thermography.table == "still":
        notices += pixel_notices(np.stack([frame.read_counts() for frame in source.frames[:_PIXEL_FRAMES]]))
    fields, clock, clock_notices = _reduce_on_clock(
        camera, registration, override, checkpoint=checkpoint, scheduler=scheduler, report=report
    )
    offset_s = clock["value"]
    fields = fields.assign(camera.per_cycle(_bounds(source, offset_s)))
    fields = fields.assign_attrs(
        frames_damaged=json.dumps(
            [f"{Path(one['file']).name}#{one['index']}" for one in camera.part["frames_damaged"]]
        ),
        frames_repeated=json.dumps(
            [f"{one.path.name}#{one.index}" for one in compress(survey.frames, survey.repeated)]
        ),
    )
    fields = fields.assign_coords(cycle=source.cycles.number)
    completed = complete_fields(source, fields, override)
    fields = check(completed.dataset, FIELDS, name="the fields")
    if registration.is_picture:
        fields = in_pixels(fields)
    notices += [*clock_notices, *_registration_notices(registration), *_frame_notices(fields), *completed.notices]
    for name in ("time", "cycle_time", "frame_time"):
        if name in fields.variables:
            moved = camera_on_laser_clock(fields[name].values, offset_s)
            fields[name] = (fields[name].dims, moved, fields[name].attrs)
    fields = fields.assign(_registration_variables(registration, reference))
    parts = {"registration": _registration_part(registration, source), "camera": camera.part, **completed.parts}
    if isinstance(source, Source):
        fields = fields.assign(_target_places(source))
        parts["alignment"] = {"clock_offset_s": clock}
    return Outcome(fields, parts, tuple(notices))


def _register(source: CameraInputs, reference: np.ndarray) -> Registration:
    """Register the plan on the mean of the first frames; a refusal names the file of the fiducials."""
    if source.plan.in_pixels:
        return register_picture(reference.shape)
    moving = source.thermography.table == "moving"
    if moving and any(fiducial.is_point for fiducial in source.fiducials):
        raise RegistrationError(
            f"{source.fiducials_file}: points picked by hand hold for one position of the table only, but thermography.table = "
            '"moving"; paint discs, or use frames of the table at rest'
        )
    try:
        return register(reference, source.fiducials, grid=source.grid, lens=source.lens)
    except RegistrationError as error:
        raise RegistrationError(f"{source.fiducials_file}: {error}") from error


def _reduce_on_clock(
    camera: CameraState,
    registration: Registration,
    override: Overrides,
    *,
    checkpoint: Path,
    scheduler: str | None,
    report: Report,
) -> tuple[xr.Dataset, dict[str, Any], list[Notice]]:
    """Reduce the frames with the clock offset that the campaign gives, that the moving table shows, or that is assumed."""
    source = camera.source
    given = source.thermography.clock_offset_s
    how: dict[str, Any] = {"scheduler": scheduler, "report": report}
    if not isinstance(source, Source):
        # Without a laser the logs are the other clock; an offset that is not stated is none.
        stated_s = given or 0.0
        fields = _reduce(camera, registration, override, stated_s, checkpoint=checkpoint, **how)
        return fields, {"value": stated_s, "u": None}, []
    if given is not None:
        fields = _reduce(camera, registration, override, given, checkpoint=checkpoint, **how)
        return fields, {"value": given, "u": 0.0}, []
    if source.thermography.table == "still":
        fields = _reduce(camera, registration, override, 0.0, checkpoint=checkpoint, **how)
        return fields, {"value": 0.0, "u": None}, [_ASSUMED_CLOCK]
    fields = _reduce(camera, registration, override, 0.0, checkpoint=checkpoint / "before_alignment", **how)
    report("clock offset", 0, 1)
    clock = estimate_clock_offset(
        fields["frame_time"].values,
        fields["table_position"].values,
        fields["table_position_u"].values,
        source.deviations["time"].values,
        source.deviations["position"].broadcast_like(source.deviations["time"]).values.ravel(),
        feed_mm_per_min=source.interferometry.feed_mm_per_min,
    )
    report("clock offset", 1, 1)
    # Frames belong to cycles by the laser's clock, so they are sorted into them again.
    fields = _reduce(camera, registration, override, clock.offset_s, checkpoint=checkpoint, **how)
    return fields, {"value": clock.offset_s, "u": clock.offset_u_s}, clock_notices(clock)


def clock_notices(clock: ClockOffset) -> list[Notice]:
    """Return a notice where the offset of the clocks is one of several that a periodic test shows.

    Parameters
    ----------
    clock : ClockOffset
        Estimated from the motion of the table.
    """
    if not clock.rivals_s:
        return []
    others = listed(f"{offset:.1f} s" for offset in clock.rivals_s)
    return [
        Notice(
            "clock_offset_periodic",
            f"The motion repeats: clock offsets of {others} fit about as well as {clock.offset_s:.1f} s, which is the smallest and was "
            "taken as an assumption.",
            "Write thermography.clock_offset if the clocks may be further apart, or film from before the first reading to after the last.",
        )
    ]


_ASSUMED_CLOCK = Notice(
    "clock_offset_assumed",
    "The clock offset is not given and frames of a still table cannot show it: 0 s was taken.",
    'Write thermography.clock_offset = "0 s" if both clocks were set by the same time server, or the offset that was noted.',
)


def _reduce(
    camera: CameraState,
    registration: Registration,
    override: Overrides,
    offset_s: float,
    *,
    checkpoint: Path,
    scheduler: str | None,
    report: Report,
) -> xr.Dataset:
    """Reduce the frames of a still or moving table, its cycles brought to the camera's clock."""
    source = camera.source
    bounds = _bounds(source, offset_s)
    total, done = len(source.frames), 0

    def count(more: int) -> None:
        nonlocal done
        done += more
        report("frames", done, total)

    report("frames", 0, total)
    kept = checkpoint if total > _CHECKPOINT_FRAMES else None
    common: dict[str, Any] = {
        "override": override,
        "correction_K": camera.correction_K,
        "scheduler": scheduler,
        "checkpoint": kept,
        "progress": count,
    }
    if source.thermography.table == "moving":
        return reduce_moving_frames(
            source.frames, registration, source.grid, bounds, direction=source.direction, **common
        )
    return reduce_frames(source.frames, registration, source.grid, bounds, **common)


def _bounds(source: CameraInputs, offset_s: float) -> np.ndarray:
    """Start and end of every cycle on the camera's clock, (cycles, 2)."""
    return source.cycles.bounds + np.timedelta64(round(offset_s * 1e9), "ns")


def pixel_notices(counts: np.ndarray) -> list[Notice]:
    """Return a notice for pixels that do not follow their neighbours in the first frames, (time, row, column).

    Parameters
    ----------
    counts : (time, row, column) ndarray of uint16
        Raw counts of the first frames of a still table.
    """
    flags = find_bad_pixels(counts)
    count = int(np.count_nonzero(flags))
    if not count:
        return []
    kinds = {"dead": DEAD, "off its neighbours": OFFSET, "noisy": NOISY}
    named = ", ".join(
        f"{int(np.count_nonzero(flags & flag))} {name}" for name, flag in kinds.items() if (flags & flag).any()
    )
    return [
        Notice(
            "bad_pixels",
            f"{counted(count, 'pixel')} do not follow their neighbours ({named}); they are included in the cell averages.",
            "Have the camera replace them (a one-point correction, or its maker's service); single cells may be off by their error.",
        )
    ]


def _registration_variables(registration: Registration, reference: np.ndarray) -> xr.Dataset:
    """Return the registration as variables: the fiducials with their errors, the homography, and the frame it was made on."""
    degrees = {"units": "degC", "units_metadata": "temperature: on_scale"}
    picture = (("row", "column"), reference.astype("f4"), degrees)
    if registration.is_picture:
        return xr.Dataset({"reference_frame": picture})
    names = list(registration.located)
    places = [registration.located[name] for name in names]
    fiducials = [registration.fiducials[name] for name in names]
    along = {
        "fiducial_x": ([fiducial.x_mm for fiducial in fiducials], "mm"),
        "fiducial_y": ([fiducial.y_mm for fiducial in fiducials], "mm"),
        "fiducial_column": ([located.column_px for located in places], "1"),
        "fiducial_row": ([located.row_px for located in places], "1"),
        "fiducial_residual": ([registration.residual_mm[name] for name in names], "mm"),
        "fiducial_leave_one_out": ([registration.leave_one_out_mm[name] for name in names], "mm"),
    }
    variables: dict[str, Any] = {name: ("fiducial", values, {"units": unit}) for name, (values, unit) in along.items()}
    variables["homography"] = (("plan_axis", "sensor_axis"), registration.homography, {"units": "1"})
    variables["reference_frame"] = picture
    variables["fiducial_name"] = ("fiducial", names)
    return xr.Dataset(variables)


def _registration_part(registration: Registration, source: CameraInputs) -> dict[str, Any]:
    """Return the part ``registration`` of results.json."""
    if registration.is_picture:
        return {
            "rms_mm": None,
            "model": registration.model,
            "leave_one_out_mm": {},
            "frames_rejected": source.frames_rejected,
        }
    return {
        "rms_mm": registration.rms_mm,
        "position_u_mm": float(np.sqrt(np.mean(registration.position_u(source.grid.centres_mm) ** 2))),
        "fiducials_listed": sum(fiducial.marker is None for fiducial in source.fiducials),
        "unchecked": list(registration.unchecked),
        "contradicted_hints": registration.contradicted_hints,
        "mirrored": registration.mirrored,
        "area_ratio": registration.area_ratio,
        "span": _span(registration, source.grid),
        "model": registration.model,
        "leave_one_out_mm": registration.leave_one_out_mm,
        "frames_rejected": source.frames_rejected,
    }


def _span(registration: Registration, grid: PlanGrid) -> float:
    """Return the share of the plan that the fiducials in use span."""
    places = [registration.fiducials[name] for name in registration.leave_one_out_mm]
    hull = cv2.convexHull(np.array([(place.x_mm, place.y_mm) for place in places], dtype=np.float32))
    return float(cv2.contourArea(hull)) / (grid.width_mm * grid.height_mm)


def _registration_notices(registration: Registration) -> list[Notice]:
    """Return one notice for all fiducials that were not used."""
    if not registration.left_out:
        return []
    named = "; ".join(f"{name}: {reason}" for name, reason in registration.left_out.items())
    return [
        Notice(
            "fiducials_left_out",
            f"{counted(len(registration.left_out), 'fiducial')} or hints not used: {named}.",
            "Correct the list of fiducials, or clean and repaint the discs; the others carry the registration.",
        )
    ]


#: Attributes of the fields that list frames: sentence that follows their number, remedy.
_FRAME_ATTRIBUTES = {
    "frames_outside_cycles": (
        "belong to no cycle, normal unless the clocks disagree; used for the field at the time of a reading, not in cycle averages",
        "",
    ),
    "knocks": (
        "show that the table moved and did not return; the plan was registered again from there on",
        "Fasten camera and table, and check what happened at that time.",
    ),
    "frames_shaken": ("are displaced alone and were left out", "Shield the camera from vibration."),
    "frames_obstructed": (
        "differ from those before and after them as if something stood before the table, and were left out",
        "Keep hands, trays and doors out of the view while a frame is taken.",
    ),
    "frames_unplaced": (
        "do not show where the table is and were left out",
        "Keep at least three fiducials in view at every axis position.",
    ),
    "frames_unchecked": (
        "have too little contrast to show whether camera or table moved; a displacement would show in the next frame that has more",
        "",
    ),
}


def _frame_notices(fields: xr.Dataset) -> list[Notice]:
    """Return one notice for each kind of frame that the reduction reports."""
    notices = []
    for name, (text, remedy) in _FRAME_ATTRIBUTES.items():
        if name == "frames_unchecked" and plan_unit(fields) == "px":
            continue
        frames = json.loads(fields.attrs.get(name, "[]"))
        if frames:
            named = listed([frame if isinstance(frame, str) else _words(frame) for frame in frames])
            notices.append(Notice(name, f"{counted(len(frames), 'frame')} {text}: {named}.", remedy))
    return notices


def _words(value: Any) -> str:
    """Return a record such as ``{"frame": "a.jpg", "shift_px": [3, 0]}`` as words; folders stay out of it."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name.replace('_', ' ')} {_words(item)}" for name, item in value.items())
    if isinstance(value, list):
        return "(" + ", ".join(_words(item) for item in value) + ")"
    return f"{value:.3g}" if isinstance(value, float) else Path(str(value)).name


def _target_places(source: Source) -> xr.Dataset:
    """Return the plan points of the targets, along ``target``."""
    x, y = source.axis.points(source.deviations["position"].values)
    targets = source.deviations["target"].values
    places = {"target_x": ("target", x, {"units": "mm"}), "target_y": ("target", y, {"units": "mm"})}
    return xr.Dataset(places, coords={"target": targets})


def map_name(cycle: int) -> str:
    """Return the name of the file with the maps of one cycle.

    Parameters
    ----------
    cycle : int
        Number of the cycle, from 1.
    """
    return f"cycle_{cycle:04d}.exr"


def write_exr(folder: Path, fields: xr.Dataset, *, report: Report) -> list[Path]:
    """Write the fields of every cycle as OpenEXR maps and return the files.

    Parameters
    ----------
    folder : Path
        Folder of the maps.
    fields : Dataset
        Content of fields.nc.
    report : callable
        ``report(label, done, total)``, for progress.
    """
    total = fields.sizes["cycle"]
    paths: list[Path] = []
    mapped = fields[["temperature", "temperature_rise", "temperature_u"]]
    for some in piece_slices(mapped["temperature"].shape):
        piece = mapped.isel(cycle=some).load()
        for cycle in piece["cycle"].values:
            report("OpenEXR maps", len(paths), total)
            maps = _exr_maps(piece.sel(cycle=cycle))
            path = folder / map_name(cycle)
            paths.append(write_atomically(path, lambda temporary, maps=maps: write_maps(temporary, maps)))  # type: ignore[misc]
    report("OpenEXR maps", total, total)
    return paths


def _exr_maps(field: xr.Dataset) -> dict[str, np.ndarray]:
    """Return the maps of one cycle for OpenEXR; the mask is 1 where the table was seen."""
    maps = {
        "temperature": field["temperature"],
        "rise": field["temperature_rise"],
        "uncertainty": field["temperature_u"],
        "mask": np.isfinite(field["temperature"]),
    }
    return {name: np.ascontiguousarray(values, dtype="f4") for name, values in maps.items()}
