"""Tables of a run for other programs: readings with drift, profile, ISO 230-2 values, and the fields on request."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from openpyxl import Workbook
from openpyxl.cell import WriteOnlyCell
from openpyxl.cell.cell import ILLEGAL_CHARACTERS_RE
from openpyxl.chart import BarChart, Reference, ScatterChart, Series
from openpyxl.styles import Font
from openpyxl.utils import get_column_letter

from fusion.report.terminal import summary_rows
from fusion.report.wording import quoted_window
from fusion.results.axis import Iso230Tolerance
from fusion.results.results import Results
from fusion.results.store import group, has, opened, read_product, require_kind
from interferometry import iso230

#: Bytes of a row of fields.csv, measured on the demo.
_FIELD_ROW_BYTES = 38


def readings_table(deviations: xr.Dataset) -> pd.DataFrame:
    """Return every reading with its drift and the standard uncertainty of that; of readings without times, the readings alone."""
    position, read = deviations["position"], deviations["deviation"]
    timed = {} if np.isnat(deviations["time"].values).all() else {"time_utc": deviations["time"]}
    columns = {"position_mm": position, **timed, "deviation_um": read}
    if has(deviations, "drift"):
        drift = group(deviations, "drift")
        columns |= {"drift_um": drift["drift"], "drift_u_um": drift["drift_u"]}
    return _in_its_units(xr.Dataset(columns).to_dataframe().dropna(subset=["deviation_um"]).reset_index(), deviations)


def _in_its_units(table: pd.DataFrame, deviations: xr.Dataset) -> pd.DataFrame:
    """Return a table whose headings carry deg and arcsec where the axis is a rotary one."""
    if deviations["deviation"].attrs["units"] != "arcsec":
        return table
    return table.rename(columns=lambda name: re.sub("_mm$", "_deg", re.sub("_um$", "_arcsec", name)))


def profile_table(deviations: xr.Dataset) -> pd.DataFrame:
    """Return the drift-free profile and the scatter per approach and target."""
    drift = group(deviations, "drift")
    columns = {"profile_um": "profile", "profile_u_um": "profile_u", "scatter_um": "scatter"}
    profile = {"position_mm": deviations["position"], **{key: drift[name] for key, name in columns.items()}}
    return xr.Dataset(profile).to_dataframe().reset_index()


def iso230_axis_table(deviations: xr.Dataset) -> pd.DataFrame:
    """Return the axis values of every window of cycles with their standard uncertainty, um."""
    windows = group(deviations, "iso")
    rows = []
    for name in (*iso230.QUANTITIES, "mean_reversal", "E_unidirectional", "R_unidirectional", "A_unidirectional"):
        if name not in windows:
            continue
        frame = xr.Dataset({"value_um": windows[name], "u_um": windows[f"{name}_u"]}).to_dataframe().reset_index()
        rows.append(frame.assign(quantity=name.removesuffix("_unidirectional")))
    table = pd.concat(rows, ignore_index=True)
    table["direction"] = table["direction"].fillna("both") if "direction" in table else "both"
    return _in_its_units(table[["window", "quantity", "direction", "value_um", "u_um"]], deviations)


def iso230_position_table(deviations: xr.Dataset, results: Results) -> pd.DataFrame:
    """Return mean, standard deviation, reversal and repeatability per target in the window whose values are quoted, um."""
    name = "" if results.iso230 is None else quoted_window(results.iso230).window
    window = _cycles_of(name, deviations)
    evaluated = iso230.evaluate_iso230(deviations, cycles=window)
    columns = {"position_mm": deviations["position"]}
    for direction in ("positive", "negative"):
        chosen = evaluated.sel(direction=direction, drop=True)
        columns[f"mean_{direction}_um"] = chosen["mean_unidirectional"]
        columns[f"s_{direction}_um"] = chosen["standard_deviation"]
        columns[f"count_{direction}"] = chosen["count"]
    columns |= {
        "reversal_um": evaluated["reversal"],
        "mean_bidirectional_um": evaluated["mean_bidirectional"],
        "repeatability_bidirectional_um": evaluated["repeatability_bidirectional"],
    }
    table = xr.Dataset(columns).to_dataframe().reset_index().assign(window=evaluated.attrs["window"])
    return _in_its_units(table, deviations)


def fields_table(folder: Path) -> pd.DataFrame:
    """Return temperature and rise per cycle and cell that was seen."""
    fields = read_product(folder, "fields")
    frame = fields[["temperature", "temperature_rise", "temperature_rise_u"]].to_dataframe().dropna().reset_index()
    names = {"temperature": "temperature_degC", "temperature_rise": "rise_K", "temperature_rise_u": "rise_u_K"}
    return frame.rename(columns={"x": "x_mm", "y": "y_mm", **names})


def fields_megabytes(folder: Path) -> float | None:
    """Return about how large fields.csv would be, MB; None where there are no fields."""
    path = folder / "fields.nc"
    if not path.is_file():
        return None
    with opened(path) as fields:
        return require_kind(fields, "fields", path)["temperature"].size * _FIELD_ROW_BYTES / 1e6


def _cycles_of(window: str, deviations: xr.Dataset) -> list[int] | None:
    """Return the cycles between the two numbers that a window's name begins with; None, all of them, where it names none."""
    ends = [int(text) for text in re.findall(r"\d+", window)[:2]]
    measured = deviations["cycle"].values.tolist()
    return [cycle for cycle in measured if ends[0] <= cycle <= ends[1]] or None if len(ends) == 2 else None


