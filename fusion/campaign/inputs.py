"""Inputs of a campaign with one instrument or both: read, checked for overlap in time and plausible clocks; omissions are noted."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from fusion.alignment.align import AlignmentError, AxisGeometry, MeasuredLine, camera_on_laser_clock
from fusion.alignment.zone_shift import covered_share, likely_zone_shift
from fusion.attribution.randomised_duty import DutyLaw, read_duty
from fusion.attribution.thermal_modes import read_regions
from fusion.campaign.config import Campaign, relative_name
from fusion.campaign.frame_stacks import camera_accuracy_notices, stack_options
from fusion.campaign.logged_tables import read_drivers, split_heading
from fusion.campaign.messages import naming
from fusion.campaign.recompensation import RecompensationError, compensate_readings, see_material
from fusion.campaign.sensors import read_sensors
from fusion.campaign.sources import (
    CameraInputs,
    Cycles,
    Inputs,
    LaserInputs,
    Source,
    cycles_of_frames,
    cycles_of_readings,
    usual_window_s,
)
from fusion.campaign.time_zones import bring_to_utc, refuse_mixed_zones
from fusion.campaign.value_types import matching_pipes
from fusion.errors import FusionError
from fusion.products.contracts import check
from fusion.products.notices import counted, left_out_notices, listed
from fusion.products.results import Notice
from interferometry.contract import DEVIATIONS
from interferometry.io.readers import read_deviations, read_environment
from thermography.errors import ThermographyError
from thermography.io.frame import FrameReference
from thermography.io.frame_index.frame_list import FrameList, frame_times
from thermography.io.frame_readers import index_recordings
from thermography.registration.lens import read_lens
from thermography.registration.picture import picture_grid
from thermography.registration.plan import PlanGrid, read_fiducials
from thermography.registration.polygon import Polygon, PolygonError

#: Words of the reason why a frame of another size is left out.
_OTHER_SIZE = "pixels among frames"
#: Smallest test that has a scatter and a drift, and smallest recording that has a rise.
_LEAST_CYCLES, _LEAST_TARGETS, _LEAST_FRAMES = 2, 2, 2


def read_source(campaign: Campaign) -> LaserInputs | CameraInputs | Source:
    """Read readings, logs, fiducials and the frames' headers of a campaign, with every check that needs no calculation.

    Parameters
    ----------
    campaign : Campaign
        A checked campaign with an instrument.

    Returns
    -------
    LaserInputs, CameraInputs or Source
        What was read, with a notice for everything that was left out: a `Source` where both instruments are there.

    Raises
    ------
    ValueError
        A subclass of the instruments' packages or of this one: a file that cannot be used, cycles that overlap, clocks that never meet.
    """
    with naming(campaign.path):
        return _read_instruments(campaign)


def _read_instruments(campaign: Campaign) -> LaserInputs | CameraInputs | Source:
    """Read what the campaign names, of the instruments that it has."""
    common: dict[str, Any] = {"campaign": campaign, "drivers": _read_drivers(campaign)}
    common["duty"] = _randomised(campaign, common["drivers"])
    common["sensors"] = read_sensors(campaign)
    if campaign.interferometry is not None:
        common |= read_laser(campaign)
    _refuse_mixed_zones(campaign, common)
    _refuse_two_of_one_name(campaign, common)
    if campaign.thermography is None:
        laser = LaserInputs(**common)
        laser.notices[:0] = _laser_notices(laser)
        return laser
    if campaign.interferometry is None:
        camera = CameraInputs(**common, **_read_camera(campaign, None))
        camera.notices[:0] = [*_camera_notices(camera), *_log_notices(camera), _window_notice(camera)]
        return camera
    source = _read_both(campaign, common)
    source.notices[:0] = [*_camera_notices(source), *_laser_notices(source)]
    return source


def _read_both(campaign: Campaign, common: Mapping[str, Any]) -> Source:
    """Read the frames of a campaign beside its readings, and refuse clocks that cannot both be right."""
    plan = campaign.plan
    assert plan is not None and plan.axis is not None
    if not _is_timed(common["deviations"]):
        assert campaign.interferometry is not None
        raise AlignmentError(
            f"{campaign.interferometry.deviations}: no reading has a time, so readings and frames cannot be brought together; give a table "
            "with times, or leave [thermography] out: the readings alone are evaluated by ISO 230-2"
        )
    axis = AxisGeometry(plan.axis.origin_mm, plan.axis.direction)
    cycles = cycles_of_readings(common["deviations"])
    source = Source(**common, **_read_camera(campaign, cycles), axis=axis)
    _raise_if_no_rise(campaign, source.frames, source.frames_rejected)
    _raise_if_line_leaves_plan(source)
    _raise_if_clocks_disagree(
        source.deviations,
        source.frame_times,
        clock_offset_s=source.thermography.clock_offset_s,
        source=str(campaign.path),
    )
    return source


def _read_drivers(campaign: Campaign) -> xr.Dataset | None:
    """Read the logged drivers; None where the campaign has none."""
    if campaign.drivers is None:
        return None
    drivers = read_drivers(campaign.resolve(campaign.drivers.file))
    return bring_to_utc(drivers, campaign.zone_of("drivers"), file=campaign.drivers.file)


def read_laser(campaign: Campaign) -> dict[str, Any]:
    """Read what `LaserInputs` holds: readings, compensated where the campaign asks for it, and the environment log.

    Parameters
    ----------
    campaign : Campaign
        With ``[interferometry]``.

    Returns
    -------
    dict
        ``interferometry``, ``deviations``, ``environment``, ``iso_budget`` and ``notices``, as in `LaserInputs`.

    Raises
    ------
    ValueError
        A subclass of the instruments' packages or of this one: a file that cannot be used.
    """
    interferometry = campaign.interferometry
    assert interferometry is not None
    laser = campaign.resolve(interferometry.deviations)
    deviations = read_deviations(
        laser,
        feed_mm_per_min=interferometry.feed_mm_per_min,
        dwell_s=interferometry.dwell_s,
        sheet=interferometry.sheet,
    )
    zone = campaign.zone_of("interferometry")
    deviations = bring_to_utc(deviations, zone, file=interferometry.deviations)
    check(deviations, DEVIATIONS, name=laser.name)
    deviations, notices = _timed_cycles(deviations, file=interferometry.deviations)
    _raise_if_too_few_readings(deviations, notices, file=interferometry.deviations)
    if _is_timed(deviations):
        cycles_of_readings(deviations)
    environment = None
    if interferometry.environment is not None:
        environment = read_environment(campaign.resolve(interferometry.environment))
        environment = bring_to_utc(environment, zone, file=interferometry.environment)
    with naming(campaign.resolve(interferometry.environment or interferometry.deviations)):
        compensated = compensate_readings(deviations, environment, interferometry)
    read = {"interferometry": interferometry, "environment": environment}
    if interferometry.material_temperature == "logged":
        return {
            **read,
            "deviations": compensated.deviations,
            "iso_budget": compensated.budget,
            "notices": [*notices, *compensated.notices],
        }
    if campaign.thermography is None:
        raise RecompensationError(
            f'{campaign.path}: interferometry.material_temperature = "camera", but this campaign has no [thermography]; '
            'write "logged", or add the frames'
        )
    return {**read, "deviations": deviations, "iso_budget": compensated.budget, "notices": notices}


def _timed_cycles(deviations: xr.Dataset, *, file: str) -> tuple[xr.Dataset, list[Notice]]:
    """Leave out cycles of which no reading has a time, where others have: nothing can be set beside them."""
    cycle = deviations["cycle"].values
    timed = ~np.isnat(deviations["time"].values).reshape(cycle.size, -1).all(axis=1)
    if timed.all() or not timed.any():
        return deviations, []
    numbers = listed(str(number) for number in cycle[~timed])
    return deviations.isel(cycle=timed), [
        Notice(
            "cycles_left_out",
            f"{counted(int((~timed).sum()), 'cycle')} of {cycle.size} in {file} left out, without a reading that has a time: {numbers}.",
            "Give the times of their readings, or measure them again; the estimates allow for the gaps.",
        )
    ]


def _is_timed(deviations: xr.Dataset) -> bool:
    """Whether any reading has a time."""
    return not bool(np.isnat(deviations["time"].values).all())


def _refuse_mixed_zones(campaign: Campaign, read: Mapping[str, Any]) -> None:
    """Refuse logs of which some give times with a zone and others without one."""
    interferometry, drivers = campaign.interferometry, campaign.drivers
    files = {
        "deviations": interferometry and interferometry.deviations,
        "environment": interferometry and interferometry.environment,
        "drivers": drivers and drivers.file,
    }
    logs = {str(file): read[name] for name, file in files.items() if read.get(name) is not None}
    if campaign.sensors is not None and read["sensors"] is not None:
        logs[campaign.sensors.file] = read["sensors"].temperature.to_dataset(name="temperature")
    refuse_mixed_zones(logs, source=str(campaign.path))


def _refuse_two_of_one_name(campaign: Campaign, read: Mapping[str, Any]) -> None:
    """Refuse a driver with the name of a quantity of the environment log, in whose place it would stand."""
    drivers, environment = read.get("drivers"), read.get("environment")
    if drivers is None or environment is None:
        return
    both = sorted({str(name) for name in drivers.data_vars} & {str(name) for name in environment.data_vars})
    if both:
        assert campaign.drivers is not None and campaign.interferometry is not None
        raise SourceError(
            f"{campaign.drivers.file}: the driver {both[0]!r} is logged in {campaign.interferometry.environment} too; rename its column"
        )


def _read_camera(campaign: Campaign, cycles: Cycles | None) -> dict[str, Any]:
    """Read what `CameraInputs` holds; without cycles of a laser, windows of the camera's time stand for them."""
    thermography, plan = campaign.thermography, campaign.plan
    assert thermography is not None and plan is not None
    frames, rejected = _read_frames(campaign)
    camera: dict[str, Any] = {
        "thermography": thermography,
        "plan": plan,
        "grid": _grid(campaign, frames, rejected),
        "fiducials": [] if plan.fiducials is None else read_fiducials(campaign.resolve(plan.fiducials)),
        "fiducials_file": plan.fiducials or "",
        "frames": frames,
        "frames_rejected": rejected,
        "cycles": cycles,
        "regions": [] if plan.regions is None else read_regions(campaign.resolve(plan.regions)),
        "lens": None if thermography.lens is None else read_lens(campaign.resolve(thermography.lens)),
    }
    if cycles is None:
        _raise_if_no_rise(campaign, frames, rejected)
        times = camera_on_laser_clock(frame_times(frames), thermography.clock_offset_s or 0.0)
        camera["cycles"] = cycles_of_frames(times, thermography.window_s or usual_window_s(times))
    return camera


