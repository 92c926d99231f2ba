"""A test by ISO 230-2 by itself: its page, its tables for the terminal, and its values for programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rich.table
import xarray as xr

from fusion.errors import FusionError
from fusion.products.grouped import group
from fusion.products.results_axis import Iso230Part
from fusion.products.store import write_text
from fusion.report.charts.embedding import embed
from fusion.report.charts.iso230 import plot_single_runs, plot_test
from fusion.report.charts.readings import plot_windows
from fusion.report.charts.style import Chart
from fusion.report.iso230_section import describe_iso230, single_run_table
from fusion.report.page import render_page
from fusion.report.pdf import print_pdf
from fusion.report.tables import Table, print_table
from fusion.report.wording import print_unit


class Iso230PageError(FusionError):
    """A test whose page or values cannot be written; the message says why."""


#: A test of one cycle has no scatter.
NO_SCATTER = (
    "One cycle: a standard deviation s is not possible, and with it neither R nor A nor any uncertainty of sampling. These are the single "
    "deviations; ISO 230-2 asks for five cycles."
)


def draw_iso230(part: Iso230Part | None, dataset: xr.Dataset) -> dict[str, Chart]:
    """Return the charts of the section on ISO 230-2, by name.

    Parameters
    ----------
    part : Iso230Part or None
        None of a test of one cycle.
    dataset : Dataset
        Readings with the groups ``settled`` and ``iso``.
    """
    if part is None:
        return {"iso230": plot_single_runs(dataset)}
    charts = {"iso230": plot_test(group(dataset, "settled"), dataset["position"])}
    windows = group(dataset, "iso")
    return charts if windows.sizes["window"] < 3 else {**charts, "windows": plot_windows(windows)}


def render_iso230(
    title: str, part: Iso230Part | None, dataset: xr.Dataset, *, remarks: tuple[str, ...], versions: Mapping[str, str]
) -> str:
    """Return the page of a test as HTML text.

    Parameters
    ----------
    title : str
        Title of the campaign, or name of the file.
    part : Iso230Part or None
        None of a test of one cycle.
    dataset : Dataset
        Readings with the groups ``settled`` and ``iso``.
    remarks : tuple of str
        What was left out or assumed when the file was read.
    versions : mapping
        ``thermofuse`` and its version.

    Raises
    ------
    Iso230PageError
        If the axis is a rotary one.
    """
    _refuse_angles(dataset, "page")
    standard = None if part is None else describe_iso230(part, dataset)
    single = single_run_table(dataset) if part is None else None
    return render_page(
        "iso230.html.j2",
        embed(draw_iso230(part, dataset)),
        title=title,
        summary={"iso230": standard, "premises": {"iso230": ""}},
        single=single,
        no_scatter=NO_SCATTER,
        remarks=remarks,
        versions=versions,
    )


def write_iso230(path: Path, page: str) -> None:
    """Write the page of a test; nothing is replaced.

    Parameters
    ----------
    path : Path
        A file that does not exist yet and ends with ``.html``, or with ``.pdf``: an installed browser prints it then.
    page : str
        HTML text.

    Raises
    ------
    Iso230PageError
        If the file exists, or has another ending.
    PrintError
        If it cannot be printed.
    """
    if path.exists():
        raise Iso230PageError(f"{path} exists already; name another file with --out, or remove it")
    if path.suffix.lower() not in (".html", ".htm", ".pdf"):
        raise Iso230PageError(f"{path}: the sheet is written as .html or .pdf; name such a file with --out")
    if path.suffix.lower() == ".pdf":
        print_pdf(page, path)
    else:
        write_text(path, page)


def iso230_tables(part: Iso230Part | None, dataset: xr.Dataset, *, title: str) -> list[rich.table.Table]:
    """Return the tables of a test for the terminal.

    Parameters
    ----------
    part : Iso230Part or None
        None of a test of one cycle.
    dataset : Dataset
        Readings with the group ``settled``.
    title : str
        Above the first table.
    """
    if part is None:
        return [print_table(single_run_table(dataset), title)]
    told = describe_iso230(part, dataset, unit=print_unit(dataset["deviation"].attrs["units"]))
    shown: list[tuple[str, Table | None]] = [
        (f"{title}, {told['window']}", told["axis"]),
        ("per target position", told["positions"]),
        ("uncertainty budget", told["budget"]),
        ("tolerances", told["tolerances"]),
    ]
    return [print_table(found, name) for name, found in shown if found is not None]


def iso230_json(part: Iso230Part | None, dataset: xr.Dataset) -> dict[str, Any]:
    """Return the values of a test for programs: the part ``iso230`` of results.json, and the values per target.

    Parameters
    ----------
    part : Iso230Part or None
        None of a test of one cycle, of which the readings alone are returned.
    dataset : Dataset
        Readings with the group ``settled``.

    Raises
    ------
    Iso230PageError
        If the axis is a rotary one.
    """
    _refuse_angles(dataset, "JSON")
    rows = _rows(part, dataset)
    return {"targets": rows} if part is None else {**part.model_dump(mode="json"), "targets": rows}


def _refuse_angles(dataset: xr.Dataset, kind: str) -> None:
    """Refuse a rotary axis where the names of the values carry the units of a linear one."""
    if dataset["deviation"].attrs["units"] == "arcsec":
        raise Iso230PageError(
            f"the axis is a rotary one, whose {kind} is not written: its units are those of lengths; use the tables, or --csv"
        )


def iso230_csv(part: Iso230Part | None, dataset: xr.Dataset) -> str:
    """Return the values per target as CSV text, one line per target.

    Parameters
    ----------
    part, dataset
        See `iso230_json`.
    """
    rows = _rows(part, dataset)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _rows(part: Iso230Part | None, dataset: xr.Dataset) -> list[dict[str, Any]]:
    """Return the values of each target; headings carry the units of the dataset."""
    unit, place = dataset["deviation"].attrs["units"], dataset["position"].attrs["units"]
    settled = None if part is None else group(dataset, "settled")
    rows = []
    for target in dataset["target"].values:
        row: dict[str, Any] = {
            "target": int(target),
            f"position_{place}": float(dataset["position"].sel(target=target)),
        }
        for direction in dataset["direction"].values:
            if settled is None:
                reading = dataset["deviation"].sel(target=target, direction=direction).values
                row |= {f"deviation_{direction}_{unit}": _finite(float(reading[0]))}
                continue
            here = settled.sel(target=target, direction=direction)
            row |= {
                f"mean_{direction}_{unit}": _finite(float(here["mean_unidirectional"])),
                f"s_{direction}_{unit}": _finite(float(here["standard_deviation"])),
                f"R_{direction}_{unit}": _finite(float(here["repeatability"])),
                f"readings_{direction}": int(here["count"]),
            }
        if settled is not None:
            here = settled.sel(target=target)
            row |= {
                f"mean_{unit}": _finite(float(here["mean_bidirectional"])),
                f"B_i_{unit}": _finite(float(here["reversal"])),
                f"R_i_{unit}": _finite(float(here["repeatability_bidirectional"])),
            }
        rows.append(row)
    return rows


def _finite(value: float) -> float | None:
    return value if value == value else None
