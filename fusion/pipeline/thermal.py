"""Thermal stage: camera checked and corrected, plan registered, frames reduced to one field per cycle, omissions noted."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import compress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.align import camera_on_laser_clock
from fusion.analysis.consistency.material import rise_share_u, share_of_zero
from fusion.analysis.consistency.series import FieldSeries, field_at, thin_fields
from fusion.campaign.config import RegionTable, ThermographyTable
from fusion.campaign.inputs import (
    OVERRIDABLE,
    CameraInputs,
    Source,
    SourceError,
    frames_notices,
    left_out_frame,
    overridden_parameters,
)
from fusion.campaign.time_zones import utc
from fusion.common import Array
from fusion.results.axis import AlignmentPart, CameraPart, CameraStepPart, RegistrationPart
from fusion.results.parts import BudgetEntry, FieldPart, Quantity, RadiometryPart, SurfacePart, TwoParts
from fusion.results.progress import Report, counted, listed
from fusion.results.results import Notice, Outcome, Parts
from fusion.results.store import check
from thermography.common import FIELDS, ZERO_CELSIUS_K, ThermographyError
from thermography.fields import total_uncertainty
from thermography.fields.cycle_fields import CLIPPED, annotate, cycles_with_field, reference_cycle
from thermography.fields.moving import reduce_moving_frames
from thermography.fields.objects import describe_unnamed_surfaces, leave_out_objects
from thermography.fields.still import reduce_frames
from thermography.fields.survey import (
    LEAST_SURROUNDING_BLOCKS,
    Blocks,
    DiscLevels,
    Survey,
    disturbed_frames,
    locate_blocks,
    read_discs,
    survey_frames,
)
from thermography.io.files import write_maps
from thermography.io.frame import CameraParameters, FrameReference, RejectedFrame
from thermography.large_arrays import in_pieces, piece_slices
from thermography.radiometry.camera import (
    DEAD,
    NOISY,
    OFFSET,
    CameraCorrection,
    Detector,
    LevelSeries,
    estimate_correction,
    find_repeats,
    hold_constant,
    room_temperatures,
)
from thermography.radiometry.planck import Overrides, calibrate, override, signal_slope
from thermography.radiometry.uncertainty import (
    KNOWN_PAINT_U,
    LEAST_OF_PAINTS,
    InputUncertainty,
    common_contributions,
    rise_scale_contributions,
)
from thermography.registration.clock_offset import ClockOffset, estimate_clock_offset
from thermography.registration.plan import Polygon
from thermography.registration.register import Registration, RegistrationError, register, with_optics_of

# The camera before the fields are made: damaged frames are left out, steps and drift of its zero are taken out.

#: Uncertainty of the camera's zero from which it is named, K: as large as the steps that many cameras make.
_NAMED_U_K = 0.1
#: Largest number of positions at which a moving table is laid out.
_POSITIONS = 21


@dataclass(frozen=True, eq=False)
class CameraState:
    """What the usable frames of a campaign show of their camera.

    Attributes
    ----------
    correction_K : (frames,), to be added to the temperature of every usable frame; None where nothing is corrected
    u_K : (frames,) ndarray, K
        Standard uncertainty of the camera's zero since the first frame, common to the whole frame; 0 where only the table is in view.
    surroundings_K : (frames,) ndarray, K
        Largest change of the surroundings of the table up to every frame after the correction: no zero changes by more. Infinite where
        they are not in view.
    reflected_u_K : (frames,) ndarray or None, K
        Standard uncertainty of the change of the reflected temperature since the first frame; None where neither log nor discs show it.
    zero : (time,) DataArray or None, K
        What a material sensor shows of the change of the zero that is left, at times on the laser's clock.
    part, notices
        Part ``camera`` of results.json, and what was left out, corrected, or cannot be distinguished.
    """

    source: CameraInputs
    correction_K: Array | None
    u_K: Array
    surroundings_K: Array
    reflected_u_K: Array | None
    part: CameraPart
    notices: list[Notice]
    zero: xr.DataArray | None = None

    def per_cycle(self, bounds: Array) -> xr.Dataset:
        """Mean correction and uncertainty of every cycle, its bounds (cycles, 2) on the camera's clock."""
        times = self.source.frame_times
        correction = np.zeros(len(times)) if self.correction_K is None else self.correction_K
        reflected = np.zeros(len(times)) if self.reflected_u_K is None else self.reflected_u_K
        values = np.full((3, len(bounds)), np.nan)
        for cycle, (start, end) in enumerate(bounds):
            inside = (times >= start) & (times < end)
            if inside.any():
                u, reflected_u = (np.sqrt(np.mean(one[inside] ** 2)) for one in (self.u_K, reflected))
                values[:, cycle] = correction[inside].mean(), u, reflected_u
        found = dict(zip(("camera_correction", "camera_correction_u", "reflected_change_u"), values, strict=True))
        if self.reflected_u_K is None:
            del found["reflected_change_u"]
        return xr.Dataset({name: ("cycle", one) for name, one in found.items()})


def counter(report: Report, label: str, total: int) -> Callable[[int], None]:
    """Report the beginning of a step; return what counts its parts and reports them."""
    done = 0

    def count(more: int) -> None:
        nonlocal done
        done += more
        report(label, done, total)

    count(0)
    return count


def survey_campaign(source: CameraInputs, override: Overrides, *, report: Report) -> Survey:
    """Read all frames of a campaign once."""
    total = len(source.frames)
    patch = source.thermography.reference_patch_px
    survey = survey_frames(
        source.frames,
        override,
        still=source.thermography.table == "still",
        patch=None if patch is None else (slice(patch[1], patch[1] + patch[3]), slice(patch[0], patch[0] + patch[2])),
        progress=counter(report, "camera check", total),
    )
    if not survey.frames:
        raise ThermographyError(
            f"the pixels of all {total} frames are damaged ({survey.damaged[0].reason}); copy the files again from the camera"
        )
    return survey