def _grid(campaign: Campaign, frames: Sequence[FrameReference], rejected: Sequence[Mapping[str, Any]]) -> PlanGrid:
    """The cells of the plan: as the campaign states them in mm, or in pixels of the frames."""
    plan = campaign.plan
    assert plan is not None
    if plan.in_pixels:
        _raise_if_no_rise(campaign, frames, rejected)
        try:
            return picture_grid(frames[0].shape, plan.cell_px)
        except ThermographyError as error:
            raise SourceError(f"{campaign.path}: plan.{error}") from None
    assert plan.size_mm is not None and plan.cell_size_mm is not None
    return PlanGrid(*plan.size_mm, plan.cell_size_mm)


def _read_frames(campaign: Campaign) -> tuple[FrameList, list[dict[str, Any]]]:
    """Return the usable frames sorted by time, and file, index and reason of the others."""
    frames, rejected = index_recordings(campaign.frame_paths(), stack_options(campaign))
    has_time = ~np.isnat(frames.times)
    timed, odd = _of_one_size(frames.choose(has_time))
    left_out = [(frame, frame.reason.replace(f"{campaign.folder}/", "")) for frame in rejected]
    left_out += [(frame, "the frame has no time") for frame in frames.choose(~has_time)]  # type: ignore[misc]
    left_out += odd  # type: ignore[arg-type]
    return timed, [
        {"file": relative_name(frame.path, campaign.folder), "index": frame.index, "reason": reason}
        for frame, reason in left_out
    ]


