"""The remainder of a model: a planted pattern is found, described and measured; a complete model leaves none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fusion.diagnosis import remainder as module
from fusion.diagnosis.remainder import LEVEL, Remainder, examine
from fusion.effects.library import library
from fusion.model.fit import Term, fit_model
from fusion.twin.machine.recipe import EffectRecipe
from tests.fusion.loop_bench import DECLARED, readings_of


def remainder_of(*effects: EffectRecipe, set_aside: tuple[tuple[int, str], ...] = ()) -> Remainder:
    readings = readings_of(*effects, seed=5)
    terms = [Term(name, next(iter(library()[name].candidates(readings, {}, None)))) for name in DECLARED]
    fit = fit_model(readings, terms).fit
    return examine(readings, fit, np.random.default_rng(1), set_aside=set_aside)


def test_complete_model_leaves_no_pattern():
    remainder = remainder_of()
    assert remainder.p_value > LEVEL
    assert (remainder.shape, remainder.rms_um) == ("", 0.0)


@pytest.fixture(scope="module")
def switching() -> Remainder:
    return remainder_of(EffectRecipe("telegraph_switching", amplitude_um=1.0))


def test_planted_pattern_is_found_where_it_acts(switching):
    assert switching.p_value < LEVEL
    assert "negative direction only" in switching.shape
    weight = dict(zip(switching.sites, np.abs(switching.along_sites), strict=True))
    assert min(weight[(target, "negative")] for target in range(9, 13)) > 0.5
    assert max(weight[(target, "positive")] for target in range(1, 17)) < 0.5


def test_pattern_explains_itself_and_noise_does_not(switching, rng):
    assert switching.share_of(switching.series[:, None]) == pytest.approx(1.0, abs=0.01)
    # one column of 1,900 readings explains 1 / 1,900 of anything by chance
    assert switching.share_of(rng.standard_normal((switching.series.size, 1))) < 0.01


def test_the_noise_is_tested_in_units_of_its_own_and_each_site_alike(monkeypatch):
    readings = readings_of(seed=5)
    fit = fit_model(
        readings, [Term(name, next(iter(library()[name].candidates(readings, {}, None)))) for name in DECLARED]
    ).fit
    seen, statistics = [], module._statistics
    monkeypatch.setattr(module, "_statistics", lambda *given: seen.append(given) or statistics(*given))
    remainder = examine(readings, fit, np.random.default_rng(1))
    # The null is made first; the residual itself is the last that is looked at.
    matrix, signs, place = seen[-1]
    noise, share = fit.noise()
    for k in (0, 1, matrix.shape[1] - 1):
        at = (readings.target == remainder.sites[k][0]) & ((readings.sign > 0) == (remainder.sites[k][1] == "positive"))
        standard = (noise / np.sqrt(share) / fit.sigma)[at].clip(-4.0, 4.0)
        np.testing.assert_allclose(matrix[:, k], (standard - standard.mean()) / standard.std(), atol=1e-9)
        assert place[k] == pytest.approx(readings.share[at][0])
    assert signs.tolist() == [1.0 if direction == "positive" else -1.0 for _, direction in remainder.sites]


def test_sites_that_are_set_aside_are_not_tested():
    aside = tuple((target, "negative") for target in range(9, 13))
    remainder = remainder_of(EffectRecipe("telegraph_switching", amplitude_um=1.0), set_aside=aside)
    assert not set(aside) & set(remainder.sites)
    assert remainder.p_value > LEVEL


def test_slowness_is_what_first_differences_lack():
    """Four differences of 1 in a ramp of five: 1 - 0.5 * 4 / 10 * 5 / 4; alternation has twice the differences of noise."""
    assert module._slowness(np.arange(5.0)) == pytest.approx(0.75)
    assert module._slowness(10.0 + 3.0 * np.arange(5.0)) == pytest.approx(0.75)
    assert module._slowness(np.tile([1.0, -1.0], 50)) == pytest.approx(-1.0)
    assert module._slowness(np.full(9, 2.0)) == module._slowness(np.arange(3.0)) == 0.0


def test_statistics_of_patterns_that_are_known():
    """Ten cycles at four targets from both sides; one pattern over time and sites, with the length of its two parts."""
    place = np.repeat([0.0, 1.0, 2.0, 3.0], 2) / 3.0
    signs = np.tile([1.0, -1.0], 4)
    time = np.repeat([1.0, -1.0], 5)
    even = module._statistics(np.outer(time, np.ones(8)), signs, place)
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
            module._statistics(np.outer(time, shape) + little, signs, place)[3:], expected, atol=1e-3
        )
    # Fewer cycles than two blocks have no slow pattern.
    np.testing.assert_array_equal(module._statistics(np.outer(time[:9], signs), signs, place)[1:3], 0.0)


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
            "irregular, 21 changes of side over 40 cycles (switching or wandering)",
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
    assert found.shape == (
        f"a slow, {course} drift that no effect of the library follows; growing along the axis, both directions"
    )
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
        LEVEL, {}, "one step", 1.0, np.arange(2), np.zeros(2), [], np.zeros(0), np.zeros(4), lambda given: given
    )
    assert not shown.is_tested
    assert replace(shown, p_value=0.99 * LEVEL).is_tested
    assert not replace(shown, p_value=0.0, shape="").is_tested


def test_a_column_explains_the_share_of_what_it_fits_beside_the_model():
    remainder = Remainder(
        0.5, {}, "", 0.0, np.arange(2), np.zeros(2), [], np.zeros(0), np.array([3.0, 4.0, 0.0]), lambda columns: columns
    )
    assert remainder.share_of(np.array([[1.0], [0.0], [0.0]])) == pytest.approx(9 / 25)
    assert not remainder.is_tested


def test_targets_are_told_as_ranges():
    assert module._runs([1, 2, 5, 6, 7, 9]) == "1-2, 5-7, 9"
