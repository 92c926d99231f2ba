"""Exports: drift and fields as CSV, the drift-free profile as the compensation table of a control.

A table corrects the profile at the mean thermal state of the test, relative to the first position, so that nothing jumps where the
axis is referenced. It must not be loaded on top of a table that was active during the test: the measured deviations are what that
table left. Signs follow each control's documentation and are stated in the file; try a small value on the machine first.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from fusion.errors import FusionError
from fusion.products.grouped import group
from fusion.products.store import read_dataset, write_atomically, write_text

#: Maximum number of points per joint that LinuxCNC reads.
_LINUXCNC_POINTS = 256
_SPACING_TOLERANCE_MM = 1e-3


class ExportError(FusionError):
    """Results that cannot be exported in the format asked for; the message says why and what to do."""


def export_results(results: Path, format: str, out: Path) -> list[Path]:
    """Write drift, profile and fields as CSV, or the drift-free profile as the compensation table of a control.

    Parameters
    ----------
    results : Path
        Folder of a finished run.
    format : {"csv", "linuxcnc", "siemens840d", "heidenhain", "renishaw"}
        Tables, or a control.
    out : Path
        Folder for the files; created where it is absent.

    Returns
    -------
    list of Path
        Written files: ``drift.csv``, ``profile.csv`` and, with thermograms, ``fields.csv``; or one compensation table.

    Raises
    ------
    ExportError
        If the folder holds no results, or the positions do not suit the control.

    Notes
    -----
    Positions are in mm, the profile in um (CSV) or mm (controls), relative to the first position and positive approach. Formats and
    signs: LinuxCNC ``COMP_FILE_TYPE 0``; Siemens 840D ``$AA_ENC_COMP``, added to the actual value; Heidenhain ``.COM``.

    Examples
    --------
    >>> from pathlib import Path
    >>> export_results(Path("results"), "csv", Path("results/export"))  # doctest: +SKIP
    """
    source = results / "deviations.nc"
    if not source.is_file():
        raise ExportError(f"{results}: there is no deviations.nc in it; name the results folder of a finished run")
    deviations = read_dataset(source)
    if format == "csv":
        return _write_tables(results, deviations, out)
    write, suffix = _CONTROLS[format]
    return [write_text(out / f"compensation.{suffix}", write(_profile_table(deviations)))]


def _profile_table(deviations: xr.Dataset) -> pd.DataFrame:
    """Return position (mm) and profile per approach (mm), relative to the first position, sorted by position.

    Raises
    ------
    ExportError
        If an approach was not measured at a position.
    """
    profile = group(deviations, "drift")["profile"] * 1e-3
    order = np.argsort(deviations["position"].values)
    table = pd.DataFrame(
        {
            "position": deviations["position"].values[order],
            "positive": profile.sel(direction="positive").values[order],
            "negative": profile.sel(direction="negative").values[order],
        }
    )
    gaps = table[table.isna().any(axis=1)]
    if len(gaps):
        raise ExportError(
            f"no profile at {gaps['position'].iloc[0]:g} mm in one approach; a compensation table needs both"
        )
    table[["positive", "negative"]] -= table["positive"].iloc[0]
    return table


def linuxcnc(table: pd.DataFrame) -> str:
    """Return a COMP_FILE of type 0: triplets of nominal, and true position by the forward and by the reverse approach, in mm.

    Parameters
    ----------
    table : DataFrame
        ``position``, ``positive`` and ``negative`` (profile by approach), mm.
    """
    if len(table) > _LINUXCNC_POINTS:
        raise ExportError(f"{len(table)} positions; LinuxCNC reads at most {_LINUXCNC_POINTS} per joint, measure fewer")
    rows = [f"{place:.4f} {place + forward:.6f} {place + reverse:.6f}" for place, forward, reverse in _rows(table)]
    return "\n".join(rows) + "\n"


def siemens840d(table: pd.DataFrame, axis: str = "AX1") -> str:
    """Return an $AA_ENC_COMP archive in mm; the value is added to the actual position, so that a positive one moves the axis back.

    The control knows one table per encoder: the mean of both approaches goes in, half the difference is left to backlash.

    Parameters
    ----------
    table : DataFrame
        ``position``, ``positive`` and ``negative`` (profile by approach), mm.
    axis : str
        Axis identifier of the control.
    """
    step = _spacing(table, "Siemens 840D")
    mean = (table["positive"] + table["negative"]) / 2
    mean = mean - mean.iloc[0]
    backlash = (table["positive"] - table["negative"]).mean()
    lines = [
        "%_N_AX1_EEC_INI",
        f"; mean profile of both approaches; mean reversal {backlash:.5f} mm belongs into MD32450 BACKLASH",
        f"CHANDATA(1)\n$AA_ENC_COMP_STEP[0,{axis}]={step:.4f}",
        f"$AA_ENC_COMP_MIN[0,{axis}]={table['position'].iloc[0]:.4f}",
        f"$AA_ENC_COMP_MAX[0,{axis}]={table['position'].iloc[-1]:.4f}",
        f"$AA_ENC_COMP_IS_MODULO[0,{axis}]=0",
        *(f"$AA_ENC_COMP[0,{number},{axis}]={value:.6f}" for number, value in enumerate(mean)),
        "M17",
    ]
    return "\n".join(lines) + "\n"


def heidenhain(table: pd.DataFrame) -> str:
    """Return a compensation table AXIS-X.COM: measured deviation (mm) of the forward approach and reversal at equal distances.

    Parameters
    ----------
    table : DataFrame
        ``position``, ``positive`` and ``negative`` (profile by approach), mm.
    """
    step = _spacing(table, "Heidenhain")
    start = table["position"].iloc[0]
    head = f"BEGIN AXIS-X.COM DATUM:{start:+.4f} DISTANCE:{step:+.4f}"
    rows = [
        f"{number} {forward:+.6f} {forward - reverse:+.6f}" for number, (_, forward, reverse) in enumerate(_rows(table))
    ]
    return "\n".join([head, "NR X BACKLASH", *rows, "[END]"]) + "\n"


def renishaw(table: pd.DataFrame) -> str:
    """Return a table of error values (um) with its spacing, start and end (mm), forward and reverse.

    Parameters
    ----------
    table : DataFrame
        ``position``, ``positive`` and ``negative`` (profile by approach), mm.
    """
    step = _spacing(table, "Renishaw")
    lines = [
        f"Compensation start {table['position'].iloc[0]:.4f}",
        f"Compensation end {table['position'].iloc[-1]:.4f}",
        f"Compensation spacing {step:.4f}",
        "No. Position Forward Reverse",
        *(
            f"{at} {place:.4f} {forward * 1e3:.3f} {reverse * 1e3:.3f}"
            for at, (place, forward, reverse) in enumerate(_rows(table), start=1)
        ),
    ]
    return "\n".join(lines) + "\n"


_CONTROLS: dict[str, tuple[Callable[[pd.DataFrame], str], str]] = {
    "linuxcnc": (linuxcnc, "comp"),
    "siemens840d": (siemens840d, "MPF"),
    "heidenhain": (heidenhain, "com"),
    "renishaw": (renishaw, "ren"),
}


def _rows(table: pd.DataFrame) -> list[tuple[float, float, float]]:
    """Return position and profile by the forward and the reverse approach, mm, as plain numbers."""
    columns = [table[name].to_numpy(dtype=float).tolist() for name in ("position", "positive", "negative")]
    return list(zip(*columns, strict=True))


def _spacing(table: pd.DataFrame, control: str) -> float:
    """Return the distance of the positions, refusing unequal ones."""
    steps = np.diff(table["position"])
    if np.ptp(steps) > _SPACING_TOLERANCE_MM:
        raise ExportError(
            f"{control} needs equally spaced positions; these are {steps.min():g} to {steps.max():g} mm apart, "
            "use the format linuxcnc or csv, or measure at equal distances"
        )
    return float(steps.mean())


def _write_tables(results: Path, deviations: xr.Dataset, out: Path) -> list[Path]:
    """Write drift per reading, profile per position, and the fields per cycle as CSV."""
    drift = group(deviations, "drift")
    readings = xr.Dataset(
        {
            "position_mm": deviations["position"],
            "time_utc": deviations["time"],
            "deviation_um": deviations["deviation"],
            "drift_um": drift["drift"],
            "drift_u_um": drift["drift_u"],
        }
    ).to_dataframe()
    profile = xr.Dataset(
        {
            "position_mm": deviations["position"],
            "profile_um": drift["profile"],
            "profile_u_um": drift["profile_u"],
            "scatter_um": drift["scatter"],
        }
    ).to_dataframe()
    written = [
        _write_csv(out / "drift.csv", readings.dropna(subset=["deviation_um"])),
        _write_csv(out / "profile.csv", profile),
    ]
    if (results / "fields.nc").is_file():
        fields = read_dataset(results / "fields.nc")
        frame = fields[["temperature", "temperature_rise", "temperature_rise_u"]].to_dataframe().dropna()
        names = {"temperature": "temperature_degC", "temperature_rise": "rise_K", "temperature_rise_u": "rise_u_K"}
        written.append(_write_csv(out / "fields.csv", frame.rename(columns=names)))
    return written


def _write_csv(path: Path, frame: pd.DataFrame) -> Path:
    return write_atomically(
        path, lambda temporary: frame.to_csv(temporary, float_format="%.6g", date_format="%Y-%m-%dT%H:%M:%S.%fZ")
    )