def _of_one_size(frames: FrameList) -> tuple[FrameList, list[tuple[FrameReference, str]]]:
    """Keep the frames of the size that most of them have; the others with the reason."""
    if not frames:
        return frames, []
    shapes = frames.shapes()
    sizes, counted = np.unique(shapes, axis=0, return_counts=True)
    # Of two sizes as frequent as each other, that of the earlier frame.
    most = sizes[counted == counted.max()]
    first = min(range(len(most)), key=lambda i: int(np.argmax((shapes == most[i]).all(axis=1))))
    fits = (shapes == most[first]).all(axis=1)
    reason = f"{{1}} x {{0}} {_OTHER_SIZE} of {{3}} x {{2}}"
    return frames.choose(fits), [
        (frame, reason.format(*frame.shape, *most[first].tolist())) for frame in frames.choose(~fits)
    ]


def compensate_by_camera(source: Source, fields: xr.Dataset) -> tuple[Source, list[Notice]]:
    """Compensate the readings again with the temperature that the camera measured along the axis, where the campaign asks for it.

    Parameters
    ----------
    source : Source
        Inputs of the campaign.
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``, on the laser's clock.

    Returns
    -------
    Source
        With the compensated readings and their ISO 230-2 budget.
    list of Notice
        What was done.
    """
    if not source.needs_camera:
        return source, []
    material = see_material(fields, source.axis, source.deviations)
    file = source.interferometry.environment or source.interferometry.deviations
    with naming(source.campaign.resolve(file)):
        redone = compensate_readings(source.deviations, source.environment, source.interferometry, material=material)
    return replace(source, deviations=redone.deviations, iso_budget=redone.budget), redone.notices


