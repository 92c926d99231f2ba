"""The budget of a campaign: stated, measured, assumed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import xarray as xr
from pydantic import ValidationError

from fusion.campaign.config import InterferometryTable
from fusion.campaign.iso_budget import material_by_cycle, state_budget
from interferometry.iso230 import Iso230Budget
from tests.interferometry.simulated_campaigns import simulate


def table(uncertainty: dict[str, str] | None = None, **keys: Any) -> InterferometryTable:
    return InterferometryTable.model_validate({"deviations": "laser.csv", "uncertainty": uncertainty or {}, **keys})


def test_what_is_stated_replaces_what_is_assumed() -> None:
    found = state_budget(table({"device": "0.1 um/m", "environmental_variation": "300 nm"}))
    assert found.budget == Iso230Budget(device_ppm=0.1, environmental_variation_um=0.3)
    assert found.origins == {
        "device": "stated",
        "alignment": "assumed",
        "material_temperature": "assumed",
        "expansion_coefficient": "assumed",
        "environmental_variation": "stated",
    }


@pytest.mark.parametrize(
    "asked",
    [
        table({"expansion_coefficient": "0.8 ppm/K"}, expansion_coefficient="10.5 ppm/K"),
        table(expansion_coefficient="10.5 +- 0.8 ppm/K"),
    ],
)
def test_the_uncertainty_of_the_coefficient_may_stand_beside_it_or_in_the_budget(asked: InterferometryTable) -> None:
    budget = state_budget(asked)
    assert budget.budget.expansion_coefficient_ppm_per_K == pytest.approx(0.8)
    assert budget.budget.nominal_expansion_ppm_per_K == 10.5
    assert budget.origins["expansion_coefficient"] == "stated"


def test_two_uncertainties_of_one_coefficient_are_refused() -> None:
    with pytest.raises(ValidationError, match=r"0\.8 ppm/K beside the coefficient and 1 ppm/K under"):
        table({"expansion_coefficient": "1 ppm/K"}, expansion_coefficient="10.5 +- 0.8 ppm/K")


def test_the_camera_as_thermometer_has_its_own_uncertainty_unless_one_is_stated() -> None:
    assert state_budget(table(), camera_u_K=0.7).budget.material_temperature_K == 0.7
    assert state_budget(table(), camera_u_K=0.7).origins["material_temperature"] == "from the camera"
    stated = state_budget(table({"material_temperature": "0.4 K"}), camera_u_K=0.7)
    assert (stated.budget.material_temperature_K, stated.origins["material_temperature"]) == (0.4, "stated")


def test_the_material_of_a_cycle_is_that_of_its_middle() -> None:
    deviations = simulate(np.random.default_rng(1), cycles=3)[0]
    time = deviations["time"].values
    log = xr.Dataset({"material_temperature": ("time", [20.0, 30.0])}, coords={"time": [time.min(), time.max()]})
    found = material_by_cycle(deviations, log)
    assert found is not None
    share = (time - time.min()) / (time.max() - time.min())
    np.testing.assert_allclose(found, 20.0 + 10.0 * share.mean(axis=(1, 2)))
    assert material_by_cycle(deviations, None) is None
    assert material_by_cycle(deviations, log.isel(time=slice(0, 0))) is None
    sensors = deviations.assign(material_temperature=(("sensor", "end"), [[21.0, 23.0]]))
    assert material_by_cycle(sensors, None).values.tolist() == [22.0, 22.0, 22.0]  # type: ignore[union-attr]
