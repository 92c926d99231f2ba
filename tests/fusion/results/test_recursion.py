"""A recursion in Python: the first-order response it is made for, and what it does at the ends of its range and without a sensor."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fusion.results.recursion import (
    FAILED,
    OK,
    SATURATED,
    UNKNOWN,
    UNTIMELY,
    RecursionError,
    read_recursion,
    run_recursion,
)
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


def short_model():
    """The same without its state of 1e6 s: it settles within 1.5 h."""
    return some_model().model_copy(
        update={
            "states": some_model().states[:-1],
            "outputs": tuple(
                one.model_copy(update={"coefficients": one.coefficients[:-1], "limit": 100.0})
                for one in some_model().outputs
            ),
        }
    )


def test_a_restart_goes_on_from_what_was_kept():
    """Off for 10 min with the spindle at rest: as if it had run on; the sensors moved straight on meanwhile, which is exact."""
    model = short_model()
    readings = np.tile([25.0, 22.0, 6000.0], (1000, 1))
    readings[:, 0] = np.linspace(21.0, 29.0, 1000)
    off = slice(400, 520)
    readings[off, 2] = 0.0
    whole = run_recursion(model, readings)
    before = run_recursion(model, readings[:400])
    after = run_recursion(model, readings[520:], kept=before.kept, off_s=121 * 5.0)
    # A correction goes to its value within a minute. When within a step the spindle stopped and started is not known: of 4 um with 300 s,
    # half a step is 0.03 um.
    np.testing.assert_allclose(after.correction[30:], whole.correction[550:], atol=0.07)
    assert set(after.status) == {OK} and np.ptp(whole.correction, axis=0).max() > 10.0


def test_a_machine_that_is_neither_cold_nor_known_is_not_corrected_until_its_states_are_known():
    model = short_model()
    readings = np.tile([25.0, 22.0, 6000.0], (2200, 1))
    readings[1200:, 0] = 27.0
    found = run_recursion(model, readings, cold=False)
    rest = model.settling_steps
    assert rest == round(3 * 1800.0 / model.sampling_s)
    assert (found.status[:rest] == UNKNOWN).all() and (found.status[rest:] == OK).all()
    np.testing.assert_array_equal(found.correction[:rest], 0.0)
    known = run_recursion(model, readings).correction
    # From the state that was reached then, known to 5 %, it corrects what changes.
    moved = known[2000:] - known[rest]
    assert np.abs(moved).max() > 3.0
    np.testing.assert_allclose(found.correction[2000:], moved, atol=0.05 * np.abs(moved).max())


def test_readings_that_are_not_there_yet_set_no_reference():
    model = short_model()
    readings = np.tile([25.0, 22.0, 3000.0], (300, 1))
    late = np.vstack([np.full((5, 3), np.nan), np.zeros((5, 3)), readings])
    found, known = run_recursion(model, late), run_recursion(model, readings)
    assert (found.status[:10] == UNKNOWN).all() and not found.correction[:10].any()
    np.testing.assert_array_equal(found.correction[10:], known.correction)


@pytest.mark.parametrize(("factor", "seen"), [(10.0, True), (1.2, True), (0.5, True), (1.02, False)])
def test_a_task_of_another_period_is_seen(factor, seen):
    model = short_model()
    readings = np.tile([25.0, 22.0, 3000.0], (600, 1))
    jitter = np.random.default_rng(3).normal(0.0, 0.5, 600)
    found = run_recursion(model, readings, elapsed_s=factor * model.sampling_s + jitter)
    assert (found.status[400:] == UNTIMELY).all() if seen else (found.status == OK).all()
    assert seen != bool(found.correction[-1].any())


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
    assert set(found.status) == {OK, SATURATED, FAILED, UNKNOWN} and (found.status[:3] == UNKNOWN).all()
    np.testing.assert_array_equal(readings, before)
    with pytest.raises(RecursionError, match=r"shape \(5, 2\); the model takes \(steps, 3\)"):
        run_recursion(model, np.zeros((5, 2)))


def test_a_description_is_read_as_it_was_written_and_another_file_is_refused(tmp_path):
    model, file = some_model(), tmp_path / "model.json"
    file.write_text(model.model_dump_json(), encoding="utf-8")
    assert read_recursion(file) == model
    for text in ('{"format": "thermofuse recursion 1"}', "[" * 100_000):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(RecursionError, match="no model description of thermofuse"):
            read_recursion(file)
