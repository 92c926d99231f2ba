"""Logged tables: the drivers of a campaign, and a record of sensors and channels over time."""

from __future__ import annotations

import fnmatch
import io
import json
import re
import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from pandas.io.parsers import TextParser  # type: ignore[attr-defined]

from fusion.analysis.alignment.sensor_health import SensorFault, examine_sensors
from fusion.campaign.config import Campaign, CampaignError, RecordTable
from fusion.campaign.time_zones import bring_to_utc
from fusion.campaign.values import QuantityError, conversion, name_and_unit
from fusion.common import Array, FusionError
from interferometry.io.faults import Numerals, RejectedLine, raise_if_mostly_invalid
from interferometry.io.spreadsheets import cell_text, read_cells
from interferometry.io.tables import (
    BadReading,
    decode_text,
    delimiter_of,
    describe_time_zone,
    find_header,
    parse_time,
    read_table,
    read_timed_rows,
)

#: Warning of pandas about a line with more fields than the header.
_SKIPPED = re.compile(r"Skipping line (\d+): expected (\d+) fields, saw (\d+)")
#: Names that a variable of NetCDF can have (netCDF-C, Users Guide, "names"), and that are short enough to be read.
_NAME = re.compile(r"\w[^/\x00-\x1f\x7f]{0,99}")
#: What the readings and the model call their own variables: a driver of that name would stand in their place.
_TAKEN = (
    "cycle", "direction", "target", "position", "time", "deviation", "quality_flag", "inside_frames", "effect", "period", "mean_rise",
    "axis_integral", "local_rise", "patch_mean_rise", "patch_axis_integral", "driver_time", "environment_time", "frame_time",
)  # fmt: skip
#: Seconds beyond these are damaged numbers: a century.
_LONGEST_RECORD_S = 3.2e9
#: Where seconds count from in a table whose start is not stated.
NO_START = np.datetime64("1970-01-01", "ns")


class TableError(CampaignError):
    """A logged table that cannot be used; the message names file, column and remedy."""


def split_heading(path: Path, heading: str) -> tuple[str, str]:
    """Return name and unit of a heading such as ``"t1 [degC]"`` or ``"t1(°C)"``."""
    name, unit = name_and_unit(heading)
    if not unit and name == heading.strip():
        raise TableError(
            f'{path}: the column "{heading}" has no unit; write it in the heading, for example "{heading} [1]" for a pure number'
        )
    return name, unit


def match_columns(patterns: Iterable[str], headings: Iterable[str]) -> tuple[str, ...]:
    """Return the headings that column names or patterns (``*`` for any text) select, in the order of the file."""
    headings = list(headings)
    selected: set[str] = set()
    for pattern in patterns:
        escaped = pattern.replace("[", "[[]")
        matching = {heading for heading in headings if heading == pattern or fnmatch.fnmatchcase(heading, escaped)}
        if not matching:
            raise CampaignError(f'no column is named "{pattern}"; the file has: {", ".join(headings)}')
        selected |= matching
    return tuple(heading for heading in headings if heading in selected)


def read_drivers(path: str | Path) -> xr.Dataset:
    """Read what was logged beside the instruments: loads, speeds, coolant.

    Parameters
    ----------
    path : str or Path
        Table with a column ``time`` and columns named ``"name [unit]"``.

    Returns
    -------
    Dataset
        Every column over ``time`` in its own unit; times with a zone in UTC, others as they are.

    Raises
    ------
    TableError
        A heading, a time or a number cannot be read; the message names file, line and column.

    Notes
    -----
    docs/formats.md lists the kinds of tables.

    Examples
    --------
    >>> from fusion import align
    >>> fused = align(deviations, fields, axis, drivers=read_drivers("drivers.csv"))  # doctest: +SKIP
    """
    path = Path(path)
    table = read_table(path, ("time",))
    headings = {column: split_heading(path, column) for column in table.columns if column != "time"}
    if not headings:
        raise TableError(
            f'{path}: there is no column apart from time; add one named "name [unit]", or leave [drivers] out'
        )
    for column, (name, _) in headings.items():
        if not _NAME.fullmatch(name):
            raise TableError(
                f'{path}: the column "{column}" has a name that no product can store; begin it with a letter, leave / out, and write up to '
                "100 characters"
            )
        if name in _TAKEN or name.startswith("loop_") or name.endswith("_series"):
            raise TableError(
                f'{path}: the column "{column}" has the name of a result; rename it, for example "logged {name}"'
            )
    variables = {name: {"units": unit, "long_name": name} for name, unit in headings.values()}
    if len(variables) < len(headings):
        names = [name for name, _ in headings.values()]
        repeated = sorted({name for name in names if names.count(name) > 1})
        raise TableError(f"{path}: more than one column is named {', '.join(repeated)}; give each its own name")
    return read_timed_rows(
        table, variables, lambda fields: [table.numerals.number(fields[column]) for column in headings]
    )


