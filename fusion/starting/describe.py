"""What a file holds, in lines of text: every kind that a run reads, with warnings about implausible content."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.products.notices import counted, left_out_notices
from fusion.report.wording import join, moment, print_unit
from fusion.starting.kinds import Kind, Recognised, is_displacement, is_temperature, is_time
from fusion.toml_file import read_toml
from interferometry.inspection import describe_test
from interferometry.io.delimited import read_grids, read_table
from interferometry.io.readers import read_deviations, read_environment
from thermography.inspection import describe_stack, inspect_file
from thermography.registration.lens import read_lens
from thermography.registration.plan import read_fiducials

if TYPE_CHECKING:
    import xarray as xr

    from fusion.campaign.config import Campaign


def describe_file(found: Recognised) -> list[str]:
    """Return what a file holds, with warnings about implausible content.

    Parameters
    ----------
    found : Recognised
        File and kind, of which it must be a known one.

    Returns
    -------
    list of str
        Lines for the terminal, the first with path and kind; lines that begin with "  warning" ask for action.

    Raises
    ------
    FusionError, ThermographyError, InterferometryError
        If the file cannot be used, with place, value and remedy.
    """
    path = found.path
    if found.kind is Kind.FRAMES:
        return inspect_file(path).lines()
    if found.kind is Kind.STACK:
        return describe_stack(path)
    if found.kind is Kind.DEVIATIONS:
        return _describe_deviations(path, read_deviations(path, rotary=True))
    if found.kind is Kind.ENVIRONMENT:
        return _describe_log(path, "environment", read_environment(path))
    if found.kind is Kind.DRIVERS:
        from fusion.campaign.logged_tables import read_drivers

        return _describe_log(path, "drivers", read_drivers(path))
    if found.kind is Kind.RECORD:
        return _describe_record(path, found.headings)
    if found.kind is Kind.FIDUCIALS:
        return _describe_fiducials(path)
    if found.kind is Kind.REGIONS:
        from fusion.attribution.thermal_modes import read_regions

        regions = read_regions(path)
        return [f"{path}: {counted(len(regions), 'region')} of the plan: {join([region.name for region in regions])}"]
    if found.kind is Kind.PLACES:
        return _describe_places(path)
    if found.kind is Kind.LENS:
        lens = read_lens(path)
        column, row = lens.principal_point_px
        return [f"{path}: lens, focal length {lens.focal_length_px:.1f} px, centre {column:.1f}, {row:.1f} px"]
    if found.kind is Kind.CAMPAIGN:
        from fusion.campaign.config import load_campaign

        return _describe_campaign(load_campaign(path))
    content, _ = read_toml(path)
    title = content.get("campaign", {}).get("title", "")
    return [f"{path}: recipe of a simulation, {title}".rstrip(", "), f"  thermofuse simulate {path} --out FOLDER"]


def _describe_deviations(path: Path, deviations: xr.Dataset) -> list[str]:
    """Return size, range and times of a file of deviations as lines."""
    time, position = deviations["time"].values, deviations["position"].values
    timed = time[~np.isnat(time)]
    readings = int(np.isfinite(deviations["deviation"]).sum())
    lines = [
        f"{path}: deviations, {counted(deviations.sizes['cycle'], 'cycle')}, {counted(deviations.sizes['target'], 'target')} "
        f"from {position.min():g} to {position.max():g} {deviations['position'].attrs['units']}, "
        f"{readings} of {deviations['deviation'].size} readings",
        f"  deviation {float(deviations['deviation'].min()):.3f} to {float(deviations['deviation'].max()):.3f} "
        f"{print_unit(deviations['deviation'].attrs['units'])}",
    ]
    if timed.size:
        origin = deviations["time"].attrs["origin"]
        lines.append(f"  {moment(timed.min())} to {moment(timed.max())}, times {origin}{_zone(deviations)}")
    else:
        lines.append(
            "  no times: thermofuse run evaluates them by ISO 230-2, and needs one per reading for drift and causes"
        )
    return [*lines, *(f"  {line}" for line in describe_test(deviations)), *_warnings(deviations)]


def _describe_log(path: Path, name: str, log: xr.Dataset) -> list[str]:
    """Return times and range of every series of a log as lines."""
    first, last = log["time"].values[0], log["time"].values[-1]
    lines = [f"{path}: {name}, {log.sizes['time']} rows, {moment(first)} to {moment(last)}{_zone(log)}"]
    for variable, values in log.data_vars.items():
        unit = "" if values.attrs["units"] == "1" else print_unit(values.attrs["units"])
        lines.append(f"  {variable} {float(values.min()):.2f} to {float(values.max()):.2f} {unit}".rstrip())
    return lines + _warnings(log)


def _describe_record(path: Path, headings: Sequence[str]) -> list[str]:
    """Return the columns of a table of temperatures and displacements, and its number of rows, as lines."""
    time = next(name for name in headings if is_time(name))
    kinds = {
        "temperature": [name for name in headings if is_temperature(name)],
        "displacement": [name for name in headings if is_displacement(name)],
    }
    known = {time, *kinds["temperature"], *kinds["displacement"]}
    kinds["other column"] = [name for name in headings if name not in known]
    rows = len(read_grids(path)[0].rows) - 1
    lines = [f"{path}: record, {counted(rows, 'row')}, time in the column {time}"]
    return lines + [f"  {counted(len(names), kind)}: {join(names)}" for kind, names in kinds.items() if names]


def _describe_fiducials(path: Path) -> list[str]:
    """Return number and extent of the fiducials as lines."""
    listed = read_fiducials(path)
    points = sum(one.is_point for one in listed)
    markers = sum(one.marker is not None for one in listed)
    discs = len(listed) - points - markers
    counts = [
        counted(count, noun) for count, noun in ((discs, "disc"), (points, "point"), (markers, "marker")) if count
    ]
    columns, rows = [one.x_mm for one in listed], [one.y_mm for one in listed]
    hints = sum(one.hint_px is not None for one in listed)
    return [
        f"{path}: fiducials, {join(counts)}, x {min(columns):g} to {max(columns):g} mm, y {min(rows):g} to {max(rows):g} mm",
        f"  {hints} with a rough place in the frame",
    ]


def _describe_places(path: Path) -> list[str]:
    """Return the names of contact sensors with a place on the plan as lines."""
    names = [fields["name"].strip() for _, fields in read_table(path, ("name",)).records() if fields is not None]
    return [
        f"{path}: places of {counted(len(names), 'contact sensor')} on the plan: {join(names)}",
        "  [sensors] of a campaign file names it as places, beside the file of their temperatures",
    ]


def _describe_campaign(campaign: Campaign) -> list[str]:
    """Return title and tables of a campaign file as lines."""
    named = ("thermography", "plan", "interferometry", "drivers", "record")
    tables = [f"[{name}]" for name in named if getattr(campaign, name) is not None]
    frames = len(campaign.frame_paths())
    lines = [f"{campaign.path}: campaign, {campaign.campaign.title}", f"  {join(tables)}, every key is understood"]
    if frames:
        lines.append(f"  {counted(frames, 'file')} of thermal frames, {len(campaign.input_files())} files in all")
    return [*lines, f"  thermofuse check {campaign.path} looks into them"]


def _zone(table: xr.Dataset) -> str:
    """Say how times came to UTC, where the reader says it."""
    reference = table["time"].attrs.get("reference", "")
    return f", {reference}" if reference else ""


def _warnings(table: xr.Dataset) -> list[str]:
    return [f"  warning: {notice.message} {notice.remedy}" for notice in left_out_notices(table, "left_out")]
