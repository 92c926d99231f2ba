"""Logged tables: the drivers of a campaign, and a record of sensors and channels over time."""

from __future__ import annotations

import fnmatch
import io
import json
import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from fusion.campaign.config import Campaign, CampaignError, RecordTable
from fusion.campaign.quantities import QuantityError, conversion, unit_name
from fusion.campaign.time_zones import bring_to_utc
from fusion.errors import FusionError
from interferometry.io.dates import describe_time_zone, parse_time
from interferometry.io.delimited import delimiter_of, find_header, read_table, read_timed_rows
from interferometry.io.encodings import decode_text
from interferometry.io.faults import BadReading, RejectedLine, raise_if_mostly_invalid
from interferometry.io.headings import CHINESE_WORDS
from interferometry.io.numerals import Numerals
from interferometry.io.workbook_limits import refuse_bomb

#: Warning of pandas about a line with more fields than the header.
_SKIPPED = re.compile(r"Skipping line (\d+): expected (\d+) fields, saw (\d+)")
#: Names that a variable of NetCDF can have (netCDF-C, Users Guide, "names"), and that are short enough to be read.
_NAME = re.compile(r"\w[^/\x00-\x1f\x7f]{0,99}")
#: What the readings and the model call their own variables: a driver of that name would stand in their place.
_TAKEN = frozenset(
    [
        "cycle",
        "direction",
        "target",
        "position",
        "time",
        "deviation",
        "quality_flag",
        "inside_frames",
        "effect",
        "period",
        "mean_rise",
        "axis_integral",
        "local_rise",
        "patch_mean_rise",
        "patch_axis_integral",
        "driver_time",
        "environment_time",
        "frame_time",
    ]
)
_HEADING = re.compile(r"\s*(.+?)\s*[\[(]\s*([^\[\]()]*?)\s*[\])]\s*")


#: Seconds beyond these are damaged numbers: a century.
_LONGEST_RECORD_S = 3.2e9
#: Where seconds count from in a table whose start is not stated.
NO_START = np.datetime64("1970-01-01", "ns")


class TableError(CampaignError):
    """A logged table that cannot be used; the message names file, column and remedy."""


def split_heading(path: Path, heading: str) -> tuple[str, str]:
    """Return name and unit of a heading such as ``"t1 [degC]"`` or ``"t1(°C)"``.

    Parameters
    ----------
    path : Path
        File, for the message.
    heading : str
        Heading of a column.

    Raises
    ------
    TableError
        If no unit stands in the heading.
    """
    match = _HEADING.fullmatch(heading)
    if match is None:
        raise TableError(
            f'{path}: the column "{heading}" has no unit; write it in the heading, for example "{heading} [1]" for a pure number'
        )
    return match.group(1), unit_name(match.group(2))


def match_columns(patterns: Iterable[str], headings: Iterable[str]) -> tuple[str, ...]:
    """Return the headings that column names or patterns (``*`` for any text) select, in the order of the file.

    Parameters
    ----------
    patterns : iterable of str
        Names or patterns; brackets stand for themselves.
    headings : iterable of str
        Headings of the file.

    Raises
    ------
    CampaignError
        If a pattern selects nothing; the message lists the headings that there are.
    """
    headings = list(headings)
    selected: set[str] = set()
    for pattern in patterns:
        escaped = pattern.replace("[", "[[]")
        matching = {heading for heading in headings if heading == pattern or fnmatch.fnmatchcase(heading, escaped)}
        if not matching:
            raise CampaignError(f'no column is named "{pattern}"; the file has: {", ".join(headings)}')
        selected |= matching
    return tuple(heading for heading in headings if heading in selected)