def read_run(campaign: Campaign, path: Path) -> xr.Dataset:
    """Read one table of a ``[record]``: temperatures, displacements and drivers over time."""
    record = campaign.record
    if record is None:
        raise TableError(f"{campaign.path}: there is no [record] in this campaign")
    frame, misfits = _read_frame(path, record)
    columns = list(frame.columns)
    if record.time not in columns:
        raise TableError(f'{path}: no column is named "{record.time}"; the file has: {", ".join(columns)}')
    others = [column for column in columns if column != record.time]
    time, reference, left_out = _times(path, frame[record.time], record)
    left_out = [*misfits, *left_out]
    keep = ~np.isnat(time)
    order = np.argsort(time[keep], kind="stable")

    def block(patterns: Iterable[str], unit: str | None) -> tuple[list[str], list[str], np.ndarray]:
        names, units, values = [], [], []
        for column in match_columns(patterns, others):
            name, given = split_heading(path, column)
            numbers = _numbers(frame[column])[keep][order]
            if np.isnan(numbers).all():
                raise TableError(
                    f'{path}: the column "{column}" contains no numbers; name another one in the campaign file'
                )
            names.append(name)
            units.append(given if unit is None else unit)
            values.append(numbers if unit is None else in_unit(numbers, given, unit, column=column, path=path))
        return names, units, np.array(values).reshape(len(names), int(keep.sum())).T

    sensors, _, temperature = block(record.temperatures, "degC")
    channels, _, displacement = block(record.displacements, "um")
    drivers, driver_units, driver = block(record.drivers, None)
    celsius = {"units": "degC", "units_metadata": "temperature: on_scale"}
    table = xr.Dataset(
        {
            "temperature": (("time", "sensor"), temperature, celsius),
            "displacement": (("time", "channel"), displacement, {"units": "um"}),
            "driver": (("time", "driver_name"), driver, {"long_name": "logged drivers, units in driver_units"}),
            "driver_units": (("driver_name",), np.array(driver_units, dtype=object)),
        },
        coords={"time": time[keep][order], "sensor": sensors, "channel": channels, "driver_name": drivers},
        attrs={"source": path.name, "left_out": json.dumps([asdict(line) for line in left_out])},
    )
    table["time"].attrs["reference"] = reference
    return bring_to_utc(table, campaign.zone_of("record"), file=path.name)


def _read_frame(path: Path, record: RecordTable) -> tuple[pd.DataFrame, list[RejectedLine]]:
    """Return the whole table as text and numbers, whatever the file's kind, and the lines that do not fit its header."""
    left_out: list[RejectedLine] = []
    if path.suffix.lower() in {".xlsx", ".xlsm"}:
        frame = _read_sheet(path, record)
    else:
        try:
            frame, left_out = _read_text(path)
        except (ValueError, OSError, pd.errors.ParserError) as error:
            raise TableError(
                f"{path}: cannot be read as a table: {error}; save it as CSV in UTF-8 or as XLSX"
            ) from None
    return frame.rename(columns=lambda name: str(name).strip()), left_out


def _read_sheet(path: Path, record: RecordTable) -> pd.DataFrame:
    """Read one sheet of a spreadsheet, the first without a name, with the types that pandas gives the columns."""
    sheets = read_cells(path, as_stored=True)
    name = record.sheet or next(iter(sheets))
    if name not in sheets:
        raise TableError(f"{path}: there is no sheet {name!r}; the sheets are {', '.join(map(repr, sheets))}")
    (_, headings), *rows = sheets[name]
    frame = TextParser([[cell_text(cell) for cell in headings], *(row for _, row in rows)]).read()
    # Lines are counted in the file.
    frame.index = pd.Index([line - 2 for line, _ in rows])
    return frame


