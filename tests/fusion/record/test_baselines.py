"""Plain predictions of a record."""

from __future__ import annotations

import numpy as np

from fusion.record.baselines import plain_predictions
from tests.fusion.record_tables import record_of

BLOCKS = 160
TRAIN = np.arange(BLOCKS) < 120


def record(*, late: bool = False):
    """One channel that follows temperature and load, or the load's first-order response."""
    rng = np.random.default_rng(2)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.1, (BLOCKS, 1)), axis=0)
    load = np.repeat(rng.integers(0, 2, BLOCKS // 8), 8).astype(float)
    response = load.copy()
    if late:
        for k in range(1, BLOCKS):
            response[k] = response[k - 1] + (1.0 - np.exp(-300.0 / 1200.0)) * (load[k] - response[k - 1])
    displacement = (
        2.0 * (temperature - temperature[0]) + 3.0 * response[:, None] + 0.01 * rng.standard_normal((BLOCKS, 1))
    )
    return record_of(displacement, temperature, drivers={"speed": load})


def rms(one, name: str) -> float:
    return float(np.sqrt(np.nanmean((one.displacement - plain_predictions(one, TRAIN)[name])[~TRAIN] ** 2)))


def test_the_simplest_predictions_are_last_value_and_mean():
    one = record()
    predicted = plain_predictions(one, TRAIN)
    assert list(predicted) == ["last_value", "mean", "least_squares", "ridge", "ridge_with_lags"]
    np.testing.assert_array_equal(predicted["last_value"], np.full((BLOCKS, 1), one.displacement[119, 0]))
    np.testing.assert_allclose(predicted["mean"], np.full((BLOCKS, 1), one.displacement[:120, 0].mean()))


def test_regressions_follow_temperatures_and_drivers():
    assert rms(record(), "least_squares") < 0.02
    assert rms(record(), "ridge") < 0.02


def test_lagged_copies_follow_a_late_response():
    assert rms(record(late=True), "ridge_with_lags") < 0.5 * rms(record(late=True), "ridge")


def test_a_channel_with_gaps_is_predicted_from_its_own_blocks():
    one = record()
    one.displacement[5:50] = np.nan
    assert rms(one, "least_squares") < 0.03
