"""Times without a zone: which zone they are in, and that no file with a zone is mixed with one without."""

from __future__ import annotations

from collections.abc import Mapping
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import xarray as xr

from fusion.campaign.config import CampaignError
from interferometry.io.tables import NO_ZONE


def utc(time: np.datetime64) -> str:
    """Return a time as results.json writes it, ISO 8601 in UTC to the second."""
    return f"{np.datetime_as_string(time, unit='s')}Z"


def bring_to_utc(table: xr.Dataset, zone: str | None, *, file: str, late_s: float = 0.0) -> xr.Dataset:
    """Bring times that a file gives without a zone from the stated one to UTC, and take off by how much its clock is late."""
    time = table["time"]
    stamps = pd.DatetimeIndex(time.values.ravel())
    if zone is not None and lacks_zone(table):
        placed = stamps.tz_localize(ZoneInfo(zone), ambiguous="NaT", nonexistent="NaT").tz_convert(None)
        lost = np.flatnonzero(np.isnat(placed.values) & ~np.isnat(stamps.values))
        if lost.size:
            first = np.datetime_as_string(stamps.values[lost[0]], unit="s")
            raise CampaignError(
                f"{file}: {lost.size} times, the first {first}, occur twice or not at all in {zone}, where clocks are changed for summer; "
                'export the times in UTC, and write time_zone = "UTC"'
            )
        time = time.assign_attrs(reference=f"converted to UTC from {zone}")
        stamps = placed
    elif not late_s:
        return table
    utc = (stamps - pd.Timedelta(seconds=late_s)).values.astype("datetime64[ns]").reshape(time.shape)
    place = table.assign_coords if "time" in table.dims else table.assign
    return place(time=(time.dims, utc, time.attrs))


def lacks_zone(table: xr.Dataset) -> bool:
    """Return whether the times of a table come from a file that gives no zone."""
    return table["time"].attrs.get("reference") == NO_ZONE


def refuse_mixed_zones(tables: Mapping[str, xr.Dataset], *, source: str) -> None:
    """Refuse logs of which some give times with a zone and others without one."""
    timed = {file: table for file, table in tables.items() if not np.isnat(table["time"].values).all()}
    without = [file for file, table in timed.items() if lacks_zone(table)]
    zoned = [file for file in timed if file not in without]
    if without and zoned:
        raise CampaignError(
            f"{source}: {', '.join(without)} gives times without a zone, {', '.join(zoned)} with one; write the zone of the former as "
            'time_zone, for example time_zone = "Europe/Vienna" or "UTC", under the table that names the file, or under [campaign]'
        )
