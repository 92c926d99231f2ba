"""Times without a zone: which zone they are in, and that no file with a zone is mixed with one without."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from fusion.campaign.config import CampaignError
from fusion.results.parts import TimePart
from fusion.results.results import Notice
from interferometry.io.tables import DATED, NO_ZONE


def utc(time: np.datetime64) -> str:
    """Return a time as results.json writes it, ISO 8601 in UTC to the second."""
    return f"{np.datetime_as_string(time, unit='s')}Z"


def bring_to_utc(table: xr.Dataset, zone: str | None, *, file: str, late_s: float = 0.0) -> xr.Dataset:
    """Bring times that a file gives without a zone from the stated one to UTC, and take off by how much its clock is late."""
    time = table["time"]
    stamps = pd.DatetimeIndex(time.values.ravel())
    if zone is not None and lacks_zone(table):
        time = time.assign_attrs(reference=f"converted to UTC from {zone}")
        stamps = pd.DatetimeIndex(from_zone(stamps.values, zone, file=file))
    elif not late_s:
        return table
    utc = (stamps - pd.Timedelta(seconds=late_s)).values.astype("datetime64[ns]").reshape(time.shape)
    return table.assign(time=(time.dims, utc, time.attrs))


def from_zone(stamps: NDArray[np.datetime64], zone: str, *, file: str) -> NDArray[np.datetime64]:
    """Return times of a zone in UTC; refuse those that its clocks show twice or never."""
    placed = pd.DatetimeIndex(stamps).tz_localize(zone, ambiguous="NaT", nonexistent="NaT").tz_convert(None)
    lost = np.flatnonzero(np.isnat(placed.values) & ~np.isnat(stamps))
    if lost.size:
        first = np.datetime_as_string(stamps[lost[0]], unit="s")
        raise CampaignError(
            f"{file}: {lost.size} times, the first {first}, occur twice or not at all in {zone}, where clocks are changed for summer; "
            'export the times in UTC, and write time_zone = "UTC"'
        )
    return placed.values.astype("M8[ns]")


def lacks_zone(table: xr.Dataset) -> bool:
    """Return whether the times of a table come from a file that gives no zone."""
    return table["time"].attrs.get("reference") == NO_ZONE


def shown_zone(table: xr.Dataset, stated: str | None) -> str | None:
    """Return the zone in which the times of a table are shown: as stated, None for UTC, and "", as logged, where nobody gives one."""
    return stated or ("" if lacks_zone(table) else None)


def is_dated(times: NDArray[np.datetime64]) -> bool:
    """Tell whether times hold a date; those without a stated beginning count from zero."""
    return bool((times > DATED).any())


def time_part(table: xr.Dataset, stated: str | None) -> TimePart | None:
    """Return when readings were taken; None where no time holds a date."""
    times = table["time"].values
    if not is_dated(times):
        return None
    return TimePart(first=utc(np.nanmin(times)), last=utc(np.nanmax(times)), zone=shown_zone(table, stated))


def zone_notices(table: xr.Dataset, *, code: str, of: str) -> Iterator[Notice]:
    """Yield the notice of times of day that nobody has given a zone."""
    if lacks_zone(table) and is_dated(table["time"].values):
        yield Notice.of("no_zone", code=code, of=of)


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
