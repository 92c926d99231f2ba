"""L2 - Why a reading is missing or doubtful: a small registry of flags, and the detectors that set them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr


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