def read_drivers(path: Path) -> xr.Dataset:
    """Read logged drivers: a column ``time`` and columns named ``"name [unit]"``.

    Parameters
    ----------
    path : Path
        CSV with a header; see the README for the accepted times.

    Returns
    -------
    Dataset
        Dim ``time`` (UTC, increasing), one variable per column with its units; attrs ``left_out`` holds the rejected lines as JSON.

    Raises
    ------
    TableError, LaserFormatError
        If the file is no table, a heading has no unit or a name that cannot be kept, or most lines cannot be used.
    """
    table = read_table(path, ("time",))
    headings = {column: split_heading(path, column) for column in table.columns if column != "time"}
    if not headings:
        raise TableError(f'{path}: there is no column beside time; add one named "name [unit]", or leave [drivers] out')
    for column, (name, _) in headings.items():
        if not _NAME.fullmatch(name):
            raise TableError(
                f'{path}: the column "{column}" has a name that no product can hold; begin it with a letter, leave / out, and write up to '
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
    return read_timed_rows(table, variables, lambda fields: [table.number(fields[column]) for column in headings])


def read_run(campaign: Campaign, path: Path) -> xr.Dataset:
    """Read one table of a ``[record]``: temperatures, displacements and drivers over time.

    Parameters
    ----------
    campaign : Campaign
        A checked campaign with a ``[record]``.
    path : Path
        The table, CSV or XLSX.

    Returns
    -------
    Dataset
        ``temperature`` (time, sensor) in degC, ``displacement`` (time, channel) in um, ``driver`` (time, driver_name) with
        ``driver_units``; ``time`` is UTC. attrs ``left_out`` lists rows without a usable time as JSON.

    Raises
    ------
    TableError
        If the file cannot be read, or a column is missing, has no unit, or holds no numbers.
    """
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
                    f'{path}: the column "{column}" holds no number; name another one in the campaign file'
                )
            names.append(name)
            units.append(given if unit is None else unit)
            values.append(numbers if unit is None else _converted(path, column, given, unit)(numbers))
        return names, units, np.array(values).reshape(len(names), int(keep.sum())).T

    sensors, _, temperature = block(record.temperatures, "degC")
    channels, _, displacement = block(record.displacements, "um")
    drivers, driver_units, driver = block(record.drivers, None)
    table = xr.Dataset(
        {
            "temperature": (
                ("time", "sensor"),
                temperature,
                {"units": "degC", "units_metadata": "temperature: on_scale"},
            ),
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
    """Read one sheet of a spreadsheet."""
    with path.open("rb") as file:
        refuse_bomb(path, file)
        try:
            return pd.read_excel(file, sheet_name=record.sheet or 0, engine="openpyxl")
        # A sheet that is not there is a ValueError; a damaged archive raises what the reader is made of: errors of zipfile, zlib, XML.
        except Exception as error:
            raise TableError(
                f"{path}: cannot be read as a table: {error}; name an existing sheet, remove a password if the file has one, and save it "
                "again as XLSX, or as CSV in UTF-8"
            ) from error


def _read_text(path: Path) -> tuple[pd.DataFrame, list[RejectedLine]]:
    """Read delimited text with the dialect that its header line shows."""
    text = decode_text(path, path.read_bytes(), chinese_words=CHINESE_WORDS)
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
    """Return the numbers of a column, NaN where a row has none.

    One mark for "no reading" leaves a whole column as text; its decimal commas and typographic minus signs are read all the same.
    """
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
        factor = _converted(path, record.time, unit, "s")(np.array([0.0, 1.0]))
        start, zone = (NO_START, "+0000") if record.start is None else _parse(path, record.start)
        zones[zone] = 0
        elapsed = seconds.to_numpy(dtype="f8") * (factor[1] - factor[0])
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


def _parse(path: Path, text: str) -> tuple[np.datetime64, str]:
    try:
        return parse_time(text)
    except BadReading as fault:
        raise TableError(f'record.start = "{text}": {fault.reason}, needed for {path}') from None


def _converted(path: Path, column: str, unit: str, target: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that brings a column to its canonical unit."""
    try:
        factor, offset = conversion(unit, target)
    except QuantityError as error:
        raise TableError(f'{path}: the column "{column}": {error}') from None
    return lambda values: values * factor + offset
