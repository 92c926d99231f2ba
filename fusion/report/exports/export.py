"""Exports of a results folder: what is asked for is made in memory, judged by the guard, and written without overwriting anything."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pandas as pd
import xarray as xr

from fusion.campaign.messages import naming
from fusion.products.contracts import read_product
from fusion.products.grouped import has
from fusion.products.results import Results, read_results
from fusion.products.store import write_atomically
from fusion.report.exports import tables
from fusion.report.exports.controls import CONTROLS, Control
from fusion.report.exports.errors import ExportError
from fusion.report.exports.guard import objections, remarks
from fusion.report.exports.header import Origin, header_lines, read_origin
from fusion.report.exports.prediction import Prediction, predict
from fusion.report.exports.profile import ErrorTable, path_variance, read_profile, tabulate
from fusion.report.exports.temperature_line import TemperatureLine, fit_temperature_line, siemens_temperature
from fusion.report.exports.thermal_state import read_thermal_state

#: Setting data that follow a temperature.
TEMPERATURE_FORMAT = "siemens840d-temperature"
FORMATS = ("csv", "xlsx", *CONTROLS, TEMPERATURE_FORMAT)
#: Name of an axis that every control accepts.
_AXIS = re.compile(r"[A-Za-z][A-Za-z0-9]{0,9}")

Writer = Callable[[Path], object]


@dataclass(frozen=True)
class Exported:
    """What an export wrote.

    Attributes
    ----------
    files : tuple of Path
        The files.
    remarks : tuple of str
        What to know of them, one sentence each.
    """

    files: tuple[Path, ...]
    remarks: tuple[str, ...] = ()


def export_results(
    results: Path,
    format: str,
    out: Path,
    *,
    axis: str | None = None,
    spacing_mm: float | None = None,
    reference_mm: float | None = None,
    fields: bool = False,
    force: bool = False,
    overwrite: bool = False,
) -> Exported:
    """Write tables of a run, or the drift-free profile as the compensation table of a control.

    Parameters
    ----------
    results : Path
        Folder of a finished run.
    format : {"csv", "xlsx", "linuxcnc", "siemens840d", "siemens840d-temperature", "heidenhain", "renishaw"}
        Tables, a workbook, or a control; ``siemens840d-temperature`` is the part of the drift that follows the material temperature.
    out : Path
        Folder for the files; created where it is absent.
    axis : str, optional
        Name of the axis in the control. None: the axis of the campaign.
    spacing_mm : float, optional
        Distance of the table's points. None: the targets themselves.
    reference_mm : float, optional
        Position at which the correction is zero. None: the first target.
    fields : bool
        Whether ``csv`` writes the fields too, which makes a large file.
    force : bool
        Write a compensation table although something speaks against it; the reason is written into its header.
    overwrite : bool
        Replace files that exist.

    Returns
    -------
    Exported
        ``csv``: ``drift.csv``, ``profile.csv``, ``iso230.csv``, ``iso230_positions.csv``, and ``fields.csv`` where it was asked for;
        ``xlsx``: ``results.xlsx``; a control: one table, with a README beside it where its dialect has no comments.

    Raises
    ------
    ExportError
        If the folder holds no results, a file exists, the positions do not suit the control, or something speaks against a compensation
        table: a verdict other than complete or explained, a doubted input, a position that moves by itself.

    Notes
    -----
    Formats, signs and their sources: `fusion.report.exports.controls`. A table corrects the profile at the mean thermal state of the
    test; what moves with the temperature is not in it.

    Examples
    --------
    >>> from pathlib import Path
    >>> export_results(Path("results"), "csv", Path("results/export"))  # doctest: +SKIP
    """
    if format not in FORMATS:
        raise ExportError(f'there is no format "{format}"; write one of {", ".join(FORMATS)}')
    if not (results / "deviations.nc").is_file():
        return _export_camera(results, format, out, overwrite=overwrite)
    found, deviations = read_results(results), read_product(results, "deviations")
    content: dict[str, Writer]
    if format == "csv":
        content = _csv_files(results, found, deviations, with_fields=fields)
        size = None if fields else tables.fields_megabytes(results)
        left = () if size is None else (f"fields.csv (about {size:.0f} MB) is written where --fields is given",)
        return Exported(_write(out, content, overwrite=overwrite), left)
    if format == "xlsx":
        from fusion.report.exports.workbook import write_workbook

        content = {"results.xlsx": lambda path: write_workbook(path, found, deviations)}
        return Exported(_write(out, content, overwrite=overwrite))
    if not has(deviations, "drift"):
        raise ExportError(
            f"{results}: the readings have no times, so there is neither drift nor profile to write; --format csv and xlsx give the values "
            "by ISO 230-2"
        )
    run = _Run(results, found, deviations, read_origin(results, found, read_thermal_state(results, deviations)))
    with naming(results):
        texts, notes = (
            _temperature_text(run, axis, reference_mm, force=force)
            if format == TEMPERATURE_FORMAT
            else _table_texts(run, CONTROLS[format], axis, spacing_mm, reference_mm, force=force)
        )
    writers = {name: _text_writer(text) for name, text in texts.items()}
    return Exported(_write(out, writers, overwrite=overwrite), tuple(notes))


@dataclass(frozen=True)
class _Run:
    """A results folder that was read, and what a header says of it."""

    folder: Path
    results: Results
    deviations: xr.Dataset
    origin: Origin


def _table_texts(
    run: _Run, control: Control, axis: str | None, spacing_mm: float | None, reference_mm: float | None, *, force: bool
) -> tuple[dict[str, str], list[str]]:
    """Return the files of a control's table by name, and what to tell the user."""
    against = _judge(objections(run.results), force=force)
    profile = read_profile(run.deviations)
    table = tabulate(profile, spacing_mm=spacing_mm, reference_mm=reference_mm)
    if control.equal_spacing and table.spacing_mm() is None:
        distances = sorted({round(float(step), 4) for step in table.position_mm[1:] - table.position_mm[:-1]})
        raise ExportError(
            f"{control.words}: needs equally spaced points; these are {distances[0]:g} to {distances[-1]:g} mm apart, as ISO 230-2 asks "
            f'for: resample them, for example with --spacing "{distances[len(distances) // 2]:.0f} mm"'
        )
    prediction = predict(profile, table, one_table=control.one_table)
    name = _axis_name(run, axis, needed=control.names_axis)
    header = header_lines(
        run.origin,
        words=control.words,
        axis=name,
        content=_content(table, prediction, path_variance(profile)),
        sign=control.sign,
        objections=against,
        remarks=remarks(run.results),
        exported=datetime.now(UTC),
    )
    file = _file_name(control.file_name, name)
    texts = {file: control.write(table, name, header if control.comment else ())}
    if not control.comment:
        texts[f"{file}.README.txt"] = "\n".join(header) + "\n"
    return texts, [*_forced(against), *remarks(run.results)]


