"""Checks of a campaign that need no long work: the file, what it names, clocks and overlap, the axis on the plan, a few frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fusion.alignment.align import camera_on_laser_clock
from fusion.campaign.config import Campaign, load_campaign
from fusion.campaign.inputs import read_source
from fusion.campaign.logged_tables import read_drivers
from fusion.campaign.sources import CameraInputs, Inputs, LaserInputs
from fusion.consistency.checks import Check, ContradictionError, open_doubts, refuse_contradictions
from fusion.errors import FusionError
from fusion.pipeline import record as record_stage
from fusion.pipeline.consistency import check_source
from fusion.products.notices import counted
from fusion.products.results import Notice
from fusion.starting.time_bars import Recording, time_bars
from interferometry.errors import InterferometryError
from interferometry.io.readers import read_deviations, read_environment
from thermography.errors import ThermographyError
from thermography.registration.lens import read_lens
from thermography.registration.plan import read_fiducials

#: What the readers raise for input that cannot be used.
_BAD_INPUT = (FusionError, ThermographyError, InterferometryError, OSError)


@dataclass(frozen=True)
class CampaignCheck:
    """What is known of a campaign before it is run.

    Attributes
    ----------
    path : Path
        The campaign file.
    title : str
        Its title; empty where the file cannot be read.
    content : tuple of str
        What was read, one sentence each.
    recordings : tuple of Recording
        What was recorded when.
    faults : tuple of str
        Why `thermofuse run` would refuse it.
    checks : tuple of Check
        Consistency of the inputs, as far as it needs no field.
    accepted : tuple of str
        Codes of the doubts that the campaign file accepts.
    notices : tuple of Notice
        What would be left out.
    """

    path: Path
    title: str = ""
    content: tuple[str, ...] = ()
    recordings: tuple[Recording, ...] = ()
    faults: tuple[str, ...] = ()
    checks: tuple[Check, ...] = ()
    accepted: tuple[str, ...] = ()
    notices: tuple[Notice, ...] = field(default=())

    @property
    def doubts(self) -> list[Check]:
        """Checks that are not passed, nor accepted, and that a run would name first."""
        return open_doubts(self.checks, self.accepted)

    def lines(self, *, quiet: bool = False) -> list[str]:
        """Return the check as lines of text, what would refuse it last; `quiet` leaves faults and doubts only."""
        doubts = [f"doubt ({check.code}): {check.evidence} {check.remedy}" for check in self.doubts]
        notices = [f"note: {notice.message} {notice.remedy}".rstrip() for notice in self.notices]
        title = [f"{self.path}: {self.title}"] if self.title else []
        bars = [f"  {line}" for line in time_bars(self.recordings)]
        told = [] if quiet else [*title, *(f"  {line}" for line in self.content), *bars, *notices]
        faults = [f"fault: {fault}" for fault in self.faults]
        return [*told, *doubts, *faults, *([] if quiet else [self._verdict()])]

    def _verdict(self) -> str:
        if self.faults:
            return f"not ready: {counted(len(self.faults), 'fault')}"
        passed = len(self.checks) - len(self.doubts)
        doubted = f", {counted(len(self.doubts), 'doubt')}" if self.doubts else ""
        return f"ready to run: {counted(passed, 'check')} passed{doubted}" if self.checks else "ready to run"

    def as_json(self) -> dict[str, Any]:
        """Return the check as a mapping of JSON's own types."""
        return {
            "campaign": self.title,
            "ready": not self.faults,
            "content": list(self.content),
            "recordings": [
                {"name": recording.name, "stretches": [[f"{a}Z", f"{b}Z"] for a, b in recording.stretches()]}
                for recording in self.recordings
            ],
            "faults": list(self.faults),
            "doubts": [{"code": one.code, "evidence": one.evidence, "remedy": one.remedy} for one in self.doubts],
            "notices": [{"code": one.code, "message": one.message, "remedy": one.remedy} for one in self.notices],
            "checks_passed": len(self.checks) - len(self.doubts),
        }


def check_campaign(path: Path) -> CampaignCheck:
    """Check a campaign without running it.

    Parameters
    ----------
    path : Path
        The campaign file.

    Returns
    -------
    CampaignCheck
        Every fault that can be found without a calculation, also where an earlier one would end a run.
    """
    try:
        campaign = load_campaign(path)
    except _BAD_INPUT as error:
        return CampaignCheck(path, faults=tuple(dict.fromkeys(_words(error).splitlines())))
    if campaign.record is not None:
        return _check_record(campaign)
    return _check_instruments(campaign)


