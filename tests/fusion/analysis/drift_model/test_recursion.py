"""Displacements as responses to what was logged: their likelihood, what a control makes of them, and the fewest sensors that suffice."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.alignment.readings import Series
from fusion.analysis.attribution.duty import DutyPlanError
from fusion.analysis.drift_model.record import close_record
from fusion.analysis.drift_model.record_data import Record, reduce_record
from fusion.analysis.drift_model.recursion import (
    Marginal,
    Response,
    columns_of,
    errors_of,
    evaluate_columns,
    events_of,
    follow,
    forecast,
    make_recursion,
    record_of_product,
    respond,
    sensor_curve,
)
from fusion.analysis.drift_model.verification import choose_test, covariance_after, propose_tests
from fusion.analysis.effects.library import library
from fusion.pipeline.record import record_variables
from fusion.results.loop import RecordLoop
from fusion.results.recursion import FAILED, OK, SATURATED, Recursion, RecursionError, run_recursion
from fusion.twin.recipe import EffectRecipe
from tests.fusion.record_tables import record_of, runs_table, table_of, twin_table

pytestmark = pytest.mark.long

FROM = {"campaign": "twin", "results_sha256": "0" * 64}


def run_of(table: xr.Dataset, *searched: str) -> tuple[Record, xr.Dataset, RecordLoop]:
    """Record, product and loop of a run without files that searches for some effects only."""
    record = reduce_record(table)
    result = close_record(record, ["quasi_static"], effects={name: library()[name] for name in searched})
    return record, record_variables(record, result), result.described(())


@pytest.fixture(scope="module")
def driven() -> tuple[Record, xr.Dataset, RecordLoop]:
    """A spindle that no sensor sees and whose speed is logged."""
    source = EffectRecipe("unseen_heat_source", 8.0, parameters={"time_constant_min": 20.0})
    return run_of(twin_table(source, seed=3, hours=12.0), "unseen_heat_source")


def readings_of(model: Recursion, record: Record) -> np.ndarray:
    """Readings (blocks, inputs) as the control gets them."""
    return np.column_stack(
        [
            record.temperature[:, record.sensors.index(one.name)]
            if one.name in record.sensors
            else record.drivers[one.name][1] * record.driver_sizes[one.name][0]
            for one in model.inputs
        ]
    )


def test_the_recursion_from_block_to_block_is_minus_the_response(driven):
    record, product, loop = driven
    model = make_recursion(product, loop, sampling_s=record.block_s, **FROM)
    wide = [one.model_copy(update={"max_step": 1e9, "limit": 1e9}) for one in model.outputs]
    found = run_recursion(model.model_copy(update={"outputs": tuple(wide)}), readings_of(model, record))
    columns = columns_of(record, record.sensors)
    values = evaluate_columns(record, columns)
    whole = follow(record, columns, values, events_of(product, loop), np.ones(record.seconds.size, bool))
    known = -values @ np.column_stack([one.coefficients for one in whole])
    places = [record.channels.index(one.name) for one in model.outputs]
    difference = found.correction - found.correction[0] - known[:, places]
    # A mean of squares over a block is not the square of the mean where the speed changes within it.
    assert (np.sqrt(np.mean(difference**2, axis=0)) < [one.u for one in model.outputs]).all()
    assert [one.before for one in model.outputs] == pytest.approx(
        [loop.channels[one.name].rmse_persistence_um for one in model.outputs]
    )
    assert all(one.u < 0.3 * one.before for one in model.outputs)


def test_a_source_is_followed_whether_the_loop_named_it_or_not(driven):
    _, product, loop = driven
    nameless = loop.model_copy(update={"steps": (), "left_out_of_forecast": ()})
    with_name, without = (make_recursion(product, one, sampling_s=60.0, **FROM) for one in (loop, nameless))
    assert with_name.states == without.states
    assert with_name.outputs == without.outputs


def test_a_load_that_runs_when_the_control_starts_has_not_warmed_anything_yet(driven):
    record, product, loop = driven
    model = make_recursion(product, loop, sampling_s=record.block_s, **FROM)
    readings = np.tile(readings_of(model, record)[0], (200, 1))
    readings[:, [one.name for one in model.inputs].index("speed")] = 6000.0
    correction = run_recursion(model, readings, zero=np.arange(200) == 0).correction
    # The twin's spindle has 20 min and a part before it a quarter of that; what the load does at once is the zero.
    assert (np.abs(correction[-1]) > 2.0).any()
    assert (np.abs(correction[1]) < 0.25 * np.abs(correction[-1]).max()).all()


def test_a_temperature_far_outside_the_test_is_that_of_a_failed_sensor_and_a_larger_load_is_held(driven):
    record, product, loop = driven
    for one in make_recursion(product, loop, sampling_s=record.block_s, **FROM).inputs:
        # Readings are followed to half the range of the test beyond it.
        beyond = one.failed_above - one.high
        if one.unit == "degC":
            extent = (one.high - one.low) / 2.0
            assert beyond == pytest.approx(max(10.0 - 0.5 * extent, 0.0))
            assert one.low - one.failed_below == pytest.approx(beyond)
        else:
            # The spindle rested and turned in one sense: to 1.5 times its speed, to twice, and not backwards.
            assert (one.high, one.failed_above) == pytest.approx((3.0 * beyond, 4.0 * beyond))
            assert one.low == one.failed_below == pytest.approx(-0.02 * 2.0 * beyond)


def test_a_load_that_never_changed_is_said_in_the_model(driven):
    _, product, loop = driven
    marked = product.assign_attrs(constant_drivers="coolant (5 l/min)")
    (told,) = (one for one in make_recursion(marked, loop, sampling_s=60.0, **FROM).remarks if "coolant" in one)
    assert told.startswith("constant over the whole test: coolant (5 l/min)") and "hold at that load alone" in told


def test_a_spindle_that_turns_the_other_way_than_in_the_test_is_a_failed_reading(driven):
    record, product, loop = driven
    model = make_recursion(product, loop, sampling_s=record.block_s, **FROM)
    assert any("hand over its magnitude" in remark for remark in model.remarks)
    readings = np.tile(readings_of(model, record)[0], (20, 1))
    speed = [one.name for one in model.inputs].index("speed")
    readings[:, speed] = -1.0
    assert set(run_recursion(model, readings).status) <= {OK, SATURATED}
    readings[10:, speed] = -3000.0
    found = run_recursion(model, readings)
    assert (found.status[10:] == FAILED).all() and not found.correction[-1].any()


def test_the_likelihood_is_that_of_the_dense_covariance():
    rng = np.random.default_rng(2)
    seconds, columns = np.cumsum(rng.uniform(50.0, 90.0, 40)), rng.standard_normal((40, 3))
    course, ratio = rng.standard_normal(40), 1e-3
    one = np.ones((40, 1))

    def dense(variance: float, columns: np.ndarray) -> float:
        wandering = ratio * (np.minimum.outer(seconds, seconds) - seconds[0])
        covariance = variance * (np.eye(40) + wandering) + columns @ columns.T
        # Restricted to what is orthogonal to a constant.
        basis = np.linalg.svd(one, full_matrices=True)[0][:, 1:]
        y, v = basis.T @ course, basis.T @ covariance @ basis
        return -0.5 * float(y @ np.linalg.solve(v, y) + np.linalg.slogdet(v)[1])

    def found(variance: float, columns: np.ndarray) -> float:
        return Marginal.of(seconds, course, one, columns, ratio=ratio).log_likelihood(variance)

    assert found(0.4, columns) - found(0.9, 2.0 * columns) == pytest.approx(
        dense(0.4, columns) - dense(0.9, 2.0 * columns), abs=1e-8
    )


def test_the_product_holds_the_record_on_its_blocks(driven):
    record, product, _ = driven
    again = record_of_product(product)
    np.testing.assert_array_equal(again.rise, record.rise)
    np.testing.assert_array_equal(again.drivers["speed"][2], record.drivers["speed"][2])
    np.testing.assert_allclose(np.diff(again.seconds), np.diff(record.seconds))


def test_the_fewest_sensors_are_those_that_the_displacement_follows():
    rng = np.random.default_rng(8)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.05, (1500, 6)), axis=0)
    displacement = (temperature[:, [1, 4]] - 20.0) @ [[6.0, 1.0], [-3.0, 5.0]] + 0.1 * rng.standard_normal((1500, 2))
    _, product, loop = run_of(table_of(displacement, temperature))
    model = make_recursion(product, loop, sampling_s=1.0, reduced=True, **FROM)
    assert [one.name for one in model.inputs] == ["t2", "t5"]
    record = record_of_product(product)
    curve, chosen = sensor_curve(record, events_of(product, loop), ~product["sealed"].values.astype(bool))
    assert [len(one.sensors) for one in curve] == [6, 5, 4, 3, 2, 1]
    assert chosen.sensors == ("t2", "t5")
    assert curve[-1].cross_rmse > 3.0 * curve[-2].cross_rmse
    assert model.remarks[0].startswith("reduced to 2 of 6 sensors: t2, t5; error on the hold-out set 0.0")
    at_once = [one.time_constant_s == 0.0 for one in model.states]
    # What a lag of 5 min does not tell from the sensor itself goes to the lag: some percent.
    np.testing.assert_allclose(np.array(model.outputs[0].coefficients)[at_once], [6.0, -3.0], rtol=0.03)


@pytest.mark.parametrize(("after", "pause_h"), [(200, 24.0), (399, 6.5e5)])
def test_after_a_long_pause_the_curve_is_that_of_the_part_before_it(after, pause_h):
    """Two displacements that each follow one sensor by 2 um/K exactly, with 24 h between the halves, or a last row in 2100."""
    rng = np.random.default_rng(8)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.05, (400, 3)), axis=0)
    table = table_of(2.0 * (temperature[:, :2] - 20.0) + 0.01 * rng.standard_normal((400, 2)), temperature)
    pause = np.where(np.arange(400) < after, 0, round(3600.0 * pause_h)).astype("m8[s]")
    _, product, loop = run_of(table.assign_coords(time=table["time"].values + pause))
    assert np.unique(product["part"].values[~product["sealed"].values.astype(bool)]).size == 1
    model = make_recursion(product, loop, sampling_s=60.0, reduced=True, **FROM)
    assert [one.name for one in model.inputs] == ["t1", "t2"]
    assert all(np.isfinite(one.cross_rmse) for one in model.sensor_curve)
    # A last row may move by no more than the noise of two readings.
    assert all(one.u < max(0.2 * one.before, 0.02) for one in model.outputs)


@pytest.mark.parametrize(("rows", "moves"), [(1, True), (2, False), (40, False)])
def test_of_readings_that_say_nothing_the_response_is_none(driven, rows, moves):
    record, _, _ = driven
    values = evaluate_columns(record, columns_of(record, record.sensors))
    course = record.displacement if moves else np.ones_like(record.displacement)
    still = Record(**{**vars(record), "displacement": course})
    none = np.empty((0, *course.shape))
    for one in respond(still, values, none, np.arange(record.seconds.size) < rows):
        np.testing.assert_allclose(one.coefficients, 0.0, atol=1e-6)
        assert np.isfinite(one.covariance).all() and one.noise_um > 0.0


def test_of_several_runs_each_is_predicted_from_the_others_and_its_own_zero():
    _, product, loop = run_of(runs_table(5.0, -3.0, 8.0, 1.0))
    (output,) = make_recursion(product, loop, sampling_s=60.0, **FROM).outputs
    # The levels differ by up to 11 um, the displacement follows its sensor exactly.
    assert output.u < 0.01 < output.before


def test_results_of_an_earlier_version_are_refused(driven):
    _, product, loop = driven
    with pytest.raises(RecursionError, match="earlier version; run the campaign again"):
        make_recursion(product.drop_vars("driver_square"), loop, sampling_s=1.0, **FROM)


def test_an_event_is_in_the_fit_and_not_in_the_recursion(rng):
    """Two displacements that follow two sensors, with a step of both in the middle."""
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.1, (80, 2)), axis=0)
    displacement = (temperature - 20.0) @ [[2.0, -1.0], [0.5, 3.0]] + rng.normal(0.0, 0.1, (80, 2))
    displacement[40:] += 4.0
    record, product, loop = run_of(table_of(displacement, temperature, step_s=300.0), "step_event")
    assert "step_event" in [one.effect for one in loop.steps]
    model = make_recursion(product, loop, sampling_s=record.block_s, **FROM)
    assert "not contained, because no reading shows it: step_event" in model.remarks
    assert {one.name for one in model.inputs} <= {*record.sensors, *record.drivers}


def test_a_longer_test_leaves_less_open_also_where_the_record_has_long_blocks():
    """A year of a load that rests and works for days, followed by its displacement and by a sensor."""
    block_h = 30.0
    rng = np.random.default_rng(4)
    load = np.repeat(rng.integers(0, 2, 40), 10).astype(float)
    series = Series(3600.0 * block_h * np.arange(400.0), load, "1")
    displacement = series.lagged(3600.0 * 2 * block_h).values[:, None] * 9.0 + rng.normal(0.0, 0.1, (400, 1))
    temperature = 20.0 + series.lagged(3600.0 * block_h).values[:, None] * 4.0 + rng.normal(0.0, 0.01, (400, 1))
    _, product, loop = run_of(table_of(displacement, temperature, load, step_s=3600.0 * block_h))
    widths = [one.left for one in propose_tests(product, loop)]
    # Random duties differ: a longer one is worse by chance by a little at most.
    assert len(widths) == 4 and all(later < 1.2 * earlier for earlier, later in itertools.pairwise(widths))


def test_a_next_test_in_shorter_steps_than_the_blocks_leaves_as_much_open(rng):
    """Three steps of one level hold what a block of it holds: their noise is larger by the root of three."""
    levels = rng.normal(size=(40, 2))
    one = Response(np.zeros(2), np.diag([4.0, 1.0]), np.array([2.0, 1.0]), noise_um=0.5, ratio=0.0)
    in_blocks = covariance_after(one, 900.0 * np.arange(40.0), levels, steps=1.0)
    in_steps = covariance_after(one, 300.0 * np.arange(120.0), np.repeat(levels, 3, axis=0), steps=3.0)
    np.testing.assert_allclose(in_steps, in_blocks, rtol=1e-9)


def test_a_next_test_leaves_less_open_and_says_what_is_open_now(driven):
    record, product, loop = driven
    tests = list(propose_tests(product, loop, largest={"speed": 9000.0}))
    assert [one.hours for one in tests] == [4.0, 8.0, 12.0, 24.0]
    for one in tests:
        assert set(one.now_um) == set(one.after_um) == set(record.channels)
        assert one.now_um == tests[0].now_um and one.left < 1.0
        # Dwells of whole minutes, none shorter than a quarter of the mean; rest, half and full, so that linear and quadratic heat differ.
        (levels,) = one.levels.values()
        dwells = np.diff([*one.minutes, 60.0 * one.hours])
        assert one.minutes[0] == 0.0 and dwells.min() > 0.0 and dwells[:-1].min() >= 0.25 * one.hold_min - 1.0
        assert set(levels) <= {0.0, 4500.0, 9000.0} and np.diff(levels).all()
    assert choose_test(tests) in tests and 1.0 - choose_test(tests).left >= 0.5 * (1.0 - min(one.left for one in tests))
    # What sensors of the same part tell is known for them together and not for each.
    assert min(tests[0].open_um.values()) > 0.0
    with pytest.raises(DutyPlanError, match="log speed, load or duty"):
        next(propose_tests(product.isel(driver_name=slice(0)), loop.model_copy(update={"steps": ()})))


def wandering_record(rng: np.random.Generator, blocks: int = 200, *, follows: float = 2.0) -> Record:
    """A displacement that follows one of two temperatures 20 min late and wanders beside it."""
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.3, (blocks, 2)), axis=0)
    late = Series(300.0 * np.arange(blocks), temperature[:, :1] - 20.0, "K").lagged(1200.0).values
    course = follows * late + np.cumsum(rng.normal(0.0, 0.02, (blocks, 1)), axis=0) + rng.normal(0.0, 0.05, (blocks, 1))
    return record_of(course, temperature)


def test_the_forecast_from_the_last_value_does_not_know_what_follows(rng):
    record = wandering_record(rng)
    train, none = np.arange(200) < 160, np.zeros((0, 200, 1))
    last = record.displacement[159]
    turned = replace(
        record, displacement=np.where(train[:, None], record.displacement, 2.0 * last - record.displacement)
    )
    one, other = (forecast(each, none, train) for each in (record, turned))
    np.testing.assert_allclose(one.predicted, other.predicted, equal_nan=True)
    np.testing.assert_array_equal(one.u, other.u)
    assert one.error.expected_um == other.error.expected_um
    # It starts at the last value, and follows what came after it.
    assert np.isnan(one.predicted[:160]).all()
    assert one.error.rmse_um < 0.5 * np.sqrt(np.mean((record.displacement[160:] - last) ** 2))
    assert (np.diff(one.u[160:, 0])[[0, 5, 20]] > -0.05).all()


def test_a_forecast_is_wide_where_a_reading_does_what_the_training_time_did_not_show(rng):
    """A temperature that rests in training says nothing of the displacement; the hold-out in which it moves is as open as the response."""
    record, widths = wandering_record(rng), []
    for moved_K in (0.0, 10.0):
        temperature = record.temperature.copy()
        temperature[:, 1] = 20.0 + 0.01 * np.sin(np.arange(200.0)) + moved_K * (np.arange(200) >= 170)
        found = forecast(replace(record, temperature=temperature), np.zeros((0, 200, 1)), np.arange(200) < 160)
        widths.append(found.u[160:, 0])
    np.testing.assert_allclose(widths[1][:10], widths[0][:10])
    assert (widths[1][15:] > 3.0 * widths[0][15:]).all()


def test_a_displacement_that_follows_no_reading_stays_at_its_last_value(rng):
    record = wandering_record(rng, follows=0.0)
    train, columns = np.arange(200) < 160, columns_of(record, record.sensors)
    values, none = evaluate_columns(record, columns), np.zeros((0, 200, 1))
    (one,) = follow(record, columns, values, none, train)
    errors = errors_of(record, values, [replace(one, coefficients=np.zeros(len(columns)))], train)
    np.testing.assert_allclose(errors[160:], record.displacement[160:] - record.displacement[159])


def test_of_several_runs_no_forecast_starts_at_a_last_value_but_each_at_its_own_zero():
    record = reduce_record(runs_table(5.0, -3.0, 8.0))
    train, columns = record.run < 2, columns_of(record, record.sensors)
    values, none = evaluate_columns(record, columns), np.zeros((0, *record.displacement.shape))
    assert forecast(record, none, train) is None
    errors = errors_of(record, values, follow(record, columns, values, none, train), train)
    assert np.abs(errors[~train]).max() < 0.05