def clear_frames(survey: Survey, most: int) -> list[FrameReference]:
    """First frames that nothing tells from those before and after them."""
    clear = [frame for index, frame in enumerate(survey.frames) if index not in survey.off]
    return (clear or survey.frames)[:most]


def examine_camera(source: CameraInputs, survey: Survey, registration: Registration) -> CameraState:
    """Leave damaged frames out, and estimate what the camera adds to all pixels alike."""
    shifts = np.zeros((0, 2))
    if source.thermography.table == "moving":
        # Places between which a moving table travels, mm on the plan.
        travel = np.linspace(-source.travel_mm, source.travel_mm, _POSITIONS)
        shifts = travel[:, None] * np.array(source.direction)
    blocks = locate_blocks(survey, registration, source.grid, shifts)
    _refuse_patch_on_plan(source, blocks)
    disturbed = disturbed_frames(survey, blocks, still=source.thermography.table == "still")
    left_out = [
        *survey.damaged,
        *(RejectedFrame(survey.frames[i].path, survey.frames[i].index, reason) for i, reason in disturbed.items()),
    ]
    kept = np.array([index not in disturbed for index in range(len(survey.frames))])
    frames = [frame for frame, keep in zip(survey.frames, kept, strict=True) if keep]
    rejected = [left_out_frame(source.campaign, one.path, one.index, one.reason) for one in left_out]
    usable = replace(source, frames=frames, frames_rejected=[*source.frames_rejected, *rejected])
    notices = [
        *frames_notices(rejected, "frames_damaged"),
        *repeat_notices(survey.repeated, [frame.time for frame in survey.frames]),
    ]
    levels = _levels(survey, blocks, kept)
    checked = {"frames_checked": len(source.frames), "frames_damaged": rejected}
    room = _room(usable)
    # Surfaces of a room change by no more than its air and what follows it: from nothing to all of it (rectangular, JCGM 100:2008, 4.3.7).
    reflected_u_K = np.abs(room - room[0]).max(axis=1) / np.sqrt(3.0) if room.shape[1] else None
    if levels is None:
        part = CameraPart(**checked, steps=(), drift_K=0.0, largest_correction_K=0.0, largest_u_K=None)
        unseen = np.full(len(frames), np.inf)
        return CameraState(
            usable, None, np.zeros(len(frames)), unseen, reflected_u_K, part, [*notices, _NO_SURROUNDINGS]
        )
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
    correction_K, largest_u_K = share * correction.correction_K, float(u_K.max())
    part = CameraPart(
        **checked,
        steps=[
            CameraStepPart(time=utc(frames[step.index].time), step_K=Quantity(value=step.value_K, u=step.u_K))
            for step in correction.steps
        ],
        drift_K=np.ptp(correction.drift_K),
        largest_correction_K=np.abs(correction_K).max(),
        largest_u_K=largest_u_K,
    )
    shown_by = "temperature of the housing" if survey.patch is None else "reference patch"
    notices += _correction_notices(correction, frames, largest_u_K, shown_by=shown_by)
    left_K = share * (background - background[0] + correction.correction_K)
    surroundings_K = np.maximum.accumulate(np.abs(left_K))
    added_K = correction_K if correction.corrects else None
    return CameraState(usable, added_K, u_K, surroundings_K, reflected_u_K, part, notices)


def _held_against_discs(
    camera: CameraState, levels: DiscLevels, fields: xr.Dataset
) -> tuple[CameraState, dict[str, Any]]:
    """The camera with what the discs show of its zero in its uncertainty, and what they show of a pattern in the picture."""
    source = camera.source
    left_out = {
        name for kind in ("frames_obstructed", "frames_shaken") for name in json.loads(fields.attrs.get(kind, "[]"))
    }
    shown = levels.compared(np.array([f"{one.path.name}#{one.index}" in left_out for one in source.frames]))
    if shown is None:
        return camera, {"untested": "fewer than five sharp discs of low emissivity are in view, or few frames"}
    change = np.ptp(shown.pattern_K, axis=0)
    strongest = int(np.argmax(change))
    found = {
        "pattern_K": float(change[strongest]),
        "disc": shown.names[strongest],
        "zero_K": 0.0,
        "warming_K": shown.warming_K,
    }
    correction_K = np.zeros(len(source.frames)) if camera.correction_K is None else camera.correction_K
    beside_table = left = shown.common_K + correction_K[shown.index] - correction_K[0]
    every = np.arange(len(source.frames))
    # What they reflect, the table reflects too: at most all that they show beside its warming.
    camera = replace(camera, reflected_u_K=np.interp(every, shown.index, np.abs(left)) / np.sqrt(3.0))
    if source.thermography.reference_patch_px is not None:
        return camera, found
    room, of_split = _room(source)[shown.index], np.zeros(len(left))
    if room.shape[1]:
        # Discs reflect the room, whose surfaces change by no more than its air; a steady drift beside it is the zero's.
        room = room - room[0]
        design = np.column_stack([shown.index / shown.index[-1], room])
        most = np.array([np.inf, *np.ones(room.shape[1])])
        found_in = scipy.optimize.lsq_linear(design, left, (np.where(most > 1.0, -np.inf, 0.0), most)).x
        scatter = float(np.std(left - design @ found_in))
        of_split = design[:, 0] * scatter * np.sqrt(np.linalg.pinv(design.T @ design)[0, 0])
        left = left - room @ found_in[1:]
        left -= left[0]
    # The zero or what the discs reflect, but no more than the surroundings show, which share the zero.
    most_K = np.minimum(np.interp(every, shown.index, np.hypot(left, of_split)), camera.surroundings_K)
    most_K = np.maximum(most_K, np.sqrt(3.0) * camera.u_K) * np.sign(np.interp(every, shown.index, left))
    # From nothing to all of it is the camera's (rectangular, JCGM 100:2008, 4.3.7), or the share that the material sensor shows.
    share, share_rms = 0.0, 1.0 / np.sqrt(3.0)
    offset_s = source.thermography.clock_offset_s or 0.0
    on_laser = fields.assign_coords(time=camera_on_laser_clock(fields["time"].values, offset_s))
    zero = xr.DataArray(most_K, {"time": camera_on_laser_clock(source.frame_times, offset_s)})
    if (near := _at_sensor(source, on_laser)) is not None:
        emissivity_u = stated_uncertainty(source.thermography).emissivity / source.frames[0].parameters.emissivity
        share, share_rms = share_of_zero(near, source.environment, near.interpolated(zero), emissivity_u)
    zero_u_K = np.maximum(camera.u_K, share_rms * np.abs(most_K))
    pattern_u_K = np.sqrt(np.mean((shown.pattern_K - shown.pattern_K[0]) ** 2, axis=1))
    u_K = np.hypot(zero_u_K, np.interp(every, shown.index, pattern_u_K))
    part = camera.part.model_copy(update={"largest_u_K": float(u_K.max())})
    return replace(camera, u_K=u_K, part=part, zero=share * zero), {
        **found,
        # A drift that only the division from the room makes, as both are alike, is in the uncertainty, but shown by nothing.
        "zero_K": min(float(np.ptp(_without_noise(course))) for course in (beside_table, left)),
    }


