"""Tables of a run for other programs: of an axis, of a record, of pictures, and the fields on request; workbooks of such tables."""

from __future__ import annotations

import errno
import io
import math
import os
import re
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from datetime import date, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from lxml.etree import LxmlError, SerialisationError
from openpyxl import Workbook
from openpyxl.cell import WriteOnlyCell
from openpyxl.chart import BarChart, Reference, ScatterChart, Series
from openpyxl.styles import Alignment, Font
from openpyxl.utils import get_column_letter

from fusion.common import own_name
from fusion.report.findings import summary_rows
from fusion.report.wording import ISO230_TERMS, baseline_words, effect_words, model_errors, parameters, say
from fusion.results.loop import RecordLoop
from fusion.results.numbers import print_unit
from fusion.results.parts import Iso230Condition
from fusion.results.results import Results
from fusion.results.store import group, has, has_product, opened, read_product, require_kind
from interferometry.io.tables import DATED
from thermography.common import ACTING

#: Bytes of a row of fields.csv, measured on the demo.
_FIELD_ROW_BYTES = 43


def findings_table(results: Results) -> pd.DataFrame:
    """Return what was found, in words."""
    return pd.DataFrame([("campaign", results.campaign), *summary_rows(results)], columns=["finding", "value"])


def conditions_of(results: Results) -> tuple[Iso230Condition, ...]:
    """Return the conditions of the test; nothing where the results hold none."""
    tests = [one for one in (results.iso230, *(results.iso230_3 or ())) if one is not None]
    return tests[0].conditions if tests else ()


def _conditions_table(results: Results) -> pd.DataFrame:
    rows = [(one.name, one.text or "not stated") for one in conditions_of(results)]
    return pd.DataFrame(rows, columns=["condition", "stated or logged"])


# Of an axis.


def axis_tables(results: Results, deviations: xr.Dataset) -> dict[str, pd.DataFrame]:
    """Return the tables of a positioning test by title."""
    return {
        "Summary": findings_table(results),
        **({} if results.iso230 is None else {"A R E M B": _judged_table(results)}),
        "Conditions": _conditions_table(results),
        "ISO 230-2 axis": iso230_axis_table(deviations),
        "ISO 230-2 positions": iso230_position_table(deviations, results),
        **({"Profile": profile_table(deviations)} if has(deviations, "estimate") else {}),
        "Readings": readings_table(deviations),
    }


def _judged_table(results: Results) -> pd.DataFrame:
    """Return the values to quote with the decision on each that has a tolerance."""
    assert results.iso230 is not None
    window, limits = results.iso230, {one.quantity: one for one in results.iso230.tolerances}
    unit, accepted = window.unit, {True: "yes", False: "no", None: "open"}[window.is_acceptance_test]
    rows = []
    for name in ISO230_TERMS:
        found, limit = getattr(window, f"{name}_um"), limits.get(name)
        judged: tuple[float | None, str, str | None] = (None, "no tolerance stated", None)
        if limit is not None:
            judged = (limit.limit_um, limit.decision, say("windows_otherwise", limit, window))
        rows.append((name, found.value, found.u, *judged, accepted))
    titles = ["decision", "decided otherwise", "acceptance by ISO 230-2"]
    return pd.DataFrame(rows, columns=["quantity", f"value_{unit}", f"u_{unit}", f"limit_{unit}", *titles])


def readings_table(deviations: xr.Dataset) -> pd.DataFrame:
    """Return every reading with its drift and the standard uncertainty of that; of readings without times, the readings alone."""
    position, read = deviations["position"], deviations["deviation"]
    timed = {} if np.isnat(deviations["time"].values).all() else {"time_utc": deviations["time"]}
    columns = {"position_mm": position, **timed, "deviation_um": read}
    if has(deviations, "estimate"):
        drift = group(deviations, "estimate")
        columns |= {"drift_um": drift["drift"], "drift_u_um": drift["drift_u"]}
    return _in_its_units(xr.Dataset(columns).to_dataframe().dropna(subset=["deviation_um"]).reset_index(), deviations)