# Workbooks: of a run, with summary, ISO 230-2, conditions, profile and readings on a sheet each; of any table of results.

#: Formats of numbers by the end of a heading; every other number is shown with three decimals.
_FORMATS = {"_mm": "0.0##", "_degC": "0.00", "_K": "0.00", "seconds": "0.0", "peak_MB": "0"}
_TIME = "yyyy-mm-dd hh:mm:ss"
#: Rows of a chart in a workbook; more would not be seen.
_MOST_ROWS = 4000


def write_workbook(path: Path, results: Results, deviations: xr.Dataset) -> None:
    """Write the workbook of a run."""
    book = Workbook(write_only=True)
    findings = [("campaign", results.campaign), *summary_rows(results)]
    _add_sheet(book, "Summary", ("finding", "value"), findings, widths=(24, 110))
    if results.iso230 is not None:
        window, limits = quoted_window(results.iso230), {one.quantity: one for one in results.iso230.tolerances}
        found = {name: getattr(window, f"{name}_um") for name in iso230.QUANTITIES if hasattr(window, f"{name}_um")}
        unit = results.iso230.unit
        rows = [
            (name, one.value, None if one.u is None else 2 * one.u, *_judged(limits.get(name)))
            for name, one in found.items()
        ]
        heads = ("quantity", f"value_{unit}", f"U_{unit} (k = 2)", f"limit_{unit}", "decision")
        _add_sheet(book, "A R E M B", heads, rows, widths=(14, 14, 16, 14, 16))
        stated = [(one.name, one.text or "not stated") for one in results.iso230.conditions]
        _add_sheet(book, "Conditions", ("condition", "stated or logged"), stated, widths=(40, 80))
    for title, frame in (
        ("ISO 230-2 axis", iso230_axis_table(deviations)),
        ("ISO 230-2 positions", iso230_position_table(deviations, results)),
        *((("Profile", profile_table(deviations)),) if has(deviations, "drift") else ()),
        ("Readings", readings_table(deviations)),
    ):
        columns = [str(name) for name in frame.columns]
        widths = [max(12, len(name) + 2) for name in columns]
        sheet = _add_sheet(book, title, columns, frame.itertuples(index=False), widths=widths)
        _add_courses(sheet, frame)
    _save(book, path)


def _judged(limit: Iso230Tolerance | None) -> tuple[float | None, str]:
    return (None, "no tolerance stated") if limit is None else (limit.limit_um, limit.decision)