def _without_noise(course: Array) -> Array:
    """A course by the line through the five values nearest to each: what the camera adds changes slowly, and a ramp keeps its size."""
    index, span = np.arange(len(course)), np.arange(5)
    start = np.clip(index - 2, 0, len(course) - 5)
    nearest = course[start[:, None] + span]
    return np.asarray(nearest.mean(axis=1) + nearest @ (span - 2) / 10 * (index - start - 2))


def camera_corrected(part: CameraPart) -> bool:
    """Whether thermograms were left out or corrected."""
    return bool(part.frames_damaged or part.steps or part.drift_K)


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
            "temperature outside the plan, or leave the key out"
        )


def _levels(survey: Survey, blocks: Blocks, kept: Array) -> tuple[Array, Array, Array] | None:
    """Level of the surroundings of the table, mean and spread of the table, (frames,) degC and K; None where they are not in view."""
    surroundings = survey.levels[kept][:, blocks.surroundings].astype(float)
    surroundings = surroundings[:, np.isfinite(surroundings).all(axis=0)]
    if surroundings.shape[1] < LEAST_SURROUNDING_BLOCKS:
        return None
    middle = np.median(surroundings, axis=0)
    # People and warm parts move in some of the blocks; the quieter half shows the room and the camera.
    variability = np.median(np.abs(surroundings - middle), axis=0)
    quiet = variability <= np.median(variability)
    background = np.median(surroundings[:, quiet] - middle[quiet], axis=1) + float(np.median(middle[quiet]))
    chosen = blocks.table if blocks.table.any() else ~blocks.surroundings
    table = survey.levels[kept][:, chosen].astype(float)
    return background, np.nanmean(table, axis=1), np.nanstd(table, axis=1)


def _series(source: CameraInputs, background: Array, table: Array) -> LevelSeries:
    """The levels with the temperatures inside the camera and of the room."""
    frames, times = source.frames, source.frame_times
    seconds = (times - times[0]) / np.timedelta64(1, "s")
    sensors = [name for name in frames[0].housekeeping if all(name in frame.housekeeping for frame in frames)]
    housing = np.array([[frame.housekeeping[name] for name in sensors] for frame in frames], float)
    log, logged_s = source.environment, 0.0
    if log is not None:
        first = camera_on_laser_clock(times[:1], source.thermography.clock_offset_s or 0.0)[0]
        logged_s = max(float((first - log["time"].values[0]) / np.timedelta64(1, "s")), 0.0)
    return LevelSeries(seconds, background, table, housing.reshape(len(frames), -1), _room(source), logged_s)


def _room(source: CameraInputs) -> Array:
    """Temperatures of the room at the frames, (frames, m); m is 0 where none was logged."""
    log = source.environment
    if log is None or "air_temperature" not in log:
        return np.zeros((len(source.frames), 0))
    # The log is on the laser's clock; the room changes too slowly for a clock that is still to be found to matter.
    on_laser = camera_on_laser_clock(source.frame_times, source.thermography.clock_offset_s or 0.0)
    logged = (log["time"].values - on_laser[0]) / np.timedelta64(1, "s")
    return room_temperatures((on_laser - on_laser[0]) / np.timedelta64(1, "s"), logged, log["air_temperature"].values)


def repeat_notices(repeated: NDArray[np.bool_], times: Sequence[np.datetime64] | Array) -> Iterator[Notice]:
    """Return one notice for frames that the camera wrote twice."""
    if found := find_repeats(repeated):
        yield Notice.of("frames_repeated", named=listed(f"{utc(times[first])}: {text}" for first, text in found))


_NO_SURROUNDINGS = Notice.of("camera_unchecked")


def _correction_notices(
    correction: CameraCorrection, frames: Sequence[FrameReference], u_K: float, *, shown_by: str
) -> Iterator[Notice]:
    """Return one notice each for steps, for a drift, and for what cannot be distinguished."""
    if correction.steps:
        named = [f"{step.value_K:+.2f} K at {utc(frames[step.index].time)}" for step in correction.steps]
        yield Notice.of(
            "camera_steps_corrected", steps=counted(len(correction.steps), "step"), named=listed(named), u_K=u_K
        )
    if correction.drift_K.any():
        yield Notice.of("camera_drift_corrected", drift_K=np.ptp(correction.drift_K), shown_by=shown_by)
    unexplained = float(np.abs(correction.unexplained_K).max())
    if u_K > _NAMED_U_K:
        yield Notice.of("camera_drift_undetermined", unexplained=unexplained, u_K=u_K)


# Radiometry of a campaign: parameters and their uncertainties, surfaces with an emissivity of their own, total
# uncertainty.

