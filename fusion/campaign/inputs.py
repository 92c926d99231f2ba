"""Inputs of a campaign with one instrument or both: read, checked for overlap in time and plausible clocks; omissions are noted."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.align import (
    AlignmentError,
    AxisGeometry,
    MeasuredLine,
    camera_on_laser_clock,
    cycle_bounds,
)
from fusion.analysis.attribution.duty import DutyLaw, read_duty
from fusion.analysis.attribution.modes import Region, read_regions
from fusion.campaign.config import (
    Campaign,
    CampaignError,
    InterferometryTable,
    PlanTable,
    RegionTable,
    StackTable,
    ThermographyTable,
    relative_name,
)
from fusion.campaign.logs import NO_START, ContactSensors, TableError, read_drivers, read_run, read_sensors
from fusion.campaign.recompensation import RecompensationError, StatedBudget, compensate_readings, see_material
from fusion.campaign.time_zones import DATED, bring_to_utc, refuse_mixed_zones, utc, zone_notices
from fusion.campaign.values import in_order, matching_pipes, name_and_unit
from fusion.common import FusionError
from fusion.common.messages import naming
from fusion.results import axis as schema
from fusion.results.progress import clock_notices, counted, left_out_notices, listed
from fusion.results.results import Notice
from fusion.results.store import check
from interferometry.common import DEVIATIONS
from interferometry.io.faults import BadReading
from interferometry.io.readings import read_deviations, read_environment
from interferometry.io.tables import DateOrder, parse_time, read_table
from interferometry.iso230 import STANDARD_CYCLES
from thermography.common import ZERO_CELSIUS_K, ThermographyError
from thermography.io.frame import FrameReference
from thermography.io.other_cameras import StackOptions, TemperatureFrame, index_recordings, to_utc
from thermography.io.region import Region as PictureRegion
from thermography.io.region import RegionKind
from thermography.io.sequence import FrameList, camera_names, frame_times
from thermography.registration.plan import Fiducial, PlanGrid, Polygon, PolygonError, read_fiducials
from thermography.registration.projection import Lens, read_lens
from thermography.registration.register import picture_grid

#: Camera parameters that a campaign file may override.
OVERRIDABLE = (
    "emissivity", "reflected_temperature_K", "atmospheric_temperature_K", "relative_humidity", "object_distance_m", "window_transmission",
    "window_temperature_K",
)  # fmt: skip


def overridden_parameters(table: ThermographyTable) -> dict[str, float]:
    """Return the camera parameters that the campaign file overrides, where temperatures are in degC."""
    stated = {name: getattr(table, name.replace("_K", "_degC")) for name in OVERRIDABLE}
    given = {name: value for name, value in stated.items() if value is not None}
    return {name: value + ZERO_CELSIUS_K if name.endswith("_K") else value for name, value in given.items()}


# Files of temperatures of other cameras in a campaign: what ``[thermography.stack]`` says of them, and what it leaves
# open.


def stack_options(campaign: Campaign) -> StackOptions:
    """Return what a campaign file says of files of temperatures."""
    table = None if campaign.thermography is None else campaign.thermography.stack
    needs_time = campaign.interferometry is not None or len(campaign.frame_paths()) > 1
    if table is None:
        return StackOptions(needs_time=needs_time)
    reflected = table.reflected_temperature_degC
    same = ("scale", "offset", "variable", "axes", "time_in_name", "interval_s", "time_zone")
    return StackOptions(
        **{name: getattr(table, name) for name in same},
        unit=table.unit or "",
        times=None if table.times is None else _read_times(campaign, table, campaign.resolve(table.times)),
        start=None if table.start is None else _instant(campaign.path, table.start, table.time_zone),
        emissivity=table.emissivity,
        needs_time=needs_time,
        reflected_temperature_K=None if reflected is None else reflected + ZERO_CELSIUS_K,
    )


def _instant(path: Path, text: str, zone: str, order: DateOrder | None = None) -> np.datetime64:
    try:
        time, given = parse_time(text, order)
    except BadReading as fault:
        raise CampaignError(f"{path}: the time {text!r} of a frame {fault.reason}") from None
    return time if given else to_utc(path, time.astype("datetime64[us]").item(), zone)


def _read_times(campaign: Campaign, table: StackTable, path: Path) -> dict[tuple[Path, int], np.datetime64]:
    """Return UTC by file and frame from a table with the columns file, time and, for files of several frames, frame (from 0).

    A file is written with as much of its path as tells it from the others; lines of files that the campaign does not name are not used.
    """
    by_name: dict[str, list[Path]] = {}
    for frame in campaign.frame_paths():
        by_name.setdefault(frame.name, []).append(frame)
    read = read_table(path, ("file", "time"))
    rows = [(line, fields) for line, fields in read.records() if fields is not None]
    order = DateOrder.of(path, [(line, fields["time"]) for line, fields in rows])
    times: dict[tuple[Path, int], np.datetime64] = {}
    for line, fields in rows:
        index = fields.get("frame", "0") or "0"
        if not index.isdecimal():
            raise CampaignError(
                f"{path}, line {line}: frame {index!r} is not a whole number; frames of a file are counted from 0"
            )
        written = PurePath(fields["file"].replace("\\", "/"))
        parts = tuple(part for part in written.parts if part != "..")
        meant = [frame for frame in by_name.get(written.name, ()) if frame.parts[-len(parts) :] == parts]
        if len(meant) > 1:
            named = [relative_name(frame, campaign.folder) for frame in meant]
            raise CampaignError(
                f"{path}, line {line}: {fields['file']!r} may be any of {len(meant)} files ({listed(named)}); write it with its folder, as "
                f"{named[0]}"
            )
        for frame in meant:
            if (frame, int(index)) in times:
                raise CampaignError(
                    f"{path}, line {line}: a second time for frame {index} of {relative_name(frame, campaign.folder)}; leave one of them"
                )
            times[frame, int(index)] = _instant(path, fields["time"], table.time_zone, order)
    return times


def camera_accuracy_notices(table: ThermographyTable, frames: Sequence[FrameReference]) -> Iterator[Notice]:
    """Return notices of what was assumed of a camera whose files hold temperatures."""
    read = [frame for frame in frames if isinstance(frame, TemperatureFrame)]
    if not read:
        return
    if table.camera_offset_u_K is None:
        yield Notice.of("camera_accuracy_assumed")
    if any(frame.options.emissivity is None for frame in read):
        yield Notice.of("stack_emissivity_unknown")


# What a campaign was read into, before anything is calculated: the inputs of either instrument, or of both.

#: Lengths of the windows that serve as cycles where no laser gives them, s: what a clock shows, up to a day.
_WINDOWS_S = (
    0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0,
    *(60.0 * m for m in (1, 2, 5, 10, 15, 30)), *(3600.0 * h for h in (1, 2, 4, 8, 24)),
)  # fmt: skip
#: So many windows a recording is divided into at most: as many maps as a reader pages through.
_MOST_WINDOWS = 60


@dataclass(frozen=True, eq=False)
class Cycles:
    """Cycles by number (n,), counted from 1 with gaps, and their bounds (n, 2), each from its first instant to that of the time after it.

    On the laser's clock, or on the camera's where there is no laser.
    """

    number: NDArray[np.int64]
    bounds: NDArray[np.datetime64]


def cycles_of_readings(deviations: xr.Dataset) -> Cycles:
    """Return the cycles of a laser test."""
    return Cycles(deviations["cycle"].values, cycle_bounds(deviations))


def cycles_of_frames(times: NDArray[np.datetime64], window_s: float) -> Cycles:
    """Return consecutive windows of equal length, s, that serve as cycles, from the first of the sorted frames on, without empty ones."""
    length = np.timedelta64(round(window_s * 1e9), "ns")
    start = times.astype("datetime64[ns]")[0]
    number = np.unique((times.astype("datetime64[ns]") - start) // length).astype(np.int64)
    first = start + number * length
    return Cycles(number + 1, np.stack([first, first + length], axis=1))


def usual_window_s(times: NDArray[np.datetime64]) -> float:
    """Return the length of the windows where the campaign file states none, s: one for each of a few frames."""
    length_s = float((times[-1] - times[0]) / np.timedelta64(1, "s"))
    if times.size > _MOST_WINDOWS:
        return next((window for window in _WINDOWS_S if window >= length_s / _MOST_WINDOWS), _WINDOWS_S[-1])
    between_s = float(np.median(np.diff(times) / np.timedelta64(1, "s"))) if times.size > 1 else _WINDOWS_S[-1]
    return next((window for window in reversed(_WINDOWS_S) if window <= between_s), between_s)


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What every campaign with an instrument has: logs along ``time`` (UTC), contact sensors, and notices of everything left out.

    ``duty`` holds randomised loads over time and the law that they were drawn from.
    """

    campaign: Campaign
    environment: xr.Dataset | None = None
    drivers: xr.Dataset | None = None
    sensors: ContactSensors | None = None
    duty: tuple[xr.DataArray, DutyLaw] | None = None
    notices: list[Notice] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class LaserInputs(Inputs):
    """Inputs of a campaign with the laser; ``deviations`` keep ``interferometry.common.DEVIATIONS``.

    ``iso_cycles`` are those whose values by ISO 230-2 are quoted, None where the campaign file chooses none.
    """

    interferometry: InterferometryTable
    deviations: xr.Dataset
    iso_budget: StatedBudget
    iso_cycles: list[int] | None


