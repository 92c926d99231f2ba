"""Index of air against published vectors, real files, and compensation undone and redone."""

from dataclasses import fields

import numpy as np
import pytest
import xarray as xr

from interferometry.compensation import (
    CompensationError,
    SensorUncertainty,
    air_index,
    compensate,
    dead_path_error_um,
    environment_factor,
    implied_wavelength_nm,
)
from interferometry.deviations import UNREADABLE
from interferometry.io.readings import read_deviations
from tests.interferometry.simulated_campaigns import START, simulate

#: NIST Engineering Metrology Toolbox: degC, kPa, % relative humidity, nm, index.
VECTORS = [
    (20, 101.325, 0, 633, 1.000271800),
    (20, 60, 0, 633, 1.000160924),
    (20, 120, 0, 633, 1.000321916),
    (50, 100, 0, 633, 1.000243285),
    (5, 100, 0, 633, 1.000282756),
    (-40, 100, 0, 633, 1.000337580),
    (50, 120, 100, 633, 1.000287924),
    (40, 120, 75, 633, 1.000299418),
    (20, 100, 100, 633, 1.000267394),
    (40, 110, 100, 1700, 1.000270247),
    (20, 101.325, 0, 1700, 1.000268479),
    (40, 110, 100, 300, 1.000289000),
    (20, 101.325, 0, 300, 1.000286581),
    (-40, 120, 0, 300, 1.000427233),
]


@pytest.mark.parametrize(("temperature", "pressure", "humidity", "wavelength", "index"), VECTORS)
def test_index_of_air_meets_the_published_vectors(temperature, pressure, humidity, wavelength, index):
    computed = air_index(temperature, pressure * 10, humidity, wavelength_nm=wavelength)
    # The vectors are printed to 1e-9.
    assert float(computed) == pytest.approx(index, abs=0.6e-9)


@pytest.mark.real_data
def test_genuine_file_implies_the_wavelength_of_the_laser(real_file):
    test = read_deviations(real_file("friedcucumber__RenishawWork/data/22.rtl"))
    index = air_index(*(test[name].values for name in ("air_temperature", "air_pressure", "relative_humidity")))
    implied = implied_wavelength_nm(
        test["environment_factor"].values,
        index,
        material_temperature_degC=test["material_temperature"].values[0],
        expansion_coefficient_ppm_per_K=float(test["expansion_coefficient"][0]),
    )
    assert implied == pytest.approx(632.9906, rel=0.1e-6)


RECORD = "matusm__NmmEnvironment/TestData/T22-0263_L2_15_{}.pos"


@pytest.fixture
def record(real_file):
    """56.8 h: X, Y, Z in m, three air temperatures in degC, pressure in Pa, humidity in %, sample temperature in degC."""
    return np.concatenate([np.loadtxt(real_file(RECORD.format(part))) for part in (1, 2)])


@pytest.mark.real_data
def test_long_record_index_of_air_and_dead_path(record):
    index = air_index(record[:, 3:6].mean(axis=1), record[:, 6] / 100, record[:, 7])
    assert np.ptp(index) * 1e6 == pytest.approx(4.0, abs=0.02)
    # One row every 204 s: 7 h are 124 rows.
    seven_hours = max(np.ptp(index[at : at + 124]) for at in range(index.size - 124))
    assert seven_hours * 1e6 == pytest.approx(2.16, abs=0.01)
    dead = dead_path_error_um(index, index[0], dead_path_mm=100.0)
    assert np.ptp(dead) == pytest.approx(0.40, abs=0.005)


def conditions(temperature: np.ndarray, pressure: np.ndarray, material: np.ndarray, minutes: np.ndarray) -> xr.Dataset:
    return xr.Dataset(
        {
            "air_temperature": (("time",), temperature),
            "air_pressure": (("time",), pressure),
            "relative_humidity": (("time",), np.full(temperature.size, 45.0)),
            "material_temperature": (("time",), material),
        },
        coords={"time": START + (minutes * 60e9).astype("timedelta64[ns]")},
    )


@pytest.fixture
def campaign(rng):
    deviations, _ = simulate(rng, cycles=10)
    minutes = np.arange(0.0, 50.0)
    environment = conditions(22 + 0.05 * minutes, 1000 + 0.1 * minutes, 21 + 0.1 * minutes, minutes)
    return deviations, environment


def test_what_was_done_with_a_fixed_factor_is_undone(campaign):
    """A display with one fixed factor, of an axis that keeps its length, is brought to the lengths the counts mean."""
    deviations, environment = campaign
    true = deviations["deviation"].values
    minutes = (deviations["time"].values - START) / np.timedelta64(1, "m")
    index = air_index(22 + 0.05 * minutes, 1000 + 0.1 * minutes, 45.0)
    factor = environment_factor(
        index, material_temperature_degC=21 + 0.1 * minutes, expansion_coefficient_ppm_per_K=11.7
    )
    position_um = deviations["position"].values * 1e3
    fixed = float(environment_factor(air_index(20.0, 1013.25, 50.0)))
    displayed = deviations.copy()
    displayed["deviation"] = (deviations["deviation"].dims, (position_um + true) / factor * fixed - position_um)
    assert np.abs(displayed["deviation"].values - true).max() > 5.0
    redone = compensate(displayed, environment, applied_factor_um=(fixed, fixed))
    np.testing.assert_allclose(redone["deviation"], true, atol=1e-6)
    assert redone.attrs["outside_environment"] == 0


