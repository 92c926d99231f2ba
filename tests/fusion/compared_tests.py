"""Tests of one machine by the twin's laser, without files: the profile stays, noise and thermal history are new in every test."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import xarray as xr

from fusion.results.results import assemble
from fusion.results.store import joined, write_dataset, write_json
from fusion.twin import simulate
from fusion.twin.instruments import deviations_of
from fusion.twin.recipe import Recipe
from interferometry.drift.estimate import estimate_drift
from tests.fusion.results_sample import PARTS

#: Target number of 16 that a repair moves, and its place.
REPAIRED, REPAIRED_MM = 5, 80.0


@cache
def readings_of(seed: int, *, cycles: int = 15, duty: str = "random") -> xr.Dataset:
    """Readings of one machine in a test of its own."""
    recipe = Recipe().vary(campaign={"seed": seed}, test={"cycles": cycles}, duty={"kind": duty})
    truth, machine = simulate(recipe), simulate(recipe.vary(campaign={"seed": 1}))
    readings = deviations_of(truth)
    readings["deviation"] = (
        readings["deviation"] - truth.readings["static_profile"] + machine.readings["static_profile"]
    )
    return readings


def repaired(readings: xr.Dataset, size_um: float) -> xr.Dataset:
    """The same test after one position has moved."""
    moved = xr.where(readings["target"] == REPAIRED, size_um, 0.0)
    return readings.assign(deviation=readings["deviation"] + moved)


def drift_of(readings: xr.Dataset) -> xr.Dataset:
    """The joint estimate with its positions, as a comparison reads it from deviations.nc."""
    return estimate_drift(readings).assign(position=readings["position"])


def write_results(folder: Path, readings: xr.Dataset, *, title: str = "X axis", axis: str = "X", **parts: Any) -> Path:
    """Write what a comparison reads of a results folder."""
    drift = estimate_drift(readings)
    write_dataset(folder / "deviations.nc", joined(readings, estimate=drift))
    found = {"iso230": PARTS["iso230"], "loop": PARTS["loop"], "anomalies": [], **parts}
    found["drift"] = {
        **PARTS["drift"], "position_mm": readings["position"].values, "range_um": drift["drift"].mean("direction").max("cycle").values,
        "range_u_um": drift["drift_u"].mean("direction").max("cycle").values,
    }  # fmt: skip
    kept = {name: part for name, part in found.items() if part is not None}
    write_json(folder / "results.json", assemble(title, kept, []).as_json())
    write_json(folder / "provenance.json", {"parameters": {"campaign": {"axis": axis}}})
    return folder
