"""Checks of a campaign that need no long work: the file, what it names, clocks and overlap, the axis on the plan, a few frames."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from fusion.analysis.alignment.align import camera_on_laser_clock
from fusion.campaign.config import Campaign, load_campaign
from fusion.campaign.inputs import CameraInputs, Inputs, LaserInputs, is_rotary, read_source, reader_of_deviations
from fusion.campaign.inspect import Kind, Recording, time_bars
from fusion.campaign.logs import NO_START, read_drivers
from fusion.common.messages import BAD_INPUT
from fusion.pipeline.consistency import (
    Check,
    ContradictionError,
    check_source,
    open_doubts,
    refuse_contradictions,
    without_consequences,
)
from fusion.results.progress import counted
from fusion.results.results import Notice
from thermography.io.sequence import camera_names

#: Bars of runs that are drawn.
_MOST_BARS = 10


@dataclass(frozen=True)
class CampaignCheck:
    """What is known of a campaign before it is run: ``faults`` say why it would be refused, ``notices`` what would be left out."""

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
        """Checks that are not passed, nor accepted, and that a run would name first; contradictions are faults."""
        return [one for one in open_doubts(self.checks, self.accepted) if not one.contradicts]

    def lines(self, *, quiet: bool = False, brief: bool = False) -> list[str]:
        """Return the check as lines of text, what would refuse it last; `quiet` leaves faults and doubts only, `brief` the verdict too."""
        doubts = [f"doubt ({check.code}): {check.evidence} {check.remedy}" for check in self.doubts]
        faults = [f"fault: {fault}" for fault in self.faults]
        if quiet:
            return [*doubts, *faults]
        title = [f"{self.path}: {self.title}"] if self.title else []
        zone = "no zone" if any(notice.code.endswith("_no_zone") for notice in self.notices) else "UTC"
        details = [f"  {line}" for line in (*self.content, *time_bars(self.recordings, zone=zone))]
        notices = [f"note: {notice.message} {notice.remedy}".rstrip() for notice in self.notices]
        if faults:
            verdict = f"not ready: {counted(len(faults), 'fault')}"
        elif self.checks:
            doubted = f", {counted(len(doubts), 'doubt')}" if doubts else ""
            verdict = f"ready to run: {counted(len(self.checks) - len(doubts), 'check')} passed{doubted}"
        else:
            verdict = "ready to run"
        return [*doubts, *faults, verdict] if brief else [*title, *details, *notices, *doubts, *faults, verdict]

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
            "checks_passed": sum(one.passed or one.code in self.accepted for one in self.checks),
        }


def check_campaign(path: Path) -> CampaignCheck:
    """Check a campaign without running it; where it cannot be read, each of its files by itself."""
    try:
        campaign = load_campaign(path)
    except BAD_INPUT as error:
        return CampaignCheck(path, faults=tuple(dict.fromkeys(_words(error).splitlines())))
    title = campaign.campaign.title
    try:
        if campaign.record is not None:
            return _check_record(campaign)
        source = read_source(campaign)
        checks = tuple(without_consequences(check_source(source), campaign.accept.doubts))
    except BAD_INPUT as error:
        faults = dict.fromkeys([_words(error), *_faults_of_files(campaign)])
        return CampaignCheck(campaign.path, title, faults=tuple(faults))
    try:
        refuse_contradictions(checks)
        contradictions = []
    except ContradictionError as error:
        contradictions = str(error).splitlines()
    return CampaignCheck(
        campaign.path,
        title,
        content=tuple(_content(source)),
        recordings=tuple(_recordings(source)),
        faults=tuple(contradictions),
        checks=checks,
        accepted=campaign.accept.doubts,
        notices=tuple(source.notices),
    )


def _check_record(campaign: Campaign) -> CampaignCheck:
    """Check a campaign whose data are a record."""
    # The model of a record loads for longer than a laser is read.
    from fusion.pipeline.record import read_record_source

    source = read_record_source(campaign)
    runs, table = len(campaign.record_paths()), source.health.table
    content = (
        f"record: {counted(runs, 'run')}, {counted(table.sizes['sensor'], 'temperature')}, "
        f"{counted(table.sizes['channel'], 'displacement')}, {counted(table.sizes['time'], 'row')}",
    )
    recordings = tuple(_record_bars(table))
    return CampaignCheck(campaign.path, campaign.campaign.title, content, recordings, notices=tuple(source.notices))


def _record_bars(table: xr.Dataset) -> Iterator[Recording]:
    """Return a record on its times; of runs that each count from their own zero the first ones, side by side from there."""
    time = table["time"].values
    if not table.attrs.get("own_zero"):
        yield Recording("record", time)
        return
    for number, name in enumerate(json.loads(table.attrs["runs"])[:_MOST_BARS]):
        of_run = time[table["run"].values == number]
        yield Recording(name, NO_START + (of_run - of_run[0]))


def _content(source: Inputs) -> Iterator[str]:
    """Say what was read."""
    if isinstance(source, LaserInputs):
        readings, position = source.deviations["deviation"], source.deviations["position"].values
        unit = "deg" if is_rotary(source.deviations) else "mm"
        yield (
            f"readings: {counted(readings.sizes['cycle'], 'cycle')}, {counted(readings.sizes['target'], 'target')} from "
            f"{position.min():g} to {position.max():g} {unit}, {int(readings.notnull().sum())} of {readings.size}"
        )
    if isinstance(source, CameraInputs):
        grid, names = source.grid, camera_names(source.pictures)
        cameras = [f"{np.count_nonzero(names == name)} of {name}" for name in dict.fromkeys(names)]
        yield f"frames: {'; '.join(cameras)}; {len(source.frames_rejected)} left out"
        if not source.frames:
            yield "no camera took most of them, or they have no time: a table of single pictures, not a series"
        elif source.plan.in_pixels:
            yield "plan: the picture itself, no scale in mm"
        else:
            yield f"plan: {grid.width_mm:g} x {grid.height_mm:g} mm, {counted(len(source.fiducials), 'fiducial')}"
    if source.sensors is not None:
        yield f"contact sensors: {', '.join(source.sensors.names)}, {counted(source.sensors.temperature.sizes['time'], 'row')}"
    for name, log in (("environment", source.environment), ("drivers", source.drivers)):
        if log is not None:
            yield f"{name}: {counted(log.sizes['time'], 'row')}, {', '.join(str(column) for column in log.data_vars)}"


def _recordings(source: Inputs) -> Iterator[Recording]:
    """Return what was recorded when, on the laser's clock."""
    if isinstance(source, CameraInputs) and source.frames:
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
    stated: dict[Kind, Callable[[Path], object]] = {
        Kind.DEVIATIONS: reader_of_deviations(campaign),
        Kind.DRIVERS: partial(read_drivers, layout=campaign.drivers and campaign.drivers.layout),
    }
    for kind in reversed(Kind):
        table, _, key = kind.value.key.partition(".")
        name = getattr(getattr(campaign, table, None), key, None)
        if isinstance(name, str):
            try:
                stated.get(kind, kind.value.read)(campaign.resolve(name))
            except BAD_INPUT as error:
                yield _words(error)


def _words(error: Exception) -> str:
    """Return a fault as a sentence; the system's own errors with the file that they name."""
    return f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
