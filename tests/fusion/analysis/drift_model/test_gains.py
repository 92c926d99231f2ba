"""Confirmation on unused readings, and the question to the hold-out set, against dense algebra and by planted effects."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from fusion.analysis.alignment.readings import Readings
from fusion.analysis.drift_model.admissibility import CandidateScorer, _judged, prior_rows
from fusion.analysis.drift_model.gains import (
    by_width,
    orthogonalise,
    profile_gains,
    reductions,
    side_by_side,
    sum_products,
    sum_products_apart,
)
from fusion.analysis.drift_model.model import SHIFT_AND_STRETCH, PriorRows, moments_of
from fusion.analysis.drift_model.search import Confirmed, Score
from fusion.analysis.effects.effect import Candidate, Prior, Separable
from interferometry.drift.gls import DriftSystem, drift_system
from tests.fusion.analysis.drift_model.test_model import squares_beside
from tests.fusion.small_campaign import campaign, model_of, term

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


# Products of whitened columns against dense algebra, and what candidates explain against one `lstsq` each.


def still(n: int) -> DriftSystem:
    """A drift that is not there: whitened columns are the columns."""
    return drift_system(np.arange(float(n)), np.ones((n, 1)), order=1, ratios=np.zeros(1))


def drifting(n: int) -> DriftSystem:
    """A common drift and a stretch that wander smoothly."""
    loadings = np.column_stack([np.ones(n), np.resize([0.0, 0.5, 1.0], n)])
    return drift_system(7.0 * np.arange(n), loadings, order=2, ratios=np.array([1e-4, 1e-5]))


def explained(candidates: list[Candidate], responses: np.ndarray, model: np.ndarray) -> tuple:
    """Reductions where nothing drifts."""
    n = responses.shape[0]
    (products,) = sum_products([still(n)], [responses], model, by_width(candidates, np.ones(n, bool)))
    return reductions(products, orthogonalise(products))


def whitened_columns(candidates: list[Candidate], system: DriftSystem) -> np.ndarray:
    """Columns as the groups order them, whitened at once."""
    n = system.seconds.size
    groups = by_width(candidates, np.ones(n, bool))
    return system.whiten(np.concatenate([group.columns(slice(None)) for group in groups], axis=1))[0]


def candidates_of_three_kinds(rng: np.random.Generator, n: int) -> list[Candidate]:
    """Width 1, 2, and 2 of which the last column is no evidence, mixed."""
    widths = [(1, 0), (2, 0), (2, 1), (1, 0), (3, 2)]
    return [Candidate(rng.standard_normal((n, width)), {}, ("um",) * width, beside=beside) for width, beside in widths]


def test_products_are_those_of_columns_that_are_whitened_at_once(monkeypatch, rng):
    """However few readings are whitened together."""
    n = 41
    system, candidates = drifting(n), candidates_of_three_kinds(rng, n)
    responses, model = rng.standard_normal((n, 2)), rng.standard_normal((n, 3))
    groups = by_width(candidates, np.ones(n, bool))
    y, x = (system.whiten(columns)[0] for columns in (responses, model))
    c = whitened_columns(candidates, system)
    for values in (1, 100, 10**6):
        monkeypatch.setattr("fusion.analysis.drift_model.gains._VALUES_AT_ONCE", values)
        (told,) = sum_products([system], [responses[:, :1], responses[:, 1:]], model, groups)
        # The design enters by combinations of its columns.
        np.testing.assert_allclose(told.design, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(told.cross, told.basis.T @ x.T @ y, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(told.squares, (y**2).sum(axis=0), rtol=1e-9)
        np.testing.assert_allclose(told.with_responses, y.T @ c, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(told.with_design, told.basis.T @ x.T @ c, rtol=1e-9, atol=1e-9)
        slots = told.slots()
        for within, of_group in zip(told.within, slots, strict=True):
            columns = np.stack([c[:, slot] for slot in of_group], axis=2)
            np.testing.assert_allclose(within, np.einsum("nmi,nmj->mij", columns, columns), rtol=1e-9, atol=1e-9)
        assert told.readings == n
        assert told.log_spread == pytest.approx(np.log(system.innovations(model)[1]).sum(), rel=1e-9)


def test_products_apart_are_those_of_each_part_under_the_same_drift(rng):
    n = 41
    system, candidates = drifting(n), candidates_of_three_kinds(rng, n)
    responses, model = rng.standard_normal((n, 2)), rng.standard_normal((n, 3))
    part = rng.random(n) < 0.4
    (told,) = sum_products_apart([system], [responses], model, by_width(candidates, np.ones(n, bool)), part)
    spread = system.innovations(model)[1]
    for products, here in zip(told, (part, ~part), strict=True):
        y, x = (system.whiten(columns)[0][here] for columns in (responses, model))
        models = products.models()
        assert len(models) == 1 + len(candidates)
        # What is no evidence, the last columns of a candidate, stands before the rest.
        ordered = [np.roll(one.columns, one.beside, axis=1) for one in candidates]
        designs = [x, *(np.column_stack([x, system.whiten(columns)[0][here]]) for columns in ordered)]
        for one, design in zip(models, designs, strict=True):
            whole = moments_of(y, design, spread[here])
            np.testing.assert_allclose(one.design, whole.design, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(one.cross, whole.cross, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(one.squares, whole.squares, rtol=1e-9)
            assert one.readings == here.sum()
            assert one.log_spread == pytest.approx(whole.log_spread, rel=1e-9)


def test_products_are_freed_of_the_design_by_its_coefficients(rng):
    n = 30
    columns, y, x = rng.standard_normal((n, 4)), rng.standard_normal((n, 2)), rng.standard_normal((n, 3))
    events = [Candidate(column[:, None], {}, ("um",)) for column in columns.T]
    part = np.arange(n) < 12
    ((first, _),) = sum_products_apart([still(n)], [y], x, by_width(events, np.ones(n, bool)), part)
    of_y, of_c = rng.standard_normal((3, 2)), rng.standard_normal((3, 4))
    crossed, own = first.freed(of_y, of_c)
    free_y, free_c = (y - x @ of_y)[part], (columns - x @ of_c)[part]
    np.testing.assert_allclose(crossed, free_c.T @ free_y, rtol=1e-10)
    np.testing.assert_allclose(own, (free_c**2).sum(axis=0), rtol=1e-10)


def test_responses_are_freed_of_a_design_with_priors_whatever_its_units(rng):
    n = 30
    x = rng.standard_normal((n, 3)) * np.array([1e-6, 1.0, 1e4])
    x = np.column_stack([x, np.zeros(n), 2.0 * x[:, 2]])
    y, candidate = rng.standard_normal((n, 2)), Candidate(rng.standard_normal((n, 1)), {}, ("um",))
    priors = PriorRows(np.array([[3e-6, 1.0, 0.0, 0.0, 0.0]]), np.array([0.7]), np.array([[-0.2]]))
    system = drifting(n)
    (products,) = sum_products([system], [y], x, by_width([candidate], np.ones(n, bool)))
    told = orthogonalise(products, priors)
    white_y, white_x = (system.whiten(columns)[0] for columns in (y, x))
    all_y, all_x = priors.append(white_y, white_x)
    c = np.vstack([system.whiten(candidate.columns)[0], [[0.0]]])
    scale = np.maximum(np.linalg.norm(all_x, axis=0), 1e-300)
    left = all_y - all_x / scale @ np.linalg.lstsq(all_x / scale, all_y, rcond=1e-12)[0]
    np.testing.assert_allclose(told.squares, (left**2).sum(axis=0), rtol=1e-8)
    np.testing.assert_allclose(told.with_responses, left.T @ c, rtol=1e-8)
    inside = all_x / scale @ np.linalg.lstsq(all_x / scale, c, rcond=1e-12)[0]
    assert (told.along_design**2).sum() == pytest.approx((inside**2).sum(), rel=1e-8)


def test_reductions_equal_one_least_squares_fit_for_every_candidate_and_response(rng):
    n = 40
    candidates = candidates_of_three_kinds(rng, n)
    model, responses = rng.standard_normal((n, 3)), rng.standard_normal((n, 2))
    reduced, given, separable = explained(candidates, responses, model)
    assert separable.all()
    for place, candidate in enumerate(candidates):
        evidence = candidate.columns.shape[1] - candidate.beside
        for k in range(2):
            alone = squares_beside(responses[:, k], model)
            whole = squares_beside(responses[:, k], np.column_stack([model, candidate.columns]))
            started = squares_beside(responses[:, k], np.column_stack([model, candidate.columns[:, evidence:]]))
            assert reduced[k, place] == pytest.approx(alone - whole, rel=1e-8)
            assert given[k, place] == pytest.approx(alone - started if candidate.beside else 0.0, rel=1e-8, abs=1e-12)


@pytest.mark.parametrize(("share", "separable"), [(0.9e-4, False), (1.1e-4, True)])
def test_a_candidate_of_which_the_model_holds_all_but_a_ten_thousandth_explains_nothing(rng, share, separable):
    q, _ = np.linalg.qr(rng.standard_normal((20, 3)))
    model, outside, y = q[:, :1], q[:, 1], q[:, 1:2]
    column = np.sqrt(1.0 - share) * model[:, 0] + np.sqrt(share) * outside
    reduced, _, told = explained([Candidate(5.0 * column[:, None], {}, ("um",))], y, model)
    assert told.tolist() == [separable]
    # What is outside the model points along the response: all of it is explained, or nothing.
    assert reduced[0, 0] == pytest.approx(1.0 if separable else 0.0, abs=1e-6)


@pytest.mark.parametrize("width", [1, 4])
def test_a_candidate_with_a_column_of_zeros_explains_nothing(rng, width):
    """A driver that is logged and never runs makes such columns; the other candidates are not touched by them."""
    columns = rng.standard_normal((20, width))
    columns[:, 0] = 0.0
    candidates = [Candidate(c, {}, ("um",) * width) for c in (columns, rng.standard_normal((20, width)))]
    y = rng.standard_normal((20, 1))
    reduced, _, separable = explained(candidates, y, np.zeros((20, 1)))
    assert separable.tolist() == [False, True]
    assert reduced[0, 0] == 0.0
    assert reduced[0, 1] == pytest.approx(y[:, 0] @ y[:, 0] - squares_beside(y[:, 0], candidates[1].columns))


def waves(rng: np.random.Generator, n: int, count: int) -> list[Candidate]:
    """Candidates of two columns that follow two courses in time at three places, in different shares."""
    place, courses = np.resize([0, 1, 2], n), tuple(rng.standard_normal((2, n)))
    return [
        Candidate(Separable((courses[k % 2],) * 2, place, rng.standard_normal((3, 2))), {}, ("um", "um"))
        for k in range(count)
    ]


def test_few_courses_at_few_places_tell_the_products_of_many_candidates(rng):
    n, used = 60, np.arange(60) % 4 > 0
    candidates = [*candidates_of_three_kinds(rng, n), *waves(rng, n, 9)]
    plain = [replace(one, columns=np.asarray(one.columns)) for one in candidates]
    y, x = rng.standard_normal((45, 2)), rng.standard_normal((45, 3))
    placed, whole = (by_width(some, used) for some in (candidates, plain))
    # Two courses at three places are six columns, those of nine candidates eighteen.
    assert sum(group.held for group in whole) - sum(group.held for group in placed) == 12
    (told,), (expected,) = (sum_products([drifting(45)], [y], x, groups) for groups in (placed, whole))
    for one, other in zip(
        reductions(told.of_candidates(), orthogonalise(told.of_candidates())),
        reductions(expected.of_candidates(), orthogonalise(expected)),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-8)


# Gains in profile log-likelihood, against dense algebra: one covariance matrix for every system, one fit for every candidate.


N = 24
SECONDS = np.cumsum(np.r_[0.0, np.tile([10.0, 25.0, 40.0], 8)])[:N]
LOADINGS = np.column_stack([np.ones(N), np.tile([0.25, 0.5, 0.75, 1.0], 6)])
ALL = np.ones(N, bool)


def systems() -> list[DriftSystem]:
    """A drift that is hardly there, a common one, and a stretch."""
    ratios = ([1e-9, 1e-9], [2e-2, 1e-9], [1e-9, 5e-1])
    return [drift_system(SECONDS, LOADINGS, order=1, ratios=np.array(pair)) for pair in ratios]


def covariance_of(system: DriftSystem) -> np.ndarray:
    """Covariance of the readings over sigma squared: noise, and random walks that start at zero."""
    walk = np.minimum.outer(system.seconds, system.seconds)
    parts = zip(system.ratios, system.loadings.T, strict=True)
    return np.eye(N) + sum(ratio * np.outer(loading, loading) * walk for ratio, loading in parts)


def dense_likelihood(system: DriftSystem, y: np.ndarray, x: np.ndarray, rows: tuple = ()) -> float:
    """Profile log-likelihood up to a constant; ``rows`` are priors (row of the design, response) in units of the noise."""
    root = np.linalg.cholesky(covariance_of(system))
    y, x = np.linalg.solve(root, y), np.linalg.solve(root, x)
    for row, value in rows:
        x, y = np.vstack([x, row]), np.r_[y, value]
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float(-0.5 * N * np.log(left @ left) - np.log(np.diag(root)).sum())


def drawn(rng: np.random.Generator, system: DriftSystem, count: int) -> np.ndarray:
    return np.linalg.cholesky(covariance_of(system)) @ rng.standard_normal((N, count))


def test_every_gain_is_that_of_the_drift_that_suits_the_candidate_best(rng):
    tried = systems()
    design = np.column_stack([LOADINGS, rng.standard_normal(N)])
    columns = [rng.standard_normal((N, width)) for width in (1, 2, 1)]
    candidates = [Candidate(column, {}, ("um",) * column.shape[1]) for column in columns]
    responses = np.column_stack([drawn(rng, system, 2) for system in tried])
    # With its candidate each first response is best explained by another drift than without it.
    responses[:, 0] += 3.0 * columns[2][:, 0]
    gains = profile_gains(tried, responses, design, by_width(candidates, ALL))
    likelihoods = np.empty((3, len(candidates), responses.shape[1]))
    without = np.empty((3, responses.shape[1]))
    for s, system in enumerate(tried):
        for r, y in enumerate(responses.T):
            without[s, r] = dense_likelihood(system, y, design)
            for k, column in enumerate(columns):
                likelihoods[s, k, r] = dense_likelihood(system, y, np.column_stack([design, column]))
    np.testing.assert_allclose(gains.gain, likelihoods.max(axis=0) - without.max(axis=0), rtol=1e-6, atol=1e-8)
    np.testing.assert_array_equal(gains.drift_place, likelihoods[:, :, 0].argmax(axis=0))
    # More than one drift is chosen, or the test would not see which.
    assert len(set(likelihoods.argmax(axis=0).ravel().tolist())) > 1
    assert gains.separable.all()


def test_what_may_be_present_without_the_effect_is_no_evidence_for_it(rng):
    tried = systems()
    candidate = Candidate(rng.standard_normal((N, 2)), {}, ("um", "um"), beside=1)
    memory = candidate.columns[:, 1:]
    weak, strong = (drawn(rng, tried[0], 1)[:, 0], drawn(rng, tried[0], 1)[:, 0] + 4.0 * memory[:, 0])
    gains = profile_gains(tried, np.column_stack([weak, strong]), LOADINGS, by_width([candidate], ALL))
    for r, y in enumerate((weak, strong)):
        with_all, started, bare = (
            max(dense_likelihood(system, y, np.column_stack([LOADINGS, columns])) for system in tried)
            for columns in (candidate.columns, memory, memory[:, :0])
        )
        # One unit of log-likelihood is the price of the memory; a model without it is held against where that is better.
        assert (started - 1.0 > bare) is (r == 1)
        assert gains.gain[0, r] == pytest.approx(with_all - max(bare, started - 1.0), rel=1e-6)


def test_a_prior_holds_its_coefficient(rng):
    tried = systems()
    design = np.column_stack([LOADINGS, np.linspace(0.0, 1.0, N)])
    candidate = Candidate(np.linspace(0.0, 1.0, N)[:, None] ** 2, {}, ("um",))
    response = drawn(rng, tried[0], 1) + 2.0 * design[:, 2:]
    row = np.array([0.0, 0.0, 5.0])
    priors = PriorRows(row[None, :], np.array([1.5]), np.empty((1, 0)))
    gains = profile_gains(tried, response, design, by_width([candidate], ALL), priors=priors)
    with_it = max(
        dense_likelihood(s, response[:, 0], np.column_stack([design, candidate.columns]), ((np.r_[row, 0.0], 1.5),))
        for s in tried
    )
    without = max(dense_likelihood(s, response[:, 0], design, ((row, 1.5),)) for s in tried)
    assert gains.gain[0, 0] == pytest.approx(with_it - without, rel=1e-6)
    free = profile_gains(tried, response, design, by_width([candidate], ALL))
    assert free.gain[0, 0] != pytest.approx(gains.gain[0, 0], rel=1e-3)


def test_a_response_that_is_the_candidate_itself_has_a_finite_gain(rng):
    candidate = Candidate(rng.standard_normal((N, 1)), {}, ("um",))
    gains = profile_gains(systems()[:1], candidate.columns, LOADINGS, by_width([candidate], ALL))
    # A share of 1e-12 of the squares is left: half of 24 readings times log(1e12).
    assert gains.gain[0, 0] == pytest.approx(12.0 * np.log(1e12), rel=1e-6)


# Work side by side: results in order, few items ahead, faults in their place.


def test_results_come_in_the_order_of_the_items():
    second_done = threading.Event()

    def slow_first(item: int) -> int:
        if item == 0:
            assert second_done.wait(10.0)
        second_done.set()
        return item * item

    assert list(side_by_side(slow_first, range(20))) == [item * item for item in range(20)]


def test_few_items_are_taken_ahead_of_the_results():
    taken = []

    def items():
        for item in range(100):
            taken.append(item)
            yield item

    results = side_by_side(lambda item: item, items())
    assert next(results) == 0
    assert len(taken) <= 3


def test_a_fault_stands_in_the_place_of_its_result():
    results = side_by_side(lambda item: 1 / item, [1, 0, 2])
    assert next(results) == 1.0
    with pytest.raises(ZeroDivisionError):
        next(results)