@dataclass(frozen=True, kw_only=True)
class CameraInputs(Inputs):
    """Inputs of a campaign with the camera.

    ``frames`` are the usable thermograms of one camera sorted by time, ``frames_rejected`` file, index and reason of those that cannot be
    used; ``cycles`` are those of the laser, or windows of the camera's time. ``pictures`` are all usable thermograms, also those of other
    cameras and without a time; where no camera took most of them they are no series, and ``frames`` is empty.
    """

    thermography: ThermographyTable
    plan: PlanTable
    grid: PlanGrid
    fiducials: list[Fiducial]
    fiducials_file: str
    frames: Sequence[FrameReference]
    pictures: FrameList
    frames_rejected: list[schema.RejectedFrame]
    cycles: Cycles
    regions: list[Region] = field(default_factory=list)
    lens: Lens | None = None

    @property
    def frame_times(self) -> np.ndarray:
        """Times of the usable frames on the camera's clock, (n,) datetime64[ns]."""
        return frame_times(self.frames)

    @property
    def direction(self) -> tuple[float, float]:
        """Direction in which a moving table goes over the plan as the axis position grows."""
        assert self.plan.axis is not None
        return self.plan.axis.direction

    @property
    def travel_mm(self) -> float:
        """Largest distance of the table from where the plan holds, mm: without a laser, up to the length of the plan."""
        return max(self.grid.width_mm, self.grid.height_mm)


