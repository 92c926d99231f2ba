"""Records on blocks: means, gaps, pauses, load cycles, switchings."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.drift_model.record import examine_record
from fusion.analysis.drift_model.record_data import RecordError, chained_blocks, independent, reduce_record
from tests.fusion.record_tables import linear_samples, record_of, runs_table, table_of, twin_table
from tests.soak.simulator import first_order

pytestmark = pytest.mark.long


def test_blocks_hold_the_means_of_their_samples(rng):
    displacement, temperature, speed = linear_samples(rng)
    record = reduce_record(table_of(displacement, temperature, speed))
    assert record.block_s == 240.0  # 2,000 samples a minute apart in at most 600 blocks
    np.testing.assert_allclose(record.displacement[7], displacement[28:32].mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(record.temperature[7], temperature[28:32].mean(axis=0), rtol=1e-12)
    assert record.seconds[7] == pytest.approx(np.mean(np.arange(28, 32) * 60.0))
    assert record.driver_sizes["speed"][0] == 3000.0
    np.testing.assert_allclose(record.drivers["speed"][2][:50], np.zeros(50))
    assert record.drivers["speed"][1].max() == 1.0


def test_a_load_that_never_changes_is_left_out_by_name_or_kept_where_a_model_reads_it(rng):
    displacement, temperature, speed = linear_samples(rng)
    table = table_of(displacement, temperature, np.full(speed.size, 6000.0))
    assert reduce_record(table).constant_drivers == ("speed (6000 1/min)",) and not reduce_record(table).drivers
    kept = reduce_record(table, constants=["speed"])
    assert kept.constant_drivers == () and kept.driver_sizes["speed"] == (6000.0, "1/min")
    np.testing.assert_array_equal(kept.drivers["speed"][2], 1.0)
    still = table_of(displacement, temperature, np.zeros(speed.size))
    assert (
        reduce_record(still).constant_drivers == ()
        and not reduce_record(still, constants=["speed"]).drivers["speed"][1].any()
    )


def test_digits_count_less_in_means_only_where_the_readings_dither(rng):
    time = np.linspace(0.0, 20.0, 2000)
    smooth, dithered = np.round(time), np.round(time + rng.normal(0.0, 1.0, 2000))
    record = reduce_record(table_of(np.column_stack([smooth, dithered, np.sqrt(time)]), np.round(time, 1)[:, None]))
    assert record.digits == pytest.approx({"t1": 0.1, "ch1": 1.0, "ch2": 1.0, "ch3": 0.0})
    # 2,000 samples in blocks of four.
    np.testing.assert_allclose(record.displacement_step, [1.0, 0.5, 0.0])
    np.testing.assert_allclose(record.temperature_step, [0.1])


def test_inputs_stay_as_they_are(rng):
    table = table_of(*linear_samples(rng))
    before = table.copy(deep=True)
    reduce_record(table)
    assert table.identical(before)


def test_gaps_are_counted_and_pauses_left_out(rng):
    displacement, temperature, speed = linear_samples(rng)
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
    displacement, temperature, speed = linear_samples(rng)
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
            lambda table: table.assign(displacement=table["displacement"].where(table["channel"] == "")),
            'record.csv: channel "ch1" holds too few values; channel "ch2" holds too few values; leave it out of [record]',
        ),
    ],
)
def test_a_record_that_cannot_be_modelled_is_refused(rng, spoil, message):
    with pytest.raises(RecordError) as refused:
        reduce_record(spoil(table_of(*linear_samples(rng))))
    assert str(refused.value) == message


@pytest.mark.parametrize(("samples", "block_s"), [(600, 60.0), (601, 120.0), (1201, 180.0)])
def test_a_record_has_at_most_six_hundred_blocks(samples, block_s, rng):
    record = reduce_record(table_of(*linear_samples(rng, samples)))
    assert record.block_s == block_s
    assert record.seconds.size == -(-samples * 60 // int(block_s))


@pytest.mark.parametrize(("burst", "bursts"), [(3, 1000), (1, 700), (10, 90)])
def test_samples_in_bursts_share_blocks(burst, bursts, rng):
    """Some samples a second apart, every hour."""
    samples = burst * bursts
    seconds = (3600.0 * np.arange(bursts)[:, None] + np.arange(burst)).ravel()
    table = table_of(*linear_samples(rng, samples))
    record = reduce_record(table.assign_coords(time=table["time"].values[0] + np.round(seconds * 1e9).astype("m8[ns]")))
    # No more than twice as long as they must be.
    assert min(bursts, 300) <= record.seconds.size <= 660


def test_samples_of_one_time_share_their_block(rng):
    """After a clock that went back, half of the times stand twice: each block holds the mean of both."""
    table = table_of(*linear_samples(rng, 400))
    again = np.sort(np.concatenate([np.arange(200), np.arange(200)]))
    record = reduce_record(table.assign_coords(time=table["time"].values[again]))
    values = table["displacement"].values
    means = 0.5 * (values[0::2] + values[1::2])
    np.testing.assert_allclose(np.diff(record.displacement, axis=0), np.diff(means, axis=0), atol=1e-9)  # rounding
    assert record.block_s == 60.0


def test_a_sample_that_comes_a_little_early_belongs_to_its_own_block(rng):
    table = table_of(*linear_samples(rng, 1200))
    jitter = np.zeros(1200)
    jitter[2::2] = -0.3 * 60.0
    moved = table.assign_coords(time=table["time"].values + np.round(jitter * 1e9).astype("m8[ns]"))
    np.testing.assert_array_equal(reduce_record(moved).displacement, reduce_record(table).displacement)


def test_what_never_moves_is_refused(rng):
    displacement, temperature, speed = linear_samples(rng)
    with pytest.raises(RecordError, match='channel "ch1" never moves; leave it out'):
        reduce_record(table_of(displacement[:, :1] * 0.0, temperature, speed))
    with pytest.raises(RecordError, match="no temperature changes; nothing that a displacement could follow"):
        reduce_record(table_of(displacement, np.full_like(temperature, 20.0), speed))


@pytest.mark.parametrize(
    ("empty", "fault"),
    [
        (slice(0, None), "holds too few values"),
        (slice(100, None), "holds too few values"),
        (slice(0, 1000), "has too few values at the beginning"),
        (None, "never moves"),
    ],
)
def test_a_channel_that_cannot_be_modelled_does_not_spoil_the_others(rng, empty, fault):
    displacement, temperature, speed = linear_samples(rng)
    if empty is None:
        displacement[:, 1] = 7.0
    else:
        displacement[empty, 1] = np.nan
    record = reduce_record(table_of(displacement, temperature, speed))
    assert record.channels == ("ch1",)
    assert record.unusable == {"ch2": fault}


def test_drivers_are_powers_of_shares_of_their_largest_size(rng):
    displacement, temperature, _ = linear_samples(rng, 600)
    speed = np.where(np.arange(600) < 300, -4000.0, 2000.0)
    record = reduce_record(table_of(displacement, temperature, speed))
    np.testing.assert_allclose(record.drivers["speed"][1], np.where(np.arange(600) < 300, -1.0, 0.5))
    np.testing.assert_allclose(record.drivers["speed"][2], np.where(np.arange(600) < 300, 1.0, 0.25))
    assert reduce_record(table_of(displacement, temperature, np.full(600, 3000.0))).drivers == {}
    assert reduce_record(table_of(displacement, temperature, np.zeros(600))).drivers == {}


def test_a_power_is_averaged_after_it_is_raised(rng):
    """Heat follows a power of the speed: the mean of the squares, not the square of the mean."""
    displacement, temperature, _ = linear_samples(rng, 1200)
    record = reduce_record(table_of(displacement, temperature, np.tile([0.0, 1000.0], 600)))
    np.testing.assert_allclose(record.drivers["speed"][1], 0.5)
    np.testing.assert_allclose(record.drivers["speed"][2], 0.5)


def test_the_noise_of_a_block_mean_falls_with_its_samples(rng):
    displacement, _, speed = linear_samples(rng, 2400)
    alternating = 0.5 * (-1.0) ** np.arange(2400)
    ramp = np.linspace(20.0, 25.0, 2400)
    record = reduce_record(table_of(displacement, (ramp + alternating)[:, None], speed))
    # Second differences of +-2 in units of sqrt(6) standard deviations; four samples a block.
    expected = 1.4826 * 2.0 / np.sqrt(6.0) / np.sqrt(4.0)
    np.testing.assert_allclose(record.temperature_noise, [expected], rtol=1e-4)


@pytest.mark.parametrize(("share", "kept"), [(0.9e-8, [0]), (1.1e-8, [0, 1])])
def test_a_column_is_independent_from_a_share_of_its_variance_on(share, kept):
    first, second = np.tile([1.0, -1.0], 8), np.repeat([1.0, -1.0], 8)
    columns = np.column_stack([first, np.sqrt(1.0 - share) * first + np.sqrt(share) * second]) * [1e3, 1e-3] + 7.0
    assert independent(columns) == kept


def test_what_happens_within_two_blocks_of_a_switching_may_be_its_consequence():
    level = np.select([np.arange(40) < 10, np.arange(40) < 25], [0.0, 1.0], 0.81)
    record = record_of(np.zeros((40, 1)), np.zeros((40, 1)), drivers={"speed": level})
    # A change by 0.19 of the range is no switching.
    np.testing.assert_array_equal(np.flatnonzero(record.switched()), [8, 9, 10, 11, 12])
    other = np.where(np.arange(40) < 31, 5.0, 7.0)
    both = record_of(np.zeros((40, 1)), np.zeros((40, 1)), drivers={"speed": level, "load": other})
    np.testing.assert_array_equal(np.flatnonzero(both.switched()), [8, 9, 10, 11, 12, 29, 30, 31, 32, 33])
    assert not record_of(np.zeros((40, 1)), np.zeros((40, 1))).switched().any()


def test_a_record_is_seen_as_readings_of_one_place(rng):
    displacement = np.array([[1.0, 3.0], [2.0, np.nan], [5.0, 5.0]])
    record = record_of(
        displacement, np.array([[20.0, 30.0], [21.0, 33.0], [22.0, 36.0]]), drivers={"speed": np.arange(3.0)}
    )
    readings = record.view()
    np.testing.assert_array_equal(readings.response, [2.0, 2.0, 5.0])
    np.testing.assert_array_equal(readings.seconds, [150.0, 450.0, 750.0])
    np.testing.assert_array_equal(readings.cycle, [1, 2, 3])
    assert set(readings.series) == {"mean_rise", "temperature t1", "temperature t2", "speed"}
    np.testing.assert_array_equal(readings.series["mean_rise"].values, [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(readings.series["temperature t2"].values, [0.0, 3.0, 6.0])
    assert (readings.series["temperature t1"].units, readings.series["speed"].units) == ("K", "1")
    assert readings.drivers == ("speed",) and set(readings.site.tolist()) == {0}


def test_a_start_of_the_load_early_late_or_soon_after_another_begins_no_part():
    """800 blocks: an eighth is 100. Starts at 50 (early), 150, 200 (too soon), 300, 450, 600 and 760 (less than half an eighth left)."""
    seconds = np.arange(801) * 300.0
    speed = np.zeros(801)
    for start in (50, 150, 200, 300, 450, 600, 760):
        speed[start : start + 20] = 1.0
    parts = chained_blocks(seconds, [speed])
    np.testing.assert_array_equal(np.flatnonzero(np.diff(parts)) + 1, [150, 300, 450, 600])


def test_every_run_has_its_own_zero_and_nothing_crosses_a_border() -> None:
    record = reduce_record(runs_table(5.0, -300.0, 40.0))
    assert record.first == (0, 60, 120)
    starts = list(record.first)
    assert (record.displacement[starts] == 0.0).all()
    assert (record.rise[starts] == 0.0).all()
    np.testing.assert_allclose(record.displacement, 2.0 * record.rise, atol=1e-9)
    # One block lies between two runs, whatever time passed.
    assert np.diff(record.seconds)[59] == 2.0 * record.block_s
    assert [str(one.start)[:10] for one in record.runs] == ["2026-01-05", "2026-01-06", "2026-01-07"]
    assert str(record.time[60])[:16] == "2026-01-06T06:00"
    lagged = record.series(record.temperature, "degC").lagged(3600.0).values
    np.testing.assert_array_equal(lagged[starts], record.temperature[starts])
    # A load that differs from the end of one run to the start of the next was not switched.
    assert not record.switched()[[58, 59, 60, 61]].any()
    assert record.switched()[[18, 19, 20, 21, 22]].all()
    assert all(np.unique(record.run[record.chained == part]).size == 1 for part in np.unique(record.chained))


def test_a_run_without_a_value_of_a_column_is_named() -> None:
    table = runs_table(0.0, 0.0, 0.0)
    table["temperature"].values[60:120] = np.nan
    with pytest.raises(RecordError, match=r'r2\.csv: column "t1" has no value in this run'):
        reduce_record(table)
    table = runs_table(0.0, 0.0, 0.0)
    table["displacement"].values[60:120] = np.nan
    with pytest.raises(RecordError, match=r'channel "ch1" has no value in r2\.csv'):
        reduce_record(table)
    with pytest.raises(RecordError, match="the run fills 5 blocks"):
        reduce_record(runs_table(0.0, 0.0).isel(time=slice(0, 65)))


def test_samples_that_no_instrument_measures_count_as_missing() -> None:
    table = runs_table(0.0, 0.0)
    table["displacement"].values[7] = 3.4e38
    table["driver"].values[9] = -3.4e38
    record = reduce_record(table)
    assert record.impossible == {"ch1": 1, "speed": 1}
    assert record.gaps["speed"] == 1
    assert np.nanmax(np.abs(record.displacement)) < 100.0


def test_a_constant_that_rounding_moves_is_no_column_of_its_own() -> None:
    columns = np.column_stack([np.full(1000, 0.1), np.arange(1000.0)])
    assert independent(columns) == [1]


# Faulty sensors of a record are left out before any model; suspected ones stay.


def test_a_sound_record_passes_as_it_is():
    table = twin_table(seed=31)
    health = examine_record(table, ["quasi_static"])
    assert health.table is table
    assert health.findings == ()


def test_the_only_sensor_of_a_record_may_break(rng):
    temperature = 20.0 + np.linspace(0.0, 5.0, 60)[:, None]
    displacement = 6.0 * (temperature - 20.0) + 0.01 * rng.standard_normal((60, 1))
    temperature[29:] += 51.0
    health = examine_record(table_of(displacement, temperature, step_s=300.0), ["quasi_static"])
    assert health.table["sensor"].values.tolist() == ["t1"]
    assert [(one.sensor, one.kind, one.state) for one in health.findings] == [("t1", "jump", "suspected")]


def test_a_sensor_that_breaks_is_left_out_and_the_error_with_it_is_stated():
    table = twin_table(seed=31)
    table["temperature"][900:, 2] += 28.0
    health = examine_record(table, ["quasi_static"])
    (part,) = health.findings
    assert "t3" not in health.table["sensor"].values
    assert (part.sensor, part.kind, part.state) == ("t3", "jump", "left_out")
    # The break lies in the training part, so that a model with it learns not to trust the sensor; without it nothing has to be learnt.
    assert part.rmse_without_um < part.rmse_with_um


@pytest.mark.parametrize(("first", "value"), [(1250, 50.0), (500, np.nan), (500, 850.0)])
def test_what_failed_after_the_training_time_or_is_silent_is_left_out_and_no_errors_are_compared(first, value):
    table = twin_table(seed=31)
    values = table["temperature"].values[:, 2]
    values[first:] = values[first:] + 28.0 if value == 50.0 else value
    health = examine_record(table, ["quasi_static"])
    (part,) = [one for one in health.findings if not one.readings]
    assert (part.sensor, part.state) == ("t3", "left_out")
    assert np.isnan([part.rmse_with_um, part.rmse_without_um]).all()
    assert "t3" not in health.table["sensor"].values


def test_a_record_without_any_sound_sensor_is_refused():
    table = twin_table(seed=31).isel(sensor=[0, 1])
    table["temperature"][700:] = 850.0
    with pytest.raises(
        RecordError, match=r"record\.csv: no temperature sensor is sound \(t1: no signal from 11\.67 h on; t2: "
    ):
        examine_record(table, ["quasi_static"])


@pytest.mark.parametrize("runs", [1, 2])
def test_glitches_of_a_displacement_are_left_out_alone_and_the_error_with_them_is_stated(runs):
    table = twin_table(seed=31)
    if runs == 2:
        number = (np.arange(table.sizes["time"]) >= 700).astype(int)
        table = table.assign_coords(run=("time", number)).assign_attrs(runs='["a", "b"]', test="[1]")
    sound = table["displacement"].values.copy()
    glitches = [200, 201, 650, 1300]
    table["displacement"].values[glitches, 1] += 500.0
    health = examine_record(table, ["quasi_static"])
    kept = np.isfinite(health.table["displacement"].values)
    np.testing.assert_array_equal(np.argwhere(~kept), [(at, 1) for at in glitches])
    np.testing.assert_array_equal(health.table["displacement"].values[kept], sound[kept])
    assert [one.run for one in health.findings] == (["a", "b"] if runs == 2 else [""])
    assert sum(one.readings for one in health.findings) == 4
    for part in health.findings:
        assert (part.sensor, part.kind, part.state) == ("ch2", "glitch", "readings_left_out")
        assert part.rmse_with_um > 10.0 * part.rmse_without_um
    assert health.findings[-1].stretches_s[-1] == ((60.0 * 1300,) * 2 if runs == 1 else (60.0 * 600,) * 2)


def test_a_record_whose_only_displacement_sticks_ends_before():
    table = twin_table(seed=31).isel(channel=[0])
    table["displacement"].values[1000:] = table["displacement"].values[1000]
    health = examine_record(table, ["quasi_static"])
    assert health.table.sizes["time"] == 1000
    assert [one.kind for one in health.findings] in (["stuck"], ["clipped"])


@pytest.mark.parametrize("channels", [[0], [0, 1]])
def test_a_displacement_that_is_computed_with_a_faulty_sensor_is_said_to_be(channels):
    table = twin_table(seed=31).isel(channel=channels)
    table["temperature"].values[900:, 2] += 28.0
    table["displacement"].values[:, 0] -= 8.0 * (table["temperature"].values[:, 2] - 20.0)
    health = examine_record(table, ["quasi_static"])
    computed, sensor = health.findings
    assert (computed.sensor, computed.kind, computed.computed_with, sensor.sensor) == ("ch1", "computed", "t3", "t3")
    assert computed.rmse_with_um < 0.5 * computed.rmse_without_um
    # Where no other displacement is left, the faulty sensor stays beside this one, and nothing is named.
    assert health.names_causes == (len(channels) == 2)
    assert computed.state == sensor.state == ("left_out" if len(channels) == 2 else "suspected")
    assert health.table["channel"].values.tolist() == (["ch2"] if len(channels) == 2 else ["ch1"])
    assert ("t3" in health.table["sensor"].values) == (len(channels) == 1)


def heated_table(seed: int, *, set_point: bool) -> xr.Dataset:
    """Four sensors, one of them in a heater that is set to 220 degC for 70 min, and a displacement that follows it late."""
    rng, seconds = np.random.default_rng(seed), 10.0 * np.arange(720)
    wanted = np.where((seconds > 600.0) & (seconds < 4800.0), 220.0, 0.0)
    hot = 25.0 + first_order(seconds, np.fmax(wanted - 25.0, 0.0), 0.3)
    air = (
        25.0
        + np.cumsum(rng.normal(0.0, 0.02, (720, 3)), axis=0)
        + 0.02 * (first_order(seconds, hot, 20.0) - 25.0)[:, None]
    )
    temperature = np.round(np.column_stack([air, hot + rng.normal(0.0, 0.3, 720), wanted][: 3 if set_point else 2]), 1)
    displacement = 0.2 * first_order(seconds, hot - 25.0, 3.0) + rng.normal(0.0, 0.5, 720)
    return table_of(displacement[:, None], temperature, step_s=10.0)


@pytest.mark.parametrize("set_point", [True, False])
def test_a_heater_is_no_faulty_sensor_and_its_set_point_acts_as_a_driver(set_point):
    health = examine_record(heated_table(4, set_point=set_point), ["quasi_static"])
    assert health.findings == ()
    assert health.table["sensor"].values.tolist() == ["t1", "t2", "t3", "t4"]
    assert health.set_points == ({"t5": "t4"} if set_point else {})
    assert health.table["driver_name"].values.tolist() == (["t5"] if set_point else [])
    assert health.undoubted is not None and health.undoubted.sizes == health.table.sizes


def test_a_sensor_stays_while_later_parts_of_the_training_time_are_predicted_better_with_it():
    table = twin_table(seed=31).isel(channel=[0])
    table["temperature"].values[200:, 2] += 28.0
    # The displacement follows this sensor alone, so that even with its break it is worth more than the others.
    others = np.random.default_rng(2).normal(20.0, 0.5, table["temperature"].shape)
    table["displacement"].values[:, 0] = 50.0 * (
        table["temperature"].values[:, 2] - 28.0 * (np.arange(1440) >= 200) - 20.0
    )
    table["temperature"].values[:, [0, 1, *range(3, 10)]] = others[:, [0, 1, *range(3, 10)]]
    health = examine_record(table, ["quasi_static"])
    assert "t3" in health.table["sensor"].values
    assert [(one.sensor, one.state) for one in health.findings] in ([], [("t3", "suspected")])