def _in_its_units(table: pd.DataFrame, deviations: xr.Dataset) -> pd.DataFrame:
    """Return a table whose headings carry deg and arcsec where the axis is a rotary one."""
    if deviations["deviation"].attrs["units"] != "arcsec":
        return table
    return table.rename(columns=lambda name: re.sub("_mm$", "_deg", re.sub("_um$", "_arcsec", name)))


def profile_table(deviations: xr.Dataset) -> pd.DataFrame:
    """Return the drift-free profile and the scatter per approach and target."""
    drift = group(deviations, "estimate")
    columns = {"profile_um": "profile", "profile_u_um": "profile_u", "scatter_um": "scatter"}
    profile = {"position_mm": deviations["position"], **{key: drift[name] for key, name in columns.items()}}
    return xr.Dataset(profile).to_dataframe().reset_index()


def iso230_axis_table(deviations: xr.Dataset) -> pd.DataFrame:
    """Return the axis values of every window of cycles with their standard uncertainty, um."""
    windows = group(deviations, "iso")
    rows = []
    for name in (*ISO230_TERMS, "mean_reversal", "E_unidirectional", "R_unidirectional", "A_unidirectional"):
        if name not in windows:
            continue
        frame = xr.Dataset({"value_um": windows[name], "u_um": windows[f"{name}_u"]}).to_dataframe().reset_index()
        rows.append(frame.assign(quantity=name.removesuffix("_unidirectional")))
    table = pd.concat(rows, ignore_index=True)
    table["direction"] = table["direction"].fillna("both") if "direction" in table else "both"
    # A test of as many cycles as the standard asks for is its own only window.
    columns = ["window", "quantity", "direction", "value_um", "u_um"]
    return _in_its_units(table[columns].drop_duplicates(ignore_index=True), deviations)


def iso230_position_table(deviations: xr.Dataset, results: Results) -> pd.DataFrame:
    """Return mean, standard deviation, reversal and repeatability per target in the window whose values are quoted, um."""
    evaluated = group(deviations, "quoted")
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
    window = results.iso230.window if results.iso230 else ""
    return _in_its_units(xr.Dataset(columns).to_dataframe().reset_index().assign(window=window), deviations)


# Of a record.


def record_tables(results: Results, record: xr.Dataset) -> dict[str, pd.DataFrame]:
    """Return the tables of a record by title."""
    loop = results.loop
    assert isinstance(loop, RecordLoop)
    named = model_errors(loop)
    plain = {words: getattr(loop.baselines, name) for name, words in baseline_words(loop).items()}
    return {
        "Summary": findings_table(results),
        "Distortions": _distortions_table(results),
        "Conditions": _conditions_table(results),
        "Model": _steps_table(loop),
        "Contributions": _contributions_table(record),
        "Hold-out errors": _channels_table(loop),
        "Predictions": pd.DataFrame(
            [(name, one.rmse_um, getattr(one, "expected_um", None)) for name, one in {**named, **plain}.items()],
            columns=["prediction", "rmse_um", "expected_um"],
        ),
        "Readings": record_readings_table(record),
    }


def _distortions_table(results: Results) -> pd.DataFrame:
    """Return how far displacements, tilts and temperatures moved by ISO 230-3, each in its own unit."""
    periods = {
        "first_hour": "first_hour",
        "whole_test": "whole",
        "last_hour": "last_hour",
        "last_minus_first": "change",
    }
    rows = []
    for test in results.iso230_3 or ():
        for one in (*test.distortions, *test.temperatures):
            found = {name: getattr(one, period) for name, period in periods.items()}
            values = {
                key: value for name, each in found.items() for key, value in ((name, each.value), (f"{name}_u", each.u))
            }
            run = {"run": test.run} if test.run else {}
            rows.append(
                {
                    **run,
                    "quantity": one.name,
                    "unit": print_unit(one.unit),
                    **values,
                    "settled_after_min": one.settling_min,
                }
            )
    return pd.DataFrame(rows, columns=None if rows else ["quantity", "unit"])


