"""The stage that models the drift: notices, the library of a campaign, and readings laid out by cycle, direction and target."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from fusion.alignment.readings import Series
from fusion.effects.effect import Prior
from fusion.effects.library import library
from fusion.loop.camera_correction import FieldFault
from fusion.loop.result import rmse
from fusion.model.fit import fit_model
from fusion.pipeline import drift_model
from fusion.pipeline.drift_model import (
    CorrectedCamera,
    both_models,
    correct_camera,
    correction_variables,
    field_notices,
    gap_notices,
    join_fusion,
    library_for,
    loop_variables,
    prediction_variables,
    with_event_times,
)
from tests.fusion.small_campaign import campaign, logged, model_of, term


def gapped(*starts: float) -> Series:
    """A log every 30 s, with gaps of 300 s from the given times on."""
    seconds = 30.0 * np.arange(60)
    kept = np.ones(60, bool)
    for start in starts:
        kept &= (seconds <= start) | (seconds >= start + 300.0)
    return Series(seconds[kept], np.ones(kept.sum()), "1")


def test_gaps_of_a_log_are_one_notice_for_every_series():
    series = {"duty": gapped(300.0, 900.0), "air_temperature": gapped(600.0), "mean_rise": gapped(300.0)}
    duty, air = gap_notices(campaign(series=series, drivers=("duty",)))
    assert (duty.code, air.code) == ("series_gap", "series_gap")
    assert duty.message.startswith("duty has 2 gaps, 10 min together, the first 5 min after the first reading; ")
    assert duty.remedy == "Log duty without a break, at least once a minute."
    assert air.message.startswith("air_temperature has 1 gap, 5 min together, the first 10 min after ")
    assert gap_notices(campaign(series={"duty": logged(np.ones(60), "1")}, drivers=("duty",))) == []
    same = {"T1": gapped(300.0), "T2": gapped(300.0)}
    (both,) = gap_notices(campaign(series=same, drivers=("T1", "T2")))
    assert both.message.startswith("T1, T2 each have 1 gap, 5 min together, ")


def test_camera_errors_that_were_taken_out_are_noted():
    error = FieldFault(
        "camera_offset", "the camera read too high from cycle 5 on", 0.5, 0.1, 5, np.zeros(1), np.ones((1, 1))
    )
    (notice,) = field_notices([error])
    assert notice.code == "field_corrected_camera_offset"
    assert notice.message.startswith("The camera read too high from cycle 5 on: taken out of the frames")
    assert field_notices([]) == []


def test_the_expected_expansion_is_that_of_the_campaign_file():
    table = SimpleNamespace(expansion_coefficient_ppm_per_K=8.0, expansion_coefficient_u_ppm_per_K=None)
    effects = library_for(SimpleNamespace(campaign=SimpleNamespace(interferometry=table, thermography=True)))
    assert effects["axis_expansion"].prior == Prior(8.0, 2.0)
    measured = SimpleNamespace(expansion_coefficient_ppm_per_K=8.0, expansion_coefficient_u_ppm_per_K=0.3)
    campaign = SimpleNamespace(interferometry=measured, thermography=True)
    assert library_for(SimpleNamespace(campaign=campaign))["axis_expansion"].prior == Prior(8.0, 0.3)
    others = {name: effect for name, effect in effects.items() if name != "axis_expansion"}
    assert others == {name: effect for name, effect in library().items() if name != "axis_expansion"}
    assert list(effects) == list(library())
    assert library()["axis_expansion"].prior == Prior(11.7, 2.0)
    assert library_for(SimpleNamespace(campaign=SimpleNamespace(interferometry=None, thermography=True))) == library()


def test_a_camera_that_did_not_err_is_not_corrected():
    times = np.datetime64("2026-01-05T06:00", "ns") + np.arange(3) * np.timedelta64(100, "s")
    fused = xr.Dataset(
        {
            "time": (("cycle", "direction", "target"), times[:, None, None]),
            "deviation": (("cycle", "direction", "target"), np.zeros((3, 1, 1))),
        },
        coords={"cycle": [1, 2, 3]},
    )
    fields = xr.Dataset(coords={"time": times})
    result = SimpleNamespace(steps=[SimpleNamespace(effect="dead_path")])
    assert correct_camera(SimpleNamespace(), result, fields, fused, fused) is None
    assert correction_variables(None, fields, fused) == {}


def test_what_the_correction_changes_is_written_beside_the_fields():
    times = np.datetime64("2026-01-05T06:00", "ns") + np.arange(3) * np.timedelta64(100, "s")
    dims = ("cycle", "direction", "target")
    fused = xr.Dataset(
        {"time": (dims, times[:, None, None]), "deviation": (dims, np.zeros((3, 1, 1)))}, coords={"cycle": [1, 2, 3]}
    )
    fields = xr.Dataset(
        {
            "frame_temperature": (("time", "y", "x"), np.full((3, 1, 1), 20.0)),
            "temperature": (("cycle", "y", "x"), np.full((3, 1, 1), 20.0)),
            "temperature_rise": (("cycle", "y", "x"), np.zeros((3, 1, 1))),
        },
        coords={"time": times, "cycle": [1, 2, 3]},
    )
    error = FieldFault("camera_offset", "it erred", 0.5, 0.1, 2, np.array([0.0, -0.5, -0.5]), np.ones((1, 1)))
    again = xr.Dataset(
        {name: (dims, np.full((3, 1, 1), k)) for k, name in enumerate(("mean_rise", "axis_integral", "local_rise"))}
    )
    told = correction_variables(CorrectedCamera([error], again), fields, fused)
    assert set(told) == {
        "field_correction",
        "temperature_corrected",
        "temperature_rise_corrected",
        "mean_rise_corrected",
        "axis_integral_corrected",
        "local_rise_corrected",
    }
    np.testing.assert_array_equal(told["axis_integral_corrected"], again["axis_integral"])
    np.testing.assert_allclose(told["temperature_corrected"].values.ravel(), [20.0, 19.5, 19.5])


def test_both_models_are_fitted_to_all_readings():
    bare = campaign(cycles=12)
    readings = replace(bare, response=np.random.default_rng(2).standard_normal(bare.seconds.size))
    terms = [term(np.sin(bare.seconds / 100.0))]
    before, after = model_of(readings, terms, bare.cycle <= 10), model_of(readings, terms)
    models = both_models(SimpleNamespace(before=before, after=after))
    assert models["final"] is after
    assert models["declared"].used.all() and models["declared"].terms == before.terms
    np.testing.assert_array_equal(models["declared"].fit.coefficients, fit_model(readings, terms).fit.coefficients)


@pytest.fixture
def laid() -> tuple[xr.Dataset, SimpleNamespace]:
    """A campaign of which one reading is missing, laid out; two steps and a wave in the final model."""
    whole = campaign(cycles=12)
    kept = ~((whole.cycle == 3) & (whole.target == 2) & (whole.sign < 0))
    bare = whole.subset(kept)
    readings = replace(bare, response=np.random.default_rng(2).standard_normal(bare.seconds.size))
    terms = [
        term((readings.seconds > 500.0).astype(float), "step_event"),
        term(np.sin(readings.seconds / 100.0), "periodic_disturbance"),
        term((readings.seconds > 900.0).astype(float), "step_event"),
    ]
    models = {"declared": model_of(readings), "final": model_of(readings, terms)}
    tests = {
        name: SimpleNamespace(
            innovations=readings.seconds + k,
            power=np.full(2, 10.0 + k),
            power_limit=5.0 + k,
            periods_min=np.array([9.0, 4.0]),
        )
        for k, name in enumerate(models)
    }
    fused = xr.Dataset(
        {"deviation": (("cycle", "direction", "target"), np.zeros((12, 2, 4)))},
        coords={"cycle": np.arange(1, 13), "direction": ["positive", "negative"], "target": np.arange(1, 5)},
    )
    return loop_variables(fused, models, tests), SimpleNamespace(models=models, readings=readings)


def test_every_reading_lies_at_its_cycle_direction_and_target(laid):
    dataset, of = laid
    readings = of.readings
    innovation = dataset["innovation_declared"]
    missing = np.argwhere(np.isnan(innovation.values))
    np.testing.assert_array_equal(missing, [[2, 1, 1]])
    for k in (0, 5, 40, 94):
        place = (readings.cycle[k] - 1, 0 if readings.sign[k] > 0 else 1, readings.target[k] - 1)
        assert innovation.values[place] == readings.seconds[k]
    np.testing.assert_array_equal(dataset["innovation_final"], innovation + 1.0)


def test_residuals_hold_the_drift_and_have_mean_zero(laid):
    dataset, of = laid
    for name, model in of.models.items():
        residual = dataset[f"residual_{name}"].values
        assert np.nanmean(residual) == pytest.approx(0.0, abs=1e-12)
        expected = model.readings.response - model.fit.design @ model.fit.coefficients
        np.testing.assert_allclose(residual[0, 0], (expected - expected.mean())[:4])
        assert dataset[f"residual_{name}"].attrs == {"units": "um"}


def test_an_event_has_the_time_of_day_of_its_instant():
    start = np.datetime64("2026-03-09T06:30:02", "ns")
    time = start + (np.arange(24).reshape(3, 2, 4) * 60).astype("timedelta64[s]")
    fused = xr.Dataset(
        {
            "deviation": (("cycle", "direction", "target"), np.zeros((3, 2, 4))),
            "time": (("cycle", "direction", "target"), time),
        }
    )
    # The first reading has no value: the loop counts from the second.
    fused["deviation"][0, 0, 0] = np.nan
    added = [SimpleNamespace(candidate=SimpleNamespace(event_s=at)) for at in (600.4, None)]
    result = SimpleNamespace(state=SimpleNamespace(added=added))
    steps = with_event_times([{"effect": "step_event"}, {"effect": "thermal_lag"}], result, fused)
    assert [step["event_time"] for step in steps] == ["2026-03-09T06:41:02Z", None]


def test_the_errors_that_the_loop_reports_are_kept_reading_by_reading():
    """Each root mean square is that of the result, and every error lies at its reading."""
    whole = campaign(cycles=12)
    readings = replace(whole, response=np.random.default_rng(2).standard_normal(whole.seconds.size))
    late = readings.cycle > 9
    random = np.random.default_rng(3)
    errors = {name: random.standard_normal(late.sum()) for name in ("declared", "final", "last_value")}
    blocks = [np.where(readings.cycle > 2, random.standard_normal(late.size), np.nan) for _ in range(2)]
    result = SimpleNamespace(
        before=model_of(readings, [], ~late),
        state=SimpleNamespace(model=model_of(readings)),
        hold_out_errors=errors,
        steps=[SimpleNamespace(cross_errors_before_um=blocks[0], cross_errors_after_um=blocks[1])],
    )
    fused = xr.Dataset(
        {"deviation": (("cycle", "direction", "target"), np.zeros((12, 2, 4)))}, coords={"cycle": np.arange(1, 13)}
    )
    variables = prediction_variables(fused, result)
    for name, values in errors.items():
        laid_out = variables[f"held_out_error_{name}"].values
        assert np.isnan(laid_out[:9]).all()
        assert np.sqrt(np.nanmean(laid_out**2)) == pytest.approx(rmse(values), rel=1e-14)
        k = int(np.flatnonzero(late)[5])
        place = (readings.cycle[k] - 1, 0 if readings.sign[k] > 0 else 1, readings.target[k] - 1)
        assert laid_out[place] == values[5]
    for name, values in zip(("before", "after"), blocks, strict=True):
        laid_out = variables[f"block_error_{name}"].values
        assert laid_out.shape == (1, 12, 2, 4) and np.isnan(laid_out[0, :2]).all()
        assert np.sqrt(np.nanmean(laid_out**2)) == pytest.approx(rmse(values), rel=1e-14)
    assert set(prediction_variables(fused, SimpleNamespace(**{**vars(result), "steps": []}))) == {
        f"held_out_error_{name}" for name in errors
    }


def test_effects_that_enter_twice_are_numbered(laid):
    dataset, of = laid
    assert dataset["effect"].values.tolist() == ["step_event 1", "periodic_disturbance", "step_event 3"]
    final = of.models["final"]
    for k, one in enumerate(final.terms):
        series, _ = final.series(one)
        np.testing.assert_allclose(dataset["contribution"].values[k][0, 0], series[:4])
        assert np.isnan(dataset["contribution"].values[k][2, 1, 1])


def test_spectra_are_kept_with_their_limit(laid):
    dataset, _ = laid
    np.testing.assert_array_equal(dataset["period"], [9.0, 4.0])
    np.testing.assert_array_equal(dataset["periodogram_final"], 11.0)
    assert (dataset["periodogram_declared"].attrs["limit"], dataset["periodogram_final"].attrs["limit"]) == (5.0, 6.0)


def test_a_model_without_effects_has_no_contribution():
    bare = campaign(cycles=12)
    readings = replace(bare, response=np.random.default_rng(2).standard_normal(bare.seconds.size))
    fused = xr.Dataset(
        {"deviation": (("cycle", "direction", "target"), np.zeros((12, 2, 4)))}, coords={"cycle": np.arange(1, 13)}
    )
    test = SimpleNamespace(innovations=readings.seconds, power=np.ones(1), power_limit=1.0, periods_min=np.ones(1))
    model = model_of(readings)
    dataset = loop_variables(fused, {"declared": model, "final": model}, {"declared": test, "final": test})
    assert dataset["contribution"].shape == (0, 12, 2, 4)


def test_the_loop_stands_beside_the_readings_and_the_attribution_in_a_group():
    fused = xr.Dataset({"deviation": ("cycle", [0.0, 1.0])}, attrs={"axis": "X"})
    maps = xr.DataTree(xr.Dataset({"map": ("x", [1.0])}, attrs={"Conventions": "CF-1.13", "lag": "30 s"}))
    tree = join_fusion(fused, fused, maps, xr.Dataset({"residual": ("cycle", [2.0, 3.0])}))
    assert set(tree.to_dataset().data_vars) == {"deviation", "loop_residual"}
    # What every product says of itself is said once, at the root.
    assert tree["correlation"].attrs == {"lag": "30 s"} and "map" in tree["correlation"]
    assert maps.attrs == {"Conventions": "CF-1.13", "lag": "30 s"}


def test_an_error_of_reading_stays_out_where_the_fields_are_corrected(monkeypatch):
    deviations = xr.Dataset({"deviation": ("reading", [1.0, 900.0, 3.0])})
    fused = xr.Dataset({"deviation": ("reading", [1.0, np.nan, 3.0])})
    monkeypatch.setattr(drift_model, "find_field_errors", lambda *given: ["an error"])
    monkeypatch.setattr(drift_model, "correct_fields", lambda *given: None)
    monkeypatch.setattr(drift_model, "align", lambda used, *given, **named: used)
    source = SimpleNamespace(axis=None, environment=None, drivers=None)
    corrected = drift_model.correct_camera(source, None, None, fused, deviations)
    np.testing.assert_array_equal(corrected.fused["deviation"], [1.0, np.nan, 3.0])