@dataclass(frozen=True, kw_only=True)
class Source(CameraInputs, LaserInputs):
    """Inputs of a campaign with both instruments; ``axis`` says where the measured line lies on the plan."""

    axis: AxisGeometry

    @property
    def needs_camera(self) -> bool:
        """Whether the readings are compensated again with the temperature from the camera."""
        return self.interferometry.material_temperature == "camera"

    @property
    def travel_mm(self) -> float:
        """Largest distance of a target from axis position 0, mm."""
        return float(np.abs(self.deviations["position"].values).max())


#: Words of the reason why a frame of another camera or size is left out.
_OTHER_CAMERA = "among frames of"
#: Words of the reason why a second frame of one time is left out.
_SAME_TIME = "has the same time"
#: Smallest test that has a scatter and a drift, and smallest recording that has a rise.
_LEAST_CYCLES, _LEAST_TARGETS, _LEAST_FRAMES = 2, 2, 2
#: Fewest cycles with a course: of two there is one difference at every target, which is drift as well as scatter.
_LEAST_COURSE = 3


def is_rotary(deviations: xr.Dataset) -> bool:
    """Return whether readings are those of a rotary axis, in arcsec."""
    return bool(deviations["deviation"].attrs["units"] == "arcsec")


def lacks_course(deviations: xr.Dataset) -> str:
    """Return why a test is evaluated by ISO 230-2 alone, without drift and neighbour differences; empty where it is not."""
    if is_rotary(deviations):
        return (
            "The axis is a rotary one: its angles are evaluated by ISO 230-2, with the scatter of the readings as the only uncertainty. "
            "Drift, positions that stand out and causes are evaluated along a linear axis only; expansion, dead path and the compensation "
            "of lengths do not apply."
        )
    cycles = deviations.sizes["cycle"]
    if cycles >= _LEAST_COURSE:
        return ""
    lacking = "R, A and the uncertainties need the standard deviation of several cycles; " if cycles == 1 else ""
    return (
        f"{counted(cycles, 'cycle')}, where ISO 230-2 asks for {STANDARD_CYCLES}: {lacking}drift and positions that stand out need at "
        f"least {_LEAST_COURSE} cycles."
    )


def read_source(campaign: Campaign) -> LaserInputs | CameraInputs | Source:
    """Read readings, logs, fiducials and the frames' headers of a campaign, with every check that needs no calculation."""
    with naming(campaign.path):
        common: dict[str, Any] = {"campaign": campaign, **_read_drivers(campaign), "sensors": read_sensors(campaign)}
        if campaign.interferometry is not None:
            common |= read_laser(campaign)
        _refuse_mixed_logs(campaign, common)
        source: LaserInputs | CameraInputs | Source
        if campaign.thermography is None:
            source = LaserInputs(**common)
            source.notices[:0] = _laser_notices(source)
        elif campaign.interferometry is None:
            source = CameraInputs(**common, **_read_camera(campaign, None))
            source.notices[:0] = [*_camera_notices(source), *_log_notices(source)]
        else:
            source = _read_both(campaign, common)
            source.notices[:0] = [*_camera_notices(source), *_laser_notices(source)]
        return source


def _read_drivers(campaign: Campaign) -> dict[str, Any]:
    """Read the logged drivers, and the randomised loads among them with the law that they were drawn from."""
    table = campaign.drivers
    if table is None:
        return {}
    path = campaign.resolve(table.file)
    drivers = bring_to_utc(
        read_drivers(path, table.layout), campaign.zone_of("drivers"), file=table.file, late_s=table.clock_offset_s
    )
    if table.mean_dwell_s is None:
        return {"drivers": drivers}
    law = DutyLaw(table.mean_dwell_s, table.least_dwell_s)
    names = [name_and_unit(heading)[0] for heading in table.randomised]
    return {"drivers": drivers, "duty": (read_duty(drivers, names, law, source=table.file), law)}