def _steps_table(loop: RecordLoop) -> pd.DataFrame:
    """Return the declared model and every effect that was added, with its parameters and the errors on the hold-out set."""
    declared = ", ".join(effect_words(name).name for name in loop.declared) or "nothing"
    rows: list[tuple[object, ...]] = [(0, f"declared: {declared}", "", None, None, loop.rmse_declared_um)]
    rows += [
        (
            turn,
            effect_words(step.effect).name,
            parameters(step.parameters, step.parameter_ranges),
            step.p_value,
            step.rmse_before_um,
            step.rmse_after_um,
        )
        for turn, step in enumerate(loop.steps, start=1)
    ]
    return pd.DataFrame(rows, columns=["step", "effect", "parameters", "p_value", "rmse_before_um", "rmse_after_um"])


def _contributions_table(record: xr.Dataset) -> pd.DataFrame:
    """Return how much each term of the final model moves each displacement over the record, largest minus smallest."""
    rows = [
        (effect_words(str(effect)).name, str(channel), float(np.ptp(record["contribution"].values[at, :, k])))
        for at, effect in enumerate(record["effect"].values)
        for k, channel in enumerate(record["channel"].values)
    ]
    return pd.DataFrame(rows, columns=["effect", "displacement", "range_um"])


def _channels_table(loop: RecordLoop) -> pd.DataFrame:
    """Return the errors on the hold-out set by displacement, and their means."""
    names = ("last_value_repeated_um", "declared_model_um", "final_model_um")
    keys = ("rmse_persistence_um", "rmse_declared_um", "rmse_final_um")
    rows = [
        (name, *(getattr(one, key) for key in keys), one.noise_um, one.variance_share)
        for name, one in loop.channels.items()
    ]
    rows.append(("mean", *(getattr(loop, key) for key in keys), loop.noise_floor_um, None))
    return pd.DataFrame(rows, columns=["displacement", *names, "noise_um", "share_of_variance_left"])


def record_readings_table(record: xr.Dataset) -> pd.DataFrame:
    """Return the readings of a record as they were modelled, means over its blocks, with the predictions of the final model."""
    time = record["time"].values
    elapsed = record["elapsed"].values / 3600.0 if "elapsed" in record else (time - time[0]) / np.timedelta64(1, "h")
    columns: dict[str, Any] = {"time [h]": elapsed}
    # The times of a record whose start nobody states count from zero.
    columns |= {"time_utc": time} if time[0] >= DATED else {}

    def add(name: str, unit: str, values: np.ndarray) -> None:
        columns[own_name(f"{name} [{unit}]", columns)] = values

    for k, name in enumerate(record["channel"].values):
        add(name, "um", record["displacement"].values[:, k])
        add(f"{name}, predicted", "um", record["predicted_final"].values[:, k])
    for k, name in enumerate(record["sensor"].values):
        add(name, "degC", record["temperature"].values[:, k])
    for k, name in enumerate(record["driver_name"].values):
        size, unit = (record[key].values[k] for key in ("driver_size", "driver_units"))
        add(name, unit, record["driver"].values[:, k] * float(size))
    return pd.DataFrame({**columns, "held_out": np.where(record["sealed"].values, "yes", "no")})


# Of a camera.


def camera_tables(results: Results, folder: Path) -> dict[str, pd.DataFrame]:
    """Return the tables of a camera without a laser by title: of its pictures, and of the plan if it sees one; empty without products."""
    found: dict[str, pd.DataFrame] = {}
    if has_product(folder, "thermograms.nc"):
        found["Regions"] = _regions_table(results)
        found["Pictures"] = _pictures_table(read_product(folder, "thermograms"))
    if has_product(folder, "fields.nc"):
        found["Fields"] = _windows_table(read_product(folder, "fields"))
    return {"Summary": findings_table(results), **found} if found else {}


