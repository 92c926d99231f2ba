"""Inputs of a campaign with both instruments: read, checked for overlap in time and plausible clocks; omissions are noted."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from fusion.alignment.align import AlignmentError, AxisGeometry, MeasuredLine, camera_on_laser_clock, cycle_bounds
from fusion.alignment.zone_shift import covered_share, likely_zone_shift
from fusion.attribution.randomised_duty import DutyLaw, read_duty
from fusion.attribution.thermal_modes import Region, read_regions
from fusion.campaign.config import Campaign, InterferometryTable, PlanTable, ThermographyTable, relative_name
from fusion.campaign.logged_tables import read_drivers, split_heading
from fusion.campaign.recompensation import compensate_readings, see_material
from fusion.campaign.time_zones import bring_to_utc, refuse_mixed_zones
from fusion.errors import FusionError
from fusion.products.contracts import check
from fusion.products.results import Notice
from interferometry.contract import DEVIATIONS
from interferometry.io.readers import read_deviations, read_environment
from interferometry.iso230 import Iso230Budget
from thermography.io.flir import FrameReference, index_frames
from thermography.registration.lens import Lens, read_lens
from thermography.registration.plan import Fiducial, PlanGrid, read_fiducials
from thermography.registration.polygon import Polygon, PolygonError

#: Maximum number of omitted items listed in a message; the products hold all of them.
_NAMED = 5
#: Smallest campaign that closed loop and attribution can use.
_LEAST_CYCLES, _LEAST_TARGETS, _LEAST_FRAMES = 12, 3, 12


@dataclass(frozen=True)
class Source:
    """Inputs of a campaign with both instruments, before anything is calculated.

    Attributes
    ----------
    campaign, thermography, plan, interferometry
        The campaign file and its tables.
    deviations : Dataset
        Readings that keep ``interferometry.contract.DEVIATIONS``.
    environment, drivers : Dataset or None
        Logs along ``time`` (UTC); None where nothing was logged.
    fiducials : list of Fiducial
        Fiducials of the plan.
    frames, frames_rejected : list
        Usable thermograms sorted by time, and file, index and reason of the others.
    regions : list of Region
        Named regions of the plan.
    duty : tuple or None
        Randomised loads over time and the law that they were drawn from.
    notices : list of Notice
        Everything that was left out.
    iso_budget : Iso230Budget or None
        Uncertainty contributions to ISO 230-2 values; None for those of the readings as recorded.
    lens : Lens or None
        Calibration of the camera's lens.
    """

    campaign: Campaign
    thermography: ThermographyTable
    plan: PlanTable
    interferometry: InterferometryTable
    deviations: xr.Dataset
    environment: xr.Dataset | None
    drivers: xr.Dataset | None
    fiducials: list[Fiducial]
    frames: list[FrameReference]
    frames_rejected: list[dict[str, Any]]
    regions: list[Region] = field(default_factory=list)
    duty: tuple[xr.DataArray, DutyLaw] | None = None
    notices: list[Notice] = field(default_factory=list)
    iso_budget: Iso230Budget | None = None
    lens: Lens | None = None

    @property
    def needs_camera(self) -> bool:
        """Whether the readings are compensated again with the temperature from the camera."""
        return self.interferometry.material_temperature == "camera"

    @property
    def is_recompensated(self) -> bool:
        """Whether the environment log entered the readings: compensated again, or corrected for a dead path."""
        return self.interferometry.compensation == "redo" or self.interferometry.dead_path_mm != 0.0

    @property
    def grid(self) -> PlanGrid:
        """The plan's cells."""
        return PlanGrid(*self.plan.size_mm, self.plan.cell_size_mm)

    @property
    def axis(self) -> AxisGeometry:
        """Where the measured line lies on the plan."""
        return AxisGeometry(self.plan.axis.origin_mm, self.plan.axis.direction)

    @property
    def frame_times(self) -> np.ndarray:
        """Times of the usable frames on the camera's clock, (n,) datetime64[ns]."""
        return np.array([frame.time for frame in self.frames], dtype="datetime64[ns]")


