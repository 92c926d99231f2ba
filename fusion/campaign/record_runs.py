"""A record of one run or of several: every table read, the runs in the order of their times, held to the same columns."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import xarray as xr

from fusion.campaign.config import Campaign
from fusion.campaign.logged_tables import NO_START, TableError, read_run
from fusion.campaign.time_zones import refuse_mixed_zones

#: Time between runs that each count their seconds from zero, so that they can be laid one after the other: one day.
_BETWEEN = np.timedelta64(1, "D").astype("m8[ns]")
#: A run counts from its own zero where its first time is at most this share of its length.
_OWN_ZERO = 0.01


def read_record(campaign: Campaign) -> xr.Dataset:
    """Read a ``[record]``, all of its runs.

    Parameters
    ----------
    campaign : Campaign
        A checked campaign with a ``[record]``.

    Returns
    -------
    Dataset
        As :func:`fusion.campaign.logged_tables.read_run` returns it. Of several runs: in the order of time, with a coordinate ``run``
        (time), from 0; attrs ``runs`` and ``test``, names of the tables and places of the runs that are held out, as JSON; attrs
        ``own_zero`` is 1 where every run counts from its own zero and they were laid one after the other in the order of the files.

    Raises
    ------
    TableError
        If a table cannot be read, the tables differ in their columns or in the unit of a driver, or their times overlap.
    """
    paths = campaign.record_paths()
    if len(paths) == 1:
        return read_run(campaign, paths[0])
    tables = {path: read_run(campaign, path) for path in paths}
    _refuse_different_columns(tables)
    refuse_mixed_zones({path.name: table for path, table in tables.items()}, source=str(campaign.path))
    own_zero = _counts_from_zero(list(tables.values()))
    if own_zero:
        tables = _laid_in_order(tables)
    else:
        tables = dict(sorted(tables.items(), key=lambda item: item[1]["time"].values[0]))
        _refuse_overlap(tables)
    test = set(campaign.test_paths()) or {list(tables)[-1]}
    numbered = [
        table.assign_coords(run=("time", np.full(table.sizes["time"], number)))
        for number, table in enumerate(tables.values())
    ]
    joined = xr.concat(numbered, "time", data_vars="minimal", coords="minimal", compat="override", join="exact")
    left_out = [line for table in tables.values() for line in json.loads(table.attrs["left_out"])]
    return joined.assign_attrs(
        source=", ".join(path.name for path in tables),
        left_out=json.dumps(left_out),
        runs=json.dumps(_short_names(list(tables))),
        test=json.dumps([number for number, path in enumerate(tables) if path in test]),
        own_zero=int(own_zero),
    )


def _short_names(paths: list[Path]) -> list[str]:
    """Names of the tables, with their folder where a name occurs twice."""
    names = [path.name for path in paths]
    return [path.name if names.count(path.name) == 1 else f"{path.parent.name}/{path.name}" for path in paths]


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
        units, wanted = _driver_units(table), _driver_units(reference)
        for name, unit in units.items():
            if unit != wanted[name]:
                raise TableError(
                    f'{path}: the driver "{name}" is in {unit}, in {first.name} in {wanted[name]}; write it in one unit in all runs'
                )


def _driver_units(table: xr.Dataset) -> dict[str, str]:
    """Unit of every driver."""
    return dict(zip(table["driver_name"].values.tolist(), table["driver_units"].values.tolist(), strict=True))


def _counts_from_zero(tables: list[xr.Dataset]) -> bool:
    """Whether every run gives seconds since its own zero and nothing says when that was."""
    for table in tables:
        time = table["time"].values
        if not NO_START <= time[0] <= NO_START + _OWN_ZERO * (time[-1] - time[0]):
            return False
    return True


def _laid_in_order(tables: dict[Path, xr.Dataset]) -> dict[Path, xr.Dataset]:
    """The runs one after the other, in the order of the files."""
    laid, start = {}, NO_START
    for path, table in tables.items():
        time = table["time"].values
        laid[path] = table.assign_coords(time=("time", time + (start - time[0]), table["time"].attrs))
        start = laid[path]["time"].values[-1] + _BETWEEN
    return laid


def _refuse_overlap(tables: dict[Path, xr.Dataset]) -> None:
    """Refuse runs of which one begins before the other has ended."""
    for (before, earlier), (path, later) in pairwise(tables.items()):
        first, last = later["time"].values[0], earlier["time"].values[-1]
        if first <= last:
            raise TableError(
                f"{path}: the run begins at {np.datetime_as_string(first, unit='s')}, before {before.name} has ended "
                f"({np.datetime_as_string(last, unit='s')}); name every run once, and correct its times or record.start"
            )