def _read_both(campaign: Campaign, common: Mapping[str, Any]) -> Source:
    """Read the frames of a campaign with readings."""
    plan = campaign.plan
    assert plan is not None and plan.axis is not None
    if not _is_timed(common["deviations"]):
        assert campaign.interferometry is not None
        raise AlignmentError(
            f"{campaign.interferometry.deviations}: no reading has a time, so readings and frames cannot be synchronised; give a table "
            "with times, or leave [thermography] out: the readings alone are evaluated by ISO 230-2"
        )
    axis = AxisGeometry(plan.axis.origin_mm, plan.axis.direction)
    cycles = cycles_of_readings(common["deviations"])
    source = Source(**common, **_read_camera(campaign, cycles), axis=axis)
    # A line or a target that leaves the plan would end the long work.
    cells = xr.Dataset(coords={"x": source.grid.x_mm, "y": source.grid.y_mm})
    try:
        MeasuredLine(cells, axis, source.deviations["position"].values)
    except AlignmentError as error:
        raise AlignmentError(f"{campaign.path}: plan.axis: {error}") from error
    return source


def reader_of_deviations(campaign: Campaign) -> Callable[[Path], xr.Dataset]:
    """Return what reads the file of readings as the campaign states it."""
    laser = campaign.interferometry
    stated: dict[str, Any] = {
        name: getattr(laser, name, None)
        for name in ("feed_mm_per_min", "dwell_s", "sheet", "directions", "position_unit", "deviation_unit")
    }
    return partial(read_deviations, rotary=campaign.thermography is None, **stated)


def read_laser(campaign: Campaign) -> dict[str, Any]:
    """Read what `LaserInputs` holds: readings, compensated where the campaign asks for it, and the environment log."""
    interferometry = campaign.interferometry
    assert interferometry is not None
    laser = campaign.resolve(interferometry.deviations)
    zone = campaign.zone_of("interferometry")
    late_s = interferometry.clock_offset_s
    alone = campaign.thermography is None
    deviations = reader_of_deviations(campaign)(laser)
    deviations = bring_to_utc(deviations, zone, file=interferometry.deviations, late_s=late_s)
    if not is_rotary(deviations):
        check(deviations, DEVIATIONS, name=laser.name)
    deviations, notices = _timed_cycles(deviations, file=interferometry.deviations)
    notices += zone_notices(deviations, code="laser_no_zone", of=interferometry.deviations)
    _raise_if_too_few_readings(deviations, notices, file=interferometry.deviations, alone=alone)
    if is_rotary(deviations) and campaign.acceptance.limits():
        raise SourceError(
            f"{campaign.path}: [acceptance] holds limits of a length, but {interferometry.deviations} is of a rotary axis; remove it"
        )
    span, chosen = campaign.acceptance.cycles, None
    if span is not None:
        stated = f'{campaign.path}: [acceptance] cycles = "{span[0]}-{span[1]}"'
        chosen = cycles_within(span, deviations, stated=stated, file=interferometry.deviations)
    if _is_timed(deviations):
        cycles_of_readings(deviations)
    environment = None
    if interferometry.environment is not None:
        environment = read_environment(campaign.resolve(interferometry.environment))
        late_s = interferometry.environment_clock_offset_s
        environment = bring_to_utc(environment, zone, file=interferometry.environment, late_s=late_s)
    with naming(campaign.resolve(interferometry.environment or interferometry.deviations)):
        compensated = compensate_readings(deviations, environment, interferometry)
    if interferometry.material_temperature == "logged":
        deviations, notices = compensated.deviations, [*notices, *compensated.notices]
    elif alone:
        raise RecompensationError(
            f'{campaign.path}: interferometry.material_temperature = "camera", but this campaign has no [thermography]; '
            'write "logged", or add the frames'
        )
    read = {"interferometry": interferometry, "environment": environment, "deviations": deviations}
    return {**read, "iso_budget": compensated.budget, "iso_cycles": chosen, "notices": notices}


def cycles_within(span: tuple[int, int], deviations: xr.Dataset, *, stated: str, file: str) -> list[int]:
    """Return the cycles of a range, first and last included; each of them has to hold readings."""
    first, last = span
    read = deviations["deviation"].notnull().any(("direction", "target")).values
    measured = deviations["cycle"].values[read].tolist()
    if measured and not measured[0] <= first <= last <= measured[-1]:
        raise SourceError(
            f"{stated}: cycles outside the test; {file} has readings of cycles {measured[0]} to {measured[-1]}"
        )
    if unread := sorted({*range(first, last + 1)} - {*measured}):
        raise SourceError(
            f"{stated}: {file} has no reading of {listed(f'cycle {number}' for number in unread)}; choose cycles without a gap"
        )
    return [*range(first, last + 1)]


def _timed_cycles(deviations: xr.Dataset, *, file: str) -> tuple[xr.Dataset, list[Notice]]:
    """Leave out cycles of which no reading has a time, where others have: nothing can be aligned with them."""
    cycle = deviations["cycle"].values
    timed = ~np.isnat(deviations["time"].values).reshape(cycle.size, -1).all(axis=1)
    if timed.all() or not timed.any():
        return deviations, []
    numbers = listed(str(number) for number in cycle[~timed])
    return deviations.isel(cycle=timed), [
        Notice.of(
            "cycles_left_out", cycles=counted(int((~timed).sum()), "cycle"), size=cycle.size, file=file, numbers=numbers
        )
    ]


