"""Sensors that break, ramp, stick, fall silent or become noisy; and sound ones."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.alignment.sensor_health import (
    Kind,
    examine_displacements,
    examine_readings,
    examine_sensors,
    excursion_limit,
    find_set_points,
    fit_ramp,
    lay_grid,
    no_readings,
)
from tests.fusion.record_tables import twin_table

SEED = 31


@pytest.fixture(scope="module")
def sound() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A record of the twin of 24 h, a sample per minute: seconds, 10 temperatures, load."""
    table = twin_table(seed=SEED)
    seconds = (table["time"].values - table["time"].values[0]) / np.timedelta64(1, "s")
    return seconds, table["temperature"].values, table["driver"].values


def test_the_limit_is_the_ratio_that_a_heavy_tail_exceeds_in_one_of_a_hundred_records():
    draws = np.abs(np.random.default_rng(3).standard_t(4, (4000, 60)))
    two = np.sort(draws, axis=1)[:, -2:]
    # One test alone: 1 % of 4000 is 40; t has not reached its power among 60 values, which at most doubles that (standard deviation 9).
    assert np.sum(two[:, 1] / two[:, 0] > excursion_limit(1)) <= 80 + 3 * 9
    assert excursion_limit(81) == pytest.approx(3.0 * excursion_limit(1))


def test_sound_sensors_are_left_alone(sound):
    assert examine_sensors(*sound) == []
    seconds, temperature, _ = sound
    assert examine_sensors(seconds, temperature) == []
    assert examine_sensors(seconds, temperature[:, :1]) == []
    assert examine_sensors(seconds[:50], temperature[:50]) == []


def test_a_sensor_without_noise_that_repeats_one_reading_is_named_by_what_its_neighbours_do(sound):
    """Its digits come five times in a row, so that neither runs nor noise say anything; its changes within minutes are well predicted."""
    seconds, temperature, load = sound
    held = temperature.copy()
    held[:, 0] = np.round(np.repeat(temperature[::5, 0], 5) / 0.05) * 0.05
    held[900:, 0] = held[900, 0]
    (fault,) = examine_sensors(seconds, held, load)
    assert (fault.sensor, fault.kind) == (0, Kind.STUCK)
    # What rests from the first reading on and moves later was not seen to fail.
    assert [one for one in examine_sensors(seconds, held[::-1], load[::-1]) if one.kind is Kind.STUCK] == []


def ramp(seconds: np.ndarray, begin: int, minutes: float) -> np.ndarray:
    return np.clip((seconds - seconds[begin]) / (60.0 * minutes), 0.0, 1.0)


@pytest.mark.parametrize(
    ("kind", "spoil"),
    [
        (Kind.JUMP, lambda t, s: t + 5.0 * (s >= s[900])),
        (Kind.RAMP, lambda t, s: t + 28.0 * ramp(s, 900, 15.0)),
        (Kind.RAMP, lambda t, s: t + 5.0 * ramp(s, 900, 40.0)),
        (Kind.STUCK, lambda t, s: np.where(s >= s[900], t[900], t)),
        (Kind.NO_SIGNAL, lambda t, s: np.where(s >= s[900], 850.0, t)),
        (Kind.NO_SIGNAL, lambda t, s: np.where(s >= s[900], np.nan, t)),
    ],
    ids=["jump", "break", "ramp", "stuck", "open circuit", "silent"],
)
def test_a_faulty_sensor_is_named_with_its_onset(sound, kind, spoil):
    sensor = 2
    seconds, temperature, load = sound
    spoilt = temperature.copy()
    spoilt[:, sensor] = spoil(temperature[:, sensor], seconds)
    (fault,) = examine_sensors(seconds, spoilt, load)
    assert (fault.sensor, fault.kind, fault.is_clear) == (sensor, kind, True)
    # Two standard uncertainties and a block of the coarse grid.
    assert abs(fault.onset_s - seconds[900]) <= 2.0 * fault.onset_u_s + 180.0


