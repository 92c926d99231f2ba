"""Structure in the residual: an event and a periodic disturbance are detected and located, and a complete model shows none."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.diagnosis import residual_tests as module
from fusion.diagnosis.residual_tests import examine_residual
from fusion.effects.library import library
from fusion.model.fit import Term, fit_model
from fusion.products.results import ResidualPart
from fusion.report.model_section import describe_residual
from fusion.twin.machine.recipe import EffectRecipe
from tests.fusion.loop_bench import DECLARED, readings_of

SEED = 5


def residual_of(*effects: EffectRecipe):
    readings = readings_of(*effects, seed=SEED)
    terms = [Term(name, next(iter(library()[name].candidates(readings, {}, None)))) for name in DECLARED]
    return readings, examine_residual(fit_model(readings, terms), np.random.default_rng(1))


def test_a_complete_model_shows_no_structure():
    _, tests = residual_of()
    # Nine shapes: the smallest p of nine true nulls is below 0.005 once in 22 campaigns, and this one is not among them.
    assert min(tests.p_values.values()) > 0.005
    assert tests.innovations.std() == pytest.approx(1.0, abs=0.05)  # 1,900 readings give it to 0.016
    assert np.median(tests.power) == pytest.approx(np.log(2.0), abs=0.2)  # power of noise is exponential with mean 1


def test_an_event_is_detected_at_its_time():
    readings, tests = residual_of(EffectRecipe("step_event", amplitude_um=1.0, parameters={"at_cycle": 30}))
    assert tests.p_values["event"] < 0.005
    start = readings.seconds[readings.cycle == 30].min()
    assert abs(tests.event_s - start) < 252.0  # within a cycle


def test_a_periodic_disturbance_is_detected_with_its_period():
    effect = EffectRecipe("periodic_disturbance", amplitude_um=0.4, parameters={"period_min": 9.0, "shape": "flat"})
    _, tests = residual_of(effect)
    assert tests.p_values["rhythm"] < 0.005
    assert tests.period_min == pytest.approx(9.0, rel=0.03)  # half the resolution of 4.2 h is 1.8 % of it
    assert tests.power.max() > tests.power_limit
    assert not tests.period_is_cycle


def test_a_changing_reversal_error_shows_at_the_period_of_the_cycles():
    _, tests = residual_of(EffectRecipe("reversal_drift", amplitude_um=0.6))
    assert tests.p_values["direction"] < 0.005
    assert tests.period_is_cycle
    part = ResidualPart.model_validate(tests.as_json())
    table = {row.cells[0]: row.cells[1] for row in describe_residual(part, part).rows}
    assert table["a rhythm"].endswith("min (that of the cycles)")


def test_the_same_seed_gives_the_same_p_values():
    _, first = residual_of()
    _, again = residual_of()
    assert first.p_values == again.p_values


def test_periods_reach_from_half_the_test_to_three_minutes_in_halves_of_the_resolution():
    periods = module._periods_min(np.array([0.0, 3600.0]))
    # An hour: 2 to 20 oscillations in steps of a half.
    np.testing.assert_allclose(60.0 / periods, np.arange(2.0, 20.0, 0.5))
    np.testing.assert_allclose(module._periods_min(np.array([0.0, 240.0])), [2.0])
    assert module._periods_min(np.array([0.0, 1e6])).size == 300


def test_memory_shift_and_power_of_series_that_are_known():
    """Forty readings: six turns of a sine; and twenty of +2 after twenty of -2, on a level that must not count."""
    n = np.arange(40)
    turns = 2 * np.pi * n[:, None] * np.array([6.0, 11.0]) / 40.0
    waves = np.hstack([np.cos(turns), np.sin(turns)]).astype(np.float32)
    series = np.stack([np.sin(2 * np.pi * 6.0 * n / 40.0 + 0.3), 5.0 + np.where(n < 20, -2.0, 2.0)])
    memory, shift, power = module._time_statistics(series, 10, [waves])
    # All of the variance at one frequency: n / 2 in units of white noise.
    np.testing.assert_allclose(power[0], [20.0, 0.0], atol=1e-4)
    # Ten readings of one sign over the root of their number; none where five are of either sign.
    assert shift.shape == (2, 31)
    np.testing.assert_allclose(shift[1, [0, 10, 15, 30]] / np.sqrt(10.0), [2.0, 2.0, 0.0, 2.0], atol=1e-9)
    # k readings apart, 40 - 2 k of the 40 - k products are the variance and k its opposite.
    lags = np.arange(1, 13)
    assert memory[1] == pytest.approx((((40 - 3 * lags) / (40 - lags)) ** 2).sum())


def test_a_permutation_p_value_counts_the_measured_order_as_one():
    assert module._p_value(3.0, np.array([1.0, 2.0, 3.0, 4.0])) == 3 / 5
    assert module._p_value(5.0, np.array([1.0, 2.0, 3.0, 4.0])) == 1 / 5


def test_waves_of_a_long_test_lie_in_parts_with_the_same_power(monkeypatch, rng):
    seconds, periods = 60.0 * np.arange(200.0), np.array([60.0, 30.0, 20.0, 15.0, 12.0])
    series = rng.standard_normal((3, 200))
    (whole,) = module._waves(seconds, periods)
    expected = module._time_statistics(series, 10, [whole])
    monkeypatch.setattr(module, "_WAVES_AT_ONCE", 1000)
    monkeypatch.setattr("thermography.fields.tasks.spool.IN_MEMORY_BYTES", 100)
    parts = module._waves(seconds, periods)
    assert [part.shape for part in parts] == [(200, 4), (200, 4), (200, 2)]
    # Products in single precision.
    np.testing.assert_allclose(module._time_statistics(series, 10, parts)[2], expected[2], rtol=1e-5)


def test_there_are_400_permutations_some_at_a_time(monkeypatch, rng):
    values = np.arange(10.0)
    for room, sizes in [(module._VALUES_AT_ONCE, [50] * 8), (70, [7] * 57 + [1]), (1, [1] * 400)]:
        monkeypatch.setattr(module, "_VALUES_AT_ONCE", room)
        some = list(module._permutations_of(values, rng))
        assert [len(one) for one in some] == sizes
        rows = np.concatenate(some)
        assert (np.sort(rows, axis=1) == values).all() and len(np.unique(rows, axis=0)) > 390


class EnoughSeenError(Exception):
    """Ends an examination once the statistics were asked for."""


def test_a_shift_is_sought_over_as_many_readings_as_a_cycle_has(monkeypatch):
    readings = readings_of(seed=SEED)
    per_cycle = np.bincount(readings.cycle)
    (count,) = np.unique(per_cycle[per_cycle > 0])
    windows = []

    def statistics(series, window, waves):
        windows.append(window)
        raise EnoughSeenError

    monkeypatch.setattr(module, "_time_statistics", statistics)
    with pytest.raises(EnoughSeenError):
        residual_of()
    assert windows == [count]