#: Attribute of `InputUncertainty` -> attribute of ``[thermography]`` that states it, with _u before the unit.
_STATED = {
    name: re.sub("(_K|_m|)$", r"_u\1", name, count=1)
    for name in (*OVERRIDABLE, "camera_offset_K", "camera_scale", "camera_drift_K", "reflected_change_K")
}


def stated_uncertainty(table: ThermographyTable) -> InputUncertainty:
    """Return the uncertainties of the radiometric inputs: those that the campaign states, defaults for the others."""
    given = {name: getattr(table, key) for name, key in _STATED.items()}
    if table.emissivity is not None and table.emissivity >= LEAST_OF_PAINTS and table.emissivity_u is None:
        given["emissivity"] = KNOWN_PAINT_U
    return InputUncertainty(**{name: u for name, u in given.items() if u is not None})


def _at_sensor(source: CameraInputs, on_laser: xr.Dataset) -> FieldSeries | None:
    """The camera at the material sensor, where its place is stated."""
    place_mm = source.interferometry.material_sensor_mm if isinstance(source, Source) else None
    return None if place_mm is None else field_at(on_laser, place_mm)


def _by_material_sensor(
    source: CameraInputs, on_laser: xr.Dataset, emissivity: float, assumed_u: float, zero: xr.DataArray | None
) -> float | None:
    """Standard uncertainty of an emissivity that the material sensor leaves; None where it is stated, or the sensor tells nothing."""
    if not isinstance(source, Source) or source.thermography.emissivity_u is not None:
        return None
    stated = source.interferometry.material_sensor_mm is not None
    near = _at_sensor(source, on_laser) if stated else thin_fields(on_laser)
    if stated and near is not None and zero is not None:
        near = replace(near, temperature=near.temperature - near.interpolated(zero)[:, None])
    share = rise_share_u(near, source.environment, stated=stated)
    if share is None:
        return None
    # Beyond a third of it an emissivity has no upper end.
    u = emissivity * min(share, 1.0 / 3.0)
    return u if stated else max(u, assumed_u)


def complete_fields(
    source: CameraInputs,
    fields: xr.Dataset,
    parameters: Overrides,
    *,
    offset_s: float = 0.0,
    zero: xr.DataArray | None = None,
) -> Outcome[xr.Dataset]:
    """Calibrate the surfaces that have an emissivity of their own, and add the total uncertainties; what the material sensor shows of the
    emissivity is free of the zero of the camera in the frames of `fields`, K.
    """
    table, inputs = source.thermography, stated_uncertainty(source.thermography)
    along = {"cycle": "cycle_time", "time": "time"}
    cameras = {name: _parameters_at(source, parameters, fields[time].values) for name, time in along.items()}
    camera = cameras["cycle"][reference_cycle(fields["temperature"])]
    on_laser = fields.assign_coords(time=camera_on_laser_clock(fields["time"].values, offset_s))
    if (measured_u := _by_material_sensor(source, on_laser, camera.emissivity, inputs.emissivity, zero)) is not None:
        inputs = replace(inputs, emissivity=measured_u)
    if table.reflected_change_u_K is not None:
        fields = fields.drop_vars("reflected_change_u", errors="ignore")
    regions = [_emissivity_region(one, fields, camera, inputs) for one in table.surfaces]
    surfaces, edge = total_uncertainty.find_surfaces(
        fields, regions, emissivity=camera.emissivity, emissivity_u=inputs.emissivity
    )
    if regions:
        fields = total_uncertainty.calibrate_surfaces(fields, surfaces, edge, cameras)
    fields = total_uncertainty.evaluate_uncertainty(
        fields, cameras["cycle"], inputs, surfaces=surfaces if regions else ()
    )
    part = RadiometryPart(
        temperature_u=_two_parts(fields, "temperature"),
        rise_u=_two_parts(fields, "temperature_rise"),
        rise_scale_u=fields["rise_scale_u"].mean(),
        budget=_budget(table, fields, camera, inputs, measured=measured_u is not None),
        surfaces=[_describe_surface(table, one, fields, camera, inputs) for one in surfaces],
        edge_cells=edge.sum(),
    )
    return Outcome(fields, Parts(radiometry=part), (*_edge_notices(edge, regions), *_drift_notices(table, fields)))


def _describe_field(fields: xr.Dataset) -> FieldPart:
    """Return the fields in short."""
    rise, times = fields["temperature_rise"], fields["time"].values
    seen = cycles_with_field(rise)
    mean = float(rise.isel(cycle=int(np.flatnonzero(seen)[-1])).mean())
    at = _largest_at(rise)
    cell = rise[at]
    since = (fields["cycle_time"].values[at[0]] - fields["cycle_time"].values[seen][0]) / np.timedelta64(1, "s")
    return FieldPart(
        fields=seen.sum(),
        frames=fields["frame_count"].sum() if "frame_count" in fields else times.size,
        duration_s=(times[-1] - times[0]) / np.timedelta64(1, "s"),
        mean_rise_K=Quantity(value=mean, u=_two_parts(fields, "temperature_rise").common_K),
        largest_rise_K=Quantity(value=cell, u=fields["temperature_rise_u"][at]),
        largest_cycle=cell["cycle"],
        largest_after_s=since,
        largest_x_mm=cell["x"],
        largest_y_mm=cell["y"],
    )


def _largest_at(rise: xr.DataArray) -> tuple[int, int, int]:
    """Cycle, row and column of the largest rise, the first of equal ones."""
    largest, at = -np.inf, (0, 0, 0)
    for some, piece in in_pieces(rise):
        cycle, y, x = np.unravel_index(int(np.argmax(np.where(np.isnan(piece), -np.inf, piece))), piece.shape)
        if piece[cycle, y, x] > largest:
            largest, at = piece[cycle, y, x], (some.start + int(cycle), int(y), int(x))
    return at


