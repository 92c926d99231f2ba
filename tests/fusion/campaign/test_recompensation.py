"""The laser's compensation in a campaign: as recorded, undone from its factor, and done again with what the camera saw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from pydantic import ValidationError

from fusion.analysis.alignment.align import AxisGeometry
from fusion.campaign.config import InterferometryTable, load_campaign
from fusion.campaign.inputs import compensate_by_camera, read_source
from fusion.campaign.recompensation import (
    RecompensationError,
    StatedBudget,
    compensate_readings,
    material_by_cycle,
    see_material,
    state_budget,
)
from fusion.pipeline.positioning import evaluate_interferometry
from fusion.results.store import read_dataset
from interferometry.compensation import CompensationError, air_index, environment_factor
from interferometry.io.readings import read_deviations
from interferometry.io.writers import write_rtl
from interferometry.iso230 import Iso230Budget
from tests.fusion.campaign_parts import change, without
from tests.interferometry.simulated_campaigns import START, simulate


def table(uncertainty: dict[str, str] | None = None, **keys: Any) -> InterferometryTable:
    return InterferometryTable.model_validate({"deviations": "laser.csv", "uncertainty": uncertainty or {}, **keys})


def assumed_budget() -> StatedBudget:
    """The budget of a campaign that states nothing, whatever is done to its readings."""
    names = ("device", "alignment", "material_temperature", "expansion_coefficient")
    return StatedBudget(Iso230Budget(nominal_expansion_ppm_per_K=11.7), dict.fromkeys(names, "assumed"))


@pytest.fixture
def readings(rng: np.random.Generator) -> xr.Dataset:
    return simulate(rng, cycles=10)[0]


@pytest.fixture
def log() -> xr.Dataset:
    minutes = np.arange(-5.0, 60.0)
    columns = {
        "air_temperature": 22 + 0.05 * minutes,
        "air_pressure": 1000 + 0.1 * minutes,
        "relative_humidity": np.full(minutes.size, 45.0),
        "material_temperature": 21 + 0.1 * minutes,
    }
    time = START + (minutes * 60e9).astype("timedelta64[ns]")
    return xr.Dataset({name: (("time",), values) for name, values in columns.items()}, coords={"time": time})


def test_as_recorded_the_readings_stay_as_they_are(readings: xr.Dataset, log: xr.Dataset) -> None:
    left = compensate_readings(readings, log, table())
    assert left.deviations.identical(readings)
    assert left.budget == assumed_budget() and left.notices == []


def test_redone_with_the_conditions_that_the_instrument_followed_nothing_moves(
    readings: xr.Dataset, log: xr.Dataset
) -> None:
    redone = compensate_readings(readings, log, table(compensation="redo"))
    np.testing.assert_allclose(redone.deviations["deviation"], readings["deviation"], atol=1e-9)
    assert redone.budget == assumed_budget()
    assert redone.notices[0].code == "compensation_redone"


def test_a_factor_in_a_rtl_is_taken_out_and_the_logged_conditions_put_in(
    readings: xr.Dataset, log: xr.Dataset, tmp_path: Path
) -> None:
    fixed = float(environment_factor(air_index(20.0, 1013.25, 50.0)))
    write_rtl(tmp_path / "laser.rtl", readings, environment={"environment_factor_um": (fixed, fixed)})
    read = read_deviations(tmp_path / "laser.rtl", feed_mm_per_min=300.0, dwell_s=2.0)
    redone = compensate_readings(read, log, table(compensation="redo", expansion_coefficient="11.7 ppm/K"))
    minutes = (read["time"].values - START) / np.timedelta64(1, "m")
    wanted = environment_factor(
        air_index(22 + 0.05 * minutes, 1000 + 0.1 * minutes, 45.0),
        material_temperature_degC=21 + 0.1 * minutes,
        expansion_coefficient_ppm_per_K=11.7,
    )
    displayed_um = read["position"].values * 1e3 + read["deviation"].values
    added = redone.deviations["deviation"].values - read["deviation"].values
    # The file prints the factor to 1e-8 um, 0.03 ppm: 0.01 um over 300 mm.
    np.testing.assert_allclose(added, displayed_um * (wanted / fixed - 1.0), atol=0.01)
    assert np.abs(added).max() > 5.0
    stated = table(compensation="redo", environment_factor=[f"{fixed} um", f"{fixed} um"])
    exact = compensate_readings(read, log, stated).deviations["deviation"].values - read["deviation"].values
    np.testing.assert_allclose(exact, displayed_um * (wanted / fixed - 1.0), atol=1e-6)


def test_what_cannot_be_redone_is_refused(readings: xr.Dataset, log: xr.Dataset) -> None:
    with pytest.raises(RecompensationError, match=r'compensation = "redo" needs the air: log air temperature'):
        compensate_readings(readings, None, table(compensation="redo"))
    with pytest.raises(ValidationError, match=r'material_temperature = "camera" without compensation = "redo"'):
        table(material_temperature="camera")
    wrong = table(compensation="redo", environment_factor=["0.3 um", "0.3 um"])
    with pytest.raises(CompensationError, match=r"the environment factor 0.3 um differs by \d+ ppm"):
        compensate_readings(readings, log, wrong)


def test_the_camera_gives_the_mean_temperature_between_zero_and_the_target(readings: xr.Dataset) -> None:
    x, y = np.arange(0.0, 400.0, 10.0), np.arange(0.0, 60.0, 10.0)
    time = START + (np.arange(0.0, 60.0, 10.0) * 60e9).astype("timedelta64[ns]")
    slope = 20.0 + 0.01 * (350.0 - x)
    frames = np.broadcast_to(slope, (time.size, y.size, x.size)) + 0.1 * np.arange(time.size)[:, None, None]
    fields = xr.Dataset(
        {
            "frame_temperature": (("time", "y", "x"), frames),
            "temperature_u": (("cycle", "y", "x"), np.full((10, y.size, x.size), 0.7)),
        },
        coords={"time": time, "y": y, "x": x},
    )
    seen = see_material(fields, AxisGeometry((350.0, 30.0), (-1.0, 0.0)), readings)
    minutes = (readings["time"].values - START) / np.timedelta64(1, "m")
    expected = 20.0 + 0.01 * readings["position"].values / 2 + 0.01 * minutes
    np.testing.assert_allclose(seen.temperature.values, expected, atol=1e-6)
    # What all cells share does not average out along the axis.
    assert seen.u_K == pytest.approx(0.7)


def test_a_campaign_with_the_camera_as_thermometer(copied: Path, results_folder: Path) -> None:
    other = without(copied / "campaign.toml", name="camera.toml")
    asked = '[interferometry]\ncompensation = "redo"\nmaterial_temperature = "camera"\n'
    source = read_source(load_campaign(change(other, "[interferometry]\n", asked)))
    recorded = read_source(load_campaign(copied / "campaign.toml"))
    assert source.deviations.identical(recorded.deviations)
    source, notices = compensate_by_camera(source, read_dataset(results_folder / "fields.nc"))
    assert "the temperature that the camera measured along the axis" in notices[0].message
    found = evaluate_interferometry(source)
    # Twice the length moves twice as far, but for the temperature along it; at the laser's zero nothing moves.
    added = (source.deviations["deviation"] - recorded.deviations["deviation"]).mean(("cycle", "direction")).values
    along = np.argsort(source.deviations["position"].values)
    assert abs(added[along[0]]) < 0.05 < abs(added[along[-1]])
    np.testing.assert_allclose(found.dataset["material_u"], source.deviations["material_u"])
    plain = evaluate_interferometry(recorded)
    # The camera's temperature enters E and A along the axis, but cancels where both directions meet at one place.
    seen, logged = (
        {entry.contributor: entry for entry in outcome.parts.iso230.contributions}["material_temperature"]
        for outcome in (found, plain)
    )
    assert seen.origin == "from the camera" and logged.origin == "assumed"
    assert seen.E_um / logged.E_um == pytest.approx(seen.u / logged.u, rel=0.05)
    assert seen.B_um == logged.B_um == 0.0


# The budget of a campaign: stated, measured, assumed.


def test_what_is_stated_replaces_what_is_assumed() -> None:
    found = state_budget(table({"device": "0.1 um/m", "environmental_variation": "300 nm"}))
    assert found.budget == Iso230Budget(device_ppm=0.1, environmental_variation_um=0.3)
    stated = dict.fromkeys(("device", "environmental_variation"), "stated")
    assert found.origins == {**assumed_budget().origins, **stated}


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
    with pytest.raises(ValidationError, match=r"of the expansion coefficient is 0.8 ppm/K with"):
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
