"""Tables of a run for other programs: readings with drift, profile, ISO 230-2 values, and the fields on request."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import xarray as xr

from fusion.products.contracts import read_product, require_kind
from fusion.products.grouped import group, has
from fusion.products.results import Results
from fusion.products.store import told_if_damaged
from fusion.report.findings import quoted_window
from interferometry import iso230
from thermography.fields.cycle_fields import plan_unit

#: Bytes of a row of fields.csv, measured on the demo.
_FIELD_ROW_BYTES = 38


def readings_table(deviations: xr.Dataset) -> pd.DataFrame:
    """Return every reading with its drift and the standard uncertainty of that; of readings without times, the readings alone.

    Parameters
    ----------
    deviations : Dataset
        Product ``deviations.nc``.
    """
    readings = xr.Dataset({"position_mm": deviations["position"], "deviation_um": deviations["deviation"]})
    if has(deviations, "drift"):
        drift = group(deviations, "drift")
        readings = xr.Dataset(
            {
                "position_mm": deviations["position"],
                "time_utc": deviations["time"],
                "deviation_um": deviations["deviation"],
                "drift_um": drift["drift"],
                "drift_u_um": drift["drift_u"],
            }
        )
    return readings.to_dataframe().dropna(subset=["deviation_um"]).reset_index()


def profile_table(deviations: xr.Dataset) -> pd.DataFrame:
    """Return the drift-free profile and the scatter per approach and target.

    Parameters
    ----------
    deviations : Dataset
        Product ``deviations.nc``.
    """
    drift = group(deviations, "drift")
    profile = xr.Dataset(
        {
            "position_mm": deviations["position"],
            "profile_um": drift["profile"],
            "profile_u_um": drift["profile_u"],
            "scatter_um": drift["scatter"],
        }
    )
    return profile.to_dataframe().reset_index()


def iso230_axis_table(deviations: xr.Dataset) -> pd.DataFrame:
    """Return the axis values of every window of cycles with their standard uncertainty, um.

    Parameters
    ----------
    deviations : Dataset
        Product ``deviations.nc``.
    """
    windows = group(deviations, "iso")
    rows = []
    for name in (*iso230.QUANTITIES, "mean_reversal", "E_unidirectional", "R_unidirectional", "A_unidirectional"):
        if name not in windows:
            continue
        frame = xr.Dataset({"value_um": windows[name], "u_um": windows[f"{name}_u"]}).to_dataframe().reset_index()
        rows.append(frame.assign(quantity=name.removesuffix("_unidirectional")))
    table = pd.concat(rows, ignore_index=True)
    table["direction"] = table["direction"].fillna("both") if "direction" in table else "both"
    return table[["window", "quantity", "direction", "value_um", "u_um"]]


def iso230_position_table(deviations: xr.Dataset, results: Results) -> pd.DataFrame:
    """Return mean, standard deviation, reversal and repeatability per target in the window whose values are quoted, um.

    Parameters
    ----------
    deviations : Dataset
        Product ``deviations.nc``.
    results : Results
        Results of the run; the window that it quotes is evaluated and named in the last column.
    """
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
    return xr.Dataset(columns).to_dataframe().reset_index().assign(window=evaluated.attrs["window"])


def fields_table(folder: Path) -> pd.DataFrame:
    """Return temperature and rise per cycle and cell that was seen.

    Parameters
    ----------
    folder : Path
        Results folder with ``fields.nc``.
    """
    fields = read_product(folder, "fields")
    frame = fields[["temperature", "temperature_rise", "temperature_rise_u"]].to_dataframe().dropna().reset_index()
    names = {"temperature": "temperature_degC", "temperature_rise": "rise_K", "temperature_rise_u": "rise_u_K"}
    unit = plan_unit(fields)
    return frame.rename(columns={"x": f"x_{unit}", "y": f"y_{unit}", **names})


def fields_megabytes(folder: Path) -> float | None:
    """Return about how large fields.csv would be, MB; None where there are no fields.

    Parameters
    ----------
    folder : Path
        Results folder.
    """
    path = folder / "fields.nc"
    if not path.is_file():
        return None
    with told_if_damaged(path), xr.open_dataset(path, engine="h5netcdf", decode_timedelta=False) as fields:
        return require_kind(fields, "fields", path)["temperature"].size * _FIELD_ROW_BYTES / 1e6


def _cycles_of(window: str, deviations: xr.Dataset) -> list[int] | None:
    """Return the cycles between the two numbers that a window's name begins with; None, all of them, where it names none."""
    ends = [int(text) for text in re.findall(r"\d+", window)[:2]]
    measured = deviations["cycle"].values.tolist()
    return [cycle for cycle in measured if ends[0] <= cycle <= ends[1]] or None if len(ends) == 2 else None
