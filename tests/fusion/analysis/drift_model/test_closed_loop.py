"""The closed loop along an axis on campaigns of the twin with one effect or two missing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fusion.analysis.alignment.align import AxisGeometry, align
from fusion.analysis.alignment.readings import Readings, ReadingsError, read_fused
from fusion.analysis.drift_model.axis import (
    LoopError,
    correct_fields,
    corrected_variables,
    declare,
    find_field_errors,
    on_corrected_fields,
    set_aside_sites,
)
from fusion.analysis.drift_model.closed_loop import close_loop
from fusion.analysis.effects.effect import Effect, Prior
from fusion.analysis.effects.library import library
from fusion.twin import simulate
from fusion.twin.instruments import deviations_of, fields_of
from fusion.twin.recipe import EffectRecipe, Recipe
from fusion.twin.simulate import driver_log, environment_log
from tests.fusion import loop_bench
from tests.fusion.small_campaign import campaign

pytestmark = pytest.mark.chain

DECLARED = ["axis_expansion", "table_offset"]
AXIS = AxisGeometry((500.0, 90.0), (-1.0, 0.0))


def readings_of(*effects: EffectRecipe, seed: int = 302, cycles: int = 60) -> Readings:
    """A campaign of 16 targets with 0.4 um noise, without rendering frames."""
    return loop_bench.readings_of(*effects, seed=seed, cycles=cycles) if effects else bare(seed, cycles)


@cache
def bare(seed: int, cycles: int) -> Readings:
    return loop_bench.readings_of(seed=seed, cycles=cycles)


@pytest.fixture(scope="module")
def complete():
    return close_loop(readings_of(), DECLARED)


def test_a_complete_model_stays_as_it_is(complete):
    assert complete.verdict == "complete"
    assert complete.steps == []
    # 1,800 readings give the noise to 0.007 um; the twin's own drift adds to the error of predicting in open loop.
    assert complete.noise_floor_um == pytest.approx(0.4, abs=0.02)
    assert complete.rmse_declared_um < 1.2 * complete.noise_floor_um


def test_a_missing_effect_is_named_and_the_held_out_error_falls_to_the_noise():
    found = close_loop(readings_of(EffectRecipe("reversal_drift", amplitude_um=0.8)), DECLARED)
    (step,) = found.steps
    assert (step.effect, found.verdict) == ("reversal_drift", "explained")
    assert found.rmse_final_um < 1.2 * found.noise_floor_um
    assert step.p_value < 0.05
    # The size that was put in; a static part of it belongs to the profile.
    assert step.rms_um == pytest.approx(0.8, rel=0.25)
    assert step.rmse_after_um < step.rmse_before_um


def test_an_effect_outside_the_library_is_left_without_a_name_and_described():
    found = close_loop(readings_of(EffectRecipe("telegraph_switching", amplitude_um=0.4)), DECLARED)
    assert (found.steps, found.verdict) == ([], "unexplained")
    assert "targets 9-12, negative direction only" in found.remainder.shape
    assert found.remainder.rms_um > 0.1
    # Sites with a diagnosis of their own are no remainder.
    left = set_aside_sites(found, [(target, "negative") for target in range(9, 13)])
    assert left.verdict == "complete"


def test_the_hold_out_cycles_do_not_touch_the_model_before_they_are_opened(complete):
    readings = readings_of()
    held_out = readings.cycle > 48
    spoiled = replace(readings, response=np.where(held_out, readings.response + 50.0, readings.response))
    found = close_loop(spoiled, DECLARED, effects=_few("reversal_drift"))
    np.testing.assert_array_equal(found.before.fit.coefficients, complete.before.fit.coefficients)
    assert found.rmse_declared_um > 40.0


def test_a_users_effect_that_raises_is_named_and_the_rest_goes_on():
    def candidates(readings, coefficients, near):
        raise KeyError("no such series")
        yield

    broken = Effect("broken", "None.", "none", candidates)
    effects = {name: library()[name] for name in (*DECLARED, "reversal_drift")}
    hidden = readings_of(EffectRecipe("reversal_drift", amplitude_um=0.8))
    found = close_loop(hidden, DECLARED, effects={"broken": broken, **effects})
    assert "KeyError: 'no such series'" in found.state.not_tried()["broken"]
    assert [step.effect for step in found.steps] == ["reversal_drift"]


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        (["axis_expansion", "sun_spots"], "'sun_spots' is not in the library"),
        (["thermal_lag"], "has parameters that are not known beforehand"),
    ],
)
def test_declared_effects_that_cannot_be_computed_are_refused(declared, message):
    with pytest.raises(LoopError, match=message):
        close_loop(readings_of(), declared)


def test_a_declared_effect_that_follows_nothing_is_refused_by_name():
    readings = readings_of()
    frozen = {
        name: replace(series, values=np.zeros_like(series.values)) if name in ("mean_rise", "axis_integral") else series
        for name, series in readings.series.items()
    }
    with pytest.raises(LoopError, match=r"'axis_expansion' is zero at every reading: .*camera frozen"):
        close_loop(replace(readings, series=frozen), DECLARED)


def test_too_few_cycles_are_refused():
    with pytest.raises(ReadingsError, match="at least 3 of each"):
        readings_of(cycles=3)


def _few(*names: str) -> dict[str, Effect]:
    return {name: library()[name] for name in (*DECLARED, *names)}


def test_a_declared_effect_has_the_prior_of_the_library():
    readings = readings_of(cycles=20)
    expansion, offset = declare(readings, DECLARED, library())
    assert (expansion.effect, expansion.candidate.prior) == ("axis_expansion", Prior(11.7, 2.0))
    assert (offset.effect, offset.candidate.prior) == ("table_offset", None)
    with pytest.raises(
        LoopError, match="'axis_expansion' cannot be computed: the campaign holds no temperature of the table"
    ):
        declare(campaign(), DECLARED, library())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "share_left"),
    [
        # A uniform jump between two frames is seen to a few mK; a patch's edge is blurred by the noise of single cells.
        (EffectRecipe("camera_offset", amplitude_K=0.5, parameters={"at_cycle": 20}), 0.05),
        (EffectRecipe("reflected_source", amplitude_K=25.0), 0.25),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_a_camera_error_is_taken_out_of_the_fields(effect: EffectRecipe, share_left: float) -> None:
    recipe = Recipe().vary(campaign={"seed": 302}, test={"cycles": 40})
    clean = fields_of(simulate(recipe))
    truth = simulate(recipe.vary(effect=(effect,)))
    fields, deviations = fields_of(truth), deviations_of(truth)
    logs = {"environment": environment_log(truth), "drivers": driver_log(truth)}
    fused = align(deviations, fields, AXIS, **logs)
    found = close_loop(read_fused(fused), DECLARED, effects=_few(effect.name, "reversal_drift"))
    assert [step.effect for step in found.steps] == [effect.name]
    if effect.name == "camera_offset":
        correction = found.steps[0].coefficients[0]
        assert correction.unit == "K"
        assert correction.value == pytest.approx(0.5, abs=4 * correction.u)

    errors = find_field_errors(found, fields, fused)
    right = correct_fields(fields, errors)
    wrong_K = float(np.sqrt(((fields["frame_temperature"] - clean["frame_temperature"]) ** 2).mean()))
    left_K = float(np.sqrt(((right["frame_temperature"] - clean["frame_temperature"]) ** 2).mean()))
    assert left_K < share_left * wrong_K
    variables = corrected_variables(fields, fused, errors)
    rise = variables["temperature_rise_corrected"].values - clean["temperature_rise"].values
    assert np.sqrt(np.mean(rise**2)) < share_left * wrong_K

    again = on_corrected_fields(found, read_fused(align(deviations, right, AXIS, **logs)), {effect.name})
    assert [term.effect for term in again.after.terms] == DECLARED
    assert again.rmse_final_um == pytest.approx(found.rmse_final_um, rel=0.05)
    expansion = again.declared_coefficients[0]
    assert expansion.value == pytest.approx(recipe.drift.expansion_ppm_per_K, abs=3 * expansion.u)