def _parameters_at(
    source: CameraInputs, parameters: Overrides, times: NDArray[np.datetime64]
) -> list[CameraParameters]:
    """Parameters of the frame nearest to each time; frames of one cycle or block hardly ever differ in them."""
    frames = source.frame_times
    last = np.minimum(np.searchsorted(frames, np.where(np.isnat(times), frames[0], times)), len(frames) - 1)
    return [parameters(source.frames[int(k)]) for k in last]


def _emissivity_region(
    table: RegionTable, fields: xr.Dataset, camera: CameraParameters, inputs: InputUncertainty
) -> total_uncertainty.EmissivityRegion:
    """One region of the campaign file, its emissivity measured from two states where it is not given."""
    outline = Polygon(f"region {table.name}", np.array(table.corners))
    if table.states is None:
        assert table.emissivity is not None
        u = inputs.emissivity if table.emissivity_u is None else table.emissivity_u
        return total_uncertainty.EmissivityRegion(outline, table.emissivity, u)
    states = [(state.cycle, state.temperature_degC, state.temperature_u_K) for state in table.states]
    estimate = total_uncertainty.measure_emissivity(fields, outline, states, camera, camera_scale=inputs.camera_scale)
    return total_uncertainty.EmissivityRegion(outline, min(estimate.emissivity, 1.0), estimate.emissivity_u)


def _two_parts(fields: xr.Dataset, name: str) -> TwoParts:
    """Noise, common part and total of temperature or rise, root mean squares over the cells of the last cycle."""
    last = _last_field(fields)
    noise, total = (float(np.sqrt((last[f"{name}{end}"] ** 2).mean())) for end in ("_noise_u", "_u"))
    return TwoParts(noise_K=noise, common_K=np.sqrt(max(total**2 - noise**2, 0.0)), total_K=total)


def _last_field(fields: xr.Dataset) -> xr.Dataset:
    """The last cycle with a field."""
    return fields.isel(cycle=int(np.flatnonzero(cycles_with_field(fields["temperature"]))[-1]))


def _budget(
    table: ThermographyTable, fields: xr.Dataset, camera: CameraParameters, inputs: InputUncertainty, *, measured: bool
) -> list[BudgetEntry]:
    """Every input that all frames share, with its contributions on the main surface at the mean of the last field."""
    last = _last_field(fields)
    mean = float(last["temperature"].mean())
    middle = mean - 0.5 * float(last["temperature_rise"].mean())
    to_temperature = common_contributions(mean, camera, inputs)
    to_rise = rise_scale_contributions(middle, camera, inputs)
    left_K, entries = _zero_left_K(fields), []
    # What changes during a test is in no single temperature: as the frames show it, or as it is stated or assumed.
    of_frames = {"camera_drift_K": left_K if left_K > inputs.camera_drift_K else None, "reflected_change_K": None}
    if "reflected_change_u" in fields:
        of_frames["reflected_change_K"] = float(np.nan_to_num(fields["reflected_change_u"].values).max())
    for name, key in _STATED.items():
        if name in of_frames:
            found_K, stated = of_frames[name], "assumed" if getattr(table, key) is None else "stated"
            left = {"value": None, "u": getattr(inputs, name), "source": stated}
            left |= {} if found_K is None else {"u": found_K, "source": "measured"}
            entries.append(BudgetEntry(input=name, **left, temperature_u_K=0.0, rise_u_percent=None))
            continue
        if camera.window_transmission == 1 and name.startswith("window_") and getattr(inputs, name) == 0:
            continue
        unstated = "measured" if measured and name == "emissivity" else "assumed"
        source = unstated if getattr(table, key) is None else "stated"
        of_temperature, of_rise = (abs(float(shares.get(name, 0.0))) for shares in (to_temperature, to_rise))
        contributed = {"temperature_u_K": of_temperature, "rise_u_percent": 100.0 * of_rise}
        value, u = getattr(camera, name, None), getattr(inputs, name)
        entries.append(BudgetEntry(input=name, value=value, u=u, source=source, **contributed))
    return entries


def _zero_left_K(fields: xr.Dataset) -> float:
    """Largest standard uncertainty of the camera's zero that its correction leaves, K; 0 where it was not examined."""
    left = fields["camera_correction_u"].values if "camera_correction_u" in fields else np.zeros(1)
    return float(np.nan_to_num(left).max())


def _drift_notices(table: ThermographyTable, fields: xr.Dataset) -> Iterator[Notice]:
    """Return a notice where the stated drift of the camera's zero is not the one that the frames leave."""
    stated_K, left_K = table.camera_drift_u_K, _zero_left_K(fields)
    if stated_K is not None and left_K > 0.0:
        larger = "the stated one" if stated_K >= left_K else "that of the frames"
        yield Notice(
            "camera_drift_stated",
            f"camera_drift_u = {stated_K:.2g} K is stated; the frames leave up to {left_K:.2g} K of the camera's zero uncertain. The "
            f"larger was taken, {larger}.",
            ""
            if stated_K >= left_K
            else "Leave camera_drift_u out, or keep a surface of constant temperature in view.",
        )


def _describe_surface(
    table: ThermographyTable,
    surface: total_uncertainty.Surface,
    fields: xr.Dataset,
    camera: CameraParameters,
    inputs: InputUncertainty,
) -> SurfacePart:
    """A surface with its emissivity and what it leaves of the rises."""
    shown = total_uncertainty.find_range(fields, surface.cells)
    sources = {f"region {one.name}": "stated" if one.states is None else "two states" for one in table.surfaces}
    ratio = scale = None
    if shown is not None:
        own = replace(inputs, emissivity=surface.emissivity_u)
        compared = total_uncertainty.compare_with_monte_carlo(
            shown, override(camera, emissivity=surface.emissivity), own
        )
        ratio, scale = compared.rise_ratio, float(np.nanmean(fields["rise_scale_u"].values[surface.cells]))
    return SurfacePart(
        name=surface.name.removeprefix("region "),
        emissivity=Quantity(value=surface.emissivity, u=surface.emissivity_u),
        source=sources.get(surface.name, "frames" if table.emissivity is None else "stated"),
        cells=surface.cells.sum(),
        rise_scale_u=scale,
        monte_carlo_ratio=ratio,
    )


