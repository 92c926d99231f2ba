"""Campaigns of the twin as fields and logs, without files, and the lies that are told with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import xarray as xr

from fusion.analysis.alignment.align import AxisGeometry, align
from fusion.analysis.alignment.readings import Readings, read_fused
from fusion.analysis.consistency.camera import compare_phase
from fusion.analysis.consistency.checks import Inputs
from fusion.analysis.consistency.clocks import Evidence, Recording, compare_clocks
from fusion.analysis.consistency.courses import compare_drift, compare_load, compare_material
from fusion.analysis.consistency.series import Motion, field_at, thin_fields
from fusion.pipeline.consistency import Check, run_checks
from fusion.twin import simulate
from fusion.twin.instruments import deviations_of, fields_of
from fusion.twin.recipe import EffectRecipe, Recipe
from fusion.twin.simulate import PROBE_MM, driver_log, environment_log

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


#: Recordings of a campaign by the names of their checks: attribute, and file.
FILES = {
    "laser": ("deviations", "laser.csv"),
    "camera": ("fields", "the frames"),
    "environment": ("environment", "environment.csv"),
    "drivers": ("drivers", "drivers.csv"),
}


def clocks(test: Recorded, *, drift: bool = True) -> dict[str, Check]:
    """The checks of all clocks of a campaign; without the drift, which takes longest, where the others tell enough."""
    field = thin_fields(test.fields)
    compared = [
        *(compare_drift(test.readings()) if drift else []),
        *compare_phase(Motion.of(test.fields["time"].values, test.deviations)),
        *compare_material(field_at(test.fields, SENSOR_MM), test.environment),
        *compare_load(field, test.drivers),
    ]
    recordings = [
        Recording(name, file, getattr(test, part)["time"].values.ravel(), name) for name, (part, file) in FILES.items()
    ]
    return check_clocks(recordings, compared)


def check_clocks(recordings: Sequence[Recording], compared: Sequence[Evidence] = ()) -> dict[str, Check]:
    """The checks of some clocks."""
    found = compare_clocks(recordings, compared)
    return {check.code: check for check in run_checks("clocks", Inputs(clocks=found))}


def with_late(test: Recorded, name: str, minutes: float) -> Recorded:
    """A campaign with one recording whose clock is late."""
    part = FILES[name][0]
    return replace(test, **{part: late(getattr(test, part), minutes)})


def without_ends(test: Recorded) -> Recorded:
    """A campaign whose recordings were begun and ended one after another, so that their first and last times tell nothing."""
    cut = {"deviations": (6, 5), "fields": (0, 3), "environment": (4, 0), "drivers": (10, 19)}
    dims = {"deviations": "cycle"}
    parts = {}
    for part, (begin, end) in cut.items():
        whole = getattr(test, part)
        dim = dims.get(part, "time")
        parts[part] = whole.isel({dim: slice(begin, whole.sizes[dim] - end)})
    return replace(test, **parts)


def late(dataset: xr.Dataset, minutes: float) -> xr.Dataset:
    """The same on a clock that is late."""
    time = dataset["time"] + np.timedelta64(round(60.0 * minutes), "s")
    return dataset.assign_coords(time=time) if "time" in dataset.dims else dataset.assign(time=time)


def scaled(fields: xr.Dataset, factor: float) -> xr.Dataset:
    """Fields whose rise is wrong by a factor, as by a wrong emissivity."""
    first = fields["frame_temperature"].isel(time=0)
    return fields.assign(frame_temperature=factor * (fields["frame_temperature"] - first) + first)
