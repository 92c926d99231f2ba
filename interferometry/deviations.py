"""The Dataset of positioning deviations: its flags, how it is built, and its readings in measuring order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from interferometry.common import DEVIATION_ATTRIBUTES, DIRECTIONS, Array, InterferometryError

DIMS = ("cycle", "direction", "target")


class Flag(NamedTuple):
    """One bit of ``quality_flag``: why a reading is missing or doubtful, with its name in the CF attribute ``flag_meanings``."""

    mask: int
    name: str


#: The file holds no reading for this cycle, direction and target.
MISSING = Flag(1, "missing")
#: The file holds a line for it whose value, time, target or direction cannot be used.
UNREADABLE = Flag(2, "unreadable")
#: The file holds this reading more than once; the first one is kept.
DUPLICATE = Flag(4, "duplicate")
#: Its time does not lie in its pass between the readings of the neighbouring targets.
OUT_OF_ORDER = Flag(8, "out_of_order")
#: It lies so far from the joint estimate that it was given little weight or none.
OUTLIER = Flag(16, "outlier")

#: Every flag, in the order of the bits.
REGISTRY: tuple[Flag, ...] = (MISSING, UNREADABLE, DUPLICATE, OUT_OF_ORDER, OUTLIER)

#: Share of a step by which a difference may miss a multiple of it: numbers in other units are rounded once more.
_OFF_STEP = 1e-3
#: Standard deviation of the rounding to steps of 1 (GUM F.2.2.1).
ROUNDING = 1.0 / np.sqrt(12.0)


def build_deviations(
    cycles: Sequence[int], targets: Sequence[int], position_mm: ArrayLike, deviation_um: ArrayLike, time: ArrayLike
) -> xr.Dataset:
    """Build the Dataset of positioning deviations from plain arrays.

    Parameters
    ----------
    cycles : (n_cycles,) sequence of int
        Numbers of the cycles, from 1.
    targets : (n_targets,) sequence of int
        Numbers of the target positions, from 1.
    position_mm : (n_targets,) array_like
        Target positions, mm.
    deviation_um : (n_cycles, 2, n_targets) array_like
        Positioning deviations x_ij, actual minus target position (ISO 230-2), um; first the positive, then the negative
        direction of approach; NaN where there is no reading.
    time : (n_cycles, 2, n_targets) array_like of datetime64
        UTC; NaT where there is no reading or no time.

    Returns
    -------
    xarray.Dataset
        Keeps ``contract.DEVIATIONS``: ``deviation`` (um), ``time`` (UTC) and ``quality_flag`` (cycle, direction, target), ``position``
        (mm; target). Missing readings are flagged. ``resolution`` (um) is the step in which the readings were recorded, 0 where none shows.

    Raises
    ------
    InterferometryError
        An array does not have the shape that the numbers of cycles and targets give, a number of cycle or target or a position comes twice,
        or a value is no number or infinite.

    Notes
    -----
    Target positions, directions of approach and deviations as in ISO 230-2:2014, clause 3.

    Examples
    --------
    >>> import numpy as np
    >>> deviation = np.array([[[0.0, 1.0], [0.5, np.nan]]])
    >>> time = np.datetime64("2026-03-09T06:30") + np.array([[[0, 6], [20, 14]]], "timedelta64[s]")
    >>> test = build_deviations([1], [1, 2], np.array([0.0, 100.0]), deviation, time)
    >>> test["deviation"].sel(cycle=1, direction="negative").values.tolist()
    [0.5, nan]
    >>> test["quality_flag"].values.tolist()
    [[[0, 0], [0, 1]]]
    """
    cells = (len(cycles), len(DIRECTIONS), len(targets))
    position_mm, deviation_um = _numbers("position_mm", position_mm), _numbers("deviation_um", deviation_um)
    time = np.asarray(time, "datetime64[ns]")
    arrays = {"position_mm": (position_mm, cells[2:]), "deviation_um": (deviation_um, cells), "time": (time, cells)}
    for name, (values, shape) in arrays.items():
        if np.shape(values) != shape:
            raise InterferometryError(
                f"{name} has shape {np.shape(values)}; {len(cycles)} cycles, 2 directions and {len(targets)} targets need {shape}"
            )
    for name, numbers in (("cycles", cycles), ("targets", targets), ("position_mm", position_mm)):
        if np.unique(numbers).size < len(numbers):
            raise InterferometryError(f"{name} holds a value twice: {np.asarray(numbers).tolist()}; give each once")
    if np.isinf(deviation_um).any() or not np.isfinite(position_mm).all():
        raise InterferometryError(
            "position_mm and deviation_um must be finite; of a reading that is missing the deviation is NaN"
        )
    missing = np.where(np.isnan(deviation_um), np.uint8(MISSING.mask), np.uint8(0))
    flags = {
        "flag_masks": np.array([flag.mask for flag in REGISTRY], dtype="u1"),
        "flag_meanings": " ".join(flag.name for flag in REGISTRY),
    }
    described = DEVIATION_ATTRIBUTES
    return xr.Dataset(
        {
            "deviation": (DIMS, deviation_um, described["deviation"]),
            "time": (DIMS, time, described["time"]),
            "position": (("target",), position_mm, described["position"]),
            "quality_flag": (DIMS, missing, described["quality_flag"] | flags),
            "resolution": ((), resolution(deviation_um), described["resolution"]),
        },
        coords={"cycle": list(cycles), "direction": list(DIRECTIONS), "target": list(targets)},
    )


def _numbers(name: str, values: ArrayLike) -> Array:
    try:
        return np.array(values, dtype="f8")
    except (TypeError, ValueError):
        raise InterferometryError(
            f"{name} holds what is no number; give an array of floats, NaN where there is no reading"
        ) from None


def resolution(values: Array) -> float:
    """Return the step of which all differences of the values are multiples; 0 where none shows."""
    finite = values[np.isfinite(values)]
    steps = np.diff(np.unique(finite))
    # Sums of decimal fractions differ by rounding from one another.
    steps = steps[steps > 1e-9 * max(1.0, float(np.abs(finite).max(initial=0.0)))]
    if not steps.size:
        return 0.0
    multiples = steps / steps.min()
    return float(steps.min()) if np.abs(multiples - np.rint(multiples)).max() < _OFF_STEP else 0.0


def resolution_um(deviations: xr.Dataset) -> float:
    """Return the step in which readings were recorded, um; a correction since then does not change it. Of joined tests the coarsest."""
    stated = deviations.get("resolution")
    return resolution(deviations["deviation"].values) if stated is None else float(stated.max())


def set_flag(deviations: xr.Dataset, flag: Flag, where: np.ndarray) -> xr.Dataset:
    """Return a copy with one flag set where a mask is true."""
    marked = deviations.copy()
    bits = deviations["quality_flag"].values | np.where(where, np.uint8(flag.mask), np.uint8(0))
    marked["quality_flag"] = (deviations["quality_flag"].dims, bits.astype("u1"), deviations["quality_flag"].attrs)
    return marked


def sort_readings(deviations: xr.Dataset) -> xr.Dataset:
    """Return the readings as one series in the order in which they were measured."""
    present = np.isfinite(deviations["deviation"].values) & ~np.isnat(deviations["time"].values)
    cycle, direction, target = np.nonzero(present)
    time = deviations["time"].values[present].astype("datetime64[ns]")
    order = np.argsort(time, kind="stable")
    time = time[order]
    seconds = (time - time[:1]) / np.timedelta64(1, "s") if time.size else np.empty(0)
    sign = np.where(deviations["direction"].values[direction[order]] == "positive", 1, -1)
    return xr.Dataset(
        {
            "deviation": (("reading",), deviations["deviation"].values[present][order], {"units": "um"}),
            "time": (("reading",), time),
            "seconds": (("reading",), seconds, {"units": "s"}),
            "cycle": (("reading",), deviations["cycle"].values[cycle[order]]),
            "target": (("reading",), deviations["target"].values[target[order]]),
            "sign": (("reading",), sign, {"units": "1"}),
            "position": (("reading",), deviations["position"].values[target[order]], {"units": "mm"}),
            "resolution": ((), resolution_um(deviations), {"units": "um"}),
        }
    )


def detect_out_of_order(deviations: xr.Dataset) -> np.ndarray:
    """Find readings whose time breaks the order of their pass."""
    along = np.argsort(deviations["position"].values, kind="stable")
    nanoseconds = deviations["time"].values.astype("datetime64[ns]").astype("i8")
    has_time = ~np.isnat(deviations["time"].values)
    marked = np.zeros(has_time.shape, dtype=bool)
    for cycle in range(has_time.shape[0]):
        for direction, name in enumerate(deviations["direction"].values):
            order = along if name == "positive" else along[::-1]
            order = order[has_time[cycle, direction, order]]
            in_order = _longest_increasing(nanoseconds[cycle, direction, order])
            marked[cycle, direction, order] = ~in_order
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
    i = int(np.argmax(length))
    while i >= 0:
        kept[i] = True
        i = int(before[i])
    return kept