def _regions_table(results: Results) -> pd.DataFrame:
    """Return highest, lowest and mean temperature of every region over the pictures of one camera."""
    regions = [
        {
            "region": one.name,
            **{key: getattr(one, key) for key in ("camera", "kind", "pictures", "emissivity")},
            **{
                f"{name}{u}": getattr(getattr(one, f"{name}_degC"), key)
                for name in ("maximum", "minimum", "mean")
                for u, key in (("_degC", "value"), ("_u_K", "u"))
            },
            "pictures_above_range": one.overrange_pictures,
            "pictures_below_range": one.underrange_pictures,
            "hottest_picture": one.maximum_at.file,
            "column_px": one.maximum_at.column_px,
            "row_px": one.maximum_at.row_px,
        }
        for one in results.regions or ()
    ]
    frame = pd.DataFrame(regions)
    if regions:
        frame["maximum_degC"] = _bounded(frame["maximum_degC"], frame["pictures_above_range"])
    return frame


def _bounded(highest: pd.Series[float], beyond: pd.Series[int]) -> pd.Series[Any]:
    """Return highest temperatures, as bounds where pixels are beyond the calibrated range."""
    pairs = zip(highest, beyond, strict=True)
    return pd.Series([Bound(value) if count else value for value, count in pairs], dtype=object)


def _pictures_table(thermograms: xr.Dataset) -> pd.DataFrame:
    """Return temperatures of every region in every picture, region by region."""
    units = {"maximum": "degC", "maximum_u": "K", "minimum": "degC", "minimum_u": "K", "mean": "degC", "mean_u": "K"}
    counts = {"overrange": "pixels_above_range", "underrange": "pixels_below_range"}
    names = {**{name: f"{name}_{unit}" for name, unit in units.items()}, "emissivity": "emissivity", **counts}
    table = thermograms[list(names)].transpose("region", "time").to_dataframe().reset_index().rename(columns=names)
    table["maximum_degC"] = _bounded(table["maximum_degC"], table["pixels_above_range"])
    table.insert(0, "time [min]", (table["time"] - table["time"].min()) / np.timedelta64(1, "m"))
    first = ["region", "source", "time [min]", "time_utc"]
    return table.rename(columns={"time": "time_utc"})[[*first, *names.values()]].rename(columns={"source": "picture"})


def _windows_table(fields: xr.Dataset) -> pd.DataFrame:
    """Return what a camera measured on the plan over every window of time."""
    plan = ("y", "x")
    columns = {
        "time_utc": fields["cycle_time"],
        "maximum_degC": fields["temperature"].max(plan),
        "mean_degC": fields["temperature"].mean(plan),
        "largest_rise_K": fields["temperature_rise"].max(plan),
        "mean_rise_K": fields["temperature_rise"].mean(plan),
    }
    frame = xr.Dataset({name: values.variable for name, values in columns.items()}).to_dataframe()
    frame.insert(0, "window", fields["cycle"].values)
    return frame


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


# Workbooks of tables: headings in words with units, uncertainties as U (k = 2), formats, filters and charts.

#: Formats of numbers by the unit at the end of a heading; every other number is shown with three decimals.
_FORMATS = {
    " / mm": "0.0##", " / °C": "0.00", " / K": "0.00", " / h": "0.00", " / min": "0.0", " / s": "0.0", " / MB": "0", "p value": "0.0E+00",
}  # fmt: skip
_TIME, _DATE = "yyyy-mm-dd hh:mm:ss", "yyyy-mm-dd"
_UNITS = "um|mm|deg|arcsec|degC|K|min|px"
#: Rows of a chart in a workbook, and lines; more would not be seen.
_MOST_ROWS, _MOST_LINES = 4000, 8
#: Characters of a column; longer text goes on below.
_WIDEST = 80


class Linked(NamedTuple):
    """A text in a cell that opens something else."""

    text: str
    target: str


class Bound(float):
    """The end of what could be measured; the value is beyond it."""