def _content(table: ErrorTable, prediction: Prediction, variance_um2_per_mm: float) -> list[str]:
    """Return what a table holds and is predicted to do."""
    points = f"{table.position_mm.size} points from {table.position_mm[0]:g} to {table.position_mm[-1]:g} mm"
    made = f"table: {points}, at the measured targets"
    if table.resampled:
        made = f"table: {points}, resampled every {table.spacing_mm():g} mm by straight lines between the targets"
    between = (variance_um2_per_mm * table.widest_gap_mm / 4.0) ** 0.5
    return [
        made,
        f"at the targets the table departs from the profile by up to {prediction.resampling_um:.3f} um; midway between targets the "
        f"profile itself is uncertain by up to {between:.2f} um (standard uncertainty)",
        f"zero of the correction: {table.reference_mm:g} mm, approached in positive direction",
        f"predicted systematic error E of the axis without drift: {prediction.before_um:.2f} um before, {prediction.after_um:.2f} um after "
        f"(as a repeated test of as many cycles would show it; the table itself leaves {prediction.own_um:.2f} um)",
        f"standard uncertainty of a value: up to {prediction.value_u_um:.2f} um",
        "not in the table: the drift with temperature",
    ]


def _temperature_text(
    run: _Run, axis: str | None, reference_mm: float | None, *, force: bool
) -> tuple[dict[str, str], list[str]]:
    """Return the file of the temperature compensation by name, and what to tell the user."""
    there = (run.folder / "fusion.nc").is_file()
    material = read_product(run.folder, "fusion").get("material_temperature") if there else None
    if material is None:
        raise ExportError(
            f"{run.folder}: no material temperature was logged; a temperature line needs one ([interferometry] environment)"
        )
    reference = float(run.deviations["position"].min()) if reference_mm is None else reference_mm
    line = fit_temperature_line(run.deviations, material, reference_mm=reference)
    against = _judge([*objections(run.results), *line.objections()], force=force)
    name = _axis_name(run, axis, needed=True)
    header = header_lines(
        run.origin,
        words="Siemens SINUMERIK 840D, temperature compensation (SD43900, SD43910, SD43920)",
        axis=name,
        content=_line_content(line),
        sign="the compensation value K0(T) + tan beta(T) (P - P0) is the measured error line: measured minus programmed",
        objections=against,
        remarks=(),
        exported=datetime.now(UTC),
    )
    return {f"temperature_{name}.MPF": siemens_temperature(line, name, header)}, _forced(against)