def read_source(campaign: Campaign) -> Source:
    """Read readings, logs, fiducials and the frames' headers of a campaign, with every check that needs no calculation.

    Parameters
    ----------
    campaign : Campaign
        A checked campaign with both instruments.

    Returns
    -------
    Source
        What was read, with a notice for everything that was left out.

    Raises
    ------
    ValueError
        A subclass of the instruments' packages or of this one: a file that cannot be used, cycles that overlap, clocks that never meet.
    """
    thermography, plan, interferometry = campaign.thermography, campaign.plan, campaign.interferometry
    assert thermography is not None and plan is not None and interferometry is not None
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
    cycle_bounds(deviations)
    environment = None
    if interferometry.environment is not None:
        environment = read_environment(campaign.resolve(interferometry.environment))
        environment = bring_to_utc(environment, zone, file=interferometry.environment)
    compensated = compensate_readings(deviations, environment, interferometry)
    by_camera = interferometry.material_temperature == "camera"
    drivers = None
    if campaign.drivers is not None:
        drivers = read_drivers(campaign.resolve(campaign.drivers.file))
        drivers = bring_to_utc(drivers, campaign.zone_of("drivers"), file=campaign.drivers.file)
    files = (interferometry.deviations, interferometry.environment, campaign.drivers and campaign.drivers.file)
    logs = {
        str(file): log for file, log in zip(files, (deviations, environment, drivers), strict=True) if log is not None
    }
    refuse_mixed_zones(logs, source=str(campaign.path))
    frames, rejected = index_frames(campaign.frame_paths())
    rejected_frames = [
        {
            "file": relative_name(frame.path, campaign.folder),
            "index": frame.index,
            "reason": frame.reason.replace(f"{campaign.folder}/", ""),
        }
        for frame in rejected
    ]
    timed = [frame for frame in frames if not np.isnat(frame.time)]
    rejected_frames += [
        {"file": relative_name(frame.path, campaign.folder), "index": frame.index, "reason": "the frame has no time"}
        for frame in frames
        if np.isnat(frame.time)
    ]
    timed, odd = _of_one_size(timed)
    rejected_frames += [
        {"file": relative_name(frame.path, campaign.folder), "index": frame.index, "reason": reason}
        for frame, reason in odd
    ]
    source = Source(
        campaign, thermography, plan, interferometry, deviations if by_camera else compensated.deviations, environment, drivers,
        read_fiducials(campaign.resolve(plan.fiducials)), timed, rejected_frames,
        [] if plan.regions is None else read_regions(campaign.resolve(plan.regions)), _randomised(campaign, drivers),
        [] if by_camera else compensated.notices, compensated.budget,
        None if thermography.lens is None else read_lens(campaign.resolve(thermography.lens)),
    )  # fmt: skip
    source.notices[:0] = _notices(source)
    return source


def _of_one_size(frames: list[FrameReference]) -> tuple[list[FrameReference], list[tuple[FrameReference, str]]]:
    """Keep the frames of the size that most of them have; the others with the reason."""
    if not frames:
        return [], []
    counted_shapes = Counter(frame.shape for frame in frames)
    shape = counted_shapes.most_common(1)[0][0]
    kept = [frame for frame in frames if frame.shape == shape]
    reason = "{1} x {0} pixels among frames of {3} x {2}"
    return kept, [(frame, reason.format(*frame.shape, *shape)) for frame in frames if frame.shape != shape]


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


