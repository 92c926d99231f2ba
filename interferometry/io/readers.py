"""Readers of deviations and environment: the kind of file is recognised, and every unusable line is listed in the result."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from interferometry.io.delimited import DelimitedTable, read_grids, read_timed_rows, table_below
from interferometry.io.ecmc import is_ecmc_log, read_ecmc_log
from interferometry.io.faults import BadReading, LaserFormatError
from interferometry.io.headings import UNITS, read_heading
from interferometry.io.long_table import find_long_table, read_long_table, what_is_missing
from interferometry.io.readings import Readings, check_and_assemble
from interferometry.io.renishaw import read_rtl
from interferometry.io.wide_table import find_wide_table, read_wide_table

DEVIATION_COLUMNS = ("cycle", "direction", "target", "position_mm", "time", "deviation_um")

#: Heading of the tables of averages that laser programs write as a report.
_AVERAGES = b"Bidirectional Avg Error"
#: The header of a log stands within so many rows.
_HEADER_WITHIN = 40
#: Column of the environment file, variable, unit, kind of quantity, smallest and largest plausible value. Below 1 % of humidity lies a
#: fraction of 1, and no workshop.
ENVIRONMENT_COLUMNS = (
    ("air_temperature_degC", "air_temperature", "degC", "temperature", -9.0, 60.0),
    ("air_pressure_hPa", "air_pressure", "hPa", "pressure", 500.0, 1200.0),
    ("relative_humidity_percent", "relative_humidity", "percent", "humidity", 1.0, 100.0),
    ("material_temperature_degC", "material_temperature", "degC", "temperature", -9.0, 80.0),
)


def read_deviations(
    path: str | Path,
    *,
    feed_mm_per_min: float | None = None,
    dwell_s: float | None = None,
    sheet: str | None = None,
    rotary: bool = False,
) -> xr.Dataset:
    r"""Read positioning deviations from a file.

    Parameters
    ----------
    path : str or pathlib.Path
        Delimited text or a spreadsheet (.xlsx, .xls, .ods) with one reading per line (columns cycle, direction, target, position_mm,
        time, deviation_um) or with one column or row per run; a Renishaw linear test (.rtl); or a log of the ecmc test tools (.dat).
        The kind of file is recognised from its content; headings may be English, German, French, Spanish or Chinese and carry their
        unit (docs/formats.md).
    feed_mm_per_min : float, optional
        Feed between targets, mm/min.
    dwell_s : float, optional
        Time at rest at each target, s. With both, the times of readings, which a .rtl does not hold, are reconstructed more closely.
        Ignored where every reading has its own time.
    sheet : str, optional
        Name of the sheet of a spreadsheet; None: the only one that holds a table of deviations.
    rotary : bool, optional
        Whether a rotary axis is accepted: its positions are in deg and its deviations in arcsec, as the units of the variables say.

    Returns
    -------
    xarray.Dataset
        Keeps ``contract.DEVIATIONS``: ``deviation`` (um), ``time`` (UTC) and ``quality_flag`` (cycle, direction, target), ``position``
        (mm; target). ``attrs["left_out"]`` is a JSON list of the lines left out (path, line, value, reason), ``attrs["notes"]`` one of
        what the reader assumed;
        ``time.attrs["origin"]`` is "recorded", "reconstructed" or "none"; ``time_u`` is the standard uncertainty of reconstructed
        times, s.

    Raises
    ------
    LaserFormatError
        The file cannot be used as a whole, or it is of a rotary axis and `rotary` is False.
    OSError
        The file cannot be opened (FileNotFoundError where there is none); its ``filename`` names it.

    Notes
    -----
    Quantities as in ISO 230-2:2014, clause 3.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "laser.csv"
    >>> _ = path.write_text("cycle,direction,target,position_mm,time,deviation_um\n"
    ...                     "1,positive,1,0,2026-03-09T06:30:00Z,0.12\n"
    ...                     "1,positive,2,100,2026-03-09T06:30:22Z,1.48\n")
    >>> test = read_deviations(path)
    >>> test["deviation"].sel(direction="positive").values.tolist()
    [[0.12, 1.48]]
    """
    path = Path(path)
    with path.open("rb") as stream:
        start = stream.read(4096)
    if b"HEADER::" in start and b"\nData:" in start:
        raise LaserFormatError(
            f"{path}: a dynamic capture has no targets; read it with interferometry.io.renishaw.read_rtx"
        )
    if b"HEADER::" in start:
        return read_rtl(path, feed_mm_per_min=feed_mm_per_min, dwell_s=dwell_s)
    if is_ecmc_log(start):
        return read_ecmc_log(path)
    if _AVERAGES in start:
        raise LaserFormatError(
            f"{path}: a report of averages over runs holds no single reading; export the readings of every run"
        )
    deviations = _read_table_of_deviations(path, sheet)
    if deviations["deviation"].attrs["units"] != "um" and not rotary:
        raise LaserFormatError(
            f"{path}: the positions are angles; of a rotary axis only the evaluation by ISO 230-2 is done (thermofuse iso230): heat and "
            "expansion are explained along a linear axis"
        )
    return deviations


def _read_table_of_deviations(path: Path, sheet: str | None) -> xr.Dataset:
    """Read delimited text or a spreadsheet: one reading per line, or position by run."""
    grids = read_grids(path, sheet=sheet)
    found: dict[str, Readings] = {}
    for grid in grids:
        long = find_long_table(grid)
        wide = find_wide_table(grid) if long is None else None
        if long is not None:
            found.setdefault(grid.sheet, read_long_table(long))
        elif wide is not None:
            found.setdefault(grid.sheet, read_wide_table(wide))
    if len(found) > 1:
        raise LaserFormatError(
            f"{path}: the sheets {', '.join(map(repr, found))} each hold a table of deviations; name one of them (sheet = ...), or save it "
            "as a file of its own"
        )
    if not found:
        raise LaserFormatError(
            f"{grids[0].place}: no table of deviations; {what_is_missing(grids[0])}; expected one reading per line with the "
            f"columns {','.join(DEVIATION_COLUMNS)}, or a table of position by run such as 'Position [mm],1+ [um],1- [um],2+ [um]'"
        )
    return check_and_assemble(next(iter(found.values())))


def is_environment_log(path: Path) -> bool:
    """Return whether a file is a table of air and material conditions, and not one of deviations.

    Parameters
    ----------
    path : pathlib.Path

    Raises
    ------
    LaserFormatError
        The file is neither text nor a spreadsheet.
    OSError
        The file cannot be opened.
    """
    with path.open("rb") as stream:
        if b"HEADER::" in stream.read(4096):
            return False
    roles = [
        {read_heading(text).role for text in fields}
        for grid in read_grids(path)
        for _, fields in grid.rows[:_HEADER_WITHIN]
    ]
    return any({"air_temperature", "air_pressure"} & found and not {"deviation", "measured"} & found for found in roles)


def read_environment(path: str | Path) -> xr.Dataset:
    r"""Read logged air and material conditions from delimited text or a spreadsheet.

    Parameters
    ----------
    path : str or pathlib.Path
        With the columns time, air_temperature_degC, air_pressure_hPa, relative_humidity_percent and material_temperature_degC, or
        headings in another language or unit (docs/formats.md).

    Returns
    -------
    xarray.Dataset
        Dim time (UTC, increasing): ``air_temperature`` and ``material_temperature`` (degC), ``air_pressure`` (hPa),
        ``relative_humidity`` (percent); ``attrs["left_out"]`` is a JSON list of the lines left out (path, line, value, reason).

    Raises
    ------
    LaserFormatError
        A column is missing, or fewer than half of the lines can be used.
    OSError
        The file cannot be opened (FileNotFoundError where there is none); its ``filename`` names it.

    Notes
    -----
    The conditions that the index of air needs (Ciddor 1996, Appl. Opt. 35, 1566).

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "environment.csv"
    >>> _ = path.write_text("time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC\n"
    ...                     "2026-03-09T06:30:00Z,23.5,1000.2,42,23.9\n")
    >>> float(read_environment(path)["air_pressure"][0])
    1000.2
    """
    path = Path(path)
    table, time, columns = _environment_table(path)
    on_scale = {"units_metadata": "temperature: on_scale"}
    variables = {
        name: {"units": unit, **(on_scale if unit == "degC" else {})} for _, name, unit, *_ in ENVIRONMENT_COLUMNS
    }

    def parse(fields: dict[str, str]) -> list[float]:
        values = []
        for (column, _, _, _, low, high), (text, unit) in zip(ENVIRONMENT_COLUMNS, columns.values(), strict=True):
            value = table.numerals.reading(fields[text]) * UNITS[unit].factor + UNITS[unit].offset
            if not low <= value <= high:
                raise BadReading(fields[text], f"lies outside {low:g} .. {high:g}, the range of {column} in its unit")
            values.append(value)
        return values

    return read_timed_rows(table, variables, parse, time=time)


def _environment_table(path: Path) -> tuple[DelimitedTable, str, dict[str, tuple[str, str]]]:
    """Return the table of a log, the column of times, and heading and unit of each variable."""
    needed = {name: kind for _, name, _, kind, *_ in ENVIRONMENT_COLUMNS}
    grids = read_grids(path)
    best: tuple[int, str] = (-99, "")
    for grid in grids:
        for at, (line, fields) in enumerate(grid.rows):
            headings = {heading.role: heading for heading in map(read_heading, fields) if heading.role is not None}
            units = {name: headings[name].unit for name in needed if name in headings}
            lacking = [column for column, name, *_ in ENVIRONMENT_COLUMNS if units.get(name) is None]
            lacking += [] if "time" in headings else ["time"]
            if not lacking:
                _check_units(path, line, {name: headings[name].text for name in needed}, units, needed)
                table = table_below(grid, at)
                named = {name: (headings[name].text, units[name] or "") for name in needed}
                return table, headings["time"].text, named
            best = max(best, (-len(lacking), f"line {line} lacks {', '.join(lacking)}"), key=lambda each: each[0])
    expected = ",".join(("time", *(column for column, *_ in ENVIRONMENT_COLUMNS)))
    raise LaserFormatError(
        f"{path}: no table of air and material: {best[1]}; expected {expected!r} (the heading names the unit, which may be another)"
    )


def _check_units(
    path: Path, line: int, texts: dict[str, str], units: dict[str, str | None], needed: dict[str, str]
) -> None:
    for name, kind in needed.items():
        if UNITS[units[name] or ""].kind != kind:
            raise LaserFormatError(
                f"{path}, line {line}: the unit of {texts[name]!r} is none of a {kind}; correct the heading"
            )