def _line_content(line: TemperatureLine) -> list[str]:
    """Return what a temperature line says and is predicted to do."""
    return [
        f"shift {line.offset_um_per_K:+.3f} um/K (standard uncertainty {line.offset_u_um_per_K:.3f}), stretch "
        f"{line.gradient_ppm_per_K:+.3f} um/m/K ({line.gradient_u_ppm_per_K:.3f}) about {line.reference_mm:g} mm",
        f"predicted drift of a reading: {line.before_um:.2f} um rms before, {line.after_um:.2f} um after (each fifth of the cycles "
        "predicted from the others)",
        f"holds from {line.range_degC[0]:.1f} to {line.range_degC[1]:.1f} degC and at the rate of this test; not in it: the profile, which "
        "is the table of the format siemens840d",
    ]


def _judge(against: list[str], *, force: bool) -> list[str]:
    """Return the objections of an export that is forced; refuse one that is not."""
    if against and not force:
        raise ExportError(
            f"no compensation table is written: {'; '.join(against)}. Remove the cause and run again, or add --force: the reason "
            "is then written into the table"
        )
    return against


def _forced(against: Sequence[str]) -> list[str]:
    return [f"forced, although {reason}" for reason in against]


def _axis_name(run: _Run, given: str | None, *, needed: bool) -> str:
    """Return the name of the axis in the control: as given, else the campaign's; empty where there is none and none is needed."""
    stated = given if given is not None else run.origin.axis
    if _AXIS.fullmatch(stated):
        return stated
    if given is None and not needed:
        return ""
    why = f'"{stated}" is no name of an axis' if stated else "the campaign does not state the axis"
    raise ExportError(f"{why}; write a letter and up to nine letters or digits, for example --axis X1")


def _file_name(pattern: str, axis: str) -> str:
    return pattern.format(axis=axis) if axis else pattern.replace("_{axis}", "")


def _export_camera(results: Path, format: str, out: Path, *, overwrite: bool) -> Exported:
    """Write what a campaign without a laser has: its fields."""
    if not (results / "fields.nc").is_file():
        raise ExportError(f"{results}: there is no deviations.nc in it; name the results folder of a finished run")
    if format != "csv":
        raise ExportError(
            f"{results}: this campaign has no laser, so there is neither drift nor profile to write; its fields are written by --format csv"
        )
    return Exported(_write(out, {"fields.csv": _frame_writer(tables.fields_table(results))}, overwrite=overwrite))


def _csv_files(folder: Path, results: Results, deviations: xr.Dataset, *, with_fields: bool) -> dict[str, Writer]:
    """Return the writers of the CSV tables by file name."""
    timed = has(deviations, "drift")
    frames = {
        "drift.csv" if timed else "readings.csv": tables.readings_table(deviations),
        **({"profile.csv": tables.profile_table(deviations)} if timed else {}),
        "iso230.csv": tables.iso230_axis_table(deviations),
        "iso230_positions.csv": tables.iso230_position_table(deviations, results),
    }
    if with_fields:
        if not (folder / "fields.nc").is_file():
            raise ExportError(
                f"{folder}: there is no fields.nc in it, so that no fields.csv can be written; leave --fields out"
            )
        frames["fields.csv"] = tables.fields_table(folder)
    return {name: _frame_writer(frame) for name, frame in frames.items()}


def _frame_writer(frame: pd.DataFrame) -> Writer:
    return lambda path: frame.to_csv(path, index=False, float_format="%.6g", date_format="%Y-%m-%dT%H:%M:%S.%fZ")


def _text_writer(text: str) -> Writer:
    return lambda path: path.write_text(text, encoding="ascii")


def _write(out: Path, content: dict[str, Writer], *, overwrite: bool) -> tuple[Path, ...]:
    """Write files, or none where one of them exists and may not be replaced."""
    paths = {out / name: write for name, write in content.items()}
    there = [path.name for path in paths if path.exists()]
    if there and not overwrite:
        raise ExportError(
            f"{out}: {', '.join(there)} exists already; add --overwrite to replace it, or name another folder with --out"
        )
    return tuple(write_atomically(path, write) for path, write in paths.items())