def write_table_book(
    path: Path, title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], *, chart: str
) -> None:
    """Write a workbook of one table whose first column names its rows, with bars of one column where the table has it."""
    book = Workbook(write_only=True)
    widths = [min(max(12, *(len(str(cell)) + 2 for cell in column)), 60) for column in zip(columns, *rows, strict=True)]
    sheet = _add_sheet(book, title, columns, rows, widths=widths)
    if chart in columns and rows:
        bars = BarChart()
        bars.type, bars.title, bars.legend = "bar", chart, None
        bars.height = max(8.0, 0.6 * len(rows))
        bars.add_data(_column(sheet, columns.index(chart), 1, len(rows) + 1), titles_from_data=True)
        bars.set_categories(_column(sheet, 0, 2, len(rows) + 1))
        sheet.add_chart(bars, f"A{len(rows) + 4}")
    _save(book, path)


def _add_courses(sheet: Any, frame: pd.DataFrame) -> None:
    """Add a chart of a column of values over position, one line per direction of approach, where the table has it."""
    names = list(frame.columns)
    drawn = next((name for name in ("profile_um", "mean_positive_um", "profile_arcsec") if name in names), None)
    place = next((at for at, name in enumerate(names) if str(name).startswith("position_")), None)
    if drawn is None or place is None or len(frame) > _MOST_ROWS:
        return
    chart = ScatterChart()
    chart.title, chart.style, chart.x_axis.title, chart.y_axis.title = drawn, 13, names[place], drawn
    by_direction = frame.groupby("direction", sort=False).indices if "direction" in names else {"": range(len(frame))}
    lines: list[tuple[str, Any, Any]] = [(drawn, direction, rows) for direction, rows in by_direction.items()]
    if drawn == "mean_positive_um":
        lines.append(("mean_negative_um", "", range(len(frame))))
    for name, direction, rows in lines:
        first, last = min(rows) + 2, max(rows) + 2
        values, places = (_column(sheet, at, first, last) for at in (names.index(name), place))
        chart.series.append(Series(values, places, title=str(direction or name)))
    sheet.add_chart(chart, f"{get_column_letter(len(names) + 2)}2")


def _column(sheet: Any, at: int, first: int, last: int) -> Reference:
    return Reference(sheet, min_col=at + 1, min_row=first, max_row=last)


def _save(book: Workbook, path: Path) -> None:
    # On a full disk the library's own file would be closed with a traceback for every sheet.
    content = io.BytesIO()
    book.save(content)
    path.write_bytes(content.getvalue())


def _add_sheet(
    book: Workbook, title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], *, widths: Sequence[int]
) -> Any:
    """Add a sheet with a bold heading that stays in sight, and with a filter for every column."""
    sheet = book.create_sheet(title)
    sheet.freeze_panes = "B2"
    for number, width in enumerate(widths, start=1):
        sheet.column_dimensions[get_column_letter(number)].width = width
    formats = [next((shown for end, shown in _FORMATS.items() if name.endswith(end)), "0.000") for name in columns]
    sheet.append([_cell(sheet, name, bold=True) for name in columns])
    count = 1
    for row in rows:
        sheet.append([_cell(sheet, value, shown=shown) for value, shown in zip(row, formats, strict=True)])
        count += 1
    sheet.auto_filter.ref = f"A1:{get_column_letter(len(columns))}{count}"
    return sheet


def _cell(sheet: object, value: object, *, bold: bool = False, shown: str = "General") -> WriteOnlyCell:
    """Return a cell: a text as a text, a number as a number, a time without its zone (UTC), nothing where there is no number."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        value = None
    if isinstance(value, pd.Timestamp):
        value = None if pd.isna(value) else value.to_pydatetime(warn=False)
    cell = WriteOnlyCell(sheet)
    if isinstance(value, str):
        cell.value = ILLEGAL_CHARACTERS_RE.sub(" ", value)
        cell.data_type = "s"
    else:
        cell.value = value
    if isinstance(value, float):
        cell.number_format = shown
    elif isinstance(value, datetime):
        cell.number_format = _TIME
    if bold:
        cell.font = Font(bold=True)
    return cell