def _is_timed(deviations: xr.Dataset) -> bool:
    """Whether any reading has a time."""
    return not bool(np.isnat(deviations["time"].values).all())


def _refuse_mixed_logs(campaign: Campaign, read: Mapping[str, Any]) -> None:
    """Refuse logs of which some give times with a zone and others without one, or of which two hold a quantity of one name."""
    laser, drivers = campaign.interferometry, campaign.drivers
    logs: dict[str, xr.Dataset] = {}
    if laser is not None:
        logs[laser.deviations] = read["deviations"]
        if laser.environment is not None:
            logs[laser.environment] = read["environment"]
    if drivers is not None:
        logs[drivers.file] = read["drivers"]
    if campaign.sensors is not None and read["sensors"] is not None:
        logs[campaign.sensors.file] = read["sensors"].temperature.to_dataset(name="temperature")
    refuse_mixed_zones(logs, source=str(campaign.path))
    if drivers is not None and laser is not None and laser.environment is not None:
        both = sorted({*map(str, read["drivers"].data_vars)} & {*map(str, read["environment"].data_vars)})
        if both:
            raise SourceError(
                f"{drivers.file}: the driver {both[0]!r} is logged in {laser.environment} too; rename its column"
            )


def _read_camera(campaign: Campaign, cycles: Cycles | None) -> dict[str, Any]:
    """Read what `CameraInputs` holds; without cycles of a laser, windows of the camera's time replace them."""
    thermography, plan = campaign.thermography, campaign.plan
    assert thermography is not None and plan is not None
    pictures, rejected = _read_frames(campaign, several_cameras=cycles is None)
    frames = _series(pictures) if cycles is None else pictures
    _raise_if_too_few_frames(campaign, pictures, rejected, least=1 if cycles is None else _LEAST_FRAMES)
    try:
        grid = plan_grid(plan, (frames or pictures)[0].shape)
    except ThermographyError as error:
        raise SourceError(f"{campaign.path}: plan.{error}") from None
    camera: dict[str, Any] = {
        "thermography": thermography,
        "plan": plan,
        "grid": grid,
        "fiducials": []
        if plan.fiducials is None
        else [
            replace(disc, u_mm=plan.fiducials_u_mm or 0.0) for disc in read_fiducials(campaign.resolve(plan.fiducials))
        ],
        "fiducials_file": plan.fiducials or "",
        "frames": frames,
        "pictures": pictures,
        "frames_rejected": rejected,
        "cycles": cycles,
        "regions": [] if plan.regions is None else read_regions(campaign.resolve(plan.regions)),
        "lens": None if thermography.lens is None else read_lens(campaign.resolve(thermography.lens)),
    }
    if cycles is None:
        times = camera_on_laser_clock(frame_times(frames), thermography.clock_offset_s or 0.0)
        windows = cycles_of_frames(times, thermography.window_s or usual_window_s(times)) if len(frames) > 1 else None
        camera["cycles"] = windows or Cycles(np.zeros(0, np.int64), np.zeros((0, 2), "datetime64[ns]"))
    return camera


def plan_grid(plan: PlanTable, shape: tuple[int, int]) -> PlanGrid:
    """Return the cells of a plan in mm, or of the picture (rows, columns) that is the plan."""
    if plan.in_pixels:
        return picture_grid(shape)
    assert plan.size_mm is not None and plan.cell_size_mm is not None
    return PlanGrid(*plan.size_mm, plan.cell_size_mm)


def _read_frames(campaign: Campaign, *, several_cameras: bool) -> tuple[FrameList, list[schema.RejectedFrame]]:
    """Return the usable frames sorted by time, and those that were left out."""
    frames, rejected = index_recordings(campaign.frame_paths(), stack_options(campaign))
    left_out: list[tuple[Any, str]] = [(frame, frame.reason) for frame in rejected]
    if not several_cameras:
        has_time = ~np.isnat(frames.times)
        left_out += [(frame, "the frame has no time") for frame in frames.choose(~has_time)]
        frames, odd = _of_one_camera(frames.choose(has_time), campaign.path)
        left_out += odd
    return frames, [left_out_frame(campaign, frame.path, frame.index, reason) for frame, reason in left_out]


def left_out_frame(campaign: Campaign, path: Path, index: int, reason: str) -> schema.RejectedFrame:
    """Return a frame that was left out, with file and reason as seen from the campaign file."""
    file, seen = relative_name(path, campaign.folder), reason.replace(f"{campaign.folder}/", "")
    return schema.RejectedFrame(file=file, index=index, reason=seen)


def _by_camera(frames: FrameList) -> tuple[NDArray[np.str_], dict[str, int]]:
    """Return camera and size of every frame, and how many frames each has, the one with most of them first."""
    names = camera_names(frames).astype(str)
    listed_names, first, counts = np.unique(names, return_index=True, return_counts=True)
    return names, {str(listed_names[k]): int(counts[k]) for k in np.lexsort((first, -counts))}


