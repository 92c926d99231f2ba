"""The model of a record: every channel fitted by itself, gains added over channels, draws alike where channels are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.analysis.drift_model.gains import by_width, profile_gains
from fusion.analysis.drift_model.model import SINGLE, Term, scaled_systems
from fusion.analysis.drift_model.predictions import (
    PENALTIES,
    chained_parts,
    channel_rmse,
    last_values,
    plain_predictions,
    predict,
    rmse,
)
from fusion.analysis.drift_model.record import channel_gains, declare, fit_record, hold_out, simulate_channels
from fusion.analysis.drift_model.record_data import Record, RecordedRun, RecordError, reduce_record
from fusion.analysis.effects.effect import Candidate
from tests.fusion.record_tables import record_of, runs_table, table_of, twin_table

BLOCKS = 120
ALL = np.ones(BLOCKS, bool)


def term(columns: np.ndarray) -> Term:
    columns = columns if columns.ndim == 2 else columns[:, None]
    return Term("a", Candidate(columns, {}, ("um",) * columns.shape[1]))


def test_channels_that_watch_one_part_are_simulated_alike(rng):
    """Two channels with one drift and one noise are one channel: independent draws would count its evidence twice."""
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.03, (1200, 2)), axis=0)
    one = (
        temperature[:, :1]
        - 20.0
        + np.cumsum(rng.normal(0.0, 0.05, (1200, 1)), axis=0)
        + rng.normal(0.0, 0.2, (1200, 1))
    )
    record = reduce_record(table_of(np.column_stack([one, one + rng.normal(0.0, 0.01, (1200, 1))]), temperature))
    model = fit_record(record, declare(["quasi_static"], record), np.ones(record.seconds.size, bool))
    first, second = simulate_channels(model, rng, draws=40)
    change = [np.corrcoef(np.diff(first[:, k]), np.diff(second[:, k]))[0, 1] for k in range(40)]
    assert np.median(change) > 0.9


def test_every_channel_has_coefficients_of_its_own_from_its_own_blocks(rng):
    column = np.sin(np.arange(BLOCKS) / 7.0)
    displacement = column[:, None] * [3.0, -1.0] + [5.0, 0.0] + 0.05 * rng.standard_normal((BLOCKS, 2))
    displacement[30:40, 1] = np.nan
    record = record_of(displacement, np.zeros((BLOCKS, 1)))
    used = np.arange(BLOCKS) < 100
    model = fit_record(record, [term(column)], used)
    np.testing.assert_array_equal(model.rows[0], np.arange(100))
    np.testing.assert_array_equal(model.rows[1], np.r_[0:30, 40:100])
    for fit, size in zip(model.channels, (3.0, -1.0), strict=True):
        np.testing.assert_allclose(fit.design[:, 0], 1.0)
        assert fit.coefficients[1] == pytest.approx(size, abs=4.0 * fit.coefficients_u[1])
        assert fit.coefficients_u[1] < 0.05
    np.testing.assert_array_equal(model.sigma, [fit.sigma for fit in model.channels])
    assert model.sigma == pytest.approx([0.05, 0.05], rel=0.3)


def test_a_column_that_depends_on_others_in_the_used_blocks_is_left_out(rng):
    columns = rng.standard_normal((BLOCKS, 2))
    used = np.arange(BLOCKS) < 100
    third = np.where(used, columns[:, 0] - columns[:, 1], 9.0)
    record = record_of(rng.standard_normal((BLOCKS, 1)), np.zeros((BLOCKS, 1)))
    model = fit_record(record, [term(np.column_stack([columns, third]))], used)
    np.testing.assert_array_equal(model.channels[0].design[:, 1:3], columns[used])


def test_more_columns_than_an_eighth_of_the_blocks_are_reduced_to_their_leading_components(rng):
    courses = rng.standard_normal((BLOCKS, 2))
    # Forty alike sensors hold two courses, and hardly anything else.
    sensors = courses @ rng.standard_normal((2, 40)) + 1e-9 * rng.standard_normal((BLOCKS, 40))
    record = record_of(courses @ [[1.0], [2.0]] + 0.01 * rng.standard_normal((BLOCKS, 1)), np.zeros((BLOCKS, 1)))
    model = fit_record(record, [term(sensors)], ALL)
    # 120 blocks allow fifteen columns of one effect.
    assert model.channels[0].design.shape[1] <= 1 + 15 + 1
    assert model.sigma[0] < 0.02
    few = fit_record(record, [term(sensors[:, :15])], ALL)
    np.testing.assert_array_equal(few.channels[0].design[:, 1], sensors[:, 0])


def test_a_channel_with_fewer_than_two_blocks_per_coefficient_is_refused(rng):
    displacement = rng.standard_normal((BLOCKS, 2))
    record = record_of(displacement, np.zeros((BLOCKS, 1)))
    terms = [term(rng.standard_normal((BLOCKS, 4)))]
    displacement[10:, 1] = np.nan
    fit_record(record, terms, ALL)
    displacement[9, 1] = np.nan
    with pytest.raises(
        RecordError, match='channel "ch2" has 9 blocks for a model of 5 coefficients; record for longer'
    ):
        fit_record(record, terms, ALL)


def test_a_displacement_that_follows_exactly_can_be_fitted():
    column = np.sin(np.arange(BLOCKS) / 7.0)
    model = fit_record(record_of(3.0 * column[:, None], np.zeros((BLOCKS, 1))), [term(column)], ALL)
    assert model.channels[0].coefficients[1] == pytest.approx(3.0, rel=1e-4)
    assert 0.0 < model.sigma[0] < 1e-4


def test_gains_add_over_channels_and_every_further_coefficient_costs_one_in_each(rng):
    wave = np.sin(np.arange(BLOCKS) / 3.0)
    displacement = wave[:, None] * [1.0, 2.0] + 0.5 * rng.standard_normal((BLOCKS, 2))
    model = fit_record(record_of(displacement, np.zeros((BLOCKS, 1))), [], ALL)
    candidates = [term(wave).candidate, term(np.column_stack([wave, np.cos(np.arange(BLOCKS) / 3.0)])).candidate]
    draws = [rng.standard_normal((BLOCKS, 5)) for _ in range(2)]
    expected = np.zeros((2, 6))
    for fit, drawn in zip(model.channels, draws, strict=True):
        gains = profile_gains(
            scaled_systems(fit, SINGLE), np.column_stack([fit.response, drawn]), fit.design, by_width(candidates, ALL)
        )
        expected += gains.gain
    told = channel_gains(model, candidates, draws)
    np.testing.assert_allclose(told.gain, expected - np.array([[0.0], [2.0]]), rtol=1e-10)
    assert told.separable.all() and channel_gains(model, candidates).gain.shape == (2, 1)
    np.testing.assert_allclose(channel_gains(model, candidates).gain[:, 0], told.gain[:, 0])


def test_a_candidate_counts_only_where_it_can_be_told_from_the_model(rng):
    """Where a channel was measured the candidate is constant; in the other channel it moves."""
    late = (np.arange(BLOCKS) >= 60).astype(float)
    displacement = late[:, None] * [1.0, 1.0] + 0.1 * rng.standard_normal((BLOCKS, 2))
    displacement[60:, 0] = np.nan
    record = record_of(displacement, np.zeros((BLOCKS, 1)))
    both = channel_gains(fit_record(record, [], ALL), [term(late).candidate])
    alone = replace(record, displacement=displacement[:, 1:], channels=("ch2",))
    np.testing.assert_allclose(
        both.gain, channel_gains(fit_record(alone, [], ALL), [term(late).candidate]).gain, rtol=1e-4
    )
    assert both.separable.tolist() == [True]


def test_simulated_channels_have_the_noise_of_the_fit(rng):
    displacement = rng.standard_normal((BLOCKS, 2)) * [0.1, 2.0]
    model = fit_record(record_of(displacement, np.zeros((BLOCKS, 1))), [], ALL)
    draws = simulate_channels(model, rng, draws=100)
    assert [drawn.shape for drawn in draws] == [(BLOCKS, 100)] * 2
    # The first block holds no drift yet: two draws from the noise of the fit.
    for drawn, sigma in zip(draws, model.sigma, strict=True):
        assert drawn[0].std() == pytest.approx(sigma, rel=0.3)
    # Independent channels are drawn independently.
    change = [np.corrcoef(np.diff(draws[0][:, k]), np.diff(draws[1][:, k]))[0, 1] for k in range(100)]
    assert abs(np.mean(change)) < 0.2


def test_simulated_channels_drift_as_the_fit_does(rng):
    """A random walk of 0.5 um a block beside noise of 0.1 um: after 120 blocks the draws scatter by some 5.5 um."""
    walk = np.cumsum(0.5 * rng.standard_normal((BLOCKS, 1)), axis=0)
    model = fit_record(record_of(walk + 0.1 * rng.standard_normal((BLOCKS, 1)), np.zeros((BLOCKS, 1))), [], ALL)
    (draws,) = simulate_channels(model, rng, draws=400)
    (fit,) = model.channels
    assert fit.system.order == 1
    expected = fit.sigma * np.sqrt(fit.system.ratios[0] * 300.0 * (BLOCKS - 1))
    assert expected == pytest.approx(5.5, rel=0.3)
    # The variances are drawn as the likelihood leaves them, up to ten times the estimate.
    assert 0.7 < (draws[-1] - draws[0]).std() / expected < 2.5


# Predictions hours ahead: ridge regression by its equation, its penalty by forward chaining, errors by hand.


def noisy(rng: np.random.Generator, *, blocks: int = 160, noise: float = 0.5) -> tuple[Record, np.ndarray]:
    columns = rng.standard_normal((blocks, 3)) * [1.0, 10.0, 0.1] + [0.0, 5.0, 0.0]
    displacement = columns @ np.array([[1.0, -1.0], [0.2, 0.1], [3.0, 0.0]]) + noise * rng.standard_normal((blocks, 2))
    return record_of(displacement + np.array([4.0, -2.0]), np.zeros((blocks, 1))), columns


def ridge(columns: np.ndarray, y: np.ndarray, train: np.ndarray, penalty: float) -> np.ndarray:
    """Prediction of all blocks: least squares on standardised columns with the penalty on the sum of their squares."""
    standard = (columns - columns[train].mean(axis=0)) / columns[train].std(axis=0)
    x, n = standard[train], train.sum()
    middle = y[train].mean(axis=0)
    normal = x.T @ x / n + penalty * np.eye(x.shape[1])
    return standard @ np.linalg.solve(normal, x.T @ (y[train] - middle) / n) + middle


def test_the_prediction_is_ridge_regression_with_the_penalty_that_chained_best(rng):
    record, columns = noisy(rng)
    train = np.arange(160) < 120
    told = predict(record, columns, train)
    errors = np.full(PENALTIES.size, np.nan)
    for k, penalty in enumerate(PENALTIES):
        parts = []
        # Parts of 20 blocks; those of the later half of the training blocks are predicted from those before.
        for number in (3, 4, 5):
            missed = record.displacement - ridge(columns, record.displacement, record.chained < number, penalty)
            part = record.chained == number
            parts.append(np.sqrt((missed[part] ** 2).mean(axis=0)).mean())
        errors[k] = np.mean(parts)
    best = int(np.argmin(errors))
    assert 0 < best < PENALTIES.size - 1
    assert told.penalty == PENALTIES[best]
    assert told.chained_rmse == pytest.approx(errors[best])
    np.testing.assert_allclose(told.predicted, ridge(columns, record.displacement, train, told.penalty), rtol=1e-8)
    offset = told.predicted - (columns - columns[train].mean(axis=0)) @ told.coefficients
    np.testing.assert_allclose(offset, np.tile(record.displacement[train].mean(axis=0), (160, 1)), rtol=1e-8)


def test_a_column_that_never_moves_in_training_gets_no_coefficient(rng):
    record, columns = noisy(rng)
    train = np.arange(160) < 120
    still = np.where(train, 1.0, 9.0)[:, None]
    told = predict(record, np.column_stack([columns, still]), train)
    np.testing.assert_allclose(told.predicted, predict(record, columns, train).predicted, rtol=1e-9)
    np.testing.assert_array_equal(told.coefficients[3], 0.0)


def test_a_channel_that_misses_blocks_is_predicted_from_its_own(rng):
    record, columns = noisy(rng, noise=1e-6)
    holed = record.displacement.copy()
    holed[10:60, 0] = np.nan
    told = predict(replace(record, displacement=holed), columns, np.arange(160) < 120)
    # The columns' means over its own blocks differ from those over all: its level must not.
    assert np.abs(told.predicted[120:, 0] - record.displacement[120:, 0]).max() < 1e-3


def test_without_later_parts_there_is_no_chained_error(rng):
    record, columns = noisy(rng)
    one_part = replace(record, chained=np.zeros(160, int))
    told = predict(one_part, columns, np.arange(160) < 120)
    assert np.isnan(told.chained_rmse) and told.penalty == PENALTIES[PENALTIES.size // 2]


def test_parts_of_the_later_half_of_the_training_blocks_are_asked(rng):
    record = record_of(np.zeros((80, 1)), np.zeros((80, 1)), parts=8)
    assert chained_parts(record, np.ones(80, bool)) == [4, 5, 6, 7]
    assert chained_parts(record, np.arange(80) < 60) == [3, 4, 5]
    # 59 blocks: part 3 has 30 before it, more than half.
    assert chained_parts(record, np.arange(80) < 59) == [3, 4, 5]
    assert chained_parts(record, np.arange(80) < 61) == [4, 5, 6]


def test_errors_are_those_of_the_blocks_that_were_measured():
    record = record_of(np.array([[1.0, 5.0], [np.nan, 5.0], [3.0, np.nan], [7.0, np.nan]]), np.zeros((4, 1)))
    predicted = np.zeros((4, 2))
    where = np.array([True, True, True, False])
    np.testing.assert_allclose(channel_rmse((record.displacement - predicted)[where]), [np.sqrt(5.0), 5.0])
    assert rmse((record.displacement - predicted)[where]) == pytest.approx(0.5 * (np.sqrt(5.0) + 5.0))
    np.testing.assert_array_equal(channel_rmse((record.displacement - predicted)[~where]), [7.0, np.nan])
    assert rmse((record.displacement - predicted)[~where]) == 7.0


def test_persistence_repeats_the_last_value_that_was_measured():
    record = record_of(np.array([[1.0, 5.0], [2.0, np.nan], [6.0, 9.0], [4.0, 3.0]]), np.zeros((4, 1)))
    train = np.array([True, True, False, False])
    # Channel 1 stays at 2, channel 2 at 5.
    np.testing.assert_allclose(
        channel_rmse((record.displacement - last_values(record, train))[~train]),
        [np.sqrt((16.0 + 4.0) / 2), np.sqrt((16.0 + 4.0) / 2)],
    )


# Hold-out set and declared model of a record.


def test_what_a_record_cannot_declare_is_refused():
    record = reduce_record(twin_table(seed=44))
    with pytest.raises(RecordError) as refused:
        declare(["dead_path"], record)
    assert str(refused.value) == (
        "declared effect 'dead_path' cannot be computed from a record; declare \"quasi_static\" (every displacement linear in the "
        "temperatures), the search tries the rest of the library"
    )


def test_the_last_fifth_of_the_time_is_held_out():
    record = record_of(np.zeros((101, 1)), np.zeros((101, 1)), block_s=360.0)
    train, description = hold_out(record)
    # Blocks from 180 s to 36180 s: four fifths of the way between lie at 28980 s, the middle of block 80.
    np.testing.assert_array_equal(train, np.arange(101) < 80)
    assert description.startswith("8.1 h to 10.1 h held out; coefficients from the time before, nothing re-zeroed")


def test_time_counts_and_not_the_number_of_blocks():
    record = record_of(np.zeros((100, 1)), np.zeros((100, 1)))
    record.seconds[50:] += 100 * 300.0
    train, _ = hold_out(record)
    # A pause of 100 blocks in the middle: the last fifth of the time holds forty of the blocks.
    assert train.sum() == 60


def test_every_displacement_is_declared_linear_in_the_temperatures():
    record = record_of(np.zeros((3, 1)), np.array([[20.0, 30.0], [21.0, 33.0], [22.0, 36.0]]))
    (term,) = declare(["quasi_static"], record)
    np.testing.assert_array_equal(term.candidate.columns, [[0.0, 0.0], [1.0, 3.0], [2.0, 6.0]])
    assert (term.effect, term.candidate.units) == ("quasi_static", ("um/K", "um/K"))
    assert declare([], record) == []


def test_runs_are_held_out_as_a_whole():
    train, description = hold_out(reduce_record(runs_table(0.0, 1.0, 2.0)))
    np.testing.assert_array_equal(train, np.arange(180) < 120)
    assert description.startswith(
        "run r3.csv held out; coefficients from runs r1.csv, r2.csv, every run from its own zero"
    )


def test_a_hold_out_set_without_a_displacement_is_refused():
    displacement = np.zeros((100, 1))
    displacement[70:] = np.nan
    with pytest.raises(RecordError, match="no displacement was measured in what is held out"):
        hold_out(record_of(displacement, np.zeros((100, 1))))


# Plain predictions of a record.


MANY = 160
TRAIN = np.arange(MANY) < 120


def record(*, late: bool = False):
    """One channel that follows temperature and load, or the load's first-order response."""
    rng = np.random.default_rng(2)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.1, (MANY, 1)), axis=0)
    load = np.repeat(rng.integers(0, 2, MANY // 8), 8).astype(float)
    response = load.copy()
    if late:
        for k in range(1, MANY):
            response[k] = response[k - 1] + (1.0 - np.exp(-300.0 / 1200.0)) * (load[k] - response[k - 1])
    displacement = (
        2.0 * (temperature - temperature[0]) + 3.0 * response[:, None] + 0.01 * rng.standard_normal((MANY, 1))
    )
    return record_of(displacement, temperature, drivers={"speed": load})


def rms(one, name: str) -> float:
    return float(np.sqrt(np.nanmean((one.displacement - plain_predictions(one, TRAIN)[name])[~TRAIN] ** 2)))


def test_the_simplest_predictions_are_last_value_and_mean():
    one = record()
    predicted = plain_predictions(one, TRAIN)
    assert list(predicted) == ["last_value", "mean", "least_squares", "ridge", "ridge_with_lags"]
    np.testing.assert_array_equal(predicted["last_value"], np.full((MANY, 1), one.displacement[119, 0]))
    np.testing.assert_allclose(predicted["mean"], np.full((MANY, 1), one.displacement[:120, 0].mean()))


def test_of_several_runs_the_mean_course_of_the_others_is_one_too():
    one, first = record(), (0, 50, 100)
    course = np.sin(np.arange(60) / 9.0)[:, None]
    runs = tuple(RecordedRun(f"r{k}", one.start, float(one.seconds[at]), k == 2) for k, at in enumerate(first))
    measured = np.concatenate([course[:50], 3.0 * course[:50], 5.0 * course])
    several = replace(one, displacement=measured, runs=runs, first=first)
    predicted = plain_predictions(several, several.run < 2)["mean_run"]
    # Of the two others for the run that is held out, kept beyond their end; of a training run the one other.
    np.testing.assert_allclose(predicted[several.run == 2], 2.0 * course[np.minimum(np.arange(60), 49)])
    np.testing.assert_allclose(predicted[several.run == 0], 3.0 * course[:50])


def test_how_a_run_differs_from_the_others_follows_how_its_readings_differ(rng):
    """Six runs, each from a level of its own: a course that no reading shows, and 2 um/K times what one temperature differs by."""
    number, place = np.divmod(np.arange(240), 40)
    course, warm = 9.0 * np.sin(place / 6.0), (1.0 + 0.3 * rng.standard_normal(6))[number]
    rise = 10.0 * warm * (1.0 - np.exp(-place / 15.0))
    temperature = (20.0 + 5.0 * rng.standard_normal(6))[number] + rise
    one = record_of((course + 2.0 * rise)[:, None], temperature[:, None])
    runs = tuple(RecordedRun(f"r{k}", one.start, float(one.seconds[40 * k]), k == 5) for k in range(6))
    several = replace(one, runs=runs, first=tuple(range(0, 240, 40)))
    predicted = plain_predictions(several, number < 5)
    errors = {
        name: float(np.sqrt(np.mean((one.displacement - values)[number == 5] ** 2)))
        for name, values in predicted.items()
    }
    assert errors["run_differences"] < 0.05 < 0.2 * min(errors["mean_run"], errors["ridge_with_lags"])


def test_regressions_follow_temperatures_and_drivers():
    assert rms(record(), "least_squares") < 0.02
    assert rms(record(), "ridge") < 0.02


def test_lagged_copies_follow_a_late_response():
    assert rms(record(late=True), "ridge_with_lags") < 0.5 * rms(record(late=True), "ridge")


def test_a_channel_with_gaps_is_predicted_from_its_own_blocks():
    one = record()
    one.displacement[5:50] = np.nan
    assert rms(one, "least_squares") < 0.03
