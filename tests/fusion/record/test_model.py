"""The model of a record: every channel fitted by itself, gains added over channels, draws alike where channels are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.effects.effect import Candidate
from fusion.model.drift_variances import SINGLE, scaled_systems
from fusion.model.fit import Term
from fusion.model.products import by_width
from fusion.model.profile_gain import profile_gains
from fusion.record.blocks import RecordError, reduce_record
from fusion.record.hold_out import declare
from fusion.record.model import channel_gains, columns_of, fit_record, simulate_channels
from tests.fusion.record_tables import record_of, table_of

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


def test_columns_of_terms_stand_side_by_side(rng):
    record = record_of(np.zeros((BLOCKS, 1)), np.zeros((BLOCKS, 1)))
    first, second = rng.standard_normal((BLOCKS, 2)), rng.standard_normal(BLOCKS)
    np.testing.assert_array_equal(columns_of(record, [term(first), term(second)]), np.column_stack([first, second]))
    assert columns_of(record, []).shape == (BLOCKS, 0)


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


def test_declared_temperatures_are_columns_of_every_channel(rng):
    temperature = 20.0 + np.cumsum(rng.standard_normal((BLOCKS, 2)), axis=0)
    rise = temperature - temperature[0]
    record = record_of(rise @ [[1.0], [-2.0]] + 0.01 * rng.standard_normal((BLOCKS, 1)), temperature)
    model = fit_record(record, declare(["quasi_static"], record), ALL)
    np.testing.assert_allclose(model.channels[0].coefficients[1:3], [1.0, -2.0], atol=0.05)


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
