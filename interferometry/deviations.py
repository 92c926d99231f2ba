"""The Dataset of deviations: built from plain arrays, and laid out as one series in measuring order.

Why a reading is missing or doubtful: a small registry of flags, and the detectors that set them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

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
    missing = np.where(np.isnan(deviation_um), np.uint8(MISSING.mask), np.uint8(0))
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
            "quality_flag": (DIMS, missing, flag_attributes()),
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


@dataclass(frozen=True)
class Flag:
    """One bit of ``quality_flag``: its mask, its name and one sentence of meaning."""

    mask: int
    name: str
    meaning: str


MISSING = Flag(1, "missing", "The file holds no reading for this cycle, direction and target.")
UNREADABLE = Flag(
    2, "unreadable", "The file holds a line for it whose value, time, target or direction cannot be used."
)
DUPLICATE = Flag(4, "duplicate", "The file holds this reading more than once; the first one is kept.")
OUT_OF_ORDER = Flag(
    8, "out_of_order", "Its time does not lie in its pass between the readings of the neighbouring targets."
)
OUTLIER = Flag(16, "outlier", "It lies so far from the joint estimate that it was given little weight or none.")

#: Every flag, in the order of the bits.
REGISTRY: tuple[Flag, ...] = (MISSING, UNREADABLE, DUPLICATE, OUT_OF_ORDER, OUTLIER)


def flag_attributes() -> dict[str, object]:
    """Return the CF attributes that explain ``quality_flag``."""
    return {
        "units": "1",
        "standard_name": "quality_flag",
        "long_name": "why the reading is missing or doubtful",
        "flag_masks": np.array([flag.mask for flag in REGISTRY], dtype="u1"),
        "flag_meanings": " ".join(flag.name for flag in REGISTRY),
    }


def set_flag(deviations: xr.Dataset, flag: Flag, where: np.ndarray) -> xr.Dataset:
    """Return a copy with one flag set where a mask is true.

    Parameters
    ----------
    deviations : xarray.Dataset
        Deviations that keep ``contract.DEVIATIONS``.
    flag : Flag
        A record of the registry.
    where : (cycle, direction, target) bool ndarray
        True where the flag applies; elsewhere the bits stay as they are.
    """
    marked = deviations.copy()
    bits = deviations["quality_flag"].values | np.where(where, np.uint8(flag.mask), np.uint8(0))
    marked["quality_flag"] = (deviations["quality_flag"].dims, bits.astype("u1"), deviations["quality_flag"].attrs)
    return marked


def count_flags(deviations: xr.Dataset) -> dict[str, int]:
    """Return how many readings carry each flag, by the flag's name."""
    bits = deviations["quality_flag"].values
    return {flag.name: int(np.count_nonzero(bits & flag.mask)) for flag in REGISTRY}


def detect_out_of_order(deviations: xr.Dataset) -> np.ndarray:
    """Return True where a reading's time breaks the order of its pass.

    Along the positive direction times grow with position, along the negative one they fall. Order is judged against the longest
    run of readings in order, so that one wrong time marks itself and not its neighbours.

    Returns
    -------
    (cycle, direction, target) bool ndarray
    """
    along = np.argsort(deviations["position"].values, kind="stable")
    seconds = deviations["time"].values.astype("datetime64[ns]").astype("i8")
    known = ~np.isnat(deviations["time"].values)
    marked = np.zeros(known.shape, dtype=bool)
    for cycle in range(known.shape[0]):
        for direction, name in enumerate(deviations["direction"].values):
            order = along if name == "positive" else along[::-1]
            order = order[known[cycle, direction, order]]
            kept = _longest_increasing(seconds[cycle, direction, order])
            marked[cycle, direction, order] = ~kept
    return marked


def _longest_increasing(values: np.ndarray) -> np.ndarray:
    """Return a mask of one longest non-decreasing subsequence (quadratic: a pass holds some tens of readings)."""
    if values.size < 2 or np.all(np.diff(values) >= 0):
        return np.ones(values.size, dtype=bool)
    length = np.ones(values.size, dtype=int)
    before = np.full(values.size, -1)
    for i in range(1, values.size):
        earlier = np.flatnonzero(values[:i] <= values[i])
        if earlier.size:
            best = earlier[np.argmax(length[earlier])]
            length[i], before[i] = length[best] + 1, best
    kept = np.zeros(values.size, dtype=bool)
    at = int(np.argmax(length))
    while at >= 0:
        kept[at] = True
        at = int(before[at])
    return kept