def _series(pictures: FrameList) -> FrameList:
    """Return the frames of the camera that took most of them, which have a time; none where it took no more than the others."""
    if len(pictures) == 1:
        return pictures
    names, counts = _by_camera(pictures)
    chosen = ~np.isnat(pictures.times) & (names == next(iter(counts), ""))
    return pictures.choose(chosen & (2 * chosen.sum() > chosen.size))


def _of_one_camera(frames: FrameList, path: Path) -> tuple[FrameList, list[tuple[FrameReference, str]]]:
    """Keep the frames of the camera and size that took most of them; the others with camera and time as the reason."""
    names, counts = _by_camera(frames)
    if len(counts) < 2:
        return frames, []
    cameras, most = {name.rpartition(",")[0] for name in counts}, next(iter(counts))
    if len(cameras) > 1 and 2 * counts[most] <= len(frames):
        of_each = "; ".join(f"{count} of {name}" for name, count in counts.items())
        raise SourceError(
            f"{path}: thermography.frames matches {len(frames)} frames of {len(cameras)} cameras, none of which took most of them, so they "
            f"are no series: {of_each}; name the frames of one camera"
        )
    return frames.choose(names == most), [
        (frame, f"{name}, taken {utc(frame.time)}, {_OTHER_CAMERA} {most}")
        for frame, name in zip(frames.choose(names != most), names[names != most], strict=True)
    ]


def compensate_by_camera(source: Source, fields: xr.Dataset) -> tuple[Source, list[Notice]]:
    """Compensate the readings again with the temperature that the camera measured along the axis, where the campaign asks for it."""
    if not source.needs_camera:
        return source, []
    material = see_material(fields, source.axis, source.deviations)
    file = source.interferometry.environment or source.interferometry.deviations
    with naming(source.campaign.resolve(file)):
        redone = compensate_readings(source.deviations, source.environment, source.interferometry, material=material)
    return replace(source, deviations=redone.deviations, iso_budget=redone.budget), redone.notices


def _camera_notices(source: CameraInputs) -> list[Notice]:
    """Return a notice for every kind of frame that is left out, and refuse what cannot be used."""
    _raise_if_patch_outside(source)
    _raise_if_regions_unusable(source)
    notices = [*frames_notices(source.frames_rejected), *pipe_notices(source.campaign)]
    if remarks := Counter(note for frame in source.frames for note in frame.notes):
        named = [f"{note} ({counted(count, 'frame')})" for note, count in remarks.items()]
        notices.append(Notice.of("frames_read_with_remarks", named=listed(named)))
    notices += _checksum_notices(source.frames)
    return [*notices, *camera_accuracy_notices(source.thermography, source.frames)]


def _checksum_notices(frames: Sequence[FrameReference]) -> Iterator[Notice]:
    """Yield the notice of frames that are kept although their headers differ from their checksums."""
    listed_frames = FrameList.of(frames)
    named = [f"{frame.path.name}, frame {frame.index}" for frame in listed_frames.choose(listed_frames.altered())]
    if named:
        yield Notice.of("frames_checksum", frames=counted(len(named), "frame"), named=listed(named))


def window_notice(source: CameraInputs) -> Notice:
    """Return the notice that says what is used as cycles."""
    bounds, stated = source.cycles.bounds, source.thermography.window_s is not None
    seconds = float((bounds[0, 1] - bounds[0, 0]) / np.timedelta64(1, "s"))
    length = f"{seconds / 60.0:g} min" if seconds >= 60.0 else f"{seconds:g} s"
    windows = int(source.cycles.number[-1])
    told = "as thermography.window states" if stated else "a usual length here (thermography.window sets another)"
    each = "each" if windows == len(bounds) else f"each of the {len(bounds)} that hold a frame"
    divided = f"the frames are divided into {counted(windows, 'window')} of {length}, {told}"
    return Notice.of("cycles_from_windows", divided=divided, each=each)


def _log_notices(source: Inputs) -> list[Notice]:
    """Return a notice for the contact sensors and the lines of the logs that are left out."""
    notices, sensors = [], source.sensors
    if sensors is not None and sensors.faults:
        named = "; ".join(f"{sensors.logged['sensor'].values[fault.sensor]} {fault.words}" for fault in sensors.faults)
        notices.append(Notice.of("sensors_left_out", file=sensors.file, named=named))
    for table, code in ((source.environment, "environment_rows_left_out"), (source.drivers, "driver_rows_left_out")):
        if table is not None:
            notices += [*left_out_notices(table, code), *clock_notices(table)]
    return notices