def _edge_notices(edge: NDArray[np.bool_], regions: list[total_uncertainty.EmissivityRegion]) -> Iterator[Notice]:
    """Return a notice for the cells that see two surfaces."""
    if regions:
        named = ", ".join(region.outline.name for region in regions)
        count = counted(int(edge.sum()), "cell")
        yield Notice.of("surface_edges", count=count, named=named)


#: Number of first frames whose mean is registered: the noise falls, and the table has hardly warmed.
_REGISTRATION_FRAMES = 5
#: Share of clipped pixels from which a picture without discs is saturated.
_SATURATED_SHARE = 0.3
#: Number of frames above which finished cycles are stored during the reduction; below, this costs more than it saves.
_CHECKPOINT_FRAMES = 2000


def taken_from_laser(source: CameraInputs) -> list[Any]:
    """Return all that the fields depend on besides camera and plan: cycles, times and places of the readings, what was logged beside them.

    The deviations, and what compensates them, are no part of it: they may change while the fields are kept.
    """
    arrays = {"bounds": source.cycles.bounds, "number": source.cycles.number}
    stated: list[Any] = []
    if isinstance(source, Source):
        arrays |= {name: source.deviations[name].values for name in ("time", "position", "target")}
        stated = [source.interferometry.material_sensor_mm, source.interferometry.feed_mm_per_min]
    if source.environment is not None:
        arrays |= {f"logged {name}": one.values for name, one in sorted(source.environment.variables.items())}
    return [*stated, {name: sha256(values.tobytes()).hexdigest() for name, values in arrays.items()}]


def reduce_thermography(source: CameraInputs, *, checkpoint: Path, scheduler: str | None, report: Report) -> Outcome:
    """Check the camera, register the plan on the first frames, and reduce all frames to one field per cycle."""
    # One surface has one emissivity: where the files change it, that of the first frame holds.
    first_emissivity = source.frames[0].parameters.emissivity
    stated = overridden_parameters(source.thermography)
    if any(frame.parameters.emissivity != first_emissivity for frame in source.frames):
        stated.setdefault("emissivity", first_emissivity)
    override = Overrides(stated)
    survey = survey_campaign(source, override, report=report)
    report("registration", 0, 1)
    # A moving table is somewhere else in the next frame, so its plan is registered on one frame alone.
    first = clear_frames(survey, 1 if source.thermography.table == "moving" else _REGISTRATION_FRAMES)
    detector = survey.detector
    reference = np.mean([calibrate(detector.read(frame), override(frame)) for frame in first], axis=0)
    try:
        registration = register_campaign(source, reference)
    except RegistrationError as error:
        share = float(detector.clipped(first[0].read_counts()).mean())
        if share < _SATURATED_SHARE:
            raise
        raise RegistrationError(
            f"{first[0].path}: {100.0 * share:.0f} % of the pixels share the highest or lowest count: the picture is saturated, and shows "
            "no discs; choose a range of the camera that includes the temperature of the table"
        ) from error
    report("registration", 1, 1)
    camera = examine_camera(source, survey, registration)
    source, notices = camera.source, camera.notices
    still = source.thermography.table == "still"
    levels = read_discs(source.frames, registration, source.grid, detector) if still else None
    blurred_since = None
    if levels is not None and levels.blurred is not None:
        first_blurred, widest = levels.blurred
        some = source.frames[max(widest - 2, 0) : widest + 3]
        mean = np.mean([calibrate(detector.read(frame), override(frame)) for frame in some], axis=0)
        focused, registration = registration, with_optics_of(mean, registration, source.grid)
        if registration is not focused:
            blurred_since = source.frames[first_blurred].time
    notices += pixel_notices(detector.flags, "are left out of the fields")
    fields, offset_s, offset_u_s, clock_notices = _reduce_on_clock(
        camera, registration, override, detector, checkpoint=checkpoint, scheduler=scheduler, report=report
    )
    notices += _clipped_notices(fields, detector, override(first[0]))
    shown: dict[str, Any] = {"untested": "camera or table was displaced, and the discs in the picture with it"}
    if levels is None:
        shown = {"untested": "the discs move through the picture with the table"}
    else:
        fields = leave_out_objects(fields)
        if blurred_since is not None:
            shown = {"untested": "the discs blur during the test"}
        elif not json.loads(fields.attrs.get("knocks", "[]")):
            camera, shown = _held_against_discs(camera, levels, fields)
    fields = fields.assign_attrs(discs=json.dumps(shown))
    fields = fields.assign(camera.per_cycle(_bounds(source, offset_s)))
    damaged = [f"{Path(one.file).name}#{one.index}" for one in camera.part.frames_damaged]
    repeated = [f"{one.path.name}#{one.index}" for one in compress(survey.frames, survey.repeated)]
    fields = fields.assign_attrs(frames_damaged=json.dumps(damaged), frames_repeated=json.dumps(repeated))
    fields = fields.assign_coords(cycle=source.cycles.number)
    completed = complete_fields(source, fields, override, offset_s=offset_s, zero=camera.zero)
    fields = check(completed.dataset, FIELDS, name="the fields")
    if still:
        unnamed = describe_unnamed_surfaces(fields, override(first[0]))
        fields = fields.assign_attrs(unnamed_surfaces=json.dumps(unnamed))
    notices += [
        *clock_notices,
        *_registration_notices(registration, blurred_since),
        *_frame_notices(fields),
        *completed.notices,
    ]
    for name in ("time", "cycle_time", "frame_time"):
        if name in fields.variables:
            moved = camera_on_laser_clock(fields[name].values, offset_s)
            fields[name] = (fields[name].dims, moved, fields[name].attrs)
    fields = fields.assign(_registration_variables(registration, reference))
    parts = completed.parts
    parts.registration, parts.camera = _describe_registration(registration, source), camera.part
    parts.field = _describe_field(fields)
    if isinstance(source, Source):
        x, y = source.axis.points(source.deviations["position"].values)
        places = {"target_x": ("target", x, {"units": "mm"}), "target_y": ("target", y, {"units": "mm"})}
        fields = fields.assign(xr.Dataset(places, coords={"target": source.deviations["target"].values}))
        parts.alignment = AlignmentPart(clock_offset_s=Quantity(value=offset_s, u=offset_u_s))
    return Outcome(fields, parts, tuple(notices))