def _check_record(campaign: Campaign) -> CampaignCheck:
    """Check a campaign whose data are a record."""
    title = campaign.campaign.title
    try:
        source = record_stage.read_source(campaign)
    except _BAD_INPUT as error:
        return CampaignCheck(campaign.path, title, faults=(_words(error),))
    runs, table = len(campaign.record_paths()), source.health.table
    content = (
        f"record: {counted(runs, 'run')}, {counted(len(source.health.names), 'temperature')}, "
        f"{counted(table.sizes['channel'], 'displacement')}, {counted(table.sizes['time'], 'row')}",
    )
    recordings = (Recording("record", table["time"].values),)
    return CampaignCheck(campaign.path, title, content, recordings, notices=tuple(source.notices))


def _check_instruments(campaign: Campaign) -> CampaignCheck:
    """Check a campaign with instruments; where it cannot be read, each of its files by itself."""
    title = campaign.campaign.title
    try:
        source = read_source(campaign)
        checks = check_source(source)
    except _BAD_INPUT as error:
        faults = [_words(error)]
        faults += [fault for fault in _faults_of_files(campaign) if fault not in faults]
        return CampaignCheck(campaign.path, title, faults=tuple(faults))
    faults = []
    try:
        refuse_contradictions(checks)
    except ContradictionError as error:
        faults = str(error).splitlines()
    return CampaignCheck(
        campaign.path,
        title,
        tuple(_content(source)),
        tuple(_recordings(source)),
        tuple(faults),
        tuple(checks),
        campaign.accept.doubts,
        tuple(source.notices),
    )


def _content(source: Inputs) -> Iterator[str]:
    """Say what was read."""
    if isinstance(source, LaserInputs):
        yield from _readings_content(source)
    if isinstance(source, CameraInputs):
        yield from _frames_content(source)
    if source.sensors is not None:
        yield f"contact sensors: {', '.join(source.sensors.names)}, {counted(source.sensors.temperature.sizes['time'], 'row')}"
    for name, log in (("environment", source.environment), ("drivers", source.drivers)):
        if log is not None:
            yield f"{name}: {counted(log.sizes['time'], 'row')}, {', '.join(str(column) for column in log.data_vars)}"


def _readings_content(source: LaserInputs) -> Iterator[str]:
    """Say what the laser file holds."""
    sizes, position = source.deviations.sizes, source.deviations["position"].values
    readings = int(source.deviations["deviation"].notnull().sum())
    yield (
        f"readings: {counted(sizes['cycle'], 'cycle')}, {counted(sizes['target'], 'target')} from {position.min():g} to "
        f"{position.max():g} mm, {readings} of {source.deviations['deviation'].size}"
    )


def _frames_content(source: CameraInputs) -> Iterator[str]:
    """Say what the frames and the plan hold."""
    first = source.frames[0]
    serial = f", serial {first.camera.serial}" if first.camera.serial else ""
    yield (
        f"frames: {len(source.frames)} of {first.shape[1]} x {first.shape[0]}, camera {first.camera.model or 'unknown'}{serial}, "
        f"{len(source.frames_rejected)} left out"
    )
    size = f"{source.grid.width_mm:g} x {source.grid.height_mm:g}"
    if source.plan.in_pixels:
        yield f"plan: the picture of {size} px in cells of {source.grid.cell_size_mm:g} px, nothing in mm"
    else:
        yield f"plan: {size} mm, {counted(len(source.fiducials), 'fiducial')}"


def _recordings(source: Inputs) -> Iterator[Recording]:
    """Return what was recorded when, on the laser's clock."""
    if isinstance(source, CameraInputs):
        offset_s = source.thermography.clock_offset_s or 0.0
        yield Recording("frames", camera_on_laser_clock(source.frame_times, offset_s))
    if isinstance(source, LaserInputs):
        yield Recording("readings", source.deviations["time"].values.ravel())
    if source.sensors is not None:
        yield Recording("contact sensors", source.sensors.temperature["time"].values)
    for name, log in (("environment", source.environment), ("drivers", source.drivers)):
        if log is not None:
            yield Recording(name, np.asarray(log["time"].values))


def _faults_of_files(campaign: Campaign) -> Iterator[str]:
    """Read every file of a campaign by itself, and yield why it cannot be used."""
    for read, name in _readers(campaign):
        try:
            read(campaign.resolve(name))
        except _BAD_INPUT as error:
            yield _words(error)


def _readers(campaign: Campaign) -> Iterator[tuple[Callable[[Path], object], str]]:
    """Return the reader of every file that a campaign names."""
    laser, plan, camera = campaign.interferometry, campaign.plan, campaign.thermography
    named: list[tuple[Callable[[Path], object], str | None]] = []
    if laser is not None:
        named += [(read_deviations, laser.deviations), (read_environment, laser.environment)]
    if campaign.drivers is not None:
        named.append((read_drivers, campaign.drivers.file))
    if plan is not None:
        named.append((read_fiducials, plan.fiducials))
    if camera is not None:
        named.append((read_lens, camera.lens))
    return ((read, name) for read, name in named if name is not None)


def _words(error: Exception) -> str:
    """Return a fault as a sentence; the system's own errors with the file that they name."""
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}"
    return str(error)
