"""A recursion in Python: the first-order response it is made for, and what it does at the ends of its range and without a sensor."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fusion.results.recursion import FAILED, OK, SATURATED, RecursionError, read_recursion, run_recursion
from tests.fusion.recursions import some_model, some_readings


def test_a_state_solves_its_differential_equation_for_readings_that_are_linear_between_steps():
    model = some_model(sampling_s=60.0)
    (lagged,) = (k for k, one in enumerate(model.states) if one.time_constant_s == 1800.0)
    weights = tuple(1.0 if k == lagged else 0.0 for k in range(len(model.states)))
    wide = {"coefficients": weights, "limit": 1e9, "max_step": 1e9}
    model = model.model_copy(update={"outputs": (model.outputs[0].model_copy(update=wide),)})
    seconds = 60.0 * np.arange(200)
    course = np.interp(seconds, [0, 3000, 6000, 12000], [20.5, 26.0, 23.0, 29.0])
    readings = np.column_stack([course, np.full(200, 21.0), np.zeros(200)])
    solved = solve_ivp(
        lambda t, x: (np.interp(t, seconds, course) - 20.5 - x) / 1800.0,
        (0.0, seconds[-1]),
        [0.0],
        t_eval=seconds,
        rtol=1e-10,
        atol=1e-10,
        max_step=60.0,
    )
    found = run_recursion(model, readings)
    # The tolerance is that of the solver.
    np.testing.assert_allclose(found.correction[:, 0], -solved.y[0], atol=1e-7)
    finer = run_recursion(
        model.at_sampling(30.0), np.column_stack([np.interp(30.0 * np.arange(399), seconds, c) for c in readings.T])
    )
    np.testing.assert_allclose(finer.correction[::2], found.correction, atol=1e-9)


def test_a_reading_outside_its_range_is_held_at_the_end_of_it():
    model = some_model()
    inside = np.tile([30.0, 22.0, 0.0], (50, 1))
    outside = inside + np.array([2.0, 0.0, 0.0])
    held, known = run_recursion(model, outside), run_recursion(model, inside)
    np.testing.assert_array_equal(held.correction, known.correction)
    assert set(held.status) == {SATURATED}


@pytest.mark.parametrize("broken", [np.nan, np.inf, 0.0, 400.0])
def test_a_failed_sensor_brings_the_corrections_to_rest_within_a_minute_until_a_reset(broken):
    model = some_model()
    readings = np.tile([25.0, 22.0, 3000.0], (200, 1))
    readings[50:60, 0] = broken
    reset = np.zeros(200, bool)
    reset[55] = reset[150] = True
    found = run_recursion(model, readings, reset=reset)
    assert np.abs(found.correction[49]).max() > 1.0
    assert (found.status[50:150] == FAILED).all(), (
        "a reset while the sensor is broken, and a sensor that comes back, change nothing"
    )
    assert found.status[150] != FAILED
    in_a_minute = 50 + int(60.0 / model.sampling_s)
    np.testing.assert_array_equal(found.correction[in_a_minute:150], 0.0)
    np.testing.assert_allclose(found.correction[-1], run_recursion(model, readings[:49]).correction[-1], rtol=0.2)
    assert np.abs(np.diff(found.correction, axis=0)).max() <= model.outputs[0].max_step * (1.0 + 1e-12)


def test_a_datum_is_the_state_without_a_correction():
    model = some_model()
    readings = np.tile([25.0, 22.0, 0.0], (100, 1))
    zero = np.zeros(100, bool)
    zero[0] = True
    np.testing.assert_allclose(run_recursion(model, readings, zero=zero).correction[0], 0.0)
    assert run_recursion(model, readings[:1]).status[0] in {OK, SATURATED}


def test_corrections_never_pass_their_limit_and_the_inputs_stay_as_they_are():
    model, (readings, zero, reset) = some_model(), some_readings()
    before = readings.copy()
    found = run_recursion(model, readings, zero=zero, reset=reset)
    assert np.abs(found.correction).max() <= model.outputs[0].limit
    assert set(found.status) == {OK, SATURATED, FAILED}
    np.testing.assert_array_equal(readings, before)
    with pytest.raises(RecursionError, match=r"shape \(5, 2\); the model takes \(steps, 3\)"):
        run_recursion(model, np.zeros((5, 2)))


def test_a_description_is_read_as_it_was_written_and_another_file_is_refused(tmp_path):
    model, file = some_model(), tmp_path / "model.json"
    file.write_text(model.model_dump_json(), encoding="utf-8")
    assert read_recursion(file) == model
    file.write_text('{"format": "thermofuse recursion 1"}', encoding="utf-8")
    with pytest.raises(RecursionError, match="no model description of thermofuse"):
        read_recursion(file)
