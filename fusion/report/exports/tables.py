"""Tables of a run for other programs: readings with drift, profile, ISO 230-2 values, and the fields on request."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from openpyxl import Workbook
from openpyxl.cell import WriteOnlyCell
from openpyxl.cell.cell import ILLEGAL_CHARACTERS_RE
from openpyxl.styles import Font

from fusion.report.terminal import summary_rows
from fusion.report.wording import quoted_window
from fusion.results.results import Results
from fusion.results.store import group, has, read_product, refuse_damaged, require_kind
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
    with refuse_damaged(path), xr.open_dataset(path, engine="h5netcdf", decode_timedelta=False) as fields:
        return require_kind(fields, "fields", path)["temperature"].size * _FIELD_ROW_BYTES / 1e6


def _cycles_of(window: str, deviations: xr.Dataset) -> list[int] | None:
    """Return the cycles between the two numbers that a window's name begins with; None, all of them, where it names none."""
    ends = [int(text) for text in re.findall(r"\d+", window)[:2]]
    measured = deviations["cycle"].values.tolist()
    return [cycle for cycle in measured if ends[0] <= cycle <= ends[1]] or None if len(ends) == 2 else None


# A workbook of a run: summary, ISO 230-2, profile and readings on one sheet each.


def write_workbook(path: Path, results: Results, deviations: xr.Dataset) -> None:
    """Write the workbook."""
    book = Workbook(write_only=True)
    findings = [("campaign", results.campaign), *summary_rows(results)]
    _add_sheet(book, "Summary", ("finding", "value"), findings, widths=(24, 110))
    for title, frame in (
        ("ISO 230-2 axis", iso230_axis_table(deviations)),
        ("ISO 230-2 positions", iso230_position_table(deviations, results)),
        *((("Profile", profile_table(deviations)),) if has(deviations, "drift") else ()),
        ("Readings", readings_table(deviations)),
    ):
        columns = [str(name) for name in frame.columns]
        widths = [max(12, len(name) + 2) for name in columns]
        _add_sheet(book, title, columns, frame.itertuples(index=False), widths=widths)
    # On a full disk the library's own file would be closed with a traceback for every sheet.
    content = io.BytesIO()
    book.save(content)
    path.write_bytes(content.getvalue())


def _add_sheet(
    book: Workbook, title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], *, widths: Sequence[int]
) -> None:
    """Add a sheet with a bold heading that stays in sight."""
    sheet = book.create_sheet(title)
    sheet.freeze_panes = "A2"
    for number, width in enumerate(widths):
        sheet.column_dimensions[chr(ord("A") + number)].width = width
    sheet.append([_cell(sheet, name, bold=True) for name in columns])
    for row in rows:
        sheet.append([_cell(sheet, value) for value in row])


def _cell(sheet: object, value: object, *, bold: bool = False) -> WriteOnlyCell:
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
    if bold:
        cell.font = Font(bold=True)
    return cell