def _read_text(path: Path) -> tuple[pd.DataFrame, list[RejectedLine]]:
    """Read delimited text with the dialect that its header line shows."""
    text = decode_text(path, path.read_bytes())
    before, header = find_header(io.StringIO(text))
    delimiter = delimiter_of(header)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", pd.errors.ParserWarning)
        frame = pd.read_csv(
            io.StringIO(text),
            sep=delimiter,
            # Spreadsheets that part fields by semicolons write decimal commas.
            decimal="," if delimiter == ";" else ".",
            skiprows=before,
            skipinitialspace=True,
            index_col=False,
            on_bad_lines="warn",
        )
    if any("loss of data" in str(warning.message) for warning in caught):
        raise FusionError("the lines hold more fields than the header names; name every column")
    # Lines are counted in the file.
    frame.index += before
    skipped = [fields for warning in caught for fields in _SKIPPED.findall(str(warning.message))]
    return frame, [
        RejectedLine(path.name, int(line), f"{saw} fields", f"{due} were expected") for line, due, saw in skipped
    ]


def _numbers(column: pd.Series) -> np.ndarray:
    """Return the numbers of a column, NaN where a row has none."""
    if pd.api.types.is_numeric_dtype(column):
        return column.to_numpy(dtype="f8", na_value=np.nan)
    texts = [str(value) for value in column]
    numerals = Numerals.of(texts)

    def number(text: str) -> float:
        try:
            return numerals.number(text)
        except BadReading:
            return float("nan")

    return np.array([number(text) for text in texts])


def _times(path: Path, column: pd.Series, record: RecordTable) -> tuple[np.ndarray, str, list[RejectedLine]]:
    """Return times, NaT where a row has none, how they came to UTC in words, and the list of the rows without a time."""
    seconds = pd.Series(_numbers(column), column.index)
    left_out: list[RejectedLine] = []
    zones: dict[str, int] = {}
    if seconds.notna().mean() > 0.5:
        _, unit = split_heading(path, record.time)
        start, zone = NO_START, "+0000"
        if record.start is not None:
            try:
                start, zone = parse_time(record.start)  # type: ignore[assignment]
            except BadReading as fault:
                raise TableError(f'record.start = "{record.start}": {fault.reason}, needed for {path}') from None
        zones[zone] = 0
        elapsed = in_unit(seconds.to_numpy(dtype="f8"), unit, "s", column=record.time, path=path)
        elapsed[~(np.abs(elapsed) < _LONGEST_RECORD_S)] = np.nan
        time = start + np.where(np.isfinite(elapsed), np.round(elapsed * 1e9), 0).astype("m8[ns]")
        time[~np.isfinite(elapsed)] = np.datetime64("NaT")
    else:
        time = np.full(len(column), np.datetime64("NaT", "ns"))
        for at, value in enumerate(column):
            try:
                time[at], zone = parse_time("" if pd.isna(value) else str(value))
            except BadReading:
                continue
            zones.setdefault(zone, int(column.index[at]) + 2)
    for at in np.flatnonzero(np.isnat(time)):
        left_out.append(RejectedLine(path.name, int(column.index[at]) + 2, str(column.iloc[at]), "is not a time"))
    raise_if_mostly_invalid(path, int((~np.isnat(time)).sum()), left_out)
    return time, describe_time_zone(path, zones), left_out


def in_unit(values: np.ndarray, unit: str, target: str, *, column: str, path: Path) -> np.ndarray:
    """Return the values of a column in the canonical unit `target`."""
    try:
        factor, offset = conversion(unit, target)
    except QuantityError as error:
        raise TableError(f'{path}: the column "{column}": {error}') from None
    return values * factor + offset


# Contact sensors of a campaign: their temperatures over time, and their places on the plan.


