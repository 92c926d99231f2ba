"""What crosses the border of the package: every source of deviations keeps the contract."""

import importlib
import pkgutil

import pytest
import xarray as xr

import interferometry
from interferometry.anomalies import detect_anomalies
from interferometry.common import DEVIATIONS, ENVIRONMENT, ESTIMATE, InterferometryError
from interferometry.compensation import compensate
from interferometry.drift.estimate import estimate_drift
from interferometry.io.readings import read_deviations, read_environment
from interferometry.io.writers import write_deviations_csv, write_rtl
from interferometry.iso230 import evaluate_iso230
from interferometry.neighbours import compare, evaluate_neighbours
from tests.interferometry.simulated_campaigns import simulate


def keeps_contract(deviations: xr.Dataset) -> bool:
    return all(
        (deviations[name].dims, deviations[name].attrs.get("units", ""), deviations[name].dtype.kind)
        == (dims, units, kind)
        for name, (dims, units, kind) in DEVIATIONS.items()
    )


def test_built_deviations_keep_the_contract(rng):
    deviations, _ = simulate(rng, cycles=2)
    assert keeps_contract(deviations)
    assert not keeps_contract(deviations.assign(position=deviations["position"].assign_attrs(units="m")))


@pytest.mark.parametrize(("name", "write"), [("laser.csv", write_deviations_csv), ("laser.rtl", write_rtl)])
def test_read_deviations_keep_the_contract(name, write, tmp_path, rng):
    write(tmp_path / name, simulate(rng, cycles=2)[0])
    assert keeps_contract(read_deviations(tmp_path / name))


ENTRIES = {
    "estimate_drift": estimate_drift,
    "evaluate_iso230": evaluate_iso230,
    "evaluate_neighbours": evaluate_neighbours,
    "compare": compare,
    "compensate": lambda deviations: compensate(deviations, xr.Dataset()),
}


@pytest.mark.parametrize("entry", ENTRIES)
def test_an_evaluation_refuses_what_is_no_dataset_of_deviations(entry, rng):
    good = simulate(rng, cycles=2)[0]
    faults = {
        r"is of type NoneType, not a Dataset; give what read_deviations or build_deviations returns": None,
        r"has no variable 'deviation' \(cycle, direction, target\); give what read_deviations": xr.Dataset(),
        r"has no variable 'position' \(target\); give": good.drop_vars("position"),
        r"has 'deviation' over \(cycle, target\) instead of 'deviation' \(cycle,": good.isel(direction=0),
    }
    for message, dataset in faults.items():
        with pytest.raises(InterferometryError, match=f"deviations {message}"):
            ENTRIES[entry](dataset)


def in_unit(dataset: xr.Dataset, name: str, unit: str, factor: float = 1.0, offset: float = 0.0) -> xr.Dataset:
    changed = dataset[name].copy(data=dataset[name].values * factor + offset)
    return dataset.assign({name: changed.assign_attrs(units=unit)})


@pytest.mark.parametrize("entry", [name for name in ENTRIES if name != "compensate"])
def test_deviations_in_another_unit_or_order_give_the_same_and_of_another_quantity_are_refused(entry, rng):
    good = simulate(rng, cycles=4)[0]
    expected = ENTRIES[entry](good)
    other = in_unit(in_unit(good, "deviation", "mm", 1e-3), "position", "m", 1e-3).transpose("target", ...)
    xr.testing.assert_allclose(ENTRIES[entry](other), expected, rtol=1e-9)
    for unit in ("um/s", "degC", "1"):
        with pytest.raises(
            InterferometryError, match=rf"deviations\['deviation'\] is in '{unit}', which cannot be conv.* 'um'"
        ):
            ENTRIES[entry](in_unit(good, "deviation", unit))


def test_angles_are_evaluated_by_iso_230_2_alone(rng):
    angles = in_unit(in_unit(simulate(rng, cycles=4)[0], "deviation", "arcsec"), "position", "deg")
    assert evaluate_iso230(angles)["A"].attrs["units"] == "arcsec"
    assert float(evaluate_iso230(in_unit(angles, "deviation", "arcmin", 1 / 60))["A"]) == pytest.approx(
        float(evaluate_iso230(angles)["A"])
    )
    with pytest.raises(InterferometryError, match=r"\['deviation'\] is in 'arcsec', which cannot be converted to 'um'"):
        estimate_drift(angles)


def test_conditions_in_other_units_are_converted(rng):
    good = simulate(rng, cycles=4)[0]
    values = {
        "air_temperature": (20.0, "degC"),
        "air_pressure": (1000.0, "hPa"),
        "relative_humidity": (50.0, "%"),
        "material_temperature": (21.0, "degC"),
    }
    time = [good["time"].values.min(), good["time"].values.max()]
    log = xr.Dataset(
        {name: ("time", [value] * 2, {"units": unit}) for name, (value, unit) in values.items()}, {"time": time}
    )
    other = in_unit(in_unit(log, "air_pressure", "Pa", 100.0), "material_temperature", "K", 1.0, 273.15)
    expected, found = (compensate(good, one, applied_factor_um=(0.31638, 0.31638)) for one in (log, other))
    assert found["correction_scale"].values == pytest.approx(expected["correction_scale"].values, abs=1e-9)
    with pytest.raises(
        InterferometryError, match=r"environment\['air_pressure'\] is in 'psi', which cannot be converted to 'hPa'"
    ):
        compensate(good, in_unit(log, "air_pressure", "psi"))


def test_anomalies_and_compensation_name_which_dataset_is_wrong(rng):
    good = simulate(rng, cycles=2)[0]
    with pytest.raises(InterferometryError, match=r"estimated has no variable 'standardised' .*; give what"):
        detect_anomalies(good, good)
    with pytest.raises(InterferometryError, match="deviations has no variable 'deviation'"):
        detect_anomalies(estimate_drift(good), good)
    with pytest.raises(InterferometryError, match=r"environment has no variable 'time' .*; give what read_environment"):
        compensate(good, xr.Dataset())


def test_what_the_package_returns_keeps_the_contracts_of_estimate_and_environment(tmp_path, rng):
    estimated = estimate_drift(simulate(rng, cycles=4)[0])
    assert {name: (estimated[name].dims, estimated[name].dtype.kind) for name in ESTIMATE} == {
        name: (dims, kind) for name, (dims, _, kind) in ESTIMATE.items()
    }
    header = "time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC"
    (tmp_path / "environment.csv").write_text(f"{header}\n2026-03-09T06:30:00Z,23.5,1000.2,42,23.9\n", encoding="utf-8")
    environment = read_environment(tmp_path / "environment.csv")
    assert {
        name: (environment[name].dims, environment[name].attrs.get("units", ""), environment[name].dtype.kind)
        for name in ENVIRONMENT
    } == ENVIRONMENT


def test_every_error_class_has_the_base_of_the_package():
    names = [module.name for module in pkgutil.walk_packages(interferometry.__path__, "interferometry.")]
    classes = {
        value
        for name in names
        for value in vars(importlib.import_module(name)).values()
        if isinstance(value, type) and issubclass(value, Exception) and value.__module__.startswith("interferometry")
    }
    assert {"CompensationError", "DriftDataError", "DriftModelError", "LaserFormatError"} <= {
        c.__name__ for c in classes
    }
    assert all(issubclass(error, InterferometryError) for error in classes)
    assert issubclass(InterferometryError, ValueError)