def _laser_notices(source: LaserInputs) -> list[Notice]:
    """Return a notice for everything that is left out of the readings and the logs, or missing from them."""
    notices = left_out_notices(source.deviations, "readings_left_out")
    if notes := json.loads(source.deviations.attrs.get("notes", "[]")):
        said = "; ".join(note.removeprefix("warning: ") for note in notes)
        notices.append(Notice.of("readings_as_read", deviations=source.interferometry.deviations, said=said))
    notices += _log_notices(source)
    if reason := lacks_course(source.deviations):
        five = source.deviations.sizes["cycle"] >= STANDARD_CYCLES
        notices.append(Notice("standard_alone", reason, "" if five else f"Measure {STANDARD_CYCLES} cycles."))
    elif not _is_timed(source.deviations):
        notices.append(Notice.of("no_times", deviations=source.interferometry.deviations))
    elif source.environment is None:
        notices.append(Notice.of("no_environment"))
    return notices


def _raise_if_too_few_readings(deviations: xr.Dataset, left_out: Sequence[Notice], *, file: str, alone: bool) -> None:
    """Raise if the test has no deviation along the axis, or beside a camera neither scatter nor drift."""
    sizes, said = deviations.sizes, "".join(f" {notice.message}" for notice in left_out)
    if (sizes["cycle"] < _LEAST_CYCLES and not alone) or sizes["target"] < _LEAST_TARGETS:
        raise SourceError(
            f"{file}: {counted(sizes['cycle'], 'cycle')} at {counted(sizes['target'], 'target')}; "
            f"scatter and drift need at least {_LEAST_CYCLES} cycles at {_LEAST_TARGETS} targets; measure more, or evaluate the readings "
            f"with thermofuse iso230 {file}{'.' if said else ''}{said}"
        )


