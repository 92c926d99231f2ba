"""The stage that models the drift: notices, the library, readings laid out by cycle, direction and target, and the scale of the rise."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.alignment.align import AxisGeometry
from fusion.analysis.alignment.readings import Readings, Series
from fusion.analysis.consistency.checks import Inputs
from fusion.analysis.drift_model.axis import FieldFault
from fusion.analysis.drift_model.model import fit_model
from fusion.analysis.drift_model.predictions import rmse
from fusion.analysis.effects.effect import Prior
from fusion.analysis.effects.library import library
from fusion.pipeline import drift_model
from fusion.pipeline.consistency import run_checks
from fusion.pipeline.drift_model import (
    CorrectedCamera,
    axis_scale_u,
    both_models,
    correct_camera,
    correction_variables,
    field_notices,
    gap_notices,
    hidden_by_zero,
    join_fusion,
    library_for,
    loop_variables,
    place_scale_u,
    plan_scale_u,
    prediction_variables,
    scale_coefficients,
    scale_evidence,
    scaled,
    with_event_times,
    with_spread,
)
from fusion.results.axis import AnomalyPart, Evidence
from fusion.results.loop import DeclaredCoefficient, ResidualDrift
from fusion.results.parts import Sensitivity
from tests.fusion import loops
from tests.fusion.small_campaign import campaign, logged, model_of, term

DIMS = ("cycle", "direction", "target")


def readings_with_noise(bare: Readings) -> Readings:
    return replace(bare, response=np.random.default_rng(2).standard_normal(bare.seconds.size))


def empty(cycles: int = 12) -> xr.Dataset:
    """Readings of four targets in both directions, all zero."""
    coords = {"cycle": np.arange(1, cycles + 1), "direction": ["positive", "negative"], "target": np.arange(1, 5)}
    return xr.Dataset({"deviation": (DIMS, np.zeros((cycles, 2, 4)))}, coords=coords)


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
    assert list(gap_notices(campaign(series={"duty": logged(np.ones(60), "1")}, drivers=("duty",)))) == []
    same = {"T1": gapped(300.0), "T2": gapped(300.0)}
    (both,) = gap_notices(campaign(series=same, drivers=("T1", "T2")))
    assert both.message.startswith("T1, T2 each have 1 gap, 5 min together, ")


def test_camera_errors_that_were_taken_out_are_noted():
    error = FieldFault.model_construct(effect="camera_offset", text="the camera read too high from cycle 5 on")
    (notice,) = field_notices([error])
    assert notice.code == "field_corrected_camera_offset"
    assert notice.message.startswith("The camera read too high from cycle 5 on: removed from the frames")
    assert list(field_notices([])) == []


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


def test_what_the_correction_of_the_camera_changes_is_kept_where_it_erred():
    times = np.datetime64("2026-01-05T06:00", "ns") + np.arange(3) * np.timedelta64(100, "s")
    fused = xr.Dataset(
        {"time": (DIMS, times[:, None, None]), "deviation": (DIMS, np.zeros((3, 1, 1)))}, coords={"cycle": [1, 2, 3]}
    )
    fields = xr.Dataset(
        {
            "frame_temperature": (("time", "y", "x"), np.full((3, 1, 1), 20.0)),
            "temperature": (("cycle", "y", "x"), np.full((3, 1, 1), 20.0)),
            "temperature_rise": (("cycle", "y", "x"), np.zeros((3, 1, 1))),
        },
        coords={"time": times, "cycle": [1, 2, 3]},
    )
    result = SimpleNamespace(steps=[SimpleNamespace(effect="dead_path")])
    assert correct_camera(SimpleNamespace(), result, fields, fused, fused) is None
    assert correction_variables(None, fields, fused) == {}
    error = FieldFault.model_construct(text="it erred", course_K=np.array([0.0, -0.5, -0.5]), pattern=np.ones((1, 1)))
    aligned = ("mean_rise", "axis_integral", "local_rise")
    again = xr.Dataset({name: (DIMS, np.full((3, 1, 1), k)) for k, name in enumerate(aligned)})
    told = correction_variables(CorrectedCamera([error], again), fields, fused)
    corrected = {f"{name}_corrected" for name in ("temperature", "temperature_rise", *aligned)}
    assert set(told) == {"field_correction", *corrected}
    np.testing.assert_array_equal(told["axis_integral_corrected"], again["axis_integral"])
    np.testing.assert_allclose(told["temperature_corrected"].values.ravel(), [20.0, 19.5, 19.5])


def test_both_models_are_fitted_to_all_readings():
    readings = readings_with_noise(campaign(cycles=12))
    terms = [term(np.sin(readings.seconds / 100.0))]
    before, after = model_of(readings, terms, readings.cycle <= 10), model_of(readings, terms)
    models = both_models(SimpleNamespace(before=before, after=after))
    assert models["final"] is after
    assert models["declared"].used.all() and models["declared"].terms == before.terms
    np.testing.assert_array_equal(models["declared"].fit.coefficients, fit_model(readings, terms).fit.coefficients)


@pytest.fixture
def laid():
    """A campaign of which one reading is missing, laid out; two steps and a wave in the final model."""
    whole = campaign(cycles=12)
    readings = readings_with_noise(whole.subset(~((whole.cycle == 3) & (whole.target == 2) & (whole.sign < 0))))
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
    return loop_variables(empty(), models, tests), SimpleNamespace(models=models, readings=readings)


def test_readings_residuals_effects_and_spectra_lie_where_they_belong(laid):
    dataset, of = laid
    readings = of.readings
    innovation = dataset["innovation_declared"]
    missing = np.argwhere(np.isnan(innovation.values))
    np.testing.assert_array_equal(missing, [[2, 1, 1]])
    for k in (0, 5, 40, 94):
        place = (readings.cycle[k] - 1, 0 if readings.sign[k] > 0 else 1, readings.target[k] - 1)
        assert innovation.values[place] == readings.seconds[k]
    np.testing.assert_array_equal(dataset["innovation_final"], innovation + 1.0)
    for name, model in of.models.items():
        residual = dataset[f"residual_{name}"].values
        assert np.nanmean(residual) == pytest.approx(0.0, abs=1e-12)
        expected = model.readings.response - model.fit.design @ model.fit.coefficients
        np.testing.assert_allclose(residual[0, 0], (expected - expected.mean())[:4])
        assert dataset[f"residual_{name}"].attrs == {"units": "um"}
    assert dataset["effect"].values.tolist() == ["step_event 1", "periodic_disturbance", "step_event 3"]
    final = of.models["final"]
    for k, one in enumerate(final.terms):
        series, _ = final.series(one)
        np.testing.assert_allclose(dataset["contribution"].values[k][0, 0], series[:4])
        assert np.isnan(dataset["contribution"].values[k][2, 1, 1])
    np.testing.assert_array_equal(dataset["period"], [9.0, 4.0])
    np.testing.assert_array_equal(dataset["periodogram_final"], 11.0)
    assert (dataset["periodogram_declared"].attrs["limit"], dataset["periodogram_final"].attrs["limit"]) == (5.0, 6.0)


def test_an_event_has_the_time_of_day_of_its_instant():
    start = np.datetime64("2026-03-09T06:30:02", "ns")
    time = start + (np.arange(24).reshape(3, 2, 4) * 60).astype("timedelta64[s]")
    fused = empty(3).assign(time=(DIMS, time))
    # The first reading has no value: the loop counts from the second.
    fused["deviation"][0, 0, 0] = np.nan
    added = [SimpleNamespace(candidate=SimpleNamespace(event_s=at)) for at in (600.4, None)]
    result = SimpleNamespace(state=SimpleNamespace(added=added))
    steps = with_event_times([loops.added("step_event"), loops.added("thermal_lag")], result, fused)
    assert [step.event_time for step in steps] == ["2026-03-09T06:41:02Z", None]


def test_the_errors_that_the_loop_reports_are_kept_reading_by_reading():
    """Each root mean square is that of the result, and every error lies at its reading."""
    readings = readings_with_noise(campaign(cycles=12))
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
    variables = prediction_variables(empty(), result)
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
    result.steps = []
    assert set(prediction_variables(empty(), result)) == {f"held_out_error_{name}" for name in errors}


def test_a_model_without_effects_has_no_contribution():
    model = model_of(readings_with_noise(campaign(cycles=12)))
    test = SimpleNamespace(
        innovations=model.readings.seconds, power=np.ones(1), power_limit=1.0, periods_min=np.ones(1)
    )
    dataset = loop_variables(empty(), {"declared": model, "final": model}, {"declared": test, "final": test})
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
    monkeypatch.setattr(drift_model.axis_loop, "find_field_errors", lambda *given: ["an error"])
    monkeypatch.setattr(drift_model.axis_loop, "correct_fields", lambda *given: None)
    monkeypatch.setattr(drift_model, "align", lambda used, *given, **named: used)
    source = SimpleNamespace(axis=None, environment=None, drivers=None)
    corrected = drift_model.correct_camera(source, None, None, fused, deviations)
    np.testing.assert_array_equal(corrected.fused["deviation"], [1.0, np.nan, 3.0])


X, Y = 5.0 + 10.0 * np.arange(30), 5.0 + 10.0 * np.arange(6)


def fields() -> xr.Dataset:
    """A plan whose left half warms by 3 K with a scale known to 1 %, its right half by 1 K with one known to 5 %."""
    left = np.broadcast_to(X < 150, (6, 30))
    rise = np.stack([np.zeros((6, 30)), np.where(left, 3.0, 1.0), np.full((6, 30), np.nan)])
    return xr.Dataset(
        {"temperature_rise": (("cycle", "y", "x"), rise), "rise_scale_u": (("y", "x"), np.where(left, 0.01, 0.05))},
        coords={"cycle": [1, 2, 3], "y": Y, "x": X},
    )


def test_scales_are_weighted_by_the_rise_and_both_parts_are_combined():
    assert plan_scale_u(fields()) == pytest.approx((3 * 0.01 + 1 * 0.05) / 4)
    along = AxisGeometry((20.0, 30.0), (1.0, 0.0))
    assert axis_scale_u(fields(), along, np.array([0.0, 100.0])) == pytest.approx(0.01)
    assert place_scale_u(fields(), 250.0, 30.0) == pytest.approx(0.05)
    assert place_scale_u(fields(), np.nan, np.nan) == pytest.approx(plan_scale_u(fields()))
    cold = fields().assign(temperature_rise=fields()["temperature_rise"] * 0.0)
    assert plan_scale_u(cold) == pytest.approx(0.03)
    # A zero that is uncertain by 0.2 K where the plan has warmed by 1.5 K on the mean: both rise and zero count over the cycles.
    creeps = fields().assign(camera_correction_u=("cycle", [0.0, 0.2, np.nan]))
    assert plan_scale_u(creeps) == pytest.approx(
        np.hypot(plan_scale_u(fields()), 0.2 / float(fields()["temperature_rise"][1].mean()))
    )
    both = scaled(Sensitivity(value=-10.0, u=0.3), 0.04)
    assert (both.u_fit, both.u_scale, both.u) == pytest.approx((0.3, 0.4, 0.5))


def test_what_was_expected_does_not_depend_on_the_rise():
    """The weighted mean of readings and expectation is shifted by the readings' weight times their own shift."""
    alone, alone_u, expected, expected_u = 10.0, 1.0, 12.0, 2.0

    def mean(readings):
        weights = np.array([alone_u, expected_u]) ** -2.0
        return float(np.average([readings, expected], weights=weights))

    u = (alone_u**-2 + expected_u**-2) ** -0.5
    entry = loops.declared_one("axis_expansion", mean(alone), u, prior=expected, prior_u=expected_u)
    assert scaled(entry, 0.01).u_scale == pytest.approx(abs(mean(alone * 1.01) - mean(alone)))
    (check,) = run_checks("loop", Inputs(loop=loops.loop(scaled(entry, 0.1))))
    # 10 against 12: with 1 of the readings, 10 % of 10 of the scale, and 2 of the expectation.
    assert check.value == pytest.approx(-2.0 / np.sqrt(1.0 + 1.0 + 4.0))


