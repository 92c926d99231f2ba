"""Writers of deviations and environment: Renishaw .rtl and CSV, in the form that the readers expect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from interferometry.common import InterferometryError, check_dataset

#: Lines of the ENVIRONMENT block: key of the argument, label in the file, factor to the file's unit.
_ENVIRONMENT = (
    ("air_temperature_degC", "Air temp   ", 1.0),
    ("air_pressure_hPa", "Air press  ", 0.1),
    ("relative_humidity_percent", "Air humid  ", 1.0),
    ("material_temperature_degC", "Mat temp 1 ", 1.0),
    ("environment_factor_um", "Env factor ", 1.0),
    ("expansion_coefficient_ppm_per_K", "Exp coeff  ", 1.0),
)
_USER_TEXT = (
    ("machine", "Machine"),
    ("serial_number", "Serial No"),
    ("date", "Date"),
    ("by", "By"),
    ("axis", "Axis"),
    ("location", "Location"),
    ("title", "TITLE"),
)


def write_rtl(
    path: str | Path,
    deviations: xr.Dataset,
    *,
    environment: Mapping[str, tuple[float, float]] | None = None,
    start: np.datetime64 | None = None,
    end: np.datetime64 | None = None,
    user_text: Mapping[str, str] | None = None,
) -> None:
    """Write a Renishaw linear test: two runs per cycle, the negative one in measuring order, missing readings as -1e20.

    Parameters
    ----------
    path : str or pathlib.Path
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``. The file cannot hold the times of readings.
    environment : mapping of str to (float, float), optional
        Values at the start and the end of the test of any of air_temperature_degC, air_pressure_hPa, relative_humidity_percent,
        material_temperature_degC, environment_factor_um, expansion_coefficient_ppm_per_K.
    start, end : numpy.datetime64, optional
        UTC; None: time of the first and of the last reading.
    user_text : mapping of str to str, optional
        Any of machine, serial_number, date, by, axis, location, title.

    Raises
    ------
    InterferometryError
        An unknown name in ``environment`` or ``user_text``, or ``deviations`` do not keep their contract.

    Notes
    -----
    The layout is that of files of the instrument's own software (version 20.02); the air pressure is in kPa there.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from interferometry.deviations import build_deviations
    >>> from interferometry.io.readings import read_deviations
    >>> time = np.datetime64("2026-03-09T06:30") + np.array([[[0, 6], [20, 14]]], "timedelta64[s]")
    >>> test = build_deviations([1], [1, 2], [0.0, 100.0], np.array([[[0.1, 1.2], [0.5, 1.6]]]), time)
    >>> path = Path(tempfile.mkdtemp()) / "laser.rtl"
    >>> write_rtl(path, test, environment={"air_temperature_degC": (20.0, 20.5)}, user_text={"axis": "X"})
    >>> read_deviations(path)["deviation"].values.tolist()
    [[[0.1, 1.2], [0.5, 1.6]]]
    """
    deviations = check_dataset(deviations, "deviations")
    environment, user_text = environment or {}, user_text or {}
    _raise_if_unknown("environment", environment, [name for name, _, _ in _ENVIRONMENT])
    _raise_if_unknown("user_text", user_text, [name for name, _ in _USER_TEXT])
    position = deviations["position"].values
    lines = ["HEADER::", "File type  : rtl", "Owner      : Linear", "Version no : V20.02.01", ""]
    lines += ["TARGET DATA::", "Filetype  : ISO", f"Target-count: {position.size}", "Targets :"]
    lines += ["  ".join(f"{value:.6f}" for value in position[i : i + 5]) + " " for i in range(0, position.size, 5)]
    lines += ["Flags: 0 0 2 1", "", "USER-TEXT::"]
    lines += [f"{label}:{user_text.get(name, '')}" for name, label in _USER_TEXT]
    lines += ["", "RUNS::", f"Run-count:{2 * deviations.sizes['cycle']}", "", "DEVIATIONS::", "Run Target Data:"]
    # A run along falling positions is stored last target first.
    along = np.argsort(deviations["position"].values, kind="stable")
    values = np.nan_to_num(deviations["deviation"].values, nan=-1e20)
    for cycle in range(values.shape[0]):
        for direction, name in enumerate(deviations["direction"].values):
            order = along if name == "positive" else along[::-1]
            run = 2 * cycle + direction + 1
            lines += [f"{run:<3d} {i + 1:<4d} {values[cycle, direction, i]:10.4f}" for i in order]
    lines += ["", "ENVIRONMENT::"]
    for name, label, factor in _ENVIRONMENT:
        if name in environment:
            first, last = environment[name]
            lines.append(f"{label}: {first * factor:.8f} {last * factor:.8f} 0")
    lines += _test_times(deviations, start, end)
    lines += ["", "EOF::", ""]
    Path(path).write_text("\r\n".join(lines), encoding="latin-1", newline="")


def _raise_if_unknown(argument: str, given: Mapping[str, object], allowed: list[str]) -> None:
    unknown = sorted(set(given) - set(allowed))
    if unknown:
        raise InterferometryError(
            f"{argument}: {', '.join(unknown)} has no place in a .rtl; known are {', '.join(allowed)}"
        )


def _test_times(deviations: xr.Dataset, start: np.datetime64 | None, end: np.datetime64 | None) -> list[str]:
    times = deviations["time"].values
    times = times[~np.isnat(times)]
    if start is None or end is None:
        if times.size == 0:
            return []
        start, end = times.min() if start is None else start, times.max() if end is None else end
    first, last = (str(time.astype("datetime64[s]")).replace("T", " ") for time in (start, end))
    return [f'Date Time  : "{first}" "{last}"']


def write_deviations_csv(path: str | Path, deviations: xr.Dataset) -> None:
    """Write readings in measuring order as CSV, with the columns cycle, direction, target, position_mm, time, deviation_um."""
    cells = deviations[["deviation", "time", "position"]].to_dataframe().reset_index()
    readings = cells.dropna(subset=["deviation", "time"]).sort_values("time", kind="stable")
    table: dict[str, Any] = {
        **{name: readings[name].to_numpy() for name in ("cycle", "direction", "target")},
        "position_mm": [np.format_float_positional(value, trim="-") for value in readings["position"]],
        "time": _iso_utc(readings["time"].to_numpy()),
        "deviation_um": [f"{value:.4f}" for value in readings["deviation"]],
    }
    _write_csv(path, table)


def write_environment_csv(path: str | Path, environment: xr.Dataset) -> None:
    """Write air and material conditions as CSV, in the form that `read_environment` reads."""
    table = {"time": _iso_utc(environment["time"].values)}
    for column, *_ in _ENVIRONMENT[:4]:
        table[column] = [f"{value:.4f}" for value in environment[column.rpartition("_")[0]].values]
    _write_csv(path, table)


def _write_csv(path: str | Path, table: Mapping[str, Sequence[str] | np.ndarray]) -> None:
    pd.DataFrame(table).to_csv(path, index=False, encoding="utf-8", lineterminator="\n")


def _iso_utc(times: np.ndarray) -> list[str]:
    return [f"{time}+00:00" for time in times.astype("datetime64[ms]")]