def _randomised(campaign: Campaign, drivers: xr.Dataset | None) -> tuple[xr.DataArray, DutyLaw] | None:
    """Return the randomised loads and the law that they were drawn from; None where no load was randomised."""
    table = campaign.drivers
    if table is None or drivers is None or table.mean_dwell_s is None:
        return None
    law = DutyLaw(table.mean_dwell_s, table.least_dwell_s)
    names = [split_heading(campaign.resolve(table.file), heading)[0] for heading in table.randomised]
    return read_duty(drivers, names, law, source=table.file), law


def _camera_notices(source: CameraInputs) -> list[Notice]:
    """Return a notice for every kind of frame that is left out, and refuse what cannot be used."""
    _raise_if_patch_outside(source)
    _raise_if_regions_unusable(source)
    return [
        *frames_notices(source.frames_rejected),
        *pipe_notices(source.campaign),
        *_remark_notices(source.frames),
        *camera_accuracy_notices(source.thermography, source.frames),
    ]


def _window_notice(source: CameraInputs) -> Notice:
    """Return the notice that says what stands for cycles."""
    bounds, stated = source.cycles.bounds, source.thermography.window_s is not None
    seconds = float((bounds[0, 1] - bounds[0, 0]) / np.timedelta64(1, "s"))
    length = f"{seconds / 60.0:g} min" if seconds >= 60.0 else f"{seconds:g} s"
    windows = int(source.cycles.number[-1])
    empty = windows - len(bounds)
    return Notice(
        "cycles_from_windows",
        f"No laser gives cycles: the frames are divided into {counted(windows, 'window')} of {length}"
        f"{', as thermography.window states' if stated else ', a usual length here (thermography.window sets another)'}; "
        + (
            "each counts as a cycle."
            if not empty
            else f"each of the {len(bounds)} that hold a frame counts as a cycle."
        ),
        "",
    )


def _sensor_notices(source: Inputs) -> list[Notice]:
    """Return a notice for the contact sensors that are left out."""
    sensors = source.sensors
    if sensors is None or not sensors.faults:
        return []
    named = "; ".join(f"{sensors.logged['sensor'].values[fault.sensor]} {fault.words}" for fault in sensors.faults)
    return [
        Notice(
            "sensors_left_out",
            f"Faulty contact sensors of {sensors.file}: {named}. They are left out of all that is calculated, also before the fault, so "
            "that one set of sensors serves the whole test and the fault is no step of the table.",
            "Look at contact and cable.",
        )
    ]


def _log_notices(source: Inputs) -> list[Notice]:
    """Return a notice for the lines of the logs and the contact sensors that are left out."""
    notices = _sensor_notices(source)
    for table, code in ((source.environment, "environment_rows_left_out"), (source.drivers, "driver_rows_left_out")):
        if table is not None:
            notices += left_out_notices(table, code)
    return notices


def _laser_notices(source: LaserInputs) -> list[Notice]:
    """Return a notice for everything that is left out of the readings and the logs, or missing from them."""
    notices = [
        *left_out_notices(source.deviations, "readings_left_out"),
        *_as_read_notices(source),
        *_log_notices(source),
    ]
    if not _is_timed(source.deviations):
        notices.append(
            Notice(
                "no_times",
                f"{source.interferometry.deviations} gives no times: ISO 230-2 and neighbour differences are evaluated; drift, positions "
                "that stand out and causes need the time of every reading, and no log can be set beside them.",
                "Export one reading per line with its time.",
            )
        )
    elif source.environment is None:
        notices.append(
            Notice(
                "no_environment",
                "No environment was logged, so effects of the air and of the material compensation cannot be separated from the drift.",
                "Log air temperature, pressure, humidity and material temperature, and name the file as interferometry.environment.",
            )
        )
    return notices