def register_campaign(source: CameraInputs, reference: np.ndarray) -> Registration:
    """Register the plan on the mean of the first frames; a refusal names the file of the fiducials."""
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
    detector: Detector,
    *,
    checkpoint: Path,
    scheduler: str | None,
    report: Report,
) -> tuple[xr.Dataset, float, float | None, list[Notice]]:
    """Reduce the frames with the clock offset that the campaign gives, that the moving table shows, or that is assumed."""
    source = camera.source
    moving = source.thermography.table == "moving"

    def reduce(offset_s: float, kept: Path = checkpoint) -> xr.Dataset:
        """Reduce the frames, the cycles brought to the camera's clock."""
        common: dict[str, Any] = {
            "override": override,
            "correction_K": camera.correction_K,
            "detector": detector,
            "scheduler": scheduler,
            "checkpoint": kept if len(source.frames) > _CHECKPOINT_FRAMES else None,
            "progress": counter(report, "frames", len(source.frames)),
        }
        where = (source.frames, registration, source.grid, _bounds(source, offset_s))
        if moving:
            return reduce_moving_frames(*where, direction=source.direction, **common)
        return reduce_frames(*where, **common)

    given = source.thermography.clock_offset_s
    if not isinstance(source, Source) or given is not None or not moving:
        # Without a laser the logs are the other clock; an offset that is not stated is none.
        assumed = isinstance(source, Source) and given is None
        u = 0.0 if isinstance(source, Source) and given is not None else None
        return reduce(given or 0.0), given or 0.0, u, [_ASSUMED_CLOCK] if assumed else []
    fields = reduce(0.0, checkpoint / "before_alignment")
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
    fields = reduce(clock.offset_s)
    return fields, clock.offset_s, clock.offset_u_s, [*clock_notices(clock)]


def clock_notices(clock: ClockOffset) -> Iterator[Notice]:
    """Return a notice where the offset of the clocks is one of several that a periodic test shows."""
    if clock.rivals_s:
        others = listed(f"{offset:.1f} s" for offset in clock.rivals_s)
        yield Notice.of("clock_offset_periodic", others=others, offset_s=clock.offset_s)


_ASSUMED_CLOCK = Notice.of("clock_offset_assumed")


def _bounds(source: CameraInputs, offset_s: float) -> np.ndarray:
    """Start and end of every cycle on the camera's clock, (cycles, 2)."""
    return source.cycles.bounds + np.timedelta64(round(offset_s * 1e9), "ns")


def _clipped_notices(fields: xr.Dataset, detector: Detector, parameters: CameraParameters) -> Iterator[Notice]:
    """Return a notice for clipped counts; refuse frames of which no field is left."""
    if not detector.clips:
        return
    end, count = ("highest", detector.highest) if detector.highest <= 65535 else ("lowest", detector.lowest)
    celsius = float(calibrate(np.array([count], np.uint16), parameters)[0])
    where = f"at their {end} value, {count} ({celsius:.1f} °C)"
    empty = (fields["quality_flag"].values & CLIPPED) > 0
    if not cycles_with_field(fields["temperature"]).any():
        raise ThermographyError(
            f"the counts of the frames are clipped {where}, on every cell of the plan: the pictures are saturated; choose a range of the "
            "camera that includes the temperature of the table"
        )
    cells = int(empty.any(axis=0).sum())
    first = fields["cycle"].values[int(np.argmax(empty.any(axis=(1, 2))))]
    lost = (
        f"{counted(cells, 'cell')} of the plan, in or after cycle {first}, are left empty"
        if cells
        else "none of the plan"
    )
    yield Notice.of("counts_clipped", where=where, lost=lost)


def pixel_notices(flags: np.ndarray, treatment: str) -> Iterator[Notice]:
    """Return a notice for pixels that do not follow their neighbours, (row, column), and what was done with them."""
    if flags.any():
        kinds = {"dead": DEAD, "off its neighbours": OFFSET, "noisy": NOISY}
        counts_by_kind = {name: int(np.count_nonzero(flags & flag)) for name, flag in kinds.items()}
        named = ", ".join(f"{count} {name}" for name, count in counts_by_kind.items() if count)
        yield Notice.of("bad_pixels", pixels=np.count_nonzero(flags), named=named, treatment=treatment)


def _registration_variables(registration: Registration, reference: np.ndarray) -> xr.Dataset:
    """Return the registration as variables: the fiducials with their errors, the homography, and the frame it was made on."""
    names = list(registration.located)
    places = [registration.located[name] for name in names]
    fiducials = [registration.fiducials[name] for name in names]
    along = {
        "fiducial_name": names,
        "fiducial_x": [fiducial.x_mm for fiducial in fiducials],
        "fiducial_y": [fiducial.y_mm for fiducial in fiducials],
        "fiducial_column": [located.column_px for located in places],
        "fiducial_row": [located.row_px for located in places],
        "fiducial_residual": [registration.residual_mm[name] for name in names],
        "fiducial_leave_one_out": [registration.leave_one_out_mm[name] for name in names],
    }
    variables: dict[str, Any] = {name: ("fiducial", values) for name, values in along.items()}
    placed_by = {
        "lens_model": registration.model,
        "distortion_k1_k2_p1_p2": registration.projection.distortion,
        "focal_length_px": registration.projection.focal_length_px,
        "principal_point_px": registration.projection.principal_point_px,
    }
    variables["homography"] = (("plan_axis", "sensor_axis"), registration.homography, placed_by)
    variables["reference_frame"] = (("row", "column"), reference.astype("f4"))
    return annotate(xr.Dataset(variables))


