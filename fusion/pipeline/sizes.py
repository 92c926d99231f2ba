"""How much a campaign must hold for each analysis, and the notice that names what a small one would need."""

from __future__ import annotations

import xarray as xr

from fusion.campaign.inputs import counted
from fusion.products.results import Notice

#: Smallest test whose drift can be modelled and attributed: below, no cycle can be held out and no course be told from chance.
LEAST_CYCLES, LEAST_TARGETS, LEAST_FRAMES = 12, 3, 12


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