def _raise_if_too_few_readings(deviations: xr.Dataset, left_out: Sequence[Notice], *, file: str) -> None:
    """Raise if the test has neither scatter nor drift."""
    sizes, said = deviations.sizes, "".join(f" {notice.message}" for notice in left_out)
    if sizes["cycle"] < _LEAST_CYCLES or sizes["target"] < _LEAST_TARGETS:
        raise SourceError(
            f"{file}: {counted(sizes['cycle'], 'cycle')} at {counted(sizes['target'], 'target')}; "
            f"scatter and drift need at least {_LEAST_CYCLES} cycles at {_LEAST_TARGETS} targets; measure more, or look at the readings "
            f"with thermofuse iso230 {file}{'.' if said else ''}{said}"
        )


def _as_read_notices(source: LaserInputs) -> list[Notice]:
    """Return the notice that says how the reader understood the laser file, where it had to choose."""
    notes = json.loads(source.deviations.attrs.get("notes", "[]"))
    if not notes:
        return []
    said = "; ".join(note.removeprefix("warning: ") for note in notes)
    return [
        Notice(
            "readings_as_read",
            f"{source.interferometry.deviations} was read so: {said}.",
            "Compare with the protocol of the test.",
        )
    ]


def _raise_if_no_rise(
    campaign: Campaign, frames: Sequence[FrameReference], rejected: Sequence[Mapping[str, Any]]
) -> None:
    """Raise if too few frames are left to show a rise."""
    if len(frames) < _LEAST_FRAMES:
        reasons = listed(_reason(item) for item in rejected) if rejected else "none rejected"
        single = f", or look at it with thermofuse inspect {frames[0].path}" if frames else ""
        raise SourceError(
            f"{campaign.path}: {counted(len(frames), 'usable frame')}, at least {_LEAST_FRAMES} are needed, as a rise is the change since "
            f"the first ({reasons}); check thermography.frames{single}"
        )


def _raise_if_patch_outside(source: CameraInputs) -> None:
    """Raise if the reference patch leaves the frames."""
    patch = source.thermography.reference_patch_px
    if patch is None:
        return
    column, row, columns, rows = patch
    height, width = source.frames[0].shape
    if column + columns > width or row + rows > height:
        raise SourceError(
            f"{source.campaign.path}: thermography.reference_patch = {list(patch)}: leaves the frames of {width} x {height} pixels; "
            "write first column, first row, number of columns and of rows"
        )


def _raise_if_regions_unusable(source: CameraInputs) -> None:
    """Raise if a region of an emissivity of its own has no cell of the plan to itself, or a state in a cycle that was not measured."""
    grid, cycles = source.grid, source.cycles.number
    for region in source.thermography.region:
        where = f"{source.campaign.path}: [[thermography.region]]"
        try:
            shares = Polygon(f"region {region.name}", np.array(region.corners_mm)).cell_shares(grid.x_mm, grid.y_mm)
        except PolygonError as error:
            raise SourceError(f"{where}: {error}; the plan is {grid.width_mm:g} x {grid.height_mm:g} mm") from error
        if not binary_erosion(shares == 1.0, np.ones((3, 3)), border_value=1).any():
            raise SourceError(
                f"{where}: region {region.name}: no cell lies inside and away from its edge, where the lens blurs both surfaces; give a "
                f"larger region, at least three cells of {grid.cell_size_mm:g} mm wide, or smaller cells"
            )
        for state in region.states or ():
            if state.cycle not in cycles:
                raise SourceError(
                    f"{where}: the states of region {region.name} name cycle {state.cycle}, but the campaign holds "
                    f"the cycles {cycles[0]} to {cycles[-1]}; name a measured one"
                )


def _raise_if_line_leaves_plan(source: Source) -> None:
    """Raise if axis position 0 or a target lies beside the plan, where the long work would end."""
    plan = xr.Dataset(coords={"x": source.grid.x_mm, "y": source.grid.y_mm})
    try:
        MeasuredLine(plan, source.axis, source.deviations["position"].values)
    except AlignmentError as error:
        raise AlignmentError(f"{source.campaign.path}: plan.axis: {error}") from error


class SourceError(FusionError):
    """The inputs of a campaign cannot be used together; the message says which and what to do."""