def test_only_coefficients_per_kelvin_of_the_rise_are_scaled():
    loop = loops.loop(
        loops.declared_one("axis_expansion", 2.0, 0.1),
        loops.declared_one("table_offset", 2.0, 0.1, "um/K"),
        loops.declared_one("material_compensation", 2.0, 0.1),
        steps=(
            loops.added("angular_growth", loops.coefficient(2.0, 0.1, "um/(K)"), parameters={"follows": "mean_rise"}),
            loops.added("step_event", loops.coefficient(2.0, 0.1, "um"), parameters={"time_s": 3.0}),
        ),
    )
    done = scale_coefficients(loop, library(), axis_u=0.02, plan_u=0.03)
    assert [entry.u_scale for entry in done.declared_coefficients] == [0.04, 0.06, None]
    assert [step.coefficients[0].u_scale for step in done.steps] == [0.06, None]


def test_the_local_temperature_of_an_anomaly_carries_the_scale_of_its_place():
    position = xr.DataArray([0.0, 200.0], dims="target", coords={"target": [1, 2]})
    axis = AxisGeometry((20.0, 30.0), (1.0, 0.0))
    known = Evidence.model_construct(temperature_um_per_K=2.0, temperature_u_um_per_K=0.1)
    evidence = scale_evidence(AnomalyPart.model_construct(target=2, evidence=known), axis, fields(), position).evidence
    assert evidence.temperature_scale_u_um_per_K == pytest.approx(0.1)
    assert evidence.temperature_u_um_per_K == pytest.approx(0.1 * np.sqrt(2.0))
    for number in (None, np.nan):
        without = AnomalyPart.model_construct(target=2, evidence=Evidence.model_construct(temperature_um_per_K=number))
        assert scale_evidence(without, axis, fields(), position) is without