def _raise_if_too_few_frames(
    campaign: Campaign, frames: Sequence[FrameReference], rejected: Sequence[schema.RejectedFrame], *, least: int
) -> None:
    """Raise if no frame is left, or beside a laser too few to show a rise."""
    if len(frames) < least:
        reasons = listed(_reason(item) for item in rejected) if rejected else "none rejected"
        needed = f"at least {least} are needed, as a rise is the change since the first " if least > 1 else ""
        raise SourceError(
            f"{campaign.path}: {counted(len(frames), 'usable frame')}, {needed}({reasons}); check thermography.frames"
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
    """Raise if a region is not in the picture, or one of an emissivity of its own has no cell of the plan, or a state no measured cycle."""
    grid, cycles = source.grid, source.cycles.number
    where = f"{source.campaign.path}: [[thermography.region]]"
    names = Counter(region.name for region in source.thermography.region)
    for region in source.thermography.region:
        if names[region.name] > 1:
            raise SourceError(
                f"{where}: {names[region.name]} regions are called {region.name}; give each a name of its own"
            )
        if region.unit == "px":
            try:
                picture_region(region).pixels((source.frames or source.pictures)[0].shape)
            except ThermographyError as error:
                raise SourceError(f"{where}: {error}") from None
    for region in source.thermography.surfaces:
        try:
            shares = Polygon(f"region {region.name}", np.array(region.corners)).cell_shares(grid.x_mm, grid.y_mm)
        except PolygonError as error:
            raise SourceError(f"{where}: {error}; the plan is {grid.width_mm:g} x {grid.height_mm:g} mm") from error
        if not scipy.ndimage.binary_erosion(shares == 1.0, np.ones((3, 3)), border_value=1).any():
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


#: Shape of a region in the campaign file -> kind of region.
_KINDS: dict[str, RegionKind] = {
    "spot": "spot", "line": "line", "rectangle": "box", "ellipse": "ellipse", "polygon": "polygon",
}  # fmt: skip


def picture_region(table: RegionTable) -> PictureRegion:
    """Return a region of the campaign file whose points are pixels."""
    return PictureRegion(table.name, _KINDS[table.shape], table.points, table.emissivity)


class SourceError(FusionError):
    """The inputs of a campaign cannot be used together; the message says which and what to do."""


def frames_notices(rejected: Sequence[schema.RejectedFrame], code: str = "frames_rejected") -> list[Notice]:
    """Return one notice that counts frames that were left out and lists the first of them."""
    if not rejected:
        return []
    named = [f"{item.file} ({_reason(item)})" for item in rejected]
    remedy = "Copy damaged files again from the camera."
    if all(_OTHER_CAMERA in _reason(item) for item in rejected):
        remedy = "Name the frames of one camera and one size only in thermography.frames."
    elif all(_SAME_TIME in _reason(item) for item in rejected):
        remedy = "Give every frame a time of its own, for example by times in [thermography.stack]."
    return [Notice(code, f"{counted(len(rejected), 'frame')} left out: {listed(named)}.", remedy)]


def pipe_notices(campaign: Campaign) -> list[Notice]:
    """Return one notice that counts what patterns of the campaign file match and no run reads: pipes, sockets and devices."""
    patterns = {
        "thermography.frames": () if campaign.thermography is None else campaign.thermography.frames,
        "record.files": () if campaign.record is None else campaign.record.files,
    }
    notices = []
    for key, named in patterns.items():
        pipes = in_order({path for pattern in named for path in matching_pipes(campaign.folder, pattern)})
        if pipes:
            several = f"{len(pipes)} pipes, sockets or devices, which are"
            what = "1 pipe, socket or device, which is" if len(pipes) == 1 else several
            names = listed(relative_name(path, campaign.folder) for path in pipes)
            remedy = f"Write a pattern in {key} that matches measured files only, or move the others away."
            notices.append(Notice("pipes_left_out", f"{key} also matches {what} left out: {names}.", remedy))
    return notices


def _reason(item: schema.RejectedFrame) -> str:
    """Return why a frame was left out without the absolute path that the reader's message starts with."""
    return item.reason.split(f"{Path(item.file).name}: ", 1)[-1]


# A record of one run or of several: every table read, the runs in the order of their times, held to the same columns.

#: Time between runs that each count their seconds from zero, so that they can be laid one after the other: one day.
_BETWEEN = np.timedelta64(1, "D").astype("m8[ns]")


def read_record(campaign: Campaign) -> xr.Dataset:
    """Read the record of a campaign, all of its runs.

    Parameters
    ----------
    campaign : Campaign
        What `load_campaign` returns, with a ``[record]``.

    Returns
    -------
    Dataset
        ``temperature`` (time, sensor) in degC, ``displacement`` (time, channel) in um, and ``driver`` (time, driver_name) as logged.

    Raises
    ------
    TableError
        If a table cannot be read, or runs do not fit together.

    Notes
    -----
    Tables, runs and their times: docs/method/records.md.
    """
    paths = campaign.record_paths()
    if len(paths) == 1:
        return read_run(campaign, paths[0])
    tables = {path: read_run(campaign, path) for path in paths}
    _refuse_different_columns(tables)
    # A name that occurs twice is given with its folder.
    names = Counter(path.name for path in tables)
    named = {path: path.name if names[path.name] == 1 else relative_name(path, campaign.folder) for path in tables}
    refuse_mixed_zones({named[path]: table for path, table in tables.items()}, source=str(campaign.path))
    ordered = dict(sorted(tables.items(), key=lambda item: item[1]["time"].values[0]))
    overlaps = _overlaps(ordered)
    # Times without a date that overlap: every run counts from its own zero, and nothing says when that was.
    own_zero = bool(overlaps) and all(table["time"].values[-1] < DATED for table in tables.values())
    if own_zero:
        start = NO_START
        for path, table in tables.items():
            moved = table["time"].values + (start - table["time"].values[0])
            tables[path] = table.assign_coords(time=("time", moved, table["time"].attrs))
            start = moved[-1] + _BETWEEN
    elif overlaps:
        raise TableError(overlaps[0])
    else:
        tables = ordered
    test = set(campaign.test_paths()) or {list(tables)[-1]}
    numbered = [
        table.assign_coords(run=("time", np.full(table.sizes["time"], k))) for k, table in enumerate(tables.values())
    ]
    # The columns of every run may stand in an order of their own.
    joined = xr.concat(numbered, "time", data_vars="minimal", coords="minimal", compat="override", join="left")
    runs = [named[path] for path in tables]
    listed_of = {
        name: json.dumps([one for table in tables.values() for one in json.loads(table.attrs[name])])
        for name in ("left_out", "clock", "held")
    }
    return joined.assign_attrs(
        source=", ".join(runs),
        **listed_of,
        runs=json.dumps(runs),
        test=json.dumps([number for number, path in enumerate(tables) if path in test]),
        own_zero=int(own_zero),
    )


def _refuse_different_columns(tables: dict[Path, xr.Dataset]) -> None:
    """Refuse runs that do not hold the same sensors, channels and drivers, a driver in the same unit."""
    (first, reference), *others = tables.items()
    for path, table in others:
        for coordinate in ("sensor", "channel", "driver_name"):
            here, there = (set(one[coordinate].values.tolist()) for one in (table, reference))
            if here != there:
                differing = ", ".join(sorted(map(str, here ^ there)))
                raise TableError(
                    f"{path}: the columns differ from those of {first.name}: {differing} is not in both; all runs of a record need the "
                    "same columns, name those that all of them have"
                )
        of_drivers = (
            dict(zip(one["driver_name"].values.tolist(), one["driver_units"].values.tolist(), strict=True))
            for one in (table, reference)
        )
        for units, wanted in (tuple(of_drivers), tuple(json.loads(one.attrs["units"]) for one in (table, reference))):
            for name, unit in units.items():
                if unit and (other := wanted.get(name)) and unit != other:
                    raise TableError(
                        f'{path}: "{name}" is in {unit}, in {first.name} in {other}; write it in one unit in all runs'
                    )


def _overlaps(tables: dict[Path, xr.Dataset]) -> list[str]:
    """Say which runs, in the order of their times, begin before the one before has ended."""
    found = []
    for (before, earlier), (path, later) in pairwise(tables.items()):
        first, last = later["time"].values[0], earlier["time"].values[-1]
        if first <= last:
            found.append(
                f"{path}: the run begins at {np.datetime_as_string(first, unit='s')}, before {before.name} has ended "
                f"({np.datetime_as_string(last, unit='s')}); name every run once, and correct its times or record.start"
            )
    return found
