"""L0 - The Dataset of deviations: built from plain arrays, and laid out as one series in measuring order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from interferometry import flags

DIMS = ("cycle", "direction", "target")
DIRECTIONS = ("positive", "negative")


def build_deviations(
    cycles: Sequence[int], targets: Sequence[int], position_mm: np.ndarray, deviation_um: np.ndarray, time: np.ndarray
) -> xr.Dataset:
    """Return a Dataset that keeps ``contract.DEVIATIONS`` from plain arrays.

    Parameters
    ----------
    cycles, targets : sequences of int
        Numbers from 1.
    position_mm : (target,) ndarray
        Programmed positions.
    deviation_um : (cycle, direction, target) ndarray
        Measured minus programmed position; NaN where there is no reading. Directions are positive, negative.
    time : (cycle, direction, target) datetime64 ndarray
        UTC; NaT where there is no reading or no time.
    """
    missing = np.where(np.isnan(deviation_um), np.uint8(flags.MISSING.mask), np.uint8(0))
    return xr.Dataset(
        {
            "deviation": (
                DIMS,
                deviation_um.astype("f8"),
                {"units": "um", "long_name": "measured minus programmed position"},
            ),
            "time": (DIMS, time.astype("datetime64[ns]"), {"long_name": "time of the reading (UTC)"}),
            "position": (
                ("target",),
                np.asarray(position_mm, dtype="f8"),
                {"units": "mm", "long_name": "programmed position"},
            ),
            "quality_flag": (DIMS, missing, flags.flag_attributes()),
        },
        coords={"cycle": list(cycles), "direction": list(DIRECTIONS), "target": list(targets)},
    )


def sort_readings(deviations: xr.Dataset) -> xr.Dataset:
    """Return the readings as one series in the order in which they were measured.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.

    Returns
    -------
    xarray.Dataset
        Single dim "reading", sorted by time, missing readings left out: deviation (um), time (UTC), seconds (s since the first
        reading), cycle, target, sign (+1 positive, -1 negative), position (mm).
    """
    present = np.isfinite(deviations["deviation"].values) & ~np.isnat(deviations["time"].values)
    at_cycle, at_direction, at_target = np.nonzero(present)
    time = deviations["time"].values[present].astype("datetime64[ns]")
    order = np.argsort(time, kind="stable")
    time = time[order]
    seconds = (time - time[:1]) / np.timedelta64(1, "s") if time.size else np.empty(0)
    sign = np.where(deviations["direction"].values[at_direction[order]] == "positive", 1, -1)
    return xr.Dataset(
        {
            "deviation": (("reading",), deviations["deviation"].values[present][order], {"units": "um"}),
            "time": (("reading",), time),
            "seconds": (("reading",), seconds, {"units": "s"}),
            "cycle": (("reading",), deviations["cycle"].values[at_cycle[order]]),
            "target": (("reading",), deviations["target"].values[at_target[order]]),
            "sign": (("reading",), sign, {"units": "1"}),
            "position": (("reading",), deviations["position"].values[at_target[order]], {"units": "mm"}),
        }
    )