def _notices(source: Source) -> list[Notice]:
    """Return a notice for everything that is left out of the input or missing from it."""
    notices = [*frames_notices(source.frames_rejected), *_remark_notices(source.frames)]
    _raise_if_too_small(source)
    _raise_if_patch_outside(source)
    _raise_if_regions_unusable(source)
    _raise_if_line_leaves_plan(source)
    _raise_if_clocks_disagree(
        source.deviations,
        source.frame_times,
        clock_offset_s=source.thermography.clock_offset_s,
        source=str(source.campaign.path),
    )
    notices += left_out_notices(source.deviations, "readings_left_out")
    notes = json.loads(source.deviations.attrs.get("notes", "[]"))
    if notes:
        said = "; ".join(note.removeprefix("warning: ") for note in notes)
        notices.append(
            Notice(
                "readings_as_read",
                f"{source.interferometry.deviations} was read so: {said}.",
                "Compare with the protocol of the test.",
            )
        )
    for table, code in ((source.environment, "environment_rows_left_out"), (source.drivers, "driver_rows_left_out")):
        if table is not None:
            notices += left_out_notices(table, code)
    if source.environment is None:
        notices.append(
            Notice(
                "no_environment",
                "No environment was logged, so effects of the air and of the material compensation cannot be separated from the drift.",
                "Log air temperature, pressure, humidity and material temperature, and name the file as interferometry.environment.",
            )
        )
    return notices


def _raise_if_too_small(source: Source) -> None:
    """Raise if the campaign is too small for a model of the drift."""
    sizes = source.deviations.sizes
    if sizes["cycle"] < _LEAST_CYCLES or sizes["target"] < _LEAST_TARGETS:
        raise SourceError(
            f"{source.interferometry.deviations}: {counted(sizes['cycle'], 'cycle')} at {counted(sizes['target'], 'target')}; "
            f"a model of the drift needs at least {_LEAST_CYCLES} cycles (better 50) at {_LEAST_TARGETS} targets, "
            "thermofuse iso230 evaluates shorter tests"
        )
    if len(source.frames) < _LEAST_FRAMES:
        reasons = (
            listed(_reason(item) for item in source.frames_rejected) if source.frames_rejected else "none rejected"
        )
        raise SourceError(
            f"{source.campaign.path}: {counted(len(source.frames), 'usable frame')}, at least {_LEAST_FRAMES} are needed "
            f"({reasons}); check thermography.frames"
        )


def _raise_if_patch_outside(source: Source) -> None:
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


def _raise_if_regions_unusable(source: Source) -> None:
    """Raise if a region of an emissivity of its own has no cell of the plan to itself, or a state in a cycle that was not measured."""
    grid, cycles = source.grid, source.deviations["cycle"].values
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
                    f"{where}: the states of region {region.name} name cycle {state.cycle}, but {source.interferometry.deviations} holds "
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
    return [
        Notice(
            code,
            f"{counted(len(rejected), 'frame')} left out: {listed(named)}.",
            "Copy damaged files again from the camera; a gap in the frames only widens the interpolation between its neighbours.",
        )
    ]


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


def left_out_notices(dataset: xr.Dataset, code: str) -> list[Notice]:
    """Return one notice for each file that counts its rejected lines and lists the first of them.

    Parameters
    ----------
    dataset : Dataset
        Table whose attribute ``left_out`` lists the rejected lines as JSON.
    code : str
        Code of the notice.
    """
    lines = json.loads(dataset.attrs.get("left_out", "[]"))
    notices = []
    for path in dict.fromkeys(item["path"] for item in lines):
        named = [f"line {item['line']} ({item['value']!r} {item['reason']})" for item in lines if item["path"] == path]
        notices.append(
            Notice(
                code,
                f"{counted(len(named), 'line')} of {path} left out: {listed(named)}.",
                f"Correct these lines in {path} and run again; the estimates allow for the gaps.",
            )
        )
    return notices


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, plural unless the number is 1.

    Parameters
    ----------
    number : int
        How many.
    noun : str
        In the singular.
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def listed(names: Iterable[str]) -> str:
    """Return the first names, and how many more there are.

    Parameters
    ----------
    names : iterable of str
        All of them; the first five are listed.
    """
    names = list(names)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return "; ".join(names[:_NAMED]) + more


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
    span = f"frames {_shown(frames[0])} to {_shown(frames[-1])}, readings {_shown(readings.min())} to {_shown(readings.max())}"
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
