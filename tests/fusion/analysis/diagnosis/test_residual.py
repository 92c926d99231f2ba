"""The remainder of a model: a planted pattern is found, described and measured; a complete model leaves none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fusion.analysis.diagnosis import residual as module
from fusion.analysis.diagnosis.residual import Remainder, ResidualTests, examine, examine_residual
from fusion.analysis.drift_model.model import ModelFit, Term, fit_model
from fusion.analysis.effects.library import library
from fusion.analysis.levels import REMAINDER_LEVEL
from fusion.twin.recipe import EffectRecipe
from tests.fusion.loop_bench import DECLARED, readings_of


def declared_model(*effects: EffectRecipe) -> ModelFit:
    """A campaign with something undeclared in it, fitted by the declared effects."""
    readings = readings_of(*effects, seed=5)
    terms = [Term(name, next(iter(library()[name].candidates(readings, {}, None)))) for name in DECLARED]
    return fit_model(readings, terms)


@pytest.fixture(scope="module")
def complete() -> ModelFit:
    return declared_model()


@pytest.fixture(scope="module")
def switched() -> ModelFit:
    return declared_model(EffectRecipe("telegraph_switching", amplitude_um=1.0))


def remainder_of(model: ModelFit, **options) -> Remainder:
    return examine(model.readings, model.fit, np.random.default_rng(1), **options)


def test_complete_model_leaves_no_pattern(complete):
    remainder = remainder_of(complete)
    assert remainder.p_value > REMAINDER_LEVEL
    assert (remainder.shape, remainder.rms_um) == ("", 0.0)


def test_planted_pattern_is_found_where_it_acts(switched):
    switching = remainder_of(switched)
    assert switching.p_value < REMAINDER_LEVEL
    assert "negative direction only" in switching.shape
    weight = dict(zip(switching.sites, np.abs(switching.along_sites), strict=True))
    assert min(weight[(target, "negative")] for target in range(9, 13)) > 0.5
    assert max(weight[(target, "positive")] for target in range(1, 17)) < 0.5


def test_the_noise_is_tested_in_units_of_its_own_and_each_site_alike(complete, monkeypatch):
    readings, fit = complete.readings, complete.fit
    seen, statistics, sites, shapes = [], module._statistics, [], module._shapes
    monkeypatch.setattr(module, "_statistics", lambda *given: seen.append(given) or statistics(*given))
    monkeypatch.setattr(module, "_shapes", lambda *given: sites.append(given) or shapes(*given))
    remainder = remainder_of(complete)
    # The null is made first; the residual itself is the last that is looked at.
    matrix, (signs, place) = seen[-1][0], sites[-1]
    noise, share = fit.noise()
    for k in (0, 1, matrix.shape[1] - 1):
        at = (readings.target == remainder.sites[k][0]) & ((readings.sign > 0) == (remainder.sites[k][1] == "positive"))
        standard = (noise / np.sqrt(share) / fit.sigma)[at].clip(-4.0, 4.0)
        np.testing.assert_allclose(matrix[:, k], (standard - standard.mean()) / standard.std(), atol=1e-9)
        assert place[k] == pytest.approx(readings.share[at][0])
    assert signs.tolist() == [1.0 if direction == "positive" else -1.0 for _, direction in remainder.sites]


def test_sites_that_are_set_aside_are_not_tested(switched):
    aside = tuple((target, "negative") for target in range(9, 13))
    remainder = remainder_of(switched, set_aside=aside)
    assert not set(aside) & set(remainder.sites)
    assert remainder.p_value > REMAINDER_LEVEL


def test_statistics_of_patterns_that_are_known():
    """Ten cycles at four targets from both sides; one pattern over time and sites, with the length of its two parts."""
    place = np.repeat([0.0, 1.0, 2.0, 3.0], 2) / 3.0
    signs = np.tile([1.0, -1.0], 4)
    time = np.repeat([1.0, -1.0], 5)
    even = module._statistics(np.outer(time, np.ones(8)), module._shapes(signs, place))
    # Sum of squares 80; means over blocks of five cycles leave 16, of which 2 at one site.
    np.testing.assert_allclose(even[:3], [np.sqrt(80.0), 4.0, 2.0])
    # Beside a little alternation of every shape, each slow shape shows in its own statistic; offset and line show in none.
    alternating, bent = np.tile([1.0, -1.0], 5), (place - 0.5) ** 2
    little = 1e-4 * np.outer(alternating, signs * (0.5 + place) + bent)
    quick, slow = module._slowness(alternating), module._slowness(time)
    for shape, expected in (
        (np.ones(8), [quick, quick, quick]),
        (2.0 + place, [quick, quick, quick]),
        (signs, [slow, quick, quick]),
        (signs * (place - 0.5), [quick, slow, quick]),
        (bent, [quick, quick, slow]),
    ):
        np.testing.assert_allclose(
            module._statistics(np.outer(time, shape) + little, module._shapes(signs, place))[3:], expected, atol=1e-3
        )
    # Fewer cycles than two blocks have no slow pattern.
    np.testing.assert_array_equal(module._statistics(np.outer(time[:9], signs), module._shapes(signs, place))[1:3], 0.0)


def test_offset_and_stretch_of_every_cycle_are_taken_out_and_nothing_else(rng):
    cycle, share = np.repeat([1, 2, 5], 6), np.tile(np.linspace(0.0, 1.0, 6), 3)
    readings = SimpleNamespace(cycle=cycle, share=share)
    bend = np.tile([5.0, -1.0, -4.0, -4.0, -1.0, 5.0], 3)
    drift = rng.normal(size=3)[np.repeat([0, 1, 2], 6)] + rng.normal(size=3)[np.repeat([0, 1, 2], 6)] * share
    np.testing.assert_allclose(
        module._freed(readings, np.column_stack([drift, drift + bend])), np.column_stack([0 * bend, bend]), atol=1e-12
    )


def test_the_leading_pattern_has_its_largest_site_at_one():
    """A shift of 2 um in the middle of twelve cycles, fully at the third site, half and reversed at the first; a reading is missing."""
    time, sites = np.repeat([-1.0, 1.0], 6), np.array([-0.5, 0.0, 1.0])
    matrix = 7.0 + np.outer(time, sites)
    along_time, along_sites, rms = module._leading(matrix)
    np.testing.assert_allclose(along_sites, sites, atol=1e-12)
    # Means of three cycles; beyond the ends there is nothing.
    expected = np.array([-2, -3, -3, -3, -3, -1, 1, 3, 3, 3, 3, 2]) / 3.0
    np.testing.assert_allclose(along_time, expected, atol=1e-12)
    assert rms == pytest.approx(np.sqrt(np.mean(np.outer(expected, sites) ** 2)))
    matrix[3, 1] = np.nan
    np.testing.assert_allclose(module._leading(matrix)[1], sites, atol=1e-12)


@pytest.mark.parametrize(
    ("series", "words"),
    [
        (np.where(np.arange(40) < 12, 1.0, 4.0), "one step at cycle 113"),
        (np.cos(2 * np.pi * np.arange(40) / 8.0), "a rhythm of about 78 min"),
        (np.cos(2 * np.pi * np.arange(40) / 13.3), "a rhythm of about 130 min"),
        (np.arange(40.0) + 3.0 * np.cos(np.arange(40.0)), "slow growth or decay"),
        (
            np.resize([1.0, 1.0, -1.0, -1.0, -1.0, 1.0, -1.0], 40),
            "irregular, with 21 changes of sign in 40 cycles",
        ),
        (np.ones(40), "course in time not determined"),
        (np.arange(7.0), "course in time not determined"),
    ],
)
def test_a_course_in_time_is_told_by_what_explains_most_of_it(series, words):
    """Cycles 101 to 140 of ten minutes each, 390 minutes from the first to the last."""
    readings = SimpleNamespace(seconds=600.0 * np.arange(40))
    assert module._time_words(np.arange(101, 101 + series.size), series, readings) == words


SITES = [(target, direction) for target in (1, 2, 3, 7) for direction in ("positive", "negative")]


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ([1.0, 0.9, 0.8, 0.9, 0.7, 0.6, 0.9, 0.8], "targets 1-3, 7, both directions"),
        ([1.0, -0.9, 0.8, -0.9, 0.7, -0.6, 0.2, -0.1], "targets 1-3, opposite in both directions"),
        ([-0.9, 1.0, -0.9, 0.8, -0.6, 0.7, -0.1, 0.2], "targets 1-3, opposite in both directions"),
        ([0.1, 1.0, 0.2, 0.3, 0.1, 0.0, 0.2, 0.6], "targets 1, 7, negative direction only"),
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.9], "target 7, both directions"),
        (
            [1.0, 0.9, 0.1, 0.0, 0.0, 0.1, -0.8, -0.9],
            "targets 1, 7, both directions, with opposite signs along the axis",
        ),
    ],
)
def test_where_a_pattern_acts_is_told_by_its_sites_of_more_than_half_its_size(weights, words):
    assert module._place_words(SITES, np.array(weights)) == words


@pytest.mark.parametrize(("order", "course"), [(1, "irregular"), (2, "smooth")])
def test_a_drift_counts_from_half_the_noise_of_a_reading_on(monkeypatch, order, course):
    fit = SimpleNamespace(sigma=2.0, system=SimpleNamespace(order=order))
    remainder = Remainder(
        0.5, {}, "", 0.0, np.arange(2), np.zeros(2), [], np.zeros(0), np.zeros(4), lambda columns: columns
    )
    basis = np.full((4, 1), 0.5)
    drift = np.column_stack([np.full(4, 0.1), [1.1, -1.1, 1.1, -1.1]])
    monkeypatch.setattr(module, "unexplained_drift", lambda fit: (drift, basis))
    found = module.with_drift(remainder, fit)
    assert found.shape == (f"a slow, {course} drift without a name; growing along the axis, both directions")
    assert found.rms_um == pytest.approx(1.1) and found.series.tolist() == [1.1, -1.1, 1.1, -1.1]
    # A constant is no explanation of it: the basis of the model takes it out.
    np.testing.assert_allclose(found.free(np.ones((4, 1))), 0.0, atol=1e-12)
    monkeypatch.setattr(module, "unexplained_drift", lambda fit: (drift / 1.1, basis))
    assert module.with_drift(remainder, fit) is remainder


def test_a_drift_of_several_channels_is_told_by_its_number(monkeypatch):
    drift = np.outer([1.0, -1.0, 1.0, -1.0], [0.1, 0.2, 3.0])
    monkeypatch.setattr(module, "unexplained_drift", lambda fit: (drift, np.zeros((4, 1))))
    nothing = Remainder(0.5, {}, "", 0.0, np.arange(2), np.zeros(2), [], np.zeros(0), np.zeros(4), lambda given: given)
    found = module.with_drift(nothing, SimpleNamespace(sigma=2.0, system=SimpleNamespace(order=1)))
    assert found.shape.endswith("; channel 3, both directions")


def test_a_shape_is_tested_below_the_level_alone():
    shown = Remainder(
        REMAINDER_LEVEL,
        {},
        "one step",
        1.0,
        np.arange(2),
        np.zeros(2),
        [],
        np.zeros(0),
        np.zeros(4),
        lambda given: given,
    )
    assert not shown.is_tested
    assert replace(shown, p_value=0.99 * REMAINDER_LEVEL).is_tested
    assert not replace(shown, p_value=0.0, shape="").is_tested


def test_a_column_explains_the_share_of_what_it_fits_beside_the_model():
    remainder = Remainder(
        0.5, {}, "", 0.0, np.arange(2), np.zeros(2), [], np.zeros(0), np.array([3.0, 4.0, 0.0]), lambda columns: columns
    )
    assert remainder.share_of(np.array([[1.0], [0.0], [0.0]])) == pytest.approx(9 / 25)
    assert not remainder.is_tested


# Structure in the residual: an event and a periodic disturbance are detected and located, and a complete model shows none.


def examined(model: ModelFit) -> ResidualTests:
    return examine_residual(model, np.random.default_rng(1))


def test_a_complete_model_shows_no_structure(complete):
    tests = examined(complete)
    # Nine shapes: the smallest p of nine true nulls is below 0.005 once in 22 campaigns, and this one is not among them.
    assert min(tests.p_values.values()) > 0.005
    assert tests.innovations.std() == pytest.approx(1.0, abs=0.05)  # 1,900 readings give it to 0.016
    assert np.median(tests.power) == pytest.approx(np.log(2.0), abs=0.2)  # power of noise is exponential with mean 1


def test_an_event_is_detected_at_its_time():
    model = declared_model(EffectRecipe("step_event", amplitude_um=1.0, parameters={"at_cycle": 30}))
    tests, readings = examined(model), model.readings
    assert tests.p_values["event"] < 0.005
    start = readings.seconds[readings.cycle == 30].min()
    assert abs(tests.event_s - start) < 252.0  # within a cycle


def test_a_periodic_disturbance_is_detected_with_its_period():
    effect = EffectRecipe("periodic_disturbance", amplitude_um=0.4, parameters={"period_min": 9.0, "shape": "flat"})
    tests = examined(declared_model(effect))
    assert tests.p_values["periodicity"] < 0.005
    assert tests.period_min == pytest.approx(9.0, rel=0.03)  # half the resolution of 4.2 h is 1.8 % of it
    assert tests.power.max() > tests.power_limit
    assert not tests.period_is_cycle


def test_a_changing_reversal_error_shows_at_the_period_of_the_cycles():
    tests = examined(declared_model(EffectRecipe("reversal_drift", amplitude_um=0.6)))
    assert tests.p_values["direction"] < 0.005
    assert tests.period_is_cycle


def test_periods_reach_from_half_the_test_to_three_minutes_in_halves_of_the_resolution():
    periods = module._periods_min(np.array([0.0, 3600.0]))
    # An hour: 2 to 20 oscillations in steps of a half.
    np.testing.assert_allclose(60.0 / periods, np.arange(2.0, 20.0, 0.5))
    np.testing.assert_allclose(module._periods_min(np.array([0.0, 240.0])), [2.0])
    assert module._periods_min(np.array([0.0, 1e6])).size == 300
    # A clock that falls back by centuries: a grid cut afterwards would take 20 GB.
    assert module._periods_min(np.array([0.0, 5e11])).size == 300


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


def test_waves_of_a_long_test_lie_in_parts_with_the_same_power(monkeypatch, rng):
    seconds, periods = 60.0 * np.arange(200.0), np.array([60.0, 30.0, 20.0, 15.0, 12.0])
    series = rng.standard_normal((3, 200))
    (whole,) = module._waves(seconds, periods)
    expected = module._time_statistics(series, 10, [whole])
    monkeypatch.setattr(module, "_WAVES_AT_ONCE", 1000)
    monkeypatch.setattr("thermography.large_arrays.IN_MEMORY_BYTES", 100)
    parts = module._waves(seconds, periods)
    assert [part.shape for part in parts] == [(200, 4), (200, 4), (200, 2)]
    # Products in single precision.
    np.testing.assert_allclose(module._time_statistics(series, 10, parts)[2], expected[2], rtol=1e-5)
