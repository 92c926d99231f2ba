"""Predictions hours ahead: ridge regression by its equation, its penalty by forward chaining, errors by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.record.blocks import Record, reduce_record
from fusion.record.prediction import PENALTIES, chained_parts, channel_rmse, persistence_rmse, predict, rmse
from tests.fusion.record_tables import linear_samples, record_of, table_of


def test_a_linear_record_is_predicted_without_its_displacements(rng):
    record = reduce_record(table_of(*linear_samples(rng)))
    train = record.seconds < 0.7 * record.seconds[-1]
    spoiled = record.displacement.copy()
    spoiled[~train] = 1e6
    predicted = predict(record, record.rise, train)
    blind = predict(type(record)(**{**vars(record), "displacement": spoiled}), record.rise, train)
    np.testing.assert_array_equal(predicted.predicted, blind.predicted)
    # Block means of an exactly linear record are exactly linear; the least penalty leaves a millionth of the variance.
    assert rmse(record, predicted.predicted, ~train) < 0.02 * record.displacement.std()
    rebuilt = (record.rise - predicted.centre) @ predicted.coefficients
    offset = predicted.predicted - rebuilt
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1e-9)


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
    np.testing.assert_allclose(told.centre, columns[train].mean(axis=0))
    offset = told.predicted - (columns - told.centre) @ told.coefficients
    np.testing.assert_allclose(offset, np.tile(record.displacement[train].mean(axis=0), (160, 1)), rtol=1e-8)


def test_penalties_reach_from_least_squares_to_hardly_any_coefficient():
    np.testing.assert_allclose(np.diff(np.log10(PENALTIES)), 0.5)
    assert PENALTIES[0] == pytest.approx(1e-5) and PENALTIES[-1] == pytest.approx(10.0**1.5)


def test_more_noise_asks_for_more_shrinkage(rng):
    record, columns = noisy(rng, noise=0.01)
    loud = replace(record, displacement=record.displacement + 20.0 * rng.standard_normal((160, 2)))
    train = np.arange(160) < 120
    assert predict(record, columns, train).penalty < predict(loud, columns, train).penalty


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
    np.testing.assert_allclose(channel_rmse(record, predicted, where), [np.sqrt(5.0), 5.0])
    assert rmse(record, predicted, where) == pytest.approx(0.5 * (np.sqrt(5.0) + 5.0))
    np.testing.assert_array_equal(channel_rmse(record, predicted, ~where), [7.0, np.nan])
    assert rmse(record, predicted, ~where) == 7.0


def test_persistence_repeats_the_last_value_that_was_measured():
    record = record_of(np.array([[1.0, 5.0], [2.0, np.nan], [6.0, 9.0], [4.0, 3.0]]), np.zeros((4, 1)))
    train = np.array([True, True, False, False])
    # Channel 1 stays at 2, channel 2 at 5.
    np.testing.assert_allclose(
        persistence_rmse(record, train, ~train), [np.sqrt((16.0 + 4.0) / 2), np.sqrt((16.0 + 4.0) / 2)]
    )