@dataclass(frozen=True, eq=False)
class ContactSensors:
    """Temperatures of contact sensors on the table, degC, as logged, the faulty sensors among them; NaN where a sensor gave nothing.

    ``logged_x_mm`` and ``logged_y_mm`` are places on the plan; ``u_K`` is the standard uncertainty of one sensor; sensors with a clear
    fault (docs/method/sensor-health.md) are left out of everything that is calculated.
    """

    file: str
    logged: xr.DataArray
    logged_x_mm: Array
    logged_y_mm: Array
    u_K: float
    faults: tuple[SensorFault, ...] = ()

    @property
    def sound(self) -> list[int]:
        """Places among the logged sensors of those that are used."""
        faulty = {fault.sensor for fault in self.faults}
        return [k for k in range(self.logged.sizes["sensor"]) if k not in faulty]

    @property
    def temperature(self) -> xr.DataArray:
        """Temperatures of the sound sensors at the times at which all of them gave one, (time, sensor) degC."""
        return self.logged.isel(sensor=self.sound).dropna("time")

    @property
    def x_mm(self) -> Array:
        """Places of the sound sensors along x, (sensors,) mm."""
        return self.logged_x_mm[self.sound]

    @property
    def y_mm(self) -> Array:
        """Places of the sound sensors along y, (sensors,) mm."""
        return self.logged_y_mm[self.sound]

    @property
    def names(self) -> list[str]:
        """Names of the sound sensors."""
        return [str(name) for name in self.logged["sensor"].values[self.sound]]


def read_sensors(campaign: Campaign) -> ContactSensors | None:
    """Read the contact sensors of a campaign."""
    table, plan = campaign.sensors, campaign.plan
    if table is None or plan is None or plan.size_mm is None:
        return None
    path = campaign.resolve(table.file)
    zone = campaign.zone_of("sensors")
    logged = bring_to_utc(read_drivers(path), zone, file=table.file, late_s=table.clock_offset_s)
    names = [str(name) for name in logged.data_vars]
    places = _read_places(campaign.resolve(table.places), names, plan.size_mm)
    columns = [
        in_unit(column.values, str(column.attrs["units"]), "degC", column=str(name), path=path)
        for name, column in logged.data_vars.items()
    ]
    temperature = xr.DataArray(
        np.stack(columns, axis=-1), dims=("time", "sensor"), coords={"time": logged["time"], "sensor": names}
    )
    temperature["time"].attrs.update(logged["time"].attrs)
    seconds = np.asarray((temperature["time"].values - temperature["time"].values[0]) / np.timedelta64(1, "s"), float)
    faults = tuple(fault for fault in examine_sensors(seconds, temperature.values) if fault.is_clear)
    if len(faults) == len(names):
        named = "; ".join(f"{names[fault.sensor]} {fault.words}" for fault in faults)
        raise TableError(f"{path}: no contact sensor is sound ({named}); repeat the test, or remove [sensors]")
    x_mm, y_mm = np.array([places[name] for name in names]).T
    return ContactSensors(table.file, temperature, x_mm, y_mm, table.temperature_u_K, faults)


def _read_places(path: Path, names: list[str], size_mm: tuple[float, float]) -> dict[str, tuple[float, float]]:
    """Read ``name,x_mm,y_mm`` of every sensor, each on the plan."""
    table = read_table(path, ("name", "x_mm", "y_mm"))
    places: dict[str, tuple[float, float]] = {}
    for line, fields in table.records():
        if fields is None:
            raise TableError(f"{path}, line {line}: it does not have the fields of the heading; write name,x_mm,y_mm")
        try:
            place = (table.numerals.number(fields["x_mm"]), table.numerals.number(fields["y_mm"]))
        except BadReading as fault:
            raise TableError(f"{path}, line {line}: {fault.reason}; write the place in mm") from None
        if not (0.0 <= place[0] <= size_mm[0] and 0.0 <= place[1] <= size_mm[1]):
            raise TableError(
                f"{path}, line {line}: x {place[0]:g} mm, y {place[1]:g} mm is outside the plan of {size_mm[0]:g} x {size_mm[1]:g} mm; "
                "correct the place, or plan.size"
            )
        places[fields["name"].strip()] = place
    strange = sorted(set(names) ^ set(places))
    if strange:
        raise TableError(
            f"{path}: {', '.join(strange)} is in only one of the two files; every sensor needs a column of temperatures and a place"
        )
    return places