def test_a_coarse_sensor_that_repeats_one_value_for_long_is_named(sound):
    """No run of ordinary readings is short here, and the prediction of so coarse a sensor misses too much to move."""
    seconds, temperature, _ = sound
    coarse = temperature.copy()
    coarse[:, 2] = np.round(seconds / 3600.0 + temperature[:, 2] * 1e-3 + np.arange(seconds.size) // 6 % 2)
    coarse[700:, 2] = coarse[699, 2]
    (fault,) = examine_sensors(seconds, coarse)
    assert (fault.sensor, fault.kind) == (2, Kind.STUCK)
    # Before a test is begun everything stands still, and coarse sensors repeat one reading.
    still = temperature.copy()
    still[:700, :] = temperature[0] + 0.001 * np.random.default_rng(4).standard_normal((700, temperature.shape[1]))
    still[:, 2] = np.round(still[:, 2])
    assert [fault for fault in examine_sensors(seconds, still) if fault.kind is Kind.STUCK] == []


@pytest.mark.parametrize("missing", [slice(0, 0), slice(900, 905), slice(893, 900)])
def test_no_signal_begins_with_the_first_implausible_reading_whatever_gaps_follow(sound, missing):
    seconds, temperature, _ = sound
    spoilt = temperature.copy()
    spoilt[900:, 2] = np.where(np.arange(seconds.size - 900) % 3 == 2, np.nan, 850.0)
    spoilt[1200:, 2] = 850.0
    spoilt[missing, 2] = np.nan
    (fault,) = examine_sensors(seconds, spoilt)
    assert fault.kind is Kind.NO_SIGNAL
    assert fault.onset_s == seconds[893 if missing.start == 893 else 900]


def test_a_glitch_long_before_is_not_the_onset_of_no_signal(sound):
    seconds, temperature, _ = sound
    spoilt = temperature.copy()
    spoilt[30, 2] = spoilt[400:402, 2] = 999.0
    spoilt[900:, 2] = 850.0
    (fault,) = examine_sensors(seconds, spoilt)
    assert (fault.kind, fault.onset_s) == (Kind.NO_SIGNAL, seconds[900])


@pytest.mark.parametrize(
    ("rail", "places", "found"),
    [
        (850.0, [300], 1),  # the end of a Pt100: documented
        (-127.0, [10, 11, 400], 3),
        (512.3, range(300, 400), 100),  # not documented, repeated to the last digit
        (512.3, [300], 0),
        (-300.0, [300], 1),  # below absolute zero
    ],
)
def test_a_rail_is_no_reading_and_a_hot_sensor_is_one(rail, places, found):
    rng = np.random.default_rng(6)
    values = np.round(20.0 + np.cumsum(rng.normal(0.0, 0.02, 600)) + rng.normal(0.0, 0.05, 600), 2)
    assert not no_readings(values).any()
    # A rise around zero, a hot end and a cold store are sound.
    for shifted in (values - 20.0, values + 320.0, values - 100.0):
        assert not no_readings(shifted).any()
    spoilt = values.copy()
    spoilt[places] = rail
    assert no_readings(spoilt).sum() == found


@pytest.mark.parametrize(("level", "found"), [(200.0, 0), (60.5, 0), (200.3, 100), (700.0, 100), (-30.0, 100)])
def test_a_level_that_a_heater_may_hold_to_the_digit_is_no_rail(level: float, found: int):
    """Switched on between two readings that lie far apart; no set point is below all others, nor in tenths of a degree."""
    values = np.round(20.0 + np.random.default_rng(6).normal(0.0, 0.5, 600), 1)
    values[300:400] = level
    assert no_readings(values).sum() == found


def test_a_set_point_that_nothing_follows_reads_no_rail():
    assert not no_readings(np.repeat([0.0, 180.0, 144.0, 0.0], [500, 200, 100, 400])).any()


@pytest.mark.parametrize(("repeated", "stuck"), [(28, False), (300, True)])
def test_rounded_noise_repeats_its_most_frequent_value_by_chance(repeated: int, stuck: bool):
    """Three readings of four are 12.0, so that 20 in a row are expected among 2000."""
    rng, seconds = np.random.default_rng(8), 2.0 * np.arange(2000)
    coarse = np.where(rng.random(2000) < 0.75, 12.0, 12.0 + rng.choice([-0.5, 0.5], 2000))
    coarse[900 : 900 + repeated] = 12.0
    found = examine_sensors(seconds, np.column_stack([coarse, wandering(2000, 3)]))
    assert [(one.sensor, one.kind) for one in found] == ([(0, Kind.STUCK)] if stuck else [])


def test_a_set_point_is_found_with_what_it_regulates():
    seconds = 10.0 * np.arange(900)
    wanted = np.select([seconds < 900, seconds < 4000, seconds < 6000], [0.0, 70.0, 60.0], 0.0)
    bed = 25.0 + respond(np.fmax(wanted - 25.0, 0.0)[:, None], seconds, time_constant_s=60.0)[:, 0]
    noise = np.random.default_rng(7).normal(0.0, 0.1, (900, 3))
    columns = np.round(np.column_stack([wandering(900, 2) + noise[:, :2], bed + noise[:, 2]]), 1)
    assert find_set_points(np.column_stack([columns, wanted])) == {3: 2}
    # A coarse thermometer in a calm room and a set point that nothing follows are none.
    calm = 21.0 + 0.5 * (seconds > 3000)
    assert find_set_points(np.column_stack([columns, calm, np.where(wanted > 0.0, 180.0, 0.0)])) == {}


def test_an_erratic_time_is_one_and_left_out_whole_and_bursts_are_left_out_alone():
    rng, seconds = np.random.default_rng(8), 600.0 * np.arange(1500)
    values = 900.0 + 30.0 * np.sin(seconds / 86400.0 * 2.0 * np.pi) + rng.normal(0.0, 0.5, 1500)
    at_fault = np.zeros(1500, bool)
    at_fault[400:466] = True
    values[at_fault] -= rng.uniform(100.0, 800.0, 66)
    # It comes back for an hour, which is no reason to trust it.
    values[420:426] = 900.0
    values[[900, 901, 902, 1100]] += [450.0, 900.0, 1335.0, 1335.0]
    faults, sound = examine_readings(seconds, values[:, None], None, quantity="displacement")
    assert [(one.kind, one.readings, len(one.stretches_s)) for one in faults] == [
        (Kind.ERRATIC, 66, 1),
        (Kind.GLITCH, 4, 2),
    ]
    assert (np.isnan(sound[:, 0]) == at_fault | np.isin(np.arange(1500), [900, 901, 902, 1100])).all()


def test_a_thermometer_in_the_ground_that_holds_one_digit_is_not_stuck(sound):
    seconds, temperature, load = sound
    slow = 11.0 + np.interp(np.arange(seconds.size), [0, 800, 1200, 1440], [0.0, 0.2, 0.2, 0.25])
    ground = np.round(slow + 0.0005 * np.random.default_rng(9).normal(size=seconds.size), 2)
    assert examine_sensors(seconds, np.column_stack([temperature, ground]), load) == []


# Displacements: what leaves the course and comes back is at fault; what stays, or takes its time, may be true.


def drifting(seconds: np.ndarray, resolution: float = 0.0) -> np.ndarray:
    values = 40.0 * np.sin(seconds / 9000.0) + np.random.default_rng(6).normal(0.0, 0.1, seconds.size)
    return np.round(values / resolution) * resolution if resolution else values


@pytest.mark.parametrize("resolution", [0.0, 1.0])
@pytest.mark.parametrize(
    "spoil",
    [
        lambda at: np.isin(at, [0, 200, 201, 700, 1000, 1439]),
        lambda at: (at >= 600) & (at < 625),
        lambda at: (at >= 600) & (at < 606),
    ],
    ids=["single readings", "a stretch", "longer than half the median"],
)
def test_glitches_of_a_displacement_are_found_to_the_reading(sound, spoil, resolution):
    seconds, temperature, load = sound
    values, at_fault = drifting(seconds, resolution), spoil(np.arange(seconds.size))
    (fault,) = examine_displacements(seconds, (values + 4300.0 * at_fault)[:, None], temperature, load)
    assert (fault.kind, fault.readings) == (Kind.GLITCH, at_fault.sum())
    found = np.zeros(seconds.size, bool)
    for first, last in fault.stretches_s:
        found |= (seconds >= first) & (seconds <= last)
    np.testing.assert_array_equal(found, at_fault)
    assert fault.size == pytest.approx(4300.0, abs=50.0)


@pytest.mark.parametrize(
    "burst", [[1600.0, 2900.0, 4300.0], [900.0, 2400.0, 4300.0, 2500.0, 1300.0], [4300.0, -2900.0, 2200.0]]
)
def test_a_burst_that_climbs_in_parts_is_left_out_as_a_whole(sound, burst):
    seconds, temperature, load = sound
    values = drifting(seconds)
    values[600 : 600 + len(burst)] += burst
    (fault,) = examine_displacements(seconds, values[:, None], temperature, load)
    assert fault.stretches_s == ((seconds[600], seconds[599 + len(burst)]),)


@pytest.mark.parametrize(
    "event",
    [
        lambda at: 500.0 * (at >= 600),
        lambda at: 500.0 * (at >= 2),
        lambda at: 500.0 * (at >= 1437),
        lambda at: 500.0 * np.exp(-np.maximum(at - 600, 0) / 8.0) * (at >= 600),
        lambda at: 500.0 * (1.0 - np.exp(-at / 3.0)),
        lambda at: 500.0 * np.exp(-0.5 * ((at - 600) / 3.0) ** 2),
    ],
    ids=["step", "step at the beginning", "step at the end", "step that relaxes", "fast start", "smooth pulse"],
)
def test_a_true_event_is_no_glitch(sound, event):
    seconds, temperature, load = sound
    values = drifting(seconds) + event(np.arange(seconds.size))
    assert examine_displacements(seconds, values[:, None], temperature, load) == []


def test_what_a_driver_switches_on_and_off_is_no_glitch(sound):
    seconds, temperature, _ = sound
    pulses = (np.arange(seconds.size) % 200 < 4).astype(float)
    values = (drifting(seconds) + 50.0 * pulses)[:, None]
    assert examine_displacements(seconds, values, temperature, pulses[:, None]) == []
    # A driver that is switched all the time explains none of them, nor does one that nothing logs.
    for driver in (None, np.random.default_rng(8).uniform(size=(seconds.size, 1))):
        (fault,) = examine_displacements(seconds, values, temperature, driver)
        assert fault.readings >= 4 * 7


@pytest.mark.parametrize(
    ("begin", "end", "kind"), [(600, 640, Kind.STUCK), (900, 1440, Kind.STUCK), (0, 0, Kind.CLIPPED)]
)
def test_readings_of_a_displacement_that_repeat_one_value_are_found(sound, begin, end, kind):
    seconds, temperature, load = sound
    values, other = drifting(seconds), drifting(seconds)[::-1]
    if kind is Kind.CLIPPED:
        repeated = values > 30.0
        values = np.minimum(values, 30.0)
    else:
        repeated = (np.arange(seconds.size) >= begin) & (np.arange(seconds.size) < end)
        values[repeated] = values[begin]
    (fault,) = examine_displacements(seconds, np.column_stack([other, values]), temperature, load)
    assert (fault.sensor, fault.kind) == (1, kind)
    # Short runs where noise crosses the end of the range are true within the noise.
    assert fault.readings == pytest.approx(repeated.sum(), abs=20 if kind is Kind.CLIPPED else 0)


def test_a_coarse_displacement_that_rests_before_the_test_is_not_stuck(sound):
    seconds, temperature, load = sound
    values = np.round(20.0 * np.maximum(0.0, np.sin((seconds - seconds[500]) / 9000.0)) * (seconds > seconds[500]))
    assert examine_displacements(seconds, values[:, None], temperature, load) == []


def test_a_sensor_that_becomes_noisy_is_named(sound):
    seconds, temperature, load = sound
    noisy = temperature.copy()
    noisy[900:, 4] += np.random.default_rng(5).normal(0.0, 0.6, seconds.size - 900)
    (fault,) = examine_sensors(seconds, noisy, load)
    assert (fault.sensor, fault.kind, fault.is_clear) == (4, Kind.NOISE, True)
    assert abs(fault.onset_s - seconds[900]) <= 3600.0


def test_heat_beside_one_sensor_that_spreads_to_others_is_no_clear_fault(sound):
    seconds, temperature, load = sound
    source = 15.0 * respond((seconds >= seconds[900]).astype(float)[:, None], seconds, time_constant_s=1200.0)[:, 0]
    spread = respond(source[:, None], seconds, time_constant_s=3600.0)[:, 0]
    warmed = temperature.copy()
    warmed[:, 3] += source
    warmed[:, [2, 4]] += 0.3 * spread[:, None]
    assert not any(fault.is_clear for fault in examine_sensors(seconds, warmed, load))


def test_a_load_that_is_switched_once_explains_what_a_sensor_does_then(sound):
    seconds, temperature, _ = sound
    spoilt = temperature.copy()
    spoilt[:, 2] += 5.0 * ramp(seconds, 900, 40.0)
    once = (seconds >= seconds[900]).astype(float)[:, None]
    (fault,) = examine_sensors(seconds, spoilt, once)
    assert not fault.is_clear
    assert fault.reason == "a load was switched then, too rarely to compare"


@pytest.mark.parametrize(
    ("jumps", "clear"), [({2: (900, 5.0), 6: (900, 5.0)}, False), ({2: (500, 5.0), 6: (1100, -4.0)}, True)]
)
def test_two_sensors_are_suspected_where_they_jump_together_and_named_one_after_the_other(sound, jumps, clear):
    seconds, temperature, load = sound
    spoilt = temperature.copy()
    for sensor, (first, jump_K) in jumps.items():
        spoilt[first:, sensor] += jump_K
    faults = examine_sensors(seconds, spoilt, load)
    assert [(fault.sensor, fault.is_clear) for fault in faults] == [(2, clear), (6, clear)]


def test_a_logger_that_stands_still_is_no_fault_of_its_sensors(sound):
    seconds, temperature, load = sound
    still = temperature.copy()
    still[700:740] = still[700]
    assert [fault for fault in examine_sensors(seconds, still, load) if fault.kind is Kind.STUCK] == []


# Changes of a sensor beyond its prediction: grids, residuals, excursions and the time of a ramp.


def wandering(n: int = 600, sensors: int = 4, seed: int = 1) -> np.ndarray:
    """Sensors that follow two sources with gains of their own, and noise."""
    rng = np.random.default_rng(seed)
    sources = np.cumsum(rng.normal(0.0, 0.05, (n, 2)), axis=0)
    return 20.0 + sources @ rng.uniform(0.5, 1.5, (2, sensors)) + rng.normal(0.0, 0.01, (n, sensors))


def test_grids_are_fine_only_where_there_are_more_samples_than_blocks():
    assert [grid.is_fine for grid in lay_grid(np.arange(500.0), wandering(500), None)] == [False]
    fine, coarse = lay_grid(np.arange(5000.0), wandering(5000), None)
    assert (fine.seconds.size, fine.step_s) == (5000, 1.0)
    assert coarse.seconds.size <= 600
    assert fine.durations() == (1, 2)
    assert coarse.durations() == (1, 2, 4, 8, 16)


def test_a_missing_reading_is_interpolated_and_a_pause_left_out():
    temperature = wandering(600)
    temperature[100:103, 0] = np.nan
    seconds = np.r_[np.arange(300.0), 9000.0 + np.arange(300.0)]
    (grid,) = lay_grid(seconds, temperature, None)
    assert grid.seconds.size == 600
    assert np.isfinite(grid.temperature).all()
    assert not grid.known[100:103, 0].any()
    assert grid.known[:, 1].all()


@pytest.mark.parametrize(("begin", "end"), [(200, 201), (150, 260)])
def test_a_ramp_is_timed_within_twice_its_uncertainty(begin, end):
    seconds = 10.0 * np.arange(400)
    ramp = 3.0 * np.clip((np.arange(400) - begin) / (end - begin), 0.0, 1.0)
    fitted = fit_ramp(seconds, ramp + np.random.default_rng(2).normal(0.0, 0.05, 400))
    assert abs(fitted.begin_s - 10.0 * begin) <= 2.0 * fitted.begin_u_s + 10.0
    assert fitted.size_K == pytest.approx(3.0, abs=0.1)
    assert fitted.begin_u_s < 100.0


def test_a_load_that_is_switched_within_a_time_is_held_against_all_other_times():
    load = (np.arange(600) // 100 % 2).astype(float)
    (grid,) = lay_grid(np.arange(600.0), wandering(), load[:, None])
    # Five switchings: four of them elsewhere are enough to compare, two are not; none within the time.
    assert not grid.switched_rarely(195.0, 205.0) and grid.switched_rarely(195.0, 405.0)
    assert not grid.switched_rarely(220.0, 240.0)
    (unlogged,) = lay_grid(np.arange(600.0), wandering(), None)
    assert not unlogged.switched_rarely(0.0, 600.0)