class Bars(NamedTuple):
    """Bars of columns of one table, whose first column names its rows, in the sheet of another."""

    table: str
    columns: tuple[str, ...]
    beside: str


def write_workbook(path: Path, sheets: Mapping[str, pd.DataFrame], bars: Bars | None = None) -> None:
    """Write a workbook of tables by title, with charts of what was measured over position or time."""
    book, made, content = Workbook(write_only=True), {}, io.BytesIO()
    try:
        for title, frame in sheets.items():
            made[title] = _add_sheet(book, title, in_words(frame))
            _add_courses(made[title], frame)
        if bars is not None:
            _add_bars(made, sheets[bars.table], bars)
        # On a full disk the library's own file would be closed with a traceback for every sheet.
        book.save(content)
    except SerialisationError as error:  # of the sheets' temporary files, by a name such as IO_ENOSPC
        for stream in (part for sheet in book.worksheets for part in (sheet._rows, sheet._writer.xf)):
            with suppress(LxmlError):
                stream.close()
        number = getattr(errno, str(error).removeprefix("IO_"), errno.EIO)
        raise OSError(number, f"{os.strerror(number)}: temporary files in {tempfile.gettempdir()}") from error
    path.write_bytes(content.getvalue())


def in_words(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table with headings for people, and expanded uncertainties (k = 2) in place of standard ones."""
    shown: dict[str, Any] = {}
    for name, column in frame.items():
        expanded = _uncertain(str(name)) and column.dtype.kind == "f"
        shown[own_name(_heading(str(name)), shown)] = 2 * column if expanded else column
    return pd.DataFrame(shown)


def _uncertain(name: str) -> re.Match[str] | None:
    return re.fullmatch(rf"(?:(.+)_)?u(?:_({_UNITS}))?", name)


def _heading(name: str) -> str:
    """Return the heading of a column in words: "drift / µm" of "drift_um" and "drift [um]", "U(drift) (k = 2) / µm" of "drift_u_um"."""
    if " / " in name:
        return name
    if found := re.fullmatch(r"(.*) \[(.*)\]", name):
        words, unit = found.groups()
    elif found := _uncertain(name):
        of, unit = found.groups()
        words = f"U({of.replace('_', ' ')}) (k = 2)" if of else "U (k = 2)"
    elif found := re.fullmatch(rf"(.+)_({_UNITS})", name):
        words, unit = found[1].replace("_", " "), found[2]
    else:
        words, unit = name.replace("_utc", " (UTC)").replace("_", " "), ""
    printed = print_unit(unit or "").replace("deg", "°")
    return f"{words} / {printed}" if printed else words


def _add_courses(sheet: Any, frame: pd.DataFrame) -> None:
    """Add a chart of what a table holds over position, one line per direction of approach, or over time, one per displacement or region."""
    names = [str(name) for name in frame.columns]
    along = next((name for name in names if name.startswith("position_") or name in ("time [h]", "time [min]")), None)
    values = ("profile_um", "profile_arcsec", "mean_positive_um", "mean_negative_um", "maximum_degC")
    shown = [name for name in names if name in values or name.endswith("[um]")]
    if along is None or not shown or not 1 < len(frame) <= _MOST_ROWS or frame[along].isna().any():
        return
    groups = next((name for name in ("direction", "region") if name in names), None)
    parts = {"": range(len(frame))} if groups is None else frame.groupby(groups, sort=False).indices
    chart = ScatterChart()
    chart.style, chart.height, chart.width = 13, 9.0, 18.0
    _name_axes(chart, _heading(along), _heading(shown[0]) if len(shown) == 1 else "µm")
    lines = [(name, part, rows) for name in shown for part, rows in parts.items()][:_MOST_LINES]
    for name, part, rows in lines:
        first, last = min(rows) + 2, max(rows) + 2
        places, drawn = (_column(sheet, names.index(one), first, last) for one in (along, name))
        line = Series(drawn, places, title=str(part) if part else _heading(name).rpartition(" / ")[0])
        line.smooth = False
        chart.series.append(line)
    sheet.add_chart(chart, f"{get_column_letter(len(names) + 2)}2")


def _add_bars(made: Mapping[str, Any], frame: pd.DataFrame, bars: Bars) -> None:
    """Add bars of those columns that the table has."""
    names = list(frame.columns)
    shown = [name for name in bars.columns if name in names]
    if not shown or frame.empty:
        return
    chart, table = BarChart(), made[bars.table]
    chart.type, chart.height, chart.width = "bar", max(8.0, 0.8 * len(frame)), 18.0
    _name_axes(chart, "", shown[0].rpartition(" / ")[2])
    # The first row of the table is at the top.
    chart.x_axis.scaling.orientation = "maxMin"
    for name in shown:
        chart.add_data(_column(table, names.index(name), 1, len(frame) + 1), titles_from_data=True)
    chart.set_categories(_column(table, 0, 2, len(frame) + 1))
    made[bars.beside].add_chart(chart, "F2")


def _name_axes(chart: Any, along: str, values: str) -> None:
    """Name both axes; a program for spreadsheets leaves out those that are not said to be there."""
    chart.x_axis.title, chart.y_axis.title = along or None, values
    chart.x_axis.delete = chart.y_axis.delete = False


def _column(sheet: Any, at: int, first: int, last: int) -> Reference:
    return Reference(sheet, min_col=at + 1, min_row=first, max_row=last)


def _add_sheet(book: Workbook, title: str, frame: pd.DataFrame) -> Any:
    """Add a sheet with a bold heading that stays in sight, and with a filter for every column."""
    sheet = book.create_sheet(title)
    sheet.freeze_panes = "B2"
    headings = [str(name) for name in frame.columns]
    for at, name in enumerate(headings, start=1):
        lengths = (len(_text(value)) for value in frame.iloc[:_MOST_ROWS, at - 1])
        sheet.column_dimensions[get_column_letter(at)].width = min(max(12, len(name), *lengths) + 2, _WIDEST)
    formats = [next((shown for end, shown in _FORMATS.items() if name.endswith(end)), "0.000") for name in headings]
    sheet.append([_cell(sheet, name, bold=True) for name in headings])
    for row in frame.itertuples(index=False, name=None):
        sheet.append([_cell(sheet, value, shown=shown) for value, shown in zip(row, formats, strict=True)])
    sheet.auto_filter.ref = f"A1:{get_column_letter(len(headings))}{len(frame) + 1}"
    return sheet


def _text(value: object) -> str:
    """Return the text of a cell that is one."""
    return value.text if isinstance(value, Linked) else value if isinstance(value, str) else ""


def _cell(sheet: object, value: Any, *, bold: bool = False, shown: str = "General") -> WriteOnlyCell:
    """Return a cell: a text as a text, a number as a number, a time without its zone (UTC), nothing where there is no number."""
    cell = WriteOnlyCell(sheet)
    if isinstance(value, str | Linked):
        text = ACTING.sub(" ", _text(value))
        cell.value, cell.data_type = text, "s"
        if isinstance(value, Linked):
            cell.hyperlink, cell.style = value.target, "Hyperlink"
            cell.value, cell.data_type = text, "s"
        elif len(text) > _WIDEST or "\n" in text:
            cell.alignment = Alignment(wrap_text=True, vertical="top")
    elif isinstance(value, Bound):
        cell.value, cell.number_format = float(value), '"> "0'
    elif value is not None and not pd.isna(value):
        value = value.item() if isinstance(value, np.generic) else value
        cell.value = value.to_pydatetime(warn=False) if isinstance(value, pd.Timestamp) else value
        if isinstance(value, float):
            cell.value, cell.number_format = (value, shown) if math.isfinite(value) else (None, shown)
        elif isinstance(value, date):
            cell.number_format = _TIME if isinstance(value, datetime) else _DATE
    if bold:
        cell.font = Font(bold=True)
    return cell
