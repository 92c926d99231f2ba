"""Records on blocks: means, gaps, pauses, load cycles; predictions that learn nothing from what they predict."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.record.blocks import RecordError, chained_blocks, independent, reduce_record
from fusion.record.prediction import predict, rmse
from tests.fusion.record_tables import table_of


def plain(rng, samples=2000, sensors=4, channels=2):
    """Temperatures that wander, displacements that follow them exactly, a driver that switches every 200 samples."""
    temperature = np.cumsum(rng.normal(0.0, 0.05, (samples, sensors)), axis=0) + 20.0
    displacement = (temperature - 20.0) @ rng.normal(0.0, 2.0, (sensors, channels))
    return displacement, temperature, (np.arange(samples) // 200 % 2) * 3000.0


def test_blocks_hold_the_means_of_their_samples(rng):
    displacement, temperature, speed = plain(rng)
    record = reduce_record(table_of(displacement, temperature, speed))
    assert record.block_s == 240.0  # 2,000 samples a minute apart in at most 600 blocks
    np.testing.assert_allclose(record.displacement[7], displacement[28:32].mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(record.temperature[7], temperature[28:32].mean(axis=0), rtol=1e-12)
    assert record.seconds[7] == pytest.approx(np.mean(np.arange(28, 32) * 60.0))
    np.testing.assert_allclose(record.drivers["speed"][2][:50], np.zeros(50))
    assert record.drivers["speed"][1].max() == 1.0


def test_inputs_stay_as_they_are(rng):
    table = table_of(*plain(rng))
    before = table.copy(deep=True)
    reduce_record(table)
    assert table.identical(before)


def test_gaps_are_counted_and_pauses_left_out(rng):
    displacement, temperature, speed = plain(rng)
    temperature[400:420, 1] = np.nan
    displacement[800:808, 0] = np.nan
    table = table_of(displacement, temperature, speed)
    record = reduce_record(table.isel(time=np.r_[0:1000, 1200:2000]))
    assert record.gaps == {"t2": 6}  # 1,800 samples in blocks of three
    assert int(np.isnan(record.displacement).sum()) == 2
    pauses = np.diff(record.seconds)
    assert (pauses > 1.5 * record.block_s).sum() == 1
    assert pauses.max() == pytest.approx(200 * 60.0, abs=record.block_s)


def test_a_sensor_that_tells_nothing_of_its_own_is_left_out(rng):
    displacement, temperature, speed = plain(rng)
    temperature[:, 3] = 0.5 * temperature[:, 0] + 0.5 * temperature[:, 1] + 1.0
    record = reduce_record(table_of(displacement, temperature, speed))
    assert record.duplicates == ("t4",)
    assert record.sensors == ("t1", "t2", "t3")
    assert independent(np.zeros((5, 2))) == []


def test_parts_begin_where_the_load_starts():
    seconds = np.arange(600) * 300.0
    speed = np.where(np.arange(600) % 100 < 40, 0.0, 1.0)  # starts at 40, 140, ... 540
    parts = chained_blocks(seconds, [speed])
    assert [int(np.flatnonzero(parts == k)[0]) for k in range(1, parts.max() + 1)] == [140, 240, 340, 440, 540]
    rare = chained_blocks(
        seconds, [np.where(np.isin(np.arange(600) // 10, (12, 30, 52)), 0.0, 1.0)]
    )  # rests three times
    np.testing.assert_array_equal(np.flatnonzero(np.diff(rare)) + 1, [130, 220, 310, 420, 530])
    without = chained_blocks(seconds, [])
    np.testing.assert_array_equal(np.bincount(without), np.full(8, 75))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda table: table.isel(time=slice(0, 30)),
            "record.csv: 30 samples are too few to hold a part out; a record needs at least 40",
        ),
        (
            lambda table: table.assign(temperature=table["temperature"].where(table["sensor"] != "t2")),
            'record.csv: column "t2" has values in 0 of 500 blocks of 240 s; leave it out of [record]',
        ),
        (
            lambda table: table.assign(displacement=table["displacement"].where(table["channel"] != "ch1")),
            'record.csv: channel "ch1" holds too few values; leave it out of [record]',
        ),
    ],
)
def test_a_record_that_cannot_be_modelled_is_refused(rng, spoil, message):
    with pytest.raises(RecordError) as refused:
        reduce_record(spoil(table_of(*plain(rng))))
    assert str(refused.value) == message


def test_a_linear_record_is_predicted_without_its_displacements(rng):
    record = reduce_record(table_of(*plain(rng)))
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