def test_results_carry_both_parts_of_every_coefficient(results_folder):
    results = json.loads((results_folder / "results.json").read_text())
    expansion, offset = results["loop"]["declared_coefficients"]
    for entry in (expansion, offset, results["correlation"]["source"]["sensitivity_um_per_K"]):
        # Of 24 cycles at so few targets several lines are as good as the declared one.
        parts = [entry["u_fit"], entry["u_scale"], entry.get("u_line") or 0.0]
        assert entry["u"] == pytest.approx(np.sqrt(np.sum(np.square(parts))))
    assert expansion["u_line"] > 0.0 and "u_line" not in offset
    # An error of the rise is one of what the readings say of the coefficient, not of its prior.
    of_readings = expansion["value"] - expansion["prior"] * (expansion["u_fit"] / expansion["prior_u"]) ** 2
    assert expansion["u_scale"] == pytest.approx(results["radiometry"]["rise_scale_u"] * of_readings, rel=0.1)
    assert all(spot["peak_rise_u_K"] > 0.01 * spot["peak_rise_K"] for spot in results["hotspots"])
    assert "the scale of the rise ±" in (results_folder / "report.html").read_text()


def test_a_zero_that_may_swing_hides_what_is_left_as_drift_in_its_share_of_the_rise():
    rise = np.array([0.0, 1.0, 2.0, 3.0])[:, None, None] * np.ones((1, 2, 2))
    coords = {"cycle": np.arange(1, 5), "y": [0.0, 10.0], "x": [0.0, 10.0]}
    fields = xr.Dataset({"temperature_rise": (("cycle", "y", "x"), rise)}, coords=coords)
    left = ResidualDrift.model_construct(common_rms_um=0.8, stretch_rms_um=0.6)
    position = np.array([0.0, 100.0, 200.0])
    assert hidden_by_zero(left, fields, position) == {"um/K": 0.0, "ppm/K": 0.0}
    unsure = fields.assign(camera_correction_u=("cycle", [0.0, 0.5, 1.0, 1.5]))
    swing, reach = np.std([0.0, 1.0, 2.0, 3.0]), np.sqrt(np.mean((1e-3 * position) ** 2))
    hidden = hidden_by_zero(left, unsure, position)
    # Half of the rise is the zero's: half of the drift per kelvin, and per kelvin and metre.
    assert hidden["um/K"] == pytest.approx(0.5 * 0.8 / swing)
    assert hidden["ppm/K"] == pytest.approx(0.5 * 0.6 / (reach * swing))
    entry = scaled(Sensitivity(value=0.02, u=0.1), 0.5, hidden["um/K"])
    assert entry.u == pytest.approx(np.sqrt(0.1**2 + 0.01**2 + hidden["um/K"] ** 2)) and entry.u_fit == 0.1


@pytest.mark.parametrize(
    ("given", "u"),
    [
        ({"u": 0.2, "u_fit": 0.2, "jackknife_u": 0.1}, 0.2),
        ({"u": 0.2, "u_fit": 0.2, "jackknife_u": 0.5}, 0.5),
        # The part of the scale stays beside it: 0.3 of the fit becomes 0.5.
        ({"u": 0.5, "u_fit": 0.3, "jackknife_u": 0.5}, np.hypot(0.4, 0.5)),
        # Half of the variance is what was expected beforehand, which does not move.
        ({"u": 1.0, "u_fit": 1.0, "jackknife_u": 4.0, "prior": 11.7, "prior_u": np.sqrt(2.0)}, 2.0),
        ({"u": 0.2, "u_fit": 0.2, "jackknife_u": None}, 0.2),
        ({"u": 0.2}, 0.2),
    ],
)
def test_a_declared_coefficient_is_no_surer_than_parts_of_the_test_agree(given, u):
    assert with_spread(
        DeclaredCoefficient(effect="axis_expansion", value=1.0, unit="ppm/K", **given)
    ).u == pytest.approx(u)
