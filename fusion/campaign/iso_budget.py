"""The uncertainty budget of a campaign's ISO 230-2 values: what is stated, what was measured, what is assumed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from fusion.campaign.config import InterferometryTable
from interferometry.iso230 import Iso230Budget

Origin = Literal["stated", "assumed", "from the camera", "not of a rotary axis"]


@dataclass(frozen=True)
class StatedBudget:
    """A budget and where its entries come from.

    Attributes
    ----------
    budget : Iso230Budget
        Standard uncertainties.
    origins : mapping
        ``device``, ``alignment``, ``material_temperature`` and ``expansion_coefficient`` -> stated, assumed, or from the camera; and
        ``environmental_variation``, stated, where it is.
    """

    budget: Iso230Budget
    origins: Mapping[str, Origin]


def state_budget(table: InterferometryTable, *, camera_u_K: float | None = None) -> StatedBudget:
    """Return the budget of a campaign, the same for readings as recorded and for those that are compensated again.

    Parameters
    ----------
    table : InterferometryTable
        ``[interferometry]`` of the campaign with its ``[interferometry.uncertainty]``.
    camera_u_K : float, optional
        Standard uncertainty of the temperature that the camera measured in place of the probe, K; None: the probe.

    Returns
    -------
    StatedBudget
        What is stated nowhere has the assumed value of `interferometry.iso230.Iso230Budget`.
    """
    stated = table.uncertainty
    coefficient_u = stated.expansion_coefficient_ppm_per_K
    if coefficient_u is None:
        coefficient_u = table.expansion_coefficient_u_ppm_per_K
    given = {
        "device": ("device_ppm", stated.device_ppm),
        "alignment": ("alignment_ppm", stated.alignment_ppm),
        "material_temperature": ("material_temperature_K", stated.material_temperature_K),
        "expansion_coefficient": ("expansion_coefficient_ppm_per_K", coefficient_u),
    }
    origins: dict[str, Origin] = {name: "assumed" if value is None else "stated" for name, (_, value) in given.items()}
    known = {key: value for key, value in given.values() if value is not None}
    if camera_u_K is not None and stated.material_temperature_K is None:
        known["material_temperature_K"] = camera_u_K
        origins["material_temperature"] = "from the camera"
    if stated.environmental_variation_um is not None:
        known["environmental_variation_um"] = stated.environmental_variation_um
        origins["environmental_variation"] = "stated"
    nominal = table.expansion_coefficient_ppm_per_K
    return StatedBudget(Iso230Budget(**known, nominal_expansion_ppm_per_K=nominal), origins)


def material_by_cycle(deviations: xr.Dataset, environment: xr.Dataset | None) -> xr.DataArray | None:
    """Return the logged temperature of the material in the middle of each cycle, degC.

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``; sensors of the laser's own file are used where no log is given.
    environment : Dataset or None
        Log along ``time``; None where it was not logged.

    Returns
    -------
    (cycle) DataArray or None
        None where neither log nor file holds a temperature of the material.
    """
    numbers = deviations["cycle"].values
    if environment is not None:
        log = environment[["material_temperature"]].dropna("time")
        time = deviations["time"].values.astype("datetime64[ns]")
        if log.sizes["time"] == 0 or np.isnat(time).all():
            return None
        start = log["time"].values[0]
        log_s = (log["time"].values - start) / np.timedelta64(1, "s")
        readings_s = np.where(np.isnat(time), np.nan, (time - start) / np.timedelta64(1, "s"))
        timed = np.isfinite(readings_s).any(axis=(1, 2))
        middle_s = np.nanmean(readings_s[timed], axis=(1, 2))
        values = np.full(numbers.size, np.nan)
        values[timed] = np.interp(middle_s, log_s, log["material_temperature"].values)
    elif "material_temperature" in deviations and np.isfinite(deviations["material_temperature"]).any():
        values = np.full(numbers.size, float(deviations["material_temperature"].mean()))
    else:
        return None
    return xr.DataArray(values, dims="cycle", coords={"cycle": numbers})