def frames_notices(rejected: Sequence[Mapping[str, Any]], code: str = "frames_rejected") -> list[Notice]:
    """Return one notice that counts frames that were left out and lists the first of them.

    Parameters
    ----------
    rejected : sequence of mapping
        ``file``, ``index`` and ``reason`` of every frame.
    code : str
        Code of the notice.
    """
    if not rejected:
        return []
    named = [f"{item['file']} ({_reason(item)})" for item in rejected]
    other_size = all(_OTHER_SIZE in _reason(item) for item in rejected)
    return [
        Notice(
            code,
            f"{counted(len(rejected), 'frame')} left out: {listed(named)}.",
            "Name the frames of one camera and one size only in thermography.frames."
            if other_size
            else "Copy damaged files again from the camera; a gap in the frames only widens the interpolation between its neighbours.",
        )
    ]


def pipe_notices(campaign: Campaign) -> list[Notice]:
    """Return one notice that counts what patterns of the campaign file match and no run reads: pipes, sockets and devices.

    Parameters
    ----------
    campaign : Campaign
        With frames, a record or neither.
    """
    patterns = {
        "thermography.frames": () if campaign.thermography is None else campaign.thermography.frames,
        "record.files": () if campaign.record is None else campaign.record.files,
    }
    notices = []
    for key, named in patterns.items():
        pipes = sorted({path for pattern in named for path in matching_pipes(campaign.folder, pattern)})
        if pipes:
            what = (
                "1 pipe, socket or device, which is"
                if len(pipes) == 1
                else f"{len(pipes)} pipes, sockets or devices, which are"
            )
            names = listed(relative_name(path, campaign.folder) for path in pipes)
            remedy = f"Write a pattern in {key} that matches measured files alone, or move away what is none."
            notices.append(Notice("pipes_left_out", f"{key} also matches {what} left out: {names}.", remedy))
    return notices


def _remark_notices(frames: Sequence[FrameReference]) -> list[Notice]:
    """Return one notice for everything that the reader corrected or skipped in frames that are used."""
    remarks = Counter(note for frame in frames for note in frame.notes)
    if not remarks:
        return []
    named = [f"{note} ({counted(count, 'frame')})" for note, count in remarks.items()]
    return [Notice("frames_read_with_remarks", f"Remarks of the reader of the frames: {listed(named)}.", "")]


def _reason(item: Mapping[str, Any]) -> str:
    """Return why a frame was left out without the absolute path that the reader's message starts with."""
    text = str(item["reason"])
    return text.split(f"{Path(item['file']).name}: ", 1)[-1]


#: A shift by whole quarter hours counts as a wrong time zone where less than this share of the readings lies within the frames.
_COVERED_NOW = 0.6


def _raise_if_clocks_disagree(
    deviations: xr.Dataset, frame_time: NDArray[np.datetime64], *, clock_offset_s: float | None, source: str
) -> None:
    """Raise if the recordings do not overlap in time or their clocks differ by a time zone.

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.
    frame_time : (n,) datetime64
        Times of the frames on the camera's clock, sorted.
    clock_offset_s : float or None
        Camera clock minus laser clock from the campaign file, None where it is left out.
    source : str
        Campaign file, for the message.

    Raises
    ------
    AlignmentError
        If frames and readings never meet, or would meet after a shift by whole quarter hours.
    """
    readings = deviations["time"].values
    readings = readings[~np.isnat(readings)]
    if readings.size == 0:
        raise AlignmentError(f"{source}: no reading has a time; readings and frames cannot be brought together")
    frames = camera_on_laser_clock(frame_time, clock_offset_s or 0.0)
    covered = covered_share(readings, frames)
    shift = likely_zone_shift(readings, frames)
    laser = f"readings of {deviations.attrs.get('source', 'the laser')}"
    span = f"frames {_shown(frames[0])} to {_shown(frames[-1])}, {laser} {_shown(readings.min())} to {_shown(readings.max())}"
    if covered < _COVERED_NOW and shift is not None:
        raise AlignmentError(
            f"{source}: the clocks look {abs(shift) / 3600:g} h apart, as in two time zones ({span}, so {covered:.0%} of the readings lie "
            f'between frames); write thermography.clock_offset = "{(clock_offset_s or 0.0) + shift:g} s" (camera clock minus laser '
            "clock) if so, or give the times of both with their zone"
        )
    if covered == 0.0:
        raise AlignmentError(
            f"{source}: frames and readings never meet ({span}); set thermography.clock_offset (camera clock minus laser clock), "
            "or check that both folders belong to the same test"
        )


def _shown(time: np.datetime64) -> str:
    """Return a time to the second with its zone."""
    return f"{np.datetime_as_string(time, unit='s')}Z"