def test_dead_path_is_corrected_by_its_length_and_the_change_of_index(campaign):
    deviations, environment = campaign
    redone = compensate(deviations, environment, dead_path_mm=100.0)
    index = redone["air_index"].values
    added = redone["deviation"].values - deviations["deviation"].values
    np.testing.assert_allclose(added, -100e3 * (index - index[0, 0, 0]) / index, atol=1e-9)
    towards = compensate(deviations, environment, dead_path_mm=100.0, away=False)
    np.testing.assert_allclose(towards["correction_dead_path"], -redone["correction_dead_path"])
    assert np.ptp(added, axis=2).max() < 0.01


def test_temperature_seen_along_the_axis_replaces_the_probe(campaign):
    deviations, environment = campaign
    fixed = (0.31639, 0.31639)
    probe = compensate(deviations, environment, applied_factor_um=fixed)
    seen = xr.full_like(deviations["deviation"], 25.0)
    camera = compensate(deviations, environment, applied_factor_um=fixed, material_temperature_degC=seen)
    minutes = (deviations["time"].values - START) / np.timedelta64(1, "m")
    difference = camera["deviation"].values - probe["deviation"].values
    expected = -11.7e-6 * (25 - (21 + 0.1 * minutes)) * deviations["position"].values * 1e3
    np.testing.assert_allclose(difference, expected, atol=2e-3)


def test_uncertainty_follows_the_sensitivities(campaign):
    deviations, environment = campaign
    none = dict.fromkeys((field.name for field in fields(SensorUncertainty)), 0.0)
    only_temperature = SensorUncertainty(**{**none, "air_temperature_K": 1.0})
    u = compensate(deviations, environment, uncertainty=only_temperature)["compensation_u"].values
    # 0.93 ppm/K at 1000 hPa and 23 degC, over 300 mm.
    assert u[..., -1].mean() == pytest.approx(0.93e-6 * 300e3, rel=0.02)
    assert u[..., 0].max() == 0.0
    every = compensate(deviations, environment, dead_path_mm=100.0)
    parts = [every[name] for name in ("air_u", "material_u", "dead_path_u")]
    assert all(float(part.max()) > 0 for part in parts)
    np.testing.assert_allclose(every["compensation_u"] ** 2, sum(part**2 for part in parts))
    with pytest.raises(CompensationError, match="formula_ppm=-1: give a finite number, 0 or more"):
        SensorUncertainty(formula_ppm=-1)


def test_readings_without_conditions_are_refused_or_counted(campaign):
    deviations, environment = campaign
    short = environment.isel(time=slice(0, 35))
    assert compensate(deviations, short)["air_index"].notnull().all()
    assert compensate(deviations, short).attrs["outside_environment"] > 0
    with pytest.raises(CompensationError, match=r"lies \d+ min from any logged condition"):
        compensate(deviations, environment.isel(time=slice(0, 10)))
    timeless = deviations.copy(deep=True)
    timeless["time"].values[:] = np.datetime64("NaT")
    with pytest.raises(CompensationError, match="no reading has a time"):
        compensate(timeless, environment)


def test_a_missing_reading_stays_missing_and_leaves_the_others_alone(campaign):
    deviations, environment = campaign
    complete = compensate(deviations, environment, applied_factor_um=(0.31639, 0.31639))
    lost = deviations.copy(deep=True)
    lost["deviation"].values[3, 0, 5] = np.nan
    lost["time"].values[3, 0, 5] = np.datetime64("NaT")
    redone = compensate(lost, environment, applied_factor_um=(0.31639, 0.31639))
    assert np.argwhere(np.isnan(redone["deviation"].values)).tolist() == [[3, 0, 5]]
    kept = np.isfinite(redone["deviation"].values)
    np.testing.assert_array_equal(redone["deviation"].values[kept], complete["deviation"].values[kept])


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("wavelength_nm", -1.0, "is outside 300 .. 1700"),
        ("wavelength_nm", 0.633, "is outside 300 .. 1700"),
        ("wavelength_nm", np.nan, "is not finite"),
        ("expansion_coefficient_ppm_per_K", np.nan, "is not finite"),
        ("dead_path_mm", np.inf, "is not finite"),
        ("dead_path_mm", -5.0, "is negative"),
        ("zero_mm", np.nan, "is not finite"),
    ],
)
def test_a_number_that_has_no_meaning_is_refused(name, value, reason, rng):
    deviations = simulate(rng, cycles=2)[0]
    environment = conditions(np.array([20.0]), np.array([1013.25]), np.array([20.0]), np.zeros(1))
    with pytest.raises(CompensationError, match=f"{name}={value} {reason}"):
        compensate(deviations, environment, **{name: value})


def test_a_reading_without_a_time_is_flagged_and_counted(campaign):
    deviations, environment = campaign
    whole = compensate(deviations, environment, dead_path_mm=500.0)
    nameless = deviations.copy(deep=True)
    nameless["time"].values[3, 1, 2] = np.datetime64("NaT")
    found = compensate(nameless, environment, dead_path_mm=500.0)
    lost = np.argwhere(found["quality_flag"].values & UNREADABLE.mask).tolist()
    assert (lost, found.attrs["without_time"], whole.attrs["without_time"]) == ([[3, 1, 2]], 1, 0)
    expected = whole["deviation"].values.copy()
    expected[3, 1, 2] = np.nan
    np.testing.assert_array_equal(found["deviation"].values, expected)


def test_a_temperature_at_the_readings_may_have_its_dims_in_any_order(campaign):
    deviations, environment = campaign
    seen = 20.0 + deviations["deviation"] * 0.1
    factor = (float(environment_factor(1.00027)),) * 2
    plain, turned = (
        compensate(
            deviations,
            environment,
            applied_factor_um=factor,
            expansion_coefficient_ppm_per_K=11.0,
            material_temperature_degC=one,
        )
        for one in (seen, seen.transpose("target", "cycle", "direction"))
    )
    np.testing.assert_array_equal(plain["deviation"].values, turned["deviation"].values)
