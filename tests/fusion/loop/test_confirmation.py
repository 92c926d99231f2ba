"""Confirmation on unused readings, and the question to the hold-out set, against dense algebra and by planted effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.alignment.readings import Readings
from fusion.effects.effect import Candidate, Prior
from fusion.loop.confirmation import CandidateScorer, _judged, ask_hold_out, prior_rows
from fusion.loop.state import Confirmed, Score
from fusion.model.drift_variances import SHIFT_AND_STRETCH, scaled_systems
from fusion.model.fit import ModelFit
from fusion.model.products import by_width
from fusion.model.profile_gain import profile_gains
from tests.fusion.small_campaign import campaign, dense_covariance, model_of, term

BARE = campaign(cycles=20)
WAVE = np.sin(BARE.seconds / 100.0)
TRAINING = BARE.cycle <= 16


def measured(*named: np.ndarray, seed: int = 5) -> Readings:
    """Readings with noise of 0.1 um and what is named."""
    return replace(BARE, response=0.1 * np.random.default_rng(seed).standard_normal(BARE.seconds.size) + sum(named))


def candidate(columns: np.ndarray, **changes) -> Candidate:
    columns = columns if columns.ndim == 2 else columns[:, None]
    return Candidate(columns, {}, ("um",) * columns.shape[1], **changes)


def score(chosen: Candidate, *, family_wise_p: float = 0.01, name: str = "a") -> Score:
    return Score(name, chosen, family_wise_p=family_wise_p)


def test_priors_are_rows_in_units_of_the_noise(rng):
    known = term(WAVE, prior=Prior(mean=3.0, u=0.5))
    model = model_of(measured(), [term(WAVE**2), known])
    rows = prior_rows(model, rng, draws=4000)
    profile = BARE.profile.shape[1]
    expected = np.zeros((1, profile + 2))
    expected[0, profile + 1] = model.fit.sigma / 0.5
    np.testing.assert_allclose(rows.design, expected)
    np.testing.assert_allclose(rows.response, [model.fit.sigma * 3.0 / 0.5])
    # In a simulated response the coefficient is zero, and its prior off by its uncertainty.
    assert rows.draws.shape == (1, 4000)
    assert rows.draws.std() == pytest.approx(model.fit.sigma, rel=0.05)
    assert prior_rows(model_of(measured()), rng, draws=7).draws.shape == (0, 7)


@pytest.mark.parametrize(
    ("p_value", "family_wise_p", "passed", "way"),
    [
        (0.1, 0.01, True, Confirmed.LATER_CYCLES),
        (0.101, 0.01, False, Confirmed.BY_EVIDENCE),
        (0.101, 0.001, True, Confirmed.BY_EVIDENCE),
        (0.101, 0.00101, False, Confirmed.BY_EVIDENCE),
        # Where half of the campaigns without the effect gain as much, the confirmation is not inconclusive any more.
        (0.5, 0.0001, True, Confirmed.BY_EVIDENCE),
        (0.501, 3e-7, False, Confirmed.BY_EVIDENCE),
        (0.501, 2.9e-7, True, Confirmed.BY_EVIDENCE),
    ],
)
def test_an_effect_passes_at_a_tenth_or_by_strong_evidence(p_value, family_wise_p, passed, way):
    told = _judged(score(candidate(WAVE), family_wise_p=family_wise_p), 2.5, p_value)
    assert (told.passed, told.way, told.gain, told.p_value) == (passed, way, 2.5, p_value)


def test_an_event_is_confirmed_on_other_targets():
    event = score(candidate(WAVE, event_s=10.0))
    assert _judged(event, 1.0, 0.05).way is Confirmed.OTHER_TARGETS


def test_the_null_is_simulated_for_the_training_readings(rng):
    model = model_of(measured(), used=TRAINING)
    scorer = CandidateScorer.of(model, rng)
    cycle = BARE.cycle[TRAINING]
    np.testing.assert_array_equal(scorer.early, cycle <= 8)
    np.testing.assert_array_equal(scorer.halves, BARE.target[TRAINING] % 2 == 1)
    assert scorer.draws.shape == (cycle.size, 200)
    assert scorer.used is model.used and scorer.fit is model.fit
    # Of an odd number of cycles the one in the middle is early.
    odd = CandidateScorer.of(model_of(measured(), used=BARE.cycle <= 15), rng)
    np.testing.assert_array_equal(odd.early, cycle[cycle <= 15] <= 8)
    assert len(scorer.systems()) == len(SHIFT_AND_STRETCH)


def test_every_coefficient_beyond_the_first_costs_one_unit(rng):
    scorer = CandidateScorer.of(model_of(measured(WAVE), used=TRAINING), rng)
    one = candidate(WAVE)
    # A further column that is orthogonal to everything gains next to nothing, and costs one.
    useless = rng.standard_normal(BARE.seconds.size)
    two = candidate(np.column_stack([WAVE, 1e-6 * useless]))
    gains = scorer.gains([one, two], simulated=False)
    assert gains.gain.shape == (2, 1)
    alone = scorer.gains([candidate(useless)], simulated=False).gain[0, 0]
    # What the useless column gains by chance is that of a fit beside the wave: small, and never negative.
    assert -1.0 <= gains.gain[1, 0] - gains.gain[0, 0] < 3.0
    assert alone < 3.0 and gains.gain[0, 0] > 20.0
    assert scorer.gains([one]).gain.shape == (1, 201)
    bare = profile_gains(
        scorer.systems(), scorer.fit.response[:, None], scorer.fit.design, by_width([one, two], scorer.used)
    )
    np.testing.assert_allclose(gains.gain, bare.gain - np.array([[0.0], [1.0]]), rtol=1e-9)


def test_a_few_readings_at_a_time_gain_what_all_together_gain(monkeypatch, rng):
    scorer = CandidateScorer.of(model_of(measured(), used=TRAINING), rng)
    candidates = [candidate(rng.standard_normal((BARE.seconds.size, width))) for width in (1, 2, 1, 3, 2)]
    whole = scorer.gains(candidates)
    monkeypatch.setattr("fusion.model.products._VALUES_AT_ONCE", 5 * 220)
    parts = scorer.gains(candidates)
    # Sums in another order are rounded otherwise.
    np.testing.assert_allclose(parts.gain, whole.gain, atol=1e-8)
    np.testing.assert_array_equal(parts.drift_place, whole.drift_place)
    np.testing.assert_array_equal(parts.separable, whole.separable)


def test_an_effect_that_lasts_is_confirmed_and_one_that_is_absent_is_not(rng):
    model = model_of(measured(WAVE), used=TRAINING)
    absent = np.cos(BARE.seconds / 37.0)
    scorer = CandidateScorer.of(model, rng)
    families = {"a": [candidate(WAVE)], "b": [candidate(absent)]}
    present, missing = scorer.confirm([score(families["a"][0]), score(families["b"][0], name="b")], families)
    assert present.confirmation.passed and present.confirmation.p_value == pytest.approx(1 / 201)
    assert present.confirmation.gain > 20.0
    assert present.confirmation.way is Confirmed.LATER_CYCLES
    assert not missing.confirmation.passed and missing.confirmation.gain < 2.0
    assert (present.name, missing.name) == ("a", "b")


def test_which_candidate_is_confirmed_is_decided_without_the_later_cycles(rng):
    """Two candidates agree early; the one that also fits the later cycles must not be chosen for that."""
    early = BARE.cycle <= 8
    right, wrong = WAVE, np.where(early, 1.01 * WAVE, -WAVE)
    response = np.where(early, 1.01 * WAVE + 0.05 * wrong, WAVE)
    model = model_of(measured(response), used=TRAINING)
    scorer = CandidateScorer.of(model, rng)
    noise = rng.standard_normal(BARE.seconds.size)
    worse_early = candidate(np.where(early, WAVE + 0.3 * noise, right))
    better_early = candidate(wrong)
    (told,) = scorer.confirm([score(worse_early)], {"a": [worse_early, better_early]})
    # The candidate that is better early predicts the later cycles with the wrong sign.
    assert told.confirmation.gain < 0.0
    (alone,) = scorer.confirm([score(worse_early)], {"a": [worse_early]})
    assert alone.confirmation.gain > 10.0


def test_an_event_that_all_targets_show_is_confirmed_and_one_of_half_of_them_is_not(rng):
    late = BARE.seconds >= 1000.0
    instants = [candidate(BARE.seconds >= t, event_s=t) for t in (700.0, 1000.0, 1300.0)]
    instants = [replace(one, columns=one.columns.astype(float)) for one in instants]
    for shown, passed in ((late, True), (late & (BARE.target % 2 == 0), False)):
        model = model_of(measured(0.4 * shown), used=TRAINING)
        (told,) = CandidateScorer.of(model, rng).confirm([score(instants[1])], {"a": instants})
        assert told.confirmation.passed is passed
        if passed:
            assert told.confirmation.way is Confirmed.OTHER_TARGETS


def dense_hold_out_errors(model: ModelFit, columns: np.ndarray) -> list[float]:
    """Errors of every drift of the grid with the likelihood of the training readings: the most likely one counts."""
    readings, used = model.readings, model.used
    whole = np.column_stack([readings.profile, columns])
    told = []
    for system in scaled_systems(model.fit, SHIFT_AND_STRETCH, over=model.whole_system()):
        v = dense_covariance(readings, system.ratios)
        early, late = v[np.ix_(used, used)], v[np.ix_(~used, used)]
        root = np.linalg.cholesky(early)
        y, x = np.linalg.solve(root, readings.response[used]), np.linalg.solve(root, whole[used])
        beta = np.linalg.lstsq(x, y, rcond=None)[0]
        variance = ((y - x @ beta) ** 2).mean()
        likelihood = -0.5 * y.size * np.log(variance) - np.log(np.diag(root)).sum()
        residual = readings.response - whole @ beta
        missed = residual[~used] - late @ np.linalg.solve(early, residual[used])
        told.append((likelihood, float(np.sqrt((missed**2).mean()))))
    return max(told)[1]


def test_the_hold_out_set_is_asked_with_the_drift_that_suits_each_model_best(rng):
    walk = np.cumsum(0.05 * rng.standard_normal(BARE.seconds.size))
    model = model_of(measured(0.2 * WAVE, walk), used=TRAINING)
    before, after, p_value = ask_hold_out(model, candidate(WAVE), rng)
    assert before == pytest.approx(dense_hold_out_errors(model, np.empty((BARE.seconds.size, 0))), rel=1e-5)
    assert after == pytest.approx(dense_hold_out_errors(model, WAVE[:, None]), rel=1e-5)
    assert 1 / 201 <= p_value <= 1.0


def test_an_effect_that_is_present_answers_the_question(rng):
    model = model_of(measured(WAVE), used=TRAINING)
    before, after, p_value = ask_hold_out(model, candidate(WAVE), rng)
    assert after < 0.15 < 0.5 < before
    # The model without the effect holds it for noise; in none of its simulated campaigns is the error so small.
    assert p_value == pytest.approx(1 / 201)
    _, _, p_value = ask_hold_out(model_of(measured(), used=TRAINING), candidate(np.cos(BARE.seconds / 37.0)), rng)
    assert p_value > 0.02


def test_a_column_of_zeros_changes_nothing(rng):
    before, after, _ = ask_hold_out(model_of(measured(), used=TRAINING), candidate(np.zeros(BARE.seconds.size)), rng)
    assert after == pytest.approx(before, rel=1e-9)


def test_the_question_to_a_long_hold_out_set_is_answered_in_parts(monkeypatch):
    at_once = ask_hold_out(model_of(measured(), used=TRAINING), candidate(WAVE), np.random.default_rng(3))
    monkeypatch.setattr("fusion.loop.confirmation._VALUES_AT_ONCE", 5000)
    monkeypatch.setattr("thermography.fields.tasks.spool.IN_MEMORY_BYTES", 100)
    in_parts = ask_hold_out(model_of(measured(), used=TRAINING), candidate(WAVE), np.random.default_rng(3))
    # The products of matrices of another width are rounded differently.
    np.testing.assert_allclose(in_parts, at_once, rtol=1e-9)
