"""Campaigns of the twin as fields and logs, without files, and the lies that are told with them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import xarray as xr

from fusion.analysis.alignment.align import AxisGeometry, align
from fusion.analysis.alignment.readings import Readings, read_fused
from fusion.twin import simulate
from fusion.twin.recipe import EffectRecipe, Recipe
from fusion.twin.simulate import PROBE_MM, driver_log, environment_log
from fusion.twin.truth import deviations_of, fields_of

#: Plan point of the material sensor of the twin, mm.
SENSOR_MM = PROBE_MM


@dataclass(frozen=True)
class Recorded:
    """What the instruments of one campaign recorded."""

    axis: AxisGeometry
    deviations: xr.Dataset
    fields: xr.Dataset
    environment: xr.Dataset
    drivers: xr.Dataset

    def readings(self) -> Readings:
        """Both recordings on one clock."""
        return read_fused(
            align(self.deviations, self.fields, self.axis, environment=self.environment, drivers=self.drivers)
        )


@cache
def recorded(seed: int = 5, *, cycles: int = 60, duty: str = "random", effect: str = "") -> Recorded:
    """A sound campaign with a varying load, and an undeclared effect where one is named."""
    recipe = Recipe().vary(
        campaign={"seed": seed},
        test={"cycles": cycles, "targets": 16},
        duty={"kind": duty, "mean_hold_min": 20.0},
        laser={"noise_um": 0.2},
        effect=(EffectRecipe(effect, 0.8),) if effect else (),
    )
    truth = simulate(recipe)
    axis = AxisGeometry(tuple(recipe.plan.origin_mm), tuple(recipe.plan.direction))
    return Recorded(
        axis, deviations_of(truth), fields_of(truth, cell_size_mm=10.0), environment_log(truth), driver_log(truth)
    )


def late(dataset: xr.Dataset, minutes: float) -> xr.Dataset:
    """The same on a clock that is late."""
    return dataset.assign_coords(time=dataset["time"] + np.timedelta64(round(60.0 * minutes), "s"))


def scaled(fields: xr.Dataset, factor: float) -> xr.Dataset:
    """Fields whose rise is wrong by a factor, as by a wrong emissivity."""
    first = fields["frame_temperature"].isel(time=0)
    return fields.assign(frame_temperature=factor * (fields["frame_temperature"] - first) + first)