def _describe_registration(registration: Registration, source: CameraInputs) -> RegistrationPart:
    """Return the registration in short."""
    # The share of the plan that the fiducials in use span.
    places = [registration.fiducials[name] for name in registration.leave_one_out_mm]
    hull = cv2.convexHull(np.array([(place.x_mm, place.y_mm) for place in places], dtype=np.float32))
    same = (
        "model", "rms_mm", "unchecked", "contradicted_hints", "mirrored", "area_ratio", "leave_one_out_mm", "margin_px"
    )  # fmt: skip
    optics = registration.optics
    return RegistrationPart(
        **{name: getattr(registration, name) for name in same},
        homography=registration.homography.tolist(),
        distortion=registration.projection.distortion.tolist(),
        focal_length_px=registration.projection.focal_length_px,
        principal_point_px=registration.projection.principal_point_px,
        frames_rejected=source.frames_rejected,
        position_u_mm=np.sqrt(np.mean(registration.position_u(source.grid.centres_mm) ** 2)),
        fiducials_listed=sum(fiducial.marker is None for fiducial in source.fiducials),
        fiducials_u_mm=source.plan.fiducials_u_mm or 0.0,
        edge_spread_px=None
        if np.isnan(registration.area_ratio)
        else Quantity(value=optics.spread_px, u=optics.spread_u_px),
        span=cv2.contourArea(hull) / (source.grid.width_mm * source.grid.height_mm),
    )


#: Edge spread of a focused camera, pixel included, px.
_SHARP_PX = 1.2


def _registration_notices(registration: Registration, blurred_since: np.datetime64 | None) -> Iterator[Notice]:
    """Return one notice for all fiducials that were not used, one for a blurred picture."""
    optics = registration.optics
    if optics.spread_px > _SHARP_PX:
        middle = np.mean([(disc.x_mm, disc.y_mm) for disc in registration.fiducials.values()], axis=0)
        lost_mm = registration.margin_px / float(registration.projection.px_per_mm(middle))
        yield Notice.of(
            "frames_blurred",
            since=f" from {utc(blurred_since)} on" if blurred_since else "",
            spread_px=optics.spread_px,
            spread_u_px=optics.spread_u_px,
            focused_px=_SHARP_PX,
            lost_mm=lost_mm,
        )
    if registration.left_out:
        named = "; ".join(f"{name}: {reason}" for name, reason in registration.left_out.items())
        yield Notice.of("fiducials_left_out", fiducials=counted(len(registration.left_out), "fiducial"), named=named)


#: Attributes of the fields that list frames, and codes of what is said of them.
_FRAME_ATTRIBUTES = (
    "frames_outside_cycles", "knocks", "frames_shaken", "frames_obstructed", "frames_unplaced", "frames_unchecked",
)  # fmt: skip


def _frame_notices(fields: xr.Dataset) -> Iterator[Notice]:
    """Return one notice for each kind of frame that the reduction reports."""
    for name in _FRAME_ATTRIBUTES:
        frames = json.loads(fields.attrs.get(name, "[]"))
        crept = [bool(frame.pop("crept")) for frame in frames] if name == "knocks" else [False] * len(frames)
        for code, chosen in ((name, np.logical_not(crept)), ("camera_creeps", crept)):
            some = list(compress(frames, chosen))
            if some:
                named = listed([frame if isinstance(frame, str) else _words(frame) for frame in some])
                yield Notice.of(code, frames=counted(len(some), "frame"), named=named)


def _words(value: Any) -> str:
    """Return a record such as ``{"frame": "a.jpg", "shift_px": [3, 0]}`` as words; folders stay out of it."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name.replace('_', ' ')} {_words(item)}" for name, item in value.items())
    if isinstance(value, list):
        return "(" + ", ".join(_words(item) for item in value) + ")"
    return f"{value:.3g}" if isinstance(value, float) else Path(str(value)).name


def map_name(cycle: int) -> str:
    """Return the name of the file with the maps of one cycle."""
    return f"cycle_{cycle:04d}.exr"


def write_exr(folder: Path, fields: xr.Dataset, *, report: Report) -> list[Path]:
    """Write the fields of every cycle as OpenEXR maps and return the files; the mask is 1 where the table was seen."""
    total = fields.sizes["cycle"]
    paths: list[Path] = []
    mapped = fields[["temperature", "temperature_rise", "temperature_u", "cycle_time"]]
    for some in piece_slices(mapped["temperature"].shape):
        piece = mapped.isel(cycle=some).load()
        for cycle, time in zip(piece["cycle"].values, piece["cycle_time"].values, strict=True):
            report("OpenEXR maps", len(paths), total)
            field = piece.sel(cycle=cycle)
            named = {
                "temperature": field["temperature"],
                "rise": field["temperature_rise"],
                "uncertainty": field["temperature_u"],
                "mask": np.isfinite(field["temperature"]),
            }
            maps = {name: np.ascontiguousarray(values, dtype="f4") for name, values in named.items()}
            path = folder / map_name(cycle)
            attributes: dict[str, str | int | float] = {
                "cell_size_mm": abs(float(field["x"][1] - field["x"][0])) if field.sizes["x"] > 1 else 0.0,
                "first_column_x_mm": float(field["x"][0]),
                "first_row_y_mm": float(field["y"][0]),
                "direction": "centres of cells on the plan; x grows from column to column, y grows from row to row",
                "cycle": int(cycle),
                "time": utc(time),
            }
            units = {"temperature": "degC", "rise": "K", "uncertainty": "K"}
            write_maps(path, maps, units=units, attributes=attributes)
            paths.append(path)
    report("OpenEXR maps", total, total)
    return paths
