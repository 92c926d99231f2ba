"""How much a campaign must hold for each analysis, and the notice that names what a small one would need."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.products.notices import counted
from fusion.products.results import Notice

#: Smallest test whose drift can be modelled and attributed: below, no cycle can be held out and no course be told from chance.
LEAST_CYCLES, LEAST_TARGETS, LEAST_FRAMES = 12, 3, 12
#: So many targets take part in the model of the drift at most: they share their drift, and the work grows with the cube of their number.
MOST_TARGETS = 64
#: So many values over the cycles are correlated with the field at most: memory and work grow with the square of their number and faster.
MOST_CYCLES = 500


def lacks_for_model(deviations: xr.Dataset) -> list[Notice]:
    """Return the notice that a test is too small for positions that stand out and for the closed loop; empty where it is not.

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.
    """
    cycles, targets = deviations.sizes["cycle"], deviations.sizes["target"]
    if cycles >= LEAST_CYCLES and targets >= LEAST_TARGETS:
        return []
    return [
        Notice(
            "too_small_for_model",
            f"{counted(cycles, 'cycle')} at {counted(targets, 'target')}: ISO 230-2, profile, scatter and drift are evaluated; positions "
            f"that stand out, causes of drift and closed loop need at least {LEAST_CYCLES} cycles (better 50) at {LEAST_TARGETS} targets.",
            f"Measure at least {LEAST_CYCLES} cycles, better 50, for the causes of the drift.",
        )
    ]


def choose_targets(deviations: xr.Dataset) -> tuple[xr.Dataset, list[Notice]]:
    """Return the readings that take part in the model of the drift: all, or those at some of very many targets, evenly chosen.

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``; or readings aligned with what was seen and logged.

    Returns
    -------
    Dataset
        The same, both ends of the axis among them.
    list of Notice
        What was left out; empty where nothing was.
    """
    count = deviations.sizes["target"]
    if count <= MOST_TARGETS:
        return deviations, []
    order = np.argsort(deviations["position"].values, kind="stable")
    chosen = np.sort(order[np.round(np.linspace(0, count - 1, MOST_TARGETS)).astype(int)])
    return deviations.isel(target=chosen), [
        Notice(
            "targets_chosen",
            f"Positions that stand out and the closed loop use {MOST_TARGETS} of the {count} positions, evenly spread with both ends, "
            "which know the drift as well; ISO 230-2, profile, scatter and drift use all.",
            "",
        )
    ]


def average_cycles(fused: xr.Dataset, field: xr.DataArray) -> tuple[xr.Dataset, xr.DataArray, list[Notice]]:
    """Return readings and field as they are correlated: as they are, or means of successive cycles and frames of a very long test.

    Parameters
    ----------
    fused : Dataset
        ``deviation`` (um) and ``time`` over cycle, direction and target, and ``position`` (mm) over target.
    field : (time, y, x) DataArray
        Field of every frame.

    Returns
    -------
    Dataset, DataArray
        Means of so many cycles that at most :data:`MOST_CYCLES` are left, each at the mean time of its readings, and of as many frames as
        were taken in them.
    list of Notice
        What was averaged; empty where nothing was.
    """
    cycles, frames = fused.sizes["cycle"], field.sizes["time"]
    together = int(np.ceil(cycles / MOST_CYCLES))
    if together == 1:
        return fused, field, []
    start = field["time"].values[0]
    present = fused["deviation"].notnull() & fused["time"].notnull()
    seconds = ((fused["time"] - start) / np.timedelta64(1, "s")).where(present)
    means = xr.Dataset({"deviation": fused["deviation"].where(present), "seconds": seconds})
    means = means.coarsen(cycle=together, boundary="trim").mean()
    milliseconds = (1000.0 * means["seconds"]).round().fillna(0.0)
    time = (start + milliseconds.astype(np.int64).astype("timedelta64[ms]")).where(means["seconds"].notnull())
    averaged = means.drop_vars("seconds").assign(time=time.astype("datetime64[ns]"), position=fused["position"])
    averaged["deviation"].attrs = fused["deviation"].attrs
    at_once = max(1, frames * together // cycles)
    of_frames = field if at_once == 1 else field.coarsen(time=at_once, boundary="trim").mean()
    return (
        averaged.assign_coords(cycle=averaged["cycle"].astype(int)),
        of_frames,
        [
            Notice(
                "cycles_averaged",
                f"Field and drift are correlated by means of {together} successive cycles ({averaged.sizes['cycle']} of {cycles}): a part "
                "that responds within less is seen as one that responds at once.",
                "",
            )
        ],
    )


def lacks_for_correlation(fields: xr.Dataset) -> list[Notice]:
    """Return the notice that a test is too small for drift and field to be compared; empty where it is not.

    Parameters
    ----------
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``.
    """
    frames = fields.sizes["time"]
    if frames >= LEAST_FRAMES:
        return []
    return [
        Notice(
            "too_few_frames",
            f"{counted(frames, 'frame')}: fields and hotspots are evaluated; which part of the field goes with the drift needs at least "
            f"{LEAST_FRAMES} frames.",
            "Take a frame in every cycle, or once a minute.",
        )
    ]
