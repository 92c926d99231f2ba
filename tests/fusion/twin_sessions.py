"""Sessions of the twin as the attribution and the diagnosis get them, without files in between."""

from __future__ import annotations

from dataclasses import dataclass

import xarray as xr

from fusion.analysis.alignment.align import AxisGeometry, align
from fusion.twin import simulate
from fusion.twin.instruments import deviations_of, fields_of
from fusion.twin.recipe import Recipe

#: Anomaly that is planted, and what the diagnosis must call it.
CAUSES = {
    "structural": "structural",
    "local_temperature": "local_temperature",
    "stick_slip": "stick_slip",
    "step": "step",
    "wander": "undetermined",
}


@dataclass(frozen=True)
class Flag:
    """An anomaly as the detection reports it."""

    target: int = 5
    direction: str = "both"


def session(seed: int, **tables) -> tuple[xr.Dataset, xr.DataArray]:
    """Fused readings and the film of a campaign of 100 cycles, cells of 20 mm."""
    recipe = Recipe().vary(campaign={"seed": seed}, test={"cycles": 100}, **tables)
    truth = simulate(recipe)
    fields = fields_of(truth, cell_size_mm=20.0)
    axis = AxisGeometry(recipe.plan.origin_mm, recipe.plan.direction)
    return align(deviations_of(truth), fields, axis), fields["frame_temperature"]
